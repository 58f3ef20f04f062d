"""Effects with a time constant, which are no sums of known functions: linearised about their own parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pincal.discover.candidate_tests import Search
from pincal.discover.history import State
from pincal.identify.calibrate import Until, refit
from pincal.identify.fit import Fit
from pincal.model.effect import Settling

# Times that an effect with a time constant is linearised anew: each step is Newton's.
_MOST_EXPANSIONS = 8


def linearised_about_itself(
    fit: Fit, effect: Settling, *, most: int = _MOST_EXPANSIONS, until: Until = Until.SETTLED
) -> tuple[Fit, Settling]:
    """Return a fit in which an effect stands linearised about its own parameters, and the effect.

    Args:
        fit: the fit.
        effect: the effect.
        most: fits at most.
        until: how far each goes.
    """
    for _ in range(most):
        values = fit.values[fit.problem.places_at(effect)]
        about = effect.about(values)
        if about == effect:
            break
        others = [other for other in fit.options.effects if other != effect]
        start = np.zeros(len(about.parameters(fit.problem.chain)))
        start[0] = values[0]
        fit, effect = refit(fit, [*others, about], start={about: start}, until=until), about
    return fit, effect


def settle(state: State, search: Search) -> State:
    """Linearise each effect with a time constant about its parameters as they are beside all others.

    All rows of a large table move it little from where the rows that effects are chosen by left it: one fit is enough.
    """
    most = 1 if len(state.fit.problem) > len(search.groups) else _MOST_EXPANSIONS
    for step in state.steps:
        for effect in step.effects:
            if isinstance(effect, Settling):
                fit, about = linearised_about_itself(state.fit, effect, most=most)
                steps = tuple(replace(s, effects=(about,)) if s is step else s for s in state.steps)
                state = state if about == effect else state.changed(fit, steps, (), ())
    return state
