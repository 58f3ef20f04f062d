r"""What a fit knows of masses that nobody weighed: static moments up to one factor, which compliances share.

What bends an arm is :math:`k \, n`: masses times c and compliances over c are one and the same robot, until a payload of
known mass is measured. A fit knows of this by first order alone: seen from its values, what is free is a straight line where
it should be :math:`k/c, m c`. Whoever takes a fit for an earlier one's prior moves it along the curve first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pincal.identify.criteria import CRITERIA
from pincal.identify.fit import ModelFit
from pincal.identify.problem import Problem
from pincal.model.conditions import UNFELT
from pincal.parameters import Covariance, Estimate


@dataclass(frozen=True)
class AxisMoment:
    """A static moment at one pose, and what the fit knows of it.

    Attributes:
        joint: name of the joint.
        axis: "x", "y" or "z" of the frame in which the chain takes moments.
        moment: [N m].
        sigma: its standard deviation if the largest moment is held, and with it the common factor [N m].
    """

    joint: str
    axis: str
    moment: float
    sigma: float

    @property
    def is_identified(self) -> bool:
        """Whether the data tell it to a third or better."""
        return self.sigma < CRITERIA.moment * abs(self.moment)


@dataclass(frozen=True)
class FoundMoments:
    """The moments of an arm whose masses were found with its compliances, at one pose.

    Attributes:
        q: shape (n,), the pose: of those fitted the one whose moments are of median size [rad or m].
        axes: the moments that are felt, from the base.
        largest: the largest of them, which is held for the others' standard deviations.
        factor_sigma: relative standard deviation of the factor that all moments share, and the compliances its inverse.
        mass: what the links weigh in all [kg].
        links: names of the links whose masses were found.
    """

    q: np.ndarray
    axes: tuple[AxisMoment, ...]
    largest: AxisMoment
    factor_sigma: float
    mass: float
    links: tuple[str, ...]


def found_moments(fit: ModelFit) -> FoundMoments | None:
    """Return the moments at a typical pose, with their uncertainty; None where masses were not found."""
    model, values = fit.arm
    places = np.array(sorted({body.parameter for body in model.bodies}), int)
    if not len(places):
        return None
    conditions = fit.problem.stations[0].conditions
    sizes = np.linalg.norm(model.static_moments(values, conditions), axis=1)
    typical = conditions.select(np.argsort(sizes)[[len(sizes) // 2]])
    n = model.static_moments(values, typical)[0]
    steps = np.eye(model.n_parameters)[places]
    J = np.array([model.static_moments(values + step, typical)[0] - n for step in steps]).T
    C = _covariance(fit, [model.names[i] for i in places])
    most = int(np.argmax(np.abs(n)))
    covariance = J @ C @ J.T
    variance = np.diag(covariance) - covariance[most] ** 2 / max(covariance[most, most], 1e-300)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    robot = model.chain.robot
    axes = [AxisMoment(robot.joint_names[i // 3], "xyz"[i % 3], float(n[i]), float(sigma[i])) for i in range(len(n))]
    grown = sum(values[body.parameter] * body.mass for body in model.bodies)
    return FoundMoments(
        q=typical.q[0],
        axes=tuple(axis for axis in axes if abs(axis.moment) > UNFELT * abs(n[most])),
        largest=axes[most],
        factor_sigma=float(np.sqrt(covariance[most, most]) / abs(n[most])),
        mass=float(robot.masses.sum() + grown),
        links=robot.massless,
    )


def _covariance(fit: ModelFit, names: list[str]) -> np.ndarray:
    """Return the covariance of parameters, that of the prior for those that were not fitted."""
    found = fit.estimate.take(names)
    C = found.dense_covariance()
    held = ~found.free
    C[held, held] = found.prior[held] ** 2
    return np.asarray(C)


def weight_of(problem: Problem, estimate: Estimate) -> float:
    """Return what the links whose masses were found weigh by an estimate, in all [kg]; 0 if none were."""
    masses = (p for p in problem.parameters if p.unit == "kg" and p.name in estimate.names)
    return sum((p.nominal + estimate[p.name] for p in masses), 0.0)


def along_gauge(problem: Problem, estimate: Estimate, factor: float) -> Estimate:
    """Return an estimate with all masses times a factor, and all that is per moment over it: the same robot.

    Args:
        problem: a problem of which the masses are parameters.
        estimate: what is known of the robot's parameters.
        factor: c.
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
        tuple((at, block * np.outer(free[at], free[at])) for at, block in estimate.covariance.groups),
    )
    values = np.where(scale == 1.0, estimate.values, scale * (nominal + estimate.values) - nominal)
    return replace(estimate, values=values, covariance=covariance, prior=scale * estimate.prior)
