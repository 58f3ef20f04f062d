r"""How far readings are from a model, against what noise and the calibration's own uncertainty allow, and what that says.

With residuals r of rows that the calibration did not use, weights W by the noise, Jacobians R and F by the parameters that
are known with covariance C and by those that are found from the very rows,

.. math:: \chi^2 = r^T V^{-1} r, \quad V = W^{-1} + R C R^T, \quad F \text{ projected out,}

follows the chi-square distribution if the robot is what the model says. It follows from the same A and b as a station's part
of a joint fit, see :mod:`pincal.identify.posterior`.

Every verb judges a model by one rule, :func:`judge`: by a noise that the model has no part in, and by what is doubtful.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.special import chdtr, chdtrc, chdtri, fdtr, fdtrc, fdtri

from pincal.identify.normal import accumulate
from pincal.identify.posterior import eliminate
from pincal.identify.quadratic import Form
from pincal.identify.station import Station
from pincal.notes import Note

MISFIT = 1e-3
"""Significance level at which residuals count as too large for the noise, in every test of this kind.

One false alarm in a thousand calibrations. tests/test_replicates.py checks level and power of the test for lack of fit.
"""
# What real arms leave on another day, in units of what noise and uncertainty allow: a UR10 discovered in one month leaves
# 1.7 times as much in the next. Beyond this, something else is at work.
_FAR = 5.0
# Part of the squares by which a station must fit better elsewhere for the move to matter: a tenth in the error.
_MATTERS = 0.2
# What an arm leaves beside noise is a field over the poses. A few rows in a corner of the workspace may call for another
# place to explain it, by so many times its square: in blocks of 12 to 400 rows of a UR10 under its geometry up to 2.2.
_LOCAL = 3.0


SURE = 0.6
"""Part of the subsamples of a search, half of the poses each, in which a name has to come up to be more than a hint.

``tests/stability_study.py`` draws how many of the names that come up so often are right.
"""
TWICE, POWER = 2.0, 0.9
"""Residuals of so many times the noise have to be noticed so surely before "adequate" may be said.

A model then misses 1.7 times as much as the noise, which any plot of the residuals shows. At :data:`MISFIT` that takes 18
degrees of freedom beside a declared noise, and 30 of pure error beside a hundred of the misfit.
"""


@dataclass(frozen=True)
class Misfit:
    """Misfit of a model to rows that its calibration did not use, all squares in units of the noise.

    Attributes:
        square: chi-square with the calibration's uncertainty allowed for.
        plain: sum of squared residuals.
        expected: what that is on average if noise and the calibration's uncertainty are all there is.
        degrees: degrees of freedom of both.
        found: number of directions that were found from the very rows.
        systematic: part of the noise's squares that is probably none, but what the model leaves: noise was estimated from
            residuals, and good instruments have less.
    """

    square: float
    plain: float
    expected: float
    degrees: int
    found: int
    systematic: float = 0.0

    @property
    def ratio(self) -> float:
        """Residuals over what is expected of them, root mean square; 1 where no row is left to judge by."""
        return float(np.sqrt(self.plain / self.expected)) if self.degrees else 1.0

    @property
    def allowed(self) -> float:
        """What is expected of residuals in units of the noise, root mean square."""
        return float(np.sqrt(self.expected / self.degrees)) if self.degrees else 1.0

    @property
    def p_value(self) -> float:
        """Probability of a chi-square as large if noise and the calibration's uncertainty are all there is."""
        return float(chdtrc(self.degrees, self.square)) if self.degrees else 1.0

    @property
    def is_significant(self) -> bool:
        """Whether there is more than noise and the calibration's uncertainty."""
        return self.p_value < MISFIT

    def is_far(self, factor: float = 1.0) -> bool:
        """Return whether there is more, by a factor, than a robot leaves that is still as it was calibrated."""
        return self.is_significant and self.ratio > factor * _FAR


def has_moved(before: Misfit, after: Misfit) -> bool:
    """Return whether rows call for another place of instrument and targets.

    Args:
        before: the misfit of the rows to the calibrated station.
        after: the same with its place found from the rows.
    """
    # A field over the poses, not scatter from row to row.
    field = after.systematic * after.degrees + max(after.square - after.degrees, 0.0)
    gain = before.square - after.square - _MATTERS * after.degrees - _LOCAL * field
    scale = max(after.square / max(after.degrees, 1), 1.0)
    more = max(after.found - before.found, 1)
    return bool(fdtrc(more, max(after.degrees, 1), max(gain, 0.0) / more / scale) < MISFIT)


def misfit_at(
    station: Station,
    values: np.ndarray,
    *,
    covariance: np.ndarray,
    sigma: np.ndarray,
    robust: np.ndarray,
    found: np.ndarray | None = None,
) -> Misfit:
    """Return the misfit of a calibrated model to rows that its calibration did not use.

    Args:
        station: model and readings.
        values: shape (P,).
        covariance: shape (P, P), of what is known of the parameters from elsewhere; zero for those that are exact.
        sigma: shape (blocks,), standard deviation of one component of each block of readings.
        robust: shape (N,), 0 for rows that are left out.
        found: shape (P,), parameters that were found from these rows, whose covariance does not count; default: none.
    """
    found = np.zeros(len(values), bool) if found is None else found
    free = found | (np.diag(covariance) > 0.0)
    normal = accumulate(station, values, free, robust)
    readings = station.reading_size * int(np.sum(robust > 0.0))
    squares = float(np.sum(normal.squares.blocks / sigma**2))
    if normal.believed is not None and found.any():
        # What the sensor knows of its own parameters counts as readings where these are found.
        facts = station.sensor.constraints(station.split(values)[1])
        squares += normal.believed.square
        readings += 0 if facts is None else len(facts.residuals)
    else:
        normal = replace(normal, believed=None)
    form = normal.at(sigma)
    sizes = np.array([parameter.size for parameter in station.parameters])[free]
    left, own = eliminate(form, found[free], sizes, values[free])
    directions = own.alone.visible_rank
    plain = squares - float(own.alone.form.g @ own.alone.step)
    known = free & ~found
    C = covariance[np.ix_(known, known)]
    degrees = max(readings - directions, 0)
    size, noise = np.array([(block.size, block.noise) for block in station.sensor.blocks]).T
    return Misfit(
        square=max(plain - explained_by_uncertainty(left, C), 0.0),
        plain=max(plain, 0.0),
        expected=degrees + float(np.sum(C * left.H)),
        degrees=degrees,
        found=directions,
        systematic=float(np.average(np.maximum(1.0 - (noise / sigma) ** 2, 0.0), weights=size)),
    )


def explained_by_uncertainty(form: Form, covariance: np.ndarray) -> float:
    """Return by how much r' r exceeds r' (1 + J C J')^-1 r, for H = J' J and g = J' r, by Woodbury's identity."""
    size, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    inner = np.eye(len(size)) + root.T @ form.H @ root
    return float((root.T @ form.g) @ np.linalg.solve(inner, root.T @ form.g))


class Verdict(StrEnum):
    """Whether a model explains the data down to their noise; the values are those of the files and of the report."""

    ADEQUATE = "adequate"
    NOT_ADEQUATE = "not adequate"
    NOT_JUDGED = "not judged"


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the verdict on several together: none is better than the worst.

    Example:
        >>> worst([Verdict.ADEQUATE, Verdict.NOT_JUDGED]).value
        'not judged'
    """
    order = (Verdict.NOT_ADEQUATE, Verdict.NOT_JUDGED, Verdict.ADEQUATE)
    return min(verdicts, key=order.index, default=Verdict.NOT_JUDGED)


@dataclass(frozen=True)
class NoiseTest:
    """Residuals beside a noise that is known without the model: declared, or from poses that were measured again.

    Attributes:
        noise: which noise, in words.
        ratio: root mean square of the residuals over the noise.
        p_value: chance of residuals as large if the model is complete.
    """

    noise: str
    ratio: float
    p_value: float

    @property
    def is_misfit(self) -> bool:
        """Whether the residuals are larger than the noise allows."""
        return self.p_value < MISFIT


def tells(degrees: float, of_noise: float = np.inf) -> bool:
    """Return whether so many degrees of freedom notice residuals of twice the noise, by a test at :data:`MISFIT`.

    Args:
        degrees: of the residuals.
        of_noise: of the noise; infinite for a declared one.

    Example:
        >>> tells(1e-6), tells(17.0), tells(18.0), tells(100.0, 29.0), tells(100.0, 30.0)
        (False, False, True, False, True)
    """
    # Of a small part of one degree a quantile is zero in a float, so that nothing would be missed.
    if degrees < 1.0 or of_noise < 1.0:
        return False
    if np.isinf(of_noise):
        missed = chdtr(degrees, chdtri(degrees, MISFIT) / TWICE**2)
    else:
        missed = fdtr(degrees, of_noise, fdtri(degrees, of_noise, 1.0 - MISFIT) / TWICE**2)
    return bool(missed <= 1.0 - POWER)


def judge(
    beside: NoiseTest | None, doubts: Sequence[Note] = (), *, unusable: bool = False, left: bool = False, few: bool = False
) -> Verdict:
    """Return what is to be said of a model.

    It is "adequate" only if its residuals are those of a known noise, enough poses say so, and nothing is doubtful. Without
    a known noise, or with too few poses, nothing can be said for it, but something may speak against it.

    Args:
        beside: the residuals beside a noise that is known without the model; None without any.
        doubts: what makes the result doubtful.
        unusable: whether one of them says that it is none.
        left: whether something is left that is no noise, whatever the size of the residuals.
        few: whether the poses are too few for the residuals to tell, see :func:`tells`.

    Example:
        >>> declared = NoiseTest("the declared noise", 1.01, 0.4)
        >>> judge(declared).value, judge(declared, few=True).value, judge(None).value, judge(None, left=True).value
        ('adequate', 'not judged', 'not judged', 'not adequate')
    """
    if unusable or left or (beside is not None and beside.is_misfit):
        return Verdict.NOT_ADEQUATE
    if few:
        return Verdict.NOT_JUDGED
    if doubts:
        return Verdict.NOT_ADEQUATE
    return Verdict.NOT_JUDGED if beside is None else Verdict.ADEQUATE
