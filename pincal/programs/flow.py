"""Which statement has set a variable by the time another one runs, as far as the text determines it.

A variable that is set in one of several branches, within a loop, before a label that may be jumped to, or by a called
routine has no single value there: it counts as unknown, so that no point is corrected with a tool that may not be its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pincal.programs.syntax import Source, Statement

OUTSIDE = "is not in these files and may set it"
"""Reason given for a routine that is in none of the files."""


@dataclass(frozen=True)
class Step:
    """The effect of a statement on the control flow.

    Attributes:
        opens: the word that opens a block here, or "".
        closes: the words of blocks that it may close.
        routine: name of the routine that the block defines, at whose start nothing is known; "" for other blocks.
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
        setters: by variable, the index of the statement that has set it, or the reason why that is not known.
        blocks: indices of the statements that opened the blocks around it.
        run: number that changes wherever the previous statement in the text may not be the one executed before.
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
    files: Sequence[tuple[Source, Sequence[Statement], Sequence[Step]]], *, outside: frozenset[str] = frozenset()
) -> list[list[InForce]]:
    """Return what is known before each statement of each file.

    Args:
        files: the files, their statements, and the effects of these.
        outside: variables that a routine in none of the files may set.

    Raises:
        ProgramError: if a block is not closed, or closed without being open.
    """
    effects = _effects([steps for _, _, steps in files])
    changed = [[step.sets.union(step.clears, *(effects.get(name, outside) for name in step.calls)) for step in steps]
               for _, _, steps in files]  # fmt: skip
    inside = [_set_within(source, statements, steps, changed=of)
              for (source, statements, steps), of in zip(files, changed, strict=True)]  # fmt: skip
    at_any_time: dict[str, int | str] = {}
    for _, statements, steps in files:
        for statement, step in zip(statements, steps, strict=True):
            for name in step.starts:
                why = f"{name}, which line {statement.line} starts, may set it at any time"
                at_any_time |= dict.fromkeys(effects.get(name, ()), why)
    return [
        _followed(statements, steps, inside=within, effects=effects, outside=outside, at_any_time=at_any_time)
        for (_, statements, steps), within in zip(files, inside, strict=True)
    ]


def _followed(
    statements: Sequence[Statement],
    steps: Sequence[Step],
    *,
    inside: Mapping[int, set[str]],
    effects: Mapping[str, frozenset[str]],
    outside: frozenset[str],
    at_any_time: Mapping[str, int | str],
) -> list[InForce]:
    known: list[InForce] = []
    stack: list[int] = []
    state: dict[str, int | str] = {}
    saved: list[tuple[dict[str, int | str], int]] = []
    run, routine = 0, -1
    for i, step in enumerate(steps):
        line = statements[i].line
        if step.routine:
            saved.append((state, routine))
            state, routine = {}, i
        if step.closes or step.is_jump:
            block = stack[-1] if stack else i
            where = f"it is set on some paths only through the block of line {statements[block].line}"
            state = state | dict.fromkeys(inside.get(block, ()), where)
        if step.is_loop:
            state = state | dict.fromkeys(inside[i], f"it is set within the loop of line {line}")
        run += bool(step.opens or step.closes or step.is_jump)
        known.append(InForce({**state, **at_any_time}, tuple(stack), run, routine))
        for name in step.calls:
            why = f"line {line} calls {name}, which "
            why += "sets it" if name in effects else OUTSIDE
            state = state | dict.fromkeys(effects.get(name, outside), why)
        if step.sets or step.clears:
            state = state | dict.fromkeys(step.clears, f"line {line} may set it") | dict.fromkeys(step.sets, i)
        if step.closes and steps[stack.pop()].routine:
            state, routine = saved.pop()
        if step.opens:
            stack.append(i)
    return known


def _effects(files: Sequence[Sequence[Step]]) -> dict[str, frozenset[str]]:
    """Return the variables that each routine may set, directly or by its calls, by its name."""
    own, calls = dict[str, set[str]](), dict[str, set[str]]()
    for steps in files:
        stack: list[str] = []
        names: list[str] = []
        for step in steps:
            if step.closes and names and stack:
                names = names[:-1] if stack.pop() else names
            if step.routine:
                names = [*names, step.routine]
                own.setdefault(step.routine, set())
                calls.setdefault(step.routine, set())
            elif names:
                own[names[-1]] |= step.sets | step.clears
                calls[names[-1]] |= set(step.calls)
            if step.opens:
                stack.append(step.routine)
    for _ in own:
        for name, called in calls.items():
            own[name] = own[name].union(*(own[other] for other in called if other in own))
    return {name: frozenset(found) for name, found in own.items()}


def _set_within(
    source: Source, statements: Sequence[Statement], steps: Sequence[Step], *, changed: Sequence[frozenset[str]]
) -> dict[int, set[str]]:
    """Return the variables set within each block, by the index of the statement that opens it."""
    inside: dict[int, set[str]] = {}
    stack: list[int] = []
    for i, step in enumerate(steps):
        if step.closes:
            word = str(statements[i].items[0])
            if not stack:
                opened = " or ".join(step.closes)
                raise source.error(f"{word!r} closes nothing; expected {opened} before it", statements[i].start)
            done = stack.pop()
            if steps[done].opens not in step.closes:
                raise source.error(
                    f"{word!r} within {steps[done].opens} of line {statements[done].line}; expected the end of that first",
                    statements[i].start,
                )
            if stack:
                inside[stack[-1]] |= inside[done]
        if step.opens:
            stack.append(i)
            inside[i] = set()
        if stack:
            inside[stack[-1]] |= changed[i]
    if stack:
        opens, line = steps[stack[-1]].opens, statements[stack[-1]].line
        raise source.error(f"the end of the file within {opens} of line {line}: is it truncated?", len(source.content))
    return inside
