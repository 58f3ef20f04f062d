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
from pincal.measure.quantities import expected_number, in_si, is_possible

if TYPE_CHECKING:
    import polars as pl

# A date and a time of day as in ISO 8601.
_DATE = r"^\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}:\d{2}"
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
    """

    part: range | None = None

    def read(self, columns: Sequence[Column]) -> tuple[pl.DataFrame, np.ndarray]:
        """Return the cells; of a part no others are read."""
        import polars as pl

        lazy = pl.scan_parquet(self.path, glob=False)
        start, count = (0, None) if self.part is None else (self.part.start, len(self.part))
        cells = (pl.col(self.labels[column.index]).alias(column.name) for column in columns)
        frame = lazy.slice(start, count).select(cells).collect()
        return frame, np.arange(start + 2, start + frame.height + 2)

    def first_cells(self, index: int, count: int) -> list[str]:
        """Return the first cells."""
        import polars as pl

        cells = pl.read_parquet(self.path, columns=[self.labels[index]], n_rows=count, glob=False).to_series()
        return ["" if cell is None else str(cell) for cell in cells]


def open_parquet(path: Path) -> Sheet:
    """Read the header of a Parquet file."""
    import polars as pl

    labels = tuple(pl.scan_parquet(path, glob=False).collect_schema())
    return ParquetSheet(path, labels, decimal_comma=True)


def read_cells(sheet: Sheet, columns: Sequence[Column]) -> tuple[dict[str, pl.Series], np.ndarray]:
    """Return the needed cells by column, numbers or names, and the line of each row.

    Raises:
        MeasurementError: for a table without rows, or a cell that is invalid.
    """
    frame, rows = sheet.read(columns)
    if frame.height == 0:
        raise MeasurementError(f"{sheet.path.name}: has a header and no rows; expected one line a pose")
    cells = {column.name: _clean(frame[column.name], column, decimal_comma=sheet.decimal_comma) for column in columns}
    _check_cells(cells, frame, rows, columns=columns, source=sheet.path.name)
    return cells, rows


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
