"""Holding rows back: at random, or whole regions of joint space at a time."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pincal.errors import BadInputError
from pincal.measure.measurements import Measurements
from pincal.model.conditions import TURN

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
        sizes = np.bincount(folds).tolist()
        is_held, count = np.zeros(len(sizes), bool), 0
        for group in np.random.default_rng(seed).permutation(len(sizes)).tolist():
            if count + 0.5 * sizes[group] <= wanted:
                is_held[group] = True
                count += sizes[group]
        held = is_held[folds]
    return measurements.select(~held), measurements.select(held)


def row_groups(measurements: Measurements, *, split: Split, seed: int) -> np.ndarray:
    """Return the group number of each row, shape (N,): each row its own, or clusters in joint space.

    Rows with the same joint positions (replicates, several targets) always share a group.
    """
    q = _at_one_turn(measurements.q)
    same = np.unique(np.round(q, 9), axis=0, return_inverse=True)[1].ravel()
    if split == "random":
        return np.asarray(same)
    from scipy.cluster.vq import kmeans2

    spread = np.maximum(q.std(axis=0), 1e-9)
    n = min(_BLOCKS, len(np.unique(same)))
    labels = kmeans2(q / spread, n, minit="++", rng=np.random.default_rng(seed))[1]
    return np.unique(labels, return_inverse=True)[1].ravel()


def _at_one_turn(q: np.ndarray) -> np.ndarray:
    """Return joint positions, shape (N, n), those of a joint that takes more than a turn folded into one turn.

    It begins behind the largest gap, so that neighbours stay neighbours. A rail of more than 6 m is folded, too: two far
    places on it may then be held out together, which does no harm.
    """
    folded = np.array(q, float)
    for j in np.flatnonzero(np.ptp(q, axis=0) > TURN) if len(q) else ():
        angles = np.unique(np.mod(q[:, j], TURN))
        gap = int(np.argmax(np.diff(angles, append=angles[0] + TURN)))
        # The middle of the gap, where rounding can't carry a row to the other end.
        start = angles[gap] + 0.5 * (angles[(gap + 1) % len(angles)] - angles[gap]) % TURN
        folded[:, j] = np.mod(q[:, j] - start, TURN)
    return folded
