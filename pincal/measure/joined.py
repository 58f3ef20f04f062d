"""Joins a table of readings with a separate log of the joints.

Rows are matched by a common column, by time while the pose is held still, or by their order where
the counts agree; a `PincalWarning` states which.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pincal.errors import MeasurementError, counted, warn
from pincal.measure.labels import name_of
from pincal.measure.reading_numbers import LOGS
from pincal.measure.sheet import FrameSheet, Sheet, SheetColumn

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True)
class HeldPoses:
    """K poses that were held still.

    Attributes:
        begin: shape (K,), first sample of each.
        end: shape (K,), last sample of each.
    """

    begin: np.ndarray
    end: np.ndarray

    def __len__(self) -> int:
        return len(self.begin)

    @property
    def samples(self) -> np.ndarray:
        """First and last sample of each, shape (K, 2)."""
        return np.column_stack([self.begin, self.end])

    def at(self, time: np.ndarray, asked: np.ndarray) -> np.ndarray:
        """Return the index of the pose held at each of the times ``asked``, shape (M,); -1 where
        none is.
        """
        found = np.searchsorted(time[self.begin], asked, side="right") - 1
        is_held = (
            (found >= 0) & (asked <= time[self.end][np.maximum(found, 0)])
            if len(self)
            else np.zeros(len(asked), bool)
        )
        return np.where(is_held, found, -1)

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return the mean of values, shape (T, k), in each pose, shape (K, k)."""
        return np.array(
            [values[a : b + 1].mean(axis=0) for a, b in zip(self.begin, self.end, strict=True)]
        )


def held_poses(time: np.ndarray, q: np.ndarray) -> HeldPoses:
    """Return the poses that are held still for a few tenths of a second.

    Args:
        time: shape (T,), strictly increasing [s].
        q: shape (T, n), joint positions [rad], prismatic [m].

    Example:
        >>> time = np.arange(0.0, 4.0, 0.01)
        >>> poses = held_poses(time, np.clip(time - 1.0, 0.0, 1.0)[:, None])
        >>> len(poses), poses.at(time, np.array([0.5, 1.5, 3.0])).tolist()
        (2, [0, -1, 1])
    """
    ahead = np.minimum(np.searchsorted(time, time + LOGS.hold), len(time) - 1)
    alone = time[ahead] - time < 0.9 * LOGS.hold  # At the end of the recording; times are rounded.
    is_held = (np.abs(q[ahead] - q).max(axis=1, initial=0.0) <= LOGS.still) & ~alone
    # All samples of a still window are held.
    change = np.zeros(len(time) + 1, int)
    np.add.at(change, np.flatnonzero(is_held), 1)
    np.add.at(change, ahead[is_held] + 1, -1)
    inside = np.cumsum(change[:-1]) > 0
    moves = np.append(np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0) > LOGS.still, True)
    begin = inside & np.append(True, ~inside[:-1] | moves[:-1])
    end = inside & (np.append(~inside[1:], True) | moves)
    first = np.flatnonzero(begin)
    last = np.flatnonzero(end)
    steady = [
        float(np.ptp(q[a : b + 1], axis=0).max(initial=0.0)) <= LOGS.drift
        for a, b in zip(first, last, strict=True)
    ]
    return HeldPoses(first[steady], last[steady])


def is_log(time: np.ndarray) -> bool:
    """Return whether rows are as close in time as in a log, which may consist of several
    recordings.
    """
    return (
        len(time) >= LOGS.fewest_rows and 0.0 < float(np.median(np.diff(time))) <= LOGS.longest_step
    )


def held_rows(
    values: Mapping[str, np.ndarray],
    rows: np.ndarray,
    joints: Sequence[str],
    *,
    was_joined: bool,
    source: str,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return one row per pose that is held still, if a table is a log in which the arm moves; else
    the table.

    Numbers are means over the middle half of the pose. A `PincalWarning` reports it.

    Args:
        values: columns in SI units, with a time, shape (N,) each.
        rows: shape (N,), their lines.
        joints: those that have to stand still.
        was_joined: whether rows between two poses have been left out already.
        source: the file, for messages.
    """
    steps = np.diff(values["time"])
    if not is_log(values["time"]):
        return dict(values), rows
    # Time may jump where one recording ends and the next begins.
    kept = np.flatnonzero(np.append(True, steps != 0.0))
    time = np.append(0.0, np.cumsum(np.where(steps[kept[1:] - 1] < 0.0, 1.0, steps[kept[1:] - 1])))
    poses = held_poses(time, np.column_stack([values[name][kept] for name in joints]))
    held = int((poses.end - poses.begin + 1).sum())
    is_dense = was_joined and held >= LOGS.rows_per_pose * len(poses)
    if len(poses) < 2 or (held > (1.0 - LOGS.in_motion) * len(kept) and not is_dense):
        return dict(values), rows
    quarter = (poses.end - poses.begin) // 4
    first = kept[poses.begin + quarter]
    last = kept[poses.end - quarter]
    found = {name: _pooled(v, np.column_stack([first, last])) for name, v in values.items()}
    if "qx" in values:
        turned = np.column_stack([values[name] for name in ("qx", "qy", "qz", "qw")])
        means = [mean_turn(turned[a : b + 1]) for a, b in zip(first, last, strict=True)]
        found |= dict(zip(("qx", "qy", "qz", "qw"), np.array(means).T, strict=True))
    warn(
        f"{source}: a log of {len(rows)} rows at {1.0 / np.median(steps):.0f} Hz is cut into the "
        f"{len(poses)} poses that are held still, each the mean over its middle half; rows in "
        f"motion left out: {len(kept) - held}"
    )
    return found, rows[first]


def mean_turn(quaternions: np.ndarray) -> np.ndarray:
    """Return the mean of quaternions of either sign, shape (4,) for (N, 4)."""
    mean = np.where((quaternions @ quaternions[0] < 0.0)[:, None], -quaternions, quaternions).mean(
        axis=0
    )
    return np.asarray(mean / np.linalg.norm(mean))


@dataclass(frozen=True)
class Log:
    """A log of joints.

    Attributes:
        sheet: the file.
        values: its known columns in SI units by name, shape (T,) each.
        joints: which of them are joints.
        is_shared: whether several tables use it.
    """

    sheet: Sheet
    values: Mapping[str, np.ndarray]
    joints: tuple[str, ...]
    is_shared: bool = False

    @property
    def q(self) -> np.ndarray:
        """Joint positions, shape (T, n)."""
        return np.column_stack([self.values[name] for name in self.joints])

    @cached_property
    def held(self) -> HeldPoses | None:
        """The poses that are held still, if its time increases as in a recording; else None."""
        time = self.values.get("time")
        return held_poses(time, self.q) if time is not None and (np.diff(time) > 0).all() else None


@dataclass(frozen=True)
class _Pairs:
    """Matched rows of table and log.

    Attributes:
        rows: shape (M,), rows of the table that have a pose.
        samples: shape (M, 2), first and last sample of each one's pose in the log.
        words: the criterion, for messages.
    """

    rows: np.ndarray
    samples: np.ndarray
    words: str


def join(
    table: Sheet, log: Log, time: np.ndarray | None, *, known: Collection[str], has: Collection[str]
) -> Sheet:
    """Return a table with the joints and other known columns of a log for its rows.

    Args:
        table: the readings.
        log: the joints.
        time: of the table's rows [s], shape (N,); None if it has none.
        known: columns with a known meaning, which do not identify rows.
        has: known columns of the table.

    Raises:
        MeasurementError: if no criterion determines which rows belong together, or two contradict
            each other.
    """
    import polars as pl

    columns = [SheetColumn(i, str(i), label, "", "name") for i, label in enumerate(table.labels)]
    frame, lines = table.read(columns)
    keys = _common(table, log, known)
    pairs = _agreed(
        _by_columns(table, frame, log, lines=lines, keys=keys),
        _by_time(log, time),
        table=table,
        log=log,
    )
    pairs = pairs or (None if log.is_shared else _by_order(log, frame.height))
    if pairs is None:
        raise MeasurementError(_advice(table, log, frame.height, has_times=time is not None))
    lost = frame.height - len(pairs.rows)
    rest = f"; {counted(lost, 'row', 'are')} left out, between two poses" if lost else ""
    source = log.sheet.path.name
    warn(
        f"{table.path.name}: {counted(len(pairs.rows), 'row', 'have')} joints from {source} "
        f"{pairs.words}{rest}"
    )
    kept = [i for i, label in enumerate(table.labels) if label not in keys]
    taken = [
        pl.Series(name, _pooled(v, pairs.samples))
        for name, v in log.values.items()
        if name not in has
    ]
    whole = pl.DataFrame([*(frame.to_series(i)[pairs.rows] for i in kept), *taken])
    labels = (*(table.labels[i] for i in kept), *(series.name for series in taken))
    return FrameSheet(table.path, labels, table.decimal_comma, whole.lazy(), lines[pairs.rows])


def _pooled(values: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return the mean of a log's values over the samples of each row; for names, the first one."""
    if values.dtype.kind not in "fi":
        return np.asarray(values[samples[:, 0]])
    total = np.append(0.0, np.cumsum(values - values[0]))
    first, last = samples.T
    return np.asarray((total[last + 1] - total[first]) / (last + 1 - first) + values[0])


def _by_columns(
    table: Sheet, frame: pl.DataFrame, log: Log, *, lines: np.ndarray, keys: Mapping[str, int]
) -> _Pairs | None:
    """Pair rows by common columns that identify the pose of each row; several have to agree."""
    found: dict[str, np.ndarray] = {}
    for label, place in keys.items():
        cells = log.sheet.read([SheetColumn(place, "key", label, "", "name")])[0]["key"]
        theirs = _places(_as_keys(cells), log.q)
        if theirs is None:
            continue
        mine = _as_keys(frame.to_series(table.labels.index(label)))
        lost = [i for i, key in enumerate(mine) if key not in theirs]
        if lost:
            raise MeasurementError(
                f'{table.path.name}, line {lines[lost[0]]}, column "{label}": '
                f"{mine[lost[0]]} is not in {log.sheet.path.name}, whose rows it identifies; rows "
                f"affected: {len(lost)}; correct them, or ignore the column"
            )
        found[label] = np.array([theirs[key] for key in mine])
    if not found:
        return None
    (first, samples), *others = found.items()
    for label, other in others:
        if not np.array_equal(samples, other):
            raise MeasurementError(
                f'{table.path.name}: the columns "{first}" and "{label}" of '
                f"{log.sheet.path.name} give different joints for "
                "the same row; expected one: ignore the wrong one"
            )
    return _Pairs(np.arange(frame.height), samples, f'by the column "{first}"')


def _common(table: Sheet, log: Log, known: Collection[str]) -> dict[str, int]:
    """Return the labels of a table that the log has, too, and that have no known meaning, with
    their index in the log.
    """
    places = {label.casefold(): i for i, label in enumerate(log.sheet.labels) if label}
    folded = {name.casefold() for name in known}
    free = [label for label in table.labels if name_of(label).casefold() not in folded]
    return {label: places[label.casefold()] for label in free if label.casefold() in places}


def _agreed(
    by_column: _Pairs | None, by_time: _Pairs | None, *, table: Sheet, log: Log
) -> _Pairs | None:
    """Return the pairs by column, else those by time; refuse a column that contradicts the time, as
    a row counter does.
    """
    if by_column is None:
        return by_time
    if by_time is not None:
        one = by_column.samples[by_time.rows]
        other = by_time.samples
    elif log.held:
        # The samples just before and after.
        one = by_column.samples
        other = np.clip(by_column.samples + np.array([-1, 1]), 0, len(log.q) - 1)
    else:
        return by_column
    if any(
        np.abs(_pooled(q, one) - _pooled(q, other)).max(initial=0.0) > LOGS.agree for q in log.q.T
    ):
        time = (
            "its time"
            if by_time is not None
            else "the motion of the arm, which does not hold still there"
        )
        raise MeasurementError(
            f"{table.path.name}: joints from {log.sheet.path.name} {by_column.words} "
            f"contradict {time}; expected one pose "
            "per row: ignore the column if it only counts rows, or correct the times"
        )
    return by_column


def _as_keys(series: pl.Series) -> list[str]:
    """Return cells as text, numbers in normal form."""
    import polars as pl

    text = series.cast(pl.String).str.strip_chars().fill_null("")
    number = text.cast(pl.Float64, strict=False)
    return [
        repr(value) if value is not None else word for word, value in zip(text, number, strict=True)
    ]


def _places(keys: Sequence[str], q: np.ndarray) -> dict[str, tuple[int, int]] | None:
    """Return first and last sample of each key; None if keys do not identify poses."""
    found: dict[str, tuple[int, int]] = {}
    for i, key in enumerate(keys):
        first, last = found.get(key, (i, i - 1))
        if last != i - 1 or not key:
            return None
        found[key] = first, i
    if any(
        np.ptp(q[first : last + 1], axis=0).max() > LOGS.agree for first, last in found.values()
    ):
        return None
    return found


def _by_time(log: Log, time: np.ndarray | None) -> _Pairs | None:
    """Pair rows with the pose held at their time, if most rows have one."""
    theirs = log.values.get("time")
    if time is None or theirs is None or len(theirs) < 2:
        return None
    if log.held is None:
        line = int(np.flatnonzero(np.diff(theirs) <= 0)[0])
        raise MeasurementError(
            f"{log.sheet.path.name}: time does not increase in row {line + 2}; expected a "
            "log in order, one sample per row"
        )
    which = log.held.at(theirs, time)
    rows = np.flatnonzero(which >= 0)
    if len(rows) <= (0.0 if is_log(time) else LOGS.between) * len(time):
        return None
    return _Pairs(rows, log.held.samples[which[rows]], "by time, while the pose is held still")


def _by_order(log: Log, count: int) -> _Pairs | None:
    """Pair rows in order with the log's rows, or with its held poses, if there are as many."""
    every = np.arange(count)
    if len(log.q) == count:
        return _Pairs(every, np.column_stack([every, every]), "by order, row by row")
    if log.held is None or len(log.held) != count:
        return None
    return _Pairs(every, log.held.samples, "by order, pose by pose")


def _advice(table: Sheet, log: Log, count: int, *, has_times: bool) -> str:
    source = table.path.name
    other = log.sheet.path.name
    what = f"{count} rows and {len(log.q)} samples of joints"
    if "time" in log.values and has_times:
        what += (
            f" ({len(log.held or ())} poses held still, at most times of the table none; do "
            "the clocks differ?)"
        )
    order = (
        " (several tables share it)"
        if log.is_shared
        else ", or a sample for each row in the same order"
    )
    return (
        f"{source}: it is not known which joints of {other} belong to which row: {what}; "
        "expected a column that both "
        f"files have and that numbers the poses, or times of one clock in both (column time){order}"
    )
