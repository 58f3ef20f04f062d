"""What the data decide of how an arm bends: directions and places of its bearings, and where moments bend it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pincal.identify.beliefs import priors_of
from pincal.identify.criteria import CRITERIA
from pincal.identify.equations import Linearised
from pincal.identify.exact import rounding
from pincal.identify.fit import ModelFit, carried
from pincal.identify.noise import outlier_limit
from pincal.identify.selection import Scored, select_stepwise
from pincal.model.catalogue.bearing_features import bearing_features
from pincal.model.chain import MomentFrame
from pincal.model.effect import Effect


class Called(NamedTuple):
    """Features of bearings that data call for, and what they take off the sum of squares, to first order."""

    effects: tuple[Effect, ...]
    gain: float


def required_features(fit: ModelFit, least: float = 0.0) -> Called:
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
        return wide.gain(kept[free])

    settled, most = gain(), gain(*asked)
    if most - settled <= least:
        return Called((), 0.0)

    def offers(found: tuple[Effect, ...]) -> Iterator[Scored[Effect]]:
        enough = gain(*found) + CRITERIA.bearing
        # All together gain no less than any of them.
        for effect in (effect for effect in asked if effect not in found and most > enough):
            gained = gain(*found, effect)
            yield Scored(effect, -gained, gained >= enough)

    found = select_stepwise(tuple[Effect, ...](), offers, lambda found, effect: (*found, effect), most=len(asked))
    return Called(found, gain(*found) - settled)


# Rows from which it is chosen: conventions differ by more than these could miss, or by nothing that matters.
_ROWS = 2000


def some_rows_of(fit: ModelFit) -> ModelFit:
    """Return a fit as it is, of as many of its rows, evenly spread, as are enough to choose a convention by."""
    n = len(fit.problem)
    return fit if n <= _ROWS else fit.select(np.linspace(0, n - 1, _ROWS).astype(int))


def best_of(fits: Sequence[ModelFit]) -> MomentFrame:
    """Return the convention of the fit that leaves least; that of the first unless another is better beyond chance.

    Conventions may have more parameters than others, which are counted by Akaike's criterion.
    """
    deviances = [deviance(fit) + 2.0 * fit.solution.effective for fit in fits]
    best = int(np.argmin(deviances))
    return fits[best if deviances[best] < deviances[0] - CRITERIA.moment_frame else 0].problem.chain.moment_frame


def deviance(fit: ModelFit) -> float:
    """Return -2 log likelihood, up to a constant; an outlier counts as a row at the edge of the noise."""
    found = 0.0
    for (station, _, blocks), rows in zip(fit.stations, fit.problem.rows, strict=True):
        n, sizes = len(station), [block.size for block in station.sensor.blocks]
        outliers = int(np.sum(fit.solution.weights[rows] == 0.0))
        spread = float(np.dot(sizes, np.log(fit.solution.estimated[blocks])))
        found += 2.0 * n * spread + outliers * outlier_limit(n, sum(sizes))
    return found
