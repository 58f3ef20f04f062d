"""Rows of another day than the calibration's: what effects of temperature, time or approach do
where rows lack their column.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from pincal.calibration.covered import of_the_day
from pincal.calibration.fitted_station import FittedStation
from pincal.measure.measurements import Measurements
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect

_Rows = TypeVar("_Rows", Measurements, Conditions)


def unrecorded(station: FittedStation, rows: Measurements | Conditions) -> list[Effect]:
    """Return the effects of a station's model that need a temperature, time or move which rows
    lack.
    """
    return [
        effect
        for effect in station.model.effects
        if any(getattr(rows, column) is None for column in of_the_day(effect))
    ]


def of_its_day(station: FittedStation, rows: _Rows) -> _Rows:
    """Return rows with the calibration's means of temperature, time and moves that effects need and
    they lack.
    """
    lacking = {column for effect in unrecorded(station, rows) for column in of_the_day(effect)}
    columns = [name for name in sorted(lacking) if getattr(rows, name) is None]
    return _at_days(station, rows, columns)


def _at_days(station: FittedStation, rows: _Rows, names: list[str], side: float = 0.0) -> _Rows:
    """Return rows with known columns of the day at their means, shifted by so many standard
    deviations.
    """
    known = station.covered.days
    days = {name: known[name] for name in names if name in known}
    columns: dict[str, Any] = {
        name: np.full(rows.q.shape if name == "move" else len(rows.q), mean + side * spread)
        for name, (mean, spread) in days.items()
    }
    return replace(rows, **columns) if columns else rows


def varied_by(
    station: FittedStation, values: np.ndarray, effect: Effect, conditions: Conditions
) -> np.ndarray:
    """Return how far the target moves, shape (N, 3) [m], if the variable of an effect changes by a
    standard deviation.

    Args:
        station: where the robot was calibrated.
        values: shape (P,), of its model.
        effect: of its model.
        conditions: the N poses, with all columns that the model needs.
    """
    model = station.model
    without = values.copy()
    without[model.spans[model.effects.index(effect)]] = 0.0

    def displacement(at: Conditions) -> np.ndarray:
        ends = model.predict(values, at)[:, :, 3]
        return np.asarray(ends - model.predict(without, at)[:, :, 3])

    columns = [column for column in of_the_day(effect) if column in station.covered.days]
    if columns:
        above = displacement(_at_days(station, conditions, columns, 1.0))
        below = displacement(_at_days(station, conditions, columns, -1.0))
        return np.asarray(0.5 * (above - below))
    found = displacement(conditions)
    # A displacement common to all poses is taken up by the pose of the instrument.
    return np.asarray(found - found.mean(axis=0))
