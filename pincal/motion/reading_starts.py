r"""How the clock of any instrument that reads a moving tool is found by the nominal arm, wherever instrument and target are.

Of a target t on a tip at (R, p), what is read depends on :math:`R t + p`; of a point P that is seen from the tool on
:math:`R^T (P - p)`. Both are linear in p, R and :math:`R^T p`, with coefficients that stay the same: so are coordinates. The
square of a distance is linear in these and :math:`|p|^2`, and an image is the ratio of two that are. So each offset of the
clocks leaves something of what is read; the right one hardly anything.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.sensor import Sensor
from pincal.motion.clocks import Alignment, Clock, aligned
from pincal.motion.moving_arm import MovingArm
from pincal.motion.starts import SHORTEST, OtherMotionError, check_clock, start_positions, steady
from pincal.motion.stream import Stream

# Steps by which offsets are searched [s], and rows of a thing that are looked at; things that are looked at, and the rows
# that the others have at least, by those of the first.
_SEARCHED, _SAMPLED, _THINGS, _MANY = 0.1, 400, 3, 0.3
# Part of the shorter log that has to overlap.
_LEAST = 0.3
# Part of the variance that may be left at the best offset, where robots leave 1e-5 to 1e-3 and less says no more; of the
# logarithm of likelihood there, what any offset may have that is farther from it than this [s].
_ALIKE, _FLOOR, _RIVALS, _APART = 1e-2, 1e-5, 0.75, 1.0
# Handedness of axes, 1 or -1 but for what the nominal arm has wrong, from which on they are mirrored.
_MIRRORED = -0.5


def start_readings(arm: MovingArm, tracker: Stream, sensor: type[Sensor]) -> Clock:
    """Lay what an instrument reads onto the motion of an arm; return its clock.

    Args:
        arm: the arm on its path.
        tracker: the stream.
        sensor: what reads it.

    Raises:
        MeasurementError: if it is not of this motion.
    """
    parts = list(_most_seen(tracker))
    if sensor.reads_pose:
        return _start_poses(arm, parts[0], parts[0].readings[sensor.fields[0].name])
    things = [_Thing.of(part, sensor) for part in parts]
    what, (begin, end) = f"{sensor.blocks[0].name}s", arm.path.span
    first, last = min(thing.time[0] for thing in things), max(thing.time[-1] for thing in things)
    lasts = min(end - begin, last - first)
    if lasts < SHORTEST:
        raise MeasurementError(
            f"{tracker.name}: {what} of {lasts:.3g} s of motion do not tell the offset of the clocks; expected "
            f"{SHORTEST:g} s or more"
        )
    grid = arm.path.grid(_SEARCHED)
    known, longest = _functions(arm.tips(grid)), max(_LEAST * lasts, 0.5 * SHORTEST)
    offsets = np.arange(begin + longest - last, end - longest - first, _SEARCHED)
    found = np.array([[thing.left(offset, grid, known) for offset in offsets] for thing in things])
    # What is left of fewer rows says less.
    score = np.mean(found[:, :, 1] * np.log(np.maximum(found[:, :, 0], _FLOOR)), axis=0)
    best = int(np.argmin(score))
    left, others = float(np.mean(found[:, best, 0])), score[np.abs(offsets - offsets[best]) > _APART]
    if left > _ALIKE or others.min(initial=0.0) < _RIVALS * score[best]:
        raise OtherMotionError(
            f"{tracker.name}: its {what} do not change as these joints move, or as well at several offsets of the clocks "
            f"({100 * np.sqrt(left):.1f} % are left at best); expected a target on the tool of this arm, or points that are "
            "seen from it, by a clock and no count of frames, on a motion of some minutes that does not repeat"
        )
    lain = _aligned(things, arm, Clock(float(offsets[best])))
    if sensor.follows != "squared" and things[0].handedness(lain.matrix[0]) < _MIRRORED:
        columns = " ".join(sensor.fields[0].columns)
        raise MeasurementError(
            f"{tracker.name}: {what} are those of a mirrored arm; expected a right-handed frame, of images u to the right "
            f"and v down as the camera sees them: swap two of {columns}, or turn the sign of one"
        )
    check_clock(tracker, lain)
    return lain.clock


def _start_poses(arm: MovingArm, tracker: Stream, position: np.ndarray) -> Clock:
    from scipy.spatial.transform import Rotation

    quaternions = tracker.readings.get("quaternion")
    try:
        return start_positions(arm, tracker, position)
    except OtherMotionError:
        turned: MeasurementError | None = None
        if quaternions is not None:
            with contextlib.suppress(MeasurementError), warnings.catch_warnings():
                warnings.simplefilter("ignore", PincalWarning)
                back = Rotation.from_quat(quaternions).inv()
                inverted = {**tracker.readings, "quaternion": back.as_quat()}
                start_positions(arm, replace(tracker, readings=inverted), -back.apply(position))
                turned = MeasurementError(
                    f"{tracker.name}: poses are those of the instrument as the target sees it; expected the target's in the "
                    "instrument's frame: invert them"
                )
        if turned is not None:
            raise turned from None
        raise


def _most_seen(tracker: Stream) -> Iterator[Stream]:
    """Yield the rows of some targets or points, each of what is seen most often when those before are not."""
    index = tracker.things
    new, most = np.ones(len(index), bool), 0
    for _ in range(_THINGS):
        rows = index == np.argmax(np.bincount(index[new])) if new.any() else new
        if rows.sum() <= _MANY * most:
            return
        most = max(most, int(rows.sum()))
        new &= ~np.isin(tracker.time, tracker.time[rows])
        yield tracker.select(rows)


@dataclass(frozen=True)
class _Thing:
    """What is read of one target or point: N coordinates, one component after the other.

    Attributes:
        time: of each, shape (N,) [s].
        values: what is linear, or the ratio of two that are, about the mean of a component and by its size, shape (N,).
        component: which it is, shape (N,).
        functions: those of the tip's pose that matter.
        is_ratio: whether values are ratios.
    """

    time: np.ndarray
    values: np.ndarray
    component: np.ndarray
    functions: slice
    is_ratio: bool

    @classmethod
    def of(cls, seen: Stream, sensor: type[Sensor]) -> _Thing:
        values, is_square = seen.readings[sensor.fields[0].name].reshape(len(seen), -1), sensor.follows == "squared"
        values = values**2 if is_square else values
        kept = steady(values)
        seen, values = seen.select(kept), values[kept]
        values = (values - values.mean(axis=0)) / np.maximum(values.std(axis=0), 1e-300)
        functions = slice(0, 16) if is_square else slice(3, 15) if sensor.is_on_tool else slice(0, 12)
        m = values.shape[1]
        component = np.repeat(np.arange(m), len(seen))
        return cls(np.tile(seen.time, m), values.T.ravel(), component, functions, sensor.follows == "as ratios")

    def columns(self, known: np.ndarray, rows: np.ndarray, middle: np.ndarray) -> np.ndarray:
        """Return what some values are linear in, shape (M, k).

        Args:
            known: functions of the tip at their times, shape (M, 16).
            rows: which they are, shape (M,).
            middle: of the functions, about which depths are not zero, shape (16,).
        """
        F, component = (known - middle)[:, self.functions], self.component[rows, None]
        A = np.column_stack([F, np.ones(len(F))])
        own = [A * (component == c) for c in range(int(self.component[-1]) + 1)]
        return np.hstack([*own, -self.values[rows, None] * F] if self.is_ratio else own)

    def left(self, offset: float, grid: np.ndarray, known: np.ndarray) -> tuple[float, float]:
        """Return the part of the variance that does not follow, and the part of the rows that this is of.

        Args:
            offset: of the clock [s].
            grid: times of the joints, shape (K,) [s].
            known: functions of the tip then, shape (K, 16).
        """
        rows = np.linspace(0, len(self.time) - 1, _SAMPLED).astype(int)
        at = self.time[rows] + offset
        inside = (at > grid[0]) & (at < grid[-1])
        if not inside.any():
            return 1.0, 0.0
        at, rows = at[inside], rows[inside]
        near = np.clip(np.searchsorted(grid, at) - 1, 0, len(grid) - 2)
        share = ((at - grid[near]) / (grid[near + 1] - grid[near]))[:, None]
        # Between the parts of a log nothing is known.
        kept = grid[near + 1] - grid[near] < 1.5 * _SEARCHED
        at, rows, near, share = at[kept], rows[kept], near[kept], share[kept]
        if not len(at):
            return 1.0, 0.0
        here = known[near] + share * (known[near + 1] - known[near])
        A, y = self.columns(here, rows, here.mean(axis=0)), self.values[rows]
        H, b = A.T @ A, A.T @ y
        H[np.diag_indices_from(H)] += 1e-9 * H.max()
        return float(y @ y - b @ np.linalg.solve(H, b)) / max(len(y) * float(y.var()), 1e-300), len(y) / _SAMPLED

    def handedness(self, solution: np.ndarray) -> float:
        """Return 1 for axes like those of a solution, of all things or this first one, -1 for mirrored ones; or between."""
        k = self.functions.stop - self.functions.start
        rows = np.array([solution[i * (k + 1) : i * (k + 1) + k] for i in range(3)])
        # Where the tip is: what is seen from the tool moves against it.
        rows = -rows[:, -3:] if self.functions.start else rows[:, :3]
        return float(np.linalg.det(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)))


def _aligned(things: list[_Thing], arm: MovingArm, start: Clock) -> Alignment:
    """Return the clock by which all of them follow."""
    middles = [
        _functions(arm.tips(start.to_joints(thing.time[:: len(thing.time) // _SAMPLED + 1]))).mean(axis=0)
        for thing in things
    ]
    time, values = (np.concatenate([getattr(thing, name) for thing in things]) for name in ("time", "values"))
    owner = np.repeat(np.arange(len(things)), [len(thing.time) for thing in things])
    number = np.concatenate([np.arange(len(thing.time)) for thing in things])

    def features(at: np.ndarray, rows: np.ndarray) -> np.ndarray:
        known, found = _functions(arm.tips(at)), []
        for k, (thing, middle) in enumerate(zip(things, middles, strict=True)):
            here = owner[rows] == k
            own = thing.columns(known[here], number[rows[here]], middle)
            found.append(np.zeros((len(at), own.shape[1])))
            found[-1][here] = own
        return np.hstack(found)

    return aligned(time, values[:, None], features, arm.path.covers, start)


def _functions(tips: np.ndarray) -> np.ndarray:
    """Return what readings of the tool are linear in, shape (N, 16): p, R, R^T p and the square of p."""
    p, R = tips[:, :, 3], tips[:, :, :3]
    return np.column_stack([p, R.reshape(-1, 9), np.einsum("nji,nj->ni", R, p), np.sum(p**2, axis=1)])
