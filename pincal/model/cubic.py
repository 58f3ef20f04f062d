"""Piecewise cubics, such as linear combinations of cubic splines over the same knots."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Cubic:
    """A piecewise cubic over intervals of equal length from ``lower`` to ``upper``, constant
    beyond.

    Attributes:
        packed: for each interval the coefficients of 1, t, t^2, t^3, with t from 0 to 1 along it;
            as bytes, so that sums of hundreds of splines are hashed fast.
    """

    lower: float
    upper: float
    packed: bytes

    @classmethod
    def of(cls, lower: float, upper: float, pieces: np.ndarray) -> Cubic:
        """Return the cubic of given coefficients, shape (K, 4)."""
        return cls(lower, upper, np.ascontiguousarray(pieces, float).tobytes())

    @property
    def _coefficients(self) -> np.ndarray:
        return np.frombuffer(self.packed).reshape(-1, 4)

    @property
    def pieces(self) -> list[list[float]]:
        """The coefficients of each interval."""
        return list(self._coefficients.tolist())

    def __call__(self, x: float) -> float:
        """Return the value at x."""
        count = len(self._coefficients)
        place = (
            (min(max(x, self.lower), self.upper) - self.lower) / (self.upper - self.lower) * count
        )
        i = min(int(place), count - 1)
        c = self._coefficients[i].tolist()
        t = place - i
        return float(((c[3] * t + c[2]) * t + c[1]) * t + c[0])

    def scaled(self, by: float) -> Cubic:
        """Return the cubic multiplied by a number."""
        return replace(self, packed=(by * self._coefficients).tobytes())

    def plus(self, other: Cubic) -> Cubic:
        """Return the sum with a cubic over the same intervals."""
        return replace(self, packed=(self._coefficients + other._coefficients).tobytes())

    def fits(self, other: Cubic) -> bool:
        """Return whether another cubic has the same intervals."""
        return (self.lower, self.upper, len(self.packed)) == (
            other.lower,
            other.upper,
            len(other.packed),
        )
