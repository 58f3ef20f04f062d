"""Contacts between points of two links of the robot: balls at a known distance of their centres, or points that coincide.

Each row names two points, each ``LINK:NAME``, and their distance. The path leads from the first link to the second: what is
"base" and "tool" elsewhere are the two links here, and the points are places on them, which do not move. A point that
several tables or pairs of links have in common is the same one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.fields import FIRST, NOT_NEGATIVE, SECOND, Field, TableRows, link_of
from pincal.measure.point_sensor import index_of
from pincal.measure.sensor import Divided
from pincal.measure.sensors.distance import PointDistances
from pincal.measure.sensors.socket import Coincidences
from pincal.measure.setup import Setup

_SCALE = "contacts without a known length do not determine the scale of the robot, which relies on its nominal lengths"


def between_links(table: Any) -> Any:
    """Return a table of contacts with the links of their points, the second point as the target.

    Raises:
        MeasurementError: for a point that is not LINK:NAME, or two of one link.
    """
    links = []
    for field in (FIRST, SECOND):
        names, first, inverse = np.unique(table.array(field.name), return_index=True, return_inverse=True)
        where = (f'{table.source}, line {table.rows[row]}, "{field}"' for row in first)
        links.append(np.array([link_of(str(name), where=at) for name, at in zip(names, where, strict=True)])[inverse])
    if np.any(same := links[0] == links[1]):
        line, link = table.rows[same][0], links[0][same][0]
        raise MeasurementError(f"{table.source}, line {line}: both points are on {link}; expected points of two links")
    return replace(table, from_link=links[0], to_link=links[1], target=table.array(SECOND.name))


@dataclass(frozen=True)
class LinkDistanceSensor(PointDistances, Divided):
    """1D: known distances, shape (N,) [m], between points of two links, such as the centres of balls that touch."""

    kind: ClassVar[str] = "contact distance"
    is_of_joints: ClassVar[bool] = True
    fields: ClassVar[tuple[Field, ...]] = (Field("distance", ("distance",), "length", NOT_NEGATIVE), FIRST, SECOND)
    names_points: ClassVar[str | None] = "first"
    thing: ClassVar[str] = "a point of a link"
    deviation_end: ClassVar[str] = "the point that it touches"
    in_link_frame: ClassVar[bool] = True

    @classmethod
    def of(cls, table: TableRows, setup: Setup) -> Self:
        """Return the distances of a table."""
        points = setup.named()
        return cls(points=points, index=index_of(table, points), distance=table.array("distance"))

    @classmethod
    def parts(cls, table: Any) -> Iterator[tuple[str, Any]]:
        """Yield contacts at a distance, and those of points that coincide, which are read in three directions."""
        whole, distance = between_links(table), table.array("distance")
        if (apart := distance > 0.0).any():
            yield "distance", whole.select(apart)
        if not apart.all():
            rows = whole.select(~apart)
            yield (
                "contact",
                replace(rows, readings={FIRST.name: rows.array(FIRST.name), SECOND.name: rows.array(SECOND.name)}),
            )

    def unobservable_with(self, known: int) -> Iterator[str]:
        """Yield nothing: the distance of the contact is a length, and the points belong to the robot."""
        yield from ()


@dataclass(frozen=True)
class LinkContactSensor(Coincidences, Divided):
    """3D: coincidence of points of two links, such as a ball of one hand in a socket of the other."""

    kind: ClassVar[str] = "contact"
    fields: ClassVar[tuple[Field, ...]] = (FIRST, SECOND)
    names_points: ClassVar[str | None] = "first"
    thing: ClassVar[str] = "a point of a link"
    deviation_end: ClassVar[str] = "the point that it meets"
    in_link_frame: ClassVar[bool] = True

    @classmethod
    def of(cls, table: TableRows, setup: Setup) -> Self:
        """Return the contacts of a table."""
        points = setup.named()
        return cls(points, index_of(table, points))

    @classmethod
    def parts(cls, table: Any) -> Iterator[tuple[str, Any]]:
        """Yield all contacts."""
        yield "contact", between_links(table)

    def unobservable_with(self, known: int) -> Iterator[str]:
        """Yield the scale."""
        if known < 2:
            yield _SCALE
