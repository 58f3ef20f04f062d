"""Samples of hand-eye calibrations (MoveIt, easy_handeye): the pose of an object in a camera for each pose of the robot.

A camera that stands still sees an object on the hand: its pose is read like that of a tool. A camera on the hand sees an
object that stands still: read the other way round it is the pose of the camera in the frame of the object. Which of them it
is, the samples tell: the motions of hand and object belong together in one of the two ways only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.measure.vectors import quaternions_of, vector_labels

_OF_ROBOT = ("effector_wrt_world", "robot")
_OF_OBJECT = ("object_wrt_sensor", "tracking", "optical")
# Residual of one way over that of the other, below which the samples tell them apart.
_CLEAR = 0.3


@dataclass(frozen=True)
class TrackedPoses:
    """Poses as they are read.

    Attributes:
        matrices: shape (N, 4, 4).
        groups: the parts of the file that they are made of.
    """

    matrices: np.ndarray
    groups: tuple[str, str]


def tracked_poses(columns: Mapping[str, np.ndarray], *, is_on_hand: bool | None, source: str) -> TrackedPoses | None:
    """Return the poses that a tracking system read, None where a file has no samples of a hand-eye calibration.

    Args:
        columns: values by their place in the file, shape (N, ...).
        is_on_hand: whether the camera is on the hand, where the file says so.
        source: the file, for messages.

    Raises:
        MeasurementError: if nothing tells whether the camera is on the hand.
    """
    parts = {path.split(".")[0] for path in columns}
    robot, seen = (next((name for name in names if name in parts), None) for names in (_OF_ROBOT, _OF_OBJECT))
    if robot is None or seen is None:
        return None
    hand, object_ = (_matrices(columns, name, source=source) for name in (robot, seen))
    said = "as the file says"
    if is_on_hand is None:
        fixed, moved = _misfit(hand, object_), _misfit(hand, np.linalg.inv(object_))
        if min(fixed, moved) > _CLEAR * max(fixed, moved):
            raise MeasurementError(
                f"{source}: {len(hand)} samples don't tell whether the camera is on the hand ({moved:.3g} rad) or stands "
                f"still ({fixed:.3g} rad); expected more samples that turn about different axes"
            )
        is_on_hand, said = moved < fixed, "as the samples tell"
    where = "on the hand, and the object stands still" if is_on_hand else "standing still, and the object is on the hand"
    warn(f"{source}: {len(hand)} samples of a hand-eye calibration with the camera {where}, {said}; {robot} is not used")
    return TrackedPoses(np.linalg.inv(object_) if is_on_hand else object_, (robot, seen))


def _matrices(columns: Mapping[str, np.ndarray], group: str, *, source: str) -> np.ndarray:
    """Return the poses of a part of a file, shape (N, 4, 4)."""
    from scipy.spatial.transform import Rotation

    found = dict[str, np.ndarray]()
    for path, values in columns.items():
        if path.split(".")[0] == group:
            inner = "pose" + path.removeprefix(group)
            if values.ndim > 1:
                labels, parts, _ = vector_labels(inner, values)
                found |= dict(zip(labels, parts, strict=True))
            else:
                *_, above, leaf = ("", *inner.split("."))
                found["q" * above.startswith(("rot", "ori")) + leaf] = values
    try:
        place, turned = (
            np.column_stack([np.asarray(found[n], float) for n in ns]) for ns in ("xyz", ("qx", "qy", "qz", "qw"))
        )
        rotations = Rotation.from_quat(turned).as_matrix()
    except (KeyError, ValueError, TypeError) as error:
        raise MeasurementError(f"{source}: {group} is no pose in each sample; expected translation and rotation") from error
    matrices = np.tile(np.eye(4), (len(place), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = rotations, place
    if np.isnan(quaternions_of(rotations)).any() or not np.isfinite(place).all():
        raise MeasurementError(f"{source}: {group} is no pose in each sample; expected finite numbers")
    return matrices


def _misfit(hand: np.ndarray, target: np.ndarray) -> float:
    """Return how far the turns of two bodies from sample to sample are from those of one body [rad]."""
    from scipy.spatial.transform import Rotation

    turns = [
        Rotation.from_matrix(np.einsum("nji,njk->nik", T[:-1, :3, :3], T[1:, :3, :3])).as_rotvec() for T in (hand, target)
    ]
    found = Rotation.align_vectors(*turns)[0] if len(turns[0]) else Rotation.identity()
    return float(np.sqrt(np.mean((turns[0] - found.apply(turns[1])) ** 2))) if len(turns[0]) else 0.0
