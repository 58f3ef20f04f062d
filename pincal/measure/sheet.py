"""Sheets: tables with a known header whose cells are read on demand; :mod:`pincal.measure.reader`
opens files as sheets.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np

from pincal.errors import MeasurementError, few, warn
from pincal.measure.numerals import numerals_read
from pincal.measure.placeholders import placeholders
from pincal.measure.reading_numbers import LAYOUT
from pincal.thresholds import Count
from pincal.units import expected_number, in_si, is_possible, plain_numbers

if TYPE_CHECKING:
    import polars as pl


# A date and a time of day as in ISO 8601.
_DATE = r"^\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}:\d{2}"
# Offset of a time zone from UTC.
_ZONE = r" ?([+-])(\d{2}):?(\d{2})$"
# A time of day alone, assigned to an arbitrary day.
_CLOCK = r"^\d{1,2}:\d{2}:\d{2}(\.\d+)?$"
_DAY = "2000-01-01"
# Longest name [bytes], as for files on most systems.
_LONGEST: Count = 255
# Cells by which columns of numbers and of words are distinguished.
_SHOWN: Count = 50


@dataclass(frozen=True)
class SheetColumn:
    """A needed column; the unit is empty where the header has none."""

    index: int
    name: str
    label: str
    unit: str
    quantity: str

    @property
    def is_name(self) -> bool:
        """Whether it holds names, not numbers."""
        return self.quantity == "name"

    def values(self, cells: pl.Series) -> np.ndarray:
        """Return names, or numbers in SI units, shape (N,)."""
        return (
            np.array(cells.to_list(), dtype=str)
            if self.is_name
            else in_si(cells.to_numpy(), self.unit, self.quantity)
        )


@dataclass(frozen=True, eq=False)
class Sheet(ABC):
    """A table whose header is known.

    Attributes:
        path: the file.
        labels: of the header, one entry per column.
        decimal_comma: whether numbers may have a comma instead of a point.
        takes_unknown: whether unneeded columns are normal, such as the joints of a gripper.
        separator: between the cells of a line: comma, semicolon or tab; empty where a file has
        none.
    """

    path: Path
    labels: tuple[str, ...]
    decimal_comma: bool
    takes_unknown: bool = field(default=False, kw_only=True)
    separator: str = field(default="", kw_only=True)

    @abstractmethod
    def read(self, columns: Sequence[SheetColumn]) -> tuple[pl.DataFrame, np.ndarray]:
        """Return the cells of some columns by name, as numbers or as text, and the line of each
        row.
        """

    @abstractmethod
    def first_cells(self, index: int, count: int) -> list[str]:
        """Return at most ``count`` cells from the top of a column, as text."""

    @final
    def has_words(self, index: int) -> bool:
        """Return whether a column holds text: its first cells contain no number and are not all
        empty.
        """
        cells = list(filter(None, map(str.strip, self.first_cells(index, _SHOWN))))
        return bool(cells) and not any(
            plain_numbers([c.replace(",", ".") if self.decimal_comma else c]) for c in cells
        )

    @final
    def first_numbers(self, index: int) -> np.ndarray:
        """Return the first cells of a column as numbers, NaN for those without one, shape (M,)."""
        cells = self.first_cells(index, _SHOWN)
        texts = (cell.replace(",", ".") if self.decimal_comma else cell for cell in cells)
        found = (plain_numbers([text.strip()]) for text in texts)
        return np.array([number[0] if number else np.nan for number in found])

    @final
    def is_blank(self, index: int) -> bool:
        """Return whether a column has neither a label nor anything in its first cells."""
        return not self.labels[index] and not any(
            text.strip() for text in self.first_cells(index, _SHOWN)
        )


@dataclass(frozen=True, eq=False)
class FrameSheet(Sheet):
    """A sheet whose cells are in memory, or in a Parquet file that is read as far as needed.

    Attributes:
        frame: the cells; its columns are in the order of the labels, whatever their names.
        rows: shape (N,), line of each row; default: counted as if there were a header.
        start: index of the first row of the frame in the file.
        worksheet: its name in a workbook.
        header_line: line of the column names in it.
    """

    frame: pl.LazyFrame
    rows: np.ndarray | None = None
    start: int = 0
    worksheet: str = ""
    header_line: int = 0

    def part(self, rows: range) -> FrameSheet:
        """Return some rows of the file, by index."""
        return replace(self, frame=self.frame.slice(rows.start, len(rows)), start=rows.start)

    def read(self, columns: Sequence[SheetColumn]) -> tuple[pl.DataFrame, np.ndarray]:
        """Return the cells; refuse lists and the like."""
        import polars as pl

        kinds = self.frame.collect_schema().dtypes()
        if wrong := [column.label for column in columns if kinds[column.index].is_nested()]:
            raise MeasurementError(
                f'{self.path.name}, column "{wrong[0]}": lists; expected one number or '
                "name per cell"
            )
        frame = self.frame.select(
            pl.nth(column.index).alias(column.name) for column in columns
        ).collect()
        return frame, np.arange(
            self.start + 2, self.start + frame.height + 2
        ) if self.rows is None else self.rows

    def first_cells(self, index: int, count: int) -> list[str]:
        import polars as pl

        if self.frame.collect_schema().dtypes()[index].is_nested():
            return []
        cells = self.frame.select(pl.nth(index)).head(count).collect().to_series()
        return ["" if cell is None else str(cell) for cell in cells]


def read_cells(
    sheet: Sheet,
    columns: Sequence[SheetColumn],
    *,
    readings: Collection[str] = (),
    flag: SheetColumn | None = None,
    is_measured: bool = False,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the values by column, names or numbers in SI units, and the line of each row.

    Args:
        sheet: the table.
        columns: the needed ones.
        readings: columns of measured values: rows with an empty one are left out with a
            `PincalWarning`.
        flag: a column that states whether the reading of a row is valid: rows with an invalid one
            are left out likewise.
        is_measured: whether an instrument wrote the readings, perhaps with a number such as -9999
            where it had none; such rows are left out likewise.

    Raises:
        MeasurementError: for a table without rows, or an invalid cell.
    """
    asked = [*columns, *([] if flag is None else [flag])]
    frame, rows = sheet.read(asked)
    if frame.height == 0:
        raise MeasurementError(
            f"{sheet.path.name}: has a header and no rows; expected one line per pose"
        )
    for column in asked:
        _check_lengths(frame[column.name], rows, column, source=sheet.path.name)
    measured = [column for column in columns if column.name in readings]
    lost = _lost(frame, measured, flag)
    if is_measured:
        lost |= _replaced(frame, measured, decimal_comma=sheet.decimal_comma)
    frame, rows = _with_readings(frame, rows, lost, measured, sheet)
    cells = {
        column.name: _clean(frame[column.name], column, decimal_comma=sheet.decimal_comma)
        for column in columns
    }
    _check_cells(cells, frame, rows, columns=columns, source=sheet.path.name)
    return {column.name: column.values(cells.pop(column.name)) for column in columns}, rows


# Cells of missing readings, and values of a flag that mark a reading as invalid, in lower case.
_NOTHING = (
    r'^(""|n/?a|n\.a\.|nan|null|none|invalid|lost|no '
    r"data|-+|[*]+|[?]+|#+|#n/a|#value!|#num!|#div/0!)?$"
)
_INVALID = (
    r"^(false|no|n|nok|bad|lost|.*(invalid|not ok|fail|error|broken|block|reject|outlier|no "
    r"(signal|target|beam)).*)$"
)
# Flags whose 0 marks a reading as invalid.
_ZERO_IS_INVALID = ("valid", "is_valid", "isvalid", "ok", "visible", "tracked")
# Lines that a note lists.
_NAMED: Count = 5


def _with_readings(
    frame: pl.DataFrame,
    rows: np.ndarray,
    lost: Mapping[str, np.ndarray],
    readings: Sequence[SheetColumn],
    sheet: Sheet,
) -> tuple[pl.DataFrame, np.ndarray]:
    """Return the rows with valid readings, at least one; warn of those that are ``lost``, by the
    reason.
    """
    gone = np.zeros(len(rows), bool)
    for reason, which in lost.items():
        if (which & ~gone).any():
            lines = rows[which & ~gone]
            words = f"{reason} and are" if len(lines) > 1 else f"{reason} and is"
            words = words if len(lines) > 1 else words.replace("have", "has", 1)
            warn(
                f"{sheet.path.name}: {len(lines)} of {len(rows)} rows {words} left out: line "
                f"{few(lines, _NAMED)}"
            )
        gone |= which
    if gone.all():
        raise MeasurementError(
            f"{sheet.path.name}, line {rows[0]}: none of {len(rows)} rows has a reading; all are "
            f"empty or flagged in {' '.join(column.label for column in readings) or 'the table'}; "
            "expected a finite number in each row"
        )
    return (frame.filter(~gone), rows[~gone]) if gone.any() else (frame, rows)


def _lost(
    frame: pl.DataFrame, readings: Sequence[SheetColumn], flag: SheetColumn | None
) -> dict[str, np.ndarray]:
    """Return which rows have no valid reading, shape (N,), by the reason in words."""
    lost = dict[str, np.ndarray]()
    for column in readings:
        series = frame[column.name]
        is_empty = (
            series.is_nan() if series.dtype.is_float() else _plain(series).str.contains(_NOTHING)
        )
        lost.setdefault("have an empty reading", np.zeros(frame.height, bool))
        lost["have an empty reading"] |= is_empty.fill_null(True).to_numpy()
    if flag is not None:
        pattern = _INVALID + (r"|^0(\.0*)?$" if flag.label.casefold() in _ZERO_IS_INVALID else "")
        lost[f'are flagged in the column "{flag.label}"'] = (
            _plain(frame[flag.name]).str.contains(pattern).fill_null(False).to_numpy()
        )
    return lost


def _plain(series: pl.Series) -> pl.Series:
    """Return the texts of a column in lower case, without blanks around them."""
    import polars as pl

    return series.cast(pl.String).str.strip_chars().str.to_lowercase()


def _replaced(
    frame: pl.DataFrame, readings: Sequence[SheetColumn], *, decimal_comma: bool
) -> dict[str, np.ndarray]:
    """Return which rows have a number in place of a reading, shape (N,), by the reason in words."""
    lengths = [column for column in readings if column.quantity == "length"]
    if not lengths:
        return {}
    cells = (_clean(frame[of.name], of, decimal_comma=decimal_comma) for of in lengths)
    values = np.column_stack([each.to_numpy() for each in cells])
    reason = "have a number in place of a reading, such as -9999 or 0 0 0,"
    return {reason: placeholders(values)}


def _check_lengths(
    series: pl.Series, rows: np.ndarray, column: SheetColumn, *, source: str
) -> None:
    """Refuse cells too long for a name or a number: in an array, all names take the space of the
    longest.
    """
    import polars as pl

    if series.dtype == pl.String:
        # An empty cell has no length.
        lengths = series.str.len_bytes().fill_null(0).to_numpy()
        if lengths.max(initial=0) > _LONGEST:
            row = int(lengths.argmax())
            raise MeasurementError(
                f'{source}, line {rows[row]}, column "{column.label}": a cell of '
                f"{lengths[row]} bytes; "
                f"expected {'a name' if column.is_name else 'a number'} of at most {_LONGEST}"
            )


def _clean(series: pl.Series, column: SheetColumn, *, decimal_comma: bool) -> pl.Series:
    import polars as pl

    if not column.is_name and series.dtype.is_numeric():
        return series.cast(pl.Float64)
    if column.quantity == "time" and series.dtype.is_temporal():
        return series.cast(pl.Datetime("us")).dt.epoch("us").cast(pl.Float64) * 1e-6
    text = series.cast(pl.String).str.strip_chars()
    if column.is_name:
        return text.replace([""], [None])
    if column.quantity == "time" and decimal_comma:
        text = text.str.replace(",", ".", literal=True)
    if column.quantity == "time" and text.str.contains(_CLOCK).all():
        return _seconds(_DAY + "T" + text.str.zfill(8))
    if column.quantity == "time" and text.str.contains(_DATE).all():
        return _seconds(text)
    return numerals_read(text, decimal_comma=decimal_comma)


def _seconds(text: pl.Series) -> pl.Series:
    """Return dates with times of day as seconds since 1970, null for other text."""
    import polars as pl

    shape = "%Y-%m-%dT%H:%M:%S%.f"
    plain = text.str.replace(" ", "T", literal=True).str.strip_suffix("Z").str.replace(_ZONE, "")
    zone = [text.str.extract(_ZONE, k).cast(pl.Float64).fill_null(0.0) for k in (2, 3)]
    sign = text.str.extract(_ZONE, 1).replace_strict(
        {"-": -1.0, "+": 1.0}, default=0.0, return_dtype=pl.Float64
    )
    local = (
        plain.str.to_datetime(shape, time_unit="us", strict=False).dt.epoch("us").cast(pl.Float64)
        * 1e-6
    )
    return local - sign * (3600.0 * zone[0] + 60.0 * zone[1])


def _check_cells(
    cells: Mapping[str, pl.Series],
    raw: pl.DataFrame,
    rows: np.ndarray,
    *,
    columns: Sequence[SheetColumn],
    source: str,
) -> None:
    total = 0
    faults = list[tuple[int, SheetColumn]]()
    for column in columns:
        series = cells[column.name]
        # An empty cell is null, or NaN as a number.
        right = (
            series.is_not_null().to_numpy()
            if column.is_name
            else is_possible(column.values(series), column.quantity)
        )
        if not right.all():
            wrong = np.flatnonzero(~right)
            total += wrong.size
            faults.append((int(wrong[0]), column))
    if faults:
        row, column = min(faults, key=lambda found: found[0])
        value = raw[column.name][row]
        found = (
            "an empty cell" if value is None or str(value).strip() in ("", '""') else f'"{value}"'
        )
        raise MeasurementError(
            f'{source}, line {rows[row]}, column "{column.label}": {found}; expected '
            f"{_expected(column)}; cells affected: {total}; {_cure(str(value))}, "
            f"delete their rows, or leave the column out (--ignore '{column.label}')"
        )


def _cure(cell: str) -> str:
    """Return what to do about a cell that holds no number alone."""
    if re.search(r"\d\s*[°a-zA-Z]", cell):
        return "write numbers alone, angles in decimals, and their unit in the name, x [mm]"
    if re.fullmatch(r"[-+]?\d{1,3}([,.]\d{3})+", cell.strip()):
        return "write numbers without separators between thousands, and with a decimal point"
    return "correct them"


def _expected(column: SheetColumn) -> str:
    """Return what a cell of a column should hold, in words."""
    if column.is_name:
        return "a name"
    dates = ", or a date and time such as 2026-01-31T12:00:00.5"
    return expected_number(column.quantity) + dates * (column.quantity == "time")


def check_unpacked(path: Path, held: int) -> None:
    """Refuse a file whose contents, of ``held`` bytes, are far larger than itself, before they are
    unpacked.
    """
    size = path.stat().st_size
    if held > max(LAYOUT.always_unpacked, LAYOUT.unpacked * size):
        raise MeasurementError(
            f"{path.name}: holds {held / 1e6:.0f} MB in {size / 1e6:.2g} MB, more than "
            f"{LAYOUT.unpacked} times its size; measured numbers do not compress like that: look "
            "for blank or copied rows and columns, or save the table as CSV"
        )
