"""Which convention of where moments bend the arm the data prefer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pincal.discover.candidate_tests import Search, has_compliance, is_small_table, variants
from pincal.discover.decisions import each_heading_once
from pincal.discover.elastic_ways import ElasticWay, elastic_way
from pincal.discover.history import State, Step
from pincal.discover.policy import Policy
from pincal.discover.score_tests import enough_errors, score_test, standard_errors
from pincal.identify.calibrate import Until, refit, with_bearings
from pincal.identify.fit import Fit
from pincal.identify.moment_frames import FRAME_BETTER, best_of, misfit
from pincal.model.chain import MomentFrame
from pincal.model.effect import Effect

# What loads move where a bearing gives way in another convention.
_LIKE_A_BEARING = ("base", "link")


def in_frame(fit: Fit, frame: MomentFrame) -> Fit:
    """Return a fit in another convention, fitted again if it has moments."""
    effects = fit.options.effects
    if frame == fit.problem.chain.moment_frame:
        return fit
    if any(effect.uses_moments for effect in effects):
        return refit(fit, effects, moment_frame=frame)
    return replace(
        fit,
        problem=fit.problem.with_effects(effects, moment_frame=frame),
        options=replace(fit.options, moment_frame=frame),
    )


def elastic_ways(fit: Fit, frames: Sequence[MomentFrame], policy: Policy) -> dict[MomentFrame, ElasticWay]:
    """Return how an arm that has no elasticity yet gives way in each convention; nothing where it does not."""
    if has_compliance(fit.options.effects):
        return {}
    return {frame: way for frame in frames if (way := elastic_way(in_frame(fit, frame), policy))}


def likeliest_fit(fit: Fit, compliances: Sequence[Effect], frames: Sequence[MomentFrame]) -> Fit:
    """Return a fit with compliances in the convention in which they explain most; the first unless beyond chance.

    What the data call for of the bearings takes part in the choice, and may enter once names have had their turn.
    """
    effects = [*fit.options.effects, *compliances]
    fits = {frame: refit(fit, effects, moment_frame=frame) for frame in frames}
    return fits[best_of([with_bearings(other) for other in fits.values()])]


def single_compliance(
    ways: Mapping[MomentFrame, ElasticWay], frames: Sequence[MomentFrame], policy: Policy
) -> tuple[MomentFrame, ElasticWay] | None:
    """Return the convention in which one drive or bearing is all that gives way; None where more does, or nothing.

    It would be lost among the many parameters by which whole arms differ between conventions. What explains as much in
    another convention is told as equivalent.

    Args:
        ways: how the arm gives way, by convention.
        frames: the conventions; the first is kept unless another is better beyond chance.
        policy: what counts as a tie.
    """
    if not ways:
        return None
    costs = {frame: way.score.ebic for frame, way in ways.items()}
    least = min(costs, key=lambda frame: costs[frame])
    frame = frames[0] if costs.get(frames[0], np.inf) < costs[least] + FRAME_BETTER else least
    if not ways[frame].is_single:
        return None
    close = [way for other, way in ways.items() if way.is_single and costs[other] < costs[frame] + policy.tie]
    every = (*ways[frame].equivalent, *(effect for way in close for effect in (*way.effects, *way.equivalent)))
    return frame, replace(ways[frame], equivalent=each_heading_once(every, ways[frame].effects[0], policy))


def best_frame(state: State, search: Search) -> MomentFrame:
    """Return the convention in which it is best to go on from what was found; that of the fit unless another is better.

    Another has to fit what was found better, or as well without the effects that a wrong convention brings about, or with
    one of loads that a wrong convention takes for a compliance: a base that tilts is a bearing that tilts with the link
    before. Where nothing but elasticity was found, the likeliest stays unless that is worth what an effect must take off.
    """
    frames, policy = search.frames, search.policy
    fit, effects, here = state.fit, state.fit.options.effects, state.fit.problem.chain.moment_frame
    others = [frame for frame in frames if frame != here]
    if not others or not any(effect.uses_moments for effect in effects):
        return here
    brought = [effect for step in state.steps if is_brought(step) for effect in step.effects]
    plain = [effect for effect in effects if effect not in brought]
    cost = fit_cost(fit)
    enough = policy.least_gain(fit.solution.degrees, declared=fit.is_declared)
    enough *= all(step.is_elastic for step in state.steps)
    costs = {}
    for frame in others:
        other = refit(fit, effects, moment_frame=frame, until=Until.CLOSE)
        costs[frame] = fit_cost(other) + enough + _still_to_gain(other, search)
        if brought:
            costs[frame] = min(costs[frame], fit_cost(refit(fit, plain, moment_frame=frame, until=Until.CLOSE)))
    best = min(others, key=lambda frame: costs[frame])
    return best if costs[best] < cost else here


def _still_to_gain(fit: Fit, search: Search) -> float:
    """Return what the best load on base or links would change of the information criterion; 0 where that may be chance.

    As in a search it has to predict rows left out, too. Few rows leave bearings out, and what loads do elsewhere would stand
    for them.
    """
    if is_small_table(fit, search.policy):
        return 0.0
    # What else moves base or links, such as time, is for every convention to explain.
    others = (effect for effect in variants(fit, _LIKE_A_BEARING) if effect not in fit.problem.effects)
    effects = [effect for effect in others if effect.is_of_loads]
    tests, limit = score_test(fit, effects, (), search.groups), search.policy.false_name / max(len(effects), 1)
    scores = [tests.score([i], len(effects)) for i in range(len(effects))]
    sure = (i for i, score in enumerate(scores) if score.p_value < limit)
    for i in sorted(sure, key=lambda i: scores[i].ebic):
        if standard_errors(tests.gains_by_block([i])) > enough_errors(effects[i]):
            return scores[i].ebic
    return 0.0


def is_brought(step: Step) -> bool:
    """Return whether a wrong convention may have brought a step about: an effect of loads, or one without a name."""
    return any(effect.is_of_loads or effect.is_nameless for effect in step.effects)


def fit_cost(fit: Fit) -> float:
    """Return the Bayesian information criterion of a fit."""
    readings = sum(len(s) * sum(block.size for block in s.sensor.blocks) for s in fit.problem.stations)
    return misfit(fit) + fit.solution.effective * float(np.log(readings))
