"""Cells of a CSV or Parquet file: numbers and names, each with the line it stands in."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.errors import MeasurementError

if TYPE_CHECKING:
    import polars as pl

# The header stands within the first part of a file, after at most a page of comments.
_HEAD_BYTES = 1 << 20


@dataclass(frozen=True)
class Sheet:
    """A table whose header is known and whose cells are still in the file."""

    path: Path
    labels: tuple[str, ...]
    separator: str = ","
    header_line: int = 1


@dataclass(frozen=True)
class Column:
    """A column that is needed; the unit is empty where the header has none."""

    index: int
    name: str
    label: str
    unit: str
    quantity: str

    @property
    def is_name(self) -> bool:
        """Whether it holds names, not numbers."""
        return self.quantity == "name"


def open_sheet(path: Path) -> Sheet:
    """Read the header of a CSV or Parquet file."""
    import polars as pl

    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if path.suffix.lower() == ".parquet":
        return Sheet(path, tuple(pl.scan_parquet(path, glob=False).collect_schema()))
    if b"\0" in head or head.startswith(b"PAR1"):
        raise MeasurementError(f"{path.name}: a binary file; expected CSV text in UTF-8, or a name ending in .parquet")
    for number, line in enumerate(head.removeprefix(b"\xef\xbb\xbf").splitlines(), start=1):
        if _has_cells(line):
            return _sheet_of_header(path, line, number)
    raise MeasurementError(f"{path.name}: is empty; expected a header line and one line a pose")


def read_cells(sheet: Sheet, columns: list[Column]) -> tuple[dict[str, pl.Series], np.ndarray]:
    """Return the needed cells by column, and the line of each row."""
    if sheet.path.suffix.lower() == ".parquet":
        import polars as pl

        frame = pl.read_parquet(sheet.path, columns=[column.label for column in columns], glob=False)
        frame = frame.select(pl.col(column.label).alias(column.name) for column in columns)
        rows = np.arange(2, frame.height + 2)
    else:
        frame, rows = _read_csv(sheet, columns) or _read_csv_text(sheet, columns)
    if frame.height == 0:
        raise MeasurementError(f"{sheet.path.name}: has a header and no rows; expected one line a pose")
    cells = {column.name: _clean(frame[column.name], column, sheet) for column in columns}
    _check_cells(cells, frame, rows, columns=columns, source=sheet.path.name)
    return cells, rows


def _sheet_of_header(path: Path, line: bytes, number: int) -> Sheet:
    try:
        header = line.decode("utf-8")
    except UnicodeDecodeError as error:
        raise MeasurementError(f"{path.name}, line {number}: not UTF-8 text; save the table as CSV UTF-8") from error
    separator = max(",;\t", key=header.count)
    labels = tuple(cell.strip() for cell in next(csv.reader([header], delimiter=separator)))
    if all(re.fullmatch(r"[-+.,\deE]+", label) for label in labels):
        raise MeasurementError(f"{path.name}, line {number}: numbers; expected the names of the columns, without a #")
    return Sheet(path, labels, separator, number)


def _has_cells(line: bytes) -> bool:
    return bool(line.strip(b" \t,;")) and not line.lstrip().startswith(b"#")


def _schema(sheet: Sheet, columns: list[Column], number: Any, text: Any) -> dict[str, Any]:
    numeric = {column.index: number for column in columns if not column.is_name}
    names = {column.index: column.name for column in columns}
    return {names.get(i, f"column {i + 1}"): numeric.get(i, text) for i in range(len(sheet.labels))}


def _read_csv(sheet: Sheet, columns: list[Column]) -> tuple[pl.DataFrame, np.ndarray] | None:
    """Return the cells of a regular table in one pass, None if anything in it needs a closer look."""
    import polars as pl

    expected = _count_lines(sheet.path) - sheet.header_line
    if expected < 1:
        return None
    try:
        frame = pl.read_csv(
            sheet.path,
            glob=False,
            has_header=False,
            skip_rows=1,
            separator=sheet.separator,
            decimal_comma=sheet.separator != ",",
            comment_prefix="#",
            schema=_schema(sheet, columns, pl.Float64, pl.String),
            columns=[column.index for column in columns],
        )
    except pl.exceptions.PolarsError:
        return None
    frame = frame.head(expected)
    if frame.height != expected or sum(frame.null_count().row(0)):
        return None
    return frame, np.arange(expected) + sheet.header_line + 1


def _count_lines(path: Path) -> int:
    """Return the number of lines, those without a cell at the end of the file not counted."""
    lines, tail = 1, b""
    with path.open("rb") as file:
        while chunk := file.read(1 << 22):
            lines, tail = lines + chunk.count(b"\n"), chunk
    return lines - tail[len(tail.rstrip(b" \t\r\n,;")) :].count(b"\n")


def _read_csv_text(sheet: Sheet, columns: list[Column]) -> tuple[pl.DataFrame, np.ndarray]:
    """Return the cells as text, without the lines that are blank or comments."""
    import polars as pl

    lines = sheet.path.read_bytes().splitlines()
    rows = np.array([i for i, line in enumerate(lines, start=1) if i > sheet.header_line and _has_cells(line)], int)
    kept = [lines[row - 1] for row in rows]
    if not kept:
        return pl.DataFrame(schema=dict.fromkeys((column.name for column in columns), pl.String)), rows
    try:
        frame = pl.read_csv(
            io.BytesIO(b"\n".join(kept) + b"\n"),
            has_header=False,
            separator=sheet.separator,
            schema=_schema(sheet, columns, pl.String, pl.String),
            columns=[column.index for column in columns],
        )
    except pl.exceptions.PolarsError:
        _check_lines(sheet, kept, rows)
        raise
    if sum(frame.null_count().row(0)):
        _check_lines(sheet, kept, rows)
    if frame.height != len(rows):
        reason = "a quotation mark is not closed, or a cell holds a line break"
        raise MeasurementError(f"{sheet.path.name}: {len(rows)} lines, but {frame.height} rows: {reason}")
    return frame, rows


def _check_lines(sheet: Sheet, kept: list[bytes], rows: np.ndarray) -> None:
    separator, expected = sheet.separator.encode(), len(sheet.labels)
    for line, row in zip(kept, rows, strict=True):
        if not line.isascii() and "\ufffd" in line.decode("utf-8", "replace"):
            raise MeasurementError(f"{sheet.path.name}, line {row}: not UTF-8 text; save the table as CSV UTF-8")
        count = line.count(separator) + 1
        if count != expected and b'"' in line:
            count = len(next(csv.reader([line.decode("utf-8", "replace")], delimiter=sheet.separator)))
        if count != expected:
            hint = "; decimal commas need ; or tab between the cells" if sheet.separator == "," else ""
            raise MeasurementError(
                f"{sheet.path.name}, line {row}: {count} cells; expected {expected} as in the header{hint}"
            )


def _clean(series: pl.Series, column: Column, sheet: Sheet) -> pl.Series:
    import polars as pl

    if not column.is_name and series.dtype.is_numeric():
        return series.cast(pl.Float64)
    text = series.cast(pl.String).str.strip_chars()
    if column.is_name:
        return text.replace([""], [None])
    if sheet.separator != ",":
        text = text.str.replace(",", ".", literal=True)
    return text.cast(pl.Float64, strict=False)


def _check_cells(
    cells: Mapping[str, pl.Series], raw: pl.DataFrame, rows: np.ndarray, *, columns: list[Column], source: str
) -> None:
    total, faults = 0, list[tuple[int, Column]]()
    for column in columns:
        series = cells[column.name]
        right = series.is_not_null() if column.is_name else series.is_finite().fill_null(False)
        if not right.all():
            wrong = np.flatnonzero(~right.to_numpy())
            total += wrong.size
            faults.append((int(wrong[0]), column))
    if faults:
        row, column = min(faults, key=lambda found: found[0])
        value = raw[column.name][row]
        found = "an empty cell" if value is None or str(value).strip() in ("", '""') else f'"{value}"'
        expected = "a name" if column.is_name else "a finite number"
        raise MeasurementError(
            f'{source}, line {rows[row]}, column "{column.label}": {found}; expected {expected}; '
            f"cells like this in the table: {total}; correct them, delete their rows or ignore the column"
        )
