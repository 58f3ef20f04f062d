"""One solver for every fit: Gauss-Newton on the posterior, with robust weights, estimated noise and bounds."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtri

from pincal.identify.exact import MOST_EXACT, is_exact, polish, rounding
from pincal.identify.normal import Normal, Posterior, accumulate, posterior, posterior_step
from pincal.identify.problem import Problem
from pincal.units import readable_unit

log = logging.getLogger(__name__)

Loss = Literal["screen", "huber", "none"]

MAX_ITERATIONS = 40
# A step that moves predictions by less than this part of the noise ends the fit: the next one would be smaller still. So
# does one that had to be halved down to this: along a bent ridge there is nothing left to gain.
_STEP = 1e-3
_ROUGH = 0.1
# The same where the noise is at its floor: steps there are rounding.
_ROUNDED = 0.03
# Steps remembered, and the ratio of successive steps above which they are put to use.
_MEMORY = 4
_SLOW = 0.3
# Relative change of the noise above which earlier steps say nothing about the next, as little as after one that they got
# wrong.
_STEADY = 0.05
# Halvings of a step that made things worse, before the fit is taken to stand still.
_HALVINGS = 10
# Robust weights that change by less are settled.
_SETTLED = 1e-3
# Probability that screening takes any sound row of a table for an outlier.
_FALSE_OUTLIER = 0.01
# Declared noise is replaced by the residuals' own when these exceed it by this many standard deviations of chi-square.
_MISFIT = 4.0


@dataclass(frozen=True)
class Priors:
    """What is believed before measuring, and how far lengths may go.

    Attributes:
        sizes: shape (P,), standard deviations about the nominal; inf for none.
        bounds: shape (P,), largest deviations; inf for none.
    """

    sizes: np.ndarray
    bounds: np.ndarray


@dataclass(frozen=True)
class Noise:
    """Standard deviations of one component of each block of readings, None where they are to be estimated."""

    declared: tuple[float | None, ...]


@dataclass(frozen=True)
class Solution:
    """A fit.

    Attributes:
        values: shape (P,).
        posterior: what data and priors say about the free parameters at ``values``.
        sigma: shape (blocks,), standard deviations that the fit used.
        estimated: shape (blocks,), those of its residuals.
        weights: shape (N,), robust weights: 0 for an outlier.
        chi2: weighted sum of squares over the declared variances (the estimated, where none are declared).
        degrees: its degrees of freedom.
        iterations: Gauss-Newton steps taken.
        converged: whether the last step was small enough.
        at_bound: shape (P,), parameters held at their bound.
        free: shape (P,), parameters that were fitted.
    """

    values: np.ndarray
    posterior: Posterior
    sigma: np.ndarray
    estimated: np.ndarray
    weights: np.ndarray
    chi2: float
    degrees: float
    iterations: int
    converged: bool
    at_bound: np.ndarray
    free: np.ndarray

    @property
    def cost(self) -> float:
        """Mean square of the residuals in units of the noise."""
        return float(self.chi2 / max(self.degrees, 1.0))


def solve(
    problem: Problem,
    start: np.ndarray,
    free: np.ndarray,
    priors: Priors,
    noise: Noise,
    *,
    loss: Loss = "screen",
    rough: bool = False,
    label: str = "",
    robust: np.ndarray | None = None,
) -> Solution:
    """Find the most probable values of the free parameters.

    Args:
        problem: model and readings.
        start: shape (P,), where to begin; the others keep these values.
        free: shape (P,), parameters to fit.
        priors: about the nominal, zero.
        noise: declared standard deviations.
        loss: "screen" weighs rows beyond the range of the noise down and leaves them out at the end; "huber" only
            weighs them down; "none" takes every row as it is.
        rough: whether another fit follows, so that this one may end early and its outliers only be weighed down.
        label: what this fit is called in the log; it is not logged without a name.
        robust: shape (N,), robust weights of an earlier fit to begin with; its outliers are then known.

    Returns:
        The fit; ``converged`` tells whether it ended well.
    """
    fit = _Fit(problem, free, priors, noise, loss)
    values, hard, converged = start.astype(float).copy(), robust is not None, False
    robust = np.ones(len(problem)) if robust is None else robust
    held, memory = np.zeros(int(free.sum()), bool), _Memory()
    normal = accumulate(problem, values, free, robust)
    state = fit.judge(normal, robust, hard=hard)
    for iteration in range(1, MAX_ITERATIONS + 1):
        step, held = fit.step(normal, values, state)
        longer = memory.accelerate(values[free], step, fit.metric(normal, state))
        moved = fit.length(step, normal, state)
        stood = values
        values, normal = fit.move(normal, values, [longer, step], state, robust)
        before, state = state, fit.judge(normal, robust, hard=hard)
        refused = longer is not step and not np.array_equal(values[free], stood[free] + longer)
        if refused or np.max(np.abs(state.sigma / before.sigma - 1.0)) > _STEADY:
            memory = _Memory()
        if label:
            log.info("%s: iteration %d, residual %s, step %.1e of the noise", label, iteration, fit.readable(state), moved)
        taken = min(moved, fit.length(values[free] - stood[free], normal, state))
        settled = taken < (_STEP if np.any(state.sigma > rounding(problem)) else _ROUNDED)
        if (rough and (settled or moved < _ROUGH)) or fit.is_beyond_normal_equations(normal, state):
            converged = moved < _ROUGH
            break
        if settled and np.max(np.abs(state.robust - robust)) < _SETTLED:
            if hard or loss != "screen" or np.all(robust == 1.0):
                converged = moved < _ROUGH
                break
            hard = True
            state = fit.judge(normal, robust, hard=hard)
        if not np.array_equal(state.robust, robust):
            robust = state.robust
            normal = accumulate(problem, values, free, robust)
    if not rough and fit.is_beyond_normal_equations(normal, state):
        weights = problem.weights * robust / np.repeat(state.sigma, fit.sizes)[:, None]
        values, extra = polish(problem, values, free, priors.sizes, priors.bounds, weights)
        normal, iteration, converged = accumulate(problem, values, free, robust), iteration + extra, True
    return fit.finish(normal, values, robust, iteration, converged, held)


def outlier_limit(rows: int, size: int) -> float:
    """Return the sum of squares, in units of the noise, beyond which a row of ``size`` readings is screened."""
    return float(chdtri(size, _FALSE_OUTLIER / rows))


class _Memory:
    """Anderson's acceleration of a slowly converging fit (Walker and Ni 2011), over the last few steps.

    Where residuals are large against what a direction is known by, Gauss-Newton overshoots it again and again by almost
    the same amount; two such steps tell where it settles. A fit that converges fast is left alone.
    """

    def __init__(self) -> None:
        self._points: list[np.ndarray] = []
        self._steps: list[np.ndarray] = []

    def accelerate(self, at: np.ndarray, step: np.ndarray, metric: np.ndarray) -> np.ndarray:
        """Return the step to take at the point ``at``, where Gauss-Newton wants ``step``; all of shape (F,)."""
        self._points = [*self._points[-_MEMORY:], at.copy()]
        self._steps = [*self._steps[-_MEMORY:], step.copy()]
        if len(self._steps) < 3 or np.linalg.norm(metric * step) < _SLOW * np.linalg.norm(metric * self._steps[-2]):
            return step
        dx, ds = np.diff(self._points, axis=0).T, np.diff(self._steps, axis=0).T
        mix = np.linalg.lstsq(metric[:, None] * ds, metric * step, rcond=1e-8)[0]
        return np.asarray(step - (dx + ds) @ mix)


@dataclass(frozen=True)
class _Judgement:
    """Noise and robust weights at one point of a fit."""

    sigma: np.ndarray
    estimated: np.ndarray
    robust: np.ndarray


@dataclass(frozen=True)
class _Fit:
    """The unchanging part of a fit."""

    problem: Problem
    free: np.ndarray
    priors: Priors
    noise: Noise
    loss: Loss

    @property
    def sizes(self) -> np.ndarray:
        """Components of each block of readings."""
        return np.array([block.size for block in self.problem.sensor.blocks])

    def judge(self, normal: Normal, robust: np.ndarray, *, hard: bool) -> _Judgement:
        """Estimate the noise from the rows that count, and weigh the rows by it."""
        counted = np.maximum(np.sum(robust > 0.0), 1) * self.sizes
        if self.loss == "none" or (hard and self.loss == "screen"):
            spent = self._spent(counted)
            estimated = np.sqrt(normal.squares / np.maximum(counted - spent * counted / counted.sum(), 1.0))
        else:
            middle = np.array([chdtri(size, 0.5) for size in self.sizes])
            estimated = np.sqrt(np.median(normal.row_squares, axis=1) / middle)
        estimated = np.maximum(estimated, rounding(self.problem))
        declared = np.array([np.nan if d is None else d for d in self.noise.declared])
        misfit = declared * (1.0 + _MISFIT / np.sqrt(2.0 * counted))
        sigma = np.where(np.isnan(declared) | (estimated > misfit), estimated, declared)
        return _Judgement(sigma, estimated, self._weigh(normal, sigma, hard=hard))

    def _spent(self, counted: np.ndarray) -> float:
        """Parameters that the data pay for; at most as many as leave one reading in ten free."""
        return float(min(self.free.sum(), 0.9 * counted.sum()))

    def _weigh(self, normal: Normal, sigma: np.ndarray, *, hard: bool) -> np.ndarray:
        n = len(self.problem)
        if self.loss == "none":
            return np.ones(n)
        distance2 = np.einsum("b,bn->n", sigma**-2.0, normal.row_squares)
        limit2 = outlier_limit(n, int(self.sizes.sum()))
        outside = distance2 > limit2
        if hard and self.loss == "screen":
            return np.where(outside, 0.0, 1.0)
        return np.where(outside, (limit2 / np.maximum(distance2, limit2)) ** 0.25, 1.0)

    def step(self, normal: Normal, values: np.ndarray, state: _Judgement) -> tuple[np.ndarray, np.ndarray]:
        """Return the step of the free parameters, and which of them a bound holds."""
        G, g = normal.at(state.sigma)
        sizes, bounds, at = self.priors.sizes[self.free], self.priors.bounds[self.free], values[self.free]
        step = posterior_step(G, g, sizes, at)
        held = np.zeros(len(step), bool)
        for _ in range(3):
            over = ~held & (np.abs(at + step) > bounds)
            if not over.any():
                break
            held |= over
            step = np.where(held, np.copysign(bounds, at + step) - at, step)
            loose = ~held
            step[loose] = posterior_step(
                G[np.ix_(loose, loose)], (g - G[:, held] @ step[held])[loose], sizes[loose], at[loose]
            )
        return step, held

    def metric(self, normal: Normal, state: _Judgement) -> np.ndarray:
        """Return how much each free parameter matters to data and prior, shape (F,)."""
        G, _ = normal.at(state.sigma)
        return np.asarray(np.sqrt(np.diag(G) + self.priors.sizes[self.free] ** -2.0))

    def readable(self, state: _Judgement) -> str:
        """Return the size of the residuals for the log."""
        units = [readable_unit(block.unit) for block in self.problem.sensor.blocks]
        return ", ".join(
            f"{sigma * factor:.5f} {unit}" for sigma, (factor, unit) in zip(state.estimated, units, strict=True)
        )

    def length(self, step: np.ndarray, normal: Normal, state: _Judgement) -> float:
        """Return how far a step moves the predictions, root mean square, in units of the noise."""
        G, _ = normal.at(state.sigma)
        readings = max(float(np.sum(state.robust > 0.0) * self.sizes.sum()), 1.0)
        return float(np.sqrt(max(step @ G @ step, 0.0) / readings))

    def move(
        self,
        normal: Normal,
        values: np.ndarray,
        steps: list[np.ndarray],
        state: _Judgement,
        robust: np.ndarray,
    ) -> tuple[np.ndarray, Normal]:
        """Take the first of the steps, or of the halves of the last, that does not make things worse."""
        before = self._objective(normal, values, state.sigma)
        readings = max(float(np.sum(robust > 0.0) * self.sizes.sum()), 1.0)
        plain = steps[-1]
        tried = steps[:-1] if steps[0] is not plain else []
        for step in [*tried, *(plain * 0.5**k for k in range(_HALVINGS))]:
            trial = values.copy()
            trial[self.free] += step
            found = accumulate(self.problem, trial, self.free, robust)
            after = self._objective(found, trial, state.sigma)
            if after <= before * (1.0 + 1e-9) + 1e-6 * readings:
                return trial, found
        return values, normal

    def is_beyond_normal_equations(self, normal: Normal, state: _Judgement) -> bool:
        """Return whether readings are so exact that J^T J can't hold what they say, and few enough for J itself."""
        G, _ = normal.at(state.sigma)
        return is_exact(np.diag(G), self.priors.sizes[self.free]) and len(self.problem) * len(G) <= MOST_EXACT

    def _objective(self, normal: Normal, values: np.ndarray, sigma: np.ndarray) -> float:
        known = self.free & np.isfinite(self.priors.sizes)
        prior = float(np.sum((values[known] / self.priors.sizes[known]) ** 2))
        return normal.chi2(sigma) + normal.disbelief() + prior

    def finish(
        self,
        normal: Normal,
        values: np.ndarray,
        robust: np.ndarray,
        iterations: int,
        converged: bool,
        held: np.ndarray,
    ) -> Solution:
        """Put the solution together, its noise judged with the parameters really spent."""
        state = self.judge(normal, robust, hard=True)
        G, g = normal.at(state.sigma)
        result = posterior(G, g, self.priors.sizes[self.free], values[self.free])
        counted = np.maximum(np.sum(robust > 0.0), 1) * self.sizes
        degrees = np.maximum(counted - result.effective * counted / counted.sum(), 1.0)
        estimated = np.maximum(np.sqrt(normal.squares / degrees), rounding(self.problem))
        declared = np.array([np.nan if d is None else d for d in self.noise.declared])
        misfit = declared * (1.0 + _MISFIT / np.sqrt(2.0 * degrees))
        sigma = np.where(np.isnan(declared) | (estimated > misfit), estimated, declared)
        G, g = normal.at(sigma)
        reference = np.where(np.isnan(declared), estimated, declared)
        at_bound = np.zeros(len(values), bool)
        at_bound[self.free] = held
        return Solution(
            values=values,
            posterior=posterior(G, g, self.priors.sizes[self.free], values[self.free]),
            sigma=sigma,
            estimated=estimated,
            weights=robust,
            chi2=normal.chi2(reference),
            degrees=float(degrees.sum()),
            iterations=iterations,
            converged=converged,
            at_bound=at_bound,
            free=self.free,
        )
