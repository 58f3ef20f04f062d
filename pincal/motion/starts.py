"""Alignment of streams with the motion of the arm before any fit: clocks, the mount of an IMU,
positions.

It uses the nominal arm, and is accurate to a millisecond and some milliradians. Faults that only
show relative to the arm are refused: rates in degrees, a mirrored frame, swapped axes, an IMU of
another session, one that slipped.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.hypotheses.hypothesis import Hypothesis, explaining
from pincal.measure.clock_jump import OFTEN
from pincal.measure.reading_numbers import JUMPS
from pincal.motion.clocks import (
    Alignment,
    Clock,
    SpeedMatch,
    aligned,
    correlate,
    refuse_uncovered,
)
from pincal.motion.imu_rows import ImuRows
from pincal.motion.motion_numbers import CLOCKS, FOLLOWING, STREAM
from pincal.motion.moving_arm import MovingArm
from pincal.motion.stream import Stream
from pincal.robot.se3 import nearest_rotation, rotation_vectors
from pincal.sensors.imu import FORCE, RATE, Window
from pincal.sensors.row_samples import evenly
from pincal.thresholds import Count, Scale
from pincal.units import size_of

# Sampling interval of the arm's speeds, and the window of the rates compared with them [s].
_GRID: Scale = 0.02
_WIDTH: Scale = 0.03
# Rows per block for finding a mount, and the least information of a row and a block on it, relative
# to the usual and the largest: the speed, and the rotation across the main axis.
_BLOCK: Count = 40
_LEAST: Scale = 0.1
# Poses whose orientations are compared.
_SAMPLED: Count = 400
# Length of the median filter.
_NEIGHBOURS: Count = 5
# The numbers of the checks below, under short names.
_SCALE = FOLLOWING.scale
_UNIT = FOLLOWING.unit
_TURNED = FOLLOWING.turned
_SLIPPED = FOLLOWING.slipped
_FEW = FOLLOWING.few_blocks
CLEARLY = JUMPS.significant


@dataclass(frozen=True)
class ImuStart:
    """Alignment of an IMU with the motion of an arm.

    Attributes:
        clock: of the IMU.
        mount: rotation from the IMU's frame to the tip, shape (3, 3).
        rows: its filtered readings while the joints were logged.
        source: name of its log.
    """

    clock: Clock
    mount: np.ndarray
    rows: ImuRows
    source: str


class OtherMotionError(MeasurementError):
    """Readings that do not follow the joints: one of the streams is of another motion, or
    misinterpreted.
    """


def start_imu(
    arm: MovingArm,
    imu: Stream,
    *,
    window: Window | None = None,
    others: Sequence[tuple[str, MovingArm]] = (),
) -> ImuStart:
    """Align the readings of an IMU with the motion of an arm, in rows by a window of 30 ms unless
    given.

    An error names the session among ``others`` to which the IMU belongs.

    Raises:
        MeasurementError: if it is not of this motion, is mirrored, or has its rates in another
            unit.
    """
    rows = ImuRows.of(
        imu.time, imu.readings[FORCE.name], imu.readings[RATE.name], window or Window(_WIDTH)
    )
    if not len(rows):
        raise MeasurementError(
            f"{imu.name}: {len(imu)} different rows in {np.ptp(imu.time):.3g} s, nowhere enough "
            "for a mean over a quarter of a second; expected readings at 50 Hz or more over some "
            "minutes of motion: log again"
        )
    found = _turned(arm, imu, rows)
    if found is None:
        sessions = [_of_session(name, other) for name, other in others]
        mistakes = list(
            explaining(sessions, arm, lambda other: _turned(other, imu, rows) is not None)
        )
        whose = mistakes[0].words if mistakes else "is it of another arm or session?"
        raise OtherMotionError(
            f"{imu.name}: its rates do not follow these joints at any offset of the clocks; "
            f"{whose} Expected an IMU on the tool, logged together with the joints"
        )
    _check_rates(imu, found)
    check_clock(imu, found)
    inside = arm.path.covers(found.clock.to_joints(rows.time), 4.0 * rows.window.width)
    refuse_uncovered(inside, source=imu.name)
    rows = rows.select(inside)
    mount = nearest_rotation(found.matrix).T
    _check_forces(arm, imu, rows, found.clock, mount)
    _check_slip(arm, imu, rows, found.clock, mount)
    return ImuStart(found.clock, mount, rows, imu.name)


def _of_session(name: str, other: MovingArm) -> Hypothesis[MovingArm]:
    """Return the hypothesis that an IMU was on another arm, or on this one in another session."""
    return Hypothesis(f"it is of {name}: were two IMUs, or two files, swapped?", lambda arm: other)


def aligned_forces(arm: MovingArm, start: ImuStart) -> float:
    """Return the delay of an IMU's rates relative to its forces, to a millisecond [s]."""

    def features(at: np.ndarray, _: np.ndarray) -> np.ndarray:
        # Forces are linear in the rotation of the mount, and in its lever arm.
        ideal = arm.ideal(at, start.rows.window)
        spin = np.einsum("na,nb->nab", ideal.rate, ideal.rate)[:, *np.triu_indices(3)]
        return np.hstack([ideal.force, ideal.turning, spin])

    rows = start.rows
    covers = partial(arm.path.covers, margin=4.0 * rows.window.width)
    middle = np.array([start.clock.middle])
    forces = aligned(
        rows.time, rows.readings[:3].T, features, covers, start.clock, source=start.source
    ).clock
    return float((start.clock.to_joints(middle) - forces.to_joints(middle))[0])


def _turned(arm: MovingArm, imu: Stream, rows: ImuRows) -> Alignment | None:
    """Return the alignment of rates with the arm's; None if they do not follow it."""
    speed = np.linalg.norm(rows.readings[3:], axis=0)
    match, clock = _match(arm, imu, rows.time, speed, by_rate=True)
    if not match.is_same:
        return None
    return aligned(
        rows.time,
        rows.readings[3:].T,
        lambda at, _: arm.ideal(at, rows.window).rate,
        lambda at: arm.path.covers(at, 4.0 * rows.window.width),
        clock,
        source=imu.name,
    )


def _match(
    arm: MovingArm, stream: Stream, time: np.ndarray, speed: np.ndarray, *, by_rate: bool
) -> tuple[SpeedMatch, Clock]:
    """Return the match of a stream's speeds with the rotation rate or speed of the arm's tip, and
    the clock by which they do.

    A clock that was set leaves a gap, on whose sides offsets differ: the match is then that of the
    part before the first one.
    """
    grid = arm.path.grid(_GRID)
    tips = arm.ideal(grid).rate if by_rate else np.gradient(arm.tips(grid)[:, :, 3], grid, axis=0)
    of_arm = np.linalg.norm(tips, axis=1)
    match = correlate(grid, of_arm, time, speed)
    parts = _between_gaps(stream, time)
    of_parts = [correlate(grid, of_arm, time[part], speed[part]) for part in parts]
    if len(parts) > 1 and all(one.is_same and one.is_clear for one in of_parts):
        offsets = np.array([one.offset for one in of_parts])
        by = np.where(np.abs(np.diff(offsets)) > STREAM.long_gap, np.diff(offsets), 0.0)
        steps = [
            (_first_behind_gap(stream, float(time[part][0])), size)
            for part, size in zip(parts[1:], by.tolist(), strict=True)
            if size
        ]
        if steps:
            return of_parts[0], Clock(float(offsets[0]), steps=tuple(steps))
    if match.is_same and not match.is_clear:
        warn(
            f"{stream.name}: the motion repeats, so that its clock may be off by a period; start "
            "the logs together, or begin with a motion that does not recur"
        )
    return match, Clock(match.offset)


def _first_behind_gap(stream: Stream, stamp: float) -> float:
    """Return the first stamp of a stream behind its last gap before a stamp [s]."""
    behind = stream.time[1:][np.diff(stream.time) > stream.gap]
    return float(np.max(behind[behind <= stamp], initial=stream.time[0]))


def _between_gaps(stream: Stream, time: np.ndarray) -> list[np.ndarray]:
    """Return the rows at stamps, shape (N,) [s], between gaps of a stream, of parts that are long
    enough to be found in a motion.
    """
    begins = np.flatnonzero(np.diff(time) > stream.gap) + 1
    parts = np.split(np.arange(len(time)), begins)
    return [part for part in parts if len(part) and np.ptp(time[part]) > FOLLOWING.shortest]


def _check_rates(imu: Stream, found: Alignment) -> None:
    """Refuse rates whose linear map from the arm's is not a rotation."""
    sizes = np.linalg.svd(found.matrix, compute_uv=False)
    if unit := _unit(sizes, _UNIT, "deg/s", "mdeg/s", "mrad/s"):
        raise MeasurementError(
            f"{imu.name}: rates are {sizes.mean():.3g} times those of the arm; looks like "
            f"[{unit}]: write `wx [{unit}]`, `wy [{unit}]`, `wz [{unit}]` in the header"
        )
    if np.any(np.abs(sizes - 1.0) > _SCALE):
        raise OtherMotionError(
            f"{imu.name}: rates are {', '.join(f'{size:.3g}' for size in sizes)} times "
            "those of the arm along three axes; "
            "expected 1: check units, and whether two columns are the same"
        )
    if np.linalg.det(found.matrix) < 0.0:
        raise MeasurementError(
            f"{imu.name}: rates are mirrored relative to the arm, in a left-handed frame; "
            "expected a right-handed one: "
            "change the sign of one axis of ax ay az and of wx wy wz, or swap two columns of both"
        )


def _unit(sizes: np.ndarray, within: float, *units: str) -> str:
    """Return the unit that explains values ``sizes`` times too large; empty for none."""
    return next(
        (unit for unit in units if np.all(np.abs(sizes * size_of(unit) - 1.0) < within)), ""
    )


def _check_forces(
    arm: MovingArm, imu: Stream, rows: ImuRows, clock: Clock, mount: np.ndarray
) -> None:
    """Refuse specific forces in another frame than the rates."""
    ideal = arm.ideal(clock.to_joints(rows.time), rows.window).force
    features = np.column_stack([ideal @ mount, np.ones(len(ideal))])
    M = np.linalg.lstsq(features, rows.readings[:3].T, rcond=None)[0][:3].T
    sizes = np.linalg.svd(M, compute_uv=False)
    if np.any(np.abs(sizes - 1.0) > _SCALE):
        warn(
            f"{imu.name}: specific forces hardly determine their axes; move so that the "
            "tool points in all directions"
        )
        return
    if np.linalg.det(M) < 0.0:
        is_opposite = np.abs(nearest_rotation(-M) - np.eye(3)).max() < _TURNED
        what = (
            "have the wrong sign: an IMU at rest reads +9.8 upwards"
            if is_opposite
            else "are mirrored"
        )
        raise MeasurementError(
            f"{imu.name}: specific forces {what}; change the sign of "
            f"{'ax, ay, az' if is_opposite else 'one of ax, ay, az'}"
        )
    turned = float(np.linalg.norm(rotation_vectors(nearest_rotation(M)[None])))
    if turned > _TURNED:
        raise MeasurementError(
            f"{imu.name}: the frames of ax ay az and wx wy wz are {np.degrees(turned):.0f} deg "
            "apart; expected one frame: check the order and the signs of the columns"
        )


def _determining(rates: np.ndarray) -> list[np.ndarray]:
    """Return the blocks of rows that determine the mount: an arm at rest, or in rotation about a
    single axis, does not.
    """
    speed = np.linalg.norm(rates, axis=1)
    turning = np.flatnonzero(speed > _LEAST * float(np.sqrt(np.mean(speed**2))))
    blocks = [turning[k : k + _BLOCK] for k in range(0, len(turning) - _BLOCK + 1, _BLOCK)]
    across = [np.linalg.eigvalsh(rates[b].T @ rates[b])[:2].sum() for b in blocks]
    return [b for b, size in zip(blocks, across, strict=True) if size > _LEAST * max(across)]


def _check_slip(
    arm: MovingArm, imu: Stream, rows: ImuRows, clock: Clock, mount: np.ndarray
) -> None:
    """Refuse an IMU whose mount rotated while it was logged."""
    ideal = arm.ideal(clock.to_joints(rows.time), rows.window).rate @ mount
    bias = np.median(rows.readings[3:].T - ideal, axis=0)
    blocks = _determining(ideal)
    count = len(blocks)
    if count < 4:
        return
    turns = rotation_vectors(
        np.array([nearest_rotation((rows.readings[3:, b].T - bias).T @ ideal[b]) for b in blocks])
    )
    middles = [
        [np.median(part, axis=0) for part in (turns[:k], turns[k:])] for k in range(1, count)
    ]
    residuals = [
        np.linalg.norm(turns - np.repeat(pair, [k, count - k], axis=0), axis=1)
        for k, pair in enumerate(middles, 1)
    ]
    at = int(np.argmin([own.sum() for own in residuals])) + 1
    best = float(np.linalg.norm(np.diff(middles[at - 1], axis=0)))
    scatter = 1.4826 * float(np.median(residuals[at - 1]))
    shorter = min(at, count - at)
    if best > max(_SLIPPED, CLEARLY * scatter / np.sqrt(shorter) * (1.0 + _FEW / shorter)):
        when = rows.time[blocks[at][0]]
        raise MeasurementError(
            f"{imu.name}: the IMU turned on its mount by {1e3 * best:.0f} mrad at about "
            f"{when:.5g} s of its clock; "
            "fasten it and repeat the motion, or give the parts before and after as two sessions"
        )


def start_positions(arm: MovingArm, tracker: Stream, position: np.ndarray) -> Clock:
    """Return the clock of an instrument by aligning positions of the tool, shape (T, 3) [m], with
    the motion of an arm.

    Raises:
        MeasurementError: if they are not of this motion, in another unit, or in a left-handed
            frame.
    """
    # Outliers are readings of something else.
    if not (kept := steady(position)).all():
        tracker = tracker.select(kept)
        position = position[kept]
    found = _placed(arm, tracker, position)
    check_clock(tracker, found)
    if "quaternion" in tracker.readings:
        _check_turns(arm, tracker, found)
    return found.clock


def _placed(arm: MovingArm, tracker: Stream, position: np.ndarray) -> Alignment:
    """Return the alignment of positions with the arm's; refuse those that do not follow it, in
    another unit, or in a left-handed frame.
    """
    match, clock = _match(arm, tracker, *_speeds(tracker, position), by_rate=False)
    if not match.is_same:
        raise OtherMotionError(
            f"{tracker.name}: its positions do not move as these joints do at any offset of the "
            f"clocks (correlation of speeds {match.likeness:.2f}); expected a target on the tool "
            "of this arm, read while the joints were logged"
        )
    found = aligned(
        tracker.time,
        position,
        lambda at, _: _features(arm.tips(at)),
        arm.path.covers,
        clock,
        source=tracker.name,
    )
    sizes = np.linalg.svd(found.matrix[:, :3], compute_uv=False)
    if np.any(np.abs(sizes - 1.0) > FOLLOWING.scale):
        raise _out_of_scale(tracker, sizes)
    if np.linalg.det(found.matrix[:, :3]) < 0.0:
        raise MeasurementError(
            f"{tracker.name}: positions are mirrored relative to the arm; expected a right-handed "
            "frame: swap two of x, y, z, or change the sign of one"
        )
    rms = float(np.linalg.norm(found.scatter))
    if rms > FOLLOWING.off * float(np.linalg.norm(position.std(axis=0))):
        raise OtherMotionError(
            f"{tracker.name}: after the best placement positions are off by {1e3 * rms:.3g} mm "
            "rms; expected a few mm: is it this arm, and is the target fixed to the tool?"
        )
    return found


def _speeds(tracker: Stream, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and the speeds of a target there by its positions, shape (T, 3) [m], some
    hundredths of a second apart, shape (M,) each [s, m/s].
    """
    smooth = max(round(0.02 * tracker.rate), 1)
    lasts = tracker.time[smooth:] - tracker.time[:-smooth]
    # Stamps with jitter may nearly coincide.
    lasts = np.maximum(lasts, 0.5 * np.median(lasts))
    moved = (position[smooth:] - position[:-smooth]) / lasts[:, None]
    middles = 0.5 * (tracker.time[smooth:] + tracker.time[:-smooth])
    return middles, np.linalg.norm(moved, axis=1)


def _out_of_scale(tracker: Stream, sizes: np.ndarray) -> MeasurementError:
    """Return the error for positions that move ``sizes`` times as far as the arm, shape (3,)."""
    unit = _unit(sizes, FOLLOWING.scale, "mm", "cm", "in")
    cure = (
        f"looks like [{unit}]: write `x [{unit}]` in the header"
        if unit
        else "check its unit and the robot's size"
    )
    text = f"{tracker.name}: positions move {sizes.mean():.3g} times as far as the arm; {cure}"
    if unit:
        return MeasurementError(text)
    if np.ptp(tracker.time) < FOLLOWING.shortest:
        text += (
            f"; or are {np.ptp(tracker.time):.3g} s of it too short to be found in the "
            f"motion? Log {FOLLOWING.shortest:g} s"
        )
    return OtherMotionError(text)


def _check_turns(arm: MovingArm, tracker: Stream, found: Alignment) -> None:
    """Refuse orientations that do not follow the arm, naming an order of their components that
    does.
    """
    from scipy.spatial.transform import Rotation

    at = found.clock.to_joints(tracker.time)
    rows = np.flatnonzero(arm.path.covers(at))
    rows = rows[evenly(len(rows), _SAMPLED)]
    # From the axes of the instrument to those of the nominal tip, by the aligned positions.
    seen = np.swapaxes(arm.tips(at[rows])[:, :, :3], 1, 2) @ nearest_rotation(found.matrix[:, :3]).T

    def off(q: np.ndarray) -> float:
        turned = seen @ Rotation.from_quat(q[rows]).as_matrix()
        mean = nearest_rotation(turned.mean(axis=0))
        return float(np.median(np.linalg.norm(rotation_vectors(turned @ mean.T), axis=1)))

    quaternions = tracker.readings["quaternion"]
    if off(quaternions) < _TURNED:
        return
    mistake = next(explaining(_orders(), quaternions, lambda q: off(q) < _TURNED), None)
    cure = (
        "check their convention (--orientation) and order"
        if mistake is None
        else f"they would {mistake.words}"
    )
    raise MeasurementError(
        f"{tracker.name}: orientations do not follow the arm, they are off by "
        f"{np.degrees(off(quaternions)):.0f} deg; {cure}; or leave them out (--ignore, one by "
        "one): positions are enough"
    )


def _orders() -> Iterator[Hypothesis[np.ndarray]]:
    """Yield mistakes in quaternions, shape (N, 4), w last."""
    yield Hypothesis(
        "in the order w x y z (--orientation wxyz, or names of columns)",
        lambda q: q[:, [1, 2, 3, 0]],
    )
    yield Hypothesis(
        "in the order x y z w (--orientation xyzw, or names of columns)",
        lambda q: q[:, [3, 0, 1, 2]],
    )
    yield Hypothesis("inverted", lambda q: q * np.array([-1.0, -1.0, -1.0, 1.0]))


def steady(values: np.ndarray) -> np.ndarray:
    """Return which readings, shape (T, k), are no outliers among their neighbours, shape (T,); all
    if most are.
    """
    from scipy.signal import medfilt

    jump = np.abs(values - medfilt(values, (_NEIGHBOURS, 1))) / np.maximum(
        values.std(axis=0), 1e-300
    )
    kept = np.asarray(np.all(jump < FOLLOWING.outlier, axis=1))
    return np.asarray(kept | (2 * kept.sum() < len(kept)))


def _features(tips: np.ndarray) -> np.ndarray:
    """Return the regressors of a target's positions, shape (N, 12): position and rotation of the
    tip.
    """
    return np.hstack([tips[:, :, 3], tips[:, :, :3].reshape(len(tips), 9)])


def check_clock(stream: Stream, found: Alignment) -> None:
    """Refuse a clock that jumps more often than one does, and warn of one with a drift larger than
    that of crystals.
    """
    clock = found.clock
    jump = found.jump
    if jump.is_sure(CLOCKS.nominal_jump):
        line = stream.lines[np.searchsorted(stream.time, jump.time)]
        raise MeasurementError(f"{stream.name}, about line {line}: {jump}, {OFTEN}")
    # Smaller steps are found by the calibrated arm, which tells them from a drift.
    if not found.is_crystal and not found.may_step:
        runs = "slowly" if clock.drift > 0.0 else "fast"
        warn(
            f"{stream.name}: its clock runs {1e6 * abs(clock.drift):.0f} ppm too {runs} "
            "relative to the joints', which "
            "is taken into account; do its stamps count frames at an assumed rate?"
        )
