"""Stepwise selection: candidates are scored, the best is accepted if it suffices, and the rest are
scored given it.

Searches differ in their candidates, in the cost of each (reduction of the sum of squares against
the cost of its parameters, or a p-value), and in how one is accepted: by releasing it in an
information form, or by a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

_C = TypeVar("_C")
_S = TypeVar("_S")


@dataclass(frozen=True)
class Scored(Generic[_C]):
    """A candidate, its cost given those accepted before (the first of the least is best), and
    whether it suffices.
    """

    candidate: _C
    cost: float
    is_enough: bool = True


def select_stepwise(
    state: _S,
    scores: Callable[[_S], Iterable[Scored[_C]]],
    taken: Callable[[_S, _C], _S],
    *,
    most: int,
) -> _S:
    """Return the final state of a search that accepts the best candidate again and again until it
    does not suffice.

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
