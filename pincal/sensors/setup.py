"""Prior knowledge of a measurement set-up in addition to the table: named points, distances between
them, the camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pincal.errors import MeasurementError
from pincal.parameters import ANYWHERE, Parameter
from pincal.sensors.fields import TableRows
from pincal.sensors.lens import DISTORTION, PINHOLE, Lens
from pincal.sensors.sensor_numbers import PLAUSIBLE
from pincal.thresholds import Scale

PointPlace = tuple[float, float, float]

# Standard deviation of the length of an artefact, unless stated by its manufacturer [m].
GAP_SIGMA: Scale = 1e-5


@dataclass(frozen=True)
class KnownDistance:
    """A known distance between two named points.

    Attributes:
        first, second: names of the points.
        length: the distance [m].
        sigma: its standard deviation [m].
    """

    first: str
    second: str
    length: float
    sigma: float = GAP_SIGMA

    def __post_init__(self) -> None:
        for what, value in (("distance", self.length), ("sigma", self.sigma)):
            if not 0.0 < value < np.inf:
                raise MeasurementError(
                    f"{what} of {self.first} and {self.second} is {value:g} m; expected more than 0"
                )
        if self.first == self.second:
            raise MeasurementError(f"distance from {self.first} to itself; expected two points")


@dataclass(frozen=True)
class NamedPoints:
    """Fixed points, each known in the instrument's frame or with three coordinates as parameters.

    Without any known point the instrument's frame is the robot's base.

    Attributes:
        places: each point's position [m], None where it is unknown.
        distances: known distances between points.

    Example:
        >>> points = NamedPoints({"a": (0.0, 0.0, 0.0), "b": None})
        >>> [p.name for p in points.parameters]
        ['b.x', 'b.y', 'b.z']
        >>> points.positions(np.array([1.0, 2.0, 3.0])).tolist()
        [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]
    """

    places: Mapping[str, PointPlace | None] = field(default_factory=dict)
    distances: tuple[KnownDistance, ...] = ()

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
        return np.array(
            [place or (0.0, 0.0, 0.0) for place in self.places.values()], float
        ).reshape(-1, 3)

    @cached_property
    def slot(self) -> np.ndarray:
        """Index of each point among the unknown ones, -1 for a known one, shape (K,)."""
        return np.where(self.known, -1, np.cumsum(~self.known) - 1)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coordinates of the unknown points."""
        unknown = [name for name, place in self.places.items() if place is None]
        return tuple(
            Parameter(f"{name}.{axis}", "m", "named_point", 0.0, ANYWHERE)
            for name in unknown
            for axis in "xyz"
        )

    def positions(self, own: np.ndarray) -> np.ndarray:
        """Return the positions of all points [m], shape (K, 3), for values of the parameters."""
        found = self.given.copy()
        found[~self.known] = own[: len(self.parameters)].reshape(-1, 3)
        return found

    @property
    def are_in_line(self) -> bool:
        """Whether the known points do not determine a rotation: fewer than three, or collinear."""
        places = self.given[self.known]
        spread = (
            np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
            if len(places) > 2
            else np.zeros(2)
        )
        return bool(spread[1] <= PLAUSIBLE.in_line * max(spread[0], 1e-300))


# Size of real distortions, used as prior.
_DISTORTION_SIZE = {"k1": 0.3, "k2": 0.3, "k3": 0.3, "p1": 0.01, "p2": 0.01}
# Parameters that are fitted for an unknown camera; k3 only matters for fisheye lenses.
_USUAL = (*PINHOLE, "k1", "k2", "p1", "p2")


@dataclass(frozen=True)
class Setup:
    """Known parts of a measurement set-up.

    Attributes:
        points: positions of named points (sockets, anchors, points of a calibration object) in the
            instrument's frame [m], where they are known.
        distances: known distances between such points.
        lens: the camera, where it is known.
        fit_lens: whether to re-estimate the parameters of a known camera, as is always done for an
            unknown one.
    """

    points: Mapping[str, PointPlace | None] = field(default_factory=dict)
    distances: tuple[KnownDistance, ...] = ()
    lens: Lens | None = None
    fit_lens: bool = False

    def over(self, table: TableRows) -> Setup:
        """Return the setup with all points of a table, new ones as unknown.

        Where no reading is of a known point, or of one at a known distance from it, known points
        are of other tables: the instrument's frame is then the robot's base.
        """
        names = table.point_names
        if names is None:
            return self
        read = set(map(str, np.unique(names)))
        ends = [{gap.first, gap.second} for gap in self.distances]
        tied = read.union(*(pair for pair in ends if pair & read))
        known = {name for name, place in self.points.items() if place is not None}
        unknown = {name: None for name in self.points if name not in known}
        here = self if known & tied else replace(self, points=unknown)
        return replace(here, points=here.named(np.unique(names)).places)

    def named(self, names: Sequence[str] | np.ndarray = ()) -> NamedPoints:
        """Return the named points with the distances between them; further ``names`` are unknown
        points.
        """
        places = {**self.points, **{str(name): None for name in names if name not in self.points}}
        inside = tuple(d for d in self.distances if {d.first, d.second} <= places.keys())
        return NamedPoints(places, inside)

    @property
    def lens_values(self) -> np.ndarray:
        """The known camera's parameters, zeros for an unknown one, shape (9,)."""
        return np.zeros(9) if self.lens is None else self.lens.values

    def lens_parameters(self) -> tuple[Parameter, ...]:
        """Return the camera's parameters, as deviations from :attr:`lens_values`."""
        found = []
        for name, value in zip((*PINHOLE, *DISTORTION), self.lens_values.tolist(), strict=True):
            unit, effect = ("px", "lens") if name in PINHOLE else ("1", "lens_distortion")
            found.append(
                Parameter(
                    f"camera.{name}", unit, effect, value, _DISTORTION_SIZE.get(name, ANYWHERE)
                )
            )
        return tuple(found)

    def lens_fixed(self) -> np.ndarray:
        """Return which of the camera's parameters are held fixed, shape (9,)."""
        free = self.lens is None or self.fit_lens
        return np.array([not (free and name in _USUAL) for name in (*PINHOLE, *DISTORTION)])
