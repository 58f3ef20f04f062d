r"""Joint positions as functions of time: splines of degree 5 fitted to encoder readings, with
derivatives.

The splines have uniform knots and are fitted by least squares, so that memory and time are linear
in the length of a log. The spacing of the knots is chosen by generalised cross-validation (Craven
and Wahba 1979): N RSS / (N - K)^2 for a regression spline of K coefficients fitted to N readings,
here the geometric mean over the joints.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.motion.motion_numbers import ON_PATH
from pincal.thresholds import Count, Scale

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

DEGREE: Count = 5
"""Degree of the splines: their jerk is continuous."""
# Knots per second that are tried: fits of a real arm with IMU and tracker were the same from 4 to
# 20.
_TRIED: tuple[Scale, ...] = (4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
# Most readings by which knots are chosen.
_MOST: Count = 6_000
# Readings processed at once; relative ridge of the normal equations.
_PIECE: Count = 50_000
_RIDGE: Scale = 1e-14
# Residuals below this are rounding of the numbers [rad or m].
_ROUNDING: Scale = 1e-12


@dataclass(frozen=True, repr=False)
class JointPath:
    """Positions of n joints as functions of time.

    Attributes:
        parts: the splines, each of n columns, between longer gaps of the log.
        spacing: time between two knots [s].
        scatter: standard deviation of the readings about the splines, shape (n,) [rad or m].
        origin: time origin of the splines [s].
    """

    parts: tuple[BSpline, ...]
    spacing: float
    scatter: np.ndarray
    origin: float = 0.0

    def __repr__(self) -> str:
        begin, end = self.span
        return (
            f"JointPath({len(self.scatter)} joints, {begin:.6g} s to {end:.6g} s, "
            f"{1.0 / self.spacing:g} knots per second)"
        )

    @classmethod
    def through(
        cls, time: np.ndarray, q: np.ndarray, *, knots_per_second: float | None = None
    ) -> JointPath:
        """Return the path fitted to readings of the joints.

        Args:
            time: shape (N,), strictly increasing [s].
            q: shape (N, n), joint positions [rad], prismatic [m].
            knots_per_second: of the splines; default: by generalised cross-validation.

        Raises:
            MeasurementError: for times that do not increase, or a log without a stretch long enough
                for a spline.

        Example:
            >>> time = np.linspace(0.0, 10.0, 1001)
            >>> path = JointPath.through(time, np.sin(time)[:, None])
            >>> path.at(np.array([5.0]), 1).round(6), path.covers(np.array([5.0, 11.0])).tolist()
            (array([[0.283662]]), [True, False])
        """
        if len(time) < 2 or np.any(np.diff(time) <= 0.0):
            raise MeasurementError(
                "times of the joints do not increase; expected a log in order, one sample per row"
            )
        own = np.asarray(time - time[0], float)
        rate = _chosen_rate(own, q) if knots_per_second is None else knots_per_second
        stretches = list(_stretches(own, 1.0 / rate))
        if not stretches:
            raise MeasurementError(
                f"the log of the joints has no {2.0 * ON_PATH.ends / rate:.2g} s without a gap of "
                f"{ON_PATH.bridged / rate:.2g} s; expected readings at 20 Hz or more"
            )
        fits = [_spline(own[part], q[part], rate) for part in stretches]
        squares = [
            np.sum((q[part] - fit(own[part])) ** 2, axis=0)
            for part, fit in zip(stretches, fits, strict=True)
        ]
        freedom = sum(
            part.stop - part.start - len(fit.c) for part, fit in zip(stretches, fits, strict=True)
        )
        return cls(
            tuple(fits),
            1.0 / rate,
            np.sqrt(np.sum(squares, axis=0) / max(freedom, 1)),
            float(time[0]),
        )

    def mapped(self, matrix: np.ndarray, offsets: np.ndarray | float = 0.0) -> JointPath:
        """Return the path of linear functions of the joints, shape (n, n), plus offsets, shape (n,)
        [rad or m].
        """
        from scipy.interpolate import BSpline

        parts = tuple(BSpline(part.t, part.c @ matrix.T + offsets, part.k) for part in self.parts)
        return replace(self, parts=parts, scatter=np.abs(matrix) @ self.scatter)

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of the log [s]."""
        return self.origin + float(self.parts[0].t[0]), self.origin + float(self.parts[-1].t[-1])

    def grid(self, step: float) -> np.ndarray:
        """Return times at intervals of ``step`` [s], except in and near gaps of the log, shape
        (K,).
        """
        times = np.arange(*self.span, step)
        kept = np.flatnonzero(self.covers(times))
        inner = np.arange(kept[0], kept[-1] + 1) if len(kept) else kept
        return np.delete(times, np.setdiff1d(inner, kept))

    def covers(self, time: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Return at which times, shape (N,), the splines are reliable over a margin on both sides
        [s], shape (N,).
        """
        inside = np.zeros(np.shape(time), bool)
        away = margin + ON_PATH.ends * self.spacing
        for part in self.parts:
            own = time - self.origin
            inside |= (own >= part.t[0] + away) & (own <= part.t[-1] - away)
        return inside

    def at(
        self, time: np.ndarray, order: int = 0, *, offsets: np.ndarray | None = None
    ) -> np.ndarray:
        """Return positions of the joints, or derivatives, shape (N, n), extrapolated at times that
        no part covers.

        Args:
            time: shape (N,) [s].
            order: 0 for positions [rad or m], 1 for velocities, 2 for accelerations, 3 for jerks.
            offsets: times relative to each ``time`` at which to evaluate instead, shape (O,) [s];
                gives (N O, n).
        """
        own = np.asarray(time, float) - self.origin
        if offsets is not None:
            # After subtraction of the origin: rounding of stamps since 1970 to 0.2 us would cause 1
            # m/s^2.
            own = (own[:, None] + offsets).ravel()
        if len(self.parts) == 1:
            return np.asarray(self.parts[0](own, order))
        begins = np.array([part.t[0] for part in self.parts])
        which = np.maximum(np.searchsorted(begins, own, side="right") - 1, 0)
        found = np.empty((len(own), len(self.scatter)))
        for k in np.unique(which):
            found[which == k] = self.parts[k](own[which == k], order)
        return found


def _spline(time: np.ndarray, q: np.ndarray, rate: float) -> BSpline:
    """Return the spline of about ``rate`` knots per second fitted to readings, by banded normal
    equations.
    """
    from scipy.interpolate import BSpline
    from scipy.linalg import solveh_banded

    count = max(int(np.ceil((time[-1] - time[0]) * rate)), 1)
    inner = np.linspace(time[0], time[-1], count + 1)
    knots = np.concatenate([[time[0]] * DEGREE, inner, [time[-1]] * DEGREE])
    size = len(knots) - DEGREE - 1
    bands = np.zeros((DEGREE + 1, size))
    right = np.zeros((size, q.shape[1]))
    # The time of scipy's make_lsq_spline grows with the square of the number of readings.
    for start in range(0, len(time), _PIECE):
        B = BSpline.design_matrix(time[start : start + _PIECE], knots, DEGREE)
        gram = B.T @ B
        for k in range(DEGREE + 1):
            bands[k, : size - k] += gram.diagonal(k)
        right += B.T @ q[start : start + _PIECE]
    bands[0] += _RIDGE * bands[0].max()
    return BSpline(knots, solveh_banded(bands, right, lower=True), DEGREE)


def _stretches(time: np.ndarray, spacing: float) -> Iterator[slice]:
    """Yield the stretches of sufficient length between gaps that no spline can bridge."""
    ends = [0, *(np.flatnonzero(np.diff(time) > ON_PATH.bridged * spacing) + 1).tolist(), len(time)]
    for a, b in pairwise(ends):
        is_long = b - a > 1 and time[b - 1] - time[a] > 2.0 * ON_PATH.ends * spacing
        if is_long and b - a >= ON_PATH.readings_per_knot * (
            (time[b - 1] - time[a]) / spacing + DEGREE
        ):
            yield slice(a, b)


def _chosen_rate(time: np.ndarray, q: np.ndarray) -> float:
    """Return the knots per second that predict left-out readings best."""
    steps = np.diff(time)
    most = 1.0 / (ON_PATH.readings_per_knot * float(np.median(steps)))
    tried = [rate for rate in _TRIED if rate <= most] or [most]
    scores = [_cross_validation(time, q, rate) for rate in tried]
    best = tried[int(np.argmin(scores))]
    if best == tried[-1] < _TRIED[-1]:
        warn(
            f"the joints are logged at {1.0 / float(np.median(steps)):.3g} Hz, too slowly to "
            f"determine the smoothness of their motion; their path has {best:.3g} knots per second"
        )
    return best


def _cross_validation(time: np.ndarray, q: np.ndarray, rate: float) -> float:
    """Return the logarithm of the mean square error of left-out readings, averaged over joints, on
    parts of a log.
    """
    total = 0
    freedom = 0
    squares = np.zeros(q.shape[1])
    for part in _samples(time, 1.0 / rate):
        fit = _spline(time[part], q[part], rate)
        squares += np.sum((q[part] - fit(time[part])) ** 2, axis=0)
        total = total + part.stop - part.start
        freedom = freedom + part.stop - part.start - len(fit.c)
    moves = np.ptp(q, axis=0) > _ROUNDING
    if freedom <= 0 or not moves.any():
        return np.inf
    return float(np.mean(np.log((squares + total * _ROUNDING**2) * total / freedom**2)[moves]))


def _samples(time: np.ndarray, spacing: float) -> Iterator[slice]:
    """Yield parts from the beginning, middle and end of a log, long enough to determine its
    smoothness.
    """
    found = list(_stretches(time, spacing))
    if not found:
        return
    longest = max(found, key=lambda part: part.stop - part.start)
    n = longest.stop - longest.start
    size = min(n, _MOST) // 3
    for middle in (n // 6, n // 2, n - n // 6):
        begin = longest.start + max(middle - size // 2, 0)
        yield slice(begin, min(begin + size, longest.stop))
