r"""Times of the samples of an IMU that was polled: a poll at the stamp p reads the latest sample.

Samples are taken every b seconds by the clock of the device, polls when the logger comes round, so
that a reading is late by

.. math:: d(p) = (p - a) \bmod b = \frac{b}{2} - \frac{b}{\pi} \sum_m \frac{1}{m} \sin \frac{2 \pi m
          (p - a)}{b},

up to a sample. The mean is an offset of the clock; the rest has the frequency by which samples and
polls differ. Of some hertz or less it passes any filter of readings, and looks like motion. A line
at 1/b in the products of the residuals of rates and their derivatives shows b and a. The delays so
found explain the residuals with a factor of 1 if stamps are of polls, and with hardly any if they
are those of the samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pincal.errors import counted, warn
from pincal.motion.clocks import Clock
from pincal.motion.motion_numbers import POLLING
from pincal.motion.moving_arm import MovingArm
from pincal.motion.stream import Stream
from pincal.sensors.imu import RATE
from pincal.thresholds import Count, Scale

# Cells of a spectrum in time for each poll, its points for each that is independent, most parts of
# a log in which the phase of the line is compared, samples that readings pass in each, and degree
# of the polynomial in time through these phases.
_CELLS: Count = 4
_FINE: Count = 2
_PARTS: Count = 12
_BEATS: Scale = 3.0
_DEGREE: Count = 2
# Part of the usual variance of delays from which on a part of a log tells their size.
_TOLD: Scale = 0.3
# Lines that are tried, and their width in those of a log.
_PEAKS: Count = 6
_WIDTH: Scale = 2.0
# Part of the usual strength of a line from which on the phase of a part is known.
_STRONG: Scale = 0.3
# Readings of an instrument from which on its rate is known.
_FEWEST: Count = 100
# Length of time about the ends of the joints' path that is left out [s].
_MARGIN: Scale = 0.1


def at_samples(arm: MovingArm, imu: Stream, clock: Clock, mount: np.ndarray) -> Stream | None:
    """Return an IMU's readings at the times of its samples if its stamps are those of polls, with a
    warning; None if they are not.

    Readings too close to the next sample to tell which it is are left out.

    Args:
        arm: the arm.
        imu: its readings, each sample once.
        clock: of the stamps.
        mount: rotation from the IMU's frame to the tip, shape (3, 3).
    """
    line = _line(_Delays.of(arm, imu, clock, mount))
    if line is None:
        return None
    since = line.samples_at(imu.time)
    is_new = np.append(True, np.diff(np.floor(since)) > 0.0)
    is_sure = np.abs(since - np.round(since)) > POLLING.unsure
    found = replace(imu, time=imu.time - line.late(imu.time)).select(is_new & is_sure)
    warn(
        f"{imu.name}: its rates are late by varying parts of a sample, as where an IMU with one "
        f"every {1e3 * line.period:.5g} ms is polled; the times of its samples are used instead, "
        f"{counted(len(imu) - len(found), 'row', 'are')} left out, close to two samples: log the "
        "device's own stamps"
    )
    return found


def at_even_samples(stream: Stream) -> Stream:
    """Return a stream without rows that repeat a sample of an instrument that was polled faster
    than it reads, and the others at the times of its samples, with a warning; as it is if stamps
    are not those of such polls.

    The first poll after a sample is late by up to the time between two polls, in which an arm moves
    by millimetres.
    """
    again = stream.repeats
    stamps = stream.time[~again]
    if stream.things.any() or not again.any() or len(stamps) < _FEWEST:
        return stream
    poll = float(np.median(np.diff(stream.time)))
    steps = np.diff(stamps)
    # Where no sample was lost.
    period = float(np.mean(steps[steps < np.median(steps) + POLLING.within * poll]))
    lost = steps > period + POLLING.within * poll
    if period < POLLING.faster * poll or lost.mean() > 0.5:
        return stream
    numbers = _numbers(stamps, poll, lost=lost)
    line = np.polyfit(numbers, stamps, 1)
    sampled = np.polyval(line, numbers)
    if np.ptp(stamps - sampled) > POLLING.within * poll:
        return stream
    kept = stream.without(
        again,
        f"repeat the previous one, of an instrument that reads every {1e3 * line[0]:.5g} ms, whose "
        "times are used instead of those of polls: the log is too fast",
    )
    return replace(kept, time=sampled)


def _numbers(stamps: np.ndarray, poll: float, *, lost: np.ndarray) -> np.ndarray:
    """Return the numbers of samples at an even rate, by the stamps of the first poll after each,
    shape (N,), the time between two polls [s], and where samples were lost, shape (N - 1,).
    """
    stretches = np.split(stamps, np.flatnonzero(lost) + 1)
    longest = max(stretches, key=len)
    count = np.arange(len(longest))
    step, start = np.polyfit(count, longest, 1)
    late = longest - start - step * count
    # Amid the time in which no first poll after a sample comes.
    before = start + late.min() - 0.5 * (step - poll)
    return np.asarray(np.floor((stamps - before) / step))


@dataclass(frozen=True)
class _Delays:
    """What N readings say of their delays.

    Attributes:
        time: stamps from the first on, shape (N,) [s].
        products: residuals of rates by their derivatives, shape (N,) [rad^2/s^3].
        squares: of the derivatives, shape (N,) [rad^2/s^4].
        start: the first stamp [s].
    """

    time: np.ndarray
    products: np.ndarray
    squares: np.ndarray
    start: float

    @classmethod
    def of(cls, arm: MovingArm, imu: Stream, clock: Clock, mount: np.ndarray) -> _Delays:
        at = clock.to_joints(imu.time)
        known = arm.path.covers(at, _MARGIN)
        ideal = arm.ideal(at[known])
        turning = ideal.turning @ mount
        features = np.column_stack([ideal.rate @ mount, turning, np.ones(len(turning))])
        readings = imu.readings[RATE.name][known]
        left = readings - features @ np.linalg.lstsq(features, readings, rcond=1e-12)[0]
        time = imu.time[known]
        start = float(imu.time[0])
        return cls(time - start, np.sum(left * turning, axis=1), np.sum(turning**2, axis=1), start)

    @property
    def rate(self) -> float:
        """Mean number of readings a second, excluding gaps."""
        steps = np.diff(self.time)
        return 1.0 / float(np.mean(steps[steps < POLLING.gap * np.median(steps)]))

    def spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Return frequencies, from half the rate of polls to three halves [Hz], and the sums of
        products there, complex, shapes (K,).
        """
        from scipy.fft import fft, fftfreq, next_fast_len

        rate = self.rate
        # Products turned by their phase at the rate of polls change slowly from cell to cell.
        turned = self.products * np.exp(-2j * np.pi * rate * self.time)
        cells = (self.time * rate * _CELLS).astype(int)
        count = next_fast_len(_FINE * (int(cells[-1]) + 1))
        sums = np.bincount(cells, turned.real, count) + 1j * np.bincount(cells, turned.imag, count)
        beats = fftfreq(count, 1.0 / (rate * _CELLS))
        near = np.abs(beats) < 0.5 * rate
        return rate + beats[near], np.asarray(fft(sums))[near]

    def passed(self, frequencies: np.ndarray) -> np.ndarray:
        """Return how many samples of a device polls pass over the log, by its frequency [Hz], shape
        (K,).
        """
        rate = 1.0 / np.median(np.diff(self.time))
        return np.asarray(np.abs(frequencies - rate) * self.time[-1])

    def phases(self, frequency: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the line at a frequency [Hz] in the delays of parts of the log, complex, beside
        their mean, and the middles of these [s], shapes (P,).

        Parts are so long that readings pass some samples.
        """
        count = int(np.clip(self.passed(np.array(frequency)) / _BEATS, 1, _PARTS))
        waves = np.exp(-2j * np.pi * frequency * self.time)
        shapes = np.column_stack([np.ones(len(waves)), waves.real, waves.imag])
        found = []
        for part in np.array_split(np.arange(len(waves)), count):
            of = shapes[part]
            gram = of.T @ (of * self.squares[part, None])
            gram[np.diag_indices(3)] += 1e-9 * self.squares.sum()
            _, across, along = np.linalg.solve(gram, of.T @ self.products[part])
            found.append(self.squares[part].sum() * complex(across, along))
        middles = [part.mean() for part in np.array_split(self.time, count)]
        return np.array(found), np.array(middles)

    def parts(self) -> Iterator[_Delays]:
        """Yield the log, and parts of it in the order of time."""
        yield self
        for rows in np.array_split(np.arange(len(self.time)), _PARTS):
            yield _Delays(self.time[rows], self.products[rows], self.squares[rows], self.start)

    def explained_by(self, line: _Line) -> _Explained:
        """Return what delays by a line explain."""
        late = line.late(self.time + self.start)
        late -= np.average(late, weights=self.squares)
        known = float(np.sum(self.squares * late**2))
        size = -float(np.sum(self.products * late)) / max(known, 1e-300)
        usual = float(np.sum(self.squares)) * line.period**2 / 12.0
        # A later reading never has residuals of the other sign.
        return _Explained(max(size, 0.0) ** 2 * known, size, known > _TOLD * usual)


class _Explained(NamedTuple):
    """What delays explain: by how much the sum of squared residuals falls [rad^2/s^2], their size
    for that relative to those of polls, and whether enough samples are passed to tell it.
    """

    gain: float
    size: float
    tells: bool


@dataclass(frozen=True)
class _Line:
    """The samples of a device by stamps of polls.

    Attributes:
        period: time between two samples [s].
        start: the stamp from which these count [s].
        numbers: polynomial in time from there on, that of samples taken, highest power first.
    """

    period: float
    start: float
    numbers: np.ndarray

    def samples_at(self, time: np.ndarray) -> np.ndarray:
        """Return how many samples were taken at stamps, shape (N,), with the part of the next."""
        return np.asarray(np.polyval(self.numbers, time - self.start))

    def late(self, time: np.ndarray) -> np.ndarray:
        """Return by how much readings at stamps are late, shape (N,) [s]."""
        since = self.samples_at(time)
        return np.asarray((since - np.floor(since)) * self.period)


def _line(delays: _Delays) -> _Line | None:
    """Return the samples of a device that was polled; None if delays show no line of its size.

    Even polls show samples at as much less than their rate as at more: the delays of one grow with
    time until they jump back, those of the other would shrink. Fewer samples passed than a line
    needs are steps of a clock that drifts, and are found as such.
    """
    if not len(delays.time) or not delays.squares.any():
        return None
    frequencies, sums = delays.spectrum()
    power = np.abs(sums) ** 2
    if power.max() < POLLING.clear * np.median(power):
        return None
    width = _WIDTH / float(delays.time[-1])
    left = power.copy()
    passed = delays.passed(frequencies)
    left[passed < _BEATS] = 0.0
    found = []
    for _ in range(_PEAKS):
        peak = float(frequencies[np.argmax(left)])
        left[np.abs(frequencies - peak) < width] = 0.0
        line = _with_phases(delays, peak)
        found.append((delays.explained_by(line).gain, line))
    _, best = max(found, key=lambda one: one[0])
    return best if all(_is_of_polls(part.explained_by(best)) for part in delays.parts()) else None


def _is_of_polls(explained: _Explained) -> bool:
    """Return whether delays are those of polls, if a part of a log tells: a clock that stepped, or
    a device that was reset, has others from there on.
    """
    return not explained.tells or POLLING.least < explained.size < 1.0 / POLLING.least


def _with_phases(delays: _Delays, frequency: float) -> _Line:
    """Return the samples of a device that takes so many a second."""
    of_parts, middles = delays.phases(frequency)
    strong = np.abs(of_parts) > _STRONG * np.median(np.abs(of_parts))
    # A reading that is late by d has residuals of -d times the derivatives.
    turns = -np.unwrap(np.angle(of_parts[strong]) + 0.5 * np.pi) / (2.0 * np.pi)
    degree = min(_DEGREE, int(strong.sum()) - 1)
    of_start = np.polyfit(middles[strong], turns, degree, w=np.abs(of_parts[strong]))
    return _Line(1.0 / frequency, delays.start, np.polysub([frequency, 0.0], of_start))
