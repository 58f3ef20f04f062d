"""Sensors of a camera in the robot's hand that sees named points of a calibration object which stands still.

The target on the tool is the camera's frame (z along the view, x to the right, y down), the instrument's frame that of the
object. Where no point of the object is known, its points are found in the robot's base frame (paper, section IV.A).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pincal.measure.lens import NEAREST, Lens
from pincal.measure.points import PointSensor
from pincal.measure.sensors import Block
from pincal.measure.setup import Setup
from pincal.parameters import FRAME_SYMBOLS, Parameter


@dataclass(frozen=True)
class _CameraSensor(PointSensor):
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS
    twist_rows: ClassVar[int] = 6

    def seen(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return each row's point in the camera's frame, shape (N, 3) [m]."""
        away = self.points.positions(own)[self.index] - poses[:, :, 3]
        return np.asarray(np.einsum("nij,ni->nj", poses[:, :, :3], away))

    def _moved(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return how each row's point moves in the camera's frame, shape (P, 3, N)."""
        away = (self.points.positions(own)[self.index] - poses[:, :, 3]).T
        shift, turn = motion[:, :3], motion[:, 3:]
        moved = -shift - np.stack(
            [
                turn[:, 1] * away[2] - turn[:, 2] * away[1],
                turn[:, 2] * away[0] - turn[:, 0] * away[2],
                turn[:, 0] * away[1] - turn[:, 1] * away[0],
            ],
            axis=1,
        )
        return np.asarray(np.einsum("nij,pin->pjn", poses[:, :, :3], moved))


@dataclass(frozen=True)
class CameraPointSensor(_CameraSensor):
    """3D: the point in the camera's frame, shape (N, 3) [m]."""

    camera_point: np.ndarray
    kind: ClassVar[str] = "camera_point"
    blocks: ClassVar[tuple[Block, ...]] = (Block("position", "m", 3),)

    def select(self, rows: slice | np.ndarray) -> CameraPointSensor:
        """Return the readings of some rows."""
        return replace(self, index=self.index[rows], camera_point=self.camera_point[rows])

    def shifted(self, change: np.ndarray) -> CameraPointSensor:
        """Return points moved by ``change``, shape (3, N) [m]."""
        return replace(self, camera_point=self.camera_point + change.T)

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction, shape (3, N) [m]."""
        return np.asarray((self.camera_point - self.seen(poses, own)).T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion of the point in the camera's frame."""
        by_place = poses[:, :, :3].transpose(1, 2, 0)
        return np.concatenate([self._moved(poses, motion, own), self._by_points(by_place)])

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return how far the camera is off: the other way round than the point in its frame."""
        return np.asarray(-np.einsum("nij,jn->ni", poses[:, :, :3], residuals))


@dataclass(frozen=True)
class CameraPixelSensor(_CameraSensor):
    """2D: the point's image, shape (N, 2) [px].

    Attributes:
        setup: what is known of the camera.
    """

    pixel: np.ndarray
    setup: Setup
    kind: ClassVar[str] = "camera_pixel"
    blocks: ClassVar[tuple[Block, ...]] = (Block("image", "px", 2, rounding=1e-9),)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coordinates of the unknown points, then the camera's own."""
        return self.points.parameters + self.setup.lens_parameters()

    @property
    def fixed(self) -> np.ndarray:
        """The camera's parameters where it is known, and always those that a usual lens does not have."""
        return np.concatenate([np.zeros(len(self.points.parameters), bool), self.setup.lens_fixed()])

    def lens(self, own: np.ndarray) -> Lens:
        """Return the camera for values of the sensor's parameters."""
        parameters = self.setup.lens_parameters()
        return Lens(*(p.nominal + value for p, value in zip(parameters, own[-len(parameters) :], strict=True)))

    def select(self, rows: slice | np.ndarray) -> CameraPixelSensor:
        """Return the readings of some rows."""
        return replace(self, index=self.index[rows], pixel=self.pixel[rows])

    def shifted(self, change: np.ndarray) -> CameraPixelSensor:
        """Return images moved by ``change``, shape (2, N) [px]."""
        return replace(self, pixel=self.pixel + change.T)

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction, shape (2, N) [px]."""
        return np.asarray((self.pixel - self.lens(own).project(self.seen(poses, own))).T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion of the image, by the point's motion and by the camera's parameters."""
        _, by_seen, by_lens = self.lens(own).linearise(self.seen(poses, own))
        moved = np.einsum("nab,pbn->pan", by_seen, self._moved(poses, motion, own))
        by_place = np.einsum("nab,nib->ian", by_seen, poses[:, :, :3])
        return np.concatenate([moved, self._by_points(by_place), by_lens.transpose(2, 1, 0)])

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the part across the view, at the distance of the point."""
        depth, lens = np.maximum(self.seen(poses, own)[:, 2], NEAREST), self.lens(own)
        across = np.stack([residuals[0] / lens.fx * depth, residuals[1] / lens.fy * depth, 0.0 * depth])
        return np.asarray(-np.einsum("nij,jn->ni", poses[:, :, :3], across))
