"""Measured poses in one table: arrays in SI units, read from CSV, Excel or Parquet and written to CSV or Parquet.

One row is one measured pose. The joints carry the names of the URDF; a unit in square brackets converts
(``x [mm]``, ``joint_1 [deg]``). Whatever can't be right is refused with the line and the column it stands in.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from pincal.atomic import replacing
from pincal.errors import MeasurementError, OutputError
from pincal.measure.fields import CONDITIONS
from pincal.measure.files import typed_errors
from pincal.measure.measurements import Measurements, concatenate, measurements_from_arrays, validated
from pincal.measure.options import TableOptions
from pincal.measure.reader import joint_columns, read_columns, read_table
from pincal.measure.registry import expected_columns, known_fields
from pincal.measure.schema import Schema
from pincal.robot.tree import Mimic

__all__ = ["Measurements", "concatenate", "joint_columns", "measurements_from_arrays", "read_columns"]
__all__ += ["read_measurements", "row_parts", "write_table"]

# Rows that are worked on at once where not all fit into memory: some hundred MB with all that a fit makes of them.
MOST_ROWS = 200_000


def read_measurements(
    path: str | os.PathLike[str],
    joint_names: Sequence[str],
    *,
    ignore: Sequence[str] = (),
    columns: Mapping[str, str] | None = None,
    orientation: str | None = None,
    joints: str | os.PathLike[str] | None = None,
    rows_in_order: bool = False,
    shares_log: bool = False,
    require: Literal["measurement", "joints"] = "measurement",
    joint_types: Sequence[str] | None = None,
    mimics: Sequence[Mimic] = (),
    part: range | None = None,
) -> Measurements:
    """Read a table of measured poses from CSV or other text, Excel or Parquet.

    Args:
        path: the file; the ending of its name says the format, text if it says none. Of text, separator, decimal comma and
            encoding are recognised.
        joint_names: the n joints whose columns are needed.
        ignore: columns to leave out; ``"*"`` leaves out all that are unknown.
        columns: names of columns in the table and what they hold, with a unit if the header has none: ``{"J1": "joint_a1
            [deg]"}``; default: as they are named, or as they number the joints.
        orientation: "kuka", "fanuc", "abb", "ur", "rpy", "xyzw" or "wxyz", see :mod:`pincal.measure.orientation`; default:
            as the header says.
        joints: a file of its own with the joint positions, whose rows are found by a column that both files have, by time
            while the pose is held still, or by order; a `PincalWarning` says by which.
        rows_in_order: whether rows stand in the order in which they were measured, or of their times: joints that have no
            column ``approach_<joint>`` then arrived from where they stood in the row before.
        shares_log: whether other tables have their joints from the same file, so that the order of its rows tells nothing.
        require: "joints" needs no measurement and leaves out all columns that are neither a joint nor a condition (target,
            point, payload, temperature, time, station, approach).
        joint_types: "revolute" or "prismatic" for each joint, which decides the units it may have; default: all revolute.
        mimics: the joints that follow another one, which may have no column of their own (``robot.mimics``).
        part: rows of a Parquet file to read, the first being 0, as :func:`row_parts` yields them; default: all.

    Returns:
        The rows in SI units, each with its line in the file (in Parquet: counted as if there were a header).

    Raises:
        MeasurementError: for a file that can't be read, or a column, unit or value that is invalid.
    """
    source, names = Path(path).name, tuple(joint_names)
    only_joints = require == "joints"
    schema = Schema(
        fields=tuple((CONDITIONS if only_joints else known_fields()).values()),
        joint_names=names,
        joint_types=tuple(joint_types or ()),
        mimics=tuple(mimics),
        options=TableOptions(
            ignore=("*", *ignore) if only_joints else tuple(ignore),
            columns=dict(columns or {}),
            orientation=orientation,
            joints=joints,
            rows_in_order=rows_in_order,
            shares_log=shares_log,
        ),
    )
    cells = read_table(path, schema, part=part)
    measurements = validated(names, cells.arrays | {"rows": cells.rows}, source=source, units=cells.units)
    measurements = replace(measurements, approach_from=cells.approach_from)
    if not only_joints and measurements.sensor is None:
        raise MeasurementError(f"{source}: no measurement in the table; expected columns {expected_columns()}")
    return measurements


def row_parts(path: str | os.PathLike[str], most: int = MOST_ROWS) -> Iterator[range]:
    """Yield the rows of a Parquet file in parts of at most so many, one after the other.

    Raises:
        MeasurementError: for a file that can't be read.
    """
    import polars as pl

    path = Path(path)
    with typed_errors(path):
        count = int(pl.scan_parquet(path, glob=False).select(pl.len()).collect().item())
    # Parts of about one size: none is left with too few rows.
    ends = np.linspace(0, count, max(-(-count // most), 1) + 1).round().astype(int).tolist()
    yield from (range(a, b) for a, b in pairwise(ends))


def write_table(path: str | os.PathLike[str], columns: Mapping[str, np.ndarray], *, to_fill: Sequence[str] = ()) -> None:
    """Write columns as CSV (or Parquet, by the name's ending): the whole file or nothing, in full precision.

    Args:
        path: the file to write; an existing one is replaced only when the new one is complete.
        columns: values by header, shape (N,) each.
        to_fill: further headers, whose columns stay empty.

    Raises:
        OutputError: for columns of unequal length, or a place that can't be written to.
    """
    import polars as pl

    path = Path(path)
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    if not arrays or len({values.shape for values in arrays.values()}) > 1 or next(iter(arrays.values())).ndim != 1:
        shapes = ", ".join(f"{name} {np.shape(values)}" for name, values in columns.items())
        raise OutputError(f"{path}: columns of shape {shapes or 'nothing'}; expected all of one shape (N,)")
    frame = pl.DataFrame({name: np.ascontiguousarray(values) for name, values in arrays.items()})
    frame = frame.with_columns(pl.lit(None, pl.Float64).alias(name) for name in to_fill if name not in arrays)
    with replacing(path) as draft:
        try:
            frame.write_parquet(draft) if path.suffix.lower() == ".parquet" else frame.write_csv(draft)
        except pl.exceptions.PolarsError as error:
            raise OutputError(f"{path}: can't be written ({error}); choose a folder that exists and is writable") from error
