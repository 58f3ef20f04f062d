"""What is found in the files of a program while they are read, and which of it is reliable.

A point is corrected if it has a single value, which nothing else in the program may set, and if all
motions to it have the same tool and base, whose values are known. Every language reduces to that: a
value in numbers, another value, a motion, and names from which something is computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pincal.errors import ProgramError
from pincal.programs.line_flow import ANY, STATED_LOAD, Line
from pincal.programs.program import FrameKind, Motion, Point, PointKey, Program, Skipped
from pincal.programs.syntax import Source, Statement
from pincal.thresholds import Count

# Uses of points by motions; each target of a computed index uses all points of its array.
MOST_USES: Count = 1_000_000
EVERY = "*"
"""Stands for every name that is not a constant."""


@dataclass
class Draft:
    """What a language finds in the files of a program.

    Attributes:
        sources: the files.
        by_itself: whether declared points are corrected even if no motion names them.
        motions: in their order.
        skipped: what can't be corrected.
        constants: names that nothing can change.
        near: by the name of a pose, the name of joint positions near which the controller searches
            for it.
        masses: of loads [kg], by their names.
        at_rest: whether the external axes of a position of their own are at 0, by its name.
    """

    sources: Sequence[Source]
    by_itself: bool = False
    motions: list[Motion] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)
    constants: set[str] = field(default_factory=set)
    near: dict[str, str] = field(default_factory=dict)
    at_rest: dict[str, bool] = field(default_factory=dict)
    masses: dict[str, float] = field(default_factory=dict)
    _points: dict[str, list[Point]] = field(default_factory=dict)
    _frames: dict[FrameKind, dict[str, np.ndarray | str]] = field(
        default_factory=lambda: {"tool": {}, "base": {}}
    )
    # The elements of arrays, by the names of these.
    _arrays: dict[str, list[str]] = field(default_factory=dict)
    # The frames of the points that a name may refer to: "tool 3", "base *".
    _framed: dict[str, set[str]] = field(default_factory=dict)
    _written: dict[str, str] = field(default_factory=dict)
    _read: set[str] = field(default_factory=set)
    _origins: dict[str, set[str]] = field(default_factory=dict)

    def declare(self, point: Point) -> None:
        """Note a point's value in numbers."""
        if point.name not in self._points and point.name != _stem(point.name):
            self._arrays.setdefault(_stem(point.name), []).append(point.name)
        self._points.setdefault(point.name, []).append(point)

    def take(self, found: Point | Skipped) -> None:
        """Note a point, or a name that is not corrected."""
        if isinstance(found, Skipped):
            self.skipped.append(found)
            self.write(found.name, found.reason)
        else:
            self.declare(found)

    def frame(self, name: str, pose: np.ndarray | str, kinds: Sequence[FrameKind]) -> None:
        """Note the pose, shape (4, 4), of a tool or a base, or why it is not known."""
        for kind in kinds:
            self._frames[kind][name] = (
                "it has more than one value" if name in self._frames[kind] else pose
            )

    def write(self, name: str, reason: str) -> None:
        """Note that a name, or with the index ``*`` any of its elements, may have another value
        than the one in numbers.
        """
        self._written.setdefault(name, reason)

    def write_any(self, reason: str) -> None:
        """Note that any name but a constant may have another value than the one in numbers."""
        self.write(EVERY, reason)

    def pass_to(self, routine: str, names: Iterable[str], line: int) -> None:
        """Note that names are passed to a routine, which may change them."""
        for name in names:
            if name not in self.constants:
                self.write(name, f"line {line} passes it to {routine}, which may change it")

    def read(self, names: Iterable[str]) -> None:
        """Note that something is computed from names."""
        self._read |= set(names)

    def derive(self, name: str, origins: Iterable[str]) -> None:
        """Note that a value, perhaps a tool or a base, is computed from names."""
        self._origins.setdefault(name, set()).update(origins)
        self.read(origins)

    def names(self) -> Mapping[str, list[Point]]:
        return self._points

    def why_displaced(self, name: str, reasons: Mapping[str, str]) -> str:
        """Return why a position may be displaced, "" if it is not.

        Args:
            name: the position, or with the index ``*`` any.
            reasons: the reasons by what is displaced: "tool 3" or "base *" for a frame, else any
                position.
        """
        for what, reason in reasons.items():
            if what == STATED_LOAD:
                continue
            kind, _, index = what.partition(" ")
            if kind not in ("tool", "base") or (index != ANY and not index.isdigit()):
                return reason
            if what in self._frames_of(name):
                return f"{what}: {reason}"
        return ""

    def _frames_of(self, name: str) -> set[str]:
        """Return the frames of the points that a name may refer to, as "tool 3"; "tool *" stands
        for any.
        """
        if name not in self._framed:
            found = set[str]()
            for other in self.elements(name):
                for point in self._points[other]:
                    if point.kind == "pose":
                        found |= {f"tool {ANY}", f"base {ANY}"}
                        found |= {f"tool {point.tool.name}"} if point.tool is not None else set()
                        found |= {f"base {point.base.name}"} if point.base is not None else set()
            self._framed[name] = found
        return self._framed[name]

    def leave_unused(self, lines: Sequence[Line]) -> None:
        """Leave the positions to which no motion goes, if any line may displace them."""
        used = {
            target
            for motion in self.motions
            for target in motion.targets
            if isinstance(target, str)
        }
        reasons = dict[str, str]()
        for line in lines:
            for name, reason in line.sets:
                reasons.setdefault(name, reason)
        for name in self._points:
            why = "" if name in used else self.why_displaced(name, reasons)
            if why:
                self.write(name, why)

    def finish(self) -> Program:
        """Return the program: each point once, with its own frames or those of the
        motions to it.
        """
        frames = self._values_of_frames()
        program = Program(self.sources, frames["tool"], frames["base"], skipped=list(self.skipped))
        known = self._known(program)
        uses = _Uses(self, program, known, {one.name for one in program.skipped})
        for motion in self.motions:
            uses.follow(motion)
        uses.add_unused()
        program.skipped += [
            uses.used.pop(key).skip(reason) for key, reason in uses.ambiguous.items()
        ]
        program.points = uses.used
        return program

    def _values_of_frames(self) -> dict[str, dict[str, np.ndarray | str]]:
        """Return tools and bases by their names, as poses or why they are not known."""
        frames: dict[str, dict[str, np.ndarray | str]] = {
            kind: {name: self.why_written(name) or pose for name, pose in found.items()}
            for kind, found in self._frames.items()
        }
        # What the program sets of a frame that it does not state in numbers.
        for motion in self.motions:
            for kind, frame in (("tool", motion.tool), ("base", motion.base)):
                # System variables are followed from statement to statement.
                is_followed = frame.pose is not None or frame.name[:1] in ("", "$")
                why = "" if is_followed else self.why_written(frame.name)
                if why:
                    frames[kind].setdefault(frame.name, why)
        return frames

    def _known(self, program: Program) -> dict[str, Point]:
        """Return the reliable points by their names; the others are skipped."""
        known: dict[str, Point] = {}
        frames = self._frame_names()
        named = {
            target
            for motion in self.motions
            for target in motion.targets
            if isinstance(target, str)
        }
        targets = {name for target in named for name in (self.elements(target) or [target])}
        for name, points in self._points.items():
            if name in frames and name not in targets:
                continue
            reason = self.why_written(name)
            if name in frames:
                reason = "it is a tool or a base, or one is computed from it"
            elif len(points) > 1:
                reason = f"it has different values on lines {points[0].line} and {points[1].line}"
            if reason:
                program.skipped += [point.skip(reason) for point in points]
            else:
                known[name] = points[0]
        for name, seed in self.near.items():
            if name in known and seed in known and known[seed].kind == "joints":
                known[name] = replace(known[name], near=tuple(known[seed].values))
        return known

    def _frame_names(self) -> set[str]:
        """Return the names of tools and bases, and of all that they are computed from."""
        found = {frame.name for motion in self.motions for frame in (motion.tool, motion.base)} | {
            "$TOOL",
            "$BASE",
        }
        ahead = list(found)
        while ahead:
            name = ahead.pop()
            more = (
                set().union(*(self._origins.get(other, set()) for other in (name, _any(name))))
                - found
            )
            found |= more
            ahead += more
        return found

    def why_written(self, name: str) -> str:
        """Return why a name may have another value than the one in numbers, or ""."""
        names = [name, _any(name), _stem(name)]
        if not {name, _stem(name)} & self.constants:
            names.append(EVERY)
        return next((self._written[one] for one in names if one in self._written), "")

    def elements(self, name: str) -> list[str]:
        """Return the names of the points that a target may refer to: for a computed index, all of
        the array.
        """
        if "*" in name:
            return self._arrays.get(_stem(name), [])
        return [name] if name in self._points else []

    def is_read(self, name: str) -> bool:
        """Return whether something is computed from a name."""
        return name in self._read or _any(name) in self._read


@dataclass
class _Uses:
    """The points that the motions of a program use, each with its frames.

    Attributes:
        draft: what was found in the files.
        program: what becomes of it.
        known: the reliable points by their names.
        said: names of what is left.
        used: the points to correct, in the order in which motions use them.
        ambiguous: why some of these are left after all.
        meant: points by the targets that mean them: a computed index means all of an array.
        loads: the loads of points that are noted, by their lines and texts.
        work: number of uses of points.
    """

    draft: Draft
    program: Program
    known: Mapping[str, Point]
    said: set[str]
    used: dict[PointKey, Point] = field(default_factory=dict)
    ambiguous: dict[PointKey, str] = field(default_factory=dict)
    meant: dict[str, list[Point]] = field(default_factory=dict)
    loads: dict[tuple[int, int, int, str], bool] = field(default_factory=dict)
    work: int = 0

    def follow(self, motion: Motion) -> None:
        """Note the points of a motion."""
        stops: list[PointKey | None] = []
        for target in motion.targets:
            points = self._points_of(target)
            if not points:
                self._leave(target, motion)
            for point in points:
                self._use(point, motion)
            stops.append(points[0].key if len(points) == 1 else None)
        # Without its items, which are most of what is read and of no use from here on.
        at = motion.statement
        place = Statement((), at.start, at.end, at.line)
        self.program.motions.append((replace(motion, statement=place), tuple(stops)))

    def _points_of(self, target: str | Point | Skipped) -> list[Point]:
        """Return the points that a target means."""
        if not isinstance(target, str):
            return [target] if isinstance(target, Point) else []
        if target not in self.meant:
            names = self.draft.elements(target)
            self.meant[target] = [self.known[name] for name in names if name in self.known]
        self.work += len(self.meant[target])
        if self.work > MOST_USES:
            raise ProgramError(
                f"more than {MOST_USES} uses of points by motions, computed indices "
                "included; expected fewer: divide the program"
            )
        return self.meant[target]

    def _leave(self, target: str | Point | Skipped, motion: Motion) -> None:
        """Note a target without a reliable point, once."""
        if isinstance(target, Skipped):
            self.program.skipped.append(target)
            self.said.add(target.name)
        elif isinstance(target, str) and not (target in self.said or self.draft.elements(target)):
            reason = self.draft.why_written(target) or "declared elsewhere"
            line = motion.statement.line
            self.program.skipped.append(Skipped(target, motion.source, line, reason))
            self.said.add(target)

    def _use(self, point: Point, motion: Motion) -> None:
        """Note that a motion goes to a point."""
        self._note_load(point, motion)
        framed = replace(point, tool=point.tool or motion.tool, base=point.base or motion.base)
        before = self.used.setdefault(point.key, framed)
        if point.kind == "joints":
            if motion.displaced:
                self.ambiguous[point.key] = motion.displaced
        elif (before.tool, before.base) != (framed.tool, framed.base):
            self.ambiguous[point.key] = (
                f"used with different frames before and on line {motion.statement.line}"
            )

    def _note_load(self, point: Point, motion: Motion) -> None:
        """Note the load of a motion to a point, once."""
        found = self.program.loads.setdefault(point.key, [])
        line = motion.load.line if motion.load is not None else 0
        text = motion.load.text if motion.load is not None else ""
        name = (*point.key, line, text)
        if name not in self.loads:
            self.loads[name] = True
            found.append(motion.load)

    def add_unused(self) -> None:
        """Take the points that no motion uses if they need none, and leave the others."""
        for point in self.known.values():
            if point.key in self.used:
                continue
            reason = self._why_unused(point)
            if reason:
                self.program.skipped.append(point.skip(reason))
            else:
                self.used[point.key] = point

    def _why_unused(self, point: Point) -> str:
        """Return why a point that no motion uses is left, "" if it is not."""
        if self.draft.is_read(point.name):
            return "other positions are computed from it, and no motion uses it directly"
        is_framed = point.tool is not None and point.base is not None
        if self.draft.by_itself and (point.kind == "joints" or is_framed):
            return ""
        if point.kind == "joints":
            return "no motion uses it here: it may be something else than a position"
        return "no motion uses it here, so its tool and base are not known"


def joined(programs: Sequence[Program]) -> Program:
    """Return one program of several that share files but no positions."""
    first = programs[0]
    for other in programs[1:]:
        first.points.update(other.points)
        first.motions += other.motions
        first.skipped += other.skipped
        first.loads.update(other.loads)
    return first


def _stem(name: str) -> str:
    """Return the name of an element's array, or the name itself."""
    return name.partition("[")[0].partition("{")[0]


def _any(name: str) -> str:
    """Return the name that stands for any element of an element's array."""
    return f"{_stem(name)}[*]"
