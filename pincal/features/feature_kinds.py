r"""Kinds of features, each by the equations that hold on its surface.

All kinds share seven numbers: a position, a unit direction and a radius; a kind has some of them.
The equations of a point x are signed distances [m] from the feature, whose derivatives by x are
orthonormal: one equation for a surface, two for a curve, three for a point. As all of them depend
on x - position only, the derivative by the position is the negative of that by x.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.robot.se3 import perpendicular
from pincal.thresholds import Count, Scale

NUMBERS = ("x", "y", "z", "i", "j", "k", "radius")
"""Names of the seven numbers of a feature: position [m], unit direction, radius [m]."""

OF_POSITION = slice(0, 3)
OF_DIRECTION = slice(3, 6)
OF_RADIUS = slice(6, 7)

# Directions of a hemisphere from which the axis of a cylinder is searched.
_DIRECTIONS: Count = 60
# Of these the ones that fit best are refined.
_REFINED: Count = 4
# Distance from an axis or a centre below which the direction from it is undefined [m].
_AT_CENTRE: Scale = 1e-12


@dataclass(frozen=True, eq=False)
class Equations:
    """The equations of N points of one feature, m for each.

    Attributes:
        values: shape (N, m), signed distances from the feature [m].
        by_point: shape (N, m, 3), their derivatives by the points, orthonormal rows.
        by_direction: shape (N, m, 3), by the direction [m].
        by_radius: shape (m,), by the radius.
    """

    values: np.ndarray
    by_point: np.ndarray
    by_direction: np.ndarray
    by_radius: np.ndarray

    def by_steps(self, basis: np.ndarray) -> np.ndarray:
        """Return the derivatives by steps of the free parameters, shape (N, m, p)."""
        by_radius = np.broadcast_to(self.by_radius[None, :, None], (*self.values.shape, 1))
        by_numbers = np.concatenate([-self.by_point, self.by_direction, by_radius], axis=2)
        return np.asarray(by_numbers @ basis)


class FeatureKind(ABC):
    """One kind of feature.

    Attributes:
        name: as in a part's file.
        least: the fewest points that determine it.
        extent: how many principal extents its points need: 0 for a point, 1 for a line, 2 for what
            points of a line do not determine, 3 for what points of a plane do not.
        has: the numbers that it has, of ``NUMBERS``.
    """

    name: ClassVar[str]
    least: ClassVar[int]
    extent: ClassVar[int]
    has: ClassVar[tuple[str, ...]] = NUMBERS

    @abstractmethod
    def equations(self, numbers: np.ndarray, points: np.ndarray) -> Equations:
        """Return the equations of points, shape (N, 3) [m], for a feature's numbers, shape (7,)."""

    @abstractmethod
    def starts(self, points: np.ndarray) -> Iterator[np.ndarray]:
        """Yield rough numbers, shape (7,), one of which is near the best fit."""

    @abstractmethod
    def free(self, numbers: np.ndarray) -> np.ndarray:
        """Return the directions in which the numbers may move, shape (7, p), p being as many as
        the feature has parameters.
        """

    def form_error(self, deviations: np.ndarray) -> float:
        """Return the peak-to-valley deviation from the feature [m] by the equations' values of its
        points, shape (N, m).
        """
        return float(np.ptp(deviations[:, 0]))


def stepped(numbers: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return a feature's numbers after a step of the seven, with a direction of unit length."""
    found = np.asarray(numbers + step)
    size = np.linalg.norm(found[OF_DIRECTION])
    if size > 0.0:
        found[OF_DIRECTION] /= size
    return found


def across(direction: np.ndarray) -> np.ndarray:
    """Return two orthonormal directions across a unit direction, shape (3, 2)."""
    first = perpendicular(direction)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(direction, first)])


class _Point(FeatureKind):
    """One place, touched or seen any number of times."""

    name = "point"
    least = 1
    extent = 0
    has = ("x", "y", "z")

    def equations(self, numbers: np.ndarray, points: np.ndarray) -> Equations:
        n = len(points)
        return Equations(
            values=points - numbers[OF_POSITION],
            by_point=np.tile(np.eye(3), (n, 1, 1)),
            by_direction=np.zeros((n, 3, 3)),
            by_radius=np.zeros(3),
        )

    def starts(self, points: np.ndarray) -> Iterator[np.ndarray]:
        yield _numbers(points.mean(axis=0))

    def free(self, numbers: np.ndarray) -> np.ndarray:
        return np.eye(7)[:, OF_POSITION]

    def form_error(self, deviations: np.ndarray) -> float:
        return 0.0


class _Line(FeatureKind):
    """A straight line in space."""

    name = "line"
    least = 2
    extent = 1
    has = ("x", "y", "z", "i", "j", "k")

    def equations(self, numbers: np.ndarray, points: np.ndarray) -> Equations:
        E = across(numbers[OF_DIRECTION])
        y = points - numbers[OF_POSITION]
        along = y @ numbers[OF_DIRECTION]
        return Equations(
            values=y @ E,
            by_point=np.tile(E.T, (len(points), 1, 1)),
            by_direction=-along[:, None, None] * E.T,
            by_radius=np.zeros(2),
        )

    def starts(self, points: np.ndarray) -> Iterator[np.ndarray]:
        yield _numbers(points.mean(axis=0), _principal(points)[0])

    def free(self, numbers: np.ndarray) -> np.ndarray:
        E = across(numbers[OF_DIRECTION])
        return _blocks(E, E)

    def form_error(self, deviations: np.ndarray) -> float:
        """Return the diameter of the cylinder about the line that holds all points [m]."""
        return 2.0 * float(np.linalg.norm(deviations, axis=1).max())


class _Plane(FeatureKind):
    """A plane; its direction is the normal."""

    name = "plane"
    least = 3
    extent = 2
    has = ("x", "y", "z", "i", "j", "k")

    def equations(self, numbers: np.ndarray, points: np.ndarray) -> Equations:
        n = len(points)
        y = points - numbers[OF_POSITION]
        return Equations(
            values=(y @ numbers[OF_DIRECTION])[:, None],
            by_point=np.tile(numbers[OF_DIRECTION], (n, 1, 1)),
            by_direction=y[:, None, :],
            by_radius=np.zeros(1),
        )

    def starts(self, points: np.ndarray) -> Iterator[np.ndarray]:
        yield _numbers(points.mean(axis=0), _principal(points)[2])

    def free(self, numbers: np.ndarray) -> np.ndarray:
        normal = numbers[OF_DIRECTION]
        return _blocks(normal[:, None], across(normal))


class _Circle(FeatureKind):
    """A circle in space, such as the rim of a hole; its direction is the normal of its plane."""

    name = "circle"
    least = 3
    extent = 2

    def equations(self, numbers: np.ndarray, points: np.ndarray) -> Equations:
        normal = numbers[OF_DIRECTION]
        y = points - numbers[OF_POSITION]
        height = y @ normal
        size, outwards = _from_centre(y - height[:, None] * normal)
        by_point = np.stack([outwards, np.broadcast_to(normal, y.shape)], axis=1)
        return Equations(
            values=np.column_stack([size - numbers[6], height]),
            by_point=by_point,
            by_direction=np.stack([-height[:, None] * outwards, y], axis=1),
            by_radius=np.array([-1.0, 0.0]),
        )

    def starts(self, points: np.ndarray) -> Iterator[np.ndarray]:
        axes = _principal(points)
        centre, radius = _round(points, axes[:2])
        yield _numbers(centre, axes[2], radius)

    def free(self, numbers: np.ndarray) -> np.ndarray:
        return _blocks(np.eye(3), across(numbers[OF_DIRECTION]), is_round=True)


class _Sphere(FeatureKind):
    """A sphere."""

    name = "sphere"
    least = 4
    extent = 3
    has = ("x", "y", "z", "radius")

    def equations(self, numbers: np.ndarray, points: np.ndarray) -> Equations:
        size, outwards = _from_centre(points - numbers[OF_POSITION])
        return Equations(
            values=(size - numbers[6])[:, None],
            by_point=outwards[:, None, :],
            by_direction=np.zeros((len(points), 1, 3)),
            by_radius=np.array([-1.0]),
        )

    def starts(self, points: np.ndarray) -> Iterator[np.ndarray]:
        centre, radius = _round(points, np.eye(3))
        yield _numbers(centre, radius=radius)

    def free(self, numbers: np.ndarray) -> np.ndarray:
        return _blocks(np.eye(3), np.zeros((3, 0)), is_round=True)


class _Cylinder(FeatureKind):
    """A cylinder; its direction is that of its axis."""

    name = "cylinder"
    least = 5
    extent = 3

    def equations(self, numbers: np.ndarray, points: np.ndarray) -> Equations:
        axis = numbers[OF_DIRECTION]
        y = points - numbers[OF_POSITION]
        along = y @ axis
        size, outwards = _from_centre(y - along[:, None] * axis)
        return Equations(
            values=(size - numbers[6])[:, None],
            by_point=outwards[:, None, :],
            by_direction=(-along[:, None] * outwards)[:, None, :],
            by_radius=np.array([-1.0]),
        )

    def starts(self, points: np.ndarray) -> Iterator[np.ndarray]:
        axes = np.vstack([_principal(points), _hemisphere(_DIRECTIONS)])
        found = [self._about(points, axis) for axis in axes]
        misfits = [np.linalg.norm(self.equations(numbers, points).values) for numbers in found]
        yield from (found[i] for i in np.argsort(misfits)[:_REFINED])

    def free(self, numbers: np.ndarray) -> np.ndarray:
        E = across(numbers[OF_DIRECTION])
        return _blocks(E, E, is_round=True)

    @staticmethod
    def _about(points: np.ndarray, axis: np.ndarray) -> np.ndarray:
        """Return the cylinder about an axis of a given direction."""
        centre, radius = _round(points, across(axis).T)
        return _numbers(centre, axis, radius)


def _numbers(
    position: np.ndarray, direction: np.ndarray | None = None, radius: float = 0.0
) -> np.ndarray:
    """Return the seven numbers; without a direction it is zero."""
    return np.concatenate([position, np.zeros(3) if direction is None else direction, [radius]])


def _blocks(position: np.ndarray, direction: np.ndarray, *, is_round: bool = False) -> np.ndarray:
    """Return the free directions of position, direction and radius as one matrix, shape (7, p)."""
    n_position = position.shape[1]
    n_direction = direction.shape[1]
    found = np.zeros((7, n_position + n_direction + int(is_round)))
    found[OF_POSITION, :n_position] = position
    found[OF_DIRECTION, n_position : n_position + n_direction] = direction
    if is_round:
        found[OF_RADIUS, -1] = 1.0
    return found


def _from_centre(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lengths of vectors, shape (N,), and their directions, shape (N, 3)."""
    size = np.linalg.norm(y, axis=1)
    return size, y / np.maximum(size, _AT_CENTRE)[:, None]


def _principal(points: np.ndarray) -> np.ndarray:
    """Return the principal axes of points, shape (3, 3), that of the largest extent first."""
    _, _, axes = np.linalg.svd(points - points.mean(axis=0))
    return np.asarray(axes)


def _round(points: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, float]:
    """Return centre and radius of the circle or sphere through points in the space of some
    orthonormal axes, shape (2 or 3, 3), by linear least squares (Kasa 1976).
    """
    mean = points.mean(axis=0)
    y = (points - mean) @ axes.T
    squares = np.sum(y**2, axis=1)
    # |y|^2 = 2 y.c + (r^2 - |c|^2), scaled so that columns are of like size.
    scale = max(float(np.sqrt(squares.mean())), _AT_CENTRE)
    columns = np.column_stack([2.0 * y / scale, np.ones(len(y))])
    found = np.linalg.lstsq(columns, squares / scale**2, rcond=None)[0] * scale
    centre = found[:-1]
    radius = np.sqrt(max(found[-1] * scale + float(centre @ centre), 0.0))
    return mean + centre @ axes, float(radius)


def _hemisphere(count: int) -> np.ndarray:
    """Return evenly spread unit vectors, of each of which the opposite is left out, shape
    (count, 3): a spiral of Fibonacci.
    """
    z = (np.arange(count) + 0.5) / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count)
    size = np.sqrt(1.0 - z**2)
    return np.column_stack([size * np.cos(angle), size * np.sin(angle), z])


_ALL = (_Point(), _Line(), _Plane(), _Circle(), _Sphere(), _Cylinder())

FITTED_KINDS: Mapping[str, FeatureKind] = {kind.name: kind for kind in _ALL}
"""Kinds of features that are fitted to points, by name."""
