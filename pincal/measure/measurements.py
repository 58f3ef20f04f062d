"""Measured poses of one robot as arrays in SI units, validated on construction."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import BadInputError, MeasurementError, nearest_first
from pincal.recorded import RECORDED, Moving, Recorded
from pincal.robot.robot import Robot
from pincal.sensors.fields import CONDITIONS, FINITE, SIGN, Field
from pincal.sensors.registry import check_fields, expected_columns, known_fields, sensor_class
from pincal.sensors.sensor import Sensor
from pincal.sensors.setup import Setup
from pincal.units import expected_number, is_possible, real_array, unmasked

# Arrays in addition to the readings.
_OF_JOINTS = {name: variable.quantity for name, variable in RECORDED.items() if variable.of_joints}
_ARRAYS = ("q", *_OF_JOINTS, "rows", *CONDITIONS, "sigma", "readings_per_row")


@dataclass(frozen=True, eq=False, repr=False)
class Measurements(Recorded):
    """Measured poses of one robot, one row per measured pose; absent columns are None and all
    arrays are read-only.

    Readings of pincal's own sensors are also attributes.

    Example:
        >>> poses = measurements(["a", "b"], [[0.0, 1.0], [0.5, 1.0]], distance=[1.2, 1.3])
        >>> poses, poses.kind, poses.select(poses.q[:, 0] > 0.1).distance
        (Measurements('arrays': 2 rows, distance, joints a b), 'distance', array([1.3]))
    """

    joint_names: tuple[str, ...]
    q: np.ndarray
    """Joint positions [rad], prismatic [m], shape (N, n)."""
    target: np.ndarray
    """Name of the measured target on the tool, shape (N,)."""
    rows: np.ndarray
    """Line of each row in its file, the header being line 1, shape (N,)."""
    source: str
    """Name of the file, for messages."""
    readings: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Readings of the instrument by the fields of its sensor: shape (N,) or (N, k) each, lengths in
    m.
    """
    point: np.ndarray | None = None
    """Name of the point of the calibration object, shape (N,)."""
    payload: np.ndarray | None = None
    """Payload [kg], shape (N,)."""
    stop: np.ndarray | None = None
    """Name of the stop of the robot in which each row was read, shape (N,); see
    :mod:`pincal.measure.stops`.
    """
    station: np.ndarray | None = None
    """Name of the set-up of instrument and targets that each row belongs to, shape (N,)."""
    from_link: np.ndarray | None = None
    """Name of the link on which the instrument of each row is, shape (N,); default: the robot's
    base.
    """
    to_link: np.ndarray | None = None
    """Name of the link on which the target of each row is, shape (N,); default: the robot's tip."""
    sigma: np.ndarray | None = None
    """Standard deviation of the row [m], shape (N,)."""
    readings_per_row: np.ndarray | None = None
    """Number of readings of which each row is the mean, shape (N,); None where each row is a single
    reading.
    """
    units: Mapping[str, str] = field(default_factory=dict)
    """The units in the header, by column; others were taken as SI."""
    approach_from: str = ""
    """Origin of ``approach`` in words, if known."""
    setup: str = ""
    """Name of the set-up whose instrument it shares with rows between other links; empty if it
    shares none.
    """
    moving: Moving | None = None
    """Motion of the arm about each row, by its path (:mod:`pincal.motion`); None where poses were
    held.
    """

    def __post_init__(self) -> None:
        for name, array in self._present().items():
            object.__setattr__(self, name, _read_only(array))
        object.__setattr__(
            self, "readings", {name: _read_only(array) for name, array in self.readings.items()}
        )

    def __len__(self) -> int:
        return len(self.q)

    @property
    def is_of_positions(self) -> bool:
        """Whether its readings are positions of the target alone."""
        return self.readings.keys() == {"position"}

    @property
    def has_orientations(self) -> bool:
        """Whether its readings are poses, positions with orientations."""
        return self.readings.keys() == {"position", "quaternion"}

    def of_positions(self) -> Self:
        """Return the positions of poses alone."""
        return replace(self, readings={"position": self.readings["position"]})

    @property
    def is_of_motion(self) -> bool:
        """Whether the rows were read while the arm moved along a path, and not in poses held."""
        return self.moving is not None

    def __repr__(self) -> str:
        joints = " ".join(self.joint_names)
        return f"Measurements({self.source!r}: {len(self)} rows, {self.kind}, joints {joints})"

    @cached_property
    def sensor(self) -> type[Sensor] | None:
        """The class of the sensor with these columns; None where nothing was measured."""
        return sensor_class(self.columns())

    @property
    def kind(self) -> str:
        """Kind of measurement, such as "position" or "pose"; "none" without any."""
        return "none" if self.sensor is None else self.sensor.kind

    @property
    def position(self) -> np.ndarray | None:
        """Target in the instrument's frame [m], shape (N, 3)."""
        return self.readings.get("position")

    @property
    def quaternion(self) -> np.ndarray | None:
        """Orientation of the tool in the instrument's frame, x y z w, normalised, shape (N, 4)."""
        return self.readings.get("quaternion")

    @property
    def distance(self) -> np.ndarray | None:
        """Distance from the instrument's point, or the row's anchor, to the target [m],
        shape (N,).
        """
        return self.readings.get("distance")

    @property
    def socket(self) -> np.ndarray | None:
        """Name of the fixed point that held the tool point, shape (N,)."""
        return self.readings.get("socket")

    @property
    def camera_point(self) -> np.ndarray | None:
        """Point of the calibration object in the camera's frame [m], shape (N, 3)."""
        return self.readings.get("camera_point")

    @property
    def pixel(self) -> np.ndarray | None:
        """The same point in the image [px], shape (N, 2)."""
        return self.readings.get("pixel")

    @property
    def point_names(self) -> np.ndarray | None:
        """Name of each row's fixed point, shape (N,); None where rows involve none."""
        sensor = self.sensor
        return (
            None
            if sensor is None or sensor.names_points is None
            else self.array(sensor.names_points)
        )

    def array(self, name: str) -> np.ndarray:
        """Return the values of a field of the table, shape (N,) or (N, k)."""
        return self.columns()[name]

    def columns(self) -> dict[str, np.ndarray]:
        """Return all arrays with one entry per row, by name."""
        return {**self._present(), **self.readings}

    def names(self) -> dict[str, np.ndarray]:
        """Return the arrays of names, such as the target's, shape (N,) each."""
        return {
            name: array for name, array in self.columns().items() if array.dtype.kind not in "fi"
        }

    def select(self, index_or_mask: Any) -> Measurements:
        """Return the rows that an index, a slice or a boolean mask of shape (N,) selects, in that
        order.
        """
        take = np.atleast_1d(np.arange(len(self))[index_or_mask])
        chosen = self._with({name: array[take] for name, array in self.columns().items()})
        return chosen if self.moving is None else replace(chosen, moving=self.moving[take])

    def with_readings(self, **readings: np.ndarray) -> Measurements:
        """Return the table with some of its readings replaced."""
        return replace(self, readings={**self.readings, **readings})

    def of_joints(self, robot: Robot) -> Measurements:
        """Return the table with positions of the URDF's joints instead of those reported by the
        controller.
        """
        q = robot.from_reported(self.q)
        return self if q is self.q else replace(self, q=q)

    def in_order_of(self, robot: Robot) -> Measurements:
        """Return the table with its joints in the order of the robot's, matched by name.

        Raises:
            MeasurementError: if the names are not those of the robot's joints.
        """
        if self.joint_names == robot.joint_names:
            return self
        if sorted(self.joint_names) != sorted(robot.joint_names):
            raise MeasurementError(self._other_joints(robot))
        order = [self.joint_names.index(name) for name in robot.joint_names]
        of_joints = ("q", *(name for name in _OF_JOINTS if getattr(self, name) is not None))
        changed: dict[str, Any] = {name: getattr(self, name)[:, order] for name in of_joints}
        moving = None if self.moving is None else self.moving.of_joints(order)
        return replace(self, joint_names=robot.joint_names, moving=moving, **changed)

    def _other_joints(self, robot: Robot) -> str:
        """Return in words that these are other joints than the robot's."""
        unknown = [name for name in self.joint_names if name not in robot.joint_names]
        missing = [name for name in robot.joint_names if name not in self.joint_names]
        parts = []
        if unknown:
            parts.append(f"unknown: {', '.join(unknown)}")
        if missing:
            parts.append(f"missing: {', '.join(missing)}")
        if robot.dependent and not unknown and set(missing) <= robot.dependent:
            cure = "pincal.measurements(robot, q, ...) computes the joints that follow from others"
        else:
            cure = "name the joints of the table as the robot's, in any order"
        got = ", ".join(self.joint_names)
        expected = ", ".join(robot.joint_names)
        found = "; ".join(parts) or "one of them twice"
        wanted = f"expected those of {robot.name}: {expected} ({found})"
        return f"{self.source}: joints {got}; {wanted}; {cure}"

    def _with(self, columns: Mapping[str, np.ndarray]) -> Measurements:
        readings = {name: columns[name] for name in self.readings}
        rest: dict[str, Any] = {
            name: array for name, array in columns.items() if name not in readings
        }
        return replace(self, readings=readings, **rest)

    def _present(self) -> dict[str, np.ndarray]:
        return {name: getattr(self, name) for name in _ARRAYS if getattr(self, name) is not None}


def measurements(
    joints: Robot | Sequence[str],
    q: ArrayLike,
    *,
    rows: ArrayLike | None = None,
    source: str = "arrays",
    units: Mapping[str, str] | None = None,
    **columns: ArrayLike | None,
) -> Measurements:
    """Build measurements from arrays in SI units, which are validated and copied.

    Args:
        joints: the robot, or the names of its n joints.
        q: joint positions [rad], prismatic [m], shape (N, n); dependent joints of a robot may be
            left out.
        rows: line numbers for messages, shape (N,); by default 2, 3, ... as if read from a file.
        source: name of the data for messages.
        units: explicitly stated units, by column.
        columns: readings and conditions by name, and fields of custom sensors; None means absent:

            - position: of the target in the instrument's frame [m], shape (N, 3).
            - quaternion: orientation of the tool in the instrument's frame, x y z w, shape (N, 4);
              with ``position``.
            - distance: from the instrument's point, or the row's anchor, to the target [m], shape
              (N,).
            - anchor: name of the point that a distance is measured from, shape (N,).
            - socket: name of the fixed point that held the tool point, shape (N,).
            - camera_point: point of the calibration object in the camera's frame [m], shape (N, 3);
              with ``point``.
            - pixel: the same point in the image [px], shape (N, 2); with ``point``.
            - point: name of the point of the calibration object, shape (N,).
            - plane: name of the plane that the probe touched, shape (N,).
            - gauge: reading of a dial gauge against this plane [m], shape (N,); with ``plane``.
            - target: name of the target on the tool, shape (N,); default: one.
            - payload: mass at the tip [kg], shape (N,).
            - temperature: in deg C, shape (N,).
            - time: in s, shape (N,).
            - stop: name of the stop of the robot in which a row was read, shape (N,); default: by
              joints, order and time.
            - station: name of the set-up that a row belongs to, shape (N,).
            - approach: direction from which each joint arrived, -1, 0 (unknown) or 1, shape (N, n).
            - droop: commanded minus read-back position of each joint [rad], prismatic [m], shape
              (N, n).
            - move: last move of each joint with its sign [rad], prismatic [m], 0 where it is not
              known, shape (N, n).
            - sigma: standard deviation of the row [m], shape (N,).

    Returns:
        The measurements; target is "tool" (of a camera's readings "camera") unless given,
        quaternions are normalised.

    Raises:
        MeasurementError: for an unknown column, a wrong shape, an invalid value, or two kinds of
            measurement.

    Example:
        >>> q = [[0.1, 0.2], [0.3, 0.4]]
        >>> measurements(["shoulder", "elbow"], q, position=[[1, 0, 0], [0, 1, 0]])
        Measurements('arrays': 2 rows, position, joints shoulder elbow)
    """
    if isinstance(joints, Robot):
        q = _as_array("q", q, None, source=source)
        if joints.dependent and q.ndim == 2 and q.shape[1] == len(joints.own_joints):
            q = joints.spread(q)
        joints = joints.joint_names
    fields = known_fields()
    unknown = [name for name in columns if name not in (*_OF_JOINTS, *fields)]
    if unknown:
        known = ", ".join(nearest_first(unknown, [*_OF_JOINTS, *fields]))
        raise MeasurementError(f'{source}: unknown column "{unknown[0]}"; known columns: {known}')
    names = tuple(joints)
    given = {"q": q, "rows": rows, **columns}
    arrays = {
        name: _as_array(name, value, fields.get(name), source=source)
        for name, value in given.items()
        if value is not None
    }
    _check_shapes(arrays, len(names), fields, source=source)
    return validated(names, arrays, source=source, units=dict(units or {}))


def _check_shapes(
    arrays: Mapping[str, np.ndarray], n_joints: int, fields: Mapping[str, Field], *, source: str
) -> None:
    """Refuse arrays that do not fit the joints, or the joint positions ``q``."""
    q = arrays["q"]
    if q.ndim != 2 or q.shape[1] != n_joints:
        raise MeasurementError(
            f"{source}: q has shape {q.shape}; expected (N, {n_joints}), one column per joint"
        )
    for name, array in arrays.items():
        width = len(fields[name].columns) if name in fields else 1
        one = q.shape[:1] if width == 1 else (len(q), width)
        expected = q.shape if name in ("q", *_OF_JOINTS) else one
        if array.shape != expected:
            raise MeasurementError(
                f'{source}: "{name}" has shape {array.shape}; expected {expected}, as for q'
            )


def concatenate(tables: Sequence[Measurements]) -> Measurements:
    """Concatenate at least one table of the same joints and columns; line numbers are kept.

    The source names all files; units are those stated by all tables.

    Raises:
        MeasurementError: for no table, different joints, or a column that only some tables have.
    """
    if not tables:
        raise MeasurementError("no table to join; expected at least one")
    if any(table.readings_per_row is not None for table in tables):
        # Rows of other tables are single readings.
        tables = [_counted(table) for table in tables]
    if any(table.move is not None for table in tables):
        # Last moves are no column of a file, and unknown for rows without a declared order.
        tables = [
            table if table.move is not None else replace(table, move=np.zeros(table.q.shape))
            for table in tables
        ]
    first = tables[0]
    for other in tables[1:]:
        _check_alike(first, other)
    parts = [table.columns() for table in tables]
    joined = first._with(
        {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    )
    units = {
        k: v for k, v in first.units.items() if all(table.units.get(k) == v for table in tables)
    }
    source = ", ".join(dict.fromkeys(table.source for table in tables))
    origins = ", ".join(
        dict.fromkeys(table.approach_from for table in tables if table.approach_from)
    )
    path = first.moving
    if path is not None:
        path = path.joined([table.moving for table in tables[1:] if table.moving])
    return replace(joined, units=units, source=source, approach_from=origins, moving=path)


def _check_alike(first: Measurements, other: Measurements) -> None:
    """Refuse two tables of different joints or columns."""
    if other.joint_names != first.joint_names:
        expected = ", ".join(first.joint_names)
        got = ", ".join(other.joint_names)
        raise MeasurementError(f"{other.source}: joints {got}; {first.source} has {expected}")
    odd = sorted(set(first.columns()) ^ set(other.columns()))
    if odd:
        raise MeasurementError(
            f'"{odd[0]}" is in only one of {first.source} and {other.source}; add or drop it'
        )


def _counted(table: Measurements) -> Measurements:
    """Return a table with the number of readings of each row, 1 if it has none."""
    if table.readings_per_row is not None:
        return table
    return replace(table, readings_per_row=np.ones(len(table), int))


def validated(
    names: tuple[str, ...], arrays: dict[str, np.ndarray], *, source: str, units: Mapping[str, str]
) -> Measurements:
    """Return the measurements of arrays, which are validated but not copied."""
    count = len(arrays["q"])
    arrays.setdefault("rows", np.arange(2, count + 2))
    fields = known_fields()
    given = frozenset(name for name in arrays if name in fields)
    check_fields(given, source=source)
    sensor = sensor_class(given)
    arrays.setdefault(
        "target",
        np.broadcast_to(np.array("tool" if sensor is None else sensor.default_target), count),
    )
    read = {} if sensor is None else {field.name: field for field in sensor.fields}
    for name, array in arrays.items():
        _check_values(name, array, read.get(name, fields.get(name)), arrays["rows"], source=source)
    for name in given:
        if fields[name].is_unit:
            arrays[name] = arrays[name] / np.linalg.norm(arrays[name], axis=1, keepdims=True)
    if "approach" in arrays:
        arrays["approach"] = arrays["approach"].astype(np.int8)
    rest: dict[str, Any] = {name: array for name, array in arrays.items() if name in _ARRAYS}
    readings = {name: array for name, array in arrays.items() if name not in rest}
    return Measurements(joint_names=names, source=source, units=units, readings=readings, **rest)


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view


def _as_array(name: str, value: ArrayLike, known: Field | None, *, source: str) -> np.ndarray:
    is_name = known is not None and known.is_name
    try:
        what = f'{source}: "{name}"'
        if is_name or name == "rows":
            return np.array(unmasked(value, what), dtype=str if is_name else int)
        return np.array(real_array(value, what))
    except BadInputError as error:
        raise MeasurementError(str(error)) from None
    except (TypeError, ValueError) as error:
        raise MeasurementError(
            f'{source}: "{name}" is not an array of {"names" if is_name else "numbers"}'
        ) from error


def _check_values(
    name: str, values: np.ndarray, known: Field | None, lines: np.ndarray, *, source: str
) -> None:
    """Refuse invalid values of one array, naming the line of the first."""
    if values.dtype.kind not in "fi":
        return
    rule = SIGN if name == "approach" else FINITE if known is None else known.rule
    quantity = (
        known.quantity
        if known is not None
        else "angle"
        if name == "q"
        else _OF_JOINTS.get(name, "number")
    )
    right = is_possible(values, quantity)
    expected = expected_number(quantity)
    if right.all():
        right = rule.is_met(values)
        expected = rule.expected
    if not right.all():
        wrong = np.flatnonzero(~right.reshape(len(right), -1).all(axis=1))
        raise MeasurementError(
            f'{source}, line {lines[wrong[0]]}, "{name}": {values[wrong[0]].tolist()}; '
            f"expected {expected}; rows affected: {wrong.size}; correct or delete them"
        )


def sensor_of(measurements: Measurements, setup: Setup | None = None) -> Sensor:
    """Return the sensor of a table of measurements.

    Points that the setup does not have are refused, except sockets, which are judged by the mean of
    their rows. By default all points of the table are unknown parameters.

    Raises:
        MeasurementError: if no sensor has such columns, or for a point that the setup does not
            have.
    """
    found = measurements.sensor
    if found is None:
        raise MeasurementError(
            f"{measurements.source}: no sensor reads measurements of kind {measurements.kind!r}; "
            f"expected columns {expected_columns()}"
        )
    return found.of(measurements, Setup().over(measurements) if setup is None else setup)


def sensor_like(measurements: Measurements, setup: Setup) -> Sensor:
    """Return the sensor of the first row of a table, with all properties that do not depend on the
    rows.
    """
    return sensor_of(measurements.select(slice(0, 1)), setup.over(measurements))


def _signature() -> inspect.Signature:
    """Return the signature of ``measurements`` with all columns, for help texts and completion."""
    plain = inspect.signature(measurements)
    *first, rest = plain.parameters.values()
    names = dict.fromkeys([*known_fields(), *_OF_JOINTS])
    columns = [
        rest.replace(name=name, kind=inspect.Parameter.KEYWORD_ONLY, default=None) for name in names
    ]
    return plain.replace(parameters=[*first, *columns, rest])


measurements.__signature__ = _signature()  # type: ignore[attr-defined]
measurements_from_arrays = measurements
"""The other name of :func:`measurements`."""
