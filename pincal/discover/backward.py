"""Backward: judge each effect once more beside all the others, and take out again what does not earn its place."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial

import numpy as np

from pincal.discover.candidate_tests import Search, addable
from pincal.discover.decisions import Decision, each_heading_once
from pincal.discover.elastic_ways import with_features
from pincal.discover.forward import decided, listed
from pincal.discover.history import State, Step
from pincal.discover.named_beside import named_beside
from pincal.discover.nuisance import score_test_beside_nuisances
from pincal.discover.policy import Policy
from pincal.discover.score_tests import WIDER, enough_errors, standard_errors
from pincal.identify.calibrate import refit
from pincal.identify.fit import Fit, without
from pincal.model.effect import Effect, Tone

# Orders closer than this [waves a turn] are one wave, found once more: stages of a drive differ by more.
_CLOSE = 1.0

log = logging.getLogger(__name__)


def name_again(state: State, search: Search) -> State:
    """Name each effect once more beside all the others, which were not there when it was named."""
    places = [k for k, step in enumerate(state.steps) if not step.is_elastic]
    beside: Iterator[tuple[Fit, Decision | None]] | None = None
    for i, k in enumerate(places if len(places) > 1 else []):
        step = state.steps[k]
        (effect,) = step.effects
        if beside is None:
            beside = named_beside(state.fit, [state.steps[later].effect for later in places[i:]], search)
        rest, decision = next(beside)
        if decision is None:
            continue
        if decision.effect.identity == effect.identity:
            # A rival that has come in since may go again.
            rivals = [*decision.equivalent, *(other for other in step.equivalent if _is_in(other, state.fit))]
            told = each_heading_once(rivals, effect, search.policy)
            state = state.with_replaced(step, replace(step, equivalent=told, together=decision.together))
            continue
        new = decided(rest, decision, search)
        if _predicts_better(effect, new.effect, rest, search):
            continue
        if _is_close(effect, new.effect):
            state, beside = state.tuned(step, new), None
            continue
        log.info("%s is %s beside what was found later", listed([effect]), listed([decision.effect]))
        steps = state.with_replaced(step, replace(new, before=step.before, after=step.after)).steps
        state, beside = state.changed(new.after, steps, (decision.effect,), (effect,)), None
    return state


def _is_close(effect: Effect, other: Effect) -> bool:
    """Return whether two effects are waves of nearly one order, of one name on one joint."""
    if not (isinstance(effect, Tone) and isinstance(other, Tone)) or effect.heading != other.heading:
        return False
    return abs((effect.locus.order or 0.0) - (other.locus.order or 0.0)) < _CLOSE


def _predicts_better(effect: Effect, other: Effect, fit: Fit, search: Search) -> bool:
    """Return whether an effect predicts blocks of poses left out better than another, by more than chance."""
    tests = score_test_beside_nuisances(fit, [effect, other], search.groups)
    return standard_errors(tests.gains_by_block([0]) - tests.gains_by_block([1])) > 1.0


def drop_needless(state: State, search: Search) -> State:
    """Take out again, one by one, what does not predict blocks of poses left out better beside all the others.

    What the whole model loses without a step has to be more than its standard error over the blocks, as it had to be when
    the step entered; and chance must not explain it. Elasticity, which every arm has, need only lose something, and of
    several that fail it goes last, the others the least missed first. What is needed only once another has left could as
    well be that other.
    """
    while state.steps:
        worth, without_it = _worths(state, search), cache(partial(_refitted_without, state.fit))
        failed = [step for step in state.steps if _fails(state, step, worth[step], search, without_it)]
        if not failed:
            break
        least = min(failed, key=lambda step: (step.is_elastic, worth[step]))
        log.info("dropped %s: the others predict blocks left out as well without it", listed(least.effects))
        state = state.changed(without_it(least), state.without_step(least).steps, (), least.effects)
        state = _with_rivals(state, least, [step for step in failed if step is not least], search)
    for step in state.steps:
        told = tuple(other for other in step.equivalent if not _is_in(other, state.fit))
        state = state.with_replaced(step, replace(step, equivalent=told))
    return state


def _is_in(effect: Effect, fit: Fit) -> bool:
    return effect.identity in {other.identity for other in fit.problem.effects}


def _fails(state: State, step: Step, worth: float, search: Search, without_it: Callable[[Step], Fit]) -> bool:
    """Return whether a step would not enter again: suspected to first order, judged on the others fitted again.

    The others may lean on it, so that what they leave without it is not what they must; and where it can't be told from
    products of theirs, as of a compliance with the place of its bearing, they seem to take more over than they do.
    """
    fit, policy, own = state.fit, search.policy, with_features(state.fit, step.effects)
    least = 0.0 if step.is_elastic else max(map(enough_errors, step.effects))
    is_one_of_many, is_rest = len(state.steps) > 1, _may_be_left_over(state, step)
    if worth > least and not (is_rest or (is_one_of_many and _is_doubtful(fit, step, policy))):
        return False
    rest, wider = without_it(step), 1.0 if step.is_elastic else WIDER
    tests = score_test_beside_nuisances(rest, own, search.groups, wider=wider)
    if standard_errors(tests.gains_by_block(range(len(own)))) <= least:
        return True
    limit = policy.elastic if step.is_elastic else policy.drop * policy.false_name
    looks = len({effect.identity for effect in addable(fit, search)}) if is_rest else 1
    return is_one_of_many and tests.p_value_of_any(range(len(own))) > limit / looks


def _may_be_left_over(state: State, step: Step) -> bool:
    """Return whether a name may be what something stronger without one leaves, which is known in outline only."""
    if step.is_elastic or step.effect.is_nameless:
        return False
    others = (other for other in state.steps if other.score.gain > step.score.gain and not other.is_elastic)
    return any(effect.is_nameless for other in others for effect in (*other.effects, *other.equivalent))


def _is_doubtful(fit: Fit, step: Step, policy: Policy) -> bool:
    """Return whether Wald's test leaves any doubt in a step."""
    found = fit.estimate.take(fit.names_of(step.effects))
    values = found.values[found.free]
    wald = values @ np.linalg.pinv(found.covariance.dense(), hermitian=True) @ values
    return bool(wald <= policy.sure * len(values))


def _worths(state: State, search: Search) -> dict[Step, float]:
    """Return what the model loses on blocks of poses left out without each step, in standard errors of it."""
    # The model is what predicts, with the priors that it was fitted with.
    tests, found = score_test_beside_nuisances(state.fit, (), search.groups, wider=1.0), {}
    # Masses bend the arm only by way of its compliances, and can't take their place.
    heavy = [effect for effect in state.fit.problem.effects if effect.bodies(state.fit.problem.chain)]
    for step in state.steps:
        own = with_features(state.fit, step.effects)
        # Nor does the place of a bearing that does not give way matter.
        places = [e for e in own if e.locus.acts_on == "place"]
        still = state.fit.names_of([*heavy, *places]) if step.is_elastic else ()
        losses = tests.losses_by_block(set(state.fit.names_of(own)) - set(still), still)
        found[step] = standard_errors(losses)
    return found


def _with_rivals(state: State, gone: Step, failed: list[Step], search: Search) -> State:
    """Return the state in which those are told to be perhaps what has left that are needed since it left."""
    worth = _worths(state, search) if failed else {}
    for step in failed:
        if worth[step] > 1.0:
            rivals = each_heading_once([*gone.effects[:1], *step.equivalent], step.effect, search.policy)
            state = state.with_replaced(step, replace(step, equivalent=rivals))
    return state


def _refitted_without(fit: Fit, step: Step) -> Fit:
    rest = fit
    for effect in with_features(fit, step.effects):
        rest = without(rest, effect)
    return refit(fit, rest.options.effects)
