"""Which convention of where moments bend the arm the data prefer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pincal.discover.candidate_tests import sampled
from pincal.discover.history import History
from pincal.discover.policy import Policy
from pincal.identify.calibrate import refit
from pincal.identify.fit import Fit
from pincal.identify.noise import outlier_limit
from pincal.model.chain import MomentFrame
from pincal.model.effects import ELASTIC

# Difference of -2 log likelihood from which another convention of moments counts as better (odds of 150 to 1).
FRAME_BETTER = 10.0


def likeliest_frame(fit: Fit, frames: Sequence[MomentFrame], policy: Policy) -> MomentFrame:
    """Return the convention in which elasticity explains most; the first unless another does so beyond chance."""
    if len(frames) == 1:
        return frames[0]
    few, _ = sampled(fit, policy)
    effects = [*fit.options.effects, *(e for e in ELASTIC if e.uses_moments and e not in fit.options.effects)]
    misfits = [_misfit(refit(few, effects, moment_frame=frame)) for frame in frames]
    best = int(np.argmin(misfits))
    return frames[best] if misfits[best] < misfits[0] - FRAME_BETTER else frames[0]


def other_frames(trail: History, frames: Sequence[MomentFrame], policy: Policy) -> list[MomentFrame]:
    """Return the conventions worth a discovery of their own.

    They fit what was found better, or as well without the effects of loads and the nameless that were found, which a wrong
    convention brings about. A convention that would take less off the squares than an effect must matters to nobody.
    """
    fit, rows = sampled(trail.final, policy)
    effects = fit.options.effects
    if not any(effect.uses_moments for effect in effects):
        return []
    brought = {e for step in trail.steps for e in step.effects if e.is_of_loads or e.is_nameless}
    plain = [effect for effect in effects if effect not in brought]
    rough = len(rows) < len(trail.final.problem)
    cost = _fit_cost(refit(fit, effects, rough=rough))
    enough = policy.least_gain(fit.solution.degrees, declared=fit.is_declared)

    def is_better(frame: MomentFrame) -> bool:
        if _fit_cost(refit(fit, effects, moment_frame=frame, rough=rough)) < cost - enough:
            return True
        return bool(brought) and _fit_cost(refit(fit, plain, moment_frame=frame, rough=rough)) < cost

    return [frame for frame in frames if is_better(frame)]


def _misfit(fit: Fit) -> float:
    """Return -2 log likelihood, up to a constant; an outlier counts as a row at the edge of the noise."""
    misfit = 0.0
    for (station, _, blocks), rows in zip(fit.stations, fit.problem.rows, strict=True):
        n, sizes = len(station), [block.size for block in station.sensor.blocks]
        outliers = int(np.sum(fit.solution.weights[rows] == 0.0))
        spread = float(np.dot(sizes, np.log(fit.solution.estimated[blocks])))
        misfit += 2.0 * n * spread + outliers * outlier_limit(n, sum(sizes))
    return misfit


def cost_of(trail: History) -> float:
    """Return the extended Bayesian information criterion of all that was found."""
    named = sum(not step.is_elastic for step in trail.steps)
    return _fit_cost(trail.final) + 2.0 * named * float(np.log(max(len(trail.last.effects), 2)))


def _fit_cost(fit: Fit) -> float:
    """Return the Bayesian information criterion of a fit."""
    readings = sum(len(s) * sum(block.size for block in s.sensor.blocks) for s in fit.problem.stations)
    return _misfit(fit) + fit.solution.posterior.effective * float(np.log(readings))
