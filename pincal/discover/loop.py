"""Find the effects that a fit misses: one pass after the other, each from one state to the next."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pincal.discover.backward import drop_needless, name_again
from pincal.discover.candidate_tests import Search, addable, over_rows_of, sampled, variants
from pincal.discover.decisions import each_heading_once, is_own_curve
from pincal.discover.forward import add_effects, add_hidden_waves, bent, hold_up_elasticity, judge_outliers_again
from pincal.discover.history import History, State
from pincal.discover.joint_noise import joint_noise, weighed
from pincal.discover.lines import name_lines
from pincal.discover.moment_frames import (
    best_frame,
    elastic_ways,
    fit_cost,
    in_frame,
    is_brought,
    likeliest_fit,
    single_compliance,
)
from pincal.discover.nuisance import missing_compliances, score_test_beside_nuisances
from pincal.discover.policy import POLICY, Policy
from pincal.discover.remainders import add_remainders, merge_parts, take_whole_curves
from pincal.discover.resolution import curves_over
from pincal.discover.settling import about_itself, settle
from pincal.discover.smoothness import smoothed
from pincal.identify.calibrate import Until, refit
from pincal.identify.dependence import is_dependent, serial_noise, with_serial
from pincal.identify.fit import Fit
from pincal.identify.moment_frames import FRAME_BETTER
from pincal.identify.solve import Exit
from pincal.model.chain import MomentFrame
from pincal.model.effect import Curve, Effect, Settling

log = logging.getLogger(__name__)

# Mean square of a joint's steps from row to row, over that of steps in random order, below which it moved along the rows: a
# path of a few turning points, or sorted poses.
_SMALL_STEPS = 0.1


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

    def searched(first: Fit) -> History:
        few, rows = sampled(first, policy)
        search = Search(policy, tuple(extra), first, groups[rows], tuple(frames), nameless)
        state = State(few)
        for step_on in PASSES:
            state = step_on(state, search)
        first = in_frame(first, state.fit.problem.chain.moment_frame)
        return History(first, state.steps, state.fit, state.changes, search.extra, policy)

    found = searched(fit)
    names = [step.effect for step in found.steps if not step.is_elastic]
    along = [effect for effect in names if _follows_the_order(effect, found.final)]
    if not along and not is_dependent(found.final):
        return found
    # Names that leave what depends on the order of the rows may be made of it: once more, with rows weighed by it. What it
    # is is told by the model without them, or, if they hide it, with them.
    named = {e.identity for step in found.steps if not step.is_elastic for e in step.effects}
    plain = refit(found.final, [e for e in found.final.options.effects if e.identity not in named], until=Until.CLOSE)
    noise = next((of for of in map(serial_noise, (plain, found.final)) if any(of)), None)
    if noise is None or not (is_dependent(found.final) or _may_be_order(along, with_serial(plain, noise), policy)):
        return found
    weighed = with_serial(fit, noise)
    log.info("what is left depends on the order of the rows: once more, rows weighed by it")
    return searched(refit(weighed, fit.options.effects, start={}))


def _follows_the_order(effect: Effect, fit: Fit) -> bool:
    """Return whether an effect follows the positions of a joint that moved by small steps along the rows of a station."""
    names = fit.problem.chain.robot.joint_names
    if effect.locus.follows not in names:
        return False
    j = names.index(effect.locus.follows)
    for station in fit.problem.stations:
        if station.position is not None and len(station) > 1:
            q = station.conditions.q[np.argsort(station.position, kind="stable"), j]
            if np.mean(np.diff(q) ** 2) < _SMALL_STEPS * 2.0 * np.var(q):
                return True
    return False


def _may_be_order(effects: Sequence[Effect], weighed: Fit, policy: Policy) -> bool:
    """Return whether noise along the rows explains any of some effects of which a fit has none.

    Where poses follow each other along a joint, what follows that joint and what drifts are the same but for rows that are
    near in the joint and far apart in the order.
    """
    fit = refit(weighed, weighed.options.effects, start={}, until=Until.CLOSE)
    few, _ = sampled(fit, policy)
    tests = score_test_beside_nuisances(few, effects)
    return any(tests.score([i], 1).p_value > policy.drop * policy.false_name for i in range(len(effects)))


def start_in_likeliest_frame(state: State, search: Search) -> State:
    """Take the convention of moments in which elasticity explains most."""
    if len(search.frames) < 2:
        return state
    ways = elastic_ways(state.fit, search.frames, search.policy)
    single = single_compliance(ways, search.frames, search.policy)
    if single is not None:
        fit = in_frame(state.fit, single[0])
        return State(fit).with_step(bent(fit, single[1]))
    every = missing_compliances(state.fit)
    whole = likeliest_fit(state.fit, every, search.frames)
    frame = whole.problem.chain.moment_frame
    fit, way = in_frame(state.fit, frame), ways.get(frame)
    if way is None:
        return State(fit)
    is_known = way.effects == every
    return State(fit).with_step(bent(fit, replace(way, effects=every), whole) if is_known else bent(fit, way))


def compare_frames(state: State, search: Search) -> State:
    """Go on in the convention of moments that fits what was found best, unless this one explains the data as well then."""
    frame = best_frame(state, search)
    if frame == state.fit.problem.chain.moment_frame:
        return state
    log.info("once more with --moment-frame %s", frame)
    told = State(in_frame(sampled(search.first, search.policy)[0], frame))
    for step in state.steps:
        if not is_brought(step):
            start = {effect: state.fit.values[state.fit.problem.places_at(effect)] for effect in step.effects}
            after = refit(told.fit, [*told.fit.options.effects, *step.effects], start=start, until=Until.CLOSE)
            told = told.with_step(replace(step, before=told.fit, after=after))
    return min(state, add_effects(told, search), key=lambda found: _cost(found, search))


def _cost(state: State, search: Search) -> float:
    """Return the extended Bayesian information criterion of all that was found, and what another convention has to gain."""
    named = sum(not step.is_elastic for step in state.steps)
    is_other = state.fit.problem.chain.moment_frame != search.frames[0]
    choices = max(len(addable(state.fit, search)), 2)
    return fit_cost(state.fit) + 2.0 * named * float(np.log(choices)) + FRAME_BETTER * is_other


def fit_all_rows(state: State, search: Search) -> State:
    """Fit all rows of the first fit, and every curve that was found as fine and as smooth as they say that it is.

    At the end rows are weighed by the noise that is left, which may come by way of the joints. How smooth curves are is told
    before: what is left of them passes for such noise.
    """
    fit, first = state.fit, search.first
    is_thinned, noise = len(fit.problem) < len(first.problem), joint_noise(fit)
    if is_thinned:
        whole = over_rows_of(fit, first)
        wider: dict[Effect, Effect] = {e: curves_over(whole, e, [e.resolution])[0] for e in _curves_of(state)}
        fit = refit(whole, _exchanged(fit.options.effects, wider), until=Until.ROUGH)
        state = _with_others(state, wider, fit)
    curves = _curves_of(state)
    if not curves and not is_thinned and noise is None:
        return state.fitted_again(refit(fit, fit.options.effects, start={})) if state.changes else state
    chosen: dict[Curve, tuple[Curve, np.ndarray]] = {}
    if curves and fit.solution.exit is not Exit.EXACT:
        chosen, fit = smoothed(fit, curves)
    for curve, (finer, _) in chosen.items():
        log.info("%s: %d pieces, smooth %d", curve.locus.joint, curve.resolution, finer.resolution)
    settling = [e for step in state.steps for e in step.effects if isinstance(e, Settling)] if is_thinned else []
    by, start = dict[Effect, Effect](), dict[Effect, np.ndarray]()
    for effect, (other, values) in (*chosen.items(), *((e, about_itself(fit, e)) for e in settling)):
        by[effect], start[other] = other, values
    effects = _exchanged(fit.options.effects, by)
    fit = fit if noise is None else weighed(fit, noise)
    state = _with_others(state, by, refit(fit, effects, start=start))
    return state.changed(state.fit, state.steps, (), ())


def _curves_of(state: State) -> list[Curve]:
    """Return the curves that were found; those that the user gave stay as they are."""
    return [effect for step in state.steps for effect in step.effects if isinstance(effect, Curve)]


def _exchanged(effects: Iterable[Effect], by: Mapping[Effect, Effect]) -> tuple[Effect, ...]:
    return tuple(by.get(effect, effect) if isinstance(effect, Curve | Settling) else effect for effect in effects)


def _with_others(state: State, by: Mapping[Effect, Effect], fit: Fit) -> State:
    steps = tuple(replace(step, effects=_exchanged(step.effects, by)) for step in state.steps)
    return replace(state, fit=fit, steps=steps)


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


# The algorithm.
PASSES: tuple[Callable[[State, Search], State], ...] = (
    start_in_likeliest_frame,
    add_effects,
    compare_frames,
    name_again,
    drop_needless,
    take_whole_curves,
    add_remainders,
    hold_up_elasticity,
    settle,
    fit_all_rows,
    settle,
    merge_parts,
    suggest_whole_curves,
    add_hidden_waves,
    judge_outliers_again,
    name_lines,
)
