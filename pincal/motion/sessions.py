"""Streams of an arm that moves: its joints, an IMU, an instrument, each by the stamps of its own clock.

What can't be right is refused when it is read, or told with what to do. What only the arm can tell, such as rates in other
units or a mirrored IMU, is found when a stream is laid onto the motion (:mod:`pincal.motion.starts`).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.measure.fields import CONDITIONS, TABLE_ENDINGS, Schema, TableOptions
from pincal.measure.reader import Cells, cells_of, open_sheet, read_table, typed_errors
from pincal.measure.recordings import is_bag, open_streams
from pincal.measure.registry import check_fields, known_fields, sensor_class
from pincal.measure.sensors.imu import FORCE, RATE
from pincal.robot.robot import Robot
from pincal.units import STANDARD_GRAVITY

STREAMS = ("joints", "imu", "tracker")
"""What a session has, by the names of its files."""
# Slowest log that a motion can be followed by [Hz], slowest instrument beside it, and the fastest log that there is.
_SLOWEST, _SLOW, _FASTEST = 10.0, 2.0, 2e4
# A gap is longer than so many samples; one of more than this [s] is told.
_GAP, _LONG = 3.0, 0.2
# Part of the rows that may be lost, by being doubled or cut off, before a stream is no good.
_FEW = 0.05
# What gravity is in units in which logs have it, and by how much it may be off.
_GRAVITIES = {"g": 1.0, "mg": 1e3, "mm/s^2": 1e3 * STANDARD_GRAVITY}
_NEAR = 1.5
# Samples in a row at the same largest value from which an axis is cut off there, and times that this has to happen.
_FLAT, _OFTEN = 3, 3
# Time for which an axis may read the same while others move by so much of what they do altogether [s].
_FROZEN, _MOVES = 1.0, 0.5


@dataclass(frozen=True, eq=False, repr=False)
class Stream:
    """Readings of one device, one after the other.

    Attributes:
        name: of its file, for messages.
        time: by its own clock, shape (T,), increasing [s].
        readings: values in SI units, shape (T,) or (T, k) each: "q" of joints, "specific_force" and "angular_rate" of an
            IMU, of an instrument the fields of its sensor.
        units: that the header gave, by column.
    """

    name: str
    time: np.ndarray
    readings: Mapping[str, np.ndarray]
    units: Mapping[str, str]

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        return f"Stream({self.name!r}: {', '.join(self.readings)}, {len(self)} rows at {self.rate:.4g} Hz)"

    @property
    def rate(self) -> float:
        """Samples a second, gaps left out."""
        return 1.0 / float(np.median(self.steps))

    @property
    def steps(self) -> np.ndarray:
        """From one stamp to the next that differs [s]."""
        steps = np.diff(self.time)
        return steps[steps > 0.0]

    @property
    def things(self) -> np.ndarray:
        """What each row is about, such as a named point, as numbers from 0, shape (T,): one instant may tell of several."""
        found = np.zeros(len(self), int)
        for values in self.readings.values():
            if values.dtype.kind not in "fi":
                names, index = np.unique(values, return_inverse=True)
                found = np.unique(found * len(names) + index, return_inverse=True)[1]
        return found

    def select(self, rows: np.ndarray) -> Stream:
        """Return some of the rows (mask or indices)."""
        chosen = {name: values[rows] for name, values in self.readings.items()}
        return replace(self, time=self.time[rows], readings=chosen)


@dataclass(frozen=True, eq=False)
class Session:
    """What was logged of one motion.

    Attributes:
        name: of the session.
        joints: positions of the robot's joints, as the URDF has them; "payload" beside "q" where a load was carried [kg].
        imu: an IMU on the tool; None without one.
        tracker: an instrument that reads the tool; None without one.
    """

    name: str
    joints: Stream
    imu: Stream | None = None
    tracker: Stream | None = None

    @property
    def payload(self) -> float:
        """Mass that was carried at the tip [kg]."""
        return float(self.joints.readings["payload"][0]) if "payload" in self.joints.readings else 0.0


def joints_of_session(path: str | os.PathLike[str]) -> Path | None:
    """Return the log of the joints of a session, a folder or a recording of ROS with an IMU; None for anything else."""
    path = Path(path)
    if is_bag(path):
        return path if path.exists() and "imu" in open_streams(path) else None
    return next(iter(_files(path, "joints")), None) if path.is_dir() else None


def read_session(robot: Robot, folder: str | os.PathLike[str], **options: Any) -> Session:
    """Read a folder with ``joints``, and ``imu`` or ``tracker`` or both, as tables of any format; or a recording of ROS.

    Args:
        robot: the robot.
        folder: the folder.
        options: how tables are to be read: ``columns`` and ``ignore``, see :class:`pincal.measure.fields.TableOptions`.

    Raises:
        MeasurementError: for a file that is missing or can't be read, or a stream that can't be right.
    """
    folder = Path(folder)
    if is_bag(folder):
        return read_streams(robot, joints=folder, name=folder.stem, **options)
    found = dict[str, Path]()
    for what in STREAMS:
        files = _files(folder, what)
        if len(files) > 1:
            names = ", ".join(path.name for path in files)
            raise MeasurementError(f"{folder}: {names}; expected one file of {what}: move the others elsewhere")
        found |= {what: files[0]} if files else {}
    if "joints" not in found or len(found) < 2:
        raise MeasurementError(
            f"{folder}: has {', '.join(path.name for path in found.values()) or 'no stream'}; expected joints.csv, and "
            "imu.csv or tracker.csv or both (or .parquet)"
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
    """Read the streams of a session, each a table with a column ``time``, or a recording of ROS that has its topic.

    Args:
        robot: the robot.
        joints: table of the joints; a recording may have the others as well.
        imu: table of an IMU, ``ax ay az wx wy wz``.
        tracker: table of an instrument's readings.
        name: of the session.
        options: as :func:`read_session` takes them.

    Raises:
        MeasurementError: as there.
    """
    said = TableOptions(**options)
    places = {
        what: Path(path) for what, path in (("joints", joints), ("imu", imu), ("tracker", tracker)) if path is not None
    }
    recorded = {path: open_streams(path, ignore=said.ignore) for path in set(places.values()) if is_bag(path)}
    for what in STREAMS[1:]:
        if what not in places and what in recorded.get(places["joints"], {}):
            places[what] = places["joints"]
    found = {}
    for what, path in places.items():
        schema = _schema(robot, what, said)
        if path in recorded:
            if what not in recorded[path]:
                raise MeasurementError(f"{path.name}: no topic of {what}; give a table, or a recording that has it")
            cells = cells_of(recorded[path][what], schema, is_part=True)
        else:
            cells = _read(path, schema)
        found[what] = _checked(what, f"{name}/{path.name}" if name and path.stem != name else path.name, cells)
    q = found["joints"].readings["q"]
    if robot.couplings:
        found["joints"] = replace(found["joints"], readings={**found["joints"].readings, "q": robot.from_reported(q)})
    return Session(name, **found)


def _read(path: Path, schema: Schema) -> Cells:
    if not schema.joint_names:
        return read_table(path, schema)
    # A table of joints alone is no log that is cut into held poses.
    with typed_errors(path):
        sheet = open_sheet(path, ignore=schema.options.ignore, joints=schema.joint_names)
    return cells_of(sheet, schema, is_part=True)


def _schema(robot: Robot, what: str, said: TableOptions) -> Schema:
    """Return what the table of a stream may hold; further columns are left out."""
    options, time = replace(said, ignore=(*said.ignore, "*")), CONDITIONS["time"]
    if what == "joints":
        return Schema((time, CONDITIONS["payload"]), options=options).of_robot(robot)
    if what == "imu":
        return Schema((FORCE, RATE, time), options=options)
    return Schema(tuple(known_fields().values()), options=options)


def _checked(what: str, source: str, cells: Cells) -> Stream:
    """Return a stream that can be right, or say what is wrong with it."""
    arrays = dict(cells.arrays)
    time = arrays.pop("time", None)
    if time is None:
        raise MeasurementError(f"{source}: no column time; expected the stamps of its own clock, in order")
    if what == "imu":
        for field in (FORCE, RATE):
            if field.name not in arrays:
                raise MeasurementError(f"{source}: no columns {field}; expected {FORCE} [m/s^2] and {RATE} [rad/s]")
    elif what == "joints":
        arrays = {name: arrays[name] for name in ("q", "payload") if name in arrays}
        load = arrays.get("payload", np.zeros(1))
        if np.ptp(load) > 0.0:
            raise MeasurementError(
                f"{source}: payload from {load.min():g} to {load.max():g} kg; expected one load carried along a path: give "
                "the parts as sessions of their own"
            )
    else:
        check_fields(arrays, source=source)
        sensor = sensor_class(arrays)
        if sensor is None:
            raise MeasurementError(f"{source}: no readings; expected such as x y z, or x y z qx qy qz qw")
        kept = [*(field.name for field in sensor.fields), "target"]
        arrays = {name: arrays[name] for name in kept if name in arrays}
    stream = _in_order(Stream(source, time, arrays, cells.units), cells.rows)
    return checked_imu(stream) if what == "imu" else stream


def _in_order(stream: Stream, rows: np.ndarray) -> Stream:
    """Return a stream whose stamps increase and come as fast as a log's; say where they do not."""
    steps, name = np.diff(stream.time), stream.name
    if len(stream.steps) < 2 * _SLOWEST:
        raise MeasurementError(f"{name}: {len(stream)} rows; expected a log of some minutes")
    if np.any(steps < 0.0):
        k = int(np.argmax(steps < 0.0))
        raise MeasurementError(
            f"{name}, line {rows[k + 1]}: time runs back from {stream.time[k]:.6g} s to {stream.time[k + 1]:.6g} s; "
            "expected one log in order: give logs that were appended to each other as sessions of their own"
        )
    order = np.lexsort((things := stream.things, stream.time))
    same = np.zeros(len(stream), bool)
    same[order[1:]] = (np.diff(stream.time[order]) == 0.0) & (np.diff(things[order]) == 0)
    if same.mean() > _FEW:
        raise MeasurementError(
            f"{name}: {100 * same.mean():.0f} % of the rows have the stamp of the row before: stamps are those of "
            "packets, not of samples; log the device's own time stamps"
        )
    if same.any():
        warn(f"{name}: {int(same.sum())} rows with the stamp of the row before are left out")
        stream = stream.select(~same)
    steps = np.diff(stream.time)
    _check_rate(stream)
    gaps = steps > max(_GAP * float(np.median(stream.steps)), _LONG)
    if gaps.any():
        k = int(np.argmax(steps))
        warn(
            f"{name}: {int(gaps.sum())} gaps of more than {_LONG} s, the longest {steps[k]:.3g} s from "
            f"{stream.time[k]:.6g} s on: what lies in them is left out"
        )
    return stream


def _check_rate(stream: Stream) -> None:
    """Refuse stamps in another unit than is said, or that count samples."""
    step, slowest = float(np.median(stream.steps)), _SLOWEST if {"q", FORCE.name} & stream.readings.keys() else _SLOW
    if 1.0 / _FASTEST <= step <= 1.0 / slowest:
        return
    if step == 1.0 and np.all(stream.time == np.round(stream.time)):
        raise MeasurementError(
            f"{stream.name}: time counts 1, 2, 3, ...: frames or samples; expected seconds: divide by the rate of the device"
        )
    units = {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    fits = next((unit for unit, size in units.items() if 1.0 / _FASTEST <= step * size <= 1.0 / slowest), None)
    is_untold = fits and "time" not in stream.units
    cure = f"looks like [{fits}]: write `time [{fits}]` in the header" if is_untold else "look at its unit"
    raise MeasurementError(
        f"{stream.name}: a row every {step:.3g} s; expected {slowest:g} to {_FASTEST:g} rows a second; {cure}"
    )


def checked_imu(stream: Stream) -> Stream:
    """Return the stream of an IMU that can be right.

    Samples that are cut off at the end of a range, or that repeat the one before because a log is faster than the device,
    are left out.

    Raises:
        MeasurementError: for accelerations in other units or without gravity, and for axes that are frozen or cut off.
    """
    force, rate = stream.readings[FORCE.name], stream.readings[RATE.name]
    _check_gravity(stream, float(np.median(np.linalg.norm(force, axis=1))))
    columns = dict(zip((*FORCE.columns, *RATE.columns), np.column_stack([force, rate]).T, strict=True))
    repeats = np.append(False, np.all(np.diff(np.column_stack([force, rate]), axis=0) == 0.0, axis=1))
    if repeats.mean() > _FEW:
        share = f"{100 * repeats.mean():.0f} %"
        warn(f"{stream.name}: {share} of the rows repeat the one before and are left out; log the IMU at its own rate")
    cut = np.zeros(len(stream), bool)
    for column, values in columns.items():
        flat = _cut_off(values)
        if flat.mean() > _FEW:
            raise MeasurementError(
                f"{stream.name}: column {column!r} is cut off at {np.abs(values).max():.4g} in {100 * flat.mean():.0f} "
                "% of the rows; choose a larger range of the IMU, or drive more slowly"
            )
        cut |= flat
    for k, (column, values) in enumerate(columns.items()):
        beside = np.delete(force if k < 3 else rate, k % 3, axis=1)
        if stuck := _longest_stuck(stream.time, values, beside):
            raise MeasurementError(
                f"{stream.name}: column {column!r} stands still for {stuck:.3g} s while others change; the axis is "
                "broken or not logged: repair the log, or leave that part out"
            )
    if cut.any():
        warn(f"{stream.name}: {int(cut.sum())} rows are cut off at the end of the IMU's range and are left out")
    return stream.select(~(cut | repeats)) if np.any(cut | repeats) else stream


def _check_gravity(stream: Stream, size: float) -> None:
    """Refuse specific forces whose median can't be gravity."""
    if STANDARD_GRAVITY / _NEAR < size < _NEAR * STANDARD_GRAVITY:
        return
    text = f"{stream.name}: specific forces of {size:.4g} m/s^2 in the median; expected about 9.8"
    for unit, gravity in _GRAVITIES.items():
        if gravity / _NEAR < size < _NEAR * gravity and "ax" not in stream.units:
            raise MeasurementError(
                f"{text}; looks like [{unit}]: write `ax [{unit}]`, `ay [{unit}]`, `az [{unit}]` in the header"
            )
    if "ax" in stream.units:
        raise MeasurementError(f"{text}; values in another unit under [{stream.units['ax']}]?")
    if size < STANDARD_GRAVITY / 3.0:
        raise MeasurementError(f"{text}: gravity was taken out; log raw accelerations")
    raise MeasurementError(f"{text}; look at its unit")


def _longest_stuck(time: np.ndarray, values: np.ndarray, beside: np.ndarray) -> float:
    """Return for how long a value stands still while those of the other axes, shape (T, 2), move; 0 if that is short [s]."""
    starts = np.flatnonzero(np.append(True, np.diff(values) != 0.0))
    spread, longest = beside.std(axis=0), 0.0
    for begin, end in _runs(starts, len(values)):
        lasts = float(time[end - 1] - time[begin])
        if lasts > _FROZEN and np.any(np.ptp(beside[begin:end], axis=0) > _MOVES * spread):
            longest = max(longest, lasts)
    return longest


def _runs(starts: np.ndarray, count: int) -> Iterator[tuple[int, int]]:
    """Yield first and past the last of stretches that begin at some rows and are longer than one."""
    ends = np.append(starts[1:], count)
    long = ends - starts > 1
    yield from zip(starts[long].tolist(), ends[long].tolist(), strict=True)


def _cut_off(values: np.ndarray) -> np.ndarray:
    """Return which samples stand at an end of a range, shape (T,): several in a row, several times, few just before it."""
    found, near = np.zeros(len(values), bool), 0.01 * float(np.ptp(values))
    for end in (values.max(), values.min()):
        at = values == end
        starts = np.flatnonzero(at & ~np.append(False, at[:-1]))
        ends = np.flatnonzero(at & ~np.append(at[1:], False))
        is_often = np.sum(ends - starts + 1 >= _FLAT) >= _OFTEN
        if is_often and at.sum() > np.sum(~at & (np.abs(values - end) < near)):
            found |= at
    return found


def stream_of(name: str, time: np.ndarray, readings: Mapping[str, np.ndarray]) -> Stream:
    """Return a stream of arrays in SI units, checked like one that is read.

    Args:
        name: for messages.
        time: shape (T,) [s].
        readings: as :class:`Stream` has them.

    Raises:
        MeasurementError: as :func:`read_streams`.
    """
    stream = _in_order(Stream(name, np.asarray(time, float), dict(readings), {}), np.arange(2, len(time) + 2))
    return checked_imu(stream) if FORCE.name in readings else stream
