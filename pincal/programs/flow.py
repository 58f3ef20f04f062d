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

# Rounds in which it is found which blocks leave a variable switched.
_ROUNDS: Count = 8
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
        is_label: whether that is from anywhere in its routine: a label, or what handles errors.
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
    is_label: bool = False
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
            jumps = any(step.is_label for step in code.steps)
            known = (effects, outside, at_any_time)
            walk = _Walk(code.statements, code.steps, around, *known, None if jumps else ends)
            found.append(Code(code.source, code.statements, code.steps, walk.through()))
        return found

    found = walked(effects)
    ended = _ended(found, ends, effects) if ends is not None else {}
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


def _ended(
    files: Sequence[Code],
    ends: Callable[[Statement], bool],
    effects: Mapping[str, frozenset[str]],
) -> dict[str, set[str]]:
    """Return, by the name of a routine, what it has surely ended when it ends."""
    found = dict[str, set[str]]()
    for code in files:
        for k, step in enumerate(code.steps):
            is_end = bool(step.closes) and bool(code.steps[code.flow[k].blocks[-1]].routine)
            if not (is_end or leaves(code.statements[k])):
                continue
            routine = code.routine(k)
            clean = set[str]()
            for name in effects.get(routine, ()):
                state = code.flow[k].setters.get(name)
                # As it was when the routine began, or ended.
                if state is None or (isinstance(state, int) and ends(code.statements[state])):
                    clean.add(name)
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
        ends: whether a statement ends what it switches; None if that is not to be followed through
            blocks.
        unbalanced: blocks and variables that may be switched where the block is left. Others are
            as they were before the block, if nothing was switched there.
        entered: what is known at the beginning of each block.
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
    ends: Callable[[Statement], bool] | None
    unbalanced: dict[tuple[int, str], bool] = field(default_factory=dict)
    entered: dict[int, dict[str, int | str]] = field(default_factory=dict)
    state: dict[str, int | str] = field(default_factory=dict)
    saved: list[dict[str, int | str]] = field(default_factory=list)
    run: int = 0

    def through(self) -> list[InForce]:
        """Return what is known before each statement."""
        inside = self._set_inside()
        for _ in range(_ROUNDS):
            count = len(self.unbalanced)
            known = self._once_through(inside)
            if len(self.unbalanced) == count:
                return known
        self.ends = None
        return self._once_through(inside)

    def _once_through(self, inside: Mapping[int, set[str]]) -> list[InForce]:
        """Return what is known before each statement if no other block is unbalanced; note those
        that are.
        """
        known: list[InForce] = []
        self.state = {}
        self.run = 0
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
            # A condition is evaluated on the way to all branches behind it.
            if step.opens or (step.is_jump and step.calls and self.blocks[i]):
                self.entered[i if step.opens else self.blocks[i][-1]] = self.state
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
            names = inside.get(block, set())
            self._check_balance(block, names)
            same = {name for name in names if self._is_balanced(block, name)}
            reason = f"it is set on some paths only through the block of line {line}"
            self._forget(names - same, reason)
            if same:
                before = self.entered[block].items()
                kept = {name: found for name, found in self.state.items() if name not in same}
                self.state = kept | {name: found for name, found in before if name in same}
        if step.is_loop:
            line = self.statements[i].line
            self.entered[i] = self.state
            changed = {name for name in inside[i] if not self._is_balanced(i, name)}
            self._forget(changed, f"it is set within the loop of line {line}")
        if word(self.statements[i].items[0]) in ("BREAK", "CONTINUE"):
            for block in self.blocks[i]:
                self._check_balance(block, inside[block])

    def _check_balance(self, block: int, names: Collection[str]) -> None:
        """Note the variables that may be switched where a block is left."""
        for name in names:
            if not self._is_off(self.state, name):
                self.unbalanced[block, name] = True

    def _is_balanced(self, block: int, name: str) -> bool:
        """Return whether a variable is switched neither before a block nor where it is left."""
        if self.ends is None or self.steps[block].routine or (block, name) in self.unbalanced:
            return False
        return self._is_off(self.entered.get(block, {}), name)

    def _is_off(self, state: Mapping[str, int | str], name: str) -> bool:
        """Return whether nothing has switched a variable, or something has ended that."""
        found = state.get(name)
        if not isinstance(found, int):
            return found is None
        return self.ends is not None and self.ends(self.statements[found])

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
