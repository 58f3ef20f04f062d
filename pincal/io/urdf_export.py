"""The calibrated robot as a URDF: the original text with calibrated origins of the arm's joints."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from pincal.errors import PincalWarning, RobotFileError
from pincal.io.file_numbers import IN_FILES
from pincal.io.urdf_readers import read_back
from pincal.io.urdf_text import (
    Origin,
    append_frame,
    read_origins,
    rpy_of,
    with_comment,
    write_origins,
)
from pincal.model.augmented import closure_frames, link_placements
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Family
from pincal.model.effects import GEOMETRIC
from pincal.model.model import Model
from pincal.robot.link_path import LinkPath
from pincal.robot.robot import Robot
from pincal.robot.tree import MOVING_TYPES, UrdfJoint, UrdfTree
from pincal.robot.urdf_file import parse_urdf
from pincal.thresholds import Count

_CHECKED_POSES: Count = 50
_GEOMETRIC_NAMES = tuple(effect.name for effect in GEOMETRIC)


@dataclass(frozen=True)
class UrdfExport:
    """A calibrated URDF.

    Attributes:
        text: the URDF, in the encoding of the original.
        tip: the link at the calibrated tip: the robot's tip, or one inserted behind it.
        edited: joints whose origin has changed.
        notes: effects that the URDF can't represent, and inserted links, in words.
        max_error_m: largest distance between the tip of ``text``, by Pinocchio, and that of the
            calibrated geometry [m].
        links_error_m: largest difference of the pose of a link between Pinocchio and yourdfpy [m,
            1], which share no code; infinite if yourdfpy can read neither this URDF nor the
            original, or is not installed.
    """

    text: bytes
    tip: str
    edited: tuple[str, ...]
    notes: tuple[str, ...]
    max_error_m: float
    links_error_m: float


def calibrated_urdf(
    model: Model, values: np.ndarray, *, urdf: bytes | None = None, comment: str = ""
) -> UrdfExport:
    r"""Write the calibrated geometry into the URDF of the robot.

    A joint's origin becomes :math:`(\prod T_{fixed})^{-1} T_{i-1,i}` with fixed joints between two
    moving ones unchanged; the last fixed joint before the tip takes the displacement of the tip.
    Elastic effects are left out.

    Args:
        model: the calibrated model.
        values: shape (P,) or longer, its parameters; further ones (a sensor's own) are not used.
        urdf: the URDF to edit; default: the one of ``model.chain.robot``.
        comment: a line at the top of the file; default: none.

    Returns:
        The URDF, identical to the original except for the numbers of changed origins, and the
        comment.

    Raises:
        RobotFileError: if there is no URDF, it is of another robot, its tip differs from the
            model's, or Pinocchio and yourdfpy put a link of the written file in different places.

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
    text = _text_of(robot, urdf)
    tree = parse_urdf(text, source=robot.source)
    paths = [robot.between(*pair) for pair in ((None, None), *robot.links)]
    values = model.own(np.asarray(values, float))
    ends = [link for path in paths for link, joint, _ in path.ends if joint >= 0]
    segments = _segments(tree, robot, ends)
    old = read_origins(text, tree.source)
    before, after = (_placements(model, of, paths) for of in (np.zeros(model.n_parameters), values))
    pins, open_pins = _pin_origins(tree, model, values, old)
    edited = write_origins(text, _origins(segments, old, before, after) | pins, tree.source)
    tip = robot.tip
    is_moved = {
        end: np.abs(after[end] - before[end]).max() > IN_FILES.tip_moved
        for end in ends
        if not segments[end]
    }
    if is_moved.pop(tip, False):
        edited, tip = _with_tip(edited, tree, robot, np.linalg.inv(before[tip]) @ after[tip])
    held = [end for end, moved in is_moved.items() if moved]
    notes = (*rigid_notes(model), *_notes_on_ends(open_pins, robot.tip, tip, held))
    new = read_origins(edited, tree.source)
    changed = tuple(name for name in old if not np.array_equal(new[name].matrix, old[name].matrix))
    lost = (*held, *ends, tip) if open_pins else held
    error = _check(edited, tip, model, values, lost=lost)
    edited = with_comment(edited, comment)
    readers = read_back(robot, edited, text)
    notes += (readers.note,) if readers.note else ()
    return UrdfExport(edited, tip, changed, notes, error, readers.error_m)


def _text_of(robot: Robot, urdf: bytes | None) -> bytes:
    """Return the URDF to edit: the one that is given, or else of the robot.

    Raises:
        RobotFileError: if there is none.
    """
    text = robot.urdf if urdf is None else urdf
    if not text:
        raise RobotFileError(
            "the model holds no URDF; expected its text: give the file that the robot was "
            "loaded from"
        )
    return text


def _placements(
    model: Model, values: np.ndarray, paths: Sequence[LinkPath]
) -> dict[str, np.ndarray]:
    """Return the poses of moving joints, and of links at the ends of paths, in the joint frames
    that carry them.
    """
    joints, behind = link_placements(model, values)
    found = dict(zip(model.chain.robot.joint_names, joints, strict=True))
    for path in paths:
        found |= {link: behind[joint + 1] @ T for link, joint, T in path.ends}
    return found


def _segments(tree: UrdfTree, robot: Robot, ends: Collection[str]) -> dict[str, list[UrdfJoint]]:
    """Return the joints that lead to each joint of the robot, including itself, and to links at the
    ends of paths.
    """
    known = {joint.name: joint for joint in tree.joints}
    missing = [name for name in robot.joint_names if name not in known]
    if robot.is_serial and not robot.links and robot.path.start == robot.base:
        names = tuple(
            joint.name for joint in tree.path(robot.base, robot.tip) if joint.kind in MOVING_TYPES
        )
        if names != robot.joint_names:
            raise RobotFileError(
                f"{tree.origin}: moving joints {', '.join(names)} between {robot.base!r} "
                f"and {robot.tip!r}; "
                f"expected those of the model, {', '.join(robot.joint_names)}: give the "
                "URDF it was calibrated with"
            )
    if missing:
        raise RobotFileError(
            f"{tree.origin}: no joint {missing[0]!r}; expected those of the model, "
            f"{', '.join(robot.joint_names)}: give the "
            "URDF it was calibrated with"
        )
    return {n: [*_way_to(tree, robot, known[n].parent), known[n]] for n in robot.joint_names} | {
        end: _way_to(tree, robot, end) for end in ends
    }


def _way_to(tree: UrdfTree, robot: Robot, link: str) -> list[UrdfJoint]:
    """Return the fixed joints from the joint of the robot that carries a link, or from the base, to
    the link.
    """
    way = tree.above(link)
    before = [k for k, joint in enumerate(way) if joint.name in robot.joint_names]
    first = (
        before[-1] + 1
        if before
        else next((k for k, joint in enumerate(way) if joint.parent == robot.base), len(way))
    )
    return list(way[first:])


def _origins(
    segments: Mapping[str, list[UrdfJoint]],
    old: dict[str, Origin],
    before: Mapping[str, np.ndarray],
    after: Mapping[str, np.ndarray],
) -> dict[str, Origin]:
    """Return the new origin of the last joint of each segment, with the joints ahead of it
    unchanged.
    """
    new = {}
    for end, segment in segments.items():
        if segment:
            to_joint = np.linalg.inv(_product(old, segment[:-1]))
            name = segment[-1].name
            new[name] = _moved(old[name], to_joint @ before[end], to_joint @ after[end])
    return new


def _pin_origins(
    tree: UrdfTree, model: Model, values: np.ndarray, old: dict[str, Origin]
) -> tuple[dict[str, Origin], list[str]]:
    """Return the new origins of loop closures, and the names of closures that the URDF
    can't move.
    """
    chain = model.chain
    new = dict[str, Origin]()
    held = list[str]()
    frames = (closure_frames(model, x) for x in (np.zeros(model.n_parameters), values))
    for (closure, nominal), (_, found) in zip(*frames, strict=True):
        ends = zip(closure.path.ends, nominal, found, ("parent", "child"), strict=True)
        for (link, _, _), before, after, role in ends:
            moved = after @ np.linalg.inv(before)
            name = f"{closure.name}.{role}_origin"
            way = _way_to(tree, chain.robot, link)
            on_link = _product(old, way)
            if name in old or (role == "parent" and closure.name in old):
                name = name if name in old else closure.name
                T_old = old[name].matrix
                new[name] = _moved(
                    old[name], T_old, np.linalg.inv(on_link) @ moved @ on_link @ T_old
                )
            elif way and way[-1].child == link and closure.name in old:
                # The second joint of a link that is fixed to another one, which has its origin.
                ahead = np.linalg.inv(_product(old, way[:-1]))
                new[way[-1].name] = _moved(
                    old[way[-1].name], ahead @ on_link, ahead @ moved @ on_link
                )
            elif np.abs(moved - np.eye(4)).max() > IN_FILES.tip_moved or closure.name not in old:
                held.append(closure.name)
    return new, list(dict.fromkeys(held))


def _product(old: dict[str, Origin], way: Sequence[UrdfJoint]) -> np.ndarray:
    """Return the product of the origins of consecutive fixed joints, shape (4, 4)."""
    found = np.eye(4)
    for joint in way:
        found = found @ old[joint.name].matrix
    return found


def _moved(old: Origin, before: np.ndarray, after: np.ndarray) -> Origin:
    """Return an origin moved with its placement; unchanged parts keep the numbers of the URDF to
    the last digit.
    """
    xyz = old.xyz + (after[:3, 3] - before[:3, 3])
    turned = not np.array_equal(after[:3, :3], before[:3, :3])
    return Origin(xyz, rpy_of(after[:3, :3], old.rpy) if turned else old.rpy)


def _with_tip(
    text: bytes, tree: UrdfTree, robot: Robot, T_tip_calibrated: np.ndarray
) -> tuple[bytes, str]:
    """Return the text with a link for the calibrated tip inserted behind the tip, and the name of
    this link.
    """
    taken = {*tree.links, *(joint.name for joint in tree.joints)}
    name = f"{robot.tip}_calibrated"
    while name in taken or f"{name}_joint" in taken:
        name += "_"
    origin = Origin(T_tip_calibrated[:3, 3], rpy_of(T_tip_calibrated[:3, :3], np.zeros(3)))
    joint = f"{name}_joint"
    return append_frame(
        text, parent=robot.tip, joint=joint, link=name, origin=origin, source=tree.source
    ), name


def _notes_on_ends(
    open_pins: Sequence[str], old_tip: str, tip: str, held: Sequence[str]
) -> Iterator[str]:
    """Yield notes on loops and links that have no fixed joint for their calibration."""
    if open_pins:
        yield (
            f"the loops at {', '.join(open_pins)} are as in the URDF; their calibration "
            "is in model.json only"
        )
    if tip != old_tip:
        yield (
            f"no fixed joint holds {old_tip}; link {tip} was inserted behind it as the "
            "calibrated tip"
        )
    if held:
        yield (
            f"no fixed joint holds {', '.join(held)}; their calibrated placement is in "
            "model.json only"
        )


def rigid_notes(model: Model, *, what: str = "URDF") -> tuple[str, ...]:
    """Return notes on effects that are in ``model.json`` but not in a file of the rigid
    geometry.
    """
    # Each once, as there may be an effect for every joint.
    of = {effect.name: effect for effect in model.effects if effect.locus.acts_on != "clock"}
    names = list(of)
    read = [name for name, effect in of.items() if effect.is_sighted]
    bends = [
        e.uses_moments or e.family is Family.ELASTICITY or bool(e.bodies(model.chain))
        for e in of.values()
    ]
    elastic = list(compress(names, bends))
    told = {*_GEOMETRIC_NAMES, "base_frame", "tool_frame", *elastic, *read}
    others = [name for name in names if name not in told]
    targets = ", ".join(model.chain.targets)
    robot = model.chain.robot
    notes = {
        f"{', '.join(elastic)}: a {what} describes a rigid arm; deflection under the "
        "arm's own weight and under a "
        "payload is in model.json only": bool(elastic),
        f"{', '.join(others)}: varies from pose to pose; the {what} has its value at "
        "q = 0, model.json the whole effect": bool(others),
        f"{', '.join(read)}: an error of the instrument, not of the robot; it is in "
        "model.json only": bool(read),
        f"base_frame: the pose of {robot.base} in the instrument's frame "
        "is in model.json only": "base_frame" in names,
        f"tool_frame: the pose of the target ({targets}) on {robot.tip} "
        "is in model.json only": "tool_frame" in names,
    }
    return tuple(note for note, is_told in notes.items() if is_told)


def _check(
    text: bytes, tip: str, model: Model, values: np.ndarray, *, lost: Collection[str]
) -> float:
    """Return the largest error of the text's tips relative to the calibrated geometry; refuse more
    than rounding.
    """
    robot = model.chain.robot
    error = 0.0
    with warnings.catch_warnings(action="ignore", category=PincalWarning):
        written = Robot.from_tree(
            parse_urdf(text, source=robot.source), replace(robot.request, tip=tip)
        )
    q = robot.random_configurations(_CHECKED_POSES, np.random.default_rng(0))
    for start, last in ((robot.path.start, robot.tip), *robot.links):
        if {start, last}.isdisjoint(lost):
            path = robot.between(start, last)
            there = written.between(*(tip if link == robot.tip else link for link in (start, last)))
            difference = written.forward_kinematics(written.following(q), there)[
                :, :3
            ] - rigid_tips(model, values, q, path)
            error = max(error, float(np.linalg.norm(difference[:, :, 3], axis=1).max()))
            if not np.abs(difference).max() <= IN_FILES.tip_error:
                raise RobotFileError(
                    f"{robot.name}: the calibrated URDF would put {last} up to "
                    f"{error:.3g} m from where the model does, "
                    f"expected at most {IN_FILES.tip_error:g} m: {_cure(robot)}"
                )
    return error


def _cure(robot: Robot) -> str:
    """Return what to do where a URDF does not have the geometry of the model."""
    if robot.linkage is not None:
        return (
            "the calibrated loops do not close as they are written; more poses, or what bends the "
            "arm (--model elastic), keep its axes nearer to the URDF"
        )
    return "give the URDF that the robot was calibrated with"


def rigid_tips(
    model: Model, values: np.ndarray, q: np.ndarray, path: LinkPath | None = None
) -> np.ndarray:
    """Return the poses of a path's tip in its start frame, shape (N, 3, 4), by the rigid part of
    the model.
    """
    rigid, found = _rigid(model, values, path)
    return rigid.predict(found, Conditions.at(q))


def rigid_joints(model: Model, values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return joint positions, shape (N, n), with passive joints that close the calibrated loops."""
    rigid, found = _rigid(model, values, None)
    drives = rigid.chain.drives
    return np.asarray(
        rigid.coordinates(found, Conditions.at(q))[:, drives]
        - rigid.rigid_coordinates(found)[drives]
    )


def _rigid(model: Model, values: np.ndarray, path: LinkPath | None) -> tuple[Model, np.ndarray]:
    robot = model.chain.robot
    chain = Chain.of(robot, moment_frame=model.chain.moment_frame, path=path)
    deviations = model.rigid_coordinates(values) - model.chain.nominal
    at = Conditions.at(np.zeros((1, robot.n_joints)))
    found = [
        deviations[term.coordinate]
        for effect in GEOMETRIC
        for term in effect.terms(chain, at, None)
    ]
    return Model(chain, GEOMETRIC), np.array(found)
