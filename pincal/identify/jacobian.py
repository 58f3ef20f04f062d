"""A Jacobian whose curves are kept as basis times one shared column, and its Gram matrix.

All the basis functions of curves that act on one coordinate share that coordinate's column: parameter p moves the reading
at pose i by basis_p(i) times column(i). Kept apart, a curve of a hundred splines costs its Gram matrix hardly more than
one parameter does, as only four splines are not zero at a pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pincal.model.sparse_basis import (
    Basis,
    SparseBasis,
    add_product,
    dense_rows,
    mirror,
    some_rows,
    sparse_across,
    sparse_times,
    sparse_times_dense,
)

# Parts of the poses are padded to one length if that makes no more of them than this many times, so many poses at once.
_PADDING = 1.5
_AT_ONCE = 512


@dataclass(frozen=True)
class SharedColumns:
    """Parameters that share a column.

    Attributes:
        places: shape (S,), their columns.
        basis: shape (S, n).
        column: shape (m, n), derivative of the readings by the coordinate.
    """

    places: np.ndarray
    basis: Basis
    column: np.ndarray

    def times_dense(self, dense: np.ndarray) -> np.ndarray:
        """Return the products of their columns with others, shape (D, m, n), shape (S, D)."""
        if isinstance(self.basis, SparseBasis):
            return np.asarray(sparse_times_dense(self.basis, np.ascontiguousarray(self.column), dense))
        return np.asarray(self.basis @ np.einsum("mn,dmn->dn", self.column, dense).T)

    def parted(self, chosen: np.ndarray) -> Iterator[SharedColumns]:
        """Yield them, or those of some chosen columns, shape (F,), and then the others."""
        here = chosen[self.places]
        if here.all() or not here.any():
            yield self
            return
        for at in (np.flatnonzero(here), np.flatnonzero(~here)):
            yield SharedColumns(self.places[at], _functions(self.basis, at), self.column)


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
    families: tuple[SharedColumns, ...] = ()

    def weighted(self, weights: np.ndarray) -> Jacobian:
        """Return it times weights of the readings, shape (m, n) or (n,)."""
        families = tuple(replace(f, column=f.column * weights) for f in self.families)
        return replace(self, dense=self.dense * weights, families=families)

    def part(self, readings: slice, poses: slice) -> Jacobian:
        """Return the part of some of the m readings at some poses."""
        families = tuple(SharedColumns(f.places, _poses(f.basis, poses), f.column[readings, poses]) for f in self.families)
        return Jacobian(self.size, self.places, self.dense[:, readings, poses], families)

    def poses(self, rows: slice) -> Jacobian:
        """Return the part of some poses."""
        return self.part(slice(None), rows)

    def columns(self, most: int, readings: slice) -> np.ndarray:
        """Return the columns of some readings, shape (D, m, n), those that share nothing first.

        Of a thin basis with more than ``most`` functions those of neighbours are added up to so many.
        """
        found = [self.dense[:, readings]]
        for family in self.families:
            basis = family.basis
            if isinstance(basis, SparseBasis):
                rows, few = dense_rows(basis), min(most, basis.size)
                basis = np.add.reduceat(rows, np.arange(few) * basis.size // few, axis=0)
            found.append(basis[:, None] * family.column[readings])
        return np.concatenate(found)

    def along(self, steps: np.ndarray) -> np.ndarray:
        """Return how R steps of the parameters, shape (F, R), move the readings, shape (R, m, n)."""
        moved = np.tensordot(steps[self.places].T, self.dense, axes=1)
        for family in self.families:
            own = np.ascontiguousarray(steps[family.places])
            by_pose = sparse_across(family.basis, own).T if isinstance(family.basis, SparseBasis) else own.T @ family.basis
            moved += by_pose[:, None] * family.column
        return moved

    def grams(
        self, residuals: np.ndarray, ends: np.ndarray, weights: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return J W^2 J^T, shape (S, F, F), and J W^2 r, shape (S, F), of each of S parts of the poses.

        Args:
            residuals: shape (m, n).
            ends: shape (S + 1,), where the parts begin and end.
            weights: shape (n,), W; default: 1.
        """
        n_parts = len(ends) - 1
        G, g = np.zeros((n_parts, self.size, self.size)), np.zeros((n_parts, self.size))
        self.add_grams(residuals, ends, G, g, weights=weights)
        return G, g

    def add_grams(
        self, residuals: np.ndarray, ends: np.ndarray, G: np.ndarray, g: np.ndarray, *, weights: np.ndarray | None = None
    ) -> None:
        """Add what :meth:`grams` returns to G, shape (S, F, F), and g, shape (S, F)."""
        for some in self._at_once(np.diff(ends)):
            here = slice(int(ends[some.start]), int(ends[some.stop]))
            A, r = self.poses(here), residuals[:, here]
            if weights is not None:
                A, r = A.weighted(weights[here]), r * weights[here]
            if some.stop - some.start == 1:
                A.add_gram(r, G[some.start], g[some.start])
            else:
                found = A._grams_at_once(r, np.diff(ends[some.start : some.stop + 1]))
                G[some] += found[0]
                g[some] += found[1]

    def _at_once(self, counts: np.ndarray) -> Iterator[slice]:
        """Yield parts that follow each other whose products are taken at once, given how many poses each has."""
        start, longest, total = 0, 0, 0
        for i, count in enumerate(counts.tolist()):
            longest, total = max(longest, count), total + count
            padded = (i + 1 - start) * longest
            if i > start and (self.families or padded > min(_PADDING * total, _AT_ONCE)):
                yield slice(start, i)
                start, longest, total = i, count, count
        yield slice(start, len(counts))

    def _grams_at_once(self, residuals: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return J J^T and J r of parts of so many poses in one product, the parts padded with zeros to the same length."""
        A, r = (_padded(of, counts) for of in (self.dense, residuals))
        A = A.transpose(2, 0, 1, 3).reshape(len(counts), len(self.dense), len(r) * r.shape[2])
        r = r.transpose(1, 0, 2).reshape(len(counts), -1, 1)
        return A @ A.swapaxes(1, 2), (A @ r)[..., 0]

    def add_gram(
        self, residuals: np.ndarray, G: np.ndarray, g: np.ndarray, groups: np.ndarray | None = None, *, known: int = 0
    ) -> None:
        """Add J J^T to G, shape (F, F), and J r to g, shape (F,).

        Args:
            residuals: shape (m, n).
            G: what J J^T is added to.
            g: what J r is added to.
            groups: shape (F,), the group that each column belongs to, negative for all of them: the products of a column of
                one group with one of another may be left out. Default: one group.
            known: number of first columns whose products with each other are left out; families have all or none of them.
        """
        families, apart, dense = self.families, self.places, np.ascontiguousarray(self.dense)
        of_dense, meant, of_all = {0}, [{0}] * len(families), np.zeros(0, int)
        if groups is not None:
            common = groups < 0
            families = tuple(part for family in families for part in family.parted(common))
            meant = [set(groups[family.places].tolist()) for family in families]
            of_dense, of_all = set(groups[apart].tolist()) - {-1}, np.flatnonzero(common[apart])
        A, n_old = dense.reshape(len(dense), residuals.size), int(np.searchsorted(apart, known))
        old, new = _span(apart[:n_old]), _span(apart[n_old:])
        G[_block(new, new)] += A[n_old:] @ A[n_old:].T
        if n_old:
            cross = A[:n_old] @ A[n_old:].T
            G[_block(old, new)] += cross
            G[_block(new, old)] += cross.T
        g[_span(apart)] += A @ np.ascontiguousarray(residuals).ravel()
        spans = [_span(family.places) for family in families]
        for i, (family, rows, own) in enumerate(zip(families, spans, meant, strict=True)):
            g[rows] += _times(family.basis, np.sum(family.column * residuals, axis=0)[:, None])[:, 0]
            every, is_old = -1 in own or not own.isdisjoint(of_dense), bool(np.all(family.places < known))
            which = slice(n_old, None) if is_old else slice(None) if every else of_all
            columns = _span(apart[which])
            part = family.times_dense(dense[which])
            G[_block(rows, columns)] += part
            G[_block(columns, rows)] += part.T
            for other, columns, others in zip(families[: i + 1], spans, meant, strict=False):
                if is_old and np.all(other.places < known):
                    continue
                if -1 in own or -1 in others or not own.isdisjoint(others):
                    _add_products(G, family, rows, other, columns)
        thin = [family.places for family in families if isinstance(family.basis, SparseBasis)]
        if thin:
            mirror(G, np.sort(np.concatenate(thin)))

    def beside(self, others: Jacobian) -> Jacobian:
        """Return these columns, and others of the same readings behind them."""
        families = tuple(replace(family, places=self.size + family.places) for family in others.families)
        places = np.concatenate([self.places, self.size + others.places])
        dense = np.concatenate([self.dense, others.dense])
        return Jacobian(self.size + others.size, places, dense, (*self.families, *families))

    def only(self, columns: np.ndarray) -> Jacobian:
        """Return the part of some columns, in this order."""
        slot = np.full(self.size, -1)
        slot[columns] = np.arange(len(columns))
        kept = slot[self.places] >= 0
        parts = ((family, np.flatnonzero(slot[family.places] >= 0)) for family in self.families)
        families = tuple(SharedColumns(slot[f.places[at]], _functions(f.basis, at), f.column) for f, at in parts if len(at))
        return Jacobian(len(columns), slot[self.places[kept]], self.dense[kept], families)


def _padded(of_poses: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return what stands for poses, shape (..., n), by parts of so many poses, shape (..., S, longest), zero behind each."""
    longest = int(counts.max())
    if np.all(counts == longest):
        return of_poses.reshape(*of_poses.shape[:-1], len(counts), longest)
    at = np.arange(longest)
    rows = np.minimum((np.cumsum(counts) - counts)[:, None] + at, of_poses.shape[-1] - 1)
    return np.asarray(of_poses[..., rows] * (at < counts[:, None]))


def _span(places: np.ndarray) -> slice | np.ndarray:
    """Return places as a slice if they follow each other, since slices need no copies."""
    if len(places) and places[-1] - places[0] == len(places) - 1 and np.all(np.diff(places) == 1):
        return slice(int(places[0]), int(places[-1]) + 1)
    return places


def _block(rows: slice | np.ndarray, columns: slice | np.ndarray) -> tuple[slice | np.ndarray, slice | np.ndarray]:
    """Return the index of a block of a matrix."""
    if isinstance(rows, np.ndarray) and isinstance(columns, np.ndarray):
        return np.ix_(rows, columns)  # type: ignore[return-value]
    return rows, columns


def _poses(basis: Basis, rows: slice) -> Basis:
    if isinstance(basis, SparseBasis):
        return basis._replace(starts=basis.starts[rows.start : rows.stop + 1])
    return basis[:, rows]


def _functions(basis: Basis, which: np.ndarray) -> Basis:
    """Return some functions of a basis, in this order."""
    return some_rows(basis, which) if isinstance(basis, SparseBasis) else basis[which]


def _add_products(
    G: np.ndarray, family: SharedColumns, rows: slice | np.ndarray, other: SharedColumns, columns: slice | np.ndarray
) -> None:
    """Add the products of two families, or of one, to G at their rows and columns; those of thin ones below its diagonal."""
    weights = np.sum(family.column * other.column, axis=0)
    if isinstance(family.basis, SparseBasis) and isinstance(other.basis, SparseBasis):
        add_product(G, family.places, family.basis, weights, other.places, other.basis)
        return
    part = _product(family.basis, weights, other.basis)
    G[_block(rows, columns)] += part
    if other is not family:
        G[_block(columns, rows)] += part.T


def _times(basis: Basis, matrix: np.ndarray) -> np.ndarray:
    """Return basis times a row-major matrix of shape (n, D), shape (S, D)."""
    return np.asarray(sparse_times(basis, matrix) if isinstance(basis, SparseBasis) else basis @ matrix)


def _product(left: Basis, weights: np.ndarray, right: Basis) -> np.ndarray:
    """Return left diag(weights) right^T, dense, of bases of which one at least is dense."""
    if isinstance(right, SparseBasis):
        return _times(right, np.ascontiguousarray((np.asarray(left) * weights).T)).T
    return _times(left, np.ascontiguousarray((right * weights).T))
