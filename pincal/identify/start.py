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

import numpy as np

from pincal.identify.placement import (
    RANK,
    Extrinsics,
    by_target,
    from_distances,
    least_squares,
)
from pincal.identify.rows import some_rows
from pincal.identify.start_points import from_anchors, from_camera_points, from_contacts, from_pixels
from pincal.measure.camera import CameraPixelSensor, CameraPointSensor
from pincal.measure.points import AnchoredDistanceSensor, ContactSensor, DistanceSensor
from pincal.measure.sensors import PoseSensor, PositionSensor, Sensor
from pincal.robot.se3 import align, nearest_rotation, transform

# More rows than this add nothing to a start.
_ROWS = 2000


def placements(sensor: Sensor, tips: np.ndarray, target: np.ndarray, n_targets: int) -> list[Extrinsics]:
    """Return candidates for the placement of instrument and tools, some perhaps far off.

    Args:
        sensor: readings of N poses.
        tips: shape (N, 3, 4), nominal tips in the base frame.
        target: shape (N,), index of each row's target.
        n_targets: number of targets.
    """
    rows = some_rows(len(sensor), _ROWS, sensor.groups)
    sensor, tips, target = sensor.select(rows), tips[rows], target[rows]
    if isinstance(sensor, PoseSensor):
        return list(_from_poses(sensor, tips, target, n_targets))
    if isinstance(sensor, PositionSensor):
        return list(_from_positions(sensor.position, tips, target, n_targets))
    if isinstance(sensor, DistanceSensor):
        return list(from_distances(sensor.distance, tips, target, n_targets))
    if isinstance(sensor, ContactSensor):
        return list(from_contacts(sensor, tips, target, n_targets))
    if isinstance(sensor, AnchoredDistanceSensor):
        return list(from_anchors(sensor, tips, target, n_targets))
    if isinstance(sensor, CameraPointSensor):
        return list(from_camera_points(sensor, tips))
    if isinstance(sensor, CameraPixelSensor):
        return list(from_pixels(sensor, tips))
    return [Extrinsics(np.eye(4), np.tile(np.eye(4), (n_targets, 1, 1)), np.zeros(len(sensor.parameters)))]


def _from_positions(m: np.ndarray, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
    p, R = tips[:, :, 3], tips[:, :, :3]
    tools = np.tile(np.eye(4), (n_targets, 1, 1))
    base = transform(*align(p, m))
    yield Extrinsics(base, tools)
    columns = by_target(R.reshape(-1, 9), target, n_targets)
    solution, complete = least_squares(np.hstack([p, columns, np.ones((len(p), 1))]), m)
    if not complete:
        return
    rotation = nearest_rotation(solution[:3].T)
    for t in range(n_targets):
        products = solution[3 + 9 * t : 12 + 9 * t].T.reshape(3, 3, 3)  # [a, c, d] = R[a, c] t[d]
        tools[t, :3, 3] = np.einsum("ac,acd->d", rotation, products) / 3.0
    ends = p + np.einsum("nij,nj->ni", R, tools[target, :3, 3])
    yield Extrinsics(transform(*align(ends, m)), tools)


def _from_poses(sensor: PoseSensor, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
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
    rotation = nearest_rotation(sign * base)
    for t in range(n_targets):
        tools[t, :3, :3] = nearest_rotation(sign * null[9 + 9 * t : 18 + 9 * t].reshape(3, 3)).T
    lever = by_target(np.einsum("ab,nbc->nac", rotation, tips[:, :, :3]), np.asarray(target), n_targets)
    ones = np.tile(np.eye(3), (len(tips), 1, 1))
    A = np.concatenate([ones, lever], axis=2).reshape(3 * len(tips), -1)
    solution = np.linalg.lstsq(A, (sensor.position - tips[:, :, 3] @ rotation.T).ravel(), rcond=RANK)[0]
    for t in range(n_targets):
        tools[t, :3, 3] = solution[3 + 3 * t : 6 + 3 * t]
    yield Extrinsics(transform(rotation, solution[:3]), tools)


def _rotation_equations(tips: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Rows of R R_i - R_m,i Y = 0 in the unknowns R and Y = X^T, each row-major, shape (9 N, 18)."""
    eye = np.eye(3)
    left = np.einsum("ac,ndb->nabcd", eye, tips)  # d(R R_i)[a, b] / d R[c, d]
    right = -np.einsum("nac,bd->nabcd", measured, eye)  # d(R_m Y)[a, b] / d Y[c, d]
    return np.concatenate([left.reshape(-1, 9), right.reshape(-1, 9)], axis=1)
