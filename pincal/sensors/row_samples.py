"""Which of many rows are looked at: drawn, or evenly spread."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pincal.thresholds import Count, Scale

# Fewest rows sampled from each group.
_EACH: Count = 6
# Part of an equal share that each station keeps of fewer rows.
_LEAST: Scale = 0.5


def sample_rows(n: int, most: int, groups: np.ndarray | None = None) -> np.ndarray:
    """Return the indices of a random subsample of n rows, in order, always the same one.

    It is drawn because every k-th row of a periodic table (targets, points of an object) would miss
    the others.

    Args:
        n: number of rows.
        most: size of the subsample.
        groups: shape (n,), group of each row, if some rows of each are needed; there may be more
            then.

    Example:
        >>> groups = np.arange(1000) % 3
        >>> sample_rows(3, 5).tolist(), len(sample_rows(1000, 5)), len(sample_rows(1000, 5, groups))
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


def evenly(n: int, most: int) -> np.ndarray:
    """Return the indices of so many of n rows, evenly spread from the first to the last; of all if
    there are no more.

    Example:
        >>> evenly(10, 4).tolist(), evenly(3, 4).tolist()
        ([0, 3, 6, 9], [0, 1, 2])
    """
    return np.arange(n) if n <= most else np.linspace(0, n - 1, most).astype(int)


def spread_rows(counts: Sequence[int], most: int) -> np.ndarray:
    """Return so many of the rows of stations with some numbers of rows, evenly spread, as indices
    into the rows of all, shape (R,); all if there are no more.

    A station keeps a part of its share at least: eight poses beside many thousand rows of an IMU
    are all that tells lengths.

    Example:
        >>> spread_rows([2, 100], 8).tolist(), spread_rows([2, 4], 8).tolist()
        ([0, 1, 14, 28, 43, 57, 72, 86, 101], [0, 1, 2, 3, 4, 5])
    """
    n = sum(counts)
    rows = evenly(n, most)
    if n <= most:
        return rows
    least = int(_LEAST * most / len(counts))
    found = list[np.ndarray]()
    begin = 0
    for count in counts:
        own = rows[(rows >= begin) & (rows < begin + count)]
        few = min(count, least)
        found.append(own if len(own) >= few else begin + evenly(count, few))
        begin += count
    return np.concatenate(found)
