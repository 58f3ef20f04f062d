"""Fits to very many rows: begun, and all that is chosen on the way chosen, by some of them; finished by all."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from pincal.identify.beliefs import excited_of, priors_of, released_of
from pincal.identify.equations import Linearised
from pincal.identify.fit import ModelFit, Solution
from pincal.identify.noise import Judge
from pincal.identify.problem import Problem
from pincal.identify.solve import Course, solve

# Rows beyond which a fit is begun by so many, and how many each station keeps of these at least. From there all rows move
# predictions by some hundredths of the noise, which one step puts right.
MANY, EACH = 20_000, 1_000


def some_of(problem: Problem) -> Problem:
    """Return the problem with some of its rows, some of everything; itself if they are not too many."""
    n = len(problem)
    if n <= MANY:
        return problem
    parts = [s if s.sensor.is_whole else s.sample(max(MANY * len(s) // n, EACH)) for s in problem.stations]
    return replace(problem, stations=tuple(parts))


def over_all(fit: ModelFit, problem: Problem, executor: Executor | None) -> ModelFit:
    """Return a fit to some rows of a problem over all of them, where it stands: base and tool fitted, the rest not yet.

    Args:
        fit: the fit; its effects and its convention of moments are kept.
        problem: all rows.
        executor: computes what stations contribute.
    """
    options, frame = fit.options, fit.problem.chain.moment_frame
    problem = replace(problem, earlier=fit.problem.earlier).with_effects(options.effects, moment_frame=frame)
    priors = priors_of(problem, options)

    # What some rows called for beyond that, all of them are asked for again.
    excited = excited_of(problem) | ~released_of(problem, options)
    start = replace(fit.solution, values=np.where(excited, fit.solution.values, 0.0), free=fit.solution.free & excited)

    def weighed(solution: Solution) -> Solution:
        """Return a solution with the robust weights that its noise gives to all rows."""
        everywhere, judge = np.ones(len(problem)), Judge(problem, solution.free, fit.noise, options.loss)
        # Squares alone take a tenth of the time.
        point = Linearised(problem, solution.values, solution.free, everywhere, priors.sizes, executor, is_doubtful=True)
        return replace(solution, weights=judge.weights(point, solution.sigma, hard=True))

    course = Course(options.loss, rough=True, label="base and tool", executor=executor)
    nominal = solve(problem, fit.nominal.values, fit.nominal.free, priors, fit.noise, course)
    nominal = replace(nominal, iterations=fit.nominal.iterations + nominal.iterations)
    return replace(fit, problem=problem, priors=priors, nominal=nominal, solution=weighed(start))
