"""What a calibration's rows cover, and what lies beyond it, where nobody has checked the model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pincal.calibration.day import pooled, recorded_days
from pincal.model.conditions import Conditions, into_range, recorded_variable
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.robot.robot import Robot

# What still counts as covered beyond the training rows: this part of their range, and this much [rad, m or kg].
_MARGIN_PART, _MARGIN = 0.02, 1e-3


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


@dataclass(frozen=True)
class Covered:
    """What the training rows cover.

    Attributes:
        q: shape (n, 2), least and largest joint positions [rad or m].
        payload: shape (2,), least and largest payload [kg].
        days: mean and standard deviation of temperature [deg C] and time [s] over these rows, as far as they were recorded.
    """

    q: np.ndarray
    payload: np.ndarray
    days: Mapping[str, tuple[float, float]] = field(default_factory=dict)

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


def outside_curves(model: Model, conditions: Conditions) -> list[OutsideCurve]:
    """Return the curves of a model that some rows ask for beyond the range in which they were seen."""
    found = []
    for curve in _curves(model, conditions):
        if curve.beyond.any():
            asked = float(curve.x.min()), float(curve.x.max())
            found.append(
                OutsideCurve(curve.effect.name, curve.joint, curve.variable, int(curve.beyond.sum()), *asked, *curve.span)
            )
    return found


def turned_curves(model: Model, conditions: Conditions) -> list[Turned]:
    """Return the curves of a model that some rows ask for a turn away from where they were seen."""
    found = []
    for curve in _curves(model, conditions):
        rows = int(np.sum((curve.x != curve.recorded) & ~curve.beyond))
        if rows:
            found.append(Turned(curve.effect.name, curve.joint, curve.variable, rows))
    return found


def inside_curves(model: Model, conditions: Conditions) -> np.ndarray:
    """Return which rows ask for no curve of a model beyond the range in which it was seen, shape (N,)."""
    inside = np.ones(len(conditions), bool)
    for curve in _curves(model, conditions):
        inside &= ~curve.beyond
    return inside


class _Curve(NamedTuple):
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


def _curves(model: Model, conditions: Conditions) -> Iterator[_Curve]:
    """Yield the curves of a model at some rows."""
    for effect in model.effects:
        at = effect.locus
        if at.span is None or at.follows is None or at.joint is None:
            continue
        spans = (None, at.span)
        recorded, x = (recorded_variable(model.chain, conditions, at.follows, joint=at.joint, span=s) for s in spans)
        yield _Curve(effect, at.joint, at.follows, at.span, recorded, x)


def _beyond(x: np.ndarray, lower: ArrayLike, upper: ArrayLike) -> np.ndarray:
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    margin = _MARGIN_PART * (high - low) + _MARGIN
    return np.asarray((x < low - margin) | (x > high + margin))
