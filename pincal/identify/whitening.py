"""A compiled loop that makes the noise of each row's readings independent and even."""

from __future__ import annotations

from pincal.compiled import compiled

# Poses worked on at once, so that what is needed of them stays in the cache.
_TILE = 512


@compiled(nogil=True)
def whitened(whitening, columns):
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
