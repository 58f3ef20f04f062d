r"""Clocks of instruments that observe a moving tool, by the nominal arm, for unknown poses of
instrument and target.

Readings of a target t on a tip at (R, p) depend on :math:`R t + p`, those of a point P seen from
the tool on
:math:`R^T (P - p)`. Both, and so coordinates, are linear in p, R and :math:`R^T p` with constant
  coefficients. The square
of a distance is linear in these and :math:`|p|^2`, and an image is the ratio of two linear
functions. So the residuals of this fit are small only at the right offset of the clocks.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pincal.errors import MeasurementError, PincalWarning
from pincal.hypotheses.hypothesis import Hypothesis, explaining
from pincal.motion.clocks import Alignment, Clock, aligned
from pincal.motion.motion_numbers import CLOCKS, FOLLOWING
from pincal.motion.moving_arm import MovingArm
from pincal.motion.starts import OtherMotionError, check_clock, start_positions, steady
from pincal.motion.stream import Stream
from pincal.sensors.sensor import Sensor
from pincal.thresholds import Count, Scale

# Step of the search over offsets [s], rows of each target or point in it, their number, and the
# fewest rows of the others relative to the first.
_SEARCHED: Scale = 0.1
_SAMPLED: Count = 400
_THINGS: Count = 3
_MANY: Scale = 0.3
# Fraction of the shorter log that has to overlap.
_LEAST: Scale = 0.3
# Floor of the fraction of unexplained variance.
_FLOOR: Scale = 1e-5


def start_readings(arm: MovingArm, tracker: Stream, sensor: type[Sensor]) -> Clock:
    """Return the clock of an instrument by aligning its readings with the motion of an arm.

    Raises:
        MeasurementError: if it is not of this motion.
    """
    parts = list(_most_seen(tracker))
    if sensor.reads_pose:
        return _start_poses(arm, parts[0], sensor.fields[0].name)
    things = [_Thing.of(part, sensor) for part in parts]
    what = f"{sensor.blocks[0].name}s"
    offset = _searched(things, arm, what, source=tracker.name)
    alignment = _aligned(things, arm, Clock(offset), source=tracker.name)
    if sensor.follows != "squared":
        _refuse_mirrored(things[0], alignment, sensor, source=tracker.name)
    check_clock(tracker, alignment)
    return alignment.clock


def _searched(things: list[_Thing], arm: MovingArm, what: str, *, source: str) -> float:
    """Return the offset of the clocks by which things follow the arm, to the step of a search [s];
    refuse things of another motion.
    """
    (begin, end) = arm.path.span
    first = min(thing.time[0] for thing in things)
    last = max(thing.time[-1] for thing in things)
    lasts = min(end - begin, last - first)
    if lasts < FOLLOWING.shortest:
        raise MeasurementError(
            f"{source}: {what} over {lasts:.3g} s of motion do not determine the offset of the "
            f"clocks; expected {FOLLOWING.shortest:g} s or more"
        )
    grid = arm.path.grid(_SEARCHED)
    known = _functions(arm.tips(grid))
    longest = max(_LEAST * lasts, 0.5 * FOLLOWING.shortest)
    offsets = np.arange(begin + longest - last, end - longest - first, _SEARCHED)
    found = np.array(
        [[thing.unexplained(offset, grid, known) for offset in offsets] for thing in things]
    )
    # Weighted by the number of rows.
    score = np.mean(found[:, :, 1] * np.log(np.maximum(found[:, :, 0], _FLOOR)), axis=0)
    best = int(np.argmin(score))
    rest = float(np.mean(found[:, best, 0]))
    others = score[np.abs(offsets - offsets[best]) > CLOCKS.readings_apart]
    if rest > CLOCKS.unexplained or others.min(initial=0.0) < CLOCKS.rivals * score[best]:
        raise OtherMotionError(
            f"{source}: its {what} do not follow these joints, or follow them equally well at "
            f"several offsets of the clocks ({100 * np.sqrt(rest):.1f} % unexplained at best); "
            "expected a target on the tool of this arm, or points seen from it, with times of a "
            "clock and not a count of frames, over some minutes of non-repeating motion"
        )
    return float(offsets[best])


def _refuse_mirrored(
    thing: _Thing, alignment: Alignment, sensor: type[Sensor], *, source: str
) -> None:
    """Refuse readings in a left-handed frame."""
    if thing.handedness(alignment.matrix[0]) < FOLLOWING.mirrored:
        columns = " ".join(sensor.fields[0].columns)
        raise MeasurementError(
            f"{source}: {sensor.blocks[0].name}s are mirrored relative to the arm; expected a "
            "right-handed frame, for images u to the right and v down as the camera sees them: "
            f"swap two of {columns}, or change the sign of one"
        )


def _start_poses(arm: MovingArm, tracker: Stream, name: str) -> Clock:
    """Return the clock by positions, ``name`` in the readings, and orientations if there are
    any.
    """

    def follow(stream: Stream) -> bool:
        with contextlib.suppress(MeasurementError), warnings.catch_warnings():
            warnings.simplefilter("ignore", PincalWarning)
            start_positions(arm, stream, stream.readings[name])
            return True
        return False

    try:
        return start_positions(arm, tracker, tracker.readings[name])
    except OtherMotionError:
        mistake = next(explaining(_mistakes(tracker, name), tracker, follow), None)
        if mistake is None:
            raise
    raise MeasurementError(f"{tracker.name}: {mistake.words}: {mistake.advice}")


def _mistakes(tracker: Stream, name: str) -> Iterator[Hypothesis[Stream]]:
    """Yield mistakes in poses, whose position is ``name`` in the readings."""
    if "quaternion" in tracker.readings:
        words = (
            "poses are of the instrument in the target's frame; expected the target in the "
            "instrument's frame"
        )
        yield Hypothesis(words, lambda stream: _inverted(stream, name), "invert them")


def _inverted(stream: Stream, name: str) -> Stream:
    """Return a stream with its poses inverted."""
    from scipy.spatial.transform import Rotation

    back = Rotation.from_quat(stream.readings["quaternion"]).inv()
    position = -back.apply(stream.readings[name])
    readings = {**stream.readings, "quaternion": back.as_quat(), name: position}
    return replace(stream, readings=readings)


def _most_seen(tracker: Stream) -> Iterator[Stream]:
    """Yield the rows of some targets or points, each the one seen most often when those before are
    not.
    """
    index = tracker.things
    new = np.ones(len(index), bool)
    most = 0
    for _ in range(_THINGS):
        rows = index == np.argmax(np.bincount(index[new])) if new.any() else new
        if rows.sum() <= _MANY * most:
            return
        most = max(most, int(rows.sum()))
        new &= ~np.isin(tracker.time, tracker.time[rows])
        yield tracker.select(rows)


@dataclass(frozen=True)
class _Thing:
    """Readings of one target or point: N coordinates, one component after the other.

    Attributes:
        time: of each, shape (N,) [s].
        values: linear functions, or ratios of two, standardised by component, shape (N,).
        component: index of the component, shape (N,).
        functions: the functions of the tip's pose on which they depend.
        is_ratio: whether values are ratios.
    """

    time: np.ndarray
    values: np.ndarray
    component: np.ndarray
    functions: slice
    is_ratio: bool

    @classmethod
    def of(cls, seen: Stream, sensor: type[Sensor]) -> _Thing:
        values = seen.readings[sensor.fields[0].name].reshape(len(seen), -1)
        is_square = sensor.follows == "squared"
        values = values**2 if is_square else values
        kept = steady(values)
        seen = seen.select(kept)
        values = values[kept]
        values = (values - values.mean(axis=0)) / np.maximum(values.std(axis=0), 1e-300)
        functions = (
            slice(0, 16) if is_square else slice(3, 15) if sensor.is_on_tool else slice(0, 12)
        )
        m = values.shape[1]
        component = np.repeat(np.arange(m), len(seen))
        return cls(
            np.tile(seen.time, m),
            values.T.ravel(),
            component,
            functions,
            sensor.follows == "as ratios",
        )

    def columns(self, known: np.ndarray, rows: np.ndarray, middle: np.ndarray) -> np.ndarray:
        """Return the regressors of some values, shape (M, k).

        Args:
            known: functions of the tip at their times, shape (M, 16).
            rows: indices of the values, shape (M,).
            middle: mean of the functions, at which depths are not zero, shape (16,).
        """
        F = (known - middle)[:, self.functions]
        component = self.component[rows, None]
        A = np.column_stack([F, np.ones(len(F))])
        own = [A * (component == c) for c in range(int(self.component[-1]) + 1)]
        return np.hstack([*own, -self.values[rows, None] * F] if self.is_ratio else own)

    def unexplained(
        self, offset: float, grid: np.ndarray, known: np.ndarray
    ) -> tuple[float, float]:
        """Return the fraction of unexplained variance at an offset [s], and the fraction of rows on
        which it is based.

        ``known`` are functions of the tip, shape (K, 16), at times ``grid`` of the joints, shape
        (K,) [s].
        """
        rows = np.linspace(0, len(self.time) - 1, _SAMPLED).astype(int)
        at = self.time[rows] + offset
        near = np.clip(np.searchsorted(grid, at) - 1, 0, len(grid) - 2)
        step = grid[near + 1] - grid[near]
        # Nothing is known in gaps of the log.
        kept = (at > grid[0]) & (at < grid[-1]) & (step < 1.5 * _SEARCHED)
        if not kept.any():
            return 1.0, 0.0
        share = ((at - grid[near]) / step)[kept, None]
        rows = rows[kept]
        near = near[kept]
        here = known[near] + share * (known[near + 1] - known[near])
        A = self.columns(here, rows, here.mean(axis=0))
        y = self.values[rows]
        H = A.T @ A
        b = A.T @ y
        H[np.diag_indices_from(H)] += 1e-9 * H.max()
        return float(y @ y - b @ np.linalg.solve(H, b)) / max(len(y) * float(y.var()), 1e-300), len(
            y
        ) / _SAMPLED

    def handedness(self, solution: np.ndarray) -> float:
        """Return the handedness of axes, from 1 to -1 if mirrored, by a solution that begins with
        this thing's.
        """
        k = self.functions.stop - self.functions.start
        rows = np.array([solution[i * (k + 1) : i * (k + 1) + k] for i in range(3)])
        # Coefficients of the tip's position, negative for points seen from the tool.
        rows = -rows[:, -3:] if self.functions.start else rows[:, :3]
        return float(
            np.linalg.det(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300))
        )


def _aligned(things: list[_Thing], arm: MovingArm, start: Clock, *, source: str) -> Alignment:
    """Return the clock by which all things follow the arm."""
    middles = [
        _functions(arm.tips(start.to_joints(thing.time[:: len(thing.time) // _SAMPLED + 1]))).mean(
            axis=0
        )
        for thing in things
    ]
    time, values = (
        np.concatenate([getattr(thing, name) for thing in things]) for name in ("time", "values")
    )
    owner = np.repeat(np.arange(len(things)), [len(thing.time) for thing in things])
    number = np.concatenate([np.arange(len(thing.time)) for thing in things])

    def features(at: np.ndarray, rows: np.ndarray) -> np.ndarray:
        known = _functions(arm.tips(at))
        found = []
        for k, (thing, middle) in enumerate(zip(things, middles, strict=True)):
            here = owner[rows] == k
            own = thing.columns(known[here], number[rows[here]], middle)
            found.append(np.zeros((len(at), own.shape[1])))
            found[-1][here] = own
        return np.hstack(found)

    return aligned(time, values[:, None], features, arm.path.covers, start, source=source)


def _functions(tips: np.ndarray) -> np.ndarray:
    """Return the functions in which readings are linear, shape (N, 16): p, R, R^T p and the square
    of p.
    """
    p = tips[:, :, 3]
    R = tips[:, :, :3]
    return np.column_stack(
        [p, R.reshape(-1, 9), np.einsum("nji,nj->ni", R, p), np.sum(p**2, axis=1)]
    )
