"""What the data say of bearings beyond the drawing: directions in which they give way, and their places on the axes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pincal.identify.beliefs import priors_of
from pincal.identify.equations import Linearised
from pincal.identify.exact import rounding
from pincal.identify.fit import Fit, carried
from pincal.model.catalogue.bearings import bearing_features
from pincal.model.effect import Effect

# What a feature has to take off the squares: odds of 150 to 1. Of a sound arm's twelve one enters in one fit out of fifty.
_ENOUGH = 10.0


class Called(NamedTuple):
    """Features of bearings that data call for, and what they take off the sum of squares, to first order."""

    effects: tuple[Effect, ...]
    gain: float


def called_for(fit: Fit, least: float = 0.0) -> Called:
    """Return the features of bearings that a fit does not have and that the data call for.

    A bearing sits where the URDF has the joint, and its stiff and soft directions are the axes of its frame, unless the data
    say otherwise. A place beside a compliance that hardly shows makes a ridge along which a fit wanders, and every parameter
    that is not needed is paid for in accuracy. So they enter one by one, each by what it takes off the squares to first
    order beside those before it.

    Args:
        fit: the fit.
        least: what they have to take off the squares together; if they can't, none is called for.
    """
    effects = fit.options.effects
    asked = [e for e in bearing_features(fit.problem.chain, effects) if e not in effects]
    if not asked:
        return Called((), 0.0)
    problem = fit.problem.with_effects((*effects, *asked))
    near, sizes = carried(fit.solution, fit.problem, problem), priors_of(problem, fit.options).sizes
    places = {effect: int(problem.places_at(effect)[0]) for effect in asked}
    free = near.free.copy()
    free[list(places.values())] = True
    sigma = np.maximum(near.sigma, rounding(problem))
    wide = Linearised(problem, near.values, free, near.weights, sizes).equations(sigma)

    def gain(*named: Effect) -> float:
        kept = near.free.copy()
        kept[list(places.values())] = False
        kept[[places[effect] for effect in named]] = True
        return wide.of(kept[free]).gain

    found, settled, most = tuple[Effect, ...](), gain(), gain(*asked)
    if most - settled <= least:
        return Called((), 0.0)
    reached = settled
    while len(found) < len(asked) and most > reached + _ENOUGH:
        gains = {effect: gain(*found, effect) for effect in asked if effect not in found}
        best = max(gains, key=lambda effect: gains[effect])
        if gains[best] < reached + _ENOUGH:
            break
        found, reached = (*found, best), gains[best]
    return Called(found, reached - settled)
