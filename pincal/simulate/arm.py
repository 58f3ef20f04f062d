"""The arm of the true machine as Pinocchio reads it from a URDF: placements, joint axes, bodies, limits.

Every joint gets a working frame whose z is the joint axis. Its x is the x axis of the URDF joint frame without its part
along the joint axis (the y axis where x is parallel to the joint axis). Where the axis is "0 0 1" the two frames are one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import BadInputError, RobotFileError, nearest_first

# A joint axis closer than this to the x axis of its frame leaves no direction to project (sine of the angle between them).
_PARALLEL = 1e-6


@dataclass(frozen=True)
class Arm:
    """A serial arm from base to tip, nominal or true.

    Attributes:
        names: Names of the n joints, from base to tip.
        prismatic: Whether a joint slides instead of turning, shape (n,).
        placements: Working frame of joint i in that of joint i-1 (base frame for the first) at joint position 0, and last
            the tip in the working frame of joint n; lengths in m, shape (n + 1, 4, 4).
        masses: Mass that moves with joint i, up to the next joint [kg], shape (n,).
        centres: Its centre of mass in the working frame of joint i [m], shape (n, 3).
        axes: Rotation from the working frame to the URDF frame of joint i, shape (n, 3, 3).
        lower: Lower joint limits [rad or m]; -pi for a continuous joint, shape (n,).
        upper: Upper joint limits [rad or m], shape (n,).
        mimics: Joint, the joint that it follows, multiplier and offset, of those that the URDF has mimic another.
        inertias: Moments of inertia about these centres in the working frames [kg m^2], shape (n, 3, 3); None for masses at
            points.
    """

    names: tuple[str, ...]
    prismatic: np.ndarray
    placements: np.ndarray
    masses: np.ndarray
    centres: np.ndarray
    axes: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    mimics: tuple[tuple[int, int, float, float], ...] = ()
    inertias: np.ndarray | None = None

    @cached_property
    def driving(self) -> np.ndarray:
        """How all joints move with those that drive themselves, shape (n, m)."""
        moves = np.eye(len(self.names))
        for joint, *_ in self.mimics:
            moves[joint] = 0.0
        own = np.flatnonzero(moves.any(axis=1))
        return np.asarray(self.following(moves[:, own].T).T - self.following(np.zeros((len(own), len(moves)))).T)

    def following(self, q: np.ndarray) -> np.ndarray:
        """Return joint positions, shape (N, n), with those that follow another joint where it takes them."""
        out = np.array(q, float)
        # As often as there are joints that follow one that follows another.
        for joint, source, multiplier, offset in self.mimics * len(self.mimics):
            out[:, joint] = multiplier * out[:, source] + offset
        return out

    @cached_property
    def lengths(self) -> np.ndarray:
        """Distance from each joint to the next, last to the tip [m], shape (n,)."""
        lengths: np.ndarray = np.linalg.norm(self.placements[1:, :3, 3], axis=1)
        return lengths

    @property
    def reach(self) -> float:
        """Sum of the distances from joint to joint and to the tip [m]."""
        return float(self.lengths.sum())

    def index(self, joint: str | None) -> int:
        """Return the index of a joint by its name in the URDF, 0 at the base.

        Raises:
            BadInputError: If there is no such joint on the way from base to tip.
        """
        if joint in self.names:
            return self.names.index(joint)
        near = ", ".join(nearest_first([str(joint)], self.names))
        raise BadInputError(f"joint {joint!r}: not between base and tip; expected one of {near}")


def read_arm(urdf: str | Path, tip: str, base: str | None = None) -> Arm:
    """Read the arm between two frames of a URDF with Pinocchio.

    Joints that are not between base and tip are locked at 0; their bodies stay on the links that carry them.

    Args:
        urdf: Path of a URDF file, or its XML text.
        tip: Name of the link at the end of the arm.
        base: Name of the link in whose frame positions are given; default: the root of the URDF.

    Raises:
        RobotFileError: If the URDF can't be read, a frame is missing or no joint lies between base and tip.
    """
    import pinocchio as pin

    full = _load(urdf)
    path = _path(full, tip, base)
    locked = [index for index in range(1, full.njoints) if index not in path]
    model = pin.buildReducedModel(full, locked, pin.neutral(full)) if locked else full
    return replace(arm := _arm(model, tip, base), mimics=_mimics(urdf, arm.names))


def _load(urdf: str | Path) -> Any:
    import pinocchio as pin

    is_text = _is_text(urdf)
    if not is_text and not Path(urdf).is_file():
        raise RobotFileError(f"{urdf}: no such file; expected a URDF")
    try:
        return pin.buildModelFromXML(str(urdf)) if is_text else pin.buildModelFromUrdf(str(urdf))
    except ValueError as error:
        raise RobotFileError(f"{'URDF text' if is_text else urdf}: {error}") from error


def _is_text(urdf: str | Path) -> bool:
    return str(urdf).lstrip().startswith("<")


def _mimics(urdf: str | Path, names: tuple[str, ...]) -> tuple[tuple[int, int, float, float], ...]:
    """Return which joints of the arm follow another joint of the arm, and how."""
    root = ElementTree.fromstring(str(urdf)) if _is_text(urdf) else ElementTree.parse(urdf).getroot()
    found = []
    for joint in root.iterfind("joint"):
        mimic = joint.find("mimic")
        if mimic is not None and joint.get("name") in names and mimic.get("joint") in names:
            indices = names.index(str(joint.get("name"))), names.index(str(mimic.get("joint")))
            found.append((*indices, float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0))))
    return tuple(found)


def _frame_id(model: Any, name: str) -> int:
    """Return the index of a link's frame; a joint may have the same name."""
    import pinocchio as pin

    if not model.existFrame(name, pin.BODY):
        names = [frame.name for frame in model.frames if frame.type == pin.BODY]
        raise RobotFileError(f"link {name!r}: not in the URDF; expected one of {', '.join(names)}")
    return int(model.getFrameId(name, pin.BODY))


def _path(model: Any, tip: str, base: str | None) -> list[int]:
    """Return the indices of the joints that move the tip and not the base."""
    tip_joint, base_joint = (model.frames[_frame_id(model, end)].parentJoint if end else 0 for end in (tip, base))
    path = [index for index in model.supports[tip_joint] if index and index not in model.supports[base_joint]]
    if not path:
        raise RobotFileError(f"no joint between base {base!r} and tip {tip!r}; name a tip that the joints move")
    return path


def _arm(model: Any, tip: str, base: str | None) -> Arm:
    import pinocchio as pin

    data, q = model.createData(), pin.neutral(model)
    pin.computeJointJacobians(model, data, q)
    pin.framesForwardKinematics(model, data, q)
    origin = data.oMf[_frame_id(model, base)] if base else pin.SE3.Identity()
    joints = range(1, model.njoints)
    twists = [_twist(model, data, i) for i in joints]
    prismatic = np.array([not np.any(twist[3:]) for twist in twists])
    axes = np.array([_working_frame(t[:3] if p else t[3:]) for t, p in zip(twists, prismatic, strict=True)])
    frames = [origin.homogeneous]
    frames += [data.oMi[i].homogeneous @ transform(axes[i - 1]) for i in joints]
    frames.append(data.oMf[_frame_id(model, tip)].homogeneous)
    lower, upper = _limits(model, prismatic)
    return Arm(
        names=tuple(model.names[i] for i in joints),
        prismatic=prismatic,
        placements=np.array([np.linalg.solve(a, b) for a, b in pairwise(frames)]),
        masses=np.array([model.inertias[i].mass for i in joints]),
        centres=np.array([axes[i - 1].T @ model.inertias[i].lever for i in joints]),
        axes=axes,
        lower=lower,
        upper=upper,
        inertias=np.array([axes[i - 1].T @ model.inertias[i].inertia @ axes[i - 1] for i in joints]),
    )


def _twist(model: Any, data: Any, joint: int) -> np.ndarray:
    """Return the direction, linear then angular, in which a joint moves its own frame, shape (6,)."""
    import pinocchio as pin

    if model.joints[joint].nv != 1:
        raise RobotFileError(f"joint {model.names[joint]!r}: has several freedoms; expected revolute or prismatic")
    jacobian = np.reshape(pin.getJointJacobian(model, data, joint, pin.LOCAL), (6, -1))
    column: np.ndarray = jacobian[:, model.joints[joint].idx_v]
    return column


def _limits(model: Any, prismatic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return limits; default: half a turn, or half a metre, to both sides."""
    lower, upper = [], []
    for slides, joint in zip(prismatic, list(model.joints)[1:], strict=True):
        low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
        bounded = joint.nq == 1 and np.isfinite([low, high]).all() and low < high and high - low < 1e3
        reach = 0.5 if slides else np.pi
        lower.append(low if bounded else -reach)
        upper.append(high if bounded else reach)
    return np.array(lower), np.array(upper)


def _working_frame(axis: np.ndarray) -> np.ndarray:
    """Return the rotation whose z is the axis and whose x is the URDF frame's x (or y) projected."""
    z = axis / np.linalg.norm(axis)
    x = np.eye(3)[0] - z[0] * z
    if np.linalg.norm(x) < _PARALLEL:
        x = np.eye(3)[1] - z[1] * z
    x = x / np.linalg.norm(x)
    return np.column_stack((x, np.cross(z, x), z))


def transform(rotation: ArrayLike | None = None, place: ArrayLike = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the transform, shape (4, 4), of a rotation, shape (3, 3), and a place [m], shape (3,)."""
    found = np.eye(4)
    found[:3, :3] = np.eye(3) if rotation is None else rotation
    found[:3, 3] = place
    return found
