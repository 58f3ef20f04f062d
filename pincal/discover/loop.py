"""Find the effects that a fit misses: one pass after the other, each from one state to the next."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np

from pincal.discover.candidate_tests import Search, addable, choose, has_compliance, named_tests, sampled, variants
from pincal.discover.decisions import Decision, each_heading_once, is_own_curve
from pincal.discover.history import History, State, Step
from pincal.discover.moment_frames import best_frame, fit_cost, in_frame, is_brought, likeliest_frame
from pincal.discover.nuisance import score_test_beside_masses, situation_of
from pincal.discover.policy import POLICY, Policy
from pincal.discover.resolution import curves_over, refined, resolved
from pincal.identify.calibrate import refit
from pincal.identify.fit import Fit, without
from pincal.identify.moment_frames import FRAME_BETTER
from pincal.model.catalogue.candidates import elasticity
from pincal.model.chain import MomentFrame
from pincal.model.effect import Curve, Effect, Family, Settling

log = logging.getLogger(__name__)

# Times that an effect with a time constant is linearised anew: each step is Newton's.
_MOST_EXPANSIONS = 8


def discover_effects(
    fit: Fit,
    groups: np.ndarray,
    *,
    frames: Sequence[MomentFrame] = (),
    extra: Sequence[Effect] = (),
    policy: Policy = POLICY,
    nameless: Collection[object] | None = None,
) -> History:
    """Find the effects that a fit misses.

    Args:
        fit: the model to start from, usually the geometric one.
        groups: shape (N,), blocks of training rows for cross-validation.
        frames: conventions of where moments bend the arm to choose from; default: that of the fit. The first stays unless
            another fits better beyond chance.
        extra: effects of the user's own, which take part like those of the catalogue.
        policy: thresholds and limits.
        nameless: identities of the dependences without a name that take part; default: all.
    """
    few, rows = sampled(fit, policy)
    search = Search(policy, tuple(extra), fit, groups, groups[rows], tuple(frames), nameless)
    state = State(few)
    for step_on in PASSES:
        state = step_on(state, search)
    last = named_tests(state.fit, search.extra, policy)
    return History(in_frame(fit, state.fit.problem.chain.moment_frame), state.steps, state.fit, last)


def start_in_likeliest_frame(state: State, search: Search) -> State:
    """Take the convention of moments in which elasticity explains most."""
    return State(in_frame(state.fit, likeliest_frame(state.fit, search.frames))) if len(search.frames) > 1 else state


def compare_frames(state: State, search: Search) -> State:
    """Go on in the convention of moments that fits what was found best, unless this one explains the data as well then."""
    rough = len(state.fit.problem) < len(search.first.problem)
    frame = best_frame(state, search.frames, search.policy, rough=rough)
    if frame == state.fit.problem.chain.moment_frame:
        return state
    log.info("once more with --moment-frame %s", frame)
    told = State(in_frame(sampled(search.first, search.policy)[0], frame))
    for step in state.steps:
        if not is_brought(step):
            start = {effect: state.fit.values[state.fit.problem.places_at(effect)] for effect in step.effects}
            after = refit(told.fit, [*told.fit.options.effects, *step.effects], start=start)
            told = State(after, (*told.steps, replace(step, before=told.fit, after=after)))
    return min(state, add_effects(told, search), key=lambda found: _cost(found, search))


def _cost(state: State, search: Search) -> float:
    """Return the extended Bayesian information criterion of all that was found, and what another convention has to gain."""
    named = sum(not step.is_elastic for step in state.steps)
    is_other = state.fit.problem.chain.moment_frame != search.frames[0]
    choices = max(len(addable(state.fit, search)), 2)
    return fit_cost(state.fit) + 2.0 * named * float(np.log(choices)) + FRAME_BETTER * is_other


def add_effects(state: State, search: Search) -> State:
    """Add what explains most of what is left, until that is no more than chance."""
    for _ in range(search.policy.most_steps):
        step = _next_step(state.fit, search)
        if step is None:
            break
        residuals = (1e3 * float(fit.solution.estimated[0]) for fit in (step.before, step.after))
        log.info("found %s: residual %.4f -> %.4f mm", _listed(step.effects), *residuals)
        state = State(step.after, (*state.steps, step))
    return state


def _next_step(fit: Fit, search: Search) -> Step | None:
    if not has_compliance(fit.problem.effects):
        block = elasticity(situation_of(fit))
        found = score_test_beside_masses(fit, block)
        if found.p_value_of_any(range(len(block))) < search.policy.elastic:
            after = refit(fit, [*fit.options.effects, *block])
            return Step(tuple(block), found.score(range(len(block)), 1), (), fit, after, block[0], np.zeros(0))
    decision = choose(fit, search)
    return None if decision is None else _decided(fit, decision, search)


def _decided(fit: Fit, decision: Decision, search: Search) -> Step:
    """Return the step that adds what was decided, a curve as fine as the data can tell."""
    tested = decision.effect
    effect = tested
    if isinstance(tested, Curve):
        effect, start, estimate = resolved(fit, tested, search.groups)
    else:
        start = estimate = score_test_beside_masses(fit, [tested]).estimate([0])
    after = refit(fit, [*fit.options.effects, effect], start={effect: start})
    if isinstance(effect, Settling):
        after, effect = linearised_about_itself(after, effect)
    return Step((effect,), decision.row.score, decision.equivalent, fit, after, tested, estimate)


def linearised_about_itself(fit: Fit, effect: Settling) -> tuple[Fit, Settling]:
    """Return a fit in which an effect stands linearised about its own parameters, and the effect."""
    for _ in range(_MOST_EXPANSIONS):
        values = fit.values[fit.problem.places_at(effect)]
        about = effect.about(values)
        if about == effect:
            break
        others = [other for other in fit.options.effects if other != effect]
        start = np.zeros(len(about.parameters(fit.problem.chain)))
        start[0] = values[0]
        fit, effect = refit(fit, [*others, about], start={about: start}), about
    return fit, effect


def settle(state: State, search: Search) -> State:
    """Linearise each effect with a time constant about its parameters as they are beside all others."""
    for step in state.steps:
        for effect in step.effects:
            if isinstance(effect, Settling):
                fit, about = linearised_about_itself(state.fit, effect)
                steps = tuple(replace(s, effects=(about,)) if s is step else s for s in state.steps)
                state = State(fit, steps)
    return state


def name_again(state: State, search: Search) -> State:
    """Name each effect once more beside all the others, which were not there when it was named."""
    named = [step for step in state.steps if not step.is_elastic]
    for step in named if len(named) > 1 else []:
        (effect,) = step.effects
        rest = without(state.fit, effect)
        decision = choose(rest, search)
        if decision is None:
            continue
        if decision.effect.identity == effect.identity:
            state = state.with_replaced(step, replace(step, equivalent=decision.equivalent))
            continue
        log.info("%s is %s beside what was found later", _listed([effect]), _listed([decision.effect]))
        new = replace(_decided(rest, decision, search), before=step.before)
        state = replace(state.with_replaced(step, new), fit=new.after)
    return state


def drop_needless(state: State, search: Search) -> State:
    """Take out again what later effects have made needless: suspected by Wald's test, judged by the score test."""
    policy = search.policy
    for step in state.steps:
        if len(state.steps) == 1 or _is_sure(state.fit, step, policy):
            continue
        smaller = state.fit
        for effect in step.effects:
            smaller = without(smaller, effect)
        tested = score_test_beside_masses(smaller, step.effects)
        limit = policy.elastic if step.is_elastic else policy.drop * policy.false_name
        if tested.p_value_of_any(range(len(step.effects))) > limit:
            log.info("dropped %s: what was found later explains it", _listed(step.effects))
            state = replace(state.without_step(step), fit=refit(state.fit, smaller.options.effects))
    return state


def _is_sure(fit: Fit, step: Step, policy: Policy) -> bool:
    """Return whether the parameters of a step are far from zero together."""
    found = fit.estimate.take(fit.names_of(step.effects))
    values = found.values[found.free]
    wald = values @ np.linalg.pinv(found.covariance.dense(), hermitian=True) @ values
    return bool(wald > policy.sure * len(values))


def fit_all_rows(state: State, search: Search) -> State:
    """Fit all rows of the first fit, and every curve that was found as fine as they and all the others let it be."""
    fit, first = state.fit, search.first
    is_thinned = len(fit.problem) < len(first.problem)
    if is_thinned:
        solution = replace(fit.solution, weights=first.solution.weights)
        pairs = zip(first.problem.stations, fit.problem.stations, strict=True)
        rows = replace(first.problem, stations=tuple(whole.with_model(part.model) for whole, part in pairs))
        whole = replace(fit, problem=rows, solution=solution)
        wider = {curve: curves_over(whole, curve, [curve.resolution])[0] for curve in _curves_of(state)}
        fit = refit(whole, _exchanged(fit.options.effects, wider), rough=True)
        state = _with_curves(state, wider, fit)
    chosen = {curve: refined(without(fit, curve), curve, search.all_groups) for curve in _curves_of(state)}
    finer = {curve: other for curve, (other, _) in chosen.items() if other != curve}
    if finer:
        names = (f"{c.locus.joint} {c.resolution} to {other.resolution}" for c, other in finer.items())
        log.info("resolved again: %s", ", ".join(names))
    elif not is_thinned:
        return state
    start: dict[Effect, np.ndarray] = {finer[curve]: heights for curve, (_, heights) in chosen.items() if curve in finer}
    return _with_curves(state, finer, refit(fit, _exchanged(fit.options.effects, finer), start=start))


def _curves_of(state: State) -> list[Curve]:
    """Return the curves that were found; those that the user gave stay as they are."""
    return [effect for step in state.steps for effect in step.effects if isinstance(effect, Curve)]


def _exchanged(effects: Iterable[Effect], by: dict[Curve, Curve]) -> tuple[Effect, ...]:
    return tuple(by.get(effect, effect) if isinstance(effect, Curve) else effect for effect in effects)


def _with_curves(state: State, by: dict[Curve, Curve], fit: Fit) -> State:
    return State(fit, tuple(replace(step, effects=_exchanged(step.effects, by)) for step in state.steps))


def merge_parts(state: State, search: Search) -> State:
    """Take a name and a term without one that follow the same variable in the same place as one effect without a name.

    A name that leaves something of its own variable unexplained where it acts is only the nearest that the catalogue has.
    """
    for rest in [step for step in state.steps if step.effect.is_nameless]:
        part = next((s for s in state.steps if s is not rest and _is_part(s.effect, rest.effect, state.fit)), None)
        if part is None:
            continue
        before, after = sorted((part, rest), key=state.steps.index)
        equivalent = [*rest.equivalent, part.effect, *part.equivalent]
        whole = replace(
            before,
            effects=(rest.effect, *part.effects),
            equivalent=each_heading_once(equivalent, rest.effect, search.policy),
            after=after.after,
        )
        state = state.with_replaced(before, whole).without_step(after)
    return state


def _is_part(effect: Effect, nameless: Effect, fit: Fit) -> bool:
    """Return whether a name follows the same variable, on the same joint or a neighbour, as a term without a name."""
    at, term, names = effect.locus, nameless.locus, fit.problem.chain.robot.joint_names
    if effect.family is not Family.CAUSE or at.joint is None or term.joint is None or at.follows not in names:
        return False
    apart = abs(names.index(term.joint) - names.index(at.joint))
    return apart <= 1 and term.follows == at.follows


def suggest_whole_curves(state: State, search: Search) -> State:
    """Add, to two simple curves of one joint's position, that together they may be one irregular one."""
    simple = [step.effect.locus.joint for step in state.steps if is_own_curve(step.effect)]
    several = {joint for joint in simple if simple.count(joint) > 1}
    if not several:
        return state
    # The coarsest of each joint.
    curves = {e.locus.joint: e for e in reversed(list(variants(state.fit))) if isinstance(e, Curve)}
    for step in state.steps:
        joint = step.effect.locus.joint
        if is_own_curve(step.effect) and joint in several and joint in curves:
            equivalent = each_heading_once([curves[joint], *step.equivalent], step.effect, search.policy)
            state = state.with_replaced(step, replace(step, equivalent=equivalent))
    return state


def _listed(effects: Sequence[Effect]) -> str:
    return ", ".join(" ".join(filter(None, effect.heading[:2])) for effect in effects)


# The algorithm.
PASSES: tuple[Callable[[State, Search], State], ...] = (
    start_in_likeliest_frame,
    add_effects,
    compare_frames,
    name_again,
    drop_needless,
    fit_all_rows,
    settle,
    merge_parts,
    suggest_whole_curves,
)
