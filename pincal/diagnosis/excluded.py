"""Smallest detectable changes, and further poses that would distinguish two changes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import msgspec
import numpy as np
from scipy.special import fdtri, ncfdtr

from pincal.compensate.compensation import compensate_poses
from pincal.diagnosis.change_search import ChangeVerdict, NamedChange
from pincal.diagnosis.diagnosis_file import ExcludedEntry
from pincal.diagnosis.diagnosis_numbers import DIAGNOSIS
from pincal.diagnosis.lineup import ChangeHypotheses, PossibleChange
from pincal.identify.quadratic import ROUNDING, root_of_inverse
from pincal.identify.station import Station
from pincal.sensors.point_sensor import PointSensor
from pincal.thresholds import Count, Scale

# Probability of detecting a change of the reported size.
DETECTED = DIAGNOSIS.detected
# Numbers of further poses to distinguish changes, random poses among which they are chosen, and
# those shown.
_MORE: tuple[Count, ...] = (3, 6, 12, 25, 50)
_TRIED: Count = 200
_SHOWN: Count = 2
# Equivalent changes listed at most.
_NAMED: Count = 8
# Fraction of an effect's strength in its best direction below which a direction is not observable.
_SEEN: Scale = 1e-6


def excluded(verdict: ChangeVerdict, searched: ChangeVerdict) -> Iterator[ExcludedEntry]:
    """Yield the smallest detectable size of each parameter and each effect that was not found.

    ``verdict`` has no changes where the rows can't decide, unlike ``searched``.
    """
    lineup = verdict.lineup
    found = searched.evidence.form
    taken = {lineup.changes[i].label for i in verdict.happened}
    listed: set[tuple[object, ...]] = set()
    motion = lineup.motion(verdict.values)
    for change, places in zip(lineup.changes, lineup.places, strict=True):
        units = {lineup.station.parameters[i].unit for i in places}
        key = (change.label, change.parameters if change.effect is None else None)
        if change.parts or change.label in taken or len(units) > 1 or key in listed:
            continue
        # The direction in which a change is least visible.
        rank = found.gain(places)[1]
        strengths, directions = np.linalg.eigh(found.H[np.ix_(places, places)])
        if rank < len(places) or strengths[0] <= _SEEN * strengths[-1]:
            continue
        detected = detected_noncentrality(rank, verdict.degrees + found.degrees, searched.limit)
        smallest = float(np.sqrt(detected / strengths[0]))
        listed.add(key)
        shift = np.linalg.norm(motion[:, :, places] @ directions[:, 0], axis=1).max()
        yield ExcludedEntry(
            **msgspec.structs.asdict(change.label),
            parameter=change.parameters[0] if len(places) == 1 else "",
            smallest=smallest,
            unit=units.pop(),
            tip_mm=float(1e3 * smallest * shift),
        )


@lru_cache(maxsize=256)
def detected_noncentrality(
    rank: int, degrees: float, limit: float, power: float = DETECTED
) -> float:
    """Return the non-centrality at which a change of some rank is detected with probability
    ``power``.
    """
    from scipy.optimize import brentq

    rest = max(degrees - rank, 1.0)
    F = float(fdtri(rank, rest, 1.0 - limit))
    upper = 100.0
    while ncfdtr(rank, rest, upper, F) > 1.0 - power:
        upper *= 2.0
    return float(brentq(lambda value: ncfdtr(rank, rest, value, F) - (1.0 - power), 1e-6, upper))


def tell_apart(verdict: ChangeVerdict, step: NamedChange) -> str:
    """Return, in words, which further poses would distinguish a change from its best rival, and how
    many.
    """
    rival = next((score.change for score in step.equivalent), None)
    if rival is None:
        return ""
    change = step.score.change
    otherwise = "re-identify either, or inspect the joints themselves"
    if _are_alike(verdict, change, rival):
        least = f"{1e3 * DIAGNOSIS.resolvable:g} mm"
        return f"the two differ by less than {least}, too little for any instrument; {otherwise}"
    there, apart = most_different_poses(verdict, change, rival)
    for n in _MORE:
        if separation(verdict, there.select(np.arange(n)), change, rival) > DIAGNOSIS.told_apart:
            shown = ", then ".join(_pose_words(verdict, there, i) for i in range(min(n, _SHOWN)))
            like = " and poses like these" if n > _SHOWN else ""
            return (
                f"measure {n} more poses in which the two differ most, by {1e3 * apart[0]:.2g} mm "
                f"at the target: {shown}{like}"
            )
    return (
        f"the two differ by at most {1e3 * apart[0]:.2g} mm beyond what a new fit takes up and the "
        f"calibration leaves open, too little for {_MORE[-1]} more poses; {otherwise}"
    )


def _are_alike(verdict: ChangeVerdict, change: int, rival: int) -> bool:
    """Return whether no instrument tells two changes apart, even of a robot that is certain."""
    there = _further_poses(verdict.lineup, np.random.default_rng(0))
    apart = _differences(verdict, there, change, rival, is_certain=True)
    return bool(apart.max() <= DIAGNOSIS.resolvable)


def most_different_poses(
    verdict: ChangeVerdict, change: int, rival: int
) -> tuple[Station, np.ndarray]:
    """Return a station with random poses, those first in which two changes differ most, and the
    differences [m]. A target that is held in a socket, or touches, is where it was in some row.

    A change has the size that explains the rows best. Of the difference counts what remains where
    the rival is fitted to the rows and these poses, with instrument and target relocated, and the
    robot as far from its calibration as that leaves open.
    """
    there = _further_poses(verdict.lineup, np.random.default_rng(0))
    apart = _differences(verdict, there, change, rival)
    order = np.argsort(-apart)
    return there.select(order), apart[order]


def _differences(
    verdict: ChangeVerdict, there: Station, change: int, rival: int, *, is_certain: bool = False
) -> np.ndarray:
    """Return the differences of two changes at the target, shape (N,) [m], as
    :func:`most_different_poses`; of a robot that is certain, without what its calibration leaves
    open.
    """
    left = _unabsorbed(verdict, there, change, rival, is_certain=is_certain)[1]
    model = there.model
    motion = model.linearise(model.own(verdict.lineup.start), there.conditions)[1]
    return np.asarray(np.linalg.norm(motion @ model.own(left), axis=1))


def _further_poses(lineup: ChangeHypotheses, rng: np.random.Generator) -> Station:
    """Return a station with random poses that can be measured."""
    rows = lineup.station.select(np.resize(np.arange(len(lineup.station)), _TRIED))
    robot = rows.model.chain.robot
    payload = rng.choice(lineup.robot.covered.payload, _TRIED)
    drawn = replace(rows.conditions, q=robot.random_configurations(_TRIED, rng), payload=payload)
    if not rows.sensor.is_of_joints or rows.model.chain.path.start != robot.base:
        return replace(rows, conditions=drawn)
    # The robot is turned about the place where its target is held, from poses drawn at random.
    held = lineup.robot.predict(rows.conditions)[:, :, 3]
    found = compensate_poses(lineup.robot, held, drawn, orientation="free")
    there = replace(rows, conditions=replace(drawn, q=robot.from_reported(found.q)))
    return there.select(found.is_ok) if found.is_ok.any() else rows


def separation(verdict: ChangeVerdict, more: Station, change: int, rival: int) -> float:
    """Return the squared signal of a change that another can't absorb if rows are added, in units
    of the noise.
    """
    return _unabsorbed(verdict, more, change, rival)[0]


def _unabsorbed(
    verdict: ChangeVerdict, more: Station, change: int, rival: int, *, is_certain: bool = False
) -> tuple[float, np.ndarray]:
    """Return the squared signal of a change that another can't absorb if rows are added, in units
    of the noise, and what causes it, shape (P,): the change, less what the other, the station and
    an uncertain robot take up of it.
    """
    known = verdict.lineup.as_certain() if is_certain else verdict.lineup
    lineup = replace(known, station=_with_poses(known.station, more), shared=None)
    found = lineup.weigh(verdict.values, [i for i in verdict.happened if i != change])
    left = np.zeros(len(verdict.values))
    c = lineup.places[change]
    g = np.setdiff1d(lineup.places[rival], c)
    if not len(g):
        return 0.0, left
    left[c] = (verdict.values - lineup.start)[c]
    form = found.form
    root = root_of_inverse(form.H[np.ix_(g, g)], form.whole[g], ROUNDING)
    left[g] -= root @ (root.T @ (form.H[g] @ left))
    square = float(max(left @ form.H @ left, 0.0))
    along = (left @ found.jacobian) @ (found.projected @ found.jacobian).T
    return square, left - along @ found.projected


def _with_poses(station: Station, more: Station) -> Station:
    """Return the rows of a station, and further poses there."""
    n = len(station)
    wider = station.select(np.resize(np.arange(n), n + len(more)))
    old = station.conditions
    new = more.conditions
    both = replace(
        wider.conditions,
        q=np.concatenate([old.q, new.q]),
        payload=np.concatenate([old.payload, new.payload]),
    )
    return replace(wider, conditions=both)


def _pose_words(verdict: ChangeVerdict, there: Station, i: int) -> str:
    """Return joint positions, and the load if there is any, in words."""
    robot = there.model.chain.robot
    q = there.conditions.q[i]
    kinds = zip(robot.joint_types, q, strict=True)
    numbers = " ".join(
        f"{1e3 * x:.0f}mm" if kind == "prismatic" else f"{np.degrees(x):.0f}" for kind, x in kinds
    )
    load = float(there.conditions.payload[i])
    held = _place_name(there, i)
    return (
        f"joints at {numbers} deg"
        + (f" in {held}" if held else "")
        + (f" with {load:g} kg" if verdict.lineup.robot.covered.payload.any() else "")
    )


def _place_name(there: Station, i: int) -> str:
    """Return the name of the place where a target is held; "" if it is not, or has no name."""
    sensor = there.sensor
    if not isinstance(sensor, PointSensor) or not sensor.is_of_joints:
        return ""
    place = int(sensor.index[i])
    return sensor.points.names[place] if place >= 0 else ""


def rival_names(changes: tuple[PossibleChange, ...], step: NamedChange) -> list[PossibleChange]:
    """Return the changes equivalent to a step's own, each name once."""
    found = {
        changes[score.change].label: changes[score.change] for score in reversed(step.equivalent)
    }
    found.pop(changes[step.score.change].label, None)
    return list(reversed(found.values()))[:_NAMED]
