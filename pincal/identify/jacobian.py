"""A Jacobian with curves kept as basis times one shared column, and its Gram matrix.

All basis functions of the curves of one coordinate share that coordinate's column: parameter p
moves the reading at pose i by basis_p(i) times column(i). Stored as factors, a curve of a hundred
splines costs hardly more than one parameter, as only four splines are nonzero at a pose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pincal.model.sparse_basis import (
    Basis,
    SparseBasis,
    add_across,
    add_product,
    dense_rows,
    mirror,
    rows_times,
    some_functions,
    sparse_times,
    sparse_times_dense,
    sparse_times_rows,
    write_times,
)
from pincal.thresholds import Count, Scale

# Columns that an operator along the rows changes at once.
_COLUMNS: Count = 32
# Parts of the poses are padded to one length up to this factor in size, and up to so many poses at
# once.
_PADDING: Scale = 1.5
_AT_ONCE: Count = 512


@dataclass(frozen=True)
class SharedColumns:
    """S parameters that share a column: their indices, their basis, shape (S, n), and the column,
    shape (m, n).

    The column is the derivative of the readings with respect to the coordinate.
    """

    places: np.ndarray
    basis: Basis
    column: np.ndarray

    def times_dense(self, dense: np.ndarray) -> np.ndarray:
        """Return the products with dense columns, shape (D, m, n), shape (S, D)."""
        if isinstance(self.basis, SparseBasis):
            return np.asarray(
                sparse_times_dense(self.basis, np.ascontiguousarray(self.column), dense)
            )
        return np.asarray(self.basis @ np.einsum("mn,dmn->dn", self.column, dense).T)

    def rows_of(self, first: int, end: int) -> np.ndarray:
        """Return the columns of some of the parameters pose by pose, shape (n, m, end - first)."""
        if isinstance(self.basis, SparseBasis):
            found = np.empty((*self.column.shape[::-1], end - first))
            rows_times(self.basis, self.column, first, found)
            return found
        return np.asarray(self.column.T[:, :, None] * self.basis[first:end].T[:, None])

    def times_rows(self, rows: np.ndarray) -> np.ndarray:
        """Return the products with columns that are stored pose by pose, shape (n, m, D), shape
        (S, D).
        """
        if isinstance(self.basis, SparseBasis):
            return np.asarray(sparse_times_rows(self.basis, self.column, rows))
        return np.asarray(self.basis @ np.einsum("mn,nmd->nd", self.column, rows))

    def write_columns(self, out: np.ndarray) -> None:
        """Write the columns, shape (S, m, n), which take far more memory."""
        if isinstance(self.basis, SparseBasis):
            write_times(self.basis, self.column, out)
        else:
            np.multiply(self.basis[:, None], self.column, out=out)


@dataclass(frozen=True)
class Jacobian:
    """Derivative of m readings at n poses with respect to F parameters.

    Attributes:
        size: F.
        places: shape (D,), indices of the parameters with columns of their own.
        dense: shape (D, m, n), these columns.
        families: the other parameters.
    """

    size: int
    places: np.ndarray
    dense: np.ndarray
    families: tuple[SharedColumns, ...] = ()

    def weighted(self, weights: np.ndarray) -> Jacobian:
        """Return the Jacobian times weights of the readings, shape (m, n) or (n,)."""
        families = tuple(replace(f, column=f.column * weights) for f in self.families)
        return replace(self, dense=self.dense * weights, families=families)

    def mapped(self, to: Callable[[np.ndarray], np.ndarray]) -> Jacobian:
        """Return the Jacobian of other readings, of which a linear function gives the columns,
        shape (m', n), by those of these, shape (m, n).
        """
        families = tuple(replace(f, column=to(f.column)) for f in self.families)
        dense = np.array([to(column) for column in self.dense])
        return replace(self, dense=dense if len(dense) else self.dense, families=families)

    def part(self, readings: slice, poses: slice) -> Jacobian:
        """Return the part of some of the m readings at some poses."""
        families = tuple(
            SharedColumns(f.places, _poses(f.basis, poses), f.column[readings, poses])
            for f in self.families
        )
        return Jacobian(self.size, self.places, self.dense[:, readings, poses], families)

    def poses(self, rows: slice) -> Jacobian:
        """Return the part of some poses."""
        return self.part(slice(None), rows)

    def columns(self, most: int, readings: slice) -> np.ndarray:
        """Return the columns of some readings, shape (D, m, n), those of single parameters first.

        Neighbouring functions of a sparse basis with more than ``most`` are summed to so many.
        """
        found = [self.dense[:, readings]]
        for family in self.families:
            basis = family.basis
            if isinstance(basis, SparseBasis):
                rows = dense_rows(basis)
                few = min(most, basis.size)
                basis = np.add.reduceat(rows, np.arange(few) * basis.size // few, axis=0)
            found.append(basis[:, None] * family.column[readings])
        return np.concatenate(found)

    def dense_columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Return all columns, shape (F, m, n), and the indices of their parameters, shape (F,)."""
        own = [self.places, *(family.places for family in self.families)]
        found = np.empty((sum(map(len, own)), *self.dense.shape[1:]))
        found[: len(self.dense)] = self.dense
        parts = np.split(found, np.cumsum(list(map(len, own)))[:-1])
        for family, part in zip(self.families, parts[1:], strict=True):
            family.write_columns(part)
        return found, np.concatenate(own)

    def along(self, steps: np.ndarray) -> np.ndarray:
        """Return the motion of the readings, shape (R, m, n), by R steps of the parameters, shape
        (F, R).
        """
        few = [f for f in self.families if not isinstance(f.basis, SparseBasis)]
        own = (np.asarray(f.basis)[:, None] * f.column for f in few)
        dense = np.concatenate([self.dense, *own])
        places = np.concatenate([self.places, *(f.places for f in few)])
        # Pose by pose, with the steps side by side, which may be as many as parameters.
        moved = np.tensordot(dense.transpose(2, 1, 0), steps[places], axes=1)
        for f in self.families:
            if isinstance(f.basis, SparseBasis):
                add_across(f.basis, f.column, np.ascontiguousarray(steps[f.places]), moved)
        return np.asarray(moved.transpose(2, 1, 0))

    def along_each(self, steps: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Return the motion of the readings, shape (m, n), at each pose by one of R steps, shape
        (F, R), which is given by its index, shape (n,).
        """
        at = np.arange(len(which))
        if self.families:
            return np.asarray(self.along(steps)[which, :, at].T)
        # As the columns are stored, without a copy of them.
        moved = steps[self.places].T @ self.dense.reshape(len(self.dense), -1)
        return np.asarray(moved.reshape(-1, *self.dense.shape[1:])[which, :, at].T)

    def add_grams(
        self,
        residuals: np.ndarray,
        ends: np.ndarray,
        G: np.ndarray,
        g: np.ndarray,
        *,
        weights: np.ndarray | None = None,
    ) -> None:
        """Add J W^2 J^T to G, shape (S, F, F), and J W^2 r to g, shape (S, F), for each of S parts
        of the poses.

        Args:
            residuals: r, shape (m, n).
            ends: shape (S + 1,), boundaries of the parts.
            G: modified in place.
            g: modified in place.
            weights: W, shape (n,) or (m, n); default: 1.
        """
        for some in self._at_once(np.diff(ends)):
            here = slice(int(ends[some.start]), int(ends[some.stop]))
            A = self.poses(here)
            r = residuals[:, here]
            if weights is not None:
                A = A.weighted(weights[..., here])
                r = r * weights[..., here]
            if some.stop - some.start == 1:
                A.add_gram(r, G[some.start], g[some.start])
            else:
                found = A._grams_at_once(r, np.diff(ends[some.start : some.stop + 1]))
                rows, columns = block(at := span(A.places), at)
                G[some][:, rows, columns] += found[0]
                g[some][:, at] += found[1]

    def _at_once(self, counts: np.ndarray) -> Iterator[slice]:
        """Yield runs of parts whose products are computed at once, given the number of poses of
        each.
        """
        start = 0
        longest = 0
        total = 0
        for i, count in enumerate(counts.tolist()):
            longest = max(longest, count)
            total = total + count
            padded = (i + 1 - start) * longest
            if i > start and (self.families or padded > min(_PADDING * total, _AT_ONCE)):
                yield slice(start, i)
                start = i
                longest = count
                total = count
        yield slice(start, len(counts))

    def _grams_at_once(
        self, residuals: np.ndarray, counts: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return J J^T and J r of parts with these numbers of poses in one product, padded with
        zeros to one length.
        """
        A, r = (_padded(of, counts) for of in (self.dense, residuals))
        A = A.transpose(2, 0, 1, 3).reshape(len(counts), len(self.dense), len(r) * r.shape[2])
        r = r.transpose(1, 0, 2).reshape(len(counts), -1, 1)
        return A @ A.swapaxes(1, 2), (A @ r)[..., 0]

    def add_gram(
        self, residuals: np.ndarray, G: np.ndarray, g: np.ndarray, groups: np.ndarray | None = None
    ) -> None:
        """Add J J^T to G, shape (F, F), and J r to g, shape (F,), for residuals r of shape (m, n).

        Args:
            residuals: r.
            G: modified in place.
            g: modified in place.
            groups: shape (F,), group of each column: products of columns of different groups may be
                omitted. Default: one.
        """
        dense = np.ascontiguousarray(self.dense)
        apart = self.places
        A = dense.reshape(len(dense), residuals.size)
        group = np.zeros(self.size, int) if groups is None else groups
        for at in _runs(group[apart]):
            own = span(apart[at])
            G[block(own, own)] += A[at] @ A[at].T
        self.add_slope(residuals, g)
        spans = [span(family.places) for family in self.families]
        meant = [set(group[family.places].tolist()) for family in self.families]
        for i, (family, rows, mine) in enumerate(zip(self.families, spans, meant, strict=True)):
            near = (
                slice(None) if groups is None else np.flatnonzero(np.isin(group[apart], list(mine)))
            )
            columns = span(apart[near])
            part = family.times_dense(dense[near])
            G[block(rows, columns)] += part
            G[block(columns, rows)] += part.T
            for other, columns, others in zip(self.families[: i + 1], spans, meant, strict=False):
                if not mine.isdisjoint(others):
                    _add_products(G, family, rows, other, columns)
        sparse = [
            family.places for family in self.families if isinstance(family.basis, SparseBasis)
        ]
        if sparse:
            mirror(G, np.sort(np.concatenate(sparse)))

    def add_slope(self, residuals: np.ndarray, g: np.ndarray) -> None:
        """Add J r to g, shape (F,), for residuals r of shape (m, n)."""
        A = np.ascontiguousarray(self.dense).reshape(len(self.dense), residuals.size)
        g[span(self.places)] += A @ np.ascontiguousarray(residuals).ravel()
        for family in self.families:
            moved = np.sum(family.column * residuals, axis=0)[:, None]
            g[span(family.places)] += _times(family.basis, moved)[:, 0]

    def add_products(self, others: Jacobian, S: np.ndarray) -> None:
        """Add J K^T to S, shape (F, F'), for other columns K of the same readings."""
        dense, theirs = (np.ascontiguousarray(of.dense) for of in (self, others))
        mine = span(self.places)
        columns = span(others.places)
        size = dense.shape[1] * dense.shape[2]
        S[block(mine, columns)] += (
            dense.reshape(len(dense), size) @ theirs.reshape(len(theirs), size).T
        )
        for family in self.families:
            S[block(span(family.places), columns)] += family.times_dense(theirs)
        for other in others.families:
            across = span(other.places)
            S[block(mine, across)] += other.times_dense(dense).T
            for family in self.families:
                weights = np.sum(family.column * other.column, axis=0)
                if isinstance(family.basis, SparseBasis) and isinstance(other.basis, SparseBasis):
                    add_product(
                        S, family.places, family.basis, weights, other.places, other.basis, False
                    )
                else:
                    S[block(span(family.places), across)] += _product(
                        family.basis, weights, other.basis
                    )

    @property
    def groups(self) -> tuple[_Apart | SharedColumns, ...]:
        """The parameters with columns of their own, and the others."""
        return (_Apart(self.places, self.dense), *self.families)

    def add_products_of_rows(self, rows: np.ndarray, places: np.ndarray, S: np.ndarray) -> None:
        """Add J K^T to S, shape (F, F'), for columns K that are stored pose by pose, shape (n, m,
        D), at these places.
        """
        across = span(places)
        for group in self.groups:
            S[block(span(group.places), across)] += group.times_rows(rows)

    def only(self, columns: np.ndarray) -> Jacobian:
        """Return the part of some columns, in this order."""
        slot = np.full(self.size, -1)
        slot[columns] = np.arange(len(columns))
        kept = slot[self.places] >= 0
        families = []
        for f in self.families:
            if len(at := np.flatnonzero(slot[f.places] >= 0)):
                basis = (
                    some_functions(f.basis, at) if isinstance(f.basis, SparseBasis) else f.basis[at]
                )
                families.append(SharedColumns(slot[f.places[at]], basis, f.column))
        return Jacobian(len(columns), slot[self.places[kept]], self.dense[kept], tuple(families))


@dataclass(frozen=True)
class _Apart:
    """D parameters with columns of their own, shape (D, m, n): as :class:`SharedColumns`."""

    places: np.ndarray
    dense: np.ndarray

    def rows_of(self, first: int, end: int) -> np.ndarray:
        return np.ascontiguousarray(self.dense[first:end].transpose(2, 1, 0))

    def times_rows(self, rows: np.ndarray) -> np.ndarray:
        return np.asarray(sum(self.dense[:, j] @ rows[:, j] for j in range(rows.shape[1])))


@dataclass(frozen=True)
class AlongRows:
    """A Jacobian whose columns an operator along the rows changes: with a few columns changed at a
    time, it takes no more memory than without.

    Attributes:
        plain: the Jacobian, not changed.
        change: changes columns that are stored pose by pose, shape (n, m, D), in place; given
            ``transposed``, by the transpose.
    """

    plain: Jacobian
    change: Callable[..., None]

    def add_grams(
        self,
        residuals: np.ndarray,
        ends: np.ndarray,
        G: np.ndarray,
        g: np.ndarray,
        *,
        weights: np.ndarray | None = None,
    ) -> None:
        """Add to G and g as :meth:`Jacobian.add_grams` does, residuals being changed; all poses are
        one part, and weights, if of each reading, are the same for all, as these have one noise.
        """
        square = np.ones(residuals.shape) if weights is None else np.atleast_2d(weights**2)
        pull = np.ascontiguousarray((square * residuals).T[:, :, None])
        self.change(pull, transposed=True)
        self.plain.add_slope(pull[:, :, 0].T, g[0])
        groups = self.plain.groups
        for k, group in enumerate(groups):
            mine = span(group.places)
            inner = np.zeros((len(group.places), len(group.places)))
            for start in range(0, len(inner), _COLUMNS):
                end = min(start + _COLUMNS, len(inner))
                rows = group.rows_of(start, end)
                self.change(rows)
                rows *= square.T[:, :, None]
                # Changed back, they meet the other columns as these are stored.
                self.change(rows, transposed=True)
                inner[:, start:end] = group.times_rows(rows)
                here = span(group.places[start:end])
                for other in groups[k + 1 :]:
                    across = other.times_rows(rows)
                    there = span(other.places)
                    G[0][block(there, here)] += across
                    G[0][block(here, there)] += across.T
            G[0][block(mine, mine)] += 0.5 * (inner + inner.T)


def _padded(of_poses: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return an array over poses, shape (..., n), in parts of these sizes, padded by zeros, shape
    (..., S, longest).
    """
    longest = int(counts.max())
    if np.all(counts == longest):
        return of_poses.reshape(*of_poses.shape[:-1], len(counts), longest)
    at = np.arange(longest)
    rows = np.minimum((np.cumsum(counts) - counts)[:, None] + at, of_poses.shape[-1] - 1)
    return np.asarray(of_poses[..., rows] * (at < counts[:, None]))


def span(places: np.ndarray) -> slice | np.ndarray:
    """Return indices as a slice if they are consecutive, since slices need no copies."""
    if (
        len(places)
        and places[-1] - places[0] == len(places) - 1
        and (places[1:] - places[:-1] == 1).all()
    ):
        return slice(int(places[0]), int(places[-1]) + 1)
    return places


def block(
    rows: slice | np.ndarray, columns: slice | np.ndarray
) -> tuple[slice | np.ndarray, slice | np.ndarray]:
    """Return the index of a block of a matrix."""
    if isinstance(rows, np.ndarray) and isinstance(columns, np.ndarray):
        return np.ix_(rows, columns)  # type: ignore[return-value]
    return rows, columns


def add_block(whole: np.ndarray, rows: np.ndarray, columns: np.ndarray, part: np.ndarray) -> None:
    """Add a part, shape (..., R, C), to a matrix at these rows and columns, in place: by runs of
    consecutive ones, as single elements take several times as long.
    """
    for here, there in _consecutive(rows):
        for across, along in _consecutive(columns):
            whole[..., there, along] += part[..., here, across]


def _consecutive(places: np.ndarray) -> Iterator[tuple[slice, slice]]:
    """Yield the runs of consecutive indices: where they stand among these, and what they are."""
    cuts = [0, *(np.flatnonzero(np.diff(places) != 1) + 1).tolist(), len(places)]
    for start, end in pairwise(cuts):
        if start < end:
            first = int(places[start])
            yield slice(start, end), slice(first, first + end - start)


def _runs(groups: np.ndarray) -> Iterator[slice]:
    """Yield the runs of columns of one group, of the group of each column."""
    cuts = [0, *(np.flatnonzero(np.diff(groups)) + 1).tolist(), len(groups)]
    for start, end in pairwise(cuts):
        if start < end:
            yield slice(start, end)


def _poses(basis: Basis, rows: slice) -> Basis:
    if isinstance(basis, SparseBasis):
        return basis._replace(starts=basis.starts[rows.start : rows.stop + 1])
    return basis[:, rows]


def _add_products(
    G: np.ndarray,
    family: SharedColumns,
    rows: slice | np.ndarray,
    other: SharedColumns,
    columns: slice | np.ndarray,
) -> None:
    """Add the products of two families, or of one, to G; those of sparse families only below the
    diagonal.
    """
    weights = np.sum(family.column * other.column, axis=0)
    if isinstance(family.basis, SparseBasis) and isinstance(other.basis, SparseBasis):
        add_product(G, family.places, family.basis, weights, other.places, other.basis, True)
        return
    if other is family:
        G[block(rows, columns)] += _own_product(np.asarray(family.basis), weights)
        return
    part = _product(family.basis, weights, other.basis)
    G[block(rows, columns)] += part
    G[block(columns, rows)] += part.T


def _times(basis: Basis, matrix: np.ndarray) -> np.ndarray:
    """Return basis times a row-major matrix of shape (n, D), shape (S, D)."""
    return np.asarray(
        sparse_times(basis, matrix) if isinstance(basis, SparseBasis) else basis @ matrix
    )


def _product(left: Basis, weights: np.ndarray, right: Basis) -> np.ndarray:
    """Return left diag(weights) right^T, dense, at least one basis being dense."""
    if isinstance(right, SparseBasis):
        return _product(right, weights, left).T
    if isinstance(left, SparseBasis):
        # By tiles, as a transposed copy of many functions takes longer than their products.
        dense = np.ascontiguousarray(right)[:, None]
        return np.asarray(sparse_times_dense(left, weights[None], dense))
    return np.asarray((left * weights) @ right.T)


def _own_product(basis: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return basis diag(weights) basis^T for weights of at least 0, of which half is computed."""
    half = basis * np.sqrt(weights)
    return np.asarray(half @ half.T)
