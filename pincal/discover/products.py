"""Products of the whitened columns of a model and of all candidates with each other, and with the residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pincal.identify.fit import Fit
from pincal.identify.jacobian import Jacobian
from pincal.identify.normal import believed, block_rows
from pincal.identify.problem import Problem
from pincal.identify.station import Station
from pincal.model.conditions import part_of


@dataclass(frozen=True, eq=False)
class Between:
    """The columns of candidates, for products of one's with another's: of many candidates few pairs are asked for.

    Attributes:
        columns: for each candidate, its columns among all.
        parts: whitened Jacobians of parts of the rows, each with where every column stands in it, shape (P,), -1 if nowhere.
    """

    columns: tuple[np.ndarray, ...]
    parts: tuple[tuple[np.ndarray, Jacobian], ...]

    def gram(self, which: Sequence[int]) -> np.ndarray:
        """Return the Gram matrix of the J columns of some candidates, shape (J, J)."""
        columns = np.concatenate([self.columns[i] for i in which])
        G = np.zeros((len(columns), len(columns)))
        for slot, jacobian in self.parts:
            here = np.flatnonzero(slot[columns] >= 0)
            own, (m, n) = np.zeros((len(here), len(here))), jacobian.dense.shape[1:]
            jacobian.only(slot[columns[here]]).add_gram(np.zeros((m, n)), own, np.zeros(len(here)))
            G[np.ix_(here, here)] += own
        return G

    def among(self, which: Sequence[int]) -> Between:
        """Return the same of some candidates."""
        return replace(self, columns=tuple(self.columns[i] for i in which))


@dataclass(frozen=True, eq=False)
class Products:
    """Products of P columns, those of the model before those of the candidates, by block of rows.

    Attributes:
        places: shape (P,), where the parameters of the columns stand in the problem.
        n_model: number of columns of the model.
        columns: for each candidate, its columns, counted from the first of all candidates.
        S: shape (B, P, P), of columns; those of one candidate's columns with another's may be left out where there is one
            block of rows.
        b: shape (B, P), of columns and residuals.
        squares: sum of squared residuals.
        between: has what is left out; None if nothing is.
    """

    places: np.ndarray
    n_model: int
    columns: tuple[np.ndarray, ...]
    S: np.ndarray
    b: np.ndarray
    squares: float
    between: Between | None


def products(
    fit: Fit, problem: Problem, values: np.ndarray, free: np.ndarray, tested: Sequence[np.ndarray], groups: np.ndarray
) -> Products:
    """Return the products of the columns of a problem, accumulated over the rows of all its stations.

    Args:
        fit: says how readings are whitened.
        problem: the model with all candidates.
        values: shape (P,), of all parameters.
        free: shape (P,), which have a column.
        tested: for each candidate, where its parameters stand.
        groups: shape (N,), the block of each row.
    """
    last = np.zeros(len(values), bool)
    for places in tested:
        last[places] = True
    kept = np.concatenate([np.flatnonzero(free & ~last), *tested]).astype(int)
    ends = np.cumsum([0, *map(len, tested)])
    columns, n_model = tuple(np.arange(a, b) for a, b in pairwise(ends)), len(kept) - int(ends[-1])
    column = np.full(len(values), -1)
    column[kept] = np.arange(len(kept))
    candidate = np.repeat(np.arange(-1, len(tested)), [n_model, *np.diff(ends)])
    n_blocks, squares = int(groups.max()) + 1, 0.0
    whole_S, whole_b = np.zeros((n_blocks, len(kept), len(kept))), np.zeros((n_blocks, len(kept)))
    parts: list[tuple[np.ndarray, Jacobian]] = []
    for i, station in enumerate(problem.stations):
        order: slice | np.ndarray = slice(None)
        if n_blocks > 1:
            order = np.argsort(groups[problem.rows[i]], kind="stable")
            sorted_rows = part_of(station.conditions, order, ("sorted", order.tobytes()))
            station = replace(station.select(order), conditions=sorted_rows)
        local = values[problem.places[i]], free[problem.places[i]]
        mine = column[problem.places[i][local[1]]]
        found = _Accumulated.zero(n_blocks, candidate[mine])
        found.add(
            station,
            *local,
            weights=fit.solution.weights[problem.rows[i]][order],
            sigma=fit.solution.estimated[problem.block_spans[i]],
            groups=groups[problem.rows[i]][order],
        )
        squares += found.squares
        slot = np.full(len(kept), -1)
        slot[mine] = np.arange(len(mine))
        parts += [(slot, jacobian) for jacobian in found.jacobians]
        if len(problem.stations) == 1 and np.array_equal(mine, np.arange(len(kept))):
            whole_S, whole_b = found.S, found.b
        else:
            for here, rows in _runs(mine):
                whole_b[:, here] += found.b[:, rows]
                for there, across in _runs(mine):
                    whole_S[:, here, there] += found.S[:, rows, across]
    own = tuple(n_model + of_one for of_one in columns)
    between = Between(own, tuple(parts)) if n_blocks == 1 and len(tested) > 1 else None
    return Products(kept, n_model, columns, whole_S, whole_b, squares, between)


def _runs(places: np.ndarray) -> list[tuple[slice, slice]]:
    """Return the stretches of places that follow each other, and where they stand in the list: slices need no copies."""
    cuts = np.r_[0, np.flatnonzero(np.diff(places) != 1) + 1, len(places)]
    return [(slice(int(places[a]), int(places[b - 1]) + 1), slice(int(a), int(b))) for a, b in pairwise(cuts) if a < b]


@dataclass
class _Accumulated:
    """The same of one station, in the order of its free parameters.

    Attributes:
        candidate: shape (F,), that of each column, -1 for the model's.
        S, b, squares: as in :class:`Products`.
        jacobians: whitened, of all pieces of the rows, if there is one block of rows.
    """

    candidate: np.ndarray
    S: np.ndarray
    b: np.ndarray
    squares: float
    jacobians: list[Jacobian]

    @classmethod
    def zero(cls, n_blocks: int, candidate: np.ndarray) -> _Accumulated:
        size = len(candidate)
        return cls(candidate, np.zeros((n_blocks, size, size)), np.zeros((n_blocks, size)), 0.0, [])

    def add(
        self,
        station: Station,
        values: np.ndarray,
        free: np.ndarray,
        *,
        weights: np.ndarray,
        sigma: np.ndarray,
        groups: np.ndarray,
    ) -> None:
        """Add the products of a station's columns, its rows sorted by their groups."""
        n_blocks = len(self.S)
        for piece, residuals, jacobian in station.linearise_shared(values, free):
            whitening = np.empty_like(residuals)
            for rows, s in zip(block_rows(station), sigma, strict=True):
                whitening[rows] = station.weights[piece] * weights[piece] / s
            residuals = residuals * whitening
            jacobian = jacobian.weighted(whitening)
            self.squares += float(np.sum(residuals**2))
            if n_blocks == 1:
                jacobian.add_gram(residuals, self.S[0], self.b[0], self.candidate)
                self.jacobians.append(jacobian)
                continue
            for k in np.unique(groups[piece]):
                here = slice(*np.searchsorted(groups[piece], [k, k + 1]))
                jacobian.poses(here).add_gram(residuals[:, here], self.S[k], self.b[k])
        facts = believed(station, values, free)
        if facts is not None:
            self.S += facts[0] / n_blocks
            self.b += facts[1] / n_blocks
