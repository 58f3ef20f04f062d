"""A program in any language: points with the positions of their numbers in the text, motions
between them, and frames.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pincal.programs.syntax import Number, Source, Statement

PointKind = Literal["pose", "joints"]
Path = Literal["joint", "line", "circle"]
FrameKind = Literal["tool", "base"]
# File and position of the first number, which identify a point.
PointKey = tuple[int, int]
# What a turn number counts: 1 for angles below 0; quarters from 0; whole turns from -180 deg; 1
# from 180 deg either way.
TurnKind = Literal["negative", "quarter", "whole", "half"]


@dataclass(frozen=True)
class Turn:
    """A number in a program that determines in which turn of its range a joint is.

    Attributes:
        joint: index of the joint.
        kind: what it counts.
        value: the count.
        number: the number in the text.
        bit: the bit of the number that is the count; None if it is the whole number.
    """

    joint: int
    kind: TurnKind
    value: int
    number: Number
    bit: int | None = None

    def counted(self, angle: float) -> int:
        """Return the count at a joint angle [rad]."""
        if self.kind == "negative":
            return int(angle < 0.0)
        if self.kind == "half":
            return int(abs(angle) >= math.pi)
        return math.floor(
            angle / (0.5 * math.pi)
            if self.kind == "quarter"
            else (angle + math.pi) / (2.0 * math.pi)
        )


@dataclass(frozen=True)
class Posture:
    """The arm configuration of a pose, as far as the program specifies it.

    Attributes:
        front: the wrist is on the side of axis 1 that the arm faces at zero.
        up: the elbow is above the line from shoulder to wrist, of an arm that faces the front.
        down: the wrist is bent downwards, where axis 4 is at zero and the arm faces the front.
        turns: numbers of turns.
    """

    front: bool | None = None
    up: bool | None = None
    down: bool | None = None
    turns: tuple[Turn, ...] = ()

    @property
    def sides(self) -> tuple[bool | None, bool | None, bool | None]:
        """The three choices."""
        return self.front, self.up, self.down

    @property
    def is_whole(self) -> bool:
        """Whether all three are specified."""
        return None not in self.sides

    def allows(self, sides: np.ndarray) -> bool:
        """Return whether an arm with these sides, 1 or -1 or 0 where it is on neither, shape (3,),
        is in this posture.
        """
        pairs = zip(self.sides, sides, strict=True)
        return all(wanted is None or not side or (side > 0.0) == wanted for wanted, side in pairs)


@dataclass(frozen=True)
class Frame:
    """A tool or a base as a program specifies it: by a name, by its values, or in a way that can't
    be followed.

    Attributes:
        name: its name; for messages, and to look it up if it has no pose.
        pose: shape (4, 4), if the program contains it.
        reason: why it is not known.
    """

    name: str
    pose: np.ndarray | None = None
    reason: str = ""

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Frame) or (self.name, self.reason) != (other.name, other.reason):
            return False
        return self.pose is other.pose or (
            self.pose is not None
            and other.pose is not None
            and np.array_equal(self.pose, other.pose)
        )

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True)
class Point:
    """A position in a program.

    Attributes:
        name: its name in the program, or its line if it has none.
        source: index of the file.
        line: its line.
        kind: "pose" or "joints".
        numbers: its numbers, in the language's order.
        posture: the arm configuration.
        tool, base: of a pose; None if they are those of the motions to it.
        near: joint positions from which the controller starts its search, in the program's units.
    """

    name: str
    source: int
    line: int
    kind: PointKind
    numbers: tuple[Number, ...]
    posture: Posture = Posture()
    tool: Frame | None = None
    base: Frame | None = None
    near: tuple[float, ...] | None = None

    @property
    def key(self) -> PointKey:
        """What identifies it: file and position of its first number."""
        return self.source, self.numbers[0].start

    @property
    def values(self) -> np.ndarray:
        """The numbers' values."""
        return np.array([number.value for number in self.numbers])

    def skip(self, reason: str) -> Skipped:
        return Skipped(self.name, self.source, self.line, reason)


@dataclass(frozen=True)
class Skipped:
    """A point or a motion that is not corrected, and why."""

    name: str
    source: int
    line: int
    reason: str


@dataclass(frozen=True)
class Load:
    """A load that a program states for a motion.

    Attributes:
        text: its statement, or what sets it.
        line: its line.
        mass: [kg]; None if it is not in numbers.
    """

    text: str
    line: int
    mass: float | None = None


@dataclass(frozen=True)
class Motion:
    """A motion to a point, perhaps through others.

    Attributes:
        path: its kind of path.
        targets: names of points, points stated in the motion itself, or reasons why one is not
            known.
        statement: its statement.
        source: index of the file.
        tool, base: the frames in force.
        span: start and end of the last target in the text.
        run: motions of one file and one run are executed in the order of the text.
        can_insert: whether a statement can be inserted before it.
        takes_posture: whether the controller obeys the target's posture; else the arm keeps its
            own.
        load: the load in force, if the program states one.
        displaced: why targets, in joints as well, are not reached; of poses ``base`` says so, too.
    """

    path: Path
    targets: tuple[str | Point | Skipped, ...]
    statement: Statement
    source: int
    tool: Frame = field(default_factory=lambda: Frame(""))
    base: Frame = field(default_factory=lambda: Frame(""))
    span: tuple[int, int] = (0, 0)
    run: int = 0
    can_insert: bool = False
    takes_posture: bool = True
    load: Load | None = None
    displaced: str = ""


@dataclass
class Program:
    """A program that has been read.

    Attributes:
        sources: its files.
        tools, bases: poses by name, shape (4, 4), or why they are not known.
        points: the points to correct by their keys, in the order in which motions use them.
        motions: with the keys of their points, None for unknown ones.
        skipped: what can't be corrected.
        loads: by the key of a point the loads of the motions to it, None if none is stated.
    """

    sources: Sequence[Source]
    tools: Mapping[str, np.ndarray | str]
    bases: Mapping[str, np.ndarray | str]
    points: dict[PointKey, Point] = field(default_factory=dict)
    motions: list[tuple[Motion, tuple[PointKey | None, ...]]] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)
    loads: dict[PointKey, list[Load | None]] = field(default_factory=dict)

    def leave(self, only_read: Collection[int]) -> None:
        """Correct nothing in some files; their points that motions of other files use
        are skipped.
        """
        used = {
            key for motion, keys in self.motions if motion.source not in only_read for key in keys
        }
        self.skipped = [one for one in self.skipped if one.source not in only_read]
        for key in [key for key in self.points if key[0] in only_read]:
            point = self.points.pop(key)
            if key in used:
                self.skipped.append(point.skip("it is in a file that is only read"))


@dataclass(frozen=True)
class Edit:
    """A text that replaces what is from start to end in a file."""

    source: int
    start: int
    end: int
    text: str


def spliced(source: Source, index: int, edits: Iterable[Edit]) -> bytes:
    """Return a file with edits applied; all other bytes are unchanged."""
    out = []
    at = 0
    for edit in sorted(
        (edit for edit in edits if edit.source == index), key=lambda edit: (edit.start, edit.end)
    ):
        out += [source.content[at : edit.start], edit.text.encode("latin-1")]
        at = edit.end
    return b"".join([*out, source.content[at:]])


def counted_axes(count: int) -> str:
    """Return a count of axes.

    Example:
        >>> counted_axes(1), counted_axes(6)
        ('1 axis', '6 axes')
    """
    return f"{count} {'axis' if count == 1 else 'axes'}"


def number_text(number: Number, value: float, least: int) -> str:
    """Return the text of a value that replaces a number: the old text if the value is the same.

    Args:
        number: what is replaced.
        value: the new value.
        least: decimal places; as many as before if these were more.

    Example:
        >>> number_text(Number(100.5, 0, 5, "100.5"), 100.50001, 3)
        '100.5'
        >>> number_text(Number(-1.0, 0, 2, "-1"), -0.99, 3)
        '-0.990'
    """
    if abs(value - number.value) < 0.5 * 10.0**-least:
        return number.text
    # Adding 0 turns a negative zero into zero.
    digits = f"{round(value, max(number.decimals, least)) + 0.0:.{max(number.decimals, least)}f}"
    sign = "+" if number.text.startswith("+") and not digits.startswith("-") else ""
    # A number without a digit before its point keeps that style.
    if number.text.lstrip("+-").startswith(".") and digits.lstrip("-").startswith("0."):
        digits = digits.replace("0.", ".", 1)
    return sign + digits
