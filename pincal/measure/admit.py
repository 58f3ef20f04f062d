"""Selection of the rows for fitting or testing, with all checks that need no fit.

Rows without information, by the rules of their sensor, are left out with a warning. Impossible
values, such as degrees, millimetres or swapped joints, are errors; unlikely ones cause warnings.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import (
    BadInputError,
    MeasurementError,
    PincalWarning,
    counted,
    few,
    nearest_first,
    warn,
)
from pincal.measure.column_numbers import JOINT_COLUMNS
from pincal.measure.joint_columns import JointColumns
from pincal.measure.measurements import Measurements, sensor_like, sensor_of
from pincal.robot.robot import Robot
from pincal.sensors.sensor import Excluded, Grouped, Plausible
from pincal.sensors.setup import Setup
from pincal.thresholds import Count

# Lines that a warning lists: of rows left out, and of copies.
_LISTED: Count = 8
_LISTED_LINES: Count = 5


@dataclass(frozen=True)
class Admitted:
    """Tables that can be fitted.

    Attributes:
        tables: the usable rows of each station.
        notes: warnings about unlikely values and rows left out.
        idle: known distances that no row involves.
    """

    tables: dict[str, Measurements]
    notes: tuple[str, ...]
    idle: tuple[str, ...]


def admit(
    robot: Robot,
    tables: Mapping[str, Measurements],
    setup_of: Callable[[str], Setup],
    *,
    holdout: Sequence[Measurements] = (),
) -> Admitted:
    """Return the rows of each station that a fit can use, after all checks that need no fit.

    Their joints are in the robot's order. Known distances may involve points of held-out rows.

    Raises:
        MeasurementError: if a table can't be of this robot, or its rows are too few.
        BadInputError: if a name or file stands for the robot.
    """
    refuse_name(robot)
    tables = {name: table.in_order_of(robot) for name, table in tables.items()}
    setups = {name: setup_of(name) for name in tables}
    idle: list[str] = []
    given = 0
    for setup in {id(setup): setup for setup in setups.values()}.values():
        own = [tables[name] for name in tables if setups[name] is setup]
        idle += _check_distances(setup, [*own, *holdout])
        given += len(setup.distances)
    if idle and len(idle) == given:
        raise MeasurementError(_unused(idle, [*tables.values(), *holdout]))
    found = {}
    with noted() as notes:
        for name, setup in setups.items():
            table = usable_rows(tables[name], setup)
            if len(tables) > 1:
                # The other stations determine the joint offsets.
                check_placeable(table, setup)
            else:
                purpose = (
                    f"to determine the poses of instrument and tool and {robot.n_joints} "
                    "joint offsets"
                )
                _check_count(table, setup, joints=robot.n_joints, purpose=purpose, better=50)
            check_table(robot, table)
            found[name] = table
        _warn_of_copies(tuple(found.values()))
    return Admitted(found, tuple(notes), _idle_note(idle))


def _warn_of_copies(tables: Sequence[Measurements]) -> None:
    """Warn of positions that are those of an earlier table to the last digit, as of a table that is
    given under two names.
    """
    held = [table for table in tables if table.position is not None and not table.is_of_motion]
    marks = [_marks(np.hstack([table.q, np.asarray(table.position)])) for table in held]
    for k, table in enumerate(held):
        for other, seen in zip(held[:k], marks[:k], strict=True):
            if copies := int(np.isin(marks[k], seen).sum()):
                warn(
                    f"{table.source}: {counted(copies, 'row', 'are')} also in {other.source}, to "
                    "the last digit; copies add weight but no information: give each reading once"
                )


def refuse_name(robot: Any) -> None:
    """Refuse a name or a file in place of a robot.

    Raises:
        BadInputError: for these.

    Example:
        >>> refuse_name("ur10")
        Traceback (most recent call last):
        pincal.errors.BadInputError: robot is 'ur10'; expected pincal.Robot.from_urdf('ur10')
    """
    if isinstance(robot, str | os.PathLike):
        raise BadInputError(f"robot is {robot!r}; expected pincal.Robot.from_urdf({robot!r})")


def admit_test(robot: Robot, table: Measurements, setup: Setup) -> Measurements:
    """Return the rows by which a calibration with ``setup`` can be judged; unlikely values cause
    warnings.

    Raises:
        MeasurementError: if the table can't be of this robot, or no row is left.
    """
    table = scorable_rows(table.in_order_of(robot), setup)
    check_table(robot, table, minimum=1)
    return table


@contextmanager
def noted() -> Iterator[list[str]]:
    """Collect the warnings of a block of code in a list, each text once, instead of
    showing them.
    """
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield notes
    notes += dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, PincalWarning))


def usable_rows(measurements: Measurements, setup: Setup) -> Measurements:
    """Return the rows with information; each reason to leave rows out causes a `PincalWarning`.

    Left out are points behind the camera, sockets that were touched once, unknown points that were
    seen once, and unknown anchors of fewer than four distances.

    Raises:
        MeasurementError: if no row is left.
    """
    kind = measurements.sensor
    if kind is None or not issubclass(kind, Grouped):
        return measurements
    sensor = sensor_of(measurements, setup.over(measurements))
    assert isinstance(sensor, Grouped)
    excluded = list(sensor.unusable_rows())
    kept = _kept(measurements, excluded)
    if not len(kept):
        raise MeasurementError(
            f"{measurements.source}: no row is left; expected {excluded[-1].expected}"
        )
    return kept


def scorable_rows(measurements: Measurements, setup: Setup) -> Measurements:
    """Return the rows by which a calibration can be judged; rows left out cause a `PincalWarning`.

    A socket that the calibration did not have is judged by the mean of its rows, so it needs two;
    other new points can't be judged.
    """
    return _kept(measurements, _unscorable(measurements, setup))


def scorable(measurements: Measurements, setup: Setup) -> np.ndarray:
    """Return which rows :func:`scorable_rows` returns, shape (N,), without warnings."""
    lost = np.zeros(len(measurements), bool)
    for part in _unscorable(measurements, setup):
        lost |= part.rows
    return ~lost


def _unscorable(measurements: Measurements, setup: Setup) -> Iterator[Excluded]:
    kind = measurements.sensor
    if kind is not None and issubclass(kind, Grouped) and len(measurements):
        yield from kind.unscorable_rows(measurements, setup)


def unobservable_notes(measurements: Measurements, setup: Setup) -> Iterator[str]:
    """Yield in words what measurements of this kind can't determine, however many rows
    there are.
    """
    return sensor_like(measurements, setup).unobservable()


def _kept(measurements: Measurements, excluded: Iterable[Excluded]) -> Measurements:
    """Return the rows that are not excluded; warn of the others."""
    kept = np.ones(len(measurements), bool)
    for part in excluded:
        kept &= ~part.rows
        if part.rows.any():
            lines = measurements.rows[part.rows]
            listed = few(lines, _LISTED)
            verb, _, rest = part.reason.partition(" ")
            warn(
                f"{measurements.source}: {counted(len(lines), 'row', verb)} {rest} and left out: "
                f"line {listed}"
            )
    return measurements if kept.all() else measurements.select(kept)


def _check_distances(setup: Setup, tables: Sequence[Measurements]) -> tuple[str, ...]:
    """Refuse a known distance between a point of the tables and an unknown one.

    Returns:
        The distances between points in none of the tables: they may belong to another one.
    """
    known = _points_of(tables) | set(setup.points)
    idle = []
    for gap in setup.distances:
        unknown = [name for name in (gap.first, gap.second) if name not in known]
        if len(unknown) == 1 or not known:
            near = ", ".join(nearest_first(unknown, sorted(known))[:6]) if known else "none"
            raise MeasurementError(
                f"a known distance names {unknown[0]!r}; expected one of the points, "
                f"nearest first: {near}"
            )
        idle += [f"{gap.first} to {gap.second}"] if unknown else []
    return tuple(idle)


def _points_of(tables: Sequence[Measurements]) -> set[str]:
    """Return the names of the points of tables."""
    found = [table.point_names for table in tables]
    return {str(name) for names in found if names is not None for name in np.unique(names)}


def _unused(idle: Sequence[str], tables: Sequence[Measurements]) -> str:
    """Return why known distances are refused, none of which is between points of the tables."""
    return (
        f"known distance {few(idle, _LISTED)}: not between points of the table, which has "
        f"{few(sorted(_points_of(tables)), _LISTED)}; expected two of these, or no distance"
    )


def _idle_note(idle: Sequence[str]) -> tuple[str, ...]:
    """Return the note on known distances that no row involves, if there are any."""
    if not idle:
        return ()
    listed = ", ".join(dict.fromkeys(idle))
    return (f"known distances between points without any row are not used: {listed}",)


def check_placeable(measurements: Measurements, setup: Setup) -> None:
    """Refuse a table with too few rows to locate instrument and tool of a known robot with one
    redundant reading.
    """
    purpose = "to determine the poses of instrument and tool of a new station with redundancy"
    _check_count(measurements, setup, joints=1, purpose=purpose, better=10)


def _check_count(
    measurements: Measurements, setup: Setup, *, joints: int, purpose: str, better: int
) -> None:
    """Refuse a table with too few rows for the poses of instrument and tool, and ``joints`` joint
    offsets.
    """
    sensor = sensor_like(measurements, setup)
    tool = len(sensor.tool_symbols) * (
        len(np.unique(measurements.target)) if len(measurements) else 1
    )
    # The parameters of a lens take no further rows: each gives two readings of it.
    own = sum(parameter.unit == "m" for parameter in sensor.parameters)
    fewest = -(-(tool + joints) // 6) + 1
    if sensor.pose_limit and (poses := len(np.unique(measurements.q, axis=0))) < fewest:
        raise MeasurementError(
            f"{measurements.source}: {counted(poses, 'pose')} {sensor.pose_limit}: expected at "
            f"least {fewest}, preferably {min(better, 30)} or more"
        )
    needed = -(
        -(len(sensor.base_symbols) + own + tool + joints)
        // sum(block.size for block in sensor.blocks)
    )
    if len(measurements) < needed:
        what = f"{measurements.kind} measurement"
        raise MeasurementError(
            f"{measurements.source}: {counted(len(measurements), what)}; "
            f"expected at least {needed} {purpose}, preferably {better} or more"
        )


def check_table(robot: Robot, measurements: Measurements, *, minimum: int = 2) -> None:
    """Refuse impossible measurements of this robot, or fewer than ``minimum`` rows; warn of
    unlikely ones.

    Raises:
        MeasurementError: as the other functions of this module.
    """
    check_rows(measurements, minimum=minimum)
    check_joints_of(robot, measurements)
    check_reach(measurements, robot.reach)


def check_joints_of(robot: Robot, measurements: Measurements) -> None:
    """Refuse joint positions that can't be this robot's, by :func:`check_joint_values` and its
    kinematic loops.

    Raises:
        MeasurementError: if a loop can't be closed in some row.
    """
    rows = measurements.of_joints(robot)
    check_joint_values(rows, robot.lower, robot.upper, robot.joint_types)
    if robot.linkage is None or (is_closed := robot.linkage.closed(rows.q)[1]).all():
        return
    drives = ", ".join(robot.joint_names[i] for i in robot.linkage.drivers)
    raise MeasurementError(
        f"{rows.source}, line {rows.rows[~is_closed][0]}: the robot's loops can't be "
        f"closed at these positions of {drives}; "
        f"rows affected: {np.sum(~is_closed)}; check zeros, signs and units"
    )


def check_reach(measurements: Measurements, reach_m: float) -> None:
    """Check the unit of readings against the reach of the flange [m], by the rules of the sensor.

    Raises:
        MeasurementError: for values farther apart than the arm can reach, or closer together than
            the motion of the joints allows though a unit was given, or distances that are no
            lengths of a measuring line.
    """
    sensor = measurements.sensor
    if len(measurements) > 1 and sensor is not None and issubclass(sensor, Plausible):
        sensor.check_plausible(measurements, reach_m)


def check_rows(measurements: Measurements, *, minimum: int) -> None:
    """Check that there are enough rows and that they differ.

    Rows that repeat an earlier one in every column cause a `PincalWarning`; a replicate differs in
    its readings.

    Raises:
        MeasurementError: for fewer rows than needed, or the same pose in all of them.
    """
    count = len(measurements)
    source = measurements.source
    if count < max(minimum, 1):
        raise MeasurementError(
            f"{source}: {counted(count, 'row')}; expected at least {max(minimum, 1)}, measure "
            "more poses"
        )
    if count > 1 and (np.ptp(measurements.q, axis=0) <= JOINT_COLUMNS.constant).all():
        raise MeasurementError(
            f"{source}: all {count} rows have the same joint values; expected different poses"
        )
    lines = _duplicate_lines(measurements)
    if lines:
        warn(
            f"{source}: {counted(len(lines), 'row', 'repeat')} an earlier row in every column "
            f"(line {few(lines, _LISTED_LINES)}); "
            "copies add weight but no information: delete them unless they were measured"
        )


def _marks(rows: np.ndarray) -> np.ndarray:
    """Return a number of each row, shape (N,), which equal rows share."""
    # Adding 0.0 turns -0.0 into 0.0, so that equal rows have equal bits.
    bits = np.ascontiguousarray(rows + 0.0).view(np.uint64)
    odd = np.random.default_rng(0).integers(1, 2**63, rows.shape[1], dtype=np.uint64)
    return np.asarray((bits * odd).sum(axis=1))


def _duplicate_lines(measurements: Measurements) -> list[int]:
    arrays = {name: column for name, column in measurements.columns().items() if name != "rows"}
    numbers = [column for column in arrays.values() if column.dtype.kind in "fi"]
    names = [
        np.unique(column, return_inverse=True)[1]
        for column in arrays.values()
        if column.dtype.kind not in "fi" and np.any(column != column[:1])
    ]
    table = (
        np.column_stack([np.asarray(column, dtype=float) for column in (*numbers, *names)]) + 0.0
    )
    marks = _marks(table)
    in_order = np.sort(marks)
    again = in_order[1:][in_order[1:] == in_order[:-1]]
    if not len(again):
        return []
    candidates = np.flatnonzero(np.isin(marks, again))
    _, first = np.unique(table[candidates], axis=0, return_index=True)
    return list(measurements.rows[np.delete(candidates, first)].tolist())


def check_joint_values(
    measurements: Measurements, lower: ArrayLike, upper: ArrayLike, joint_types: Sequence[str]
) -> None:
    """Check that joint values are in rad or m, in the right columns and within the limits.

    Each joint with values beyond its limits causes a `PincalWarning`.

    Args:
        measurements: the table, N rows of n joints.
        lower: lower joint limits [rad], prismatic [m], shape (n,); -inf without a limit.
        upper: upper joint limits, likewise; a joint with lower >= upper is unlimited.
        joint_types: "revolute" or "prismatic" for each joint.

    Raises:
        MeasurementError: for degrees or millimetres without a unit, or two swapped columns.
    """
    if measurements.q.size:
        JointColumns.of(measurements, lower, upper, joint_types).check()
