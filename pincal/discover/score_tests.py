"""From a fit to its score tests: columns of the model, made once for all tests against it, and candidates beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from pincal.discover.first_order import Doubt, ScoreTests
from pincal.discover.levers import MassError, missing_features
from pincal.discover.policy import TESTING
from pincal.discover.products import Information, Products, RowPart, Rows, Whitened
from pincal.identify.beliefs import priors_of
from pincal.identify.fit import ModelFit
from pincal.identify.jacobian import Jacobian
from pincal.identify.normal import believed, block_rows
from pincal.identify.problem import Problem, extended
from pincal.identify.quadratic import Form
from pincal.identify.station import Station
from pincal.model.conditions import part_of
from pincal.model.effect import Effect, Family


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
        blocks: what each block of rows says of the N columns.
        squares: sum of squared residuals.
        information: what follows from them with priors of geometry so many times as wide as the fit's.
    """

    fit: ModelFit
    nuisance: tuple[Effect, ...]
    problem: Problem
    values: np.ndarray
    free: np.ndarray
    known: np.ndarray
    orders: tuple[np.ndarray | slice, ...]
    pieces: tuple[tuple[_Piece, ...], ...]
    blocks: Form
    squares: float
    information: dict[float, Information] = field(default_factory=dict)

    @classmethod
    def at(cls, fit: ModelFit, nuisance: Sequence[Effect], groups: np.ndarray | None) -> Tangent:
        """Return the columns at a fit.

        Args:
            fit: the fit.
            nuisance: effects that are projected out with the model.
            groups: shape (N,), the block of each row; default: one block.
        """
        problem, known = extended(fit.problem, nuisance)
        values, free = np.zeros(len(problem.parameters)), np.ones(len(problem.parameters), bool)
        values[known], free[known] = fit.values, fit.solution.free
        n_blocks, size = 1 if groups is None else int(groups.max()) + 1, int(free.sum())
        H, g, squares = np.zeros((n_blocks, size, size)), np.zeros((n_blocks, size)), 0.0
        column, orders, pieces = np.cumsum(free) - 1, [], []
        for i, station in enumerate(problem.stations):
            rows, places = problem.rows[i], problem.places[i]
            blocks = np.zeros(len(station), int) if groups is None else groups[rows]
            order: np.ndarray | slice = slice(None) if n_blocks == 1 else np.argsort(blocks, kind="stable")
            sorted_station = _sorted(station, order)
            local_values, local_free = values[places], free[places]
            weights, sigma = fit.solution.weights[rows][order], fit.solution.estimated[problem.block_spans[i]]
            mine = column[places[local_free]]
            own_H, own_g, found = _room(H, mine, mine), np.zeros((n_blocks, len(mine))), list[_Piece]()
            for piece, residuals, jacobian in sorted_station.linearise_shared(local_values, local_free):
                whitening = np.empty_like(residuals)
                for readings, s in zip(block_rows(station), sigma, strict=True):
                    whitening[readings] = sorted_station.weights[piece] * weights[piece] / s
                here = np.arange(rows.start, rows.stop)[order][piece]
                part = _Piece(here, blocks[order][piece], whitening, residuals * whitening, jacobian.weighted(whitening))
                for k, some in part.parts(n_blocks):
                    part.jacobian.poses(some).add_gram(part.residuals[:, some], own_H[k], own_g[k])
                squares += float(np.sum(part.residuals**2))
                found.append(part)
            facts = believed(sorted_station, local_values, local_free)
            if facts is not None:
                own_H += facts.H / n_blocks
                own_g += facts.g / n_blocks
            g[:, mine] += own_g
            _scatter(own_H, mine, mine, H)
            orders.append(order)
            pieces.append(tuple(found))
        said = Form.of(H, g)
        return cls(fit, tuple(nuisance), problem, values, free, known, tuple(orders), tuple(pieces), said, squares)

    def tests(self, candidates: Sequence[Effect], *, wider: float = TESTING.wider) -> ScoreTests:
        """Return the tests of candidates, none of them in the model; ``wider`` as of :func:`score_test`."""
        fit, (problem, known) = self.fit, extended(self.problem, candidates)
        model, of_fit = known[self.free], known[self.known]
        values = np.zeros(len(problem.parameters))
        values[known] = self.values
        # Of nuisance parameters the sizes are priors as they are, whatever they move.
        sizes = np.array([parameter.size for parameter in problem.parameters])
        sizes[of_fit] = fit.priors.sizes
        for effect in fit.problem.effects:
            sizes[problem.places_at(effect)] *= wider if effect.family is Family.GEOMETRY else 1.0
        alone = fit.problem.with_effects(candidates)
        own, places = priors_of(alone, fit.options).sizes, [problem.places_at(effect) for effect in candidates]
        for effect, at in zip(candidates, places, strict=True):
            sizes[at] = own[alone.places_at(effect)]
        if wider not in self.information:
            beyond, precision = problem.beliefs.beyond_priors(model, values, sizes), sizes[model] ** -2.0
            prior = Form.of(beyond.H + np.diag(precision), beyond.g - values[model] * precision)
            self.information[wider] = Information(self.blocks, prior)
        masses = (effect for effect in self.nuisance if isinstance(effect, MassError))
        unsure = [place for effect in masses for place in problem.places_at(effect)]
        return ScoreTests(
            effects=tuple(candidates),
            names=tuple(problem.parameters[i].name for i in model),
            values=values[model],
            sizes=sizes[np.concatenate([model, *places])],
            model=self.information[wider],
            products=self._products(problem, values, places),
            squares=self.squares,
            readings=int(problem.readings(fit.solution.weights).sum()),
            spent=fit.solution.effective,
            doubt=Doubt(np.isin(model, unsure), *zip(*TESTING.mass_beliefs, strict=True)) if unsure else None,
        )

    def _products(self, problem: Problem, values: np.ndarray, places: Sequence[np.ndarray]) -> Products:
        """Return the products of these columns and of candidates', which stand at some places in a problem with all."""
        tested, free = np.concatenate([np.zeros(0, int), *places]), np.zeros(len(values), bool)
        free[tested] = True
        n_model, n_blocks, n = self.blocks.H.shape[1], len(self.blocks.H), len(tested)
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
        return Products(columns, cross, inner, b, rows, n_blocks == 1 and len(places) > 1)


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


def nuisances(fit: ModelFit, effects: Sequence[Effect]) -> list[Effect]:
    """Return what effects are tested beside: errors of masses, and what a fit and they do not have of its bearings.

    A bearing compliant elsewhere or in other directions than the drawing says is no effect that a name may stand for.
    """
    masses, named = MassError.of(*fit.arm), {effect.identity for effect in effects}
    features = [feature for feature in missing_features(fit) if feature.identity not in named]
    return [masses, *features] if masses else features


@dataclass(frozen=True)
class BesideNuisances:
    """Tests effects against a fit with what is nobody's name projected out; what all tests share is made once.

    Attributes:
        fit: the fit.
    """

    fit: ModelFit
    _tangents: dict[object, Tangent] = field(default_factory=dict, repr=False)

    def __call__(
        self, effects: Sequence[Effect], groups: np.ndarray | None = None, *, wider: float = TESTING.wider
    ) -> ScoreTests:
        """Return the tests of candidates; arguments as of :func:`score_test`."""
        beside = nuisances(self.fit, effects)
        key = (tuple(effect.identity for effect in beside), None if groups is None else groups.tobytes())
        if key not in self._tangents:
            self._tangents[key] = Tangent.at(self.fit, beside, groups)
        return self._tangents[key].tests(effects, wider=wider)


def score_test_given_nuisances(
    fit: ModelFit, effects: Sequence[Effect], groups: np.ndarray | None = None, *, wider: float = TESTING.wider
) -> ScoreTests:
    """Test effects against a fit with what is nobody's name projected out, masses as far as they may be off.

    See :func:`nuisances` and :func:`score_test`.
    """
    return BesideNuisances(fit)(effects, groups, wider=wider)


def score_test(
    fit: ModelFit, candidates: Sequence[Effect], groups: np.ndarray | None = None, *, wider: float = TESTING.wider
) -> ScoreTests:
    """Test candidates against a fit.

    Args:
        fit: the fitted model.
        candidates: effects to test, none of them in the model.
        groups: shape (N,), the block of each training row, for cross-validation; default: one block.
        wider: by how much wider than in the fit the priors of geometry are.
    """
    return Tangent.at(fit, (), groups).tests(candidates, wider=wider)
