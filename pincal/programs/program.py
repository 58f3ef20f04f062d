"""A program as all languages have it: points with the places of their numbers, motions between them, and frames."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from pincal.programs.syntax import Number, Source, Statement

PointKind = Literal["pose", "joints"]
Path = Literal["joint", "line", "circle"]
# What a turn number counts: 1 for angles below 0; quarters from 0; whole turns from -180 deg; 1 from 180 deg either way.
# File and place of the first number, which tell a point from all others.
PointKey = tuple[int, int]
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

    def counted(self, q: np.ndarray) -> np.ndarray:
        """Return the number at joint positions, shape (N, n), shape (N,)."""
        angle = q[:, self.joint]
        count = {
            "negative": angle < 0.0,
            "quarter": np.floor(angle / (0.5 * np.pi)),
            "whole": np.floor((angle + np.pi) / (2.0 * np.pi)),
            "half": np.abs(angle) >= np.pi,
        }[self.kind]
        return np.asarray(count).astype(int)


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
        run: motions of one file and one run follow each other as they stand in the text.
        can_insert: whether a statement can be put before it.
    """

    path: Path
    targets: tuple[str | Point | Left, ...]
    statement: Statement
    source: int
    tool: Frame
    base: Frame
    span: tuple[int, int]
    run: int = 0
    can_insert: bool = False


@dataclass
class Draft:
    """What a language finds in the files of a program, while it reads them.

    Attributes:
        sources: the files.
        declared: points by name, all that have it.
        motions: in their order.
        left: what is not understood.
        tools, bases: poses by name, shape (4, 4); None where a name has several or one that is computed.
        changed: why a point by this name is not what its declaration says, in words.
        fixed: names of points that nothing can change.
        near: names of joint positions near which the controller searches for a pose, by the name of the pose.
        computed: names of points that other positions are computed from.
        by_itself: whether declared points are corrected even if no motion names them.
    """

    sources: Sequence[Source]
    declared: dict[str, list[Point]] = field(default_factory=dict)
    motions: list[Motion] = field(default_factory=list)
    left: list[Left] = field(default_factory=list)
    tools: dict[str, np.ndarray | None] = field(default_factory=dict)
    bases: dict[str, np.ndarray | None] = field(default_factory=dict)
    changed: dict[str, str] = field(default_factory=dict)
    fixed: set[str] = field(default_factory=set)
    near: dict[str, str] = field(default_factory=dict)
    computed: set[str] = field(default_factory=set)
    by_itself: bool = False

    def declare(self, point: Point) -> None:
        """Add a point."""
        self.declared.setdefault(point.name, []).append(point)

    def keep(self, frames: dict[str, np.ndarray | None], name: str, pose: np.ndarray | None) -> None:
        """Add a tool or a base; one that is there already is not known."""
        frames[name] = None if name in frames else pose

    def finish(self) -> Program:
        """Return the program: each point once, with the frames that its motions or itself tell."""
        program = Program(self.sources, dict(self.tools), dict(self.bases), left=list(self.left))
        known: dict[str, Point] = {}
        for name, points in self.declared.items():
            reason = self.changed.get(name, "")
            if len(points) > 1:
                reason = f"it has a value on line {points[0].line} and another on line {points[1].line}"
            if reason:
                program.left += [Left(name, point.source, point.line, reason) for point in points]
            else:
                known[name] = points[0]
        for name, seed in self.near.items():
            if name in known and seed in known and known[seed].kind == "joints":
                known[name] = replace(known[name], near=tuple(known[seed].values))
        used: dict[PointKey, Point] = {}
        spoilt: dict[PointKey, str] = {}
        for motion in self.motions:
            stops: list[PointKey | None] = []
            for target in motion.targets:
                point = known.get(target) if isinstance(target, str) else target
                if not isinstance(point, Point):
                    lost = point or Left(str(target), motion.source, motion.statement.line, "declared elsewhere")
                    if not (isinstance(target, str) and target in self.declared):
                        program.left.append(lost)
                    stops.append(None)
                    continue
                framed = replace(point, tool=point.tool or motion.tool, base=point.base or motion.base)
                before = used.setdefault(point.key, framed)
                if point.kind == "pose" and (before.tool, before.base) != (framed.tool, framed.base):
                    spoilt[point.key] = f"used with other frames on line {motion.statement.line} than before"
                stops.append(point.key)
            program.motions.append((motion, tuple(stops)))
        for point in known.values():
            if point.key in used:
                continue
            is_alone = (self.by_itself or point.kind == "joints") and point.name not in self.computed
            is_framed = point.tool is not None and point.base is not None
            if is_alone and (point.kind == "joints" or is_framed):
                used[point.key] = point
            else:
                words = "other positions are computed from it, and no motion uses it itself"
                no_motion = "no motion uses it here, so its tool and base are not known"
                program.left.append(
                    Left(point.name, point.source, point.line, words if point.name in self.computed else no_motion)
                )
        for key, reason in spoilt.items():
            point = used.pop(key)
            program.left.append(Left(point.name, point.source, point.line, reason))
        program.points = used
        return program


@dataclass
class Program:
    """A program that has been read.

    Attributes:
        sources: its files.
        tools, bases: poses by name, shape (4, 4), None where they are not known.
        points: by where they stand, in the order in which motions use them.
        motions: with the keys of their points, None for those that are not known.
        left: what is not understood.
    """

    sources: Sequence[Source]
    tools: Mapping[str, np.ndarray | None]
    bases: Mapping[str, np.ndarray | None]
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
