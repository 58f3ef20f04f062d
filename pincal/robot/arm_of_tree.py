"""An arm of a URDF that was read: its path, frames and limits, and masses, or what the shape suggests of these."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.errors import BadInputError, RobotFileError, warn
from pincal.robot.dh import dh_frames
from pincal.robot.tree import MOVING_TYPES, Mimic, UrdfJoint, UrdfTree
from pincal.robot.urdf_file import arm_text
from pincal.units import LARGEST

if TYPE_CHECKING:
    import pinocchio as pin

# A limit beyond this [rad or m] is how URDFs write "none".
_NO_LIMIT = 1e3
# Mass of a robot [kg] below which grams were not meant, but nothing at all.
_LIGHTEST = 1e-3
# No serial arm has more joints that move; memory and time grow with their cube.
_MOST_JOINTS = 50
# Mass of what moves of an industrial arm, over the length of its links along the joints to the power below [kg/m^2.5]; from
# data sheets of arms from 0.6 m to 3.2 m. Of cobots it is a fifth. It is only where a search starts.
_PER_LENGTH, _GROWTH = 36.0, 2.5
# Part of a data sheet's mass that moves; the rest is the base that the arm stands on.
_MOVING = 0.7
# Length that a link has at least, over that of the arm: flanges are short but weigh.
_SHORTEST = 0.02
# Links that may weigh the same by chance are fewer than these.
_FEWEST_ALIKE = 3


def arm_of_tree(
    tree: UrdfTree, *, tip: str | None, base: str | None, joints: Sequence[str] | None, mass: float | None
) -> dict[str, Any]:
    """Return the attributes of a robot; arguments and errors are those of :meth:`pincal.robot.robot.Robot.from_urdf`."""
    tip = tree.default_tip(joints) if tip is None else tip
    base = _default_base(tree, tip, joints) if base is None else base
    path = _checked_path(tree, base, tip)
    if mass is not None and not _LIGHTEST <= mass <= LARGEST:
        raise BadInputError(f"mass of the robot is {mass} kg; expected {_LIGHTEST:g} to {LARGEST:g} kg")
    return _attributes(tree, path, base, tip, mass=mass)


def _attributes(tree: UrdfTree, path: tuple[UrdfJoint, ...], base: str, tip: str, *, mass: float | None) -> dict[str, Any]:
    import pinocchio as pin

    mimics = tree.mimics(path)
    path = tuple(joint for joint in path if joint.kind in MOVING_TYPES)
    names = tuple(joint.name for joint in path)
    model = arm_model(tree.text, names, tree.source)
    data = model.createData()
    ids = [model.getJointId(name) for name in names]
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    T_base_world = data.oMf[model.getFrameId(base, pin.BODY)].inverse()
    joints = np.array([(T_base_world * data.oMi[i]).homogeneous for i in ids])
    axes = np.einsum("nij,nj->ni", joints[:, :3, :3], _local_axes(model, data, ids))
    frames = dh_frames(joints[:, :3, 3], axes, (T_base_world * data.oMf[model.getFrameId(tip, pin.BODY)]).homogeneous)
    T_link_joint = np.linalg.inv(frames.T_base_link) @ joints
    levers = np.array([model.inertias[i].lever for i in ids])
    centres = np.einsum("nij,nj->ni", T_link_joint[:, :3, :3], levers) + T_link_joint[:, :3, 3]
    masses = np.array([model.inertias[i].mass for i in ids])
    unknown = (masses <= 0.0) | are_placeholders(masses.tolist()) | (mass is not None)
    if unknown.any():
        tip_at = (frames.T_base_link[-1] @ frames.T_last_tip)[:3, 3]
        masses, middles = guessed_masses(masses, np.vstack([joints[:, :3, 3], tip_at]), unknown, total=mass)
        middles = np.einsum("nji,nj->ni", frames.T_base_link[:, :3, :3], middles - frames.T_base_link[:, :3, 3])
        centres = np.where(unknown[:, None], middles, centres)
    places = [model.joints[i].idx_q for i in ids]
    lower, upper = model.lowerPositionLimit[places], model.upperPositionLimit[places]
    turns = np.array([joint.kind == "continuous" for joint in path])
    bounded = ~turns & (upper > lower) & (upper - lower < _NO_LIMIT)
    limits = np.where(bounded, lower, -np.inf), np.where(bounded, upper, np.inf)
    limits = _with_mimics(*limits, names=names, mimics=mimics)
    return {
        "name": tree.name,
        "joint_names": names,
        "joint_types": tuple("prismatic" if joint.kind == "prismatic" else "revolute" for joint in path),
        "lower": limits[0],
        "upper": limits[1],
        "base": base,
        "tip": tip,
        "frames": frames,
        "T_link_joint": T_link_joint,
        "masses": masses,
        "centres": centres,
        "massless": tuple(joint.child for joint, is_unknown in zip(path, unknown, strict=True) if is_unknown),
        "gravity": T_base_world.rotation @ model.gravity.linear,
        "notes": _notes(tree, names, base, tip),
        "urdf": tree.text,
        "source": tree.source,
        "mimics": mimics,
    }


def _local_axes(model: pin.Model, data: pin.Data, ids: list[int]) -> np.ndarray:
    """Return the unit axes of the joints in their own frames, shape (n, 3), whatever Pinocchio's type of joint."""
    import pinocchio as pin

    pin.computeJointJacobians(model, data, pin.neutral(model))
    axes = []
    for i in ids:
        column = np.reshape(pin.getJointJacobian(model, data, i, pin.LOCAL), (6, -1))[:, model.joints[i].idx_v]
        axes.append(column[3:] if np.any(column[3:]) else column[:3])
    return np.array(axes)


def _with_mimics(
    lower: np.ndarray, upper: np.ndarray, *, names: tuple[str, ...], mimics: tuple[Mimic, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return limits, shape (n,) each, within which the joints that follow others keep their own limits, too."""
    low, high = lower.copy(), upper.copy()
    for mimic in mimics:
        i, k = names.index(mimic.joint), names.index(mimic.source)
        if mimic.multiplier:
            ends = np.sort((np.array([lower[i], upper[i]]) - mimic.offset) / mimic.multiplier)
            if max(low[k], ends[0]) < min(high[k], ends[1]):
                low[k], high[k] = max(low[k], ends[0]), min(high[k], ends[1])
    for mimic in mimics:
        i, k = names.index(mimic.joint), names.index(mimic.source)
        if mimic.multiplier:
            low[i], high[i] = np.sort(mimic.multiplier * np.array([low[k], high[k]]) + mimic.offset)
    return low, high


def _notes(tree: UrdfTree, names: tuple[str, ...], base: str, tip: str) -> tuple[str, ...]:
    """Return what the user should know of how the arm was read; it is also warned of."""
    locked = [joint for joint in tree.joints if joint.kind != "fixed" and joint.name not in names]
    notes = tree.notes
    if locked:
        more = f" and {len(locked) - 6} more" if len(locked) > 6 else ""
        shown = ", ".join(joint.name for joint in locked[:6]) + more
        notes += (f"{len(locked)} joints off the path from {base} to {tip} are locked at their neutral position: {shown}",)
    for note in notes:
        warn(f"{tree.source}: {note}")
    return notes


def _default_base(tree: UrdfTree, tip: str, joints: Sequence[str] | None) -> str:
    """Return the root, or the link behind the moving joints that stand before the first of ``joints``."""
    moving = [joint for joint in tree.path(tree.root, tip) if joint.kind in MOVING_TYPES]
    if joints is None or not moving or moving[0].name in joints:
        return tree.root
    return next((joint.parent for joint in moving if joint.name in joints), tree.root)


def _checked_path(tree: UrdfTree, base: str, tip: str) -> tuple[UrdfJoint, ...]:
    """Return all joints from base to tip, fixed ones too."""
    path = tree.path(base, tip)
    moving = [joint for joint in path if joint.kind in MOVING_TYPES]
    for joint in path:
        if joint.kind not in (*MOVING_TYPES, "fixed"):
            where = f"{tree.source}: joint {joint.name!r} between {base!r} and {tip!r}"
            expected = "expected revolute, continuous, prismatic or fixed joints: choose another base or tip"
            raise RobotFileError(f"{where} is {joint.kind}; {expected}")
    if not moving:
        raise RobotFileError(f"{tree.source}: no moving joint between {base!r} and {tip!r}; choose another tip")
    if len(moving) > _MOST_JOINTS:
        raise RobotFileError(
            f"{tree.source}: {len(moving)} moving joints between {base!r} and {tip!r}; expected at most {_MOST_JOINTS}: "
            "choose another base or tip"
        )
    tree.refuse_loops(path)
    return path


def arm_model(urdf: bytes, joint_names: tuple[str, ...], source: str) -> pin.Model:
    """Build the model from text of any encoding; what Pinocchio can't do with it is passed on in words."""
    import pinocchio as pin

    try:
        return pin.buildModelFromXML(arm_text(urdf, joint_names, source))
    except (ValueError, RuntimeError) as error:
        raise RobotFileError(f"{source}: Pinocchio can't read this URDF: {error}") from None


def are_placeholders(masses: Sequence[float]) -> bool:
    """Return whether the masses of links [kg] were only written so that a program reads them: all of them the same.

    The last link may carry a flange that has its own.

    Example:
        >>> are_placeholders([2.0] * 6), are_placeholders([2.0, 2.0, 2.0, 4.0]), are_placeholders([7.8, 12.9, 12.9, 3.9])
        (True, True, False)
    """
    arm = np.asarray(masses if len(masses) == _FEWEST_ALIKE else masses[:-1], float)
    return len(arm) >= _FEWEST_ALIKE and bool(arm[0] > 0.0 and np.allclose(arm, arm[0], rtol=1e-9, atol=0.0))


def guessed_masses(
    masses: np.ndarray, ends: np.ndarray, unknown: np.ndarray, *, total: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return masses, those that are not known told by the shape of the arm, and where the shape has the centres of mass.

    A link weighs in proportion to the length of arm from its joint to the tip, and has its centre between its joint and
    the next. The scale is that of the links whose mass is known, or else of industrial arms of this length.

    Args:
        masses: shape (n,), as far as they are known [kg].
        ends: shape (n + 1, 3), the joints at q = 0 and the tip, in the base frame [m].
        unknown: shape (n,), which links have no mass that is known.
        total: mass of the whole robot with its base, as on a data sheet [kg].

    Returns:
        Masses, shape (n,) [kg], and centres, shape (n, 3), in the base frame [m].
    """
    lengths = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    whole = max(float(lengths.sum()), 1e-3)
    beyond = np.cumsum(np.maximum(lengths, _SHORTEST * whole)[::-1])[::-1]
    if total is not None:
        scale = max(_MOVING * total - masses[~unknown].sum(), 0.0) / beyond[unknown].sum()
    elif unknown.all():
        scale = _PER_LENGTH * whole**_GROWTH / beyond.sum()
    else:
        scale = masses[~unknown].sum() / beyond[~unknown].sum()
    return np.where(unknown, scale * beyond, masses), 0.5 * (ends[:-1] + ends[1:])
