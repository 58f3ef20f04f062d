"""All stations of a problem linearised at one point: squares of residuals, and normal equations for one noise.

What a station contributes is computed by functions of arguments that can be pickled, so that the sum can be mapped by any
``concurrent.futures`` executor. Contributions are added in the order of the stations, so that the result does not depend on
it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pincal.identify.batch import Batch, Task
from pincal.identify.posterior import (
    Contribution,
    Eliminated,
    Posterior,
    posterior,
    posterior_covariance,
    posterior_step,
    spent_parameters,
)
from pincal.identify.problem import Problem
from pincal.identify.sums import Kept, Part, Squares, contribution, contribution_of, reweighted, squares, squares_of
from pincal.spread import repeated

# Bytes of normal equations of single stations that are kept at most at one point.
_MOST_KEPT = 2_000_000


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
        remembered: shape (C, C), the part of G that is believed beyond the priors, known from an earlier fit or that curves
            are smooth; None for nothing.
    """

    G: np.ndarray
    g: np.ndarray
    shared: np.ndarray
    diagonal: np.ndarray
    own: tuple[Eliminated, ...]
    sizes: np.ndarray
    values: np.ndarray
    remembered: np.ndarray | None = None

    def step(self, bounds: np.ndarray, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the step that the posterior wants within bounds of the values, shape (F,), and which ones a bound stops.

        Args:
            bounds: shape (F,), largest values.
            damping: how much surer than the priors it is that parameters stay where they are (Levenberg's): what the
                readings are sure of moves as far as without, what they hardly see does not.
        """
        step, held = self._bounded(bounds[self.shared], 1.0 + damping)
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

    def _bounded(self, bounds: np.ndarray, stiffness: float) -> tuple[np.ndarray, np.ndarray]:
        at, sizes, diagonal = self.values[self.shared], self.sizes[self.shared], self.diagonal[self.shared]
        # The slope of the priors stays what it is.
        sizes, pulled = sizes / np.sqrt(stiffness), at / stiffness
        step = posterior_step(self.G, self.g, sizes, pulled, diagonal=diagonal)
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
            step[loose] = posterior_step(inner, left, sizes[loose], pulled[loose], diagonal=diagonal[loose])
        return step, held

    def square(self, step: np.ndarray) -> float:
        """Return the square of a step, shape (F,), in units of the noise: how far it moves the readings altogether."""
        across = step[self.shared]
        return float(across @ self.G @ across) + sum(part.square(step[part.places], across) for part in self.own)

    @property
    def metric(self) -> np.ndarray:
        """How much each parameter matters to readings and prior, shape (F,)."""
        return np.asarray(np.sqrt(self.diagonal + self.sizes**-2.0))

    @cached_property
    def posterior(self) -> Posterior:
        """What data and priors say together."""
        at, sizes, diagonal = self.values[self.shared], self.sizes[self.shared], self.diagonal[self.shared]
        found = posterior(self.G, self.g, sizes, at, diagonal=diagonal)
        known = 0.0 if self.remembered is None else float(np.sum(found.covariance * self.remembered))
        return replace(found, own=self.own, remembered=known)

    def covariance(self, unseen: np.ndarray) -> np.ndarray:
        """Return the covariance of the shared parameters alone, given the directions that nothing sees, shape (H, K)."""
        sizes, diagonal = self.sizes[self.shared], self.diagonal[self.shared]
        return posterior_covariance(self.G, sizes, diagonal=diagonal, unseen=unseen)

    @cached_property
    def spent(self) -> tuple[float, tuple[float, ...]]:
        """How many parameters the data spend, priors counted: of those that are shared, and of each station's own."""
        shared = None if self.own else spent_parameters(self.G, self.sizes, self.remembered)
        if shared is not None:
            return shared, ()
        return self.posterior.shared_effective, self.posterior.own_effective

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


@dataclass(frozen=True, eq=False)
class Linearised:
    """A problem at one set of values.

    The Gram matrices of each station are kept block by block of its readings, since another noise only weighs them anew. Of
    too many stations for that nothing is kept but squares and the sums over batches of them for one noise.

    Attributes:
        problem: the stations.
        values: shape (P,).
        free: shape (P,), the F parameters that may move.
        robust: shape (N,), factor on each row's weight: 0 leaves a row out.
        sizes: shape (P,), standard deviations of the priors; inf for none.
        executor: computes what stations contribute; default: one after the other, here.
        sigma: shape (blocks,), the noise for which equations will be wanted, where it is known before the residuals are:
            one pass over several stations then does for both.
        is_doubtful: whether the values may be given up by their squares, so that these come first, in a tenth of the time.
        past: sums over batches at the same values, perhaps with other robust weights.
        past_normals: likewise the normal equations of each station.
    """

    problem: Problem
    values: np.ndarray
    free: np.ndarray
    robust: np.ndarray
    sizes: np.ndarray
    executor: Executor | None = None
    sigma: np.ndarray | None = None
    is_doubtful: bool = False
    past: tuple[Part, ...] = ()
    past_normals: tuple[Kept, ...] = ()

    def reweighted(self, robust: np.ndarray) -> Linearised:
        """Return the same point with other robust weights; stations whose weights stay are not computed again."""
        kept = tuple(self._normals) if self._are_kept else ()
        return replace(self, robust=robust, is_doubtful=False, past=tuple(self._parts), past_normals=kept)

    def narrowed(self, free: np.ndarray) -> Linearised:
        """Return the same point with fewer free parameters, shape (P,); of one station nothing is computed again."""
        found = replace(self, free=free, past=(), past_normals=())
        if len(self.problem.stations) > 1:
            return found
        (kept,), inner = self._normals, free[self.free]
        normal, inner = kept.normal, np.flatnonzero(inner)
        if normal.believed is not None:
            information, slope, square = normal.believed
            normal = replace(normal, believed=(information[inner[:, None], inner], slope[inner], square))
        normal = replace(normal, G=normal.G[..., inner[:, None], inner], g=normal.g[..., inner])
        return replace(found, past_normals=(Kept(kept.robust, normal),))

    def release(self) -> None:
        """Give up the memory of several stations' equations, which are computed again if they are asked for."""
        if len(self.problem.stations) > 1 and self._squares:
            for name in ("_normals", "_parts", "_equations"):
                self.__dict__.pop(name, None)

    @cached_property
    def _are_kept(self) -> bool:
        """Whether the normal equations of each station are kept."""
        stations, blocks = len(self.problem.stations), len(self.problem.blocks)
        n_free = np.count_nonzero(self.free[self.problem.places[0]])
        return stations == 1 or 8 * blocks * int(n_free) ** 2 <= _MOST_KEPT

    @cached_property
    def _normals(self) -> list[Kept]:
        """The normal equations of the stations of each batch."""
        asked = [(batch, self.robust[batch.rows]) for batch in self._batches]
        past = self.past_normals or (None,) * len(asked)
        valid = [
            kept if kept is not None and np.array_equal(kept.robust, robust) else None
            for kept, (_, robust) in zip(past, asked, strict=True)
        ]
        tasks = (
            batch.work(reweighted, self.values, self.free[batch.places[0]], robust, stale)
            for kept, stale, (batch, robust) in zip(valid, past, asked, strict=True)
            if kept is None
        )
        fresh = iter(self._done(tasks))
        pairs = zip(valid, asked, strict=True)
        return [Kept(robust, next(fresh)) if kept is None else kept for kept, (_, robust) in pairs]

    @cached_property
    def _batches(self) -> list[Batch]:
        return [part for batch in self.problem.batches for part in batch.alike(self.free)]

    @cached_property
    def _parts(self) -> list[Part]:
        """The latest sums, batch by batch; empty before there are any."""
        return list(self.past)

    @cached_property
    def _squares(self) -> list[Squares]:
        if self._are_kept and not self.is_doubtful:
            pairs = zip(self._normals, self._batches, strict=True)
            return [squares_of(kept.normal, batch.ends) for kept, batch in pairs]
        if self.sigma is not None and not self.is_doubtful:
            self.equations(self.sigma)
            return [part.squares for part in self._parts]
        return list(self._done(batch.work(squares, self.values, self.robust[batch.rows]) for batch in self._batches))

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
        return self.chi2(sigma) + beliefs + prior + self.problem.beliefs_squared(self.values, self.sizes)

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
        G, g = (of[0] for of in self._normals[0].normal.at(sigma))
        free = self.free
        known = self._remember(G, g)
        return Equations(G, g, np.ones(len(g), bool), np.diag(G), (), self.sizes[free], self.values[free], known)

    def _remember(self, G: np.ndarray, g: np.ndarray) -> np.ndarray | None:
        """Add beliefs beyond priors to the equations of the shared parameters, and return their part of G."""
        if not self.problem.has_beliefs:
            return None
        kept = np.flatnonzero(self.free & self.problem.is_shared)
        known, slope = self.problem.beyond_priors(kept, self.values, self.sizes)
        G += known
        g += slope
        return known

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
        found = self._from_normals(todo, sigma) if self._are_kept else self._from_rows(todo, sigma)
        for k, each in zip(todo, found, strict=True):
            parts[k] = Part(*wanted[k], *each)
        self._parts[:] = [part for part in parts if part is not None]

    def _from_normals(self, todo: list[int], sigma: np.ndarray) -> Iterator[tuple[Contribution, Squares]]:
        """Yield what some batches contribute, from the normal equations of their stations."""
        for k in todo:
            batch, normal = self._batches[k], self._normals[k].normal
            values, free = batch.values(self.values), self.free[batch.places[0]]
            known = self._known(batch, sigma)
            yield contribution_of(normal, values, free, **known), squares_of(normal, batch.ends)

    def _from_rows(self, todo: list[int], sigma: np.ndarray) -> Iterable[tuple[Contribution, Squares]]:
        """Return what some batches contribute, from the rows of their stations."""
        batches = (self._batches[k] for k in todo)
        return self._done(
            batch.work(
                contribution,
                self.values,
                self.robust[batch.rows],
                self.free[batch.places[0]],
                *self._known(batch, sigma).values(),
            )
            for batch in batches
        )

    def _known(self, batch: Batch, sigma: np.ndarray) -> dict[str, np.ndarray]:
        """Return which parameters of a batch's stations are their own, their noise, and the sizes of their priors."""
        each = sigma[batch.blocks].reshape(len(batch.stations), -1)
        return {"own": batch.own, "sigma": each, "sizes": self.sizes[batch.places]}

    def _done(self, tasks: Iterable[Task]) -> Iterable[Any]:
        """Do tasks, here or on the workers, who are sent the stations once."""
        work = self.problem.work
        return map(work, tasks) if self.executor is None else repeated(work, tasks, label="station", executor=self.executor)
