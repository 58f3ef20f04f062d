r"""Score tests of candidate effects on the Jacobian of a fitted model, and refits to first order.

With A the whitened Jacobian by all parameters (of the model, N, and of every candidate, at zero), r
the whitened residuals, S = A A^T and b = A r, all criteria follow from S and b: with the model's
tangent space and its priors L projected out,

.. math:: S'_{gg} = S_{gg} - S_{gN} (S_{NN} + L)^{-1} S_{Ng}, \qquad
    b'_g = b_g - S_{gN} (S_{NN} + L)^{-1} (b_N - L x)

are information and gradient of candidates given a refit of the model, x its parameters less their
prior means, and

.. math:: T_g = b'^T_g S'^{-1}_{gg} b'_g

is the reduction of the sum of squares by adding effect g and refitting everything (Rao's score
test; chi-square with k_g degrees of freedom if g is absent). One pass over the data serves all
candidates. docs/criteria.md derives the criteria.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np
from scipy.special import fdtrc

from pincal.discover.products import Information, RowPart
from pincal.discover.score_numbers import TESTING
from pincal.identify.quadratic import ROUNDING, SEEN, Factor
from pincal.model.effect import Effect
from pincal.thresholds import Count

# Numbers that are worked on at once where candidates are tested in pairs (16 MB).
_MOST_NUMBERS: Count = 2_000_000

_Numbers = np.ndarray | float


class _Belief(NamedTuple):
    """A choice of the uncertain sizes of priors.

    Attributes:
        size: factor on these.
        more: shape (N,), information that it adds.
        cost: -2 log of its posterior probability, relative to the most probable choice.
        factor, slope: of what remains of the information on them, see :class:`Doubted`.
    """

    size: float
    more: np.ndarray
    cost: float
    factor: Factor
    slope: np.ndarray


@dataclass(frozen=True)
class ScoreResult:
    """The test of one candidate.

    Attributes:
        gain: T, the reduction of the sum of squares (in units of the residual noise).
        rank: k, number of its observable directions.
        p_value: of the F test, corrected for the places or frequencies among which the candidate
            was chosen.
        ebic: change of the extended Bayesian information criterion (Chen and Chen 2008); negative
            is better.
    """

    gain: float
    rank: int
    p_value: float
    ebic: float


@dataclass(frozen=True, eq=False)
class ScoreTests:
    """Gram matrices of a fitted model and of all candidates, whitened by the residual noise.

    Refits with candidates, or without parameters of the model, follow from them to first order.

    Attributes:
        effects: the candidates.
        columns: for each of them its columns among all C columns of candidates.
        names: the N parameters of the model and of nuisance effects.
        values: shape (N,), of these.
        sizes: shape (N + C,), standard deviations of the priors, of the candidates' parameters
            last.
        unsure: shape (N,), which parameters have a prior of uncertain size about zero.
        model: information of rows and priors on the N parameters, by block of poses.
        blocks_cross: shape (B, N, C), products of the model's columns with the candidates', by
            block of poses.
        blocks_inner: shape (B, C, C), products of the candidates' columns with each other; or, of
            many in one block, of each candidate's own ones alone. Those of different candidates are
            then computed from the rows on demand, as few pairs are needed.
        blocks_g: shape (B, C), products of the candidates' columns with the residuals.
        parts: the rows.
        squares: weighted sum of squared residuals.
        readings: number of readings that count.
        spent: parameters spent by the model.
        asked: cache of products computed on demand, by candidates: they are the same whatever the
            sizes are believed to be.
    """

    effects: tuple[Effect, ...]
    columns: tuple[np.ndarray, ...]
    names: tuple[str, ...]
    values: np.ndarray
    sizes: np.ndarray
    unsure: np.ndarray
    model: Information
    blocks_cross: np.ndarray
    blocks_inner: np.ndarray | tuple[np.ndarray, ...]
    blocks_g: np.ndarray
    squares: float
    readings: int
    spent: float
    parts: tuple[RowPart, ...] = ()
    asked: dict[tuple[int, ...], np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def n_model(self) -> int:
        """Number of columns of the model and of nuisance effects."""
        return len(self.names)

    @property
    def squares_left(self) -> float:
        """What a refit of the model to these rows leaves of the squared residuals, to first order:
        its priors pull it away from their least.
        """
        rows = self.model.rows
        step = self.model.factor.solve(rows.g + self.model.prior.g)
        return self.squares - float(step @ (2.0 * rows.g - rows.H @ step))

    @property
    def precision(self) -> np.ndarray:
        """Inverse variances of the priors, shape (N + C,)."""
        return np.asarray(self.sizes**-2.0)

    @cached_property
    def cross(self) -> np.ndarray:
        """Products of the model's columns with the candidates' columns, shape (N, C)."""
        return _summed(self.blocks_cross)

    @cached_property
    def _inner(self) -> np.ndarray | None:
        """Products of the candidates' columns with each other, if they are kept."""
        kept = self.blocks_inner
        return None if isinstance(kept, tuple) else _summed(kept)

    def own(self, i: int) -> np.ndarray:
        """Return the products of a candidate's J columns with each other, shape (J, J)."""
        if isinstance(self.blocks_inner, tuple):
            return self.blocks_inner[i]
        j = self.columns[i]
        assert self._inner is not None
        return np.asarray(self._inner[j[:, None], j])

    @cached_property
    def _squares(self) -> np.ndarray:
        """Products of each candidates' column with itself, shape (C,)."""
        if self._inner is not None:
            return np.diag(self._inner)
        return np.concatenate([np.zeros(0), *map(np.diag, self.blocks_inner)])

    @cached_property
    def inner(self) -> np.ndarray:
        """Products of the candidates' columns with each other, shape (C, C)."""
        return self.inner_of(range(len(self.columns)))

    @cached_property
    def g(self) -> np.ndarray:
        """Products of the candidates' columns with the residuals, shape (C,)."""
        return np.asarray(self.blocks_g.sum(axis=0))

    def places(self, which: Sequence[int]) -> np.ndarray:
        """Return the columns of some candidates, shape (J,)."""
        return np.concatenate([np.zeros(0, int), *(self.columns[i] for i in which)])

    def inner_of(self, which: Sequence[int]) -> np.ndarray:
        """Return the products of some candidates' columns with each other, shape (J, J)."""
        if len(which) == 1:
            return self.own(which[0])
        j = self.places(which)
        if self._inner is not None:
            return np.asarray(self._inner[j[:, None], j])
        if not len(j):
            return np.zeros((0, 0))
        if (key := tuple(which)) not in self.asked:
            self.asked[key] = self._from_rows(j, j)
        return self.asked[key]

    def _from_rows(self, some: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return the products of J candidates' columns with K others, shape (J, K)."""
        n = self.n_model
        found = np.zeros((len(some), len(others)))
        for part in self.parts:
            found += part.products(n + some, n + others)
        return found

    def _between(self, some: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Return the products of J candidates' columns with K others, shape (J, K)."""
        if self._inner is None:
            return self._from_rows(some, others)
        return np.asarray(self._inner[some[:, None], others])

    def _rows(self, at: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Return the products of columns, by index among all N + C, with candidates' columns j, by
        block, shape (B, len(at), J).
        """
        n = self.n_model
        found = np.empty((len(self.blocks_cross), len(at), len(j)))
        of_model = at < n
        found[:, of_model] = self.blocks_cross[:, at[of_model, None], j]
        if not of_model.all():
            some = at[~of_model] - n
            found[:, ~of_model] = (
                self._from_rows(some, j)
                if isinstance(self.blocks_inner, tuple)
                else self.blocks_inner[:, some[:, None], j]
            )
        return found

    def prior(self, which: Sequence[int]) -> np.ndarray:
        """Return the information of the priors of some candidates' J parameters, smoothness of
        curves included, (J, J).
        """
        own = self.places(which)
        L = np.diag(self.precision[self.n_model + own])
        start = 0
        for i in which:
            end = start + len(self.columns[i])
            if (smooth := self.effects[i].smoothness()) is not None:
                L[start:end, start:end] += smooth
            start = end
        return L

    def _projection(self, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """H, shape (J, N), with S' = S - H H^T, and b', shape (J,), of J columns of candidates.

        It is not kept: of all columns it is as large as :attr:`cross`.
        """
        taken = self.model.factor.half(self.cross[:, j]).T
        return taken, self.g[j] - taken @ self.model.slope

    def _projections(self, j: np.ndarray) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        """Yield, for each choice of the uncertain sizes, its cost, and H and b' of J columns as of
        :meth:`_projection`; once if no size is uncertain.
        """
        if not self.unsure.any():
            yield 0.0, *self._projection(j)
            return
        doubted = self.model.doubted(self.unsure)
        cross = self.cross[:, j]
        first = doubted.factor.half(cross[doubted.known])
        rest = cross[doubted.unsure] - doubted.across.T @ first
        b = self.g[j] - first.T @ doubted.slope
        for belief in self._beliefs:
            last = belief.factor.half(rest)
            yield belief.cost, np.concatenate([first, last]).T, b - last.T @ belief.slope

    @cached_property
    def _beliefs(self) -> list[_Belief]:
        """Each choice of the uncertain sizes, if any."""
        doubted = self.model.doubted(self.unsure)
        found = []
        for size, cost in TESTING.mass_beliefs:
            more = self.unsure * self.precision[: self.n_model] * (size**-2.0 - 1.0)
            factor, slope = doubted.with_sizes(more[doubted.unsure])
            evidence = 0.5 * (factor.log_det - slope @ slope) + len(slope) * np.log(size)
            found.append(_Belief(size, more, cost + 2.0 * float(evidence), factor, slope))
        least = min(belief.cost for belief in found)
        return [belief._replace(cost=belief.cost - least) for belief in found]

    def likeliest(self, which: Sequence[int]) -> Self:
        """Return the tests with the most probable uncertain sizes given some candidates."""
        if not self.unsure.any():
            return self
        k = self._given_sizes(which)[0]
        belief = self._beliefs[k]
        model = self.model.believing(belief.size, belief.more)
        return replace(self, unsure=np.zeros_like(self.unsure), model=model)

    def _given_sizes(self, which: Sequence[int]) -> tuple[int, float, np.ndarray, np.ndarray]:
        """Return the number of the most probable choice of uncertain sizes given some candidates,
        its cost, and S' and b' of their J columns with it, shape (J, J) and (J,).

        The cost is relative to the most probable sizes without the candidates.
        """
        j = self.places(which)
        inner = self.inner_of(which)
        each = [(cost, inner - H @ H.T, b) for cost, H, b in self._projections(j)]
        k = min(range(len(each)), key=lambda k: each[k][0] - float(self._gains(j, *each[k][1:])[0]))
        return k, *each[k]

    def within(self, which: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the J columns of some candidates, and S' and b' of these, shape (J, J)
        and (J,).
        """
        j = self.places(which)
        (taken, b) = self._projection(j)
        return j, self.inner_of(which) - taken @ taken.T, b

    def gain(self, which: Sequence[int]) -> tuple[float, int]:
        """Return T and rank of some candidates together, with the most probable uncertain sizes
        with and without them.
        """
        if len(which) == 1:
            gains, ranks, _ = self._alone
            return float(gains[which[0]]), int(ranks[which[0]])
        gain, rank = self._likeliest_gains(self.places(which), self.inner_of(which))
        return float(gain), int(rank)

    @cached_property
    def _alone(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """T, rank and p-value of each candidate by itself, vectorised over candidates
        of one size.
        """
        sizes = np.array([len(j) for j in self.columns])
        trials = np.array([effect.trials for effect in self.effects])
        gains = np.zeros(len(sizes))
        ranks = np.zeros(len(sizes), int)
        for size in np.unique(sizes):
            some = np.flatnonzero(sizes == size)
            j = np.array([self.columns[i] for i in some])
            inner = np.array([self.own(i) for i in some.tolist()])
            gains[some], ranks[some] = self._likeliest_gains(j, inner)
        return (
            gains,
            ranks,
            np.minimum(trials * chance_of(gains, ranks, self.squares, self.dof), 1.0),
        )

    def _likeliest_gains(self, j: np.ndarray, inner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return T and rank, as of :meth:`gain`, of sets of J columns.

        Args:
            j: shape (..., J), the columns.
            inner: shape (..., J, J), their products with each other.
        """
        columns, at = np.unique(j, return_inverse=True)
        at = at.reshape(j.shape)
        gains = np.full(j.shape[:-1], -np.inf)
        ranks = np.zeros(j.shape[:-1], int)
        for cost, taken, b in self._projections(columns):
            H = taken[at]
            gained, seen = self._gains(j, inner - H @ H.swapaxes(-1, -2), b[at])
            is_more = gained - cost > gains
            gains = np.where(is_more, gained - cost, gains)
            ranks = np.where(is_more, seen, ranks)
        return gains, ranks

    def _gains(self, j: np.ndarray, S: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return T and rank of sets of J columns, given S' and b' of each, shape (..., J, J) and
        (..., J).
        """
        roots, seen = self._roots(j, S)
        return np.sum(np.einsum("...i,...ik->...k", b, roots) ** 2, axis=-1), seen.sum(axis=-1)

    def _gains_beside(
        self, which: Sequence[int], others: Sequence[Sequence[int]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return T and rank of some candidates together with each of several sets of others, none
        of them among the former.
        """
        own = self.places(which)
        places = [self.places(of) for of in others]
        sizes = np.array([len(j) for j in places])
        columns, at = np.unique(np.concatenate(places), return_inverse=True)
        across = np.split(self._between(own, columns)[:, at], np.cumsum(sizes)[:-1], axis=1)
        inner = self.inner_of(which)
        gains = np.zeros(len(others))
        ranks = np.zeros(len(others), int)
        for some in _alike(sizes, self.n_model * (len(own) + sizes)):
            j = np.array([np.append(own, places[k]) for k in some])
            both = [
                np.block([[inner, across[k]], [across[k].T, self.inner_of(others[k])]])
                for k in some
            ]
            gains[some], ranks[some] = self._likeliest_gains(j, np.array(both))
        return gains, ranks

    def whitening(self, which: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the J columns of some candidates, and W, shape (J, rank), with T = |b' W|^2 for b'
        at these columns.
        """
        j, S, _ = self.within(which)
        roots, seen = self._roots(j, S)
        return j, roots[:, seen]

    def _roots(self, j: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the root of S^-1 of J columns, shape (..., J, J), zero in unobservable directions,
        and a mask of others.
        """
        scale = 1.0 / np.sqrt(np.maximum(self._squares[j], 1e-300))
        values, vectors = np.linalg.eigh(S * scale[..., None] * scale[..., None, :])
        expected = (self.sizes[self.n_model + j] / scale) ** 2
        reduction = values * np.einsum("...i,...ik->...k", expected, vectors**2)
        seen = (values > SEEN) & (reduction > TESTING.observed)
        root = 1.0 / np.sqrt(np.where(seen, values, np.inf))
        return scale[..., None] * vectors * root[..., None, :], seen

    def gains_by_block(self, which: Sequence[int]) -> np.ndarray:
        """Return the reduction of the squared prediction error on each held-out block by some
        candidates, shape (B,).

        The model with and without the candidates is refitted, to first order, without each block,
        with the uncertain sizes that are most probable with the candidates.
        """
        tests = self.likeliest(which)
        fits = tests.model.without_block
        return np.array([tests._gain_left_out(k, *fit, which) for k, fit in enumerate(fits)])

    def _gain_left_out(
        self, k: int, model: Factor, model_step: np.ndarray, which: Sequence[int]
    ) -> float:
        """Return the reduction of the squared error on block k by some candidates fitted without
        it, given the factor of the model's information and its step, without it.
        """
        j = self.places(which)
        model_S = self.model.blocks.H[k]
        model_b = self.model.blocks.g[k]
        across = self.blocks_cross[k][:, j]
        kept = self.blocks_inner
        own = self.inner_of(which) if isinstance(kept, tuple) else kept[k][j[:, None], j]
        b = self.blocks_g[k, j]
        cross = self.cross[:, j] - across
        taken = model.half(cross)
        known = self.inner_of(which) - own + self.prior(which)
        # Where few rows determine a candidate, the difference may be below its rounding errors.
        factor = Factor.of(known - taken.T @ taken + ROUNDING * np.diag(np.diag(known)))
        step = factor.solve(self.g[j] - b - cross.T @ model_step)
        change = -model.back(taken @ step)
        along = model_S @ change + across @ step, across.T @ change + own @ step
        rest = model_b - model_S @ model_step, b - across.T @ model_step
        return float(
            2.0 * (change @ rest[0] + step @ rest[1]) - change @ along[0] - step @ along[1]
        )

    def among(self, which: Sequence[int], gone: Collection[str]) -> Self:
        """Return the tests of some candidates against the model with the parameters ``gone``
        removed, to first order.
        """
        stays = np.array([name not in gone for name in self.names], bool)
        kept = np.flatnonzero(stays)
        out = np.flatnonzero(~stays)
        values = self.values[out]
        rows = self.model.rows.part(out)
        undone = np.zeros(len(self.sizes))
        undone[out] = values
        return replace(
            self.rearranged(kept, which, undone),
            names=tuple(self.names[i] for i in kept),
            values=self.values[kept],
            unsure=self.unsure[kept],
            model=self.model.without(kept, out, values),
            squares=self.squares + float(values @ (2.0 * rows.g + rows.H @ values)),
        )

    def rearranged(self, model: np.ndarray, which: Sequence[int], undone: np.ndarray) -> Self:
        """Return the products of some candidates with another model's columns; the attributes of
        the model are unchanged.

        Args:
            model: its columns, by index among all N + C.
            which: the candidates.
            undone: shape (N + C,), values of parameters that are set to zero, which changes the
                residuals.
        """
        j = self.places(which)
        ends = np.cumsum([0, *(len(self.columns[i]) for i in which)])
        gone = np.flatnonzero(undone)
        order = np.concatenate([model, self.n_model + j])
        slots = np.full(len(self.sizes) + 1, -1)
        slots[order] = np.arange(len(order))
        return replace(
            self,
            effects=tuple(self.effects[i] for i in which),
            columns=tuple(np.arange(a, b) for a, b in pairwise(ends)),
            sizes=self.sizes[order],
            blocks_cross=self._rows(model, j),
            blocks_inner=(
                tuple(self.blocks_inner[i] for i in which)
                if isinstance(self.blocks_inner, tuple)
                else self.blocks_inner[:, j[:, None], j]
            ),
            blocks_g=self.blocks_g[:, j] + undone[gone] @ self._rows(gone, j),
            parts=tuple(part.among(slots, undone) for part in self.parts),
            asked={},
        )

    def along_rows(
        self, which: Sequence[int], steps: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield rows, their residuals after a refit of the model, and their motions by steps of
        candidates with a refit.

        Args:
            which: candidates.
            steps: shape (J, R), R steps of their J parameters.

        Yields:
            Indices of the rows, shape (n,), whitened residuals, shape (m, n), and motions, shape
            (R, m, n).
        """
        model = self.model
        j = self.places(which)
        taken = model.factor.solve(
            np.column_stack([self.cross[:, j] @ steps, -model.rows.g - model.prior.g])
        )
        every = np.vstack([-taken, np.zeros((len(self.g), taken.shape[1]))])
        every[self.n_model + j, :-1] = steps
        for part in self.parts:
            moved = part.moved(every)
            yield part.rows, part.residuals - moved[-1], moved[:-1]

    def estimate(self, which: Sequence[int]) -> np.ndarray:
        """Return some candidates' parameters to first order, priors included."""
        _, S, b = self.within(which)
        return np.asarray(np.linalg.inv(S + self.prior(which)) @ b)

    @property
    def dof(self) -> float:
        """Degrees of freedom that the model leaves."""
        return max(self.readings - self.spent, 1.0)

    def score(self, which: Sequence[int], groups: int) -> ScoreResult:
        """Return the test of some candidates together, one of so many tested groups."""
        gain, rank = self.gain(which)
        trials = math.prod(self.effects[i].trials for i in which)
        chance = (
            self._alone[2][which[0]]
            if len(which) == 1
            else trials * chance_of(gain, rank, self.squares, self.dof)
        )
        return self._judged(gain, rank, float(chance), self.squares, groups * trials)

    def score_given(
        self, which: Sequence[int], given: Sequence[int], groups: int = 1
    ) -> ScoreResult:
        """Return the test of some candidates given others in the model."""
        both = self.gain(sorted({*which, *given}))
        gain, rank, squares, chance = self._beyond(both, self.gain(given))
        return self._judged(float(gain), int(rank), float(chance), float(squares), groups)

    def scores_given(
        self, each: Sequence[Sequence[int]], given: Sequence[int], groups: Sequence[float]
    ) -> list[ScoreResult]:
        """Return the test of each of several sets of candidates given others in the model: as of
        :meth:`score_given`, with one pass over the rows for all.
        """
        if not each:
            return []
        found = self._beyond(self._gains_beside(given, each), self.gain(given))
        return [
            self._judged(float(gain), int(rank), float(chance), float(squares), of)
            for gain, rank, squares, chance, of in zip(
                *np.broadcast_arrays(*found), groups, strict=True
            )
        ]

    def chances_given_each(
        self, which: Sequence[int], others: Sequence[Sequence[int]]
    ) -> np.ndarray:
        """Return the p-value of some candidates given each of several sets of others in the model,
        shape (sets,): as of :meth:`score_given`, with one pass over the rows for all.
        """
        if not others:
            return np.zeros(0)
        gains, ranks = zip(*map(self.gain, others), strict=True)
        alone = np.array(gains), np.array(ranks)
        return np.asarray(
            np.minimum(self._beyond(self._gains_beside(which, others), alone)[3], 1.0)
        )

    def _beyond(
        self, both: tuple[_Numbers, _Numbers], alone: tuple[_Numbers, _Numbers]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return gain and rank of candidates given others, the squares that these leave, and the
        p-value, from T and rank of both together and of the others alone.
        """
        gain = np.asarray(both[0] - alone[0])
        rank = np.maximum(both[1] - alone[1], 0)
        squares = np.maximum(self.squares - alone[0], 1e-6 * self.squares)
        return gain, rank, squares, chance_of(gain, rank, squares, self.dof - alone[1])

    def p_value_of_any(self, which: Sequence[int]) -> float:
        """Return the smaller p-value of all candidates together and of the best one alone,
        corrected for its selection.

        A single compliant drive is not significant among the many parameters of all drives and
        bearings.
        """
        alone = (len(which) * self.score([i], 1).p_value for i in which)
        return min(self.score(which, 1).p_value, *alone)

    def _judged(
        self, gain: float, rank: int, chance: float, squares: float, groups: float
    ) -> ScoreResult:
        if rank == 0:
            return ScoreResult(0.0, 0, 1.0, np.inf)
        gain = min(gain, TESTING.most_explained * squares)
        n = self.readings
        cost = (
            n * float(np.log1p(-gain / squares))
            + rank * float(np.log(n))
            + 2.0 * float(np.log(max(groups, 1.0)))
        )
        return ScoreResult(gain, rank, min(chance, 1.0), cost)

    def rescaled(self, i: int, factor: float) -> Self:
        """Return the tests with the prior of a candidate so many times as wide."""
        sizes = self.sizes.copy()
        sizes[self.n_model + self.columns[i]] *= factor
        return replace(self, sizes=sizes)

    def log_evidence(self, which: Sequence[int]) -> float:
        """Return the log Bayes factor in favour of some candidates, to first order.

        It is corrected for the places or frequencies among which they were chosen. Unlike a p-value
        it depends on the width of their priors.
        """
        _, cost, S, b = self._given_sizes(which)
        size = self.sizes[self.n_model + self.places(which)]
        prior = np.outer(size, size) * self.prior(which)
        information = np.outer(size, size) * S + prior
        step = np.linalg.solve(information, size * b)
        spread = np.linalg.slogdet(prior)[1] - np.linalg.slogdet(information)[1]
        trials = sum(float(np.log(self.effects[i].trials)) for i in which)
        return float(0.5 * ((size * b) @ step + spread - cost)) - trials


def _alike(sizes: np.ndarray, numbers: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the indices of sets of one size, as many at once as are worked on in little memory,
    given how many numbers each takes.
    """
    for size in np.unique(sizes):
        some = np.flatnonzero(sizes == size)
        at_once = max(_MOST_NUMBERS // max(int(numbers[some[0]]), 1), 1)
        yield from np.split(some, range(at_once, len(some), at_once))


def _summed(blocks: np.ndarray) -> np.ndarray:
    """Return products of all blocks."""
    return np.asarray(blocks[0] if len(blocks) == 1 else blocks.sum(axis=0))


def chance_of(
    gain: np.ndarray | float,
    rank: np.ndarray | int,
    squares: np.ndarray | float,
    dof: np.ndarray | float,
) -> np.ndarray:
    """Return the p-value of the F test of a gain, arguments of any shape; 1 of rank 0.

    Args:
        gain: reduction of the squares.
        rank: number of observable directions.
        squares: before, in the same unit.
        dof: degrees of freedom before.
    """
    gain = np.minimum(gain, TESTING.most_explained * squares)
    rest = np.maximum(dof - rank, 1.0)
    seen = np.maximum(rank, 1)
    return np.asarray(
        np.where(rank, fdtrc(seen, rest, (gain / seen) / ((squares - gain) / rest)), 1.0)
    )
