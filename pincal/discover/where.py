"""Where model and data disagree, in words: the elastic part, then what is left before anything else is named."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import chdtrc

from pincal.discover.history import History
from pincal.discover.locate import levers, locate
from pincal.discover.scatter import Scatter
from pincal.discover.words import location_words, region_words
from pincal.identify.fit import Fit
from pincal.model.effects import Compliance

# Standard deviations that a compliance has to be away from zero to be named by itself.
_SIGNIFICANT = 4.0


def noise_floor(fit: Fit) -> np.ndarray:
    """Return the declared standard deviations of the blocks, shape (blocks,), those of the residuals where none are."""
    pairs = zip(fit.noise.declared, fit.solution.estimated, strict=True)
    return np.array([estimated if declared is None else declared for declared, estimated in pairs])


def where_of(trail: History, scatter: Scatter | None, *, is_misfit: bool) -> list[dict[str, Any]]:
    """Return the entries ``where`` of ``discovery.json``, the share that of the excess over the noise.

    The disagreement is located in the first fit that has elasticity, if the arm is elastic, else in the first of all,
    without regard to what it was named later.

    Args:
        trail: the discovery.
        scatter: the joint that scatters in the end, if one does.
        is_misfit: whether the residuals are larger than the noise allows in the end.
    """
    robot = trail.final.model.chain.robot
    fit, found = trail.first, list[dict[str, Any]]()
    sigma = noise_floor(trail.final)
    for step in trail.steps:
        if step.is_elastic:
            fit = step.after
            found.append(_elastic(step.before, fit, sigma))
    location = locate(fit, sigma)
    for place in location.places:
        entry = {"joint": place.joint} if place.joint else {"region": "whole arm"}
        more = {"acts_on": place.acts_on, "depends_on": place.depends_on}
        found.append(entry | {"statement": location_words(place, robot), "share": place.share} | more)
    for region in location.regions:
        name, statement = region_words(region, robot)
        found.append({"region": name, "statement": statement, "share": region.share})
    if scatter:
        found.append(_scattered(trail.final, scatter, sigma))
    elif is_misfit and not location.places:
        statement = "what is left follows no joint position, load or recorded column"
        found.append({"region": "whole workspace", "statement": statement, "share": 1.0})
    return found


def _excess(fit: Fit, sigma: np.ndarray) -> float:
    """Return what the noise does not make of a fit's squared residuals, in units of its variance."""
    solution = fit.solution
    counted = int(np.sum(solution.weights > 0.0))
    sizes = np.array([block.size for block in fit.station.sensor.blocks])
    degrees = counted * sizes - solution.posterior.effective * sizes / sizes.sum()
    return float(np.sum(degrees * ((solution.estimated / sigma) ** 2 - 1.0)))


def _elastic(before: Fit, after: Fit, sigma: np.ndarray) -> dict[str, Any]:
    """Say how much of what the geometric model leaves follows the static moments, and where it is strongest."""
    whole = _excess(before, sigma)
    share = 1.0 - max(_excess(after, sigma), 0.0) / whole if whole > 0.0 else 0.0
    joint = elastic_entries(after)[0]["joint"]
    statement = f"what the geometric model leaves follows the static moments on the joints, that on {joint} above all"
    return {"joint": joint, "statement": statement, "share": float(np.clip(share, 0.0, 1.0))}


def _scattered(fit: Fit, scatter: Scatter, sigma: np.ndarray) -> dict[str, Any]:
    """Say how much of what is left in the end is scatter of one joint."""
    chain = fit.model.chain
    lever = levers(fit, (int(chain.drives[chain.robot.joint_names.index(scatter.joint)]),))[0]
    rows = fit.solution.weights > 0.0
    made = scatter.sigma**2 * float(np.sum(lever[: fit.station.sensor.blocks[0].size, rows] ** 2)) / float(sigma[0]) ** 2
    share = made / max(_excess(fit, sigma), made)
    statement = f"{scatter.joint} is somewhere else about its own axis each time, whatever pose and recorded columns are"
    return {"joint": scatter.joint, "statement": statement, "share": share}


def elastic_entries(fit: Fit) -> list[dict[str, Any]]:
    """Return the joints and bearings whose compliance is far from zero, the surest first."""
    sigma = fit.estimate.fitted_sigma
    found = []
    for effect in fit.model.effects:
        if not isinstance(effect, Compliance):
            continue
        by_joint: dict[str, list[int]] = {}
        for parameter in effect.parameters(fit.model.chain):
            by_joint.setdefault(parameter.name.rsplit(".", 1)[0], []).append(fit.model.index(parameter.name))
        for joint, places in by_joint.items():
            z2 = float(np.sum((fit.values[places] / sigma[places]) ** 2))
            found.append((z2, len(places), effect.name, joint, places))
    found.sort(key=lambda item: -item[0])
    sure = [item for item in found if item[0] > _SIGNIFICANT**2 * item[1]] or found[:1]
    return [
        {
            "effect": name,
            "joint": joint,
            "parameters": {
                fit.model.names[i]: {
                    "value": float(fit.values[i]),
                    "sigma": float(sigma[i]) if np.isfinite(sigma[i]) else None,
                    "unit": fit.model.parameters[i].unit,
                }
                for i in places
            },
            "p_value": float(chdtrc(size, z2)),
        }
        for z2, size, name, joint, places in sure
    ]
