"""Headers of a table: which columns are known, and which units they may have."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.fields import Field, nearest_first
from pincal.measure.sheet import Column, Sheet

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


def match_columns(
    sheet: Sheet, names: tuple[str, ...], quantities: Mapping[str, str], *, ignore: tuple[str, ...]
) -> list[Column]:
    """Return the columns that are needed; raise for those that are not understood."""
    columns: list[Column] = []
    unknown: list[str] = []
    for index, label in enumerate(sheet.labels):
        name = label.split("[")[0].strip()
        if name in ignore or label in ignore:
            continue
        if name not in quantities:
            unknown.append(label)
            continue
        unit = _unit_of(label, quantities[name], where=f'{sheet.path.name}, column {index + 1} ("{label}")')
        if any(name == column.name for column in columns):
            raise MeasurementError(f'{sheet.path.name}: two columns "{name}"; expected one, delete or rename the other')
        columns.append(Column(index, name, label, unit, quantities[name]))
    found = {column.name for column in columns}
    _check_joints([name for name in names if name not in found], unknown, source=sheet.path.name)
    if unknown and "*" not in ignore:
        free = [name for name in quantities if name not in found]
        known = ", ".join(nearest_first([label.split("[")[0].strip() for label in unknown], free))
        listed = ", ".join(f'"{label}"' for label in unknown)
        raise MeasurementError(
            f"{sheet.path.name}: unknown column {listed}; known and not in the table, nearest first: "
            f"{known or 'none'}; rename it (a unit is written as x [mm]), delete it or ignore it"
        )
    return columns


def quantities_of(
    names: tuple[str, ...], joint_types: Sequence[str] | None, fields: Sequence[Field], *, source: str
) -> dict[str, str]:
    """Return the physical quantity of every column that a table of these joints may have."""
    known = {column: field.quantity for field in fields for column in field.columns}
    clash = [name for name in names if name in known]
    if clash:
        raise MeasurementError(f'{source}: joint "{clash[0]}" has the name of a column; rename it in the URDF')
    types = joint_types or ["revolute"] * len(names)
    joints = {name: "length" if kind == "prismatic" else "angle" for name, kind in zip(names, types, strict=True)}
    return joints | known | {f"approach_{name}": "number" for name in names}


def _check_joints(missing: Sequence[str], unknown: Sequence[str], *, source: str) -> None:
    if not missing:
        return
    texts = []
    for name in missing:
        same = [label for label in unknown if label.split("[")[0].strip().casefold() == name.casefold()]
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


def converted(series: pl.Series, column: Column) -> np.ndarray:
    """Return the cells of one column in SI units, shape (N,)."""
    if column.quantity == "name":
        return np.array(series.to_list(), dtype=str)
    scale, offset = _UNITS[column.quantity].get(column.unit, (1, 0))
    values = series.to_numpy()
    return values if (scale, offset) == (1, 0) else values * scale + offset
