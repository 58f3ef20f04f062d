"""What the sensors of a camera in the robot's hand have in common: it sees named points of an object that stands still.

The target on the tool is the camera's frame (z along the view, x to the right, y down), the instrument's frame that of the
object. Where no point of the object is known, its points are found in the robot's base frame (paper, section IV.A).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from pincal.measure.point_sensor import PointSensor
from pincal.parameters import FRAME_SYMBOLS


@dataclass(frozen=True)
class CameraSensor(PointSensor):
    """Readings of a camera, each of one point; ``has_scale`` says whether they tell how far away it is."""

    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS
    twist_rows: ClassVar[int] = 6
    names_points: ClassVar[str | None] = "point"
    default_target: ClassVar[str] = "camera"
    pose_limit: ClassVar[str] = "of the camera; however many points are seen in one, it tells six coordinates"
    has_camera: ClassVar[bool] = True
    thing: ClassVar[str] = "a point"
    fewest: ClassVar[int] = 2
    needs_all_rows: ClassVar[bool] = False
    has_scale: ClassVar[bool]

    @final
    def unobservable_with(self, known: int) -> Iterator[str]:
        """Yield where the object stands, if none of its points is known, and what else is open then."""
        if not known:
            yield (
                "the points of the calibration object are not known, so they are found in the robot's base frame; with "
                "--points FILE.csv (columns point x y z) they tell more"
            )
            if not (self.has_scale or self.points.distances):
                yield "images of unknown points have no scale of their own: it rests on the nominal lengths of the arm"

    @final
    def seen(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return each row's point in the camera's frame, shape (N, 3) [m]."""
        away = self.points.positions(own)[self.index] - poses[:, :, 3]
        return np.asarray(np.einsum("nij,ni->nj", poses[:, :, :3], away))

    @final
    def seen_motion(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
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
