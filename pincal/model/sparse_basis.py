"""Sparse basis functions, and compiled loops over their non-zero values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from pincal.compiled import compiled
from pincal.thresholds import Count

# Poses processed at once, so that their data stay in the CPU's cache.
_TILE: Count = 128


class SparseBasis(NamedTuple):
    """S basis functions at n poses, mostly zero: entries of pose i run from ``starts[i]`` to
    ``starts[i + 1]``.

    Attributes:
        starts: shape (n + 1,).
        place: shape (entries,), index of the function of each entry.
        value: shape (entries,).
        size: S.
    """

    starts: np.ndarray
    place: np.ndarray
    value: np.ndarray
    size: int


Basis: TypeAlias = np.ndarray | SparseBasis


def sparse_rows(basis: np.ndarray) -> SparseBasis:
    """Return a basis of shape (S, n) without its zeros."""
    starts, place, value = _without_zeros(np.ascontiguousarray(basis))
    return SparseBasis(starts, place, value, len(basis))


def dense_rows(basis: SparseBasis) -> np.ndarray:
    """Return a basis with its zeros, shape (S, n)."""
    dense = np.zeros((basis.size, len(basis.starts) - 1))
    dense[basis.place, _poses(basis)] = basis.value
    return dense


def some_functions(basis: SparseBasis, which: np.ndarray) -> SparseBasis:
    """Return some functions of a basis, in this order."""
    slot = np.full(basis.size, -1)
    slot[which] = np.arange(len(which))
    kept = slot[basis.place] >= 0
    starts = np.concatenate([[0], np.cumsum(kept)])[basis.starts]
    return SparseBasis(starts, slot[basis.place[kept]], basis.value[kept], len(which))


def joined_rows(bases: Sequence[SparseBasis]) -> SparseBasis:
    """Return the functions of several bases at the same poses, one basis after the other."""
    if len(bases) == 1:
        return bases[0]
    pose = np.concatenate([_poses(basis) for basis in bases])
    first = np.cumsum([0, *(basis.size for basis in bases)])
    order = np.argsort(pose, kind="stable")
    place = np.concatenate(
        [basis.place + start for basis, start in zip(bases, first, strict=False)]
    )[order]
    value = np.concatenate([basis.value for basis in bases])[order]
    starts = np.sum([basis.starts for basis in bases], axis=0)
    return SparseBasis(starts, place, value, int(first[-1]))


def _poses(basis: SparseBasis) -> np.ndarray:
    """Return the pose of each entry."""
    return np.repeat(np.arange(len(basis.starts) - 1), np.diff(basis.starts))


@compiled(nogil=True)
def _without_zeros(basis):
    """Return where the entries of each pose start, their functions in order, and their values."""
    size, n = basis.shape
    starts = np.zeros(n + 1, np.int64)
    for p in range(size):
        for i in range(n):
            starts[i + 1] += basis[p, i] != 0.0
    # A slice assigned at once takes two seconds to compile.
    for i in range(n):
        starts[i + 1] += starts[i]
    place = np.empty(starts[n], np.int64)
    value = np.empty(starts[n])
    end = starts[:n].copy()
    for p in range(size):
        for i in range(n):
            if basis[p, i] != 0.0:
                place[end[i]] = p
                value[end[i]] = basis[p, i]
                end[i] += 1
    return starts, place, value


@compiled(nogil=True)
def sparse_across(basis, matrix):
    """Return the transpose of a sparse basis times a matrix of shape (S, D), shape (n, D)."""
    out = np.zeros((len(basis.starts) - 1, matrix.shape[1]))
    for i in range(len(out)):
        sums = out[i]
        for a in range(basis.starts[i], basis.starts[i + 1]):
            value = basis.value[a]
            row = matrix[basis.place[a]]
            for d in range(len(row)):
                sums[d] += value * row[d]
    return out


@compiled(nogil=True)
def add_across(basis, column, matrix, out):
    """Add to out, shape (n, m, D), the transpose of a sparse basis times a matrix of shape (S, D),
    times a column of shape (m, n): without a copy of all products.
    """
    sums = np.empty(matrix.shape[1])
    for i in range(len(out)):
        sums[:] = 0.0
        for a in range(basis.starts[i], basis.starts[i + 1]):
            value = basis.value[a]
            row = matrix[basis.place[a]]
            for d in range(len(sums)):
                sums[d] += value * row[d]
        for j in range(len(column)):
            factor = column[j, i]
            to = out[i, j]
            for d in range(len(sums)):
                to[d] += factor * sums[d]


@compiled(nogil=True)
def sparse_times(basis, matrix):
    """Return a sparse basis times a row-major matrix of shape (n, D), shape (S, D)."""
    n, n_columns = matrix.shape
    out = np.zeros((basis.size, n_columns))
    for i in range(n):
        for a in range(basis.starts[i], basis.starts[i + 1]):
            value = basis.value[a]
            p = basis.place[a]
            for d in range(n_columns):
                out[p, d] += value * matrix[i, d]
    return out


@compiled(nogil=True)
def write_times(basis, column, out):
    """Write a sparse basis, with its zeros, times a column of shape (m, n), shape (S, m, n)."""
    out[:] = 0.0
    for i in range(column.shape[1]):
        for a in range(basis.starts[i], basis.starts[i + 1]):
            for j in range(len(column)):
                out[basis.place[a], j, i] = basis.value[a] * column[j, i]


@compiled(nogil=True)
def rows_times(basis, column, first, out):
    """Write D functions of a sparse basis, from ``first`` on, times a column of shape (m, n), pose
    by pose: shape (n, m, D).
    """
    out[:] = 0.0
    for i in range(len(out)):
        for a in range(basis.starts[i], basis.starts[i + 1]):
            d = basis.place[a] - first
            if 0 <= d < out.shape[2]:
                for j in range(len(column)):
                    out[i, j, d] = basis.value[a] * column[j, i]


@compiled(nogil=True)
def sparse_times_rows(basis, column, rows):
    """Return a sparse basis, times a column of shape (m, n), times columns that are stored pose by
    pose, shape (n, m, D): shape (S, D).
    """
    n, m, size = rows.shape
    out = np.zeros((basis.size, size))
    sums = np.empty(size)
    for i in range(n):
        sums[:] = 0.0
        for j in range(m):
            factor = column[j, i]
            own = rows[i, j]
            for d in range(size):
                sums[d] += factor * own[d]
        for a in range(basis.starts[i], basis.starts[i + 1]):
            value = basis.value[a]
            to = out[basis.place[a]]
            for d in range(size):
                to[d] += value * sums[d]
    return out


@compiled(nogil=True)
def sparse_times_dense(basis, column, dense):
    """Return a sparse basis, times a column of shape (m, n), times dense columns of shape (D, m,
    n): shape (S, D).
    """
    n_dense, m, n = dense.shape
    out = np.zeros((basis.size, n_dense))
    along = np.empty((_TILE, _TILE))
    total = np.empty(_TILE)
    for first in range(0, n, _TILE):
        size = min(_TILE, n - first)
        for start in range(0, n_dense, _TILE):
            width = min(_TILE, n_dense - start)
            for d in range(width):
                sums = total[:size]
                sums[:] = 0.0
                for j in range(m):
                    # Slices, as loops over these are vectorised.
                    left = column[j, first : first + size]
                    right = dense[start + d, j, first : first + size]
                    for i in range(size):
                        sums[i] += left[i] * right[i]
                for i in range(size):
                    along[i, d] = sums[i]
            for i in range(size):
                row = along[i, :width]
                for a in range(basis.starts[first + i], basis.starts[first + i + 1]):
                    value = basis.value[a]
                    to = out[basis.place[a], start : start + width]
                    for d in range(width):
                        to[d] += value * row[d]
    return out


@compiled(nogil=True)
def add_product(G, rows, left, weights, columns, right, below):
    """Add left diag(weights) right^T of two sparse bases at rows and columns of G; with ``below``,
    to its lower triangle.
    """
    is_same = below and rows[0] == columns[0]
    for i in range(len(weights)):
        first = right.starts[i]
        end = right.starts[i + 1]
        for a in range(left.starts[i], left.starts[i + 1]):
            scaled = left.value[a] * weights[i]
            row = rows[left.place[a]]
            for b in range(first, a + 1 if is_same else end):
                column = columns[right.place[b]]
                if column <= row or not below:
                    G[row, column] += scaled * right.value[b]
                else:
                    G[column, row] += scaled * right.value[b]


@compiled(nogil=True)
def mirror(G, places):
    """Copy the lower triangle of G, at ascending rows and columns, to the upper one."""
    n = len(places)
    for first in range(0, n, _TILE):
        for start in range(0, first + 1, _TILE):
            for i in range(first, min(first + _TILE, n)):
                for j in range(start, min(start + _TILE, i)):
                    G[places[j], places[i]] = G[places[i], places[j]]
