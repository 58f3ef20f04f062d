"""How a calibration decides: one search for what data call for, and the numbers by which it does.

Candidates are scored, the best is taken in if it is enough, the rest scored beside it. What is searched differs in its
candidates, in what each costs (what it takes off the squares against what its parameters cost, or the chance of as large a
gain), and in how one is taken in: by releasing it in an information form, or by a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

_C = TypeVar("_C")
_S = TypeVar("_S")


@dataclass(frozen=True)
class Scored(Generic[_C]):
    """A candidate beside those that were taken in before.

    Attributes:
        candidate: it.
        cost: the least is the best; of equal ones the first.
        is_enough: whether data call for it.
    """

    candidate: _C
    cost: float
    is_enough: bool = True


def select_stepwise(
    state: _S, scores: Callable[[_S], Iterable[Scored[_C]]], taken: Callable[[_S, _C], _S], *, most: int
) -> _S:
    """Return what a search comes to: the best candidate is taken in, again and again, until it is not enough.

    Example:
        >>> def scores(chosen):
        ...     return [Scored(n, -n, n > 2) for n in (1, 2, 3, 5) if n not in chosen]
        >>> select_stepwise((), scores, lambda chosen, n: (*chosen, n), most=4)
        (5, 3)
    """
    for _ in range(most):
        best = min(scores(state), key=lambda scored: scored.cost, default=None)
        if best is None or not best.is_enough:
            break
        state = taken(state, best.candidate)
    return state


class Criteria(NamedTuple):
    """Numbers that decide; chances are between 0 and 1, gains are of twice the log-likelihood.

    What bounds a computation (rows looked at, steps, rounding) stands where it is used.

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
