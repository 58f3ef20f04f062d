"""A Jacobian whose curves are kept as basis times one shared column, and its Gram matrix.

All the basis functions of curves that act on one coordinate share that coordinate's column: parameter p moves the reading
at pose i by basis_p(i) times column(i). Kept apart, a curve of a hundred splines costs its Gram matrix hardly more than
one parameter does, as only four splines are not zero at a pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from scipy.sparse import csr_array

Basis: TypeAlias = np.ndarray | csr_array
# Part of a basis function's values that are not zero, below which it is kept sparse.
_THIN = 0.25


@dataclass(frozen=True)
class Family:
    """Parameters that share a column.

    Attributes:
        places: shape (S,), their columns.
        basis: shape (S, n).
        column: shape (m, n), derivative of the readings by the coordinate.
    """

    places: np.ndarray
    basis: Basis
    column: np.ndarray


@dataclass(frozen=True)
class Jacobian:
    """Derivative of m readings at n poses by F parameters.

    Attributes:
        size: F.
        places: shape (D,), columns of the parameters that share nothing.
        dense: shape (D, m, n).
        families: the others.
    """

    size: int
    places: np.ndarray
    dense: np.ndarray
    families: tuple[Family, ...] = ()

    def weighted(self, weights: np.ndarray) -> Jacobian:
        """Return it times weights of the readings, shape (m, n) or (n,)."""
        families = tuple(replace(f, column=f.column * weights) for f in self.families)
        return replace(self, dense=self.dense * weights, families=families)

    def readings(self, rows: slice) -> Jacobian:
        """Return the part of some of the m readings."""
        families = tuple(replace(f, column=f.column[rows]) for f in self.families)
        return replace(self, dense=self.dense[:, rows], families=families)

    def poses(self, rows: slice) -> Jacobian:
        """Return the part of some poses."""
        families = tuple(replace(f, column=f.column[:, rows], basis=f.basis[:, rows]) for f in self.families)
        return replace(self, dense=self.dense[:, :, rows], families=families)

    def gram(self, residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return J J^T, shape (F, F), and J r, shape (F,), for residuals of shape (m, n)."""
        A = np.ascontiguousarray(self.dense).reshape(len(self.dense), residuals.size)
        r = np.ascontiguousarray(residuals).ravel()
        if not self.families:
            return A @ A.T, A @ r
        ends = np.cumsum([len(A), *(len(family.places) for family in self.families)])
        spans = [slice(int(start), int(end)) for start, end in pairwise(ends)]
        first = slice(0, len(A))
        G, g = np.empty((self.size, self.size)), np.empty(self.size)
        G[first, first] = A @ A.T
        g[first] = A @ r
        for i, (family, rows) in enumerate(zip(self.families, spans, strict=True)):
            g[rows] = family.basis @ np.sum(family.column * residuals, axis=0)
            G[rows, first] = family.basis @ np.einsum("mn,dmn->nd", family.column, self.dense)
            G[first, rows] = G[rows, first].T
            for other, columns in zip(self.families[: i + 1], spans, strict=False):
                G[rows, columns] = _product(family.basis, np.sum(family.column * other.column, axis=0), other.basis)
                G[columns, rows] = G[rows, columns].T
        order = np.argsort(np.concatenate([self.places, *(family.places for family in self.families)]))
        return G[np.ix_(order, order)], g[order]


def _product(left: Basis, weights: np.ndarray, right: Basis) -> np.ndarray:
    """Return left diag(weights) right^T, dense."""
    weighted = left * weights if isinstance(left, np.ndarray) else left.multiply(weights).tocsr()
    if isinstance(weighted, np.ndarray) and not isinstance(right, np.ndarray):
        return np.asarray((right @ weighted.T).T)
    product = weighted @ right.T
    return np.asarray(product if isinstance(product, np.ndarray) else product.toarray())


def split_by_density(basis: np.ndarray) -> list[tuple[np.ndarray, Basis]]:
    """Return the rows of a basis that are mostly zero, sparse, and the others, dense, each with their indices."""
    thin = np.count_nonzero(basis, axis=1) < _THIN * basis.shape[1]
    split: list[tuple[np.ndarray, Basis]] = []
    if thin.any():
        split.append((np.flatnonzero(thin), csr_array(basis[thin])))
    if not thin.all():
        split.append((np.flatnonzero(~thin), basis[~thin]))
    return split
