"""The attributes of an arm of a URDF: its path, frames, limits and masses, which may be guessed
from its shape.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.errors import (
    BadInputError,
    RobotFileError,
    RobotWarning,
    counted,
    few,
    nearest_first,
    warn,
)
from pincal.robot.closure import Closure
from pincal.robot.dh import DhFrames, dh_frames
from pincal.robot.kinematics import Kinematics
from pincal.robot.link_path import LinkPath, above
from pincal.robot.robot_numbers import OF_ROBOT
from pincal.robot.tree import MOVING_TYPES, Mimic, UrdfJoint, UrdfTree
from pincal.robot.tree_loops import Choice, Pins, linkage_notes, linkage_of
from pincal.robot.urdf_file import arm_text
from pincal.thresholds import Count, Scale
from pincal.units import LARGEST

if TYPE_CHECKING:
    import pinocchio as pin

# Most moving joints of a robot; memory and time grow with their cube.
_MOST_JOINTS: Count = 150
# Moving mass of an industrial arm, per length of its links along the joints to the power below
# [kg/m^2.5]; from data sheets of arms from 0.6 m to 3.2 m. Cobots have a fifth of it. It is an
# initial value only.
_PER_LENGTH: Scale = 36.0
_GROWTH: Scale = 2.5
# Moving fraction of a data sheet's mass; the rest is the base.
_MOVING: Scale = 0.7
# Least length of a link relative to the arm, as flanges are short but have mass.
_SHORTEST: Scale = 0.02
# Joints that a note names.
_NAMED: Count = 3


@dataclass(frozen=True)
class TreeRequest:
    """The part of a URDF that is the robot.

    Attributes:
        tip: link at the end of the path; default: the end of the chain of ``joints``, or of the
            longest moving chain.
        start: link at its start; default: the base.
        base: link on which the tree stands; default: the start of a single path down the tree, else
            the root.
        joints: names of the joints with independent positions (the columns of a table of
            measurements).
        paths: further paths, by the names of their first and last links.
        others: names of further moving joints; all others are locked at their neutral position.
    """

    tip: str | None = None
    start: str | None = None
    base: str | None = None
    joints: Sequence[str] | None = None
    paths: Sequence[tuple[str, str]] = ()
    others: Sequence[str] = ()


def arm_of_tree(tree: UrdfTree, request: TreeRequest, *, mass: float | None) -> dict[str, Any]:
    """Return the attributes of a robot; arguments and errors are those of
    :meth:`pincal.robot.robot.Robot.from_urdf`.
    """
    tip = tree.default_tip(request.joints) if request.tip is None else request.tip
    base, start = _stand(tree, tip, request)
    ends = [(start, tip), *request.paths]
    joints = _moving_joints(tree, base, ends, request.others)
    passed = {
        joint.name for pair in ends for way in _checked_path(tree, base, *pair) for joint in way
    }
    if mass is not None and not OF_ROBOT.lightest <= mass <= LARGEST:
        raise BadInputError(
            f"mass of the robot is {mass} kg; expected {OF_ROBOT.lightest:g} to {LARGEST:g} kg"
        )
    unmeasured = tuple(joint.name for joint in joints if joint.name not in tree.with_loops(passed))
    found = _attributes(tree, joints, base, ends, mass=mass, recorded=request.joints)
    return found | {"unmeasured": unmeasured, "links": tuple(ends[1:])}


def _stand(tree: UrdfTree, tip: str, request: TreeRequest) -> tuple[str, str]:
    """Return the link on which the tree stands, and the start of the first path."""
    base = request.base
    start = request.start
    if start is None:
        default = _default_base(tree, tip, request.joints) if not request.paths else tree.root
        return (default, default) if base is None else (base, base)
    if base is not None:
        return base, start
    tree.path(tree.root, start)
    is_above = any(joint.parent == start for joint in tree.path(tree.root, tip))
    return (start if is_above and not request.paths and not request.others else tree.root), start


def _check_moving(tree: UrdfTree, name: str) -> None:
    """Refuse the name of a joint that is not there, or does not move."""
    known = {joint.name: joint for joint in tree.joints}
    if name not in known or known[name].kind not in MOVING_TYPES:
        raise RobotFileError(
            f"{tree.origin}: no moving joint {name!r}; its joints: "
            f"{', '.join(nearest_first([name], list(known))[:12])}"
        )


def _sources(known: Mapping[str, UrdfJoint], name: str, taken: Collection[str]) -> list[str]:
    """Return the joint that a joint mimics, the one that this mimics, and so on, up to one that is
    taken.
    """
    found = list[str]()
    while (mimic := known[name].mimic) is not None and mimic.source in known:
        name = mimic.source
        if name in taken or name in found:
            break
        found.append(name)
    return found


def _moving_joints(
    tree: UrdfTree, base: str, ends: Sequence[tuple[str, str]], others: Sequence[str]
) -> tuple[UrdfJoint, ...]:
    """Return the moving joints, each after those that carry it: those of the first path's tip
    before its branches.

    Joints above both ends of a path are locked unless they are on another path. All joints of a
    loop move if one does.
    """
    paths = [_checked_path(tree, base, *pair) for pair in ends]
    order: dict[str, None] = dict.fromkeys(
        joint.name for pair in paths for way in reversed(pair) for joint in way
    )
    known = {joint.name: joint for joint in tree.joints}
    for name in others:
        _check_moving(tree, name)
        if _is_above(tree, base, known[name]):
            order.setdefault(name)
    order |= dict.fromkeys(
        joint.name for joint in tree.joints if joint.name in tree.with_loops(order)
    )
    _check_base_outside_loops(tree, base, [known[name] for name in order])
    for name in list(order):
        # A mimic joint moves with its source, which may be on another branch.
        order |= dict.fromkeys(_sources(known, name, order))
    chosen = [known[name] for name in order if known[name].kind in MOVING_TYPES]
    if len(chosen) > _MOST_JOINTS:
        raise RobotFileError(
            f"{tree.origin}: {len(chosen)} moving joints; expected at most "
            f"{_MOST_JOINTS}: choose other links"
        )
    return _in_preorder(tree, chosen)


def _check_base_outside_loops(tree: UrdfTree, base: str, joints: Sequence[UrdfJoint]) -> None:
    """Refuse a base that is carried by a loop of which joints move."""
    cut = [
        joint.name
        for joint in joints
        if joint.name in tree.looped and not _is_above(tree, base, joint)
    ]
    if cut:
        raise RobotFileError(
            f"{tree.origin}: base {base!r} is in a loop with {cut[0]!r}; expected a link that "
            "carries the loop"
        )


def _is_above(tree: UrdfTree, base: str, joint: UrdfJoint) -> bool:
    return base == tree.root or any(above.parent == base for above in tree.above(joint.child))


def _in_preorder(tree: UrdfTree, joints: Sequence[UrdfJoint]) -> tuple[UrdfJoint, ...]:
    """Return joints in depth-first preorder, otherwise in their given order."""
    parents = _parents(tree, joints)
    names = [joint.name for joint in joints]
    children: dict[int, list[int]] = {}
    for i in range(len(names)):
        children.setdefault(parents[i], []).append(i)
    found = []
    open_joints = children.get(-1, [])[::-1]
    while open_joints:
        i = open_joints.pop()
        found.append(joints[i])
        open_joints += children.get(i, [])[::-1]
    return tuple(found)


def _parents(tree: UrdfTree, joints: Sequence[UrdfJoint]) -> tuple[int, ...]:
    return tuple(tree.carrier(joints, joint.parent) for joint in joints)


def path_between(
    tree: UrdfTree,
    joint_names: Sequence[str],
    base: str,
    start: str,
    tip: str,
    *,
    at_rest: bool = False,
    model: pin.Model | None = None,
) -> LinkPath:
    """Return the path between two links of a tree with some moving joints, see
    :meth:`pincal.robot.robot.Robot.between`; ``model`` is that of these joints, where it is known.
    """
    import pinocchio as pin

    known = {joint.name: joint for joint in tree.joints}
    joints = [known[name] for name in joint_names]
    for way in _checked_path(tree, base, start, tip):
        locked = [
            joint.name
            for joint in way
            if joint.kind in MOVING_TYPES and joint.name not in joint_names
        ]
        if locked and not at_rest:
            between = f"{locked[0]!r} between {start!r} and {tip!r} is locked in this robot"
            raise RobotFileError(
                f"{tree.origin}: {between}; expected links with only "
                f"{', '.join(joint_names)} between them"
            )
    if model is None:
        model = arm_model(tree.text, tuple(joint_names), tree.source)
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    placed = {
        link: data.oMf[model.getFrameId(link, pin.BODY)].homogeneous for link in (base, start, tip)
    }
    frames = [data.oMi[model.getJointId(name)].homogeneous for name in joint_names]
    carriers = tree.carrier(joints, start), tree.carrier(joints, tip)
    relative = [
        np.linalg.inv(placed[base] if i < 0 else frames[i]) @ placed[link]
        for i, link in zip(carriers, (start, tip), strict=True)
    ]
    return LinkPath(start, tip, *carriers, *relative)


@dataclass(frozen=True)
class _Neutral:
    """The n moving joints of an arm, and all links, at q = 0 in the base frame.

    Attributes:
        model: Pinocchio's, with all other joints locked.
        ids: the joints in it.
        T_base_world: the frame of the URDF's root.
        joints: shape (n, 4, 4), frames of the joints.
        axes: shape (n, 3), their unit directions.
        links: shape (4, 4), frame of each link by its name.
    """

    model: pin.Model
    ids: list[int]
    T_base_world: pin.SE3
    joints: np.ndarray
    axes: np.ndarray
    links: dict[str, np.ndarray]

    @classmethod
    def of(cls, tree: UrdfTree, names: tuple[str, ...], base: str) -> _Neutral:
        import pinocchio as pin

        model = arm_model(tree.text, names, tree.source)
        data = model.createData()
        ids = [model.getJointId(name) for name in names]
        pin.framesForwardKinematics(model, data, pin.neutral(model))
        T_base_world = data.oMf[model.getFrameId(base, pin.BODY)].inverse()
        joints = np.array([(T_base_world * data.oMi[i]).homogeneous for i in ids])
        axes = np.einsum("nij,nj->ni", joints[:, :3, :3], _local_axes(model, data, ids))
        links = {
            link: (T_base_world * data.oMf[model.getFrameId(link, pin.BODY)]).homogeneous
            for link in tree.links
        }
        return cls(model, ids, T_base_world, joints, axes, links)

    def pins(self, tree: UrdfTree, path: tuple[UrdfJoint, ...]) -> Sequence[Pins]:
        """Return the pins of the loops that the joints close."""
        lines = np.stack([self.joints[:, :3, 3], self.axes], axis=1)
        return Pins.of_tree(tree, path, self.links, lines)

    def limits(self, path: tuple[UrdfJoint, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Return the joints' own limits, shape (n,) each, infinite where they have none."""
        places = [self.model.joints[i].idx_q for i in self.ids]
        lower = self.model.lowerPositionLimit[places]
        upper = self.model.upperPositionLimit[places]
        turns = np.array([joint.kind == "continuous" for joint in path])
        bounded = ~turns & (upper > lower) & (upper - lower < OF_ROBOT.unlimited)
        return np.where(bounded, lower, -np.inf), np.where(bounded, upper, np.inf)


@dataclass(frozen=True)
class _Placed:
    """An arm of n joints at its neutral position, with Denavit-Hartenberg frames.

    Attributes:
        neutral: the arm as the URDF describes it.
        parents: the joint that carries each joint, -1 for the base.
        tips: shape (n, 4, 4), the ends of the links in the base frame.
        pins: the pins at which links close loops.
        frames: the Denavit-Hartenberg frames.
        way: the path of the readings on the links.
    """

    neutral: _Neutral
    parents: tuple[int, ...]
    tips: np.ndarray
    pins: Sequence[Pins]
    frames: DhFrames
    way: LinkPath

    @classmethod
    def of(
        cls,
        tree: UrdfTree,
        path: tuple[UrdfJoint, ...],
        base: str,
        ends: Sequence[tuple[str, str]],
    ) -> _Placed:
        """Return the arm of these joints, with readings between these ends."""
        names = tuple(joint.name for joint in path)
        neutral = _Neutral.of(tree, names, base)
        parents = _parents(tree, path)
        aims = {tree.carrier(path, link): link for pair in reversed(ends) for link in pair}
        tips = np.array([neutral.links[aims.get(i, joint.child)] for i, joint in enumerate(path)])
        pins = neutral.pins(tree, path)
        rods = _rods_of(pins, aims)
        frames = dh_frames(neutral.joints[:, :3, 3], neutral.axes, tips, parents, rods)
        T_link_joint = np.linalg.inv(frames.T_base_link) @ neutral.joints
        way = path_between(tree, names, base, *ends[0], model=neutral.model)
        way = way.on_links(T_link_joint)
        frames = replace(frames, T_last_tip=way.T_joint_tip)
        return cls(neutral, parents, tips, pins, frames, way)

    @property
    def T_link_joint(self) -> np.ndarray:
        """The frames of the URDF's joints in those of the links, shape (n, 4, 4)."""
        return np.asarray(np.linalg.inv(self.frames.T_base_link) @ self.neutral.joints)

    def attributes(self, base: str) -> dict[str, Any]:
        """Return what a robot has of it; ``base`` is the link in whose frame it is."""
        is_whole = self.way.is_whole(len(self.parents)) and self.way.start == base
        return {
            "base": base,
            "tip": self.way.tip,
            "frames": self.frames,
            "T_link_joint": self.T_link_joint,
            "gravity": self.neutral.T_base_world.rotation @ self.neutral.model.gravity.linear,
            "parents": self.parents,
            "ends": None if is_whole else self.way,
        }


@dataclass(frozen=True)
class _Masses:
    """Masses of the n links [kg], shape (n,), centres of mass in the frames of the links [m], shape
    (n, 3), which of them are guessed, and the masses that the URDF has instead of some, else 0
    [kg].
    """

    masses: np.ndarray
    centres: np.ndarray
    guessed: np.ndarray
    placeholders: np.ndarray

    @classmethod
    def of(cls, arm: _Placed, total: float | None) -> _Masses:
        """Return those of the URDF, or guesses where it has none or the user states the total."""
        neutral = arm.neutral
        parents = arm.parents
        T_base_link = arm.frames.T_base_link
        T_link_joint = arm.T_link_joint
        inertias = [neutral.model.inertias[i] for i in neutral.ids]
        masses = np.array([inertia.mass for inertia in inertias])
        levers = np.array([inertia.lever for inertia in inertias])
        centres = np.einsum("nij,nj->ni", T_link_joint[:, :3, :3], levers) + T_link_joint[:, :3, 3]
        spans = _link_ends(parents, neutral.joints, arm.tips)
        light = (masses > 0.0) & are_too_light(masses, spans, parents)
        placeholders = np.where(light & (total is None), masses, 0.0)
        unknown = (masses <= 0.0) | light | are_placeholders(masses.tolist()) | (total is not None)
        if unknown.any():
            masses, middles = guessed_masses(masses, spans, unknown, total=total, parents=parents)
            middles = np.einsum(
                "nji,nj->ni", T_base_link[:, :3, :3], middles - T_base_link[:, :3, 3]
            )
            centres = np.where(unknown[:, None], middles, centres)
        return cls(masses, centres, unknown, placeholders)

    def notes(self, joints: Sequence[str]) -> tuple[str, ...]:
        """Return a note on masses that are none."""
        found = [
            f"{mass:g} kg for what {joint} moves"
            for joint, mass in zip(joints, self.placeholders, strict=True)
            if mass > 0.0
        ]
        if not found:
            return ()
        return (
            f"the robot description has {few(found, _NAMED)}, which no arm of this reach can "
            "weigh: placeholders, read as no mass; state the robot's mass (--mass) if it is known",
        )


def _attributes(
    tree: UrdfTree,
    path: tuple[UrdfJoint, ...],
    base: str,
    ends: Sequence[tuple[str, str]],
    *,
    mass: float | None,
    recorded: Sequence[str] | None,
) -> dict[str, Any]:
    mimics = tree.mimics(path)
    names = tuple(joint.name for joint in path)
    types = tuple("prismatic" if joint.kind == "prismatic" else "revolute" for joint in path)
    arm = _Placed.of(tree, path, base, ends)
    links = _Masses.of(arm, mass)
    limits = _with_mimics(*arm.neutral.limits(path), names=names, mimics=mimics)
    on_path = [names[i] for i, _ in arm.way.steps(arm.parents)]
    choice = Choice(tree.origin, names, recorded, on_path, [mimic.source for mimic in mimics])
    kinematics = Kinematics.of(arm.frames, types, arm.parents)
    closures = [each.placed(arm.frames.T_base_link) for each in arm.pins]
    closed, notes = _closed(tree, kinematics, closures, limits, choice)
    described = {
        "name": tree.name,
        "joint_names": names,
        "joint_types": types,
        "lower": limits[0],
        "upper": limits[1],
        "masses": links.masses,
        "centres": links.centres,
        "massless": tuple(compress((joint.child for joint in path), links.guessed)),
        "notes": _notes(tree, names, ends, (*notes, *links.notes(names))),
        "urdf": tree.text,
        "source": tree.source,
        "mimics": mimics,
    }
    return arm.attributes(base) | closed | described


def _rods_of(pins: Sequence[Pins], aims: Collection[int]) -> dict[int, np.ndarray]:
    """Return the frame of the pin of each joint that is a rod, other than one at whose link a path
    ends.
    """
    pairs = (pair for each in pins for pair in zip(each.carriers, each.T_base, strict=True))
    return {i: T for i, T in pairs if i not in aims}


def _closed(
    tree: UrdfTree,
    kinematics: Kinematics,
    closures: Sequence[Closure],
    limits: tuple[np.ndarray, np.ndarray],
    choice: Choice,
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the closures and passive joints of an arm with loops, and all notes on its tree."""
    if not closures:
        return {"closures": (), "passive": ()}, tree.notes
    linkage = linkage_of(kinematics, closures, limits, choice)
    notes = (*tree.notes, *linkage_notes(linkage, choice))
    passive = tuple(choice.names[i] for i in linkage.passive)
    return {"closures": linkage.closures, "passive": passive}, notes


def _link_ends(parents: Sequence[int], joints: np.ndarray, aims: np.ndarray) -> np.ndarray:
    """Return the start of each joint's link, and its end at the next joint or at its aim, shape (n,
    2, 3).
    """
    following = {parent: i for i, parent in reversed(list(enumerate(parents)))}
    ends = [
        joints[following[i], :3, 3] if i in following else aims[i, :3, 3]
        for i in range(len(joints))
    ]
    return np.stack([joints[:, :3, 3], np.array(ends)], axis=1)


def _local_axes(model: pin.Model, data: pin.Data, ids: list[int]) -> np.ndarray:
    """Return the unit axes of the joints in their own frames, shape (n, 3), for any of Pinocchio's
    joint types.
    """
    import pinocchio as pin

    pin.computeJointJacobians(model, data, pin.neutral(model))
    axes = []
    for i in ids:
        column = np.reshape(pin.getJointJacobian(model, data, i, pin.LOCAL), (6, -1))[
            :, model.joints[i].idx_v
        ]
        axes.append(column[3:] if np.any(column[3:]) else column[:3])
    return np.array(axes)


def _with_mimics(
    lower: np.ndarray, upper: np.ndarray, *, names: tuple[str, ...], mimics: tuple[Mimic, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return limits, shape (n,) each, within which mimic joints also respect their own limits."""
    low = lower.copy()
    high = upper.copy()
    for mimic in mimics:
        i = names.index(mimic.joint)
        k = names.index(mimic.source)
        if mimic.multiplier:
            ends = np.sort((np.array([lower[i], upper[i]]) - mimic.offset) / mimic.multiplier)
            if max(low[k], ends[0]) < min(high[k], ends[1]):
                low[k] = max(low[k], ends[0])
                high[k] = min(high[k], ends[1])
    for mimic in mimics:
        i = names.index(mimic.joint)
        k = names.index(mimic.source)
        if mimic.multiplier:
            low[i], high[i] = np.sort(mimic.multiplier * np.array([low[k], high[k]]) + mimic.offset)
    return low, high


def _notes(
    tree: UrdfTree, names: tuple[str, ...], ends: Sequence[tuple[str, str]], notes: tuple[str, ...]
) -> tuple[str, ...]:
    """Return ``notes`` plus a note on locked joints, and issue them as warnings."""
    locked = [joint for joint in tree.joints if joint.kind != "fixed" and joint.name not in names]
    if locked:
        more = f" and {len(locked) - 6} more" if len(locked) > 6 else ""
        shown = ", ".join(joint.name for joint in locked[:6]) + more
        paths = " and ".join(f"from {start} to {tip}" for start, tip in ends)
        way = "path" if len(ends) == 1 else "paths"
        are = "is locked at its" if len(locked) == 1 else "are locked at their"
        notes += (
            f"{counted(len(locked), 'joint')} off the {way} {paths} {are} neutral position: "
            f"{shown}",
        )
    for note in notes:
        warn(f"{tree.origin}: {note}", RobotWarning)
    return notes


def _default_base(tree: UrdfTree, tip: str, joints: Sequence[str] | None) -> str:
    """Return the root, or the parent link of the first of ``joints`` if other moving joints precede
    it.
    """
    moving = [joint for joint in tree.path(tree.root, tip) if joint.kind in MOVING_TYPES]
    known = tree.with_loops(joints or ())
    if joints is None or not moving or moving[0].name in known:
        return tree.root
    return next((joint.parent for joint in moving if joint.name in known), tree.root)


def _checked_path(
    tree: UrdfTree, base: str, start: str, tip: str
) -> tuple[tuple[UrdfJoint, ...], tuple[UrdfJoint, ...]]:
    """Return all joints between two links, including fixed ones: those traversed backwards, and
    those forwards.
    """
    up = tree.path(base, start)
    down = tree.path(base, tip)
    shared = len([a for a, b in zip(up, down, strict=False) if a is b])
    for joint in (path := (*up[shared:], *down[shared:])):
        if joint.kind not in (*MOVING_TYPES, "fixed"):
            where = f"{tree.origin}: joint {joint.name!r} between {start!r} and {tip!r}"
            expected = (
                "expected revolute, continuous, prismatic or fixed joints: choose another "
                "base or tip"
            )
            raise RobotFileError(f"{where} is {joint.kind}; {expected}")
    if not any(joint.kind in MOVING_TYPES for joint in path):
        raise RobotFileError(
            f"{tree.origin}: no moving joint between {start!r} and {tip!r}; choose another tip"
        )
    return up[shared:], down[shared:]


def arm_model(urdf: bytes, joint_names: tuple[str, ...], source: str) -> pin.Model:
    """Build the model from text of any encoding; an error of Pinocchio becomes a RobotFileError."""
    import pinocchio as pin

    try:
        return pin.buildModelFromXML(arm_text(urdf, joint_names, source))
    except (ValueError, RuntimeError) as error:
        raise RobotFileError(f"{source}: Pinocchio can't read this URDF: {error}") from None


def are_placeholders(masses: Sequence[float]) -> bool:
    """Return whether the masses of links [kg] are placeholders: all equal, except that the last may
    include a flange.

    Example:
        >>> are_placeholders([2.0] * 6), are_placeholders([2.0, 2.0, 2.0, 4.0])
        (True, True)
        >>> are_placeholders([7.8, 12.9, 12.9, 3.9])
        False
    """
    arm = np.asarray(masses if len(masses) == OF_ROBOT.alike else masses[:-1], float)
    return len(arm) >= OF_ROBOT.alike and bool(
        arm[0] > 0.0 and np.allclose(arm, arm[0], rtol=1e-9, atol=0.0)
    )


def are_too_light(masses: np.ndarray, ends: np.ndarray, parents: Sequence[int]) -> np.ndarray:
    """Return which masses [kg], shape (n,), no arm of these links can have, shape (n,); arguments
    as in :func:`guessed_masses`.

    Exporters write a gram or less where a program wants a mass, such as on the frame of a tool.
    """
    usual, _ = guessed_masses(masses, ends, np.ones(len(masses), bool), parents=parents)
    is_light_arm = masses.sum() < OF_ROBOT.light_arm * usual.sum()
    return np.asarray((masses < OF_ROBOT.light_link * usual) | is_light_arm)


def guessed_masses(
    masses: np.ndarray,
    ends: np.ndarray,
    unknown: np.ndarray,
    *,
    total: float | None = None,
    parents: Sequence[int] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return masses, the unknown ones guessed from the shape of the arm, and guessed centres of
    mass.

    The mass of a link is proportional to the length of arm beyond its joint, and its centre is
    midway to the next joint. The scale is taken from the known masses, or else from industrial arms
    of this length.

    Args:
        masses: shape (n,), as far as known [kg].
        ends: shape (n, 2, 3), start and end of each link at q = 0, in the base frame [m]; or, for a
            serial arm, shape (n + 1, 3), its joints and the tip.
        unknown: shape (n,), which links have no known mass.
        total: mass of the whole robot with its base, as on a data sheet [kg].
        parents: the joint that carries each joint, -1 for the base; default: each carries the next.

    Returns:
        Masses, shape (n,) [kg], and centres, shape (n, 3), in the base frame [m].
    """
    spans = ends if ends.ndim == 3 else np.stack([ends[:-1], ends[1:]], axis=1)
    parents = range(-1, len(masses) - 1) if parents is None else parents
    lengths = np.linalg.norm(spans[:, 1] - spans[:, 0], axis=1)
    along = lengths.copy()
    for i, parent in enumerate(parents):
        along[i] += along[parent] if parent >= 0 else 0.0
    longest = above(int(np.argmax(along)), parents)
    whole = max(float(lengths[longest].sum()), 1e-3)
    shown = np.maximum(lengths, _SHORTEST * whole)
    beyond = shown.copy()
    for i, parent in reversed(list(enumerate(parents))):
        if parent >= 0:
            beyond[parent] += beyond[i]
    if total is not None:
        scale = max(_MOVING * total - masses[~unknown].sum(), 0.0) / beyond[unknown].sum()
    elif unknown.all():
        scale = _PER_LENGTH * whole**_GROWTH / np.cumsum(shown[longest][::-1]).sum()
    else:
        scale = masses[~unknown].sum() / beyond[~unknown].sum()
    return np.where(unknown, scale * beyond, masses), 0.5 * (spans[:, 0] + spans[:, 1])
