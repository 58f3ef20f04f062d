"""What all readers of a language of nested brackets do alike: targets, assignments, and names that are handed on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from pincal.programs.draft import Draft
from pincal.programs.flow import InForce, Step
from pincal.programs.program import Frame, Left, Point
from pincal.programs.syntax import Brackets, Statement, calls_in, element_name, split, text_of_items, words_in

PARAMETER = "a parameter of the routine"


@dataclass(frozen=True)
class Reader:
    """Reads one file of a program.

    Attributes:
        draft: what is found.
        file: index of the file.
        statements: its statements.
        steps: what they mean to the order in which they run.
        flow: what is known before each.
        harmless: names of functions and routines that change nothing of what is handed to them.
        case: whether capitals make a difference.
    """

    draft: Draft
    file: int
    statements: Sequence[Statement]
    steps: Sequence[Step]
    flow: Sequence[InForce]
    harmless: frozenset[str]
    case: ClassVar[bool] = False

    def literal(self, line: int, name: str, items: Sequence[Any]) -> Point | Left | None:
        """Return the point whose values stand there in numbers, why it is none, or None for another expression."""
        raise NotImplementedError

    def left(self, name: str, line: int, reason: str) -> Left:
        """Return something that is left as it was."""
        return Left(name, self.file, line, reason)

    def words(self, items: Sequence[Any]) -> set[str]:
        """Return the names in items."""
        return set(words_in(items, case=self.case))

    def parameters(self, k: int) -> set[str]:
        """Return the names of the parameters of the routine that a statement is in."""
        routine = self.flow[k].routine
        return set(formal_names(self.statements[routine], case=self.case)) if routine >= 0 else set()

    def target(self, k: int, part: Sequence[Any]) -> str | Point | Left:
        """Return what a motion goes to: a name, a point in numbers, or something that is left."""
        line = self.statements[k].line
        found = self.literal(line, f"target of line {line}", part)
        if found is not None:
            return found
        name, is_part = element_name(part, case=self.case)
        if name and not is_part and not name.startswith("$"):
            return self.left(name, line, PARAMETER) if name in self.parameters(k) else name
        self.draft.read(self.words(part))
        self.hand(line, part)
        return self.left(text_of_items(part, case=self.case)[:40], line, "a computed position")

    def frame(self, k: int, items: Sequence[Any], computed: str) -> Frame:
        """Return the tool or the base that a name is, or why it is none."""
        name, is_part = element_name(items, case=self.case)
        if not name or is_part or "*" in name:
            return Frame("", reason=computed)
        return Frame(name, reason=f"{name} is {PARAMETER}" if name in self.parameters(k) else "")

    def assign(self, line: int, name: str, is_part: bool, value: Sequence[Any]) -> None:
        """Take note of what a name is set to."""
        found = None if is_part or "*" in name else self.literal(line, name, value)
        if found is not None:
            self.draft.take(name, found)
            return
        self.draft.write(name, f"line {line} sets {'a part of it' if is_part else 'it'} while the program runs")
        self.draft.derive(name, self.words(value))

    def hand(self, line: int, items: Sequence[Any]) -> None:
        """Take note of the names that calls within items may change."""
        for called, group in calls_in(items):
            if (called if self.case else called.upper()) not in self.harmless:
                self.draft.hand([element_name(part, case=self.case)[0] for part in group.parts], line, called)


def formal_names(statement: Statement, kinds: Sequence[str] = (), *, case: bool = False) -> list[str]:
    """Return the names of the parameters of a routine, of some kinds or all, by the statement that opens it."""
    found = []
    for item in statement.items:
        for part in item.parts if isinstance(item, Brackets) else ():
            for piece in split(part, "\\"):
                # ``NAME:IN`` has its kind behind the name, ``PERS kind NAME`` before.
                words = list(words_in(split(piece, ":")[0], case=case))
                if words and (not kinds or set(kinds) & set(words)):
                    found.append(words[-1])
    return found
