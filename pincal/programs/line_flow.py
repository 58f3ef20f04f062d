"""Which lines of a listing can act on which others, in languages without nested statements.

What a line displaces stays displaced on every path behind it, through jumps, loops, branches and
calls, up to a line that ends it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from pincal.errors import ProgramError
from pincal.programs.flow import OUTSIDE
from pincal.thresholds import Count

# The part of a block that a line is: its start, if the block is repeated or not; another branch of
# it; its end.
BlockPart = Literal["", "loop", "branch", "else", "end"]
# Lines, times what any of them may displace: the states that are followed.
MOST_STATES: Count = 3_000_000
ANY = "*"
"""A label that is computed, and any number of a tool or a base."""

STATED_LOAD = "load"
"""What statements that set a load switch."""
POSITIONS = "positions"
"""What an instruction that is not understood may displace."""


@dataclass(frozen=True)
class Line:
    """The effect of one instruction.

    Attributes:
        number: its line.
        sets: what it may displace, with the reason.
        ends: what is displaced no more.
        label: the label that it is, "" if none.
        jumps: labels that may be executed next.
        calls: programs that it calls.
        is_last: whether the line below is never executed next.
        block: the part of a block that it is.
    """

    number: int
    sets: tuple[tuple[str, str], ...] = ()
    ends: tuple[str, ...] = ()
    label: str = ""
    jumps: tuple[str, ...] = ()
    calls: tuple[str, ...] = ()
    is_last: bool = False
    block: BlockPart = ""


@dataclass(frozen=True)
class Listing:
    """The instructions of one program.

    Attributes:
        name: by which others call it.
        lines: its instructions.
    """

    name: str
    lines: Sequence[Line]


def with_outside(listings: Sequence[Listing], switched: Sequence[str]) -> list[Listing]:
    """Return listings in which calls of programs that are not among them may displace what any of
    them displaces or ends.

    Args:
        listings: the programs.
        switched: what may be displaced by a program that is not among them.
    """
    known = {listing.name for listing in listings}
    used = set[str]()
    for listing in listings:
        for line in listing.lines:
            used |= {*line.ends, *(name for name, _ in line.sets)}
    in_play = [name for name in switched if name in used]
    found = []
    for listing in listings:
        lines = []
        for line in listing.lines:
            outside = [name for name in line.calls if name not in known]
            why = f"line {line.number} calls {outside[0]}, which {OUTSIDE}" if outside else ""
            more = [(name, why) for name in in_play] if outside else []
            lines.append(replace(line, sets=(*line.sets, *more)))
        found.append(Listing(listing.name, lines))
    return found


def reasons_before(
    listings: Sequence[Listing], *, lasting: Sequence[str] = ()
) -> list[list[dict[str, str]]]:
    """Return for each line of each listing what may be displaced before it, with the reason.

    Args:
        listings: the programs.
        lasting: what stays displaced when a program ends, and therefore at its next start.

    Raises:
        ProgramError: if too many frames change on too many lines.
    """
    switched = {name for listing in listings for line in listing.lines for name, _ in line.sets}
    count = sum(len(listing.lines) for listing in listings)
    if len(switched) * count > MOST_STATES:
        raise ProgramError(
            f"{len(switched)} frames that change on {count} lines; expected a program of at most "
            f"{MOST_STATES} pairs of these: divide it"
        )
    paths = _Paths(listings, lasting)
    for listing in listings:
        paths.starts.append(len(paths.lines))
        paths.lines += listing.lines
        paths.next += [[] for _ in listing.lines]
        if listing.lines:
            paths.entries[listing.name] = paths.starts[-1]
    for listing, start in zip(listings, paths.starts, strict=True):
        paths.connect(start, listing.lines)
    return paths.reasons()


@dataclass
class _Paths:
    """The paths through some listings, whose lines are numbered one after the other.

    Attributes:
        listings: the programs.
        lasting: what stays displaced when a program ends.
        starts: the first line of each program.
        lines: all lines.
        next: the lines that may be executed behind each.
        again: the line with which a program starts again, by its last line.
        entries: the first line of a program, by its name.
    """

    listings: Sequence[Listing]
    lasting: Sequence[str]
    starts: list[int] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)
    next: list[list[int]] = field(default_factory=list)
    again: dict[int, int] = field(default_factory=dict)
    entries: dict[str, int] = field(default_factory=dict)

    def connect(self, start: int, lines: Sequence[Line]) -> None:
        """Note which lines may be executed behind each."""
        self._connect_blocks(start, lines)
        labels = self._labels(start, lines)
        for k, line in enumerate(lines):
            is_end = k + 1 == len(lines)
            if is_end:
                self.again[start + k] = start
            # A line that nothing seems to lead to counts as the next one.
            elif not (line.is_last and lines[k + 1].label) and lines[k + 1].block != "else":
                self.next[start + k].append(start + k + 1)
            self.next[start + k] += [labels[label] for label in line.jumps if label in labels]

    def _labels(self, start: int, lines: Sequence[Line]) -> dict[str, int]:
        """Return the lines to which jumps lead, by their labels; one more line stands for all of a
        computed label, or of one that stands in several places.
        """
        places = dict[str, list[int]]()
        for k, line in enumerate(lines):
            if line.label:
                places.setdefault(line.label, []).append(start + k)
                places.setdefault(ANY, []).append(start + k)
        found = dict[str, int]()
        for label, those in places.items():
            found[label] = those[0]
            if len(those) > 1:
                found[label] = len(self.lines)
                self.lines.append(Line(0))
                self.next.append(those)
        return found

    def _connect_blocks(self, start: int, lines: Sequence[Line]) -> None:
        """Connect the start of each block, and the ends of its branches, to its end; and the end of
        a loop to its start.
        """
        opened = list[int]()
        tails = list[list[int]]()
        for k, line in enumerate(lines):
            if line.block in ("loop", "branch"):
                opened.append(k)
                tails.append([k])
            elif line.block == "else":
                if opened:
                    tails[-1].append(k - 1)
                    self.next[start + opened[-1]].append(start + k)
                elif k > 0:
                    self.next[start + k - 1].append(start + k)
            elif line.block == "end" and opened:
                first = opened.pop()
                for tail in tails.pop():
                    self.next[start + tail].append(start + k)
                if lines[first].block == "loop":
                    self.next[start + k].append(start + first)

    def _effects_of_calls(self) -> dict[str, dict[str, str]]:
        """Return what each program may displace, itself or by its calls, with the reason."""
        effects = {listing.name: dict[str, str]() for listing in self.listings}
        callers = dict[str, dict[str, bool]]()
        for listing in self.listings:
            for line in listing.lines:
                for variable, reason in line.sets:
                    effects[listing.name].setdefault(variable, reason)
                for name in line.calls:
                    callers.setdefault(name, {})[listing.name] = True
        ahead = [listing.name for listing in self.listings]
        while ahead:
            name = ahead.pop()
            for caller in callers.get(name, {}):
                size = len(effects[caller])
                for variable, reason in list(effects[name].items()):
                    effects[caller].setdefault(variable, reason)
                if len(effects[caller]) > size:
                    ahead.append(caller)
        return effects

    def reasons(self) -> list[list[dict[str, str]]]:
        """Return what may be displaced before each line."""
        before: list[dict[str, str]] = [{} for _ in self.lines]
        called = self._effects_of_calls()
        is_ahead = [True for _ in self.lines]
        # The last one is the first one looked at: lines in their order, first to last.
        ahead = list(reversed(range(len(self.lines))))
        while ahead:
            k = ahead.pop()
            is_ahead[k] = False
            after = self._after(k, before[k], called)
            lasts = {name: reason for name, reason in after.items() if name in self.lasting}
            targets = [(j, after) for j in self.next[k]]
            called_here = [self.entries[n] for n in self.lines[k].calls if n in self.entries]
            targets += [(entry, before[k]) for entry in called_here]
            if k in self.again:
                targets.append((self.again[k], lasts))
            for j, state in targets:
                if all(name in before[j] for name in state):
                    continue
                # What is shared by several lines is not changed in place.
                before[j] = {**state, **before[j]} if before[j] else dict(state)
                if not is_ahead[j]:
                    is_ahead[j] = True
                    ahead.append(j)
        return [
            before[start : start + len(listing.lines)]
            for listing, start in zip(self.listings, self.starts, strict=True)
        ]

    def _after(
        self, k: int, before: Mapping[str, str], called: Mapping[str, Mapping[str, str]]
    ) -> Mapping[str, str]:
        """Return what may be displaced behind a line."""
        line = self.lines[k]
        after = before
        for name in line.calls:
            new = called.get(name, {})
            if new:
                after = {**new, **after}
        if line.ends:
            after = {name: reason for name, reason in after.items() if name not in line.ends}
        if line.sets:
            after = {**after, **{name: reason for name, reason in line.sets}}
        return after
