"""The columns of lists of numbers, which follow from their names and lengths."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from pincal.measure.flat_matrices import poses_from, quaternions_of

JOINTS = re.compile(
    r"((robot|arm|actual|act|measured|meas|current)_?)?"
    r"(joints?|joint_?(positions?|values?|angles?|states?|pos|poses?|config(uration)?s?|vectors?)"
    r"|q|qs|qpos|jpos|angles?|state|config(uration)?s?|thetas?|axes|axis_?(values|angles|positions)"
    r"|achsen|achswinkel|gelenkwinkel)"
    r"(_deg|_rad)?",
    re.I,
)
"""Names of lists of joint positions."""
PLACE = re.compile(
    r"((measured|meas|tracker|laser|marker|target|object|tool)_?)?"
    r"(positions?|pos|xyz|translation|points?|p|t|trans|tvecs?|target|place|measured)"
    r"(_mm|_cm|_m)?",
    re.I,
)
TURNED = re.compile(r"(orientation|rotation|quaternions?|quat|q|ori|rot|R)(_?(xyzw|wxyz))?", re.I)
# A capital T, as in ``T_base_tool``, is a transform; the letter occurs in other words.
POSE = re.compile(
    r"(?i:.*(pose|transform|matrix|matrices|wrt).*)|(.*[^A-Za-z])?[TH]([^a-z].*)?|[a-z]T[a-z]"
)
IS_OF_CONTROLLER = re.compile(
    r"robot|effector_wrt_world|(actual_)?tcp(_pose)?|flange|ee_pos(e)?|end_?effector|O_T_EE.*", re.I
)
"""Names of poses that a controller computes from the joints, which are no measurements."""
_ROTATION_VECTORS = (
    "rotvec",
    "rot_vec",
    "rvec",
    "rvecs",
    "rotation_vector",
    "rodrigues",
    "axis_angle",
)
# Endings of names of six numbers, and the columns of the last three.
_TURNS = {
    "rpy": ("roll", "pitch", "yaw"),
    "euler": ("roll", "pitch", "yaw"),
    "abc": ("A", "B", "C"),
    "wpr": ("W", "P", "R"),
}
_UNIT = re.compile(r".*[_ \[(](deg|rad|mm|cm|m)[\])]?")
_AXES = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_ORDER = "quaternions in lists are read in the order x y z w; if that is wrong, call them wxyz"


def vector_labels(
    path: str, values: np.ndarray, names: Sequence[str] | None = None
) -> tuple[tuple[str, ...], list[np.ndarray], str]:
    """Return labels and columns of N lists or matrices, and a note on an assumed order of
    components, or an empty one.

    Args:
        path: their keys in the file, separated by dots.
        values: shape (N, ...); dimensions of 1, as of OpenCV's vectors, are disregarded.
        names: of the joints, where the file has them.

    Example:
        >>> vector_labels("tool.pose", np.zeros((2, 7)))[0]
        ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
        >>> vector_labels("tvec", np.zeros((2, 3, 1)))[0]
        ('x', 'y', 'z')
    """
    key = path.split(".")[-1]
    if values.ndim > 2:
        values = values.reshape(len(values), *(size for size in values.shape[1:] if size > 1))
    if not JOINTS.fullmatch(key) and any(
        IS_OF_CONTROLLER.fullmatch(part) for part in path.split(".")
    ):
        return *_numbered(path, values), ""
    is_matrix = values.shape[1:] in ((4, 4), (3, 4), (4, 3), (12,), (16,))
    poses = poses_from(values) if is_matrix else None
    if poses is not None:
        turned = quaternions_of(poses[:, :, :3])
        return (*_AXES, *_QUATERNION), [*poses[:, :, 3].T, *turned.T], ""
    if values.shape[1:] == (3, 3):
        return _QUATERNION, [*quaternions_of(values).T], ""
    if values.ndim != 2:
        return *_numbered(path, values), ""
    labels, note = _plain(key, values.shape[1], names)
    if not labels:
        return *_numbered(path, values), ""
    unit = match[1] if (match := _UNIT.fullmatch(key)) else ""
    return (
        tuple(f"{label} [{unit}]" if unit and label[0] != "q" else label for label in labels),
        [*values.T],
        note,
    )


def _plain(key: str, count: int, names: Sequence[str] | None) -> tuple[tuple[str, ...], str]:
    """Return the labels of ``count`` numbers and a note; no labels if undetermined."""
    if (
        names is not None
        and len(names) == count
        and (JOINTS.fullmatch(key) or "state" in key or "position" in key)
    ):
        return tuple(map(str, names)), ""
    small = key.casefold()
    if count == 3 and PLACE.fullmatch(key):
        return _AXES, ""
    if count == 4 and TURNED.fullmatch(key):
        return (("qw", "qx", "qy", "qz"), "") if "wxyz" in small else (_QUATERNION, _ORDER)
    if count == 3 and small in _ROTATION_VECTORS:
        return ("rx", "ry", "rz"), ""
    if count == 3 and small in _TURNS:
        return _TURNS[small], ""
    if count == 6 and (turn := next((v for k, v in _TURNS.items() if small.endswith(k)), None)):
        return (*_AXES, *turn), ""
    if count in (6, 7) and POSE.fullmatch(key) and not JOINTS.fullmatch(key):
        if count == 6:
            return (*_AXES, "rx", "ry", "rz"), ""
        if "wxyz" in small:
            return (*_AXES, "qw", "qx", "qy", "qz"), ""
        return (*_AXES, *_QUATERNION), _ORDER
    if count == 2 and small in ("uv", "pixel", "pixels", "image"):
        return ("u", "v"), ""
    if JOINTS.fullmatch(key):
        return tuple(f"joint_{i + 1}" for i in range(count)), ""
    return (), ""


def _numbered(path: str, values: np.ndarray) -> tuple[tuple[str, ...], list[np.ndarray]]:
    flat = values.reshape(len(values), -1)
    return tuple(f"{path}.{i}" for i in range(flat.shape[1])), [*flat.T]
