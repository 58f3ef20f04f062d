"""Sheets: tables whose header is known, with cells that are read when they are needed.

How a file becomes a sheet is the business of its format: :mod:`pincal.measure.files` chooses it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.packed import check_unpacked
from pincal.measure.quantities import expected_number, in_si, is_possible

if TYPE_CHECKING:
    import polars as pl

# A date and a time of day as in ISO 8601.
_DATE = r"^\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}:\d{2}"
# Longest name [bytes]: that of a file on most systems.
_LONGEST = 255
# Size of a cell in memory [bytes], a number's.
_BYTES = 8
# Cells that show whether a column holds numbers or words.
_SHOWN = 50


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

    def in_si(self, cells: pl.Series) -> np.ndarray:
        """Return numbers of the column in SI units, shape (N,)."""
        return in_si(cells.to_numpy(), self.quantity, self.unit)


@dataclass(frozen=True, eq=False)
class Sheet(ABC):
    """A table whose header is known.

    Attributes:
        path: the file.
        labels: what the header says, one entry per column.
        decimal_comma: whether numbers may have a comma instead of a point.
    """

    path: Path
    labels: tuple[str, ...]
    decimal_comma: bool

    @property
    def takes_unknown(self) -> bool:
        """Whether columns that nobody knows are no mistake of the user."""
        return False

    @abstractmethod
    def read(self, columns: Sequence[Column]) -> tuple[pl.DataFrame, np.ndarray]:
        """Return the cells of some columns under their names, as numbers or as text, and the line of each row."""

    @abstractmethod
    def first_cells(self, index: int, count: int) -> list[str]:
        """Return at most so many cells of a column from the top, as text; empty ones are empty."""

    @final
    def has_words(self, index: int) -> bool:
        """Return whether a column holds text: none of its first cells is a number, and some are not empty."""
        cells = [cell for cell in (text.strip() for text in self.first_cells(index, _SHOWN)) if cell]
        return bool(cells) and not any(map(self._is_number, cells))

    @final
    def is_blank(self, index: int) -> bool:
        """Return whether neither the header nor the first cells of a column hold anything."""
        return not self.labels[index] and not any(text.strip() for text in self.first_cells(index, _SHOWN))

    def _is_number(self, cell: str) -> bool:
        try:
            float(cell.replace(",", ".") if self.decimal_comma else cell)
        except ValueError:
            return False
        return True


@dataclass(frozen=True, eq=False)
class FrameSheet(Sheet):
    """A sheet in memory.

    Attributes:
        frame: the cells; its columns stand in the order of the labels, whatever their names.
        rows: shape (N,), line of each row.
        holds_more: whether columns that nobody asked for belong there, such as the joints of a gripper.
    """

    frame: pl.DataFrame
    rows: np.ndarray
    holds_more: bool = False

    @property
    def takes_unknown(self) -> bool:
        """Whether it holds more."""
        return self.holds_more

    def read(self, columns: Sequence[Column]) -> tuple[pl.DataFrame, np.ndarray]:
        """Return the cells."""
        import polars as pl

        return pl.DataFrame([self.frame.to_series(c.index).alias(c.name) for c in columns]), self.rows

    def first_cells(self, index: int, count: int) -> list[str]:
        """Return the first cells."""
        return ["" if cell is None else str(cell) for cell in self.frame.to_series(index).head(count)]


@dataclass(frozen=True, eq=False)
class ParquetSheet(Sheet):
    """A Parquet file; its rows are counted as if there were a header.

    Attributes:
        part: the rows to read, the first being 0; default: all.
        nested: labels of the columns whose cells are lists or the like, of any size.
    """

    part: range | None = None
    nested: frozenset[str] = frozenset()

    def read(self, columns: Sequence[Column]) -> tuple[pl.DataFrame, np.ndarray]:
        """Return the cells; of a part no others are read."""
        import polars as pl

        if wrong := [column.label for column in columns if self.labels[column.index] in self.nested]:
            raise MeasurementError(f'{self.path.name}, column "{wrong[0]}": lists; expected one number or name a cell')
        lazy = pl.scan_parquet(self.path, glob=False)
        start, count = (0, None) if self.part is None else (self.part.start, len(self.part))
        cells = (pl.col(self.labels[column.index]).alias(column.name) for column in columns)
        frame = lazy.slice(start, count).select(cells).collect()
        return frame, np.arange(start + 2, start + frame.height + 2)

    def first_cells(self, index: int, count: int) -> list[str]:
        """Return the first cells."""
        import polars as pl

        if self.labels[index] in self.nested:
            return []
        cells = pl.read_parquet(self.path, columns=[self.labels[index]], n_rows=count, glob=False).to_series()
        return ["" if cell is None else str(cell) for cell in cells]


def open_parquet(path: Path) -> Sheet:
    """Read the header of a Parquet file.

    Raises:
        MeasurementError: if it holds far more than fits into its size.
    """
    import polars as pl

    lazy = pl.scan_parquet(path, glob=False)
    schema = lazy.collect_schema()
    check_unpacked(path, _BYTES * len(schema) * int(lazy.select(pl.len()).collect().item()))
    nested = frozenset(label for label, kind in schema.items() if kind.is_nested())
    return ParquetSheet(path, tuple(schema), decimal_comma=True, nested=nested)


def read_cells(sheet: Sheet, columns: Sequence[Column]) -> tuple[dict[str, pl.Series], np.ndarray]:
    """Return the needed cells by column, numbers or names, and the line of each row.

    Raises:
        MeasurementError: for a table without rows, or a cell that is invalid.
    """
    frame, rows = sheet.read(columns)
    if frame.height == 0:
        raise MeasurementError(f"{sheet.path.name}: has a header and no rows; expected one line a pose")
    for column in columns:
        _check_lengths(frame[column.name], rows, column, source=sheet.path.name)
    cells = {column.name: _clean(frame[column.name], column, decimal_comma=sheet.decimal_comma) for column in columns}
    _check_cells(cells, frame, rows, columns=columns, source=sheet.path.name)
    return cells, rows


def _check_lengths(series: pl.Series, rows: np.ndarray, column: Column, *, source: str) -> None:
    """Refuse a cell that is no name and no number for its length: in an array, all names take the room of the longest."""
    import polars as pl

    if series.dtype == pl.String:
        lengths = series.str.len_bytes()
        if (lengths.max() or 0) > _LONGEST:
            row = int(lengths.arg_max() or 0)
            raise MeasurementError(
                f'{source}, line {rows[row]}, column "{column.label}": a cell of {lengths[row]} bytes; '
                f"expected {'a name' if column.is_name else 'a number'} of at most {_LONGEST}"
            )


def _clean(series: pl.Series, column: Column, *, decimal_comma: bool) -> pl.Series:
    import polars as pl

    if not column.is_name and series.dtype.is_numeric():
        return series.cast(pl.Float64)
    if column.quantity == "time" and series.dtype.is_temporal():
        return series.cast(pl.Datetime("us")).dt.epoch("us").cast(pl.Float64) * 1e-6
    text = series.cast(pl.String).str.strip_chars()
    if column.is_name:
        return text.replace([""], [None])
    if decimal_comma:
        text = text.str.replace(",", ".", literal=True)
    if column.quantity == "time" and text.str.contains(_DATE).all():
        return _seconds(text)
    return text.cast(pl.Float64, strict=False)


def _seconds(text: pl.Series) -> pl.Series:
    """Return dates with times of day as seconds since 1970, null where a text is none."""
    import polars as pl

    shape = "%Y-%m-%dT%H:%M:%S%.f"
    plain = text.str.replace(" ", "T", literal=True).str.strip_suffix("Z")
    return plain.str.to_datetime(shape, time_unit="us", strict=False).dt.epoch("us").cast(pl.Float64) * 1e-6


def _check_cells(
    cells: Mapping[str, pl.Series], raw: pl.DataFrame, rows: np.ndarray, *, columns: Sequence[Column], source: str
) -> None:
    total, faults = 0, list[tuple[int, Column]]()
    for column in columns:
        series = cells[column.name]
        # An empty cell is null, as numbers nan.
        right = series.is_not_null().to_numpy() if column.is_name else is_possible(column.in_si(series), column.quantity)
        if not right.all():
            wrong = np.flatnonzero(~right)
            total += wrong.size
            faults.append((int(wrong[0]), column))
    if faults:
        row, column = min(faults, key=lambda found: found[0])
        value = raw[column.name][row]
        found = "an empty cell" if value is None or str(value).strip() in ("", '""') else f'"{value}"'
        expected = "a name" if column.is_name else expected_number(column.quantity)
        raise MeasurementError(
            f'{source}, line {rows[row]}, column "{column.label}": {found}; expected {expected}; '
            f"cells like this in the table: {total}; correct them, delete their rows, or leave the "
            f"column out (--ignore '{column.label}')"
        )
