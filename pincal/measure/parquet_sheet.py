"""Parquet files and data sets of LeRobot: each number of a list is a column, named as the data set says.

A data set is a folder with ``meta/info.json``, which names the numbers of each feature, and ``data/*/*.parquet``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pincal.errors import MeasurementError, warn
from pincal.measure.sheet import FrameSheet, check_unpacked
from pincal.measure.vectors import vector_labels

# Size of a cell in memory [bytes], a number's.
_BYTES = 8
# Numbers of a list that are columns: images are longer.
_MOST = 32


def open_parquet(path: Path) -> FrameSheet:
    """Read the header of a Parquet file.

    Raises:
        MeasurementError: if it holds far more than fits into its size.
    """
    return _with_vectors(_scanned(path))


def _scanned(path: Path) -> FrameSheet:
    import polars as pl

    lazy = pl.scan_parquet(path, glob=False)
    labels = lazy.collect_schema().names()
    check_unpacked(path, _BYTES * len(labels) * int(lazy.select(pl.len()).collect().item()))
    return FrameSheet(path, tuple(labels), decimal_comma=True, frame=lazy)


def is_dataset(path: Path) -> bool:
    """Return whether a path is the folder of a data set."""
    return (path / "meta" / "info.json").is_file()


def open_dataset(path: Path) -> FrameSheet:
    """Read the headers of all episodes of a data set.

    Raises:
        MeasurementError: for a folder without data, or files that differ in their columns.
    """
    import polars as pl

    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise MeasurementError(f"{path.name}: no Parquet file in data/; expected a data set of LeRobot")
    sheets = [_scanned(file) for file in files]
    if len({sheet.labels for sheet in sheets}) > 1:
        raise MeasurementError(f"{path.name}: files in data/ differ in their columns; expected one data set")
    whole = replace(sheets[0], path=path, frame=pl.concat([sheet.frame for sheet in sheets]))
    return _with_vectors(whole)


def _with_vectors(sheet: FrameSheet) -> FrameSheet:
    """Return a sheet with a column for each number of those lists that are short and of one length; others stay."""
    import numpy as np
    import polars as pl

    kinds = sheet.frame.collect_schema()
    lists = [name for name, kind in kinds.items() if isinstance(kind, pl.List | pl.Array) and kind.inner.is_numeric()]
    if not lists:
        return sheet
    place = sheet.path.resolve()
    names = next((_names(folder) for folder in (place, *place.parents) if is_dataset(folder)), {})
    count = [pl.col(name).cast(pl.List(pl.Float64)).list.len() for name in lists]
    low, high = (sheet.frame.select(ends).collect().row(0) for ends in ([n.min() for n in count], [n.max() for n in count]))
    sizes = {name: b for name, a, b in zip(lists, low, high, strict=True) if a == b and 0 < (b or 0) <= _MOST}
    asked, labels = list[Any](), list[str]()
    for name in kinds.names():
        found, _, note = vector_labels(name, np.zeros((1, sizes.get(name, 1))))
        said = names.get(name, [])
        is_named = len(said) == sizes.get(name) and name != "action"
        if name not in sizes or (found[0].startswith(name) and not is_named):
            asked, labels = [*asked, pl.col(name)], [*labels, name]
            continue
        if is_named:
            found = tuple(n.removesuffix(".pos") + " [deg]" * n.endswith(".pos") for n in said)
            if any(n.endswith(".pos") for n in said):
                warn(f"{sheet.path.name}: positions in {name} are taken for degrees, not for shares of the range")
        if note:
            warn(f"{sheet.path.name}: {note}")
        values = pl.col(name).cast(pl.List(pl.Float64))
        asked += [values.list.get(i).alias(f"{name} {i}") for i in range(sizes[name])]
        labels += found
    return replace(sheet, labels=tuple(labels), frame=sheet.frame.select(asked))


def _names(folder: Path) -> dict[str, list[str]]:
    """Return the names of the numbers of each feature of a data set."""
    import msgspec

    try:
        found = msgspec.json.decode((folder / "meta" / "info.json").read_bytes())["features"]
        listed = {name: feature.get("names") for name, feature in found.items()}
    except (OSError, msgspec.DecodeError, KeyError, TypeError, AttributeError) as error:
        raise MeasurementError(
            f"{folder.name}: meta/info.json can't be read; expected that of a data set of LeRobot"
        ) from error
    flat = {n: next(iter(v.values()), None) if isinstance(v, Mapping) else v for n, v in listed.items()}
    return {name: [str(each) for each in value] for name, value in flat.items() if isinstance(value, list)}
