"""Reading a table: columns by name and unit, in SI units, put together to the fields of a schema.

Measurements, targets of a compensation and lists of known points are tables of different schemas.
"""

from __future__ import annotations

import difflib
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pincal.errors import MeasurementError, PincalWarning, nearest_first
from pincal.measure.fields import CONDITIONS, Field
from pincal.measure.files import open_sheet, typed_errors
from pincal.measure.joined import Log, join
from pincal.measure.labels import Label, listed, numbered_joints, renamed, spelled, unit_of, without_unit
from pincal.measure.options import TableOptions
from pincal.measure.orientation import CONVENTIONS, Orientation, find_orientation, looks_like_orientation
from pincal.measure.quantities import in_si
from pincal.measure.sheet import Column, Sheet, read_cells
from pincal.robot.tree import Mimic

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True)
class Schema:
    """What a table may hold.

    Attributes:
        fields: the quantities that are understood.
        joint_names: the joints, each with a column of its own and perhaps one for the direction of approach.
        joint_types: "revolute" or "prismatic" for each joint, which says the units it may have; all revolute if empty.
        mimics: the joints that follow another one; they may be absent, as their position follows from that one's.
        may_lack_joints: whether a table without any joint is allowed.
        options: what the user says of it.
    """

    fields: tuple[Field, ...]
    joint_names: tuple[str, ...] = ()
    joint_types: tuple[str, ...] = ()
    mimics: tuple[Mimic, ...] = ()
    may_lack_joints: bool = False
    options: TableOptions = field(default_factory=TableOptions)

    @property
    def own_joints(self) -> tuple[str, ...]:
        """The joints that follow none, whose columns are needed."""
        driven = {mimic.joint for mimic in self.mimics}
        return tuple(name for name in self.joint_names if name not in driven)

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
    """Read a table from CSV or other text (separator, decimal mark and encoding are detected), Excel or Parquet.

    Args:
        path: the file; the ending of its name says the format, text if it says none.
        schema: what it may hold.

    Raises:
        MeasurementError: for a file that can't be read, or a column, unit or cell that is invalid.
    """
    path = Path(path)
    with typed_errors(path):
        sheet = open_sheet(path, ignore=schema.options.ignore, joints=schema.joint_names)
        if schema.options.joints is not None and schema.joint_names:
            sheet, schema = _with_log(sheet, schema)
        header = _understood(sheet, schema)
        cells, rows = read_cells(sheet, header.columns)
        values = {column.name: _in_si(cells.pop(column.name), column) for column in header.columns}
    if header.orientation is not None:
        found = header.orientation.quaternions(values, where=path.name)
        values = {name: value for name, value in values.items() if name not in header.orientation.columns}
        values |= zip(_rotations(schema.fields).columns, found.T, strict=True)
    joints = header.joints
    for mimic in schema.mimics:
        if mimic.joint in joints and mimic.joint not in values:
            values[mimic.joint] = mimic.multiplier * values[mimic.source] + mimic.offset
            if (approach := values.get(f"approach_{mimic.source}")) is not None:
                values.setdefault(f"approach_{mimic.joint}", np.sign(mimic.multiplier) * approach)
    arrays = {} if not joints else {"q": np.column_stack([values.pop(name) for name in joints])}
    if any(f"approach_{name}" in values for name in joints):
        unknown = np.zeros(len(rows))
        arrays["approach"] = np.column_stack([values.pop(f"approach_{name}", unknown) for name in joints])
    for part in schema.fields:
        if any(name in values for name in part.columns):
            arrays[part.name] = _whole(part, values, source=path.name)
    return Cells(arrays, rows, {column.name: column.unit for column in header.columns if column.unit})


def _whole(part: Field, values: Mapping[str, np.ndarray], *, source: str) -> np.ndarray:
    """Return the array of a field whose columns have to come together.

    Raises:
        MeasurementError: if some of them are missing.
    """
    given = [name for name in part.columns if name in values]
    if missing := [name for name in part.columns if name not in values]:
        raise MeasurementError(f"{source}: {' '.join(given)} without {' '.join(missing)}; add what is missing")
    return np.column_stack([values[name] for name in given]) if len(given) > 1 else values[given[0]]


def read_columns(
    path: str | os.PathLike[str], quantities: Mapping[str, str], *, optional: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Return the columns in SI units, shape (N,) each, of a small table whose columns are all known.

    Args:
        path: the file; formats and units as in a table of measurements.
        quantities: columns and what they hold: "name", "length", ...
        optional: those that may be absent.

    Raises:
        MeasurementError: for a file that can't be read, or a column, unit or cell that is invalid.
    """
    schema = Schema(tuple(Field(name, (name,), quantity) for name, quantity in quantities.items()))
    found = read_table(path, schema).arrays
    required = [name for name in quantities if name not in optional]
    missing = [name for name in required if name not in found]
    if missing:
        raise MeasurementError(f"{Path(path).name}: no column {missing[0]!r}; expected columns {' '.join(required)}")
    return found


def joint_columns(path: str | os.PathLike[str], names: Iterable[str], options: TableOptions) -> tuple[str, ...]:
    """Return those of some joints that have a column in a table, in the order of the columns, without reading its rows.

    Raises:
        MeasurementError: for a file that can't be read.
    """
    angles = dict.fromkeys(names, "angle")
    lengths = dict.fromkeys(angles, "length")
    place = Path(path if options.joints is None else options.joints)
    with typed_errors(place):
        others = () if options.joints is None else open_sheet(Path(path)).labels
        sheet = open_sheet(place, ignore=options.ignore, only_joints=True)
        labels = renamed(sheet.labels, options.columns, source=place.name, others=others)
    found = [spelled(label, angles) or spelled(label, lengths) for label in labels]
    return tuple(dict.fromkeys(name for name, _ in filter(None, found)))


def _with_log(sheet: Sheet, schema: Schema) -> tuple[Sheet, Schema]:
    """Return a table joined with the log that the user names, and how to read it then."""
    options, source = schema.options, sheet.path.name
    path = Path(options.joints or "")
    quantities = schema.quantities(source=path.name)
    readings = {name for part in schema.fields if part.name not in CONDITIONS for name in part.columns}
    told = {name: quantity for name, quantity in quantities.items() if name not in readings}
    with typed_errors(path):
        log = open_sheet(path, ignore=options.ignore, only_joints=True)
        labels = renamed(log.labels, options.columns, source=path.name, others=sheet.labels)
        labels = _with_joints(labels, schema, quantities, source=path.name)
        columns, unknown = _matched(labels, told, {}, source=path.name)
        _check_joints([name for name in schema.joint_names if name not in columns], unknown, log)
        cells, _ = read_cells(log, tuple(columns.values()))
        values = {name: _in_si(cells[name], column) for name, column in columns.items()}
    mine = renamed(sheet.labels, options.columns, source=source, others=log.labels)
    mine = [label for label in mine if not {label.name, label.meant, label.text} & set(options.ignore)]
    found, _ = _matched(mine, quantities, {}, source=source)
    if twice := [name for name in schema.joint_names if name in found]:
        raise MeasurementError(
            f'{source}: joint "{twice[0]}" stands in {path.name}, too; leave out --joints, or ignore the column'
        )
    time = None
    if "time" in found:
        time = _in_si(read_cells(sheet, (found["time"],))[0]["time"], found["time"])
    known = {*quantities, *options.ignore}
    whole = join(sheet, Log(log, values, schema.joint_names), time, known=known, has=found)
    here = {name: meaning for name, meaning in options.columns.items() if _names_one(name, whole.labels)}
    return whole, replace(schema, options=replace(options, joints=None, columns=here))


def _names_one(name: str, labels: Sequence[str]) -> bool:
    return any(name in (label, without_unit(label)) for label in labels)


@dataclass(frozen=True)
class _Header:
    """What a header means: the columns that are needed, the joints among them, and those that tell an orientation."""

    columns: tuple[Column, ...]
    joints: tuple[str, ...]
    orientation: Orientation | None


def _rotations(fields: Iterable[Field]) -> Field:
    """Return the field that holds a unit quaternion."""
    return next(part for part in fields if part.is_unit)


def _understood(sheet: Sheet, schema: Schema) -> _Header:
    """Return what a header means; raise for what is not understood, warn of what is guessed or left out."""
    source, options = sheet.path.name, schema.options
    labels = renamed(sheet.labels, options.columns, source=source)
    labels = [label for label in labels if not {label.name, label.meant, label.text} & set(options.ignore)]
    quantities = schema.quantities(source=source)
    labels = _with_joints(labels, schema, quantities, source=source)
    orientation = None
    if any(part.is_unit for part in schema.fields):
        orientation = _orientation(labels, schema, quantities, source=source)
    units = {}
    if orientation is not None:
        hidden = {*_rotations(schema.fields).columns} - {*orientation.columns} if options.orientation else set()
        quantities = {name: quantity for name, quantity in quantities.items() if name not in hidden}
        quantities |= dict.fromkeys(orientation.columns, orientation.quantity)
        units = dict.fromkeys(orientation.columns, orientation.convention.unit)
    columns, unknown = _matched(labels, quantities, units, source=source)
    joints = schema.joint_names
    if schema.may_lack_joints and not columns.keys() & set(joints):
        joints = ()
    _check_joints([name for name in schema.own_joints if joints and name not in columns], unknown, sheet)
    if "*" not in options.ignore and not sheet.takes_unknown:
        free = {name: quantity for name, quantity in quantities.items() if name not in columns}
        _check_unknown(sheet, unknown, free)
    return _Header(tuple(columns.values()), joints, orientation)


def _with_joints(labels: list[Label], schema: Schema, quantities: Mapping[str, str], *, source: str) -> list[Label]:
    """Return the labels with those replaced that number the joints, if no joint has a column under its name."""
    names = set(schema.joint_names)
    if not names or any(label.name in names or (spelled(label, quantities) or ("", ""))[0] in names for label in labels):
        return labels
    free = [label for label in labels if label.name not in quantities]
    guessed = numbered_joints(free, schema.own_joints)
    if not guessed:
        return labels
    pairs = ", ".join(f"{label}={joint}" for label, joint in guessed.items())
    warnings.warn(
        f"{source}: joints are taken from the columns {pairs}; if that is wrong, say which with --columns",
        PincalWarning,
        stacklevel=2,
    )
    return [replace(label, meant=guessed.get(label.meant, label.meant)) for label in labels]


def _orientation(labels: list[Label], schema: Schema, quantities: Mapping[str, str], *, source: str) -> Orientation | None:
    """Return how the table tells an orientation, None if it does so by qx qy qz qw or not at all."""
    names, said = [without_unit(label.meant) for label in labels], schema.options.orientation
    usual = _rotations(schema.fields).columns
    found = find_orientation(names, said, taken=[n for n in quantities if n not in usual], source=source)
    if found is None or said is not None:
        return found
    if set(usual) & set(names):
        raise MeasurementError(
            f"{source}: orientations in {' '.join(found.columns)} and in {' '.join(usual)}; expected one: ignore the others"
        )
    warnings.warn(
        f"{source}: {' '.join(found.columns)} are read as {found.convention.words}; if that is wrong, say how with "
        f"--orientation {'|'.join(CONVENTIONS)}",
        PincalWarning,
        stacklevel=2,
    )
    return found


def _matched(
    labels: Sequence[Label], quantities: Mapping[str, str], units: Mapping[str, str], *, source: str
) -> tuple[dict[str, Column], list[Label]]:
    """Return the columns that are known, and the labels that are not; a name as it is known goes before other spellings.

    Args:
        labels: the header.
        quantities: what is known.
        units: of columns whose label has none, where that is not SI.
        source: the file, for messages.
    """
    columns, others = dict[str, Column](), list[Label]()
    for label in labels:
        name = label.name
        if name not in quantities:
            others.append(label)
            continue
        unit = unit_of(label.meant, quantities[name], where=f'{source}, column {label.index + 1} ("{label.text}")')
        if name in columns:
            raise MeasurementError(f'{source}: two columns "{name}"; expected one, delete or rename the other')
        columns[name] = Column(label.index, name, label.text, unit or units.get(name, ""), quantities[name])
    unknown, exact = [], set(columns)
    for label in others:
        found = spelled(label, quantities)
        if found is None or found[0] in exact:
            unknown.append(label)
            continue
        name, unit = found
        where = f'{source}, column {label.index + 1} ("{label.text}")'
        unit = unit_of(unit, quantities[name], where=where) if "[" in unit else unit
        if name in columns:
            raise MeasurementError(f'{source}: two columns "{name}"; expected one, delete or rename the other')
        columns[name] = Column(label.index, name, label.text, unit or units.get(name, ""), quantities[name])
    return columns, unknown


def _check_joints(missing: Sequence[str], unknown: Sequence[Label], sheet: Sheet) -> None:
    if not missing:
        return
    texts, labels = [], [label.text for label in unknown]
    for name in missing:
        close = difflib.get_close_matches(name, labels, n=1, cutoff=0.6)
        texts.append(f'"{name}"' + (f' (is it "{close[0]}"?)' if close else ""))
    raise MeasurementError(
        f"{sheet.path.name}: no column for joint {', '.join(texts)}; expected a column named as in the URDF, or "
        f"--columns 'NAME={missing[0]},...'; {listed(sheet.labels)}"
    )


def _check_unknown(sheet: Sheet, unknown: Sequence[Label], free: Mapping[str, str]) -> None:
    """Refuse unknown columns, but for words that nobody needs, which are left out with a `PincalWarning`."""
    names = [name for name, quantity in free.items() if quantity == "name"]
    wrong, words = list[str](), list[str]()
    for label in unknown:
        is_close = difflib.get_close_matches(label.name.casefold(), names, n=1, cutoff=0.75)
        if sheet.is_blank(label.index):
            continue
        (words if sheet.has_words(label.index) and not is_close else wrong).append(label.text)
    if wrong:
        known = ", ".join(nearest_first(wrong, free))
        texts = ", ".join(f'"{text[:40]}"' for text in wrong[:30])
        hint = f"; an orientation? --orientation {'|'.join(CONVENTIONS)}" if looks_like_orientation(wrong) else ""
        raise MeasurementError(
            f"{sheet.path.name}: unknown column {texts}; known and not in the table, nearest first: "
            f"{known or 'none'}{hint}; rename it (--columns '{wrong[0]}=NAME'; a unit is written as x [mm]), delete it or "
            f"ignore it; {listed(sheet.labels)}"
        )
    if words:
        texts = ", ".join(f'"{text}"' for text in words)
        warnings.warn(f"{sheet.path.name}: columns of text are left out: {texts}", PincalWarning, stacklevel=2)


def _in_si(series: pl.Series, column: Column) -> np.ndarray:
    if column.is_name:
        return np.array(series.to_list(), dtype=str)
    return in_si(series.to_numpy(), column.quantity, column.unit)
