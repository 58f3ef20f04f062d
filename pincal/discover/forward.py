"""Forward: add to a model what explains most of what it leaves, until that is no more than chance."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from pincal.discover.candidate_tests import Search, choose, has_compliance, is_small_table
from pincal.discover.decisions import Decision
from pincal.discover.history import State, Step
from pincal.discover.nuisance import score_test_beside_masses, situation_of
from pincal.discover.policy import Policy
from pincal.discover.resolution import resolved
from pincal.discover.settling import linearised_about_itself
from pincal.identify.calibrate import refit
from pincal.identify.fit import Fit
from pincal.model.catalogue.candidates import elasticity
from pincal.model.effect import Effect, Settling

log = logging.getLogger(__name__)


def add_effects(state: State, search: Search) -> State:
    """Add what explains most of what is left, until that is no more than chance."""
    for _ in range(search.policy.most_steps):
        step = _next_step(state.fit, search)
        if step is None:
            break
        residuals = (1e3 * float(fit.solution.estimated[0]) for fit in (step.before, step.after))
        log.info("found %s: residual %.4f -> %.4f mm", listed(step.effects), *residuals)
        state = state.with_step(step)
    return state


def _next_step(fit: Fit, search: Search) -> Step | None:
    step = None if has_compliance(fit.problem.effects) else _elastic_step(fit, search.policy)
    if step is not None:
        return step
    decision = choose(fit, search)
    return None if decision is None else decided(fit, decision, search)


def _elastic_step(fit: Fit, policy: Policy) -> Step | None:
    """Return the step that adds elasticity, if it is there.

    On a small table what bends least is enough: drives without bearings, if that is likelier before the data than all.
    """
    block = elasticity(situation_of(fit))
    tests = score_test_beside_masses(fit, block)
    ways: list[Sequence[int]] = [range(len(block))]
    if is_small_table(fit, policy):
        ways += [[i] for i in range(len(block))]
        best = max(ways, key=tests.log_evidence)
        is_there = tests.log_evidence(best) > -np.log(policy.false_name)
    else:
        best = ways[0]
        is_there = tests.p_value_of_any(best) < policy.elastic
    if not is_there:
        return None
    chosen = tuple(block[i] for i in best)
    after = refit(fit, [*fit.options.effects, *chosen])
    return Step(chosen, tests.score(best, 1), (), fit, after, chosen[0], np.zeros(0))


def decided(fit: Fit, decision: Decision, search: Search) -> Step:
    """Return the step that adds what was decided, a curve as fine as the data can tell."""
    tested = decision.effect
    effect, start, estimate = resolved(fit, tested, search.groups)
    after = refit(fit, [*fit.options.effects, effect], start={effect: start})
    if isinstance(effect, Settling):
        after, effect = linearised_about_itself(after, effect)
    return Step((effect,), decision.row.score, decision.equivalent, fit, after, tested, estimate)


def listed(effects: Sequence[Effect]) -> str:
    """Return effects in words, for the log."""
    return ", ".join(" ".join(filter(None, effect.heading[:2])) for effect in effects)
