"""Sensors that have to do with named points which stand still: contacts, distances from anchors.

A point is known in the instrument's frame, or its coordinates are parameters of the sensor; see
:class:`pincal.measure.setup.NamedPoints`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from pincal.measure.sensors import Block, Constraints, Sensor
from pincal.measure.setup import NamedPoints
from pincal.parameters import FRAME_SYMBOLS, Parameter


@dataclass(frozen=True)
class PointSensor(Sensor):
    """Readings that each have to do with one named point.

    Attributes:
        points: the named points.
        index: shape (N,), each row's point.
    """

    points: NamedPoints
    index: np.ndarray

    def __len__(self) -> int:
        return len(self.index)

    @property
    def groups(self) -> np.ndarray:
        """The point of each row."""
        return self.index

    @property
    def base_symbols(self) -> tuple[str, ...]:
        """All if any point is known in a frame of its own; else the robot's base is that frame."""
        return FRAME_SYMBOLS if self.points.known.any() else ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coordinates of the unknown points."""
        return self.points.parameters

    def constraints(self, own: np.ndarray) -> Constraints | None:
        """Return the known distances between points."""
        gaps = self.points.distances
        if not gaps:
            return None
        names, places = self.points.names, self.points.positions(own)
        jacobian = np.zeros((len(own), len(gaps)))
        residuals = np.empty(len(gaps))
        for c, gap in enumerate(gaps):
            ends = names.index(gap.first), names.index(gap.second)
            line = places[ends[0]] - places[ends[1]]
            length = max(float(np.linalg.norm(line)), 1e-12)
            residuals[c] = gap.length - length
            for end, sign in zip(ends, (1.0, -1.0), strict=True):
                slot = int(self.points.slot[end])
                if slot >= 0:
                    jacobian[3 * slot : 3 * slot + 3, c] += sign * line / length
        return Constraints(residuals, jacobian, np.array([gap.sigma for gap in gaps]))

    def _by_points(self, by_place: np.ndarray) -> np.ndarray:
        """Return the derivative by the unknown points, shape (own, m, N), from that by each row's, shape (3, m, N)."""
        out = np.zeros((len(self.points.parameters), *by_place.shape[1:]))
        slot = self.points.slot[self.index]
        for k in range(len(out) // 3):
            rows = slot == k
            out[3 * k : 3 * k + 3, :, rows] = by_place[:, :, rows]
        return out


@dataclass(frozen=True)
class ContactSensor(PointSensor):
    """No instrument: the tool point is held in sockets, so that its distance from a socket is zero.

    Rows in a socket that ``points`` do not know (``index`` -1 and below, one number a socket) are judged by their distance
    from their own mean: how well the model keeps the tool point in one place.
    """

    kind: ClassVar[str] = "socket"
    blocks: ClassVar[tuple[Block, ...]] = (Block("position", "m", 3),)
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS[:3]
    twist_rows: ClassVar[int] = 3
    shift: np.ndarray = field(default_factory=lambda: np.zeros((3, 0)))

    @property
    def is_whole(self) -> bool:
        """Whether some rows are judged by their own mean."""
        return bool(np.any(self.index < 0))

    def select(self, rows: slice | np.ndarray) -> ContactSensor:
        """Return the contacts of some rows."""
        shift = self.shift[:, rows] if self.shift.size else self.shift
        return replace(self, index=self.index[rows], shift=shift)

    def shifted(self, change: np.ndarray) -> ContactSensor:
        """Return contacts whose point sits off its socket by ``change``, shape (3, N) [m]."""
        return replace(self, shift=change + self.shift if self.shift.size else change)

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return socket minus tool point, shape (3, N) [m]."""
        places = self.points.positions(own)
        place = places[np.maximum(self.index, 0)].T if len(places) else np.zeros((3, len(self)))
        place = self._about_means(poses[:, :, 3].T, place)
        found = place - poses[:, :, 3].T
        return np.asarray(found + self.shift if self.shift.size else found)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion of the tool point, and minus that of the socket."""
        if self.is_whole and len(motion):
            motion = motion - np.stack([self._about_means(column, np.zeros_like(column)) for column in motion])
        by_place = np.zeros((3, 3, len(self)))
        by_place[[0, 1, 2], [0, 1, 2]] = -1.0
        return np.concatenate([motion, self._by_points(by_place)])

    def _about_means(self, values: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Put the mean of ``values``, shape (3, N), in place of what is not known."""
        for unknown in np.unique(self.index[self.index < 0]):
            rows = self.index == unknown
            place[:, rows] = values[:, rows].mean(axis=1, keepdims=True)
        return place


@dataclass(frozen=True)
class DistanceSensor(Sensor):
    """1D: the distance, shape (N,) [m], from the instrument's point to the target.

    The instrument's frame stands at this point and is parallel to the robot's base: a distance sees no orientation.
    """

    distance: np.ndarray
    kind: ClassVar[str] = "distance"
    blocks: ClassVar[tuple[Block, ...]] = (Block("distance", "m", 1),)
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS[:3]
    twist_rows: ClassVar[int] = 3

    def __len__(self) -> int:
        return len(self.distance)

    @property
    def base_symbols(self) -> tuple[str, ...]:
        """Where the base is, not how it is turned."""
        return FRAME_SYMBOLS[:3]

    def select(self, rows: slice | np.ndarray) -> DistanceSensor:
        """Return the readings of some rows."""
        return replace(self, distance=self.distance[rows])

    def shifted(self, change: np.ndarray) -> DistanceSensor:
        """Return distances longer by ``change``, shape (1, N) [m]."""
        return replace(self, distance=self.distance + change[0])

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction, shape (1, N) [m]."""
        return np.asarray(self.distance - np.linalg.norm(poses[:, :, 3], axis=1))[None]

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion along the line of sight."""
        return np.asarray(np.einsum("ni,pin->pn", self._direction(poses), motion)[:, None])

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the part along the line of sight."""
        return np.asarray(residuals[0][:, None] * self._direction(poses))

    @staticmethod
    def _direction(poses: np.ndarray) -> np.ndarray:
        return np.asarray(poses[:, :, 3] / np.linalg.norm(poses[:, :, 3], axis=1, keepdims=True))


@dataclass(frozen=True)
class AnchoredDistanceSensor(PointSensor):
    """1D: distances, shape (N,) [m], each from a named anchor to the target; a ball-bar's length is one, too."""

    distance: np.ndarray
    kind: ClassVar[str] = "distance"
    blocks: ClassVar[tuple[Block, ...]] = DistanceSensor.blocks
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS[:3]
    twist_rows: ClassVar[int] = 3

    def select(self, rows: slice | np.ndarray) -> AnchoredDistanceSensor:
        """Return the readings of some rows."""
        return replace(self, index=self.index[rows], distance=self.distance[rows])

    def shifted(self, change: np.ndarray) -> AnchoredDistanceSensor:
        """Return distances longer by ``change``, shape (1, N) [m]."""
        return replace(self, distance=self.distance + change[0])

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction, shape (1, N) [m]."""
        return np.asarray(self.distance - np.linalg.norm(self._lines(poses, own), axis=0))[None]

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion along the line of sight, of the target and of its anchor."""
        direction = self._direction(poses, own)
        along = np.einsum("in,pin->pn", direction, motion)[:, None]
        return np.concatenate([along, self._by_points(-direction[:, None])])

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the part along the line of sight."""
        return np.asarray(residuals[0][:, None] * self._direction(poses, own).T)

    def _direction(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        lines = self._lines(poses, own)
        return np.asarray(lines / np.maximum(np.linalg.norm(lines, axis=0), 1e-12))

    def _lines(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the way from anchor to target, shape (3, N) [m]."""
        return np.asarray(poses[:, :, 3].T - self.points.positions(own)[self.index].T)
