"""When the samples of a stream were taken, by its stamps: once each, in order, as fast as a log's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.measure.sensors.imu import FORCE
from pincal.motion.stream import LONG_GAP, Stream

# Slowest log that a motion can be followed by [Hz], slowest instrument beside it, the fastest log that there is, and the
# fastest that is usual.
_SLOWEST, _SLOW, _FASTEST, _USUAL = 9.0, 2.0, 2e4, 2e3
# A gap that is none [s].
_ENDLESS = 3600.0
# Part of the rows that may have the stamp of the row before.
_FEW = 0.05
# How late a row may be written [s]; stamps too many where it was, in all and of those that there should be, from which on a
# clock was set back; times that one may be set in a log.
_LATE, _EXTRA, _CROWDED, _OFTEN_SET = 2.0, 1.5, 0.2, 3
# Part of the mean step by which most stamps follow each other in bursts, or a part of them that two devices do not explain.
_BURST, _PAIRED, _OFTEN = 1.0 / 3.0, 0.25, 0.2
# How much smoother some reading is by stamps or by the count of samples, whichever is right.
_SMOOTHER = 0.7
# Packets in which one is hardly delayed, and parts of a log in which the least delayed are compared, at least and at most;
# what these may be off an even rate, of a step and in all [s], and those of few packets, which lack less than one sample.
_PACKETS, _PARTS, _STRAIGHT, _EXACT, _WHOLE = 10, (5, 30), 0.25, 1e-3, 0.75


def in_order(stream: Stream) -> Stream:
    """Return a stream whose stamps increase and come as fast as a log's; say where they do not.

    Rows that a logger wrote twice or a little late are put right, and so are stamps of packets where the count of the
    samples tells when each was taken.

    Raises:
        MeasurementError: for stamps that run back, or from which the times of the samples do not follow.
    """
    name = stream.name
    if (stamps := len(stream.steps)) < 2 * _SLOWEST:
        raise MeasurementError(f"{name}: {len(stream)} rows with {stamps + 1} stamps; expected a log of some minutes")
    same, twice = _same(stream)
    in_packets = (same & ~twice).mean() > _FEW
    if twice.any() and not in_packets:
        first = stream.lines[twice][0]
        warn(f"{name}: {int(twice.sum())} rows stand twice, the first in line {first}; they are taken once")
        stream = stream.select(~twice)
    stream = _sorted(stream, in_packets)
    if in_packets:
        stream = _by_count(stream, f"{100 * same.mean():.0f} % of the rows have the stamp of the row before")
    elif (same := _same(stream)[0]).any():
        warn(f"{name}: {int(same.sum())} rows with the stamp of the row before are left out")
        stream = stream.select(~same)
    stream = _checked_rate(stream)
    steps = np.diff(stream.time)
    gaps = steps > stream.gap
    if gaps.any():
        k = int(np.argmax(steps))
        if steps[k] > _ENDLESS:
            raise MeasurementError(
                f"{name}, line {stream.lines[k + 1]}: time jumps from {_shown(stream.time[k])} to "
                f"{_shown(stream.time[k + 1])}; expected one log: give the parts as sessions of their own, or delete rows "
                "from before the clock was set"
            )
        warn(
            f"{name}: {int(gaps.sum())} gaps of more than {LONG_GAP} s, the longest {steps[k]:.3g} s from "
            f"{_shown(stream.time[k])} on: what lies in them is left out"
        )
    return stream


def _same(stream: Stream) -> tuple[np.ndarray, np.ndarray]:
    """Return which rows have the stamp of one before about the same thing, shape (T,), and which are the same altogether."""
    order = np.lexsort((things := stream.things, stream.time))
    same, twice = np.zeros(len(stream), bool), np.zeros(len(stream), bool)
    same[order[1:]] = (np.diff(stream.time[order]) == 0.0) & (np.diff(things[order]) == 0)
    twice[order] = same[order] & stream.select(order).repeats
    return same, twice


def _sorted(stream: Stream, in_packets: bool) -> Stream:
    """Return a stream whose rows were written a little late in the order of their stamps; refuse a clock that runs back."""
    time = stream.time
    if not np.any(back := np.diff(time) < 0.0):
        return stream
    latest, ordered = np.maximum.accumulate(time), stream.select(np.argsort(time, kind="stable"))
    # Rows which none that comes later belongs before.
    begins = np.flatnonzero(np.append(True, latest[:-1] <= np.minimum.accumulate(time[::-1])[-2::-1]))
    new = np.append(True, np.diff(ordered.time) > 0.0)
    count = np.add.reduceat(new if in_packets else new | _same(ordered)[0], begins)
    around = np.concatenate([[-np.inf], ordered.time, [np.inf]])
    # A clock that was set back gives each of some times to two samples.
    usual = (around[np.append(begins[1:], len(time)) + 1] - around[begins]) * ordered.rate
    crowded = (np.diff(begins, append=len(time)) > 1) & (count + 1 - usual > np.maximum(_EXTRA, _CROWDED * usual))
    farthest = float(np.max(latest - time))
    is_often = crowded.any() and farthest <= _LATE and back.sum() > _OFTEN_SET
    # Rows in the order of their samples are smooth as they stand.
    if is_often and _is_smoother((stream, np.arange(len(time))), (ordered, ordered.time)):
        return _by_count(stream, f"time runs back {int(back.sum())} times, by {farthest:.2g} s or less")
    if crowded.any() or farthest > _LATE:
        k = int(np.argmax(back))
        raise MeasurementError(
            f"{stream.name}, line {stream.lines[k + 1]}: time runs back from {_shown(time[k])} to {_shown(time[k + 1])}; "
            "expected one log by one clock: give logs that were appended to each other, or what is before and after a clock "
            "was set, as sessions of their own, and add its range to a counter that overflowed; if it runs back again and "
            "again, stamps are those of arrival: log the device's own"
        )
    late, name = latest > time, stream.name
    warn(f"{name}: {int(late.sum())} rows, the first in line {stream.lines[late][0]}, stand late and are put in order")
    return ordered


def _by_count(stream: Stream, what: str) -> Stream:
    """Return a stream whose stamps are those of packets by the count of its samples, if they came at an even rate."""
    time, count, steps = stream.time, np.arange(len(stream)), np.diff(stream.time)
    packets = int(np.sum(steps > steps[steps <= stream.gap].mean())) + 1
    text, cure = f"{stream.name}: {what}: stamps are those of", "; log the device's own time stamps, with all their digits"
    if stream.things.any() or packets < _PACKETS * _PARTS[0]:
        raise MeasurementError(f"{text} packets, not of samples, or lost digits{cure}")
    line = np.polyfit(count, time, 1)
    parts = np.array_split(count, min(packets // _PACKETS, _PARTS[1]))
    for _ in range(3):
        left = time - np.polyval(line, count)
        least = np.array([part[np.argmin(left[part])] for part in parts])
        line = np.polyfit(least, time[least], 1)
    left, step = time - np.polyval(line, count), float(line[0])
    begins = np.linspace(0, len(time), packets // _PACKETS, endpoint=False).astype(int)
    off, lacks = np.abs(left[least]), np.abs(np.minimum.reduceat(left, begins))
    if off.max() > min(_STRAIGHT * step, _EXACT) or lacks.max() > _WHOLE * step:
        k = int(begins[np.argmax(lacks)] if lacks.max() > _WHOLE * step else least[np.argmax(off)])
        raise MeasurementError(
            f"{text} packets, not of samples, or lost digits, and counting samples tells no times either: about line "
            f"{stream.lines[k]} they leave an even rate by {1e3 * max(off.max(), lacks.max()):.2g} ms, as where some are "
            f"lost{cure}, or number the samples and give `time` = number / rate"
        )
    warn(
        f"{text} their arrival; samples are taken to be {1e3 * step:.6g} ms apart, as by their count they are to "
        f"{1e3 * off.max():.2g} ms from beginning to end"
    )
    return replace(stream, time=np.polyval(line, count))


def _is_smoother(one: tuple[Stream, np.ndarray], other: tuple[Stream, np.ndarray]) -> bool:
    """Return whether readings change more smoothly in one order at some times than in another at others."""
    rough, else_ = (_roughness(*each) for each in (one, other))
    return bool(np.any(rough < _SMOOTHER * else_))


def _roughness(stream: Stream, time: np.ndarray) -> np.ndarray:
    """Return how far values are on the average off the line between those before and after, by column, at such times."""
    values = np.column_stack([v for v in stream.readings.values() if v.dtype.kind == "f"])
    share = ((time[1:-1] - time[:-2]) / np.maximum(time[2:] - time[:-2], 1e-300))[:, None]
    off = np.abs(values[1:-1] - (1.0 - share) * values[:-2] - share * values[2:])
    return np.asarray(off.mean(axis=0))


def _shown(stamp: float) -> str:
    return f"{stamp:.6g} s" if abs(stamp) < 1e5 else f"{stamp:.3f} s"


def _checked_rate(stream: Stream) -> Stream:
    """Return a stream without bursts; refuse stamps in another unit than is said, or that count samples."""
    step, slowest = float(np.median(stream.steps)), _SLOWEST if {"q", FORCE.name} & stream.readings.keys() else _SLOW
    usual = stream.steps[stream.steps < stream.gap]
    is_burst = len(usual) and (step < _BURST * usual.mean() or np.mean(usual < _PAIRED * usual.mean()) > _OFTEN)
    # Two devices that log into one stream stamp their samples in pairs, too, and rightly.
    if is_burst and not _is_smoother((stream, stream.time), (stream, np.arange(len(stream)))):
        return _by_count(stream, f"rows come in bursts, mostly {step:.2g} s apart, on the average {usual.mean():.2g} s")
    if 1.0 / _FASTEST <= step <= 1.0 / slowest:
        return stream
    if step == 1.0 and np.all(stream.time == np.round(stream.time)):
        raise MeasurementError(
            f"{stream.name}: time counts 1, 2, 3, ...: frames or samples; expected seconds: divide by the rate of the device"
        )
    units = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    # A log is of some seconds at least.
    long = {unit: size for unit, size in units.items() if size * np.ptp(stream.time) > 1.0}
    fits = next((unit for unit, size in long.items() if 1.0 / _USUAL <= step * size <= 1.0 / slowest), None)
    is_untold = fits and "time" not in stream.units
    cure = f"looks like [{fits}]: write `time [{fits}]` in the header" if is_untold else "look at its unit, or log faster"
    raise MeasurementError(
        f"{stream.name}: a row every {step:.3g} s; expected {slowest:g} to {_FASTEST:g} rows a second; {cure}"
    )
