"""Excel workbooks (.xlsx) as sheets: the worksheet given by name, or the one with joint columns."""

from __future__ import annotations

import contextlib
import datetime
import re
import zipfile
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from pincal.errors import MeasurementError, counted, few, needed, warn
from pincal.measure.heading import TableHead, find_heading, names_joints
from pincal.measure.nameless import numbers_as_names
from pincal.measure.sheet import FrameSheet, Sheet, check_unpacked
from pincal.thresholds import Count

if TYPE_CHECKING:
    import polars as pl

# Number and cells of a line.
_Line: TypeAlias = tuple[int, tuple[Any, ...]]

ENDINGS = (".xlsx", ".xlsm")
# Most rows of an Excel worksheet.
_MOST_LINES: Count = 1_048_576
# Least size of a cell in memory, a reference [bytes], and number of cells between two checks of the
# total.
_BYTES: Count = 8
_CELLS: Count = 100_000
# Lines that a note lists, and lines searched for the header.
_LISTED: Count = 3
_LOOKED_AT: Count = 200
_ROW = re.compile(rb"<(?:\w+:)?row\b([^>]*)>")
_HIDDEN = re.compile(rb"\bhidden\s*=\s*[\"'](?:1|true)[\"']")
_NUMBER = re.compile(rb"\br\s*=\s*[\"'](\d+)[\"']")
# Results of formulas that failed.
_FAILED = ("#NULL!", "#DIV/0!", "#VALUE!", "#REF!", "#NAME?", "#NUM!", "#N/A")


def open_excel(path: Path, *, sheet: str | None = None, joints: Collection[str] = ()) -> Sheet:
    """Read a worksheet: the one given by name, else the first with joint columns, else the first
    with any cells.

    Visible worksheets precede hidden ones. Worksheets and lines above the table that are left out,
    and hidden rows, cause a `PincalWarning`.

    Raises:
        MeasurementError: without the library openpyxl, or for a workbook that is empty, holds far
            more than fits into its size, lacks the worksheet, or can't be read.
    """
    import polars as pl

    title, lines = _lines(path, sheet, joints)
    if not lines:
        raise MeasurementError(
            f"{path.name}: is empty; expected a header line and one line per pose"
        )
    found = _heading(lines, joints)
    if found.body > 1:
        warn(f"{path.name}: {found.described([row for row, _ in lines])}")
    body = lines[found.body :]
    count = len(found.labels)
    top = lines[found.header][0]
    _check_widths(body, count, top, path.name)
    columns = [
        _series([cells[i] if i < len(cells) else None for _, cells in body], str(i))
        for i in range(count)
    ]
    rows = np.array([row for row, _ in body], int)
    return FrameSheet(
        path, found.labels, False, pl.LazyFrame(columns), rows, worksheet=title, header_line=top
    )


def _heading(lines: Sequence[_Line], joints: Collection[str]) -> TableHead:
    """Return where the names of the columns stand: in the first line if no other looks like it."""
    cells = [["" if cell is None else str(cell) for cell in line] for _, line in lines[:_LOOKED_AT]]
    if (found := find_heading(cells, joints)) is not None:
        return found
    if (numbers := numbers_as_names(cells[0], decimal_comma=False)) is not None:
        return TableHead(0, 0, numbers)
    return TableHead(0, 1, tuple(cell.strip() for cell in cells[0]))


def _check_widths(body: Sequence[_Line], count: int, top: int, name: str) -> None:
    """Refuse a line with more cells than the header has."""
    for row, cells in body:
        if len(cells) > count:
            raise MeasurementError(
                f"{name}, line {row}: {len(cells)} cells; expected {count} as in the header, line "
                f"{top}; delete the lines above it, or begin them with #"
            )


def _lines(path: Path, named: str | None, joints: Collection[str]) -> tuple[str, list[_Line]]:
    """Return the name of the worksheet, and number and cells of its non-blank lines; warn of what
    is left out.
    """
    install = "'pincal[excel]', or save the table as CSV"
    with needed("openpyxl", f"{path.name}: Excel files", install=install, error=MeasurementError):
        import openpyxl
    try:
        with zipfile.ZipFile(path) as parts:
            check_unpacked(path, sum(part.file_size for part in parts.infolist()))
        # A file, as openpyxl refuses a workbook by another ending.
        with (
            path.open("rb") as file,
            contextlib.closing(
                openpyxl.load_workbook(file, read_only=True, data_only=True)
            ) as book,
        ):
            sheets = sorted(book.worksheets, key=lambda sheet: bool(sheet.sheet_state != "visible"))
            if named is None:
                return _of_joints(sheets, path, joints)
            return _of_name(sheets, path, named)
    except (OSError, MeasurementError):
        raise
    except Exception as error:  # Broken archives raise all kinds of errors in these libraries.
        raise MeasurementError(
            f"{path.name}: can't be read ({error}); expected an Excel workbook"
        ) from error


def _of_name(sheets: Sequence[Any], path: Path, named: str) -> tuple[str, list[_Line]]:
    """Return the title and lines of the worksheet that the user named."""
    sheet = next((sheet for sheet in sheets if sheet.title == named), None)
    if sheet is None:
        titles = ", ".join(sheet.title for sheet in sheets)
        raise MeasurementError(f"{path.name}: no worksheet {named!r}; expected one of {titles}")
    lines = list(_filled(sheet, path))
    if not lines:
        return "", []
    _warn_of_hidden(sheet, {row for row, _ in lines}, path.name, is_wanted=True)
    return sheet.title, lines


def _of_joints(
    sheets: Sequence[Any], path: Path, joints: Collection[str]
) -> tuple[str, list[_Line]]:
    """Return the title and lines of the first worksheet with joint columns, else of the first with
    any cells.
    """
    others = list[Any]()
    first: tuple[Any, list[_Line]] | None = None
    for sheet in sheets:
        if found := list(_filled(sheet, path)):
            first = first or (sheet, found)
            others.append(sheet)
            texts = (
                [str(cell) for cell in cells if cell is not None] for _, cells in found[:_LOOKED_AT]
            )
            if any(names_joints(cells, joints) for cells in texts):
                first = sheet, found
                others += sheets[sheets.index(sheet) + 1 :]
                break
    if first is None:
        return "", []
    chosen, lines = first
    _warn_of_hidden(chosen, {row for row, _ in lines}, path.name, is_wanted=False)
    others.remove(chosen)
    if others:
        listed = ", ".join(
            sheet.title + " (hidden)" * (sheet.sheet_state != "visible") for sheet in others
        )
        warn(
            f"{path.name}: worksheet {chosen.title} is read; worksheets {listed} are not read "
            "(--sheet NAME reads another one)"
        )
    return chosen.title, lines


def _filled(sheet: Any, path: Path) -> Iterator[_Line]:
    """Yield number and cells of each non-blank line; refuse more lines than Excel has, or far too
    many blank cells.
    """
    # The stated size of the worksheet may be wrong, and rows beyond it would be lost.
    sheet.reset_dimensions()
    name = path.name
    cells = 0
    for row, values in enumerate(sheet.iter_rows(values_only=True), start=1):
        if row > _MOST_LINES:
            raise MeasurementError(
                f"{name}: has more than the {_MOST_LINES} lines of Excel; save the table as CSV"
            )
        if not _has_cells(values):
            continue
        cells += len(values)
        if cells % _CELLS < len(values):
            check_unpacked(path, _BYTES * cells)
        count = max(i for i, cell in enumerate(values, start=1) if cell is not None)
        yield row, tuple(values[:count])


def _warn_of_hidden(sheet: Any, rows: set[int], name: str, *, is_wanted: bool) -> None:
    """Warn if the worksheet is hidden, unless it was asked for, and if some of its rows are."""
    if sheet.sheet_state != "visible" and not is_wanted:
        warn(
            f"{name}: no visible worksheet has columns of joints; the hidden one "
            f"{sheet.title} is read"
        )
    # In read-only mode openpyxl drops the attributes of rows.
    with sheet._get_source() as source:
        text = source.read()
    hidden = []
    for place, tag in enumerate(_ROW.finditer(text) if b"hidden" in text else (), start=1):
        number = _NUMBER.search(tag[1])
        if _HIDDEN.search(tag[1]) and (row := int(number[1]) if number else place) in rows:
            hidden.append(row)
    if hidden:
        warn(
            f"{name}: {counted(len(hidden), 'row', 'are')} hidden in worksheet {sheet.title}, by a "
            "filter perhaps (line "
            f"{few(hidden, _LISTED)}), and read like the others; delete them to leave them out"
        )


def _has_cells(cells: Sequence[Any]) -> bool:
    first = next((cell for cell in cells if cell not in (None, "")), None)
    return first is not None and (first in _FAILED or not str(first).lstrip().startswith("#"))


def _series(cells: list[Any], name: str) -> pl.Series:
    """Return a column as numbers or times if all its cells are, else as text."""
    import polars as pl

    kinds = {type(cell) for cell in cells if cell is not None}
    if kinds and kinds <= {int, float}:
        return pl.Series(name, cells, dtype=pl.Float64, strict=False)
    if kinds == {datetime.datetime}:
        return pl.Series(name, cells, dtype=pl.Datetime("us"))
    return pl.Series(name, [None if cell is None else str(cell) for cell in cells], dtype=pl.String)
