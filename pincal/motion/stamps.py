"""Times of the samples of a stream, by its stamps: unique, in order, and at the rate of a log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pincal.errors import MeasurementError, counted, warn
from pincal.motion.motion_numbers import STAMP, STREAM
from pincal.motion.stream import Stream
from pincal.sensors.imu import FORCE
from pincal.thresholds import Count

# Parts of a log whose least delayed packets are compared.
_MOST_PARTS: Count = 30


def in_order(stream: Stream) -> Stream:
    """Return a stream with increasing stamps at the rate of a log; warn of corrections.

    Rows that a logger wrote twice or a little late are corrected, and so are stamps of packets if
    the count of samples determines their times.

    Raises:
        MeasurementError: for stamps that run back, or do not determine the times of the samples.
    """
    name = stream.name
    if (stamps := len(stream.steps)) < 2 * STAMP.slowest:
        raise MeasurementError(
            f"{name}: {len(stream)} rows with {stamps + 1} stamps; expected a log of some minutes"
        )
    same, twice = _same(stream)
    in_packets = (same & ~twice).mean() > STAMP.few
    if twice.any() and not in_packets:
        first = stream.lines[twice][0]
        warn(
            f"{name}: {counted(int(twice.sum()), 'row', 'occur')} twice, the first in "
            f"line {first}: used once"
        )
        stream = stream.select(~twice)
    stream = _sorted(stream, in_packets)
    if in_packets:
        stream = _by_count(
            stream, f"{100 * same.mean():.0f} % of the rows have the stamp of the previous row"
        )
    elif (same := _same(stream)[0]).any():
        warn(f"{name}: left out: {counted(int(same.sum()), 'row')} with the previous stamp")
        stream = stream.select(~same)
    stream = _checked_rate(stream)
    _warn_of_gaps(stream)
    return stream


def _warn_of_gaps(stream: Stream) -> None:
    """Warn of gaps of a log; refuse one that no log has."""
    steps = np.diff(stream.time)
    gaps = steps > stream.gap
    if not gaps.any():
        return
    k = int(np.argmax(steps))
    if steps[k] > STAMP.endless:
        raise MeasurementError(
            f"{stream.name}, line {stream.lines[k + 1]}: time jumps from {_shown(stream.time[k])} "
            f"to {_shown(stream.time[k + 1])}; expected one log: give the parts as separate "
            "sessions, or delete rows from before the clock was set"
        )
    warn(
        f"{stream.name}: {counted(int(gaps.sum()), 'gap')} of more than {STREAM.long_gap} s, up to "
        f"{steps[k]:.3g} s from {_shown(stream.time[k])} on: motion within is left out"
    )


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
    """Return a stream with late rows in the order of their stamps, or with stamps that go on where
    a clock was set back by little; refuse one that runs back otherwise.
    """
    time = stream.time
    if not np.any(back := np.diff(time) < 0.0):
        return stream
    latest = np.maximum.accumulate(time)
    ordered = stream.select(np.argsort(time, kind="stable"))
    is_crowded = _is_crowded(time, ordered, in_packets)
    farthest = float(np.max(latest - time))
    is_often = is_crowded and farthest <= STAMP.late and back.sum() > STAMP.often_set
    # Rows in the order of sampling are smoother than in the order of their stamps.
    if is_often and _is_smoother((stream, np.arange(len(time))), (ordered, ordered.time)):
        return _by_count(
            stream, f"time runs backwards {int(back.sum())} times, by {farthest:.2g} s or less"
        )
    if is_crowded and farthest <= STAMP.late and back.sum() <= STAMP.often_set:
        return _continued(stream, back)
    if is_crowded or farthest > STAMP.late:
        raise _runs_back(stream, back)
    late = latest > time
    name = stream.name
    warn(
        f"{name}: {counted(int(late.sum()), 'row', 'are')} late, the first in line "
        f"{stream.lines[late][0]}, and sorted by time"
    )
    return ordered


def _runs_back(stream: Stream, back: np.ndarray) -> MeasurementError:
    """Return the error of a log whose stamps run back, shape (T - 1,), with what to do."""
    k = int(np.argmax(back))
    return MeasurementError(
        f"{stream.name}, line {stream.lines[k + 1]}: time runs backwards from "
        f"{_shown(stream.time[k])} to {_shown(stream.time[k + 1])}; expected one log with one "
        "clock: give logs that were appended to each other, or the parts before and after a clock "
        "was set, as separate sessions, and add its range to a counter that overflowed; if it runs "
        "backwards repeatedly, stamps are times of arrival: log the device's own"
    )


def _continued(stream: Stream, back: np.ndarray) -> Stream:
    """Return a stream whose clock was set back by little while it was read, where its stamps run
    back, shape (T - 1,), with stamps that go on there.

    If samples were lost meanwhile, the clock still has a step, which is found like any other.
    """
    steps = np.diff(stream.time)
    by = np.where(back, np.median(steps[~back]) - steps, 0.0)
    k = int(np.argmax(back))
    warn(
        f"{stream.name}, line {stream.lines[k + 1]}: time runs backwards from "
        f"{_shown(stream.time[k])} to {_shown(stream.time[k + 1])}, "
        f"{counted(int(back.sum()), 'time')} in all: a clock was set back; stamps are assumed to "
        "go on there"
    )
    return replace(stream, time=stream.time + np.append(0.0, np.cumsum(by)))


def _is_crowded(time: np.ndarray, ordered: Stream, in_packets: bool) -> bool:
    """Return whether a clock was set back and assigned some times to two samples each, by stamps
    as written, shape (T,) [s], and the stream in their order.
    """
    # Rows at which all earlier stamps are smaller than all later ones.
    latest = np.maximum.accumulate(time)
    begins = np.flatnonzero(
        np.append(True, latest[:-1] <= np.minimum.accumulate(time[::-1])[-2::-1])
    )
    new = np.append(True, np.diff(ordered.time) > 0.0)
    count = np.add.reduceat(new if in_packets else new | _same(ordered)[0], begins)
    around = np.concatenate([[-np.inf], ordered.time, [np.inf]])
    usual = (around[np.append(begins[1:], len(time)) + 1] - around[begins]) * ordered.rate
    crowded = (np.diff(begins, append=len(time)) > 1) & (
        count + 1 - usual > np.maximum(STAMP.extra, STAMP.crowded * usual)
    )
    return bool(crowded.any())


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
    if stream.things.any() or packets < STAMP.packets * STAMP.fewest_parts:
        raise MeasurementError(f"{text} packets, not of samples, or lost digits{cure}")
    line, least = _even_line(time, min(packets // STAMP.packets, _MOST_PARTS))
    left = time - np.polyval(line, count)
    step = float(line[0])
    begins = np.linspace(0, len(time), packets // STAMP.packets, endpoint=False).astype(int)
    off = np.abs(left[least])
    lacks = np.abs(np.minimum.reduceat(left, begins))
    is_lacking = lacks.max() > STAMP.lacking * step
    if is_lacking or off.max() > min(STAMP.uneven * step, STAMP.uneven_time):
        k = int(begins[np.argmax(lacks)] if is_lacking else least[np.argmax(off)])
        raise MeasurementError(
            f"{text} packets, not of samples, or lost digits, and the count of samples does not "
            f"determine times either: about line {stream.lines[k]} they deviate from an even rate "
            f"by {1e3 * max(off.max(), lacks.max()):.2g} ms, as when some are lost{cure}, or "
            "number the samples and give `time` = number / rate"
        )
    warn(
        f"{text} their arrival; samples are assumed to be {1e3 * step:.6g} ms apart, which holds "
        f"by their count to {1e3 * off.max():.2g} ms from beginning to end"
    )
    return replace(stream, time=np.polyval(line, count))


def _even_line(time: np.ndarray, parts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the line of stamps, shape (T,) [s], by their count through the least delayed of each
    part of a log, and the indices of these, shape (parts,).
    """
    count = np.arange(len(time))
    line = np.polyfit(count, time, 1)
    for _ in range(3):
        left = time - np.polyval(line, count)
        least = np.array([part[np.argmin(left[part])] for part in np.array_split(count, parts)])
        line = np.polyfit(least, time[least], 1)
    return line, least


def _is_smoother(one: tuple[Stream, np.ndarray], other: tuple[Stream, np.ndarray]) -> bool:
    """Return whether some reading is clearly smoother in one order, at its times, than
    in another.
    """
    return bool(np.any(_roughness(*one) < STAMP.smoother * _roughness(*other)))


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


def _fitting_unit(stream: Stream, step: float, slowest: float) -> str | None:
    """Return the unit in which stamps with a step, in the stated one, would have a usual rate."""
    units = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    # A log lasts some seconds at least.
    long = {unit: size for unit, size in units.items() if size * np.ptp(stream.time) > 1.0}
    ends = 1.0 / STAMP.usual, 1.0 / slowest
    return next((unit for unit, size in long.items() if ends[0] <= step * size <= ends[1]), None)


def _checked_rate(stream: Stream) -> Stream:
    """Return a stream without bursts; refuse stamps in another unit than stated, or that count
    samples.
    """
    step = float(np.median(stream.steps))
    slowest = STAMP.slowest if {"q", FORCE.name} & stream.readings.keys() else STAMP.slow
    usual = stream.steps[stream.steps < stream.gap]
    is_burst = len(usual) and (
        step < STAMP.burst * usual.mean()
        or np.mean(usual < STAMP.paired * usual.mean()) > STAMP.often_paired
    )
    # Two devices in one stream rightly stamp their samples in pairs as well.
    if is_burst and not _is_smoother((stream, stream.time), (stream, np.arange(len(stream)))):
        return _by_count(
            stream,
            f"rows are in bursts, mostly {step:.2g} s apart, on average {usual.mean():.2g} s",
        )
    if 1.0 / STAMP.fastest <= step <= 1.0 / slowest:
        return stream
    if step == 1.0 and np.all(stream.time == np.round(stream.time)):
        raise MeasurementError(
            f"{stream.name}: time counts 1, 2, 3, ...: frames or samples; expected "
            "seconds: divide by the rate of the device"
        )
    raise MeasurementError(
        f"{stream.name}: a row every {step:.3g} s; expected {slowest:g} to {STAMP.fastest:g} "
        f"rows a second; {_cure_of_rate(stream, step, slowest)}"
    )


def _cure_of_rate(stream: Stream, step: float, slowest: float) -> str:
    """Return what may be done about an implausible rate, in words."""
    fits = _fitting_unit(stream, step, slowest)
    if fits and "time" not in stream.units:
        return f"looks like [{fits}]: write `time [{fits}]` in the header"
    return "check its unit, or log faster"
