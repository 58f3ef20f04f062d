"""Regions of joint space that are left out, predicted by geometry and elasticity, with the names
that a search found, and with what has no name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pincal.discover.decisions import standard_errors
from pincal.discover.levers import missing_compliances
from pincal.discover.remainder_numbers import REMAINDER
from pincal.discover.score_numbers import TESTING
from pincal.discover.steps import History
from pincal.identify.calibrate import Tolerance, refit, reweighted_by_order, with_bearings
from pincal.identify.dependence import placed_at_mean
from pincal.identify.fit import ModelFit
from pincal.identify.folds import left_out_residuals
from pincal.thresholds import Scale
from pincal.validate.accuracy import pose_error_sizes

# Difference of two mean errors that is rounding [mm].
_ROUNDING: Scale = 1e-9


@dataclass(frozen=True)
class LeftOutRegions:
    """Mean errors of regions of joint space, each predicted by fits of the others [mm].

    Attributes:
        rows: shape (R,), number of rows of each region.
        plain: shape (R,), by geometry and elasticity, as ``pincal calibrate`` fits them.
        before: shape (R,), with the names that were found.
        after: shape (R,), with the remainder as well.
    """

    rows: np.ndarray
    plain: np.ndarray
    before: np.ndarray
    after: np.ndarray

    @property
    def predicts(self) -> bool:
        """Whether all regions together are predicted better with the remainder."""
        return standard_errors(self.rows * (self.before - self.after)) > TESTING.predicts

    @property
    def is_nowhere_worse(self) -> bool:
        """Whether no region is predicted worse with the remainder than by geometry and elasticity
        alone.
        """
        return bool(np.all(self.after <= self.plain + _ROUNDING))

    @property
    def mean(self) -> float:
        """Mean error of all rows with the remainder [mm]."""
        return float(np.average(self.after, weights=self.rows))


@dataclass(frozen=True, eq=False)
class RegionJudge:
    """Errors of regions that are left out, by fits of the others.

    Attributes:
        trail: the history of names.
        fold: shape (N,), the region of each row.
    """

    trail: History
    fold: np.ndarray

    def select(self, rows: np.ndarray) -> RegionJudge:
        """Return the same of some rows, fits not repeated."""
        first, final = (fit.select(rows) for fit in (self.trail.first, self.trail.final))
        return RegionJudge(replace(self.trail, first=first, fit=final), self.fold[rows])

    @cached_property
    def without(self) -> np.ndarray:
        """Errors without a remainder, as calibrated and with the names, shape (2, N) [mm]."""
        fits = as_calibrated(self.trail), self.trail.final
        return np.array([errors_left_out(fit, self.fold) for fit in fits])

    @cached_property
    def rows(self) -> list[np.ndarray]:
        """The rows of each region that count, shape (N,) each; empty where no error is known.

        A region of few rows, which have no mean worth the name, is one with its neighbour.
        """
        known = np.isfinite(self.without).all(axis=0)
        known &= self.trail.final.solution.weights > 0.0
        region = joined_regions(
            self.trail.final.problem.conditions.q[known], self.fold[known], REMAINDER.region
        )
        of_row = np.full(len(known), -1)
        of_row[known] = region
        return [of_row == k for k in np.unique(region)]

    @property
    def centres(self) -> np.ndarray:
        """Mean joint positions of each region, shape (R, n)."""
        q = self.trail.final.problem.conditions.q
        return np.array([q[rows].mean(axis=0) for rows in self.rows])

    def regions(self, after: ModelFit) -> LeftOutRegions | None:
        """Return the errors with the remainder of a fit; None where no error is known."""
        errors = np.vstack([self.without, errors_left_out(after, self.fold)])
        if not self.rows or not np.isfinite(errors[:, np.any(self.rows, axis=0)]).all():
            return None
        plain, before, last = np.array([errors[:, rows].mean(axis=1) for rows in self.rows]).T
        counts = np.array([np.count_nonzero(rows) for rows in self.rows])
        return LeftOutRegions(counts, plain, before, last)


def joined_regions(q: np.ndarray, region: np.ndarray, least: int) -> np.ndarray:
    """Return the region of each row, shape (N,), the smallest joined to the one whose mean joint
    positions are nearest until each has at least so many rows, or is the only one.

    Args:
        q: shape (N, n), joint positions.
        region: shape (N,), regions to begin with.
        least: number of rows.
    """
    region = region.copy()
    while True:
        names, counts = np.unique(region, return_counts=True)
        if len(names) < 2 or counts.min() >= least:
            return region
        smallest = names[np.argmin(counts)]
        others = names[names != smallest]
        centres = np.array([q[region == k].mean(axis=0) for k in others])
        away = np.linalg.norm(centres - q[region == smallest].mean(axis=0), axis=1)
        region[region == smallest] = others[np.argmin(away)]


def as_calibrated(trail: History) -> ModelFit:
    """Return the fit of geometry and elasticity alone, as ``pincal calibrate`` makes it of the same
    rows, in the moment frame of the search.
    """
    first = trail.first
    effects = [*first.options.effects, *missing_compliances(first)]
    frame = trail.final.problem.chain.moment_frame
    fit = refit(first, effects, moment_frame=frame, start={}, until=Tolerance.CLOSE)
    found = with_bearings(fit)
    return reweighted_by_order(found) if first.options.serial else found


def errors_left_out(fit: ModelFit, fold: np.ndarray) -> np.ndarray:
    """Return the error of each row by the fit without its fold, shape (N,) [mm]; nan of readings
    that have none.
    """
    fit = placed_at_mean(fit)
    (by_station,) = left_out_residuals(fit, fit.solution, [fold])
    found = np.full(len(fold), np.nan)
    for (station, places, _), rows, residuals in zip(
        fit.stations, fit.problem.rows, by_station, strict=True
    ):
        sizes = pose_error_sizes(station, fit.values[places], residuals=residuals)
        if "mm" in sizes:
            found[rows] = sizes["mm"]
    return found
