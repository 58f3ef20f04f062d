"""The set-up of the paper: a camera in the robot's hand that looks at a fixed calibration object."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.calibration_object import CalibrationObject
from pincal.simulate.camera import in_camera, measure_camera, plan_camera_poses
from pincal.simulate.lens import Lens
from pincal.simulate.machine import TrueMachine
from pincal.simulate.measure import Table
from pincal.simulate.setup import Setup

# The camera looks from where a field's radius fills so much of the image's half height; border that stays free.
_FILL, _BORDER = (0.45, 0.85), 0.04
# How far the view may lean from the normal of what is looked at [rad].
_LEAN = 0.6
# Rounds of random goals for all views of a field, and to find out whether there are any.
_PATIENCE, _GLANCES = 60, 3


@dataclass(frozen=True, kw_only=True)
class EyeInHand(Setup):
    """A camera at the tip that looks at a fixed calibration object.

    Attributes:
        seen: The object.
        object_pose: Transform from the object's frame to the robot's base frame, shape (4, 4).
        camera_pose: Transform from the camera frame (z along the view) to the tip frame, shape (4, 4).
        lens: The camera; only what is in its image is measured.
        in_metres: It gives points in its own frame [m], as a stereo camera does, instead of their image [px].
    """

    seen: CalibrationObject
    object_pose: np.ndarray
    camera_pose: np.ndarray
    lens: Lens
    in_metres: bool

    @property
    def kind(self) -> str:
        """Points in the camera's frame or in its image."""
        return "camera_point" if self.in_metres else "camera_pixel"

    @property
    def points(self) -> dict[str, np.ndarray]:
        """The points in the object's own frame."""
        return dict(zip(self.seen.names, self.seen.places, strict=True))

    def plan(self, machine: TrueMachine, count: int, rng: np.random.Generator, *, min_height: float | None) -> np.ndarray:
        """Return poses that have the whole of one image field after the other in view, from its front."""
        owner = np.arange(count) * self.seen.n_fields // count
        fields = range(self.seen.n_fields)
        return np.vstack([self._views(machine, i, int(np.sum(owner == i)), rng, min_height, _PATIENCE) for i in fields])

    def is_in_reach(self, machine: TrueMachine, rng: np.random.Generator, *, min_height: float | None) -> bool:
        """Return whether the arm finds views of all fields without much ado."""
        try:
            for i in range(self.seen.n_fields):
                self._views(machine, i, 1, rng, min_height, _GLANCES)
        except BadInputError:
            return False
        return True

    def _views(
        self, machine: TrueMachine, i: int, n: int, rng: np.random.Generator, min_height: float | None, patience: int
    ) -> np.ndarray:
        centre, normal, radius = self.seen.look_at(i)
        places = self._in_base[self.seen.field == i]
        half = 0.5 * min(size / focal for size, focal in zip(self.lens.size, self.lens.focals, strict=True))

        def is_whole(camera: np.ndarray) -> np.ndarray:
            seen = in_camera(camera, places).reshape(-1, 3)
            return np.asarray(self.lens.sees(seen, margin=_BORDER).reshape(len(camera), -1).all(axis=1))

        return plan_camera_poses(
            machine,
            n,
            rng,
            camera_pose=self.camera_pose,
            look_at=self.object_pose[:3, :3] @ centre + self.object_pose[:3, 3],
            distance=(radius / (half * _FILL[1]), radius / (half * _FILL[0])),
            tilt=_LEAN,
            facing=self.object_pose[:3, :3] @ normal,
            min_height=min_height,
            accept=is_whole,
            patience=patience,
        )

    @cached_property
    def _in_base(self) -> np.ndarray:
        return np.asarray(self.seen.places @ self.object_pose[:3, :3].T + self.object_pose[:3, 3])

    def measure(self, machine: TrueMachine, q: np.ndarray, rng: np.random.Generator, **conditions: Any) -> Table:
        """Return a row for every pose and point in the image that faces the camera."""
        if not self.in_metres:
            self.refuse_scale(machine, "an image has none")
        normals = self.seen.normals @ self.object_pose[:3, :3].T
        return measure_camera(
            machine,
            q,
            camera_pose=self.camera_pose,
            points=dict(zip(self.seen.names, self._in_base, strict=True)),
            normals=dict(zip(self.seen.names, normals, strict=True)),
            lens=self.lens,
            in_metres=self.in_metres,
            noise_sigma=self.sigma,
            rng=rng,
            **conditions,
        )

    def sight(self, tip: np.ndarray) -> np.ndarray:
        """Return the origin of the object in the camera's frame."""
        return in_camera(tip @ self.camera_pose, self.object_pose[None, :3, 3])[:, 0]

    def truth(self) -> dict[str, Any]:
        """Return places of camera and object, and the camera itself."""
        found = {"T_tip_camera": self.camera_pose.tolist(), "T_base_object": self.object_pose.tolist()}
        return found | ({} if self.in_metres else {"camera": self.lens.intrinsics})
