"""Measured poses in one table: arrays in SI units, read from and written to CSV or Parquet.

One row is one measured pose. The joints carry the names of the URDF; a unit in square brackets converts
(``x [mm]``, ``joint_1 [deg]``). Whatever can't be right is refused with the line and the column it stands in.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from pincal.atomic import replacing
from pincal.errors import MeasurementError, OutputError
from pincal.measure.columns import converted, match_columns, quantities_of
from pincal.measure.fields import CONDITIONS, FIELDS
from pincal.measure.measurements import Measurements, concatenate, measurements_from_arrays, validated
from pincal.measure.sheet import open_sheet, read_cells

__all__ = [
    "Measurements",
    "column_names",
    "concatenate",
    "measurements_from_arrays",
    "read_columns",
    "read_measurements",
    "write_table",
]


def read_measurements(
    path: str | os.PathLike[str],
    joint_names: Sequence[str],
    *,
    ignore: Sequence[str] = (),
    require: Literal["measurement", "joints"] = "measurement",
    joint_types: Sequence[str] | None = None,
) -> Measurements:
    """Read a table of measured poses from CSV (separator and decimal comma are recognised) or Parquet.

    Args:
        path: The file; ``.parquet`` is read as Parquet, everything else as CSV.
        joint_names: The n joints whose columns are needed.
        ignore: Columns to leave out; ``"*"`` leaves out all that are unknown.
        require: "joints" needs no measurement and leaves out all columns that are neither a joint nor a
            condition (target, point, payload, temperature, time, approach).
        joint_types: "revolute" (the default) or "prismatic" for each joint: decides which units it may have.

    Returns:
        The rows in SI units, each with its line in the file (in Parquet: counted as if there were a header).

    Raises:
        MeasurementError: A file that can't be read, or a column, unit or value that can't be right.
    """
    path, names = Path(path), tuple(joint_names)
    fields = CONDITIONS if require == "joints" else FIELDS
    quantities = quantities_of(names, joint_types, fields, source=path.name)
    with _typed_errors(path):
        sheet = open_sheet(path)
        columns = match_columns(sheet, names, quantities, ignore=("*", *ignore) if require == "joints" else tuple(ignore))
        cells, rows = read_cells(sheet, columns)
        values = {column.name: converted(cells.pop(column.name), column) for column in columns}
    arrays = _assemble(names, values, rows, source=path.name)
    measurements = validated(names, arrays, source=path.name, units={c.name: c.unit for c in columns if c.unit})
    if require == "measurement" and measurements.kind == "none":
        expected = "x y z, x y z qx qy qz qw, distance, socket, cx cy cz with point, or u v with point"
        raise MeasurementError(f"{path.name}: no measurement in the table; expected columns {expected}")
    return measurements


def read_columns(
    path: str | os.PathLike[str], quantities: Mapping[str, str], *, optional: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Read a small table whose columns are all known; separator, decimal comma and units as in a table of measurements.

    Args:
        path: The file.
        quantities: Columns and what they hold: "name", "length", ...
        optional: Those that may be absent.

    Returns:
        Columns in SI units, each of shape (N,).

    Raises:
        MeasurementError: A file that can't be read, or a column, unit or value that can't be right.
    """
    path = Path(path)
    with _typed_errors(path):
        sheet = open_sheet(path)
        columns = match_columns(sheet, (), quantities, ignore=())
        missing = [name for name in quantities if name not in {c.name for c in columns} and name not in optional]
        if missing:
            expected = " ".join(name for name in quantities if name not in optional)
            raise MeasurementError(f"{path.name}: no column {missing[0]!r}; expected columns {expected}")
        cells, _ = read_cells(sheet, columns)
        return {column.name: converted(cells.pop(column.name), column) for column in columns}


def column_names(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Return the names of a table's columns, units taken off, without reading its rows.

    Raises:
        MeasurementError: A file that can't be read.
    """
    with _typed_errors(Path(path)):
        return tuple(label.split("[")[0].strip() for label in open_sheet(Path(path)).labels)


def write_table(path: str | os.PathLike[str], columns: Mapping[str, np.ndarray]) -> None:
    """Write columns as CSV (or Parquet, by the name's ending): the whole file or nothing, in full precision.

    Args:
        path: The file to write; an existing one is replaced only when the new one is complete.
        columns: Header -> values, each shape (N,).

    Raises:
        OutputError: Columns of unequal length, or a place that can't be written to.
    """
    import polars as pl

    path = Path(path)
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    if not arrays or len({values.shape for values in arrays.values()}) > 1 or next(iter(arrays.values())).ndim != 1:
        shapes = ", ".join(f"{name} {np.shape(values)}" for name, values in columns.items())
        raise OutputError(f"{path}: columns of shape {shapes or 'nothing'}; expected all of one shape (N,)")
    frame = pl.DataFrame({name: np.ascontiguousarray(values) for name, values in arrays.items()})
    with replacing(path) as draft:
        try:
            frame.write_parquet(draft) if path.suffix.lower() == ".parquet" else frame.write_csv(draft)
        except pl.exceptions.PolarsError as error:
            raise OutputError(f"{path}: can't be written ({error}); choose a folder that exists and is writable") from error


@contextlib.contextmanager
def _typed_errors(path: Path) -> Iterator[None]:
    import polars as pl

    try:
        yield
    except MeasurementError:
        raise
    except FileNotFoundError as error:
        raise MeasurementError(f"{path}: no such file; check the name and the folder") from error
    except IsADirectoryError as error:
        raise MeasurementError(f"{path}: is a folder; expected a file, .csv or .parquet") from error
    except (OSError, ValueError, pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
        reason = str(error).strip().split("\n")[0]
        raise MeasurementError(f"{path}: can't be read ({reason}); expected a CSV or .parquet table") from error


def _assemble(
    names: tuple[str, ...], values: dict[str, np.ndarray], rows: np.ndarray, *, source: str
) -> dict[str, np.ndarray]:
    arrays = {"rows": rows, "q": np.column_stack([values.pop(name) for name in names])}
    if any(f"approach_{name}" in values for name in names):
        unknown = np.zeros(len(rows))
        arrays["approach"] = np.column_stack([values.pop(f"approach_{name}", unknown) for name in names])
    for name, (_, parts) in FIELDS.items():
        given = [part for part in parts if part in values]
        if given and len(given) < len(parts):
            missing = " ".join(part for part in parts if part not in given)
            raise MeasurementError(f"{source}: {' '.join(given)} without {missing}; add what is missing")
        if given:
            stack = [values.pop(part) for part in given]
            arrays[name] = np.column_stack(stack) if len(stack) > 1 else stack[0]
    return arrays
