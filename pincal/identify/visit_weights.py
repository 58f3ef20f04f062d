r"""How readings scatter: within a stop of the robot, between stops at a pose, and the poses about
the model.

With n readings in v stops behind the mean of a pose, its variance about the model is

.. math:: V = \frac{\sigma_r^2}{n} + \frac{\sigma_a^2}{v} + \tau^2 ,

of the readings (the instrument), of the stops (the arrival of the drives) and of what the model
lacks at a pose. The first two follow from moments of repeated readings, whatever the model (Searle,
Casella and McCulloch 1992, Variance Components, section 3.6); the third from the residuals of a
fit, which they exceed (Paule and Mandel 1982, J. Res. NBS 87, 377-385). Means of poses are weighted
by V, relative to a single reading in a single stop: so the noise of a fit is that of one visit,
however often poses were visited.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtri

from pincal.identify.fit import ModelFit
from pincal.identify.station import Station
from pincal.identify.stop_numbers import STOPS
from pincal.identify.stop_scatter import scatter_of_stops
from pincal.measure.measurements import Measurements
from pincal.measure.stops import Plan, plan_of
from pincal.thresholds import Scale

# Relative change of weights below which they stay as they are.
_SAME: Scale = 0.01


@dataclass(frozen=True)
class VarianceComponent:
    """One component of the variance of a reading.

    Attributes:
        sigma_m: standard deviation of one coordinate [m].
        degrees: effective degrees of freedom; 0 where nothing was repeated that could show it.
    """

    sigma_m: float
    degrees: float

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the interval of the standard deviation by chi-square [m]; (0, inf) without degrees
        of freedom.
        """
        if self.degrees < 1.0:
            return 0.0, np.inf
        squares = self.degrees * self.sigma_m**2
        upper, lower = (
            float(chdtri(self.degrees, p)) for p in (0.5 * (1.0 - level), 0.5 * (1.0 + level))
        )
        return float(np.sqrt(squares / upper)), float(np.sqrt(squares / max(lower, 1e-300)))


@dataclass(frozen=True)
class ScatterByLevel:
    """The scatter of the readings of a station, level by level, of its first block of readings.

    Attributes:
        reading: between readings of a target within a stop: the instrument.
        stop: between stops at a pose, apart from it: the arrival of the drives. Where no stop has
            repeated readings it includes the instrument.
        model: between poses, about the model, apart from both.
    """

    reading: VarianceComponent
    stop: VarianceComponent
    model: VarianceComponent

    def __str__(self) -> str:
        levels = (
            ("readings within a stop", self.reading),
            ("stops at a pose" if self.reading.degrees else "visits of a pose", self.stop),
            ("poses about the model", self.model),
        )
        return ", ".join(f"{words} {1e3 * of.sigma_m:.4f} mm" for words, of in levels if of.degrees)

    def is_beyond(self, declared: float | None) -> bool:
        """Return whether a reading in a stop of its own is known to scatter by more than a declared
        noise [m], if any.
        """
        if not self.stop.degrees:
            return False
        least, _ = VarianceComponent(self.of_visit_m, self.stop.degrees).interval(STOPS.agrees)
        return declared is None or least > declared

    @property
    def of_visit_m(self) -> float:
        """Standard deviation of one coordinate of a reading in a stop of its own, apart from what
        the model lacks [m].
        """
        return float(np.hypot(self.reading.sigma_m, self.stop.sigma_m))

    def variance(self, readings: np.ndarray, stops: np.ndarray) -> np.ndarray:
        """Return the variance of one coordinate of means of so many readings in so many stops
        [m^2].
        """
        of_stops = self.stop.sigma_m**2 / stops
        return np.asarray(self.reading.sigma_m**2 / readings + of_stops + self.model.sigma_m**2)


def with_visits(fit: ModelFit, tables: Mapping[str, Measurements]) -> ModelFit:
    """Return a fit, not refitted, whose means of poses are weighted by the visits behind them;
    itself if none changes.

    ``tables`` are the readings of each station as they were measured, in the order of the stations.
    """
    stations = list[Station]()
    of_visits = np.zeros(len(fit.problem.blocks))
    parts = zip(fit.stations, tables.values(), strict=True)
    for k, ((station, _, blocks), table) in enumerate(parts):
        plan = plan_of(table)
        found = None
        if weighs_visits(station, plan):
            as_read = fit.readings(table, station=station.name)
            found = scatter_by_level(fit.alone[k], as_read, plan)
        if found is None:
            stations.append(station)
            continue
        stations.append(_weighted(station, found, plan, table.sigma))
        if table.sigma is None and found.is_beyond(fit.noise.declared[blocks.start]):
            of_visits[blocks.start] = found.of_visit_m
    is_weighted = any(a is not b for a, b in zip(stations, fit.problem.stations, strict=True))
    is_too_quiet = bool(np.any(of_visits > (1.0 + _SAME) * fit.solution.sigma))
    if not is_weighted and not is_too_quiet:
        return fit
    noise = replace(fit.noise, least=tuple(of_visits.tolist()))
    return replace(fit.over(stations), noise=noise)


def weighs_visits(station: Station, plan: Plan) -> bool:
    """Return whether rows of a station that are means of repeated readings are weighted by these.

    Contacts, and readings that are judged by the mean of all of them, are not.
    """
    sensor = station.sensor
    is_of_readings = sensor.reads_place and not sensor.is_of_joints and not sensor.is_whole
    return plan.is_repeated and is_of_readings and len(station) == int(plan.thing.max()) + 1


def scatter_by_level(alone: ModelFit, as_read: Station, plan: Plan) -> ScatterByLevel | None:
    """Return how the readings of a station scatter; None where none was repeated, or readings are
    not of positions.

    Args:
        alone: the fit of this station alone, whose rows are the means of poses.
        as_read: its calibrated model over the single readings, shape (N,) rows.
        plan: how these came about.
    """
    station = alone.station
    if not weighs_visits(station, plan):
        return None
    rows = station.block_rows[0]
    counted = alone.solution.weights > 0.0
    sound = np.flatnonzero(counted[plan.thing])
    found = scatter_of_stops(as_read.select(sound), alone.values, plan.select(sound))
    reading = VarianceComponent(float(np.sqrt(found.within[0])), float(found.within_degrees[0]))
    reading = _as_declared(reading, alone.noise.declared[0])
    # Where no stop has repeats, its component is that of a reading, instrument included.
    stop = VarianceComponent(float(np.sqrt(found.between[0])), float(found.between_degrees[0]))
    readings, stops = _counts(plan)
    pure = reading.sigma_m**2 / readings + stop.sigma_m**2 / stops
    squares = np.sum(station.residuals(alone.values)[rows][:, counted] ** 2, axis=0)
    size = rows.stop - rows.start
    degrees = float(max(size * np.count_nonzero(counted) - alone.solution.effective, 1.0))
    left = _beyond(squares, pure[counted], degrees)
    return ScatterByLevel(reading, stop, VarianceComponent(float(np.sqrt(left)), degrees))


def _as_declared(reading: VarianceComponent, declared: float | None) -> VarianceComponent:
    """Return the scatter within stops, as it was declared where both agree."""
    if declared is None or not reading.degrees:
        return reading
    low, high = reading.interval(STOPS.agrees)
    return replace(reading, sigma_m=declared) if low <= declared <= high else reading


def _weighted(
    station: Station, scatter: ScatterByLevel, plan: Plan, sigma: np.ndarray | None
) -> Station:
    """Return the station with rows weighted by the visits behind them; itself if they are so
    already.
    """
    readings, stops = _counts(plan)
    one = np.ones(1)
    weights = np.sqrt(scatter.variance(one, one) / scatter.variance(readings, stops))
    if sigma is not None:
        # Declared row by row: the mean of n readings has been given its own.
        weights = weights * station.weights / np.sqrt(readings)
    is_same = np.max(np.abs(weights / station.weights - 1.0)) < _SAME
    return station if is_same else replace(station, weights=weights)


def _counts(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of readings and of stops of each pose and target, shape (groups,)."""
    pairs = np.unique(np.column_stack([plan.thing, plan.stop]), axis=0)
    return np.bincount(plan.thing), np.bincount(pairs[:, 0])


def _beyond(squares: np.ndarray, known: np.ndarray, degrees: float) -> float:
    """Return the variance beyond a known one that makes squares of rows, shape (N,), add up to
    their degrees of freedom.
    """

    def excess(variance: float) -> float:
        return float(np.sum(squares / (variance + known))) - degrees

    largest = float(np.sum(squares)) / degrees
    if np.any(known <= 0.0):
        known = np.maximum(known, 1e-12 * largest)
    if largest <= 0.0 or excess(0.0) <= 0.0:
        return 0.0
    return float(brentq(excess, 0.0, largest, rtol=1e-6))
