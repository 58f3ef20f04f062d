"""Rigid transforms and rotations: the algebra of SE(3).

Transforms are arrays of shape (4, 4), or (N, 3, 4) for many poses at once (rotation and translation
without the last row). ``T_a_b`` maps coordinates in frame b to frame a.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def transform(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return transforms, shape (..., 4, 4), of rotations, shape (..., 3, 3), and translations,
    shape (..., 3) [m].
    """
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def rotation(axis: str, angle: float) -> np.ndarray:
    """Return the rotation, shape (4, 4), about "x", "y" or "z" by ``angle`` [rad]."""
    c = np.cos(angle)
    s = np.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    T = np.eye(4)
    T[i, i] = T[j, j] = c
    T[i, j] = -s
    T[j, i] = s
    return T


def translation(x: float, y: float, z: float) -> np.ndarray:
    """Return the translation, shape (4, 4), by (x, y, z) [m]."""
    return transform(np.eye(3), np.array([x, y, z]))


def placed(reference: np.ndarray, coordinates: np.ndarray) -> np.ndarray:
    r"""Return the frame, shape (4, 4), of six coordinates about a reference orientation.

    :math:`Tr(x, y, z)\, R_{ref}\, R(x; r_x)\, R(y; r_y)\, R(z; r_z)`, the parametrisation of base
      and tool frames: position
    [m] and angles [rad] in the order of ``pincal.parameters.FRAME_SYMBOLS``.
    """
    x, y, z, rx, ry, rz = map(float, coordinates)
    turned = transform(reference, np.array([x, y, z]))
    return np.asarray(turned @ rotation("x", rx) @ rotation("y", ry) @ rotation("z", rz))


def compose(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the products of transforms, shape (N, 3, 4) each."""
    R = A[:, :, :3]
    return np.concatenate([R @ B[:, :, :3], R @ B[:, :, 3:] + A[:, :, 3:]], axis=2)


def inverse(A: np.ndarray) -> np.ndarray:
    """Return the inverses of transforms, shape (N, 3, 4)."""
    turned = A[:, :, :3].swapaxes(1, 2)
    return np.concatenate([turned, -turned @ A[:, :, 3:]], axis=2)


def rotation_of_rpy(rpy: np.ndarray) -> np.ndarray:
    """Return the rotation matrix R_z R_y R_x, shape (3, 3), of roll, pitch and yaw, shape (3,)
    [rad]: a URDF's ``rpy``.
    """
    cr, cp, cy = np.cos(rpy)
    sr, sp, sy = np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Return rotation matrices, shape (N, 3, 3), of unit quaternions x y z w, shape (N, 4)."""
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def quaternions(matrices: np.ndarray) -> np.ndarray:
    """Return unit quaternions x y z w, shape (N, 4), of rotation matrices, shape (N, 3, 3)."""
    return np.asarray(Rotation.from_matrix(matrices).as_quat())


def rotation_vectors(matrices: np.ndarray) -> np.ndarray:
    """Return rotation vectors, shape (N, 3) [rad], of rotation matrices, shape (N, 3, 3)."""
    return np.asarray(Rotation.from_matrix(matrices).as_rotvec())


def exponentials(vectors: np.ndarray) -> np.ndarray:
    """Return the rotation matrices, shape (N, 3, 3), of rotation vectors, shape (N, 3) [rad]."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def perpendicular(direction: np.ndarray) -> np.ndarray:
    """Return a vector perpendicular to a unit vector, shape (3,), at least 0.8 long: its cross
    product with the axis along which it is shortest.
    """
    return np.asarray(np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))]))


def shortest_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the smallest rotation, shape (4, 4), from one unit vector to another."""
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    cosine = float(start @ end)
    if sine < 1e-12:
        return np.eye(4) if cosine > 0.0 else rotation("x", np.pi)
    x, y, z = axis / sine
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return transform(np.eye(3) + sine * K + (1.0 - cosine) * K @ K, np.zeros(3))


def nearest_rotation(M: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to a matrix, shape (3, 3), in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def align(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares rotation and translation from points ``a`` to ``b`` (Kabsch 1976,
    Umeyama 1991).
    """
    ca = a.mean(axis=0)
    cb = b.mean(axis=0)
    R = nearest_rotation((b - cb).T @ (a - ca))
    return R, cb - R @ ca


def are_rotations(matrices: np.ndarray, *, tolerance: float) -> bool:
    """Return whether matrices, shape (..., 3, 3), are rotations to ``tolerance`` in every element
    of R R^T.
    """
    products = matrices @ np.swapaxes(matrices, -1, -2)
    is_orthogonal = np.abs(products - np.eye(3)).max(initial=0.0) <= tolerance
    return bool(is_orthogonal and (np.linalg.det(matrices) > 0.0).all())
