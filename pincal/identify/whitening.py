r"""Whitening of noise: among the readings of each row, and along the rows in their order.

Drift of a set-up, moving air or a settling floor correlate the errors of consecutive rows. Each component of a reading then
has, in addition to white noise, an autoregression of first order along the rows,

.. math:: V_{tu} = \sigma^2 \left( (1 - s) \, \delta_{tu} + s \, \varphi^{|t - u|} \right) ,

which with :math:`\varphi` near 1 is a random walk. Its innovations (Kalman 1960) are independent and follow from the
readings by a recursion, in a time linear in the number of rows, and all methods for independent rows (fits, score tests,
covariances) apply to them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pincal.compiled import compiled

# Poses processed at once, so that their data stay in the cache.
_TILE = 512


@compiled(nogil=True)
def whitened_rows(whitening, columns):
    """Return columns, shape (D, m, N), times the lower triangular matrix of each row, shape (m, m, N)."""
    n_columns, m, n = columns.shape
    out = columns.copy()
    for first in range(0, n, _TILE):
        end = min(first + _TILE, n)
        for d in range(n_columns):
            for i in range(m):
                # As slices: loops over these are vectorised.
                to, own, mine = out[d, i, first:end], columns[d, i, first:end], whitening[i, i, first:end]
                for k in range(end - first):
                    to[k] = mine[k] * own[k]
                for j in range(i):
                    factor, other = whitening[i, j, first:end], columns[d, j, first:end]
                    for k in range(end - first):
                        to[k] += factor[k] * other[k]
    return out


@compiled(nogil=True)
def recursion(phi, share, gaps, counted):
    """Return decay, gain and scale, shape (m, N), for :func:`filtered`, of an autoregression plus white noise.

    Their variances are ``share`` and 1 - ``share``, shape (m,); ``phi`` is the correlation per step; ``gaps``, shape (N,),
    are the steps from the previous row; rows that are not ``counted`` do not predict the next ones.
    """
    m, n = len(phi), len(gaps)
    decay, gain, scale = np.empty((m, n)), np.empty((m, n)), np.empty((m, n))
    for i in range(m):
        known = share[i]
        for k in range(n):
            left = phi[i] ** gaps[k]
            known = left * left * known + share[i] * (1.0 - left * left)
            variance = known + 1.0 - share[i]
            decay[i, k], scale[i, k] = left, 1.0 / np.sqrt(variance)
            gain[i, k] = known / variance if counted[k] else 0.0
            known *= 1.0 - gain[i, k]
    return decay, gain, scale


@compiled(nogil=True)
def filtered(columns, order, decay, gain, scale, back):
    """Return the innovations of columns, shape (D, m, N), along rows in an order, each times its scale (a Kalman filter).

    The prediction of a row is ``decay`` times the last estimate, which is corrected by ``gain`` times the innovation; order
    has shape (N,), the others (m, N), in this order. With ``back`` columns are returned for given innovations.
    """
    n_columns, m, n = columns.shape
    out = np.empty_like(columns)
    for d in range(n_columns):
        for i in range(m):
            known = 0.0
            for k in range(n):
                row = order[k]
                known *= decay[i, k]
                here = columns[d, i, row]
                beyond = here / scale[i, k] if back else here - known
                out[d, i, row] = known + beyond if back else beyond * scale[i, k]
                known += gain[i, k] * beyond
    return out


@dataclass(frozen=True, eq=False, repr=False)
class Serial:
    """Correlation of the noise of N rows of a station along their order.

    Attributes:
        phi: shape (m,), correlation per unit of position, of each component of a reading.
        share: shape (m,), correlated fraction of the variance.
        position: shape (N,), of each row in the order.
        counted: shape (N,), rows that predict the next ones; an outlier does not.
        turns: shape (N, 3, 3), rotation from the frame in which the error persists, such as a loose target's, to the
            readings' frame; default: the same frame.
    """

    phi: np.ndarray
    share: np.ndarray
    position: np.ndarray
    counted: np.ndarray
    turns: np.ndarray | None = None

    def select(self, rows: Any) -> Serial:
        """Return the correlation of some rows (mask, indices or slice)."""
        turns = None if self.turns is None else self.turns[rows]
        return replace(self, position=self.position[rows], counted=self.counted[rows], turns=turns)

    @cached_property
    def _recursion(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The order of the rows, shape (N,), and decay, gain and scale of each, shape (m, N)."""
        order = np.argsort(self.position, kind="stable")
        gaps = np.diff(self.position[order], prepend=self.position[order[:1]])
        size = np.sqrt([self._spread(*each) for each in zip(self.phi.tolist(), self.share.tolist(), strict=True)])
        decay, gain, scale = recursion(self.phi, self.share, gaps, self.counted[order])
        return order, decay, gain, scale * size[:, None]

    def _spread(self, phi: float, share: float) -> float:
        """Return the variance of the rows about their mean, in units of the process's; for a random walk it is small."""
        n = max(len(self.position), 1)
        # The mean of phi^|i - j| over all pairs of n rows in a closed form.
        q = 1.0 - phi
        together = 1.0 if q * n < 1e-6 else 1.0 / n + 2.0 * phi * (n * q - 1.0 + phi**n) / (n * q) ** 2
        return max(1.0 - share * together - (1.0 - share) / n, 1e-12)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance, relative to white noise of the same size."""
        return -2.0 * float(np.sum(np.log(self._recursion[3])))

    def innovations(self, columns: np.ndarray) -> np.ndarray:
        """Return columns of all rows, shape (D, m, N), whitened to white noise of the same size."""
        if self.turns is not None:
            columns = turned_into(self.turns, columns)
        return np.asarray(filtered(np.ascontiguousarray(columns), *self._recursion, False))

    def coloured(self, noise: np.ndarray) -> np.ndarray:
        """Return white noise, shape (m, N), with this correlation."""
        found = np.asarray(filtered(np.ascontiguousarray(noise[None]), *self._recursion, True)[0])
        return found if self.turns is None else turned_into(self.turns.swapaxes(1, 2), found)


def turned_into(turns: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return columns, shape (..., m, N), in the frames of N rotations, shape (N, 3, 3), three components at a time."""
    shape = columns.shape
    vectors = columns.reshape(*shape[:-2], shape[-2] // 3, 3, shape[-1])
    return np.asarray(np.einsum("nij,...in->...jn", turns, vectors)).reshape(shape)
