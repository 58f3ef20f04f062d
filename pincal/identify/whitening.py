"""Compiled loops that make noise independent and even: among the readings of each row, and along rows in their order."""

from __future__ import annotations

import numpy as np

from pincal.compiled import compiled

# Poses worked on at once, so that what is needed of them stays in the cache.
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
    """Return decay, gain and scale, shape (m, N), of an autoregression beside white noise, as :func:`filtered` wants them.

    Their variances are ``share`` and the rest of 1, shape (m,); ``gaps``, shape (N,), are the steps from the row before, by
    each of which ``phi`` is left; rows that are not ``counted`` tell nothing of the next ones.
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
def filtered(columns, order, decay, gain, scale):
    """Return the innovations of columns, shape (D, m, N), along rows in an order, each times its scale.

    What is known of a row from those before it is ``decay`` times what was known after the last one, and is put right by
    ``gain`` times what the row itself shows beyond it; order has shape (N,), the others (m, N), in this order.
    """
    n_columns, m, n = columns.shape
    out = np.empty_like(columns)
    for d in range(n_columns):
        for i in range(m):
            known = 0.0
            for k in range(n):
                row = order[k]
                known *= decay[i, k]
                beyond = columns[d, i, row] - known
                out[d, i, row] = beyond * scale[i, k]
                known += gain[i, k] * beyond
    return out


@compiled(nogil=True)
def unfiltered(columns, order, decay, gain, scale):
    """Return columns whose innovations these are; arguments as of :func:`filtered`."""
    n_columns, m, n = columns.shape
    out = np.empty_like(columns)
    for d in range(n_columns):
        for i in range(m):
            known = 0.0
            for k in range(n):
                row = order[k]
                known *= decay[i, k]
                beyond = columns[d, i, row] / scale[i, k]
                out[d, i, row] = known + beyond
                known += gain[i, k] * beyond
    return out
