"""What all readers of a language of nested brackets share: targets, frames, assignments, and
arguments of routines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

from pincal.programs.draft import Draft
from pincal.programs.flow import Code, InForce, Step, leaves
from pincal.programs.line_flow import STATED_LOAD
from pincal.programs.program import Frame, Load, Point, Skipped
from pincal.programs.syntax import (
    Brackets,
    Statement,
    calls_in,
    element_name,
    split,
    text_of_items,
    words_in,
)

PARAMETER = "a parameter of the routine"
EXTERNAL = "an external axis is not at 0"


@dataclass(frozen=True)
class Reader:
    """Reads one file of a program.

    Attributes:
        draft: collects what is found.
        file: index of the file.
        code: the file.
        harmless: names of functions and routines that change none of their arguments.
        entries: in which state routines start.
        case: whether names are case-sensitive.
    """

    draft: Draft
    file: int
    code: Code
    harmless: frozenset[str]
    entries: Entries
    case: ClassVar[bool] = False

    @property
    def statements(self) -> Sequence[Statement]:
        """The statements of the file."""
        return self.code.statements

    @property
    def steps(self) -> Sequence[Step]:
        """The effect of each on the control flow."""
        return self.code.steps

    @property
    def flow(self) -> Sequence[InForce]:
        """What is known before each."""
        return self.code.flow

    def literal(self, line: int, name: str, items: Sequence[Any]) -> Point | Skipped | None:
        """Return the point that items state in numbers, why it can't be used, or None for another
        expression.
        """
        raise NotImplementedError

    def skip(self, name: str, line: int, reason: str) -> Skipped:
        return Skipped(name, self.file, line, reason)

    def not_understood(self, motion: str, line: int) -> None:
        """Note a motion whose arguments are not understood."""
        self.draft.skipped.append(self.skip(f"{motion} of line {line}", line, "not understood"))

    def words(self, items: Sequence[Any]) -> set[str]:
        return set(words_in(items, case=self.case))

    def parameters(self, k: int) -> frozenset[str]:
        """Return the names of the parameters of the routine around a statement."""
        return self._parameters.get(self.flow[k].routine, frozenset())

    @cached_property
    def _parameters(self) -> dict[int, frozenset[str]]:
        """The names of parameters, by the statement that opens their routine."""
        return {
            k: frozenset(formal_names(self.statements[k], case=self.case))
            for k, step in enumerate(self.steps)
            if step.routine
        }

    def target(self, k: int, part: Sequence[Any]) -> str | Point | Skipped:
        """Return the target of a motion: a name, a point in numbers, or something that can't be
        corrected.
        """
        line = self.statements[k].line
        found = self.literal(line, f"target of line {line}", part)
        if found is not None:
            return found
        name, is_part = element_name(part, case=self.case)
        if name and not is_part and not name.startswith("$"):
            return self.skip(name, line, PARAMETER) if name in self.parameters(k) else name
        self.draft.read(self.words(part))
        self.pass_arguments(line, part)
        return self.skip(text_of_items(part, case=self.case)[:40], line, "a computed position")

    def frame(self, k: int, items: Sequence[Any], computed: str) -> Frame:
        """Return the tool or base that items name, or why it is not known."""
        name, is_part = element_name(items, case=self.case)
        if not name or is_part or "*" in name:
            return Frame("", reason=computed)
        return Frame(name, reason=f"{name} is {PARAMETER}" if name in self.parameters(k) else "")

    def assign(self, line: int, name: str, is_part: bool, value: Sequence[Any]) -> None:
        """Note the value that a name is set to."""
        found = None if is_part or "*" in name else self.literal(line, name, value)
        if found is not None:
            self.draft.take(found)
            return
        self.draft.write(
            name, f"line {line} sets {'a part of it' if is_part else 'it'} while the program runs"
        )
        self.draft.derive(name, self.words(value))

    def pass_arguments(self, line: int, items: Sequence[Any]) -> None:
        """Note the names that calls within items may change."""
        for called, group in calls_in(items):
            if (called if self.case else called.upper()) not in self.harmless:
                self.draft.pass_to(
                    called, [element_name(part, case=self.case)[0] for part in group.parts], line
                )

    def displaced(self, k: int, kinds: Sequence[str]) -> str:
        """Return why positions are, or may be, displaced at a statement, "" if not: by kinds that
        any of the files switches.
        """
        known = self.flow[k]
        for kind in kinds:
            found = known.setters.get(kind)
            if isinstance(found, int):
                if not self.entries.ends(self.statements[found]):
                    called = text_of_items(self.statements[found].items[:1], case=True)
                    return f"line {self.statements[found].line} displaces positions ({called})"
            elif found is not None:
                return f"positions may be displaced ({kind}): {found}"
            elif self.starts_displaced(k, kind):
                return f"positions may be displaced ({kind}): another routine does so"
        return ""

    def starts_displaced(self, k: int, kind: str) -> bool:
        """Return whether the routine around a statement may start with something set."""
        routine = self.code.routine(k)
        return bool(routine) and routine in self.entries.displaced_at_start(kind)

    def load(self, k: int) -> Load | None:
        """Return the load in force at a motion, None if the program states none."""
        known = self.flow[k]
        found = known.setters.get(STATED_LOAD)
        if isinstance(found, int):
            statement = self.statements[found]
            return Load(text_of_items(statement.items), statement.line, self.mass(statement))
        if found is None and self.starts_displaced(k, STATED_LOAD):
            found = "it is set by another routine"
        return Load(found, self.statements[k].line) if found is not None else None

    def mass(self, statement: Statement) -> float | None:
        """Return the mass [kg] that a statement sets, None if it is not in numbers."""
        raise NotImplementedError

    def left(self, target: str | Point | Skipped, reason: str) -> str | Skipped:
        """Return a target that is left for a reason, by its name if it has one."""
        if isinstance(target, Point):
            return target.skip(reason)
        if isinstance(target, str):
            self.draft.write(target, reason)
        return target


@dataclass(frozen=True)
class Entries:
    """In which state the routines of some files start.

    Attributes:
        files: the files.
        ends: whether a statement ends what it switches.
        lasting: kinds of displacement that last when a program ends.
        known: by a kind of displacement, the routines that may start with positions displaced.
    """

    files: Sequence[Code]
    ends: Callable[[Statement], bool]
    lasting: Sequence[str] = ()
    known: dict[str, frozenset[str]] = field(default_factory=dict)

    def displaced_at_start(self, kind: str) -> frozenset[str]:
        """Return the routines that may start with positions displaced in some way."""
        if kind not in self.known:
            self.known[kind] = self._displaced_at_start(kind)
        return self.known[kind]

    def _displaced_at_start(self, kind: str) -> frozenset[str]:
        starts = _Starts(kind, self.ends)
        for code in self.files:
            for k in range(len(code.steps)):
                starts.look_at(code, k)
        return starts.displaced(lasts=kind in self.lasting)


@dataclass
class _Starts:
    """How the routines of some files start and end with respect to one kind of displacement.

    Attributes:
        kind: the kind.
        ends: whether a statement ends what it switches.
        found: routines that are called, or may run, while positions may be displaced.
        called: all routines that are called.
        heirs: the routines that are called before anything of the kind has happened, by the
            routine that calls them.
        is_clean: whether positions are displaced no more wherever a routine is left.
    """

    kind: str
    ends: Callable[[Statement], bool]
    found: set[str] = field(default_factory=set)
    called: set[str] = field(default_factory=set)
    heirs: dict[str, list[str]] = field(default_factory=dict)
    is_clean: dict[str, bool] = field(default_factory=dict)

    def look_at(self, code: Code, k: int) -> None:
        """Note the routines that a statement calls, starts or ends."""
        step = code.steps[k]
        state = code.flow[k].setters.get(self.kind)
        is_clean = state is None or (isinstance(state, int) and self.ends(code.statements[state]))
        self.called |= set(step.calls)
        self.found |= set(step.starts)
        routine = code.routine(k)
        for name in step.calls:
            if not is_clean:
                self.found.add(name)
            elif state is None:
                self.heirs.setdefault(routine, []).append(name)
        is_end = bool(step.closes) and bool(code.steps[code.flow[k].blocks[-1]].routine)
        if is_end or leaves(code.statements[k]):
            self.is_clean[routine] = is_clean and self.is_clean.get(routine, True)

    def displaced(self, *, lasts: bool) -> frozenset[str]:
        """Return the routines that may start displaced.

        Args:
            lasts: whether displacements of the kind last when a program ends: a program that
                nothing else calls starts again as it has ended.
        """
        found = set(self.found)
        if lasts:
            ended = self.is_clean.items()
            found |= {name for name, is_clean in ended if not (is_clean or name in self.called)}
        ahead = sorted(found)
        while ahead:
            for name in self.heirs.get(ahead.pop(), []):
                if name not in found:
                    found.add(name)
                    ahead.append(name)
        return frozenset(found)


def formal_names(
    statement: Statement, kinds: Sequence[str] = (), *, case: bool = False
) -> list[str]:
    """Return the names of a routine's parameters, of some kinds or all, from the statement that
    opens it.
    """
    found = []
    for item in statement.items:
        for part in item.parts if isinstance(item, Brackets) else ():
            for piece in split(part, "\\"):
                # ``NAME:IN`` has its kind after the name, ``PERS kind NAME`` before it.
                words = list(words_in(split(piece, ":")[0], case=case))
                if words and (not kinds or set(kinds) & set(words)):
                    found.append(words[-1])
    return found
