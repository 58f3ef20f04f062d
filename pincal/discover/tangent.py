"""The columns of a model at a fit, made once for all tests against it, and their products with candidates' columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pincal.discover.information import Information
from pincal.discover.products import Products, RowPart, Rows, Whitened
from pincal.identify.fit import Fit
from pincal.identify.jacobian import Jacobian
from pincal.identify.normal import believed, block_rows
from pincal.identify.problem import Problem
from pincal.identify.station import Station
from pincal.model.conditions import part_of
from pincal.model.effect import Effect


@dataclass(frozen=True, eq=False)
class _Piece:
    """Some rows of a station, sorted by their blocks, with the whitened Jacobian of the model.

    Attributes:
        rows: shape (n,), which of all rows of the fit they are.
        groups: shape (n,), the block of each row.
        whitening: shape (m, n).
        residuals: shape (m, n), whitened.
        jacobian: by the station's columns.
    """

    rows: np.ndarray
    groups: np.ndarray
    whitening: np.ndarray
    residuals: np.ndarray
    jacobian: Jacobian

    def parts(self, n_blocks: int) -> Iterator[tuple[int, slice]]:
        """Yield the blocks of rows that are here, and which of the rows they are."""
        if n_blocks == 1:
            yield 0, slice(0, len(self.groups))
            return
        for k in np.unique(self.groups).tolist():
            yield k, slice(*np.searchsorted(self.groups, [k, k + 1]))


class Beside(NamedTuple):
    """Candidates beside a model.

    Attributes:
        problem: the model with all of them.
        known: where the parameters of the fit stand in it.
        model: shape (N,), where those of the model's columns do, what is projected out included.
        tested: shape (C,), where those of the candidates do.
        products: of the candidates' columns.
    """

    problem: Problem
    known: np.ndarray
    model: np.ndarray
    tested: np.ndarray
    products: Products


@dataclass(frozen=True, eq=False)
class Tangent:
    """The columns of a model at a fit, and of what is projected out with it, whitened by the noise that the model leaves.

    Of all candidates' tests against a fit this is the same.

    Attributes:
        fit: the fit.
        nuisance: what is projected out with the model.
        problem: the model with this.
        values, free: shape (P,), of its parameters.
        known: where those of the fit stand among them.
        orders: for each station, its rows sorted by their blocks.
        pieces: for each station, its pieces.
        S: shape (B, N, N), products of the N columns, by block of rows.
        b: shape (B, N), of columns and residuals.
        squares: sum of squared residuals.
        information: what follows from them with priors of geometry so many times as wide as the fit's.
    """

    fit: Fit
    nuisance: tuple[Effect, ...]
    problem: Problem
    values: np.ndarray
    free: np.ndarray
    known: np.ndarray
    orders: tuple[np.ndarray | slice, ...]
    pieces: tuple[tuple[_Piece, ...], ...]
    S: np.ndarray
    b: np.ndarray
    squares: float
    information: dict[float, Information] = field(default_factory=dict)

    @classmethod
    def at(cls, fit: Fit, nuisance: Sequence[Effect], groups: np.ndarray | None) -> Tangent:
        """Return the columns at a fit.

        Args:
            fit: the fit.
            nuisance: effects that are projected out with the model.
            groups: shape (N,), the block of each row; default: one block.
        """
        problem, known = fit.problem.extended(nuisance)
        values, free = np.zeros(len(problem.parameters)), np.ones(len(problem.parameters), bool)
        values[known], free[known] = fit.values, fit.solution.free
        n_blocks, size = 1 if groups is None else int(groups.max()) + 1, int(free.sum())
        S, b, squares = np.zeros((n_blocks, size, size)), np.zeros((n_blocks, size)), 0.0
        column, orders, pieces = np.cumsum(free) - 1, [], []
        for i, station in enumerate(problem.stations):
            rows, places = problem.rows[i], problem.places[i]
            blocks = np.zeros(len(station), int) if groups is None else groups[rows]
            order: np.ndarray | slice = slice(None) if n_blocks == 1 else np.argsort(blocks, kind="stable")
            sorted_station = _sorted(station, order)
            local_values, local_free = values[places], free[places]
            weights, sigma = fit.solution.weights[rows][order], fit.solution.estimated[problem.block_spans[i]]
            mine = column[places[local_free]]
            own_S, own_b, found = _room(S, mine, mine), np.zeros((n_blocks, len(mine))), list[_Piece]()
            for piece, residuals, jacobian in sorted_station.linearise_shared(local_values, local_free):
                whitening = np.empty_like(residuals)
                for readings, s in zip(block_rows(station), sigma, strict=True):
                    whitening[readings] = sorted_station.weights[piece] * weights[piece] / s
                here = np.arange(rows.start, rows.stop)[order][piece]
                part = _Piece(here, blocks[order][piece], whitening, residuals * whitening, jacobian.weighted(whitening))
                for k, some in part.parts(n_blocks):
                    part.jacobian.poses(some).add_gram(part.residuals[:, some], own_S[k], own_b[k])
                squares += float(np.sum(part.residuals**2))
                found.append(part)
            facts = believed(sorted_station, local_values, local_free)
            if facts is not None:
                own_S += facts[0] / n_blocks
                own_b += facts[1] / n_blocks
            b[:, mine] += own_b
            _scatter(own_S, mine, mine, S)
            orders.append(order)
            pieces.append(tuple(found))
        return cls(fit, tuple(nuisance), problem, values, free, known, tuple(orders), tuple(pieces), S, b, squares)

    def beside(self, candidates: Sequence[Effect]) -> Beside:
        """Return the model with candidates, and the products of these columns and of candidates'."""
        problem, known = self.problem.extended(candidates)
        places = [problem.places_at(effect) for effect in candidates]
        values, free = np.zeros(len(problem.parameters)), np.zeros(len(problem.parameters), bool)
        values[known] = self.values
        model, tested = known[self.free], np.concatenate([np.zeros(0, int), *places])
        free[tested] = True
        n_model, n_blocks, n = len(model), len(self.S), len(tested)
        of_model, of_tested = np.cumsum(self.free) - 1, np.zeros(len(values), int)
        of_tested[tested] = np.arange(n)
        ends = np.cumsum([0, *map(len, places)])
        candidate = np.repeat(np.arange(len(places)), np.diff(ends)) if n_blocks == 1 else np.zeros(n, int)
        cross, inner, b = np.zeros((n_blocks, n_model, n)), np.zeros((n_blocks, n, n)), np.zeros((n_blocks, n))
        parts = list[RowPart]()
        for i, station in enumerate(problem.stations):
            local, before = problem.places[i], self.problem.places[i]
            mine, ours = of_model[before[self.free[before]]], of_tested[local[free[local]]]
            own_cross, own_inner, own_b = _room(cross, mine, ours), _room(inner, ours, ours), np.zeros((n_blocks, len(ours)))
            linearised = _sorted(station, self.orders[i]).linearise_shared(values[local], free[local])
            for piece, (_, _, jacobian) in zip(self.pieces[i], linearised, strict=True):
                added = jacobian.weighted(piece.whitening)
                for k, some in piece.parts(n_blocks):
                    part = added.poses(some)
                    part.add_gram(piece.residuals[:, some], own_inner[k], own_b[k], candidate[ours])
                    piece.jacobian.poses(some).add_products(part, own_cross[k])
                whitened = Whitened.of(piece.jacobian, mine, n_model), Whitened.of(added, ours, n)
                parts.append(RowPart(piece.rows, piece.residuals, *whitened))
            b[:, ours] += own_b
            _scatter(own_cross, mine, ours, cross)
            _scatter(own_inner, ours, ours, inner)
        columns = tuple(np.arange(a, b) for a, b in pairwise(ends))
        rows = Rows(tuple(parts), np.arange(n_model), columns, np.zeros(n_model))
        products = Products(columns, cross, inner, b, rows, n_blocks == 1 and len(places) > 1)
        return Beside(problem, known[self.known], model, tested, products)


def _sorted(station: Station, order: np.ndarray | slice) -> Station:
    """Return a station with its rows in another order."""
    if isinstance(order, slice):
        return station
    conditions = part_of(station.conditions, order, ("sorted", order.tobytes()))
    return replace(station.select(order), conditions=conditions)


def _room(S: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return where to add up the products of a station: those of all, where it has all columns in their order."""
    has_all = np.array_equal(rows, np.arange(S.shape[1])) and np.array_equal(columns, np.arange(S.shape[2]))
    return S if has_all else np.zeros((len(S), len(rows), len(columns)))


def _scatter(own: np.ndarray, rows: np.ndarray, columns: np.ndarray, S: np.ndarray) -> None:
    """Add the products of a station's columns to those of all, at their places, if they are not there."""
    for here, mine in _runs(rows) if own is not S else ():
        for there, across in _runs(columns):
            S[:, here, there] += own[:, mine, across]


def _runs(places: np.ndarray) -> list[tuple[slice, slice]]:
    """Return the stretches of places that follow each other, and where they stand in the list: slices need no copies."""
    cuts = np.r_[0, np.flatnonzero(np.diff(places) != 1) + 1, len(places)]
    return [(slice(int(places[a]), int(places[b - 1]) + 1), slice(int(a), int(b))) for a, b in pairwise(cuts) if a < b]
