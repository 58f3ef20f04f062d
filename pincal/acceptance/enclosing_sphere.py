"""The smallest sphere that holds points, whose diameter is a location error."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from pincal.thresholds import Scale

# Points so far outside, relative to the radius, are on the sphere.
_ROUNDING: Scale = 1e-9


class Sphere(NamedTuple):
    """A sphere.

    Attributes:
        centre: shape (3,) [m].
        radius: [m].
    """

    centre: np.ndarray
    radius: float

    def holds(self, points: np.ndarray) -> bool:
        """Return whether no point, shape (N, 3), is outside."""
        far = np.linalg.norm(points - self.centre, axis=1).max()
        return bool(far <= self.radius * (1.0 + _ROUNDING) + np.finfo(float).tiny)


def smallest_sphere(points: np.ndarray) -> Sphere:
    """Return the smallest sphere that holds all points, shape (N, 3) [m].

    At most four of them are on it. A point outside the sphere of those found so far is on the
    sphere of these and itself, which is larger: so it ends.

    Example:
        >>> found = smallest_sphere(np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 0.5, 0]]))
        >>> found.radius
        1.0
    """
    support = points[:1]
    found = Sphere(points[0], 0.0)
    while not found.holds(points):
        farthest = points[np.argmax(np.linalg.norm(points - found.centre, axis=1))]
        support, found = _of_few(np.vstack([support, farthest]))
    return found


def _of_few(points: np.ndarray) -> tuple[np.ndarray, Sphere]:
    """Return the points on the smallest sphere of at most five, and that sphere."""
    through = [
        (points[list(some)], _through(points[list(some)]))
        for k in range(1, min(len(points), 4) + 1)
        for some in combinations(range(len(points)), k)
    ]
    return min((each for each in through if each[1].holds(points)), key=lambda each: each[1].radius)


def _through(points: np.ndarray) -> Sphere:
    """Return the smallest sphere through one to four points."""
    edges = points[1:] - points[0]
    towards, *_ = np.linalg.lstsq(2.0 * edges, np.sum(edges**2, axis=1), rcond=None)
    return Sphere(points[0] + towards, float(np.linalg.norm(towards)))
