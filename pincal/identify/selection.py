"""One search for what data call for: candidates are scored, the best is taken in if it is enough, the rest scored beside it.

What is searched differs in its candidates, in what each costs (what it takes off the squares against what its parameters
cost, or the chance of as large a gain), and in how one is taken in: by releasing it in an information form, or by a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

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
