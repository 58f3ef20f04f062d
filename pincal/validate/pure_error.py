"""Pure error: what replicates of a pose differ by among themselves, as sums of squares with degrees of freedom."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.identify.normal import block_rows
from pincal.validate.replicates import Replicates, groups


@dataclass(frozen=True)
class Squares:
    """Sums of squared residuals in units of the variances, and of the differences between replicates.

    Attributes:
        total: sum of squares.
        readings: number of readings in it.
        pure: sum of squares about the poses' means.
        degrees: its degrees of freedom.
        poses: number of poses with replicates.
        by_block: shape (blocks, 2), ``pure``, in the units of the readings, and ``degrees`` of each block.
        spread: of :func:`spread_of`.
    """

    total: float
    readings: int
    pure: float
    degrees: int
    poses: int
    by_block: np.ndarray
    spread: np.ndarray


def squares_of(rows_of: Replicates, values: np.ndarray, sigma: np.ndarray) -> Squares:
    """Return the squares of the rows that are no outliers.

    Args:
        rows_of: rows of one part; replicates of a pose in another part are not compared with them.
        values: shape (P,).
        sigma: shape (blocks,), standard deviations of one component.
    """
    rows = np.flatnonzero(rows_of.counted)
    weight = rows_of.station.weights[rows] ** 2
    residuals = rows_of.station.residuals(values)[:, rows]
    _, pose = np.unique(rows_of.pose[rows], return_inverse=True)
    count, mass = np.bincount(pose), np.bincount(pose, weight)
    again = count > 1
    degrees = int((count[again] - 1).sum())
    means = np.stack([np.bincount(pose, weight * component) / mass for component in residuals])
    apart = np.sqrt(weight) * (residuals - means[:, pose])
    blocks = block_rows(rows_of.station)
    by_block = np.array([((apart[b][:, again[pose]] ** 2).sum(), degrees * (b.stop - b.start)) for b in blocks])
    scale = np.repeat(sigma, [b.stop - b.start for b in blocks])[:, None]
    return Squares(
        total=float((weight * (residuals / scale) ** 2).sum()),
        readings=residuals.size,
        pure=float((by_block[:, 0] / sigma**2).sum()),
        degrees=int(by_block[:, 1].sum()),
        poses=int(again.sum()),
        by_block=by_block,
        spread=spread_of(apart / scale, pose),
    )


def spread_of(apart: np.ndarray, pose: np.ndarray) -> np.ndarray:
    r"""Return what says how evenly readings scatter over poses and components, to be added over tables.

    With S the covariance in a pose of n = f + 1 > 2 replicates, unbiased
    :math:`\widehat{tr \Sigma^2} = \frac{f^2}{(f - 1)(f + 2)} (tr S^2 - (tr S)^2 / f)`.

    Args:
        apart: shape (m, N), differences from the poses' means.
        pose: shape (N,), numbers of the poses.

    Returns:
        Sums over the poses of tr S, of the estimate of tr Sigma^2, of the variance of tr S, and of m; shape (4,).
    """
    sums = np.zeros(4)
    for rows in groups(pose):
        f = len(rows) - 1
        if f > 1:
            S = apart[:, rows] @ apart[:, rows].T / f
            square = f**2 / ((f - 1.0) * (f + 2.0)) * (np.sum(S * S) - np.trace(S) ** 2 / f)
            sums += [np.trace(S), square, 2.0 * square / f, len(S)]
    return sums


def evenness(spread: np.ndarray) -> float:
    """Return the factor on the degrees of freedom of sums of squares of readings that scatter unevenly or together.

    A robot scatters more where it is stretched out, and its errors in x, y and z go together; sums of squares then vary
    more than those of independent readings (Box, Ann. Math. Stat. 25, 1954, Eq. 3.1).

    Args:
        spread: shape (4,), sums of :func:`spread_of`.

    Returns:
        1 where all readings scatter alike and each by itself, down to 1 / readings.
    """
    trace, square, variance, readings = spread
    if square <= 0.0:
        return 1.0
    return float(np.clip((trace**2 - variance) / (readings * square), 1.0 / readings, 1.0))
