"""Holding rows back: at random, whole regions of joint space at a time, or stretches of consecutive rows."""

from __future__ import annotations

from typing import Literal

import numpy as np

from pincal.errors import BadInputError
from pincal.measure.measurements import Measurements
from pincal.measure.poses import SCATTER, replicate_groups
from pincal.model.conditions import TURN

Split = Literal["random", "blocked"]
Way = Literal["regions", "stretches"]
"""What rows that are held out are apart from the fitted ones in: their joint positions, or the order of measurement."""

# Regions of joint space that a blocked split deals out, and stretches of rows.
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
    if round(fraction * len(measurements)):
        held = _dealt(row_groups(measurements, split=split, seed=seed), round(fraction * len(measurements)), seed)
    return measurements.select(~held), measurements.select(held)


def ways_held_out(measurements: Measurements, fraction: float, *, seed: int = 0) -> dict[Way, np.ndarray]:
    """Return which rows to hold out both ways, half of them by regions of joint space and half by stretches of rows.

    A model that knows the neighbours of a pose, or what the day was like before and after it, predicts it better than one
    that doesn't: curves between trained positions, drift between trained rows.

    Args:
        measurements: the table.
        fraction: of the rows to hold out, from 0 to below 1.
        seed: of the choice.

    Returns:
        Of each way which rows it holds out, shape (N,); readings of one pose together, and no row by both.

    Raises:
        BadInputError: if the fraction is out of range.
    """
    if not 0.0 <= fraction < 1.0:
        raise BadInputError(f"test fraction is {fraction:g}; expected at least 0 and below 1")
    n, wanted = len(measurements), round(0.5 * fraction * len(measurements))
    if not wanted:
        return {"regions": np.zeros(n, bool), "stretches": np.zeros(n, bool)}
    regions = _dealt(row_groups(measurements, split="blocked", seed=seed), wanted, seed)
    along = measurements.rows if measurements.time is None else measurements.time
    place = np.argsort(np.argsort(along, kind="stable"), kind="stable")
    stretches = _dealt(place * min(_BLOCKS, n) // n, wanted, seed + 1)
    pose = replicate_groups([measurements], within=SCATTER)[0]
    regions = np.isin(pose, pose[regions])
    return {"regions": regions, "stretches": np.isin(pose, pose[stretches]) & ~regions}


def _dealt(groups: np.ndarray, wanted: int, seed: int) -> np.ndarray:
    """Return which rows belong to groups, drawn whole, that have about as many rows as are wanted, shape (N,)."""
    sizes = np.bincount(groups).tolist()
    is_held, count = np.zeros(len(sizes), bool), 0
    for group in np.random.default_rng(seed).permutation(len(sizes)).tolist():
        if count + 0.5 * sizes[group] <= wanted:
            is_held[group] = True
            count += sizes[group]
    return np.asarray(is_held[groups])


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
