r"""Misfit of readings to a model, compared with noise and the calibration's uncertainty, and the
verdict that follows.

With residuals r of rows that the calibration did not use, weights W by the noise, Jacobians R and F
with respect to parameters known with covariance C and to those estimated from these rows,

.. math:: \chi^2 = r^T V^{-1} r, \quad V = W^{-1} + R C R^T, \quad F \text{ projected out,}

follows the chi-square distribution if the model is complete. It follows from the same A and b as a
station's part of a joint fit, see :mod:`pincal.identify.posterior`.

Every command judges a model by one rule, :func:`judge`: by a noise that does not depend on the
model, and by reservations.
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
from pincal.validate.validation_numbers import JUDGEMENT

MISFIT = JUDGEMENT.misfit
"""Significance level at which residuals count as too large for the noise."""
SURE = JUDGEMENT.sure
"""Fraction of the subsamples of a search in which a name has to occur to be more than a hint."""
TWICE = JUDGEMENT.twice
POWER = JUDGEMENT.power
"""Power with which residuals of this multiple of the noise have to be detected for the verdict
"adequate".
"""


@dataclass(frozen=True)
class Misfit:
    """Misfit of a model to rows that its calibration did not use, all squares in units of the
    noise.

    Attributes:
        square: chi-square, the calibration's uncertainty accounted for.
        plain: sum of squared residuals.
        expected: its expectation for noise and the calibration's uncertainty alone.
        degrees: degrees of freedom of both.
        found: number of directions estimated from the same rows.
        systematic: fraction of the noise's squares that is probably model error: noise was
            estimated from residuals, and good instruments have less.
    """

    square: float
    plain: float
    expected: float
    degrees: int
    found: int
    systematic: float = 0.0

    @property
    def ratio(self) -> float:
        """Residuals relative to their expectation, root mean square; 1 without degrees
        of freedom.
        """
        return float(np.sqrt(self.plain / self.expected)) if self.degrees else 1.0

    @property
    def allowed(self) -> float:
        """Expected residuals in units of the noise, root mean square."""
        return float(np.sqrt(self.expected / self.degrees)) if self.degrees else 1.0

    @property
    def p_value(self) -> float:
        """Probability of a chi-square as large for noise and the calibration's
        uncertainty alone.
        """
        return float(chdtrc(self.degrees, self.square)) if self.degrees else 1.0

    @property
    def is_significant(self) -> bool:
        """Whether noise and the calibration's uncertainty do not explain the residuals."""
        return self.p_value < MISFIT

    def is_far(self, factor: float = 1.0) -> bool:
        """Return whether the misfit exceeds that of an unchanged robot by a factor."""
        return self.is_significant and self.ratio > factor * JUDGEMENT.far


def has_moved(before: Misfit, after: Misfit) -> bool:
    """Return whether rows require another placement of instrument and targets.

    Args:
        before: the misfit of the rows to the calibrated station.
        after: the misfit with the placement estimated from the rows.
    """
    # A field over the poses, not scatter from row to row.
    field = after.systematic * after.degrees + max(after.square - after.degrees, 0.0)
    gain = (
        before.square - after.square - JUDGEMENT.matters * after.degrees - JUDGEMENT.local * field
    )
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
        covariance: shape (P, P), prior covariance of the parameters; zero for exact ones.
        sigma: shape (blocks,), standard deviation of one component of each block of readings.
        robust: shape (N,), 0 for excluded rows.
        found: shape (P,), parameters estimated from these rows, whose covariance is ignored;
            default: none.
    """
    found = np.zeros(len(values), bool) if found is None else found
    free = found | (np.diag(covariance) > 0.0)
    normal = accumulate(station, values, free, robust)
    readings = station.reading_size * int(np.sum(robust > 0.0))
    squares = float(np.sum(normal.squares.blocks / sigma**2))
    if normal.believed is not None and found.any():
        # The sensor's knowledge of its own parameters counts as readings where these are estimated.
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
    """Return by how much r' r exceeds r' (1 + J C J')^-1 r, for H = J' J and g = J' r, by
    Woodbury's identity.
    """
    size, axes = np.linalg.eigh(covariance)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    inner = np.eye(len(size)) + root.T @ form.H @ root
    return float((root.T @ form.g) @ np.linalg.solve(inner, root.T @ form.g))


class Verdict(StrEnum):
    """Whether a model explains the data down to their noise; the values are those of the files and
    of the report.
    """

    ADEQUATE = "adequate"
    NOT_ADEQUATE = "not adequate"
    NOT_JUDGED = "not judged"


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the joint verdict on several: the worst of them.

    Example:
        >>> worst([Verdict.ADEQUATE, Verdict.NOT_JUDGED]).value
        'not judged'
    """
    order = (Verdict.NOT_ADEQUATE, Verdict.NOT_JUDGED, Verdict.ADEQUATE)
    return min(verdicts, key=order.index, default=Verdict.NOT_JUDGED)


@dataclass(frozen=True)
class NoiseTest:
    """Residuals compared with a noise known without the model: declared, or from poses that were
    measured again.

    Attributes:
        noise: which noise, in words.
        ratio: root mean square of the residuals over the noise.
        p_value: probability of residuals as large if the model is complete.
    """

    noise: str
    ratio: float
    p_value: float

    @property
    def is_misfit(self) -> bool:
        """Whether the residuals are larger than the noise allows."""
        return self.p_value < MISFIT


def is_informative(degrees: float, of_noise: float = np.inf) -> bool:
    """Return whether a test at :data:`MISFIT` with these degrees of freedom detects residuals of
    twice the noise.

    ``of_noise`` are the degrees of freedom of the noise; infinite for a declared one.

    Example:
        >>> is_informative(1e-6), is_informative(17.0), is_informative(18.0)
        (False, False, True)
        >>> is_informative(100.0, 29.0), is_informative(100.0, 30.0)
        (False, True)
    """
    # For a small fraction of a degree a quantile underflows to zero, and the power would seem to be
    # 1.
    if degrees < 1.0 or of_noise < 1.0:
        return False
    if np.isinf(of_noise):
        missed = chdtr(degrees, chdtri(degrees, MISFIT) / TWICE**2)
    else:
        missed = fdtr(degrees, of_noise, fdtri(degrees, of_noise, 1.0 - MISFIT) / TWICE**2)
    return bool(missed <= 1.0 - POWER)


def judge(
    noise_test: NoiseTest | None,
    doubts: Sequence[Note] = (),
    *,
    unusable: bool = False,
    incomplete: bool = False,
    few: bool = False,
) -> Verdict:
    """Return the verdict on a model.

    It is "adequate" only if its residuals agree with a known noise, there are enough poses, and
    there is no reservation. Without a known noise, or with too few poses, nothing can speak for it,
    but something may speak against it.

    Args:
        noise_test: the residuals compared with a noise known without the model; None without any.
        doubts: reservations about the result.
        unusable: whether one of them makes it unusable.
        incomplete: whether there is a significant model error, whatever the size of the residuals.
        few: whether there are too few poses for the test, see :func:`is_informative`.

    Example:
        >>> declared = NoiseTest("the declared noise", 1.01, 0.4)
        >>> judge(declared).value, judge(declared, few=True).value
        ('adequate', 'not judged')
        >>> judge(None).value, judge(None, incomplete=True).value
        ('not judged', 'not adequate')
    """
    if unusable or incomplete or (noise_test is not None and noise_test.is_misfit):
        return Verdict.NOT_ADEQUATE
    if few:
        return Verdict.NOT_JUDGED
    if doubts:
        return Verdict.NOT_ADEQUATE
    return Verdict.NOT_JUDGED if noise_test is None else Verdict.ADEQUATE
