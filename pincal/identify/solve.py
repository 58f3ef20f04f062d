"""The solver of every fit: Gauss-Newton on the posterior, with robust weights, estimated noise and
bounds.

Where two parameters multiply each other and the readings hardly distinguish them, such as a
bearing's compliance and its place, Gauss-Newton steps lead far off this curved ridge. A step is
then damped by the priors, and the remaining error is corrected from its end by what the readings
determine best. Halving steps instead would creep along the ridge.
"""

from __future__ import annotations

import logging
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from pincal.identify.equations import Linearised
from pincal.identify.fit import MOST_STEPS, Ending, Priors, Solution
from pincal.identify.noise import (
    MOST_EXACT,
    Judge,
    Loss,
    Noise,
    are_at_rounding,
    is_exact,
    polish,
    rounding,
    usual_sizes,
)
from pincal.identify.normal import Normal
from pincal.identify.posterior import Posterior
from pincal.identify.problem import Problem
from pincal.thresholds import Count, Scale
from pincal.units import readable_unit

log = logging.getLogger(__name__)

# A step that moves predictions by less than this part of the noise ends the fit: the next one would
# be smaller still. So does one that had to be halved down to this: along a curved ridge there is
# nothing to gain.
SETTLED: Scale = 1e-3
_ROUGH: Scale = 0.1
# Readings of correlated rows times parameters, above which products of columns take long: a fifth
# of a second.
_LONG: Count = 20_000_000
# After a step that moves them by less than this, products of the columns are much the same.
_ALIKE: Scale = 0.3
# Damping of steps by such products, in units of the priors' precision: directions that readings
# hardly tell turn with the values, and would be taken for others.
_STIFF: Scale = 1000.0
# A step that moves them by less than this changes nothing that is told, and is not taken.
_STILL: Scale = 1e-9
# The same in standard deviations of parameters, which are smaller than a short step if there are
# very many rows. On a ridge that is known to rounding such steps may continue, so after this number
# of them a short one suffices.
_NEAR: Scale = 0.05
_TRIALS: Count = 8
# The same where the noise is at its floor: steps there are rounding.
_ROUNDED: Scale = 0.03
# Relative change of the noise above which earlier steps do not predict the next.
_STEADY: Scale = 0.05
# Change of robust weights below which they are settled.
_SETTLED: Scale = 1e-3
# Largest step, in units of the priors' sizes, over which the normal matrix stays the same to some
# six digits, whatever columns grow with a deviation; it is short, too. Of steps a hundred times as
# long the next one is told too badly: a search took another path.
_NEARBY: Scale = 1e-5
# Number of steps kept, and the ratio of successive steps above which they are used.
_MEMORY: Count = 4
_SLOW: Scale = 0.3
# First damping, in units of the priors' precision; its factors after a refused and after an
# accepted step; and the number of refusals after which steps are halved instead.
_FIRST: Scale = 3.0
_MORE: Scale = 4.0
_LESS: Scale = 2.0
_MOST: Count = 6
# Additional damping of a step that corrects another one.
_REPAIR: Scale = 10.0
# Halvings of a step that increased the squares, before the fit counts as stalled.
_HALVINGS: Count = 10


@dataclass(frozen=True)
class Course:
    """How a fit is done.

    Attributes:
        loss: "screen" down-weights rows beyond the range of the noise and excludes them at the end;
            "huber" only down-weights them; "none" takes every row at full weight.
        rough: whether another fit follows, so that this one may end early and only down-weight
            outliers.
        short: motion of the predictions, root mean square in units of the noise, below which a step
            ends the fit.
        ahead: whether to stop before a step that moves every parameter by little of its standard
            deviation.
        columns: shape (P,), parameters whose columns the next fit needs where a rough one ends, the
            fitted ones among them; default: these alone.
        label: name of the fit in the log; without one it is not logged.
        executor: computes the stations' contributions; default: serially, in this process.
    """

    loss: Loss = "screen"
    rough: bool = False
    short: float = SETTLED
    ahead: bool = False
    columns: np.ndarray | None = None
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
    """Find the most probable values of the free parameters; ``exit`` of the result reports how the
    fit ended.

    Arguments as for :func:`solve_to`.
    """
    return solve_to(problem, start, free, priors, noise, course)[0]


def solve_to(
    problem: Problem,
    start: np.ndarray | Linearised,
    free: np.ndarray,
    priors: Priors,
    noise: Noise,
    course: Course = Course(),
) -> tuple[Solution, Linearised]:
    """Return the result of :func:`solve` and the problem at its values, with its robust weights and
    the columns that the next fit needs.

    Args:
        problem: model and readings.
        start: shape (P,), start values, which the other parameters keep. Or the problem at such
            values with the robust weights of an earlier fit, whose outliers are then known, and
            perhaps more free parameters.
        free: shape (P,), parameters to fit.
        priors: about the nominal, zero.
        noise: declared standard deviations.
        course: treatment of outliers, convergence and executor.
    """
    run = _Run(problem, start, free, priors, noise, course)
    ended = run.until_it_ends()
    point = run.for_next()
    return run.solution(ended), point


def likeliest_values(
    problem: Problem,
    start: np.ndarray,
    free: np.ndarray,
    priors: Priors,
    noise: Noise,
    course: Course = Course(),
) -> np.ndarray:
    """Return only the values of :func:`solve`, shape (P,), without their posterior."""
    run = _Run(problem, start, free, priors, noise, course)
    run.is_whole = False
    run.until_it_ends()
    return run.point.values


class _Run:
    """State of a fit; arguments as for :func:`solve`.

    Attributes:
        is_whole: whether more than the values is needed.
        is_along_rows: whether rows are correlated along their order.
        is_long: whether the products of their columns take long.
        point: the problem at the latest values, rows weighted by robust weights of an earlier
            point.
        judged: noise and robust weights by the residuals there.
        hard: whether outliers are excluded rather than down-weighted.
        iterations: number of steps.
        wanted: motion of the predictions by the last Gauss-Newton step, root mean square in units
            of the noise.
        columns: shape (P,), parameters whose columns are needed where the fit ends.
        is_last: whether the step ends a fit whose last point gets more columns than others.
        wide: this point with them, once it was tried.
        is_short: whether the part of it that was taken is too short to matter.
        near: the latest normal equations that were summed, where that takes long: their H stands
            for that of the points after short steps.
        alike: length of steps after which it does.
        was_near: whether the latest step was by such products.
        held: shape (F,), free parameters that a bound stopped.
        damping: for the next step; 0 while full steps succeed.
        was_refused: whether steps from the previous point were refused.
        history: points and their Gauss-Newton steps, the latest last, both of shape (F,).
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
        self.problem = problem
        self.free = free
        self.priors = priors
        self.course = course
        self.judge = Judge(problem, free, noise, course.loss)
        self.is_along_rows = any(station.serial is not None for station in problem.stations)
        size = problem.readings(np.ones(len(problem))).sum() * np.count_nonzero(free)
        # Of a rough fit all that readings hardly tell moves, as the next one begins there.
        self.is_long = self.is_along_rows and not course.rough and bool(size > _LONG)
        self.wanted = np.inf
        self.near: tuple[Normal, ...] | None = None
        self.alike: float = _ALIKE
        self.was_near = False
        # Outliers are known if robust weights are.
        self.hard = isinstance(start, Linearised)
        if not isinstance(start, Linearised):
            ones = np.ones(len(problem))
            self.point = self.linearised(
                start.astype(float), ones, None, squares_first=self.is_along_rows
            )
        else:
            declared = None if np.isnan(noise.known).any() else noise.known
            self.point = replace(start.narrowed(free), executor=course.executor, sigma=declared)
        self.judged = self.judge.at(self.point, hard=self.hard)
        self.iterations = 0
        self.columns = free if course.columns is None else course.columns
        self.is_last = False
        self.wide: Linearised | None = None
        self.is_short = False
        self.held = np.zeros(int(free.sum()), bool)
        self.damping = 0.0
        self.was_refused = False
        self.is_whole = True
        self.history: list[tuple[np.ndarray, np.ndarray]] = []

    def until_it_ends(self) -> Ending:
        """Take steps until the fit ends; return how."""
        ended = self.ending() if self.rests() else None
        while ended is None and self.iterations < MOST_STEPS:
            self.advance()
            if label := self.course.label:
                size = self.readable()
                log.info("%s: iteration %d, residual %s", label, self.iterations, size)
            ended = self.ending()
            if ended is None:
                self.reweigh()
        self.point = self.point.exactly()
        if not self.course.rough and self.is_beyond_normal_equations():
            values, extra = polish(self.point, self.priors.bounds, self.judged.sigma)
            self.point = self.linearised(values, self.point.robust, self.judged.sigma)
            self.iterations += extra
            return Ending.EXACT
        return ended or Ending.BUDGET

    def gauss_newton(self) -> tuple[np.ndarray, float]:
        """Return the step from the latest point, shape (F,), and its square; also note what bounds
        stopped.
        """
        posterior = self.point.posterior(self.judged.sigma)
        step, self.held = posterior.step_within(self.priors.bounds[self.free])
        return step, posterior.square(step)

    def rests(self) -> bool:
        """Return whether the fit starts where another ended, and no step from there is worth
        taking.
        """
        if not self.hard or self.course.rough:
            return False
        self.wanted = self.length(self.gauss_newton()[1])
        self.is_short = self.wanted < _STILL
        return self.is_short

    def advance(self) -> None:
        """Take a step."""
        free = self.free
        here = self.point
        before = self.judged
        posterior, step = self.begun()
        longer = self.accelerated(step, posterior.metric)
        self.wanted = self.length(posterior.square(step))
        self.is_last = (
            self.course.rough and self.wanted < _ROUGH and not np.array_equal(self.columns, free)
        )
        known = posterior if self.is_long else None
        del posterior
        self.point = self.moved(longer, step)
        self.judged = self.judge.at(self.point, hard=self.hard)
        self.iterations += 1
        taken = self.point.values[free] - here.values[free]
        refused = longer is not step and not np.array_equal(
            self.point.values[free], here.values[free] + longer
        )
        if refused or np.max(np.abs(self.judged.sigma / before.sigma - 1.0)) > _STEADY:
            self.history = []
        is_as_wanted = np.array_equal(self.point.values[free], here.values[free] + step)
        self.is_short = self.wanted < self.shortest() or (
            not self.is_last and not is_as_wanted and self.length_of(taken, known) < self.shortest()
        )
        if self.course.ahead and self.iterations < _TRIALS:
            self.is_short = self.is_near()
        if self.was_near and self.is_short:
            # What readings hardly tell may be on its way still.
            self.point = self.point.reweighted(self.judged.robust).exactly()
            self.wanted = self.length(self.gauss_newton()[1])
            self.is_short = self.wanted < self.shortest()

    def begun(self) -> tuple[Posterior, np.ndarray]:
        """Return the posterior at the latest point and the Gauss-Newton step from there, shape
        (F,), which is damped if it is by products from elsewhere.
        """
        here = self.point
        posterior = here.posterior(self.judged.sigma)
        is_near = here.near is not None
        if is_near != self.was_near:
            # Earlier steps do not predict others.
            self.history = []
        self.was_near = is_near
        if self.is_long and self.is_whole and not is_near:
            self.near = here.known_normals()
        damping = _STIFF if is_near else 0.0
        step, self.held = posterior.step_within(self.priors.bounds[self.free], damping)
        return posterior, step

    def length_of(self, taken: np.ndarray, known: Posterior | None) -> float:
        """Return the length of the part of a step that was taken, shape (F,), which takes all rows
        again; ``known`` tells it where that takes long.
        """
        posterior = self.point.posterior(self.judged.sigma) if known is None else known
        return self.length(posterior.square(taken))

    def shortest(self) -> float:
        """Return the length of a step below which none matters, in standard deviations."""
        is_exact = np.all(self.judged.sigma <= rounding(self.problem))
        return _ROUNDED if is_exact else self.course.short

    def is_near(self) -> bool:
        """Return whether the next step would move every parameter by only a small part of its
        standard deviation.
        """
        posterior = self.point.posterior(self.judged.sigma)
        free = self.free
        step, _ = posterior.step_within(self.priors.bounds[free])
        return (
            posterior.square(step) + float(np.sum((step / self.priors.sizes[free]) ** 2)) < _NEAR**2
        )

    def accelerated(self, step: np.ndarray, metric: np.ndarray) -> np.ndarray:
        """Return the step to take in place of the Gauss-Newton ``step``, both of shape (F,).

        Anderson acceleration over the last few steps (Walker and Ni 2011): where residuals are
        large and a direction is weakly determined, Gauss-Newton overshoots by almost the same
        amount again and again, and two such steps determine the limit. A fit that converges fast is
        unaffected.
        """
        self.history = [*self.history[-_MEMORY:], (self.point.values[self.free], step.copy())]
        points, steps = zip(*self.history, strict=True)
        if (
            self.damping
            or len(steps) < 3
            or np.linalg.norm(metric * step) < _SLOW * np.linalg.norm(metric * steps[-2])
        ):
            return step
        dx = np.diff(points, axis=0).T
        ds = np.diff(steps, axis=0).T
        mix = np.linalg.lstsq(metric[:, None] * ds, metric * step, rcond=1e-8)[0]
        return np.asarray(step - (dx + ds) @ mix)

    @property
    def is_steady(self) -> bool:
        """Whether the robust weights agree with the residuals."""
        change = np.abs(self.judged.robust - self.point.robust)
        return bool(np.max(change, initial=0.0) < _SETTLED)

    def ending(self) -> Ending | None:
        """Return how the fit has ended, None if it continues."""
        rough = self.course.rough
        screened = (
            self.judge.loss == "screen" and not self.hard and np.any(self.point.robust != 1.0)
        )
        if rough and (self.is_short or self.wanted < _ROUGH):
            done = Ending.ROUGH
        elif self.is_beyond_normal_equations():
            done = Ending.ROUGH if rough else Ending.EXACT
        elif self.is_short and self.is_steady and not screened:
            done = Ending.SETTLED
        else:
            return None
        # A fit without a successful step may still be far from the solution.
        return done if self.wanted < _ROUGH else Ending.STUCK

    def reweigh(self) -> None:
        """Take the robust weights that follow from the residuals, hard ones once nothing else
        moves.
        """
        if self.is_short and self.is_steady:
            self.hard = True
            self.judged = self.judge.at(self.point, hard=True)
        if not np.array_equal(self.judged.robust, self.point.robust):
            self.point = self.point.reweighted(self.judged.robust)

    def is_beyond_normal_equations(self) -> bool:
        """Return whether readings are too exact for J^T J, and few enough for J itself.

        J contains neither knowledge beyond the priors of each parameter nor correlated noise. Of a
        few positions that parameters fit exactly beside the noise of an IMU nothing is exact.
        """
        if not are_at_rounding(self.problem, self.judged.sigma):
            return False
        correlated = any(s.is_correlated or s.whitening is not None for s in self.problem.stations)
        if (
            correlated
            or not self.problem.beliefs.is_slope
            or not np.isfinite(self.priors.sizes[self.free]).any()
        ):
            return False
        whole = self.point.posterior(self.judged.sigma).whole
        # A prior that is wider than usual does not make readings more exact, nor does one of what
        # has no usual size: a target that is within reach of the arm.
        usual = usual_sizes(self.problem)
        sizes = np.where(np.isfinite(usual), np.minimum(usual, self.priors.sizes), np.inf)
        is_beyond = is_exact(whole, sizes[self.free])
        return is_beyond and len(self.problem) * len(whole) <= MOST_EXACT

    def for_next(self) -> Linearised:
        """Return the latest point with the columns that the next fit needs."""
        if np.array_equal(self.columns, self.free):
            return self.point
        if self.wide is None or not self.wide.is_at(self.point):
            self.wide = self.point.with_columns(self.columns)
            self.point = self.wide.narrowed(self.free)
        return self.wide

    def solution(self, ended: Ending) -> Solution:
        """Return the solution, its noise estimated with the effective number of parameters."""
        point = self.point
        noise = self.judge.noise
        spent = point.posterior(self.judge.noise_at(point, hard=True)[0]).spent
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
            f"{sigma * factor:.5f} {unit}"
            for sigma, (factor, unit) in zip(self.judged.estimated, units, strict=True)
        )

    def linearised(
        self,
        values: np.ndarray,
        robust: np.ndarray,
        sigma: np.ndarray | None,
        *,
        squares_first: bool = False,
    ) -> Linearised:
        """Return the problem at values; if ``sigma``, the noise so far, is the declared one, it
        will be used again.
        """
        is_near = self.near is not None and self.wanted < self.alike
        likely = (
            sigma if sigma is not None and np.array_equal(sigma, self.judge.noise.known) else None
        )
        return Linearised(
            self.problem,
            values,
            self.free,
            robust,
            self.priors.sizes,
            self.course.executor,
            likely,
            squares_first,
            near=self.near if is_near else None,
        )

    def length(self, square: float) -> float:
        """Return the motion of the predictions by a step of this square, root mean square, in units
        of the noise.
        """
        return float(np.sqrt(max(square, 0.0) / self.readings(self.judged.robust)))

    def readings(self, robust: np.ndarray) -> float:
        """Return the number of readings that count, 1 if none does."""
        return max(float(self.problem.readings(robust).sum()), 1.0)

    def moved(self, longer: np.ndarray, step: np.ndarray) -> Linearised:
        """Return the point of the first successful step, the largest first.

        Args:
            longer: the accelerated step, shape (F,).
            step: the Gauss-Newton step.
        """
        trial = _Trial(self)
        # The equations here are rarely needed again.
        self.point.release()
        if longer is not step and trial.succeeds(longer):
            return trial.there
        if self.point.near is not None and not trial.succeeds(step):
            # The products changed too much since they were summed.
            self.alike = self.wanted
            self.point = self.point.exactly()
            step, square = self.gauss_newton()
            self.wanted = self.length(square)
            trial = _Trial(self)
        if trial.is_open.any() and not self.is_taken(step, trial):
            # Fits without a successful step stay here.
            return self.point if trial.is_open.all() else trial.at(np.zeros(len(step)))
        return trial.there

    def is_taken(self, step: np.ndarray, trial: _Trial) -> bool:
        """Return whether the Gauss-Newton step, or one that is damped or halved, succeeds."""
        here = self.point
        sigma = self.judged.sigma
        bounds = self.priors.bounds[self.free]
        damping = self.damping
        for _ in range(_MOST if np.isfinite(here.sizes[here.free]).any() else 0):
            if damping:
                step = here.posterior(sigma).step_within(bounds, damping)[0]
            self.damping = damping / _LESS if damping > _FIRST else 0.0
            if trial.succeeds(step):
                return True
            # Correcting from the end of a full step may lead on into another valley.
            if damping:
                there = trial.there
                worse = trial.there.objective(sigma) / max(here.objective(sigma), 1e-300)
                repair = _REPAIR * (1.0 + damping) * max(worse, 1.0)
                if trial.succeeds(step + there.posterior(sigma).step_within(bounds, repair)[0]):
                    return True
            damping = max(_FIRST, _MORE * damping)
        self.damping = damping
        return any(trial.succeeds(step * 0.5**k) for k in range(_HALVINGS))


class _Trial:
    """Steps from a point, tried one after the other until one does not increase the squares.

    Stations that share no free parameter are fits of their own: each takes the first step that
    succeeds for it.

    Attributes:
        there: the latest point.
        is_open: which fits still need a step.
    """

    def __init__(self, run: _Run) -> None:
        self._run = run
        self._here = run.point
        self._sigma = run.judged.sigma
        spare = 1e-6 * run.readings(self._here.robust)
        self._limits = self._here.objectives(self._sigma) * (1.0 + 1e-9) + spare
        self._group = self._here.group_of[run.free]
        self._is_refused = False
        self.there = self._here
        self.is_open = np.ones(len(self._limits), bool)

    def succeeds(self, step: np.ndarray) -> bool:
        """Try a step, shape (F,); return whether all fits have a successful step now."""
        run = self._run
        # Squares suffice for the last point if only its values are needed. Equations of correlated
        # rows are summed anew for other robust weights, so only once these are known.
        squares_first = (
            self._is_refused
            or run.is_along_rows
            or run.was_refused
            or (run.wanted < run.course.short and not run.is_whole)
        )
        self.there = self.at(step, squares_first=squares_first)
        self.is_open &= self.there.objectives(self._sigma) > self._limits
        if self.is_open.any():
            self._is_refused = True
            return False
        run.was_refused = self._is_refused
        return True

    def at(self, step: np.ndarray, *, squares_first: bool = False) -> Linearised:
        """Return the point where the fits that still need a step take this one."""
        here = self._here
        free = self._run.free
        values = self.there.values.copy()
        values[free] = np.where(self.is_open[self._group], here.values[free] + step, values[free])
        if self._is_carried(values):
            return here.carried_to(values)
        run = self._run
        if run.is_last and not squares_first:
            there = run.linearised(values, here.robust, self._sigma, squares_first=True)
            run.wide = there.with_columns(run.columns)
            return run.wide.narrowed(free) if run.wide.normals else there
        return run.linearised(values, here.robust, self._sigma, squares_first=squares_first)

    def _is_carried(self, values: np.ndarray) -> bool:
        """Return whether values are so near that the normal matrix here holds there, too, and is
        needed there.
        """
        run = self._run
        here = self._here
        if not (run.is_whole and here.may_be_carried) or run.is_last:
            return False
        taken = values[run.free] - here.values[run.free]
        if np.any(np.abs(taken) > _NEARBY * run.priors.sizes[run.free]):
            return False
        return run.length(here.posterior(self._sigma).square(taken)) < run.course.short
