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
from pincal.identify.noise import MOST_EXACT, Judge, Loss, Noise, is_exact, polish, rounding, usual_sizes
from pincal.identify.problem import Problem
from pincal.units import readable_unit

log = logging.getLogger(__name__)

# A step that moves predictions by less than this part of the noise ends the fit: the next one would be smaller still. So
# does one that had to be halved down to this: along a bent ridge there is nothing left to gain.
SETTLED = 1e-3
_ROUGH = 0.1
# The same in standard deviations of parameters: of very many rows, these are known to less than a step may be that is short.
# On a ridge that is known to rounding such steps may go on, so that after so many a short one will do.
_NEAR, _LOOKS = 0.05, 8
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
        ahead: whether it ends before a step that moves no parameter by much of its standard deviation, without taking it.
        label: what the fit is called in the log; it is not logged without a name.
        executor: computes what stations contribute, where there are several; default: one after the other, here.
    """

    loss: Loss = "screen"
    rough: bool = False
    short: float = SETTLED
    ahead: bool = False
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
    run = _Run(problem, start, free, priors, noise, course)
    ended = run.until_it_ends()
    return run.solution(ended)


def likeliest_values(
    problem: Problem, start: np.ndarray, free: np.ndarray, priors: Priors, noise: Noise, course: Course = Course()
) -> np.ndarray:
    """Return the values of :func:`solve` alone, shape (P,), without what is known of them."""
    run = _Run(problem, start, free, priors, noise, course)
    run.is_whole = False
    run.until_it_ends()
    return run.point.values


class _Run:
    """A fit on its way; arguments as of :func:`solve`.

    Attributes:
        is_whole: whether more is asked for than the values.
        point: the problem at the latest values, rows weighted by robust weights of an earlier point.
        judged: noise and robust weights by the residuals there.
        hard: whether outliers are left out rather than weighed down.
        iterations: number of steps.
        wanted: how far Gauss-Newton wanted the last one to move predictions, root mean square, in units of the noise.
        is_short: whether what was taken of it is too short to matter.
        held: shape (F,), free parameters that a bound stopped.
        damping: of the last step, less what its success is worth; 0 while whole steps do.
        was_refused: whether the point before had steps that made things worse.
        trail: points and the steps that Gauss-Newton wanted there, the latest last, both of shape (F,).
    """

    def __init__(
        self,
        problem: Problem,
        start: np.ndarray | Linearised,
        free: np.ndarray,
        priors: Priors,
        noise: Noise,
        course: Course,
    ) -> None:
        self.problem, self.free, self.priors, self.course = problem, free, priors, course
        self.judge = Judge(problem, free, noise, course.loss)
        # Outliers are known if robust weights are.
        self.hard = isinstance(start, Linearised)
        if not isinstance(start, Linearised):
            self.point = self.linearised(start.astype(float), np.ones(len(problem)), None)
        else:
            declared = None if np.isnan(noise.known).any() else noise.known
            self.point = replace(start.narrowed(free), executor=course.executor, sigma=declared)
        self.judged = self.judge.at(self.point, hard=self.hard)
        self.iterations, self.wanted, self.is_short, self.held = 0, np.inf, False, np.zeros(int(free.sum()), bool)
        self.damping, self.was_refused, self.is_whole = 0.0, False, True
        self.trail: list[tuple[np.ndarray, np.ndarray]] = []

    def until_it_ends(self) -> Ending:
        """Take steps until the fit ends; return how."""
        ended = None
        while ended is None and self.iterations < MOST_STEPS:
            self.advance()
            if label := self.course.label:
                size = self.readable()
                log.info("%s: iteration %d, residual %s, step %.1e of the noise", label, self.iterations, size, self.wanted)
            ended = self.ending()
            if ended is None:
                self.reweigh()
        if not self.course.rough and self.is_beyond_normal_equations():
            values, extra = polish(self.point, self.priors.bounds, self.judged.sigma)
            self.point = self.linearised(values, self.point.robust, self.judged.sigma)
            self.iterations += extra
            return Ending.EXACT
        return ended or Ending.BUDGET

    def advance(self) -> None:
        """Take a step."""
        free, here, before = self.free, self.point, self.judged
        posterior = here.posterior(before.sigma)
        step, self.held = posterior.step_within(self.priors.bounds[free])
        longer = self.accelerated(step, posterior.metric)
        self.wanted = self.length(posterior.square(step))
        del posterior
        self.point = self.moved(longer, step)
        self.judged = self.judge.at(self.point, hard=self.hard)
        self.iterations += 1
        taken = self.point.values[free] - here.values[free]
        refused = longer is not step and not np.array_equal(self.point.values[free], here.values[free] + longer)
        if refused or np.max(np.abs(self.judged.sigma / before.sigma - 1.0)) > _STEADY:
            self.trail = []
        shortest = self.course.short if np.any(self.judged.sigma > rounding(self.problem)) else _ROUNDED
        self.is_short = (
            self.wanted < shortest or self.length(self.point.posterior(self.judged.sigma).square(taken)) < shortest
        )
        if self.course.ahead and self.iterations < _LOOKS:
            self.is_short = self.is_near()

    def is_near(self) -> bool:
        """Return whether the next step would move no parameter by more than a small part of its standard deviation."""
        posterior, free = self.point.posterior(self.judged.sigma), self.free
        step, _ = posterior.step_within(self.priors.bounds[free])
        return posterior.square(step) + float(np.sum((step / self.priors.sizes[free]) ** 2)) < _NEAR**2

    def accelerated(self, step: np.ndarray, metric: np.ndarray) -> np.ndarray:
        """Return the step to take where Gauss-Newton wants ``step``, both of shape (F,).

        Anderson's acceleration of a slowly converging fit (Walker and Ni 2011), over the last few steps: where residuals are
        large against what a direction is known by, Gauss-Newton overshoots it again and again by almost the same amount; two
        such steps tell where it settles. A fit that converges fast is left alone.
        """
        self.trail = [*self.trail[-_MEMORY:], (self.point.values[self.free], step.copy())]
        points, steps = zip(*self.trail, strict=True)
        if self.damping or len(steps) < 3 or np.linalg.norm(metric * step) < _SLOW * np.linalg.norm(metric * steps[-2]):
            return step
        dx, ds = np.diff(points, axis=0).T, np.diff(steps, axis=0).T
        mix = np.linalg.lstsq(metric[:, None] * ds, metric * step, rcond=1e-8)[0]
        return np.asarray(step - (dx + ds) @ mix)

    @property
    def is_steady(self) -> bool:
        """Whether the robust weights are those that the residuals call for."""
        return bool(np.max(np.abs(self.judged.robust - self.point.robust)) < _SETTLED)

    def ending(self) -> Ending | None:
        """Return how the fit has ended, None if it goes on."""
        rough = self.course.rough
        screened = self.judge.loss == "screen" and not self.hard and np.any(self.point.robust != 1.0)
        if rough and (self.is_short or self.wanted < _ROUGH):
            done = Ending.ROUGH
        elif self.is_beyond_normal_equations():
            done = Ending.ROUGH if rough else Ending.EXACT
        elif self.is_short and self.is_steady and not screened:
            done = Ending.SETTLED
        else:
            return None
        # One that can go no further may still have had far to go.
        return done if self.wanted < _ROUGH else Ending.STUCK

    def reweigh(self) -> None:
        """Take the robust weights that the residuals call for, hard ones once nothing else moves."""
        if self.is_short and self.is_steady:
            self.hard = True
            self.judged = self.judge.at(self.point, hard=True)
        if not np.array_equal(self.judged.robust, self.point.robust):
            self.point = self.point.reweighted(self.judged.robust)

    def is_beyond_normal_equations(self) -> bool:
        """Return whether readings are so exact that J^T J can't hold what they say, and few enough for J itself.

        What is believed beyond the priors of each parameter, and noise that is correlated, have no part in J.
        """
        correlated = any(s.serial is not None or s.whitening is not None for s in self.problem.stations)
        if correlated or not self.problem.beliefs.is_slope or not np.isfinite(self.priors.sizes[self.free]).any():
            return False
        whole = self.point.posterior(self.judged.sigma).whole
        # A prior that is wider than usual makes no reading more exact.
        sizes = usual_sizes(self.problem, self.priors.sizes)[self.free]
        return is_exact(whole, sizes) and len(self.problem) * len(whole) <= MOST_EXACT

    def solution(self, ended: Ending) -> Solution:
        """Put the solution together, its noise judged with the parameters really spent."""
        point, noise = self.point, self.judge.noise
        spent = point.posterior(self.judge.at(point, hard=True).sigma).spent
        degrees = self.judge.degrees(point.robust, *spent)
        estimated = np.maximum(np.sqrt(point.squares / degrees), rounding(self.problem))
        sigma = noise.resolved(estimated, degrees)
        at_bound = np.zeros(len(point.values), bool)
        at_bound[self.free] = self.held
        return Solution(
            values=point.values,
            posterior=point.posterior(sigma),
            sigma=sigma,
            estimated=estimated,
            weights=point.robust,
            chi2=point.chi2(np.where(np.isnan(noise.known), estimated, noise.known)),
            degrees=float(degrees.sum()),
            iterations=self.iterations,
            exit=ended,
            at_bound=at_bound,
            free=self.free,
        )

    def readable(self) -> str:
        """Return the size of the residuals for the log."""
        units = [readable_unit(block.unit) for block in self.problem.blocks]
        return ", ".join(
            f"{sigma * factor:.5f} {unit}" for sigma, (factor, unit) in zip(self.judged.estimated, units, strict=True)
        )

    def linearised(
        self, values: np.ndarray, robust: np.ndarray, sigma: np.ndarray | None, *, is_doubtful: bool = False
    ) -> Linearised:
        """Return the problem at values; if ``sigma``, the noise so far, is the declared one, it will be again."""
        likely = sigma if sigma is not None and np.array_equal(sigma, self.judge.noise.known) else None
        return Linearised(
            self.problem, values, self.free, robust, self.priors.sizes, self.course.executor, likely, is_doubtful
        )

    def length(self, square: float) -> float:
        """Return how far a step of this square moves the predictions, root mean square, in units of the noise."""
        return float(np.sqrt(max(square, 0.0) / self.readings(self.judged.robust)))

    def readings(self, robust: np.ndarray) -> float:
        """Return the number of readings that count, 1 if none does."""
        return max(float(self.problem.readings(robust).sum()), 1.0)

    def moved(self, longer: np.ndarray, step: np.ndarray) -> Linearised:
        """Return the point of the first step that does not make things worse, the largest first.

        Args:
            longer: the accelerated step, shape (F,).
            step: Gauss-Newton's own.
        """
        here, sigma, bounds = self.point, self.judged.sigma, self.priors.bounds[self.free]
        trial = _Trial(self)
        # Few steps lead back here.
        here.release()
        if longer is not step and trial.succeeds(longer):
            return trial.there
        damping = self.damping
        for _ in range(_MOST if np.isfinite(here.sizes[here.free]).any() else 0):
            if damping:
                step = here.posterior(sigma).step_within(bounds, damping)[0]
            self.damping = damping / _LESS if damping > _FIRST else 0.0
            if trial.succeeds(step):
                return trial.there
            # From where a whole step led to, putting it right may lead on into another valley.
            if damping:
                there, worse = trial.there, trial.there.objective(sigma) / max(here.objective(sigma), 1e-300)
                if trial.succeeds(
                    step + there.posterior(sigma).step_within(bounds, _REPAIR * (1.0 + damping) * max(worse, 1.0))[0]
                ):
                    return trial.there
            damping = max(_FIRST, _MORE * damping)
        self.damping = damping
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

    def __init__(self, run: _Run) -> None:
        self._run, self._here, self._sigma = run, run.point, run.judged.sigma
        spare = 1e-6 * run.readings(self._here.robust)
        self._limits = self._here.objectives(self._sigma) * (1.0 + 1e-9) + spare
        self._group, self._is_refused = self._here.group_of[run.free], False
        self.there, self.is_open = self._here, np.ones(len(self._limits), bool)

    def succeeds(self, step: np.ndarray) -> bool:
        """Try a step, shape (F,); return whether all fits have one now that does not make them worse."""
        run = self._run
        # Of the last point the squares will do if only its values are asked for.
        is_doubtful = self._is_refused or run.was_refused or (run.wanted < run.course.short and not run.is_whole)
        self.there = self.at(step, is_doubtful=is_doubtful)
        self.is_open &= self.there.objectives(self._sigma) > self._limits
        if self.is_open.any():
            self._is_refused = True
            return False
        run.was_refused = self._is_refused
        return True

    def at(self, step: np.ndarray, *, is_doubtful: bool = False) -> Linearised:
        """Return the point where the fits that still look for a step take this one."""
        here, free, values = self._here, self._run.free, self.there.values.copy()
        values[free] = np.where(self.is_open[self._group], here.values[free] + step, values[free])
        return self._run.linearised(values, here.robust, self._sigma, is_doubtful=is_doubtful)
