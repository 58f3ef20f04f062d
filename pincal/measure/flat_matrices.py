"""Poses as the numbers of their 4 x 4 matrices: in which order these stand is decided by the
numbers themselves.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pincal.measure.reading_numbers import LAYOUT


def quaternions_of(matrices: np.ndarray) -> np.ndarray:
    """Return quaternions x y z w of rotation matrices, shape (N, 3, 3); NaN for other matrices."""
    found = np.full((len(matrices), 4), np.nan)
    product = np.einsum("nij,nkj->nik", matrices, matrices)
    right = np.isfinite(matrices).all(axis=(1, 2)) & (
        np.abs(product - np.eye(3)).max(axis=(1, 2), initial=0.0) < LAYOUT.orthonormal
    )
    right &= np.linalg.det(np.where(right[:, None, None], matrices, np.eye(3))) > 0
    found[right] = Rotation.from_matrix(matrices[right]).as_quat() if right.any() else found[right]
    return found


def order_of_matrix(values: np.ndarray) -> np.ndarray | None:
    """Return in which order numbers form matrices: indices of the elements of the first three rows,
    shape (3, 4); None if in no order they do.

    Rotations are orthonormal, and the last row of a 4 x 4 matrix is 0 0 0 1, so that the numbers
    show whether they stand row by row or column by column.

    Args:
        values: shape (N, 12) or (N, 16); rows with NaN are disregarded.

    Example:
        >>> T = np.eye(4)
        >>> T[:3, 3] = 1.0, 2.0, 3.0
        >>> [order_of_matrix(of.reshape(1, -1))[:, 3].tolist() for of in (T, T.T, T[:3], T[:3].T)]
        [[3, 7, 11], [12, 13, 14], [3, 7, 11], [9, 10, 11]]
    """
    count = values.shape[1]
    whole = values[np.isfinite(values).all(axis=1)]
    if not len(whole) or count not in (12, 16):
        return None
    index = np.arange(count)
    for order in (index.reshape(-1, 4), index.reshape(4, -1).T):
        turned = quaternions_of(whole[:, order[:3, :3]])
        is_pose = np.isfinite(turned).all(axis=1)
        if count == 16:
            last = whole[:, order[3]]
            is_pose &= np.abs(last - np.eye(4)[3]).max(axis=1) < LAYOUT.orthonormal
        # A row that is none is a mistake in a table of poses, which is refused by its line.
        if np.mean(is_pose) > LAYOUT.filled:
            return order[:3]
    return None


def poses_from(values: np.ndarray) -> np.ndarray | None:
    """Return the poses whose numbers are given, shape (N, 3, 4), NaN for rows without; None if they
    are no poses.

    Args:
        values: shape (N, 4, 4), (N, 3, 4), (N, 4, 3), (N, 12) or (N, 16).
    """
    flat = values.reshape(len(values), -1)
    order = order_of_matrix(flat)
    return None if order is None else np.asarray(flat[:, order])
