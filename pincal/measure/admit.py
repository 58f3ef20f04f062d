"""Which rows of a table can be fitted or judged by, after all checks that need no fit.

Rows that can tell nothing are left out with a warning, and all others are still processed; the rules are the sensors'.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from pincal.errors import MeasurementError, PincalWarning, nearest_first
from pincal.measure.checks import check_table
from pincal.measure.measurements import Measurements
from pincal.measure.sensing import sensor_like, sensor_of
from pincal.measure.sensor import Excluded, Grouped
from pincal.measure.setup import Setup
from pincal.robot.robot import Robot

# Lines that a warning lists.
_LISTED = 8


@dataclass(frozen=True)
class Admitted:
    """Tables that can be fitted.

    Attributes:
        tables: the usable rows of each station.
        notes: what is odd, but possible, and what was left out.
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
    """Return the rows that a fit can use, after all checks that need no fit.

    Args:
        robot: the arm.
        tables: the rows of each station.
        setup_of: takes the name of a station and returns what is known of it.
        holdout: further rows that may involve points of known distances.

    Raises:
        MeasurementError: if a table can't be of this robot, or its rows are too few.
    """
    setups = {name: setup_of(name) for name in tables}
    idle: list[str] = []
    for setup in {id(setup): setup for setup in setups.values()}.values():
        idle += _check_distances(setup, [*(tables[name] for name in tables if setups[name] is setup), *holdout])
    found = {}
    with noted() as notes:
        for name, setup in setups.items():
            table = usable_rows(tables[name], setup)
            if len(tables) > 1:
                # The other stations tell the joint offsets.
                check_placeable(table, setup)
            else:
                told = f"to tell where instrument and tool stand and {robot.n_joints} joint offsets"
                _check_count(table, setup, joints=robot.n_joints, told=told, better=50)
            check_table(robot, table)
            found[name] = table
    return Admitted(found, tuple(notes), tuple(dict.fromkeys(idle)))


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


def usable_rows(measurements: Measurements, setup: Setup) -> Measurements:
    """Return the rows that can tell something; each reason to leave rows out causes a `PincalWarning`.

    Left out are points behind the camera, sockets that were touched only once, unknown points that were seen only once, and
    unknown anchors of fewer than four distances.

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
        raise MeasurementError(f"{measurements.source}: no row is left; expected {excluded[-1].expected}")
    return kept


def scorable_rows(measurements: Measurements, setup: Setup) -> Measurements:
    """Return the rows that a calibration can be judged by; rows left out cause a `PincalWarning`.

    A socket that the calibration did not have is judged by the mean of its rows, so it needs two; any other point that it
    did not have can't be judged.

    Args:
        measurements: rows that it never saw.
        setup: the points that it had.
    """
    return _kept(measurements, _unscorable(measurements, setup))


def scorable(measurements: Measurements, setup: Setup) -> np.ndarray:
    """Return which rows a calibration can be judged by, shape (N,), as :func:`scorable_rows` has it, without warnings."""
    lost = np.zeros(len(measurements), bool)
    for part in _unscorable(measurements, setup):
        lost |= part.rows
    return ~lost


def _unscorable(measurements: Measurements, setup: Setup) -> Iterator[Excluded]:
    kind = measurements.sensor
    if kind is not None and issubclass(kind, Grouped) and len(measurements):
        yield from kind.unscorable_rows(measurements, setup)


def unobservable_notes(measurements: Measurements, setup: Setup) -> Iterator[str]:
    """Yield what measurements of this kind can't determine, however many rows there are, in words."""
    return sensor_like(measurements, setup).unobservable()


def _kept(measurements: Measurements, excluded: Iterable[Excluded]) -> Measurements:
    """Return the rows that are not excluded; warn of the others."""
    kept = np.ones(len(measurements), bool)
    for part in excluded:
        kept &= ~part.rows
        if part.rows.any():
            lines = measurements.rows[part.rows]
            listed = ", ".join(str(line) for line in lines[:_LISTED]) + (" ..." if len(lines) > _LISTED else "")
            text = f"{measurements.source}: {len(lines)} rows {part.reason} and are left out: lines {listed}"
            warnings.warn(text, PincalWarning, stacklevel=3)
    return measurements if kept.all() else measurements.select(kept)


def _check_distances(setup: Setup, tables: Sequence[Measurements]) -> tuple[str, ...]:
    """Refuse a known distance from a point of the tables to one that nobody knows.

    Returns:
        A note on distances between points that are in none of the tables: they may belong to another one.
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


def check_placeable(measurements: Measurements, setup: Setup) -> None:
    """Refuse a table that could not tell where instrument and tool of a known robot stand, and check it by one reading.

    Raises:
        MeasurementError: saying how many rows are needed.
    """
    told = "to tell where instrument and tool of a new station stand, with a reading to spare"
    _check_count(measurements, setup, joints=1, told=told, better=10)


def _check_count(measurements: Measurements, setup: Setup, *, joints: int, told: str, better: int) -> None:
    """Refuse a table that could not even tell where instrument and tool stand, and so many joint offsets."""
    sensor = sensor_like(measurements, setup)
    tool = len(sensor.tool_symbols) * (len(np.unique(measurements.target)) if len(measurements) else 1)
    # What a camera's lens is like takes no rows beyond: any one of them tells two readings of it.
    own = sum(parameter.unit == "m" for parameter in sensor.parameters)
    poses = len(np.unique(measurements.q, axis=0))
    fewest = -(-(tool + joints) // 6) + 1
    if sensor.pose_limit and poses < fewest:
        raise MeasurementError(
            f"{measurements.source}: {poses} poses {sensor.pose_limit}: expected at least {fewest}, "
            f"and better {min(better, 30)} or more"
        )
    needed = -(-(len(sensor.base_symbols) + own + tool + joints) // sum(block.size for block in sensor.blocks))
    if len(measurements) < needed:
        raise MeasurementError(
            f"{measurements.source}: {len(measurements)} rows of kind {measurements.kind}; expected at least {needed} "
            f"{told}, and better {better} or more"
        )
