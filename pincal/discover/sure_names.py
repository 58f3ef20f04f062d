"""Expected names that are beyond doubt enter a search together.

A search on half of the poses finds again, one by one, the strong names that all poses showed. In
which order these enter makes no difference: each explains much of what all the others leave. One
pass over the rows and one fit serve them all. What is weaker is searched for as ever, and in the
end each name is named again given all the others, and removed where it does not predict.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pincal.discover.candidate_tests import Search, has_compliance, is_small_table
from pincal.discover.drive_curves import resolved, smoothed
from pincal.discover.elastic import elastic_way
from pincal.discover.first_order import ScoreResult, ScoreTests, chance_of
from pincal.discover.levers import missing_from, situation_of
from pincal.discover.policy import Policy
from pincal.discover.score_numbers import TESTING
from pincal.discover.score_tests import GivenNuisances
from pincal.discover.steps import SearchState, SearchStep, elastic_step, listed, settled
from pincal.identify.beliefs import priors_of
from pincal.identify.calibrate import Tolerance, refit
from pincal.identify.fit import Ending, ModelFit
from pincal.model.catalogue.candidates import why_not_testable
from pincal.model.effect import Candidate, Curve, Effect
from pincal.thresholds import Scale

# What others leave is taken to be at least this part of all squares: less is rounding.
_LEAST_LEFT: Scale = 1e-6

log = logging.getLogger(__name__)


def add_sure_names(state: SearchState, search: Search) -> SearchState:
    """Add the expected names of which each is beyond doubt given all the others.

    On a small table priors decide, and none is beyond doubt.
    """
    expected = missing_from(state.fit, search.expected or ())
    if len(expected) < 2 or is_small_table(state.fit, search.policy):
        return state
    state = _with_elasticity(state, search)
    fit = state.fit
    expected = _over_these_poses(fit, expected)
    if len(expected) < 2:
        return state
    tests = search.tests_of(fit)(expected)
    scores = _sure(tests, search.policy)
    # A single name has no others given which it would be named again.
    if len(scores) < 2:
        return state
    forms = dict[int, Effect]()
    begun = fit
    # What explains most first, as in a search, by which their resolutions are alike.
    for i in sorted(scores, key=lambda i: scores[i].ebic):
        forms[i], begun = _entered(begun, expected[i], search)
    effects = tuple(forms.values())
    after = refit(begun, begun.options.effects, start={}, until=Tolerance.CLOSE)
    log.info("found %s", listed(effects))
    steps = [
        SearchStep((form,), scores[i], (), fit, after, expected[i], tests.estimate([i]))
        for i, form in forms.items()
    ]
    return settled(state.changed(after, (*state.steps, *steps), effects, ()))


def _with_elasticity(state: SearchState, search: Search) -> SearchState:
    """Return the state with the elasticity that the rows show, which enters before any name."""
    if has_compliance(search.first.problem.effects):
        return state
    way = elastic_way(state.fit, search.policy, search.tests_of(state.fit))
    return state if way is None else settled(state.with_step(elastic_step(state.fit, way)))


def _over_these_poses(fit: ModelFit, effects: Sequence[Effect]) -> list[Effect]:
    """Return the effects that the poses of a fit can show, of which curves are over their range."""
    situation = situation_of(fit)
    has_loads = has_compliance(fit.problem.effects)
    some = [effect for effect in effects if has_loads or not effect.is_of_loads]
    shown = [effect for effect in some if not why_not_testable(Candidate(effect), situation)]
    return [
        effect.resized(situation, effect.resolution) if isinstance(effect, Curve) else effect
        for effect in shown
    ]


def _entered(fit: ModelFit, effect: Effect, search: Search) -> tuple[Effect, ModelFit]:
    """Return an effect in the resolution that the rows determine, and the fit with it, to first
    order.
    """
    form: Effect
    if isinstance(effect, Curve) and fit.solution.exit is not Ending.EXACT:
        chosen, fit = smoothed(fit, [effect])
        form, values = chosen[effect]
    else:
        form, values, _ = resolved(GivenNuisances(fit, search.groups), effect, search.groups)
    begun = fit.with_effects([*fit.options.effects, form])
    at = begun.problem.places_at(form)
    begun.values[at] = values
    begun.solution.free[at] = True
    return form, replace(begun, priors=priors_of(begun.problem, begun.options))


def _sure(tests: ScoreTests, policy: Policy) -> dict[int, ScoreResult]:
    """Return the effects of which each is beyond doubt given all the others, by index, with their
    tests given these.
    """
    limit = TESTING.beyond_doubt * policy.false_name
    sure = list(range(len(tests.effects)))
    while sure:
        found = _given_each_other(tests, sure)
        weakest = min(sure, key=lambda i: found[i].share)
        chances = [one.score.p_value for one in found.values()]
        if found[weakest].share > TESTING.much and max(chances) < limit:
            return {i: one.score for i, one in found.items()}
        sure.remove(weakest)
    return {}


class _GivenOthers(NamedTuple):
    """The test of a candidate given others, and the part that it explains of the squares that these
    leave.
    """

    score: ScoreResult
    share: float


def _given_each_other(tests: ScoreTests, which: Sequence[int]) -> dict[int, _GivenOthers]:
    """Return the test of each of some candidates given the others, by index, all from one estimate
    of their parameters (Wald).
    """
    tests = tests.likeliest(which)
    _, S, b = tests.within(which)
    covariance = np.linalg.inv(S + tests.prior(which))
    x = covariance @ b
    left = max(tests.squares - float(b @ x), _LEAST_LEFT * tests.squares)
    found = {}
    ends = np.cumsum([len(tests.columns[i]) for i in which])
    for i, end in zip(which, ends.tolist(), strict=True):
        rank = len(tests.columns[i])
        at = slice(end - rank, end)
        gain = float(x[at] @ np.linalg.solve(covariance[at, at], x[at]))
        chance = chance_of(gain, rank, left + gain, tests.dof - (len(b) - rank))
        share = gain / (left + gain)
        cost = tests.readings * float(np.log1p(-share)) + rank * float(np.log(tests.readings))
        p_value = min(tests.effects[i].trials * float(chance), 1.0)
        found[i] = _GivenOthers(ScoreResult(gain, rank, p_value, cost), share)
    return found
