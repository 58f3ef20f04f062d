"""An instrument's table and a log of the joints from a file of its own, made one table.

Rows belong together by a column that both have, by time while the pose is held still, or by their order where the counts
agree; whichever it is, a `PincalWarning` tells.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.labels import name_of
from pincal.measure.sheet import Column, FrameSheet, Sheet
from pincal.measure.still import held_poses

if TYPE_CHECKING:
    import polars as pl

# Rows of a table that may fall between the poses of a log, as a share.
_BETWEEN = 0.5
# Joint positions of one pose in a log differ by less [rad, m].
_SAME = 2e-3


@dataclass(frozen=True)
class Log:
    """A log of joints.

    Attributes:
        sheet: the file.
        values: its known columns in SI units by name, shape (T,) each.
        joints: those that are joints.
        is_shared: whether it belongs to several tables.
    """

    sheet: Sheet
    values: Mapping[str, np.ndarray]
    joints: tuple[str, ...]
    is_shared: bool = False

    @property
    def q(self) -> np.ndarray:
        """Joint positions, shape (T, n)."""
        return np.column_stack([self.values[name] for name in self.joints])


@dataclass(frozen=True)
class _Pairs:
    """Which rows belong together.

    Attributes:
        rows: shape (M,), rows of the table that have a pose.
        samples: for each of them the first and the last sample of the log that are its pose, shape (M, 2).
        words: by what.
    """

    rows: np.ndarray
    samples: np.ndarray
    words: str


def join(table: Sheet, log: Log, time: np.ndarray | None, *, known: Collection[str], has: Collection[str]) -> Sheet:
    """Return a table with the joints that a log holds for its rows, and with what else the log knows of them.

    Args:
        table: readings.
        log: joints.
        time: of the table's rows [s], shape (N,); None if it has none.
        known: columns with a meaning of their own, by which rows can't be told.
        has: those of them that the table has.

    Raises:
        MeasurementError: if nothing, or more than one thing, says which rows belong together.
    """
    import polars as pl

    columns = [Column(i, str(i), label, "", "name") for i, label in enumerate(table.labels)]
    frame, lines = table.read(columns)
    keys = _common(table, log.sheet, known)
    pairs = _agreed(_by_columns(table, frame, log, lines=lines, keys=keys), _by_time(log, time), table=table, log=log)
    pairs = pairs or (None if log.is_shared else _by_order(log, frame.height))
    if pairs is None:
        raise MeasurementError(_advice(table, log, frame.height, has_times=time is not None))
    left = frame.height - len(pairs.rows)
    rest = f"; {left} rows between two poses are left out" if left else ""
    source = log.sheet.path.name
    text = f"{table.path.name}: {len(pairs.rows)} rows have their joints from {source} {pairs.words}{rest}"
    warnings.warn(text, PincalWarning, stacklevel=2)
    kept = [i for i, label in enumerate(table.labels) if label not in keys]
    taken = [pl.Series(name, _pooled(v, pairs.samples)) for name, v in log.values.items() if name not in has]
    whole = pl.DataFrame([*(frame.to_series(i)[pairs.rows] for i in kept), *taken])
    labels = (*(table.labels[i] for i in kept), *(series.name for series in taken))
    return FrameSheet(table.path, labels, table.decimal_comma, whole, lines[pairs.rows])


def _pooled(values: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return the mean of a log's values over the samples of each row; names are those of the first sample."""
    if values.dtype.kind not in "fi":
        return np.asarray(values[samples[:, 0]])
    total = np.append(0.0, np.cumsum(values - values[0]))
    first, last = samples.T
    return np.asarray((total[last + 1] - total[first]) / (last + 1 - first) + values[0])


def _common(table: Sheet, log: Sheet, known: Collection[str]) -> dict[str, int]:
    """Return labels of the table that the log has, too, and that mean nothing else, with their place in the log."""
    places = {label.casefold(): i for i, label in enumerate(log.labels) if label}
    folded = {name.casefold() for name in known}
    free = [label for label in table.labels if name_of(label).casefold() not in folded]
    return {label: places[label.casefold()] for label in free if label.casefold() in places}


def _by_columns(table: Sheet, frame: pl.DataFrame, log: Log, *, lines: np.ndarray, keys: Mapping[str, int]) -> _Pairs | None:
    """Pair rows by the columns that both have and that tell each row its pose; several have to agree."""
    found: dict[str, np.ndarray] = {}
    for label, place in keys.items():
        cells = log.sheet.read([Column(place, "key", label, "", "name")])[0]["key"]
        theirs = _places(_as_keys(cells), log.q)
        if theirs is None:
            continue
        mine = _as_keys(frame.to_series(table.labels.index(label)))
        lost = [i for i, key in enumerate(mine) if key not in theirs]
        if lost:
            raise MeasurementError(
                f'{table.path.name}, line {lines[lost[0]]}, column "{label}": {mine[lost[0]]} is not in '
                f"{log.sheet.path.name}, whose rows it tells apart; rows like this: {len(lost)}; correct them, or "
                "ignore the column"
            )
        found[label] = np.array([theirs[key] for key in mine])
    if not found:
        return None
    (first, samples), *others = found.items()
    for label, other in others:
        if not np.array_equal(samples, other):
            raise MeasurementError(
                f'{table.path.name}: the columns "{first}" and "{label}" of {log.sheet.path.name} tell different joints for '
                "the same row; expected one: ignore the wrong one"
            )
    return _Pairs(np.arange(frame.height), samples, f'by the column "{first}"')


def _agreed(by_column: _Pairs | None, by_time: _Pairs | None, *, table: Sheet, log: Log) -> _Pairs | None:
    """Return the pairs by column, else those by time; counters of rows are no names of poses.

    Raises:
        MeasurementError: if column and time tell different joints.
    """
    if by_column is None:
        return by_time
    one = by_column.samples if by_time is None else by_column.samples[by_time.rows]
    other = _around(log, by_column) if by_time is None else by_time.samples
    first, second = (_pooled_rows(log.q, samples) for samples in (one, other))
    if np.abs(first - second).max(initial=0.0) > _SAME:
        time = "its time" if by_time is not None else "the motion of the arm, which does not hold still there"
        raise MeasurementError(
            f"{table.path.name}: joints from {log.sheet.path.name} {by_column.words} contradict {time}; expected one pose a "
            "row: ignore the column if it only counts rows, or correct the times"
        )
    return by_column


def _around(log: Log, pairs: _Pairs) -> np.ndarray:
    """Return the samples just before and after those of each pair where the log is a recording, shape (M, 2)."""
    time = log.values.get("time")
    if time is None or not (np.diff(time) > 0).all() or not len(held_poses(time, log.q)):
        return pairs.samples
    return np.asarray(np.clip(pairs.samples + np.array([-1, 1]), 0, len(time) - 1))


def _pooled_rows(q: np.ndarray, samples: np.ndarray) -> np.ndarray:
    return np.asarray(np.column_stack([_pooled(column, samples) for column in q.T]))


def _as_keys(series: pl.Series) -> list[str]:
    """Return cells as text; numbers are the same however they are written."""
    import polars as pl

    text = series.cast(pl.String).str.strip_chars().fill_null("")
    number = text.cast(pl.Float64, strict=False)
    return [repr(value) if value is not None else word for word, value in zip(text, number, strict=True)]


def _places(keys: Sequence[str], q: np.ndarray) -> dict[str, tuple[int, int]] | None:
    """Return first and last sample of each key; None if the keys tell no poses apart."""
    found: dict[str, tuple[int, int]] = {}
    for i, key in enumerate(keys):
        first, last = found.get(key, (i, i - 1))
        if last != i - 1 or not key:
            return None
        found[key] = first, i
    if any(np.ptp(q[first : last + 1], axis=0).max() > _SAME for first, last in found.values()):
        return None
    return found


def _by_time(log: Log, time: np.ndarray | None) -> _Pairs | None:
    """Pair rows with the pose that is held at their time, if most rows have one."""
    theirs = log.values.get("time")
    if time is None or theirs is None or len(theirs) < 2:
        return None
    if not (np.diff(theirs) > 0).all():
        line = int(np.flatnonzero(np.diff(theirs) <= 0)[0])
        raise MeasurementError(
            f"{log.sheet.path.name}: its time does not increase in row {line + 2}; expected a log in order, one sample a row"
        )
    poses = held_poses(theirs, log.q)
    which = poses.at(theirs, time)
    rows = np.flatnonzero(which >= 0)
    if len(rows) <= _BETWEEN * len(time):
        return None
    return _Pairs(rows, np.column_stack([poses.begin, poses.end])[which[rows]], "by time, while the pose is held still")


def _by_order(log: Log, count: int) -> _Pairs | None:
    """Pair rows in their order with the log's rows, or with its poses, of which there are as many."""
    every = np.arange(count)
    if len(log.q) == count:
        return _Pairs(every, np.column_stack([every, every]), "by order, row by row")
    time = log.values.get("time")
    if time is None or not (np.diff(time) > 0).all():
        return None
    poses = held_poses(time, log.q)
    if len(poses) != count:
        return None
    return _Pairs(every, np.column_stack([poses.begin, poses.end]), "by order, pose by pose")


def _advice(table: Sheet, log: Log, count: int, *, has_times: bool) -> str:
    source, other = table.path.name, log.sheet.path.name
    time = log.values.get("time")
    what = f"{count} rows and {len(log.q)} samples of joints"
    if time is not None and has_times:
        poses = held_poses(time, log.q) if (np.diff(time) > 0).all() else ()
        what += f" ({len(poses)} poses held still, at most times of the table none; do the clocks differ?)"
    order = " (several tables share it)" if log.is_shared else ", or a sample for each row in the same order"
    return (
        f"{source}: nothing says which joints of {other} belong to which row: {what}; expected a column that both "
        f"files have and that numbers the poses, or times of one clock in both (column time){order}"
    )
