"""Where model and data disagree, in words: the elastic part, then what is left before anything else is named."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace as changed
from scipy.special import chdtrc

from pincal.discover.decisions import each_heading_once
from pincal.discover.history import History, Step
from pincal.discover.levers import levers
from pincal.discover.locate import Place, locate
from pincal.discover.policy import POLICY
from pincal.discover.scatter import Excess
from pincal.identify.fit import Fit
from pincal.io.discovery_file import Disagreement
from pincal.model.effect import Effect
from pincal.model.effects import Compliance
from pincal.parameters import Estimate
from pincal.robot.robot import Robot
from pincal.units import format_small

# Standard deviations that a compliance has to be away from zero to be named by itself.
_SIGNIFICANT = 4.0
# Places, and regions, of all stations together that are worth a line.
_MOST = 3


def noise_floor(fit: Fit) -> np.ndarray:
    """Return the declared standard deviations of the blocks, shape (blocks,), those of the residuals where none are."""
    pairs = zip(fit.noise.declared, fit.solution.estimated, strict=True)
    return np.array([estimated if declared is None else declared for declared, estimated in pairs])


def where_of(trail: History, excess: Excess | None, *, is_misfit: bool) -> tuple[Disagreement, ...]:
    """Return where model and data disagree, the share that of the excess over the noise.

    The disagreement is located in the first fit that has elasticity, if the arm is elastic, else in the first of all,
    without regard to what it was named later.

    Args:
        trail: the discovery.
        excess: what is left along the lever of one joint in the end, if something is.
        is_misfit: whether the residuals are larger than the noise allows in the end.
    """
    robot = trail.final.problem.chain.robot
    fit, found = trail.first, list[Disagreement]()
    sigma = noise_floor(trail.final)
    for step in trail.steps:
        if step.is_elastic:
            fit = step.after
            found.append(_elastic(step, sigma))
    places, regions = _located(fit, sigma)
    for name, place in places:
        region, words = None if place.joint else "whole arm", _words(place, robot)
        words = f"{name}: {words}" if name else words
        found.append(Disagreement(words, place.share, place.joint, region, place.acts_on, place.depends_on))
    found += regions
    if excess:
        found.append(_left_along(trail.final, excess, sigma))
    elif is_misfit and not places:
        statement = "what is left follows no joint position, load or recorded column"
        found.append(Disagreement(statement, 1.0, region="whole workspace"))
    return tuple(found)


def _located(fit: Fit, sigma: np.ndarray) -> tuple[list[tuple[str, Place]], list[Disagreement]]:
    """Return where a fit and its data disagree, of several stations with their names, the largest first."""
    places: list[tuple[str, Place]] = []
    regions: list[Disagreement] = []
    for station, alone, (_, _, blocks) in zip(fit.problem.stations, fit.alone, fit.stations, strict=True):
        location = locate(alone, sigma[blocks])
        part = 1.0 if not station.name else _excess(alone, sigma[blocks]) / max(_excess(fit, sigma), 1e-300)
        part = float(np.clip(part, 0.0, 1.0))
        places += [(station.name, replace(place, share=part * place.share)) for place in location.places]
        name = f"{station.name}: " if station.name else ""
        regions += [changed(r, statement=name + r.statement, share=part * r.share) for r in location.regions]
    if len(fit.problem.stations) == 1:
        return places, regions
    places.sort(key=lambda pair: -pair[1].share)
    regions.sort(key=lambda region: -region.share)
    return places[:_MOST], regions[:_MOST]


def _excess(fit: Fit, sigma: np.ndarray) -> float:
    """Return what the noise does not make of a fit's squared residuals, in units of its variance."""
    solution = fit.solution
    counted = [int(np.sum(solution.weights[rows] > 0.0)) for rows in fit.problem.rows]
    blocks = [len(station.sensor.blocks) for station in fit.problem.stations]
    readings = np.repeat(counted, blocks) * fit.problem.block_sizes
    degrees = readings - solution.effective * (readings / readings.sum())
    return float(np.sum(degrees * ((solution.estimated / sigma) ** 2 - 1.0)))


def _elastic(step: Step, sigma: np.ndarray) -> Disagreement:
    """Say how much of what a model leaves follows the static moments, and where it is strongest."""
    whole = _excess(step.before, sigma)
    share = 1.0 - max(_excess(step.after, sigma), 0.0) / whole if whole > 0.0 else 0.0
    joint = sure_compliances(step.after, step.effects)[0].effect.locus.joint
    statement = f"what the geometric model leaves follows the static moments on the joints, that on {joint} above all"
    return Disagreement(statement, float(np.clip(share, 0.0, 1.0)), joint)


def _left_along(fit: Fit, excess: Excess, sigma: np.ndarray) -> Disagreement:
    """Say how much of what is left in the end is along the lever of one joint."""
    chain, made = fit.problem.chain, 0.0
    drive = int(chain.drives[chain.robot.joint_names.index(excess.joint)])
    for alone, (_, _, blocks) in zip(fit.alone, fit.stations, strict=True):
        lever, rows = levers(alone, (drive,))[0], alone.solution.weights > 0.0
        squares = float(np.sum(lever[: alone.station.sensor.blocks[0].size, rows] ** 2))
        made += excess.sigma**2 * squares / float(sigma[blocks.start]) ** 2
    share = made / max(_excess(fit, sigma), made)
    return Disagreement(excess.statement, share, excess.joint)


class Sure(NamedTuple):
    """A compliance of one joint that is far from zero.

    Attributes:
        effect: the drive or the bearing.
        estimate: its parameters and those of the same name that go with them.
        p_value: the chance of compliances as large if there were none: of its own, with that other one as it is if it
            is sure only so, or of all of its step where none is sure.
        others: what could give way instead: none of its step is sure, or the data can't tell it from these.
        beside: parameters of the other one, if it is sure only together with another.
    """

    effect: Effect
    estimate: Estimate
    p_value: float
    others: tuple[Effect, ...]
    beside: tuple[str, ...] = ()


def sure_compliances(fit: Fit, effects: Iterable[Effect], equivalent: tuple[Effect, ...] = ()) -> list[Sure]:
    """Return the compliances among effects that are far from zero, the surest first.

    Args:
        fit: the fit in which they are.
        effects: what entered together.
        equivalent: what the data can't tell from it.

    Returns:
        If none is far from zero, the surest alone, with the others in its place and the p-value of all together.
    """
    found, chain = list[tuple[float, int, Sure]](), fit.problem.chain
    for effect in effects:
        if not isinstance(effect, Compliance):
            continue
        likes = [e for e in fit.problem.effects if e.heading[0] == effect.heading[0]]
        names = [parameter.name for e in likes for parameter in e.parameters(chain)]
        for single in effect.parts(chain):
            estimate = fit.estimate.take(name for name in names if name.rsplit(".", 1)[0] == single.only)
            z2, size = _squares(estimate)
            found.append((z2, size, Sure(single, estimate, float(chdtrc(size, z2)), equivalent)))
    found.sort(key=lambda item: -item[0])
    sure = [(z2, entry) for z2, size, entry in found if z2 > _SIGNIFICANT**2 * size]
    sure += _sure_together(fit, [entry for z2, size, entry in found if z2 <= _SIGNIFICANT**2 * size])
    if sure:
        return [entry for _, entry in sorted(sure, key=lambda item: -item[0])]
    first, *others = (entry for _, _, entry in found)
    rivals = each_heading_once((*equivalent, *(other.effect for other in others)), first.effect, POLICY)
    z2, size = _squares(fit.estimate.take({name for _, _, entry in found for name in entry.estimate.names}))
    return [first._replace(others=rivals, p_value=float(chdtrc(size, z2)))]


def _squares(estimate: Estimate, known: Estimate | None = None) -> tuple[float, int]:
    """Return the squares of compliances in units of their covariance, and their number.

    Some that trade with each other may be sure together and none of them alone.

    Args:
        estimate: the parameters.
        known: these first, then others that are taken to be as they are; default: without others.
    """
    # Where one sits says nothing of whether it gives way.
    bends = [np.array([p.unit.endswith("/(N m)") for p in some.parameters]) for some in (estimate, known or estimate)]
    values, size = estimate.values[bends[0]], int(bends[0].sum())
    covariance = (known or estimate).dense_covariance()[np.ix_(bends[1], bends[1])]
    information = np.linalg.pinv(covariance, hermitian=True)[:size, :size]
    return float(values @ information @ values), size


def _sure_together(fit: Fit, doubtful: Sequence[Sure]) -> Iterator[tuple[float, Sure]]:
    """Yield the compliances that would be sure if another one stayed as it is, each with that of which this holds most.

    Their squares come first.

    A drive and the bearing of the joint before may turn an arm nearly alike; that one of them gives way is sure, not which.
    """
    for one in doubtful:
        pairs = []
        for other in (entry for entry in doubtful if entry is not one):
            z2, size = _squares(one.estimate, fit.estimate.take((*one.estimate.names, *other.estimate.names)))
            pairs.append((z2, size, other))
        z2, size, other = max(pairs, key=lambda pair: pair[0], default=(0.0, 1, one))
        if z2 > _SIGNIFICANT**2 * size:
            others = each_heading_once((other.effect, *one.others), one.effect, POLICY)
            yield z2, one._replace(p_value=float(chdtrc(size, z2)), others=others, beside=other.estimate.names)


_FOLLOWED = {
    "approach": "depending on the direction from which it arrives",
    "load": "following the load on its axis",
    "move": "in proportion to its last move",
    "payload": "following the payload",
    "temperature": "following the temperature",
    "time": "as time goes by",
}


def _words(place: Place, robot: Robot) -> str:
    """Return where a disagreement acts, what it follows, and the range in which most of it sits."""
    units = dict(zip(robot.joint_names, robot.joint_units, strict=True))
    if place.acts_on == "base":
        moves = "the whole arm moves on its base"
    elif place.acts_on == "lengths":
        moves = f"all lengths grow by {format_small(place.size, '1')} rms"
    elif place.acts_on != "drive":
        moves = f"the axis of {place.joint} tilts by {format_small(place.size, 'rad')} rms"
    elif units[place.joint or ""] == "m":
        moves = f"{place.joint} is off along its axis by {format_small(place.size, 'm')} rms"
    else:
        moves = f"{place.joint} is off about its own axis by {format_small(place.size, 'rad')} rms"
    whose = "its own position" if place.depends_on == place.joint else f"the position of {place.depends_on}"
    text = f"{moves}, {_FOLLOWED.get(place.depends_on, f'following {whose}')}"
    if place.window is None:
        return text
    form, unit, factor = (".3f", "m", 1.0) if units[place.depends_on] == "m" else (".0f", "deg", np.degrees(1.0))
    low, high = (f"{x * factor:{form}}" for x in place.window)
    return f"{text}; {100 * place.inside:.0f} % of it between {low} and {high} {unit}"
