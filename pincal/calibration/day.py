"""What belongs to the day of a calibration, on another one: effects of time, temperature and set-up that nobody recorded.

An effect that follows such a column stands where the column's mean over the calibration's rows puts it, and by as much as it
varied there, a prediction is unsure. Directions of approach and commanded positions are another matter: they are not the
day's but each pose's own, the robot's part can't be told without them, and rows that lack them are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pincal.measure.measurements import Measurements
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.units import format_readable

# Mean and standard deviation of columns over the rows of a calibration, by their names.
Days = Mapping[str, tuple[float, float]]
# Columns that tell the day, not the pose.
OF_THE_DAY = ("temperature", "time", "move")


def recorded_days(conditions: Conditions) -> dict[str, tuple[float, float]]:
    """Return mean and standard deviation of each column of the day over some rows, as far as they have it."""
    columns = {name: conditions.column(name) for name in OF_THE_DAY}
    # Moves, of all joints, go one way as often as the other.
    return {
        name: (0.0, float(np.sqrt(np.mean(np.square(x))))) if name == "move" else (float(np.mean(x)), float(np.std(x)))
        for name, x in columns.items()
        if x is not None
    }


def pooled(one: Days, other: Days) -> dict[str, tuple[float, float]]:
    """Return what columns were on two days together; a column that does not vary on the second tells nothing of it."""
    found = dict(one)
    for name, (mean, spread) in other.items():
        if name not in found:
            found[name] = mean, spread
        elif spread > 0.0:
            means, spreads = zip(found[name], (mean, spread), strict=True)
            found[name] = float(np.mean(means)), float(np.sqrt(np.mean(np.square(spreads)) + np.var(means)))
    return found


def of_the_day(effect: Effect) -> tuple[str, ...]:
    """Return the columns of the day that an effect needs."""
    return tuple(column for column in effect.needs if column in OF_THE_DAY)


def standing_in(model: Model, days: Days, is_recorded: Callable[[str], bool]) -> dict[str, float]:
    """Return the mean of each column of the day that effects of a model need, rows lack, and a calibration knows."""
    lacking = {column for effect in model.effects for column in of_the_day(effect) if not is_recorded(column)}
    return {column: days[column][0] for column in sorted(lacking) if column in days}


def with_means(conditions: Conditions, model: Model, days: Days) -> Conditions:
    """Return conditions with the means of columns of the day that they lack, as far as they are known."""
    means = standing_in(model, days, lambda column: conditions.column(column) is not None)
    columns: dict[str, Any] = {name: _filled(name, mean, conditions.q) for name, mean in means.items()}
    return replace(conditions, **columns) if columns else conditions


def rows_with_means(rows: Measurements, model: Model, days: Days) -> Measurements:
    """Return a table with the means of columns of the day that it lacks, as far as they are known."""
    means = standing_in(model, days, lambda column: getattr(rows, column) is not None)
    columns: dict[str, Any] = {name: _filled(name, mean, rows.q) for name, mean in means.items()}
    return replace(rows, **columns) if columns else rows


def _filled(column: str, value: float, q: np.ndarray) -> np.ndarray:
    """Return a column of the day that is the same at all rows, for joint positions of shape (N, n)."""
    return np.full(q.shape if column == "move" else len(q), value)


def unrecorded(model: Model, is_recorded: Callable[[str], bool]) -> Iterator[Effect]:
    """Yield the effects that need a column of the day that rows lack."""
    for effect in model.effects:
        if any(not is_recorded(column) for column in of_the_day(effect)):
            yield effect


def varied_by(effect: Effect, model: Model, values: np.ndarray, conditions: Conditions, days: Days) -> np.ndarray:
    """Return how far the target moves, shape (N, 3) [m], as an effect goes from its mean to where it typically was.

    Args:
        effect: an effect of the model, of the day or of the set-up.
        model: the model.
        values: shape (P,), of its parameters.
        conditions: the N poses, with all columns that the model needs.
        days: mean and standard deviation of the columns of the day over the calibration's rows.
    """
    columns = [column for column in of_the_day(effect) if column in days]
    if columns:
        ends = []
        for side in (1.0, -1.0):
            at: dict[str, Any] = {
                name: _filled(name, days[name][0] + side * days[name][1], conditions.q) for name in columns
            }
            ends.append(_without_others(effect, model, values, replace(conditions, **at)))
        return np.asarray(0.5 * (ends[0] - ends[1]))
    way = _without_others(effect, model, values, conditions)
    # A shift that all poses share is the new place of the instrument.
    return np.asarray(way - way.mean(axis=0))


def _without_others(effect: Effect, model: Model, values: np.ndarray, conditions: Conditions) -> np.ndarray:
    """Return how far one effect of a model moves the target, shape (N, 3) [m]."""
    without = values.copy()
    without[model.spans[model.effects.index(effect)]] = 0.0
    ends = [model.predict(at, conditions)[:, :, 3] for at in (values, without)]
    return np.asarray(ends[0] - ends[1])


def words_of(effect: Effect, source: str, *, size: float | None, is_left_out: bool) -> str:
    """Return what is done about an effect of the day or the set-up, in words.

    Args:
        effect: the effect.
        source: what the rows are called.
        size: how far it typically moved the target [m]; None where the model's file does not tell.
        is_left_out: whether it is left out rather than taken at its mean.
    """
    name = " of ".join(filter(None, (effect.name, effect.locus.joint)))
    columns = ", ".join(of_the_day(effect))
    lacks = f"{source} has no column {columns}" if columns else "it belongs to the instrument as it stood then"
    left_out, at_mean = "of the calibration's station is left out", "is taken at its mean over the calibration's rows"
    done = f"{name} {left_out if is_left_out else at_mean}"
    if size is None:
        return f"{done}: {lacks}"
    return f"{done}: {lacks}; that leaves {format_readable(size, 'm', '.2g')} unknown, as much as it varied there"
