"""What is known of a measuring setup beside the table: named points, distances between them, the camera."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.fields import Table
from pincal.measure.lens import DISTORTION, PINHOLE, Lens
from pincal.measure.named_points import GAP_SIGMA, KnownDistance, NamedPoints, Place
from pincal.measure.reader import read_columns
from pincal.parameters import Parameter

# Size of real distortions, used as prior where the image can't tell.
_DISTORTION_SIZE = {"k1": 0.3, "k2": 0.3, "k3": 0.3, "p1": 0.01, "p2": 0.01}
# Distortion that is looked for in an unknown camera; k3 only matters to fisheyes.
_USUAL = (*PINHOLE, "k1", "k2", "p1", "p2")


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

    def over(self, table: Table) -> Setup:
        """Return the setup with all points that a table names, those of no known position as unknown."""
        names = table.point_names
        return self if names is None else replace(self, points=self.named(np.unique(names)).places)

    def named(self, names: Sequence[str] | np.ndarray = ()) -> NamedPoints:
        """Return the named points, others of these names among them as unknown, and the distances between them."""
        places = {**self.points, **{str(name): None for name in names if name not in self.points}}
        inside = tuple(d for d in self.distances if {d.first, d.second} <= places.keys())
        return NamedPoints(places, inside)

    def lens_parameters(self) -> tuple[Parameter, ...]:
        """Return the camera's parameters, as deviations from what is known of it."""
        nominal = np.zeros(9) if self.lens is None else self.lens.values
        found = []
        for name, value in zip((*PINHOLE, *DISTORTION), nominal.tolist(), strict=True):
            unit, effect = ("px", "lens") if name in PINHOLE else ("1", "lens_distortion")
            found.append(Parameter(f"camera.{name}", unit, effect, value, _DISTORTION_SIZE.get(name, float("inf"))))
        return tuple(found)

    def lens_fixed(self) -> np.ndarray:
        """Return which of the camera's parameters stay as they are, shape (9,)."""
        free = self.lens is None or self.fit_lens
        return np.array([not (free and name in _USUAL) for name in (*PINHOLE, *DISTORTION)])


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
