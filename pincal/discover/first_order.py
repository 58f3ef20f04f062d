r"""Score tests of candidate effects on the Jacobian of a fitted model, and what refits would change, to first order.

With A the whitened Jacobian by all parameters (those of the model, N, and those of every candidate, at zero), r the
whitened residuals, S = A A^T and b = A r, everything that criticism asks follows from S and b: with the model's tangent
space and its priors L projected out,

.. math:: S'_{gg} = S_{gg} - S_{gN} (S_{NN} + L)^{-1} S_{Ng}, \qquad b'_g = b_g - S_{gN} (S_{NN} + L)^{-1} (b_N - L x)

are what is left of candidates once the model has taken up what it can of them, x its parameters less what is believed, and

.. math:: T_g = b'^T_g S'^{-1}_{gg} b'_g

is what adding effect g and refitting everything would take off the sum of squares (Rao's score test; chi-square with
k_g degrees of freedom if g is not there). One pass over the data serves all candidates. Which criteria follow from these,
and what each decides, stands in docs/criteria.md.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.special import fdtrc

from pincal.discover.policy import TESTING
from pincal.discover.products import Information, RowPart
from pincal.identify.quadratic import ROUNDING, SEEN, Factor
from pincal.model.effect import Effect


@dataclass(frozen=True)
class ScoreResult:
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

    What a refit with candidates, or without parameters of the model, would change follows from them to first order.

    Attributes:
        effects: the candidates.
        columns: for each of them its columns, counted from the first of all C columns of candidates.
        names: the N parameters of the model and of nuisance effects.
        values: shape (N,), of these.
        sizes: shape (N + C,), standard deviations of the priors, those of the candidates' parameters behind.
        unsure: shape (N,), which parameters at zero are small though not how small: their sizes are in doubt.
        model: what rows and priors say of the N parameters, by block of poses.
        blocks_H: shape (B, N + C, C), products of all columns with those of the candidates, by block of poses.
        blocks_g: shape (B, C), of the candidates' columns with the residuals.
        is_partial: whether products of one candidate's columns with another's are left out of ``blocks_H``, to be taken from
            the rows when they are asked for: of many candidates few pairs are.
        parts: the rows that all products are taken over; none if nobody asks for them.
        squares: weighted sum of squared residuals.
        readings: number of readings that count.
        spent: parameters spent by the model.
    """

    effects: tuple[Effect, ...]
    columns: tuple[np.ndarray, ...]
    names: tuple[str, ...]
    values: np.ndarray
    sizes: np.ndarray
    unsure: np.ndarray
    model: Information
    blocks_H: np.ndarray
    blocks_g: np.ndarray
    squares: float
    readings: int
    spent: float
    is_partial: bool = False
    parts: tuple[RowPart, ...] = ()
    _asked: dict[tuple[int, ...], np.ndarray] = field(default_factory=dict, init=False, repr=False)

    @property
    def n_model(self) -> int:
        """Number of columns of the model and of nuisance effects."""
        return len(self.names)

    @property
    def precision(self) -> np.ndarray:
        """Inverse variances of the priors, shape (N + C,)."""
        return np.asarray(self.sizes**-2.0)

    @cached_property
    def H(self) -> np.ndarray:
        """Products of all columns with those of the candidates, shape (N + C, C); of one with another perhaps not."""
        return self.blocks_H[0] if len(self.blocks_H) == 1 else np.asarray(self.blocks_H.sum(axis=0))

    @property
    def cross(self) -> np.ndarray:
        """Of the model's columns with those of the candidates, shape (N, C)."""
        return self.H[: self.n_model]

    @cached_property
    def inner(self) -> np.ndarray:
        """Of the candidates' columns with each other, shape (C, C)."""
        return self.inner_of(range(len(self.columns)))

    @cached_property
    def g(self) -> np.ndarray:
        """Of the candidates' columns with the residuals, shape (C,)."""
        return np.asarray(self.blocks_g.sum(axis=0))

    def places(self, which: Sequence[int]) -> np.ndarray:
        """Return the columns of some candidates, shape (J,)."""
        return np.concatenate([np.zeros(0, int), *(self.columns[i] for i in which)])

    def inner_of(self, which: Sequence[int]) -> np.ndarray:
        """Return the products of some candidates' columns with each other, shape (J, J)."""
        j = self.places(which)
        at = self.n_model + j
        if not self.is_partial or len(which) < 2:
            return np.asarray(self.H[at[:, None], j])
        if (key := tuple(which)) not in self._asked:
            self._asked[key] = np.asarray(sum(part.products(at, at) for part in self.parts))
        return self._asked[key]

    def prior(self, which: Sequence[int]) -> np.ndarray:
        """Return the information of the priors of some candidates' J parameters, smoothness of curves included, (J, J)."""
        own = self.places(which)
        L, start = np.diag(self.precision[self.n_model + own]), 0
        for i in which:
            end = start + len(self.columns[i])
            if (smooth := self.effects[i].smoothness()) is not None:
                L[start:end, start:end] += smooth
            start = end
        return L

    @cached_property
    def _projection(self) -> tuple[np.ndarray, np.ndarray]:
        """H, shape (C, N), with S' = S - H H^T, and b', shape (C,), of all C candidate columns."""
        taken = self.model.factor.half(self.cross).T
        return taken, self.g - taken @ self.model.slope

    @cached_property
    def _beliefs(self) -> list[tuple[float, Self]]:
        """The same tests with each of the sizes that are in doubt, and what each costs: -2 log of how likely it is."""
        if not self.unsure.any():
            return [(0.0, self)]
        found = []
        for factor, cost in TESTING.mass_beliefs:
            known = self.model.prior.H + np.diag(self.unsure * self.precision[: self.n_model] * (factor**-2.0 - 1.0))
            tests = replace(self, unsure=np.zeros_like(self.unsure), model=self.model.believing(factor, known))
            evidence = 0.5 * (tests.model.factor.log_det - tests.model.slope @ tests.model.slope)
            evidence += np.count_nonzero(self.unsure) * np.log(factor)
            found.append((cost + 2.0 * float(evidence), tests))
        least = min(cost for cost, _ in found)
        return [(cost - least, tests) for cost, tests in found]

    def likeliest(self, which: Sequence[int]) -> tuple[float, Self]:
        """Return the tests with the sizes, of those in doubt, that are likeliest with some candidates, and their cost.

        The cost is what these sizes cost beyond the likeliest ones without the candidates.
        """
        return min(self._beliefs, key=lambda belief: belief[0] - belief[1].gain(which)[0])

    def within(self, which: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the J columns of some candidates, and S' and b' of these, shape (J, J) and (J,)."""
        j, (taken, b) = self.places(which), self._projection
        return j, self.inner_of(which) - taken[j] @ taken[j].T, b[j]

    def gain(self, which: Sequence[int]) -> tuple[float, int]:
        """Return T and rank of some candidates together; sizes in doubt are the likeliest ones, with and without them."""
        if len(which) == 1:
            gains, ranks, _ = self._alone
            return float(gains[which[0]]), int(ranks[which[0]])
        if self.unsure.any():
            found = [(cost, *tests.gain(which)) for cost, tests in self._beliefs]
            cost, gain, rank = min(found, key=lambda belief: belief[0] - belief[1])
            return gain - cost, rank
        j, whitening = self.whitening(which)
        return float(np.sum((self._projection[1][j] @ whitening) ** 2)), whitening.shape[1]

    @cached_property
    def _alone(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """T, rank and the p-value of each candidate by itself; those of one size are worked out at once."""
        sizes, looks = np.array([len(j) for j in self.columns]), np.array([effect.looks for effect in self.effects])
        gains, ranks = np.zeros(len(sizes)), np.zeros(len(sizes), int)
        if self.unsure.any():
            each = [(tests._alone[0] - cost, tests._alone[1]) for cost, tests in self._beliefs]
            gains, ranks = (np.array(of) for of in zip(*each, strict=True))
            best = np.argmax(gains, axis=0), np.arange(len(sizes))
            gains, ranks = gains[best], ranks[best]
        for size in () if self.unsure.any() else np.unique(sizes):
            some, (taken, b) = np.flatnonzero(sizes == size), self._projection
            j = np.array([self.columns[i] for i in some])
            inner = self.H[self.n_model + j[:, :, None], j[:, None]]
            roots, seen = self._roots(j, inner - taken[j] @ taken[j].swapaxes(1, 2))
            gains[some] = np.sum(np.einsum("gi,gik->gk", b[j], roots) ** 2, axis=1)
            ranks[some] = seen.sum(axis=1)
        return gains, ranks, np.minimum(looks * chance_of(gains, ranks, self.squares, self.dof), 1.0)

    def whitening(self, which: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the J columns of some candidates, and W, shape (J, rank), with T = |b' W|^2 for b' at these columns."""
        j, S, _ = self.within(which)
        roots, seen = self._roots(j, S)
        return j, roots[:, seen]

    def _roots(self, j: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the root of S^-1 of J columns, shape (..., J, J), zero where the data see nothing, and what they see."""
        scale = 1.0 / np.sqrt(np.maximum(self.H[self.n_model + j, j], 1e-300))
        values, vectors = np.linalg.eigh(S * scale[..., None] * scale[..., None, :])
        expected = (self.sizes[self.n_model + j] / scale) ** 2
        told = values * np.einsum("...i,...ik->...k", expected, vectors**2)
        seen = (values > SEEN) & (told > TESTING.told)
        root = 1.0 / np.sqrt(np.where(seen, values, np.inf))
        return scale[..., None] * vectors * root[..., None, :], seen

    def gains_by_block(self, which: Sequence[int]) -> np.ndarray:
        """Return by how much some candidates lower the squared prediction error on each block left out, shape (B,).

        Both the model and the model with the candidates are refitted, to first order, without each block. Sizes in doubt
        are those that are likeliest with the candidates.
        """
        tests = self.likeliest(which)[1]
        return np.array([tests._gain_left_out(k, which) for k in range(len(self.model.blocks.H))])

    def _gain_left_out(self, k: int, which: Sequence[int]) -> float:
        """Return by how much some candidates, fitted without block k, lower the squared error on it."""
        j, (model, model_step) = self.places(which), self.model.without_block[k]
        model_S, model_b = self.model.blocks.H[k], self.model.blocks.g[k]
        (across, own), b = np.split(self.blocks_H[k][:, j], [self.n_model]), self.blocks_g[k, j]
        own = own[j]
        cross = self.cross[:, j] - across
        taken = model.half(cross)
        known = self.inner_of(which) - own + self.prior(which)
        # Where few rows tell nearly all of it, what the model does not take is less than its rounding.
        factor = Factor.of(known - taken.T @ taken + ROUNDING * np.diag(np.diag(known)))
        step = factor.solve(self.g[j] - b - cross.T @ model_step)
        change = -model.back(taken @ step)
        along = model_S @ change + across @ step
        beside = across.T @ change + own @ step
        left = model_b - model_S @ model_step, b - across.T @ model_step
        return float(2.0 * (change @ left[0] + step @ left[1]) - change @ along - step @ beside)

    def among(self, which: Sequence[int], gone: Collection[str]) -> Self:
        """Return the tests of some candidates against the model as it stands with some of its parameters at zero.

        Args:
            which: the candidates.
            gone: the parameters of the model that go; what is left follows, to first order, without evaluation.
        """
        stays = np.array([name not in gone for name in self.names], bool)
        kept, out = np.flatnonzero(stays), np.flatnonzero(~stays)
        values, rows, undone = self.values[out], self.model.rows.part(out), np.zeros(len(self.sizes))
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
        """Return the products of some candidates with another model's columns; what is said of that model is left as it is.

        Args:
            model: its columns, by their places among all N + C.
            which: the candidates.
            undone: shape (N + C,), how far parameters have gone back, so that the residuals have grown by what they did.
        """
        j, ends, gone = self.places(which), np.cumsum([0, *(len(self.columns[i]) for i in which)]), np.flatnonzero(undone)
        order, slots = np.concatenate([model, self.n_model + j]), np.full(len(self.sizes) + 1, -1)
        slots[order] = np.arange(len(order))
        return replace(
            self,
            effects=tuple(self.effects[i] for i in which),
            columns=tuple(np.arange(a, b) for a, b in pairwise(ends)),
            sizes=self.sizes[order],
            blocks_H=self.blocks_H[:, order[:, None], j],
            blocks_g=self.blocks_g[:, j] + undone[gone] @ self.blocks_H[:, gone[:, None], j],
            parts=tuple(part.among(slots, undone) for part in self.parts),
        )

    def along_rows(self, which: Sequence[int], steps: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield rows, what a refit of the model leaves of their residuals, and how steps of candidates then move them.

        Args:
            which: candidates.
            steps: shape (J, R), R steps of their J parameters.

        Yields:
            Which of all rows they are, shape (n,), whitened residuals, shape (m, n), and motions beside what the model takes
            up of them, shape (R, m, n).
        """
        model, j = self.model, self.places(which)
        taken = model.factor.solve(np.column_stack([self.cross[:, j] @ steps, -model.rows.g - model.prior.g]))
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
        """Return the test of some candidates taken as one, of so many groups that are tested."""
        (gain, rank), looks = self.gain(which), math.prod(self.effects[i].looks for i in which)
        chance = self._alone[2][which[0]] if len(which) == 1 else looks * chance_of(gain, rank, self.squares, self.dof)
        return self._judged(gain, rank, float(chance), self.squares, groups * looks)

    def score_given(self, which: Sequence[int], given: Sequence[int], groups: int = 1) -> ScoreResult:
        """Return the test of what some candidates still explain once others are in the model."""
        both, rank_both = self.gain(sorted({*which, *given}))
        alone, rank_alone = self.gain(given)
        gain, rank, squares = both - alone, max(rank_both - rank_alone, 0), max(self.squares - alone, 1e-6 * self.squares)
        chance = float(chance_of(gain, rank, squares, self.dof - rank_alone))
        return self._judged(gain, rank, chance, squares, groups)

    def p_value_of_any(self, which: Sequence[int]) -> float:
        """Return the p-value of some candidates, of all as one or of one of them alone, its choice paid for.

        One joint's drive that is compliant is lost among as many parameters as all drives and bearings have.
        """
        alone = (len(which) * self.score([i], 1).p_value for i in which)
        return min(self.score(which, 1).p_value, *alone)

    def _judged(self, gain: float, rank: int, chance: float, squares: float, groups: float) -> ScoreResult:
        if rank == 0:
            return ScoreResult(0.0, 0, 1.0, np.inf)
        gain, n = min(gain, TESTING.most_explained * squares), self.readings
        cost = n * float(np.log1p(-gain / squares)) + rank * float(np.log(n)) + 2.0 * float(np.log(max(groups, 1.0)))
        return ScoreResult(gain, rank, min(chance, 1.0), cost)

    def log_evidence(self, which: Sequence[int]) -> float:
        """Return the log of how much likelier the data are with some candidates, whatever their values, than without.

        Their priors decide what they may be: a wide one costs more, which no p-value knows (Bayes factor, first order). The
        places or frequencies among which they were chosen cost, too.
        """
        cost, tests = self.likeliest(which)
        j, S, b = tests.within(which)
        size = self.sizes[self.n_model + j]
        prior = np.outer(size, size) * tests.prior(which)
        information = np.outer(size, size) * S + prior
        step = np.linalg.solve(information, size * b)
        spread = np.linalg.slogdet(prior)[1] - np.linalg.slogdet(information)[1]
        looks = sum(float(np.log(self.effects[i].looks)) for i in which)
        return float(0.5 * ((size * b) @ step + spread - cost)) - looks


def chance_of(
    gain: np.ndarray | float, rank: np.ndarray | int, squares: np.ndarray | float, dof: np.ndarray | float
) -> np.ndarray:
    """Return the chance that something of a rank that is not there takes as much off the squares (F test).

    All arguments of any shape.

    Args:
        gain: what it takes off.
        rank: directions of it that the data see; of none the chance is 1.
        squares: before, in the same unit.
        dof: degrees of freedom before.
    """
    gain, rest, rank_seen = (
        np.minimum(gain, TESTING.most_explained * squares),
        np.maximum(dof - rank, 1.0),
        np.maximum(rank, 1),
    )
    return np.asarray(np.where(rank, fdtrc(rank_seen, rest, (gain / rank_seen) / ((squares - gain) / rest)), 1.0))
