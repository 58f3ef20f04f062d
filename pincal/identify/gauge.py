r"""The factor that masses share with the inverse of the compliances, where both were found: a scale without a measure.

What bends an arm is :math:`k \, n`: masses times c and compliances over c are one and the same robot, until a payload of
known mass is measured. A fit knows of this by first order alone: seen from its values, what is free is a straight line where
it should be :math:`k/c, m c`. Whoever takes a fit for an earlier one's prior moves it along the curve first.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pincal.identify.problem import Problem
from pincal.parameters import Covariance, Estimate


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
    powers = dict.fromkeys((p.name for p in problem.parameters if p.unit in ("kg", "kg m")), 1.0)
    for effect in problem.effects:
        if effect.uses_moments:
            units = {p.name: p.unit for p in effect.parameters(problem.chain)}
            powers |= {name: -1.0 for name, unit in units.items() if unit.endswith("/(N m)")}
            powers |= {name: -2.0 for name, unit in units.items() if unit.endswith("/(N m)^2")}
    scale = np.array([factor ** powers.get(name, 0.0) for name in estimate.names])
    nominal = np.array([p.nominal for p in estimate.parameters])
    free = scale[estimate.free]
    covariance = Covariance(
        free[:, None] * estimate.covariance.factor,
        tuple((at, block * np.outer(free[at], free[at])) for at, block in estimate.covariance.groups),
    )
    values = np.where(scale == 1.0, estimate.values, scale * (nominal + estimate.values) - nominal)
    return replace(estimate, values=values, covariance=covariance, prior=scale * estimate.prior)
