"""The table of what a robot read of a part: joints, the feature of each row, and what a sensor on
the flange saw of it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from pincal.errors import MeasurementError, few
from pincal.features.features_numbers import FEATURES
from pincal.measure.admit import check_joints_of
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.reader import read_table
from pincal.measure.stops import plan_of
from pincal.measure.table_schema import Schema, TableOptions
from pincal.robot.robot import Robot
from pincal.sensors.fields import CONDITIONS, Field
from pincal.sensors.registry import known_fields
from pincal.thresholds import Count

CAMERA_POINT = "camera_point"
IMAGE = "pixel"
RANGE = "range"
CONTACT = "contact"
"""Kinds of readings: points in a sensor's frame, images, distances along its z axis, and contacts,
which are the joints alone.
"""

_FEATURE = Field("feature", ("feature",), "name")
_PASSES = (Field("pass", ("pass",), "name"), Field("run", ("run",), "name"))
_APPRAISERS = tuple(Field(name, (name,), "name") for name in ("operator", "day", "robot"))
_RANGE = Field(RANGE, ("range",), "length")
_READ = (known_fields()[CAMERA_POINT], known_fields()[IMAGE], _RANGE)
_FIELDS = (_FEATURE, *_PASSES, *_APPRAISERS, *_READ, *CONDITIONS.values())
# The column of the distance from the sensor, by the kind of readings.
_DEPTH = {CAMERA_POINT: "cz", RANGE: "range"}
# Rows that a message lists.
_LISTED: Count = 5


@dataclass(frozen=True, eq=False)
class FeatureReadings:
    """N readings of the features of a part.

    Attributes:
        rows: joints and conditions.
        feature: shape (N,), name of the feature of each row.
        kind: "camera_point", "pixel", "range" or "contact".
        seen: what the sensor read: shape (N, 3) [m], (N, 2) [px] or (N,) [m]; None for contacts.
        pass_name: shape (N,), the run through the features, by its column; None without one.
        appraiser: shape (N,), who measured: operator, day and robot, by their columns; None without
            any.
    """

    rows: Measurements
    feature: np.ndarray
    kind: str
    seen: np.ndarray | None = None
    pass_name: np.ndarray | None = None
    appraiser: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.feature)

    @property
    def point(self) -> np.ndarray:
        """Name of each row's point of its feature, shape (N,); empty where it has none."""
        named = self.rows.point
        return np.full(len(self), "") if named is None else named

    @cached_property
    def stop(self) -> np.ndarray:
        """Number of each row's stop of the robot, shape (N,)."""
        return plan_of(self._plain).stop

    @cached_property
    def passes(self) -> np.ndarray:
        """Number of each row's run through the features, shape (N,).

        Without a column, poses that return divide runs if each run then holds as many readings of
        each feature as the first: a pose from which several features are seen may return within a
        run. Each appraiser has runs of its own.
        """
        if self.appraiser is None:
            return self._runs
        pairs = zip(self.appraiser.tolist(), self._runs.tolist(), strict=True)
        return _numbered(np.array([f"{who} {run}" for who, run in pairs]))

    @cached_property
    def _runs(self) -> np.ndarray:
        """Number of each row's run, whoever measured, shape (N,)."""
        if self.pass_name is not None:
            return _numbered(self.pass_name)
        found = plan_of(self._plain).passes
        features = _numbered(self.feature)
        counts = np.zeros((found.max(initial=0) + 1, features.max(initial=0) + 1), int)
        np.add.at(counts, (found, features), 1)
        are_alike = bool(np.all(counts == counts[:1]))
        return found if are_alike else np.zeros(len(self), int)

    @property
    def _plain(self) -> Measurements:
        """The rows as one thing that is visited, since features differ, and not poses."""
        return replace(self.rows, point=None)

    def of(self, feature: str) -> np.ndarray:
        """Return which rows are of a feature, shape (N,)."""
        return np.asarray(self.feature == feature)

    def select(self, rows: np.ndarray) -> FeatureReadings:
        """Return some of the rows (mask or indices)."""
        return FeatureReadings(
            self.rows.select(rows),
            self.feature[rows],
            self.kind,
            None if self.seen is None else self.seen[rows],
            None if self.pass_name is None else self.pass_name[rows],
            None if self.appraiser is None else self.appraiser[rows],
        )


def read_readings(
    path: str | os.PathLike[str], robot: Robot, *, options: TableOptions | None = None
) -> FeatureReadings:
    """Read a table of readings of a part, with the units and formats of a table of measurements.

    Args:
        path: the file: columns of joints and ``feature``; ``cx cy cz``, ``u v`` or ``range`` where
            a sensor read something; conditions such as ``point``, ``stop`` or ``payload``; ``pass``
            where the features were measured repeatedly, ``operator``, ``day`` or ``robot`` where by
            several.
        robot: the arm.
        options: how to read the table.

    Raises:
        MeasurementError: for a file that can't be read, a table without features or with readings
            of several kinds, or an invalid column, unit or value.
    """
    path = Path(path)
    schema = Schema(_FIELDS, options=options or TableOptions()).of_robot(robot)
    cells = read_table(path, schema)
    arrays = dict(cells.arrays)
    feature = arrays.pop("feature", None)
    if feature is None:
        raise MeasurementError(
            f"{path.name}: no column feature; expected the name of the feature of the part that "
            "each row touched or saw"
        )
    runs = [arrays.pop(of.name) for of in _PASSES if of.name in arrays]
    if len(runs) > 1:
        raise MeasurementError(f"{path.name}: columns pass and run; expected one of them")
    who = [arrays.pop(of.name) for of in _APPRAISERS if of.name in arrays]
    appraiser = np.array([", ".join(names) for names in zip(*who, strict=True)]) if who else None
    seen = {of.name: arrays.pop(of.name) for of in _READ if of.name in arrays}
    if len(seen) > 1:
        raise MeasurementError(
            f"{path.name}: readings of several kinds ({', '.join(seen)}); expected one, --ignore "
            "the columns of the others"
        )
    rows = measurements_from_arrays(
        robot.joint_names, **arrays, rows=cells.rows, source=path.name, units=cells.units
    )
    check_joints_of(robot, rows)
    kind = next(iter(seen), CONTACT)
    found = FeatureReadings(
        rows, feature, kind, seen.get(kind), runs[0] if runs else None, appraiser
    )
    _check(found)
    return found


def readings_of(
    rows: Measurements,
    feature: np.ndarray,
    *,
    camera_point: np.ndarray | None = None,
    pixel: np.ndarray | None = None,
    distance: np.ndarray | None = None,
    pass_name: np.ndarray | None = None,
) -> FeatureReadings:
    """Return readings from arrays.

    Args:
        rows: joints and conditions of N rows.
        feature: shape (N,), names of features.
        camera_point: shape (N, 3), points in the sensor's frame [m].
        pixel: shape (N, 2), images [px].
        distance: shape (N,), distances along the sensor's z axis [m].
        pass_name: shape (N,), the run through the features.

    Raises:
        MeasurementError: for arrays of another shape, several kinds of readings, or values that are
            not finite.
    """
    given = {CAMERA_POINT: camera_point, IMAGE: pixel, RANGE: distance}
    seen = {kind: np.asarray(array, float) for kind, array in given.items() if array is not None}
    if len(seen) > 1:
        raise MeasurementError(f"readings of several kinds ({', '.join(seen)}); expected one")
    kind = next(iter(seen), CONTACT)
    names = np.asarray(feature, str)
    runs = None if pass_name is None else np.asarray(pass_name, str)
    found = FeatureReadings(rows, names, kind, seen.get(kind), runs)
    expected = {CAMERA_POINT: (len(rows), 3), IMAGE: (len(rows), 2), RANGE: (len(rows),)}
    for what, array, shape in (
        ("features", names, (len(rows),)),
        (kind, found.seen, expected.get(kind)),
        ("passes", runs, (len(rows),)),
    ):
        if array is not None and array.shape != shape:
            raise MeasurementError(f"{what} have shape {array.shape}; expected {shape}")
    _check(found)
    return found


def _check(readings: FeatureReadings) -> None:
    """Refuse rows without a feature, and readings that are not finite."""
    lines = readings.rows.rows
    source = readings.rows.source
    nameless = np.array([not name.strip() for name in readings.feature.tolist()], bool)
    if nameless.any():
        raise MeasurementError(
            f'{source}, line {few(lines[nameless], _LISTED)}, "feature": no name; expected one in '
            "each row"
        )
    if readings.seen is None:
        return
    for is_bad, what, expected in _faults(readings.kind, readings.seen):
        if is_bad.any():
            raise MeasurementError(
                f"{source}, line {few(lines[is_bad], _LISTED)}: {what}; expected {expected}"
            )


def _faults(kind: str, seen: np.ndarray) -> Iterator[tuple[np.ndarray, str, str]]:
    """Yield which rows have a fault, shape (N,), the fault and what is expected."""
    is_finite = np.isfinite(seen).reshape(len(seen), -1).all(axis=1)
    yield ~is_finite, f"{kind} is not finite", "numbers"
    if kind in _DEPTH:
        depth = np.abs(seen if kind == RANGE else seen[:, 2])
        yield (
            np.full(len(depth), float(np.median(depth)) > FEATURES.farthest),
            f"{_DEPTH[kind]} has a median of {np.median(depth):g} m, which looks like millimetres",
            f"at most {FEATURES.farthest:g} m: write `{_DEPTH[kind]} [mm]` in the header",
        )
    if kind == CAMERA_POINT:
        yield (
            seen[:, 2] <= 0.0,
            "cz <= 0, a point behind the sensor",
            "points in front of it, z along the view",
        )
    if kind == RANGE:
        yield seen <= 0.0, "a range of 0 or less", "distances along the sensor's z axis, > 0"


def _numbered(names: np.ndarray) -> np.ndarray:
    """Return the number of each name in the order of first appearance, shape (N,)."""
    numbers = {name: i for i, name in enumerate(dict.fromkeys(names.tolist()))}
    return np.array([numbers[name] for name in names.tolist()], int)
