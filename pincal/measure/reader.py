"""Reading a table: columns by name and unit, converted to SI units and assembled into the fields of
a schema.

Measurements, targets of a compensation and lists of known points are tables of different schemas.
"""

from __future__ import annotations

import contextlib
import difflib
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pincal.errors import MeasurementError, counted, warn
from pincal.measure.approach import BY_COLUMNS, agreeing, completed, gives_order, moves_of_table
from pincal.measure.excel_sheet import ENDINGS, open_excel
from pincal.measure.header import (
    NANOSECONDS,
    check_joints,
    matched,
    rotations,
    understood,
    with_joints,
)
from pincal.measure.joined import Log, held_rows, join
from pincal.measure.labels import is_named, joint_families, renamed, spelled, unignored
from pincal.measure.list_cells import with_lists
from pincal.measure.nameless import check_named
from pincal.measure.orientation import Convention
from pincal.measure.parquet_sheet import open_parquet
from pincal.measure.sheet import FrameSheet, Sheet, SheetColumn, read_cells
from pincal.measure.sheet_reader import SHEET_READERS, SheetOptions
from pincal.measure.table_schema import OF_EACH_JOINT, OTHERS, Schema, TableOptions
from pincal.measure.text_sheet import open_text
from pincal.sensors.fields import CONDITIONS, FIRST, SECOND, Field, link_of
from pincal.thresholds import Scale

# Step by which the direction of dependent joints is determined [rad or m].
_SMALL: Scale = 1e-4
# Likeness of a column's name to a joint's, from which it may be a slip of the pen.
_SLIP: Scale = 0.75
# Formats that other programs can convert to one that is read.
_OTHERS = (".xls", ".xlsb", ".ods", ".numbers", ".pkl", ".pickle", ".h5", ".hdf5")


def open_sheet(
    path: Path,
    *,
    ignore: Collection[str] = (),
    only_joints: bool = False,
    joints: Collection[str] = (),
    sheet: str | None = None,
) -> Sheet:
    """Return the sheet of a file, by its contents; text if they are of no other format.

    Args:
        path: the file; a recording may be a folder.
        ignore: topics of a recording, or keys of nested values, to leave out.
        only_joints: whether to read only the joints of a recording, sample by sample.
        joints: those that have to stand still in a recording, and by which the header of a table is
            recognised.
        sheet: worksheet of a workbook.

    Raises:
        MeasurementError: for a file that is empty, binary, or not of this format.
    """
    ending = path.suffix.lower()
    options = SheetOptions(ignore=ignore, only_joints=only_joints, joints=joints)
    for reader in SHEET_READERS.all():
        if reader.reads(path):
            return reader.open(path, options)
    with path.open("rb") as file:
        head = file.read(4)
    if ending == ".parquet" or head == b"PAR1":
        return open_parquet(path)
    if ending in ENDINGS or head == b"PK\x03\x04":
        return with_lists(open_excel(path, sheet=sheet, joints=joints))
    if ending in _OTHERS:
        raise MeasurementError(f"{path.name}: {ending} is not read; save the table as .xlsx or CSV")
    return with_lists(open_text(path, joints))


@contextlib.contextmanager
def typed_errors(path: Path) -> Iterator[None]:
    """Convert all errors of reading a file to a `MeasurementError` that names it."""
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
        raise MeasurementError(
            f"{path}: can't be read ({reason}); expected a CSV or .parquet table"
        ) from error


@dataclass(frozen=True)
class Cells:
    """The contents of a table of N rows.

    Attributes:
        arrays: values in SI units by field, shape (N,) or (N, k); "q", "approach" and "move" of the
            joints, shape (N, n), where there are any.
        rows: shape (N,), line of each row in its file, the header being line 1.
        units: the units in the header, by column.
        approach_from: origin of the directions of approach, in words; empty where there are none.
        sheet: the table itself.
        columns: the columns that were read.
        orientation: how they give an orientation, if not by a quaternion.
    """

    arrays: dict[str, np.ndarray]
    rows: np.ndarray
    units: dict[str, str]
    approach_from: str
    sheet: Sheet
    columns: tuple[SheetColumn, ...]
    orientation: Convention | None


def read_table(path: str | os.PathLike[str], schema: Schema, *, part: range | None = None) -> Cells:
    """Read a table, or some rows of a Parquet file, by a schema of its possible contents; see
    :func:`open_sheet`.

    Raises:
        MeasurementError: for a file that can't be read, or a column, unit or cell that is invalid.
    """
    path = Path(path)
    with typed_errors(path):
        sheet = open_sheet(
            path,
            ignore=schema.options.ignore,
            joints=schema.joint_names,
            sheet=schema.options.sheet,
        )
        sheet = sheet if part is None else _part(sheet, part)
        if was_joined := schema.options.joints is not None and bool(schema.joint_names):
            sheet, schema = _with_log(sheet, schema)
    return cells_of(sheet, schema, is_part=part is not None, was_joined=was_joined)


def cells_of(
    sheet: Sheet, schema: Schema, *, is_part: bool = False, was_joined: bool = False
) -> Cells:
    """Return the contents of a sheet; a part of a table, or a stream, is not cut into
    held poses.
    """
    path = sheet.path
    with typed_errors(path):
        header = understood(sheet, schema)
        values, rows = read_cells(
            sheet,
            header.columns,
            readings=header.readings,
            flag=header.flag,
            is_measured=schema.has_readings,
        )
    if NANOSECONDS in values:
        values["time"] = values["time"] + values.pop(NANOSECONDS)
    if header.orientation is not None:
        values = _with_quaternions(values, header.orientation, schema, source=path.name)
    joints = header.joints
    values |= _resting(schema, joints, values, len(rows), source=path.name)
    if joints and (missing := [name for name in joints if name not in values]):
        values |= _followers(schema, values, missing)
    may_move = bool(header.readings) and "time" in values and not schema.may_lack_joints
    if joints and may_move and not is_part:
        values, rows = held_rows(values, rows, joints, was_joined=was_joined, source=path.name)
    arrays, origin = _of_joints(schema, joints, values, source=path.name)
    for of in schema.fields:
        if any(name in values for name in of.columns):
            arrays[of.name] = _whole(of, values, source=path.name)
    units = {column.name: column.unit for column in header.columns if column.unit}
    return Cells(arrays, rows, units, origin, sheet, header.columns, header.orientation)


def _with_quaternions(
    values: dict[str, np.ndarray], orientation: Convention, schema: Schema, *, source: str
) -> dict[str, np.ndarray]:
    """Return the columns with quaternions instead of an orientation in another convention."""
    found = orientation.quaternions(values, where=source)
    others = {name: value for name, value in values.items() if name not in orientation.columns}
    return others | dict(zip(rotations(schema.fields).columns, found.T, strict=True))


def _resting(
    schema: Schema,
    joints: Sequence[str],
    values: Mapping[str, np.ndarray],
    count: int,
    *,
    source: str,
) -> dict[str, np.ndarray]:
    """Return columns of joints that may be at rest and have none; warn of them."""
    resting = [name for name in schema.resting if name in joints and name not in values]
    if resting:
        at = ", ".join(f"{name} at {schema.resting[name]:g}" for name in resting)
        warn(
            f"{source}: no column for {counted(len(resting), 'joint')} off the paths of these "
            f"rows; assumed at rest: {at}"
        )
    return {name: np.full(count, schema.resting[name]) for name in resting}


def _of_joints(
    schema: Schema, joints: Sequence[str], values: dict[str, np.ndarray], *, source: str
) -> tuple[dict[str, np.ndarray], str]:
    """Remove all columns of joints from the values; return them as arrays, shape (N, n), and the
    origin of the directions of approach.
    """
    droop = _droop(values, joints, source=source)
    arrays = {} if not joints else {"q": np.column_stack([values.pop(name) for name in joints])}
    if droop is not None:
        arrays["droop"] = droop
    others, origin = _of_each_joint(schema, joints, values, arrays.get("q"), source=source)
    return arrays | others, origin


def _of_each_joint(
    schema: Schema,
    joints: Sequence[str],
    values: dict[str, np.ndarray],
    q: np.ndarray | None,
    *,
    source: str,
) -> tuple[dict[str, np.ndarray], str]:
    """Remove the columns of each joint, such as directions of approach, from the values; return
    them as arrays, shape (N, n), completed by the order of rows, and the origin of the directions.
    """
    given = {
        what: {j: values.pop(f"{what}_{j}") for j in joints if f"{what}_{j}" in values}
        for what in OF_EACH_JOINT
    }
    sides = given["approach"]
    origin = BY_COLUMNS if sides else ""
    if q is None:
        return {}, origin
    arrays = dict[str, np.ndarray]()
    time = values.get("time")
    in_order = schema.options.rows_in_order
    if in_order or gives_order(time, q):
        moves = moves_of_table(q, time=time, station=values.get("station"))
        arrays["move"] = agreeing(moves, sides, joints)
        if in_order:
            given["approach"], origin = completed(
                sides, joints, moves, by_time=time is not None, source=source
            )
    unknown = np.zeros(len(q))
    return arrays | {
        what: np.column_stack([own.get(j, unknown) for j in joints])
        for what, own in given.items()
        if own
    }, origin


def _followers(
    schema: Schema, values: Mapping[str, np.ndarray], missing: Sequence[str]
) -> dict[str, np.ndarray]:
    """Return the columns of dependent joints: positions, and directions of approach where those of
    others are given.
    """
    joints = schema.joint_names
    nothing = np.zeros(len(values[schema.own_joints[0]]))
    q = np.column_stack([values.get(name, nothing) for name in joints])
    found = schema.following(q)
    columns = {name: found[:, joints.index(name)] for name in missing}
    if any(f"approach_{name}" in values for name in joints):
        step = np.column_stack([values.get(f"approach_{name}", nothing) for name in joints])
        moved = schema.following(q + _SMALL * step) - found
        columns |= {
            f"approach_{name}": np.sign(np.round(moved[:, joints.index(name)] / _SMALL, 3))
            for name in missing
        }
    return columns


def _part(sheet: Sheet, part: range) -> Sheet:
    if not isinstance(sheet, FrameSheet) or sheet.rows is not None:
        raise MeasurementError(
            f"{sheet.path.name}: only a Parquet file is read in parts; write the table as .parquet"
        )
    return sheet.part(part)


def _droop(
    values: dict[str, np.ndarray], joints: Sequence[str], *, source: str
) -> np.ndarray | None:
    """Remove second positions of joints from the values; return commanded minus read back, shape
    (N, n), if any.

    Raises:
        MeasurementError: if both are given in addition to the joints' own columns.
    """
    given = {kind: [name for name in joints if f"{kind}_{name}" in values] for kind in OTHERS}
    kinds = [kind for kind, names in given.items() if names]
    if not kinds:
        return None
    if len(kinds) > 1:
        raise MeasurementError(
            f"{source}: columns commanded_<joint> and read_<joint> in addition to those "
            "of the joints; expected two "
            "records: name the one to fit as the joints, as with --columns read_joint_1=joint_1"
        )
    (kind,) = kinds
    fitted = {"commanded": "read back", "read": "commanded"}[kind]
    warn(
        f"{source}: the joints' own columns are fitted, as positions that were {fitted}; "
        f"{kind}_{given[kind][0]} ... show the steady-state position error"
    )
    nothing = np.zeros(len(values[joints[0]]))
    found = [
        OTHERS[kind] * (values.pop(f"{kind}_{j}") - values[j]) if j in given[kind] else nothing
        for j in joints
    ]
    return np.column_stack(found)


def _whole(part: Field, values: Mapping[str, np.ndarray], *, source: str) -> np.ndarray:
    """Return the array of a field; refuse a table with only some of its columns."""
    given = [name for name in part.columns if name in values]
    if missing := [name for name in part.columns if name not in values]:
        raise MeasurementError(
            f"{source}: {' '.join(given)} without {' '.join(missing)}; add what is missing"
        )
    return np.column_stack([values[name] for name in given]) if len(given) > 1 else values[given[0]]


def read_columns(
    path: str | os.PathLike[str],
    quantities: Mapping[str, str],
    *,
    optional: Sequence[str] = (),
    is_whole: bool = False,
) -> dict[str, np.ndarray]:
    """Return the columns in SI units, shape (N,) each, of a small table whose columns are all
    known.

    Args:
        path: the file; formats and units as in a table of measurements.
        quantities: quantity of each column: "name", "length", ...
        optional: columns that may be absent.
        is_whole: whether each row counts, so that an empty cell is refused; otherwise its row is
            left out with a note.

    Raises:
        MeasurementError: for a file that can't be read, or a column, unit or cell that is invalid.
    """
    fields = tuple(Field(name, (name,), quantity) for name, quantity in quantities.items())
    schema = Schema(fields, is_whole=is_whole)
    found = read_table(path, schema).arrays
    required = [name for name in quantities if name not in optional]
    if missing := [name for name in required if name not in found]:
        raise MeasurementError(
            f"{Path(path).name}: no column {missing[0]!r}; expected columns {' '.join(required)}"
        )
    return found


def joint_columns(
    path: str | os.PathLike[str],
    names: Iterable[str],
    options: TableOptions,
    *,
    by_words: bool = True,
) -> tuple[str, ...]:
    """Return which joints have a column in a table, in the order of the columns, without reading
    its rows.

    Args:
        path: the table.
        names: of the joints.
        options: how to read the table.
        by_words: whether names may be among other words if no column has exactly such a name, as in
            logs of motion.

    Raises:
        MeasurementError: for a file that can't be read.
    """
    angles = dict.fromkeys(names, "angle")
    known = tuple(angles)
    lengths = dict.fromkeys(angles, "length")
    if options.joints is not None:
        with typed_errors(Path(path)):
            open_sheet(Path(path), ignore=options.ignore, joints=known, sheet=options.sheet)
    place = Path(path if options.joints is None else options.joints)
    with typed_errors(place):
        sheet = open_sheet(
            place, ignore=options.ignore, only_joints=True, joints=known, sheet=options.sheet
        )
        # Other names are refused, or belong to another file, when rows are read.
        labels = renamed(sheet.labels, _named_here(sheet, options), source=place.name)
    found = [spelled(label, angles) or spelled(label, lengths) for label in labels]
    if by_words and not any(found):
        found = [(joint, "") for family in joint_families(labels, known)[:1] for joint in family]
    return tuple(dict.fromkeys(name for name, _ in filter(None, found)))


def nearly_named(
    path: str | os.PathLike[str],
    joints: Sequence[str],
    options: TableOptions,
    *,
    known: Collection[str],
) -> tuple[str, str] | None:
    """Return a column of a table that is of none of the ``known`` joints, and whose name is nearly
    that of one of some joints without a column; and that joint. None if there is none.

    Raises:
        MeasurementError: for a file that can't be read.
    """
    place = Path(path if options.joints is None else options.joints)
    with typed_errors(place):
        sheet = open_sheet(place, ignore=options.ignore, only_joints=True, sheet=options.sheet)
        labels = renamed(sheet.labels, _named_here(sheet, options), source=place.name)
    angles = dict.fromkeys(known, "angle")
    lengths = dict.fromkeys(known, "length")
    for label in labels:
        is_known = spelled(label, angles) or spelled(label, lengths)
        close = difflib.get_close_matches(label.name, joints, n=1, cutoff=_SLIP)
        if close and not is_known:
            return label.text, close[0]
    return None


def of_path(
    path: str | os.PathLike[str], names: Collection[str], options: TableOptions
) -> TableOptions:
    """Return how to read a table of joints, whose columns may lack the common prefix of the joints'
    names.

    The controllers of two identical robots use the same names.
    """
    first = next(iter(names), "")
    if "_" not in first or joint_columns(path, names, options):
        return options
    for end in (i + 1 for i, letter in enumerate(first) if letter == "_"):
        own = {name[end:]: name for name in names if name.startswith(first[:end])}
        if len(own) == len(names) and own.keys() <= set(
            joint_columns(path, own, options, by_words=False)
        ):
            return replace(options, columns={**options.columns, **own})
    return options


def links_of_rows(
    path: str | os.PathLike[str], options: TableOptions
) -> list[tuple[str | None, str | None]]:
    """Return the pairs of links between which the rows of a table are, None for links that it does
    not name.

    Raises:
        MeasurementError: for a file that can't be read, or a point that is not LINK:NAME.
    """
    fields = [CONDITIONS[f"{end}_link"] for end in ("from", "to")] + [FIRST, SECOND]
    path = Path(path)
    with typed_errors(path):
        sheet = open_sheet(path, ignore=options.ignore, sheet=options.sheet)
        # Other names are refused, or belong to the log of the joints, when rows are read.
        here = _named_here(sheet, options)
        labels = renamed(sheet.labels, here, source=path.name)
    names = {name for part in fields for name in part.columns}
    if not any(
        (spelled(label, dict.fromkeys(names, "name")) or ("",))[0] in names for label in labels
    ):
        return [(None, None)]
    schema = Schema(
        tuple(fields),
        options=replace(options, ignore=("*", *options.ignore), joints=None, columns=here),
    )
    cells = read_table(path, schema)
    ends: list[list[str | None]]
    if FIRST.name in cells.arrays and SECOND.name in cells.arrays:
        ends = [
            [link_of(str(point), where=path.name) for point in cells.arrays[end.name]]
            for end in (FIRST, SECOND)
        ]
    else:
        columns = (cells.arrays.get(f"{end}_link") for end in ("from", "to"))
        ends = [
            [None] * len(cells.rows) if column is None else list(map(str, column))
            for column in columns
        ]
    return list(dict.fromkeys(zip(*ends, strict=True))) or [(None, None)]


def _log(path: Path, schema: Schema, quantities: Mapping[str, str], *, beside: Sheet) -> Log:
    """Return the log of joints in a file, whose other columns are conditions of the rows beside."""
    options = schema.options
    log = open_sheet(path, ignore=options.ignore, only_joints=True, joints=schema.joint_names)
    check_named(log, schema)
    labels = unignored(
        renamed(log.labels, options.columns, source=path.name, others=beside.labels),
        options.ignore,
    )
    labels = with_joints(labels, schema, quantities, sheet=log)
    readings = {
        name for part in schema.fields if part.name not in CONDITIONS for name in part.columns
    }
    others = {name: quantity for name, quantity in quantities.items() if name not in readings}
    columns, unknown = matched(labels, others, {}, source=path.name)
    check_joints([name for name in schema.needed_joints if name not in columns], unknown, log)
    values, _ = read_cells(log, tuple(columns.values()))
    return Log(log, values, schema.own_joints, is_shared=options.shares_log)


def _with_log(sheet: Sheet, schema: Schema) -> tuple[Sheet, Schema]:
    """Return a table joined with the log named by the user, and the schema for reading it."""
    options = schema.options
    source = sheet.path.name
    path = Path(options.joints or "")
    quantities = schema.quantities(source=path.name)
    with typed_errors(path):
        log = _log(path, schema, quantities, beside=sheet)
    mine = unignored(
        renamed(sheet.labels, options.columns, source=source, others=log.sheet.labels),
        options.ignore,
    )
    found, _ = matched(mine, quantities, {}, source=source)
    if twice := [name for name in schema.joint_names if name in found]:
        raise MeasurementError(
            f'{source}: joint "{twice[0]}" is in {path.name} as well; omit --joints, or '
            "ignore the column"
        )
    time = read_cells(sheet, (found["time"],))[0]["time"] if "time" in found else None
    known = {*quantities, *options.ignore}
    whole = join(sheet, log, time, known=known, has=found)
    here = _named_here(whole, options)
    return whole, replace(schema, options=replace(options, joints=None, columns=here))


def _named_here(sheet: Sheet, options: TableOptions) -> dict[str, str]:
    """Return the meanings that the user assigned to columns of this sheet."""
    return {
        name: meaning
        for name, meaning in options.columns.items()
        if any(is_named(text, name) for text in sheet.labels)
    }
