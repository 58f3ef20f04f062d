"""Score tests of a fit: columns of the model, computed once for all tests against it, and columns
of candidates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pincal.discover.first_order import ScoreTests
from pincal.discover.levers import missing_features
from pincal.discover.products import Information, RowPart, Whitening
from pincal.discover.score_numbers import TESTING
from pincal.identify.beliefs import priors_of
from pincal.identify.fit import ModelFit
from pincal.identify.jacobian import Jacobian, add_block, block, span
from pincal.identify.mass_error import MassError
from pincal.identify.normal import believed
from pincal.identify.problem import Problem, extended
from pincal.identify.quadratic import Form
from pincal.identify.station import Station
from pincal.model.conditions import part_of
from pincal.model.effect import Effect, Family
from pincal.thresholds import Count

# Columns of candidates that are multiplied at once, and numbers of correlated ones (64 MB).
_MOST_COLUMNS: Count = 128
_MOST_NUMBERS: Count = 8_000_000
# Columns up to which all their products take hardly longer than those of each candidate's own.
_FEW_COLUMNS: Count = 64


class _Piece(NamedTuple):
    """Some rows of a station, sorted by their blocks, with the Jacobian of the model.

    Attributes:
        rows: shape (n,), their indices among all rows of the fit.
        blocks: the blocks of rows in the piece, and their slices.
        whitening: of the rows.
        residuals: shape (m, n), whitened.
        jacobian: by the station's columns, not whitened.
    """

    rows: np.ndarray
    blocks: list[tuple[int, slice]]
    whitening: Whitening
    residuals: np.ndarray
    jacobian: Jacobian


class _StationColumns(NamedTuple):
    """The whitened columns of a model at one station, and their products.

    Attributes:
        order: the station's rows sorted by block.
        pieces: these rows with their columns, piece by piece.
        H, g: shape (blocks, n, n) and (blocks, n), information of each block on its n columns.
    """

    order: np.ndarray | slice
    pieces: tuple[_Piece, ...]
    H: np.ndarray
    g: np.ndarray

    @classmethod
    def at(
        cls,
        fit: ModelFit,
        problem: Problem,
        index: int,
        local: tuple[np.ndarray, np.ndarray],
        groups: np.ndarray | None,
        n_blocks: int,
    ) -> _StationColumns:
        """Return the columns of the station of this index, at its values and by its free
        parameters; ``groups`` are the blocks of its rows, default: one.
        """
        station = problem.stations[index]
        rows = problem.rows[index]
        blocks = np.zeros(len(station), int) if groups is None else groups
        order: np.ndarray | slice = (
            slice(None) if n_blocks == 1 else np.argsort(blocks, kind="stable")
        )
        station = _sorted(station, order)
        noise = np.repeat(fit.solution.estimated[problem.block_spans[index]], station.block_sizes)
        weights = station.weights * fit.solution.weights[rows][order] / noise[:, None]
        numbers = np.arange(rows.start, rows.stop)[order]
        size = int(local[1].sum())
        H = np.zeros((n_blocks, size, size))
        g = np.zeros((n_blocks, size))
        pieces = list[_Piece]()
        for piece, residuals, jacobian in station.linearise_correlated(*local):
            white = Whitening(station, piece, weights[:, piece])
            parts = list(_blocks(blocks[order][piece]))
            residuals = white.whitened(residuals[None])[0]
            pieces.append(_Piece(numbers[piece], parts, white, residuals, jacobian))
            if n_blocks == 1:
                white.add_grams(jacobian, residuals, H, g)
                continue
            for readings, whitened in white.jacobians(jacobian):
                for k, some in parts:
                    whitened.poses(some).add_gram(residuals[readings, some], H[k], g[k])
        if (facts := believed(station, *local)) is not None:
            H = H + facts.H / n_blocks
            g = g + facts.g / n_blocks
        return cls(order, tuple(pieces), H, g)


@dataclass(frozen=True, eq=False)
class Tangent:
    """The columns of a model at a fit and of nuisance effects, whitened by the residual noise;
    shared by all tests.

    Attributes:
        fit: the fit.
        nuisance: effects that are projected out with the model.
        problem: the model with these.
        values, free: shape (P,), of its parameters.
        known: indices of the fit's parameters among them.
        orders: for each station, its rows sorted by block.
        pieces: for each station, its pieces.
        blocks: information of each block of rows on the N columns.
        squares: sum of squared residuals.
        information: with priors, by the factor on the widths of those of geometry.
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
        """Return the columns at a fit; ``groups``, shape (N,), are the blocks of rows, default:
        one.
        """
        problem, known = extended(fit.problem, nuisance)
        values = np.zeros(len(problem.parameters))
        free = np.ones(len(problem.parameters), bool)
        values[known] = fit.values
        free[known] = fit.solution.free
        n_blocks = 1 if groups is None else int(groups.max()) + 1
        size = int(free.sum())
        H = np.zeros((n_blocks, size, size))
        g = np.zeros((n_blocks, size))
        column = np.cumsum(free) - 1
        orders = list[np.ndarray | slice]()
        pieces = list[tuple[_Piece, ...]]()
        for i, places in enumerate(problem.places):
            blocks = None if groups is None else groups[problem.rows[i]]
            local = (values[places], free[places])
            own = _StationColumns.at(fit, problem, i, local, blocks, n_blocks)
            mine = column[places[local[1]]]
            g[:, mine] += own.g
            add_block(H, mine, mine, own.H)
            orders.append(own.order)
            pieces.append(own.pieces)
            # The information of a station's blocks is as large as that of all.
            del own
        squares = sum(
            float(np.sum(part.residuals**2)) for of_station in pieces for part in of_station
        )
        return cls(
            fit=fit,
            nuisance=tuple(nuisance),
            problem=problem,
            values=values,
            free=free,
            known=known,
            orders=tuple(orders),
            pieces=tuple(pieces),
            blocks=Form.of(H, g),
            squares=squares,
        )

    @cached_property
    def joined(self) -> Tangent:
        """The same columns with all rows in one block."""
        if len(self.blocks.H) == 1:
            return self
        pieces = tuple(
            tuple(piece._replace(blocks=[(0, slice(0, len(piece.rows)))]) for piece in of_station)
            for of_station in self.pieces
        )
        rows = self.blocks.sum()
        return replace(
            self, pieces=pieces, blocks=Form.of(rows.H[None], rows.g[None]), information={}
        )

    def with_fewer(self, nuisance: Sequence[Effect]) -> Tangent:
        """Return the same columns with only some of the nuisance effects."""
        problem, known = extended(self.fit.problem, nuisance)
        place = {parameter.name: i for i, parameter in enumerate(self.problem.parameters)}
        at = np.array([place[parameter.name] for parameter in problem.parameters])
        column = np.cumsum(self.free) - 1
        pieces = list[tuple[_Piece, ...]]()
        for before, after, own in zip(
            self.problem.places, problem.places, self.pieces, strict=True
        ):
            kept = np.flatnonzero(np.isin(before[self.free[before]], at[after]))
            of_station = (part._replace(jacobian=part.jacobian.only(kept)) for part in own)
            pieces.append(tuple(of_station))
        return replace(
            self,
            nuisance=tuple(nuisance),
            problem=problem,
            values=self.values[at],
            free=self.free[at],
            known=known,
            pieces=tuple(pieces),
            blocks=self.blocks.part(column[at[self.free[at]]]),
            information={},
        )

    def tests(self, candidates: Sequence[Effect], *, wider: float = TESTING.wider) -> ScoreTests:
        """Return the tests of candidates, none of them in the model; ``wider`` as of
        :func:`score_test`.
        """
        fit = self.fit
        problem, known = extended(self.problem, candidates)
        model = known[self.free]
        values = np.zeros(len(problem.parameters))
        values[known] = self.values
        places = [problem.places_at(effect) for effect in candidates]
        sizes = self._sizes(problem, known[self.known], candidates, wider)
        if wider not in self.information:
            beforehand = _known_before(problem, model, values, sizes)
            self.information[wider] = Information(self.blocks, beforehand)
        masses = (effect for effect in self.nuisance if isinstance(effect, MassError))
        unsure = [place for effect in masses for place in problem.places_at(effect)]
        products, parts = self._products(problem, values, places)
        return ScoreTests(
            effects=tuple(candidates),
            columns=tuple(np.arange(a, b) for a, b in pairwise(np.cumsum([0, *map(len, places)]))),
            names=tuple(problem.parameters[i].name for i in model),
            values=values[model],
            sizes=sizes[np.concatenate([model, *places])],
            unsure=np.isin(model, unsure),
            model=self.information[wider],
            blocks_cross=products.cross,
            blocks_inner=products.inner if products.own is None else tuple(products.own),
            blocks_g=products.g,
            squares=self.squares,
            readings=int(problem.readings(fit.solution.weights).sum()),
            spent=fit.solution.effective,
            parts=parts,
        )

    def _sizes(
        self, problem: Problem, of_fit: np.ndarray, candidates: Sequence[Effect], wider: float
    ) -> np.ndarray:
        """Return the standard deviations of the priors of all parameters, those of geometry
        ``wider`` times as large as in the fit, whose indices are ``of_fit``.
        """
        fit = self.fit
        # Priors of nuisance parameters are not widened.
        sizes = np.array([parameter.size for parameter in problem.parameters])
        sizes[of_fit] = fit.priors.sizes
        for effect in fit.problem.effects:
            sizes[problem.places_at(effect)] *= wider if effect.family is Family.GEOMETRY else 1.0
        alone = fit.problem.with_effects(candidates)
        own = priors_of(alone, fit.options).sizes
        for effect in candidates:
            sizes[problem.places_at(effect)] = own[alone.places_at(effect)]
        return sizes

    def _products(
        self, problem: Problem, values: np.ndarray, places: Sequence[np.ndarray]
    ) -> tuple[_Products, tuple[RowPart, ...]]:
        """Return products and ``parts`` of :class:`ScoreTests`, for the columns at some indices."""
        tested = np.concatenate([np.zeros(0, int), *places])
        free = np.isin(np.arange(len(values)), tested)
        n_model = self.blocks.H.shape[1]
        of_model = np.cumsum(self.free) - 1
        of_tested = np.zeros(len(values), int)
        of_tested[tested] = np.arange(len(tested))
        products = _Products.none(len(self.blocks.H), n_model, list(map(len, places)))
        parts = list[RowPart]()
        for i, station in enumerate(problem.stations):
            local = problem.places[i]
            before = self.problem.places[i]
            mine = of_model[before[self.free[before]]]
            ours = of_tested[local[free[local]]]
            ordered = _sorted(station, self.orders[i])
            linearised = ordered.linearise_correlated(values[local], free[local])
            at = np.append(mine, n_model + ours)
            for piece, (_, _, added) in zip(self.pieces[i], linearised, strict=True):
                products.add(piece, added, mine, ours)
                part = (piece.rows, piece.residuals, piece.jacobian, added, at, piece.whitening)
                parts.append(RowPart(*part))
        return products, tuple(parts)


def _known_before(
    problem: Problem, model: np.ndarray, values: np.ndarray, sizes: np.ndarray
) -> Form:
    """Return what priors and other knowledge say of the parameters at some indices."""
    beyond = problem.beliefs.beyond_priors(model, values, sizes)
    precision = sizes[model] ** -2.0
    return Form.of(beyond.H + np.diag(precision), beyond.g - values[model] * precision)


@dataclass(frozen=True, eq=False)
class _Products:
    """Products of the C columns of candidates, by block of rows.

    Attributes:
        cross: shape (blocks, N, C), with the columns of the model.
        inner: shape (blocks, C, C), with each other; empty if only those of each are kept.
        own: of each candidate's columns with each other, if there is one block and many columns of
            several candidates.
        g: shape (blocks, C), with the residuals.
        candidate: shape (C,), the candidate of each column; the same for all if all products are
            kept.
        starts: first column of each candidate.
    """

    cross: np.ndarray
    inner: np.ndarray
    own: list[np.ndarray] | None
    g: np.ndarray
    candidate: np.ndarray
    starts: np.ndarray

    @classmethod
    def none(cls, n_blocks: int, n_model: int, sizes: Sequence[int]) -> _Products:
        """Return those of no rows, for candidates of so many columns."""
        c = sum(sizes)
        is_partial = n_blocks == 1 and len(sizes) > 1 and c > _FEW_COLUMNS
        each = np.repeat(np.arange(len(sizes)), sizes)
        return cls(
            cross=np.zeros((n_blocks, n_model, c)),
            inner=np.zeros((0, 0, 0) if is_partial else (n_blocks, c, c)),
            own=[np.zeros((size, size)) for size in sizes] if is_partial else None,
            g=np.zeros((n_blocks, c)),
            candidate=each if is_partial else np.zeros(c, int),
            starts=np.cumsum([0, *sizes])[:-1],
        )

    def add(self, piece: _Piece, added: Jacobian, mine: np.ndarray, ours: np.ndarray) -> None:
        """Add a piece of the rows in place, with the model's columns and candidates' columns at
        these indices.
        """
        for columns in self._at_once(piece, self.candidate[ours]):
            some = added if len(columns) == added.size else added.only(columns)
            for readings, whitened in piece.whitening.jacobians(some):
                self._add(piece, readings, whitened, mine, ours[columns])

    def _at_once(self, piece: _Piece, candidate: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the indices of columns, those of a candidate together, that are multiplied at once.

        Products of different candidates are not kept, and correlated columns need an array each.
        """
        most = len(candidate) if self.own is None else _MOST_COLUMNS
        if piece.whitening.station.is_correlated and self.own is not None:
            most = min(most, _MOST_NUMBERS // max(piece.residuals.size, 1))
        if len(candidate) <= most:
            yield np.arange(len(candidate))
            return
        order = np.argsort(candidate, kind="stable")
        cuts = np.flatnonzero(np.diff(candidate[order], append=-1)) + 1
        start = 0
        for end, following in pairwise([*cuts.tolist(), len(order) + most + 1]):
            if following - start > most:
                yield np.sort(order[start:end])
                start = end

    def _add(
        self, piece: _Piece, readings: slice, added: Jacobian, mine: np.ndarray, at: np.ndarray
    ) -> None:
        """Add a piece of the rows with some candidates' columns, whitened at some readings."""
        c = len(at)
        candidate = self.candidate[at]
        for k, some in piece.blocks:
            part = added.poses(some)
            inner = np.zeros((c, c))
            g = np.zeros(c)
            cross = np.zeros((piece.jacobian.size, c))
            part.add_gram(piece.residuals[readings, some], inner, g, candidate)
            piece.whitening.add_products(piece.jacobian, added, cross, readings, some)
            self.g[k][span(at)] += g
            add_block(self.cross[k], mine, at, cross)
            if self.own is None:
                add_block(self.inner[k], at, at, inner)
            else:
                self._add_own(inner, at, candidate)

    def _add_own(self, inner: np.ndarray, at: np.ndarray, candidate: np.ndarray) -> None:
        """Add the products of each candidate's columns with each other."""
        assert self.own is not None
        order = np.argsort(candidate, kind="stable")
        for some in np.split(order, np.flatnonzero(np.diff(candidate[order])) + 1):
            if len(some):
                i = candidate[some[0]]
                here = span(at[some] - self.starts[i])
                self.own[i][block(here, here)] += inner[block(span(some), span(some))]


def _sorted(station: Station, order: np.ndarray | slice) -> Station:
    """Return a station with its rows in another order."""
    if isinstance(order, slice):
        return station
    conditions = part_of(station.conditions, order, ("sorted", order.tobytes()))
    return replace(station.select(order), conditions=conditions)


def _blocks(groups: np.ndarray) -> Iterator[tuple[int, slice]]:
    """Yield the blocks of rows that are sorted by block, and their slices."""
    for k in np.unique(groups).tolist():
        yield k, slice(*np.searchsorted(groups, [k, k + 1]))


def nuisances(fit: ModelFit, effects: Sequence[Effect]) -> list[Effect]:
    """Return the nuisance effects: errors of masses, and bearing features that neither a fit nor
    the tested effects have.

    That a bearing is compliant at another place or in other directions than nominal must not be
    attributed to a name.
    """
    masses = MassError.of(*fit.arm)
    named = {effect.identity for effect in effects}
    features = [feature for feature in missing_features(fit) if feature.identity not in named]
    return [masses, *features] if masses else features


@dataclass(frozen=True)
class GivenNuisances:
    """Tests effects against a fit with nuisances projected out; common parts are computed once.

    Attributes:
        fit: the fit.
        groups: shape (N,), blocks of its rows by which some effects will be tested: one pass over
            the rows then serves all tests. Default: not known.
    """

    fit: ModelFit
    groups: np.ndarray | None = None
    _tangents: dict[object, Tangent] = field(default_factory=dict, repr=False)

    def __call__(
        self,
        effects: Sequence[Effect],
        groups: np.ndarray | None = None,
        *,
        wider: float = TESTING.wider,
    ) -> ScoreTests:
        """Return the tests of candidates; arguments as of :func:`score_test`."""
        found = self._tangent(effects, self.groups if groups is None else groups)
        return (found.joined if groups is None else found).tests(effects, wider=wider)

    def _tangent(self, effects: Sequence[Effect], blocks: np.ndarray | None) -> Tangent:
        """Return the columns of the fit and of the nuisances that some effects leave."""
        nuisance = nuisances(self.fit, effects)
        key = (
            tuple(effect.identity for effect in nuisance),
            None if blocks is None else blocks.tobytes(),
        )
        if key not in self._tangents:
            # Others that leave more of them follow.
            is_part = effects and self.groups is not None
            every = nuisances(self.fit, ()) if is_part else nuisance
            self._tangents[key] = (
                self._tangent((), blocks).with_fewer(nuisance)
                if len(every) > len(nuisance)
                else Tangent.at(self.fit, nuisance, blocks)
            )
        return self._tangents[key]


def score_test_given_nuisances(
    fit: ModelFit,
    effects: Sequence[Effect],
    groups: np.ndarray | None = None,
    *,
    wider: float = TESTING.wider,
) -> ScoreTests:
    """Test effects against a fit with :func:`nuisances` projected out; see :func:`score_test`."""
    return GivenNuisances(fit)(effects, groups, wider=wider)


def score_test(
    fit: ModelFit,
    candidates: Sequence[Effect],
    groups: np.ndarray | None = None,
    *,
    wider: float = TESTING.wider,
) -> ScoreTests:
    """Test candidates against a fit.

    Args:
        fit: the fitted model.
        candidates: effects to test, none of them in the model.
        groups: shape (N,), the block of each training row, for cross-validation; default: one
            block.
        wider: factor on the widths of the fit's priors on geometry.
    """
    return Tangent.at(fit, (), groups).tests(candidates, wider=wider)
