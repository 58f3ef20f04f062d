"""Data sets of LeRobot as sheets: a folder with ``data/*/*.parquet``, and ``meta/info.json``, which
names the numbers of each feature.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from pincal.errors import MeasurementError
from pincal.measure.parquet_sheet import open_parquet, scanned, with_vectors
from pincal.measure.sheet import FrameSheet, Sheet
from pincal.measure.sheet_reader import SheetOptions, SheetReader


def _is_data_set(path: Path) -> bool:
    """Return whether a path is the folder of a data set."""
    return (path / "meta" / "info.json").is_file()


def _whole(path: Path) -> FrameSheet:
    """Read the headers of all episodes of a data set.

    Raises:
        MeasurementError: for a folder without data, or files that differ in their columns.
    """
    import polars as pl

    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise MeasurementError(
            f"{path.name}: no Parquet file in data/; expected a data set of LeRobot"
        )
    sheets = [scanned(file) for file in files]
    if len({sheet.labels for sheet in sheets}) > 1:
        raise MeasurementError(
            f"{path.name}: files in data/ differ in their columns; expected one data set"
        )
    whole = replace(sheets[0], path=path, frame=pl.concat([sheet.frame for sheet in sheets]))
    return with_vectors(whole, _names(path))


def _names(folder: Path) -> dict[str, list[str]]:
    """Return the names of the numbers of each feature of a data set."""
    import msgspec

    try:
        found = msgspec.json.decode((folder / "meta" / "info.json").read_bytes())["features"]
        listed = {name: feature.get("names") for name, feature in found.items()}
    except (OSError, msgspec.DecodeError, KeyError, TypeError, AttributeError) as error:
        raise MeasurementError(
            f"{folder.name}: meta/info.json can't be read; expected one as LeRobot writes it"
        ) from error
    flat = {
        n: next(iter(v.values()), None) if isinstance(v, Mapping) else v for n, v in listed.items()
    }
    return {
        name: [str(each) for each in value]
        for name, value in flat.items()
        if isinstance(value, list)
    }


def _folder_of(file: Path) -> Path | None:
    """Return the data set that a Parquet file is in; None for any other file."""
    if file.suffix.lower() != ".parquet":
        return None
    return next((folder for folder in file.resolve().parents if _is_data_set(folder)), None)


class _DataSets:
    """Reads data sets, and single files of them."""

    def reads(self, path: Path) -> bool:
        return _is_data_set(path) or _folder_of(path) is not None

    def open(self, path: Path, options: SheetOptions) -> Sheet:
        folder = _folder_of(path)
        return _whole(path) if folder is None else open_parquet(path, _names(folder))


DATA_SETS: SheetReader = _DataSets()
