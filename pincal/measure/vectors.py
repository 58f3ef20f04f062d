"""Which columns the numbers of a list are: joints, a place, an orientation or both, by its name and its length."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

JOINTS = re.compile(
    r"(joints?|joint_?(positions?|values?|angles?|states?|pos)|(actual_?)?q|qpos|angles?|state)(_deg|_rad)?", re.I
)
"""What lists of joint positions are called."""
PLACE = re.compile(r"(position|pos|xyz|translation|point|p|t|trans|tvec|target|place|measured)(_mm|_m)?", re.I)
TURNED = re.compile(r"(orientation|rotation|quaternions?|quat|q|ori|rot|R)(_?(xyzw|wxyz))?", re.I)
POSE = re.compile(r".*(pose|transform|T|matrix|wrt).*", re.I)
IS_OF_CONTROLLER = re.compile(r"robot|effector_wrt_world|(actual_)?tcp(_pose)?|flange|ee_pos(e)?|end_?effector", re.I)
"""What the pose is called that a controller computes from the joints: it is no measurement."""
_UNIT = re.compile(r".*[_ \[(](deg|rad|mm|cm|m)[\])]?")
_AXES = ("x", "y", "z")
_QUATERNION = ("qx", "qy", "qz", "qw")
_ORDER = "quaternions in lists are read in the order x y z w; if that is wrong, call them wxyz"


def vector_labels(
    path: str, values: np.ndarray, names: Sequence[str] | None = None
) -> tuple[tuple[str, ...], list[np.ndarray], str]:
    """Return labels and columns of N lists or matrices, and a note on what was taken for what, empty without any.

    Args:
        path: where they stand in the file.
        values: shape (N, ...).
        names: those of joints, where the file has them.

    Example:
        >>> vector_labels("tool.pose", np.zeros((2, 7)))[0]
        ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
    """
    key = path.split(".")[-1]
    if not JOINTS.fullmatch(key) and any(IS_OF_CONTROLLER.fullmatch(part) for part in path.split(".")):
        return *_numbered(path, values), ""
    if values.shape[1:] == (4, 4) or (values.shape[1:] == (16,) and POSE.fullmatch(key)):
        matrices = values.reshape(-1, 4, 4)
        return (*_AXES, *_QUATERNION), [*matrices[:, :3, 3].T, *quaternions_of(matrices[:, :3, :3]).T], ""
    if values.shape[1:] == (3, 3):
        return _QUATERNION, [*quaternions_of(values).T], ""
    if values.ndim != 2:
        return *_numbered(path, values), ""
    labels, note = _plain(key, values.shape[1], names)
    if not labels:
        return *_numbered(path, values), ""
    unit = match[1] if (match := _UNIT.fullmatch(key)) else ""
    return tuple(f"{label} [{unit}]" if unit and label[0] != "q" else label for label in labels), [*values.T], note


def _plain(key: str, count: int, names: Sequence[str] | None) -> tuple[tuple[str, ...], str]:
    """Return the labels of so many numbers; none if nothing tells."""
    if names is not None and len(names) == count and (JOINTS.fullmatch(key) or "state" in key or "position" in key):
        return tuple(map(str, names)), ""
    if count == 3 and PLACE.fullmatch(key):
        return _AXES, ""
    if count == 4 and TURNED.fullmatch(key):
        return (("qw", "qx", "qy", "qz"), "") if "wxyz" in key.casefold() else (_QUATERNION, _ORDER)
    if count == 3 and key.casefold() in ("rotvec", "rvec", "rotation_vector"):
        return ("rx", "ry", "rz"), ""
    if count == 3 and key.casefold() in ("rpy", "euler"):
        return ("roll", "pitch", "yaw"), ""
    if count in (6, 7) and POSE.fullmatch(key) and not JOINTS.fullmatch(key):
        return ((*_AXES, "rx", "ry", "rz"), "") if count == 6 else ((*_AXES, *_QUATERNION), _ORDER)
    if count == 2 and key.casefold() in ("uv", "pixel", "pixels", "image"):
        return ("u", "v"), ""
    if JOINTS.fullmatch(key):
        return tuple(f"joint_{i + 1}" for i in range(count)), ""
    return (), ""


def quaternions_of(matrices: np.ndarray) -> np.ndarray:
    """Return quaternions x y z w of rotation matrices, shape (N, 3, 3); nan for those that are none."""
    from scipy.spatial.transform import Rotation

    found = np.full((len(matrices), 4), np.nan)
    product = np.einsum("nij,nkj->nik", matrices, matrices)
    right = np.isfinite(matrices).all(axis=(1, 2)) & (np.abs(product - np.eye(3)).max(axis=(1, 2)) < 1e-2)
    right &= np.linalg.det(np.where(right[:, None, None], matrices, np.eye(3))) > 0
    found[right] = Rotation.from_matrix(matrices[right]).as_quat() if right.any() else found[right]
    return found


def _numbered(path: str, values: np.ndarray) -> tuple[tuple[str, ...], list[np.ndarray]]:
    flat = values.reshape(len(values), -1)
    return tuple(f"{path}.{i}" for i in range(flat.shape[1])), [*flat.T]
