"""All checks of a table before a fit, in one call: does it belong to this robot, and is it enough?"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.admission import scorable_rows, usable_rows
from pincal.measure.checks import TableFindings, check_measurements
from pincal.measure.fields import nearest_first
from pincal.measure.measurements import Measurements
from pincal.measure.sensing import sensor_like
from pincal.measure.setup import Setup
from pincal.robot.robot import Robot


@dataclass(frozen=True)
class Admitted:
    """A table that can be fitted.

    Attributes:
        table: its usable rows.
        notes: what is odd, but possible, and what was left out.
        idle: known distances that no row involves.
    """

    table: Measurements
    notes: tuple[str, ...]
    idle: tuple[str, ...]


def admit(robot: Robot, table: Measurements, setup: Setup, *, holdout: Measurements | None = None) -> Admitted:
    """Return the rows of a table that a fit can use, after all checks that need no fit.

    Args:
        robot: the arm.
        table: the table.
        setup: named points, distances and camera, as far as they are known.
        holdout: further rows that may involve points of known distances.

    Raises:
        MeasurementError: if the table can't be of this robot, or its rows are too few.
    """
    idle = check_gaps(setup, [table] if holdout is None else [table, holdout])
    with noted() as notes:
        table = usable_rows(table, setup)
        check_count(robot, table, setup)
        check_table(robot, table)
    return Admitted(table, tuple(notes), idle)


def admit_test(robot: Robot, table: Measurements, setup: Setup) -> Measurements:
    """Return the rows of a table by which a calibration that knew ``setup`` can be judged; oddities cause warnings.

    Raises:
        MeasurementError: if the table can't be of this robot, or no row is left.
    """
    table = scorable_rows(table, setup)
    check_table(robot, table, minimum=1)
    return table


@contextmanager
def noted() -> Iterator[list[str]]:
    """Collect the warnings of a block of code in a list, each text once, instead of showing them."""
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield notes
    notes += dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, PincalWarning))


def check_table(robot: Robot, measurements: Measurements, *, minimum: int = 2) -> TableFindings:
    """Refuse what can't be measurements of this robot; warn of what is merely odd.

    Args:
        robot: the arm.
        measurements: the table.
        minimum: fewest rows that are enough.

    Raises:
        MeasurementError: as :func:`pincal.measure.checks.check_measurements`.
    """
    return check_measurements(
        measurements,
        lower=robot.lower,
        upper=robot.upper,
        joint_types=robot.joint_types,
        reach_m=robot.reach,
        minimum=minimum,
    )


def check_gaps(setup: Setup, tables: Sequence[Measurements]) -> tuple[str, ...]:
    """Refuse a known distance from a point of the tables to one that nobody knows.

    Returns:
        A note on distances between points that are in none of the tables: they may belong to another one.

    Raises:
        MeasurementError: naming the unknown point.
    """
    found = [table.point_names for table in tables]
    known = {str(name) for names in found if names is not None for name in np.unique(names)} | set(setup.points)
    idle = []
    for gap in setup.distances:
        unknown = [name for name in (gap.first, gap.second) if name not in known]
        if len(unknown) == 1 or not known:
            near = ", ".join(nearest_first(unknown, sorted(known))[:6]) if known else "none"
            raise MeasurementError(
                f"a known distance names {unknown[0]!r}; expected one of the points, nearest first: {near}"
            )
        idle += [f"{gap.first} to {gap.second}"] if unknown else []
    return (f"known distances between points that are in no row are not used: {', '.join(idle)}",) if idle else ()


def check_count(robot: Robot, measurements: Measurements, setup: Setup | None = None) -> None:
    """Refuse a table that could not even tell where instrument and tool stand.

    Raises:
        MeasurementError: saying how many rows are needed.
    """
    sensor = sensor_like(measurements, setup or Setup())
    targets = len(np.unique(measurements.target)) if len(measurements) else 1
    tool = len(sensor.tool_symbols) * targets
    # What a camera's lens is like takes no rows beyond: any one of them tells two readings of it.
    own = sum(parameter.unit == "m" for parameter in sensor.parameters)
    poses = len(np.unique(measurements.q, axis=0))
    fewest = -(-(tool + robot.n_joints) // 6) + 1
    if sensor.pose_limit and poses < fewest:
        raise MeasurementError(
            f"{measurements.source}: {poses} poses {sensor.pose_limit}: expected at least {fewest}, and better 30 or more"
        )
    needed = -(-(len(sensor.base_symbols) + own + tool + robot.n_joints) // sum(block.size for block in sensor.blocks))
    if len(measurements) < needed:
        raise MeasurementError(
            f"{measurements.source}: {len(measurements)} rows of kind {measurements.kind}; expected at least {needed} "
            f"to tell where instrument and tool stand and {robot.n_joints} joint offsets, and better 50 or more"
        )
