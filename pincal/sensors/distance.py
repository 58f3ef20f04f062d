r"""Distances to a target from the instrument, or from several named anchors, such as those of a
ball-bar.

Starts: with the nominal arm's poses (R_i, p_i), c the vector from the instrument's point to the
base, and the tool t, d_i^2 = |p_i|^2 + 2 p_i.c + 2 (R_i^T p_i).t + 2 c^T R_i t + const is linear in
c, t and c (x) t.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Self, final

import numpy as np

from pincal.errors import MeasurementError
from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.robot.se3 import transform
from pincal.sensors.extrinsics import Extrinsics, by_target, least_squares
from pincal.sensors.fields import POSITIVE, Field, TableRows
from pincal.sensors.point_sensor import PointSensor
from pincal.sensors.pose import check_spread
from pincal.sensors.sensor import Additive, Block, Plausible, Simulatable
from pincal.sensors.sensor_numbers import PLAUSIBLE
from pincal.sensors.setup import Setup

DISTANCE = Field("distance", ("distance",), "length", POSITIVE)
_NO_BASE = "distances do not determine the pose of the base, only the arm relative to its anchors"


@dataclass(frozen=True)
class Distances(Additive, Plausible):
    """1D: distances, shape (N,) [m], each along a line of sight to the target."""

    kind: ClassVar[str] = "distance"
    blocks: ClassVar[tuple[Block, ...]] = (Block("distance", "m", 1),)
    follows: ClassVar[str] = "squared"
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS[:3]
    twist_rows: ClassVar[int] = 3
    deviation_end: ClassVar[str] = "the part along the line of sight"

    distance: np.ndarray

    @abstractmethod
    def lines(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the lines of sight, from the origin of each distance to the target, shape (3, N)
        [m].
        """

    @final
    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.asarray(self.distance - np.linalg.norm(self.lines(poses, own), axis=0))[None]

    @final
    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion of both ends along the line of sight."""
        direction = self._direction(poses, own)
        along = np.einsum("in,pin->pn", direction, motion)[:, None]
        by_own = self.by_own(direction)
        return np.concatenate([along, by_own]) if len(by_own) else along

    @abstractmethod
    def by_own(self, direction: np.ndarray) -> np.ndarray:
        """Return the derivative with respect to own parameters, shape (own, 1, N), for lines of
        sight of length 1.
        """

    @final
    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.asarray(residuals[0][:, None] * self._direction(poses, own).T)

    def _direction(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        lines = self.lines(poses, own)
        return np.asarray(lines / np.maximum(np.linalg.norm(lines, axis=0), 1e-12))

    @classmethod
    @final
    def check_plausible(cls, table: TableRows, reach_m: float) -> None:
        distance = table.array("distance")
        check_spread(table, distance[:, None], label="distance", reach_m=reach_m)
        middle = float(np.median(distance))
        longest = float(distance.max())
        unit = table.units.get("distance", "m")
        if middle > PLAUSIBLE.farthest:
            raise MeasurementError(
                f"{table.source}: distance of {middle:.4g} m under the unit [{unit}]; expected at "
                f"most {PLAUSIBLE.farthest:g} m; looks like millimetres: write `distance [mm]`, or "
                "their unit"
            )
        if longest < PLAUSIBLE.nearest * reach_m:
            raise MeasurementError(
                f"{table.source}: distance of at most {longest * 1000:.3g} mm; expected the whole "
                f"distance, not a deviation; values in metres under [{unit}]? Then write "
                "`distance [m]`"
            )


@dataclass(frozen=True)
class DistanceSensor(Distances, Simulatable):
    """1D: the distance, shape (N,) [m], from the instrument's point to the target.

    The instrument's frame has its origin at this point and is parallel to the robot's base, as
    distances determine no orientation.
    """

    fields: ClassVar[tuple[Field, ...]] = (DISTANCE,)
    base_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS[:3]
    per_row: ClassVar[tuple[str, ...]] = ("distance",)
    needs_instrument: ClassVar[bool] = True

    @classmethod
    def of(cls, table: TableRows, setup: Setup) -> Self:
        return cls(table.array("distance"))

    @classmethod
    def simulated(cls, poses: np.ndarray, places: np.ndarray | None = None) -> Self:
        return cls(np.linalg.norm(poses[:, :, 3], axis=1))

    def lines(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return poses[:, :, 3].T

    def by_own(self, direction: np.ndarray) -> np.ndarray:
        return np.zeros((0, 1, direction.shape[1]))

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield the base for targets at the tip, then base and targets by the distances."""
        return _starts(self.distance, tips, target, n_targets)

    def unobservable(self) -> Iterator[str]:
        yield _NO_BASE


@dataclass(frozen=True)
class PointDistances(Distances, PointSensor):
    """1D: distances, shape (N,) [m], each from a named point to the target."""

    per_row: ClassVar[tuple[str, ...]] = ("index", "distance")
    fewest: ClassVar[int] = 4
    needs_all_rows: ClassVar[bool] = False
    impossible: ClassVar[None] = None
    other_parameters: ClassVar[tuple[Parameter, ...]] = ()

    def lines(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.asarray(poses[:, :, 3].T - self.points.positions(own)[self.index].T)

    def by_own(self, direction: np.ndarray) -> np.ndarray:
        return self.by_points(-direction[:, None])

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield anchors by their own distances, with the tool as the mean over the anchors."""
        found = [
            list(_starts(self.distance[rows], tips[rows], target[rows], n_targets))
            if rows.any()
            else []
            for rows in (self.index == k for k in range(len(self.points.names)))
        ]
        for deep in (False, True):
            chosen = [
                starts[min(int(deep), len(starts) - 1)] if starts else None for starts in found
            ]
            anchors = np.array(
                [np.zeros(3) if start is None else -start.base[:3, 3] for start in chosen]
            )
            tools = np.mean([start.tools for start in chosen if start is not None], axis=0)
            yield self.start_with_points(anchors, tools)


@dataclass(frozen=True)
class AnchoredDistanceSensor(PointDistances):
    """1D: distances, shape (N,) [m], each from a named anchor to the target, such as the length of
    a ball-bar.
    """

    fields: ClassVar[tuple[Field, ...]] = (DISTANCE, Field("anchor", ("anchor",), "name"))
    names_points: ClassVar[str | None] = "anchor"
    thing: ClassVar[str] = "an anchor"

    def unobservable_with(self, known: int) -> Iterator[str]:
        """Yield the pose of the base if no anchor is known, and a note on single anchors."""
        if not known:
            yield _NO_BASE
        if len(self.points.names) == 1:
            yield (
                "distances from one anchor measure one direction per pose: several anchors around "
                "the arm give more information"
            )


def _starts(
    d: np.ndarray, tips: np.ndarray, target: np.ndarray, n_targets: int
) -> Iterator[Extrinsics]:
    """Yield the poses by distances ``d`` from one point, shape (N,); tools at the tip, then as
    measured.
    """
    p = tips[:, :, 3]
    R = tips[:, :, :3]
    tools = np.tile(np.eye(4), (n_targets, 1, 1))
    squares = (d**2 - np.einsum("ni,ni->n", p, p))[:, None]
    solution, _ = least_squares(np.hstack([2.0 * p, np.ones((len(p), 1))]), squares)
    yield Extrinsics(transform(np.eye(3), solution[:3, 0]), tools)
    lever = by_target(2.0 * np.einsum("nji,nj->ni", R, p), target, n_targets)
    products = by_target(2.0 * R.reshape(-1, 9), target, n_targets)
    constants = by_target(np.ones((len(p), 1)), target, n_targets)
    solution, complete = least_squares(np.hstack([2.0 * p, lever, products, constants]), squares)
    if complete:
        found = solution[3 : 3 + 3 * n_targets, 0].reshape(n_targets, 3)
        yield Extrinsics(transform(np.eye(3), solution[:3, 0]), transform(np.eye(3), found))
