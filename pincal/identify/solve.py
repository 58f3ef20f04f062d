"""One solver for every fit: Gauss-Newton on the posterior, with robust weights, estimated noise and bounds.

Where two parameters multiply each other and the readings hardly tell them apart, such as a bearing's compliance and its
place, what Gauss-Newton wants along this bent ridge leads far off it. A step is then damped by the priors, and what such a
one did wrong all the same is put right from where it led to, by what the readings are surest of. A step that is halved
instead creeps along the ridge.
"""

from __future__ import annotations

import logging
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from pincal.identify.equations import Linearised
from pincal.identify.fit import MOST_STEPS, Ending, Priors, Solution
from pincal.identify.noise import MOST_EXACT, Judge, Judgement, Loss, Noise, is_exact, polish, rounding
from pincal.identify.problem import Problem
from pincal.units import readable_unit

log = logging.getLogger(__name__)

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
# Steps remembered, and the ratio of successive steps above which they are put to use.
_MEMORY = 4
_SLOW = 0.3
# Damping of the first step that is damped, in priors; how much more of it each refusal brings, how much less a success;
# and after how many refusals steps are halved instead.
_FIRST, _MORE, _LESS, _MOST = 3.0, 4.0, 2.0, 6
# How much more a step is damped that puts right what another one did wrong.
_REPAIR = 10.0
# Halvings of a step that made things worse, before the fit is taken to stand still.
_HALVINGS = 10


@dataclass(frozen=True)
class Course:
    """How a fit is done.

    Attributes:
        loss: "screen" weighs rows beyond the range of the noise down and leaves them out at the end; "huber" only
            weighs them down; "none" takes every row as it is.
        rough: whether another fit follows, so that this one may end early and its outliers only be weighed down.
        short: how far a step that ends the fit may move predictions, root mean square, in units of the noise.
        label: what the fit is called in the log; it is not logged without a name.
        executor: computes what stations contribute, where there are several; default: one after the other, here.
    """

    loss: Loss = "screen"
    rough: bool = False
    short: float = SETTLED
    label: str = ""
    executor: Executor | None = None


def solve(
    problem: Problem,
    start: np.ndarray | Linearised,
    free: np.ndarray,
    priors: Priors,
    noise: Noise,
    course: Course = Course(),
) -> Solution:
    """Find the most probable values of the free parameters.

    Args:
        problem: model and readings.
        start: shape (P,), where to begin; the others keep these values. Or the problem at such values with the robust
            weights of an earlier fit, whose outliers are then known, and perhaps more free parameters.
        free: shape (P,), parameters to fit.
        priors: about the nominal, zero.
        noise: declared standard deviations.
        course: what to do with outliers, how far to go, and where.

    Returns:
        The fit; ``exit`` tells how it ended.
    """
    fit = _Fit(problem, free, priors, Judge(problem, free, noise, course.loss), course)
    return fit.finish(*fit.run(start))


def likeliest_values(
    problem: Problem, start: np.ndarray, free: np.ndarray, priors: Priors, noise: Noise, course: Course = Course()
) -> np.ndarray:
    """Return the values of :func:`solve` alone, shape (P,), without what is known of them."""
    return _Fit(problem, free, priors, Judge(problem, free, noise, course.loss), course).run(start)[0].point.values


class _Memory:
    """What earlier steps of a fit tell of the next one.

    Anderson's acceleration of a slowly converging fit (Walker and Ni 2011), over the last few steps: where residuals are
    large against what a direction is known by, Gauss-Newton overshoots it again and again by almost the same amount; two
    such steps tell where it settles. A fit that converges fast is left alone.

    Attributes:
        damping: of the last step that was taken, less what its success is worth; 0 while whole steps do.
        was_refused: whether the last point had steps that made things worse.
    """

    def __init__(self) -> None:
        self.damping = 0.0
        self.was_refused = False
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._points: list[np.ndarray] = []
        self._steps: list[np.ndarray] = []

    def accelerate(self, at: np.ndarray, step: np.ndarray, metric: np.ndarray) -> np.ndarray:
        """Return the step to take at the point ``at``, where Gauss-Newton wants ``step``; all of shape (F,)."""
        self._points = [*self._points[-_MEMORY:], at.copy()]
        self._steps = [*self._steps[-_MEMORY:], step.copy()]
        if self.damping or len(self._steps) < 3:
            return step
        if np.linalg.norm(metric * step) < _SLOW * np.linalg.norm(metric * self._steps[-2]):
            return step
        dx, ds = np.diff(self._points, axis=0).T, np.diff(self._steps, axis=0).T
        mix = np.linalg.lstsq(metric[:, None] * ds, metric * step, rcond=1e-8)[0]
        return np.asarray(step - (dx + ds) @ mix)


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

    def end(self, done: Ending) -> Ending:
        """Return how a fit ended that can go no further: ``done``, unless it still had far to go."""
        return done if self.wanted < _ROUGH else Ending.STUCK


@dataclass(frozen=True)
class _Fit:
    """The unchanging part of a fit."""

    problem: Problem
    free: np.ndarray
    priors: Priors
    judge: Judge
    course: Course

    def run(self, start: np.ndarray | Linearised) -> tuple[_State, _Step, int, Ending]:
        """Return the last point, the step to it, the number of steps and how they ended; arguments as of :func:`solve`."""
        state, memory, ended = self.begin(start), _Memory(), None
        for iteration in range(1, MOST_STEPS + 1):
            state, step = self.advance(state, memory)
            if label := self.course.label:
                size = self.readable(state.judged)
                log.info("%s: iteration %d, residual %s, step %.1e of the noise", label, iteration, size, step.wanted)
            ended = self.exit_of(state, step)
            if ended is not None:
                break
            state = self.reweighted(state, step)
        if not self.course.rough and self.is_beyond_normal_equations(state):
            values, extra = polish(state.point, self.priors.bounds, state.judged.sigma)
            point = self._linearised(values, state.point.robust, state.judged.sigma)
            return replace(state, point=point), step, iteration + extra, Ending.EXACT
        return state, step, iteration, ended or Ending.BUDGET

    def begin(self, start: np.ndarray | Linearised) -> _State:
        """Return the first point; outliers are known if robust weights are."""
        if not isinstance(start, Linearised):
            point = self._linearised(start.astype(float), np.ones(len(self.problem)), None)
        elif len(self.problem.stations) == 1:
            point = start.narrowed(self.free)
        else:
            point = self._linearised(start.values, start.robust, self.judge.noise.known)
        hard = isinstance(start, Linearised)
        return _State(point, self.judge.at(point, hard=hard), hard)

    def advance(self, state: _State, memory: _Memory) -> tuple[_State, _Step]:
        """Return the next point and the step to it."""
        free, values = self.free, state.point.values
        equations = state.point.equations(state.judged.sigma)
        step, held = equations.step(self.priors.bounds[free])
        longer = memory.accelerate(values[free], step, equations.metric)
        wanted = self._length(equations.square(step), state.judged.robust)
        del equations
        point = self._moved(state, longer, step, memory)
        judged = self.judge.at(point, hard=state.hard)
        refused = longer is not step and not np.array_equal(point.values[free], values[free] + longer)
        if refused or np.max(np.abs(judged.sigma / state.judged.sigma - 1.0)) > _STEADY:
            memory.forget()
        shortest = self.course.short if np.any(judged.sigma > rounding(self.problem)) else _ROUNDED
        is_short = wanted < shortest
        if not is_short:
            taken = point.equations(judged.sigma).square(point.values[free] - values[free])
            is_short = self._length(taken, judged.robust) < shortest
        return _State(point, judged, state.hard), _Step(wanted, is_short, held)

    def exit_of(self, state: _State, step: _Step) -> Ending | None:
        """Return how the fit has ended, None if it goes on."""
        if self.course.rough and (step.is_short or step.wanted < _ROUGH):
            return step.end(Ending.ROUGH)
        if self.is_beyond_normal_equations(state):
            return step.end(Ending.ROUGH if self.course.rough else Ending.EXACT)
        screened = self.judge.loss == "screen" and not state.hard and np.any(state.point.robust != 1.0)
        if step.is_short and state.is_steady and not screened:
            return step.end(Ending.SETTLED)
        return None

    def reweighted(self, state: _State, step: _Step) -> _State:
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
        if self.problem.beliefs.terms:
            return False
        whole = state.point.equations(state.judged.sigma).whole
        return is_exact(whole, self.priors.sizes[self.free]) and len(self.problem) * len(whole) <= MOST_EXACT

    def finish(self, state: _State, step: _Step, iterations: int, ended: Ending) -> Solution:
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
        return Linearised(
            self.problem, values, self.free, robust, self.priors.sizes, self.course.executor, likely, is_doubtful
        )

    def _length(self, square: float, robust: np.ndarray) -> float:
        """Return how far a step of this square moves the predictions, root mean square, in units of the noise."""
        return float(np.sqrt(max(square, 0.0) / self._readings(robust)))

    def _readings(self, robust: np.ndarray) -> float:
        """Return the number of readings that count, 1 if none does."""
        return max(float(self.problem.readings(robust).sum()), 1.0)

    def _moved(self, state: _State, longer: np.ndarray, step: np.ndarray, memory: _Memory) -> Linearised:
        """Return the point of the first step that does not make things worse, the largest first.

        Args:
            state: the point to leave.
            longer: the accelerated step, shape (F,).
            step: Gauss-Newton's own.
            memory: of the fit; its damping is kept up to date.
        """
        here, sigma, bounds = state.point, state.judged.sigma, self.priors.bounds[self.free]
        spare = 1e-6 * self._readings(here.robust)
        trial = _Trial(self, here, sigma, here.objectives(sigma) * (1.0 + 1e-9) + spare, memory)
        # Few steps lead back here.
        here.release()
        if longer is not step and trial.succeeds(longer):
            return trial.there
        damping = memory.damping
        for _ in range(_MOST if np.isfinite(here.sizes[here.free]).any() else 0):
            if damping:
                step = here.equations(sigma).step(bounds, damping)[0]
            memory.damping = damping / _LESS if damping > _FIRST else 0.0
            if trial.succeeds(step):
                return trial.there
            # From where a whole step led to, putting it right may lead on into another valley.
            if damping:
                there, worse = trial.there, trial.there.objective(sigma) / max(here.objective(sigma), 1e-300)
                if trial.succeeds(
                    step + there.equations(sigma).step(bounds, _REPAIR * (1.0 + damping) * max(worse, 1.0))[0]
                ):
                    return trial.there
            damping = max(_FIRST, _MORE * damping)
        memory.damping = damping
        if any(trial.succeeds(step * 0.5**k) for k in range(_HALVINGS)):
            return trial.there
        # Those fits stay here that no step made better.
        return here if trial.is_open.all() else trial.at(np.zeros(len(step)))


class _Trial:
    """Steps from a point, tried one after the other until none makes things worse.

    Stations that share nothing that is free are fits of their own: each takes what does not make it worse.

    Attributes:
        there: the latest point.
        is_open: which fits still look for a step.
    """

    def __init__(self, fit: _Fit, here: Linearised, sigma: np.ndarray, limits: np.ndarray, memory: _Memory) -> None:
        self._fit, self._here, self._sigma, self._limits, self._memory = fit, here, sigma, limits, memory
        self._group, self.is_open, self._is_refused = here.group_of[fit.free], np.ones(len(limits), bool), False
        self.there = here

    def succeeds(self, step: np.ndarray) -> bool:
        """Try a step, shape (F,); return whether all fits have one now that does not make them worse."""
        doubtful = self._is_refused or self._memory.was_refused
        self.there = self.at(step, is_doubtful=doubtful)
        self.is_open &= self.there.objectives(self._sigma) > self._limits
        if self.is_open.any():
            self._is_refused = True
            return False
        self._memory.was_refused = self._is_refused
        return True

    def at(self, step: np.ndarray, *, is_doubtful: bool = False) -> Linearised:
        """Return the point where the fits that still look for a step take this one."""
        here, free, values = self._here, self._fit.free, self.there.values.copy()
        values[free] = np.where(self.is_open[self._group], here.values[free] + step, values[free])
        return self._fit._linearised(values, here.robust, self._sigma, is_doubtful=is_doubtful)
