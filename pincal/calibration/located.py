"""Initial poses of the robots of a cell relative to each other, found from the readings.

An instrument that sees two robots without being moved has both in its frame. A point of one robot
that is held at a point of the other, p on its hand (R_i, p_i) and s on the other's hand (S_i, s_i),
satisfies

    R (R_i p + p_i) + t = S_i s + s_i

with (R, t) the pose of the first relative to the second: linear in t, p and s, so that only R has
to be searched for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pincal.calibration.calibration_numbers import OTHER_ROWS
from pincal.identify.initial import base_seen, links_of, starts_of
from pincal.identify.options import Options
from pincal.identify.station import Station
from pincal.io.urdf_text import rpy_of
from pincal.measure.measurements import Measurements
from pincal.robot.cell import Beside
from pincal.robot.robot import Robot
from pincal.robot.se3 import transform
from pincal.robot.urdf_file import parse_urdf
from pincal.sensors.pose import PlausiblePositions
from pincal.sensors.row_samples import evenly
from pincal.sensors.socket import Coincidences
from pincal.thresholds import Count

# Contacts used to search for a rotation at most.
_MOST: Count = 300


def located(
    robot: Robot, others: Sequence[Beside], tables: Mapping[str, Measurements], options: Options
) -> tuple[Beside, ...]:
    """Return the robots of a cell other than the first with their poses, unknown ones as far as the
    readings determine them.

    In the cell, ``robot``, those of unknown pose coincide with the first robot.
    """
    found = []
    unknown = [of for of in others if of.place is None]
    for of in others:
        T = None if of.place is not None else _seen(robot, of, tables, options, unknown)
        if T is not None:
            place = (*T[:3, 3].tolist(), *rpy_of(T[:3, :3], np.zeros(3)).tolist())
            of = replace(of, place=place, is_found=True)
        found.append(of)
    return tuple(found)


def _seen(
    robot: Robot,
    of: Beside,
    tables: Mapping[str, Measurements],
    options: Options,
    unknown: Sequence[Beside],
) -> np.ndarray | None:
    """Return the pose of a robot, shape (4, 4), if an instrument sees it and another one, or
    contacts join them.
    """
    setups = dict[str, dict[bool, str]]()
    contacts = list[tuple[Station, list[str]]]()
    robot_of = _ownership(robot, of, unknown)
    for name, table in tables.items():
        links = links_of(table, robot.path)
        sensor = table.sensor
        sides = [robot_of(link) for link in links]
        if sensor is None or None in sides:
            continue
        at = options.at(name)
        at = replace(at, setup=at.setup.over(table))
        if issubclass(sensor, Coincidences) and sides[0] != sides[1]:
            station = starts_of(robot, table, at)[0][0]
            contacts.append((station, [links[sides.index(True)], links[sides.index(False)]]))
        elif table.setup and links[0] == robot.base and issubclass(sensor, PlausiblePositions):
            setups.setdefault(table.setup, {}).setdefault(bool(sides[1]), name)
    for both in setups.values():
        if len(both) == 2:
            first, second = (
                base_seen(robot, {both[k]: tables[both[k]]}, options) for k in (False, True)
            )
            return np.asarray(np.linalg.inv(first) @ second)
    if not contacts:
        return None
    return _touched(robot, *max(contacts, key=lambda contact: len(contact[0])))


def _ownership(robot: Robot, of: Beside, unknown: Sequence[Beside]) -> Callable[[str], bool | None]:
    """Return the function that says whether a link belongs to a robot of the cell, None if to
    another one of unknown pose.
    """
    tree = parse_urdf(robot.urdf, source=robot.source)
    holders = {link: {joint.name for joint in tree.above(link)} for link in tree.links}
    nowhere = {one.joint for one in unknown}

    def robot_of(link: str) -> bool | None:
        its = holders[link] & nowhere
        return None if its - {of.joint} else bool(its)

    return robot_of


@dataclass(frozen=True, eq=False)
class _Touches:
    """Contacts of points p on a hand with points s on another robot's hand.

    Attributes:
        T: shape (N, 4, 4), poses of the first hand.
        S: shape (N, 4, 4), poses of the other's.
        p: shape (N, k), 1 for the point of a contact on the first hand, 0 for the rest.
        s: shape (N, m), the same on the other's.
    """

    T: np.ndarray
    S: np.ndarray
    p: np.ndarray
    s: np.ndarray

    @classmethod
    def of(cls, robot: Robot, station: Station, links: Sequence[str]) -> _Touches:
        of_sensor = isinstance(station.sensor, Coincidences) and station.sensor.index
        is_tip = station.model.chain.path.tip == links[0]
        points = [
            np.unique(of, return_inverse=True)[1] for of in (station.conditions.target, of_sensor)
        ][:: 1 if is_tip else -1]
        T, S = (
            robot.forward_kinematics(
                station.conditions.q, robot.between(robot.base, link, at_rest=True)
            )
            for link in links
        )
        return cls(T, S, *(np.eye(of.max() + 1)[of] for of in points))

    @property
    def spare(self) -> int:
        """Equations beyond the unknowns."""
        return 3 * len(self.T) - (6 + 3 * int(self.p.shape[1] + self.s.shape[1]))

    @cached_property
    def of_other(self) -> np.ndarray:
        """How the points of the other hand enter the equations, shape (3 N, 3 m)."""
        turned = np.einsum("nij,nk->nikj", self.S[:, :3, :3], self.s)
        return np.asarray(turned.reshape(3 * len(self.S), -1))

    def solved(self, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals, shape (3 N,), and t, p and s for R as a rotation vector."""
        n = len(self.T)
        R = Rotation.from_rotvec(turn).as_matrix()
        own = np.einsum("il,nlj,nk->nikj", R, self.T[:, :3, :3], self.p).reshape(3 * n, -1)
        A = np.hstack([np.tile(np.eye(3), (n, 1)), own, -self.of_other])
        b = (self.S[:, :3, 3] - self.T[:, :3, 3] @ R.T).ravel()
        x = np.linalg.lstsq(A, b)[0]
        return b - A @ x, x


def _touched(robot: Robot, station: Station, links: Sequence[str]) -> np.ndarray | None:
    """Return the pose of a robot by contacts of its own link, the first, with the second; None if
    undetermined.
    """
    rows = evenly(len(station), _MOST)
    touches = _Touches.of(robot, station.select(rows), links)
    if touches.spare < OTHER_ROWS.spare:
        return None
    found = [
        least_squares(lambda turn: touches.solved(turn)[0], start)
        for start in Rotation.create_group("O").as_rotvec()
    ]
    best = min(found, key=lambda one: float(one.cost))
    here = Rotation.from_rotvec(best.x)
    others = [
        one.cost
        for one in found
        if (here.inv() * Rotation.from_rotvec(one.x)).magnitude() > OTHER_ROWS.elsewhere
    ]
    if others and best.cost > OTHER_ROWS.clear * min(others):
        return None
    return transform(here.as_matrix(), touches.solved(best.x)[1][:3])
