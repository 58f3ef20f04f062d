"""Wrong readings among those of a pose: judged by the others, and by the model where these fail.

A fit uses the means of poses, in which a wrong reading would spoil the sound ones. Readings are
therefore screened before they are averaged. Of three readings or more, those are sound that agree
with most of the others, to within the scatter that all poses show
(:mod:`pincal.identify.visit_scatter`). Of two that disagree, or where no two agree, the model
decides which one is wrong, or nothing does and both are kept. Readings of a pose that was read once
are judged by the fit alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from pincal.identify.fit import ModelFit
from pincal.identify.visit_numbers import VISITS
from pincal.identify.visit_scatter import Arrivals, arrivals_of, levers_of
from pincal.measure.measurements import Measurements
from pincal.measure.poses import (
    SCATTER,
    are_distinct,
    numbers_of_copies,
    replicate_groups,
    without_copies,
)
from pincal.sensors.sensor import Sensor
from pincal.thresholds import Count

# Rounds in which the centre of a pose and its sound readings are found in turn.
_ROUNDS: Count = 3


def wrong_readings(fit: ModelFit, tables: Mapping[str, Measurements]) -> dict[str, np.ndarray]:
    """Return the wrong readings among those of poses that were read more than once, for each table
    a mask, shape (N,).

    Args:
        fit: a calibration, one station for each table in this order.
        tables: rows as measured; others than the fitted ones are judged alike.
    """
    found = {}
    for k, (name, table) in enumerate(tables.items()):
        found[name] = _wrong_at(fit, k, table)
    return found


def without_wrong(
    tables: Mapping[str, Measurements], wrong: Mapping[str, np.ndarray]
) -> dict[str, Measurements]:
    """Return tables without the rows of masks, shape (N,) each."""
    return {
        name: table.select(~wrong[name]) if wrong[name].any() else table
        for name, table in tables.items()
    }


@dataclass(frozen=True)
class _Readings:
    """Readings of poses with several of them.

    Attributes:
        left: shape (n, m), reading minus prediction.
        levers: shape (n, m, J).
        pose: shape (n,), number of the pose and target of each, from 0 without gaps.
        scatter: of readings between visits.
        misfit: shape (m,), standard deviation of the means of poses about the model.
        limit: of the square of a sound deviation.
    """

    left: np.ndarray
    levers: np.ndarray
    pose: np.ndarray
    scatter: Arrivals
    misfit: np.ndarray
    limit: float

    def wrong(self) -> np.ndarray:
        """Return which readings are wrong, shape (n,)."""
        apart = self.left - _medians(self.left, self.pose)[self.pose]
        sound = self.scatter.distances(apart, self.levers) < self.limit
        for _ in range(_ROUNDS):
            before = sound
            sound = self._near_the_others(sound)
            if np.array_equal(sound, before):
                break
        count = np.bincount(self.pose)
        agree = np.bincount(self.pose, sound)
        by_others = (count >= 3) & (agree >= 2) & (agree > count - agree)
        wrong = by_others[self.pose] & ~sound
        for pose in np.flatnonzero((agree < count) & ~by_others):
            rows = np.flatnonzero(self.pose == pose)
            wrong[rows] = self._by_model(rows)
        return np.asarray(wrong)

    def _near_the_others(self, sound: np.ndarray) -> np.ndarray:
        """Return which readings are near the mean of the other sound ones of their pose, shape
        (n,).
        """
        weight = sound.astype(float)
        mass = np.bincount(self.pose, weight)[self.pose] - weight
        sums = np.stack(
            [np.bincount(self.pose, weight * x)[self.pose] - weight * x for x in self.left.T],
            axis=1,
        )
        others = np.where(mass > 0.0, mass, np.inf)
        apart = self.left - sums / np.maximum(mass, 1.0)[:, None]
        # Without another sound reading there is nothing to compare with.
        near = self.scatter.distances(apart, self.levers) < self.limit * (1.0 + 1.0 / others)
        return np.asarray(near & (mass > 0.0))

    def _by_model(self, rows: np.ndarray) -> np.ndarray:
        """Return which readings of a pose are wrong by the model, shape (n,); none if it does not
        decide.
        """
        covariance = self.scatter.covariance(self.levers[rows]) + np.diag(self.misfit**2)
        left = self.left[rows]
        squares = np.sum(left * np.linalg.solve(covariance, left[:, :, None])[:, :, 0], axis=1)
        best = int(np.argmin(squares))
        apart = self.scatter.distances(left - left[best], self.levers[rows]) > 2.0 * self.limit
        is_decided = np.all(squares[apart] > squares[best] + VISITS.decided)
        return np.asarray(apart & is_decided)


def _wrong_at(fit: ModelFit, k: int, table: Measurements) -> np.ndarray:
    """Return which readings of a table at the k-th station are wrong, shape (N,)."""
    nothing = np.zeros(len(table), bool)
    station, places, blocks = list(fit.stations)[k]
    sensor = station.sensor
    if not len(table) or not _has_single_readings(table, sensor):
        return nothing
    group = replicate_groups([table], within=SCATTER)[0]
    rows = _repeated(table, group)
    pose = np.unique(group[rows], return_inverse=True)[1].ravel()
    degrees = len(rows) - int(pose.max() + 1) if len(rows) else 0
    if degrees < VISITS.fewest:
        return nothing
    at = fit.readings(table.select(rows), station=station.name)
    values = fit.values[places]
    left = at.residuals(values).T
    levers = levers_of(at, values)
    count = np.bincount(pose)[pose]
    least = np.repeat([block.rounding for block in sensor.blocks], station.block_sizes)
    # In two readings the mean is the median, which halves the deviations of both.
    share = 1.0 - 1.0 / count
    apart = left - _medians(left, pose)[pose]
    scatter = arrivals_of(apart, levers, share, blocks=station.block_rows, least=least)
    m = left.shape[1]
    limit = m * float(fdtri(m, m * degrees, 1.0 - VISITS.wrong / len(rows)))
    misfit = np.repeat(fit.solution.estimated[blocks], station.block_sizes)
    wrong = _Readings(left, levers, pose, scatter, misfit, limit).wrong()
    if wrong.mean() >= VISITS.too_many:
        return nothing
    copies = numbers_of_copies(table, group)
    return np.isin(copies, copies[rows[wrong]])


def _has_single_readings(table: Measurements, sensor: Sensor) -> bool:
    """Return whether rows are single readings of held poses, one independent of the other."""
    is_of_arm = not sensor.is_of_joints and not sensor.is_whole
    return table.readings_per_row is None and not table.is_of_motion and is_of_arm


def _repeated(table: Measurements, group: np.ndarray) -> np.ndarray:
    """Return the rows of poses that were read several times, copies not counted, of rows whose pose
    has a number, shape (N,).
    """
    if are_distinct(group):
        return np.zeros(0, int)
    kept = without_copies(table, group)
    several = np.bincount(group[kept], minlength=group.max() + 1) > 1
    return np.asarray(kept[several[group[kept]]])


def _medians(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the median of each component over each group, shape (groups, m)."""
    order = np.argsort(group, kind="stable")
    cuts = np.flatnonzero(np.diff(group[order])) + 1
    return np.array([np.median(rows, axis=0) for rows in np.split(values[order], cuts)])
