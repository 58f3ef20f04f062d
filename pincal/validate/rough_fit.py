"""Rough fits of a nominal robot to a table which may not be its own: base and tool, and large zero
errors.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pincal.errors import BadInputError, IdentificationError
from pincal.identify.beliefs import bounds_of, is_frame, priors_of, released_of
from pincal.identify.fit import Priors
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
from pincal.thresholds import Count, Scale
from pincal.validate.agreement_numbers import AGREEMENT

# Rows that suffice for a typical error.
_TYPICAL: Count = 1000
# Step of the search over a turn of one joint [rad], fits converging from some 20 deg; number of
# joints tried, the most promising ones.
_STEP: Scale = np.deg2rad(15.0)
_TRIED: Count = 4
UNFIT = (BadInputError, IdentificationError, np.linalg.LinAlgError)
"""Errors that end fits to a table which is not of the robot."""


def typical_residuals(station: Station, values: np.ndarray) -> tuple[float, float]:
    """Return the median error of position [m] and of orientation [rad], robust against outliers."""
    if not station.sensor.reads_place:
        return 0.0, 0.0
    station = station.sample(_TYPICAL)
    position = float(np.median(np.linalg.norm(station.displacements(values), axis=1)))
    turned = [
        rows
        for rows, b in zip(station.block_rows, station.sensor.blocks, strict=True)
        if b.unit == "rad"
    ]
    if not turned:
        return position, 0.0
    residuals = station.residuals(values)
    return position, max(
        float(np.median(np.linalg.norm(residuals[part], axis=0))) for part in turned
    )


def least_size(
    robot: Robot,
    table: Measurements,
    options: Options,
    size: Callable[[tuple[float, float]], float],
) -> float:
    """Return the size of the residuals of the best first placement, inf if there is none."""
    with suppress(*UNFIT):
        return min(size(typical_residuals(*start)) for start in starts_of(robot, table, options))
    return np.inf


def roughly_placed(
    robot: Robot,
    table: Measurements,
    options: Options,
    *,
    offsets: bool = False,
    lengths: Collection[str] = (),
) -> tuple[Station, np.ndarray]:
    """Return a station and its values, with base and tool fitted, and the offsets of revolute
    joints if asked for, and lengths by the names of their parameters.
    """
    ((station, values),) = place(robot, {"": table}, options)
    problem = Problem((station,))
    free = is_frame(problem)
    priors = Priors(np.full(len(values), np.inf), bounds_of(problem, options))
    if offsets:
        free = free | np.array(
            [
                (p.effect == JointOffset.name and p.unit == "rad") or p.name in lengths
                for p in problem.parameters
            ]
        )
        priors = priors_of(problem, options)
    free = free & released_of(problem, options)
    noise = Noise((None,) * len(problem.blocks))
    return station, likeliest_values(
        problem, values, free, priors, noise, Course("huber", rough=True)
    )


def revolute_joints(robot: Robot) -> tuple[str, ...]:
    """Return the names of the revolute joints that are neither mimic joints nor their sources."""
    free = free_joints(robot)
    kinds = zip(robot.joint_names, robot.joint_types, strict=True)
    return tuple(name for name, kind in kinds if kind != "prismatic" and name in free)


def zero_shifts(robot: Robot, table: Measurements, options: Options) -> dict[str, float]:
    """Return the zero shifts of joints that minimise the residuals with base and tool fitted [rad],
    by name.

    One joint may be shifted by any angle, the others as far as a fit converges from zero. ``table``
    holds some of the rows.
    """
    options = replace(
        options, effects=(JointOffset(),), zeros=("*",), earlier=None, moment_frame="paper"
    )
    search = _ZeroSearch(robot, table, options)
    likely = sorted(search.turns(), key=lambda one: one[0])[:_TRIED]
    found = []
    for shift in (np.zeros(robot.n_joints), *(shift for _, shift in likely)):
        with suppress(*UNFIT):
            found.append(search.fitted(shift))
    if not found:
        return {}
    least = min(rest for rest, _ in found)
    # The first joint's shift is a turn of the base: the smallest of equally good ones is taken.
    alike = [within_a_turn(shift) for rest, shift in found if rest < AGREEMENT.alike * least]
    best = min(alike, key=lambda shift: float(np.abs(shift).sum()))
    return {robot.joint_names[i]: float(best[i]) for i in search.turning}


@dataclass(frozen=True)
class _ZeroSearch:
    """A search for the zeros of joints by some rows, with base, tool and all zeros free."""

    robot: Robot
    table: Measurements
    options: Options

    @cached_property
    def turning(self) -> list[int]:
        """Indices of the revolute joints that are measured."""
        return [self.robot.joint_names.index(name) for name in revolute_joints(self.robot)]

    def turns(self) -> Iterator[tuple[float, np.ndarray]]:
        """Yield, for each joint, the turn by which the first placement leaves least, with what it
        leaves [m].
        """
        for i in self.turning:
            angles = np.arange(_STEP, 2.0 * np.pi - 0.5 * _STEP, _STEP)
            shifts = [
                np.eye(self.robot.n_joints)[i] * (angle - 2.0 * np.pi * (angle > np.pi))
                for angle in angles
            ]
            sizes = (
                least_size(self.robot, self._shifted(shift), self.options, lambda left: left[0])
                for shift in shifts
            )
            yield min(zip(sizes, shifts, strict=True), key=lambda one: one[0])

    def fitted(self, shift: np.ndarray) -> tuple[float, np.ndarray]:
        """Return what a fit from a shift leaves [m], and the shift that it finds, shape (n,)."""
        station, values = roughly_placed(
            self.robot, self._shifted(shift), self.options, offsets=True
        )
        pairs = zip(station.parameters, values.tolist(), strict=True)
        offsets = {
            p.name.split(".")[0]: value for p, value in pairs if p.effect == JointOffset.name
        }
        rest = typical_residuals(station, values)[0]
        return rest, shift + [offsets.get(name, 0.0) for name in self.robot.joint_names]

    def _shifted(self, shift: np.ndarray) -> Measurements:
        q = self.table.q + self.robot.as_reported(shift[None])[0]
        return replace(self.table, q=q)


def within_a_turn(shift: np.ndarray) -> np.ndarray:
    """Return angles between -pi and pi."""
    return np.asarray(shift - 2.0 * np.pi * np.round(shift / (2.0 * np.pi)))
