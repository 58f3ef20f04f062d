"""The columns of a model at a fit, made once for all tests against it, and their products with candidates' columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from pincal.discover.information import Information
from pincal.discover.products import Between, Products
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
        rows: the piece of the station.
        groups: shape (n,), the block of each row.
        whitening: shape (m, n).
        residuals: shape (m, n), whitened.
        jacobian: by the station's columns.
    """

    rows: slice
    groups: np.ndarray
    whitening: np.ndarray
    residuals: np.ndarray
    jacobian: Jacobian

    def add(
        self, jacobian: Jacobian, S: np.ndarray, b: np.ndarray, *, candidate: np.ndarray | None = None, known: int = 0
    ) -> None:
        """Add the products of columns to S and b, by block."""
        if len(S) == 1:
            jacobian.add_gram(self.residuals, S[0], b[0], candidate, known=known)
            return
        for k in np.unique(self.groups):
            here = slice(*np.searchsorted(self.groups, [k, k + 1]))
            jacobian.poses(here).add_gram(self.residuals[:, here], S[k], b[k], known=known)


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
            own_S, own_b = _room(mine, S, b)
            found = []
            for piece, residuals, jacobian in sorted_station.linearise_shared(local_values, local_free):
                whitening = np.empty_like(residuals)
                for readings, s in zip(block_rows(station), sigma, strict=True):
                    whitening[readings] = sorted_station.weights[piece] * weights[piece] / s
                part = _Piece(piece, blocks[order][piece], whitening, residuals * whitening, jacobian.weighted(whitening))
                part.add(part.jacobian, own_S, own_b)
                squares += float(np.sum(part.residuals**2))
                found.append(part)
            facts = believed(sorted_station, local_values, local_free)
            if facts is not None:
                own_S += facts[0] / n_blocks
                own_b += facts[1] / n_blocks
            _scatter(own_S, own_b, mine, S, b)
            orders.append(order)
            pieces.append(tuple(found))
        return cls(fit, tuple(nuisance), problem, values, free, known, tuple(orders), tuple(pieces), S, b, squares)

    def products(self, candidates: Sequence[Effect]) -> Products:
        """Return the products of these columns and of candidates'."""
        problem, known = self.problem.extended(candidates)
        tested = [problem.places_at(effect) for effect in candidates]
        values, free = np.zeros(len(problem.parameters)), np.zeros(len(problem.parameters), bool)
        values[known] = self.values
        model = known[self.free]
        kept = np.concatenate([model, *tested]).astype(int)
        free[kept[len(model) :]] = True
        ends = np.cumsum([0, *map(len, tested)])
        columns, n_model, n_blocks = tuple(np.arange(a, b) for a, b in pairwise(ends)), len(model), len(self.S)
        column = np.full(len(values), -1)
        column[kept] = np.arange(len(kept))
        candidate = np.repeat(np.arange(-1, len(tested)), [n_model, *np.diff(ends)])
        S, b = np.zeros((n_blocks, len(kept), len(kept))), np.zeros((n_blocks, len(kept)))
        parts: list[tuple[np.ndarray, Jacobian]] = []
        for i, station in enumerate(problem.stations):
            places = problem.places[i]
            local_values, local_free = values[places], free[places]
            of_model = column[known[self.problem.places[i]][self.free[self.problem.places[i]]]]
            mine = np.concatenate([of_model, column[places[local_free]]])
            own_S, own_b = _room(mine, S, b)
            slot = np.full(len(kept), -1)
            slot[mine] = np.arange(len(mine))
            linearised = _sorted(station, self.orders[i]).linearise_shared(local_values, local_free)
            for part, (_, _, jacobian) in zip(self.pieces[i], linearised, strict=True):
                both = part.jacobian.beside(jacobian.weighted(part.whitening))
                part.add(both, own_S, own_b, candidate=candidate[mine], known=len(of_model))
                parts.append((slot, both))
            _scatter(own_S, own_b, mine, S, b)
        S[:, :n_model, :n_model], b[:, :n_model] = self.S, self.b
        own = tuple(n_model + of_one for of_one in columns)
        between = Between(own, tuple(parts)) if n_blocks == 1 and len(tested) > 1 else None
        return Products(problem, known[self.known], kept, columns, S, b, between)


def _sorted(station: Station, order: np.ndarray | slice) -> Station:
    """Return a station with its rows in another order."""
    if isinstance(order, slice):
        return station
    conditions = part_of(station.conditions, order, ("sorted", order.tobytes()))
    return replace(station.select(order), conditions=conditions)


def _room(mine: np.ndarray, S: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where to add up the products of a station's columns: those of all, where it has all in their order."""
    if np.array_equal(mine, np.arange(b.shape[1])):
        return S, b
    return np.zeros((len(S), len(mine), len(mine))), np.zeros((len(b), len(mine)))


def _scatter(own_S: np.ndarray, own_b: np.ndarray, mine: np.ndarray, S: np.ndarray, b: np.ndarray) -> None:
    """Add the products of a station's columns to those of all, at their places, if they are not there."""
    for here, rows in _runs(mine) if own_S is not S else ():
        b[:, here] += own_b[:, rows]
        for there, across in _runs(mine):
            S[:, here, there] += own_S[:, rows, across]


def _runs(places: np.ndarray) -> list[tuple[slice, slice]]:
    """Return the stretches of places that follow each other, and where they stand in the list: slices need no copies."""
    cuts = np.r_[0, np.flatnonzero(np.diff(places) != 1) + 1, len(places)]
    return [(slice(int(places[a]), int(places[b - 1]) + 1), slice(int(a), int(b))) for a, b in pairwise(cuts) if a < b]
