"""What a calibration's rows cover: the range beyond which nobody has checked the model, and the day they were measured on.

An effect that follows temperature, time or a move that other rows did not record stands where the column's mean over the
calibration's rows puts it, and by as much as it varied there, a prediction is unsure. Directions of approach and commanded
positions are another matter: they are not the day's but each pose's own, the robot's part can't be told without them, and
rows that lack them are refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pincal.io.arrays import ArrayShape, Matrix, Numbers, Record
from pincal.measure.measurements import Measurements
from pincal.model.conditions import Conditions, into_range, recorded_variable
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.robot.robot import Robot
from pincal.units import format_readable

# What still counts as covered beyond the training rows: this part of their range, and this much [rad, m or kg].
_MARGIN_PART, _MARGIN = 0.02, 1e-3
# Mean and standard deviation of columns over the rows of a calibration, by their names.
Days = Mapping[str, tuple[float, float]]
_Rows = TypeVar("_Rows", Measurements, Conditions)
# Columns that tell the day, not the pose.
OF_THE_DAY = ("temperature", "time", "move")


class Outside(NamedTuple):
    """A value beyond the training rows: row index, joint name or "payload", the value and their range [rad, m or kg]."""

    row: int
    name: str
    value: float
    lower: float
    upper: float


class OutsideCurve(NamedTuple):
    """Rows beyond the range in which a curve of the model was seen; there it keeps its end value.

    Attributes:
        effect, joint: the curve.
        variable: what it follows: a joint's name, "time", "temperature" or "payload".
        rows: how many rows lie beyond.
        lowest, highest: of the variable over all rows.
        lower, upper: the range that was seen.
    """

    effect: str
    joint: str
    variable: str
    rows: int
    lowest: float
    highest: float
    lower: float
    upper: float


class Turned(NamedTuple):
    """Rows with a joint a whole turn or more from where a curve of the model was seen; it is taken as if it repeated.

    Attributes:
        effect, joint: the curve.
        variable: the joint that it follows.
        rows: how many rows.
    """

    effect: str
    joint: str
    variable: str
    rows: int


class Covered(Record, frozen=True):
    """What the training rows cover.

    Attributes:
        q: shape (n, 2), least and largest joint positions [rad or m].
        payload: shape (2,), least and largest payload [kg].
        days: mean and standard deviation of temperature [deg C], time [s] and moves [rad or m] over these rows, as far as
            they were recorded.
    """

    q: Annotated[Matrix, ArrayShape("joints", 2)]
    payload: Annotated[Numbers, ArrayShape(2)]
    days: Mapping[str, tuple[float, float]] = {}

    @classmethod
    def of(cls, conditions: Conditions) -> Covered:
        """Return what some rows cover."""
        q, payload = conditions.q, conditions.payload
        spans = np.column_stack([q.min(axis=0), q.max(axis=0)]), np.array([payload.min(), payload.max()])
        return cls(*spans, recorded_days(conditions))

    def over(self, other: Covered) -> Covered:
        """Return what rows of both cover."""
        spans = [np.stack([one, two]) for one, two in ((self.q, other.q), (self.payload, other.payload))]
        q, payload = (np.stack([both[..., 0].min(axis=0), both[..., 1].max(axis=0)], axis=-1) for both in spans)
        return Covered(q, payload, pooled(self.days, other.days))

    def carries(self, payload: np.ndarray) -> np.ndarray:
        """Return which payloads [kg] lie within those of the training rows, shape (N,)."""
        return ~_beyond(payload, *self.payload)

    def outside(self, robot: Robot, conditions: Conditions) -> list[Outside]:
        """Return, row by row, what lies beyond; a joint that turns is at the same place after a turn.

        Args:
            robot: the arm.
            conditions: the rows.
        """
        turns = np.array([kind != "prismatic" for kind in robot.joint_types])
        at = np.where(turns, into_range(conditions.q, *self.q.T), conditions.q)
        values = np.column_stack([conditions.q, conditions.payload])
        lower, upper = np.vstack([self.q, self.payload]).T
        beyond = _beyond(np.column_stack([at, conditions.payload]), lower, upper)
        named = (*robot.joint_names, "payload")
        return [
            Outside(int(i), named[j], float(values[i, j]), float(lower[j]), float(upper[j])) for i, j in np.argwhere(beyond)
        ]


def inside_curves(model: Model, conditions: Conditions) -> np.ndarray:
    """Return which rows ask for no curve of a model beyond the range in which it was seen, shape (N,)."""
    inside = np.ones(len(conditions), bool)
    for curve in curves_at(model, conditions):
        inside &= ~curve.beyond
    return inside


class SeenCurve(NamedTuple):
    """A curve of a model at some rows: the variable that it follows as recorded, and at the turn where it is taken."""

    effect: Effect
    joint: str
    variable: str
    span: tuple[float, float]
    recorded: np.ndarray
    x: np.ndarray

    @property
    def beyond(self) -> np.ndarray:
        """Which rows lie beyond its range, shape (N,)."""
        return _beyond(self.x, *self.span)


def curves_at(model: Model, conditions: Conditions) -> Iterator[SeenCurve]:
    """Yield the curves of a model at some rows."""
    for effect in model.effects:
        at = effect.locus
        if at.span is None or at.follows is None or at.joint is None:
            continue
        spans = (None, at.span)
        recorded, x = (recorded_variable(model.chain, conditions, at.follows, joint=at.joint, span=s) for s in spans)
        yield SeenCurve(effect, at.joint, at.follows, at.span, recorded, x)


def _beyond(x: np.ndarray, lower: ArrayLike, upper: ArrayLike) -> np.ndarray:
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    margin = _MARGIN_PART * (high - low) + _MARGIN
    return np.asarray((x < low - margin) | (x > high + margin))


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


def with_means(rows: _Rows, model: Model, days: Days) -> _Rows:
    """Return rows with the means of columns of the day that effects need and they lack, as far as these are known."""
    lacking = {column for effect in unrecorded(model, rows) for column in of_the_day(effect)}
    columns: dict[str, Any] = {
        name: _filled(name, days[name][0], rows.q)
        for name in sorted(lacking)
        if name in days and getattr(rows, name) is None
    }
    return replace(rows, **columns) if columns else rows


def _filled(column: str, value: float, q: np.ndarray) -> np.ndarray:
    """Return a column of the day that is the same at all rows, for joint positions of shape (N, n)."""
    return np.full(q.shape if column == "move" else len(q), value)


def unrecorded(model: Model, rows: Measurements | Conditions) -> Iterator[Effect]:
    """Yield the effects that need a column of the day that rows lack."""
    for effect in model.effects:
        if any(getattr(rows, column) is None for column in of_the_day(effect)):
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
    return f"{done}: {lacks}; that leaves {format_readable(size, 'm', '.2g')} of uncertainty, as much as it varied there"
