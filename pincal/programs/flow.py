"""Which statement has set a variable when another one runs, as far as that can be read from the text.

A variable that is set in one branch of several, within a loop, or before a label that may be jumped to, has no one value
there: it counts as not known, so that no point is corrected with a tool that it may not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pincal.programs.syntax import Source, Statement


@dataclass(frozen=True)
class Step:
    """What a statement means to the order in which a program runs.

    Attributes:
        opens: the word that opens a block here, or "".
        closes: the words of blocks that it may close.
        is_routine: whether the block is a routine, in which nothing is known at first.
        is_loop: whether the block is run again.
        is_jump: whether it may be reached from elsewhere: a label, or another branch of its block.
        sets: variables that it sets.
        clears: variables that it may set.
    """

    opens: str = ""
    closes: tuple[str, ...] = ()
    is_routine: bool = False
    is_loop: bool = False
    is_jump: bool = False
    sets: frozenset[str] = frozenset()
    clears: frozenset[str] = frozenset()


@dataclass(frozen=True)
class InForce:
    """What is known before a statement.

    Attributes:
        setters: index of the statement that has set a variable, or the reason why it is not known, by variable.
        depth: number of blocks that are open.
        run: number that changes wherever the statement before in the text may not be the one before as the program runs.
    """

    setters: dict[str, int | str]
    depth: int
    run: int


def followed(source: Source, statements: Sequence[Statement], steps: Sequence[Step]) -> list[InForce]:
    """Return what is known before each statement.

    Raises:
        ProgramError: if a block is not closed, or closed without being open.
    """
    inside = _set_within(source, statements, steps)
    known: list[InForce] = []
    stack: list[int] = []
    state: dict[str, int | str] = {}
    saved: list[dict[str, int | str]] = []
    run = 0
    for i, step in enumerate(steps):
        if step.is_routine:
            saved.append(state)
            state = {}
        if step.closes or step.is_jump:
            block = stack[-1] if stack else i
            where = f"it is set on one way only through the block of line {statements[block].line}"
            state = state | dict.fromkeys(inside.get(block, ()), where)
        if step.is_loop:
            state = state | dict.fromkeys(inside[i], f"it is set within the loop of line {statements[i].line}")
        run += bool(step.opens or step.closes or step.is_jump)
        known.append(InForce(state, len(stack), run))
        if step.sets or step.clears:
            reason = f"line {statements[i].line} may set it"
            state = state | dict.fromkeys(step.clears, reason) | dict.fromkeys(step.sets, i)
        if step.closes and steps[stack.pop()].is_routine:
            state = saved.pop()
        if step.opens:
            stack.append(i)
    return known


def _set_within(source: Source, statements: Sequence[Statement], steps: Sequence[Step]) -> dict[int, set[str]]:
    """Return the variables that are set within each block, by the statement that opens it."""
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
            inside[stack[-1]] |= step.sets | step.clears
    if stack:
        opens, line = steps[stack[-1]].opens, statements[stack[-1]].line
        raise source.error(f"the end of the file within {opens} of line {line}: is it cut?", len(source.content))
    return inside
