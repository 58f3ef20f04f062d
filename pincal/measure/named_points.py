"""Points that stand still: sockets, anchors of a distance, points of a calibration object, and distances between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pincal.errors import MeasurementError
from pincal.parameters import Parameter

Place = tuple[float, float, float]

# An artefact is made, and measured, to about this [m], unless its maker says otherwise.
GAP_SIGMA = 1e-5
# Width of a row of points, over its length, below which they stand in a line.
_LINE = 1e-3


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
                raise MeasurementError(f"{what} of {self.first} and {self.second} is {value:g} m; expected more than 0")
        if self.first == self.second:
            raise MeasurementError(f"distance of {self.first} to itself; expected two points")


@dataclass(frozen=True)
class NamedPoints:
    """Points that stand still.

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
        unknown = [name for name, place in self.places.items() if place is None]
        return tuple(Parameter(f"{name}.{axis}", "m", "named_point", 0.0, np.inf) for name in unknown for axis in "xyz")

    def positions(self, own: np.ndarray) -> np.ndarray:
        """Return the positions of all points [m], shape (K, 3), for values of the parameters."""
        found = self.given.copy()
        found[~self.known] = own[: len(self.parameters)].reshape(-1, 3)
        return found

    @property
    def are_in_line(self) -> bool:
        """Whether the known points leave a rotation open: fewer than three of them, or all on one line."""
        places = self.given[self.known]
        spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) if len(places) > 2 else np.zeros(2)
        return bool(spread[1] <= _LINE * max(spread[0], 1e-300))
