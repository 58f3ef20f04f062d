"""Measured poses in one table: arrays in SI units, read from CSV, Excel or Parquet and written to
CSV or Parquet.

One row per measured pose. Joints have their names in the URDF; units are given in square brackets
(``x [mm]``, ``joint_1 [deg]``). Invalid values are refused with their line and column.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pincal.atomic import replacing
from pincal.errors import BadInputError, MeasurementError, OutputError
from pincal.measure.measurements import (
    Measurements,
    concatenate,
    measurements_from_arrays,
    validated,
)
from pincal.measure.reader import joint_columns, read_columns, read_table, typed_errors
from pincal.measure.table_schema import TABLE_ENDINGS, Schema, TableOptions
from pincal.robot.robot import Robot
from pincal.robot.tree import Mimic, mimicked
from pincal.sensors.fields import CONDITIONS
from pincal.sensors.registry import expected_columns, known_fields
from pincal.sensors.sensor import Divided
from pincal.thresholds import Count

__all__ = [
    "Measurements",
    "concatenate",
    "joint_columns",
    "measurements_from_arrays",
    "read_columns",
]
__all__ += ["read_measurements", "row_parts", "write_table"]

# Name of a set-up without one.
_UNNAMED = "setup"
# Ends of the path between the two links of a reading.
LINK_ENDS = ("from", "to")
# Rows processed at once where not all fit into memory: some hundred MB, including all that a fit
# derives from them.
MOST_ROWS: Count = 200_000


def read_measurements(
    path: str | os.PathLike[str],
    robot: Robot | Sequence[str],
    *,
    require: Literal["measurement", "joints"] = "measurement",
    joint_types: Sequence[str] | None = None,
    mimics: Sequence[Mimic] = (),
    resting: Mapping[str, float] | None = None,
    part: range | None = None,
    **options: Any,
) -> Measurements:
    """Read a table of measured poses from CSV or other text, Excel or Parquet.

    Args:
        path: the file; the ending of its name gives the format, text by default, whose separator,
            decimal comma and encoding are detected.
        robot: the robot, or the names of its n joints; dependent joints of a robot need no column.
        require: "joints" needs no measurement and leaves out all columns that are neither a joint
            nor a condition (target, point, payload, temperature, time, station, approach).
        joint_types: "revolute" or "prismatic" for each named joint, which determines its possible
            units; default: all revolute.
        mimics: named joints that mimic others and may have no column (``robot.mimics``).
        resting: joints that may have no column, with their rest positions [rad or m].
        part: rows of a Parquet file to read, by index, as :func:`row_parts` yields them; default:
            all.
        options: ignore, columns, orientation, joints, sheet, rows_in_order and shares_log, as in
            :class:`pincal.measure.table_schema.TableOptions`.

    Returns:
        The rows in SI units, each with its line in the file (in Parquet: counted as if there were a
        header).

    Raises:
        MeasurementError: for a file that can't be read, or a column, unit or value that is invalid.
    """
    source = Path(path).name
    only_joints = require == "joints"
    given = TableOptions(**{name: value for name, value in options.items() if value is not None})
    schema = Schema(
        fields=tuple((CONDITIONS if only_joints else known_fields()).values()),
        resting=dict(resting or {}),
        options=replace(given, ignore=("*", *given.ignore)) if only_joints else given,
    )
    if isinstance(robot, Robot):
        schema = schema.of_robot(robot)
    else:
        schema = _of_names(schema, tuple(robot), tuple(joint_types or ()), mimics)
    cells = read_table(path, schema, part=part)
    measurements = validated(
        schema.joint_names, cells.arrays | {"rows": cells.rows}, source=source, units=cells.units
    )
    measurements = replace(measurements, approach_from=cells.approach_from)
    if not only_joints and measurements.sensor is None:
        raise MeasurementError(
            f"{source}: no measurement in the table; expected columns {expected_columns()}"
        )
    return measurements


def _of_names(
    schema: Schema, names: tuple[str, ...], types: tuple[str, ...], mimics: Sequence[Mimic]
) -> Schema:
    """Return a schema with named joints, of which those that mimic others need no column."""
    driven = {mimic.joint for mimic in mimics}
    return replace(
        schema,
        joint_names=names,
        joint_types=types,
        own_joints=tuple(name for name in names if name not in driven),
        following=partial(mimicked, names=names, mimics=mimics),
    )


def row_parts(path: str | os.PathLike[str], most: int = MOST_ROWS) -> Iterator[range]:
    """Yield the rows of a Parquet file, by index, in parts of limited size.

    Raises:
        MeasurementError: for a file that can't be read.
    """
    import polars as pl

    path = Path(path)
    with typed_errors(path):
        count = int(pl.scan_parquet(path, glob=False).select(pl.len()).collect().item())
    # Parts of about the same size, so that none has too few rows.
    ends = np.linspace(0, count, max(-(-count // most), 1) + 1).round().astype(int).tolist()
    yield from (range(a, b) for a, b in pairwise(ends))


def write_table(
    path: str | os.PathLike[str], columns: Mapping[str, np.ndarray], *, to_fill: Sequence[str] = ()
) -> None:
    """Write columns as CSV, tab-separated text or Parquet, by the ending of the name, in full
    precision.

    Args:
        path: the file to write; an existing one is replaced only when the new one is complete.
        columns: values by header, shape (N,) each.
        to_fill: headers of further, empty columns.

    Raises:
        OutputError: for columns of unequal length, another ending, or a place that can't be written
            to.
    """
    import polars as pl

    path = Path(path)
    ending = path.suffix.lower()
    if ending not in TABLE_ENDINGS:
        raise OutputError(
            f"{path}: a table can't be written as {ending or 'a file without an ending'}; "
            "end the name in .csv or .parquet"
        )
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    shapes = [values.shape for values in arrays.values()]
    if len(set(shapes)) != 1 or len(shapes[0]) != 1:
        listed = ", ".join(f"{name} {shape}" for name, shape in zip(arrays, shapes, strict=True))
        raise OutputError(
            f"{path}: columns of shape {listed or 'nothing'}; expected all of one shape (N,)"
        )
    frame = pl.DataFrame({name: np.ascontiguousarray(values) for name, values in arrays.items()})
    frame = frame.with_columns(
        pl.lit(None, pl.Float64).alias(name) for name in to_fill if name not in arrays
    )
    with replacing(path) as draft:
        try:
            if ending == ".parquet":
                frame.write_parquet(draft)
            else:
                frame.write_csv(draft, separator="\t" if ending == ".tsv" else ",")
        except pl.exceptions.PolarsError as error:
            raise OutputError(
                f"{path}: can't be written ({error}); choose a folder that exists and is writable"
            ) from error


def stations_of(tables: Iterable[tuple[str, Measurements]]) -> dict[str, Measurements]:
    """Return the rows of each station, in the order in which stations appear.

    A table is a station unless it has a column ``station``; rows of one name may then come from
    several tables. Rows between other links form a separate station, named after the set-up and
    these links.

    Args:
        tables: tables with their names as stations if they have no such column.

    Raises:
        BadInputError: if two stations have the same name, or rows of one station were read by
            different sensors.

    Example:
        >>> from pincal.measure.measurements import measurements_from_arrays
        >>> columns = {"distance": [1.0] * 3, "station": ["mo", "tu", "mo"]}
        >>> days = measurements_from_arrays(["a"], [[0.0], [1.0], [2.0]], **columns)
        >>> found = stations_of([("days", days), ("later", days.select([0]))])
        >>> {name: len(rows) for name, rows in found.items()}
        {'mo': 3, 'tu': 1}
    """
    tables = [pair for name, table in tables for pair in _by_links(name, table)]
    whole: dict[str, Measurements] = {}
    parts: dict[str, list[Measurements]] = {}
    for name, table in tables:
        if table.station is None:
            if name in whole:
                raise _same_name(name, whole[name], table)
            whole[name] = table
            parts.setdefault(name, [])
            continue
        for station in dict.fromkeys(table.station.tolist()):
            parts.setdefault(station, []).append(_rows_of(table, station))
    for name in whole.keys() & {name for name, found in parts.items() if found}:
        raise _same_name(name, whole[name], parts[name][0])
    stations: dict[str, Measurements] = {}
    for name, found in parts.items():
        # Rows of one station from several tables may be between different links.
        stations |= {name: whole[name]} if name in whole else _by_links(name, _joined(name, found))
    return stations


def _pairs_of_links(table: Measurements) -> list[tuple[list[str], Measurements]]:
    """Return the rows of a table between each pair of links, marked by the names of the links and
    the kind of reading.
    """
    sensor = table.sensor
    parts = (
        list(sensor.parts(table))
        if sensor is not None and issubclass(sensor, Divided)
        else [("", table)]
    )
    found: list[tuple[list[str], Measurements]] = []
    for kind, part in parts:
        columns = [of for end in LINK_ENDS if (of := getattr(part, f"{end}_link")) is not None]
        if not columns or (len(part) and all((of == of[0]).all() for of in columns)):
            found.append(([*(str(of[0]) for of in columns), kind], part))
            continue
        links, inverse = np.unique(np.array(columns), axis=1, return_inverse=True)
        found += [
            ([*links[:, k], kind], part.select(inverse == k))
            for k in dict.fromkeys(inverse.tolist())
        ]
    return found


def _by_links(name: str, table: Measurements) -> Iterator[tuple[str, Measurements]]:
    """Yield the rows of a table between each pair of links, with their names as stations."""
    found = _pairs_of_links(table)
    # Readings from different links are by different instruments.
    starts = [
        "" if rows.from_link is None or not len(rows) else str(rows.from_link[0])
        for _, rows in found
    ]
    for (own, rows), start in zip(found, starts, strict=True):
        shared = (name or _UNNAMED) if len(set(starts)) == 1 else f"{name or _UNNAMED}:{start}"
        # Only marks that differ between the stations.
        several = zip(own, zip(*(marks for marks, _ in found), strict=True), strict=True)
        ending = "".join(f":{mark}" for mark, all_marks in several if len(set(all_marks)) > 1)
        ending = ending.removeprefix("" if name else ":")
        station = (
            None
            if rows.station is None
            else np.array([f"{each}{ending}" for each in rows.station.tolist()])
        )
        setup = shared if ending and starts.count(start) > 1 else rows.setup
        yield f"{name}{ending}", replace(rows, station=station, setup=setup)


def _rows_of(table: Measurements, station: str) -> Measurements:
    assert table.station is not None
    mine = table.station == station
    if not station.strip():
        raise BadInputError(
            f'{table.source}, line {table.rows[mine][0]}, "station": no name; expected '
            "one in each row"
        )
    return replace(table if mine.all() else table.select(mine), station=None)


def _joined(name: str, parts: list[Measurements]) -> Measurements:
    if len(parts) == 1:
        return parts[0]
    kinds = {part.kind: part.source for part in parts}
    if len(kinds) > 1:
        (kind, source), (other, second) = list(kinds.items())[:2]
        raise BadInputError(
            f"station {name!r} is read as {kind} in {source} and as {other} in {second}; expected "
            "one sensor at a station: give each its own name in the column station"
        )
    return concatenate(parts)


def _same_name(name: str, one: Measurements, other: Measurements) -> BadInputError:
    kinds = f" of different kinds ({one.kind} and {other.kind})" if one.kind != other.kind else ""
    return BadInputError(
        f"two stations{kinds} are called {name!r}, from {one.source} and {other.source}; expected "
        "a different name for each: rename a file, or name the stations in a column station"
    )
