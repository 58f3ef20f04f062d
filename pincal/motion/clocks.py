r"""Offset and drift of instruments' clocks relative to the joints' clock, from a common motion.

First speeds are correlated over all offsets. Then the reading y at each stamp t is linear in
features of the nominal arm at
:math:`t + \tau_0 + \tau_1 (t - t_m)`, for any pose of the instrument: an IMU's rates in the
  flange's rates, a tracker's
positions in the flange's pose. Offset and drift follow by Gauss-Newton with the linear part
projected out (Kaufman 1975), over growing intervals, so that any drift is found. A fit of the arm
refines them (:class:`pincal.model.catalogue.InstrumentClock`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pincal.errors import MeasurementError, counted
from pincal.measure.clock_jump import Jump, likeliest_jump
from pincal.measure.reading_numbers import JUMPS
from pincal.motion.motion_numbers import CLOCKS
from pincal.sensors.row_samples import evenly
from pincal.thresholds import Count, Scale

# Sampling rate at which speeds are compared [Hz], and the fraction of the shorter log that has to
# overlap.
_RATE: Scale = 50.0
_OVERLAP: Scale = 0.3
# First interval that is aligned [s], most rows of intervals and of the whole, most steps, and the
# change that counts as convergence [s].
_FIRST: Scale = 60.0
_SOME: Count = 1_500
_ROWS: Count = 6_000
_STEPS: Count = 20
_SETTLED: Scale = 1e-6
# Step of the numerical differentiation of features [s].
_STEP: Scale = 1e-3
# Steps that a nominal arm is not sure of, at most, by which a drift may be explained.
_SMALL: Count = 3
# Standard deviations by which a drift exceeds that of a crystal.
_CLEARLY: Scale = 5.0


@dataclass(frozen=True)
class Clock:
    """A clock relative to the joints' clock: its stamp t is their time t + offset + drift (t -
    middle), and steps later where one of the clocks was set or a count was lost.

    Attributes:
        offset: [s].
        drift: [1].
        middle: stamp at which the offset holds [s].
        sigma: standard deviations of offset [s] and drift [1], infinite for guesses.
        steps: stamp of the first reading after each step, and what it adds to times from there on
            [s].

    Example:
        >>> Clock(0.5, 1e-3, 100.0).to_joints(np.array([100.0, 200.0])).tolist()
        [100.5, 200.6]
        >>> Clock(0.5, steps=((150.0, 8e-3),)).to_joints(np.array([100.0, 200.0])).tolist()
        [100.5, 200.508]
    """

    offset: float = 0.0
    drift: float = 0.0
    middle: float = 0.0
    sigma: tuple[float, float] = (np.inf, np.inf)
    steps: tuple[tuple[float, float], ...] = ()

    def to_joints(self, time: np.ndarray) -> np.ndarray:
        """Return stamps as times of the joints' clock, shape (N,) [s]."""
        stepped = sum((size * (time >= at) for at, size in self.steps), np.zeros(np.shape(time)))
        return np.asarray(time + self.offset + self.drift * (time - self.middle) + stepped)

    def moved(self, offset: float, drift: float, steps: Sequence[float] = ()) -> Clock:
        """Return the clock with a change of offset [s], drift [1] and of each step [s]."""
        more = steps or np.zeros(len(self.steps)).tolist()
        changed = tuple((at, size + by) for (at, size), by in zip(self.steps, more, strict=True))
        return replace(self, offset=self.offset + offset, drift=self.drift + drift, steps=changed)

    def about(self, middle: float) -> Clock:
        """Return the same clock with the offset at another stamp [s], as a guess."""
        offset = self.offset + self.drift * (middle - self.middle)
        return Clock(offset, self.drift, middle, steps=self.steps)

    def stepping(self, jump: Jump) -> Clock:
        """Return the clock with one step more."""
        return replace(self, steps=tuple(sorted((*self.steps, (jump.time, jump.size)))))

    def is_clear(self, time: np.ndarray, margin: float) -> np.ndarray:
        """Return which stamps, shape (N,), are farther than a margin from all steps [s]."""
        found = np.ones(np.shape(time), bool)
        for at, _ in self.steps:
            found &= np.abs(time - at) > margin
        return found


@dataclass(frozen=True)
class SpeedMatch:
    """Match of two logs of speeds.

    Attributes:
        offset: time to be added to the second log's times [s].
        likeness: correlation of the speeds there, at most 1.
        rival: the best correlation at another offset.
    """

    offset: float
    likeness: float
    rival: float

    @property
    def is_same(self) -> bool:
        """Whether both are of the same motion."""
        return self.likeness >= CLOCKS.same_motion

    @property
    def is_clear(self) -> bool:
        """Whether no other offset matches as well, as happens in a motion that repeats."""
        return self.rival < self.likeness - CLOCKS.clear


def correlate(
    time: np.ndarray, speed: np.ndarray, other_time: np.ndarray, other: np.ndarray
) -> SpeedMatch:
    """Return the offset between the clocks of two logs of speeds, in any units, by their
    correlation.

    Times [s] are increasing; those and speeds have the shape (N,) in one log and (M,) in the other.
    """
    from scipy.signal import fftconvolve

    a, b = (_resampled(t, v) for t, v in ((time, speed), (other_time, other)))
    masks = np.ones(len(a)), np.ones(len(b))[::-1]
    a = a - a.mean()
    b = (b - b.mean())[::-1]
    count = np.maximum(np.round(fftconvolve(*masks)), 1.0)
    sums = fftconvolve(a, masks[1]), fftconvolve(masks[0], b)
    squares = fftconvolve(a**2, masks[1]), fftconvolve(masks[0], b**2)
    spread = [
        np.maximum(s - own**2 / count, 1e-12 * s.max(initial=1e-300))
        for s, own in zip(squares, sums, strict=True)
    ]
    like = (fftconvolve(a, b) - sums[0] * sums[1] / count) / np.sqrt(spread[0] * spread[1])
    like[count < _OVERLAP * min(len(a), len(b))] = -1.0
    best = int(np.argmax(like))
    others = np.abs(np.arange(len(like)) - best) > CLOCKS.apart * _RATE
    start = float(time[0] - other_time[0]) + (best - (len(b) - 1)) / _RATE
    return SpeedMatch(start, float(like[best]), float(like[others].max(initial=-1.0)))


def _resampled(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return means of values about evenly spaced times, shape (K,)."""
    grid = np.arange(time[0], time[-1], 1.0 / _RATE)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    ends = np.searchsorted(time, [grid - 0.5 / _RATE, grid + 0.5 / _RATE])
    count = ends[1] - ends[0]
    means = (sums[ends[1]] - sums[ends[0]]) / np.maximum(count, 1)
    return np.asarray(np.where(count > 0, means, np.interp(grid, time, values)))


@dataclass(frozen=True)
class Alignment:
    """A clock, and the linear map from features of the arm to readings.

    Attributes:
        clock: the clock.
        matrix: shape (m, k), readings by features.
        constant: shape (m,).
        scatter: shape (m,), standard deviation of the residuals.
        jump: the likeliest jump of the clock.
        may_step: whether the clock may have steps of which a nominal arm is not sure, in place of
            a drift that no crystal has.
    """

    clock: Clock
    matrix: np.ndarray
    constant: np.ndarray
    scatter: np.ndarray
    jump: Jump
    may_step: bool = False

    @property
    def is_crystal(self) -> bool:
        """Whether the clock drifts no more than a crystal."""
        return abs(self.clock.drift) <= max(CLOCKS.drift, _CLEARLY * self.clock.sigma[1])


def refuse_uncovered(known: np.ndarray, *, source: str) -> None:
    """Refuse readings of which none lies on the path of the joints; ``known`` are those that do,
    indices or a mask.

    Raises:
        MeasurementError: if there are none.
    """
    if not (known.any() if known.dtype == bool else len(known)):
        raise MeasurementError(
            f"{source}: no reading lies where the joints were logged without a gap; expected "
            "joints and readings over the same minutes of motion: log them together, and the "
            "joints without gaps"
        )


def _refuse_few(time: np.ndarray, unknown: int, *, source: str) -> None:
    """Refuse readings on the path of the joints, of stamps ``time``, that are no more than what
    they have to tell.
    """
    if len(time) <= unknown:
        raise MeasurementError(
            f"{source}: but for {counted(len(time), 'reading')}, over {np.ptp(time):.2g} s, no "
            "reading lies where the joints were logged without a gap: too few to find the offset "
            "of their clock; expected joints and readings that were logged together over some "
            "minutes of motion"
        )


def aligned(
    time: np.ndarray,
    readings: np.ndarray,
    features: Callable[[np.ndarray, np.ndarray], np.ndarray],
    covers: Callable[[np.ndarray], np.ndarray],
    start: Clock,
    *,
    source: str,
) -> Alignment:
    """Return the clock by which readings are linear in features of the motion, with the steps that
    no error of a nominal arm looks like.

    Args:
        time: stamps of the readings, shape (N,) [s].
        readings: shape (N, m).
        features: returns features, shape (M, k), for times of the joints' clock, shape (M,) [s],
            and indices of readings.
        covers: returns at which of such times they are known.
        start: the clock, to some tenths of a second; if its drift is known, the whole is aligned at
            once.
        source: of the readings, for errors.

    Raises:
        MeasurementError: if the joints' path is known at none of the readings.
    """
    stamped = _Stamped(time, readings, features, covers, source)
    found = stamped.whole(start)
    while found.jump.is_sure(CLOCKS.nominal_jump) and len(found.clock.steps) < JUMPS.most:
        found = stamped.whole(found.clock.stepping(found.jump))
    beside = found
    for _ in range(_SMALL):
        if beside.is_crystal or np.isinf(beside.jump.sigma):
            break
        beside = stamped.whole(beside.clock.stepping(beside.jump))
    return replace(found, may_step=beside is not found and beside.is_crystal)


@dataclass(frozen=True, eq=False)
class _Stamped:
    """Readings by their own clock; attributes are the arguments of :func:`aligned`."""

    time: np.ndarray
    readings: np.ndarray
    features: Callable[[np.ndarray, np.ndarray], np.ndarray]
    covers: Callable[[np.ndarray], np.ndarray]
    source: str

    def whole(self, start: Clock) -> Alignment:
        """Return the clock of all readings, with as many steps as the start has."""
        known = self.covers(start.to_joints(self.time))
        refuse_uncovered(known, source=self.source)
        # Of a reading: amid the stamps there may be none, where a clock was set or a log paused.
        middle = np.sort(self.time[known])[np.count_nonzero(known) // 2]
        farthest = np.abs(self.time[known] - middle).max()
        first = _FIRST if np.isinf(start.sigma[1]) else np.inf
        clock = start.about(float(middle))
        half = 0.5 * first
        while True:
            is_whole = half >= farthest
            half = min(half, farthest)
            inside = np.flatnonzero(np.abs(self.time - middle) <= half + 1e-9)
            rows = inside[evenly(len(inside), _ROWS if is_whole else _SOME)]
            found = self.part(rows, clock)
            clock = found.clock
            if is_whole:
                return found
            half *= 2.0

    def part(self, rows: np.ndarray, clock: Clock) -> Alignment:
        """Return the clock of some readings, from one that is nearly theirs."""
        for _ in range(_STEPS):
            seen = rows[self.covers(clock.to_joints(self.time[rows]))]
            refuse_uncovered(seen, source=self.source)
            since = self.time[seen] - clock.middle
            shapes = [np.ones(len(since)), since, *(self.time[seen] >= at for at, _ in clock.steps)]
            found = _Projected.of(
                self.readings[seen], clock.to_joints(self.time[seen]), shapes, seen, self.features
            )
            _refuse_few(self.time[seen], found.basis.shape[1] + len(shapes), source=self.source)
            J = found.jacobian
            H = J.T @ J
            # A step outside of the rows is not seen.
            H[np.diag_indices_from(H)] += 1e-12 * H[0, 0]
            step = np.linalg.solve(H, J.T @ (found.rest * found.weights).ravel())
            sigma = np.sqrt(np.diag(np.linalg.inv(H)))
            clock = replace(
                clock.moved(float(step[0]), float(step[1]), step[2:].tolist()),
                sigma=(float(sigma[0]), float(sigma[1])),
            )
            if abs(step[0]) < _SETTLED and abs(step[1]) * np.ptp(since) < _SETTLED:
                break
        jump = likeliest_jump(
            since + clock.middle,
            found.rest * found.weights,
            found.rate * found.weights,
            found.unexplained,
            [at for at, _ in clock.steps],
        )
        solution = found.solution
        return Alignment(clock, solution[:-1].T, solution[-1], found.scatter, jump)


@dataclass(frozen=True)
class _Projected:
    """N readings of m values, with their linear part in k features of the motion projected out.

    Attributes:
        basis: shape (N, k), orthonormal columns that span the features.
        solution: shape (k, m), the linear part.
        rest: shape (N, m), residuals.
        rate: shape (N, m), derivatives of the linear part by time.
        scatter: shape (m,), standard deviation of the residuals.
        weights: shape (m,), their inverse.
        jacobian: shape (N m, 2 + steps), weighted derivatives by offset, drift and steps of the
            clock.
    """

    basis: np.ndarray
    solution: np.ndarray
    rest: np.ndarray
    rate: np.ndarray
    scatter: np.ndarray
    weights: np.ndarray
    jacobian: np.ndarray

    @classmethod
    def of(
        cls,
        y: np.ndarray,
        at: np.ndarray,
        shapes: Sequence[np.ndarray],
        seen: np.ndarray,
        features: Callable[[np.ndarray, np.ndarray], np.ndarray],
    ) -> _Projected:
        """Return the readings ``y`` of the rows ``seen`` at times of the joints' clock, shape (N,)
        [s]; ``shapes``, shape (N,) each, are derivatives of these by what is unknown of the clock.
        """
        A, ahead, behind = (
            np.column_stack([features(at + s, seen), np.ones(len(at))])
            for s in (0.0, _STEP, -_STEP)
        )
        Q = np.linalg.qr(A)[0]
        solution = np.linalg.lstsq(A, y, rcond=1e-12)[0]
        rest = y - A @ solution
        rate = ((ahead - behind) / (2.0 * _STEP)) @ solution
        changes = (rate * shape[:, None] for shape in shapes)
        columns = [change - Q @ (Q.T @ change) for change in changes]
        scatter = np.sqrt(np.sum(rest**2, axis=0) / max(len(y) - A.shape[1] - 1, 1))
        weights = 1.0 / np.maximum(scatter, 1e-12 * np.abs(y).max(initial=1e-300))
        J = np.column_stack([(column * weights).ravel() for column in columns])
        return cls(Q, solution, rest, rate, scatter, weights, J)

    @cached_property
    def _clock_basis(self) -> np.ndarray:
        return np.linalg.qr(self.jacobian)[0]

    def unexplained(self, steps: np.ndarray) -> np.ndarray:
        """Return columns, shape (N, m, K), projected onto the complement of the linear part, and of
        offset, drift and steps.
        """
        Q = self.basis
        clocks = self._clock_basis
        flat = (steps - np.tensordot(Q, np.tensordot(Q.T, steps, axes=1), axes=1)).reshape(
            self.jacobian.shape[0], -1
        )
        return np.asarray((flat - clocks @ (clocks.T @ flat)).reshape(steps.shape))
