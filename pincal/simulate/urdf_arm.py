"""Reading the arm of the true machine from a URDF with Pinocchio: placements, axes, bodies, limits,
pins of loops.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from pincal.errors import RobotFileError
from pincal.simulate.arm import Arm, Pin, frames, transform

# The default axis of a joint.
_X = "1 0 0"
# Sine of the angle between a joint axis and the x axis of its frame below which x has no
# projection.
_PARALLEL = 1e-6


def read_arm(
    urdf: str | Path,
    tip: str,
    base: str | None = None,
    *,
    start: str | None = None,
    joints: Sequence[str] = (),
    passive: Collection[str] = (),
) -> Arm:
    """Read the arm between two frames of a URDF with Pinocchio.

    Joints that are not between base and tip are locked at 0, with their bodies fixed to the links
    that carry them.

    Args:
        urdf: Path of a URDF file, or its XML text.
        tip: Name of the link at the end of the arm.
        base: Name of the link on which the arm stands; default: the root of the URDF.
        start: Name of the link in whose frame positions are given; default: the base.
        joints: Names of the moving joints, each after the one that carries it; default: those
            between base and tip.
        passive: Those of them whose positions follow from the URDF's loops; without any, loops stay
            open.

    Raises:
        RobotFileError: If the URDF can't be read, a frame is missing or no joint lies between base
            and tip.
    """
    import pinocchio as pin

    root = _root(urdf)
    halves = take_pins(root)
    full = _load(
        ElementTree.tostring(root, encoding="unicode"), "URDF text" if _is_text(urdf) else str(urdf)
    )
    path = [full.getJointId(name) for name in joints] or _path(full, tip, base)
    locked = [index for index in range(1, full.njoints) if index not in path]
    model = pin.buildReducedModel(full, locked, pin.neutral(full)) if locked else full
    arm = _arm(model, tip, base, start=start or base, order=joints or model.names[1:])
    arm = replace(arm, mimics=_mimics(root, arm.names))
    return _with_pins(arm, model, base, halves, passive) if passive else arm


class Half(NamedTuple):
    """One half of a pin in a URDF: link, frame on it (None: the other half's at zero) and axis in
    the frame.
    """

    link: str
    place: np.ndarray | None
    axis: np.ndarray


def _half(element: ElementTree.Element, role: str) -> Half:
    """Return the half of a constraint on its parent or child link."""
    return Half(
        _link(element, role),
        _origin(element.find(f"{role}_origin")),
        _axis(element.find(f"{role}_axis")),
    )


def take_pins(root: ElementTree.Element) -> list[tuple[str, bool, Half, Half]]:
    """Return name, whether it is a hinge, and halves of each pin of a URDF; remove second joints of
    a link from it.
    """
    found = []

    def add(element: ElementTree.Element, one: Half, other: Half) -> None:
        is_hinge = element.get("type") in ("revolute", "continuous")
        found.append((element.get("name", ""), is_hinge, one, other))

    for element in root.iterfind("constraint"):
        add(element, _half(element, "parent"), _half(element, "child"))
    for element in root.iterfind("gazebo/joint"):
        parent, child = ((element.findtext(role) or "").strip() for role in ("parent", "child"))
        axis = np.array((element.findtext("axis/xyz") or _X).split(), float)
        add(element, Half(parent, None, axis), Half(child, np.eye(4), axis))
    seen = set[str]()
    for joint in sorted(root.findall("joint"), key=lambda joint: joint.get("type") != "fixed"):
        child = _link(joint, "child")
        axis = _axis(joint.find("axis"))
        if child in seen:
            first = Half(_link(joint, "parent"), _origin(joint.find("origin")), axis)
            add(joint, first, Half(child, np.eye(4), axis))
            root.remove(joint)
        seen.add(child)
    return found


def _link(element: ElementTree.Element, role: str) -> str:
    end = element.find(role)
    return "" if end is None else end.get("link", "")


def _axis(element: ElementTree.Element | None) -> np.ndarray:
    return np.array((_X if element is None else element.get("xyz", _X)).split(), float)


def _origin(element: ElementTree.Element | None) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    xyz, rpy = ("0 0 0" if element is None else element.get(key, "0 0 0") for key in ("xyz", "rpy"))
    return transform(
        Rotation.from_euler("xyz", np.array(rpy.split(), float)).as_matrix(),
        np.array(xyz.split(), float),
    )


def _with_pins(
    arm: Arm,
    model: Any,
    base: str | None,
    halves: list[tuple[str, bool, Half, Half]],
    passive: Collection[str],
) -> Arm:
    import pinocchio as pin

    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    origin = data.oMf[_frame_id(model, base)].inverse() if base else pin.SE3.Identity()
    # Working frames of the joints at position 0, and last the base's.
    working = np.roll(frames(arm, np.zeros((1, len(arm.names))))[0, :-1], -1, axis=0)
    links = {}
    moved = {}
    for frame, place in zip(model.frames, data.oMf, strict=True):
        if frame.type == pin.BODY:
            name = model.names[frame.parentJoint]
            links[frame.name] = (origin * place).homogeneous
            moved[frame.name] = arm.names.index(name) if name in arm.names else -1
    pins = []
    for name, is_hinge, one, other in halves:
        end = links[other.link] @ other.place
        start = end if one.place is None else links[one.link] @ one.place
        places = [
            place @ transform(_working_frame(half.axis))
            for place, half in ((start, one), (end, other))
        ]
        joints = moved[one.link], moved[other.link]
        if joints[0] != joints[1]:
            inside = [
                np.linalg.solve(working[joint], place)
                for joint, place in zip(joints, places, strict=True)
            ]
            pins.append(Pin(name, joints, np.array(inside), is_hinge))
    return replace(arm, pins=tuple(pins), passive=tuple(arm.index(name) for name in passive))


def _root(urdf: str | Path) -> ElementTree.Element:
    if not _is_text(urdf) and not Path(urdf).is_file():
        raise RobotFileError(f"{urdf}: no such file; expected a URDF")
    try:
        return (
            ElementTree.fromstring(str(urdf))
            if _is_text(urdf)
            else ElementTree.parse(urdf).getroot()
        )
    except ElementTree.ParseError as error:
        raise RobotFileError(f"{'URDF text' if _is_text(urdf) else urdf}: {error}") from error


def _load(text: str, source: str) -> Any:
    import pinocchio as pin

    try:
        return pin.buildModelFromXML(text)
    except ValueError as error:
        raise RobotFileError(f"{source}: {error}") from error


def _is_text(urdf: str | Path) -> bool:
    return str(urdf).lstrip().startswith("<")


def _mimics(
    root: ElementTree.Element, names: tuple[str, ...]
) -> tuple[tuple[int, int, float, float], ...]:
    """Return the mimic joints of the arm: joint, source, multiplier and offset."""
    found = []
    for joint in root.iterfind("joint"):
        mimic = joint.find("mimic")
        if mimic is not None and joint.get("name") in names and mimic.get("joint") in names:
            indices = names.index(str(joint.get("name"))), names.index(str(mimic.get("joint")))
            found.append(
                (*indices, float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0)))
            )
    return tuple(found)


def _frame_id(model: Any, name: str) -> int:
    """Return the index of a link's frame; a joint may have the same name."""
    import pinocchio as pin

    if not model.existFrame(name, pin.BODY):
        names = [frame.name for frame in model.frames if frame.type == pin.BODY]
        raise RobotFileError(f"link {name!r}: not in the URDF; expected one of {', '.join(names)}")
    return int(model.getFrameId(name, pin.BODY))


def _path(model: Any, tip: str, base: str | None) -> list[int]:
    tip_joint, base_joint = (
        model.frames[_frame_id(model, end)].parentJoint if end else 0 for end in (tip, base)
    )
    path = [
        index
        for index in model.supports[tip_joint]
        if index and index not in model.supports[base_joint]
    ]
    if not path:
        raise RobotFileError(
            f"no joint between base {base!r} and tip {tip!r}; name a tip that the joints move"
        )
    return path


def _at_neutral(model: Any) -> Any:
    """Return Pinocchio's data of a model at its neutral position."""
    import pinocchio as pin

    data = model.createData()
    q = pin.neutral(model)
    pin.computeJointJacobians(model, data, q)
    pin.framesForwardKinematics(model, data, q)
    return data


def _axes(model: Any, data: Any, joints: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the working frame of each joint's axis, shape (n, 3, 3), and which are prismatic."""
    twists = [_twist(model, data, i) for i in joints]
    prismatic = np.array([not np.any(twist[3:]) for twist in twists])
    axes = [_working_frame(t[:3] if p else t[3:]) for t, p in zip(twists, prismatic, strict=True)]
    return np.array(axes), prismatic


def _moving_joint(model: Any, tip: str) -> int:
    """Return the joint that moves a link.

    Raises:
        RobotFileError: if none does.
    """
    joint = int(model.frames[_frame_id(model, tip)].parentJoint)
    if not joint:
        raise RobotFileError(
            f"no joint moves {tip!r}, which is to be measured; expected a link of the arm, or "
            f"with it the hand that sees it (--from HAND --to {tip})"
        )
    return joint


def _bodies(model: Any, joints: Sequence[int], axes: np.ndarray) -> dict[str, Any]:
    """Return masses, centres of mass and inertias of the links, about the axes of their joints."""
    bodies = [(model.inertias[i], axis) for i, axis in zip(joints, axes, strict=True)]
    return {
        "masses": np.array([body.mass for body, _ in bodies]),
        "centres": np.array([axis.T @ body.lever for body, axis in bodies]),
        "inertias": np.array([axis.T @ body.inertia @ axis for body, axis in bodies]),
    }


def _arm(model: Any, tip: str, base: str | None, *, start: str | None, order: Sequence[str]) -> Arm:
    import pinocchio as pin

    data = _at_neutral(model)
    origin = data.oMf[_frame_id(model, base)] if base else pin.SE3.Identity()
    joints = [model.getJointId(name) for name in order]
    axes, prismatic = _axes(model, data, joints)
    working = {0: origin.homogeneous} | {
        i: data.oMi[i].homogeneous @ transform(axis) for i, axis in zip(joints, axes, strict=True)
    }
    end = _moving_joint(model, tip)
    placements = [np.linalg.solve(working[model.parents[i]], working[i]) for i in joints]
    placements.append(np.linalg.solve(working[end], data.oMf[_frame_id(model, tip)].homogeneous))
    lower, upper = _limits(model, prismatic, joints)
    carrier = model.frames[_frame_id(model, start)].parentJoint if start else 0
    seen_from = data.oMf[_frame_id(model, start)] if start else pin.SE3.Identity()
    return Arm(
        names=tuple(order),
        prismatic=prismatic,
        placements=np.array(placements),
        **_bodies(model, joints, axes),
        axes=axes,
        lower=lower,
        upper=upper,
        parents=tuple(joints.index(model.parents[i]) if model.parents[i] else -1 for i in joints),
        tip_joint=joints.index(end),
        start_joint=joints.index(carrier) if carrier else -1,
        start=np.linalg.solve(working[carrier], seen_from.homogeneous),
    )


def _twist(model: Any, data: Any, joint: int) -> np.ndarray:
    """Return the direction, linear then angular, in which a joint moves its own frame,
    shape (6,).
    """
    import pinocchio as pin

    if model.joints[joint].nv != 1:
        raise RobotFileError(
            f"joint {model.names[joint]!r}: has several freedoms; expected revolute or prismatic"
        )
    jacobian = np.reshape(pin.getJointJacobian(model, data, joint, pin.LOCAL), (6, -1))
    return np.asarray(jacobian[:, model.joints[joint].idx_v])


def _limits(
    model: Any, prismatic: np.ndarray, joints: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return limits; default: half a turn, or half a metre, to either side."""
    lower = []
    upper = []
    for slides, joint in zip(prismatic, [model.joints[i] for i in joints], strict=True):
        low = model.lowerPositionLimit[joint.idx_q]
        high = model.upperPositionLimit[joint.idx_q]
        bounded = (
            joint.nq == 1 and np.isfinite([low, high]).all() and low < high and high - low < 1e3
        )
        reach = 0.5 if slides else np.pi
        lower.append(low if bounded else -reach)
        upper.append(high if bounded else reach)
    return np.array(lower), np.array(upper)


def _working_frame(axis: np.ndarray) -> np.ndarray:
    """Return the rotation whose z is the axis and whose x is the URDF frame's x (or y)
    projected.
    """
    z = axis / np.linalg.norm(axis)
    x = np.eye(3)[0] - z[0] * z
    if np.linalg.norm(x) < _PARALLEL:
        x = np.eye(3)[1] - z[1] * z
    x = x / np.linalg.norm(x)
    return np.column_stack((x, np.cross(z, x), z))
