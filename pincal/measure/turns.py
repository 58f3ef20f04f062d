"""Compiled loops over rotations: how far predicted orientations are from measured ones, and how that follows a motion."""

from __future__ import annotations

import numpy as np

from pincal.compiled import compiled

# Below this angle [rad] series are exact to rounding.
_SMALL = 1e-3
# Poses worked on at once, so that what is needed of them stays in the cache.
_TILE = 512


@compiled(nogil=True)
def turns(measured, poses):
    """Return the rotation vectors from predicted to measured orientations, shape (3, N) [rad].

    Args:
        measured: shape (N, 3, 3), rotation matrices.
        poses: shape (N, 3, 4), predicted rotations and translations.

    By quaternions, whose largest element is found first (Shepperd 1978).
    """
    n = len(measured)
    out, R, q = np.empty((3, n)), np.empty((3, 3)), np.empty(4)
    for k in range(n):
        for i in range(3):
            for j in range(3):
                R[i, j] = (
                    measured[k, i, 0] * poses[k, j, 0]
                    + measured[k, i, 1] * poses[k, j, 1]
                    + measured[k, i, 2] * poses[k, j, 2]
                )
        trace, a = R[0, 0] + R[1, 1] + R[2, 2], 0
        for i in range(1, 3):
            if R[i, i] > R[a, a]:
                a = i
        b, c = (a + 1) % 3, (a + 2) % 3
        if trace >= R[a, a]:
            q[0], q[1], q[2], q[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace
        else:
            q[a], q[3] = 1.0 - trace + 2.0 * R[a, a], R[c, b] - R[b, c]
            q[b], q[c] = R[b, a] + R[a, b], R[c, a] + R[a, c]
        if q[3] < 0.0:
            for i in range(4):
                q[i] = -q[i]
        size = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
        norm = np.sqrt(size**2 + q[3] ** 2)
        angle = 2.0 * np.arctan2(size, q[3])
        scale = angle / size if angle > _SMALL else (2.0 + angle**2 / 12.0 + 7.0 * angle**4 / 2880.0) / norm
        for i in range(3):
            out[i, k] = scale * q[i]
    return out


@compiled(nogil=True)
def turned(turn, motion):
    """Return motions, shape (D, 6, N), with their rotations as they change rotation vectors of residuals, shape (3, N).

    These change by the inverse right Jacobian: log(exp(phi) exp(-w)) = phi - J_r^-1 w + O(w^2) [Sola et al. 2018, Eq. 144].
    """
    n_columns, _, n = motion.shape
    out, rows = np.empty(motion.shape), np.empty((3, 3, _TILE))
    for first in range(0, n, _TILE):
        end = min(first + _TILE, n)
        for k in range(first, end):
            x, y, z = turn[0, k], turn[1, k], turn[2, k]
            angle2 = x * x + y * y + z * z
            angle = np.sqrt(angle2)
            if angle < _SMALL:
                factor = 1.0 / 12.0 + angle2 / 720.0
            else:
                factor = 1.0 / angle2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
            i = k - first
            rows[0, 0, i] = 1.0 - factor * (y * y + z * z)
            rows[1, 1, i] = 1.0 - factor * (x * x + z * z)
            rows[2, 2, i] = 1.0 - factor * (x * x + y * y)
            rows[0, 1, i], rows[1, 0, i] = factor * x * y - 0.5 * z, factor * x * y + 0.5 * z
            rows[0, 2, i], rows[2, 0, i] = factor * x * z + 0.5 * y, factor * x * z - 0.5 * y
            rows[1, 2, i], rows[2, 1, i] = factor * y * z - 0.5 * x, factor * y * z + 0.5 * x
        for d in range(n_columns):
            out[d, :3, first:end] = motion[d, :3, first:end]
            # As slices: loops over these are vectorised.
            u, v, w = motion[d, 3, first:end], motion[d, 4, first:end], motion[d, 5, first:end]
            for i in range(3):
                a, b, c, to = rows[i, 0], rows[i, 1], rows[i, 2], out[d, 3 + i, first:end]
                for k in range(len(to)):
                    to[k] = a[k] * u[k] + b[k] * v[k] + c[k] * w[k]
    return out
