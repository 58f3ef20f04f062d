"""Readings of an IMU as rows: filtered, with the noise due to vibration at each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pincal.motion.motion_numbers import ON_PATH
from pincal.sensors.imu import Window
from pincal.thresholds import Scale

# Spacing of rows in widths of the window, so that adjacent windows overlap.
APART: Scale = 2.5
# Half length of a window, in widths.
_REACH: Scale = 4.0
# Time over which the vibration level is averaged [s].
_LOCAL: Scale = 1.0


@dataclass(frozen=True)
class ImuRows:
    """N filtered readings.

    Attributes:
        time: middle of each window by the IMU's clock, shape (N,) [s].
        readings: specific force [m/s^2] and angular rate [rad/s], shape (6, N).
        sigma: standard deviation of a component of force and rate by the vibration about each
            window, shape (2, N).
        window: the filter.
    """

    time: np.ndarray
    readings: np.ndarray
    sigma: np.ndarray
    window: Window

    def __len__(self) -> int:
        return len(self.time)

    @classmethod
    def of(
        cls,
        time: np.ndarray,
        force: np.ndarray,
        rate: np.ndarray,
        window: Window,
        *,
        delay: float = 0.0,
    ) -> ImuRows:
        """Filter readings by a Gaussian window about evenly spaced times, without rows in gaps.

        Stamps, shape (T,), increase [s]; those of rates, shape (T, 3) [rad/s], are too early by
        ``delay`` [s] compared with those of forces, shape (T, 3) [m/s^2].
        """
        middles = np.arange(
            time[0] + _REACH * window.width, time[-1] - _REACH * window.width, APART * window.width
        )
        of_force, found = _filters(time, middles, window)
        of_rate = _filters(time + delay, middles, window)[0] if delay else of_force
        rows = np.concatenate([of_force @ force, of_rate @ rate], axis=1)
        noise = [
            _noise(F, time, middles, values, window.width)
            for F, values in ((of_force, force), (of_rate, rate))
        ]
        return cls(middles[found], rows[found].T, np.array(noise)[:, found], window)

    def select(self, rows: np.ndarray) -> ImuRows:
        """Return some of the rows (mask or indices)."""
        return replace(
            self, time=self.time[rows], readings=self.readings[:, rows], sigma=self.sigma[:, rows]
        )


def _filters(time: np.ndarray, middles: np.ndarray, window: Window) -> tuple[Any, np.ndarray]:
    """Return the weights of readings in rows, sparse, shape (N, T), and which rows are outside
    gaps, shape (N,).
    """
    from scipy.sparse import csr_array

    reach = _REACH * window.width
    first = np.searchsorted(time, middles - reach)
    last = np.searchsorted(time, middles + reach)
    count = last - first
    starts = np.concatenate([[0], np.cumsum(count)])
    columns = np.arange(starts[-1]) - np.repeat(starts[:-1] - first, count)
    # Weights of an integral over time, so that stamps may be uneven.
    cells = np.gradient(time) if len(time) > 1 else np.ones(len(time))
    away = (time[columns] - np.repeat(middles, count)) / window.width
    F = csr_array(
        (cells[columns] * np.exp(-0.5 * away**2), columns, starts), shape=(len(middles), len(time))
    )
    # The window has the moments of a Gaussian, so that the mean of a parabola is exact.
    gram = _moments(F, away)
    # There are no weights in a gap; such rows are not returned.
    gram[count < 3] = np.eye(3)
    factors = np.linalg.solve(
        gram + 1e-12 * np.eye(3) * gram[:, :1, :1],
        np.tile([[1.0], [0.0], [1.0]], (len(middles), 1, 1)),
    )
    F.data *= sum(np.repeat(factors[:, k, 0], count) * away**k for k in range(3))
    gaps = np.diff(time, prepend=time[0]) > ON_PATH.window_gap * window.width
    begins = time[:-1][gaps[1:]]
    ends = time[1:][gaps[1:]]
    touched = np.zeros(len(middles), bool)
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        touched |= (middles > begin - 0.5 * reach) & (middles < end + 0.5 * reach)
    return F, ~touched & (count > 2)


def _moments(F: Any, away: np.ndarray) -> np.ndarray:
    """Return sums of weights times powers of the distance from the middle, shape (N, 3, 3)."""
    powers = F.copy()
    sums = []
    for order in range(5):
        powers.data = F.data * away**order
        sums.append(powers.sum(axis=1))
    return np.stack([np.stack(sums[i : i + 3], axis=-1) for i in range(3)], axis=-2)


def _noise(
    F: Any, time: np.ndarray, middles: np.ndarray, values: np.ndarray, width: float
) -> np.ndarray:
    """Return the standard deviation of rows by the scatter about a parabola in each window, shape
    (N,).
    """
    away = (time[F.indices] - np.repeat(middles, np.diff(F.indptr))) / width
    powers = F.copy()
    along = []
    gram = _moments(F, away)
    for order in range(3):
        powers.data = F.data * away**order
        along.append(powers @ values)
    moments = np.stack(along, axis=1)
    # A parabola is not determined in a window of few readings.
    solved = np.linalg.solve(gram + 1e-9 * np.eye(3), moments)
    variance = np.maximum(F @ values**2 - np.sum(moments * solved, axis=1), 0.0).mean(axis=1)
    powers.data = F.data**2
    share = powers.sum(axis=1)
    # Share of white noise that the parabola absorbs: the mean of 1 + t^2 + (t^2 - 1)^2 / 2 over the
    # squared window.
    variance /= np.maximum(1.0 - 1.875 * share, 0.1)
    return np.asarray(np.sqrt(_local_mean(variance, _LOCAL / (APART * width)) * share))


def _local_mean(values: np.ndarray, rows: float) -> np.ndarray:
    """Return means over so many rows about each, fewer at the ends and in a shorter log, shape
    (N,).
    """
    half = int(rows / 2.0)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    at = np.arange(len(values))
    begin = np.maximum(at - half, 0)
    end = np.minimum(at + half + 1, len(values))
    return np.asarray((sums[end] - sums[begin]) / (end - begin))
