"""CSV and whitespace-separated text as sheets.

Text is UTF-8; UTF-16 with a byte-order mark, as spreadsheets write it, and Windows-1252 (Latin-1
and more) are read, too.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.measure.heading import TableHead, find_heading, is_number
from pincal.measure.nameless import numbers_as_names
from pincal.measure.sheet import Sheet, SheetColumn
from pincal.thresholds import Count

if TYPE_CHECKING:
    import polars as pl

# The header stands within the first part of a file, after at most a page of comments.
_HEAD_BYTES: Count = 1 << 20
_CHUNK_BYTES: Count = 1 << 22
# Rows that show what columns hold.
_FIRST_ROWS: Count = 50
_BLANKS = re.compile(rb"[ \t]+")
_SEPARATORS = ("\t", ";", "|", ",")


@dataclass(frozen=True, eq=False)
class TextSheet(Sheet):
    """Cells between separators, one row per line.

    Attributes:
        header_line: line of the header, or the one before the first line of a table without.
        has_header: whether it has one; else the columns have their numbers for labels.
        content: the whole text in UTF-8 with these separators, where the file differs from it.
    """

    header_line: int
    content: bytes | None = None
    has_header: bool = True

    def read(self, columns: Sequence[SheetColumn]) -> tuple[pl.DataFrame, np.ndarray]:
        """Return the cells; regular tables are read in one pass."""
        return _read_regular(self, columns) or _read_lines(self, columns)

    def first_cells(self, index: int, count: int) -> list[str]:
        return [row[index] if index < len(row) else "" for row in self._first_rows[:count]]

    @cached_property
    def _first_rows(self) -> list[list[str]]:
        with self.open() as file:
            head = file.read(_HEAD_BYTES)
        lines = [line for line in head.splitlines()[self.header_line :] if _has_cells(line)][
            :_FIRST_ROWS
        ]
        return _split(
            [line.decode("utf-8", "replace") for line in lines], self.separator, self.path.name
        )

    def open(self) -> BinaryIO:
        """Return the text as a file."""
        return self.path.open("rb") if self.content is None else io.BytesIO(self.content)


def open_text(path: Path, joints: Collection[str] = ()) -> Sheet:
    """Read the header of a text file, recognised by names of joints; other lines are left out with
    a `PincalWarning`.

    Raises:
        MeasurementError: for a binary or an empty file.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    content = None
    if head.startswith((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE)):
        head = content = path.read_bytes().decode("utf-32").encode()
    elif head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        head = content = path.read_bytes().decode("utf-16").encode()
    elif b"\0" in head or head.startswith(b"PAR1"):
        raise MeasurementError(
            f"{path.name}: a binary file; expected CSV text in UTF-8, or a name ending in .parquet"
        )
    if (found := _heading(head.removeprefix(codecs.BOM_UTF8), joints)) is not None:
        return _below(path, content, *found)
    for number, line in enumerate(head.removeprefix(codecs.BOM_UTF8).splitlines(), start=1):
        if _has_cells(line):
            return _sheet_of_header(path, line, number, content=content)
    raise MeasurementError(f"{path.name}: is empty; expected a header line and one line per pose")


# Lines searched for the header.
_LOOKED_AT: Count = 200


def _heading(head: bytes, joints: Collection[str]) -> tuple[TableHead, list[int]] | None:
    """Return a heading that is more than the first line, and the numbers of the non-blank lines."""
    numbers = list[int]()
    texts = list[str]()
    for number, line in enumerate(head.splitlines()[:_LOOKED_AT], start=1):
        # The last comment before the numbers may contain the names.
        are_comments = len(texts) <= 1 and all(text.startswith("#") for text in texts)
        if _has_cells(line) or (are_comments and line.startswith(b"#")):
            start = 0 if line.startswith(b"#") else len(texts)
            numbers[start:] = [number]
            texts[start:] = [line.decode("utf-8", "replace")]
    for separator in (*_SEPARATORS, " "):
        try:
            rows = (
                [t.split() for t in texts]
                if separator == " "
                else [*csv.reader(texts, delimiter=separator)]
            )
        except csv.Error:
            continue
        first = 0
        if texts and texts[0].startswith("#"):
            names = _commented_names(rows)
            first = 1 if names is None else 0
            rows = [*([] if names is None else [names]), *rows[1:]]
        if len(rows) == len(texts) - first and (found := find_heading(rows, joints)) is not None:
            is_plain = found.header == 0 and found.body == 1 and not texts[first].startswith("#")
            return None if is_plain else (found, numbers[first:])
    return None


def _below(
    path: Path, content: bytes | None, found: TableHead, numbers: Sequence[int]
) -> TextSheet:
    """Return the table below its preamble, whose lines become comments so that line numbers are
    preserved.
    """
    lines = _utf8(
        path.read_bytes().removeprefix(codecs.BOM_UTF8) if content is None else content, path
    ).splitlines()
    header = numbers[found.header]
    for number in numbers[: found.body]:
        if number != header:
            lines[number - 1] = b"#"
    lines[header - 1] = lines[header - 1].lstrip(b"# ")
    warn(f"{path.name}: {found.described(numbers)}")
    sheet = _sheet_of_header(path, lines[header - 1], header, content=b"\n".join(lines) + b"\n")
    return replace(sheet, labels=found.labels) if len(found.labels) == len(sheet.labels) else sheet


def _split(lines: list[str], separator: str, name: str) -> list[list[str]]:
    """Return the cells of lines; refuse what no table contains, such as a cell of a hundred
    thousand characters.
    """
    try:
        return list(csv.reader(lines, delimiter=separator))
    except csv.Error as error:
        raise MeasurementError(
            f"{name}: can't be split into cells ({error}); expected a table of names and numbers"
        ) from None


def _sheet_of_header(path: Path, line: bytes, number: int, *, content: bytes | None) -> TextSheet:
    try:
        header = line.decode("utf-8")
    except UnicodeDecodeError:
        content = _utf8(path.read_bytes(), path)
        header = content.splitlines()[number - 1].decode("utf-8")
    separator = _separator(header)
    if separator == " ":
        lines = (path.read_bytes() if content is None else content).splitlines()
        content = b"\n".join(_BLANKS.sub(b"\t", line.strip(b" \t")) for line in lines)
        header = re.sub(r"\s+", "\t", re.sub(r"\s+(?=[\[(])", "", header.strip()))
        separator = "\t"
    labels = tuple(cell.strip() for cell in _split([header], separator, path.name)[0])
    comma = separator != ","
    if (numbers := numbers_as_names(labels, decimal_comma=comma)) is not None:
        nameless = TextSheet(path, numbers, comma, number - 1, content, separator=separator)
        return replace(nameless, has_header=False)
    return TextSheet(path, labels, comma, number, content, separator=separator)


def _separator(header: str) -> str:
    """Return what stands between the cells of the first line: comma, semicolon, tab or blanks.

    Numbers with decimal commas have more commas than cells.
    """
    for mark in (";", "\t", None):
        numbers = header.split(mark)
        if len(numbers) > 1 and "," in header and all(map(is_number, numbers)):
            return mark or " "
    usual = max(reversed(_SEPARATORS), key=header.count)
    return " " if usual not in header and len(header.split()) > 1 else usual


def _utf8(text: bytes, path: Path) -> bytes:
    """Return text as UTF-8, converted from Windows-1252 with a `PincalWarning` where it is not."""
    with suppress(UnicodeDecodeError):
        text.decode("utf-8")
        return text
    try:
        decoded = text.decode("cp1252")
    except UnicodeDecodeError as error:
        line = text[: error.start].count(b"\n") + 1
        raise MeasurementError(
            f"{path.name}, line {line}: not UTF-8 text; save the table as CSV UTF-8"
        ) from error
    warn(f"{path.name}: not UTF-8; read as Windows-1252 (Latin-1)")
    return decoded.encode("utf-8")


def _has_cells(line: bytes) -> bool:
    return bool(line.strip(b" \t,;")) and not line.lstrip().startswith(b"#")


def _schema(
    sheet: TextSheet, columns: Sequence[SheetColumn], number: Any, text: Any
) -> dict[str, Any]:
    numeric = {column.index: number for column in columns if not column.is_name}
    names = {column.index: column.name for column in columns}
    return {names.get(i, f"column {i + 1}"): numeric.get(i, text) for i in range(len(sheet.labels))}


def _read_regular(
    sheet: TextSheet, columns: Sequence[SheetColumn]
) -> tuple[pl.DataFrame, np.ndarray] | None:
    """Return the cells of a regular table in one pass, None if any line needs a closer look."""
    import polars as pl

    expected = _count_lines(sheet) - sheet.header_line
    if expected < 1 or (len(columns) < len(sheet.labels) and not _are_equal(sheet, expected)):
        return None
    try:
        frame = pl.read_csv(
            sheet.path if sheet.content is None else io.BytesIO(sheet.content),
            glob=False,
            has_header=False,
            skip_rows=int(sheet.has_header),
            separator=sheet.separator,
            decimal_comma=sheet.decimal_comma,
            comment_prefix="#",
            schema=_schema(sheet, columns, pl.Float64, pl.String),
            columns=[column.index for column in columns],
        ).head(expected)
    except pl.exceptions.PolarsError:
        return None
    if frame.height != expected or sum(frame.null_count().row(0)):
        return None
    return frame, np.arange(expected) + sheet.header_line + 1


def _count_lines(sheet: TextSheet) -> int:
    """Return the number of lines, not counting blank ones at the end of the file."""
    lines = 1
    tail = b""
    with sheet.open() as file:
        while chunk := file.read(_CHUNK_BYTES):
            lines = lines + chunk.count(b"\n")
            tail = chunk
    return lines - tail[len(tail.rstrip(b" \t\r\n,;")) :].count(b"\n")


def _are_equal(sheet: TextSheet, expected: int) -> bool:
    """Return whether so many lines after the header have as many separators as the header."""
    counts = list[np.ndarray]()
    carried = 0
    with sheet.open() as file:
        while chunk := file.read(_CHUNK_BYTES):
            marks = np.frombuffer(chunk, np.uint8)
            found = np.flatnonzero(marks == ord(sheet.separator))
            ends = np.searchsorted(found, np.flatnonzero(marks == ord("\n")))
            counts.append(np.diff(ends, prepend=-carried))
            carried = len(found) - (int(ends[-1]) if len(ends) else -carried)
    counts.append(np.array([carried]))
    body = np.concatenate(counts)[sheet.header_line : sheet.header_line + expected]
    return bool((body == len(sheet.labels) - 1).all())


def _commented_names(rows: Sequence[list[str]]) -> list[str] | None:
    """Return the names of columns in a comment above the first row; None if it does not fit this
    row.
    """
    if len(rows) < 2:
        return None
    # The first column itself may be named #.
    is_name = len(rows[0]) == len(rows[1]) and rows[0][0].strip() == "#"
    cells = [rows[0][0].lstrip("# "), *rows[0][1:]]
    names = [cell.strip() for cell in cells if cell.strip(" #")]
    names = ["#", *names] if is_name else names
    numbers = sum(map(is_number, rows[1]))
    return names if len(names) == len(rows[1]) and numbers > len(names) - 1 - is_name else None


def _read_lines(
    sheet: TextSheet, columns: Sequence[SheetColumn]
) -> tuple[pl.DataFrame, np.ndarray]:
    """Return the cells as text, skipping blank lines and comments."""
    import polars as pl

    with sheet.open() as file:
        lines = _utf8(file.read(), sheet.path).splitlines()
    below = range(sheet.header_line + 1, len(lines) + 1)
    rows = np.array([i for i in below if _has_cells(lines[i - 1])], int)
    kept = _without_last(sheet, [lines[row - 1] for row in rows])
    if not kept:
        names = (column.name for column in columns)
        return pl.DataFrame(schema=dict.fromkeys(names, pl.String)), rows
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
    if sum(frame.null_count().row(0)) or len(columns) < len(sheet.labels):
        _check_lines(sheet, kept, rows)
    if frame.height != len(rows):
        reason = "a quotation mark is not closed, or a cell holds a line break"
        raise MeasurementError(
            f"{sheet.path.name}: {len(rows)} lines, but {frame.height} rows: {reason}"
        )
    return frame, rows


def _without_last(sheet: TextSheet, lines: list[bytes]) -> list[bytes]:
    """Return lines without the separator at their ends, if all have one that the header lacks."""
    mark = sheet.separator.encode()
    count = len(sheet.labels)
    has_more = all(line.endswith(mark) and line.count(mark) == count for line in lines)
    return [line.removesuffix(mark) for line in lines] if has_more else lines


def _check_lines(sheet: TextSheet, kept: list[bytes], rows: np.ndarray) -> None:
    """Refuse the first line whose number of cells differs from the header's."""
    separator = sheet.separator.encode()
    expected = len(sheet.labels)
    for line, row in zip(kept, rows, strict=True):
        count = line.count(separator) + 1
        if count != expected and b'"' in line:
            count = len(
                _split([line.decode("utf-8", "replace")], sheet.separator, sheet.path.name)[0]
            )
        if count != expected:
            hint = (
                "; decimal commas need ; or tab between the cells" if sheet.separator == "," else ""
            )
            raise MeasurementError(
                f"{sheet.path.name}, line {row}: {count} cells; expected {expected} as in "
                f"the header{hint}"
            )
