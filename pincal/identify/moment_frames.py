"""Which convention of where moments bend the arm the data prefer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pincal.identify.fit import Fit
from pincal.identify.noise import outlier_limit
from pincal.model.chain import MomentFrame

# Difference of -2 log likelihood from which another convention of moments counts as better (odds of 150 to 1).
FRAME_BETTER = 10.0
# Rows from which it is chosen: conventions differ by more than these could miss, or by nothing that matters.
_ENOUGH = 2000


def some_rows_of(fit: Fit) -> Fit:
    """Return a fit as it is, of as many of its rows, evenly spread, as are enough to choose a convention by."""
    n = len(fit.problem)
    if n <= _ENOUGH:
        return fit
    rows = np.linspace(0, n - 1, _ENOUGH).astype(int)
    solution = replace(fit.solution, weights=fit.solution.weights[rows])
    return replace(fit, problem=fit.problem.select(rows), solution=solution)


def best_of(fits: Sequence[Fit]) -> MomentFrame:
    """Return the convention of the fit that leaves least; that of the first unless another is better beyond chance.

    Conventions may have more parameters than others, which are counted by Akaike's criterion.
    """
    misfits = [misfit(fit) + 2.0 * fit.solution.effective for fit in fits]
    best = int(np.argmin(misfits))
    return fits[best if misfits[best] < misfits[0] - FRAME_BETTER else 0].problem.chain.moment_frame


def misfit(fit: Fit) -> float:
    """Return -2 log likelihood, up to a constant; an outlier counts as a row at the edge of the noise."""
    found = 0.0
    for (station, _, blocks), rows in zip(fit.stations, fit.problem.rows, strict=True):
        n, sizes = len(station), [block.size for block in station.sensor.blocks]
        outliers = int(np.sum(fit.solution.weights[rows] == 0.0))
        spread = float(np.dot(sizes, np.log(fit.solution.estimated[blocks])))
        found += 2.0 * n * spread + outliers * outlier_limit(n, sum(sizes))
    return found
