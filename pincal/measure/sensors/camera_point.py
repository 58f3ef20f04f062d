"""Points in space that a camera in the hand sees, such as the corners of a board whose pose was found from an image.

Where it starts: P - R_i (W c_i + t) = p_i with the point c_i in the camera's frame is linear in P and in the camera's place
t, W on the tool. P is eliminated by taking each point's rows about their mean.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from pincal.measure.extrinsics import Extrinsics
from pincal.measure.fields import POINT, Field, Table
from pincal.measure.plausible import check_spread
from pincal.measure.point_sensor import centred, index_of, solved
from pincal.measure.sensor import Block, Excluded, Plausible
from pincal.measure.sensors.camera import CameraSensor
from pincal.measure.setup import Setup
from pincal.parameters import Parameter
from pincal.robot.se3 import nearest_rotation, transform


@dataclass(frozen=True)
class CameraPointSensor(CameraSensor, Plausible):
    """3D: the point in the camera's frame, shape (N, 3) [m]."""

    kind: ClassVar[str] = "camera_point"
    fields: ClassVar[tuple[Field, ...]] = (Field("camera_point", ("cx", "cy", "cz"), "length"), POINT)
    blocks: ClassVar[tuple[Block, ...]] = (Block("position", "m", 3),)
    per_row: ClassVar[tuple[str, ...]] = ("index", "camera_point")
    has_scale: ClassVar[bool] = True
    deviation_end: ClassVar[str] = "where the camera would have to be for its reading"

    camera_point: np.ndarray

    @classmethod
    def of(cls, table: Table, setup: Setup) -> Self:
        """Return the points of a table."""
        points = setup.named()
        return cls(points, index_of(table, points), table.array("camera_point"))

    @property
    def own_parameters(self) -> tuple[Parameter, ...]:
        """Coordinates of the unknown points."""
        return self.points.parameters

    def shifted(self, change: np.ndarray) -> Self:
        """Return points moved by ``change``, shape (3, N) [m]."""
        return replace(self, camera_point=self.camera_point + change.T)

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction, shape (3, N) [m]."""
        return np.asarray((self.camera_point - self.seen(poses, own)).T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion of the point in the camera's frame."""
        by_place = poses[:, :, :3].transpose(1, 2, 0)
        return np.concatenate([self.seen_motion(poses, motion, own), self.by_points(by_place)])

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return how far the camera is off: opposite to the point in its frame."""
        return np.asarray(-np.einsum("nij,jn->ni", poses[:, :, :3], residuals))

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield the camera's place in the hand in which the points of the object stand still."""
        p, R, c = tips[:, :, 3], tips[:, :, :3], self.camera_point
        products = np.einsum("nab,nc->nabc", R, c).reshape(len(p), 3, 9)
        A = np.concatenate([products, R], axis=2)
        W = nearest_rotation(solved(-centred(A, self.index), centred(p, self.index))[:9].reshape(3, 3))
        seen = np.einsum("nab,bc,nc->na", R, W, c)
        t = solved(-centred(R, self.index), centred(p + seen, self.index))
        yield self.start_at_means(p + seen + R @ t, transform(W, t)[None])

    @property
    def impossible(self) -> Excluded:
        """Points behind the camera."""
        behind = self.camera_point[:, 2] <= 0.0
        return Excluded(behind, "have cz <= 0, a point behind the camera", "points in front of the camera")

    @classmethod
    def check_plausible(cls, table: Table, reach_m: float) -> None:
        """Refuse points whose distances from the camera differ by more than the arm can span."""
        ranges = np.linalg.norm(table.array("camera_point"), axis=1, keepdims=True)
        check_spread(table, ranges, label="cx", reach_m=reach_m)
