"""How far the real arm deviates from lines and circles between corrected points, and intermediate
points against that.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pincal.compensate.robot_frames import in_base_frame
from pincal.programs.correct import Change, Corrector
from pincal.programs.language import ControllerLanguage
from pincal.programs.program import Edit, Motion, PointKey, Program, Skipped
from pincal.programs.syntax import Source
from pincal.robot.se3 import compose, exponentials, inverse, rotation_vectors, transform
from pincal.thresholds import Count, Scale

# Number of places along a motion, without its ends, at which the deviation is evaluated.
_SAMPLES: Count = 15
# Largest number of parts into which a motion is divided.
_MOST_PARTS: Count = 64
# Root of twice the area of three points of a circle, below which they count as collinear [m].
_STRAIGHT: Scale = 1e-6


@dataclass(frozen=True)
class Leg:
    """A motion along a line or a circle between corrected points.

    Attributes:
        motion: the motion.
        ends: the corrections of its points, from its start.
        tool: shape (4, 4), the tool in the tip.
    """

    motion: Motion
    ends: tuple[Change, ...]
    tool: np.ndarray


@dataclass(frozen=True)
class Deviation:
    """Largest distance of the tool from its path along a motion: ``size`` [m], NaN where the arm
    can't follow.
    """

    motion: Motion
    size: float


def legs_of(program: Program, changes: Mapping[PointKey, Change]) -> list[Leg]:
    """Return the lines and circles whose points are all corrected, the start included."""
    found = []
    for (before, starts), (motion, keys) in zip(program.motions, program.motions[1:], strict=False):
        if (
            motion.path == "joint"
            or not starts
            or (before.source, before.run) != (motion.source, motion.run)
        ):
            continue
        ends = [changes.get(key) if key is not None else None for key in (starts[-1], *keys)]
        known = tuple(end for end in ends if end is not None)
        if len(known) == len(ends) and known[-1].point.kind == "pose":
            found.append(Leg(motion, known, np.linalg.inv(known[-1].frames[1])))
    return found


class Follower:
    """Follows lines and circles with the real arm, as commanded by a nominal controller."""

    def __init__(self, corrector: Corrector) -> None:
        self.corrector = corrector
        self.placed = in_base_frame(corrector.calibrated)

    def deviations(self, legs: Sequence[Leg]) -> list[Deviation]:
        """Return how far the tool deviates from lines and circles between corrected points."""
        if not legs:
            return []
        ends = [np.array([[end.q, end.commanded] for end in leg.ends]) for leg in legs]
        payloads = np.array([leg.ends[-1].payload for leg in legs])
        sizes = self._sizes(ends, np.array([leg.tool for leg in legs]), payloads)
        return [Deviation(leg.motion, float(size)) for leg, size in zip(legs, sizes, strict=True)]

    def _sizes(
        self, ends: Sequence[np.ndarray], tools: np.ndarray, payloads: np.ndarray
    ) -> np.ndarray:
        """Return the largest deviations [m] between ends of shape (2 or 3, 2, n), joints as meant
        and as commanded.
        """
        tips = [
            self.corrector.arms.tips(end.reshape(-1, end.shape[-1])).reshape(*end.shape[:2], 3, 4)
            for end in ends
        ]
        stops = [[compose(tip[:, k], tool[None, :3])[[0, -2, -1]] for k in (0, 1)]
                 for tip, tool in zip(tips, tools, strict=True)]  # fmt: skip
        # Three poses each; the second one of a line is NaN.
        meant, commanded = np.array(stops).swapaxes(0, 1)
        is_line = np.array([len(end) == 2 for end in ends])
        meant[is_line, 1] = np.nan
        commanded[is_line, 1] = np.nan
        q = np.array([end[0, 1] for end in ends])
        back = inverse(tools[:, :3])
        worst = np.zeros(len(ends))
        follows = np.ones(len(ends), bool)
        for s in np.arange(1, _SAMPLES + 1) / (_SAMPLES + 1):
            q, reached = self.corrector.arms.reach(q, compose(_between(commanded, s), back))
            follows &= reached
            here, ahead = (_between(meant, t)[:, :, 3] for t in (s, s + 1e-4))
            off = compose(self._real_tips(q, payloads), tools[:, :3])[:, :, 3] - here
            along = ahead - here
            along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
            off -= np.einsum("ni,ni->n", off, along)[:, None] * along
            worst = np.maximum(worst, np.linalg.norm(off, axis=1))
        return np.where(follows, worst, np.nan)

    def _real_tips(self, q: np.ndarray, payloads: np.ndarray) -> np.ndarray:
        conditions = self.placed.of_its_day(self.corrector.conditions(q, payloads))
        targets = self.placed.model.predict(self.placed.model_values, conditions)
        return compose(targets, inverse(self.corrector.target))

    def divided(self, leg: Leg, limit: float) -> list[np.ndarray] | str:
        """Return intermediate poses of the tool that keep a line within a limit [m], or why there
        are none.

        The poses, shape (4, 4), are to be commanded in the base of the motion.
        """
        parts = 2
        while parts <= _MOST_PARTS:
            meant = self._along(leg, parts)
            if isinstance(meant, str):
                return meant
            start, end = leg.ends
            payloads = np.full(len(meant), end.payload)
            commanded, reasons = self.corrector.solve(
                meant, self.corrector.arms.tips(meant), payloads
            )
            if any(reasons):
                return next(reason for reason in reasons if reason)
            stops = zip(meant, commanded, strict=True)
            pairs = np.array([[start.q, start.commanded], *stops, [end.q, end.commanded]])
            sizes = self._sizes(
                [pairs[k : k + 2] for k in range(parts)],
                np.repeat(leg.tool[None], parts, axis=0),
                np.full(parts, end.payload),
            )
            if np.all(sizes <= limit):
                tips = self.corrector.arms.tips(commanded)
                base = np.linalg.inv(end.frames[0])
                return [base @ transform(tip[:, :3], tip[:, 3]) @ leg.tool for tip in tips]
            parts *= 2
        return f"the limit is exceeded even with {_MOST_PARTS} parts"

    def _along(self, leg: Leg, parts: int) -> np.ndarray | str:
        """Return the nominal joint positions where a line is divided, shape (parts - 1, n), or why
        there are none.
        """
        start, end = leg.ends
        back = inverse(leg.tool[None, :3])
        ends = compose(self.corrector.arms.tips(np.array([start.q, end.q])), leg.tool[None, :3])
        stop = np.array([[ends[0], np.full((3, 4), np.nan), ends[1]]])
        q = start.q[None]
        found = []
        for k in range(1, parts):
            q, reached = self.corrector.arms.reach(q, compose(_between(stop, k / parts), back))
            if not reached[0]:
                return "the arm can't follow it"
            found.append(q[0])
        return np.array(found)

    def inserted(
        self, program: Program, legs: Sequence[Leg], limit: float
    ) -> tuple[list[Edit], list[Skipped], int]:
        """Return inserted statements that keep lines within a limit [m], motions without any, and
        the number of points.
        """
        edits = list[Edit]()
        skipped = list[Skipped]()
        count = 0
        for leg, deviation in zip(legs, self.deviations(legs), strict=True):
            if deviation.size <= limit:
                continue
            motion = leg.motion
            line = _line_before(program.sources[motion.source], motion.statement.start)
            why = _no_insertion(self.corrector.language, motion, line.indent)
            poses = why or self.divided(leg, limit)
            if isinstance(poses, str):
                name = f"motion of line {motion.statement.line}"
                words = (
                    f"leaves its path by {1e3 * deviation.size:.3f} mm, and no points are "
                    f"inserted: {poses}"
                )
                skipped.append(Skipped(name, motion.source, motion.statement.line, words))
                continue
            text = "".join(
                line.indent + statement + line.ending
                for statement in self._statements(program, leg, poses)
            )
            edits.append(Edit(motion.source, line.begin, line.begin, text))
            count += len(poses)
        return edits, skipped, count

    def _statements(self, program: Program, leg: Leg, poses: Sequence[np.ndarray]) -> Iterator[str]:
        """Yield the statements of motions to poses on the way of a leg."""
        language = self.corrector.language
        point = leg.ends[-1].point
        source = program.sources[leg.motion.source]
        near = point.values
        for pose in poses:
            near = language.numbers(pose, near)
            yield language.statement(leg.motion, source, values=near, posture=point.posture)


@dataclass(frozen=True)
class _LineBefore:
    """Where statements are inserted.

    Attributes:
        begin: position of the beginning of the line in the text.
        indent: what stands before the statement on its line.
        ending: the end of the line before.
    """

    begin: int
    indent: str
    ending: str


def _line_before(source: Source, start: int) -> _LineBefore:
    """Return the place before the line of a statement that begins at a position."""
    begin = max(source.text.rfind(end, 0, start) for end in "\r\n") + 1
    is_pair = source.text.endswith("\r\n", 0, begin)
    ending = "\r\n" if is_pair else source.text[:begin][-1:] or "\n"
    return _LineBefore(begin, source.text[begin:start], ending)


def _no_insertion(language: ControllerLanguage, motion: Motion, indent: str) -> str:
    """Return why no statement can be inserted before a motion whose line begins with ``indent``, or
    "".
    """
    if not language.can_insert:
        return f"none can be inserted into programs in {language.name}"
    if motion.path == "circle":
        return "none can be inserted into circles"
    if not motion.can_insert or indent.strip(" \t"):
        return "no statement can stand before it"
    return ""


def _between(stops: np.ndarray, s: float) -> np.ndarray:
    """Return the poses, shape (N, 3, 4), at the fraction s of the way from the first of three poses
    to the last.

    The second of each three, shape (N, 3, 3, 4), is on a circle, or NaN for a line.
    """
    first = stops[:, 0]
    via = stops[:, 1]
    last = stops[:, 2]
    turn = rotation_vectors(last[:, :, :3] @ first[:, :, :3].swapaxes(1, 2))
    R = exponentials(s * turn) @ first[:, :, :3]
    position = first[:, :, 3] + s * (last[:, :, 3] - first[:, :, 3])
    for k in np.flatnonzero(np.isfinite(via[:, 0, 3])):
        position[k] = _on_circle(first[k, :, 3], via[k, :, 3], last[k, :, 3], s)
    return np.concatenate([R, position[:, :, None]], axis=2)


def _on_circle(a: np.ndarray, via: np.ndarray, b: np.ndarray, s: float) -> np.ndarray:
    """Return the point at the fraction s of the way from a via another point to b on the circle
    through the three.
    """
    u = via - a
    v = b - a
    normal = np.cross(u, v)
    area = float(normal @ normal)
    if area < _STRAIGHT**4:
        return np.asarray(a + s * v)
    centre = a + (np.cross(normal, u) * (v @ v) + np.cross(v, normal) * (u @ u)) / (2.0 * area)
    x = a - centre
    y = np.cross(normal, x) / np.sqrt(area)
    end = np.arctan2((b - centre) @ y, (b - centre) @ x) % (2.0 * np.pi)
    return np.asarray(centre + x * np.cos(s * end) + y * np.sin(s * end))
