"""The one rule by which every verb judges a model: by a noise that the model has no part in, and by what is doubtful."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.special import chdtr, chdtri, fdtr, fdtri

from pincal.notes import Note
from pincal.validate.misfit import MISFIT

TWICE, POWER = 2.0, 0.9
"""Residuals of so many times the noise have to be noticed so surely before "adequate" may be said.

A model then misses 1.7 times as much as the noise, which any plot of the residuals shows. At :data:`MISFIT` that takes 18
degrees of freedom beside a declared noise, and 30 of pure error beside a hundred of the misfit.
"""


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
class Beside:
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
        >>> tells(17.0), tells(18.0), tells(100.0, 29.0), tells(100.0, 30.0)
        (False, True, False, True)
    """
    if degrees <= 0.0 or of_noise <= 0.0:
        return False
    if np.isinf(of_noise):
        missed = chdtr(degrees, chdtri(degrees, MISFIT) / TWICE**2)
    else:
        missed = fdtr(degrees, of_noise, fdtri(degrees, of_noise, 1.0 - MISFIT) / TWICE**2)
    return bool(missed <= 1.0 - POWER)


def judge(
    beside: Beside | None,
    doubts: Sequence[Note] = (),
    *,
    unusable: bool = False,
    left: bool = False,
    few: bool = False,
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
        >>> declared = Beside("the declared noise", 1.01, 0.4)
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
