"""Holding rows back: at random, or whole regions of joint space at a time."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pincal.errors import BadInputError
from pincal.measure.measurements import Measurements

Split = Literal["random", "blocked"]

# Regions of joint space that a blocked split deals out.
_BLOCKS = 25


def hold_out(
    measurements: Measurements, fraction: float, *, split: Split = "random", seed: int = 0
) -> tuple[Measurements, Measurements]:
    """Divide a table into training and held-out rows.

    Args:
        measurements: the table.
        fraction: of the rows to hold out, from 0 to below 1.
        split: "random" rows, or "blocked": whole clusters of similar joint positions, so that held-out poses are not
            the neighbours of measured ones.
        seed: of the choice.

    Returns:
        Training rows and held-out rows, both in the order of the table.

    Raises:
        BadInputError: if the fraction is out of range.
    """
    if not 0.0 <= fraction < 1.0:
        raise BadInputError(f"test fraction is {fraction:g}; expected at least 0 and below 1")
    held = np.zeros(len(measurements), bool)
    wanted = round(fraction * len(measurements))
    if wanted:
        folds = row_groups(measurements, split=split, seed=seed)
        for group in np.random.default_rng(seed).permutation(folds.max() + 1):
            size = int(np.sum(folds == group))
            if held.sum() + 0.5 * size <= wanted:
                held |= folds == group
    return measurements.select(~held), measurements.select(held)


def row_groups(measurements: Measurements, *, split: Split, seed: int) -> np.ndarray:
    """Return the group number of each row, shape (N,): each row its own, or clusters in joint space.

    Rows with the same joint positions (replicates, several targets) always share a group.
    """
    same = np.unique(np.round(measurements.q, 9), axis=0, return_inverse=True)[1].ravel()
    if split == "random":
        return np.asarray(same)
    from scipy.cluster.vq import kmeans2

    q = measurements.q
    spread = np.maximum(q.std(axis=0), 1e-9)
    n = min(_BLOCKS, len(np.unique(same)))
    labels = kmeans2(q / spread, n, minit="++", rng=np.random.default_rng(seed))[1]
    return np.unique(labels, return_inverse=True)[1].ravel()
