"""What is known of a measuring setup beside the table: named points, distances between them, the camera."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
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


def read_lens(path: str | os.PathLike[str]) -> Lens:
    """Read a camera from JSON: ``fx fy u0 v0`` and, where there is distortion, ``k1 k2 p1 p2 k3``.

    Raises:
        MeasurementError: if the file can't be read, or a value is missing or no number.
    """
    found = _camera_file(path)
    return Lens(**dict(_lens_values(found, path)))


def read_mount(path: str | os.PathLike[str]) -> np.ndarray | None:
    """Read how a camera is mounted, ``T_tip_camera`` (4 rows of 4), from the JSON of :func:`read_lens`; None without it.

    Raises:
        MeasurementError: as :func:`read_lens`, or if it is no rigid transform.
    """
    found = _camera_file(path).get("T_tip_camera")
    if found is None:
        return None
    try:
        mount = np.array(found, float)
    except (TypeError, ValueError):
        mount = np.zeros(0)
    if mount.shape != (4, 4) or not _is_rigid(mount):
        raise MeasurementError(f"{path}: T_tip_camera is no transform; expected 4 rows of 4, rotation and metres")
    return mount


def _is_rigid(transform: np.ndarray) -> bool:
    R = transform[:3, :3]
    is_turn = np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0.0
    return bool(np.isfinite(transform).all() and is_turn and np.array_equal(transform[3], [0.0, 0.0, 0.0, 1.0]))


def _camera_file(path: str | os.PathLike[str]) -> dict[str, Any]:
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise MeasurementError(f"{path}: can't be read ({error.strerror}); expected a camera's JSON") from None
    except ValueError as error:
        raise MeasurementError(f"{path}: no JSON ({error}); expected {{{_keys()}}}") from None
    if not isinstance(found, dict) or any(name not in found for name in PINHOLE):
        raise MeasurementError(f"{path}: expected an object with {', '.join(PINHOLE)} [px] and, where known, {_keys()}")
    return found


def _lens_values(found: dict[str, Any], path: str | os.PathLike[str]) -> Iterator[tuple[str, float]]:
    for name in (f.name for f in fields(Lens)):
        value = found.get(name, 0.0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise MeasurementError(f"{path}: {name} is {value!r}; expected a number")
        if name in ("fx", "fy") and value <= 0.0:
            raise MeasurementError(f"{path}: {name} is {value:g} px; expected more than 0")
        yield name, float(value)


def _keys() -> str:
    return ", ".join((*PINHOLE, *DISTORTION))


def _listed(names: Mapping[str, Any]) -> str:
    return ", ".join(list(names)[:8]) + (" ..." if len(names) > 8 else "")
