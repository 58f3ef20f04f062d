r"""What refits would change, to first order: with further effects, without some of a model, and without blocks of poses.

With S and b of all whitened columns, those of the model (N) and of candidates (g), and L the priors of the model,

.. math:: S'_{gg} = S_{gg} - S_{gN} (S_{NN} + L)^{-1} S_{Ng}, \qquad b'_g = b_g - S_{gN} (S_{NN} + L)^{-1} (b_N - L x)

are what is left of candidates once the model has taken up what it can of them; x are its parameters less what is believed.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from pincal.discover.information import Information, scaled_factor
from pincal.discover.products import Products
from pincal.model.effects import Effect

# Part of a column's square that must be left after projection for the data to see it.
_SEEN = 1e-5
# Part of a parameter's prior variance that the data take off, at least, where they see it: they know nothing of what only
# the priors of the model keep apart from it, as of a tilt that geometry is, too, were its lengths as far off as nobody
# builds them.
_TOLD = 0.01
# What parameters that are held are known by, in units of what the data say of them.
_HELD = 1e6


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
class FirstOrder:
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

    @cached_property
    def projected(self) -> tuple[np.ndarray, np.ndarray]:
        """S' and b' of all candidate columns."""
        taken, b = self._projection
        return self.products.inner - taken @ taken.T, b

    @cached_property
    def _projection(self) -> tuple[np.ndarray, np.ndarray]:
        """H, shape (C, N), with S' = S - H H^T, and b', shape (C,), of all C candidate columns."""
        scale, L, slope = self.model.factor
        taken = solve_triangular(L, scale[:, None] * self.products.cross, lower=True, check_finite=False).T
        return taken, self.products.b - taken @ slope

    @cached_property
    def _beliefs(self) -> list[tuple[float, Self]]:
        """The same tests with each of the sizes that are in doubt, and what each costs: -2 log of how likely it is."""
        if self.doubt is None:
            return [(0.0, self)]
        found, own = [], self.doubt.columns
        for factor, cost in zip(self.doubt.factors, self.doubt.costs, strict=True):
            known = self.model.known.copy()
            known.flat[:: len(known) + 1] += own * self.precision[: self.n_model] * (factor**-2.0 - 1.0)
            tests = replace(self, doubt=None, model=self.model.believing(factor, known))
            scale, L, slope = tests.model.factor
            evidence = np.sum(np.log(np.diag(L) / scale)) + np.count_nonzero(own) * np.log(factor) - 0.5 * slope @ slope
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
        if self.doubt is not None:
            found = [(cost, *tests.gain(which)) for cost, tests in self._beliefs]
            cost, gain, rank = min(found, key=lambda belief: belief[0] - belief[1])
            return gain - cost, rank
        if len(which) == 1:
            gains, ranks = self._alone
            return float(gains[which[0]]), int(ranks[which[0]])
        j, whitening = self.whitening(which)
        return float(np.sum((self._projection[1][j] @ whitening) ** 2)), whitening.shape[1]

    @cached_property
    def _alone(self) -> tuple[np.ndarray, np.ndarray]:
        """T and rank of each of C candidates by itself, shape (C,); those of one size are worked out at once."""
        (taken, b), diagonal = self._projection, self.products.squares
        sizes = np.array([len(j) for j in self.columns])
        gains, ranks = np.zeros(len(sizes)), np.zeros(len(sizes), int)
        for size in np.unique(sizes):
            some = np.flatnonzero(sizes == size)
            j = np.array([self.columns[i] for i in some])
            scale = 1.0 / np.sqrt(np.maximum(diagonal[j], 1e-300))
            S = self.products.each_inner(j) - taken[j] @ taken[j].swapaxes(1, 2)
            values, vectors = np.linalg.eigh(S * scale[:, :, None] * scale[:, None])
            seen = self._seen(j, scale, values, vectors)
            along = np.einsum("gi,gik->gk", scale * b[j], vectors) ** 2
            gains[some] = np.sum(np.where(seen, along / np.where(seen, values, 1.0), 0.0), axis=1)
            ranks[some] = seen.sum(axis=1)
        return gains, ranks

    def whitening(self, which: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the J columns of some candidates, and W, shape (J, rank), with T = |b' W|^2 for b' at these columns."""
        j, S, _ = self.within(which)
        scale = 1.0 / np.sqrt(np.maximum(self.products.squares[j], 1e-300))
        values, vectors = np.linalg.eigh(S * np.outer(scale, scale))
        seen = self._seen(j, scale, values, vectors)
        return j, scale[:, None] * vectors[:, seen] / np.sqrt(values[seen])

    def _seen(self, j: np.ndarray, scale: np.ndarray, values: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Return which eigenvectors, shape (..., J, J), of J columns the data see; shape (..., J) like all others."""
        expected = (self.sizes[self.n_model + j] / scale) ** 2
        told = values * np.einsum("...i,...ik->...k", expected, vectors**2)
        return np.asarray((values > _SEEN) & (told > _TOLD))

    def gains_by_block(self, which: Sequence[int]) -> np.ndarray:
        """Return by how much some candidates lower the squared prediction error on each block left out, shape (B,).

        Both the model and the model with the candidates are refitted, to first order, without each block. Sizes in doubt
        are those that are likeliest with the candidates.
        """
        tests = self.likeliest(which)[1]
        return np.array([tests._gain_left_out(k, which) for k in range(len(self.model.blocks_S))])

    def _gain_left_out(self, k: int, which: Sequence[int]) -> float:
        """Return by how much some candidates, fitted without block k, lower the squared error on it."""
        products, j = self.products, self.products.places(which)
        model_S, model_b = self.model.blocks_S[k], self.model.blocks_b[k]
        across, b = products.blocks_cross[k][:, j], products.blocks_b[k, j]
        own = products.blocks_inner[k][np.ix_(j, j)]
        model_scale, L, model_step = self.model.without_block[k]
        cross = products.cross[:, j] - across
        taken = solve_triangular(L, model_scale[:, None] * cross, lower=True, check_finite=False)
        precision = np.diag(self.precision[self.n_model + j])
        scale, factor = scaled_factor(products.inner_of(which) - own - taken.T @ taken + precision)
        slope = scale * (products.b[j] - b - cross.T @ model_step)
        step = scale * cho_solve((factor, True), slope, check_finite=False)
        change = -model_scale * solve_triangular(L, taken @ step, lower=True, trans="T", check_finite=False)
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
        units, losses = np.eye(self.n_model)[:, j], np.zeros(len(self.model.blocks_S))
        for k, (scale, factor, step) in enumerate(self.model.without_block if len(j) else ()):
            columns = scale[:, None] * cho_solve((factor, True), scale[:, None] * units, check_finite=False)
            held = step - columns @ np.linalg.solve(columns[j], step[j] + goes * self.values[j])
            S, b = self.model.blocks_S[k], self.model.blocks_b[k]
            losses[k] = held @ S @ held - step @ S @ step - 2.0 * b @ (held - step)
        return losses

    def holding(self, names: Collection[str]) -> Self:
        """Return the same tests against the model with some of its parameters held where they are."""
        held = np.array([name in names for name in self.names])
        known = self.model.known + np.diag(held * np.diag(self.model.S) * _HELD)
        return replace(self, model=Information(self.model.blocks_S, self.model.blocks_b, known, self.model.pull))

    def among(self, which: Sequence[int], gone: Collection[str], model: Information | None = None) -> Self:
        """Return the tests of some candidates against the model as it stands with some of its parameters at zero.

        Args:
            which: the candidates.
            gone: the parameters of the model that go.
            model: what rows and priors say of those that stay; default: it follows, to first order, without evaluation.
        """
        stays = np.array([name not in gone for name in self.names], bool)
        kept, out = np.flatnonzero(stays), np.flatnonzero(~stays)
        values = self.values[out]
        return replace(
            self,
            effects=tuple(self.effects[i] for i in which),
            names=tuple(self.names[i] for i in kept),
            values=self.values[kept],
            sizes=self.sizes[np.concatenate([kept, self.n_model + self.products.places(which)])],
            model=self.model.without(kept, out, values) if model is None else model,
            products=self.products.among(which, kept, out, values),
            doubt=None if self.doubt is None else replace(self.doubt, columns=self.doubt.columns[kept]),
            squares=self.squares + self.model.grown(out, values),
        )

    def estimate(self, which: Sequence[int]) -> np.ndarray:
        """Return some candidates' parameters to first order, priors included."""
        j, S, b = self.within(which)
        return np.asarray(np.linalg.inv(S + np.diag(self.precision[self.n_model + j])) @ b)
