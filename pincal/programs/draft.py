"""What is found in the files of a program while they are read, and what of it may be relied on.

A point is corrected if it has one value, which nothing else in the program may set, and if all motions to it have the same
tool and base, whose values are known. Whatever a language can say comes down to that: a value in numbers, another value, a
motion, and names that something is computed from.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pincal.programs.program import FrameKind, Left, Motion, Point, PointKey, Program
from pincal.programs.syntax import Source


@dataclass
class Draft:
    """What a language finds in the files of a program.

    Attributes:
        sources: the files.
        by_itself: whether declared points are corrected even if no motion names them.
        motions: in their order.
        left: what is not understood.
        constants: names that nothing can change.
        near: names of joint positions near which the controller searches for a pose, by the name of the pose.
    """

    sources: Sequence[Source]
    by_itself: bool = False
    motions: list[Motion] = field(default_factory=list)
    left: list[Left] = field(default_factory=list)
    constants: set[str] = field(default_factory=set)
    near: dict[str, str] = field(default_factory=dict)
    _points: dict[str, list[Point]] = field(default_factory=dict)
    _frames: dict[FrameKind, dict[str, np.ndarray | str]] = field(default_factory=lambda: {"tool": {}, "base": {}})
    _written: dict[str, str] = field(default_factory=dict)
    _read: set[str] = field(default_factory=set)
    _origins: dict[str, set[str]] = field(default_factory=dict)

    def declare(self, point: Point) -> None:
        """Take note of a point's value in numbers."""
        self._points.setdefault(point.name, []).append(point)

    def take(self, name: str, found: Point | Left) -> None:
        """Take note of a point, or that a name is left as it was."""
        if isinstance(found, Left):
            self.left.append(found)
            self.write(name, found.reason)
        else:
            self.declare(found)

    def frame(self, name: str, pose: np.ndarray | str, kinds: Sequence[FrameKind]) -> None:
        """Take note of the pose, shape (4, 4), of a tool or a base, or why it is not known."""
        for kind in kinds:
            self._frames[kind][name] = "it has more than one value" if name in self._frames[kind] else pose

    def write(self, name: str, reason: str) -> None:
        """Take note that a name, or with the index ``*`` any element of it, has another value than it has in numbers."""
        self._written.setdefault(name, reason)

    def hand(self, names: Iterable[str], line: int, routine: str) -> None:
        """Take note that names are handed to a routine, which may change them."""
        for name in names:
            if name not in self.constants:
                self.write(name, f"line {line} hands it to {routine}, which may change it")

    def read(self, names: Iterable[str]) -> None:
        """Take note that something is computed from names."""
        self._read |= set(names)

    def derive(self, name: str, origins: Iterable[str]) -> None:
        """Take note that a value, perhaps a tool or a base, is computed from names."""
        self._origins.setdefault(name, set()).update(origins)
        self.read(origins)

    def names(self) -> Mapping[str, list[Point]]:
        """Return the points by their names."""
        return self._points

    def finish(self) -> Program:
        """Return the program: each point once, with the frames that its motions or itself tell."""
        frames = {
            kind: {name: self._why(name) or pose for name, pose in found.items()} for kind, found in self._frames.items()
        }
        program = Program(self.sources, frames["tool"], frames["base"], left=list(self.left))
        known = self._known(program)
        used: dict[PointKey, Point] = {}
        spoilt: dict[PointKey, str] = {}
        for motion in self.motions:
            stops: list[PointKey | None] = []
            for target in motion.targets:
                points = self._meant(target, known)
                name = target if isinstance(target, str) else ""
                if isinstance(target, Left):
                    program.left.append(target)
                elif (
                    not points and not self._elements(name, self._points) and name not in {one.name for one in program.left}
                ):
                    line = motion.statement.line
                    program.left.append(Left(name, motion.source, line, self._why(name) or "declared elsewhere"))
                for point in points:
                    framed = replace(point, tool=point.tool or motion.tool, base=point.base or motion.base)
                    before = used.setdefault(point.key, framed)
                    if point.kind == "pose" and (before.tool, before.base) != (framed.tool, framed.base):
                        spoilt[point.key] = f"used with other frames on line {motion.statement.line} than before"
                stops.append(points[0].key if len(points) == 1 else None)
            program.motions.append((motion, tuple(stops)))
        for point in known.values():
            if point.key in used:
                continue
            is_framed = point.tool is not None and point.base is not None
            if not self._is_read(point.name) and (point.kind == "joints" or (self.by_itself and is_framed)):
                used[point.key] = point
            else:
                words = "other positions are computed from it, and no motion uses it itself"
                no_motion = "no motion uses it here, so its tool and base are not known"
                reason = words if self._is_read(point.name) else no_motion
                program.left.append(Left(point.name, point.source, point.line, reason))
        for key, reason in spoilt.items():
            point = used.pop(key)
            program.left.append(Left(point.name, point.source, point.line, reason))
        program.points = used
        return program

    def _known(self, program: Program) -> dict[str, Point]:
        """Return the points that may be relied on by their names; name the others."""
        known: dict[str, Point] = {}
        frames = self._frame_names()
        targets = {name for motion in self.motions for target in motion.targets if isinstance(target, str)
                   for name in (self._elements(target, self._points) or [target])}  # fmt: skip
        for name, points in self._points.items():
            if name in frames and name not in targets:
                continue
            reason = self._why(name)
            if name in frames:
                reason = "a tool or a base is computed from it, or it is one"
            elif len(points) > 1:
                reason = f"it has a value on line {points[0].line} and another on line {points[1].line}"
            if reason:
                program.left += [Left(name, point.source, point.line, reason) for point in points]
            else:
                known[name] = points[0]
        for name, seed in self.near.items():
            if name in known and seed in known and known[seed].kind == "joints":
                known[name] = replace(known[name], near=tuple(known[seed].values))
        return known

    def _frame_names(self) -> set[str]:
        """Return the names of all that tools and bases are, or are computed from."""
        found = {frame.name for motion in self.motions for frame in (motion.tool, motion.base)} | {"$TOOL", "$BASE"}
        ahead = list(found)
        while ahead:
            name = ahead.pop()
            more = set().union(*(self._origins.get(other, set()) for other in (name, _any(name)))) - found
            found |= more
            ahead += more
        return found

    def _why(self, name: str) -> str:
        """Return why a name may have another value than it has in numbers, or an empty text."""
        return next((self._written[one] for one in (name, _any(name), _stem(name)) if one in self._written), "")

    def _is_read(self, name: str) -> bool:
        return name in self._read or _any(name) in self._read

    def _elements(self, name: str, points: Iterable[str]) -> list[str]:
        """Return the names of points that a target may be: of an array with an index that is computed, all."""
        if "*" in name:
            return [other for other in points if other != _stem(other) and _stem(other) == _stem(name)]
        return [name] if name in self._points else []

    def _meant(self, target: str | Point | Left, known: Mapping[str, Point]) -> list[Point]:
        if isinstance(target, str):
            return [known[name] for name in self._elements(target, known) if name in known]
        return [target] if isinstance(target, Point) else []


def _stem(name: str) -> str:
    """Return the name of the array that an element is of, or the name."""
    return name.partition("[")[0].partition("{")[0]


def _any(name: str) -> str:
    """Return the name of any element of the array that an element is of."""
    return f"{_stem(name)}[*]"
