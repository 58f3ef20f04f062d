r"""Choices that the data make about elasticity: directions and places of bearings, moment
convention, and masses.

Unknown masses enter as static moments up to one factor, which compliances share. The deflection is
:math:`k \, n`: masses times c with compliances over c describe the same robot, until a payload of
known mass is measured. A fit represents this to first order only: from its values, the free
direction is a straight line where the truth is :math:`k/c, m c`. A fit used as the prior of another
is therefore first moved along the curve.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pincal.identify.beliefs import priors_of
from pincal.identify.criteria import CRITERIA
from pincal.identify.equations import Linearised
from pincal.identify.fit import ModelFit
from pincal.identify.noise import outlier_limit, rounding
from pincal.identify.problem import Problem
from pincal.identify.selection import Scored, select_stepwise
from pincal.model.catalogue.bearing_features import bearing_features
from pincal.model.chain import MomentFrame
from pincal.model.conditions import UNFELT, Conditions
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.parameters import Covariance, Estimate
from pincal.sensors.row_samples import spread_rows
from pincal.thresholds import Count


class RequiredFeatures(NamedTuple):
    """Bearing features that the data require, and their joint gain in the sum of squares, to first
    order.
    """

    effects: tuple[Effect, ...]
    gain: float


def required_features(fit: ModelFit, least: float = 0.0) -> RequiredFeatures:
    """Return the bearing features that a fit lacks and the data require; none if their joint gain
    is below ``least``.

    By default a bearing sits where the URDF has the joint, and its stiff and soft directions are
    the axes of its frame. A place next to a compliance that is hardly determined makes a ridge
    along which a fit wanders, and every superfluous parameter costs accuracy. So features enter one
    by one, each by its gain to first order given those before it.
    """
    effects = fit.options.effects
    candidates = [e for e in bearing_features(fit.problem.chain, effects) if e not in effects]
    if not candidates:
        return RequiredFeatures((), 0.0)
    gain = _gains(fit, candidates)
    most = gain(*candidates)
    if most <= least:
        return RequiredFeatures((), 0.0)

    def scores(found: tuple[Effect, ...]) -> Iterator[Scored[Effect]]:
        enough = gain(*found) + CRITERIA.bearing
        # All together gain no less than any of them.
        for effect in (effect for effect in candidates if effect not in found and most > enough):
            gained = gain(*found, effect)
            yield Scored(effect, -gained, gained >= enough)

    found = select_stepwise(
        tuple[Effect, ...](), scores, lambda found, effect: (*found, effect), most=len(candidates)
    )
    return RequiredFeatures(found, gain(*found))


def _gains(fit: ModelFit, candidates: Sequence[Effect]) -> Callable[..., float]:
    """Return the function that gives the gain of some of the candidates, to first order, given all
    that is free in the fit.
    """
    wider = fit.with_effects((*fit.options.effects, *candidates))
    problem = wider.problem
    near = wider.solution
    sizes = priors_of(problem, fit.options).sizes
    places = {effect: int(problem.places_at(effect)[0]) for effect in candidates}
    held = near.free.copy()
    free = near.free.copy()
    held[list(places.values())] = False
    free[list(places.values())] = True
    sigma = np.maximum(near.sigma, rounding(problem))
    posterior = Linearised(problem, near.values, free, near.weights, sizes).posterior(sigma)
    beyond = posterior.gains_beyond(held[free])

    def gain(*released: Effect) -> float:
        more = np.zeros(len(free), bool)
        more[[places[effect] for effect in released]] = True
        return beyond(more[free])

    return gain


# Rows used to choose a convention: a difference that these do not show does not matter.
_ROWS: Count = 2000


def some_rows_of(fit: ModelFit) -> ModelFit:
    """Return a fit, unchanged, of as many of its rows, spread over each station, as suffice to
    choose a convention.
    """
    if len(fit.problem) <= _ROWS:
        return fit
    return fit.select(spread_rows(list(map(len, fit.problem.stations)), _ROWS))


def best_of(fits: Sequence[ModelFit]) -> MomentFrame:
    """Return the convention of the best fit; the first fit's unless another is better beyond
    chance.

    Conventions may differ in the number of parameters, so fits are compared by Akaike's criterion.
    """
    deviances = [deviance(fit) + 2.0 * fit.solution.effective for fit in fits]
    best = int(np.argmin(deviances))
    return fits[
        best if deviances[best] < deviances[0] - CRITERIA.moment_frame else 0
    ].problem.chain.moment_frame


def deviance(fit: ModelFit) -> float:
    """Return -2 log likelihood, up to a constant; an outlier counts as a row at the limit of
    screening.
    """
    found = 0.0
    for (station, _, blocks), rows in zip(fit.stations, fit.problem.rows, strict=True):
        n = len(station)
        sizes = station.block_sizes
        outliers = int(np.sum(fit.solution.weights[rows] == 0.0))
        spread = float(np.dot(sizes, np.log(fit.solution.estimated[blocks])))
        found += 2.0 * n * spread + outliers * outlier_limit(n, sum(sizes))
    return found


@dataclass(frozen=True)
class AxisMoment:
    """A static moment at one pose, and its uncertainty.

    Attributes:
        joint: name of the joint.
        axis: "x", "y" or "z" of the frame in which the chain takes moments.
        moment: [N m].
        sigma: its standard deviation conditional on the largest moment, and so on the common factor
            [N m].
    """

    joint: str
    axis: str
    moment: float
    sigma: float

    @property
    def is_identified(self) -> bool:
        """Whether the data determine it to a third or better."""
        return self.sigma < CRITERIA.moment * abs(self.moment)


@dataclass(frozen=True)
class FoundMoments:
    """The static moments at one pose of an arm whose masses were identified together with its
    compliances.

    Attributes:
        q: shape (n,), the pose: of those fitted the one whose moments are of median size [rad or
            m].
        axes: the moments that matter, from the base.
        largest: the largest of them, on which the others' standard deviations are conditioned.
        factor_sigma: relative standard deviation of the factor that moments share, and compliances
            inversely.
        mass: total mass of the links [kg].
        links: names of the links whose masses were identified.
    """

    q: np.ndarray
    axes: tuple[AxisMoment, ...]
    largest: AxisMoment
    factor_sigma: float
    mass: float
    links: tuple[str, ...]


def found_moments(fit: ModelFit) -> FoundMoments | None:
    """Return the moments at a typical pose, with their uncertainty; None where masses were not
    identified.
    """
    model, values = fit.arm
    places = np.array(sorted({body.parameter for body in model.bodies}), int)
    if not len(places):
        return None
    typical = _typical_load(model, values, fit.problem.stations[0].conditions)
    n = model.static_moments(values, typical)[0]
    steps = np.eye(model.n_parameters)[places]
    J = np.array([model.static_moments(values + step, typical)[0] - n for step in steps]).T
    # Parameters that were not fitted have their priors.
    known = fit.estimate.take(model.names[i] for i in places)
    C = known.dense_covariance() + np.diag(np.where(known.free, 0.0, known.prior**2))
    most = int(np.argmax(np.abs(n)))
    covariance = J @ C @ J.T
    variance = np.diag(covariance) - covariance[most] ** 2 / max(covariance[most, most], 1e-300)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    robot = model.chain.robot
    axes = [
        AxisMoment(robot.joint_names[i // 3], "xyz"[i % 3], float(n[i]), float(sigma[i]))
        for i in range(len(n))
    ]
    grown = sum(values[body.parameter] * body.mass for body in model.bodies)
    return FoundMoments(
        q=typical.q[0],
        axes=tuple(axis for axis in axes if abs(axis.moment) > UNFELT * abs(n[most])),
        largest=axes[most],
        factor_sigma=float(np.sqrt(covariance[most, most]) / abs(n[most])),
        mass=float(robot.masses.sum() + grown),
        links=robot.massless,
    )


def _typical_load(model: Model, values: np.ndarray, conditions: Conditions) -> Conditions:
    """Return the pose whose static moments are the median of all."""
    sizes = np.linalg.norm(model.static_moments(values, conditions), axis=1)
    return conditions.select(np.argsort(sizes)[[len(sizes) // 2]])


def weight_of(problem: Problem, estimate: Estimate) -> float:
    """Return the total mass of the links with identified masses by an estimate [kg]; 0 if there are
    none.
    """
    masses = (p for p in problem.parameters if p.unit == "kg" and p.name in estimate.names)
    return sum((p.nominal + estimate[p.name] for p in masses), 0.0)


def along_gauge(problem: Problem, estimate: Estimate, factor: float) -> Estimate:
    """Return an estimate with all masses times a factor, and all that is per moment divided by it:
    the same robot.
    """
    powers = {p.name: float(max(p.moment_power, 0)) for p in problem.parameters}
    for effect in problem.effects:
        if effect.uses_moments:
            powers |= {p.name: float(p.moment_power) for p in effect.parameters(problem.chain)}
    scale = np.array([factor ** powers.get(name, 0.0) for name in estimate.names])
    nominal = np.array([p.nominal for p in estimate.parameters])
    free = scale[estimate.free]
    covariance = Covariance(
        free[:, None] * estimate.covariance.factor,
        tuple(
            (at, block * np.outer(free[at], free[at])) for at, block in estimate.covariance.groups
        ),
    )
    values = np.where(scale == 1.0, estimate.values, scale * (nominal + estimate.values) - nominal)
    return replace(estimate, values=values, covariance=covariance, prior=scale * estimate.prior)
