"""Poses of instrument and tools, with the linear algebra and the subsample of rows for finding
them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pincal.thresholds import Count, Scale

# Relative size of singular values below which a linear start does not determine a direction.
RANK: Scale = 1e-6


@dataclass(frozen=True)
class Extrinsics:
    """Poses of instrument and tools.

    Attributes:
        base: shape (4, 4), robot base in the instrument's frame.
        tools: shape (targets, 4, 4), targets in the tip frame.
        own: values of the sensor's own parameters.
    """

    base: np.ndarray
    tools: np.ndarray
    own: np.ndarray = field(default_factory=lambda: np.zeros(0))


def by_target(columns: np.ndarray, target: np.ndarray, n_targets: int) -> np.ndarray:
    """Return the columns once for each target, zero in the rows of other targets."""
    here = [(target == t).reshape(-1, *[1] * (columns.ndim - 1)) for t in range(n_targets)]
    return np.concatenate([np.where(h, columns, 0.0) for h in here], axis=-1)


def least_squares(A: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the least-squares solution and whether the data determine all of it."""
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0.0] = 1.0
    solution, _, rank, _ = np.linalg.lstsq(A / scale, y, rcond=RANK)
    return solution / scale[:, None], bool(rank == A.shape[1])


# Fewest rows sampled from each group.
_EACH: Count = 6


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
