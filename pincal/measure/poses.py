r"""Replicates: the rows of each pose, and the table with one row per pose.

Rows are of one pose if they have the same joint positions, target, named point, payload and
direction of approach, and temperatures within 4 K, as ISO 9283 allows :math:`\pm 2` K. Times may
differ, so that drift counts as poor repeatability.

The error of the robot is common to all readings of a pose: they are one observation of the robot,
however many they are. So fits, tests and held-out sets use the means of poses. The scatter of the
readings of a pose is pure error, against which the means are judged
(:mod:`pincal.validate.lack_of_fit`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pincal.measure.measurements import Measurements
from pincal.measure.reading_numbers import SAME_POSE
from pincal.sensors.registry import known_fields
from pincal.thresholds import Count

# Bytes of joint positions whose labels are remembered, and most labels of the latest tables.
_MOST_REMEMBERED: Count = 1 << 20
_MOST_LABELS: Count = 200_000
_REMEMBERED: dict[tuple[int, tuple[int, ...], float], np.ndarray] = {}
SCATTER = SAME_POSE.settled
"""Joint positions that count as the same although drives settle differently [rad or m]."""


def by_pose(table: Measurements) -> Measurements:
    """Return a table with one row for each pose: the mean of its readings, joints and conditions.

    Readings that are equal to the last digit are copies and count once. ``readings_per_row`` counts
    the readings of each row; a table without replicates is returned unchanged.

    Example:
        >>> from pincal.measure.measurements import measurements_from_arrays
        >>> q, distance = [[0.1], [0.5], [0.1], [0.1]], [1.0, 2.0, 1.2, 1.2]
        >>> means = by_pose(measurements_from_arrays(["a"], q, distance=distance))
        >>> means.distance.tolist(), means.readings_per_row.tolist()
        ([1.1, 2.0], [2, 1])
    """
    if table.readings_per_row is not None or table.is_of_motion:
        return table
    return mean_rows(table, replicate_groups([table], within=SCATTER)[0])


def mean_rows(table: Measurements, group: np.ndarray) -> Measurements:
    """Return a table with one row for each group of rows: the mean of readings, joints and
    conditions.

    Args:
        table: the table; copies among its rows count once.
        group: shape (N,), number of each row's group; rows of one group are of one target and
            point.

    Returns:
        The means in the order of their first rows, with ``readings_per_row`` counted; the table
        itself where each row is a group.
    """
    if are_distinct(group):
        return table
    kept = without_copies(table, group)
    table = table.select(kept)
    weight = np.ones(len(kept)) if table.sigma is None else table.sigma**-2.0
    groups = _Groups.of(group[kept], weight)
    if len(groups.first) == len(kept):
        return replace(table, readings_per_row=groups.count)
    fields = known_fields()
    units = {name for name, of in fields.items() if of.is_unit}
    means = {
        name: groups.mean_direction(values) if name in units else groups.mean(values)
        for name, values in table.columns().items()
        if values.dtype.kind == "f"
    }
    if table.sigma is not None:
        means["sigma"] = groups.mass**-0.5
    rows = table.select(groups.first)
    readings: Mapping[str, np.ndarray] = {
        name: means.pop(name, array) for name, array in rows.readings.items()
    }
    others: dict[str, Any] = means
    return replace(rows, readings=readings, readings_per_row=groups.count, **others)


@dataclass(frozen=True)
class _Groups:
    """K groups of N weighted rows, in the order of their first rows.

    Attributes:
        first: shape (K,), first row of each.
        count: shape (K,), number of rows.
        number: shape (N,), group of each row.
        weight: shape (N,).
    """

    first: np.ndarray
    count: np.ndarray
    number: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, group: np.ndarray, weight: np.ndarray) -> _Groups:
        """Return the groups of rows with the same number in ``group``, shape (N,)."""
        _, first, number, count = np.unique(
            group, return_index=True, return_inverse=True, return_counts=True
        )
        in_order = np.argsort(first)
        return cls(first[in_order], count[in_order], np.argsort(in_order)[number.ravel()], weight)

    @cached_property
    def mass(self) -> np.ndarray:
        """Sum of the weights of each, shape (K,)."""
        return np.bincount(self.number, self.weight)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the means of values, shape (K, ...) for (N, ...)."""
        flat = values.reshape(len(values), -1)
        sums = np.stack(
            [np.bincount(self.number, self.weight * column) for column in flat.T], axis=1
        )
        return np.asarray((sums / self.mass[:, None]).reshape(len(self.first), *values.shape[1:]))

    def mean_direction(self, values: np.ndarray) -> np.ndarray:
        """Return the means of quaternions, of which q and -q are the same orientation, shape (K, 4)
        for (N, 4).
        """
        is_opposite = np.sum(values * values[self.first][self.number], axis=1, keepdims=True) < 0.0
        mean = self.mean(np.where(is_opposite, -values, values))
        return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True))


def without_copies(table: Measurements, group: np.ndarray) -> np.ndarray:
    """Return the rows, shape (n,), that are no copies of an earlier row of their group."""
    return np.sort(np.unique(numbers_of_copies(table, group), return_index=True)[1])


def numbers_of_copies(table: Measurements, group: np.ndarray) -> np.ndarray:
    """Return a number for each row, shape (N,), that only copies of it in its group share.

    Copies have the same readings, or the same joints where these are all that is read, as in
    sockets.
    """
    numbers = {name: a for name, a in table.columns().items() if a.dtype.kind == "f"}
    read = [numbers[name].reshape(len(group), -1) for name in table.readings if name in numbers]
    key = np.column_stack([group, *(read or [table.q])])
    return np.asarray(np.unique(key, axis=0, return_inverse=True)[1]).ravel()


def replicate_groups(
    tables: Sequence[Measurements], *, within: float = SAME_POSE.same
) -> list[np.ndarray]:
    """Return the pose and target of each row of some tables as a number.

    Each row of an arm in motion is a separate pose.

    Args:
        tables: tables of the same joints.
        within: difference of joint positions that count as the same [rad or m].

    Returns:
        For each table shape (N,), integers from 0; equal for readings of the same target, and
        point, at the same pose.

    Example:
        >>> from pincal.measure.measurements import measurements_from_arrays
        >>> q, load = [[0.1], [0.5], [0.100001], [0.1]], [0.0, 0.0, 0.0, 80.0]
        >>> table = measurements_from_arrays(["a"], q, distance=[1.0] * 4, payload=load)
        >>> replicate_groups([table])[0].tolist()
        [0, 1, 0, 2]
    """
    return _pose_numbers(tables, within, by_thing=True)


def pose_groups(tables: Sequence[Measurements], *, within: float = SCATTER) -> list[np.ndarray]:
    """Return the pose of each row of some tables as a number, whatever was read there.

    Arguments and result as for :func:`replicate_groups`: readings of several targets at one pose
    have one number.
    """
    return _pose_numbers(tables, within, by_thing=False)


def _pose_numbers(
    tables: Sequence[Measurements], within: float, *, by_thing: bool
) -> list[np.ndarray]:
    ends = np.cumsum([len(t) for t in tables])[:-1]
    keys = [same_joints(np.vstack([table.q for table in tables]), within)]
    if are_distinct(keys[0]):
        return np.split(np.arange(len(keys[0])), ends)
    named = [table.names() for table in tables]
    for name in dict.fromkeys(name for columns in named for name in columns):
        # A stop is a visit of a pose, not another pose.
        if by_thing and name != "stop":
            names = [
                columns.get(name, np.full(len(t), ""))
                for t, columns in zip(tables, named, strict=True)
            ]
            keys.append(np.unique(np.concatenate(names), return_inverse=True)[1])
    keys.append(np.round(_stacked(tables, "payload") / SAME_POSE.load).astype(int))
    if any(table.approach is not None for table in tables):
        sides = [np.zeros(t.q.shape, int) if t.approach is None else t.approach for t in tables]
        keys.append(np.unique(np.vstack(sides), axis=0, return_inverse=True)[1].ravel())
    if any(table.is_of_motion for table in tables):
        # Rows at a brief stop vibrate less than others, and their filter windows overlap.
        moves = np.concatenate([np.full(len(table), table.is_of_motion) for table in tables])
        keys.append(moves * np.arange(len(moves)))
    poses = _numbered(np.column_stack(keys))
    climate = _same_climate(_stacked(tables, "temperature"), poses)
    poses = _numbered(np.column_stack([poses, climate]))
    return np.split(poses, ends)


def count_distinct(numbers: np.ndarray) -> int:
    """Return how many numbers from 0 on occur among some, in a tenth of the time of sorting."""
    return int(np.count_nonzero(np.bincount(numbers)))


def are_distinct(numbers: np.ndarray) -> bool:
    """Return whether each number from 0 on occurs once at most."""
    return count_distinct(numbers) == len(numbers)


def _stacked(tables: Sequence[Measurements], name: str) -> np.ndarray:
    """Return a column of numbers, 0 where a table has none."""
    columns = [getattr(table, name) for table in tables]
    return np.concatenate(
        [np.zeros(len(t)) if c is None else c for t, c in zip(tables, columns, strict=True)]
    )


def _numbered(keys: np.ndarray) -> np.ndarray:
    """Return the number of each row among the distinct ones, in the order of first appearance."""
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), int)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[inverse.ravel()])


def same_joints(q: np.ndarray, within: float = SAME_POSE.same) -> np.ndarray:
    """Return a label for rows with the same joint positions, shape (N,), by connected cells of a
    grid.
    """
    if q.nbytes > _MOST_REMEMBERED:
        return _labels(q, within)
    # One calibration asks for the same rows a dozen times, of each of its stations.
    content = np.ascontiguousarray(q, float).tobytes()
    # Of 64 bits, a fifth of the time of a digest.
    key = hash(content), q.shape, within
    known = _REMEMBERED.get(key)
    if known is None:
        known = _labels(q, within).astype(np.int32)
        _REMEMBERED[key] = known
        while sum(map(len, list(_REMEMBERED.values()))) > _MOST_LABELS:
            _REMEMBERED.pop(next(iter(_REMEMBERED)), None)
    return known.astype(int)


def _labels(q: np.ndarray, within: float) -> np.ndarray:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    cells, inverse = np.unique(np.floor(q / within), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.5, p=np.inf, output_type="ndarray")
    if not len(pairs):
        # No two cells touch, as of poses at random: each is one by itself.
        return np.asarray(inverse.ravel())
    links = coo_array(
        (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells))
    )
    count, label = connected_components(links, directed=False)
    low = np.full((count, q.shape[1]), np.inf)
    high = np.full((count, q.shape[1]), -np.inf)
    np.minimum.at(low, label, cells)
    np.maximum.at(high, label, cells)
    # A slow motion connects cells over a long distance: its rows are not replicates.
    label = label[inverse.ravel()]
    is_motion = np.any(high - low > 1.5, axis=1)[label]
    return np.asarray(np.where(is_motion, count + np.arange(len(q)), label))


def _same_climate(temperature: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return the temperature window of each row within its pose, as a number."""
    window = np.zeros(len(poses), int)
    pose = -1
    lowest = 0.0
    number = 0
    for row in np.lexsort((temperature, poses)):
        if poses[row] != pose:
            pose = poses[row]
            lowest = temperature[row]
            number = 0
        elif temperature[row] - lowest > SAME_POSE.climate:
            lowest = temperature[row]
            number = number + 1
        window[row] = number
    return window
