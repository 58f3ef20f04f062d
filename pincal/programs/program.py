"""A program as all languages have it: points with the places of their numbers, motions between them, and frames."""

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
# File and place of the first number, which tell a point from all others.
PointKey = tuple[int, int]
# What a turn number counts: 1 for angles below 0; quarters from 0; whole turns from -180 deg; 1 from 180 deg either way.
TurnKind = Literal["negative", "quarter", "whole", "half"]


@dataclass(frozen=True)
class Turn:
    """A number in a program that tells where in its range a joint is.

    Attributes:
        joint: index of the joint.
        kind: what it counts.
        value: the number.
        number: where it stands.
        bit: which bit of the number it is; None if it is the whole number.
    """

    joint: int
    kind: TurnKind
    value: int
    number: Number
    bit: int | None = None

    def counted(self, angle: float) -> int:
        """Return the number where the joint is at an angle [rad]."""
        if self.kind == "negative":
            return int(angle < 0.0)
        if self.kind == "half":
            return int(abs(angle) >= math.pi)
        return math.floor(angle / (0.5 * math.pi) if self.kind == "quarter" else (angle + math.pi) / (2.0 * math.pi))


@dataclass(frozen=True)
class Posture:
    """Which of the arms that reach a pose is meant, as far as the program says.

    Attributes:
        front: the wrist is on the side of axis 1 to which the arm looks at zero.
        up: the elbow is above the line from shoulder to wrist, of an arm that looks to the front.
        down: the wrist is bent downwards, where axis 4 is at zero and the arm looks to the front.
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
        """Whether all three are made."""
        return None not in self.sides

    def allows(self, sides: np.ndarray) -> bool:
        """Return whether an arm is meant, by its sides as 1 or -1, shape (3,), 0 where it is on neither."""
        pairs = zip(self.sides, sides, strict=True)
        return all(wanted is None or not side or (side > 0.0) == wanted for wanted, side in pairs)


@dataclass(frozen=True)
class Frame:
    """A tool or a base as a program names it: by a name, by its values, or in a way that can't be followed.

    Attributes:
        name: its name; for messages, and to look it up if it has no pose.
        pose: shape (4, 4), if the program says it.
        reason: why it is not known, in words.
    """

    name: str
    pose: np.ndarray | None = None
    reason: str = ""

    def __eq__(self, other: object) -> bool:
        """Return whether another is the same frame."""
        if not isinstance(other, Frame) or (self.name, self.reason) != (other.name, other.reason):
            return False
        return self.pose is other.pose or (
            self.pose is not None and other.pose is not None and np.array_equal(self.pose, other.pose)
        )

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True)
class Point:
    """A position in a program.

    Attributes:
        name: as the program calls it; where it stands if it has none.
        source: index of the file.
        line: where it stands.
        kind: "pose" or "joints".
        numbers: the numbers that are it, in the language's order.
        posture: which arm is meant.
        tool: of a pose; None if the motions that use it tell.
        base: likewise.
        near: joint positions from which the controller starts to search, as it stands in the program.
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
        """What tells it from all others: where its first number stands."""
        return self.source, self.numbers[0].start

    @property
    def values(self) -> np.ndarray:
        """The numbers' values."""
        return np.array([number.value for number in self.numbers])


@dataclass(frozen=True)
class Left:
    """Something that is left as it was, and why."""

    name: str
    source: int
    line: int
    reason: str


@dataclass(frozen=True)
class Motion:
    """A motion to a point, and before it through others.

    Attributes:
        path: how.
        targets: names of points in the program, points that stand in the motion, or reasons why one is not known.
        statement: the statement that it is.
        source: index of the file.
        tool, base: the frames in force.
        span: start and end of the last target in the text.
        takes_posture: whether the controller obeys what the target says of the arm's posture; else it keeps the one it has.
        run: motions of one file and one run follow each other as they stand in the text.
        can_insert: whether a statement can be put before it.
    """

    path: Path
    targets: tuple[str | Point | Left, ...]
    statement: Statement
    source: int
    tool: Frame = field(default_factory=lambda: Frame(""))
    base: Frame = field(default_factory=lambda: Frame(""))
    span: tuple[int, int] = (0, 0)
    run: int = 0
    can_insert: bool = False
    takes_posture: bool = True


@dataclass
class Program:
    """A program that has been read.

    Attributes:
        sources: its files.
        tools, bases: poses by name, shape (4, 4), or why they are not known.
        points: by where they stand, in the order in which motions use them.
        motions: with the keys of their points, None for those that are not known.
        left: what is not understood.
    """

    sources: Sequence[Source]
    tools: Mapping[str, np.ndarray | str]
    bases: Mapping[str, np.ndarray | str]
    points: dict[PointKey, Point] = field(default_factory=dict)
    motions: list[tuple[Motion, tuple[PointKey | None, ...]]] = field(default_factory=list)
    left: list[Left] = field(default_factory=list)

    def leave(self, only_read: Collection[int]) -> None:
        """Correct nothing in some files, and name those of their points that motions of the others use."""
        used = {key for motion, keys in self.motions if motion.source not in only_read for key in keys}
        self.left = [left for left in self.left if left.source not in only_read]
        for key in [key for key in self.points if key[0] in only_read]:
            point = self.points.pop(key)
            if key in used:
                self.left.append(Left(point.name, point.source, point.line, "it stands in a file that is only read"))


@dataclass(frozen=True)
class Edit:
    """A text that takes the place of another: from start to end in a file."""

    source: int
    start: int
    end: int
    text: str


def spliced(source: Source, index: int, edits: Iterable[Edit]) -> bytes:
    """Return a file with edits; all other bytes are as they were."""
    out, at = [], 0
    for edit in sorted((edit for edit in edits if edit.source == index), key=lambda edit: (edit.start, edit.end)):
        out += [source.content[at : edit.start], edit.text.encode("latin-1")]
        at = edit.end
    return b"".join([*out, source.content[at:]])


def number_text(number: Number, value: float, least: int) -> str:
    """Return a value as it stands in the place of a number: its own text if this says the same.

    Args:
        number: what stands there.
        value: the new value.
        least: digits behind the point that it takes; there are as many as before, if these were more.

    Example:
        >>> number_text(Number(100.5, 0, 5, "100.5"), 100.50001, 3), number_text(Number(-1.0, 0, 2, "-1"), -0.99, 3)
        ('100.5', '-0.990')
    """
    if abs(value - number.value) < 0.5 * 10.0**-least:
        return number.text
    # Adding 0 makes a zero of a negative zero.
    digits = f"{round(value, max(number.decimals, least)) + 0.0:.{max(number.decimals, least)}f}"
    sign = "+" if number.text.startswith("+") and not digits.startswith("-") else ""
    # A number that starts with its point goes on doing so.
    if number.text.lstrip("+-").startswith(".") and digits.lstrip("-").startswith("0."):
        digits = digits.replace("0.", ".", 1)
    return sign + digits
