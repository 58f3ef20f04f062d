"""Reading a table from CSV or Parquet: columns by name and unit, in SI units, put together to the fields of a schema.

Measurements, targets of a compensation and lists of known points are tables of different schemas.
"""

from __future__ import annotations

import contextlib
import difflib
import os
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pincal.errors import MeasurementError, nearest_first
from pincal.measure.fields import Field
from pincal.measure.sheet import Column, Sheet, open_sheet, read_cells

if TYPE_CHECKING:
    import polars as pl

# SI value = factor * value + offset, by physical quantity and unit.
_LENGTHS: dict[str, tuple[float, float]] = {
    "m": (1, 0),
    "mm": (1e-3, 0),
    "cm": (1e-2, 0),
    "um": (1e-6, 0),
    "µm": (1e-6, 0),
    "in": (0.0254, 0),
}
_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "length": _LENGTHS,
    "noise": _LENGTHS | {"px": (1, 0)},
    "angle": {"rad": (1, 0), "mrad": (1e-3, 0), "deg": (np.pi / 180, 0), "°": (np.pi / 180, 0)},
    "mass": {"kg": (1, 0), "g": (1e-3, 0), "lb": (0.45359237, 0)},
    "time": {"s": (1, 0), "ms": (1e-3, 0), "min": (60, 0), "h": (3600, 0)},
    "temperature": {"degC": (1, 0), "°C": (1, 0), "K": (1, -273.15)},
    "pixel": {"px": (1, 0)},
    "number": {},
    "name": {},
}


@dataclass(frozen=True)
class Schema:
    """What a table may hold.

    Attributes:
        fields: the quantities that are understood.
        joint_names: the joints, each with a column of its own and perhaps one for the direction of approach.
        joint_types: "revolute" or "prismatic" for each joint, which says the units it may have; all revolute if empty.
        may_lack_joints: whether a table without any joint is allowed.
        ignore: columns to leave out; ``"*"`` leaves out all that are unknown.
    """

    fields: tuple[Field, ...]
    joint_names: tuple[str, ...] = ()
    joint_types: tuple[str, ...] = ()
    may_lack_joints: bool = False
    ignore: tuple[str, ...] = ()

    def quantities(self, *, source: str) -> dict[str, str]:
        """Return the physical quantity of every column that a table may have; joints that clash with a field are refused."""
        known = {column: field.quantity for field in self.fields for column in field.columns}
        clash = [name for name in self.joint_names if name in known]
        if clash:
            raise MeasurementError(f'{source}: joint "{clash[0]}" has the name of a column; rename it in the URDF')
        types = self.joint_types or ("revolute",) * len(self.joint_names)
        pairs = zip(self.joint_names, types, strict=True)
        joints = {name: "length" if kind == "prismatic" else "angle" for name, kind in pairs}
        return joints | known | {f"approach_{name}": "number" for name in self.joint_names}


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
    with _typed_errors(path):
        sheet = open_sheet(path)
        quantities = schema.quantities(source=path.name)
        if schema.may_lack_joints and not {_name(label) for label in sheet.labels} & set(joints):
            quantities = {name: quantity for name, quantity in quantities.items() if name not in joints}
            joints = ()
        columns = _matched(sheet, joints, quantities, ignore=schema.ignore)
        cells, rows = read_cells(sheet, columns)
        values = {}
        for column in columns:
            values[column.name] = _in_si(cells.pop(column.name), column)
    arrays = {} if not joints else {"q": np.column_stack([values.pop(name) for name in joints])}
    if any(f"approach_{name}" in values for name in joints):
        unknown = np.zeros(len(rows))
        arrays["approach"] = np.column_stack([values.pop(f"approach_{name}", unknown) for name in joints])
    for field in schema.fields:
        if any(part in values for part in field.columns):
            arrays[field.name] = _whole(field, values, source=path.name)
    return Cells(arrays, rows, {column.name: column.unit for column in columns if column.unit})


def _whole(field: Field, values: Mapping[str, np.ndarray], *, source: str) -> np.ndarray:
    """Return the array of a field whose columns have to come together.

    Raises:
        MeasurementError: if some of them are missing.
    """
    given = [part for part in field.columns if part in values]
    if missing := [part for part in field.columns if part not in values]:
        raise MeasurementError(f"{source}: {' '.join(given)} without {' '.join(missing)}; add what is missing")
    return np.column_stack([values[part] for part in given]) if len(given) > 1 else values[given[0]]


def read_columns(
    path: str | os.PathLike[str], quantities: Mapping[str, str], *, optional: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Return the columns in SI units, shape (N,) each, of a small table whose columns are all known.

    Args:
        path: the file; separator, decimal mark and units as in a table of measurements.
        quantities: columns and what they hold: "name", "length", ...
        optional: those that may be absent.

    Raises:
        MeasurementError: for a file that can't be read, or a column, unit or cell that is invalid.
    """
    required = [name for name in quantities if name not in optional]
    missing = set(required).difference(column_names(path))
    if missing:
        first = next(name for name in required if name in missing)
        raise MeasurementError(f"{Path(path).name}: no column {first!r}; expected columns {' '.join(required)}")
    return read_table(path, Schema(tuple(Field(name, (name,), quantity) for name, quantity in quantities.items()))).arrays


def column_names(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Return the names of a table's columns, units taken off, without reading its rows.

    Raises:
        MeasurementError: for a file that can't be read.
    """
    with _typed_errors(Path(path)):
        return tuple(_name(label) for label in open_sheet(Path(path)).labels)


def _name(label: str) -> str:
    return label.split("[")[0].strip()


def _matched(
    sheet: Sheet, joints: tuple[str, ...], quantities: Mapping[str, str], *, ignore: tuple[str, ...]
) -> list[Column]:
    """Return the columns that are needed; raise for those that are not understood."""
    source, columns, unknown = sheet.path.name, dict[str, Column](), list[str]()
    for index, label in enumerate(sheet.labels):
        name = _name(label)
        if name in ignore or label in ignore:
            continue
        if name not in quantities:
            unknown.append(label)
            continue
        unit = _unit_of(label, quantities[name], where=f'{source}, column {index + 1} ("{label}")')
        if name in columns:
            raise MeasurementError(f'{source}: two columns "{name}"; expected one, delete or rename the other')
        columns[name] = Column(index, name, label, unit, quantities[name])
    _check_joints([name for name in joints if name not in columns], unknown, source=source)
    if unknown and "*" not in ignore:
        free = [name for name in quantities if name not in columns]
        known = ", ".join(nearest_first([_name(label) for label in unknown], free))
        listed = ", ".join(f'"{label}"' for label in unknown)
        raise MeasurementError(
            f"{source}: unknown column {listed}; known and not in the table, nearest first: "
            f"{known or 'none'}; rename it (a unit is written as x [mm]), delete it or ignore it"
        )
    return list(columns.values())


def _check_joints(missing: Sequence[str], unknown: Sequence[str], *, source: str) -> None:
    if not missing:
        return
    texts = []
    for name in missing:
        same = [label for label in unknown if _name(label).casefold() == name.casefold()]
        close = same or difflib.get_close_matches(name, unknown, n=1, cutoff=0.6)
        texts.append(f'"{name}"' + (f' (is it "{close[0]}"?)' if close else ""))
    raise MeasurementError(f"{source}: no column for joint {', '.join(texts)}; expected a column named as in the URDF")


def _unit_of(label: str, quantity: str, *, where: str) -> str:
    match = re.fullmatch(r"[^\[\]]*(?:\[([^\[\]]*)\])?", label)
    unit = unicodedata.normalize("NFC", (match[1] or "").strip()).replace("μ", "µ") if match else ""
    accepted = ", ".join(f"[{unit}]" for unit in _UNITS[quantity]) or "no unit"
    if match is None:
        raise MeasurementError(f"{where}: unclosed unit; expected at its end one of {accepted}")
    if "[" in label and unit not in _UNITS[quantity]:
        raise MeasurementError(f"{where}: [{unit}] is no unit of this column; expected one of {accepted}")
    return unit


def _in_si(series: pl.Series, column: Column) -> np.ndarray:
    if column.is_name:
        return np.array(series.to_list(), dtype=str)
    values = series.to_numpy()
    scale, offset = _UNITS[column.quantity].get(column.unit, (1, 0))
    return values if (scale, offset) == (1, 0) else values * scale + offset


@contextlib.contextmanager
def _typed_errors(path: Path) -> Iterator[None]:
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
