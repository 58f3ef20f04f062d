"""Excel workbooks (.xlsx) as sheets: their first worksheet with cells."""

from __future__ import annotations

import contextlib
import datetime
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.sheet import FrameSheet, Sheet

if TYPE_CHECKING:
    import polars as pl

ENDINGS = (".xlsx", ".xlsm")
# What stands in the cell of a formula that failed.
_FAILED = ("#NULL!", "#DIV/0!", "#VALUE!", "#REF!", "#NAME?", "#NUM!", "#N/A")


def open_excel(path: Path) -> Sheet:
    """Read the first worksheet of a workbook that has cells; the first row with cells is the header.

    Raises:
        MeasurementError: without the library openpyxl, or for a workbook that is empty or can't be read.
    """
    import polars as pl

    lines, others = _lines(path)
    if not lines:
        raise MeasurementError(f"{path.name}: is empty; expected a header line and one line a pose")
    if others:
        warnings.warn(f"{path.name}: worksheets {', '.join(others)} are not read", PincalWarning, stacklevel=2)
    (top, header), *body = lines
    width = max(i for i, cell in enumerate(header, start=1) if cell is not None)
    labels = tuple("" if cell is None else str(cell).strip() for cell in header[:width])
    for row, cells in body:
        if any(cell is not None for cell in cells[width:]):
            count = max(i for i, cell in enumerate(cells, start=1) if cell is not None)
            raise MeasurementError(
                f"{path.name}, line {row}: {count} cells; expected {width} as in the header, line {top}; "
                "delete what stands above it, or begin it with #"
            )
    columns = [_series([cells[i] if i < len(cells) else None for _, cells in body], str(i)) for i in range(width)]
    return FrameSheet(path, labels, False, pl.DataFrame(columns), np.array([row for row, _ in body], int))


def _lines(path: Path) -> tuple[list[tuple[int, tuple[Any, ...]]], list[str]]:
    """Return number and cells of each line that has some, comments left out, and the names of other worksheets."""
    try:
        import openpyxl
    except ImportError as error:
        raise MeasurementError(
            f"{path.name}: Excel files need openpyxl; run pip install 'pincal[excel]', or save the table as CSV"
        ) from error
    try:
        with contextlib.closing(openpyxl.load_workbook(path, read_only=True, data_only=True)) as book:
            found: list[tuple[int, tuple[Any, ...]]] = []
            names = list(book.sheetnames)
            for sheet in book.worksheets:
                names.pop(0)
                numbered = enumerate(sheet.iter_rows(values_only=True), start=1)
                found = [(row, tuple(cells)) for row, cells in numbered if _has_cells(cells)]
                if found:
                    break
            return found, names
    except OSError:
        raise
    except Exception as error:  # Whatever a broken archive does to the libraries below.
        raise MeasurementError(f"{path.name}: can't be read ({error}); expected an Excel workbook") from error


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
