r"""Where instrument and tool stand, in closed form, from any placement and without a first guess.

With the nominal arm's poses (R_i, p_i) in the robot's base frame, base R, b and tool t, X:

position    m_i = R p_i + R R_i t + b: linear in R, b and the products R (x) t.
pose        R_m,i = R R_i X, a homogeneous linear system in R and X^T; then b and t linearly.
distance    d_i^2 = |p_i|^2 + 2 p_i.c + 2 (R_i^T p_i).t + 2 c^T R_i t + const, linear in c, t and c (x) t,
            with c the vector from the instrument's point to the base.

Each start is a candidate; the fit of base and tool begins at the best. Several targets: the products are one set a target.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pincal.measure.sensors import DistanceSensor, PoseSensor, PositionSensor, Sensor

# More rows than this add nothing to a start.
_ROWS = 2000
# Relative size of singular values below which a linear start says nothing about a direction.
_RANK = 1e-6


@dataclass(frozen=True)
class Placement:
    """Where instrument and tools stand.

    Attributes:
        base: shape (4, 4), robot base in the instrument's frame.
        tools: shape (targets, 4, 4), targets in the tip frame.
    """

    base: np.ndarray
    tools: np.ndarray


def placements(sensor: Sensor, tips: np.ndarray, target: np.ndarray, n_targets: int) -> list[Placement]:
    """Return candidates for the placement of instrument and tools, some perhaps far off.

    Args:
        sensor: readings of N poses.
        tips: shape (N, 3, 4), nominal tips in the base frame.
        target: shape (N,), index of each row's target.
        n_targets: number of targets.
    """
    rows = slice(None) if len(sensor) <= _ROWS else np.linspace(0, len(sensor) - 1, _ROWS).astype(int)
    sensor, tips, target = sensor.select(rows), tips[rows], target[rows]
    if isinstance(sensor, PoseSensor):
        return list(_from_poses(sensor, tips, target, n_targets))
    if isinstance(sensor, PositionSensor):
        return list(_from_positions(sensor.position, tips, target, n_targets))
    if isinstance(sensor, DistanceSensor):
        return list(_from_distances(sensor.distance, tips, target, n_targets))
    return [Placement(np.eye(4), np.tile(np.eye(4), (n_targets, 1, 1)))]


def _from_positions(m: np.ndarray, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Placement]:
    p, R = tips[:, :, 3], tips[:, :, :3]
    tools = np.tile(np.eye(4), (n_targets, 1, 1))
    base = _frame(*_rigid(p, m))
    yield Placement(base, tools)
    columns = _by_target(R.reshape(-1, 9), target, n_targets)
    solution, complete = _least_squares(np.hstack([p, columns, np.ones((len(p), 1))]), m)
    if not complete:
        return
    rotation = _nearest_rotation(solution[:3].T)
    for t in range(n_targets):
        products = solution[3 + 9 * t : 12 + 9 * t].T.reshape(3, 3, 3)  # [a, c, d] = R[a, c] t[d]
        tools[t, :3, 3] = np.einsum("ac,acd->d", rotation, products) / 3.0
    ends = p + np.einsum("nij,nj->ni", R, tools[target, :3, 3])
    yield Placement(_frame(*_rigid(ends, m)), tools)


def _from_poses(sensor: PoseSensor, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Placement]:
    tools = np.tile(np.eye(4), (n_targets, 1, 1))
    blocks = np.zeros((9 + 9 * n_targets, 9 + 9 * n_targets))
    for t in range(n_targets):
        here = target == t
        A = _rotation_equations(tips[here, :, :3], sensor.rotation[here])
        places = np.r_[0:9, 9 + 9 * t : 18 + 9 * t]
        blocks[np.ix_(places, places)] += A.T @ A
    null = np.linalg.eigh(blocks)[1][:, 0]
    base = null[:9].reshape(3, 3)
    sign = np.sign(np.linalg.det(base))
    rotation = _nearest_rotation(sign * base)
    for t in range(n_targets):
        tools[t, :3, :3] = _nearest_rotation(sign * null[9 + 9 * t : 18 + 9 * t].reshape(3, 3)).T
    lever = _by_target(np.einsum("ab,nbc->nac", rotation, tips[:, :, :3]), np.asarray(target), n_targets)
    ones = np.tile(np.eye(3), (len(tips), 1, 1))
    A = np.concatenate([ones, lever], axis=2).reshape(3 * len(tips), -1)
    solution = np.linalg.lstsq(A, (sensor.position - tips[:, :, 3] @ rotation.T).ravel(), rcond=_RANK)[0]
    for t in range(n_targets):
        tools[t, :3, 3] = solution[3 + 3 * t : 6 + 3 * t]
    yield Placement(_frame(rotation, solution[:3]), tools)


def _from_distances(d: np.ndarray, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Placement]:
    p, R = tips[:, :, 3], tips[:, :, :3]
    tools = np.tile(np.eye(4), (n_targets, 1, 1))
    squares = (d**2 - np.einsum("ni,ni->n", p, p))[:, None]
    solution, _ = _least_squares(np.hstack([2.0 * p, np.ones((len(p), 1))]), squares)
    yield Placement(_frame(np.eye(3), solution[:3, 0]), tools)
    lever = _by_target(2.0 * np.einsum("nji,nj->ni", R, p), target, n_targets)
    products = _by_target(2.0 * R.reshape(-1, 9), target, n_targets)
    constants = _by_target(np.ones((len(p), 1)), target, n_targets)
    solution, complete = _least_squares(np.hstack([2.0 * p, lever, products, constants]), squares)
    if complete:
        found = tools.copy()
        found[:, :3, 3] = solution[3 : 3 + 3 * n_targets, 0].reshape(n_targets, 3)
        yield Placement(_frame(np.eye(3), solution[:3, 0]), found)


def _rotation_equations(tips: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Rows of R R_i - R_m,i Y = 0 in the unknowns R and Y = X^T, each row-major, shape (9 N, 18)."""
    eye = np.eye(3)
    left = np.einsum("ac,ndb->nabcd", eye, tips)  # d(R R_i)[a, b] / d R[c, d]
    right = -np.einsum("nac,bd->nabcd", measured, eye)  # d(R_m Y)[a, b] / d Y[c, d]
    return np.concatenate([left.reshape(-1, 9), right.reshape(-1, 9)], axis=1)


def _by_target(columns: np.ndarray, target: np.ndarray, n_targets: int) -> np.ndarray:
    """Return the columns once a target, zero at the rows of the other targets."""
    here = [(target == t).reshape(-1, *[1] * (columns.ndim - 1)) for t in range(n_targets)]
    return np.concatenate([np.where(h, columns, 0.0) for h in here], axis=-1)


def _least_squares(A: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the least-squares solution and whether the data determine all of it."""
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0.0] = 1.0
    solution, _, rank, _ = np.linalg.lstsq(A / scale, y, rcond=_RANK)
    return solution / scale[:, None], bool(rank == A.shape[1])


def _rigid(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return R, t that bring points ``a`` nearest to ``b`` (Kabsch 1976, Umeyama 1991)."""
    ca, cb = a.mean(axis=0), b.mean(axis=0)
    R = _nearest_rotation((b - cb).T @ (a - ca))
    return R, cb - R @ ca


def _nearest_rotation(M: np.ndarray) -> np.ndarray:
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def _frame(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T
