"""The true part: features that deviate from their nominal ones, as points that a camera sees.

A sensor on the flange looks at one feature after the other, as at the fields of a calibration
object, and measures those points of it that face the sensor.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.camera import CalibrationObject

# Points of a feature.
_COUNTS = {"point": 1, "line": 8, "plane": 12, "circle": 8, "sphere": 15, "cylinder": 16}
# Half of the length of a line and of the sides of a plane that are measured [m].
_HALF_LENGTH = 0.04
# Angle from the pole within which points of a sphere are seen, and from the side that faces the
# sensor on a cylinder [rad].
_CAP = np.deg2rad(65.0)
_SIDE = np.deg2rad(55.0)
# Half-height of the measured part of a cylinder, relative to its radius.
_TALL = 1.0
# Cosine of the angle to the part's z axis above which a cylinder is seen along its axis.
_UPRIGHT = 0.7
# Deviation of a radius relative to that of a position, and length over which a direction deviates
# by as much as a position [m].
_OF_RADIUS = 0.5
_LEVER = 0.1
_UP = np.array([0.0, 0.0, 1.0])
# Images that tell where a point is.
_IMAGES = 2
# Between the name of a feature and that of its point.
_MARK = "/"


@dataclass(frozen=True)
class TrueFeature:
    """A feature in the part's frame.

    Attributes:
        name: Of the feature.
        kind: One of point, line, plane, circle, sphere, cylinder.
        position: A point of it, its centre or a point of its axis [m], shape (3,).
        direction: Unit direction of a line or an axis, normal of a plane or a circle, shape (3,).
        radius: Of a circle, a sphere or a cylinder [m].
    """

    name: str
    kind: str
    position: np.ndarray
    direction: np.ndarray
    radius: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what can't be measured."""
        if self.kind not in _COUNTS:
            raise BadInputError(
                f"feature {self.name!r}: kind {self.kind!r}; expected one of {', '.join(_COUNTS)}"
            )
        if self.kind in ("circle", "sphere", "cylinder") and not self.radius > 0.0:
            raise BadInputError(
                f"feature {self.name!r} ({self.kind}): radius {self.radius:g} m; expected more "
                "than 0"
            )

    def drawn(self, rng: np.random.Generator, deviation: float) -> TrueFeature:
        """Return the feature with random deviations, of the standard deviation ``deviation`` of
        each coordinate of its position [m].
        """
        off = deviation * rng.standard_normal(3)
        turned = self.direction + deviation / _LEVER * rng.standard_normal(3)
        wider = _OF_RADIUS * deviation * rng.standard_normal()
        return replace(
            self,
            position=self.position + off,
            direction=turned / np.linalg.norm(turned),
            radius=self.radius + wider if self.radius else 0.0,
        )

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Return points of the feature [m], and the directions from which each is seen, shape
        (N, 3) both; the first of these is where the sensor should be.
        """
        places, normals = _PLACES[self.kind](self)
        return self.position + places, normals

    def truth(self) -> dict[str, Any]:
        """Return its numbers, for JSON."""
        found: dict[str, Any] = {"kind": self.kind, "position_m": self.position.tolist()}
        if self.kind not in ("point", "sphere"):
            found["direction"] = self.direction.tolist()
        if self.radius:
            found["diameter_m"] = 2.0 * self.radius
        return found


def _basis(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two directions across another, and across each other."""
    least = np.eye(3)[np.argmin(np.abs(direction))]
    first = np.cross(direction, least)
    first /= np.linalg.norm(first)
    return first, np.cross(direction, first)


def _ring(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return cosines and sines of evenly spread angles, shape (n, 1) both."""
    angle = 2.0 * np.pi * np.arange(n)[:, None] / n
    return np.cos(angle), np.sin(angle)


def _of_point(feature: TrueFeature) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((1, 3)), _UP[None]


def _of_line(feature: TrueFeature) -> tuple[np.ndarray, np.ndarray]:
    n = _COUNTS["line"]
    along = np.linspace(-_HALF_LENGTH, _HALF_LENGTH, n)[:, None]
    return along * feature.direction, np.tile(_UP, (n, 1))


def _of_plane(feature: TrueFeature) -> tuple[np.ndarray, np.ndarray]:
    first, second = _basis(feature.direction)
    side = np.linspace(-_HALF_LENGTH, _HALF_LENGTH, 4)
    grid = np.array([[x, y] for x in side for y in side[[0, 1, 3]]])
    places = grid[:, :1] * first + grid[:, 1:] * second
    return places, np.tile(feature.direction, (len(places), 1))


def _of_circle(feature: TrueFeature) -> tuple[np.ndarray, np.ndarray]:
    first, second = _basis(feature.direction)
    cosine, sine = _ring(_COUNTS["circle"])
    places = feature.radius * (cosine * first + sine * second)
    return places, np.tile(feature.direction, (len(places), 1))


def _of_sphere(feature: TrueFeature) -> tuple[np.ndarray, np.ndarray]:
    # The pole first, then rings down to the edge of the cap.
    n = (_COUNTS["sphere"] - 1) // 2
    cosine, sine = _ring(n)
    normals = [_UP[None]]
    for angle in (0.5 * _CAP, _CAP):
        level = np.sin(angle) * np.hstack([cosine, sine])
        normals.append(np.column_stack([level, np.full(n, np.cos(angle))]))
    stacked = np.vstack(normals)
    return feature.radius * stacked, stacked


def _of_cylinder(feature: TrueFeature) -> tuple[np.ndarray, np.ndarray]:
    axis = feature.direction
    n = _COUNTS["cylinder"]
    height = _TALL * feature.radius * np.tile([-1.0, 1.0, 0.0, 0.5], n // 4)[:, None]
    if abs(axis[2]) > _UPRIGHT:
        first, second = _basis(axis)
        cosine, sine = _ring(n)
        outwards = cosine * first + sine * second
        seen_from = np.tile(axis * np.sign(axis[2]), (n, 1))
        return feature.radius * outwards + height * axis, seen_from
    top = _UP - axis * (axis @ _UP)
    top /= np.linalg.norm(top)
    # The middle first, as it is where the sensor looks.
    angle = _SIDE * np.roll(np.linspace(-1.0, 1.0, n), -(n // 2))[:, None]
    outwards = np.cos(angle) * top + np.sin(angle) * np.cross(axis, top)
    return feature.radius * outwards + height * axis, outwards


_PLACES: Mapping[str, Callable[[TrueFeature], tuple[np.ndarray, np.ndarray]]] = {
    "point": _of_point,
    "line": _of_line,
    "plane": _of_plane,
    "circle": _of_circle,
    "sphere": _of_sphere,
    "cylinder": _of_cylinder,
}


def object_of_features(features: Sequence[TrueFeature]) -> CalibrationObject:
    """Return the points of features as an object with a field for each; a point is named by its
    feature and a number, as in ``hole_1/3``.

    Example:
        >>> hole = TrueFeature("hole", "circle", np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.01)
        >>> object_of_features([hole]).names[:2]
        ('hole/1', 'hole/2')
    """
    found = [feature.points() for feature in features]
    counts = [len(places) for places, _ in found]
    names = [
        f"{feature.name}{_MARK}{k + 1}"
        for feature, count in zip(features, counts, strict=True)
        for k in range(count)
    ]
    return CalibrationObject(
        names=tuple(names),
        places=np.vstack([places for places, _ in found]),
        normals=np.vstack([normals for _, normals in found]),
        field=np.repeat(np.arange(len(features)), counts),
    )


def readings_of_features(
    table: Mapping[str, np.ndarray], joint: str, positions: np.ndarray, features: Sequence[str]
) -> dict[str, np.ndarray]:
    """Return the rows in which a pose shows the feature that it is for, with the columns
    ``feature``, ``point``, its number, and ``pass`` if poses are visited several times. Of images a
    point needs two in each pass; others of it are left out.

    Args:
        table: Columns of the readings of an object of features.
        joint: Name of a joint that tells poses apart.
        positions: Its positions in the poses of one pass, as many for each feature, shape (N,).
        features: Their names, in the order of the object.

    Raises:
        BadInputError: If nothing is left, as of images of each feature from a single pose.
    """
    names = [str(name).rpartition(_MARK) for name in table["point"]]
    views = len(positions) // len(features)
    shown = {at: features[i // views] for i, at in enumerate(positions.tolist())}
    visits = Counter[tuple[str, float]]()
    rows = list[int]()
    passes = list[int]()
    for row, (name, at) in enumerate(zip(table["point"], table[joint].tolist(), strict=True)):
        if names[row][0] != shown[at]:
            continue
        visits[name, at] += 1
        rows.append(row)
        passes.append(visits[name, at])
    seen = Counter((table["point"][row], k) for row, k in zip(rows, passes, strict=True))
    least = _IMAGES if "u" in table else 1
    kept = [i for i, row in enumerate(rows) if seen[table["point"][row], passes[i]] >= least]
    if not kept:
        raise BadInputError(
            f"no point of the part is seen from {least} poses; expected more poses of each feature "
            "(--poses)"
        )
    found = {name: column[[rows[i] for i in kept]] for name, column in table.items()}
    found["feature"] = np.array([names[rows[i]][0] for i in kept])
    found["point"] = np.array([names[rows[i]][2] for i in kept])
    if max(passes) > 1:
        found["pass"] = np.array([passes[i] for i in kept])
    return found
