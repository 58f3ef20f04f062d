"""The numbers by which a calibration decides, each with its unit and where it comes from.

What bounds a computation (rows looked at, steps, rounding) stands where it is used.
"""

from __future__ import annotations

from typing import NamedTuple


class Criteria(NamedTuple):
    """Numbers that decide; chances are between 0 and 1, gains are of twice the log-likelihood.

    Attributes:
        bearing: what a feature of a bearing has to take off the sum of squares [1]: odds of 150 to 1. Of a sound arm's
            twelve one enters in one fit out of fifty.
        moment_frame: by how much another convention of moments has to be likelier [1]: the same odds.
        unexcited: chance that sound data call for a parameter that the nominal geometry never excites.
        outlier: chance that screening takes any sound row of a table for an outlier.
        too_noisy: standard deviations of chi-square by which residuals exceed what declared noise leaves before they replace
            it [1].
        readings_left: readings beyond the unknowns from which the noise is known to 30 %, demanded beside an earlier fit:
            the parameters that it knows give way as far as the noise seems small, and the noise seems small as far as they
            do.
        dependent: standard deviations by which sums of products of residuals exceed those of independent rows before rows
            are taken for dependent [1]: sound tables get there once in 10 000.
        correlated: what correlation along the rows has to gain [1]: two parameters at a chance of 1e-4.
        identified: ratio of posterior to prior standard deviation below which a parameter counts as identified [1]: at 0.5
            the data hold three times the information of the prior (1 / 0.25 - 1).
        narrowed: the same ratio above which the data count as adding nothing [1]: no prior's size is known to 3 %.
        unseen: share in directions that no reading sees above which a parameter is not identifiable by itself [1]: far above
            rounding, far below any share that matters.
        moment: standard deviation over a static moment itself below which it counts as identified [1].
    """

    bearing: float = 10.0
    moment_frame: float = 10.0
    unexcited: float = 1e-6
    outlier: float = 0.01
    too_noisy: float = 4.0
    readings_left: int = 6
    dependent: float = 4.0
    correlated: float = 18.0
    identified: float = 0.5
    narrowed: float = 0.97
    unseen: float = 1e-3
    moment: float = 1.0 / 3.0


CRITERIA = Criteria()
