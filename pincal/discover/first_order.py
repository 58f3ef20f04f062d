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
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.special import fdtrc

from pincal.discover.policy import TESTING
from pincal.discover.products import Information, Products
from pincal.identify.quadratic import ROUNDING, SEEN, Factor
from pincal.model.effects import Effect


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
class Doubt:
    """Parameters at zero that are believed to be small, though not how small.

    Attributes:
        columns: shape (N,), whether each parameter of the model is one of them.
        factors: what their sizes may have to be multiplied by.
        costs: of believing in each factor, as an information criterion.
    """

    columns: np.ndarray
    factors: tuple[float, ...]
    costs: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class ScoreTests:
    """Gram matrices of a fitted model and of all candidates, whitened by the noise that the model leaves.

    What a refit with candidates, or without parameters of the model, would change follows from them to first order.

    Attributes:
        effects: the candidates.
        names: the N parameters of the model and of nuisance effects.
        values: shape (N,), of these.
        sizes: shape (N + C,), standard deviations of the priors, those of the candidates' C parameters behind.
        model: what rows and priors say of the N parameters, by block of poses.
        products: of the candidates' columns.
        doubt: parameters whose sizes are in doubt; None if none are.
        squares: weighted sum of squared residuals.
        readings: number of readings that count.
        spent: parameters spent by the model.
    """

    effects: tuple[Effect, ...]
    names: tuple[str, ...]
    values: np.ndarray
    sizes: np.ndarray
    model: Information
    products: Products
    squares: float
    readings: int
    spent: float
    doubt: Doubt | None = None

    @property
    def columns(self) -> tuple[np.ndarray, ...]:
        """For each candidate, its columns, counted from the first column of all candidates."""
        return self.products.columns

    @property
    def n_model(self) -> int:
        """Number of columns of the model and of nuisance effects."""
        return len(self.names)

    @property
    def precision(self) -> np.ndarray:
        """Inverse variances of the priors, shape (N + C,)."""
        return np.asarray(self.sizes**-2.0)

    def prior(self, which: Sequence[int]) -> np.ndarray:
        """Return the information of the priors of some candidates' J parameters, smoothness of curves included, (J, J)."""
        own = self.products.places(which)
        L, start = np.diag(self.precision[self.n_model + own]), 0
        for i in which:
            end = start + len(self.columns[i])
            if (smooth := self.effects[i].smoothness()) is not None:
                L[start:end, start:end] += smooth
            start = end
        return L

    @cached_property
    def projected(self) -> tuple[np.ndarray, np.ndarray]:
        """S' and b' of all candidate columns."""
        taken, b = self._projection
        return self.products.inner - taken @ taken.T, b

    @cached_property
    def _projection(self) -> tuple[np.ndarray, np.ndarray]:
        """H, shape (C, N), with S' = S - H H^T, and b', shape (C,), of all C candidate columns."""
        taken = self.model.factor.half(self.products.cross).T
        return taken, self.products.g - taken @ self.model.slope

    @cached_property
    def _beliefs(self) -> list[tuple[float, Self]]:
        """The same tests with each of the sizes that are in doubt, and what each costs: -2 log of how likely it is."""
        if self.doubt is None:
            return [(0.0, self)]
        found, own = [], self.doubt.columns
        for factor, cost in zip(self.doubt.factors, self.doubt.costs, strict=True):
            known = self.model.prior.H + np.diag(own * self.precision[: self.n_model] * (factor**-2.0 - 1.0))
            tests = replace(self, doubt=None, model=self.model.believing(factor, known))
            evidence = 0.5 * (tests.model.factor.log_det - tests.model.slope @ tests.model.slope)
            evidence += np.count_nonzero(own) * np.log(factor)
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
        j, (taken, b) = self.products.places(which), self._projection
        return j, self.products.inner_of(which) - taken[j] @ taken[j].T, b[j]

    def gain(self, which: Sequence[int]) -> tuple[float, int]:
        """Return T and rank of some candidates together; sizes in doubt are the likeliest ones, with and without them."""
        if len(which) == 1:
            gains, ranks, _ = self._alone
            return float(gains[which[0]]), int(ranks[which[0]])
        if self.doubt is not None:
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
        if self.doubt is not None:
            each = [(tests._alone[0] - cost, tests._alone[1]) for cost, tests in self._beliefs]
            gains, ranks = (np.array(of) for of in zip(*each, strict=True))
            best = np.argmax(gains, axis=0), np.arange(len(sizes))
            gains, ranks = gains[best], ranks[best]
        for size in np.unique(sizes) if self.doubt is None else ():
            some, (taken, b), inner = np.flatnonzero(sizes == size), self._projection, self.products.each_inner
            j = np.array([self.columns[i] for i in some])
            roots, seen = self._roots(j, inner[j[:, :, None], j[:, None]] - taken[j] @ taken[j].swapaxes(1, 2))
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
        scale = 1.0 / np.sqrt(np.maximum(self.products.squares[j], 1e-300))
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
        products, j = self.products, self.products.places(which)
        model_S, model_b = self.model.blocks.H[k], self.model.blocks.g[k]
        across, b = products.blocks_cross[k][:, j], products.blocks_g[k, j]
        own = products.blocks_inner[k][np.ix_(j, j)]
        model, model_step = self.model.without_block[k]
        cross = products.cross[:, j] - across
        taken = model.half(cross)
        known = products.inner_of(which) - own + self.prior(which)
        # Where few rows tell nearly all of it, what the model does not take is less than its rounding.
        factor = Factor.of(known - taken.T @ taken + ROUNDING * np.diag(np.diag(known)))
        step = factor.solve(products.g[j] - b - cross.T @ model_step)
        change = -model.back(taken @ step)
        along = model_S @ change + across @ step
        beside = across.T @ change + own @ step
        left = model_b - model_S @ model_step, b - across.T @ model_step
        return float(2.0 * (change @ left[0] + step @ left[1]) - change @ along - step @ beside)

    def losses_by_block(self, names: Collection[str], still: Collection[str] = ()) -> np.ndarray:
        """Return by how much the squared error on each block left out grows without some of the model, shape (B,).

        Their values are held at zero and all others refitted, to first order, without each block.

        Args:
            names: parameters of the model.
            still: others that stay as they are, as what they do is done by way of those that go.
        """
        j = np.array([i for i, name in enumerate(self.names) if name in names or name in still], int)
        goes = np.array([self.names[i] in names for i in j], bool)
        units, losses = np.eye(self.n_model)[:, j], np.zeros(len(self.model.blocks.H))
        for k, (factor, step) in enumerate(self.model.without_block if len(j) else ()):
            columns = factor.solve(units)
            held = step - columns @ np.linalg.solve(columns[j], step[j] + goes * self.values[j])
            H, g = self.model.blocks.H[k], self.model.blocks.g[k]
            losses[k] = held @ H @ held - step @ H @ step - 2.0 * g @ (held - step)
        return losses

    def holding(self, names: Collection[str]) -> Self:
        """Return the same tests against the model with some of its parameters held where they are."""
        held = np.array([name in names for name in self.names])
        H = self.model.prior.H + np.diag(held * np.diag(self.model.rows.H) * TESTING.held)
        return replace(self, model=Information(self.model.blocks, replace(self.model.prior, H=H)))

    def among(self, which: Sequence[int], gone: Collection[str], model: Information | None = None) -> Self:
        """Return the tests of some candidates against the model as it stands with some of its parameters at zero.

        Args:
            which: the candidates.
            gone: the parameters of the model that go.
            model: what rows and priors say of those that stay; default: it follows, to first order, without evaluation.
        """
        stays = np.array([name not in gone for name in self.names], bool)
        kept, out = np.flatnonzero(stays), np.flatnonzero(~stays)
        values, rows = self.values[out], self.model.rows.part(out)
        return replace(
            self,
            effects=tuple(self.effects[i] for i in which),
            names=tuple(self.names[i] for i in kept),
            values=self.values[kept],
            sizes=self.sizes[np.concatenate([kept, self.n_model + self.products.places(which)])],
            model=self.model.without(kept, out, values) if model is None else model,
            products=self.products.among(which, kept, out, values),
            doubt=None if self.doubt is None else replace(self.doubt, columns=self.doubt.columns[kept]),
            squares=self.squares + float(values @ (2.0 * rows.g + rows.H @ values)),
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
        products, model, j = self.products, self.model, self.products.places(which)
        taken = model.factor.solve(np.column_stack([products.cross[:, j] @ steps, -model.rows.g - model.prior.g]))
        own = np.zeros((len(products.g), taken.shape[1]))
        own[j, :-1] = steps
        for part in products.parts:
            moved = part.moved(-taken, own)
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

    def costs_instead(self, which: Sequence[int], lost: Mapping[str, float]) -> list[float]:
        """Return the changes of the information criterion if each candidate took the place of some parameters of the model.

        Both are in the model first, priors included, and these parameters then lose what they are told to, to first order.
        """
        j = np.array([i for i, name in enumerate(self.names) if name in lost], int)
        columns = self.model.factor.solve(np.eye(self.n_model)[:, j])
        values = np.array([lost[self.names[i]] for i in j]) + columns.T @ (self.model.rows.g + self.model.prior.g)
        spared = float(np.sum(np.clip(1.0 - np.diag(columns[j]) * self.precision[j], 0.0, 1.0)))
        costs = []
        for i, (c, S, b) in ((i, self.within([i])) for i in which):
            inverse = np.linalg.inv(S + self.prior([i]))
            cross = columns.T @ self.products.cross[:, c]
            left = values - cross @ inverse @ b
            loss = left @ np.linalg.solve(columns[j] + cross @ inverse @ cross.T, left) - b @ inverse @ b
            costs.append(float(loss + (len(c) - spared) * np.log(self.readings)))
        return costs


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
