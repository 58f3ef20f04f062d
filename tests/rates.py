"""Rates from counts: exact intervals, and what a number of tables lets a test notice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import beta, binom

# How often a test of a rate fails by chance alone.
CHANCE = 1e-3


def interval(hits: int, n: int, *, level: float = 0.95) -> tuple[float, float]:
    """Return the interval of a rate that was met so often (Clopper and Pearson, 1934), 0 to 1."""
    tail = (1.0 - level) / 2.0
    low, high = beta.ppf([tail, 1.0 - tail], [hits, hits + 1], [n - hits + 1, n - hits])
    return (float(low) if hits else 0.0), (float(high) if hits < n else 1.0)


def in_words(hits: int, n: int) -> str:
    """Return a rate with its interval.

    Example:
        >>> in_words(3, 300)
        '3 of 300: 0.2 to 2.9 %'
    """
    low, high = (100.0 * edge for edge in interval(hits, n))
    return f"{hits} of {n}: {low:.1f} to {high:.1f} %"


def is_at_least(rate: float, hits: Sequence[bool]) -> bool:
    """Return whether so few hits are no surprise at a rate."""
    return bool(binom.cdf(sum(hits), len(hits), rate) > CHANCE)


def is_at_most(rate: float, hits: Sequence[bool]) -> bool:
    """Return whether so many hits are no surprise at a rate."""
    return bool(binom.sf(sum(hits) - 1, len(hits), rate) > CHANCE)


def allowed(rate: float, n: int) -> int:
    """Return with how many hits in n tables :func:`is_at_most` still holds."""
    counts = np.arange(n + 1)
    return int(counts[binom.sf(counts - 1, n, rate) > CHANCE][-1])


def power(rate: float, n: int, *, factor: float = 2.0) -> float:
    """Return how likely :func:`is_at_most` of a rate fails in n tables where the rate is so many times as high."""
    return float(binom.sf(allowed(rate, n), n, min(factor * rate, 1.0)))


def tables_for(rate: float, *, factor: float = 2.0, wanted: float = 0.9) -> int:
    """Return how many tables it takes to notice a rate that is so many times as high, with a power."""
    n = 1
    while power(rate, n, factor=factor) < wanted:
        n += max(n // 200, 1)
    return n


def noticed(rate: float, n: int, *, wanted: float = 0.9) -> float:
    """Return the rate from which on n tables show, with a power, that it is higher than it should be; 1 if none does."""
    rates = np.linspace(rate, 1.0, 2001)
    seen = rates[binom.sf(allowed(rate, n), n, rates) >= wanted]
    return float(seen[0]) if len(seen) else 1.0
