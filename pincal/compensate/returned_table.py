"""A table returned in its own form: new numbers in some of its columns, further columns after them,
all else unchanged.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pincal.atomic import replacing, write_atomic
from pincal.errors import MeasurementError, needed
from pincal.measure.excel_sheet import ENDINGS
from pincal.measure.reader import Cells
from pincal.measure.sheet import FrameSheet, SheetColumn
from pincal.measure.table import write_table
from pincal.measure.text_sheet import TextSheet
from pincal.units import SIZES, in_unit, plain_numbers

DECIMALS = {
    "m": 11,
    "cm": 9,
    "mm": 8,
    "um": 5,
    "µm": 5,
    "in": 10,
    "rad": 11,
    "mrad": 8,
    "urad": 5,
    "deg": 9,
    "°": 9,
}
"""Least number of decimal places of a written number, by its unit."""
_TEXT = (".csv", ".txt", ".tsv")


def write_returned(
    out: Path, cells: Cells, columns: Mapping[str, np.ndarray], joints: Sequence[str]
) -> None:
    """Write a table in the form of the one that was read if the file's name allows it, else a new
    one in SI units.

    Args:
        out: the file.
        cells: the table that was read.
        columns: values in SI units, shape (N,), by name, in their order.
        joints: names of the columns that replace the table's own, in its units. The table's other
            columns are unchanged, and columns that it lacks are appended.

    Raises:
        OutputError: for a name that no table can have, or a place that can't be written to.
    """
    sheet = cells.sheet
    kind = out.suffix.lower()
    mine = {column.name: column for column in cells.columns}
    again = {
        label: SheetColumn(i, label, label, "", "number")
        for i, label in enumerate(sheet.labels)
        if label not in mine
    }
    changed = {mine[name]: columns[name] for name in joints if name in mine}
    changed |= {again[name]: values for name, values in columns.items() if name in again}
    present = {*mine, *again, *(joints if changed.keys() & mine.values() else ())}
    present |= {"qx", "qy", "qz", "qw"} if cells.orientation is not None else set()
    more = {name: values for name, values in columns.items() if name not in present}
    if (
        isinstance(sheet, TextSheet)
        and kind in _TEXT
        and (kind != ".tsv" or sheet.separator == "\t")
    ):
        write_atomic(out, _text(sheet, cells.rows, changed, more))
    elif isinstance(sheet, FrameSheet) and sheet.worksheet and kind in ENDINGS:
        _write_workbook(out, sheet, cells.rows, changed, more)
    elif (
        isinstance(sheet, FrameSheet)
        and sheet.path.suffix.lower() == kind == ".parquet"
        and sheet.rows is None
    ):
        _write_parquet(out, sheet, cells.rows, changed, more)
    else:
        write_table(out, columns)


def _with_cells(
    body: str, spans: Sequence[tuple[int, int]], cells: Mapping[SheetColumn, float]
) -> str:
    """Return a line with other numbers in some of its cells, which are at these spans."""
    # From the end, as a new number may be longer.
    for column in sorted(cells, key=lambda column: -column.index):
        start, stop = spans[column.index]
        cell = _cell(cells[column], column.unit, body[start:stop])
        body = body[:start] + cell + body[stop:]
    return body


def _is_row(body: str, spans: Sequence[tuple[int, int]], sheet: TextSheet) -> bool:
    """Return whether a line has as many cells as the table, and is no comment."""
    return len(spans) == len(sheet.labels) and not body.lstrip().startswith("#")


def _text(
    sheet: TextSheet,
    rows: np.ndarray,
    changed: Mapping[SheetColumn, np.ndarray],
    more: Mapping[str, np.ndarray],
) -> bytes:
    """Return the text with changed cells and further ones at the end of each line of the table."""
    raw = sheet.path.read_bytes()
    encoding = "utf-16" if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "latin-1"
    lines = re.split(r"(?<=\n)|(?<=\r)(?!\n)", raw.decode(encoding))
    # Without a header the first line of the table shows what stands between cells.
    header = lines[sheet.header_line - int(sheet.has_header)]
    separator = sheet.separator if sheet.separator in header else " "
    places = {int(line): k for k, line in enumerate(rows)}
    commas = False
    for number, line in enumerate(lines, start=1):
        body = line.rstrip("\r\n")
        end = line[len(body) :]
        spans = cells_in(body, separator)
        if number == sheet.header_line and sheet.has_header:
            lines[number - 1] = _extended(body, separator, more) + end
        elif (k := places.get(number)) is not None:
            commas |= sheet.decimal_comma and any(
                "," in body[slice(*spans[column.index])] for column in changed
            )
            cells = {column: values[k] for column, values in changed.items()}
            body = _with_cells(body, spans, cells)
            point = "," if commas else "."
            new = [_plain(values[k]).replace(".", point) for values in more.values()]
            lines[number - 1] = _extended(body, separator, new) + end
        elif number > sheet.header_line and _is_row(body, spans, sheet):
            nothing = "" if separator != " " else "-"
            lines[number - 1] = _extended(body, separator, [nothing] * len(more)) + end
    return "".join(lines).encode(encoding)


def _extended(body: str, separator: str, cells: Iterable[str]) -> str:
    return separator.join([body.rstrip(" ") if separator == " " else body, *cells])


def cells_in(line: str, separator: str) -> list[tuple[int, int]]:
    """Return start and end of the cells of a line, without surrounding blanks and quotation marks.

    Example:
        >>> cells_in('1; "2,5" ;x', ";")
        [(0, 1), (4, 7), (10, 11)]
    """
    if separator == " ":
        return [match.span() for match in re.finditer(r"\S+", line)]
    found = list[tuple[int, int]]()
    start = 0
    is_quoted = False
    for i, letter in enumerate(line + separator):
        is_quoted ^= letter == '"'
        if letter == separator and (not is_quoted or i == len(line)):
            raw = line[start:i]
            text = re.sub(r'^"(.*)"$', r"\1", raw.strip()).strip()
            at = start + raw.find(text)
            found.append((at, at + len(text)))
            start = i + 1
    return found


def _cell(value: Any, unit: str, old: str) -> str:
    """Return a value [SI] in the form of the number that it replaces, which is kept if
    it is equal.
    """
    if isinstance(value, str):
        return value
    return number_like(float(in_unit(np.array([value]), unit)[0]), DECIMALS.get(unit, 11), old)


def number_like(value: float, least: int, old: str) -> str:
    """Return a value with the decimal mark and the sign of the number that it replaces, which is
    kept if it is equal.

    Example:
        >>> number_like(1.25, 3, "1,2"), number_like(1.2, 3, "+1.2"), number_like(2.5, 1, "+1.2")
        ('1,250', '+1.2', '+2.5')
    """
    if any(
        abs(value - number) < 0.5 * 10.0**-least
        for number in plain_numbers([old.replace(",", ".")])
    ):
        return old
    decimals = re.search(r"[.,](\d*)", old)
    text = f"{value:.{max(len(decimals[1]) if decimals else 0, least)}f}"
    text = text.replace(".", ",") if "," in old else text
    return f"+{text}" if old.startswith("+") and value >= 0.0 else text


def _plain(value: Any) -> str:
    return repr(value.item()) if isinstance(value, (np.floating, np.integer)) else str(value)


def _write_workbook(
    out: Path,
    sheet: FrameSheet,
    rows: np.ndarray,
    changed: Mapping[SheetColumn, np.ndarray],
    more: Mapping[str, np.ndarray],
) -> None:
    with needed("openpyxl", "Excel files", install="'pincal[excel]'", error=MeasurementError):
        import openpyxl
    book = openpyxl.load_workbook(sheet.path, keep_vba=sheet.path.suffix.lower() == ".xlsm")
    page = book[sheet.worksheet]
    width = len(sheet.labels)
    for k, name in enumerate(more, start=1):
        page.cell(sheet.header_line, width + k, name)
    for i, row in enumerate(map(int, rows)):
        for column, values in changed.items():
            page.cell(row, column.index + 1).value = _value(values[i], column.unit)
        for k, values in enumerate(more.values(), start=1):
            page.cell(row, width + k, _value(values[i], ""))
    with replacing(out) as draft:
        book.save(draft)


def _value(value: Any, unit: str) -> Any:
    return str(value) if isinstance(value, str) else in_unit(np.array([value]), unit)[0].item()


def _write_parquet(
    out: Path,
    sheet: FrameSheet,
    rows: np.ndarray,
    changed: Mapping[SheetColumn, np.ndarray],
    more: Mapping[str, np.ndarray],
) -> None:
    import polars as pl

    frame = sheet.frame.collect()
    at = rows - 2
    pairs = [
        (frame.columns[column.index], values, column.unit) for column, values in changed.items()
    ]
    for name, values, unit in [*pairs, *((name, values, "") for name, values in more.items())]:
        old = (
            frame[name].to_numpy().astype(float)
            if name in frame.columns
            else np.full(frame.height, np.nan)
        )
        if values.dtype.kind in "US":
            frame = frame.with_columns(pl.Series(name, values.tolist()))
            continue
        old[at] = in_unit(values, unit)
        frame = frame.with_columns(pl.Series(name, old))
    with replacing(out) as draft:
        frame.write_parquet(draft)


def false_columns(cells: Cells, poses: np.ndarray) -> dict[str, np.ndarray]:
    """Return poses, shape (N, 3, 4) [m], as columns that begin with false_, in the units and angles
    of the table's own.

    Raises:
        ValueError: if the table has no poses.
    """
    by_name = {column.name: column for column in cells.columns}
    found = {}
    for i, axis in enumerate("xyz"):
        column = by_name[axis]
        found[f"false_{column.label}"] = in_unit(poses[:, i, 3], column.unit)
    if (convention := cells.orientation) is not None:
        values = np.array([convention.values(pose[:, :3]) for pose in poses])
        for k, name in enumerate(convention.columns):
            column = by_name[name]
            ratio = (
                SIZES[convention.unit] / SIZES[column.unit]
                if convention.unit and column.unit
                else 1.0
            )
            found[f"false_{column.label}"] = values[:, k] * ratio
    return found
