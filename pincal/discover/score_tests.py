r"""Score tests of candidate effects on the Jacobian of a fitted model.

With A the whitened Jacobian by all parameters (those of the model, N, and those of every candidate, at zero), r the
whitened residuals, S = A A^T and b = A r, everything that criticism asks follows from S and b: with the model's tangent
space and its priors L projected out,

.. math:: S'_{gg} = S_{gg} - S_{gN} (S_{NN} + L)^{-1} S_{Ng}, \qquad T_g = b'^T_g S'^{-1}_{gg} b'_g ,

T_g is what adding effect g and refitting everything would take off the sum of squares (Rao's score test; chi-square with
k_g degrees of freedom if g is not there). One pass over the data serves all candidates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
from pincal.model.effects import Effect

# Part of a column's square that must be left after projection for the data to see it.
_SEEN = 1e-5
# Keeps a scaled matrix of information definite where rounding would not.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Score:
    """The test of one candidate.

    Attributes:
        gain: T, what it takes off the sum of squares (in units of the noise that the model leaves).
        rank: k, directions of it that the data see.
        p_value: of the F test.
        ebic: change of the extended Bayesian information criterion (Chen and Chen 2008); negative is better.
    """

    gain: float
    rank: int
    p_value: float
    ebic: float


@dataclass(frozen=True)
class ScoreTests:
    """Gram matrices of a fitted model and of all candidates.

    Attributes:
        effects: the candidates.
        columns: for each candidate, its columns in ``S``.
        n_model: the first columns, those of the model and of nuisance effects.
        S: shape (P, P), whitened by the noise that the model leaves.
        b: shape (P,).
        precision: shape (n_model, n_model), inverse covariance of what was known of the model's parameters before.
        pull: shape (n_model,), slope of the sum of squares by it at the present values.
        blocks_S, blocks_b: shape (B, P, P), (B, P), by block of poses, for cross-validation.
        squares: weighted sum of squared residuals.
        readings: number of readings that count.
        spent: parameters spent by the model.
    """

    effects: tuple[Effect, ...]
    columns: tuple[slice, ...]
    n_model: int
    S: np.ndarray
    b: np.ndarray
    precision: np.ndarray
    pull: np.ndarray
    sizes: np.ndarray
    blocks_S: np.ndarray
    blocks_b: np.ndarray
    squares: float
    readings: int
    spent: float

    @property
    def dof(self) -> float:
        """Degrees of freedom that the model leaves."""
        return max(self.readings - self.spent, 1.0)

    @cached_property
    def _projected(self) -> tuple[np.ndarray, np.ndarray]:
        """S' and b' of all candidate columns."""
        N = slice(0, self.n_model)
        C = slice(self.n_model, len(self.b))
        scale, L = _scaled_factor(self.S[N, N] + self.precision)
        left = solve_triangular(L, scale[:, None] * self.S[N, C], lower=True, check_finite=False)
        slope = solve_triangular(L, scale * (self.b[N] - self.pull), lower=True, check_finite=False)
        return self.S[C, C] - left.T @ left, self.b[C] - left.T @ slope

    @cached_property
    def _gains(self) -> dict[tuple[int, ...], tuple[float, int]]:
        return {}

    def columns_of(self, which: Sequence[int]) -> np.ndarray:
        """Return the columns of some candidates, counted from the first candidate column."""
        spans = [np.arange(self.columns[i].start, self.columns[i].stop) for i in which]
        return np.concatenate(spans) - self.n_model if spans else np.zeros(0, int)

    def gain(self, which: Sequence[int]) -> tuple[float, int]:
        """Return T and rank of some candidates together."""
        key = tuple(sorted(which))
        if key not in self._gains:
            self._gains[key] = self._gain(key)
        return self._gains[key]

    def _gain(self, which: Sequence[int]) -> tuple[float, int]:
        S, b = self._projected
        j = self.columns_of(which)
        whole = np.diag(self.S)[self.n_model + j]
        scale = 1.0 / np.sqrt(np.maximum(whole, 1e-300))
        values, vectors = np.linalg.eigh(S[np.ix_(j, j)] * np.outer(scale, scale))
        seen = values > _SEEN
        along = (vectors[:, seen].T @ (scale * b[j])) ** 2
        return float(np.sum(along / values[seen])), int(seen.sum())

    def score(self, which: Sequence[int], groups: int) -> Score:
        """Return the test of some candidates taken as one."""
        gain, rank = self.gain(which)
        return self.judge(gain, rank, groups)

    def judge(self, gain: float, rank: int, groups: int) -> Score:
        """Return p-value and EBIC of a gain."""
        if rank == 0:
            return Score(0.0, 0, 1.0, np.inf)
        gain = min(gain, 0.999999 * self.squares)
        left = self.squares - gain
        F = (gain / rank) / (left / max(self.dof - rank, 1.0))
        p_value = float(fdtrc(rank, max(self.dof - rank, 1.0), F))
        ebic = self.readings * np.log(left / self.squares) + rank * np.log(self.readings) + 2.0 * np.log(max(groups, 1))
        return Score(gain, rank, p_value, float(ebic))

    def gain_given(self, which: int, given: int) -> Score:
        """Return what one candidate still explains once another is in the model."""
        both, rank_both = self.gain([which, given])
        alone, rank_alone = self.gain([given])
        return self.judge(both - alone, max(rank_both - rank_alone, 0), 1)

    def cross_validated_gain(self, which: Sequence[int]) -> tuple[float, float]:
        """Return the gain in squared prediction error on blocks left out, and its standard error."""
        gains = self.gains_by_block(which)
        return float(gains.sum()), float(gains.std(ddof=1) * np.sqrt(len(gains)))

    def gains_by_block(self, which: Sequence[int]) -> np.ndarray:
        """Return by how much some candidates lower the squared prediction error on each block left out, shape (B,).

        Both the model and the model with the candidates are refitted, to first order, without each block.
        """
        j = self.n_model + self.columns_of(which)
        precision = self.sizes[j] ** -2.0
        return np.array([block.gain(j, precision) for block in self._blocks])

    @cached_property
    def _blocks(self) -> list[_LeftOut]:
        return [_LeftOut.of(self, k) for k in range(len(self.blocks_S))]

    def estimate(self, which: Sequence[int]) -> np.ndarray:
        """Return some candidates' parameters to first order, priors included."""
        S, b = self._projected
        j = self.columns_of(which)
        C = np.linalg.inv(S[np.ix_(j, j)] + np.diag(self.sizes[self.n_model + j] ** -2.0))
        return np.asarray(C @ b[j])


@dataclass(frozen=True)
class _LeftOut:
    """The model refitted to first order without one block, and what candidates would change on the block.

    Attributes:
        whole_S, whole_b: of all blocks.
        S, b: of the block alone.
        scale, factor: of the others' information about the model, see :func:`_scaled_factor`.
        step: shape (n_model,), of the model's parameters.
    """

    whole_S: np.ndarray
    whole_b: np.ndarray
    S: np.ndarray
    b: np.ndarray
    scale: np.ndarray
    factor: np.ndarray
    step: np.ndarray

    @classmethod
    def of(cls, found: ScoreTests, k: int) -> _LeftOut:
        """Factor once what all candidates share."""
        S, b = found.blocks_S[k], found.blocks_b[k]
        N = slice(0, found.n_model)
        scale, factor = _scaled_factor(found.S[N, N] - S[N, N] + found.precision)
        slope = scale * (found.b[N] - b[N] - found.pull)
        step = scale * cho_solve((factor, True), slope, check_finite=False)
        return cls(found.S, found.b, S, b, scale, factor, step)

    def gain(self, j: np.ndarray, precision: np.ndarray) -> float:
        """Return by how much the candidate columns ``j`` lower the squared error on the block."""
        N, own = slice(0, len(self.step)), np.ix_(j, j)
        cross = self.whole_S[N, j] - self.S[N, j]
        carried = self.scale[:, None] * cho_solve((self.factor, True), self.scale[:, None] * cross, check_finite=False)
        scale, factor = _scaled_factor(self.whole_S[own] - self.S[own] - cross.T @ carried + np.diag(precision))
        slope = scale * (self.whole_b[j] - self.b[j] - cross.T @ self.step)
        step = scale * cho_solve((factor, True), slope, check_finite=False)
        change = -carried @ step
        along = self.S[N, N] @ change + self.S[N, j] @ step
        beside = self.S[j, N] @ change + self.S[own] @ step
        left = self.b[N] - self.S[N, N] @ self.step, self.b[j] - self.S[j, N] @ self.step
        return float(2.0 * (change @ left[0] + step @ left[1]) - change @ along - step @ beside)


def _scaled_factor(H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return s and the lower Cholesky factor of diag(s) H diag(s), whose diagonal is 1; H is overwritten."""
    scale = np.asarray(1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300)))
    H *= np.outer(scale, scale)
    H[np.diag_indices_from(H)] += _ROUNDING
    return scale, cholesky(H, lower=True, overwrite_a=True, check_finite=False)


def score_test(fit: Fit, candidates: Sequence[Effect], nuisance: Sequence[Effect], groups: np.ndarray) -> ScoreTests:
    """Test candidates against a fit.

    Args:
        fit: the fitted model.
        candidates: effects to test, none of them in the model.
        nuisance: effects that are projected out but not tested.
        groups: shape (N,), the block of each training row, for cross-validation.
    """
    problem, known = fit.problem.extended([*nuisance, *candidates])
    first = len(fit.problem.effects)
    sizes = priors_of(problem, fit.options).sizes
    # Nuisance parameters are relative errors: their sizes are priors as they are, whatever they move.
    for k in range(len(nuisance)):
        places = problem.places_of(first + k)
        sizes[places] = [problem.parameters[i].size for i in places]
    values, free = np.zeros(len(problem.parameters)), np.ones(len(problem.parameters), bool)
    values[known], free[known] = fit.values, fit.solution.free
    tested = [problem.places_of(first + len(nuisance) + k) for k in range(len(candidates))]
    blocks_S, blocks_b, squares, kept = _gram(fit, problem, values, free, tested, groups)
    n_model = len(kept) - sum(len(places) for places in tested)
    ends = n_model + np.cumsum([0, *(len(places) for places in tested)])
    priors = sizes[kept]
    known, slope = problem.beyond_priors(kept[:n_model], values, sizes)
    precision = priors[:n_model] ** -2.0
    counts = [int(np.sum(fit.solution.weights[rows] > 0)) for rows in problem.rows]
    return ScoreTests(
        effects=tuple(candidates),
        columns=tuple(slice(int(a), int(b)) for a, b in pairwise(ends)),
        n_model=n_model,
        S=blocks_S.sum(axis=0),
        b=blocks_b.sum(axis=0),
        precision=np.diag(precision) + known,
        pull=values[kept[:n_model]] * precision - slope,
        sizes=priors,
        blocks_S=blocks_S,
        blocks_b=blocks_b,
        squares=squares,
        readings=int(np.dot(counts, [problem.block_sizes[span].sum() for span in problem.block_spans])),
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
        order = np.argsort(groups[problem.rows[i]], kind="stable")
        local = values[problem.places[i]], free[problem.places[i]]
        weights = fit.solution.weights[problem.rows[i]][order]
        sigma = fit.solution.estimated[problem.block_spans[i]]
        S, b, found = _station_gram(
            station.select(order), *local, weights=weights, sigma=sigma, groups=groups[problem.rows[i]][order], n=n_blocks
        )
        mine = column[problem.places[i][local[1]]]
        squares += found
        if len(problem.stations) == 1 and np.array_equal(mine, np.arange(len(kept))):
            whole_S, whole_b = S, b
        else:
            whole_S[:, mine[:, None], mine] += S
            whole_b[:, mine] += b
    return whole_S, whole_b, squares, kept


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
