r"""Score tests of candidate effects on the Jacobian of a fitted model.

With A the whitened Jacobian by all parameters (those of the model, N, and those of every candidate, at zero), r the
whitened residuals, S = A A^T and b = A r, everything that criticism asks follows from S and b: with the model's tangent
space and its priors L projected out,

.. math:: S'_{gg} = S_{gg} - S_{gN} (S_{NN} + L)^{-1} S_{Ng}, \qquad T_g = b'^T_g S'^{-1}_{gg} b'_g ,

T_g is what adding effect g and refitting everything would take off the sum of squares (Rao's score test; chi-square with
k_g degrees of freedom if g is not there). One pass over the data serves all candidates.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.special import fdtrc

from pincal.identify.beliefs import priors_of
from pincal.identify.fit import Fit
from pincal.identify.normal import believed, block_rows
from pincal.identify.problem import Problem
from pincal.identify.station import Station
from pincal.model.conditions import part_of
from pincal.model.effect import Family
from pincal.model.effects import Effect

# Part of a column's square that must be left after projection for the data to see it.
_SEEN = 1e-5
# Part of a parameter's prior variance that the data take off, at least, where they see it: they know nothing of what only
# the priors of the model keep apart from it, as of a tilt that geometry is, too, were its lengths as far off as nobody
# builds them.
_TOLD = 0.01
# By how much wider than in a fit the priors of geometry are where effects are tested: one that only they keep apart from
# geometry would be found wherever a machine leaves them. Sound arms with nearly parallel axes do: small errors of these are
# large ones of where their common normal stands.
WIDER = 10.0
# Keeps a scaled matrix of information definite where rounding would not.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Score:
    """The test of one candidate.

    Attributes:
        gain: T, what it takes off the sum of squares (in units of the noise that the model leaves).
        rank: k, directions of it that the data see.
        p_value: of the F test, the places or frequencies paid for among which the candidate was chosen.
        ebic: change of the extended Bayesian information criterion (Chen and Chen 2008); negative is better.
    """

    gain: float
    rank: int
    p_value: float
    ebic: float


@dataclass(frozen=True, eq=False)
class ScoreTests:
    """Gram matrices of a fitted model and of all candidates, whitened by the noise that the model leaves.

    Attributes:
        effects: the candidates.
        columns: for each candidate, its columns, counted from the first column of all candidates.
        names: the parameters of the columns before these, those of the model and of nuisance effects.
        values: their values, shape (len(names),).
        sizes: shape (P,), standard deviations of the priors.
        known: shape (n_model, n_model), inverse covariance of what was known of the model's parameters before.
        pull: shape (n_model,), slope of the sum of squares by it at the present values.
        blocks_S, blocks_b: shape (B, P, P), (B, P), S and b by block of poses.
        squares: weighted sum of squared residuals.
        readings: number of readings that count.
        spent: parameters spent by the model.
    """

    effects: tuple[Effect, ...]
    columns: tuple[np.ndarray, ...]
    names: tuple[str, ...]
    values: np.ndarray
    sizes: np.ndarray
    known: np.ndarray
    pull: np.ndarray
    blocks_S: np.ndarray
    blocks_b: np.ndarray
    squares: float
    readings: int
    spent: float

    @cached_property
    def S(self) -> np.ndarray:
        """Gram matrix of all blocks, shape (P, P)."""
        return self.blocks_S[0] if len(self.blocks_S) == 1 else np.asarray(self.blocks_S.sum(axis=0))

    @cached_property
    def b(self) -> np.ndarray:
        """Products with the residuals of all blocks, shape (P,)."""
        return np.asarray(self.blocks_b.sum(axis=0))

    @property
    def n_model(self) -> int:
        """Number of columns of the model and of nuisance effects."""
        return len(self.names)

    @property
    def precision(self) -> np.ndarray:
        """Inverse variances of the priors, shape (P,)."""
        return np.asarray(self.sizes**-2.0)

    @property
    def dof(self) -> float:
        """Degrees of freedom that the model leaves."""
        return max(self.readings - self.spent, 1.0)

    @cached_property
    def projected(self) -> tuple[np.ndarray, np.ndarray]:
        """S' and b' of all candidate columns."""
        N, C = slice(0, self.n_model), slice(self.n_model, None)
        scale, L = _scaled_factor(self.S[N, N] + self.known)
        left = solve_triangular(L, scale[:, None] * self.S[N, C], lower=True, check_finite=False)
        slope = solve_triangular(L, scale * (self.b[N] - self.pull), lower=True, check_finite=False)
        return self.S[C, C] - left.T @ left, self.b[C] - left.T @ slope

    def columns_of(self, which: Sequence[int]) -> np.ndarray:
        """Return the columns of some candidates, counted from the first candidate column."""
        return np.concatenate([self.columns[i] for i in which])

    def gain(self, which: Sequence[int]) -> tuple[float, int]:
        """Return T and rank of some candidates together."""
        if len(which) == 1:
            gains, ranks = self._alone
            return float(gains[which[0]]), int(ranks[which[0]])
        j, whitening = self.whitening(which)
        return float(np.sum((self.projected[1][j] @ whitening) ** 2)), whitening.shape[1]

    @cached_property
    def _alone(self) -> tuple[np.ndarray, np.ndarray]:
        """T and rank of each of C candidates by itself, shape (C,); those of one size are worked out at once."""
        S, b = self.projected
        sizes = np.array([len(j) for j in self.columns])
        gains, ranks = np.zeros(len(sizes)), np.zeros(len(sizes), int)
        for size in np.unique(sizes):
            some = np.flatnonzero(sizes == size)
            j = np.array([self.columns[i] for i in some])
            scale = 1.0 / np.sqrt(np.maximum(np.diag(self.S)[self.n_model + j], 1e-300))
            values, vectors = np.linalg.eigh(S[j[:, :, None], j[:, None]] * scale[:, :, None] * scale[:, None])
            seen = self._seen(j, scale, values, vectors)
            along = np.einsum("gi,gik->gk", scale * b[j], vectors) ** 2
            gains[some] = np.sum(np.where(seen, along / np.where(seen, values, 1.0), 0.0), axis=1)
            ranks[some] = seen.sum(axis=1)
        return gains, ranks

    def whitening(self, which: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the J columns of some candidates, and W, shape (J, rank), with T = |b' W|^2 for b' at these columns."""
        j = self.columns_of(which)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.S)[self.n_model + j], 1e-300))
        values, vectors = np.linalg.eigh(self.projected[0][np.ix_(j, j)] * np.outer(scale, scale))
        seen = self._seen(j, scale, values, vectors)
        return j, scale[:, None] * vectors[:, seen] / np.sqrt(values[seen])

    def _seen(self, j: np.ndarray, scale: np.ndarray, values: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Return which eigenvectors, shape (..., J, J), of J columns the data see; shape (..., J) like all others."""
        expected = (self.sizes[self.n_model + j] / scale) ** 2
        told = values * np.einsum("...i,...ik->...k", expected, vectors**2)
        return np.asarray((values > _SEEN) & (told > _TOLD))

    def score(self, which: Sequence[int], groups: int) -> Score:
        """Return the test of some candidates taken as one, of so many groups that are tested."""
        looks = math.prod(self.effects[i].looks for i in which)
        return self._judged(*self.gain(which), groups, looks)

    def score_given(self, which: Sequence[int], given: Sequence[int], groups: int = 1) -> Score:
        """Return the test of what some candidates still explain once others are in the model."""
        both, rank_both = self.gain(sorted({*which, *given}))
        alone, rank_alone = self.gain(given)
        return self._judged(both - alone, max(rank_both - rank_alone, 0), groups, beside=(alone, rank_alone))

    def p_value_of_any(self, which: Sequence[int]) -> float:
        """Return the p-value of some candidates, of all as one or of one of them alone, its choice paid for.

        One joint's drive that gives way is lost among as many parameters as all drives and bearings have.
        """
        alone = (len(which) * self.score([i], 1).p_value for i in which)
        return min(self.score(which, 1).p_value, *alone)

    def _judged(
        self, gain: float, rank: int, groups: int, looks: float = 1.0, beside: tuple[float, int] = (0.0, 0)
    ) -> Score:
        if rank == 0:
            return Score(0.0, 0, 1.0, np.inf)
        squares, dof = max(self.squares - beside[0], 1e-6 * self.squares), self.dof - beside[1]
        gain = min(gain, 0.999999 * squares)
        left, rest = squares - gain, max(dof - rank, 1.0)
        p_value = min(looks * float(fdtrc(rank, rest, (gain / rank) / (left / rest))), 1.0)
        price = rank * np.log(self.readings) + 2.0 * np.log(max(groups, 1) * looks)
        ebic = self.readings * np.log(left / squares) + price
        return Score(gain, rank, p_value, float(ebic))

    def log_evidence(self, which: Sequence[int]) -> float:
        """Return the log of how much likelier the data are with some candidates, whatever their values, than without.

        Their priors decide what they may be: a wide one costs more, which no p-value knows (Bayes factor, first order). The
        places or frequencies among which they were chosen cost, too.
        """
        S, b = self.projected
        j = self.columns_of(which)
        size = self.sizes[self.n_model + j]
        information = np.outer(size, size) * S[np.ix_(j, j)] + np.eye(len(j))
        step = np.linalg.solve(information, size * b[j])
        looks = sum(float(np.log(self.effects[i].looks)) for i in which)
        return float(0.5 * (size * b[j]) @ step - 0.5 * np.linalg.slogdet(information)[1]) - looks

    def gains_by_block(self, which: Sequence[int]) -> np.ndarray:
        """Return by how much some candidates lower the squared prediction error on each block left out, shape (B,).

        Both the model and the model with the candidates are refitted, to first order, without each block.
        """
        j = self.n_model + self.columns_of(which)
        return np.array([self._gain_left_out(k, j) for k in range(len(self.blocks_S))])

    def _gain_left_out(self, k: int, j: np.ndarray) -> float:
        """Return by how much the columns ``j``, fitted without block k, lower the squared error on it."""
        S, b, N, own = self.blocks_S[k], self.blocks_b[k], slice(0, self.n_model), np.ix_(j, j)
        model_scale, model_factor, model_step = self._without_block[k]
        cross = self.S[N, j] - S[N, j]
        carried = model_scale[:, None] * cho_solve((model_factor, True), model_scale[:, None] * cross, check_finite=False)
        scale, factor = _scaled_factor(self.S[own] - S[own] - cross.T @ carried + np.diag(self.precision[j]))
        slope = scale * (self.b[j] - b[j] - cross.T @ model_step)
        step = scale * cho_solve((factor, True), slope, check_finite=False)
        change = -carried @ step
        along = S[N, N] @ change + S[N, j] @ step
        beside = S[j, N] @ change + S[own] @ step
        left = b[N] - S[N, N] @ model_step, b[j] - S[j, N] @ model_step
        return float(2.0 * (change @ left[0] + step @ left[1]) - change @ along - step @ beside)

    def costs_instead(self, which: Sequence[int], lost: Mapping[str, float]) -> list[float]:
        """Return the changes of the information criterion if each candidate took the place of some parameters of the model.

        Both are in the model first, priors included, and these parameters then lose what they are told to, to first order.
        """
        j = np.array([i for i, name in enumerate(self.names) if name in lost], int)
        N = slice(0, self.n_model)
        scale, factor = _scaled_factor(self.S[N, N] + self.known)
        units = np.eye(self.n_model)[:, j]
        columns = scale[:, None] * cho_solve((factor, True), scale[:, None] * units, check_finite=False)
        values = np.array([lost[self.names[i]] for i in j]) + columns.T @ (self.b[N] - self.pull)
        spared = float(np.sum(np.clip(1.0 - np.diag(columns[j]) * self.precision[j], 0.0, 1.0)))
        S, b = self.projected
        costs = []
        for c in (self.columns[i] for i in which):
            inverse = np.linalg.inv(S[np.ix_(c, c)] + np.diag(self.precision[self.n_model + c]))
            cross = columns.T @ self.S[N, self.n_model + c]
            left = values - cross @ inverse @ b[c]
            loss = left @ np.linalg.solve(columns[j] + cross @ inverse @ cross.T, left) - b[c] @ inverse @ b[c]
            costs.append(float(loss + (len(c) - spared) * np.log(self.readings)))
        return costs

    def losses_by_block(self, names: Collection[str], still: Collection[str] = ()) -> np.ndarray:
        """Return by how much the squared error on each block left out grows without some of the model, shape (B,).

        Their values are held at zero and all others refitted, to first order, without each block.

        Args:
            names: parameters of the model.
            still: others that stay as they are, as what they do is done by way of those that go.
        """
        j = np.array([i for i, name in enumerate(self.names) if name in names or name in still], int)
        goes = np.array([self.names[i] in names for i in j], bool)
        units, N, losses = np.eye(self.n_model)[:, j], slice(0, self.n_model), np.zeros(len(self.blocks_S))
        for k, (scale, factor, step) in enumerate(self._without_block if len(j) else ()):
            columns = scale[:, None] * cho_solve((factor, True), scale[:, None] * units, check_finite=False)
            held = step - columns @ np.linalg.solve(columns[j], step[j] + goes * self.values[j])
            S, b = self.blocks_S[k, N, N], self.blocks_b[k, N]
            losses[k] = held @ S @ held - step @ S @ step - 2.0 * b @ (held - step)
        return losses

    @cached_property
    def _without_block(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Scale and factor of the model's information without each block, and the step of its parameters."""
        N, found = slice(0, self.n_model), []
        for S, b in zip(self.blocks_S, self.blocks_b, strict=True):
            scale, factor = _scaled_factor(self.S[N, N] - S[N, N] + self.known)
            slope = scale * (self.b[N] - b[N] - self.pull)
            found.append((scale, factor, scale * cho_solve((factor, True), slope, check_finite=False)))
        return found

    def among(self, which: Sequence[int], gone: Collection[str]) -> ScoreTests:
        """Return the tests of some candidates against the model as it stands with some of its parameters at zero.

        To first order nothing has to be evaluated again: without columns J of value v, r grows by J v, and b by S v.
        """
        stays = np.array([name not in gone for name in self.names], bool)
        model, out = np.flatnonzero(stays), np.flatnonzero(~stays)
        kept = np.concatenate([model, self.n_model + self.columns_of(which)])
        v, S = self.values[out], self.blocks_S[:, :, out]
        ends = np.cumsum([0, *(len(self.columns[i]) for i in which)])
        return replace(
            self,
            effects=tuple(self.effects[i] for i in which),
            columns=tuple(np.arange(a, b) for a, b in pairwise(ends)),
            names=tuple(self.names[i] for i in model),
            values=self.values[model],
            sizes=self.sizes[kept],
            known=self.known[np.ix_(model, model)],
            pull=self.pull[model],
            blocks_S=self.blocks_S[:, kept[:, None], kept],
            blocks_b=self.blocks_b[:, kept] + S[:, kept] @ v,
            squares=self.squares + float(v @ (2.0 * self.b[out] + S[:, out].sum(axis=0) @ v)),
        )

    def estimate(self, which: Sequence[int]) -> np.ndarray:
        """Return some candidates' parameters to first order, priors included."""
        S, b = self.projected
        j = self.columns_of(which)
        return np.asarray(np.linalg.inv(S[np.ix_(j, j)] + np.diag(self.precision[self.n_model + j])) @ b[j])


def standard_errors(gains: np.ndarray) -> float:
    """Return the sum of what blocks of poses left out gain, in its standard errors as the blocks differ.

    More than one is what it takes, here and everywhere in a discovery, to call a prediction better.
    """
    return float(gains.sum() / max(gains.std(ddof=1) * np.sqrt(len(gains)), 1e-300)) if len(gains) > 1 else 0.0


def enough_errors(effect: Effect) -> float:
    """Return how many standard errors blocks left out have to gain by an effect.

    One; two by an effect that is the best of many that were looked at on all blocks, such as waves of all orders: to be the
    best it took chance for help, in the blocks left out as well. Of the ripples that chance does not explain on a real UR10
    that one comes up in both series, at 2.4 and 2.2; the others reach 1.7 at most.
    """
    return 2.0 if effect.looks > 1.0 else 1.0


def _scaled_factor(H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return s and the lower Cholesky factor of diag(s) H diag(s), whose diagonal is 1; H is overwritten."""
    scale = np.asarray(1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300)))
    H *= np.outer(scale, scale)
    H[np.diag_indices_from(H)] += _ROUNDING
    return scale, cholesky(H, lower=True, overwrite_a=True, check_finite=False)


def score_test(
    fit: Fit,
    candidates: Sequence[Effect],
    nuisance: Sequence[Effect] = (),
    groups: np.ndarray | None = None,
    *,
    wider: float = WIDER,
) -> ScoreTests:
    """Test candidates against a fit.

    Args:
        fit: the fitted model.
        candidates: effects to test, none of them in the model.
        nuisance: effects that are projected out but not tested.
        groups: shape (N,), the block of each training row, for cross-validation; default: one block.
        wider: by how much wider than in the fit the priors of geometry are.
    """
    problem, known = fit.problem.extended([*nuisance, *candidates])
    groups = np.zeros(len(problem), int) if groups is None else groups
    # Nuisance parameters are relative errors: their sizes are priors as they are, whatever they move.
    sizes = np.array([parameter.size for parameter in problem.parameters])
    sizes[known] = fit.priors.sizes
    for effect in fit.problem.effects:
        sizes[problem.places_at(effect)] *= wider if effect.family is Family.GEOMETRY else 1.0
    alone = fit.problem.with_effects(candidates)
    found, tested = priors_of(alone, fit.options).sizes, [problem.places_at(effect) for effect in candidates]
    for effect, places in zip(candidates, tested, strict=True):
        sizes[places] = found[alone.places_at(effect)]
    values, free = np.zeros(len(problem.parameters)), np.ones(len(problem.parameters), bool)
    values[known], free[known] = fit.values, fit.solution.free
    blocks_S, blocks_b, squares, kept = _gram(fit, problem, values, free, tested, groups)
    ends = np.cumsum([0, *map(len, tested)])
    n_model = len(kept) - int(ends[-1])
    model = kept[:n_model]
    beyond, slope = problem.beyond_priors(model, values, sizes)
    counts = problem.counted_rows(fit.solution.weights)[problem.station_of_block]
    return ScoreTests(
        effects=tuple(candidates),
        columns=tuple(np.arange(a, b) for a, b in pairwise(ends)),
        names=tuple(problem.parameters[i].name for i in model),
        values=values[model],
        sizes=sizes[kept],
        known=np.diag(sizes[model] ** -2.0) + beyond,
        pull=values[model] * sizes[model] ** -2.0 - slope,
        blocks_S=blocks_S,
        blocks_b=blocks_b,
        squares=squares,
        readings=int(counts @ problem.block_sizes),
        spent=fit.solution.posterior.effective,
    )


def _gram(
    fit: Fit, problem: Problem, values: np.ndarray, free: np.ndarray, tested: Sequence[np.ndarray], groups: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Accumulate Gram matrices block of poses by block of poses, over all stations.

    Returns:
        G, shape (B, F, F), and g, shape (B, F), of the free parameters, those to be tested last; the sum of squares; and
        the places of these parameters, shape (F,).
    """
    last = np.zeros(len(values), bool)
    for places in tested:
        last[places] = True
    kept = np.concatenate([np.flatnonzero(free & ~last), *tested]).astype(int)
    column = np.full(len(values), -1)
    column[kept] = np.arange(len(kept))
    n_blocks, squares = int(groups.max()) + 1, 0.0
    whole_S, whole_b = np.zeros((n_blocks, len(kept), len(kept))), np.zeros((n_blocks, len(kept)))
    for i, station in enumerate(problem.stations):
        order: slice | np.ndarray = slice(None)
        if n_blocks > 1:
            order = np.argsort(groups[problem.rows[i]], kind="stable")
            sorted_rows = part_of(station.conditions, order, ("sorted", order.tobytes()))
            station = replace(station.select(order), conditions=sorted_rows)
        local = values[problem.places[i]], free[problem.places[i]]
        weights = fit.solution.weights[problem.rows[i]][order]
        sigma = fit.solution.estimated[problem.block_spans[i]]
        S, b, found = _station_gram(
            station, *local, weights=weights, sigma=sigma, groups=groups[problem.rows[i]][order], n=n_blocks
        )
        mine = column[problem.places[i][local[1]]]
        squares += found
        if len(problem.stations) == 1 and np.array_equal(mine, np.arange(len(kept))):
            whole_S, whole_b = S, b
        else:
            for here, rows in _runs(mine):
                whole_b[:, here] += b[:, rows]
                for there, columns in _runs(mine):
                    whole_S[:, here, there] += S[:, rows, columns]
    return whole_S, whole_b, squares, kept


def _runs(places: np.ndarray) -> list[tuple[slice, slice]]:
    """Return the stretches of places that follow each other, and where they stand in the list: slices need no copies."""
    cuts = np.r_[0, np.flatnonzero(np.diff(places) != 1) + 1, len(places)]
    return [(slice(int(places[a]), int(places[b - 1]) + 1), slice(int(a), int(b))) for a, b in pairwise(cuts) if a < b]


def _station_gram(
    station: Station,
    values: np.ndarray,
    free: np.ndarray,
    *,
    weights: np.ndarray,
    sigma: np.ndarray,
    groups: np.ndarray,
    n: int,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the same of one station, its rows sorted by their groups, in the order of its free parameters."""
    size = int(free.sum())
    blocks_S, blocks_b, squares = np.zeros((n, size, size)), np.zeros((n, size)), 0.0
    for piece, residuals, jacobian in station.linearise_shared(values, free):
        whitening = np.empty_like(residuals)
        for rows, s in zip(block_rows(station), sigma, strict=True):
            whitening[rows] = station.weights[piece] * weights[piece] / s
        residuals = residuals * whitening
        jacobian = jacobian.weighted(whitening)
        squares += float(np.sum(residuals**2))
        for k in np.unique(groups[piece]):
            here = slice(*np.searchsorted(groups[piece], [k, k + 1]))
            jacobian.poses(here).add_gram(residuals[:, here], blocks_S[k], blocks_b[k])
    facts = believed(station, values, free)
    if facts is not None:
        blocks_S += facts[0] / n
        blocks_b += facts[1] / n
    return blocks_S, blocks_b, squares
