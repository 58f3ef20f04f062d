"""The search for effects that a fit lacks: a sequence of passes, each from one state to
the next.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TypedDict, Unpack

import numpy as np

from pincal.discover.backward import drop_unneeded, judge_remainders, merge_parts, name_again
from pincal.discover.candidate_tests import (
    NamelessKind,
    Search,
    addable,
    has_compliance,
    is_small_table,
    sampled,
    table_of,
    variants,
)
from pincal.discover.decisions import Decision, Row, accepted, each_heading_once
from pincal.discover.elastic import elastic_way, likeliest_fit
from pincal.discover.ending import fit_all_rows, name_lines
from pincal.discover.levers import missing_compliances
from pincal.discover.noise_numbers import NOISE
from pincal.discover.policy import POLICY, Policy
from pincal.discover.score_numbers import TESTING
from pincal.discover.score_tests import score_test, score_test_given_nuisances
from pincal.discover.steps import (
    History,
    SearchState,
    SearchStep,
    add_effects,
    add_hidden_waves,
    add_prior_elasticity,
    elastic_step,
    listed,
    refine_time_constants,
    reject_outliers_again,
)
from pincal.discover.sure_names import add_sure_names
from pincal.identify.calibrate import Tolerance, refit, reweighted_by_order
from pincal.identify.choices import deviance
from pincal.identify.criteria import CRITERIA
from pincal.identify.dependence import is_dependent, serial_noise, with_serial
from pincal.identify.fit import ModelFit
from pincal.identify.station import Station
from pincal.identify.whitening import Serial
from pincal.model.chain import MomentFrame
from pincal.model.effect import Effect
from pincal.validate.midway import change_in

log = logging.getLogger(__name__)
# Places where effects of loads resemble a bearing that is compliant in another moment frame.
_LIKE_A_BEARING = ("base", "link")
# Variables that change with the session, and most where it was interrupted.
_OF_SESSION = ("time", "temperature")


class OfWhole(TypedDict, total=False):
    """What a search on a part of the rows is given of that on all."""

    nameless: Collection[NamelessKind] | None
    expected: Sequence[Effect] | None


def discover_effects(
    fit: ModelFit,
    groups: np.ndarray,
    *,
    frames: Sequence[MomentFrame] = (),
    extra: Sequence[Effect] = (),
    policy: Policy = POLICY,
    when_named: Callable[[History], None] | None = None,
    **of_whole: Unpack[OfWhole],
) -> History:
    """Find the effects that a fit lacks.

    Args:
        fit: the model to start from, usually the geometric one.
        groups: shape (N,), blocks of training rows for cross-validation.
        frames: moment frames to choose from; default: that of the fit. The first is kept unless
            another fits significantly better.
        extra: effects of the user, candidates like those of the catalogue.
        policy: thresholds and limits.
        when_named: told what a sample of a table's rows has named before all rows are fitted with
            that, unless its residuals let expect that it is searched again with weighted rows; and
            what a search with weighted rows has named.

    Keyword Args:
        nameless: kinds of the unnamed dependences that are candidates (``nameless_kind``); default:
            all.
        expected: effects of a search on more rows, of which these are a part: they enter together
            where each is beyond doubt given all the others, and fits are as close as names need.
    """
    fit = _with_rows_independent(fit)
    _, rows = sampled(fit, policy)
    expected = of_whole.get("expected")
    given = tuple(extra), fit, groups[rows], tuple(frames), of_whole.get("nameless")
    search = Search(policy, *given, None if expected is None else tuple(expected))
    state = _named(search)
    is_sample = len(state.fit.problem) < len(fit.problem)
    # Where all rows are searched, only their last fit shows whether they have to be weighted.
    if when_named and is_sample and not (fit.options.serial and is_dependent(state.fit)):
        when_named(_history(state, search))
    found = _ended(state, search)
    noise = _noise_of_order(found, policy) if fit.options.serial else None
    if noise is None:
        return found
    search = replace(search, first=refit(with_serial(fit, noise), fit.options.effects, start={}))
    of_few = tuple(station.serial for station in sampled(search.first, policy)[0].problem.stations)
    if _are_apart(of_few):
        log.info("the residuals depend on the order of the rows: fitting all with weighted rows")
        state = state.fitted_again(with_serial(state.fit, of_few))
    else:
        log.info("the residuals depend on the order of the rows: repeating with weighted rows")
        state = _named(search)
        if when_named:
            when_named(_history(state, search))
    found = _ended(state, search)
    return found.fitted_again(reweighted_by_order(found.final, Tolerance.TOLD))


def _with_rows_independent(fit: ModelFit) -> ModelFit:
    """Return a fit without the correlation along the rows, which may be due to the effects searched
    for.
    """
    stations = fit.problem.stations
    if not fit.options.serial or all(station.serial is None for station in stations):
        return fit
    return refit(with_serial(fit, (None,) * len(stations)), fit.options.effects, start={})


def _named(search: Search) -> SearchState:
    """Return the state in which a sample of the rows has named all that it shows."""
    few, _ = sampled(search.first, search.policy)
    # A copy, whose tests of the latest fit are large and of no use to what follows.
    return _after(_NAMING, SearchState(few), replace(search))


def _ended(state: SearchState, search: Search) -> History:
    """Return the history in which all rows are fitted with what was named."""
    return _history(_after(_ENDING, state, search), search)


def _history(state: SearchState, search: Search) -> History:
    """Return a state as a history, with its start."""
    first = in_frame(search.first, state.fit.problem.chain.moment_frame)
    return History(
        state.fit,
        state.steps,
        state.changes,
        first=first,
        extra=search.extra,
        policy=search.policy,
    )


def _after(
    passes: Sequence[Callable[[SearchState, Search], SearchState]],
    state: SearchState,
    search: Search,
) -> SearchState:
    """Return the state after some passes."""
    for step_on in passes:
        state = step_on(state, search)
    return state


def _are_apart(noise: Sequence[Serial | None]) -> bool:
    """Return whether the rows of a sample are so far apart in the order that this noise of all rows
    is independent from one to the next.

    The same names come out of them then, however they are weighted.
    """
    return all(of is None or of.inflation < NOISE.apart for of in noise)


def _noise_of_order(found: History, policy: Policy) -> tuple[Serial | None, ...] | None:
    """Return the noise correlated along the rows by which a search has to be repeated; None if it
    need not be.

    Where residuals depend on the order of the rows, names may be artefacts of it. The correlation
    is estimated with all that was found, or else without, as a missing effect may resemble it.
    """
    final = found.final
    named = [step for step in found.steps if not step.is_elastic]
    along = [step.effect for step in named if _follows_the_order(step.effect, final)]
    if not along and not is_dependent(final):
        return None
    identities = {effect.identity for step in named for effect in step.effects}
    others = [e for e in final.options.effects if e.identity not in identities]
    plain = refit(final, others, until=Tolerance.CLOSE)
    noise = next((of for of in map(serial_noise, (final, plain)) if any(of)), None)
    if noise is None or is_dependent(final):
        return noise
    return noise if _may_be_order(along, with_serial(plain, noise), policy) else None


IsShifted = Callable[[ModelFit], bool]
"""Tells from single visits of poses whether something changed between them, which the means of
poses do not show.
"""


def withdraw_names_at_change(found: History, is_shifted: IsShifted) -> History:
    """Withdraw all names if something changed midway in a table, which can be mistaken for effects
    of the robot.

    A model that describes neither half leaves residuals that some name always fits partly.
    Elasticity is kept. An effect of a variable that changes most between two rows, as time does
    between two sessions, describes both halves; it is withdrawn if a step there explains the rows
    as well.
    """
    names = [step for step in found.steps if not step.is_elastic]
    if not names:
        return found
    if not _is_changed_midway(found.final) and not is_shifted(found.final):
        return _withdraw_steps_in_time(found, names, is_shifted)
    return _without(found, names, is_shifted)


def _withdraw_steps_in_time(
    found: History, names: Sequence[SearchStep], is_shifted: IsShifted
) -> History:
    """Withdraw all names if a step midway explains what those do that follow a variable of the
    session.

    The others are kept if the step is not seen without them.
    """
    # A sample of the rows tells whether there is anything to judge by all.
    few, _ = sampled(found.final, found.policy)
    for variable in _OF_SESSION:
        following = [step for step in names if step.effect.locus.follows == variable]
        if not following:
            continue
        gone = {effect.identity for step in following for effect in step.effects}
        kept = [effect for effect in few.options.effects if effect.identity not in gone]
        if _is_changed_midway(refit(few, kept, start={}, until=Tolerance.TOLD), variable):
            withdrawn = _without(found, names, is_shifted)
            return _without(found, following, is_shifted) if withdrawn is found else withdrawn
    return found


def _without(found: History, names: Sequence[SearchStep], is_shifted: IsShifted) -> History:
    """Return the history in which names were withdrawn at the end; as it is if no change is seen
    without them.
    """
    effects = tuple(effect for step in names for effect in step.effects)
    gone = {effect.identity for effect in effects}
    fit = refit(
        found.final, [e for e in found.final.options.effects if e.identity not in gone], start={}
    )
    if not _is_changed_midway(fit) and not is_shifted(fit):
        return found
    log.info("withdrawn because of a change during the session: %s", listed(effects))
    steps = tuple(step for step in found.steps if step not in names)
    return found.changed(fit, steps, (), effects)


def _is_changed_midway(fit: ModelFit, variable: str | None = None) -> bool:
    """Return whether something changed between two rows of a station, rather than in proportion to
    a variable if given.
    """
    for station, places, _ in fit.stations:
        along = None if variable is None else station.conditions.column(variable)
        if change_in(
            station, fit.values[places], fit.solution.free[places], _order(station), along=along
        ):
            return True
    return False


def _order(station: Station) -> np.ndarray:
    return np.arange(len(station)) if station.position is None else station.position


def _follows_the_order(effect: Effect, fit: ModelFit) -> bool:
    """Return whether an effect depends on a joint that moved by small steps along the rows of a
    station.
    """
    names = fit.problem.chain.robot.joint_names
    if effect.locus.follows not in names:
        return False
    j = names.index(effect.locus.follows)
    for station in fit.problem.stations:
        if station.position is not None and len(station) > 1:
            q = station.conditions.q[np.argsort(station.position, kind="stable"), j]
            if np.mean(np.diff(q) ** 2) < TESTING.order * 2.0 * np.var(q):
                return True
    return False


def _may_be_order(effects: Sequence[Effect], weighed: ModelFit, policy: Policy) -> bool:
    """Return whether correlated noise explains some of the effects, none of which is in the fit.

    Where a joint moves along the rows, an effect of that joint and drift differ only in rows that
    are close in the joint and far apart in the order.
    """
    fit = refit(weighed, weighed.options.effects, start={}, until=Tolerance.CLOSE)
    few, _ = sampled(fit, policy)
    tests = score_test_given_nuisances(few, effects)
    scores = (tests.score([i], 1) for i in range(len(effects)))
    rows = (
        Row(effect, score, score.ebic, question="stay")
        for effect, score in zip(effects, scores, strict=True)
    )
    return not all(accepted(row, policy) for row in rows)


def start_in_likeliest_frame(state: SearchState, search: Search) -> SearchState:
    """Choose the moment frame in which elasticity explains most."""
    if len(search.frames) < 2:
        return state
    ways = elastic_ways(state.fit, search.frames, search.policy)
    single = single_compliance(ways, search.frames, search.policy)
    if single is not None:
        fit = in_frame(state.fit, single[0])
        return SearchState(fit).with_step(elastic_step(fit, single[1]))
    every = missing_compliances(state.fit)
    whole = likeliest_fit(state.fit, every, search.frames)
    frame = whole.problem.chain.moment_frame
    fit = in_frame(state.fit, frame)
    way = ways.get(frame)
    if way is None:
        return SearchState(fit)
    if way.effects != every:
        return SearchState(fit).with_step(elastic_step(fit, way))
    # The very objects of the fit, by which a problem finds their parameters.
    return SearchState(fit).with_step(elastic_step(fit, replace(way, effects=every), whole))


def compare_frames(state: SearchState, search: Search) -> SearchState:
    """Continue in the moment frame that fits best with the effects found, unless the present one
    then explains as much.
    """
    frame = best_frame(state, search)
    if frame == state.fit.problem.chain.moment_frame:
        return state
    log.info("repeating with --moment-frame %s", frame)
    other = SearchState(in_frame(sampled(search.first, search.policy)[0], frame))
    for step in state.steps:
        if not is_brought(step):
            start = {
                effect: state.fit.values[state.fit.problem.places_at(effect)]
                for effect in step.effects
            }
            after = refit(
                other.fit,
                [*other.fit.options.effects, *step.effects],
                start=start,
                until=Tolerance.CLOSE,
            )
            other = other.with_step(replace(step, before=other.fit, after=after))
    return min(state, add_effects(other, search), key=lambda found: _cost(found, search))


def _cost(state: SearchState, search: Search) -> float:
    """Return the extended Bayesian information criterion of a state, with the surcharge of another
    moment frame.
    """
    named = sum(not step.is_elastic for step in state.steps)
    is_other = state.fit.problem.chain.moment_frame != search.frames[0]
    choices = max(len(addable(state.fit, search)), 2)
    return (
        fit_cost(state.fit)
        + 2.0 * named * float(np.log(choices))
        + CRITERIA.moment_frame * is_other
    )


def in_frame(fit: ModelFit, frame: MomentFrame) -> ModelFit:
    """Return a fit in another moment frame, refitted if it uses moments."""
    effects = fit.options.effects
    if frame == fit.problem.chain.moment_frame:
        return fit
    if any(effect.uses_moments for effect in effects):
        return refit(fit, effects, moment_frame=frame)
    return fit.with_effects(effects, moment_frame=frame)


def elastic_ways(
    fit: ModelFit, frames: Sequence[MomentFrame], policy: Policy
) -> dict[MomentFrame, Decision]:
    """Return the compliances of an arm by moment frame, where significant; empty if the fit has
    elasticity.
    """
    if has_compliance(fit.options.effects):
        return {}
    return {frame: way for frame in frames if (way := elastic_way(in_frame(fit, frame), policy))}


def single_compliance(
    ways: Mapping[MomentFrame, Decision], frames: Sequence[MomentFrame], policy: Policy
) -> tuple[MomentFrame, Decision] | None:
    """Return the moment frame in which a single drive or bearing is compliant, and that; None
    otherwise.

    Among all parameters of an arm, its moment frame would not be significant. The first frame is
    kept unless another is significantly better. What explains as much in another frame is
    equivalent.
    """
    if not ways:
        return None
    costs = {frame: way.row.cost for frame, way in ways.items()}
    least = min(costs, key=lambda frame: costs[frame])
    frame = (
        frames[0] if costs.get(frames[0], np.inf) < costs[least] + CRITERIA.moment_frame else least
    )
    if not ways[frame].is_single:
        return None
    close = [
        way
        for other, way in ways.items()
        if way.is_single and costs[other] < costs[frame] + policy.tie
    ]
    every = (
        *ways[frame].equivalent,
        *(effect for way in close for effect in (*way.effects, *way.equivalent)),
    )
    return frame, replace(
        ways[frame], equivalent=each_heading_once(every, ways[frame].effects[0], policy)
    )


def best_frame(state: SearchState, search: Search) -> MomentFrame:
    """Return the moment frame in which to continue the search: that of the fit unless another is
    better.

    Another frame has to fit the effects found better, or as well without artefacts of a wrong
    frame, or with an effect of loads that a wrong frame mistakes for a compliance, as a tilting
    base resembles a tilting bearing. Where only elasticity was found, the improvement has to be as
    large as that of an effect.
    """
    frames = search.frames
    policy = search.policy
    fit = state.fit
    effects = state.fit.options.effects
    here = state.fit.problem.chain.moment_frame
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
        other = refit(fit, effects, moment_frame=frame, until=Tolerance.CLOSE)
        costs[frame] = fit_cost(other) + enough + _still_to_gain(other, search)
        if brought:
            costs[frame] = min(
                costs[frame], fit_cost(refit(fit, plain, moment_frame=frame, until=Tolerance.CLOSE))
            )
    best = min(others, key=lambda frame: costs[frame])
    return best if costs[best] < cost else here


def _still_to_gain(fit: ModelFit, search: Search) -> float:
    """Return the change of the information criterion by the best effect of loads on base or links;
    0 if not accepted.

    Not on few rows, where it may substitute for bearings that the model lacks.
    """
    if is_small_table(fit, search.policy):
        return 0.0
    # Other motions of base or links, as with time, are the same in every moment frame.
    others = (
        effect for effect in variants(fit, _LIKE_A_BEARING) if effect not in fit.problem.effects
    )
    effects = [effect for effect in others if effect.is_of_loads]
    if not effects:
        return 0.0
    table = table_of(fit, search, partial(score_test, fit), effects, among=len(effects))
    return next(
        (table.rows[i].cost for i in table.cheapest() if accepted(table.rows[i], search.policy)),
        0.0,
    )


def is_brought(step: SearchStep) -> bool:
    """Return whether a step may be an artefact of a wrong moment frame: an effect of loads, or an
    unnamed one.
    """
    return any(effect.is_of_loads or effect.is_nameless for effect in step.effects)


def fit_cost(fit: ModelFit) -> float:
    """Return the Bayesian information criterion of a fit."""
    readings = sum(len(s) * s.reading_size for s in fit.problem.stations)
    return deviance(fit) + fit.solution.effective * float(np.log(readings))


# The algorithm: what is missing is named on a sample of the rows, and in the end all are fitted.
_NAMING: tuple[Callable[[SearchState, Search], SearchState], ...] = (
    start_in_likeliest_frame,
    add_sure_names,
    add_effects,
    compare_frames,
    name_again,
    drop_unneeded,
    judge_remainders,
    add_prior_elasticity,
)
_ENDING: tuple[Callable[[SearchState, Search], SearchState], ...] = (
    fit_all_rows,
    refine_time_constants,
    merge_parts,
    add_hidden_waves,
    reject_outliers_again,
    name_lines,
)
