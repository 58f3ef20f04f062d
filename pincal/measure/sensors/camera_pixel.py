"""Images of points that a camera in the hand sees; the camera's lens is known or found along with everything else.

Where it starts: :mod:`pincal.measure.triangulation` lays the lines of sight so that they meet in the points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from pincal.measure.extrinsics import Extrinsics
from pincal.measure.fields import POINT, Field, Table
from pincal.measure.lens import NEAREST, Lens
from pincal.measure.point_sensor import index_of
from pincal.measure.rows import some_rows
from pincal.measure.sensor import Block, KnownParameters
from pincal.measure.sensors.camera import CameraSensor
from pincal.measure.setup import Setup
from pincal.measure.triangulation import Views, camera_starts
from pincal.parameters import Parameter
from pincal.robot.se3 import transform

# Rows of the first search.
_SAMPLE = 300


@dataclass(frozen=True)
class CameraPixelSensor(CameraSensor, KnownParameters):
    """2D: the point's image, shape (N, 2) [px].

    Attributes:
        setup: what is known of the camera.
    """

    kind: ClassVar[str] = "camera_pixel"
    fields: ClassVar[tuple[Field, ...]] = (Field("pixel", ("u", "v"), "pixel"), POINT)
    blocks: ClassVar[tuple[Block, ...]] = (Block("image", "px", 2, rounding=1e-9, noise=0.1, axes="uv"),)
    per_row: ClassVar[tuple[str, ...]] = ("index", "pixel")
    has_scale: ClassVar[bool] = False
    impossible: ClassVar[None] = None
    deviation_end: ClassVar[str] = "the part across the view that the image tells"

    pixel: np.ndarray
    setup: Setup

    @classmethod
    def of(cls, table: Table, setup: Setup) -> Self:
        """Return the images of a table."""
        points = setup.named()
        return cls(points, index_of(table, points), table.array("pixel"), setup)

    @property
    def own_parameters(self) -> tuple[Parameter, ...]:
        """Coordinates of the unknown points, then the camera's own."""
        return self.points.parameters + self.setup.lens_parameters()

    @property
    def known_parameters(self) -> np.ndarray:
        """The camera's parameters where it is known, and always those that a usual lens does not have."""
        return np.concatenate([np.zeros(len(self.points.parameters), bool), self.setup.lens_fixed()])

    @property
    def is_given(self) -> bool:
        """Whether the user gave the camera."""
        return self.setup.lens is not None

    @property
    def doubt(self) -> str:
        """The images don't fit the camera."""
        return "the images call for another camera than the given one: --fit-camera finds its parameters"

    def lens(self, own: np.ndarray) -> Lens:
        """Return the camera for values of the sensor's parameters."""
        parameters = self.setup.lens_parameters()
        return Lens(*(p.nominal + value for p, value in zip(parameters, own[-len(parameters) :], strict=True)))

    def shifted(self, change: np.ndarray) -> Self:
        """Return images moved by ``change``, shape (2, N) [px]."""
        return replace(self, pixel=self.pixel + change.T)

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction, shape (2, N) [px]."""
        return np.asarray((self.pixel - self.lens(own).project(self.seen(poses, own))).T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion of the image, by the point's motion and by the camera's parameters."""
        _, by_seen, by_lens = self.lens(own).linearise(self.seen(poses, own))
        moved = np.einsum("nab,pbn->pan", by_seen, self.seen_motion(poses, motion, own))
        by_place = np.einsum("nab,nib->ian", by_seen, poses[:, :, :3])
        return np.concatenate([moved, self.by_points(by_place), by_lens.transpose(2, 1, 0)])

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the part across the view, at the distance of the point."""
        depth, lens = np.maximum(self.seen(poses, own)[:, 2], NEAREST), self.lens(own)
        across = np.stack([residuals[0] / lens.fx * depth, residuals[1] / lens.fy * depth, 0.0 * depth])
        return np.asarray(-np.einsum("nij,jn->ni", poses[:, :, :3], across))

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield the best places and focal lengths of the camera."""
        rows = some_rows(len(self), _SAMPLE, self.groups)
        views = Views(self.index, len(self.points.names), tips, self.pixel)
        nominal = np.array([parameter.nominal for parameter in self.setup.lens_parameters()])
        for found in camera_starts(views, self.setup.lens, rows=rows):
            hand = transform(found.rotation, found.camera)
            yield self.start_with_points(found.points, hand[None], rest=found.lens.values - nominal)
