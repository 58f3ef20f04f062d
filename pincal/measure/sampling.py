"""Rows that stand for a table where all of them would add nothing but time."""

from __future__ import annotations

import numpy as np

# Rows of each group that are taken at least.
_EACH = 6


def sample_rows(n: int, most: int, groups: np.ndarray | None = None) -> np.ndarray:
    """Return at most so many of n row numbers, in order.

    Drawn, always the same ones, and not every k-th: tables repeat themselves (targets, points of an object), and whatever
    falls between the steps would never be looked at.

    Args:
        n: number of rows.
        most: how many will do.
        groups: shape (n,), what each row belongs to, if some rows of everything are needed; then there may be more.

    Example:
        >>> sample_rows(3, 5).tolist(), len(sample_rows(1000, 5)), len(sample_rows(1000, 5, np.arange(1000) % 3))
        ([0, 1, 2], 5, 18)
    """
    if n <= most:
        return np.arange(n)
    rng = np.random.default_rng(0)
    if groups is None:
        return np.sort(rng.choice(n, most, replace=False))
    order = rng.permutation(n)
    ranked = order[np.argsort(groups[order], kind="stable")]
    _, first, count = np.unique(groups[ranked], return_index=True, return_counts=True)
    place = np.empty(n, int)
    place[ranked] = np.arange(n) - np.repeat(first, count)
    taken = place < _EACH
    taken[order[: max(most - int(taken.sum()), 0)]] = True
    return np.flatnonzero(taken)
