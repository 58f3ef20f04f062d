"""Times of the samples of a stream, by its stamps: unique, in order, and at the rate of a log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.measure.sensors.imu import FORCE
from pincal.motion.stream import LONG_GAP, Stream

# Lowest rate of a log of joints or an IMU, and of other instruments, highest possible rate, and
# highest usual rate [Hz].
_SLOWEST = 9.0
_SLOW = 2.0
_FASTEST = 2e4
_USUAL = 2e3
# Longest gap within a log [s].
_ENDLESS = 3600.0
# Largest fraction of rows with the stamp of the row before.
_FEW = 0.05
# Longest delay of a row [s]; excess of stamps there, absolute and relative to the expected number,
# above which the clock was set back; most times that a clock is set in a log.
_LATE = 2.0
_EXTRA = 1.5
_CROWDED = 0.2
_OFTEN_SET = 3
# Median step of stamps in bursts relative to the mean, step of pairs of rows, and fraction of such
# pairs above which they are not due to two devices.
_BURST = 1.0 / 3.0
_PAIRED = 0.25
_OFTEN = 0.2
# Ratio of roughness below which readings show that times are by stamps, or by the count of samples.
_SMOOTHER = 0.7
# Packets among which one is hardly delayed; fewest and most parts of a log whose least delayed
# packets are compared; their largest deviation from an even rate, in steps and in seconds, and that
# of a few packets, less than one sample.
_PACKETS = 10
_PARTS = (5, 30)
_STRAIGHT = 0.25
_EXACT = 1e-3
_WHOLE = 0.75


def in_order(stream: Stream) -> Stream:
    """Return a stream with increasing stamps at the rate of a log; warn of corrections.

    Rows that a logger wrote twice or a little late are corrected, and so are stamps of packets if
    the count of samples determines their times.

    Raises:
        MeasurementError: for stamps that run back, or do not determine the times of the samples.
    """
    name = stream.name
    if (stamps := len(stream.steps)) < 2 * _SLOWEST:
        raise MeasurementError(
            f"{name}: {len(stream)} rows with {stamps + 1} stamps; expected a log of some minutes"
        )
    same, twice = _same(stream)
    in_packets = (same & ~twice).mean() > _FEW
    if twice.any() and not in_packets:
        first = stream.lines[twice][0]
        warn(
            f"{name}: {int(twice.sum())} rows occur twice, the first in line {first}; "
            "they are used once"
        )
        stream = stream.select(~twice)
    stream = _sorted(stream, in_packets)
    if in_packets:
        stream = _by_count(
            stream, f"{100 * same.mean():.0f} % of the rows have the stamp of the previous row"
        )
    elif (same := _same(stream)[0]).any():
        warn(f"{name}: {int(same.sum())} rows with the stamp of the previous row are left out")
        stream = stream.select(~same)
    stream = _checked_rate(stream)
    steps = np.diff(stream.time)
    gaps = steps > stream.gap
    if gaps.any():
        k = int(np.argmax(steps))
        if steps[k] > _ENDLESS:
            raise MeasurementError(
                f"{name}, line {stream.lines[k + 1]}: time jumps from {_shown(stream.time[k])} to "
                f"{_shown(stream.time[k + 1])}; expected one log: give the parts as "
                "separate sessions, or delete rows from "
                "before the clock was set"
            )
        warn(
            f"{name}: {int(gaps.sum())} gaps of more than {LONG_GAP} s, the longest "
            f"{steps[k]:.3g} s from "
            f"{_shown(stream.time[k])} on: motion within them is left out"
        )
    return stream


def _same(stream: Stream) -> tuple[np.ndarray, np.ndarray]:
    """Return which rows have the stamp of an earlier one of the same thing, shape (T,), and which
    are identical to it.
    """
    order = np.lexsort((things := stream.things, stream.time))
    same = np.zeros(len(stream), bool)
    twice = np.zeros(len(stream), bool)
    same[order[1:]] = (np.diff(stream.time[order]) == 0.0) & (np.diff(things[order]) == 0)
    twice[order] = same[order] & stream.select(order).repeats
    return same, twice


def _sorted(stream: Stream, in_packets: bool) -> Stream:
    """Return a stream with late rows in the order of their stamps; refuse a clock that
    runs back.
    """
    time = stream.time
    if not np.any(back := np.diff(time) < 0.0):
        return stream
    latest = np.maximum.accumulate(time)
    ordered = stream.select(np.argsort(time, kind="stable"))
    # Rows at which all earlier stamps are smaller than all later ones.
    begins = np.flatnonzero(
        np.append(True, latest[:-1] <= np.minimum.accumulate(time[::-1])[-2::-1])
    )
    new = np.append(True, np.diff(ordered.time) > 0.0)
    count = np.add.reduceat(new if in_packets else new | _same(ordered)[0], begins)
    around = np.concatenate([[-np.inf], ordered.time, [np.inf]])
    # A clock that was set back assigns some times to two samples each.
    usual = (around[np.append(begins[1:], len(time)) + 1] - around[begins]) * ordered.rate
    crowded = (np.diff(begins, append=len(time)) > 1) & (
        count + 1 - usual > np.maximum(_EXTRA, _CROWDED * usual)
    )
    farthest = float(np.max(latest - time))
    is_often = crowded.any() and farthest <= _LATE and back.sum() > _OFTEN_SET
    # Rows in the order of sampling are smoother than in the order of their stamps.
    if is_often and _is_smoother((stream, np.arange(len(time))), (ordered, ordered.time)):
        return _by_count(
            stream, f"time runs backwards {int(back.sum())} times, by {farthest:.2g} s or less"
        )
    if crowded.any() or farthest > _LATE:
        k = int(np.argmax(back))
        raise MeasurementError(
            f"{stream.name}, line {stream.lines[k + 1]}: time runs backwards from "
            f"{_shown(time[k])} to "
            f"{_shown(time[k + 1])}; expected one log with one clock: give logs that were "
            "appended to each "
            "other, or the parts before and after a clock was set, as separate sessions, "
            "and add its range to a counter "
            "that overflowed; if it runs backwards repeatedly, stamps are times of "
            "arrival: log the device's own"
        )
    late = latest > time
    name = stream.name
    warn(
        f"{name}: {int(late.sum())} rows, the first in line {stream.lines[late][0]}, are "
        "late and are sorted by time"
    )
    return ordered


def _by_count(stream: Stream, what: str) -> Stream:
    """Return a stream with stamps of packets replaced by the count of samples, if their rate is
    even.
    """
    time = stream.time
    count = np.arange(len(stream))
    steps = np.diff(stream.time)
    packets = int(np.sum(steps > steps[steps <= stream.gap].mean())) + 1
    text = f"{stream.name}: {what}: stamps are those of"
    cure = "; log the device's own time stamps, with all their digits"
    if stream.things.any() or packets < _PACKETS * _PARTS[0]:
        raise MeasurementError(f"{text} packets, not of samples, or lost digits{cure}")
    line = np.polyfit(count, time, 1)
    parts = np.array_split(count, min(packets // _PACKETS, _PARTS[1]))
    for _ in range(3):
        left = time - np.polyval(line, count)
        least = np.array([part[np.argmin(left[part])] for part in parts])
        line = np.polyfit(least, time[least], 1)
    left = time - np.polyval(line, count)
    step = float(line[0])
    begins = np.linspace(0, len(time), packets // _PACKETS, endpoint=False).astype(int)
    off = np.abs(left[least])
    lacks = np.abs(np.minimum.reduceat(left, begins))
    if off.max() > min(_STRAIGHT * step, _EXACT) or lacks.max() > _WHOLE * step:
        k = int(begins[np.argmax(lacks)] if lacks.max() > _WHOLE * step else least[np.argmax(off)])
        raise MeasurementError(
            f"{text} packets, not of samples, or lost digits, and the count of samples "
            "does not determine times either: "
            f"about line {stream.lines[k]} they deviate from an even rate by "
            f"{1e3 * max(off.max(), lacks.max()):.2g} ms, as "
            f"when some are lost{cure}, or number the samples and give `time` = number / rate"
        )
    warn(
        f"{text} their arrival; samples are assumed to be {1e3 * step:.6g} ms apart, "
        "which holds by their count to "
        f"{1e3 * off.max():.2g} ms from beginning to end"
    )
    return replace(stream, time=np.polyval(line, count))


def _is_smoother(one: tuple[Stream, np.ndarray], other: tuple[Stream, np.ndarray]) -> bool:
    """Return whether some reading is clearly smoother in one order, at its times, than
    in another.
    """
    return bool(np.any(_roughness(*one) < _SMOOTHER * _roughness(*other)))


def _roughness(stream: Stream, time: np.ndarray) -> np.ndarray:
    """Return the mean deviation of values from linear interpolation between their neighbours in
    time, by column.
    """
    values = np.column_stack([v for v in stream.readings.values() if v.dtype.kind == "f"])
    share = ((time[1:-1] - time[:-2]) / np.maximum(time[2:] - time[:-2], 1e-300))[:, None]
    off = np.abs(values[1:-1] - (1.0 - share) * values[:-2] - share * values[2:])
    return np.asarray(off.mean(axis=0))


def _shown(stamp: float) -> str:
    return f"{stamp:.6g} s" if abs(stamp) < 1e5 else f"{stamp:.3f} s"


def _checked_rate(stream: Stream) -> Stream:
    """Return a stream without bursts; refuse stamps in another unit than stated, or that count
    samples.
    """
    step = float(np.median(stream.steps))
    slowest = _SLOWEST if {"q", FORCE.name} & stream.readings.keys() else _SLOW
    usual = stream.steps[stream.steps < stream.gap]
    is_burst = len(usual) and (
        step < _BURST * usual.mean() or np.mean(usual < _PAIRED * usual.mean()) > _OFTEN
    )
    # Two devices in one stream rightly stamp their samples in pairs as well.
    if is_burst and not _is_smoother((stream, stream.time), (stream, np.arange(len(stream)))):
        return _by_count(
            stream,
            f"rows are in bursts, mostly {step:.2g} s apart, on average {usual.mean():.2g} s",
        )
    if 1.0 / _FASTEST <= step <= 1.0 / slowest:
        return stream
    if step == 1.0 and np.all(stream.time == np.round(stream.time)):
        raise MeasurementError(
            f"{stream.name}: time counts 1, 2, 3, ...: frames or samples; expected "
            "seconds: divide by the rate of the device"
        )
    units = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    # A log lasts some seconds at least.
    long = {unit: size for unit, size in units.items() if size * np.ptp(stream.time) > 1.0}
    fits = next(
        (unit for unit, size in long.items() if 1.0 / _USUAL <= step * size <= 1.0 / slowest), None
    )
    is_unstated = fits and "time" not in stream.units
    cure = (
        f"looks like [{fits}]: write `time [{fits}]` in the header"
        if is_unstated
        else "check its unit, or log faster"
    )
    raise MeasurementError(
        f"{stream.name}: a row every {step:.3g} s; expected {slowest:g} to {_FASTEST:g} "
        f"rows a second; {cure}"
    )
