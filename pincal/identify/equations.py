"""All stations of a problem linearised at one point: squares of residuals, and normal equations for one noise.

What a station contributes is computed by functions of this module on arguments that can be pickled, so that the sum can be
mapped by any ``concurrent.futures`` executor. Contributions are added in the order of the stations, so that the result does
not depend on it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pincal.identify.batch import Batch
from pincal.identify.normal import Normal, accumulate, accumulate_each, beliefs_squared, block_rows
from pincal.identify.posterior import Contribution, Eliminated, Posterior, eliminate, posterior, posterior_step
from pincal.identify.problem import Problem
from pincal.identify.station import Station


@dataclass(frozen=True)
class Squares:
    """Squares of the residuals of stations, one after the other.

    Attributes:
        blocks: shape (blocks,), weighted sums.
        rows: of each station, shape (its blocks, its N rows), each row's weighted squared residual, robust weights left out.
        beliefs: of what each station's sensor knows beside its readings, in units of the variances.
    """

    blocks: np.ndarray
    rows: tuple[np.ndarray, ...]
    beliefs: np.ndarray


def squares(station: Station, ends: np.ndarray, values: np.ndarray, robust: np.ndarray) -> Squares:
    """Return the squares of stations' residuals; arguments as in :func:`pincal.identify.normal.accumulate_each`."""
    residuals = station.residuals(values)
    parts = [np.einsum("in,in->n", residuals[rows], residuals[rows]) for rows in block_rows(station)]
    rows = np.array(parts) * station.weights**2
    each = np.split(rows, ends[1:-1], axis=1)
    blocks = np.concatenate([of @ weights**2 for of, weights in zip(each, np.split(robust, ends[1:-1]), strict=True)])
    known = [beliefs_squared(station, values)] if len(each) == 1 else np.zeros(len(each))
    return Squares(blocks, tuple(each), np.asarray(known))


def contribution(
    station: Station,
    ends: np.ndarray,
    values: np.ndarray,
    robust: np.ndarray,
    free: np.ndarray,
    own: np.ndarray,
    sigma: np.ndarray,
    sizes: np.ndarray,
) -> tuple[Contribution, Squares]:
    """Return what stations say of the free parameters that they share with others, and the squares of their residuals.

    Args:
        station: the rows of S stations, one after the other.
        ends: shape (S + 1,), where those of each begin and end.
        values: shape (P,), or of several stations shape (P, S).
        robust: shape (N,), factor on each row's weight: 0 leaves a row out.
        free: shape (P,), which parameters may move.
        own: shape (P,), which of them belong to a station alone.
        sigma: shape (S, blocks), standard deviation of one component of each block of readings.
        sizes: shape (S, P), standard deviations of the priors; inf for none.
    """
    normal = accumulate_each(station, ends, values, free, robust)
    G, g = normal.at(sigma)
    at = np.atleast_2d(values.T)[:, free]
    return eliminate(G, g, own[free], sizes[:, free], at), squares_of(normal, ends)


def squares_of(normal: Normal, ends: np.ndarray) -> Squares:
    """Return the squares of residuals that normal equations came with."""
    known = np.zeros(len(ends) - 1)
    if normal.believed is not None:
        known[:] = normal.believed[2]
    return Squares(normal.squares.ravel(), tuple(np.split(normal.row_squares, ends[1:-1], axis=1)), known)


@dataclass(frozen=True)
class Equations:
    """Normal equations of the F free parameters for one noise, C of them left after stations' own were eliminated.

    Attributes:
        G: shape (C, C).
        g: shape (C,).
        shared: shape (F,), which parameters these are; with one station all.
        diagonal: shape (F,), of the normal equations before anything was eliminated.
        own: the parameters that were eliminated; with one station none.
        sizes: shape (F,), standard deviations of the priors; inf for none.
        values: shape (F,), present values.
        remembered: shape (C, C), the part of G that is known from an earlier fit; None for nothing.
    """

    G: np.ndarray
    g: np.ndarray
    shared: np.ndarray
    diagonal: np.ndarray
    own: tuple[Eliminated, ...]
    sizes: np.ndarray
    values: np.ndarray
    remembered: np.ndarray | None = None

    def step(self, bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the step that the posterior wants within bounds of the values, shape (F,), and which ones a bound stops."""
        step, held = self._bounded(bounds[self.shared])
        if not self.own:
            return step, held
        whole, stopped = np.empty(len(self.values)), np.zeros(len(self.values), bool)
        whole[self.shared], stopped[self.shared] = step, held
        for part in self.own:
            at, most = self.values[part.places], bounds[part.places]
            wanted = at + part.step(step)
            whole[part.places] = np.clip(wanted, -most, most) - at
            stopped[part.places] = np.abs(wanted) > most
        return whole, stopped

    def _bounded(self, bounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at, sizes, diagonal = self.values[self.shared], self.sizes[self.shared], self.diagonal[self.shared]
        step = posterior_step(self.G, self.g, sizes, at, diagonal=diagonal)
        held = np.zeros(len(step), bool)
        for _ in range(3):
            over = ~held & (np.abs(at + step) > bounds)
            if not over.any():
                break
            held |= over
            step = np.where(held, np.copysign(bounds, at + step) - at, step)
            loose = ~held
            left = (self.g - self.G[:, held] @ step[held])[loose]
            inner = self.G[np.ix_(loose, loose)]
            step[loose] = posterior_step(inner, left, sizes[loose], at[loose], diagonal=diagonal[loose])
        return step, held

    def square(self, step: np.ndarray) -> float:
        """Return the square of a step, shape (F,), in units of the noise: how far it moves the readings altogether."""
        across = step[self.shared]
        return float(across @ self.G @ across) + sum(part.square(step[part.places], across) for part in self.own)

    @property
    def metric(self) -> np.ndarray:
        """How much each parameter matters to readings and prior, shape (F,)."""
        return np.asarray(np.sqrt(self.diagonal + self.sizes**-2.0))

    def posterior(self) -> Posterior:
        """Return what data and priors say together."""
        at, sizes, diagonal = self.values[self.shared], self.sizes[self.shared], self.diagonal[self.shared]
        found = posterior(self.G, self.g, sizes, at, diagonal=diagonal)
        known = 0.0 if self.remembered is None else float(np.sum(found.covariance * self.remembered))
        return replace(found, own=self.own, remembered=known)

    @property
    def gain(self) -> float:
        """How much the step would take off the sum of squares, what eliminated parameters do by themselves left out."""
        at, sizes = self.values[self.shared], self.sizes[self.shared]
        slope = self.g - at / sizes**2
        return float(slope @ posterior_step(self.G, self.g, sizes, at, diagonal=self.diagonal[self.shared]))

    def of(self, kept: np.ndarray) -> Equations:
        """Return the equations of some of the shared parameters alone, and of all own ones; ``kept``, shape (F,)."""
        inner = kept[self.shared]
        rank = np.cumsum(kept) - 1
        slot = np.where(inner, np.cumsum(inner) - 1, -1)
        own = []
        for part in self.own:
            mine = inner[part.shared]
            own.append(
                replace(part, places=rank[part.places], shared=slot[part.shared[mine]], carried=part.carried[..., mine])
            )
        return Equations(
            G=self.G[np.ix_(inner, inner)],
            g=self.g[inner],
            shared=self.shared[kept],
            diagonal=self.diagonal[kept],
            own=tuple(own),
            sizes=self.sizes[kept],
            values=self.values[kept],
            remembered=None if self.remembered is None else self.remembered[np.ix_(inner, inner)],
        )


@dataclass(frozen=True)
class Part:
    """What a batch of stations contributes for one noise and for one set of robust weights."""

    sigma: np.ndarray
    robust: np.ndarray
    found: Contribution
    squares: Squares

    def is_for(self, sigma: np.ndarray, robust: np.ndarray) -> bool:
        """Return whether it is for this noise and these robust weights of its own readings."""
        return np.array_equal(self.sigma, sigma) and np.array_equal(self.robust, robust)


@dataclass(frozen=True, eq=False)
class Linearised:
    """A problem at one set of values.

    With one station the Gram matrices are kept block by block of its readings, since another noise only weighs them anew.
    Of several nothing is kept but squares and the sums over batches of stations for one noise.

    Attributes:
        problem: the stations.
        values: shape (P,).
        free: shape (P,), the F parameters that may move.
        robust: shape (N,), factor on each row's weight: 0 leaves a row out.
        sizes: shape (P,), standard deviations of the priors; inf for none.
        executor: computes what stations contribute; default: one after the other, here.
        sigma: shape (blocks,), the noise for which equations will be wanted, where it is known before the residuals are:
            one pass over several stations then does for both.
        past: sums over batches at the same values, perhaps with other robust weights.
    """

    problem: Problem
    values: np.ndarray
    free: np.ndarray
    robust: np.ndarray
    sizes: np.ndarray
    executor: Executor | None = None
    sigma: np.ndarray | None = None
    past: tuple[Part, ...] = ()

    def reweighted(self, robust: np.ndarray) -> Linearised:
        """Return the same point with other robust weights; stations whose weights stay are not computed again."""
        return replace(self, robust=robust, past=tuple(self._parts))

    @cached_property
    def _normal(self) -> Normal:
        return accumulate(self.problem.station, self.values, self.free, self.robust)

    @cached_property
    def _batches(self) -> list[Batch]:
        return [part for batch in self.problem.batches for part in batch.alike(self.free)]

    @cached_property
    def _parts(self) -> list[Part]:
        """The latest sums, batch by batch; empty before there are any."""
        return list(self.past)

    @cached_property
    def _squares(self) -> list[Squares]:
        if len(self.problem.stations) == 1:
            normal, ends = self._normal, np.array([0, len(self.problem)])
            return [squares_of(normal, ends)]
        if self.sigma is not None:
            self.equations(self.sigma)
            return [part.squares for part in self._parts]
        batches = self._batches
        robust = (self.robust[batch.rows] for batch in batches)
        return list(self._map(squares, *self._work(batches), robust))

    @property
    def squares(self) -> np.ndarray:
        """Weighted sums of squared residuals of all blocks of readings, shape (blocks,)."""
        return np.concatenate([found.blocks for found in self._squares])

    @property
    def row_squares(self) -> list[np.ndarray]:
        """For each station, each row's weighted squared residual, shape (its blocks, its rows), robust weights left out."""
        return [rows for found in self._squares for rows in found.rows]

    def chi2(self, sigma: np.ndarray) -> float:
        """Return the sum of squares in units of the variances, for standard deviations of all blocks."""
        return float(np.sum(self.squares / sigma**2))

    @cached_property
    def group_of(self) -> np.ndarray:
        """For each parameter, shape (P,), the fit that it belongs to: stations that share nothing have one each."""
        found = np.zeros(len(self.values), int)
        if len(self.problem.stations) > 1 and not np.any(self.free & self.problem.is_shared):
            for i, (places, own) in enumerate(zip(self.problem.places, self.problem.eliminated, strict=True)):
                found[places[own]] = i
        return found

    def objectives(self, sigma: np.ndarray) -> np.ndarray:
        """Return the sums of squares of the fits that the parameters belong to, each as in :meth:`objective`."""
        n = int(self.group_of.max(initial=0)) + 1
        if n == 1:
            return np.array([self.objective(sigma)])
        starts = [span.start for span in self.problem.block_spans]
        known = np.flatnonzero(self.free & np.isfinite(self.sizes))
        prior = np.bincount(self.group_of[known], (self.values[known] / self.sizes[known]) ** 2, minlength=n)
        beliefs = np.concatenate([found.beliefs for found in self._squares])
        return np.asarray(np.add.reduceat(self.squares / sigma**2, starts) + beliefs + prior)

    def objective(self, sigma: np.ndarray) -> float:
        """Return the sum of squares of readings, of what sensors know beside them and of priors, in units of variances."""
        known = self.free & np.isfinite(self.sizes)
        prior = float(np.sum((self.values[known] / self.sizes[known]) ** 2))
        beliefs = sum(float(found.beliefs.sum()) for found in self._squares)
        return self.chi2(sigma) + beliefs + prior + self._remembered_square()

    @cached_property
    def _equations(self) -> dict[bytes, Equations]:
        return {}

    def equations(self, sigma: np.ndarray) -> Equations:
        """Return the normal equations for standard deviations of all blocks of readings, shape (blocks,)."""
        key = sigma.tobytes()
        if key not in self._equations:
            found = self._alone(sigma) if len(self.problem.stations) == 1 else self._sum(sigma)
            self._equations.clear()
            self._equations[key] = found
        return self._equations[key]

    def _alone(self, sigma: np.ndarray) -> Equations:
        G, g = self._normal.at(sigma)
        free = self.free
        known = self._remember(G, g)
        return Equations(G, g, np.ones(len(g), bool), np.diag(G), (), self.sizes[free], self.values[free], known)

    def _remember(self, G: np.ndarray, g: np.ndarray) -> np.ndarray | None:
        """Add what is known from an earlier fit to the equations of the shared parameters, and return its part of G."""
        if self.problem.remembered is None:
            return None
        kept = np.flatnonzero(self.free & self.problem.is_shared)
        known, slope = self.problem.beyond_priors(kept, self.values, self.sizes)
        G += known
        g += slope
        return known

    def _remembered_square(self) -> float:
        if self.problem.remembered is None:
            return 0.0
        places, earlier = self.problem.remembered
        return earlier.square(self.values[places], self.sizes[places])

    def _sum(self, sigma: np.ndarray) -> Equations:
        free, batches = self.free, self._batches
        rank = np.cumsum(free) - 1
        shared = self.problem.is_shared[free]
        slot = np.cumsum(shared) - 1
        n = int(shared.sum())
        G, g, diagonal = np.zeros((n, n)), np.zeros(n), np.zeros(int(free.sum()))
        known = self._remember(G, g)
        diagonal[shared] += np.diag(G)
        eliminated = []
        self._contribute(sigma)
        for batch, part in zip(batches, self._parts, strict=True):
            moved = free[batch.places[0]]
            mine, ours = batch.places[:, moved & batch.own], slot[rank[batch.places[0, moved & ~batch.own]]]
            G[ours[:, None], ours] += part.found.G
            g[ours] += part.found.g
            np.add.at(diagonal, rank[batch.places[:, moved]], part.found.diagonal)
            eliminated.append(part.found.eliminated(rank[mine], ours))
        return Equations(G, g, shared, diagonal, tuple(eliminated), self.sizes[free], self.values[free], known)

    def _contribute(self, sigma: np.ndarray) -> None:
        """Compute the sums over those batches of which there are none yet for this noise and these robust weights."""
        parts: list[Part | None] = list(self._parts) or [None] * len(self._batches)
        wanted = [(sigma[batch.blocks], self.robust[batch.rows]) for batch in self._batches]
        todo = [
            k for k, (part, asked) in enumerate(zip(parts, wanted, strict=True)) if part is None or not part.is_for(*asked)
        ]
        batches = [self._batches[k] for k in todo]
        found = self._map(
            contribution,
            *self._work(batches),
            (wanted[k][1] for k in todo),
            (self.free[batch.places[0]] for batch in batches),
            (batch.own for batch in batches),
            (wanted[k][0].reshape(len(batch.stations), -1) for k, batch in zip(todo, batches, strict=True)),
            (self.sizes[batch.places] for batch in batches),
        )
        for k, each in zip(todo, found, strict=True):
            parts[k] = Part(*wanted[k], *each)
        self._parts[:] = [part for part in parts if part is not None]

    def _work(self, batches: list[Batch]) -> tuple[Iterable[Any], Iterable[Any], Iterable[Any]]:
        """Return the stations of each batch as one, where the rows of each begin and end, and their values."""
        values = (batch.values(self.values) for batch in batches)
        return (batch.together() for batch in batches), (batch.ends for batch in batches), values

    def _map(self, function: Callable[..., Any], *arguments: Iterable[Any]) -> Iterable[Any]:
        return map(function, *arguments) if self.executor is None else self.executor.map(function, *arguments)
