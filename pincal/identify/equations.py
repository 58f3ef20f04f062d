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

from pincal.identify.normal import Normal, accumulate, beliefs_squared, block_rows
from pincal.identify.posterior import Contribution, Eliminated, Posterior, eliminate, posterior, posterior_step
from pincal.identify.problem import Problem
from pincal.identify.station import Station


@dataclass(frozen=True)
class Squares:
    """Squares of a station's residuals.

    Attributes:
        blocks: shape (blocks,), weighted sums.
        rows: shape (blocks, N), each row's weighted squared residual, robust weights left out.
        beliefs: of what the sensor knows beside its readings, in units of the variances.
    """

    blocks: np.ndarray
    rows: np.ndarray
    beliefs: float


def squares(station: Station, values: np.ndarray, robust: np.ndarray) -> Squares:
    """Return the squares of a station's residuals at values of its parameters; ``robust`` as in :func:`contribution`."""
    residuals = station.residuals(values)
    parts = [np.einsum("in,in->n", residuals[rows], residuals[rows]) for rows in block_rows(station)]
    rows = np.array(parts) * station.weights**2
    return Squares(rows @ robust**2, rows, beliefs_squared(station, values))


def contribution(
    station: Station,
    values: np.ndarray,
    free: np.ndarray,
    robust: np.ndarray,
    sigma: np.ndarray,
    own: np.ndarray,
    sizes: np.ndarray,
) -> tuple[Contribution, Squares]:
    """Return what a station says of the free parameters that it shares with others, and the squares of its residuals.

    Args:
        station: the station.
        values: shape (P,), of its parameters, as are the others.
        free: shape (P,), which of them may move.
        robust: shape (N,), factor on each row's weight: 0 leaves a row out.
        sigma: shape (blocks,), standard deviation of one component of each block of its readings.
        own: shape (P,), which of them belong to the station alone.
        sizes: shape (P,), standard deviations of the priors; inf for none.
    """
    normal = accumulate(station, values, free, robust)
    G, g = normal.at(sigma)
    return eliminate(G, g, own[free], sizes[free], values[free]), squares_of(normal)


def squares_of(normal: Normal) -> Squares:
    """Return the squares of residuals that normal equations came with."""
    return Squares(normal.squares, normal.row_squares, 0.0 if normal.believed is None else normal.believed[2])


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
                replace(part, places=rank[part.places], shared=slot[part.shared[mine]], carried=part.carried[:, mine])
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
class Past:
    """Sums over stations with other robust weights, shape (N,): equations and squares by the noise that they are for."""

    robust: np.ndarray
    sums: dict[bytes, tuple[Equations, list[Squares]]]


@dataclass(frozen=True, eq=False)
class Linearised:
    """A problem at one set of values.

    With one station the Gram matrices are kept block by block of its readings, since another noise only weighs them anew.
    Of several nothing is kept but squares and the sum for one noise.

    Attributes:
        problem: the stations.
        values: shape (P,).
        free: shape (P,), the F parameters that may move.
        robust: shape (N,), factor on each row's weight: 0 leaves a row out.
        sizes: shape (P,), standard deviations of the priors; inf for none.
        executor: computes what stations contribute; default: one after the other, here.
        sigma: shape (blocks,), the noise for which equations will be wanted, where it is known before the residuals are:
            one pass over several stations then does for both.
        past: the same values with other robust weights: most stations have the same ones, and contribute what they did.
    """

    problem: Problem
    values: np.ndarray
    free: np.ndarray
    robust: np.ndarray
    sizes: np.ndarray
    executor: Executor | None = None
    sigma: np.ndarray | None = None
    past: Past | None = None

    def reweighted(self, robust: np.ndarray) -> Linearised:
        """Return the same point with other robust weights; stations whose weights stay are not computed again."""
        return replace(self, robust=robust, past=Past(self.robust, dict(self._sums)))

    @cached_property
    def _normal(self) -> Normal:
        return accumulate(self.problem.station, self.values, self.free, self.robust)

    @cached_property
    def _squares(self) -> list[Squares]:
        if len(self.problem.stations) == 1:
            return [squares_of(self._normal)]
        if self.sigma is not None:
            self.equations(self.sigma)
            return self._sums[self.sigma.tobytes()][1]
        stations = self.problem.stations
        return list(self._map(squares, stations, self._local(self.values), self._by_rows(self.robust)))

    @property
    def squares(self) -> np.ndarray:
        """Weighted sums of squared residuals of all blocks of readings, shape (blocks,)."""
        return np.concatenate([found.blocks for found in self._squares])

    @property
    def row_squares(self) -> list[np.ndarray]:
        """For each station, each row's weighted squared residual, shape (its blocks, its rows), robust weights left out."""
        return [found.rows for found in self._squares]

    def chi2(self, sigma: np.ndarray) -> float:
        """Return the sum of squares in units of the variances, for standard deviations of all blocks."""
        return float(np.sum(self.squares / sigma**2))

    def objective(self, sigma: np.ndarray) -> float:
        """Return the sum of squares of readings, of what sensors know beside them and of priors, in units of variances."""
        known = self.free & np.isfinite(self.sizes)
        prior = float(np.sum((self.values[known] / self.sizes[known]) ** 2))
        return self.chi2(sigma) + sum(found.beliefs for found in self._squares) + prior + self._remembered_square()

    @cached_property
    def _sums(self) -> dict[bytes, tuple[Equations, list[Squares]]]:
        return {}

    def equations(self, sigma: np.ndarray) -> Equations:
        """Return the normal equations for standard deviations of all blocks of readings, shape (blocks,)."""
        key = sigma.tobytes()
        if key not in self._sums:
            found = (self._alone(sigma), []) if len(self.problem.stations) == 1 else self._sum(sigma)
            self._sums.clear()
            self._sums[key] = found
        return self._sums[key][0]

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

    def _sum(self, sigma: np.ndarray) -> tuple[Equations, list[Squares]]:
        problem, free = self.problem, self.free
        rank = np.cumsum(free) - 1
        shared = problem.is_shared[free]
        slot = np.cumsum(shared) - 1
        n = int(shared.sum())
        stations, robust = range(len(problem.stations)), self._by_rows(self.robust)
        if self.past is None or sigma.tobytes() not in self.past.sums:
            G, g, diagonal = np.zeros((n, n)), np.zeros(n), np.zeros(int(free.sum()))
            known = self._remember(G, g)
            diagonal[shared] += np.diag(G)
            own: dict[int, Eliminated] = {}
            residuals: dict[int, Squares] = {}
            work = [(i, 1.0, robust[i]) for i in stations]
        else:
            before, squares_before = self.past.sums[sigma.tobytes()]
            known = before.remembered
            G, g, diagonal = before.G.copy(), before.g.copy(), before.diagonal.copy()
            own, residuals = dict(enumerate(before.own)), dict(enumerate(squares_before))
            pairs = zip(stations, self._by_rows(self.past.robust), robust, strict=True)
            work = [job for i, old, new in pairs if np.any(old != new) for job in ((i, -1.0, old), (i, 1.0, new))]
        places, local_free, sizes = problem.places, self._local(free), self._local(self.sizes)
        values, spans = self._local(self.values), problem.block_spans
        parts = self._map(
            contribution,
            [problem.stations[i] for i, _, _ in work],
            [values[i] for i, _, _ in work],
            [local_free[i] for i, _, _ in work],
            [weights for _, _, weights in work],
            [sigma[spans[i]] for i, _, _ in work],
            [problem.eliminated[i] for i, _, _ in work],
            [sizes[i] for i, _, _ in work],
        )
        for (i, sign, _), (part, found) in zip(work, parts, strict=True):
            is_own, moved = problem.eliminated[i], local_free[i]
            mine, ours = rank[places[i][moved & is_own]], slot[rank[places[i][moved & ~is_own]]]
            G[ours[:, None], ours] += sign * part.G
            g[ours] += sign * part.g
            diagonal[rank[places[i][moved]]] += sign * part.diagonal
            own[i], residuals[i] = part.eliminated(mine, ours), found
        eliminated, at = tuple(own.values()), self.values[free]
        return Equations(G, g, shared, diagonal, eliminated, self.sizes[free], at, known), list(residuals.values())

    def _map(self, function: Callable[..., Any], *arguments: Iterable[Any]) -> Iterable[Any]:
        return map(function, *arguments) if self.executor is None else self.executor.map(function, *arguments)

    def _local(self, vector: np.ndarray) -> list[np.ndarray]:
        """Return each station's part of a vector over all parameters."""
        return [vector[places] for places in self.problem.places]

    def _by_rows(self, vector: np.ndarray) -> list[np.ndarray]:
        """Return each station's part of a vector over all rows."""
        return [vector[rows] for rows in self.problem.rows]
