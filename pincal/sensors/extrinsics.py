"""Poses of instrument and tools, with the linear algebra for finding them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pincal.thresholds import Scale

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
