"""Forward: add to a model what explains most of what it leaves, until that is no more than chance."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pincal.discover.candidate_tests import Search, choose, has_compliance, hidden_wave, is_small_table
from pincal.discover.decisions import Decision
from pincal.discover.elastic_ways import ElasticWay, elastic_way
from pincal.discover.history import State, Step
from pincal.discover.moment_frames import likeliest_fit
from pincal.discover.nuisance import missing_compliances, score_test_beside_nuisances
from pincal.discover.resolution import resolved
from pincal.discover.score_tests import score_test, standard_errors
from pincal.discover.settling import linearised_about_itself
from pincal.identify.bearings import called_for
from pincal.identify.calibrate import Until, refit
from pincal.identify.fit import Fit
from pincal.model.effect import Effect, Settling
from pincal.validate.gathered import gathering_of

# Times that an effect with a time constant is linearised anew before the next one is looked for.
_MOST_WHILE_SEARCHING = 3
# Standard errors that blocks of poses have to lose by what is known beforehand to speak against it.
_AGAINST = 2.0

log = logging.getLogger(__name__)


def add_effects(state: State, search: Search) -> State:
    """Add what explains most of what is left, until that is no more than chance.

    What the data call for of the bearings enters once no name explains more: before, it would take up what drives do.
    """
    for _ in range(search.policy.most_steps):
        state = _trusting_what_gathers(state)
        step = _next_step(state.fit, search)
        least = 0.0 if step is None else step.score.gain
        called = called_for(state.fit, least)
        if features := _that_predict(state.fit, called.effects, search) if called.gain > least else ():
            fit = refit(state.fit, [*state.fit.options.effects, *features], start={}, until=Until.CLOSE)
            log.info("bearings: %s", listed(features))
            state = state.changed(fit, state.steps, features, ())
            continue
        if step is None:
            break
        residuals = (1e3 * float(fit.solution.estimated[0]) for fit in (step.before, step.after))
        log.info("found %s: residual %.4f -> %.4f mm", listed(step.effects), *residuals)
        state = state.with_step(step)
    return state


def _trusting_what_gathers(state: State) -> State:
    """Return the state in which outliers that gather along a joint count: they may be what is looked for."""
    fit, stations = state.fit, []
    for station, rows in zip(fit.problem.stations, fit.problem.rows, strict=True):
        found = gathering_of(station, fit.solution.weights[rows] == 0.0)
        if found is not None and found.variable != "line":
            log.info("%d outliers gather at %s and count from now on", len(found.rows), found.variable)
            trusted = np.zeros(len(station), bool) if station.trusted is None else station.trusted.copy()
            trusted[found.rows] = True
            station = replace(station, trusted=trusted)
        stations.append(station)
    problem = replace(fit.problem, stations=tuple(stations))
    if all(a is b for a, b in zip(problem.stations, fit.problem.stations, strict=True)):
        return state
    return state.fitted_again(refit(replace(fit, problem=problem), fit.options.effects, start={}, until=Until.CLOSE))


def judge_outliers_again(state: State, search: Search) -> State:
    """Leave out again what counted because it gathered, if the model does not describe it in the end."""
    problem = state.fit.problem
    if all(station.trusted is None for station in problem.stations):
        return state
    problem = replace(problem, stations=tuple(replace(station, trusted=None) for station in problem.stations))
    return state.fitted_again(refit(replace(state.fit, problem=problem), state.fit.options.effects, start={}))


def hold_up_elasticity(state: State, search: Search) -> State:
    """Let in, on few rows, the elasticity that has no name, unless blocks of poses left out speak against it.

    Few rows can't show that an arm bends, and every arm does: what is known beforehand of how much predicts better than that
    it does not, and intervals without it would be those of a rigid arm.
    """
    fit = state.fit
    missing = () if has_compliance(search.first.problem.effects) else missing_compliances(fit)
    if not missing or not is_small_table(fit, search.policy):
        return state
    tests = score_test_beside_nuisances(fit, missing, search.groups, wider=1.0)
    if standard_errors(tests.gains_by_block(range(len(missing)))) < -_AGAINST:
        return state
    log.info("few rows: held by what is known beforehand, %s", listed(missing))
    if len(search.frames) > 1:
        after = likeliest_fit(fit, missing, search.frames)
    else:
        after = refit(fit, [*fit.options.effects, *missing], start={}, until=Until.CLOSE)
    return state.changed(after, state.steps, missing, ())


def _that_predict(fit: Fit, features: Sequence[Effect], search: Search) -> tuple[Effect, ...]:
    """Return those of some features of bearings without which blocks of poses left out are predicted worse."""
    if not features:
        return ()
    tests, found, gains = score_test(fit, features, (), search.groups, wider=1.0), list[int](), 0.0
    for i in range(len(features)):
        beside = float(tests.gains_by_block([*found, i]).sum())
        if beside > gains:
            found, gains = [*found, i], beside
    return tuple(features[i] for i in found)


def add_hidden_waves(state: State, search: Search) -> State:
    """Add the waves that show once curves are as fine as the rows tell.

    Of more rows than effects are chosen by, all are fitted once and nothing is added after it.
    """
    is_thinned = len(search.groups) < len(state.fit.problem)
    for _ in range(0 if is_thinned else search.policy.most_steps):
        hidden = hidden_wave(state.fit, search)
        if hidden is None:
            break
        found, start = hidden
        wave = found.effect
        after = refit(state.fit, [*state.fit.options.effects, wave], start={wave: start})
        log.info("found %s behind the curves", listed([wave]))
        state = state.with_step(Step((wave,), found.row.score, found.equivalent, state.fit, after, wave, start))
    return state


def _next_step(fit: Fit, search: Search) -> Step | None:
    # Elasticity that the user gave is not for a discovery to complete.
    way = None if has_compliance(search.first.problem.effects) else elastic_way(fit, search.policy)
    if way is not None:
        return bent(fit, way)
    decision = choose(fit, search)
    return None if decision is None else decided(fit, decision, search)


def bent(fit: Fit, way: ElasticWay, after: Fit | None = None) -> Step:
    """Return the step that adds compliances, to the fit with them if it is known."""
    after = refit(fit, [*fit.options.effects, *way.effects]) if after is None else after
    return Step(way.effects, way.score, way.equivalent, fit, after, way.effects[0], np.zeros(0))


def decided(fit: Fit, decision: Decision, search: Search) -> Step:
    """Return the step that adds what was decided, a curve as fine as the data can tell."""
    tested = decision.effect
    effect, start, estimate = resolved(fit, tested, search.groups)
    after = refit(fit, [*fit.options.effects, effect], start={effect: start}, until=Until.CLOSE)
    if isinstance(effect, Settling):
        # What is left of its time constant is found once nothing else is missing.
        after, effect = linearised_about_itself(after, effect, most=_MOST_WHILE_SEARCHING, until=Until.CLOSE)
    return Step((effect,), decision.row.score, decision.equivalent, fit, after, tested, estimate, decision.together)


def listed(effects: Sequence[Effect]) -> str:
    """Return effects in words, for the log."""
    return ", ".join(" ".join(filter(None, effect.heading[:2])) for effect in effects)
