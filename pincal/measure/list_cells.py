"""Cells of text that hold lists of numbers, as pandas writes those of a data frame:
``"[0.1, 0.2, 0.3]"``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.measure.nested_labels import vector_labels
from pincal.measure.sheet import FrameSheet, Sheet, SheetColumn

# As programs print lists; p[...] is a pose of URScript, a position and a rotation vector.
_LIST = re.compile(r"\s*(?:np\.)?(?:array|p)?\(?[\[(].*[\])]\s*")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|nan", re.I)


def with_lists(sheet: Sheet) -> Sheet:
    """Return a sheet with a column for each number of the lists in its cells; others unchanged.

    Raises:
        MeasurementError: for lists of unequal length.
    """
    import polars as pl

    lists = [i for i in range(len(sheet.labels)) if _has_lists(sheet.first_cells(i, 1))]
    if not lists:
        return sheet
    columns = [SheetColumn(i, str(i), label, "", "name") for i, label in enumerate(sheet.labels)]
    frame, rows = sheet.read(columns)
    labels = list[str]()
    series = list[pl.Series]()
    for i, label in enumerate(sheet.labels):
        cells = frame[str(i)]
        if i not in lists:
            labels.append(label)
            series.append(cells.alias(str(len(series))))
            continue
        values = _numbers(cells.to_list(), rows, f'{sheet.path.name}, column "{label}"')
        names, parts, note = vector_labels(label, values)
        if note:
            warn(f"{sheet.path.name}: {note}")
        labels += names
        series += [pl.Series(str(len(series) + k), part) for k, part in enumerate(parts)]
    whole = pl.LazyFrame(series)
    return FrameSheet(sheet.path, tuple(labels), sheet.decimal_comma, whole, rows)


def _has_lists(cells: Sequence[str]) -> bool:
    """Return whether the first of the cells is a list of several numbers."""
    first = next(iter(cells), "")
    return _LIST.fullmatch(first) is not None and len(_NUMBER.findall(first)) > 1


def _numbers(cells: Sequence[str | None], rows: np.ndarray, where: str) -> np.ndarray:
    """Return the lists of cells, shape (N, k), NaN for empty cells."""
    found = [[float(text) for text in _NUMBER.findall(cell or "")] for cell in cells]
    count = len(found[0])
    for row, numbers in zip(rows, found, strict=True):
        if numbers and len(numbers) != count:
            raise MeasurementError(
                f"{where}, line {row}: a list of {len(numbers)} numbers; expected {count} as in "
                "the first one"
            )
    return np.array([numbers or [np.nan] * count for numbers in found])
