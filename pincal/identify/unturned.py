"""Targets whose place on the tool the poses do not determine, because they hardly turn it.

Readings tell where a target is on the tool by the rotations R of the tip alone: displaced by e, it
moves by :math:`R e`, of which the unknown base absorbs what is the same in all poses. Along an e
that all poses carry the same way a fit has nothing to hold on to but noise and the robot's own
errors, by which it would place the target many metres away.
"""

from __future__ import annotations

import numpy as np

from pincal.identify.beliefs import is_on_tool
from pincal.identify.problem import Problem
from pincal.identify.station import Station
from pincal.model.model import Model
from pincal.thresholds import Count, Scale

# Root mean square turn of a direction below which a robot's own errors of a millimetre leave the
# place of a target along it open by a third of a metre [rad].
_TURN: Scale = 3e-3
# Rows that tell how far a station's poses turn its targets.
_SOME: Count = 200
# Random poses that tell whether the arm can turn the direction at all, and their seed.
_DRAWN: Count = 64
_SEED: Count = 0


def unturned(problem: Problem, free: np.ndarray) -> tuple[str, ...]:
    """Return the names of the stations that hardly turn a target in some direction, though the arm
    can.

    Args:
        problem: the stations.
        free: shape (P,), parameters that are fitted.
    """
    return tuple(
        station.name
        for station, places in zip(problem.stations, problem.places, strict=True)
        if _hardly_turns(station, free[places])
    )


def _hardly_turns(station: Station, free: np.ndarray) -> bool:
    """Return whether a station's poses hardly turn a target in some direction, though the arm can.

    Args:
        station: readings and model.
        free: shape (P,), parameters that are fitted.
    """
    if not station.sensor.reads_place or not station.sensor.base_symbols:
        return False
    wanted = {
        p.element
        for p, is_free in zip(station.parameters, free, strict=True)
        if is_free and is_on_tool(p)
    }
    nominal = Model(station.model.chain, ())
    names = nominal.chain.targets
    targets = [k for k, name in enumerate(names) if name in wanted]
    if not targets:
        return False
    some = station.sample(_SOME)
    tips = nominal.predict(np.zeros(0), some.conditions.at_moments)[:, :, :3]
    read = [some.conditions.target == k for k in targets]
    return any(
        np.linalg.eigvalsh(_scatter(tips[rows]))[0] < _TURN**2 and _could_turn_more(some, rows)
        for rows in read
        if rows.any()
    )


def _could_turn_more(station: Station, rows: np.ndarray) -> bool:
    """Return whether there is a direction that some rows hardly turn, and random poses do."""
    robot = station.model.chain.robot
    path = station.model.chain.path
    drawn = robot.random_configurations(_DRAWN, np.random.default_rng(_SEED))
    able = _scatter(robot.forward_kinematics(drawn, path)[:, :3, :3])
    measured = robot.forward_kinematics(station.conditions.q[rows], path)[:, :3, :3]
    values, axes = np.linalg.eigh(_scatter(measured))
    by_able = np.einsum("ik,ij,jk->k", axes, able, axes)
    return bool(np.any((values < _TURN**2) & (by_able > _TURN**2)))


def _scatter(R: np.ndarray) -> np.ndarray:
    """Return the mean square of what rotations do to a vector beyond their mean, shape (3, 3)."""
    off = R - R.mean(axis=0)
    return np.asarray(np.einsum("nji,njk->ik", off, off) / len(R))
