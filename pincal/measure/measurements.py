"""Measured poses of one robot as arrays in SI units, checked when they are built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import MeasurementError, nearest_first
from pincal.measure.fields import CONDITIONS, FINITE, SIGN, Field
from pincal.measure.quantities import expected_number, is_possible
from pincal.measure.registry import check_fields, known_fields, sensor_class
from pincal.measure.sensor import Sensor

# What a table has beside its readings.
_OF_JOINTS = ("q", "approach", "droop", "move")
_ARRAYS = (*_OF_JOINTS, "rows", *CONDITIONS, "sigma", "readings_per_row")


@dataclass(frozen=True, eq=False, repr=False)
class Measurements:
    """Measured poses of one robot, one row per measured pose; absent columns are None and all arrays are read-only.

    The readings of pincal's own sensors are attributes as well.

    Example:
        >>> poses = measurements_from_arrays(["a", "b"], [[0.0, 1.0], [0.5, 1.0]], distance=[1.2, 1.3])
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
    """What the instrument read, by the fields that its sensor declares: shape (N,) or (N, k) each, lengths in m."""
    point: np.ndarray | None = None
    """Name of the point of the calibration object, shape (N,)."""
    payload: np.ndarray | None = None
    """Payload [kg], shape (N,)."""
    temperature: np.ndarray | None = None
    """Temperature [deg C], shape (N,)."""
    time: np.ndarray | None = None
    """Time [s], shape (N,)."""
    station: np.ndarray | None = None
    """Name of the set-up of instrument and targets that each row belongs to, shape (N,)."""
    approach: np.ndarray | None = None
    """Direction from which each joint arrived: -1, 0 (unknown) or 1, shape (N, n)."""
    droop: np.ndarray | None = None
    """Commanded minus read-back position of each joint [rad], prismatic [m], shape (N, n)."""
    move: np.ndarray | None = None
    """Last move of each joint with its sign [rad], prismatic [m], 0 where it is not known, shape (N, n)."""
    sigma: np.ndarray | None = None
    """Standard deviation of the row [m], shape (N,)."""
    readings_per_row: np.ndarray | None = None
    """How many readings of a pose each row is the mean of, shape (N,); None where each row is a single reading."""
    units: Mapping[str, str] = field(default_factory=dict)
    """The units that the header gave, by column; what is not in it was taken as SI."""
    approach_from: str = ""
    """Where ``approach`` comes from, in words, as far as it is known."""

    def __post_init__(self) -> None:
        for name, array in self._present().items():
            object.__setattr__(self, name, _read_only(array))
        object.__setattr__(self, "readings", {name: _read_only(array) for name, array in self.readings.items()})

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        joints = " ".join(self.joint_names)
        return f"Measurements({self.source!r}: {len(self)} rows, {self.kind}, joints {joints})"

    @property
    def sensor(self) -> type[Sensor] | None:
        """The class of the sensor that reads these columns; None where nothing was measured."""
        return sensor_class(self.columns())

    @property
    def kind(self) -> str:
        """What was measured, such as "position" or "pose"; "none" where nothing was."""
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
        """From the instrument's point, or the row's anchor, to the target [m], shape (N,)."""
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
        """Name of the fixed point that each row involves, shape (N,); None where rows involve none."""
        sensor = self.sensor
        return None if sensor is None or sensor.names_points is None else self.array(sensor.names_points)

    def array(self, name: str) -> np.ndarray:
        """Return the values of a field that the table has, shape (N,) or (N, k)."""
        return self.columns()[name]

    def columns(self) -> dict[str, np.ndarray]:
        """Return all arrays with one entry per row by name: joints, readings, conditions."""
        return {**self._present(), **self.readings}

    def names(self) -> dict[str, np.ndarray]:
        """Return the arrays that hold names, such as that of the target, shape (N,) each."""
        return {name: array for name, array in self.columns().items() if array.dtype.kind not in "fi"}

    def select(self, index_or_mask: Any) -> Measurements:
        """Return the rows that an index, a slice or a boolean mask of shape (N,) selects, in that order."""
        take = np.atleast_1d(np.arange(len(self))[index_or_mask])
        return self._with({name: array[take] for name, array in self.columns().items()})

    def with_readings(self, **readings: np.ndarray) -> Measurements:
        """Return the table with other values of some of its readings."""
        return replace(self, readings={**self.readings, **readings})

    def _with(self, columns: Mapping[str, np.ndarray]) -> Measurements:
        readings = {name: columns[name] for name in self.readings}
        rest: dict[str, Any] = {name: array for name, array in columns.items() if name not in readings}
        return replace(self, readings=readings, **rest)

    def _present(self) -> dict[str, np.ndarray]:
        return {name: getattr(self, name) for name in _ARRAYS if getattr(self, name) is not None}


def measurements_from_arrays(
    joint_names: Sequence[str],
    q: ArrayLike,
    *,
    rows: ArrayLike | None = None,
    source: str = "arrays",
    units: Mapping[str, str] | None = None,
    **columns: ArrayLike | None,
) -> Measurements:
    """Build measurements from arrays in SI units, which are checked and copied.

    Args:
        joint_names: names of the n joints.
        q: joint positions [rad], prismatic [m], shape (N, n).
        rows: line numbers for messages, shape (N,); by default 2, 3, ... as if read from a file.
        source: name of the data for messages.
        units: units that were stated explicitly, by column name; an entry marks a column as intended.
        **columns: target, payload, temperature, time, station, approach, droop, move, sigma, point and the fields of a
            sensor (position, quaternion, distance, anchor, socket, camera_point, pixel, ...), shaped as in `Measurements`;
            None is absent.

    Returns:
        The measurements; target is "tool" (of a camera's readings "camera") unless given, quaternions are normalised.

    Raises:
        MeasurementError: for an unknown column, a wrong shape, an invalid value, or two kinds of measurement.
    """
    fields = known_fields()
    unknown = [name for name in columns if name not in (*_OF_JOINTS[1:], *fields)]
    if unknown:
        known = ", ".join(nearest_first(unknown, [*_OF_JOINTS[1:], *fields]))
        raise MeasurementError(f'{source}: unknown column "{unknown[0]}"; known columns: {known}')
    names, given = tuple(joint_names), {"q": q, "rows": rows, **columns}
    arrays = {
        name: _as_array(name, value, fields.get(name), source=source) for name, value in given.items() if value is not None
    }
    if arrays["q"].ndim != 2 or arrays["q"].shape[1] != len(names):
        raise MeasurementError(
            f"{source}: q has shape {arrays['q'].shape}; expected (N, {len(names)}), one column per joint"
        )
    for name, array in arrays.items():
        width = len(fields[name].columns) if name in fields else 1
        one = arrays["q"].shape[:1] if width == 1 else (len(arrays["q"]), width)
        expected = arrays["q"].shape if name in _OF_JOINTS else one
        if array.shape != expected:
            raise MeasurementError(f'{source}: "{name}" has shape {array.shape}; expected {expected}, as for q')
    return validated(names, arrays, source=source, units=dict(units or {}))


def concatenate(tables: Sequence[Measurements]) -> Measurements:
    """Join at least one table of the same joints and columns; each keeps its own line numbers.

    The source names all files, units are those that all tables stated.

    Raises:
        MeasurementError: for no table at all, other joints, or a column that only some tables have.
    """
    if not tables:
        raise MeasurementError("no table to join; expected at least one")
    if any(table.readings_per_row is not None for table in tables):
        tables = [table if table.readings_per_row is not None else _single(table) for table in tables]
    if any(table.move is not None for table in tables):
        # No column of a file: of rows whose order nobody told the last moves are unknown.
        tables = [table if table.move is not None else replace(table, move=np.zeros(table.q.shape)) for table in tables]
    first = tables[0]
    for other in tables[1:]:
        if other.joint_names != first.joint_names:
            expected, got = ", ".join(first.joint_names), ", ".join(other.joint_names)
            raise MeasurementError(f"{other.source}: joints {got}; {first.source} has {expected}")
        odd = sorted(set(first.columns()) ^ set(other.columns()))
        if odd:
            raise MeasurementError(f'"{odd[0]}" is in only one of {first.source} and {other.source}; add or drop it')
    parts = [table.columns() for table in tables]
    joined = first._with({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
    units = {k: v for k, v in first.units.items() if all(table.units.get(k) == v for table in tables)}
    source = ", ".join(dict.fromkeys(table.source for table in tables))
    origins = ", ".join(dict.fromkeys(table.approach_from for table in tables if table.approach_from))
    return replace(joined, units=units, source=source, approach_from=origins)


def _single(table: Measurements) -> Measurements:
    """Return a table whose rows are single readings as one that says so."""
    return replace(table, readings_per_row=np.ones(len(table), int))


def validated(
    names: tuple[str, ...], arrays: dict[str, np.ndarray], *, source: str, units: Mapping[str, str]
) -> Measurements:
    """Return the measurements of these arrays, which are checked but not copied."""
    count = len(arrays["q"])
    arrays.setdefault("rows", np.arange(2, count + 2))
    fields = known_fields()
    given = frozenset(name for name in arrays if name in fields)
    check_fields(given, source=source)
    sensor = sensor_class(given)
    arrays.setdefault("target", np.broadcast_to(np.array("tool" if sensor is None else sensor.default_target), count))
    for name, array in arrays.items():
        _check_values(name, array, fields.get(name), arrays["rows"], source=source)
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
        return np.array(value, dtype=str if is_name else int if name == "rows" else float)
    except (TypeError, ValueError) as error:
        raise MeasurementError(f'{source}: "{name}" is not an array of {"names" if is_name else "numbers"}') from error


def _check_values(name: str, values: np.ndarray, known: Field | None, lines: np.ndarray, *, source: str) -> None:
    """Refuse invalid values of one array, naming the line of the first."""
    if values.dtype.kind not in "fi":
        return
    rule = SIGN if name == "approach" else FINITE if known is None else known.rule
    quantity = known.quantity if known is not None else "angle" if name in ("q", "droop") else "number"
    right, expected = is_possible(values, quantity), expected_number(quantity)
    if right.all():
        right, expected = rule.is_met(values), rule.expected
    if not right.all():
        wrong = np.flatnonzero(~right.reshape(len(right), -1).all(axis=1))
        raise MeasurementError(
            f'{source}, line {lines[wrong[0]]}, "{name}": {values[wrong[0]].tolist()}; '
            f"expected {expected}; rows like this: {wrong.size}; correct or delete them"
        )
