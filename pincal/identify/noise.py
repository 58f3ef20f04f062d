"""Noise and outliers, estimated from the residuals of a fit, station by station; and fits to exact
readings.

Real instruments are never so exact that rounding of J^T J to sixteen digits loses information;
simulated ones are, and they serve to find out what a model can represent at all. Fits to them are
finished to rounding with singular values of the Jacobian itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np
from scipy.special import chdtri

from pincal.identify.criteria import CRITERIA
from pincal.identify.equations import Linearised
from pincal.identify.normal import belief_rows
from pincal.identify.problem import Problem
from pincal.thresholds import Count, Scale

# Steps of a fit to exact readings, and the largest Jacobian (rows times parameters) for which it is
# done.
_POLISHING: Count = 60
MOST_EXACT: Count = 2_000_000
# Damping of a step relative to the largest singular value of J (Levenberg, Marquardt): rounding,
# and more where that fails.
_DAMPING = (64.0 * np.finfo(float).eps, 1e-11, 1e-9, 1e-7)
# Fractions of a step that are tried.
_PARTS: tuple[Scale, ...] = (1.0, 0.5, 0.25, 0.1, 0.02)
# Singular values, relative to the largest, above which directions are strong, and the corrections
# along them after each.
_STRONG: tuple[Scale, Scale] = (1e-3, 1e-6)
_CORRECTIONS: Count = 3
# Rounding of G, in units of the priors' information, above which it is too coarse.
_COARSE: Scale = 1e-4
# Noise, in units of the rounding of predictions, below which readings may be exact.
_NEAR_ROUNDING: Scale = 1e4
# Residuals of a perfect fit to exact readings, in units of their rounding.
_EXACT: Scale = 1e-3


def rounding(problem: Problem) -> np.ndarray:
    """Return the rounding of predictions, shape (blocks,), a lower bound on the noise."""
    return np.array([block.rounding for block in problem.blocks])


def usual_sizes(problem: Problem, at_most: np.ndarray | float = np.inf) -> np.ndarray:
    """Return the usual standard deviations of the parameters in these poses, shape (P,)."""
    return np.asarray(
        np.minimum([p.size for p in problem.parameters] / problem.largest_basis[0], at_most)
    )


def are_at_rounding(problem: Problem, sigma: np.ndarray) -> bool:
    """Return whether the noise of all readings, shape (blocks,), is near the rounding of
    predictions.
    """
    return bool(np.all(sigma < _NEAR_ROUNDING * rounding(problem)))


def is_exact(G: np.ndarray, sizes: np.ndarray) -> bool:
    """Return whether the readings' information, the diagonal of G, is so large that its rounding
    swamps the priors.
    """
    known = np.isfinite(sizes)
    # By roots: squares of the sizes that follow from an absurd mass overflow.
    ratio = np.sqrt(np.maximum(G[known], 0.0)) * sizes[known]
    return bool(np.max(ratio, initial=0.0) > np.sqrt(_COARSE / np.finfo(float).eps))


def polish(point: Linearised, bounds: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, int]:
    """Continue a fit that is nearly converged; return the values, shape (P,), and the number of
    steps.

    Priors do not enter: their pull along unobservable directions, which are curved, would only
    stall the fit. Such directions are held. A long step along weak directions leaves the valley
    floor, which is curved, too; steps along strong ones lead back to it (a second-order correction,
    Nocedal and Wright 2006, section 18.3).

    Args:
        point: the problem at the start values; of the priors only the sizes are used, to scale
            parameters.
        bounds: shape (P,), largest deviations.
        sigma: shape (blocks,), noise.
    """
    exact = _Exact.of(point, bounds, sigma)
    values = point.values
    J, r = exact.linearised(values)
    for k in range(1, _POLISHING + 1):
        better = exact.improved(values, J, r)
        if better is None:
            return values, k
        values = better
        J, r = exact.linearised(values)
        if r @ r < exact.floor:
            return values, k
    return values, _POLISHING


@dataclass(frozen=True, eq=False)
class _Exact:
    """A problem of exact readings, its residuals in units of the noise.

    Attributes:
        problem: the problem.
        free: shape (P,), the F free parameters.
        sizes: shape (F,), their sizes, infinite for frames.
        bounds: shape (F,), largest deviations.
        weights: of the readings of each station, shape (m, N).
        floor: sum of squares that rounding leaves.
    """

    problem: Problem
    free: np.ndarray
    sizes: np.ndarray
    bounds: np.ndarray
    weights: list[np.ndarray]
    floor: float

    @classmethod
    def of(cls, point: Linearised, bounds: np.ndarray, sigma: np.ndarray) -> _Exact:
        problem = point.problem
        free = point.free
        exact = _EXACT * rounding(problem)
        weights = []
        floor = 0.0
        for station, rows, span in zip(
            problem.stations, problem.rows, problem.block_spans, strict=True
        ):
            noise, least = (np.repeat(of[span], station.block_sizes) for of in (sigma, exact))
            weights.append(station.weights * point.robust[rows] / noise[:, None])
            floor += float(np.sum((least[:, None] * weights[-1]) ** 2))
        return cls(problem, free, point.sizes[free], bounds[free], weights, floor)

    def linearised(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Jacobian, shape (F, M), and residuals, shape (M,), constraints among them."""
        free = self.free
        problem = self.problem
        rank = np.cumsum(free) - 1
        columns = []
        each = zip(problem.stations, problem.places, self.weights, strict=True)
        for station, places, weight in each:
            at = values[places]
            moved = free[places]
            parts = [J for _, _, J in station.linearise(at, moved)]
            more, known = belief_rows(station, at, moved)
            J = np.concatenate(parts, axis=2) * weight
            whole = np.zeros((int(free.sum()), weight.size + len(known)))
            whole[rank[places[moved]]] = np.hstack([J.reshape(len(J), weight.size), more])
            columns.append(whole)
        return np.hstack(columns), self.residuals(values)

    def residuals(self, values: np.ndarray) -> np.ndarray:
        """Return residuals, shape (M,), constraints among them, in a tenth of the time of
        :meth:`linearised`.
        """
        problem = self.problem
        residuals = []
        for station, places, weight in zip(
            problem.stations, problem.places, self.weights, strict=True
        ):
            at = values[places]
            residuals.append((station.residuals(at) * weight).ravel())
            residuals.append(belief_rows(station, at, np.zeros(len(at), bool))[1])
        return np.concatenate(residuals)

    def improved(self, values: np.ndarray, J: np.ndarray, r: np.ndarray) -> np.ndarray | None:
        """Return values, shape (P,), that leave smaller residuals than these; None if no step to
        any does.
        """
        directions = _Directions.of(J, self.sizes)
        for damping, part in product(_DAMPING, _PARTS):
            trial = values.copy()
            trial[self.free] += directions.step(r, damping, part)
            trial, left = self._on_valley_floor(trial, directions)
            is_inside = np.all(np.abs(trial[self.free]) <= self.bounds)
            if left @ left < r @ r and is_inside:
                return trial
        return None

    def _on_valley_floor(
        self, values: np.ndarray, directions: _Directions
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return values after steps along strong directions that halve the residuals, and these."""
        left = self.residuals(values)
        for least in [least for least in _STRONG for _ in range(_CORRECTIONS)]:
            back = values.copy()
            back[self.free] += directions.strong_step(left, least)
            better = self.residuals(back)
            if better @ better < 0.5 * (left @ left):
                values = back
                left = better
        return values, left


@dataclass(frozen=True, eq=False)
class _Directions:
    """The singular directions of a Jacobian, its F parameters in units of a scale.

    Attributes:
        scale: shape (F,).
        U: shape (M, k), directions of the residuals.
        s: shape (k,), singular values, the largest first.
        Vt: shape (k, F), directions of the parameters.
    """

    scale: np.ndarray
    U: np.ndarray
    s: np.ndarray
    Vt: np.ndarray

    @classmethod
    def of(cls, J: np.ndarray, sizes: np.ndarray) -> _Directions:
        known = np.isfinite(sizes)
        norms = np.maximum(np.linalg.norm(J, axis=1), 1e-300)
        # Frames have no size of their own and are scaled like the most influential parameter.
        scale = np.where(known, sizes, np.max((norms * sizes)[known], initial=1.0) / norms)
        return cls(scale, *np.linalg.svd((J * scale[:, None]).T, full_matrices=False))

    def step(self, residuals: np.ndarray, damping: float, part: float) -> np.ndarray:
        """Return part of a damped step, shape (F,); the damping is relative to the largest singular
        value.
        """
        damped = self.s / (self.s**2 + (damping * self.s[0]) ** 2)
        return np.asarray(part * self.scale * (self.Vt.T @ (damped * (self.U.T @ residuals))))

    def strong_step(self, residuals: np.ndarray, least: float) -> np.ndarray:
        """Return the step along directions with singular values above ``least`` times the largest,
        shape (F,).
        """
        strong = self.s > least * self.s[0]
        along = (self.U[:, strong].T @ residuals) / self.s[strong]
        return np.asarray(self.scale * (self.Vt[strong].T @ along))


Loss = Literal["screen", "huber", "none"]


@dataclass(frozen=True)
class Noise:
    """What is known of the noise of each block of readings before a fit, per component.

    Attributes:
        declared: standard deviations, None where they are to be estimated.
        least: what they are known to be no less than, 0 where nothing is known, and a fit to a few
            poses could not show: where rows are means of visits, what visits scatter by. Empty for
            zeros.
    """

    declared: tuple[float | None, ...]
    least: tuple[float, ...] = ()

    @cached_property
    def known(self) -> np.ndarray:
        """The declared standard deviations, shape (blocks,), nan where none are."""
        return np.array([np.nan if sigma is None else sigma for sigma in self.declared], float)

    def resolved(self, estimated: np.ndarray, degrees: np.ndarray) -> np.ndarray:
        """Return the noise to use, shape (blocks,): the declared unless the estimated exceeds it
        significantly, and no less than the least.
        """
        misfit = self.known * (1.0 + CRITERIA.too_noisy / np.sqrt(2.0 * degrees))
        is_estimated = np.isnan(self.known) | (estimated > misfit)
        found = np.where(is_estimated, estimated, self.known)
        return np.maximum(found, self.least) if self.least else found

    def select(self, blocks: Sequence[int]) -> Noise:
        """Return that of some blocks."""
        declared = tuple(self.declared[b] for b in blocks)
        return Noise(declared, tuple(self.least[b] for b in blocks) if self.least else ())

    def no_less_than(self, sigma: np.ndarray) -> Noise:
        """Return it with a least noise of each block, shape (blocks,), where it was lower."""
        least = np.maximum(sigma, self.least) if self.least else sigma
        return replace(self, least=tuple(least.tolist()))


@dataclass(frozen=True)
class Judgement:
    """Noise and robust weights at one point of a fit.

    Attributes:
        sigma: shape (blocks,), standard deviations to use.
        estimated: shape (blocks,), standard deviations of the residuals.
        robust: shape (N,), factor on each row's weight: 0 excludes it.
    """

    sigma: np.ndarray
    estimated: np.ndarray
    robust: np.ndarray


def outlier_limit(rows: int, size: int) -> float:
    """Return the sum of squares, in units of the noise, above which a row of ``size`` readings is
    screened.
    """
    return float(chdtri(size, CRITERIA.outlier / rows))


@dataclass(frozen=True)
class Judge:
    """Estimates the noise of each station and the robust weights of its rows.

    Attributes:
        problem: the stations.
        free: shape (P,), parameters that are fitted.
        noise: declared noise.
        loss: treatment of outliers, as in :func:`pincal.identify.solve.solve`.
    """

    problem: Problem
    free: np.ndarray
    noise: Noise
    loss: Loss

    def at(self, point: Linearised, *, hard: bool) -> Judgement:
        """Return the noise, estimated from the rows that count, and the robust weights that follow.

        ``hard``: whether outliers, if screened, are known well enough to be excluded.
        """
        sigma, estimated = self.noise_at(point, hard=hard)
        return Judgement(sigma, estimated, self.weights(point, sigma, hard=hard))

    def noise_at(self, point: Linearised, *, hard: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the standard deviations to use and those of the residuals, shape (blocks,) each;
        arguments as for :meth:`at`.
        """
        counted = self.counted(point.robust)
        if self.loss == "none" or (hard and self.loss == "screen"):
            is_shared = self.problem.is_shared
            shared = int(np.sum(self.free & is_shared & ~self.problem.beliefs.is_earlier))
            own = [int(np.sum((self.free & ~is_shared)[places])) for places in self.problem.places]
            estimated = np.sqrt(
                point.squares / self.degrees(point.robust, shared, own, most=CRITERIA.most_spent)
            )
        else:
            middle = np.array([chdtri(block.size, 0.5) for block in self.problem.blocks])
            estimated = np.sqrt(_medians(point.row_squares) / middle)
        estimated = np.maximum(estimated, rounding(self.problem))
        return self.noise.resolved(estimated, counted), estimated

    def counted(self, robust: np.ndarray) -> np.ndarray:
        """Return the number of readings that count in each block, shape (blocks,)."""
        return np.asarray(
            np.maximum(self.problem.readings(robust), [block.size for block in self.problem.blocks])
        )

    def degrees(
        self, robust: np.ndarray, shared: float, own: Sequence[float], *, most: float = np.inf
    ) -> np.ndarray:
        """Return the degrees of freedom that a fit leaves to each block, shape (blocks,).

        Each block pays for its part of the shared parameters and of those of its station.

        Args:
            robust: shape (N,), factor on each row's weight: 0 excludes a row.
            shared: effective number of parameters that stations share.
            own: of each station's own parameters.
            most: largest fraction of the readings that parameters are assumed to use up.
        """
        counted = self.counted(robust)
        spans = self.problem.block_spans
        of = np.repeat(np.arange(len(spans)), [span.stop - span.start for span in spans])
        whole = np.bincount(of, counted)
        numbers = np.zeros(len(whole))
        numbers[: len(own)] = own
        shared = min(shared, most * counted.sum())
        spent = counted * (shared / counted.sum() + (np.minimum(numbers, most * whole) / whole)[of])
        return np.asarray(np.maximum(counted - spent, 1.0))

    def weights(self, point: Linearised, sigma: np.ndarray, *, hard: bool) -> np.ndarray:
        """Return the rows' robust weights for noise of each block, shape (blocks,); further
        arguments as for :meth:`at`.

        Rows that most of a station's rows are as far off as are no outliers, whatever the noise:
        the nearer half of each station counts, so that no fit is left without rows.
        """
        if self.loss == "none":
            return np.ones(len(self.problem))
        spans = self.problem.block_spans
        pairs = zip(point.row_squares, spans, strict=True)
        distance2 = np.concatenate(
            [np.einsum("b,bn->n", sigma[span] ** -2.0, rows) for rows, span in pairs]
        )
        counts = [rows.shape[1] for rows in point.row_squares]
        sizes = [station.reading_size for station in self.problem.stations]
        limits = [
            outlier_limit(n, size) if n else np.inf for n, size in zip(counts, sizes, strict=True)
        ]
        limit2 = np.repeat(limits, counts)
        if not np.any(distance2 > limit2):
            return np.ones(len(self.problem))
        parts = np.split(distance2, np.cumsum(counts)[:-1])
        middles = [float(np.median(part)) if len(part) else np.inf for part in parts]
        limit2 = np.maximum(limit2, np.repeat(middles, counts))
        lighter = (
            0.0
            if hard and self.loss == "screen"
            else (limit2 / np.maximum(distance2, limit2)) ** 0.25
        )
        trusted = [
            np.zeros(len(s), bool) if s.trusted is None else s.trusted
            for s in self.problem.stations
        ]
        return np.where((distance2 > limit2) & ~np.concatenate(trusted), lighter, 1.0)


def _medians(rows: list[np.ndarray]) -> np.ndarray:
    """Return the median of each row of each matrix, one matrix after the other; matrices of one
    shape at once.
    """
    of_shape: dict[tuple[int, ...], list[int]] = {}
    for i, each in enumerate(rows):
        of_shape.setdefault(each.shape, []).append(i)
    found: list[np.ndarray] = [np.zeros(0)] * len(rows)
    for (_, n), members in of_shape.items():
        several = np.array([rows[i] for i in members])
        # As np.median, which takes ten times as long for few rows.
        at = (n - 1) // 2, n // 2
        for i, middle in zip(
            members, np.partition(several, at, axis=2)[..., at] if n else several, strict=True
        ):
            found[i] = 0.5 * middle.sum(axis=1)
    return np.concatenate(found)
