"""Fits to very many rows: begun with a sample, which also makes all choices on the way, and
finished with all rows.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from pincal.identify.beliefs import excited_of, priors_of, released_of
from pincal.identify.equations import Linearised
from pincal.identify.fit import ModelFit
from pincal.identify.noise import Judge
from pincal.identify.problem import Problem
from pincal.identify.solve import Course, solve
from pincal.thresholds import Count

# Number of rows above which a fit is begun with so many, and the fewest that each station keeps.
# All rows then move predictions by some hundredths of the noise, which one step corrects.
MANY: Count = 20_000
EACH: Count = 1_000


def some_of(problem: Problem) -> Problem:
    """Return the problem with a sample of its rows that covers everything; itself if there are not
    too many.
    """
    n = len(problem)
    if n <= MANY:
        return problem
    parts = [
        s if s.sensor.is_whole else s.sample(max(MANY * len(s) // n, EACH))
        for s in problem.stations
    ]
    return replace(problem, stations=tuple(parts))


def over_all(fit: ModelFit, problem: Problem, executor: Executor | None) -> ModelFit:
    """Return a fit to some rows of a problem over all its rows: base and tool fitted, the rest not
    yet.

    Effects and moment convention are those of the fit; the executor computes the stations'
    contributions.
    """
    options = fit.options
    frame = fit.problem.chain.moment_frame
    problem = replace(problem, earlier=fit.problem.earlier).with_effects(
        options.effects, moment_frame=frame
    )
    priors = priors_of(problem, options)
    # What the sample required beyond that is tested again with all rows.
    excited = excited_of(problem) | ~released_of(problem, options)
    start = replace(
        fit.solution,
        values=np.where(excited, fit.solution.values, 0.0),
        free=fit.solution.free & excited,
    )
    judge = Judge(problem, start.free, fit.noise, options.loss)
    # Squares alone take a tenth of the time.
    point = Linearised(
        problem,
        start.values,
        start.free,
        np.ones(len(problem)),
        priors.sizes,
        executor,
        squares_first=True,
    )
    solution = replace(start, weights=judge.weights(point, start.sigma, hard=True))
    course = Course(options.loss, rough=True, label="base and tool", executor=executor)
    nominal = solve(problem, fit.nominal.values, fit.nominal.free, priors, fit.noise, course)
    nominal = replace(nominal, iterations=fit.nominal.iterations + nominal.iterations)
    return replace(fit, problem=problem, priors=priors, nominal=nominal, solution=solution)
