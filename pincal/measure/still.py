"""Poses that an arm holds still, cut out of a recording of its joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# An arm that moves by less than this [rad, m] within this time [s] holds still; noise of encoders is smaller.
_STILL, _HOLD = 3e-4, 0.3
# A pose that wanders by more than this [rad, m] while it is held is none.
_DRIFT = 2e-3


@dataclass(frozen=True)
class Poses:
    """K poses that were held still.

    Attributes:
        begin: shape (K,), first sample of each.
        end: shape (K,), its last sample.
    """

    begin: np.ndarray
    end: np.ndarray

    def __len__(self) -> int:
        return len(self.begin)

    def at(self, time: np.ndarray, asked: np.ndarray) -> np.ndarray:
        """Return the pose that is held at each time asked for, shape (M,); -1 where none is."""
        found = np.searchsorted(time[self.begin], asked, side="right") - 1
        is_held = (found >= 0) & (asked <= time[self.end][np.maximum(found, 0)]) if len(self) else np.zeros(len(asked), bool)
        return np.where(is_held, found, -1)

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return the mean of values, shape (T, k), in each pose, shape (K, k)."""
        return np.array([values[a : b + 1].mean(axis=0) for a, b in zip(self.begin, self.end, strict=True)])


def held_poses(time: np.ndarray, q: np.ndarray) -> Poses:
    """Return the poses that are held still for some tenths of a second.

    Args:
        time: shape (T,), strictly increasing [s].
        q: shape (T, n), joint positions [rad], prismatic [m].

    Example:
        >>> time = np.arange(0.0, 4.0, 0.01)
        >>> poses = held_poses(time, np.clip(time - 1.0, 0.0, 1.0)[:, None])
        >>> len(poses), poses.at(time, np.array([0.5, 1.5, 3.0])).tolist()
        (2, [0, -1, 1])
    """
    ahead = np.minimum(np.searchsorted(time, time + _HOLD), len(time) - 1)
    alone = time[ahead] - time < 0.9 * _HOLD  # The recording ends; times are rounded.
    is_held = (np.abs(q[ahead] - q).max(axis=1, initial=0.0) <= _STILL) & ~alone
    # Each held window holds all its samples.
    change = np.zeros(len(time) + 1, int)
    np.add.at(change, np.flatnonzero(is_held), 1)
    np.add.at(change, ahead[is_held] + 1, -1)
    inside = np.cumsum(change[:-1]) > 0
    moves = np.append(np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0) > _STILL, True)
    begin = inside & np.append(True, ~inside[:-1] | moves[:-1])
    end = inside & (np.append(~inside[1:], True) | moves)
    first, last = np.flatnonzero(begin), np.flatnonzero(end)
    steady = [float(np.ptp(q[a : b + 1], axis=0).max(initial=0.0)) <= _DRIFT for a, b in zip(first, last, strict=True)]
    return Poses(first[steady], last[steady])
