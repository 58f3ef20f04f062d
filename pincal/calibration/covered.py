"""What a calibration's rows cover, and what lies beyond it, where nobody has checked the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pincal.model.conditions import Conditions, recorded_variable
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

    def outside(self, names: tuple[str, ...], conditions: Conditions) -> list[Outside]:
        """Return, row by row, what lies beyond.

        Args:
            names: names of the joints.
            conditions: the rows.
        """
        values = np.column_stack([conditions.q, conditions.payload])
        lower, upper = np.vstack([self.q, self.payload]).T
        margin = _MARGIN_PART * (upper - lower) + _MARGIN
        beyond = (values < lower - margin) | (values > upper + margin)
        named = (*names, "payload")
        return [
            Outside(int(i), named[j], float(values[i, j]), float(lower[j]), float(upper[j])) for i, j in np.argwhere(beyond)
        ]


def outside_curves(model: Model, conditions: Conditions) -> list[OutsideCurve]:
    """Return the curves of a model that some rows ask for beyond the range in which they were seen."""
    found = []
    for effect in model.effects:
        at = effect.locus
        if at.span is None or at.follows is None or at.joint is None:
            continue
        lower, upper = at.span
        x = recorded_variable(model.chain, conditions, at.follows)
        margin = _MARGIN_PART * (upper - lower) + _MARGIN
        beyond = int(np.sum((x < lower - margin) | (x > upper + margin)))
        if beyond:
            asked = float(x.min()), float(x.max())
            found.append(OutsideCurve(effect.name, at.joint, at.follows, beyond, *asked, lower, upper))
    return found
