"""Where instrument and tools stand, and the linear algebra that finds it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from pincal.robot.se3 import transform

# Relative size of singular values below which a linear start says nothing about a direction.
RANK = 1e-6


@dataclass(frozen=True)
class Extrinsics:
    """Where instrument and tools stand.

    Attributes:
        base: shape (4, 4), robot base in the instrument's frame.
        tools: shape (targets, 4, 4), targets in the tip frame.
        own: values of the sensor's own parameters.
    """

    base: np.ndarray
    tools: np.ndarray
    own: np.ndarray = field(default_factory=lambda: np.zeros(0))


def from_distances(d: np.ndarray, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
    """Yield placements by distances ``d``, shape (N,), from one point; tools at the tip, then where the data have them."""
    p, R = tips[:, :, 3], tips[:, :, :3]
    tools = np.tile(np.eye(4), (n_targets, 1, 1))
    squares = (d**2 - np.einsum("ni,ni->n", p, p))[:, None]
    solution, _ = least_squares(np.hstack([2.0 * p, np.ones((len(p), 1))]), squares)
    yield Extrinsics(transform(np.eye(3), solution[:3, 0]), tools)
    lever = by_target(2.0 * np.einsum("nji,nj->ni", R, p), target, n_targets)
    products = by_target(2.0 * R.reshape(-1, 9), target, n_targets)
    constants = by_target(np.ones((len(p), 1)), target, n_targets)
    solution, complete = least_squares(np.hstack([2.0 * p, lever, products, constants]), squares)
    if complete:
        found = tools.copy()
        found[:, :3, 3] = solution[3 : 3 + 3 * n_targets, 0].reshape(n_targets, 3)
        yield Extrinsics(transform(np.eye(3), solution[:3, 0]), found)


def by_target(columns: np.ndarray, target: np.ndarray, n_targets: int) -> np.ndarray:
    """Return the columns once a target, zero at the rows of the other targets."""
    here = [(target == t).reshape(-1, *[1] * (columns.ndim - 1)) for t in range(n_targets)]
    return np.concatenate([np.where(h, columns, 0.0) for h in here], axis=-1)


def least_squares(A: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the least-squares solution and whether the data determine all of it."""
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0.0] = 1.0
    solution, _, rank, _ = np.linalg.lstsq(A / scale, y, rcond=RANK)
    return solution / scale[:, None], bool(rank == A.shape[1])
