r"""How the rows of a table came about: readings within a stop, stops at a pose, poses in a pass.

A *reading* is a row: one target, or one point of an image. A *stop* is the arm standing still once:
all its readings, repeats and targets alike, share the arrival of the drives. A *pose* is a set of
joint positions, with its payload and direction of approach, visited by one stop or more. A *pass*
is one run through poses, and a *session* a stretch of time without a long pause. With e of each
reading, a of each stop and d of each pass,

.. math:: y_{psr} = f(q_p) + m(q_p) + J_p a_{ps} + d_{pass} + e_{psr} .

So a table of n readings holds as many independent observations of the robot as it has stops, and as
many of the model as it has poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pincal.measure.measurements import Measurements
from pincal.measure.poses import (
    SCATTER,
    are_distinct,
    count_distinct,
    mean_rows,
    pose_groups,
    replicate_groups,
    without_copies,
)
from pincal.measure.reading_numbers import DIVISION


@dataclass(frozen=True, eq=False)
class Plan:
    """The plan by which N rows were measured; all arrays of shape (N,), numbers from 0.

    Attributes:
        order: indices of the rows in the order of measurement.
        pose: number of each row's pose, whatever target was read.
        thing: number of each row's pose and target, or point: equal for repeated readings.
        stop: number of the stop of the robot, in the order of measurement.
        passes: number of the run through the poses; a pass ends where a pose of it is visited
            again.
        session: number of the session; 0 without times.
    """

    order: np.ndarray
    pose: np.ndarray
    thing: np.ndarray
    stop: np.ndarray
    passes: np.ndarray
    session: np.ndarray

    def __len__(self) -> int:
        return len(self.order)

    @cached_property
    def n_poses(self) -> int:
        """Number of poses."""
        return count_distinct(self.pose)

    @cached_property
    def n_stops(self) -> int:
        """Number of stops of the robot."""
        return count_distinct(self.stop)

    @cached_property
    def is_repeated(self) -> bool:
        """Whether any reading was repeated."""
        return not are_distinct(self.thing)

    @property
    def is_revisited(self) -> bool:
        """Whether any pose was visited by more than one stop."""
        return self.n_stops > self.n_poses

    @cached_property
    def shares_stops(self) -> bool:
        """Whether several targets, or points, were read in one stop."""
        pairs = np.unique(np.column_stack([self.stop, self.thing]), axis=0)
        return len(pairs) > self.n_stops

    @cached_property
    def visit(self) -> np.ndarray:
        """The how-manieth stop at its pose each row's stop is, from 0, shape (N,)."""
        stops, first, number = np.unique(self.stop, return_index=True, return_inverse=True)
        pose = self.pose[first]
        visit = np.zeros(len(stops), int)
        seen = dict[int, int]()
        for i, at in enumerate(pose.tolist()):
            visit[i] = seen.get(at, 0)
            seen[at] = visit[i] + 1
        return np.asarray(visit[number.ravel()])

    def select(self, rows: np.ndarray) -> Plan:
        """Return the plan of some rows (mask or indices), numbers as they are."""
        index = np.arange(len(self))[rows]
        rank = np.empty(len(self), int)
        rank[self.order] = np.arange(len(self))
        return Plan(
            order=np.argsort(rank[index], kind="stable"),
            pose=self.pose[index],
            thing=self.thing[index],
            stop=self.stop[index],
            passes=self.passes[index],
            session=self.session[index],
        )


def plan_of(table: Measurements) -> Plan:
    """Return the plan by which a table was measured, from its joints, order, times and column
    ``stop``.

    Consecutive rows of one pose are one stop, unless the column ``stop`` or a pause in ``time``
    that is long enough to leave the pose and come back divides them; times in equal steps, as of a
    counter of the rows, do not.

    Example:
        >>> from pincal.measure.measurements import measurements_from_arrays
        >>> q = [[0.1], [0.1], [0.5], [0.1], [0.5]]
        >>> plan = plan_of(measurements_from_arrays(["a"], q, distance=[1.0, 1.1, 2.0, 1.0, 2.0]))
        >>> plan.stop.tolist(), plan.pose.tolist(), plan.passes.tolist()
        ([0, 0, 1, 2, 3], [0, 0, 1, 0, 1], [0, 0, 0, 1, 1])
    """
    n = len(table)
    pose = pose_groups([table], within=SCATTER)[0]
    thing = replicate_groups([table], within=SCATTER)[0]
    along = table.rows.astype(float) if table.time is None else table.time
    order = np.argsort(along, kind="stable")
    if table.is_of_motion or n < 2:
        number = np.empty(n, int)
        number[order] = np.arange(n)
        return Plan(order, pose, thing, number, np.zeros(n, int), np.zeros(n, int))
    begins = _stops_begin(table, pose[order], order)
    stop = np.empty(n, int)
    stop[order] = np.cumsum(begins) - 1
    passes = np.empty(n, int)
    passes[order] = _passes_of(pose[order], begins)
    session = np.zeros(n, int) if table.time is None else sessions_by_time(table.time)
    return Plan(order, pose, thing, stop, passes, session)


@dataclass(frozen=True, eq=False)
class StopRows:
    """A table with one row for each target, or point, read in each stop, and the single readings
    behind it.

    Attributes:
        table: the M rows: means of repeats within a stop.
        plan: of these.
        readings: the N single readings, without copies of readings at the same pose.
        of_readings: the plan of these.
        row_of: shape (N,), the row of the table to which each of them belongs.
    """

    table: Measurements
    plan: Plan
    readings: Measurements
    of_readings: Plan
    row_of: np.ndarray

    @classmethod
    def of(cls, table: Measurements) -> StopRows:
        """Return the rows of a table by stops; a table of means, or of an arm in motion, stands for
        itself.
        """
        plan = plan_of(table)
        if table.readings_per_row is not None or table.is_of_motion or not plan.is_repeated:
            return cls(table, plan, table, plan, np.arange(len(table)))
        kept = without_copies(table, plan.thing)
        readings = table.select(kept)
        plan = plan.select(kept)
        pairs = np.column_stack([plan.stop, plan.thing])
        _, first, number = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
        in_order = np.argsort(first)
        row_of = np.argsort(in_order)[number.ravel()]
        return cls(
            mean_rows(readings, row_of), plan.select(first[in_order]), readings, plan, row_of
        )

    def select(self, rows: np.ndarray) -> StopRows:
        """Return some of the rows, by index, with their readings."""
        kept = np.isin(self.row_of, rows)
        rank = np.full(len(self.table), -1)
        rank[rows] = np.arange(len(rows))
        return StopRows(
            self.table.select(rows),
            self.plan.select(rows),
            self.readings.select(kept),
            self.of_readings.select(kept),
            rank[self.row_of[kept]],
        )


def by_stop(table: Measurements) -> Measurements:
    """Return a table with one row for each target, or point, read in each stop: the mean of its
    repeats.

    ``readings_per_row`` counts these; a table without repeats in a stop is returned unchanged, and
    so is one of means.

    Example:
        >>> from pincal.measure.measurements import measurements_from_arrays
        >>> q = [[0.1], [0.1], [0.5], [0.1]]
        >>> means = by_stop(measurements_from_arrays(["a"], q, distance=[1.0, 1.2, 2.0, 1.3]))
        >>> means.distance.tolist(), means.readings_per_row.tolist()
        ([1.1, 2.0, 1.3], [2, 1, 1])
    """
    if table.readings_per_row is not None or table.is_of_motion:
        return table
    plan = plan_of(table)
    pairs = np.column_stack([plan.stop, plan.thing])
    number = np.unique(pairs, axis=0, return_inverse=True)[1].ravel()
    return mean_rows(table, number)


def _stops_begin(table: Measurements, pose: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Return which rows, in order, are the first of a stop, shape (N,)."""
    moved = np.append(True, pose[1:] != pose[:-1])
    if table.stop is not None:
        named = table.stop[order]
        return np.asarray(moved | np.append(True, named[1:] != named[:-1]))
    if table.time is None or moved[1:].all() or not moved[1:].any():
        return moved
    gaps = np.diff(table.time[order])
    usual = float(np.median(gaps[moved[1:]]))
    if usual <= 0.0 or np.allclose(gaps, usual):
        # Equal steps, as of a counter of the rows, do not tell whether the arm left.
        return moved
    return np.asarray(moved | np.append(True, gaps >= DIVISION.away * usual))


def _passes_of(pose: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Return the pass of each row, in order, shape (N,)."""
    if np.bincount(pose[begins]).max() == 1:
        # No pose is visited again.
        return np.zeros(len(pose), int)
    number = 0
    visited = set[int]()
    found = np.empty(len(pose), int)
    for i, (at, is_first) in enumerate(zip(pose.tolist(), begins.tolist(), strict=True)):
        if is_first:
            if at in visited:
                number += 1
                visited = set()
            visited.add(at)
        found[i] = number
    return found


def sessions_by_time(time: np.ndarray) -> np.ndarray:
    """Return the session of each row from its time [s], shape (N,): long pauses divide them."""
    order = np.argsort(time, kind="stable")
    gaps = np.diff(time[order], prepend=time[order[:1]])
    moved = gaps[gaps > 0.0]
    usual = float(np.median(moved)) if len(moved) else 0.0
    session = np.empty(len(time), int)
    session[order] = np.cumsum(gaps > max(DIVISION.pause * usual, DIVISION.least_pause))
    return session
