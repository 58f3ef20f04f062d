"""A stream: the log of one device on a moving arm, and checks of its plausibility."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from pincal.errors import MeasurementError, counted, warn
from pincal.motion.motion_numbers import STREAM
from pincal.sensors.imu import FORCE, RATE
from pincal.thresholds import Count, Scale
from pincal.units import STANDARD_GRAVITY

# Gravity in units of logs.
_GRAVITIES = {"g": 1.0, "mg": 1e3, "mm/s^2": 1e3 * STANDARD_GRAVITY}
# Most decimals of a log, and rounding of single precision.
_DECIMALS: Count = 12
_SINGLE: Scale = 2e-7


@dataclass(frozen=True, eq=False, repr=False)
class Stream:
    """Readings of one device in time.

    Attributes:
        name: of its file, for messages.
        time: by its own clock, shape (T,), increasing [s].
        readings: values in SI units, shape (T,) or (T, k) each: "q" of joints, "specific_force" and
            "angular_rate" of an IMU, of an instrument the fields of its sensor.
        units: the units in the header, by column.
        lines: of the file, shape (T,); default: consecutive below a header.
    """

    name: str
    time: np.ndarray
    readings: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    lines: np.ndarray = field(default_factory=lambda: np.zeros(0, int))

    def __post_init__(self) -> None:
        if not len(self.lines):
            object.__setattr__(self, "lines", np.arange(2, len(self.time) + 2))

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        return (
            f"Stream({self.name!r}: {', '.join(self.readings)}, {len(self)} rows at "
            f"{self.rate:.4g} Hz)"
        )

    @property
    def rate(self) -> float:
        """Samples per second, excluding gaps."""
        return 1.0 / float(np.median(self.steps))

    @property
    def steps(self) -> np.ndarray:
        """Positive differences of consecutive stamps [s]."""
        steps = np.diff(self.time)
        return steps[steps > 0.0]

    @property
    def things(self) -> np.ndarray:
        """Number of the target or named point of each row, from 0, shape (T,); several may have the
        same stamp.
        """
        found = np.zeros(len(self), int)
        for values in self.readings.values():
            if values.dtype.kind not in "fi":
                names, index = np.unique(values, return_inverse=True)
                found = np.unique(found * len(names) + index, return_inverse=True)[1]
        return found

    @property
    def repeats(self) -> np.ndarray:
        """Which rows equal the one before of the same thing except for their time, shape (T,); none
        where nothing is read, as of a name alone.
        """
        things = self.things
        order = np.argsort(things, kind="stable")
        found = np.zeros(len(self), bool)
        read = [v[order] for v in self.readings.values() if v.dtype.kind == "f"]
        if not read:
            return found
        values = np.column_stack(read)
        found[order[1:]] = np.all(np.diff(values, axis=0) == 0.0, axis=1) & (
            np.diff(things[order]) == 0
        )
        return found

    def select(self, rows: np.ndarray) -> Stream:
        """Return some of the rows (mask or indices)."""
        chosen = {name: values[rows] for name, values in self.readings.items()}
        return replace(self, time=self.time[rows], readings=chosen, lines=self.lines[rows])

    def without(self, lost: np.ndarray, why: str) -> Stream:
        """Return the stream without the rows of a mask, with a warning.

        Raises:
            MeasurementError: if too little remains.
        """
        if not lost.any():
            return self
        text = (
            f"{self.name}: {int(lost.sum())} of {len(lost)} rows, the first in line "
            f"{self.lines[lost][0]}, {why}"
        )
        kept = self.select(~lost)
        if kept.covered < (1.0 - STREAM.most) * self.covered:
            raise MeasurementError(f"{text}; expected readings for most of the time: log again")
        warn(f"{text}; they are left out")
        return kept

    @property
    def gap(self) -> float:
        """Longest step that is not a gap [s]."""
        return max(STREAM.gap / self.rate, STREAM.long_gap)

    @property
    def covered(self) -> float:
        """Duration of the readings, excluding gaps [s]."""
        steps = self.steps
        return float(steps[steps <= self.gap].sum()) if len(steps) else 0.0


def checked_joints(stream: Stream, names: Sequence[str], turning: np.ndarray) -> Stream:
    """Return the stream of joints without impossible rows: repeated by the logger, or faster than
    any arm.

    Joints that are ``turning``, shape (n,), may jump by a revolution.

    Raises:
        MeasurementError: for joints that jump without returning.
    """
    stream = _unwrapped(_at_own_rate(stream), names, turning)
    q = stream.readings["q"]
    usual = np.maximum(np.diff(stream.time), float(np.median(stream.steps)))[:, None]
    speed = np.abs(np.diff(q, axis=0)) / usual
    jumps = np.flatnonzero(
        np.any(speed > STREAM.sudden * np.maximum(np.quantile(speed, 0.99, axis=0), 1.0), axis=1)
    )
    lost = _interrupted(q)
    starts, ends, run = _still(q)
    for k in jumps:
        # Repetitions before the jump, from the second row, and after it, from the first.
        lost[starts[run[k]] + 1 : k + 1] = True
        if ends[run[k + 1]] > k + 2:
            lost[k + 1 : ends[run[k + 1]]] = True
    for first, last in pairwise(jumps):
        if stream.time[last] - stream.time[first + 1] < STREAM.long_gap:
            lost[first + 1 : last + 1] = True
    for row in jumps.tolist():
        if usual[row, 0] < STREAM.long_gap and not lost[max(row - 1, 0) : row + 3].any():
            raise _stays(stream, row, names, int(np.argmax(speed[row])), usual[row, 0])
    return stream.without(
        lost,
        "repeat the previous one, or are off the motion, and end in a jump: the log was "
        "interrupted",
    )


def _stays(stream: Stream, k: int, names: Sequence[str], j: int, lasts: float) -> MeasurementError:
    """Return the error for a joint that jumps behind a row within a time [s], and stays there."""
    q = stream.readings["q"]
    return MeasurementError(
        f"{stream.name}, line {stream.lines[k + 1]}: {names[j]} jumps by "
        f"{q[k + 1, j] - q[k, j]:.3g} within {lasts:.2g} s and stays there; expected one motion: "
        "give logs that were appended to each other as separate sessions"
    )


def _interrupted(q: np.ndarray) -> np.ndarray:
    """Return which rows, shape (T,), repeat the one before until the joints jump on."""
    steps = np.abs(np.diff(q, axis=0))
    lost = np.zeros(len(q), bool)
    starts, ends, _ = _still(q)
    # A real motion starts with its smallest steps, not with one that is larger than those that
    # follow.
    finest = np.min(np.where(steps > 0.0, steps, np.inf), axis=0)
    is_long = ends - starts > STREAM.flat
    for begin, end in zip(starts[is_long], ends[is_long], strict=True):
        after = steps[end : end + STREAM.flat].max(axis=0, initial=0.0)
        if end < len(q) and np.any(steps[end - 1] > STREAM.sudden * after + STREAM.jumps * finest):
            lost[begin + 1 : end] = True
    return lost


def interpolated(values: np.ndarray) -> np.ndarray:
    """Return which readings, shape (T, k), are on straight lines between others, to the rounding of
    their digits.
    """
    off = np.zeros(values.shape)
    off[1:-1] = np.abs(values[1:-1] - 0.5 * (values[:-2] + values[2:]))
    moves = np.any(np.diff(values, axis=0, prepend=values[:1]) != 0.0, axis=1)
    decimals = next(
        (
            k
            for k in range(_DECIMALS)
            if np.abs(values - np.round(values, k)).max() < 1e-3 * 10.0**-k
        ),
        _DECIMALS,
    )
    rounding = np.maximum(_SINGLE * np.abs(values).max(axis=0), 1.5 * 10.0**-decimals)
    if not moves.any() or np.any(rounding > STREAM.even * np.median(off[moves], axis=0)):
        return np.zeros(len(values), bool)
    is_even = moves & np.all(off < rounding, axis=1)
    starts, ends, run = _still(is_even[:, None])
    return np.asarray(is_even & (ends - starts >= STREAM.straight)[run])


def _still(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return begin and end of each stretch of constant rows, and the index of each
    row's stretch.
    """
    new = np.append(True, np.any(np.diff(values, axis=0) != 0.0, axis=1))
    starts = np.flatnonzero(new)
    return starts, np.append(starts[1:], len(values)), np.cumsum(new) - 1


def _at_own_rate(stream: Stream) -> Stream:
    """Return a log of joints without rows that repeat the one before, if it is faster than their
    controller.
    """
    starts, ends, run = _still(stream.readings["q"])
    again = (np.arange(len(stream)) > starts[run]) & (
        stream.time[ends - 1] - stream.time[starts] < 0.5 * STREAM.long_gap
    )[run]
    if again.mean() < STREAM.often_same:
        return stream
    share = f"{100 * again.mean():.0f} %"
    warn(
        f"{stream.name}: {share} of the rows repeat the previous one and are left out; "
        "log joints at their own rate"
    )
    return stream.select(~again)


def _unwrapped(stream: Stream, names: Sequence[str], turning: np.ndarray) -> Stream:
    """Return joints that continue where a log wraps to the interval of a revolution."""
    steps = np.diff(stream.readings["q"], axis=0)
    turns = np.round(steps / (2.0 * np.pi))
    turns[(np.abs(steps - 2.0 * np.pi * turns) > STREAM.turn) | ~turning] = 0.0
    if not turns.any():
        return stream
    k, j = np.argwhere(turns)[0].tolist()
    warn(
        f"{stream.name}, line {stream.lines[k + 1]}: {names[j]} jumps by a revolution; it "
        "is assumed to continue"
    )
    q = stream.readings["q"].copy()
    q[1:] -= 2.0 * np.pi * np.cumsum(turns, axis=0)
    return replace(stream, readings={**stream.readings, "q": q})


def _refuse_stuck(stream: Stream, column: str, values: np.ndarray, others: np.ndarray) -> None:
    if stuck := _longest_stuck(stream.time, values, others):
        raise MeasurementError(
            f"{stream.name}: column {column!r} is constant for {stuck:.3g} s while others "
            "change; the axis is broken or not logged: repair the log, or leave that part out"
        )


def checked_imu(stream: Stream) -> Stream:
    """Return the plausible stream of an IMU, without clipped samples and repetitions in a log
    faster than the device.

    Raises:
        MeasurementError: for accelerations in other units or without gravity, and for axes that are
            frozen or clipped.
    """
    force = stream.readings[FORCE.name]
    rate = stream.readings[RATE.name]
    _check_gravity(stream, float(np.median(np.linalg.norm(force, axis=1))))
    columns = dict(
        zip((*FORCE.columns, *RATE.columns), np.column_stack([force, rate]).T, strict=True)
    )
    repeats = stream.repeats
    held = (
        _held(force) | _held(rate) if repeats.mean() < STREAM.most else np.zeros(len(stream), bool)
    )
    _warn_of_repeats(stream, repeats, held)
    ends = {
        column: _clipped(values, column, source=stream.name) for column, values in columns.items()
    }
    cut = np.any([*ends.values()], axis=0)
    for k, (column, values) in enumerate(columns.items()):
        others = np.delete(force if k < 3 else rate, k % 3, axis=1)
        _refuse_stuck(stream, column, np.where(ends[column], np.nan, values), others)
    if cut.any():
        warn(
            f"{stream.name}: {counted(int(cut.sum()), 'row', 'are')} clipped at the limit of the "
            "IMU's range: left out"
        )
    kept = stream.without(
        held, "have constant forces or rates, which jump before or after: they were not updated"
    )
    return kept.select(~(cut | repeats)[~held]) if np.any(cut | repeats) else kept


def _warn_of_repeats(stream: Stream, repeats: np.ndarray, held: np.ndarray) -> None:
    """Warn of rows of an IMU that repeat the one before, other than those that were not updated."""
    if (repeats & ~held).mean() > STREAM.few:
        share = f"{100 * repeats.mean():.0f} %"
        warn(
            f"{stream.name}: {share} of the rows repeat the previous one and are left "
            "out; log the IMU at its own rate"
        )
    elif again := int((repeats & ~held).sum()):
        warn(
            f"{stream.name}: {counted(again, 'row', 'repeat')} the previous one, the first in "
            f"line {stream.lines[repeats & ~held][0]}: left out; was it polled at nearly its own "
            "rate? Then "
            "stamps are up to a sample late, which adds noise; log its own stamps"
        )


def _clipped(values: np.ndarray, column: str, *, source: str) -> np.ndarray:
    """Return which samples of a column are clipped, shape (T,); refuse one that often is."""
    flat = _cut_off(values)
    if flat.mean() > STREAM.few:
        raise MeasurementError(
            f"{source}: column {column!r} is clipped at "
            f"{np.abs(values).max():.4g} in {100 * flat.mean():.0f} "
            "% of the rows; choose a larger range of the IMU, or drive more slowly"
        )
    return flat


def _held(values: np.ndarray) -> np.ndarray:
    """Return which rows, shape (T,), are constant over several samples, with a jump of many steps
    before or after.
    """
    steps = np.abs(np.diff(values, axis=0))
    smallest = np.min(np.where(steps > 0.0, steps, np.inf), axis=0)
    far = np.append(np.any(steps > STREAM.jumps * smallest, axis=1), False)
    starts, ends, run = _still(values)
    return np.asarray(((ends - starts > STREAM.flat) & (far[ends - 1] | far[starts - 1]))[run])


def _check_gravity(stream: Stream, size: float) -> None:
    """Refuse specific forces whose median can't be gravity."""
    if STANDARD_GRAVITY / STREAM.gravity < size < STREAM.gravity * STANDARD_GRAVITY:
        return
    text = f"{stream.name}: median specific force of {size:.4g} m/s^2; expected about 9.8"
    for unit, gravity in _GRAVITIES.items():
        if gravity / STREAM.gravity < size < STREAM.gravity * gravity and "ax" not in stream.units:
            raise MeasurementError(
                f"{text}; looks like [{unit}]: write `ax [{unit}]`, `ay [{unit}]`, `az "
                f"[{unit}]` in the header"
            )
    if "ax" in stream.units:
        raise MeasurementError(f"{text}; values in another unit under [{stream.units['ax']}]?")
    if size < STANDARD_GRAVITY / 3.0:
        raise MeasurementError(f"{text}: gravity was removed; log raw accelerations")
    is_raw = np.all(stream.readings[FORCE.name] == np.round(stream.readings[FORCE.name]))
    raise MeasurementError(
        f"{text}; {'raw counts? Multiply all by their scales' if is_raw else 'check its unit'}"
    )


def _longest_stuck(time: np.ndarray, values: np.ndarray, others: np.ndarray) -> float:
    """Return how long a value is constant while the other axes, shape (T, 2), move [s]; 0 for short
    times.
    """
    starts, ends, _ = _still(values[:, None])
    spread = others.std(axis=0)
    longest = 0.0
    steps = np.abs(np.diff(values))
    most = STREAM.jumps * float(np.min(steps[steps > 0.0], initial=np.inf))
    for begin, end in zip(starts[ends - starts > 1], ends[ends - starts > 1], strict=True):
        if (
            steps[max(begin - 1, 0)] <= most
            and steps[min(end - 1, len(steps) - 1)] <= most < np.inf
        ):
            continue  # A sensor of few digits.
        lasts = float(time[end - 1] - time[begin])
        if lasts > STREAM.frozen and np.any(
            np.ptp(others[begin:end], axis=0) > STREAM.moves * spread
        ):
            longest = max(longest, lasts)
    return longest


def _cut_off(values: np.ndarray) -> np.ndarray:
    """Return which samples are clipped, shape (T,): at an extreme, consecutive, repeatedly, with
    few just below it.
    """
    found = np.zeros(len(values), bool)
    near = 0.01 * float(np.ptp(values))
    for end in (values.max(), values.min()):
        at = values == end
        starts = np.flatnonzero(at & ~np.append(False, at[:-1]))
        ends = np.flatnonzero(at & ~np.append(at[1:], False))
        lasts = ends - starts + 1
        is_often = np.sum(lasts >= STREAM.flat) >= STREAM.often_flat or (
            near > 0.0 and lasts.max() >= STREAM.long_flat
        )
        if is_often and at.sum() > np.sum(~at & (np.abs(values - end) < near)):
            found |= at
    return found
