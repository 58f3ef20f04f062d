"""Rows that stand for a table where all of them would add nothing but time."""

from __future__ import annotations

import numpy as np


def some_rows(n: int, most: int) -> np.ndarray:
    """Return at most so many of n row numbers, in order.

    Drawn, always the same ones, and not every k-th: tables repeat themselves (targets, points of an object), and whatever
    falls between the steps would never be looked at.

    Example:
        >>> some_rows(3, 5).tolist(), len(some_rows(1000, 5))
        ([0, 1, 2], 5)
    """
    if n <= most:
        return np.arange(n)
    return np.sort(np.random.default_rng(0).choice(n, most, replace=False))
