"""What is known of a measuring setup beside the table: named points, distances between them, the camera."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.lens import DISTORTION, PINHOLE, Lens
from pincal.measure.measurements import Measurements
from pincal.measure.table import read_columns
from pincal.parameters import Parameter

Place = tuple[float, float, float]

# An artefact is made, and measured, to about this [m], unless its maker says otherwise.
GAP_SIGMA = 1e-5
# Size of real distortions, used as prior where the image can't tell.
_DISTORTION_SIZE = {"k1": 0.3, "k2": 0.3, "k3": 0.3, "p1": 0.01, "p2": 0.01}
# Distortion that is looked for in an unknown camera; k3 only matters to fisheyes.
_USUAL = (*PINHOLE, "k1", "k2", "p1", "p2")
# Width of a row of points, over its length, below which they stand in a line.
_LINE = 1e-3


@dataclass(frozen=True)
class KnownDistance:
    """A known distance between two named points: ``length`` and its standard deviation ``sigma`` [m]."""

    first: str
    second: str
    length: float
    sigma: float = GAP_SIGMA

    def __post_init__(self) -> None:
        if not (np.isfinite(self.length) and self.length > 0.0):
            raise MeasurementError(f"distance of {self.first} and {self.second} is {self.length:g} m; expected more than 0")
        if not (np.isfinite(self.sigma) and self.sigma > 0.0):
            raise MeasurementError(f"sigma of {self.first} to {self.second} is {self.sigma:g} m; expected more than 0")
        if self.first == self.second:
            raise MeasurementError(f"distance of {self.first} to itself; expected two points")


@dataclass(frozen=True)
class NamedPoints:
    """Points that stand still: sockets, anchors of a distance, points of a calibration object.

    A point is known in the instrument's frame, or its three coordinates are parameters. Without any known point the
    instrument's frame is the robot's base.

    Attributes:
        places: each point's position [m], None where it is unknown.
        distances: known distances between points.

    Example:
        >>> points = NamedPoints({"a": (0.0, 0.0, 0.0), "b": None})
        >>> [p.name for p in points.parameters], points.positions(np.array([1.0, 2.0, 3.0])).tolist()
        (['b.x', 'b.y', 'b.z'], [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    """

    places: Mapping[str, Place | None] = field(default_factory=dict)
    distances: tuple[KnownDistance, ...] = ()

    def __post_init__(self) -> None:
        for gap in self.distances:
            for name in (gap.first, gap.second):
                if self.places and name not in self.places:
                    raise MeasurementError(f"a distance names {name!r}; the points are {_listed(self.places)}")

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the K points."""
        return tuple(self.places)

    @cached_property
    def known(self) -> np.ndarray:
        """Which points are known, shape (K,)."""
        return np.array([place is not None for place in self.places.values()], bool)

    @cached_property
    def given(self) -> np.ndarray:
        """Positions of the points [m], zero where unknown, shape (K, 3)."""
        return np.array([place or (0.0, 0.0, 0.0) for place in self.places.values()], float).reshape(-1, 3)

    @cached_property
    def slot(self) -> np.ndarray:
        """Place of each point among the unknown ones, -1 for a known one, shape (K,)."""
        return np.where(self.known, -1, np.cumsum(~self.known) - 1)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coordinates of the unknown points."""
        return tuple(
            Parameter(f"{name}.{axis}", "m", "named_point", 0.0, float("inf"))
            for name, place in self.places.items()
            if place is None
            for axis in "xyz"
        )

    def positions(self, own: np.ndarray) -> np.ndarray:
        """Return the positions of all points [m], shape (K, 3), for values of the parameters."""
        found = self.given.copy()
        found[~self.known] = own[: len(self.parameters)].reshape(-1, 3)
        return found

    def with_names(self, names: Sequence[str]) -> NamedPoints:
        """Return the points with those of other names among them, unknown."""
        new: dict[str, Place | None] = {str(name): None for name in names if name not in self.places}
        return replace(self, places={**self.places, **new}) if new else self

    @property
    def are_in_line(self) -> bool:
        """Whether the known points leave a rotation open: fewer than three of them, or all on one line."""
        places = self.given[self.known]
        spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) if len(places) > 2 else np.zeros(2)
        return bool(spread[1] <= _LINE * max(spread[0], 1e-300))


@dataclass(frozen=True)
class Setup:
    """What is known beforehand of what a robot is measured with.

    Attributes:
        points: positions of named points (sockets, anchors, points of a calibration object) in the instrument's frame [m],
            where they are known.
        distances: known distances between such points.
        lens: the camera, where it is known.
        fit_lens: whether to find a known camera's parameters again, too; those of an unknown camera always are.
    """

    points: Mapping[str, Place | None] = field(default_factory=dict)
    distances: tuple[KnownDistance, ...] = ()
    lens: Lens | None = None
    fit_lens: bool = False

    def over(self, measurements: Measurements) -> Setup:
        """Return the setup with all points that a table names, those of no known position as unknown."""
        names = point_names(measurements)
        return self if names is None else replace(self, points=self.named(np.unique(names)).places)

    def named(self, names: Sequence[str] | np.ndarray = ()) -> NamedPoints:
        """Return the named points, others of these names among them as unknown."""
        found = NamedPoints(self.points).with_names([str(name) for name in names])
        inside = tuple(d for d in self.distances if {d.first, d.second} <= found.places.keys())
        return replace(found, distances=inside)

    def lens_parameters(self) -> tuple[Parameter, ...]:
        """Return the camera's parameters, as deviations from what is known of it."""
        nominal = np.zeros(9) if self.lens is None else self.lens.values
        return tuple(
            Parameter(
                f"camera.{name}",
                "px" if name in PINHOLE else "1",
                "lens" if name in PINHOLE else "lens_distortion",
                float(value),
                _DISTORTION_SIZE.get(name, float("inf")),
            )
            for name, value in zip((*PINHOLE, *DISTORTION), nominal, strict=True)
        )

    def lens_fixed(self) -> np.ndarray:
        """Return which of the camera's parameters stay as they are, shape (9,)."""
        free = self.lens is None or self.fit_lens
        return np.array([not (free and name in _USUAL) for name in (*PINHOLE, *DISTORTION)])


def point_names(measurements: Measurements) -> np.ndarray | None:
    """Return the name of the point that each row has to do with, shape (N,), None without any."""
    return next((c for c in (measurements.socket, measurements.anchor, measurements.point) if c is not None), None)


def read_points(path: str | os.PathLike[str]) -> dict[str, Place]:
    """Read positions of named points from a table with columns ``point x y z``; units stand in the header.

    Raises:
        MeasurementError: if the file can't be read, or a name stands twice.
    """
    columns = read_columns(path, {"point": "name", "x": "length", "y": "length", "z": "length"})
    places = np.column_stack([columns[axis] for axis in "xyz"]).tolist()
    found: dict[str, Place] = {}
    for name, (x, y, z) in zip(columns["point"], places, strict=True):
        if str(name) in found:
            raise MeasurementError(f"{path}: point {str(name)!r} stands there twice; expected each name once")
        found[str(name)] = (x, y, z)
    return found


def read_distances(path: str | os.PathLike[str]) -> tuple[KnownDistance, ...]:
    """Read known distances from a table with columns ``first second distance`` and perhaps ``sigma``.

    Raises:
        MeasurementError: if the file can't be read, or a value can't be right.
    """
    quantities = {"first": "name", "second": "name", "distance": "length", "sigma": "length"}
    columns = read_columns(path, quantities, optional=("sigma",))
    sigma = columns.get("sigma", np.full(len(columns["first"]), GAP_SIGMA))
    return tuple(
        KnownDistance(str(a), str(b), float(length), float(s))
        for a, b, length, s in zip(columns["first"], columns["second"], columns["distance"], sigma, strict=True)
    )


def _listed(names: Mapping[str, Any]) -> str:
    return ", ".join(list(names)[:8]) + (" ..." if len(names) > 8 else "")
