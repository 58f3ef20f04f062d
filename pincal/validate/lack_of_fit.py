"""Lack of fit against pure error: whether a model misses something, whatever was declared of the noise.

Replicates of one pose differ by what the instrument and the robot do at random, whatever the model is. If poses are off
their predictions by more than that, the model misses something: an F test on the sums of squares (Draper and Smith, Applied
Regression Analysis, 2.1). What a pose means is told in :mod:`pincal.validate.replicates`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import fdtrc

from pincal.identify.normal import accumulate, block_rows
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.units import format_readable
from pincal.validate.replicates import Replicates, groups, iso9283, replicate_groups

MISFIT = 1e-3
"""Chance below which a lack of fit counts as one."""


@dataclass(frozen=True)
class Squares:
    """Squares of residuals in units of the variances, and what visits of one pose differ by among themselves.

    Attributes:
        total: sum of squares.
        readings: number of readings in it.
        pure: sum of squares about the poses' means.
        degrees: its degrees of freedom.
        poses: number of poses visited more than once.
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


def squares_of(visits: Replicates, values: np.ndarray, sigma: np.ndarray) -> Squares:
    """Return the squares of the rows that are no outliers.

    Args:
        visits: rows of one part; visits of a pose in another part are not held against them.
        values: shape (P,).
        sigma: shape (blocks,), standard deviations of one component.
    """
    rows = np.flatnonzero(visits.counted)
    weight = visits.problem.weights[rows] ** 2
    residuals = visits.problem.residuals(values)[:, rows]
    _, pose = np.unique(visits.pose[rows], return_inverse=True)
    count, mass = np.bincount(pose), np.bincount(pose, weight)
    again = count > 1
    degrees = int((count[again] - 1).sum())
    means = np.stack([np.bincount(pose, weight * component) / mass for component in residuals])
    apart = np.sqrt(weight) * (residuals - means[:, pose])
    blocks = block_rows(visits.problem)
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

    With S the covariance in a pose of n = f + 1 > 2 visits, unbiased
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


def lack_of_fit(
    visits: Sequence[Replicates], values: np.ndarray, sigma: np.ndarray, *, spent: float
) -> dict[str, Any] | None:
    r"""Return whether the fitted rows are off by more than visits of the same pose differ by: an F test.

    .. math:: F = \frac{(SS - SS_{pure}) / (N - p - f_{pure})}{SS_{pure} / f_{pure}}

    No declared noise enters, only the ratio of those of position and orientation. Pure error is that of all parts; the
    degrees of freedom are corrected for readings that scatter unevenly, see :func:`evenness`.

    Args:
        visits: the fitted rows, then the held-out ones.
        values: shape (P,), the fit.
        sigma: shape (blocks,), standard deviations that it used.
        spent: number p of parameters that the data pay for.

    Returns:
        What ``result.json`` has under this key: F, its p value and degrees of freedom, their correction, number of poses
        visited more than once, and the standard deviation of one component among visits. None where no pose was visited
        twice, or nothing but rounding is between the visits.
    """
    parts = [squares_of(v, values, sigma) for v in visits]
    fitted = parts[0]
    return _f_test(parts, visits[0].problem, fitted.total - fitted.pure, fitted.readings - spent - fitted.degrees)


def lack_of_prediction(
    visits: Replicates, values: np.ndarray, sigma: np.ndarray, covariance: np.ndarray
) -> dict[str, Any] | None:
    r"""Return the same of rows that the fit has not seen: whether predictions are off by more than they may.

    The residuals' covariance is that of the noise, as large as visits of one pose say, and what the calibration left
    uncertain: :math:`s^2 D + J C J^T`.

    Args:
        visits: the rows.
        values: shape (P,), the calibrated values.
        sigma: shape (blocks,), standard deviations of one component in the calibration; only their ratio counts.
        covariance: shape (P, P), of the values.
    """
    found = squares_of(visits, values, sigma)
    if not _is_enough([found], visits.problem):
        return None
    scale = found.pure / found.degrees
    free = np.diag(covariance) > 0.0
    normal = accumulate(visits.problem, values, free, visits.counted.astype(float))
    G = np.einsum("b,bij->ij", 1.0 / (scale * sigma**2), normal.G)
    g = np.einsum("b,bi->i", 1.0 / (scale * sigma**2), normal.g)
    explained = explained_by_uncertainty(G, g, covariance[np.ix_(free, free)])
    return _f_test([found], visits.problem, found.total - found.pure - scale * explained, found.readings - found.degrees)


def explained_by_uncertainty(G: np.ndarray, g: np.ndarray, covariance: np.ndarray) -> float:
    """Return by how much r' r exceeds r' (1 + J C J')^-1 r, for G = J' J and g = J' r, by Woodbury's identity."""
    size, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    inner = np.eye(len(size)) + root.T @ G @ root
    return float((root.T @ g) @ np.linalg.solve(inner, root.T @ g))


def _is_enough(parts: Sequence[Squares], problem: Station) -> bool:
    """Return whether visits differ by more than rounding."""
    pure = np.sum([part.by_block for part in parts], axis=0)
    sizes = [np.sqrt(squares / degrees) if degrees else 0.0 for squares, degrees in pure]
    return any(size > 10.0 * block.rounding for size, block in zip(sizes, problem.sensor.blocks, strict=True))


def _f_test(parts: Sequence[Squares], problem: Station, misfit: float, degrees: float) -> dict[str, Any] | None:
    if not _is_enough(parts, problem) or degrees < 1.0:
        return None
    free = sum(part.degrees for part in parts)
    ratio = max(misfit, 0.0) / degrees / (sum(part.pure for part in parts) / free)
    even = evenness(np.sum([part.spread for part in parts], axis=0))
    blocks = np.sum([part.by_block for part in parts], axis=0)
    return {
        "F": float(ratio),
        "p_value": float(fdtrc(even * degrees, even * free, ratio)),
        "degrees": {"misfit": float(even * degrees), "pure_error": float(even * free)},
        "evenness": even,
        "poses": sum(part.poses for part in parts),
        "pure_error": {
            f"sigma_{block.unit}": float(np.sqrt(squares / count))
            for block, (squares, count) in zip(problem.sensor.blocks, blocks, strict=True)
        },
    }


def lack_words(found: Mapping[str, Any]) -> str:
    """Return what the test says, in a sentence.

    Example:
        >>> lack_words({"F": 1.02, "p_value": 0.4, "degrees": {"misfit": 60.0, "pure_error": 870.0}})
        'F(60, 870) = 1.02, p 0.4: what is left is no more than visits of one pose differ by'
    """
    degrees = found["degrees"]
    test = f"F({degrees['misfit']:.0f}, {degrees['pure_error']:.0f}) = {found['F']:.3g}, p {found['p_value']:.2g}"
    if found["p_value"] < MISFIT:
        return f"{test}: what is left is more than visits of one pose differ by; the model misses something"
    return f"{test}: what is left is no more than visits of one pose differ by"


def pure_words(found: Mapping[str, Any]) -> str:
    """Return what visits of one pose differ by, in words.

    Example:
        >>> pure_words({"pure_error": {"sigma_m": 5.02e-5, "sigma_rad": 1e-4}, "poses": 8})
        '0.0502 mm and 0.1 mrad per coordinate at 8 poses'
    """
    sizes = [format_readable(sigma, name.removeprefix("sigma_")) for name, sigma in found["pure_error"].items()]
    return f"{' and '.join(sizes)} per coordinate at {found['poses']} poses"


def replicate_statistics(
    problem: Station, values: np.ndarray, table: Measurements, *, sigma: np.ndarray, covariance: np.ndarray
) -> dict[str, Any]:
    """Return what rows that a calibrated model has not seen tell of it, as far as poses were visited more than once.

    Args:
        problem: the calibrated model over the rows.
        values: shape (P,), its values.
        table: the rows.
        sigma: shape (blocks,), noise of one component of each block of readings.
        covariance: shape (P, P), of the values.

    Returns:
        ``iso9283`` and ``lack_of_fit`` as in ``result.json``, those that there are.
    """
    visits = Replicates("test", table, problem, replicate_groups([table])[0], np.ones(len(table), bool))
    found = {
        "iso9283": iso9283([visits], {"calibrated": values}),
        "lack_of_fit": lack_of_prediction(visits, values, sigma, covariance),
    }
    return {name: value for name, value in found.items() if value is not None}
