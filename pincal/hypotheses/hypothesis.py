"""Hypotheses about what is wrong, and the choice between them.

Every search for a fault goes the same way. A list of hypotheses says what may have happened: two
columns exchanged, a joint that counts the other way, an instrument that was touched. Each is tried,
either by undoing it and looking whether the subject then fits (:class:`Hypothesis`,
:func:`explaining`), or by what is gained where it is estimated. :func:`likeliest` compares what
they leave: it believes the one that leaves least, and names those that leave hardly more, between
which nobody can decide.

A new hypothesis is an entry in the list of its topic; neither the trial nor the comparison changes.
The lists stand where what they need is known: of columns in
:mod:`pincal.measure.joint_columns`, of tables and robots in :mod:`pincal.validate.cures`, of events
between rows in :mod:`pincal.validate.causes`, of logs in :mod:`pincal.motion`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

_S = TypeVar("_S")
_H = TypeVar("_H")


@dataclass(frozen=True)
class Hypothesis(Generic[_S]):
    """One thing that may be wrong with a subject: with columns, a table and its robot, a log.

    Attributes:
        words: what is supposed, as it stands in a message.
        undo: returns the subject as it would be if it had not happened.
        advice: what to do about it, in words.
    """

    words: str
    undo: Callable[[_S], _S]
    advice: str = ""


def explaining(
    hypotheses: Iterable[Hypothesis[_S]], subject: _S, fits: Callable[[_S], bool]
) -> Iterator[Hypothesis[_S]]:
    """Yield the hypotheses which, undone, make a subject fit, in their order.

    Each is tried only when it is asked for, so the first costs no trial of those behind it.

    Example:
        >>> def too_far(k):
        ...     return Hypothesis(f"{k} turns too far", lambda angle: angle - k)
        >>> turns = [too_far(k) for k in (1, 2, 3)]
        >>> [one.words for one in explaining(turns, 2.1, lambda angle: abs(angle) < 0.5)]
        ['2 turns too far']
    """
    return (one for one in hypotheses if fits(one.undo(subject)))


@dataclass(frozen=True)
class Explanation(Generic[_H]):
    """What a hypothesis explains.

    Attributes:
        hypothesis: any description of it.
        left: what it leaves unexplained, in any measure of which less is better: the ratio of
            residuals to plausible ones, or -2 log likelihood, or minus a gain.
        is_enough: whether it explains enough to be believed if no other one did.
    """

    hypothesis: _H
    left: float
    is_enough: bool = True


@dataclass(frozen=True)
class Likeliest(Generic[_H]):
    """The hypothesis that is believed, and those that explain as much, in the order of the list."""

    best: _H
    rivals: tuple[_H, ...]

    @property
    def every(self) -> tuple[_H, ...]:
        """All that may be true, the believed one first."""
        return (self.best, *self.rivals)


def likeliest(
    explanations: Sequence[Explanation[_H]], close: Callable[[float], float]
) -> Likeliest[_H] | None:
    """Return which hypothesis is believed, and its rivals; None if none explains enough.

    The order of the explanations is that of preference: of those that explain as much as the best,
    the first is believed. In the order of what they leave, it is the best one.

    Args:
        explanations: of all hypotheses that were tried.
        close: returns, for the least that is left, the limit below which another hypothesis
            explains as much.

    Example:
        >>> tried = [Explanation("swapped", 1.2), Explanation("late", 1.1)]
        >>> tried.append(Explanation("early", 9.0))
        >>> likeliest(tried, lambda least: 2.0 * least)
        Likeliest(best='swapped', rivals=('late',))
    """
    enough = [one for one in explanations if one.is_enough]
    if not enough:
        return None
    least = min(one.left for one in enough)
    limit = close(least)
    best = next(one for one in enough if one.left < limit or one.left == least)
    others = (one for one in explanations if one is not best and one.left < limit)
    return Likeliest(best.hypothesis, tuple(one.hypothesis for one in others))


def exchange_order(n: int, i: int, j: int) -> np.ndarray:
    """Return the order of n columns with two of them exchanged, shape (n,).

    Example:
        >>> exchange_order(4, 0, 2)
        array([2, 1, 0, 3])
    """
    order = np.arange(n)
    order[i] = j
    order[j] = i
    return order
