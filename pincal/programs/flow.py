"""Which statement has set a variable by the time another one runs, as far as the text determines
it.

A variable that is set in one of several branches, within a loop, before a label that may be jumped
to, or by a called routine has no single value there: it counts as unknown, so that no point is
corrected with a tool that may not be its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pincal.programs.syntax import Source, Statement
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


def followed(
    files: Sequence[tuple[Source, Sequence[Statement], Sequence[Step]]],
    *,
    outside: frozenset[str] = frozenset(),
) -> list[list[InForce]]:
    """Return what is known before each statement of each file.

    Args:
        files: the files, their statements, and the effects of these.
        outside: variables that a routine in none of the files may set.

    Raises:
        ProgramError: if a block is not closed, or closed without being open.
    """
    blocks = [_blocks(source, statements, steps) for source, statements, steps in files]
    effects = _effects(
        [(steps, around) for (_, _, steps), around in zip(files, blocks, strict=True)]
    )
    at_any_time: dict[str, int | str] = {}
    for _, statements, steps in files:
        for statement, step in zip(statements, steps, strict=True):
            for name in step.starts:
                why = f"{name}, which line {statement.line} starts, may set it at any time"
                if name not in effects:
                    why = f"line {statement.line} starts {name}, which {OUTSIDE}"
                at_any_time |= dict.fromkeys(effects.get(name, outside), why)
    return [
        _followed(
            statements, steps, around, effects=effects, outside=outside, at_any_time=at_any_time
        )
        for (_, statements, steps), around in zip(files, blocks, strict=True)
    ]


def _followed(
    statements: Sequence[Statement],
    steps: Sequence[Step],
    blocks: Sequence[tuple[int, ...]],
    *,
    effects: Mapping[str, frozenset[str]],
    outside: frozenset[str],
    at_any_time: Mapping[str, int | str],
) -> list[InForce]:
    inside: dict[int, set[str]] = {i: set() for i, step in enumerate(steps) if step.opens}
    for i, step in enumerate(steps):
        changed = step.sets.union(step.clears, *(effects.get(name, outside) for name in step.calls))
        for block in (
            *(blocks[i][:-1] if step.closes else blocks[i]),
            *([i] if step.opens else []),
        ):
            inside[block] |= changed
    known: list[InForce] = []
    state: dict[str, int | str] = {}
    saved: list[dict[str, int | str]] = []
    run = 0
    for i, step in enumerate(steps):
        line = statements[i].line
        if step.routine:
            saved.append(state)
            state = {}
        # The end of a routine is not joined by other paths: what follows does not run behind it.
        is_end = bool(step.closes) and bool(steps[blocks[i][-1]].routine)
        if (step.closes and not is_end) or step.is_jump:
            block = blocks[i][-1] if blocks[i] else i
            where = (
                f"it is set on some paths only through the block of line {statements[block].line}"
            )
            state = state | dict.fromkeys(inside.get(block, ()), where)
        if step.is_loop:
            state = state | dict.fromkeys(inside[i], f"it is set within the loop of line {line}")
        run += bool(step.opens or step.closes or step.is_jump)
        routine = i if step.routine else _routine(steps, blocks[i])
        known.append(InForce({**state, **at_any_time}, blocks[i], run, routine))
        for name in step.calls:
            why = f"line {line} calls {name}, which "
            why += "sets it" if name in effects else OUTSIDE
            state = state | dict.fromkeys(effects.get(name, outside), why)
        if step.sets or step.clears:
            state = (
                state
                | dict.fromkeys(step.clears, f"line {line} may set it")
                | dict.fromkeys(step.sets, i)
            )
        if step.closes and steps[blocks[i][-1]].routine:
            state = saved.pop()
    return known


def _routine(steps: Sequence[Step], blocks: tuple[int, ...]) -> int:
    """Return the index of the statement that opens the innermost routine of some blocks, -1 outside
    any.
    """
    return next((i for i in reversed(blocks) if steps[i].routine), -1)


def _effects(
    files: Sequence[tuple[Sequence[Step], Sequence[tuple[int, ...]]]],
) -> dict[str, frozenset[str]]:
    """Return the variables that each routine may set, directly or by its calls, by its name."""
    own = dict[str, set[str]]()
    calls = dict[str, set[str]]()
    for steps, blocks in files:
        for k, step in enumerate(steps):
            i = k if step.routine else _routine(steps, blocks[k][:-1] if step.closes else blocks[k])
            if i >= 0:
                name = steps[i].routine
                own[name] = own.get(name, set()) | step.sets | step.clears
                calls[name] = calls.get(name, set()) | set(step.calls)
    callers = dict[str, list[str]]()
    for name, called in calls.items():
        for other in called:
            callers.setdefault(other, []).append(name)
    ahead = list(own)
    while ahead:
        changed = ahead.pop()
        for name in callers.get(changed, []):
            size = len(own[name])
            own[name] |= own[changed]
            if len(own[name]) > size:
                ahead.append(name)
    return {name: frozenset(found) for name, found in own.items()}


def _blocks(
    source: Source, statements: Sequence[Statement], steps: Sequence[Step]
) -> list[tuple[int, ...]]:
    """Return, for each statement, the indices of the statements that open the blocks around it."""
    found: list[tuple[int, ...]] = []
    blocks: tuple[int, ...] = ()
    for i, step in enumerate(steps):
        found.append(blocks)
        if step.closes:
            word = str(statements[i].items[0])
            if not blocks:
                opened = " or ".join(step.closes)
                raise source.error(
                    f"{word!r} has nothing to close; expected {opened} before it",
                    statements[i].start,
                )
            block = blocks[-1]
            if steps[block].opens not in step.closes:
                raise source.error(
                    f"{word!r} within {steps[block].opens} of line "
                    f"{statements[block].line}; expected its end first",
                    statements[i].start,
                )
            blocks = blocks[:-1]
        if step.opens:
            blocks = (*blocks, i)
            if len(blocks) > _DEEPEST:
                raise source.error(
                    f"a block within {_DEEPEST} others; expected fewer", statements[i].start
                )
    if blocks:
        opens = steps[blocks[-1]].opens
        line = statements[blocks[-1]].line
        raise source.error(
            f"the end of the file within {opens} of line {line}: is it truncated?",
            len(source.content),
        )
    return found
