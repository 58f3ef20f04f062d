"""Calibration objects: plates with marked points, one image field after the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

PITCH = 0.025
"""Distance from one marked point to the next on the paper's object [m]."""

# Points of one image field, in rows and columns.
_FIELD = 5
# The paper's object has two sides with three image fields each; the paper does not say how the sides lean.
_FIELDS, _LEAN = 3, np.pi / 4


@dataclass(frozen=True)
class CalibrationObject:
    """Named points on plates, in a frame of their own.

    Attributes:
        names: Names of the K points.
        places: Where they are in the object's frame [m], shape (K, 3).
        normals: Direction in which the plate of each looks, shape (K, 3); None for points seen from everywhere.
        field: Number of the image field of each, from 0, shape (K,).
    """

    names: tuple[str, ...]
    places: np.ndarray
    normals: np.ndarray | None
    field: np.ndarray

    @classmethod
    def of_points(cls, points: Mapping[str, Any], normals: Mapping[str, Any] | None = None) -> CalibrationObject:
        """Return an object of one field from named points [m] and, if they have a front, normals, shape (3,) each."""
        towards = None if normals is None else np.array([normals[name] for name in points], float)
        return cls(tuple(points), np.array([*points.values()], float), towards, np.zeros(len(points), int))

    @property
    def n_fields(self) -> int:
        """Number of image fields."""
        return int(self.field.max()) + 1

    def look_at(self, field: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return centre [m], shape (3,), normal, shape (3,), and radius [m] of an image field."""
        places = self.places[self.field == field]
        centre = places.mean(axis=0)
        normal = np.array([0.0, 0.0, 1.0]) if self.normals is None else self.normals[self.field == field][0]
        return centre, normal, float(np.linalg.norm(places - centre, axis=1).max())


def paper_object() -> CalibrationObject:
    """Return the object of the paper (Fig. 5): two sides with points 25 mm apart, three image fields per side.

    The sides make a roof with its ridge along x; both lean by 45 degrees. Point ``a2_1_3`` is in row 1 and column 3 of
    the second field of side a.

    Example:
        >>> paper = paper_object()
        >>> paper.n_fields, len(paper.names), paper.names[-1]
        (6, 150, 'b3_5_5')
    """
    sides = []
    for side, sign in (("a", -1.0), ("b", 1.0)):
        down = np.array([0.0, sign * np.cos(_LEAN), -np.sin(_LEAN)])
        along = np.array([1.0, 0.0, 0.0])
        middle = 0.5 * (_FIELDS * _FIELD - 1) * PITCH
        for field in range(_FIELDS):
            corner = (field * _FIELD * PITCH - middle) * along + PITCH * down
            sides.append(_plate(f"{side}{field + 1}", _FIELD, _FIELD, corner, down, along))
    return _joined(sides)


def grid_object(rows: int = 7, columns: int = 9) -> CalibrationObject:
    """Return a plane grid of points 25 mm apart about the origin, looking along z, its rows along y, its columns along x.

    Example:
        >>> grid_object().names[:2], grid_object().places[-1]
        (('p_1_1', 'p_1_2'), array([0.1  , 0.075, 0.   ]))
    """
    corner = -0.5 * PITCH * np.array([columns - 1.0, rows - 1.0, 0.0])
    return _joined([_plate("p", rows, columns, corner, np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]))])


OBJECTS = {"paper": paper_object, "grid": grid_object}
"""The objects by name."""


def _plate(
    name: str, rows: int, columns: int, corner: np.ndarray, down: np.ndarray, along: np.ndarray
) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return names, places and the normal, upwards, of a plate's points."""
    row, column = (index.ravel() for index in np.mgrid[:rows, :columns])
    names = [f"{name}_{i + 1}_{j + 1}" for i, j in zip(row, column, strict=True)]
    places = corner + PITCH * (row[:, None] * down + column[:, None] * along)
    normal = np.cross(down, along)
    return names, places, normal * np.sign(normal[2])


def _joined(plates: list[tuple[list[str], np.ndarray, np.ndarray]]) -> CalibrationObject:
    return CalibrationObject(
        names=tuple(name for names, _, _ in plates for name in names),
        places=np.vstack([places for _, places, _ in plates]),
        normals=np.vstack([np.tile(normal, (len(names), 1)) for names, _, normal in plates]),
        field=np.repeat(np.arange(len(plates)), [len(names) for names, _, _ in plates]),
    )
