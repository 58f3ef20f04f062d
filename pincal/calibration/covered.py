"""The coverage of a calibration's rows: the range within which the model is validated, and the
conditions of the day.

Where other rows lack temperature, time or move, an effect of it is evaluated at the column's mean
over the calibration's rows, and the prediction is uncertain by its variation there. Directions of
approach and commanded positions belong to each pose, not to the day; rows that lack them are
refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pincal.calibration.calibration_numbers import COVERAGE
from pincal.calibration.change_numbers import CHANGES
from pincal.io.arrays import ArrayShape, Matrix, Numbers, Record
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, into_range, recorded_variable
from pincal.model.effect import Curve, Effect
from pincal.model.model import Model
from pincal.parameters import Estimate
from pincal.recorded import OF_THE_DAY, RECORDED
from pincal.robot.robot import Robot
from pincal.thresholds import Count

# Points per piece of a curve at which its uncertainty is evaluated.
_POINTS: Count = 4


class Outside(NamedTuple):
    """A value beyond the training rows: row index, joint name or "payload", the value and their
    range [rad, m or kg].
    """

    row: int
    name: str
    value: float
    lower: float
    upper: float


class OutsideCurve(NamedTuple):
    """Number of rows beyond the range, lower to upper, of a curve of a variable; there it keeps its
    end value.

    The variable is a joint's name, "time", "temperature" or "payload", and over all rows between
    lowest and highest.
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
    """Number of rows in a range, lower to upper, where the training rows do not determine a curve:
    it is interpolated.
    """

    effect: str
    joint: str
    variable: str
    rows: int
    lower: float
    upper: float


class Turned(NamedTuple):
    """Number of rows with a joint a whole turn or more outside the range of a curve, which is taken
    to be periodic.
    """

    effect: str
    joint: str
    variable: str
    rows: int


class Covered(Record, frozen=True):
    """Coverage of the training rows.

    Attributes:
        q: shape (n, 2), least and largest joint positions [rad or m].
        payload: shape (2,), least and largest payload [kg].
        days: mean and standard deviation of temperature [deg C], time [s] and moves [rad or m] over
            these rows, as far as they were recorded.
    """

    q: Annotated[Matrix, ArrayShape("joints", 2)]
    payload: Annotated[Numbers, ArrayShape(2)]
    days: Mapping[str, tuple[float, float]] = {}

    @classmethod
    def of(cls, conditions: Conditions) -> Covered:
        """Return the coverage of some rows."""
        q = conditions.q
        payload = conditions.payload
        days = dict[str, tuple[float, float]]()
        for name in OF_THE_DAY:
            if (x := conditions.column(name)) is not None:
                # Moves of all joints have mean zero.
                of_joints = RECORDED[name].of_joints
                days[name] = (
                    0.0 if of_joints else float(np.mean(x)),
                    _rms(x) if of_joints else float(np.std(x)),
                )
        return cls(
            np.column_stack([q.min(axis=0), q.max(axis=0)]),
            np.array([payload.min(), payload.max()]),
            days,
        )

    def over(self, other: Covered) -> Covered:
        """Return the coverage of the rows of both; a column that is constant on the second day is
        not counted.
        """
        spans = [
            np.stack([one, two]) for one, two in ((self.q, other.q), (self.payload, other.payload))
        ]
        q, payload = (
            np.stack([both[..., 0].min(axis=0), both[..., 1].max(axis=0)], axis=-1)
            for both in spans
        )
        days = dict(self.days)
        for name, (mean, spread) in other.days.items():
            if name not in days:
                days[name] = mean, spread
            elif spread > 0.0:
                means, spreads = zip(days[name], (mean, spread), strict=True)
                days[name] = (
                    float(np.mean(means)),
                    float(np.hypot(_rms(np.array(spreads)), np.std(means))),
                )
        return Covered(q, payload, days)

    def carries(self, payload: np.ndarray) -> np.ndarray:
        """Return which payloads [kg] lie within those of the training rows, shape (N,)."""
        return ~_beyond(payload, *self.payload)

    def outside(self, robot: Robot, conditions: Conditions) -> list[Outside]:
        """Return, row by row, values beyond the coverage; a revolute joint repeats after a turn."""
        turns = np.array([kind != "prismatic" for kind in robot.joint_types])
        at = np.where(turns, into_range(conditions.q, *self.q.T), conditions.q)
        values = np.column_stack([conditions.q, conditions.payload])
        lower, upper = np.vstack([self.q, self.payload]).T
        beyond = _beyond(np.column_stack([at, conditions.payload]), lower, upper)
        named = (*robot.joint_names, "payload")
        return [
            Outside(int(i), named[j], float(values[i, j]), float(lower[j]), float(upper[j]))
            for i, j in np.argwhere(beyond)
        ]


class SeenCurve(NamedTuple):
    """A curve of a model at some rows: its variable as recorded, and shifted by whole turns into
    its span.
    """

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
        """Return where in its range the training rows do not determine it, shape (G, 2).

        There the variance of its deviation from its mean (the mean is the joint offset's) is
        reduced by less than 3/4.
        """
        effect = self.effect
        members = self.effect.parameters(chain)
        if not isinstance(effect, Curve) or (belief := effect.belief(members)) is None:
            return np.zeros((0, 2))
        x = np.linspace(*self.span, _POINTS * effect.resolution + 1)
        basis = effect.basis(x)
        basis = basis - basis.mean(axis=1, keepdims=True)
        C = estimate.take([member.name for member in members]).dense_covariance()
        known, believed = (
            np.sum(basis * (part @ basis), axis=0) for part in (C, np.linalg.inv(belief))
        )
        is_open = np.concatenate([[False], known > CHANGES.curve_seen**2 * believed, [False]])
        edges = np.flatnonzero(is_open[1:] != is_open[:-1]).reshape(-1, 2)
        return np.asarray(x[np.minimum(edges, len(x) - 1)])

    def determined(self, chain: Chain, estimate: Estimate) -> np.ndarray:
        """Return the rows at which the training rows determined it, shape (N,)."""
        return ~self.beyond & ~self.rows_in(self.gaps(chain, estimate)).any(axis=0)

    def rows_in(self, gaps: np.ndarray) -> np.ndarray:
        """Return which rows lie in which of G gaps, shape (G, N)."""
        return (self.x >= gaps[:, :1]) & (self.x <= gaps[:, 1:])


def curves_at(model: Model, conditions: Conditions) -> Iterator[SeenCurve]:
    """Yield the curves of a model at some rows; a function of two joints once along each."""
    for effect in model.effects:
        at = effect.locus
        for variable, span in ((at.follows, at.span), (at.joint, at.own_span)):
            if span is None or variable is None or at.joint is None:
                continue
            recorded, x = (
                recorded_variable(model.chain, conditions, variable, joint=at.joint, span=s)
                for s in (None, span)
            )
            yield SeenCurve(effect, at.joint, variable, span, recorded, x)


def _beyond(x: np.ndarray, lower: ArrayLike, upper: ArrayLike) -> np.ndarray:
    low = np.asarray(lower, float)
    high = np.asarray(upper, float)
    margin = COVERAGE.margin_part * (high - low) + COVERAGE.margin
    return np.asarray((x < low - margin) | (x > high + margin))


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def of_the_day(effect: Effect) -> tuple[str, ...]:
    """Return the columns that describe the day that an effect needs."""
    return tuple(column for column in effect.needs if column in OF_THE_DAY)
