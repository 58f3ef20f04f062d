"""The same arm with other zeros and directions of its joints, or other lengths."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

from pincal.errors import BadInputError, PincalWarning, nearest_first
from pincal.robot.robot import Robot
from pincal.robot.urdf_file import parse_urdf, parse_xml


def free_joints(robot: Robot) -> tuple[str, ...]:
    """Return the names of the joints that are neither mimic joints nor their sources."""
    bound = {name for mimic in robot.mimics for name in (mimic.joint, mimic.source)}
    return tuple(name for name in robot.joint_names if name not in bound)


def remastered(
    robot: Robot, *, shifts: Mapping[str, float] | None = None, turned: Collection[str] = ()
) -> Robot:
    """Return the same arm with other zeros or directions of its joints.

    Args:
        robot: the arm.
        shifts: the URDF's position of revolute joints at which they report zero [rad], by name.
        turned: names of the joints that report the opposite of the URDF's positions.

    Raises:
        BadInputError: for a joint that the robot does not have, or that mimics another or is
            mimicked.

    Example:
        >>> robot = Robot.from_urdf("ur10")
        >>> other, q = remastered(robot, turned=["elbow_joint"]), np.full((1, 6), 0.3)
        >>> flipped = q * [1, 1, -1, 1, 1, 1]
        >>> bool(np.allclose(robot.forward_kinematics(q), other.forward_kinematics(flipped)))
        True
    """
    given = shifts or {}
    known = free_joints(robot)
    for name in (*given, *turned):
        if name not in known:
            raise BadInputError(
                f"sign or zero of an unknown joint, {name!r}; expected one of "
                f"{', '.join(nearest_first([name], known))}"
            )
    root = parse_xml(robot.urdf, robot.source)
    for joint in root.iterfind("joint"):
        axis = np.array(_numbers(joint.find("axis"), "xyz", "1 0 0"))
        if joint.get("name") in given:
            _shift(joint, axis, given[joint.get("name")])
        if joint.get("name") in turned:
            _reverse(joint, axis)
    with warnings.catch_warnings(action="ignore", category=PincalWarning):
        # The same warnings were issued when the robot was read.
        tree = parse_urdf(etree.tostring(root), source=robot.source)
        found = Robot.from_tree(tree, robot.request)
    flipped = np.isin(robot.joint_names, list(turned))
    return _as_known(found, robot, flipped)


def resized(robot: Robot, lengths: Mapping[str, float]) -> Robot:
    """Return an arm with other lengths.

    Args:
        robot: the arm.
        lengths: what lengths are longer by [m], by the names of their Denavit-Hartenberg
            parameters: ``"elbow_joint.a"`` from a joint's axis to the next, ``"elbow_joint.d"``
            along it.

    Raises:
        BadInputError: for a joint after which no other one follows, where a length is the tool's.

    Example:
        >>> robot = Robot.from_urdf("ur10")
        >>> longer = resized(robot, {"elbow_joint.a": 0.02})
        >>> np.round((longer.frames.parameters - robot.frames.parameters)[2, 3:5], 9).tolist()
        [0.0, 0.02]
    """
    if not lengths:
        return robot
    root = parse_xml(robot.urdf, robot.source)
    joints = {joint.get("name"): joint for joint in root.iterfind("joint")}
    for name, longer in lengths.items():
        joint, _, symbol = name.partition(".")
        i = robot.joint_names.index(joint)
        following = robot.next_joint(i)
        if following is None or symbol not in ("a", "d"):
            raise BadInputError(f"{name!r} is no length between two joints; expected JOINT.a or .d")
        x_axis = robot.frames.T_base_link[i, :3, 0]
        axis = x_axis if symbol == "a" else robot.frames.axis(i, robot.parents[i])
        _lengthen(joints[robot.joint_names[following]], robot, following, longer * axis)
    with warnings.catch_warnings(action="ignore", category=PincalWarning):
        tree = parse_urdf(etree.tostring(root), source=robot.source)
        found = Robot.from_tree(tree, robot.request)
    return _as_known(found, robot, np.zeros(robot.n_joints, bool))


def _lengthen(joint: Any, robot: Robot, i: int, by: np.ndarray) -> None:
    """Move the origin of the i-th joint of an arm by a vector in the base frame at q = 0,
    shape (3,) [m].
    """
    origin = _part(joint, "origin")
    turn = Rotation.from_euler("xyz", _numbers(origin, "rpy", "0 0 0")).as_matrix()
    at_zero = (robot.frames.T_base_link[i] @ robot.T_link_joint[i])[:3, :3]
    moved = np.array(_numbers(origin, "xyz", "0 0 0")) + turn @ at_zero.T @ by
    origin.set("xyz", _text(moved))


def _as_known(found: Robot, robot: Robot, flipped: np.ndarray) -> Robot:
    """Return an arm that was read again with all that is known of it besides its URDF; ``flipped``,
    shape (n,), are joints that count the other way now.
    """
    # Links keep their pose in the URDF's joint frames.
    frames = found.T_link_joint @ np.linalg.inv(robot.T_link_joint)
    return replace(
        found,
        masses=robot.masses,
        centres=np.einsum("nij,nj->ni", frames[:, :3, :3], robot.centres) + frames[:, :3, 3],
        massless=robot.massless,
        lower=np.where(flipped, -robot.upper, robot.lower),
        upper=np.where(flipped, -robot.lower, robot.upper),
        gravity=robot.gravity,
        notes=robot.notes,
        couplings=robot.couplings,
    )


def _shift(joint: Any, axis: np.ndarray, zero: float) -> None:
    """Turn the origin of a joint of a URDF to a position that becomes its zero [rad]."""
    origin = _part(joint, "origin")
    turn = Rotation.from_rotvec(zero * axis / np.linalg.norm(axis))
    now = Rotation.from_euler("xyz", _numbers(origin, "rpy", "0 0 0")) * turn
    origin.set("rpy", _text(now.as_euler("xyz")))


def _reverse(joint: Any, axis: np.ndarray) -> None:
    """Reverse the axis of a joint of a URDF, and its limits."""
    _part(joint, "axis").set("xyz", _text(-axis))
    if (limit := joint.find("limit")) is not None:
        lower, upper = (np.array(_numbers(limit, end, "0")) for end in ("lower", "upper"))
        limit.set("lower", _text(-upper))
        limit.set("upper", _text(-lower))


def _part(joint: Any, tag: str) -> Any:
    """Return a part of a joint, which is added where it is missing."""
    found = joint.find(tag)
    return etree.SubElement(joint, tag) if found is None else found


def _numbers(element: Any, key: str, default: str) -> list[float]:
    text = default if element is None else element.get(key, default)
    return [float(word) for word in text.split()]


def _text(numbers: np.ndarray) -> str:
    return " ".join(repr(float(number)) for number in numbers)
