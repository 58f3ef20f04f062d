r"""Denavit-Hartenberg frames from joint axes, for axes in any position.

The frame :math:`S_i` has its z axis along the axis of joint i+1 and its x axis along the common
normal of the axes i and i+1. The nominal chain of a joint is

.. math:: R(x; s_x) R(y; s_y) R(z; \theta) Tr(z; d) Tr(x; a) R(x; \alpha)

(paper, Eq. (2) at q = 0). Its s_x and s_y are zero unless two axes are parallel up to the rounding
of the URDF: the common normal of such axes may be kilometres away, so they are taken as parallel
and s_x and s_y of the next joint absorb the remaining tilt. The frames are exact either way.

If an origin is free (the first axis, parallel axes) it is at the URDF's joint: bearings are
compliant about this point, so it is not a mere convention.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pincal.robot.robot_numbers import OF_ROBOT
from pincal.robot.se3 import rotation, transform, translation
from pincal.thresholds import Scale

# Distance [m] below which two axes count as intersecting: the common normal then has no direction
# of its own.
INTERSECTING: Scale = 1e-7
# Distance [m] below which two parallel axes count as one line.
COAXIAL: Scale = 1e-12


@dataclass(frozen=True)
class DhFrames:
    """Nominal frames of an arm, or of a tree of arms.

    Along the tree each joint continues the frames of the joint that carries it, except the first
    joint of a branch: of several joints on a link the first one continues, and each of the others
    begins a branch, with its own frame on its axis like the first joint.

    Attributes:
        T_base_first: shape (4, 4), frame S_0 in the base frame.
        parameters: shape (n, 6), columns s_x, s_y, theta, d, a, alpha [rad, m].
        T_base_link: shape (n, 4, 4), frames S_1 .. S_n in the base frame at q = 0.
        T_last_tip: shape (4, 4), the tip in the link frame of the joint that carries it.
        branches: the m joints that begin a branch, except the first joint.
        T_branch_first: shape (m, 4, 4), the frame on the axis of each of these, in the link frame
            of the joint that carries it, or in the base frame.
    """

    T_base_first: np.ndarray
    parameters: np.ndarray
    T_base_link: np.ndarray
    T_last_tip: np.ndarray
    branches: tuple[int, ...] = ()
    T_branch_first: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))

    def before(self, i: int) -> np.ndarray:
        """Return the fixed transform from the link that carries joint i to the joint's own
        transforms, shape (4, 4).
        """
        if i in self.branches:
            return np.asarray(self.T_branch_first[self.branches.index(i)])
        return self.T_base_first if i == 0 else np.eye(4)

    def axis(self, i: int, parent: int) -> np.ndarray:
        """Return the direction of joint i's axis in the base frame at q = 0, shape (3,); ``parent``
        is -1 for the base.
        """
        before = (self.T_base_link[parent] if parent >= 0 else np.eye(4)) @ self.before(i)
        s_x, s_y = self.parameters[i, :2]
        return np.asarray(
            before[:3, :3] @ [np.sin(s_y), -np.sin(s_x) * np.cos(s_y), np.cos(s_x) * np.cos(s_y)]
        )


def dh_frames(
    origins: np.ndarray,
    axes: np.ndarray,
    T_base_tip: np.ndarray,
    parents: Sequence[int] | None = None,
    pins: Mapping[int, np.ndarray] | None = None,
) -> DhFrames:
    """Return the Denavit-Hartenberg frames of joint axes at q = 0.

    Args:
        origins: shape (n, 3), the URDF's joint origins, on the axes, in the base frame [m].
        axes: shape (n, 3), unit directions in the base frame.
        T_base_tip: shape (4, 4), the tip at q = 0; for a tree shape (n, 4, 4), the end of the last
            link of a branch, for each joint that carries no other.
        parents: the joint that carries each joint, -1 for the base, earlier joints first; default:
            each carries the next.
        pins: for joints of rods, which carry no other joint, the frame of the pin, shape (4, 4),
            with z along the axis at the end of the link, so that the link's length is the rod's.

    Returns:
        The frames; for a serial arm their product with ``T_last_tip`` equals ``T_base_tip`` to
        rounding.
    """
    n = len(axes)
    parents = range(-1, n - 1) if parents is None else parents
    tips = np.broadcast_to(T_base_tip, (n, 4, 4))
    # The first joint that a link carries continues its frames.
    following = {parent: i for i, parent in reversed(list(enumerate(parents)))}
    ends = {i: (pin[:3, 3], pin[:3, 2]) for i, pin in (pins or {}).items()}
    ends |= {parent: (origins[i], axes[i]) for parent, i in following.items()}
    parameters = []
    frames = list[np.ndarray]()
    branches = dict[int, np.ndarray]()
    first = _first_frame(origins[0], axes[0])
    for i, parent in enumerate(parents):
        carried = first if parent < 0 else frames[parent]
        start = carried if following[parent] == i else _first_frame(origins[i], axes[i])
        if following[parent] != i:
            branches[i] = start if parent < 0 else np.linalg.inv(carried) @ start
        tilt = _tilt(start, axes[i])
        frame = start @ rotation("x", tilt[0]) @ rotation("y", tilt[1])
        step = _step(frame, *ends[i]) if i in ends else _last_step(frame, tips[i])
        parameters.append([*tilt, *step])
        theta, d, a, alpha = step
        frames.append(frame @ rotation("z", theta) @ translation(a, 0, d) @ rotation("x", alpha))
    return DhFrames(
        first,
        np.array(parameters),
        np.array(frames),
        np.linalg.inv(frames[-1]) @ tips[-1],
        tuple(branches),
        np.array(list(branches.values())).reshape(-1, 4, 4),
    )


def _first_frame(origin: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return S_0: on axis 1 where the URDF has its joint, x as near the base's x as can be."""
    reference = np.array([1.0, 0.0, 0.0])
    if abs(axis @ reference) > 0.9:
        reference = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    x = reference - axis * (axis @ reference)
    x = x / np.linalg.norm(x)
    return transform(np.column_stack([x, np.cross(axis, x), axis]), origin)


def _tilt(frame: np.ndarray, axis: np.ndarray) -> tuple[float, float]:
    """Return s_x, s_y that turn the z axis of ``frame`` into ``axis``; exactly zero when they agree
    to rounding.
    """
    local = frame[:3, :3].T @ axis
    if np.hypot(local[0], local[1]) < 1e-14:
        return 0.0, 0.0
    # R(x; s_x) R(y; s_y) z = (sin s_y, -sin s_x cos s_y, cos s_x cos s_y)
    return float(np.arctan2(-local[1], local[2])), float(np.arcsin(np.clip(local[0], -1, 1)))


def _step(
    frame: np.ndarray, origin: np.ndarray, axis: np.ndarray
) -> tuple[float, float, float, float]:
    """Return theta, d, a, alpha from ``frame`` (z on its own axis) to the frame on the
    next axis.
    """
    R = frame[:3, :3]
    p = R.T @ (origin - frame[:3, 3])
    z = R.T @ axis
    sine = float(np.hypot(z[0], z[1]))
    if sine < OF_ROBOT.parallel:
        a = float(np.hypot(p[0], p[1]))
        theta = float(np.arctan2(p[1], p[0])) if a > COAXIAL else 0.0
        return theta, float(p[2]), a, 0.0 if z[2] > 0 else np.pi
    normal = np.array([-z[1], z[0], 0.0]) / sine
    a = float(p @ normal)
    if abs(a) > INTERSECTING:
        normal = normal * np.sign(a)
        a = abs(a)
    elif normal[0] < -1e-9 or (abs(normal[0]) <= 1e-9 and normal[1] < 0):
        normal = -normal
        a = -a
    # foot of the common normal: p + t z lies in the plane of z_i and the normal
    across = np.array([-normal[1], normal[0], 0.0])
    t = -(p @ across) / (z @ across)
    alpha = float(np.arctan2(z @ -across, z[2]))
    return float(np.arctan2(normal[1], normal[0])), float(p[2] + t * z[2]), a, alpha


def _last_step(frame: np.ndarray, T_base_tip: np.ndarray) -> tuple[float, float, float, float]:
    """Return theta and d that bring the last frame to the height and heading of the tip; a = alpha
    = 0.
    """
    tip = np.linalg.inv(frame) @ T_base_tip
    heading = tip[:2, 0] if np.hypot(*tip[:2, 0]) > 0.1 else np.array([1.0, 0.0])
    return float(np.arctan2(heading[1], heading[0])), float(tip[2, 3]), 0.0, 0.0
