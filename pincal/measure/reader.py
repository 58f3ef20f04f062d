"""Reading a table from CSV or Parquet: columns in SI units, put together to the fields that a schema allows.

Measurements, targets of a compensation and lists of known points are tables of different schemas.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.columns import converted, match_columns, quantities_of
from pincal.measure.fields import Field
from pincal.measure.sheet import open_sheet, read_cells


@dataclass(frozen=True)
class Schema:
    """What a table may hold.

    Attributes:
        fields: the quantities that are understood.
        required: names of those that have to be there.
        joint_names: the joints, each with a column of its own and perhaps one for the direction of approach.
        joint_types: "revolute" or "prismatic" for each joint, which says the units it may have; all revolute if empty.
        may_lack_joints: whether a table without any joint is allowed.
        ignore: columns to leave out; ``"*"`` leaves out all that are unknown.
    """

    fields: tuple[Field, ...]
    required: tuple[str, ...] = ()
    joint_names: tuple[str, ...] = ()
    joint_types: tuple[str, ...] = ()
    may_lack_joints: bool = False
    ignore: tuple[str, ...] = ()


@dataclass(frozen=True)
class Cells:
    """What a table of N rows holds.

    Attributes:
        arrays: values in SI units by the names of the fields, shape (N,) or (N, k); joint positions as "q" and directions of
            approach as "approach", shape (N, n), where there are any.
        rows: shape (N,), line of each row in its file, the header being line 1.
        units: the units that the header gave, by column.
    """

    arrays: dict[str, np.ndarray]
    rows: np.ndarray
    units: dict[str, str]


def read_table(path: str | os.PathLike[str], schema: Schema) -> Cells:
    """Read a table from CSV (field separator and decimal mark are detected) or Parquet.

    Args:
        path: the file; ``.parquet`` is read as Parquet, everything else as CSV.
        schema: what it may hold.

    Raises:
        MeasurementError: for a file that can't be read, or a column, unit or cell that is invalid.
    """
    path = Path(path)
    joints = schema.joint_names
    with typed_errors(path):
        sheet = open_sheet(path)
        quantities = quantities_of(joints, schema.joint_types or None, schema.fields, source=path.name)
        if schema.may_lack_joints and not {label.split("[")[0].strip() for label in sheet.labels} & set(joints):
            quantities = {name: quantity for name, quantity in quantities.items() if name not in joints}
            joints = ()
        columns = match_columns(sheet, joints, quantities, ignore=schema.ignore)
        found = {column.name for column in columns}
        _check_required(schema, found, source=path.name)
        cells, rows = read_cells(sheet, columns)
        values = {column.name: converted(cells.pop(column.name), column) for column in columns}
    arrays = _joint_arrays(joints, values, len(rows)) | _field_arrays(schema.fields, values, source=path.name)
    return Cells(arrays, rows, {column.name: column.unit for column in columns if column.unit})


def read_columns(
    path: str | os.PathLike[str], quantities: Mapping[str, str], *, optional: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Read a small table whose columns are all known; separator, decimal mark and units as in a table of measurements.

    Args:
        path: the file.
        quantities: columns and what they hold: "name", "length", ...
        optional: those that may be absent.

    Returns:
        Columns in SI units, each of shape (N,).

    Raises:
        MeasurementError: for a file that can't be read, or a column, unit or cell that is invalid.
    """
    fields = tuple(Field(name, (name,), quantity) for name, quantity in quantities.items())
    return read_table(path, Schema(fields, required=tuple(name for name in quantities if name not in optional))).arrays


def column_names(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Return the names of a table's columns, units taken off, without reading its rows.

    Raises:
        MeasurementError: for a file that can't be read.
    """
    with typed_errors(Path(path)):
        return tuple(label.split("[")[0].strip() for label in open_sheet(Path(path)).labels)


@contextlib.contextmanager
def typed_errors(path: Path) -> Iterator[None]:
    """Raise whatever goes wrong with a file as a `MeasurementError` that names it."""
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


def _check_required(schema: Schema, found: set[str], *, source: str) -> None:
    required = [column for field in schema.fields if field.name in schema.required for column in field.columns]
    missing = [column for column in required if column not in found]
    if missing:
        raise MeasurementError(f"{source}: no column {missing[0]!r}; expected columns {' '.join(required)}")


def _joint_arrays(names: tuple[str, ...], values: dict[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    if not names:
        return {}
    arrays = {"q": np.column_stack([values.pop(name) for name in names])}
    if any(f"approach_{name}" in values for name in names):
        unknown = np.zeros(count)
        arrays["approach"] = np.column_stack([values.pop(f"approach_{name}", unknown) for name in names])
    return arrays


def _field_arrays(fields: tuple[Field, ...], values: dict[str, np.ndarray], *, source: str) -> dict[str, np.ndarray]:
    arrays = {}
    for field in fields:
        given = [part for part in field.columns if part in values]
        if given and len(given) < len(field.columns):
            missing = " ".join(part for part in field.columns if part not in given)
            raise MeasurementError(f"{source}: {' '.join(given)} without {missing}; add what is missing")
        if given:
            stack = [values.pop(part) for part in given]
            arrays[field.name] = np.column_stack(stack) if len(stack) > 1 else stack[0]
    return arrays
