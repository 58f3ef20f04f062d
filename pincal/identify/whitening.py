r"""Whitening of noise: among the readings of each row, among the rows of a stop, and along the rows
in their order.

Drift of a set-up, moving air or a settling floor correlate the errors of consecutive rows. Each
component of a reading then has, in addition to white noise, an autoregression of first order along
the rows,

.. math:: V_{tu} = \sigma^2 \left( (1 - s) \, \delta_{tu} + s \, \varphi^{|t - u|} \right) ,

which with :math:`\varphi` near 1 is a random walk. Its innovations (Kalman 1960) are independent
and follow from the readings by a recursion, in a time linear in the number of rows, and all methods
for independent rows (fits, score tests, covariances) apply to them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_array

from pincal.compiled import compiled
from pincal.thresholds import Count

# Poses processed at once, so that their data stay in the cache.
_TILE: Count = 512
# Columns that are filtered side by side, and rows of these that stay in the nearest cache.
_AT_ONCE: Count = 8
_ROWS: Count = 128


@compiled(nogil=True)
def whitened_rows(whitening, columns):
    """Return columns, shape (D, m, N), times the lower triangular matrix of each row, shape (m, m,
    N).
    """
    n_columns, m, n = columns.shape
    out = columns.copy()
    for first in range(0, n, _TILE):
        end = min(first + _TILE, n)
        for d in range(n_columns):
            for i in range(m):
                # As slices: loops over these are vectorised.
                to = out[d, i, first:end]
                own = columns[d, i, first:end]
                mine = whitening[i, i, first:end]
                for k in range(end - first):
                    to[k] = mine[k] * own[k]
                for j in range(i):
                    factor = whitening[i, j, first:end]
                    other = columns[d, j, first:end]
                    for k in range(end - first):
                        to[k] += factor[k] * other[k]
    return out


@compiled(nogil=True)
def recursion(phi, share, gaps, counted):
    """Return decay, gain and scale, shape (3, m, N), for :func:`filter_rows`, of an autoregression
    plus white noise.

    Their variances are ``share`` and 1 - ``share``, shape (m,); ``phi`` is the correlation per
    step; ``gaps``, shape (N,), are the steps from the previous row; rows that are not ``counted``
    do not predict the next ones.
    """
    m = len(phi)
    n = len(gaps)
    found = np.empty((3, m, n))
    decay, gain, scale = found
    for i in range(m):
        known = share[i]
        for k in range(n):
            left = phi[i] ** gaps[k]
            known = left * left * known + share[i] * (1.0 - left * left)
            variance = known + 1.0 - share[i]
            decay[i, k] = left
            scale[i, k] = 1.0 / np.sqrt(variance)
            gain[i, k] = known / variance if counted[k] else 0.0
            known *= 1.0 - gain[i, k]
    return found


@compiled(nogil=True)
def filter_rows(columns, before, after, order, coefficients, transposed):
    """Replace columns, shape (D, m, N), by their innovations along rows in an order, each times its
    scale (a Kalman filter).

    The prediction of a row is ``decay`` times the last estimate, which is corrected by ``gain``
    times the innovation: with the scale the coefficients of each row, shape (3, m, N), in this
    order, of shape (N,). Rows are multiplied by ``before`` and by ``after`` the filter, shape (N,).
    If ``transposed``, columns are multiplied by the transpose of all this, given the order, and
    coefficients, from the last row to the first.
    """
    n_columns, m, n = columns.shape
    known = np.empty(_AT_ONCE)
    for first in range(0, n_columns, _AT_ONCE):
        rows = np.zeros((_ROWS, _AT_ONCE))
        some = columns[first : first + _AT_ONCE]
        for i in range(m):
            known[:] = 0.0
            for start in range(0, n, _ROWS):
                here = order[start : start + _ROWS]
                for c in range(len(some)):
                    for k in range(len(here)):
                        rows[k, c] = some[c, i, here[k]] * before[here[k]]
                _step(rows[: len(here)], known, coefficients[:, i, start:], transposed)
                for c in range(len(some)):
                    for k in range(len(here)):
                        some[c, i, here[k]] = rows[k, c] * after[here[k]]


@compiled(nogil=True)
def _step(rows, known, coefficients, transposed):
    """Filter rows of some columns side by side, so that none waits for its own last step; ``known``
    is what the rows before tell of these.
    """
    for k in range(len(rows)):
        decay = coefficients[0, k]
        gain = coefficients[1, k]
        scale = coefficients[2, k]
        for c in range(_AT_ONCE):
            if transposed:
                found = scale * rows[k, c] + gain * known[c]
                known[c] = decay * (known[c] - found)
                rows[k, c] = found
            else:
                expected = decay * known[c]
                beyond = rows[k, c] - expected
                known[c] = expected + gain * beyond
                rows[k, c] = scale * beyond


@compiled(nogil=True)
def filter_across(rows, before, after, order, coefficients, transposed):
    """Do what :func:`filter_rows` does to columns that are stored row by row, shape (N, m, D)."""
    n, m, size = rows.shape
    every = np.zeros((m, size))
    for k in range(n):
        row = order[k]
        first = before[row]
        last = after[row]
        for i in range(m):
            decay = coefficients[0, i, k]
            gain = coefficients[1, i, k]
            scale = coefficients[2, i, k]
            own = rows[row, i]
            known = every[i]
            # As slices: loops over these are vectorised.
            if transposed:
                for c in range(size):
                    found = scale * (first * own[c]) + gain * known[c]
                    known[c] = decay * (known[c] - found)
                    own[c] = last * found
            else:
                for c in range(size):
                    expected = decay * known[c]
                    beyond = first * own[c] - expected
                    known[c] = expected + gain * beyond
                    own[c] = last * (scale * beyond)


@compiled(nogil=True)
def coloured_rows(noise, order, coefficients):
    """Return the rows, shape (m, N), whose innovations along an order, times their scale, are given
    ones; coefficients as of :func:`filter_rows`.
    """
    found = np.empty_like(noise)
    for i in range(len(noise)):
        known = 0.0
        for k in range(len(order)):
            decay, gain, scale = coefficients[:, i, k]
            beyond = noise[i, order[k]] / scale
            found[i, order[k]] = decay * known + beyond
            known = decay * known + gain * beyond
    return found


@dataclass(frozen=True, eq=False, repr=False)
class Serial:
    """Correlation of the noise of N rows of a station along their order.

    Attributes:
        phi: shape (m,), correlation per unit of position, of each component of a reading.
        share: shape (m,), correlated fraction of the variance.
        position: shape (N,), of each row in the order.
        counted: shape (N,), rows that predict the next ones; an outlier does not.
        turns: shape (N, 3, 3), rotation from the frame in which the error persists, such as a loose
            target's, to the readings' frame; default: the same frame.
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

    def of_readings(self, readings: slice) -> Serial:
        """Return the correlation of some components."""
        return replace(self, phi=self.phi[readings], share=self.share[readings])

    @property
    def inflation(self) -> float:
        """Factor by which the correlation raises the variance of a mean of these rows; the largest
        of all components.
        """
        before = np.zeros(len(self.phi))
        of_pairs = np.zeros(len(self.phi))
        for gap in np.diff(np.sort(self.position)):
            # The sum of the correlations of a row with all those before it.
            before = self.phi**gap * (1.0 + before)
            of_pairs += before
        n = max(len(self.position), 1)
        return float(np.max(1.0 + 2.0 * self.share * of_pairs / n))

    @property
    def alone(self) -> np.ndarray | None:
        """Factor on each component that whitens it, shape (m, 1), if all rows are independent."""
        if self.turns is not None or self.share.any():
            return None
        return np.asarray(self._recursion[1][2][:, :1])

    @cached_property
    def _recursion(self) -> tuple[np.ndarray, np.ndarray]:
        """The order of the rows, shape (N,), and decay, gain and scale of each, shape (3, m, N)."""
        order = np.argsort(self.position, kind="stable")
        gaps = np.diff(self.position[order], prepend=self.position[order[:1]])
        size = np.sqrt(
            [
                self._spread(*each)
                for each in zip(self.phi.tolist(), self.share.tolist(), strict=True)
            ]
        )
        coefficients = recursion(self.phi, self.share, gaps, self.counted[order])
        coefficients[2] *= size[:, None]
        return order, coefficients

    def _spread(self, phi: float, share: float) -> float:
        """Return the variance of the rows about their mean, in units of the process's; for a random
        walk it is small.
        """
        n = max(len(self.position), 1)
        # The mean of phi^|i - j| over all pairs of n rows in a closed form.
        q = 1.0 - phi
        together = (
            1.0 if q * n < 1e-6 else 1.0 / n + 2.0 * phi * (n * q - 1.0 + phi**n) / (n * q) ** 2
        )
        return max(1.0 - share * together - (1.0 - share) / n, 1e-12)

    def about_mean(self, component: int) -> float:
        """Return the part of the variance of a component's rows about their mean that persists."""
        share = float(self.share[component])
        spread = self._spread(float(self.phi[component]), share)
        return max(1.0 - (1.0 - share) / spread, 0.0)

    def of_mean(self, component: int) -> float:
        """Return the variance of the mean of what persists, in units of that of the rows about
        their mean.

        The start of a random walk is where it would be without it: its mean is from there by twice
        the variance about the mean, and no process is farther.
        """
        share = float(self.share[component])
        spread = self._spread(float(self.phi[component]), share)
        together = 1.0 - spread - (1.0 - share) / max(len(self.position), 1)
        return min(max(together, 0.0) / spread, 2.0 * self.about_mean(component))

    @cached_property
    def _backwards(self) -> tuple[np.ndarray, np.ndarray]:
        """The same from the last row to the first."""
        order, coefficients = (np.ascontiguousarray(of[..., ::-1]) for of in self._recursion)
        return order, coefficients

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance, relative to white noise of
        the same size.
        """
        return -2.0 * float(np.sum(np.log(self._recursion[1][2])))

    def innovations(self, columns: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        """Return columns of all rows, shape (D, m, N), whitened to white noise of the same size;
        it is that of rows times ``weights``, shape (N,), by default 1.
        """
        found = np.array(columns, order="C")
        self.whiten(found, np.ones(columns.shape[2]) if weights is None else weights)
        return found

    def whiten(self, columns: np.ndarray, weights: np.ndarray, *, transposed: bool = False) -> None:
        """Replace columns by their :meth:`innovations`, in place; or multiply them by the
        transpose of what whitens.
        """
        if transposed:
            filter_rows(columns, 1.0 / weights, weights, *self._backwards, True)
            if self.turns is not None:
                columns[:] = turned_into(self.turns.swapaxes(1, 2), columns)
            return
        if self.turns is not None:
            columns[:] = turned_into(self.turns, columns)
        filter_rows(columns, weights, 1.0 / weights, *self._recursion, False)

    def whiten_rows(
        self, rows: np.ndarray, weights: np.ndarray, *, transposed: bool = False
    ) -> None:
        """Do what :meth:`whiten` does to columns that are stored row by row, shape (N, m, D): of
        many columns in a fifth of the time.
        """
        if transposed:
            filter_across(rows, 1.0 / weights, weights, *self._backwards, True)
            if self.turns is not None:
                rows[:] = _turned_rows(self.turns, rows)
            return
        if self.turns is not None:
            rows[:] = _turned_rows(self.turns.swapaxes(1, 2), rows)
        filter_across(rows, weights, 1.0 / weights, *self._recursion, False)

    def coloured(self, noise: np.ndarray) -> np.ndarray:
        """Return white noise, shape (m, N), with this correlation."""
        found = np.asarray(coloured_rows(np.ascontiguousarray(noise), *self._recursion))
        return found if self.turns is None else turned_into(self.turns.swapaxes(1, 2), found)


@dataclass(frozen=True, eq=False, repr=False)
class StopNoise:
    """Noise that all rows of a stop share, beside independent noise of variance 1: V = 1 + L L^T.

    Attributes:
        levers: shape (r, m, N), L of each row, in units of the independent noise.
        size: shape (m,), standard deviation of both together, a typical row's, by component: noise
            is whitened to this.
        stop: shape (N,), number of each row's stop, from 0.
        axes: eigenvalues, shape (S, r), and eigenvectors, shape (S, r, r), of L^T L of each stop.
        rows: shape (S,), number of rows of each stop behind them.
    """

    levers: np.ndarray
    size: np.ndarray
    stop: np.ndarray
    axes: tuple[np.ndarray, np.ndarray]
    rows: np.ndarray

    @classmethod
    def of(cls, levers: np.ndarray, stop: np.ndarray, size: np.ndarray | None = None) -> StopNoise:
        """Return the noise of rows with levers, shape (r, m, N), in stops, shape (N,); ``size`` by
        default 1.
        """
        size = np.ones(levers.shape[1]) if size is None else size
        stop = np.unique(stop, return_inverse=True)[1].ravel()
        rows = np.bincount(stop)
        G = np.zeros((len(rows), len(levers), len(levers)))
        np.add.at(G, stop, np.einsum("imn,jmn->nij", levers, levers))
        values, vectors = np.linalg.eigh(G)
        return cls(
            np.ascontiguousarray(levers), size, stop, (np.maximum(values, 0.0), vectors), rows
        )

    def select(self, index: Any) -> StopNoise:
        """Return that of some rows (mask, indices or slice)."""
        levers = self.levers[..., index]
        stop = self.stop[index]
        count = np.bincount(stop, minlength=len(self.rows))
        if np.any((count > 0) & (count < self.rows)):
            # Of some stops only a part of the rows is left.
            return StopNoise.of(levers, stop, self.size)
        return replace(self, levers=np.ascontiguousarray(levers), stop=stop)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance, relative to independent noise of the same
        size.
        """
        together = float(np.sum(np.log1p(self.axes[0][np.unique(self.stop)])))
        return together - 2.0 * len(self.stop) * float(np.sum(np.log(self.size)))

    def whitened(self, columns: np.ndarray, *, transposed: bool = False) -> np.ndarray:
        """Return columns of all rows, shape (D, m, N), whitened to white noise of the same size; or
        the transpose of what whitens times the columns.
        """
        root = np.sqrt(1.0 + self.axes[0])
        # (1 / root - 1) / values without the difference of near numbers.
        factor = -1.0 / (root * (root + 1.0))
        size = self.size[:, None]
        if transposed:
            return self._along(columns * size, factor)
        return np.asarray(self._along(columns, factor) * size)

    def coloured(self, noise: np.ndarray) -> np.ndarray:
        """Return white noise, shape (m, N), with this covariance: the inverse of
        :meth:`whitened`.
        """
        independent = noise / self.size[:, None]
        return np.asarray(
            self._along(independent[None], 1.0 / (np.sqrt(1.0 + self.axes[0]) + 1.0))[0]
        )

    def _along(self, columns: np.ndarray, factor: np.ndarray) -> np.ndarray:
        """Return columns plus L U f U^T L^T times these, with the eigenvectors U and factors f,
        shape (S, r).
        """
        vectors = self.axes[1]
        r, m, n = self.levers.shape
        present, stop = np.unique(self.stop, return_inverse=True)
        # One sparse matrix sums over the rows of each stop.
        at = stop.ravel() * r + np.arange(r)[:, None]
        rows = np.broadcast_to(at[:, None], (r, m, n)).ravel()
        places = np.broadcast_to(np.arange(m * n).reshape(1, m, n), (r, m, n)).ravel()
        L = coo_array(
            (self.levers.ravel(), (rows, places)), shape=(len(present) * r, m * n)
        ).tocsr()
        flat = columns.reshape(len(columns), m * n)
        sums = (L @ flat.T).reshape(len(present), r, len(columns))
        U = vectors[present]
        M = (U * factor[present][:, None, :]) @ U.transpose(0, 2, 1)
        back = L.T @ (M @ sums).reshape(len(present) * r, len(columns))
        return np.asarray((flat + back.T).reshape(columns.shape))


def turned_into(turns: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return columns, shape (..., m, N), in the frames of N rotations, shape (N, 3, 3), three
    components at a time.
    """
    shape = columns.shape
    vectors = columns.reshape(*shape[:-2], shape[-2] // 3, 3, shape[-1])
    return np.asarray(np.einsum("nij,...in->...jn", turns, vectors)).reshape(shape)


def _turned_rows(turns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return N rotations, shape (N, 3, 3), times columns that are stored row by row, shape (N, m,
    D), three components at a time.
    """
    n, m, size = rows.shape
    return np.asarray(turns[:, None] @ rows.reshape(n, m // 3, 3, size)).reshape(rows.shape)
