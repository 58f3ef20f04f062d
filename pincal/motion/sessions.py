"""Sessions: streams of joints, an IMU and an instrument in motion, each with the stamps of its own
clock.

Impossible values are refused on reading. Faults that only show relative to the arm, such as rates
in other units or a mirrored IMU, are found when a stream is aligned with the motion
(:mod:`pincal.motion.starts`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.admit import check_joint_values
from pincal.measure.labels import columns_listed, is_named
from pincal.measure.measurements import measurements
from pincal.measure.reader import Cells, cells_of, open_sheet, typed_errors
from pincal.measure.sheet import Sheet
from pincal.measure.table_schema import TABLE_ENDINGS, Schema, TableOptions
from pincal.motion.stamps import in_order
from pincal.motion.stream import Stream, checked_imu, checked_joints, interpolated
from pincal.readers.recordings import is_bag, open_streams
from pincal.robot.robot import Robot
from pincal.sensors.fields import CONDITIONS, Field
from pincal.sensors.imu import FORCE, RATE
from pincal.sensors.registry import check_fields, known_fields, sensor_class

STREAMS = ("joints", "imu", "tracker")
"""The streams of a session, by the names of their files."""


@dataclass(frozen=True, eq=False)
class Session:
    """The logs of one motion.

    Attributes:
        name: of the session.
        joints: positions "q" of the URDF's joints, with "payload" where a load was carried [kg].
        imu: an IMU on the tool; None without one.
        tracker: an instrument that observes the tool; None without one.
    """

    name: str
    joints: Stream
    imu: Stream | None = None
    tracker: Stream | None = None

    @property
    def payload(self) -> float:
        """Mass carried at the tip [kg]."""
        return (
            float(self.joints.readings["payload"][0]) if "payload" in self.joints.readings else 0.0
        )


def joints_of_session(path: str | os.PathLike[str]) -> Path | None:
    """Return the log of the joints of a session, a folder or a recording of ROS with an IMU; None
    for other paths.
    """
    path = Path(path)
    if is_bag(path):
        return path if path.exists() and "imu" in open_streams(path) else None
    return next(iter(_files(path, "joints")), None) if path.is_dir() else None


def read_session(robot: Robot, folder: str | os.PathLike[str], **options: Any) -> Session:
    """Read a folder with ``joints``, and ``imu`` or ``tracker`` or both, as tables of any format;
    or a recording of ROS.

    Args:
        robot: the robot.
        folder: the folder.
        options: ``columns`` and ``ignore``, see :class:`pincal.measure.table_schema.TableOptions`.

    Raises:
        MeasurementError: for a file that is missing or can't be read, or an impossible stream.
    """
    folder = Path(folder)
    if is_bag(folder):
        return read_streams(robot, joints=folder, name=folder.stem, **options)
    found = dict[str, Path]()
    for what in STREAMS:
        files = _files(folder, what)
        if len(files) > 1:
            names = ", ".join(path.name for path in files)
            raise MeasurementError(
                f"{folder}: {names}; expected one file of {what}: move the others elsewhere"
            )
        found |= {what: files[0]} if files else {}
    if "joints" not in found or len(found) < 2:
        raise MeasurementError(
            f"{folder}: has {', '.join(path.name for path in found.values()) or 'no stream'}; "
            "expected joints.csv, and imu.csv or tracker.csv or both (or .parquet)"
        )
    return read_streams(robot, name=folder.name, **found, **options)


def _files(folder: Path, what: str) -> list[Path]:
    return sorted(path for path in folder.glob(f"{what}.*") if path.suffix.lower() in TABLE_ENDINGS)


def read_streams(
    robot: Robot,
    *,
    joints: str | os.PathLike[str],
    imu: str | os.PathLike[str] | None = None,
    tracker: str | os.PathLike[str] | None = None,
    name: str = "",
    **options: Any,
) -> Session:
    """Read the streams of a session, each a table with a column ``time``, or a recording of ROS
    with its topic.

    Args:
        robot: the robot.
        joints: table of the joints; a recording may contain the others as well.
        imu: table of an IMU, ``ax ay az wx wy wz``.
        tracker: table of an instrument's readings.
        name: of the session.
        options: as for :func:`read_session`.

    Raises:
        MeasurementError: as there.
    """
    given = TableOptions(**options)
    places = {
        what: Path(path)
        for what, path in (("joints", joints), ("imu", imu), ("tracker", tracker))
        if path is not None
    }
    sheets = _sheets(places, robot, given)
    every = [label for sheet in sheets.values() for label in sheet.labels]
    found = {}
    for what, sheet in sheets.items():
        own = _own_names(sheet, every, given.columns)
        cells = cells_of(sheet, _schema(robot, what, replace(given, columns=own)), is_part=True)
        path = sheet.path
        source = f"{name}/{path.name}" if name and path.stem != name else path.name
        found[what] = _checked(what, source, cells)
    found["joints"] = _checked_joints(robot, found["joints"])
    q = found["joints"].readings["q"]
    if robot.couplings:
        found["joints"] = replace(
            found["joints"], readings={**found["joints"].readings, "q": robot.from_reported(q)}
        )
    return Session(name, **found)


def _sheets(given: Mapping[str, Path], robot: Robot, options: TableOptions) -> dict[str, Sheet]:
    """Return the sheets of streams by their files; a recording of the joints has others as well."""
    recorded = {
        path: open_streams(path, ignore=options.ignore)
        for path in set(given.values())
        if is_bag(path)
    }
    joints = given["joints"]
    others = (what for what in STREAMS[1:] if what not in given)
    places = {**given, **{what: joints for what in others if what in recorded.get(joints, {})}}
    return {
        what: _sheet(what, path, recorded.get(path), robot, options)
        for what, path in places.items()
    }


def _own_names(sheet: Sheet, every: Sequence[str], columns: Mapping[str, str]) -> dict[str, str]:
    """Return the meanings of the names that a sheet has, or that none has: each is given once for
    all files.
    """
    return {
        name: meaning
        for name, meaning in columns.items()
        if any(is_named(label, name) for label in sheet.labels)
        or not any(is_named(label, name) for label in every)
    }


def _sheet(
    what: str, path: Path, recorded: Mapping[str, Sheet] | None, robot: Robot, options: TableOptions
) -> Sheet:
    """Return the sheet of a stream, by the topic of a recording or as a table."""
    if recorded is not None:
        if what not in recorded:
            raise MeasurementError(
                f"{path.name}: no topic of {what}; give a table, or a recording that has it"
            )
        return recorded[what]
    with typed_errors(path):
        return open_sheet(
            path, ignore=options.ignore, joints=robot.joint_names if what == "joints" else ()
        )


def _schema(robot: Robot, what: str, options: TableOptions) -> Schema:
    """Return the possible contents of a stream; further columns are left out."""
    fields = {
        "joints": (CONDITIONS["time"], CONDITIONS["payload"]),
        "imu": (FORCE, RATE, CONDITIONS["time"]),
    }
    known = tuple(field for field in known_fields().values() if field not in (FORCE, RATE))
    schema = Schema(fields.get(what, known), options=options, is_stream=True)
    return schema.of_robot(robot) if what == "joints" else schema


def _checked(what: str, source: str, cells: Cells) -> Stream:
    """Return a valid stream, or raise an error."""
    arrays = dict(cells.arrays)
    time = arrays.pop("time", None)
    listed = columns_listed(cells.sheet.labels)
    if time is None:
        raise MeasurementError(
            f"{source}: no column time; expected the stamps of its own clock, in order; {listed}: "
            "is it one of them (--columns 'NAME=time [s]')?"
        )
    if what == "imu":
        _check_imu_columns(arrays, listed, source=source)
        return checked_imu(in_order(Stream(source, time, arrays, cells.units, cells.rows)))
    if what == "joints":
        arrays = {name: arrays[name] for name in ("q", "payload") if name in arrays}
        _check_one_load(arrays.get("payload", np.zeros(1)), source=source)
        return in_order(Stream(source, time, arrays, cells.units, cells.rows))
    fields = _fields_read(arrays, listed, source=source)
    kept = [*(field.name for field in fields), "target"]
    arrays = {name: arrays[name] for name in kept if name in arrays}
    return _seen(in_order(Stream(source, time, arrays, cells.units, cells.rows)), fields[0])


def _check_imu_columns(arrays: Mapping[str, np.ndarray], listed: str, *, source: str) -> None:
    for field in (FORCE, RATE):
        if field.name not in arrays:
            raise MeasurementError(
                f"{source}: no columns {field}; expected {FORCE} [m/s^2] and {RATE} [rad/s]; "
                f"{listed}: name them (--columns 'NAME={field.columns[0]},...')"
            )


def _check_one_load(load: np.ndarray, *, source: str) -> None:
    if np.ptp(load) > 0.0:
        raise MeasurementError(
            f"{source}: payload from {load.min():g} to {load.max():g} kg; expected one load "
            "carried along a path: give the parts as separate sessions"
        )


def _fields_read(
    arrays: Mapping[str, np.ndarray], listed: str, *, source: str
) -> tuple[Field, ...]:
    """Return the fields of the sensor of an instrument's columns; refuse those of none."""
    check_fields(arrays, source=source)
    sensor = sensor_class(arrays)
    if sensor is None:
        raise MeasurementError(
            f"{source}: no readings; expected columns such as x y z, or x y z qx qy qz qw; "
            f"{listed}: name them (--columns 'NAME=x,...')"
        )
    return sensor.fields


def _seen(stream: Stream, main: Field) -> Stream:
    """Return the readings of a target that was seen, by the main field of its sensor."""
    if main.is_name:
        return stream
    values = stream.readings[main.name].reshape(len(stream), -1)
    stream = stream.without(
        np.all(values == 0.0, axis=1), f"read exactly 0 in {main}: the target was lost"
    )
    if not stream.things.any():
        lost = interpolated(stream.readings[main.name].reshape(len(stream), -1))
        stream = stream.without(
            lost,
            "are evenly spaced on straight lines: the target was lost, and they are interpolated",
        )
    return stream


def _checked_joints(robot: Robot, joints: Stream) -> Stream:
    """Return the joints, with plausible values and without jumps."""
    table = measurements(
        robot, joints.readings["q"], rows=joints.lines, source=joints.name, units=joints.units
    )
    check_joint_values(table, robot.lower, robot.upper, robot.joint_types)
    return checked_joints(
        joints, robot.joint_names, np.array([kind == "revolute" for kind in robot.joint_types])
    )
