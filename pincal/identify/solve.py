"""One solver for every fit: Gauss-Newton on the posterior, with robust weights, estimated noise and bounds."""

from __future__ import annotations

import logging
from concurrent.futures import Executor
from dataclasses import dataclass
from enum import Enum

import numpy as np

from pincal.identify.equations import Equations, Linearised
from pincal.identify.exact import MOST_EXACT, is_exact, polish, rounding
from pincal.identify.noise import Judge, Judgement, Loss, Noise
from pincal.identify.posterior import Posterior
from pincal.identify.problem import Problem
from pincal.identify.trials import Memory, trials
from pincal.units import readable_unit

log = logging.getLogger(__name__)

MAX_ITERATIONS = 40
# A step that moves predictions by less than this part of the noise ends the fit: the next one would be smaller still. So
# does one that had to be halved down to this: along a bent ridge there is nothing left to gain.
SETTLED = 1e-3
_ROUGH = 0.1
# The same where the noise is at its floor: steps there are rounding.
_ROUNDED = 0.03
# Relative change of the noise above which earlier steps say nothing about the next, as little as after one that they got
# wrong.
_STEADY = 0.05
# Robust weights that change by less are settled.
_SETTLED = 1e-3


class Exit(Enum):
    """How a fit ended."""

    SETTLED = "the last step moved predictions by far less than the noise"
    ROUGH = "it came close enough for the fit that follows it"
    EXACT = "the readings are exact, and the model was fitted to rounding"
    STUCK = "no step made things better although a long one was still called for"
    BUDGET = f"it was not done after {MAX_ITERATIONS} steps"

    @property
    def is_good(self) -> bool:
        """Whether the fit ended well."""
        return self in (Exit.SETTLED, Exit.ROUGH, Exit.EXACT)


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
class Solution:
    """A fit.

    Attributes:
        values: shape (P,).
        equations: what data and priors say about the free parameters at ``values``.
        sigma: shape (blocks,), standard deviations that the fit used, one station's blocks after the other's.
        estimated: shape (blocks,), those of its residuals.
        weights: shape (N,), robust weights: 0 for an outlier.
        chi2: weighted sum of squares over the declared variances (the estimated, where none are declared).
        degrees: its degrees of freedom.
        iterations: Gauss-Newton steps taken.
        exit: how it ended.
        at_bound: shape (P,), parameters held at their bound.
        free: shape (P,), parameters that were fitted.
        wide: what is known of the parameters where more than the noise is in doubt; default: what the equations say.
    """

    values: np.ndarray
    equations: Equations
    sigma: np.ndarray
    estimated: np.ndarray
    weights: np.ndarray
    chi2: float
    degrees: float
    iterations: int
    exit: Exit
    at_bound: np.ndarray
    free: np.ndarray
    wide: Posterior | None = None

    @property
    def posterior(self) -> Posterior:
        """What is known of the free parameters."""
        return self.equations.posterior if self.wide is None else self.wide

    @property
    def effective(self) -> float:
        """Number of parameters that the data spend, priors counted: :attr:`Posterior.effective` in a fifth of the time."""
        shared, own = self.equations.spent
        return shared + sum(own)

    @property
    def converged(self) -> bool:
        """Whether the fit ended well."""
        return self.exit.is_good

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
    begun: Linearised | None = None,
    short: float = SETTLED,
    executor: Executor | None = None,
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
        begun: the problem at ``start`` with these robust weights, and perhaps more free parameters; default: nobody knows.
        short: how far a step that ends the fit may move predictions, root mean square, in units of the noise.
        executor: computes what stations contribute, where there are several; default: one after the other, here.

    Returns:
        The fit; ``exit`` tells how it ended.
    """
    fit = _Fit(problem, free, priors, Judge(problem, free, noise, loss), rough, executor, begun, short)
    return fit.finish(*fit.run(start, robust, label))


def most_probable(
    problem: Problem,
    start: np.ndarray,
    free: np.ndarray,
    priors: Priors,
    noise: Noise,
    *,
    loss: Loss,
    rough: bool = False,
) -> np.ndarray:
    """Return the values of :func:`solve` alone, shape (P,), without what is known of them."""
    return _Fit(problem, free, priors, Judge(problem, free, noise, loss), rough).run(start)[0].point.values


@dataclass(frozen=True)
class _State:
    """A point of a fit.

    Attributes:
        point: the problem at its values, rows weighted by robust weights of an earlier point.
        judged: noise and robust weights by the residuals here.
        hard: whether outliers are left out rather than weighed down.
    """

    point: Linearised
    judged: Judgement
    hard: bool

    @property
    def is_steady(self) -> bool:
        """Whether the robust weights are those that the residuals call for."""
        return bool(np.max(np.abs(self.judged.robust - self.point.robust)) < _SETTLED)


@dataclass(frozen=True)
class _Step:
    """The step that led to a point.

    Attributes:
        wanted: how far Gauss-Newton wanted to move predictions, root mean square, in units of the noise.
        is_short: whether what was taken of it is too short to matter.
        held: shape (F,), free parameters that a bound stopped.
    """

    wanted: float
    is_short: bool
    held: np.ndarray

    def end(self, done: Exit) -> Exit:
        """Return how a fit ended that can go no further: ``done``, unless it still had far to go."""
        return done if self.wanted < _ROUGH else Exit.STUCK


@dataclass(frozen=True)
class _Fit:
    """The unchanging part of a fit."""

    problem: Problem
    free: np.ndarray
    priors: Priors
    judge: Judge
    rough: bool = False
    executor: Executor | None = None
    begun: Linearised | None = None
    short: float = SETTLED

    def run(self, start: np.ndarray, robust: np.ndarray | None = None, label: str = "") -> tuple[_State, _Step, int, Exit]:
        """Return the last point, the step to it, the number of steps and how they ended; arguments as of :func:`solve`."""
        state, memory, ended = self.begin(start.astype(float), robust), Memory(), None
        for iteration in range(1, MAX_ITERATIONS + 1):
            state, step = self.advance(state, memory)
            if label:
                size = self.readable(state.judged)
                log.info("%s: iteration %d, residual %s, step %.1e of the noise", label, iteration, size, step.wanted)
            ended = self.exit_of(state, step)
            if ended is not None:
                break
            state = self.weighed_anew(state, step)
        if not self.rough and self.is_beyond_normal_equations(state):
            state, extra = self.polished(state)
            return state, step, iteration + extra, Exit.EXACT
        return state, step, iteration, ended or Exit.BUDGET

    def begin(self, values: np.ndarray, robust: np.ndarray | None) -> _State:
        """Return the first point; outliers are known if robust weights are."""
        hard = robust is not None
        known = self.judge.noise.known if hard else None
        if self.begun is not None and hard and len(self.problem.stations) == 1:
            point = self.begun.narrowed(self.free)
        else:
            point = self._linearised(values, np.ones(len(self.problem)) if robust is None else robust, known)
        return _State(point, self.judge.at(point, hard=hard), hard)

    def advance(self, state: _State, memory: Memory) -> tuple[_State, _Step]:
        """Return the next point and the step to it."""
        free, values = self.free, state.point.values
        equations = state.point.equations(state.judged.sigma)
        step, held = equations.step(self.priors.bounds[free])
        longer = memory.accelerate(values[free], step, equations.metric)
        wanted = self._length(equations.square(step), state.judged.robust)
        del equations
        point = self._moved(state, [longer, step], memory)
        judged = self.judge.at(point, hard=state.hard)
        refused = longer is not step and not np.array_equal(point.values[free], values[free] + longer)
        if refused or np.max(np.abs(judged.sigma / state.judged.sigma - 1.0)) > _STEADY:
            memory.forget()
        shortest = self.short if np.any(judged.sigma > rounding(self.problem)) else _ROUNDED
        is_short = wanted < shortest
        if not is_short:
            taken = point.equations(judged.sigma).square(point.values[free] - values[free])
            is_short = self._length(taken, judged.robust) < shortest
        return _State(point, judged, state.hard), _Step(wanted, is_short, held)

    def exit_of(self, state: _State, step: _Step) -> Exit | None:
        """Return how the fit has ended, None if it goes on."""
        if self.rough and (step.is_short or step.wanted < _ROUGH):
            return step.end(Exit.ROUGH)
        if self.is_beyond_normal_equations(state):
            return step.end(Exit.ROUGH if self.rough else Exit.EXACT)
        screened = self.judge.loss == "screen" and not state.hard and np.any(state.point.robust != 1.0)
        if step.is_short and state.is_steady and not screened:
            return step.end(Exit.SETTLED)
        return None

    def weighed_anew(self, state: _State, step: _Step) -> _State:
        """Return the same point with the robust weights that its residuals call for, hard ones once nothing else moves."""
        judged, hard = state.judged, state.hard
        if step.is_short and state.is_steady:
            hard = True
            judged = self.judge.at(state.point, hard=hard)
        if np.array_equal(judged.robust, state.point.robust):
            return _State(state.point, judged, hard)
        return _State(state.point.reweighted(judged.robust), judged, hard)

    def is_beyond_normal_equations(self, state: _State) -> bool:
        """Return whether readings are so exact that J^T J can't hold what they say, and few enough for J itself.

        What is believed beyond the priors of each parameter has no part in J.
        """
        if self.problem.has_beliefs:
            return False
        diagonal = state.point.equations(state.judged.sigma).diagonal
        return is_exact(diagonal, self.priors.sizes[self.free]) and len(self.problem) * len(diagonal) <= MOST_EXACT

    def polished(self, state: _State) -> tuple[_State, int]:
        """Return the point that exact readings lead to, and the steps taken."""
        point, problem = state.point, self.problem
        noise = [np.repeat(state.judged.sigma[span], problem.block_sizes[span]) for span in problem.block_spans]
        weights = [
            station.weights * point.robust[rows] / sigma[:, None]
            for station, rows, sigma in zip(problem.stations, problem.rows, noise, strict=True)
        ]
        values, steps = polish(problem, point.values, self.free, self.priors.sizes, self.priors.bounds, weights)
        return _State(self._linearised(values, point.robust, state.judged.sigma), state.judged, state.hard), steps

    def finish(self, state: _State, step: _Step, iterations: int, ended: Exit) -> Solution:
        """Put the solution together, its noise judged with the parameters really spent."""
        point, noise = state.point, self.judge.noise
        spent = point.equations(self.judge.at(point, hard=True).sigma).spent
        degrees = self.judge.degrees(point.robust, *spent)
        estimated = np.maximum(np.sqrt(point.squares / degrees), rounding(self.problem))
        sigma = noise.resolved(estimated, degrees)
        at_bound = np.zeros(len(point.values), bool)
        at_bound[self.free] = step.held
        return Solution(
            values=point.values,
            equations=point.equations(sigma),
            sigma=sigma,
            estimated=estimated,
            weights=point.robust,
            chi2=point.chi2(np.where(np.isnan(noise.known), estimated, noise.known)),
            degrees=float(degrees.sum()),
            iterations=iterations,
            exit=ended,
            at_bound=at_bound,
            free=self.free,
        )

    def readable(self, judged: Judgement) -> str:
        """Return the size of the residuals for the log."""
        units = [readable_unit(block.unit) for block in self.problem.blocks]
        return ", ".join(
            f"{sigma * factor:.5f} {unit}" for sigma, (factor, unit) in zip(judged.estimated, units, strict=True)
        )

    def _linearised(
        self, values: np.ndarray, robust: np.ndarray, sigma: np.ndarray | None, *, is_doubtful: bool = False
    ) -> Linearised:
        """Return the problem at values; if ``sigma``, the noise so far, is the declared one, it will be again."""
        likely = sigma if sigma is not None and np.array_equal(sigma, self.judge.noise.known) else None
        return Linearised(self.problem, values, self.free, robust, self.priors.sizes, self.executor, likely, is_doubtful)

    def _length(self, square: float, robust: np.ndarray) -> float:
        """Return how far a step of this square moves the predictions, root mean square, in units of the noise."""
        return float(np.sqrt(max(square, 0.0) / self._readings(robust)))

    def _readings(self, robust: np.ndarray) -> float:
        """Return the number of readings that count, 1 if none does."""
        counts = self.problem.counted_rows(robust)[self.problem.station_of_block]
        return max(float(counts @ self.problem.block_sizes), 1.0)

    def _moved(self, state: _State, steps: list[np.ndarray], memory: Memory) -> Linearised:
        """Take the first of the steps that does not make things worse; see :func:`pincal.identify.trials.trials`.

        Stations that share nothing that is free are fits of their own: each takes what does not make it worse.
        """
        here, sigma, free = state.point, state.judged.sigma, self.free
        spare = 1e-6 * self._readings(here.robust)
        limits = here.objectives(sigma) * (1.0 + 1e-9) + spare
        # Few steps lead back here.
        here.release()
        group = here.group_of[free]
        values, is_open, is_refused = here.values.copy(), np.ones(len(limits), bool), False
        tried = trials(here, sigma, self.priors.bounds[free], steps, memory)
        step: np.ndarray | None = next(tried)
        while step is not None:
            values = values.copy()
            values[free] = np.where(is_open[group], here.values[free] + step, values[free])
            there = self._linearised(values, here.robust, sigma, is_doubtful=is_refused or memory.was_refused)
            is_open &= there.objectives(sigma) > limits
            if not is_open.any():
                memory.was_refused = is_refused
                return there
            is_refused = True
            try:
                step = tried.send(there)
            except StopIteration:
                step = None
        values[free] = np.where(is_open[group], here.values[free], values[free])
        return here if is_open.all() else self._linearised(values, here.robust, sigma)
