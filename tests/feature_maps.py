"""Linearised features of positions, in closed form, as the derivatives of what they give by the positions.

A feature of n points is a map A, shape (p, 3n), of their displacements: least squares on the points' directions, as in a
book on coordinate metrology. Rows of real series do not lie on circles; a map needs directions only, so those of near rows
stand for a circle's, whatever their distances.
"""

from collections.abc import Callable

import numpy as np

# How far two readings are apart [m], and by how much that may differ.
APART = (0.02, 0.1, 0.5)
_ROUGHLY = 1.6


def difference(places: np.ndarray) -> np.ndarray:
    """Return the map of two positions to their difference, shape (3, 6)."""
    return np.hstack([-np.eye(3), np.eye(3)])


def circle(places: np.ndarray) -> np.ndarray:
    """Return the map to centre in the plane and radius of a circle, shape (3, 3n)."""
    directions, axes = _directions(places, 2)
    normals = directions @ axes
    return _by_normals(normals, np.column_stack([directions, np.ones(len(places))]))


def plane(places: np.ndarray) -> np.ndarray:
    """Return the map to height and both slopes of a plane, slopes by the radius of its points, shape (3, 3n)."""
    centred = places - places.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    along = centred @ axes[:2].T / np.linalg.norm(centred, axis=1).mean()
    return _by_normals(np.tile(axes[2], (len(places), 1)), np.column_stack([along, np.ones(len(places))]))


def sphere(places: np.ndarray) -> np.ndarray:
    """Return the map to centre and radius of a sphere, shape (4, 3n)."""
    directions, axes = _directions(places, 3)
    return _by_normals(directions @ axes, np.column_stack([directions @ axes, np.ones(len(places))]))


def _directions(places: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directions from the mean of places in its first principal axes, shape (n, size), and these, (size, 3)."""
    centred = places - places.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2][:size]
    along = centred @ axes.T
    return along / np.linalg.norm(along, axis=1, keepdims=True), axes


def _by_normals(normals: np.ndarray, design: np.ndarray) -> np.ndarray:
    """Return the least-squares map of displacements along normals, shape (n, 3), to what a design, shape (n, p), gives."""
    n = len(normals)
    along = np.zeros((n, 3 * n))
    for i, normal in enumerate(normals):
        along[i, 3 * i : 3 * i + 3] = normal
    return np.asarray(np.linalg.pinv(design) @ along)


# Features, their numbers of points, and their maps.
FEATURES: dict[str, tuple[int, Callable[[np.ndarray], np.ndarray]]] = {
    "circle": (8, circle),
    "plane": (12, plane),
    "sphere": (15, sphere),
}


def near_rows(places: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return n rows near one of them: half of the 2n that are nearest to it."""
    centre = places[rng.integers(len(places))]
    nearest = np.argsort(np.linalg.norm(places - centre, axis=1))[: 2 * n]
    return rng.permutation(nearest)[:n]


def pairs_apart(places: np.ndarray, apart: float, count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return pairs of rows roughly so far apart, shape (2,) each, as many as there are up to a count."""
    found = []
    for first in rng.permutation(len(places)):
        distance = np.linalg.norm(places - places[first], axis=1)
        fit = np.flatnonzero((distance < apart * _ROUGHLY) & (distance > apart / _ROUGHLY))
        if len(fit):
            found.append(np.array([first, rng.choice(fit)]))
        if len(found) == count:
            break
    return found
