"""The columns of nested values: records, one for each pose, or lists and arrays of one length.

Records are a list; or values of a mapping by the pose (``{"pose_1": {...}, "pose_2": {...}}``); or
numbered keys side by side (``joints_0``, ``T_0``, ``joints_1``, ...).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.measure.nested_labels import JOINTS
from pincal.measure.reading_numbers import LAYOUT
from pincal.thresholds import Count

MOST_VALUES: Count = 2000
"""Most values of a record."""
# Deepest nesting of measured values.
_DEEPEST: Count = 12
_NUMBERED = re.compile(r"(.*?)[ _.\-]?(\d+)")


def by_path(data: Any, source: str) -> dict[str, np.ndarray]:
    """Return the columns of equal length N, by their keys in the file: shape (N, ...).

    Numbers without names, as lists of lists have them, have their place, counted from 1, for a key.

    Raises:
        MeasurementError: for values that are no table.
    """
    records = data if isinstance(data, list) else _records(data, source)
    if records is not None:
        return _of_records(records, source)
    if isinstance(data, np.ndarray):
        return nameless_columns(data, source)
    if not isinstance(data, Mapping):
        raise MeasurementError(
            f"{source}: holds one value; expected a list of records, or columns of one length"
        )
    found = {path: _array(v) for path, v in flat(data) if isinstance(v, list | np.ndarray)}
    count = _number_of_poses(found)
    found = {path: _along_poses(v, count) for path, v in found.items()}
    others = [path for path, v in found.items() if not v.ndim or len(v) != count]
    if others:
        warn(
            f"{source}: these differ in length from the {count} rows and are left out: "
            f"{', '.join(others[:20])}"
        )
    return {path: v for path, v in found.items() if path not in others}


def nameless_columns(values: np.ndarray, source: str) -> dict[str, np.ndarray]:
    """Return the columns of an array without names, shape (N, k), by their number."""
    if values.ndim > 2:
        return {"pose": values}
    if values.ndim != 2 or values.dtype.kind not in "fiub":
        raise MeasurementError(
            f"{source}: an array of shape {values.shape}; expected a row for each pose"
        )
    return {str(i + 1): column for i, column in enumerate(values.T)}


def flat(value: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested mappings by their keys, separated by dots."""
    if not isinstance(value, Mapping):
        yield path, value
    elif depth < _DEEPEST:
        for name, inner in value.items():
            yield from flat(inner, f"{path}.{name}" if path else str(name), depth + 1)


def _number_of_poses(arrays: Mapping[str, np.ndarray]) -> int:
    """Return the number of poses of arrays, which is the length that most of them have.

    It is that of their first dimension, or of the last where this is longer: MATLAB's users have a
    pose in each column.
    """
    votes = Counter[int]()
    for path, values in arrays.items():
        if not values.ndim or re.search(r"names?$", path):
            continue
        votes[len(values)] += 1
        if values.ndim > 1 and values.shape[-1] > len(values):
            votes[values.shape[-1]] += 1
    return max(votes, key=lambda length: (votes[length], length), default=0)


def _along_poses(values: np.ndarray, count: int) -> np.ndarray:
    """Return an array with the poses, so many, along its first dimension."""
    is_last = values.ndim > 1 and values.shape[-1] == count and len(values) < count
    return np.moveaxis(values, -1, 0) if is_last else values


def _records(data: Any, source: str) -> list[Any] | None:
    """Return the only list of records among nested values; None without any."""
    if not isinstance(data, Mapping):
        return None
    lists = {
        path: v
        for path, v in flat(data)
        if isinstance(v, list) and v and all(isinstance(r, Mapping) for r in v)
    }
    if len(lists) > 1:
        raise MeasurementError(
            f"{source}: several lists of records: {', '.join(lists)}; expected one"
        )
    found = next(iter(lists.values()), None)
    if found is None:
        found = _of_frame(data) or _keyed_by_pose(data) or _of_numbered_keys(data)
    return found


def _of_frame(data: Mapping[Any, Any]) -> list[Any] | None:
    """Return the records of a table of pandas, written by columns with or without their index."""
    names = data.get("columns")
    rows = data.get("data")
    if isinstance(names, list) and isinstance(rows, list) and rows:
        return [dict(zip(map(str, names), row, strict=False)) for row in rows]
    indexed = [v for v in data.values() if isinstance(v, Mapping)]
    keys = [*indexed[0]] if indexed else []
    is_indexed = (
        len(indexed) == len(data)
        and len(keys) >= LAYOUT.fewest_keys
        and all(str(key).isdigit() for key in keys)
        and all([*v] == keys for v in indexed)
    )
    if not is_indexed:
        return None
    return [{name: of[key] for name, of in data.items()} for key in keys]


def _keyed_by_pose(data: Mapping[Any, Any]) -> list[Any] | None:
    """Return the records of a mapping from poses to their values, which may be inside others."""
    values = [v for v in data.values() if isinstance(v, Mapping)]
    is_whole = len(values) == len(data) >= LAYOUT.fewest_keys
    if is_whole and all(v.keys() == values[0].keys() for v in values):
        is_numbered = all(_NUMBERED.fullmatch(str(key)) for key in data)
        if is_numbered or any(JOINTS.fullmatch(str(key)) for key in values[0]):
            return values
    rows = [v for v in data.values() if isinstance(v, list)]
    if len(rows) == len(data) >= LAYOUT.fewest_keys and all(str(key).isdigit() for key in data):
        return rows
    inner = [found for v in values if (found := _keyed_by_pose(v)) is not None]
    return inner[0] if len(inner) == 1 else None


def _of_numbered_keys(data: Mapping[Any, Any]) -> list[Any] | None:
    """Return the records of keys such as ``joints_0``, ``T_0``, ``joints_1``; None for others.

    Numbered columns, such as those of joints, are told from them by their lengths.
    """
    groups = dict[str, dict[int, Any]]()
    for key, value in flat(data):
        if match := _NUMBERED.fullmatch(key):
            groups.setdefault(match[1], {})[int(match[2])] = value
    sets = Counter(frozenset(of) for of in groups.values() if len(of) >= LAYOUT.fewest_keys)
    numbers = max(sets, key=lambda of: (sets[of], len(of)), default=frozenset[int]())
    chosen = {name: of for name, of in groups.items() if frozenset(of) == numbers}
    shapes = {name: _shapes(of.values()) for name, of in chosen.items()}
    if len(chosen) < 2 or any(len(of) != 1 for of in shapes.values()):
        return None
    kinds = {next(iter(of)) for of in shapes.values()}
    short = all(
        len(shape) > 1 or 0 < shape[0] <= LAYOUT.of_pose < len(numbers) for shape in kinds if shape
    )
    if not any(kinds) or not (len(kinds) > 1 or short):
        return None
    return [{name: of[k] for name, of in chosen.items()} for k in sorted(numbers)]


def _shapes(values: Any) -> set[tuple[int, ...]]:
    try:
        return {np.shape(value) for value in values}
    except ValueError:
        return set()


def _of_records(records: list[Any], source: str) -> dict[str, np.ndarray]:
    """Return the columns of records, which may lack some of the values."""
    if records and all(isinstance(record, list) for record in records):
        return _of_lists(records, source)
    if not records or not all(isinstance(record, Mapping) for record in records):
        raise MeasurementError(
            f"{source}: a list without records; expected one named record per pose"
        )
    rows = [dict(flat(record)) for record in records]
    paths = dict.fromkeys(path for row in rows for path in row)
    if len(paths) > MOST_VALUES:
        raise MeasurementError(
            f"{source}: {len(paths)} values per record; expected at most {MOST_VALUES}"
        )
    return {path: _array([row.get(path) for row in rows]) for path in paths}


def _of_lists(records: list[list[Any]], source: str) -> dict[str, np.ndarray]:
    """Return the columns of lists of numbers, of which each may consist of several; the first may
    have their names.
    """
    if len(records) > 1 and all(isinstance(name, str) for name in records[0]):
        named = [dict(zip(records[0], record, strict=False)) for record in records[1:]]
        return _of_records(named, source)
    rows = [[*_numbers(record)] for record in records]
    counts = sorted({len(row) for row in rows})
    if len(counts) > 1 or not 0 < counts[0] <= MOST_VALUES:
        raise MeasurementError(
            f"{source}: lists of {counts[0]} to {counts[-1]} numbers; expected as many for each "
            "pose, or a named record per pose"
        )
    shape = np.shape(records[0]) if len(_shapes(records)) == 1 else ()
    found = np.array(rows, float)
    if shape in ((4, 4), (3, 4)):
        return {"pose": found.reshape(-1, *shape)}
    return nameless_columns(found, source)


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, list):
        for inner in value:
            yield from _numbers(inner)
    else:
        try:
            yield np.nan if value is None else float(value)
        except (TypeError, ValueError):
            # Words, such as the name of a pose, have no number.
            yield np.nan


def _array(values: Any) -> np.ndarray:
    """Return values as numbers, with NaN for None, else as objects."""
    if isinstance(values, np.ndarray):
        return values if values.dtype.kind in "fiub" else values.astype(object)
    usual = next((v for v in values if isinstance(v, list | np.ndarray)), None)
    if usual is not None:
        nothing = np.full(np.shape(usual), np.nan)
        values = [nothing if v is None else v for v in values]
    try:
        if any(isinstance(v, str | bool) for v in values):
            raise ValueError
        return np.array([np.nan if v is None else v for v in values], float)
    except (TypeError, ValueError, OverflowError):
        found = np.empty(len(values), object)
        found[:] = values
        return found
