"""Parquet files as sheets, each number of a list as a column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pincal.errors import warn
from pincal.measure.nested_labels import vector_labels
from pincal.measure.reading_numbers import LAYOUT
from pincal.measure.sheet import FrameSheet, check_unpacked
from pincal.thresholds import Count

# Size of a number in memory [bytes].
_BYTES: Count = 8


def open_parquet(path: Path, names: Mapping[str, Sequence[str]] | None = None) -> FrameSheet:
    """Read the header of a Parquet file.

    Args:
        path: the file.
        names: those of the numbers of lists, by column, where they are known.

    Raises:
        MeasurementError: if it holds far more than fits into its size.
    """
    return with_vectors(scanned(path), names or {})


def scanned(path: Path) -> FrameSheet:
    """Return the columns of a Parquet file as they are, lists not divided.

    Raises:
        MeasurementError: if it holds far more than fits into its size.
    """
    import polars as pl

    lazy = pl.scan_parquet(path, glob=False)
    labels = lazy.collect_schema().names()
    check_unpacked(path, _BYTES * len(labels) * int(lazy.select(pl.len()).collect().item()))
    return FrameSheet(path, tuple(labels), decimal_comma=True, frame=lazy)


def with_vectors(sheet: FrameSheet, names: Mapping[str, Sequence[str]]) -> FrameSheet:
    """Return a sheet with a column for each number of short lists of one length; other lists are
    unchanged.

    Args:
        sheet: as it was read.
        names: those of the numbers of lists, by column, where they are known.
    """
    import polars as pl

    kinds = sheet.frame.collect_schema()
    lists = [
        name
        for name, kind in kinds.items()
        if isinstance(kind, pl.List | pl.Array) and kind.inner.is_numeric()
    ]
    if not lists:
        return sheet
    sizes = _sizes(sheet, lists)
    asked = list[Any]()
    labels = list[str]()
    for name in kinds.names():
        found, _, note = vector_labels(name, np.zeros((1, sizes.get(name, 1))))
        given = names.get(name, [])
        is_named = len(given) == sizes.get(name) and name != "action"
        if name not in sizes or (found[0].startswith(name) and not is_named):
            asked = [*asked, pl.col(name)]
            labels = [*labels, name]
            continue
        if is_named:
            found = _with_degrees(name, given, source=sheet.path.name)
        if note:
            warn(f"{sheet.path.name}: {note}")
        values = pl.col(name).cast(pl.List(pl.Float64))
        asked += [values.list.get(i).alias(f"{name} {i}") for i in range(sizes[name])]
        labels += found
    return replace(sheet, labels=tuple(labels), frame=sheet.frame.select(asked))


def _sizes(sheet: FrameSheet, lists: Sequence[str]) -> dict[str, int]:
    """Return the lengths of the short lists that are equally long in all rows, by column."""
    import polars as pl

    count = [pl.col(name).cast(pl.List(pl.Float64)).list.len() for name in lists]
    low, high = (
        sheet.frame.select(ends).collect().row(0)
        for ends in ([n.min() for n in count], [n.max() for n in count])
    )
    return {
        name: b
        for name, a, b in zip(lists, low, high, strict=True)
        if a == b and 0 < (b or 0) <= LAYOUT.longest_list
    }


def _with_degrees(name: str, given: Sequence[str], *, source: str) -> tuple[str, ...]:
    """Return the names of a list's numbers, those of positions with their unit; warn of it."""
    if any(n.endswith(".pos") for n in given):
        warn(
            f"{source}: positions in {name} are interpreted as degrees, "
            "not as fractions of the range"
        )
    return tuple(n.removesuffix(".pos") + " [deg]" * n.endswith(".pos") for n in given)
