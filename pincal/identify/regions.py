"""Regions of joint space: rows whose poses are near each other."""

from __future__ import annotations

import numpy as np

from pincal.model.conditions import TURN


def joint_regions(q: np.ndarray, most: int, seed: int = 0) -> np.ndarray:
    """Return the number of the region of joint space of each row of q, shape (N, n), of at most so many, shape (N,)."""
    from scipy.cluster.vq import kmeans2

    folded = _at_one_turn(q)
    spread = np.maximum(folded.std(axis=0), 1e-9)
    n = min(most, len(np.unique(distinct_poses(q))))
    labels = kmeans2(folded / spread, n, minit="++", rng=np.random.default_rng(seed))[1]
    return np.unique(labels, return_inverse=True)[1].ravel()


def distinct_poses(q: np.ndarray) -> np.ndarray:
    """Return a number for each row of q, shape (N, n), the same for those with the same joint positions, shape (N,)."""
    return np.unique(np.round(_at_one_turn(q), 9), axis=0, return_inverse=True)[1].ravel()


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
