"""The calibrated robot as a URDF: the original text with the origins of the arm's joints where the fit puts them."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from pincal.errors import PincalWarning, RobotFileError
from pincal.io.urdf_text import Origin, append_frame, read_origins, rpy_of, write_origins
from pincal.model.augmented import joint_placements
from pincal.model.chain import Chain
from pincal.model.effect import Family
from pincal.model.effects import GEOMETRIC, Conditions
from pincal.model.model import Model
from pincal.robot.robot import Robot
from pincal.robot.tree import MOVING_TYPES, UrdfJoint, UrdfTree
from pincal.robot.urdf_file import parse_urdf

# Largest error of the written URDF's tip [m], and of an element of its rotation matrix, against the calibrated
# geometry: a thousand times what rounding does and a thousand times less than what is ever measured.
FK_TOLERANCE = 1e-9
# A tip that moves by less [m or rad] stays where it is.
_TIP_MOVED = 1e-12
_CHECKED_POSES = 50
_GEOMETRIC_NAMES = tuple(effect.name for effect in GEOMETRIC)


@dataclass(frozen=True)
class UrdfExport:
    """A calibrated URDF.

    Attributes:
        text: the URDF, in the encoding of the original.
        tip: the link that is the calibrated tip: the robot's tip, or one inserted behind it.
        edited: joints whose origin has changed.
        notes: what the URDF can't carry and what had to be inserted, in words.
        max_error_m: largest distance between the tip of ``text``, by Pinocchio, and that of the calibrated geometry [m].
    """

    text: bytes
    tip: str
    edited: tuple[str, ...]
    notes: tuple[str, ...]
    max_error_m: float


def calibrated_urdf(model: Model, values: np.ndarray, *, urdf: bytes | None = None) -> UrdfExport:
    r"""Write the calibrated geometry into the URDF of the robot.

    A joint's origin becomes :math:`(\prod T_{fixed})^{-1} T_{i-1,i}` with the fixed joints between two moving ones left as
    they are; the last fixed joint before the tip takes what the tip moves by. Elastic effects are left out.

    Args:
        model: the calibrated model.
        values: shape (P,) or longer, its parameters; what follows them (a sensor's own) is not used.
        urdf: the URDF to edit; default: that of ``model.chain.robot``.

    Returns:
        The URDF, byte for byte the original but for the numbers of the origins that changed.

    Raises:
        RobotFileError: if there is no URDF, it is not that of the robot, or its tip is not where the model has it.

    Example:
        >>> from pincal.robot.robot import Robot
        >>> robot = Robot.from_urdf("ur10", tip="tool0")
        >>> model = Model(Chain.of(robot), GEOMETRIC)
        >>> values = np.zeros(model.n_parameters)
        >>> values[model.index("elbow_joint.theta")] = 1e-3
        >>> calibrated_urdf(model, values).edited
        ('elbow_joint',)
    """
    robot = model.chain.robot
    text = robot.urdf if urdf is None else urdf
    if not text:
        raise RobotFileError("the model holds no URDF; expected its text: give the file that the robot was loaded from")
    tree = parse_urdf(text, source=robot.source)
    values = model.own(np.asarray(values, float))
    before, after = _placements(model, np.zeros(model.n_parameters)), _placements(model, values)
    segments, old = _segments(tree, robot), read_origins(text, tree.source)
    edited, tip, notes = (
        write_origins(text, _origins(segments, old, before, after), tree.source),
        robot.tip,
        rigid_notes(model),
    )
    if not segments[-1] and np.abs(after[-1] - before[-1]).max() > _TIP_MOVED:
        edited, tip = _with_tip(edited, tree, robot, np.linalg.inv(before[-1]) @ after[-1])
        notes = (*notes, f"no fixed joint holds {robot.tip}; link {tip} was inserted behind it as the calibrated tip")
    new = read_origins(edited, tree.source)
    changed = tuple(name for name in old if not np.array_equal(new[name].matrix, old[name].matrix))
    return UrdfExport(edited, tip, changed, notes, _check(edited, tip, model, values))


def _placements(model: Model, values: np.ndarray) -> np.ndarray:
    """Return the moving joints each in the one before, and the tip in the last, shape (n + 1, 4, 4)."""
    joints, tip = joint_placements(model, values)
    return np.concatenate([joints, tip[None]])


def _segments(tree: UrdfTree, robot: Robot) -> list[list[UrdfJoint]]:
    """Return the joints from base to tip, cut behind each moving one: the last list holds those behind the last."""
    segments: list[list[UrdfJoint]] = [[]]
    for joint in tree.path(robot.base, robot.tip):
        segments[-1].append(joint)
        if joint.kind in MOVING_TYPES:
            segments.append([])
    names = tuple(segment[-1].name for segment in segments[:-1])
    if names != robot.joint_names:
        raise RobotFileError(
            f"{tree.source}: moving joints {', '.join(names)} between {robot.base!r} and {robot.tip!r}; "
            f"expected those of the model, {', '.join(robot.joint_names)}: give the URDF it was calibrated with"
        )
    return segments


def _origins(
    segments: list[list[UrdfJoint]], old: dict[str, Origin], before: np.ndarray, after: np.ndarray
) -> dict[str, Origin]:
    """Return the new origin of the last joint of each segment, those ahead of it left as they are."""
    new = {}
    for segment, nominal, calibrated in zip(segments, before, after, strict=True):
        if segment:
            ahead = np.eye(4)
            for joint in segment[:-1]:
                ahead = ahead @ old[joint.name].matrix
            to_joint, name = np.linalg.inv(ahead), segment[-1].name
            new[name] = _moved(old[name], to_joint @ nominal, to_joint @ calibrated)
    return new


def _moved(old: Origin, before: np.ndarray, after: np.ndarray) -> Origin:
    """Return an origin moved as its placement does: what has not moved stays as the URDF has it, to the last digit."""
    xyz = old.xyz + (after[:3, 3] - before[:3, 3])
    turned = not np.array_equal(after[:3, :3], before[:3, :3])
    return Origin(xyz, rpy_of(after[:3, :3], old.rpy) if turned else old.rpy)


def _with_tip(text: bytes, tree: UrdfTree, robot: Robot, T_tip_calibrated: np.ndarray) -> tuple[bytes, str]:
    """Return the text with a link for the calibrated tip behind the tip, and this link's name."""
    taken = {*tree.links, *(joint.name for joint in tree.joints)}
    name = f"{robot.tip}_calibrated"
    while name in taken or f"{name}_joint" in taken:
        name += "_"
    origin = Origin(T_tip_calibrated[:3, 3], rpy_of(T_tip_calibrated[:3, :3], np.zeros(3)))
    joint = f"{name}_joint"
    return append_frame(text, parent=robot.tip, joint=joint, link=name, origin=origin, source=tree.source), name


def rigid_notes(model: Model, *, what: str = "URDF") -> tuple[str, ...]:
    """Say what a file of the rigid geometry leaves to ``model.json``."""
    names = [effect.name for effect in model.effects]
    elastic = [
        effect.name
        for effect in model.effects
        if effect.uses_moments or effect.family is Family.ELASTICITY or effect.bodies(model.chain)
    ]
    read = [effect.name for effect in model.effects if effect.is_sighted]
    others = [n for n in names if n not in (*_GEOMETRIC_NAMES, "base_frame", "tool_frame", *elastic, *read)]
    notes = []
    if elastic:
        notes.append(
            f"{', '.join(elastic)}: a {what} describes a rigid arm; deflection under the arm's own weight and under a "
            "payload is in model.json only"
        )
    if others:
        notes.append(
            f"{', '.join(others)}: varies from pose to pose; the {what} has its value at q = 0, model.json all of it"
        )
    if read:
        notes.append(f"{', '.join(read)}: an error of the instrument, not of the robot; it is in model.json only")
    if "base_frame" in names:
        notes.append(f"base_frame: the pose of {model.chain.robot.base} in the instrument's frame is in model.json only")
    if "tool_frame" in names:
        targets = ", ".join(model.chain.targets)
        notes.append(f"tool_frame: the pose of the target ({targets}) on {model.chain.robot.tip} is in model.json only")
    return tuple(notes)


def _check(text: bytes, tip: str, model: Model, values: np.ndarray) -> float:
    """Return how far the text's tip is from the calibrated geometry at most; refuse what is more than rounding."""
    robot = model.chain.robot
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PincalWarning)
        written = Robot.from_urdf(text, tip=tip, base=robot.base)
    q = robot.random_configurations(_CHECKED_POSES, np.random.default_rng(0))
    difference = written.forward_kinematics(q)[:, :3] - rigid_tips(model, values, q)
    error = float(np.linalg.norm(difference[:, :, 3], axis=1).max())
    if not np.abs(difference).max() <= FK_TOLERANCE:
        raise RobotFileError(
            f"{robot.source}: the calibrated URDF would put {tip} up to {error:.3g} m from where the model does, "
            f"expected at most {FK_TOLERANCE:g} m: give the URDF that the robot was calibrated with"
        )
    return error


def rigid_tips(model: Model, values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the tip in the base frame, shape (N, 3, 4), by the rigid part of the model, not by its placements."""
    robot = model.chain.robot
    chain = Chain.of(robot, moment_frame=model.chain.moment_frame)
    rigid = Model(chain, GEOMETRIC)
    deviations = model.rigid_coordinates(values) - model.chain.nominal
    found = [deviations[chain.joint(robot.joint_names.index(p.element), p.symbol)] for p in rigid.parameters]
    return rigid.predict(np.array(found), Conditions.at(q))
