"""A camera's file: its lens and, if known, its mount."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.errors import MeasurementError
from pincal.io.arrays import Matrix, array_of
from pincal.io.file_numbers import IN_FILES
from pincal.io.strict_json import Fault, FileKind, read_json
from pincal.parameters import Estimate
from pincal.robot.se3 import are_rotations, placed
from pincal.sensors.lens import DISTORTION, PINHOLE, Lens

_CAMERA_FILE = FileKind(
    "a camera's JSON",
    MeasurementError,
    mark=" ",
    whole=f"an object with {', '.join(PINHOLE)} [px] and, where known, {', '.join(DISTORTION)}, "
    "T_tip_camera",
)


@dataclass(frozen=True)
class CameraFile(Lens):
    """A camera, see :class:`pincal.sensors.lens.Lens`; unknown distortion is 0.

    Attributes:
        T_tip_camera: shape (4, 4), the camera's frame in the tip frame [m]; null if the mount is to
            be identified.
    """

    T_tip_camera: Matrix | None = None

    def __post_init__(self) -> None:
        for name in ("fx", "fy"):
            if not getattr(self, name) > 0.0:
                raise Fault(f"is {getattr(self, name):g} px", "more than 0", key=f".{name}")
        if (mount := self.T_tip_camera) is not None:
            is_whole = mount.shape == (4, 4) and bool(np.isfinite(mount).all())
            is_rigid = is_whole and are_rotations(mount[:3, :3], tolerance=IN_FILES.mount)
            if not is_rigid or not np.array_equal(mount[3], [0.0, 0.0, 0.0, 1.0]):
                raise Fault(
                    "is not a rigid transform",
                    "4 rows of 4, rotation and metres",
                    key=".T_tip_camera",
                )

    def lens(self) -> Lens:
        """Return the lens."""
        return Lens(*self.values.tolist())


def read_camera(path: str | os.PathLike[str]) -> CameraFile:
    """Read a camera from JSON: ``fx fy u0 v0``, optionally ``k1 k2 p1 p2 k3`` and ``T_tip_camera``
    (4 rows of 4).

    Raises:
        MeasurementError: if the file can't be read, or a value is missing or invalid.
    """
    return read_json(path, CameraFile, _CAMERA_FILE, hook=_matrix)


def camera_entries(estimate: Estimate, tool_rotation: np.ndarray) -> dict[str, Any]:
    """Return the camera of an estimate as :func:`read_camera` reads it; empty if it has none.

    Args:
        estimate: with the lens and the frame of the camera, relative to the nominal.
        tool_rotation: shape (3, 3), from the frame of the nominal camera to that of the tip.
    """
    lens = {
        p.name.removeprefix("camera."): p.nominal + estimate[p.name]
        for p in estimate.parameters
        if p.effect.startswith("lens")
    }
    if not lens:
        return {}
    return {**lens, "T_tip_camera": placed(tool_rotation, estimate.frame("camera")).tolist()}


def _matrix(kind: Any, value: Any) -> np.ndarray:
    try:
        return array_of(value)
    except Fault:
        raise Fault("is not a rigid transform", "4 rows of 4, rotation and metres") from None
