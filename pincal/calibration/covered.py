"""What a calibration's rows cover: the range beyond which nobody has checked the model, and the day they were measured on.

An effect that follows temperature, time or a move that other rows did not record stands where the column's mean over the
calibration's rows puts it, and by as much as it varied there, a prediction is unsure. Directions of approach and commanded
positions are another matter: they are not the day's but each pose's own, the robot's part can't be told without them, and
rows that lack them are refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pincal.identify.criteria import CHANGES
from pincal.io.arrays import ArrayShape, Matrix, Numbers, Record
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, into_range, recorded_variable
from pincal.model.effect import Curve, Effect
from pincal.model.model import Model
from pincal.parameters import Estimate
from pincal.robot.robot import Robot

# What still counts as covered beyond the training rows: this part of their range, and this much [rad, m or kg].
_MARGIN_PART, _MARGIN = 0.02, 1e-3
# Points of each piece of a curve at which it is asked whether the rows told it.
_POINTS = 4
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


class CurveGap(NamedTuple):
    """A range in which the training rows left a curve of the model open, and across which it is interpolated.

    Attributes:
        effect, joint: the curve.
        variable: what it follows: a joint's name, "time", "temperature" or "payload".
        rows: how many rows lie there.
        lower, upper: where it begins and ends.
    """

    effect: str
    joint: str
    variable: str
    rows: int
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
        q, payload, days = conditions.q, conditions.payload, dict[str, tuple[float, float]]()
        for name in OF_THE_DAY:
            if (x := conditions.column(name)) is not None:
                # Moves, of all joints, go one way as often as the other.
                is_move = name == "move"
                days[name] = 0.0 if is_move else float(np.mean(x)), _rms(x) if is_move else float(np.std(x))
        return cls(np.column_stack([q.min(axis=0), q.max(axis=0)]), np.array([payload.min(), payload.max()]), days)

    def over(self, other: Covered) -> Covered:
        """Return what rows of both cover; a column that does not vary on the second day tells nothing of it."""
        spans = [np.stack([one, two]) for one, two in ((self.q, other.q), (self.payload, other.payload))]
        q, payload = (np.stack([both[..., 0].min(axis=0), both[..., 1].max(axis=0)], axis=-1) for both in spans)
        days = dict(self.days)
        for name, (mean, spread) in other.days.items():
            if name not in days:
                days[name] = mean, spread
            elif spread > 0.0:
                means, spreads = zip(days[name], (mean, spread), strict=True)
                days[name] = float(np.mean(means)), float(np.hypot(_rms(np.array(spreads)), np.std(means)))
        return Covered(q, payload, days)

    def carries(self, payload: np.ndarray) -> np.ndarray:
        """Return which payloads [kg] lie within those of the training rows, shape (N,)."""
        return ~_beyond(payload, *self.payload)

    def outside(self, robot: Robot, conditions: Conditions) -> list[Outside]:
        """Return, row by row, what lies beyond; a joint that turns is at the same place after a turn."""
        turns = np.array([kind != "prismatic" for kind in robot.joint_types])
        at = np.where(turns, into_range(conditions.q, *self.q.T), conditions.q)
        values = np.column_stack([conditions.q, conditions.payload])
        lower, upper = np.vstack([self.q, self.payload]).T
        beyond = _beyond(np.column_stack([at, conditions.payload]), lower, upper)
        named = (*robot.joint_names, "payload")
        return [
            Outside(int(i), named[j], float(values[i, j]), float(lower[j]), float(upper[j])) for i, j in np.argwhere(beyond)
        ]


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

    def gaps(self, chain: Chain, estimate: Estimate) -> np.ndarray:
        """Return where in its range the training rows left it open, shape (G, 2).

        They told less than three quarters of its variance there; its mean, which is the joint offset's, apart.
        """
        effect, members = self.effect, self.effect.parameters(chain)
        if not isinstance(effect, Curve) or (belief := effect.belief(members)) is None:
            return np.zeros((0, 2))
        x = np.linspace(*self.span, _POINTS * effect.resolution + 1)
        basis = effect.basis(x)
        basis = basis - basis.mean(axis=1, keepdims=True)
        C = estimate.take([member.name for member in members]).dense_covariance()
        known, believed = (np.sum(basis * (part @ basis), axis=0) for part in (C, np.linalg.inv(belief)))
        is_open = np.concatenate([[False], known > CHANGES.curve_seen**2 * believed, [False]])
        edges = np.flatnonzero(is_open[1:] != is_open[:-1]).reshape(-1, 2)
        return np.asarray(x[np.minimum(edges, len(x) - 1)])

    def told(self, chain: Chain, estimate: Estimate) -> np.ndarray:
        """Return the rows at which the training rows determined it, shape (N,)."""
        return ~self.beyond & ~self.rows_in(self.gaps(chain, estimate)).any(axis=0)

    def rows_in(self, gaps: np.ndarray) -> np.ndarray:
        """Return which rows lie in which of G gaps, shape (G, N)."""
        return (self.x >= gaps[:, :1]) & (self.x <= gaps[:, 1:])


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


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def of_the_day(effect: Effect) -> tuple[str, ...]:
    """Return the columns of the day that an effect needs."""
    return tuple(column for column in effect.needs if column in OF_THE_DAY)
