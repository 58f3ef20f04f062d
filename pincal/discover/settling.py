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
        about, start = about_itself(fit, effect)
        if about == effect:
            break
        others = [other for other in fit.options.effects if other != effect]
        fit, effect = refit(fit, [*others, about], start={about: start}, until=until), about
    return fit, effect


def about_itself(fit: Fit, effect: Settling) -> tuple[Settling, np.ndarray]:
    """Return an effect of a fit linearised about its parameters as they are, and what these are then, shape (K,)."""
    values = fit.values[fit.problem.places_at(effect)]
    about = effect.about(values)
    start = np.zeros(len(about.parameters(fit.problem.chain)))
    start[0] = values[0]
    return about, start


def settle(state: State, search: Search) -> State:
    """Linearise each effect with a time constant about its parameters as they are beside all others.

    All rows of a large table move it little from where the rows that effects are chosen by left it: they are fitted with it
    about where they have it, and that is enough.
    """
    if len(state.fit.problem) > len(search.groups):
        return state
    for step in state.steps:
        for effect in step.effects:
            if isinstance(effect, Settling):
                fit, about = linearised_about_itself(state.fit, effect)
                steps = tuple(replace(s, effects=(about,)) if s is step else s for s in state.steps)
                state = state if about == effect else state.changed(fit, steps, (), ())
    return state
