"""Which statement has set a variable by the time another one runs, as far as the text determines
it.

A variable that is set in one of several branches, within a loop, before a label that may be jumped
to, or by a called routine has no single value there: it counts as unknown, so that no point is
corrected with a tool that may not be its own.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

from pincal.programs.syntax import Source, Statement, word
from pincal.thresholds import Count

# Blocks within blocks.
_DEEPEST: Count = 100
OUTSIDE = "is not in these files and may set it"
"""Reason given for a routine that is in none of the files."""


@dataclass(frozen=True)
class Step:
    """The effect of a statement on the control flow.

    Attributes:
        opens: the word that opens a block here, or "".
        closes: the words of blocks that it may close.
        routine: name of the routine that the block defines, at whose start nothing is known; "" for
            other blocks.
        is_loop: whether the block is repeated.
        is_jump: whether it may be reached from elsewhere: a label, or another branch of its block.
        sets: variables that it sets.
        clears: variables that it may set.
        calls: names of routines that it calls.
        starts: names of routines that may run at any time from here on: interrupts, threads.
    """

    opens: str = ""
    closes: tuple[str, ...] = ()
    routine: str = ""
    is_loop: bool = False
    is_jump: bool = False
    sets: frozenset[str] = frozenset()
    clears: frozenset[str] = frozenset()
    calls: tuple[str, ...] = ()
    starts: tuple[str, ...] = ()


@dataclass(frozen=True)
class InForce:
    """What is known before a statement.

    Attributes:
        setters: by variable, the index of the statement that has set it, or the reason why that is
            not known.
        blocks: indices of the statements that opened the blocks around it.
        run: number that changes wherever the previous statement in the text may not be the one
            executed before.
        routine: index of the statement that opens the routine, -1 outside any.
    """

    setters: Mapping[str, int | str]
    blocks: tuple[int, ...]
    run: int
    routine: int

    @property
    def depth(self) -> int:
        """Number of open blocks."""
        return len(self.blocks)


@dataclass(frozen=True)
class Code:
    """One file whose control flow has been followed.

    Attributes:
        source: the file.
        statements: its statements.
        steps: the effect of each.
        flow: what is known before each.
    """

    source: Source
    statements: Sequence[Statement]
    steps: Sequence[Step]
    flow: Sequence[InForce] = ()

    def routine(self, k: int) -> str:
        """Return the name of the routine around a statement, "" outside any."""
        opening = self.flow[k].routine
        return self.steps[opening].routine if opening >= 0 else ""


def followed(
    files: Sequence[Code],
    *,
    outside: frozenset[str] = frozenset(),
    ends: Callable[[Statement], bool] | None = None,
) -> list[Code]:
    """Return files with what is known before each of their statements.

    Args:
        files: the files, their statements, and the effects of these.
        outside: variables that a routine in none of the files may set.
        ends: whether a statement ends what it switches: a routine that surely ends it before it
            ends itself is one that does not switch it.

    Raises:
        ProgramError: if a block is not closed, or closed without being open.
    """
    blocks = [_blocks(code) for code in files]
    paired = [(code.steps, around) for code, around in zip(files, blocks, strict=True)]
    effects = _effects(paired, {})
    at_any_time = _at_any_time(files, effects, outside)

    def walked(effects: Mapping[str, frozenset[str]]) -> list[Code]:
        found = []
        for code, around in zip(files, blocks, strict=True):
            walk = _Walk(code.statements, code.steps, around, effects, outside, at_any_time)
            found.append(Code(code.source, code.statements, code.steps, walk.through()))
        return found

    found = walked(effects)
    ended = _ended(found, ends) if ends is not None else {}
    return walked(_effects(paired, ended)) if any(ended.values()) else found


def _at_any_time(
    files: Sequence[Code], effects: Mapping[str, frozenset[str]], outside: frozenset[str]
) -> dict[str, int | str]:
    """Return what interrupts and threads may set, with the reason."""
    found: dict[str, int | str] = {}
    for code in files:
        for statement, step in zip(code.statements, code.steps, strict=True):
            for name in step.starts:
                why = f"{name}, which line {statement.line} starts, may set it at any time"
                if name not in effects:
                    why = f"line {statement.line} starts {name}, which {OUTSIDE}"
                found |= dict.fromkeys(effects.get(name, outside), why)
    return found


def leaves(statement: Statement) -> bool:
    """Return whether a statement leaves its routine, or the whole program, before its end."""
    return word(statement.items[0]) in ("RETURN", "EXITCYCLE")


def _ended(files: Sequence[Code], ends: Callable[[Statement], bool]) -> dict[str, set[str]]:
    """Return, by the name of a routine, what it has surely ended when it ends."""
    found = dict[str, set[str]]()
    for code in files:
        for k, step in enumerate(code.steps):
            is_end = bool(step.closes) and bool(code.steps[code.flow[k].blocks[-1]].routine)
            if not (is_end or leaves(code.statements[k])):
                continue
            states = code.flow[k].setters.items()
            clean = {
                name
                for name, state in states
                if isinstance(state, int) and ends(code.statements[state])
            }
            routine = code.routine(k)
            found[routine] = {name for name in clean if name in found.get(routine, clean)}
    return found


@dataclass
class _Walk:
    """The way through the statements of a file in their order.

    Attributes:
        statements: the statements.
        steps: their effects.
        blocks: the indices of the statements that open the blocks around each.
        effects: the variables that each routine may set.
        outside: those that a routine in none of the files may set.
        at_any_time: what interrupts and threads may set, with the reason.
        state: what is known of the variables.
        saved: what was known before each routine that is open.
        run: number of the run.
    """

    statements: Sequence[Statement]
    steps: Sequence[Step]
    blocks: Sequence[tuple[int, ...]]
    effects: Mapping[str, frozenset[str]]
    outside: frozenset[str]
    at_any_time: Mapping[str, int | str]
    state: dict[str, int | str] = field(default_factory=dict)
    saved: list[dict[str, int | str]] = field(default_factory=list)
    run: int = 0

    def through(self) -> list[InForce]:
        """Return what is known before each statement."""
        inside = self._set_inside()
        known: list[InForce] = []
        for i, step in enumerate(self.steps):
            if step.routine:
                self.saved.append(self.state)
                self.state = {}
            self._join(i, inside)
            self.run += bool(step.opens or step.closes or step.is_jump)
            routine = i if step.routine else _routine(self.steps, self.blocks[i])
            setters = {**self.state, **self.at_any_time} if self.at_any_time else self.state
            known.append(InForce(setters, self.blocks[i], self.run, routine))
            self._execute(i)
            if self._ends_routine(i):
                self.state = self.saved.pop()
        return known

    def _set_inside(self) -> dict[int, set[str]]:
        """Return what may be set within each block, by the statement that opens it."""
        inside: dict[int, set[str]] = {i: set() for i, step in enumerate(self.steps) if step.opens}
        for i, step in enumerate(self.steps):
            called = [self.effects.get(name, self.outside) for name in step.calls]
            changed = step.sets.union(step.clears, *called)
            if not changed:
                continue
            around = self.blocks[i][:-1] if step.closes else self.blocks[i]
            for block in (*around, *([i] if step.opens else [])):
                inside[block] |= changed
        return inside

    def _ends_routine(self, i: int) -> bool:
        return bool(self.steps[i].closes) and bool(self.steps[self.blocks[i][-1]].routine)

    def _join(self, i: int, inside: Mapping[int, set[str]]) -> None:
        """Forget what is not the same on all paths that lead to a statement."""
        step = self.steps[i]
        # The end of a routine is not joined by other paths: what follows does not run behind it.
        if (step.closes and not self._ends_routine(i)) or step.is_jump:
            block = self.blocks[i][-1] if self.blocks[i] else i
            line = self.statements[block].line
            self._forget(
                inside.get(block, set()),
                f"it is set on some paths only through the block of line {line}",
            )
        if step.is_loop:
            line = self.statements[i].line
            self._forget(inside[i], f"it is set within the loop of line {line}")

    def _execute(self, i: int) -> None:
        """Note what a statement sets, itself or by what it calls."""
        step = self.steps[i]
        line = self.statements[i].line
        for name in step.calls:
            why = f"line {line} calls {name}, which "
            why += "sets it" if name in self.effects else OUTSIDE
            self._forget(self.effects.get(name, self.outside), why)
        self._forget(step.clears, f"line {line} may set it")
        if step.sets:
            self.state = self.state | dict.fromkeys(step.sets, i)

    def _forget(self, names: Collection[str], reason: str) -> None:
        """Note that variables have no known value."""
        if names:
            self.state = self.state | dict.fromkeys(names, reason)


def _routine(steps: Sequence[Step], blocks: tuple[int, ...]) -> int:
    """Return the index of the statement that opens the innermost routine of some blocks, -1 outside
    any.
    """
    return next((i for i in reversed(blocks) if steps[i].routine), -1)


def _effects(
    files: Sequence[tuple[Sequence[Step], Sequence[tuple[int, ...]]]],
    ended: Mapping[str, set[str]],
) -> dict[str, frozenset[str]]:
    """Return the variables that each routine may set, directly or by its calls, by its name; not
    those that it has ended when it ends.
    """
    own = dict[str, set[str]]()
    calls = dict[str, set[str]]()
    for steps, blocks in files:
        for k, step in enumerate(steps):
            i = k if step.routine else _routine(steps, blocks[k][:-1] if step.closes else blocks[k])
            if i >= 0:
                name = steps[i].routine
                own[name] = own.get(name, set()) | step.sets | step.clears
                calls[name] = calls.get(name, set()) | set(step.calls)
    own = {name: found - ended.get(name, set()) for name, found in own.items()}
    callers = dict[str, list[str]]()
    for name, called in calls.items():
        for other in called:
            callers.setdefault(other, []).append(name)
    ahead = list(own)
    while ahead:
        changed = ahead.pop()
        for name in callers.get(changed, []):
            size = len(own[name])
            own[name] |= own[changed] - ended.get(name, set())
            if len(own[name]) > size:
                ahead.append(name)
    return {name: frozenset(found) for name, found in own.items()}


def _blocks(code: Code) -> list[tuple[int, ...]]:
    """Return, for each statement, the indices of the statements that open the blocks around it."""
    found: list[tuple[int, ...]] = []
    blocks: tuple[int, ...] = ()
    for i, step in enumerate(code.steps):
        found.append(blocks)
        if step.closes:
            _check_closing(code, i, blocks)
            blocks = blocks[:-1]
        if step.opens:
            blocks = (*blocks, i)
            if len(blocks) > _DEEPEST:
                raise code.source.error(
                    f"a block within {_DEEPEST} others; expected fewer", code.statements[i].start
                )
    if blocks:
        opens = code.steps[blocks[-1]].opens
        line = code.statements[blocks[-1]].line
        raise code.source.error(
            f"the end of the file within {opens} of line {line}: is it truncated?",
            len(code.source.content),
        )
    return found


def _check_closing(code: Code, i: int, blocks: tuple[int, ...]) -> None:
    """Refuse a statement that closes none of its blocks, or not the innermost one."""
    closes = code.steps[i].closes
    start = code.statements[i].start
    word = str(code.statements[i].items[0])
    if not blocks:
        opened = " or ".join(closes)
        raise code.source.error(
            f"{word!r} has nothing to close; expected {opened} before it", start
        )
    opens = code.steps[blocks[-1]].opens
    if opens not in closes:
        line = code.statements[blocks[-1]].line
        raise code.source.error(
            f"{word!r} within {opens} of line {line}; expected its end first", start
        )
