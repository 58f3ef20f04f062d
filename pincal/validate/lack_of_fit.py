"""Lack of fit against pure error: whether a model is incomplete, independently of the declared
noise.

Replicates of a pose differ by the random errors of instrument and robot, whatever the model. If
residuals exceed that scatter, the model is incomplete: an F test on the sums of squares (Draper and
Smith, Applied Regression Analysis, 2.1).
:mod:`pincal.validate.accuracy` defines which rows are replicates of one pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import fdtr, fdtrc

from pincal.errors import counted
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.measure.poses import replicate_groups
from pincal.units import format_readable, show_chance
from pincal.validate.accuracy import Replicates, groups, iso9283
from pincal.validate.misfit import MISFIT, NoiseTest, is_informative, misfit_at
from pincal.validate.validation_numbers import JUDGEMENT


@dataclass(frozen=True)
class Degrees:
    """Effective degrees of freedom.

    Attributes:
        misfit: of the means of the poses about the model.
        pure_error: of the replicates about these means.
    """

    misfit: float
    pure_error: float


@dataclass(frozen=True)
class LackOfFit:
    """Outcome of the F test of lack of fit; ``str()`` gives it in words. The fields are those of
    ``result.json``.

    Attributes:
        F: mean square of the misfit over that of the pure error.
        p_value: probability of an F as large if the model is complete.
        degrees: effective degrees of freedom, corrected for uneven scatter.
        evenness: that correction, see :func:`evenness`.
        poses: number of poses with replicates.
        pure_error: standard deviation of one component between replicates, by block of readings
            ("sigma_m" [m], ...).

    Example:
        >>> str(LackOfFit(1.02, 0.4, Degrees(60.0, 870.0), 1.0, 8, {"sigma_m": 5.02e-5}))
        'F(60, 870) = 1.02, p 0.4: the residuals are within the scatter between replicates'
    """

    F: float
    p_value: float
    degrees: Degrees
    evenness: float
    poses: int
    pure_error: Mapping[str, float]

    @property
    def is_significant(self) -> bool:
        """Whether the model is incomplete."""
        return self.p_value < MISFIT

    def __str__(self) -> str:
        test = (
            f"F({self.degrees.misfit:.0f}, {self.degrees.pure_error:.0f}) = {self.F:.3g}, p "
            f"{show_chance(self.p_value)}"
        )
        if self.is_significant:
            return (
                f"{test}: the residuals exceed the scatter between replicates; the model is "
                "incomplete"
            )
        return f"{test}: the residuals are within the scatter between replicates"

    def is_too_small(self, together: float = 1.0) -> bool:
        """Return whether replicates scatter by more than the means of poses about the model allow,
        as after a change.

        ``together`` is the number of stops over that of readings: those of one stop share its
        arrival.
        """
        of_misfit = together * self.degrees.misfit
        of_replicates = together * self.degrees.pure_error
        return bool(fdtr(of_misfit, of_replicates, self.F) < MISFIT)

    @property
    def noise_test(self) -> NoiseTest | None:
        """The residuals compared with the scatter between replicates; None if the degrees of
        freedom are too few.
        """
        if not is_informative(self.degrees.misfit, self.degrees.pure_error):
            return None
        return NoiseTest(
            "the scatter between repeated measurements of a pose", self.F**0.5, self.p_value
        )

    @property
    def scatter(self) -> str:
        """The scatter between replicates of a pose in words."""
        sizes = [
            format_readable(sigma, name.removeprefix("sigma_"))
            for name, sigma in self.pure_error.items()
        ]
        return f"{' and '.join(sizes)} per coordinate at {counted(self.poses, 'pose')}"


def lack_of_fit(
    parts: Sequence[Replicates], values: np.ndarray, sigma: np.ndarray, *, spent: float
) -> LackOfFit | None:
    r"""Test whether the residuals of the fitted rows exceed the scatter between replicates: an F
    test.

    .. math:: F = \frac{(SS - SS_{pure}) / (N - p - f_{pure})}{SS_{pure} / f_{pure}}

    Declared noise does not enter, only the ratio of position and orientation noise. Pure error is
    pooled over all parts; the degrees of freedom are corrected by :func:`evenness`.

    Args:
        parts: the fitted rows, then the held-out ones.
        values: shape (P,), the fit.
        sigma: shape (blocks,), standard deviations that it used.
        spent: effective number p of parameters.

    Returns:
        The outcome; None where no pose has replicates, or they differ by no more than rounding.
    """
    squares = [replicate_squares(part, values, sigma) for part in parts]
    fitted = squares[0]
    return _f_test(
        squares,
        parts[0].station,
        fitted.total - fitted.pure,
        fitted.readings - spent - fitted.degrees,
    )


def _is_enough(parts: Sequence[ReplicateSquares], station: Station) -> bool:
    """Return whether replicates differ by more than rounding."""
    pure = np.sum([part.by_block for part in parts], axis=0)
    sizes = [np.sqrt(squares / degrees) if degrees else 0.0 for squares, degrees in pure]
    return any(
        size > JUDGEMENT.rounding * block.rounding
        for size, block in zip(sizes, station.sensor.blocks, strict=True)
    )


def _f_test(
    parts: Sequence[ReplicateSquares], station: Station, misfit: float, degrees: float
) -> LackOfFit | None:
    if not _is_enough(parts, station) or degrees < 1.0:
        return None
    free = sum(part.degrees for part in parts)
    ratio = max(misfit, 0.0) / degrees / (sum(part.pure for part in parts) / free)
    even = evenness(np.sum([part.spread for part in parts], axis=0))
    blocks = np.sum([part.by_block for part in parts], axis=0)
    return LackOfFit(
        F=float(ratio),
        p_value=float(fdtrc(even * degrees, even * free, ratio)),
        degrees=Degrees(float(even * degrees), float(even * free)),
        evenness=even,
        poses=sum(part.poses for part in parts),
        pure_error={
            f"sigma_{block.unit}": float(np.sqrt(squares / count))
            for block, (squares, count) in zip(station.sensor.blocks, blocks, strict=True)
        },
    )


def replicate_statistics(
    station: Station,
    values: np.ndarray,
    table: Measurements,
    *,
    sigma: np.ndarray,
    covariance: np.ndarray,
    found: np.ndarray | None = None,
    pose: np.ndarray | None = None,
) -> tuple[dict[str, Any] | None, LackOfFit | None]:
    r"""Return accuracy, repeatability and lack of fit of rows that were not fitted, where they
    contain replicates.

    The test is whether residuals exceed what noise and calibration uncertainty allow: their
    covariance is that of the noise, estimated from the replicates, plus that of the calibrated
    values, :math:`s^2 D + J C J^T`.

    Args:
        station: the calibrated model over the rows.
        values: shape (P,), its values.
        table: the rows, the mean of each stop.
        sigma: shape (blocks,), standard deviations of one component in the calibration; only their
            ratio counts.
        covariance: shape (P, P), of the values.
        found: shape (P,), parameters that were estimated from these rows; default: none.
        pose: shape (N,), number of each row's pose and target; default: rows with the same joints,
            target and load.

    Returns:
        ``iso9283`` as in ``result.json``, and the test of lack of fit; None where rows do not
        determine them.
    """
    pose = replicate_groups([table])[0] if pose is None else pose
    rows_of = Replicates("test", table, station, pose, np.ones(len(table), bool))
    lack = None
    squares = replicate_squares(rows_of, values, sigma)
    if _is_enough([squares], station):
        scale = squares.pure / squares.degrees
        everything = np.ones(len(table))
        noise = sigma * np.sqrt(scale)
        left = misfit_at(
            station, values, covariance=covariance, found=found, sigma=noise, robust=everything
        )
        degrees = squares.readings - left.found - squares.degrees
        lack = _f_test([squares], station, scale * left.square - squares.pure, degrees)
    return iso9283([rows_of], {"calibrated": values}), lack


@dataclass(frozen=True)
class ReplicateSquares:
    """Sums of squared residuals in units of the variances, and of the differences between
    replicates.

    Attributes:
        total: sum of squares.
        readings: number of readings in it.
        pure: sum of squares about the poses' means.
        degrees: its degrees of freedom.
        poses: number of poses with replicates.
        by_block: shape (blocks, 2), ``pure``, in the units of the readings, and ``degrees`` of each
            block.
        spread: from :func:`scatter_of`.
    """

    total: float
    readings: int
    pure: float
    degrees: int
    poses: int
    by_block: np.ndarray
    spread: np.ndarray


def replicate_squares(
    rows_of: Replicates, values: np.ndarray, sigma: np.ndarray
) -> ReplicateSquares:
    """Return the squares of the rows that are no outliers; replicates in other parts are not
    compared with them.

    ``sigma``, shape (blocks,), are standard deviations of one component.
    """
    rows = np.flatnonzero(rows_of.counted)
    weight = rows_of.station.weights[rows] ** 2
    residuals = rows_of.station.residuals(values)[:, rows]
    _, pose = np.unique(rows_of.pose[rows], return_inverse=True)
    count = np.bincount(pose)
    mass = np.bincount(pose, weight)
    again = count > 1
    degrees = int((count[again] - 1).sum())
    means = np.stack([np.bincount(pose, weight * component) / mass for component in residuals])
    apart = np.sqrt(weight) * (residuals - means[:, pose])
    blocks = rows_of.station.block_rows
    by_block = np.array(
        [((apart[b][:, again[pose]] ** 2).sum(), degrees * (b.stop - b.start)) for b in blocks]
    )
    scale = np.repeat(sigma, [b.stop - b.start for b in blocks])[:, None]
    return ReplicateSquares(
        total=float((weight * (residuals / scale) ** 2).sum()),
        readings=residuals.size,
        pure=float((by_block[:, 0] / sigma**2).sum()),
        degrees=int(by_block[:, 1].sum()),
        poses=int(again.sum()),
        by_block=by_block,
        spread=scatter_of(apart / scale, pose),
    )


def scatter_of(apart: np.ndarray, pose: np.ndarray) -> np.ndarray:
    r"""Return statistics of how evenly readings scatter over poses and components, to be added over
    tables.

    With S the covariance in a pose of n = f + 1 > 2 replicates, unbiased
    :math:`\widehat{tr \Sigma^2} = \frac{f^2}{(f - 1)(f + 2)} (tr S^2 - (tr S)^2 / f)`.

    Args:
        apart: shape (m, N), differences from the poses' means.
        pose: shape (N,), numbers of the poses.

    Returns:
        Sums over the poses of tr S, of the estimate of tr Sigma^2, of the variance of tr S, and of
        m; shape (4,).
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
    """Return the factor on the degrees of freedom of sums of squares of readings that scatter
    unevenly or are correlated.

    A robot scatters more where it is stretched out, and its errors in x, y and z are correlated;
    sums of squares then vary more than those of independent readings (Box, Ann. Math. Stat. 25,
    1954, Eq. 3.1). The factor is 1 if readings are independent with equal variances, down to 1 /
    readings.

    Args:
        spread: shape (4,), sums of :func:`scatter_of`.
    """
    trace, square, variance, readings = spread
    if square <= 0.0:
        return 1.0
    return float(np.clip((trace**2 - variance) / (readings * square), 1.0 / readings, 1.0))
