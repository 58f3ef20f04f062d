"""Contacts without any instrument: of the tool point with sockets, and between points of two links
of the robot.

The tool point is held in sockets, so that its distance from a socket is zero. Between links, balls
touch at a known distance of their centres, or points coincide: each row names two points,
``LINK:NAME`` each, and their distance. The path leads from the first link to the second, which take
the roles of base and tool, and the points are fixed to them. Points of the same name in several
tables or pairs of links are the same.

Starts: a fixed point P and a tool t satisfy P - R_i t = p_i, linear in P and t, with the nominal
arm's poses (R_i, p_i). P is eliminated by subtracting the mean over each point's rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from pincal.errors import MeasurementError
from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.robot.se3 import transform
from pincal.sensors.distance import PointDistances
from pincal.sensors.extrinsics import Extrinsics, by_target
from pincal.sensors.fields import FIRST, NOT_NEGATIVE, SECOND, Field, link_of
from pincal.sensors.point_sensor import PointSensor, centred, solved
from pincal.sensors.sensor import Block, Divided, Simulatable
from pincal.sensors.setup import NamedPoints

_SCALE = (
    "contacts without a known length do not determine the scale of the robot, which relies on "
    "its nominal lengths"
)


@dataclass(frozen=True)
class Coincidences(PointSensor):
    """3D: coincidence of the target with a named point.

    Rows of a point that is not among ``points`` (``index`` -1, -2, ...) are judged by their
    distance from their own mean.

    Attributes:
        shift: shape (N, 3), offset of each row's target from its point [m]; None for zero.
    """

    blocks: ClassVar[tuple[Block, ...]] = (Block("position", "m", 3),)
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS[:3]
    twist_rows: ClassVar[int] = 3
    is_of_joints: ClassVar[bool] = True
    per_row: ClassVar[tuple[str, ...]] = ("index", "shift")
    fewest: ClassVar[int] = 2
    impossible: ClassVar[None] = None
    other_parameters: ClassVar[tuple[Parameter, ...]] = ()

    shift: np.ndarray | None = None

    @property
    def needs_all_rows(self) -> bool:
        """Whether some rows are judged by their own mean."""
        return bool(np.any(self.index < 0))

    def shifted(self, change: np.ndarray) -> Self:
        return replace(self, shift=change.T if self.shift is None else change.T + self.shift)

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        places = self.points.positions(own)
        place = places[np.maximum(self.index, 0)].T if len(places) else np.zeros((3, len(self)))
        place = self._about_means(poses[:, :, 3].T, place)
        found = place - poses[:, :, 3].T
        return np.asarray(found if self.shift is None else found + self.shift.T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion of the tool point minus the socket's."""
        if self.is_whole and len(motion):
            motion = motion - np.stack(
                [self._about_means(column, np.zeros_like(column)) for column in motion]
            )
        by_place = np.zeros((3, 3, len(self)))
        by_place[[0, 1, 2], [0, 1, 2]] = -1.0
        return np.concatenate([motion, self.by_points(by_place)])

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return residuals.T

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield tool points at the tip, then those that move least in their sockets."""
        p = tips[:, :, 3]
        R = tips[:, :, :3]
        columns = by_target(R, target, n_targets)
        offsets = solved(-centred(columns, self.index), centred(p, self.index))
        yield self.start_at_means(p, np.tile(np.eye(4), (n_targets, 1, 1)))
        yield self.start_at_means(
            p + columns @ offsets, transform(np.eye(3), offsets.reshape(n_targets, 3))
        )

    def _about_means(self, values: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Return ``place``, shape (3, N), with unknown points at the mean of their rows'
        ``values``, shape (3, N).
        """
        for unknown in np.unique(self.index[self.index < 0]):
            rows = self.index == unknown
            place[:, rows] = values[:, rows].mean(axis=1, keepdims=True)
        return place


@dataclass(frozen=True)
class ContactSensor(Coincidences, Simulatable):
    """3D: coincidence of the tool point with its socket; new sockets are judged by their means."""

    kind: ClassVar[str] = "socket"
    fields: ClassVar[tuple[Field, ...]] = (Field("socket", ("socket",), "name"),)
    names_points: ClassVar[str | None] = "socket"
    deviation_end: ClassVar[str] = "the socket"
    thing: ClassVar[str] = "a socket"
    judges_new_points: ClassVar[bool] = True
    needs_places: ClassVar[bool] = True

    @classmethod
    def simulated(cls, poses: np.ndarray, places: np.ndarray | None = None) -> Self:
        """Return contacts in sockets of unknown position, named socket_1, socket_2, ..."""
        assert places is not None, "contacts need places"
        points = poses[:, :, 3]
        index = np.linalg.norm(points[:, None] - places, axis=2).argmin(axis=1)
        return cls(
            NamedPoints({f"socket_{k + 1}": None for k in range(len(places))}),
            index,
            points - places[index],
        )

    def unobservable_with(self, known: int) -> Iterator[str]:
        if not known:
            yield (
                "contacts determine only the relative geometry of the arm, not the pose of its base"
            )
        if known < 2 and not self.points.distances:
            yield (
                "contacts without a known length do not determine the scale of the arm, "
                "which relies on its nominal "
                "lengths: give the distance between two sockets (--socket-distance A B METRES)"
            )


def between_links(table: Any) -> Any:
    """Return a table of contacts with the links of their points, and the second point as the
    target.

    Raises:
        MeasurementError: for a point that is not LINK:NAME, or two points of one link.
    """
    links = []
    for field in (FIRST, SECOND):
        names, first, inverse = np.unique(
            table.array(field.name), return_index=True, return_inverse=True
        )
        where = (f'{table.source}, line {table.rows[row]}, "{field}"' for row in first)
        links.append(
            np.array([link_of(str(name), where=at) for name, at in zip(names, where, strict=True)])[
                inverse
            ]
        )
    if np.any(same := links[0] == links[1]):
        line = table.rows[same][0]
        link = links[0][same][0]
        raise MeasurementError(
            f"{table.source}, line {line}: both points are on {link}; expected points of two links"
        )
    return replace(table, from_link=links[0], to_link=links[1], target=table.array(SECOND.name))


@dataclass(frozen=True)
class LinkDistanceSensor(PointDistances, Divided):
    """1D: known distances, shape (N,) [m], between points of two links, such as the centres of
    balls that touch.
    """

    kind: ClassVar[str] = "contact distance"
    is_of_joints: ClassVar[bool] = True
    fields: ClassVar[tuple[Field, ...]] = (
        Field("distance", ("distance",), "length", NOT_NEGATIVE),
        FIRST,
        SECOND,
    )
    names_points: ClassVar[str | None] = "first"
    thing: ClassVar[str] = "a point of a link"
    deviation_end: ClassVar[str] = "the point that it touches"
    in_link_frame: ClassVar[bool] = True

    @classmethod
    def parts(cls, table: Any) -> Iterator[tuple[str, Any]]:
        """Yield contacts at a distance, and coincidences, which are readings in three
        directions.
        """
        whole = between_links(table)
        distance = table.array("distance")
        if (apart := distance > 0.0).any():
            yield "distance", whole.select(apart)
        if not apart.all():
            rows = whole.select(~apart)
            yield (
                "contact",
                replace(
                    rows,
                    readings={
                        FIRST.name: rows.array(FIRST.name),
                        SECOND.name: rows.array(SECOND.name),
                    },
                ),
            )

    def unobservable_with(self, known: int) -> Iterator[str]:
        """Yield nothing: distances determine the scale, and the points belong to the robot."""
        yield from ()


@dataclass(frozen=True)
class LinkContactSensor(Coincidences, Divided):
    """3D: coincidence of points of two links, such as a ball of one hand in a socket of
    the other.
    """

    kind: ClassVar[str] = "contact"
    fields: ClassVar[tuple[Field, ...]] = (FIRST, SECOND)
    names_points: ClassVar[str | None] = "first"
    thing: ClassVar[str] = "a point of a link"
    deviation_end: ClassVar[str] = "the point that it meets"
    in_link_frame: ClassVar[bool] = True

    @classmethod
    def parts(cls, table: Any) -> Iterator[tuple[str, Any]]:
        """Yield all contacts."""
        yield "contact", between_links(table)

    def unobservable_with(self, known: int) -> Iterator[str]:
        """Yield the scale."""
        if known < 2:
            yield _SCALE
