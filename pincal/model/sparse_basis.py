"""Basis functions that are mostly zero, and the compiled loops over what is not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

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


Basis: TypeAlias = np.ndarray | SparseBasis


def sparse_rows(basis: np.ndarray) -> SparseBasis:
    """Return a basis of shape (S, n) without its zeros."""
    pose, place = np.nonzero(basis.T)
    starts = np.concatenate([[0], np.cumsum(np.bincount(pose, minlength=basis.shape[1]))])
    return SparseBasis(starts, place, basis[place, pose], len(basis))


def dense_rows(basis: SparseBasis) -> np.ndarray:
    """Return a basis with its zeros, shape (S, n)."""
    dense = np.zeros((basis.size, len(basis.starts) - 1))
    dense[basis.place, _poses(basis)] = basis.value
    return dense


def joined_rows(bases: Sequence[SparseBasis]) -> SparseBasis:
    """Return the functions of several bases at the same poses, one basis after the other."""
    if len(bases) == 1:
        return bases[0]
    pose = np.concatenate([_poses(basis) for basis in bases])
    first = np.cumsum([0, *(basis.size for basis in bases)])
    order = np.argsort(pose, kind="stable")
    place = np.concatenate([basis.place + start for basis, start in zip(bases, first, strict=False)])[order]
    value = np.concatenate([basis.value for basis in bases])[order]
    starts = np.sum([basis.starts for basis in bases], axis=0)
    return SparseBasis(starts, place, value, int(first[-1]))


def _poses(basis: SparseBasis) -> np.ndarray:
    """Return the pose of each entry."""
    return np.repeat(np.arange(len(basis.starts) - 1), np.diff(basis.starts))


@njit(**_COMPILE)
def sparse_across(basis, matrix):
    """Return the sums over a thin basis of its functions times the rows of a matrix, shape (S, D); shape (n, D)."""
    out = np.zeros((len(basis.starts) - 1, matrix.shape[1]))
    for i in range(len(out)):
        sums = out[i]
        for a in range(basis.starts[i], basis.starts[i + 1]):
            value, row = basis.value[a], matrix[basis.place[a]]
            for d in range(len(row)):
                sums[d] += value * row[d]
    return out


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
