"""Samples of hand-eye calibrations (OpenCV, MoveIt, easy_handeye): the pose of an object in a
camera for each pose of the robot.

With a fixed camera the object is on the hand, and its pose is that of a tool. With the camera on
the hand the object is fixed, and the inverse is the pose of the camera in the object's frame. The
samples determine which: relative rotations of hand and object are consistent in one of the two
cases only.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from pincal.errors import MeasurementError, warn
from pincal.measure.flat_matrices import quaternions_of
from pincal.measure.nested_labels import vector_labels
from pincal.measure.reading_numbers import LAYOUT
from pincal.robot.se3 import transform

_HAND = r"(gripper|ee|eef|end|end_?effector|effector|flange|tool0?|tcp|hand|tip|grip)"
_BASE = r"(base|robot|world|arm)(_?link)?"
_MARK = r"(target|object|obj|marker|board|tag|aruco|charuco|pattern|tracking|optical)"
_CAMERA = r"(cam|camera|sensor|eye)(_?(optical_?)?(link|frame))?"
# How names say that one frame is in another: gripper2base, object_wrt_sensor, base_T_ee,
# cam_marker.
_IN = r"(_?(2|to|in|wrt|T)_?|_)"
# Names of the poses of the hand and of the object, without what precedes them in
# ``R_gripper2base``.
_OF_ROBOT = re.compile(rf"robot|{_HAND}{_IN}{_BASE}|{_BASE}{_IN}{_HAND}", re.I)
_OF_OBJECT = re.compile(rf"tracking|optical|{_MARK}{_IN}{_CAMERA}|{_CAMERA}{_IN}{_MARK}", re.I)
_PART = re.compile(r"(R|t|T|H|P|rot|trans|rvecs?|tvecs?|quat|pose)_(.+)")


def grouped(path: str) -> str:
    """Return the keys of a value with what it is of before what it is.

    Example:
        >>> grouped("R_gripper2base"), grouped("T_cam_marker"), grouped("joint_states")
        ('gripper2base.R', 'cam_marker.T', 'joint_states')
    """
    first, dot, rest = path.partition(".")
    match = _PART.fullmatch(first)
    if match is None or not any(role.fullmatch(match[2]) for role in (_OF_ROBOT, _OF_OBJECT)):
        return path
    return f"{match[2]}.{match[1]}{dot}{rest}"


def is_of_hand(name: str) -> bool:
    """Return whether a key is that of poses of the hand, which the controller computes."""
    return _OF_ROBOT.fullmatch(name) is not None


def tracked_poses(
    columns: Mapping[str, np.ndarray], *, is_on_hand: bool | None, source: str
) -> tuple[np.ndarray, tuple[str, str]] | None:
    """Return the poses of a hand-eye calibration, shape (N, 4, 4), and the keys of its groups; None
    for other files.

    Args:
        columns: values by their keys, as :func:`grouped` returns these.
        is_on_hand: whether the camera is on the hand, if the file states it.
        source: the file, for messages.

    Raises:
        MeasurementError: if neither the file nor the samples determine whether the camera is on the
            hand.
    """
    robot = _group(columns, _OF_ROBOT)
    seen = _group(columns, _OF_OBJECT)
    if robot is None or seen is None:
        return None
    hand = _matrices(columns, robot, source=source)
    object_ = _matrices(columns, seen, source=source)
    evidence = "as the file states"
    if is_on_hand is None:
        fixed = _misfit(hand, object_)
        moved = _misfit(hand, np.linalg.inv(object_))
        if min(fixed, moved) > LAYOUT.clear * max(fixed, moved):
            raise MeasurementError(
                f"{source}: {len(hand)} samples do not show whether the camera is on the "
                f"hand ({moved:.3g} rad) or fixed "
                f"({fixed:.3g} rad); expected more samples with rotations about different axes"
            )
        is_on_hand = moved < fixed
        evidence = "as the samples show"
    where = "on the hand and the object fixed" if is_on_hand else "fixed and the object on the hand"
    warn(
        f"{source}: {len(hand)} samples of a hand-eye calibration with the camera "
        f"{where}, {evidence}; {robot} is not used"
    )
    return np.linalg.inv(object_) if is_on_hand else object_, (robot, seen)


def _group(paths: Iterable[str], role: re.Pattern[str]) -> str | None:
    """Return the first of the groups of columns that have a role; None without any."""
    groups = (path.split(".")[0] for path in paths)
    return next((group for group in groups if role.fullmatch(group)), None)


def _matrices(columns: Mapping[str, np.ndarray], group: str, *, source: str) -> np.ndarray:
    """Return the poses of a group of a file, shape (N, 4, 4)."""
    found = dict[str, np.ndarray]()
    for path, values in columns.items():
        if path.split(".")[0] == group:
            inner = "pose" + path.removeprefix(group)
            if values.ndim > 1:
                labels, parts, _ = vector_labels(inner, values)
                found |= dict(zip(labels, parts, strict=True))
            else:
                above, _, leaf = inner.rpartition(".")
                is_turn = above.rpartition(".")[2].startswith(("rot", "ori"))
                found["q" * is_turn + leaf] = values
    try:
        place = np.column_stack([np.asarray(found[n], float) for n in ("x", "y", "z")])
        rotations = _rotations(found)
    except (KeyError, ValueError, TypeError) as error:
        raise MeasurementError(
            f"{source}: {group} does not hold a pose in each sample; expected translation "
            "and rotation"
        ) from error
    if np.isnan(quaternions_of(rotations)).any() or not np.isfinite(place).all():
        raise MeasurementError(
            f"{source}: {group} does not hold a pose in each sample; expected finite numbers"
        )
    return transform(rotations, place)


def _rotations(found: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return rotations, shape (N, 3, 3), of quaternions or rotation vectors."""
    if "rx" in found:
        vectors = np.column_stack([np.asarray(found[n], float) for n in ("rx", "ry", "rz")])
        return np.asarray(Rotation.from_rotvec(vectors).as_matrix())
    turned = np.column_stack([np.asarray(found[n], float) for n in ("qx", "qy", "qz", "qw")])
    return np.asarray(Rotation.from_quat(turned).as_matrix())


def _misfit(hand: np.ndarray, target: np.ndarray) -> float:
    """Return the residual of the rotations of two bodies from sample to sample as those of one
    rigid body [rad].
    """
    turns = [
        Rotation.from_matrix(np.einsum("nji,njk->nik", T[:-1, :3, :3], T[1:, :3, :3])).as_rotvec()
        for T in (hand, target)
    ]
    if not len(turns[0]):
        return 0.0
    found = Rotation.align_vectors(*turns)[0]
    return float(np.sqrt(np.mean((turns[0] - found.apply(turns[1])) ** 2)))
