"""Piecewise cubics: what any linear combination of splines over the same knots is."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cubic:
    """A piecewise cubic over equal pieces, constant beyond its ends.

    Attributes:
        lower, upper: its ends.
        pieces: for each piece the coefficients of 1, t, t^2, t^3, with t from 0 to 1 along the piece.
    """

    lower: float
    upper: float
    pieces: tuple[tuple[float, ...], ...]

    def __call__(self, x: float) -> float:
        """Return its value."""
        place = (min(max(x, self.lower), self.upper) - self.lower) / (self.upper - self.lower) * len(self.pieces)
        i = min(int(place), len(self.pieces) - 1)
        c, t = self.pieces[i], place - i
        return ((c[3] * t + c[2]) * t + c[1]) * t + c[0]

    def scaled(self, by: float) -> Cubic:
        """Return it times a number."""
        return Cubic(self.lower, self.upper, tuple(tuple(by * c for c in piece) for piece in self.pieces))

    def plus(self, other: Cubic) -> Cubic:
        """Return the sum with a cubic over the same pieces."""
        pairs = zip(self.pieces, other.pieces, strict=True)
        return Cubic(self.lower, self.upper, tuple(tuple(a + b for a, b in zip(p, o, strict=True)) for p, o in pairs))

    def fits(self, other: Cubic) -> bool:
        """Return whether another one has the same pieces."""
        return (self.lower, self.upper, len(self.pieces)) == (other.lower, other.upper, len(other.pieces))
