"""Base class of sensors each of whose readings involves one named, fixed point.

A point is known in the instrument's frame, or its coordinates are parameters of the sensor; see
:class:`pincal.sensors.setup.NamedPoints`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import ClassVar, Self, final

import numpy as np

from pincal.errors import MeasurementError, few
from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.robot.se3 import align, transform
from pincal.sensors.extrinsics import RANK, Extrinsics
from pincal.sensors.fields import TableRows
from pincal.sensors.sensor import Constraints, Excluded, Grouped, OwnParameters, Sensor
from pincal.sensors.setup import NamedPoints, Setup
from pincal.thresholds import Count

# Names that a message lists.
_LISTED: Count = 8


@dataclass(frozen=True)
class PointSensor(Sensor, OwnParameters, Grouped):
    """Readings that each involve one named point.

    Attributes:
        thing: name of such a point in messages.
        fewest: least number of readings of an unknown point that are redundant.
        judges_new_points: whether a point that the calibration did not have is judged by the mean
            of its rows, of which it needs two.
        in_link_frame: whether points are fixed to the link at which the path starts, whose frame is
            the base.
        points: the named points.
        index: shape (N,), each row's point.
    """

    thing: ClassVar[str]
    fewest: ClassVar[int]
    judges_new_points: ClassVar[bool] = False
    in_link_frame: ClassVar[bool] = False

    points: NamedPoints
    index: np.ndarray

    @classmethod
    def of(cls, table: TableRows, setup: Setup) -> Self:
        """Return the readings of a table; points that the setup does not have are refused, unless
        they can be judged.

        A class with an attribute ``setup`` gets the setup.
        """
        points = setup.named()
        names = {field.name for field in cls.fields}.intersection(cls.per_row)
        index = index_of(table, points, may_be_new=cls.judges_new_points)
        others: dict[str, object] = {name: table.array(name) for name in names}
        if "setup" in cls.__dataclass_fields__:
            others["setup"] = setup
        return cls(points=points, index=index, **others)

    @property
    @abstractmethod
    def other_parameters(self) -> tuple[Parameter, ...]:
        """The sensor's own parameters other than points."""

    @property
    @final
    def row_groups(self) -> np.ndarray:
        return self.index

    @property
    @final
    def own_parameters(self) -> tuple[Parameter, ...]:
        """Coordinates of the unknown points, then all others."""
        return self.points.parameters + self.other_parameters

    @property
    @final
    def base_symbols(self) -> tuple[str, ...]:
        """All if any point is known in the instrument's frame; else the robot's base is
        that frame.
        """
        return FRAME_SYMBOLS if self.points.known.any() and not self.in_link_frame else ()

    @property
    @final
    def own_words(self) -> str:
        return "" if self.points.known.all() else "the unknown points"

    @final
    def facts(self, own: np.ndarray) -> Constraints | None:
        """Return the known distances between points."""
        gaps = self.points.distances
        if not gaps:
            return None
        ends = np.array(
            [[self.points.names.index(name) for name in (gap.first, gap.second)] for gap in gaps]
        ).T
        places = self.points.positions(own)
        lines = places[ends[0]] - places[ends[1]]
        lengths = np.maximum(np.linalg.norm(lines, axis=1), 1e-12)
        jacobian = np.zeros((len(own), len(gaps)))
        for slots, sign in zip(self.points.slot[ends], (1.0, -1.0), strict=True):
            for c in np.flatnonzero(slots >= 0):
                jacobian[3 * slots[c] : 3 * slots[c] + 3, c] += sign * lines[c] / lengths[c]
        known = np.array([(gap.length, gap.sigma) for gap in gaps])
        return Constraints(known[:, 0] - lengths, jacobian, known[:, 1])

    @final
    def unobservable(self) -> Iterator[str]:
        """Yield what the kind of reading and the known points do not determine."""
        known = int(self.points.known.sum())
        yield from self.unobservable_with(known)
        if known and self.points.are_in_line and not self.in_link_frame:
            some = (
                "fewer than three of the named points are known"
                if known < 3
                else "the known points are collinear"
            )
            yield (
                f"{some}, so a rotation of the base about them is undetermined: give another "
                "one off their line"
            )

    @abstractmethod
    def unobservable_with(self, known: int) -> Iterator[str]:
        """Yield what the kind of reading does not determine with ``known`` known points."""

    @final
    def unusable_rows(self) -> Iterator[Excluded]:
        """Yield impossible readings, then unknown points with too few readings to do more than
        locate them.
        """
        keep = np.ones(len(self), bool)
        if self.impossible is not None:
            keep = ~self.impossible.rows
            yield self.impossible
        lonely = np.zeros(len(self), bool)
        known = [name for name, place in self.points.places.items() if place is not None]
        lonely[keep], listed = poor_groups(
            np.array(self.points.names)[self.index][keep], self.fewest, known
        )
        yield Excluded(
            lonely,
            f"are of {self.thing} with fewer than {self.fewest} readings, which only "
            f"determine its pose ({listed})",
            f"{self.fewest} readings and more of {self.thing}, in other poses",
        )

    @property
    @abstractmethod
    def impossible(self) -> Excluded | None:
        """Rows that the instrument can't have seen; None if all are possible."""

    @classmethod
    @final
    def unscorable_rows(cls, table: TableRows, setup: Setup) -> Iterator[Excluded]:
        """Yield rows of points that the calibration did not have, unless judged by the mean of two
        rows or more.
        """
        lost, listed = rows_of_new(table, setup, enough=2 if cls.judges_new_points else None)
        yield Excluded(
            lost,
            f"are of points not used in the calibration ({listed})",
            "points of the calibration",
        )

    @final
    def by_points(self, by_place: np.ndarray) -> np.ndarray:
        """Return the derivative with respect to the unknown points, shape (own, m, N), from the
        rows', shape (3, m, N).
        """
        out = np.zeros((len(self.points.parameters), *by_place.shape[1:]))
        # Points that the calibration did not have are numbered from -1 down, and are no parameters.
        slot = np.where(self.index < 0, -1, self.points.slot[np.maximum(self.index, 0)])
        for k in range(len(out) // 3):
            rows = slot == k
            out[3 * k : 3 * k + 3, :, rows] = by_place[:, :, rows]
        return out

    @final
    def start_at_means(self, ends: np.ndarray, tools: np.ndarray) -> Extrinsics:
        """Return the poses with each point at the mean of its rows' ``ends``, shape (N, 3), in the
        base frame.
        """
        n = len(self.points.names)
        count = np.bincount(self.index, minlength=n).astype(float)
        places = np.stack(
            [np.bincount(self.index, weights=column, minlength=n) for column in ends.T], axis=1
        )
        return self.start_with_points(places / np.maximum(count, 1.0)[:, None], tools)

    @final
    def start_with_points(
        self, places: np.ndarray, tools: np.ndarray, *, rest: np.ndarray | None = None
    ) -> Extrinsics:
        """Return the poses for points in the robot's base frame; the known ones determine the base.

        Args:
            places: shape (K, 3), the points [m].
            tools: shape (targets, 4, 4).
            rest: values of own parameters other than the points.
        """
        points = self.points
        seen = points.known & np.isin(np.arange(len(places)), self.index)
        is_fixed = self.in_link_frame or not seen.any()
        base = np.eye(4) if is_fixed else transform(*align(places[seen], points.given[seen]))
        moved = places @ base[:3, :3].T + base[:3, 3]
        own = moved[~points.known].ravel()
        return Extrinsics(base, tools, own if rest is None else np.concatenate([own, rest]))


def _names_of(table: TableRows) -> np.ndarray:
    """Return the name of each row's point, shape (N,)."""
    names = table.point_names
    assert names is not None
    return names


def poor_groups(
    names: np.ndarray, fewest: int, known: Collection[str] = ()
) -> tuple[np.ndarray, str]:
    """Return the rows of unknown names with fewer than ``fewest`` rows, shape (N,), and these
    names.
    """
    found, inverse, count = np.unique(names, return_inverse=True, return_counts=True)
    poor = (count < fewest) & np.array([str(name) not in known for name in found], bool)
    return poor[inverse], few(found[poor], _LISTED)


def rows_of_new(
    table: TableRows, setup: Setup, *, enough: int | None = None
) -> tuple[np.ndarray, str]:
    """Return the rows of names that a calibration did not have, shape (N,), unless they are enough,
    and these names.
    """
    names = _names_of(table)
    found, inverse, count = np.unique(names, return_inverse=True, return_counts=True)
    is_new = np.array([str(name) not in setup.points for name in found], bool)
    lost = (is_new & ((enough is None) | (count < (enough or 0))))[inverse]
    return lost, ", ".join(sorted(set(map(str, names[lost])))[:_LISTED])


def index_of(table: TableRows, points: NamedPoints, *, may_be_new: bool = False) -> np.ndarray:
    """Return the index of each row's point, shape (N,); new points are refused, or have the indices
    -1, -2, ...
    """
    names = _names_of(table)
    found, inverse = np.unique(names, return_inverse=True)
    place = {name: i for i, name in enumerate(points.names)}
    new = [str(name) for name in found if str(name) not in place]
    if new and not may_be_new:
        row = int(np.flatnonzero(names == new[0])[0])
        raise MeasurementError(
            f"{table.source}, line {table.rows[row]}: point {new[0]!r} was not among those of the "
            f"calibration; expected {few(points.names, _LISTED)}"
        )
    index = np.array(
        [place[str(name)] if str(name) in place else -1 - new.index(str(name)) for name in found],
        int,
    )
    return index[inverse]


def centred(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return values, shape (N, 3, ...), minus the mean over the rows of the same point, as shape (3
    N, ...).
    """
    _, group, count = np.unique(index, return_inverse=True, return_counts=True)
    total = np.zeros((len(count), *values.shape[1:]))
    np.add.at(total, group, values)
    mean = total / count.reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((values - mean[group]).reshape(3 * len(values), *values.shape[2:]))


def solved(A: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the least-squares solution of A x = y, of minimum norm where it is not unique."""
    return np.asarray(np.linalg.lstsq(A, y, rcond=RANK)[0])
