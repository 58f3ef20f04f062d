"""What a calibration's rows cover, and what lies beyond it, where nobody has checked the model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pincal.model.conditions import Conditions, recorded_variable
from pincal.model.effect import Effect
from pincal.model.model import Model

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


@dataclass(frozen=True)
class Covered:
    """What the training rows cover: ``q``, shape (n, 2), least and largest joint positions, and ``payload``, shape (2,)."""

    q: np.ndarray
    payload: np.ndarray

    @classmethod
    def of(cls, conditions: Conditions) -> Covered:
        """Return what some rows cover."""
        q, payload = conditions.q, conditions.payload
        return cls(np.column_stack([q.min(axis=0), q.max(axis=0)]), np.array([payload.min(), payload.max()]))

    def carries(self, payload: np.ndarray) -> np.ndarray:
        """Return which payloads [kg] lie within those of the training rows, shape (N,)."""
        return ~_beyond(payload, *self.payload)

    def outside(self, names: tuple[str, ...], conditions: Conditions) -> list[Outside]:
        """Return, row by row, what lies beyond.

        Args:
            names: names of the joints.
            conditions: the rows.
        """
        values = np.column_stack([conditions.q, conditions.payload])
        lower, upper = np.vstack([self.q, self.payload]).T
        beyond = _beyond(values, lower, upper)
        named = (*names, "payload")
        return [
            Outside(int(i), named[j], float(values[i, j]), float(lower[j]), float(upper[j])) for i, j in np.argwhere(beyond)
        ]


def outside_curves(model: Model, conditions: Conditions) -> list[OutsideCurve]:
    """Return the curves of a model that some rows ask for beyond the range in which they were seen."""
    found = []
    for effect, joint, x, beyond in _curves(model, conditions):
        if beyond.any():
            at, asked = effect.locus, (float(x.min()), float(x.max()))
            assert at.span is not None
            found.append(OutsideCurve(effect.name, joint, str(at.follows), int(beyond.sum()), *asked, *at.span))
    return found


def inside_curves(model: Model, conditions: Conditions) -> np.ndarray:
    """Return which rows ask for no curve of a model beyond the range in which it was seen, shape (N,)."""
    inside = np.ones(len(conditions), bool)
    for _, _, _, beyond in _curves(model, conditions):
        inside &= ~beyond
    return inside


def _curves(model: Model, conditions: Conditions) -> Iterator[tuple[Effect, str, np.ndarray, np.ndarray]]:
    """Yield the curves of a model, their joints, the variables that they follow and which rows are beyond their range."""
    for effect in model.effects:
        at = effect.locus
        if at.span is None or at.follows is None or at.joint is None:
            continue
        x = recorded_variable(model.chain, conditions, at.follows)
        yield effect, at.joint, x, _beyond(x, *at.span)


def _beyond(x: np.ndarray, lower: ArrayLike, upper: ArrayLike) -> np.ndarray:
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    margin = _MARGIN_PART * (high - low) + _MARGIN
    return np.asarray((x < low - margin) | (x > high + margin))
