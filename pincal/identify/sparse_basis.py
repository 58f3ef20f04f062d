"""Basis functions that are mostly zero, and the compiled loops over what is not."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

_COMPILE = {"cache": True, "nogil": True}


class SparseBasis(NamedTuple):
    """S basis functions at n poses, most of which are zero: those of pose i stand from ``starts[i]`` to ``starts[i + 1]``.

    Attributes:
        starts: shape (n + 1,).
        place: shape (entries,), which function an entry is of.
        value: shape (entries,).
        size: S.
    """

    starts: np.ndarray
    place: np.ndarray
    value: np.ndarray
    size: int


def sparse_rows(basis: np.ndarray, rows: np.ndarray) -> SparseBasis:
    """Return the functions ``rows`` of a basis of shape (S, n)."""
    starts, place, value = _entries(basis, rows)
    return SparseBasis(starts, place, value, len(rows))


@njit(**_COMPILE)
def sparse_product(left, weights, right):
    """Return left diag(weights) right^T, dense, of two thin bases; weights of shape (n,)."""
    out = np.zeros((left.size, right.size))
    for i in range(len(weights)):
        for a in range(left.starts[i], left.starts[i + 1]):
            scaled = left.value[a] * weights[i]
            for b in range(right.starts[i], right.starts[i + 1]):
                out[left.place[a], right.place[b]] += scaled * right.value[b]
    return out


@njit(**_COMPILE)
def sparse_times(basis, matrix):
    """Return a thin basis times a matrix of shape (n, D), shape (S, D)."""
    out = np.zeros((basis.size, matrix.shape[1]))
    for i in range(matrix.shape[0]):
        row = matrix[i]
        for a in range(basis.starts[i], basis.starts[i + 1]):
            value, sums = basis.value[a], out[basis.place[a]]
            for d in range(len(row)):
                sums[d] += value * row[d]
    return out


@njit(**_COMPILE)
def _entries(basis, rows):
    n = basis.shape[1]
    starts = np.zeros(n + 1, np.int64)
    for p in rows:
        for i in range(n):
            starts[i + 1] += basis[p, i] != 0.0
    starts = np.cumsum(starts)
    at, place, value = starts[:-1].copy(), np.empty(starts[-1], np.int64), np.empty(starts[-1])
    for s in range(len(rows)):
        for i in range(n):
            if basis[rows[s], i] != 0.0:
                place[at[i]], value[at[i]] = s, basis[rows[s], i]
                at[i] += 1
    return starts, place, value
