"""Zeros of joints that are far from where the URDF has them: the search for them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pincal.errors import BadInputError, IdentificationError
from pincal.identify.beliefs import is_frame, priors_of, released_of
from pincal.identify.initial import place, starts_of
from pincal.identify.noise import Noise
from pincal.identify.options import Options
from pincal.identify.problem import Problem
from pincal.identify.solve import Course, likeliest_values
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.model.effects import JointOffset
from pincal.robot.mastering import free_joints
from pincal.robot.robot import Robot

# Rows from which a typical error is told.
_TYPICAL = 1000
# Step of the search around the turn of one joint [rad], whose fits reach some 20 deg; how many joints are tried, the most
# promising ones.
_STEP, _TRIED = np.deg2rad(15.0), 4
# Of shifts that leave as much but for this factor the smallest are meant: the first joint's is a turn of the base.
_ALIKE = 1.2


def typical_left(station: Station, values: np.ndarray) -> tuple[float, float]:
    """Return the robust size of the errors of position [m] and orientation [rad]: outliers have no say."""
    station = station.sample(_TYPICAL)
    position = float(np.median(np.linalg.norm(station.displacements(values), axis=1)))
    ends = np.cumsum([0, *(block.size for block in station.sensor.blocks)])
    turned = [slice(a, a + b.size) for a, b in zip(ends, station.sensor.blocks, strict=False) if b.unit == "rad"]
    if not turned:
        return position, 0.0
    residuals = station.residuals(values)
    return position, max(float(np.median(np.linalg.norm(residuals[part], axis=0))) for part in turned)


def shifts_found(robot: Robot, table: Measurements, options: Options) -> dict[str, float]:
    """Return the zeros of joints with which base and tool alone leave least [rad], by name.

    One joint may be off by any angle, the others by as much as a fit reaches from zero.

    Args:
        robot: the arm.
        table: some rows of it.
        options: how the robot is placed.
    """
    options = replace(options, effects=(JointOffset(),), zeros=("*",), earlier=None, moment_frame="paper")
    names = free_joints(robot)
    turning = [i for i, kind in enumerate(robot.joint_types) if kind != "prismatic" and robot.joint_names[i] in names]

    def shifted(shift: np.ndarray) -> Measurements:
        return replace(table, q=table.q + robot.as_reported(shift[None])[0])

    def starts() -> Iterator[tuple[float, np.ndarray]]:
        for i in turning:
            angles = np.arange(_STEP, 2.0 * np.pi - 0.5 * _STEP, _STEP)
            shifts = [np.eye(robot.n_joints)[i] * (angle - 2.0 * np.pi * (angle > np.pi)) for angle in angles]
            yield min(((_at_start(robot, shifted(shift), options), shift) for shift in shifts), key=lambda one: one[0])

    likely = sorted(starts(), key=lambda one: one[0])[:_TRIED]
    found = []
    for shift in (np.zeros(robot.n_joints), *(shift for _, shift in likely)):
        try:
            rest, offsets = _fitted(robot, shifted(shift), options)
        except (BadInputError, IdentificationError, np.linalg.LinAlgError):
            continue
        found.append((rest, shift + [offsets.get(name, 0.0) for name in robot.joint_names]))
    if not found:
        return {}
    least = min(rest for rest, _ in found)
    alike = [shift - 2.0 * np.pi * np.round(shift / (2.0 * np.pi)) for rest, shift in found if rest < _ALIKE * least]
    best = min(alike, key=lambda shift: float(np.abs(shift).sum()))
    return {robot.joint_names[i]: float(best[i]) for i in turning}


def _at_start(robot: Robot, table: Measurements, options: Options) -> float:
    try:
        return min(typical_left(*start)[0] for start in starts_of(robot, table, options))
    except (BadInputError, IdentificationError, np.linalg.LinAlgError):
        return np.inf


def _fitted(robot: Robot, table: Measurements, options: Options) -> tuple[float, dict[str, float]]:
    """Return what base, tool and offsets of joints leave together, and these offsets [rad] by name."""
    starts = [*place(robot, {"": table}, options)]
    ((station, values),) = starts
    problem = Problem((station,))
    offsets = np.array([p.effect == JointOffset.name and p.unit == "rad" for p in problem.parameters])
    free, noise = (is_frame(problem) | offsets) & released_of(problem, options), Noise((None,) * len(problem.blocks))
    values = likeliest_values(problem, values, free, priors_of(problem, options), noise, Course("huber", rough=True))
    found = {
        p.name.split(".")[0]: float(value)
        for p, value in zip(problem.parameters, values, strict=True)
        if p.effect == JointOffset.name
    }
    return typical_left(station, values)[0], found
