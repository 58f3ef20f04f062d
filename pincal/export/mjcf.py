"""The calibrated robot as a MuJoCo model: bodies in the calibrated geometry, linear compliances as
springs.

A spring is equivalent to a compliance if the moment and the resulting rotation are about the same
axis of the same frame: about a joint's own axis in every convention, across it where moments are
taken and act at the same place. MuJoCo computes the equilibrium of the deflected arm; its distance
from the model with moments on the undeflected arm is reported.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar
from xml.etree import ElementTree as ET

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.export.exported import FORMATS, Exported, Format, machine_lines
from pincal.io.urdf_export import rigid_joints, rigid_notes, rigid_tips
from pincal.model.augmented import closure_frames, joint_mounts, link_placements
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Family, Term
from pincal.model.model import Model
from pincal.robot.link_path import LinkPath
from pincal.robot.robot import Robot
from pincal.robot.se3 import (
    exponentials,
    quaternions,
    rotation,
    rotation_matrices,
    transform,
    translation,
)
from pincal.thresholds import Count, Scale

# MuJoCo requires a mass and an inertia of each body [kg, kg m^2].
_LEAST_MASS: Scale = 1e-6
_LEAST_INERTIA: Scale = 1e-9
# MuJoCo's default [s]: a spring with a faster oscillation needs armature and damping to be stable.
_TIME_STEP: Scale = 2e-3
_CHECKED_POSES: Count = 100
# Number of equations of a closure on position; position of a second point on its axis [m].
_PLACES: Count = 3
_ON_AXIS: Scale = 0.1


@dataclass(frozen=True)
class _Springs:
    """The compliances that are springs.

    Attributes:
        compliances: shape (n, 3), about three axes at each joint, the last its own [rad/(N m)];
            zero where there is none.
        axes: shape (n, 3, 3), these axes in columns, in the axes of the joint's moments.
        carried: their effects.
        refused: names of negative compliances, which are left out.
        rigid: names of joints in loops without springs across their axes, which would share the
            loads of the loop.
    """

    compliances: np.ndarray
    axes: np.ndarray
    carried: tuple[Effect, ...]
    refused: tuple[str, ...]
    rigid: tuple[str, ...]


@FORMATS.register
@dataclass(frozen=True)
class MujocoModel(Format):
    """An MJCF file: bodies, joints, masses, and springs in addition to the joints."""

    name: ClassVar[str] = "mjcf"
    meaning: ClassVar[str] = "a MuJoCo model"
    of_robot: ClassVar[bool] = True

    def export(self, calibrated: FittedRobot) -> Exported:
        model = calibrated.model
        values = calibrated.model_values
        robot = model.chain.robot
        springs = _springs(model, values)
        placed, behind = link_placements(model, values)
        root = ET.Element("mujoco", model=robot.name)
        _add(root, "compiler", angle="radian", autolimits="true", balanceinertia="true")
        _add(root, "option", gravity=_numbers(model.chain.gravity))
        # The world is the robot's base link.
        bodies = {-1: _add(root, "worldbody")}
        for i, (name, parent) in enumerate(zip(robot.joint_names, robot.parents, strict=True)):
            bodies[i] = body = _add(bodies[parent], "body", name=f"{name}_body", **_pose(placed[i]))
            _add_mass(body, model, values, i=i)
            for attributes in _joints(model, values, springs, i=i):
                _add(body, "joint", **attributes)
        for link, joint, place in {
            end[0]: end for path in _paths(robot, model.chain.path) for end in path.ends
        }.values():
            if link != robot.base:
                _add(bodies[joint], "site", name=link, **_pose(behind[joint + 1] @ place))
        constraints = [*_closed(model, values, bodies), *_followers(robot)]
        equality = _add(root, "equality") if constraints else root
        for tag, attributes in constraints:
            _add(equality, tag, **attributes)
        ET.indent(root)
        notes = _notes(calibrated, springs)
        above = (*machine_lines(calibrated), *notes)
        comment = "\n".join("  " + re.sub("-(?=-)", "- ", line) for line in above)
        text = f"<!--\n{comment}\n-->\n{ET.tostring(root, encoding='unicode')}\n"
        return Exported({"": text.encode()}, notes, _error(model, values, text))


def _followers(robot: Robot) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the constraints of mimic joints."""
    for mimic in robot.mimics:
        polynomial = _numbers(np.array([mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0]))
        yield "joint", {"joint1": mimic.joint, "joint2": mimic.source, "polycoef": polynomial}


def _closed(
    model: Model, values: np.ndarray, bodies: Mapping[int, ET.Element]
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the constraints that close loops, between sites added to bodies: what the passive
    joints can satisfy.

    What they can't satisfy, such as the out-of-plane error of a planar loop, affects them to second
    order only.
    """
    for closure, frames in closure_frames(model, values):
        turns = max(closure.rows) >= _PLACES
        tag = "weld" if turns and closure.kind == "pose" else "connect"
        for along in (0.0, _ON_AXIS) if turns and closure.kind == "axis" else (0.0,):
            names = [f"{closure.name}_{end}{'_axis' if along else ''}" for end in ("start", "end")]
            for name, (_, joint, _), T in zip(names, closure.path.ends, frames, strict=True):
                _add(bodies[joint], "site", name=name, **_pose(T @ translation(0.0, 0.0, along)))
            yield tag, {"site1": names[0], "site2": names[1]}


def _springs(model: Model, values: np.ndarray) -> _Springs:
    """Return the compliances that are equivalent to springs between two links."""
    chain = model.chain
    n = model.chain.robot.n_joints
    matrices, carried = _compliance_matrices(model, values)
    refused = []
    compliances = np.zeros((n, 3))
    axes = np.tile(np.eye(3), (n, 1, 1))
    loops = {
        joint
        for closure in chain.robot.closures
        for joint, _ in closure.path.steps(chain.robot.parents)
    }
    rigid = sorted(chain.robot.joint_names[i] for i in loops if matrices[i, :2, :2].any())
    matrices[list(loops), :2, :2] = 0.0
    for i, matrix in enumerate(matrices):
        if matrix[0, 1]:
            compliances[i, :2], axes[i, :2, :2] = np.linalg.eigh(matrix[:2, :2])
            compliances[i, 2] = matrix[2, 2]
        else:
            compliances[i] = np.diag(matrix)
        names = ("k_across", "k_across", "k_z") if matrix[0, 1] else ("k_x", "k_y", "k_z")
        refused += [
            f"{chain.robot.joint_names[i]}.{names[c]}" for c in np.flatnonzero(compliances[i] < 0.0)
        ]
    return _Springs(np.maximum(compliances, 0.0), axes, carried, tuple(refused), tuple(rigid))


def _compliance_matrices(model: Model, values: np.ndarray) -> tuple[np.ndarray, tuple[Effect, ...]]:
    """Return the compliance matrix of each joint, shape (n, 3, 3), and the effects that are wholly
    in them.
    """
    chain = model.chain
    n = chain.robot.n_joints
    at = Conditions.at(np.zeros((1, n)))
    moments = np.ones((1, 3 * n))
    matrices = np.zeros((n, 3, 3))
    carried = []
    own = "z" if chain.moment_frame == "paper" else "xyz"
    places = {
        chain.joint(i, f"gamma_{axis}"): (i, "xyz".index(axis)) for i in range(n) for axis in own
    }
    for span, effect in zip(model.spans, model.effects, strict=True):
        terms = effect.terms(chain, at, moments) if effect.uses_moments else ()
        entries = [_entry(term, places) for term in terms]
        if None in entries or not (terms or effect.family is Family.ELASTICITY):
            continue
        carried.append(effect)
        for term, entry in zip(terms, entries, strict=True):
            matrices[entry] += float(values[span][term.parameter])
    return matrices, tuple(carried)


def _entry(term: Term, places: Mapping[int, tuple[int, int]]) -> tuple[int, int, int] | None:
    """Return joint, row and column of a term in the compliance matrices, shape (n, 3, 3); None if
    it is not in them.
    """
    if term.coordinate not in places or term.moment is None or term.slope is not None:
        return None
    i, row = places[term.coordinate]
    joint, column = divmod(term.moment, 3)
    return (i, row, column) if joint == i and (row == 2) == (column == 2) else None


def _own_joint(robot: Robot, i: int, turning: np.ndarray) -> dict[str, str]:
    """Return the attributes of a joint of the robot; ``turning``, shape (4, 4), is its frame in its
    body.
    """
    own = {
        "name": robot.joint_names[i],
        "type": "slide" if robot.joint_types[i] == "prismatic" else "hinge",
        "pos": _numbers(turning[:3, 3]),
        "axis": _numbers(turning[:3, 2]),
    }
    if np.isfinite(robot.lower[i]):
        own["range"] = _numbers(np.array([robot.lower[i], robot.upper[i]]))
    return own


def _joints(
    model: Model, values: np.ndarray, springs: _Springs, *, i: int
) -> Iterator[dict[str, str]]:
    """Yield the attributes of the joints of a body in the order in which they turn it: springs, and
    the robot's own.
    """
    chain = model.chain
    robot = model.chain.robot
    turning = np.linalg.inv(joint_mounts(chain)[i])
    own = _own_joint(robot, i, turning)
    is_slide = own["type"] == "slide"
    before = chain.moment_frame == "before"
    axes = turning[:3, :3]
    rigid = model.rigid_coordinates(values)
    if before:
        axes = axes @ rotation("z", -rigid[chain.joint(i, "theta")])[:3, :3]
    axes = axes @ springs.axes[i]
    height = rigid[chain.joint(i, "h")]
    if is_slide:
        # Springs of a carriage are on it, at this place when the joint is at 0.
        height = rigid[chain.joint(i, "d")] - height
    bearing = _numbers(turning[:3, 3] + height * turning[:3, 2])
    elastic = [
        _spring(
            f"{robot.joint_names[i]}_spring_{'xyz'[c]}",
            bearing,
            axes[:, c],
            1.0 / springs.compliances[i, c],
        )
        for c in (2, 1, 0)
        if springs.compliances[i, c] > 0.0
    ]
    # A carriage deflects after it has moved in every convention, see pincal.model.chain.
    yield from (*elastic, own) if before and not is_slide else (own, *elastic)


def _spring(name: str, foot: str, axis: np.ndarray, stiffness: float) -> dict[str, str]:
    """Return the attributes of a spring; armature and damping do not affect statics."""
    return {
        "name": name,
        "type": "hinge",
        "pos": foot,
        "axis": _numbers(axis),
        "stiffness": repr(float(stiffness)),
        "armature": repr(float(stiffness * _TIME_STEP**2)),
        "damping": repr(float(stiffness * _TIME_STEP)),
    }


def _add_mass(body: ET.Element, model: Model, values: np.ndarray, *, i: int) -> None:
    """Add to a body its mass and centre of mass in the calibrated link, and the inertia of the
    URDF.
    """
    chain = model.chain
    robot = model.chain.robot
    layout = model.layout(values)
    x = model.rigid_coordinates(values)
    d, a, alpha = (x[chain.joint(i, symbol)] for symbol in ("d", "a", "alpha"))
    link = np.linalg.inv(joint_mounts(chain)[i]) @ translation(a, 0.0, d) @ rotation("x", alpha)
    nominal = robot.pinocchio_model()
    inertia = np.asarray(nominal.inertias[nominal.getJointId(robot.joint_names[i])].inertia)
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    centre = link[:3, :3] @ layout.centres[i] + link[:3, 3]
    mass = float(max(layout.masses[i], _LEAST_MASS))
    moments = np.maximum(moments, _LEAST_INERTIA)
    _add(
        body,
        "inertial",
        mass=repr(mass),
        diaginertia=_numbers(moments),
        pos=_numbers(centre),
        quat=_quaternion(axes),
    )


def _notes(calibrated: FittedRobot, springs: _Springs) -> tuple[str, ...]:
    """Return the differences between the MuJoCo model and the calibrated one."""
    model = calibrated.model
    robot = calibrated.model.chain.robot
    carried = (
        *springs.carried,
        *(effect for effect in model.effects if effect.bodies(model.chain)),
    )
    left = model.with_effects([effect for effect in model.effects if effect not in carried])
    notes = rigid_notes(left, what="MuJoCo model") + _notes_on_masses_and_springs(
        calibrated, springs
    )
    if robot.massless:
        notes += (
            "inertia of links without one in the URDF is a placeholder: statics are "
            "correct, dynamics are not",
        )
    return notes


def _notes_on_masses_and_springs(calibrated: FittedRobot, springs: _Springs) -> tuple[str, ...]:
    model = calibrated.model
    robot = model.chain.robot
    notes: tuple[str, ...] = ()
    masses = model.layout(calibrated.model_values).masses
    below = [
        f"{name} ({mass:.3g} kg)"
        for name, mass in zip(robot.joint_names, masses, strict=True)
        if mass < 0.0
    ]
    if below:
        notes += (
            f"masses after {', '.join(below)}: negative, which is not physical; omitted, "
            "so moments differ",
        )
    if springs.refused:
        notes += (f"{', '.join(springs.refused)}: negative, which is not physical; omitted",)
    if springs.rigid:
        notes += (
            f"bearings of {', '.join(springs.rigid)}: rigid here, as springs in a closed "
            "loop would share its loads",
        )
    if robot.closures:
        notes += ("loops are closed between sites, which old versions of MuJoCo do not support",)
    if np.any(springs.compliances):
        notes += (
            "springs reproduce the arm's static deflection under its own weight; their armature "
            "and damping keep MuJoCo stable at a step of 2 ms and are not measured",
            *([] if model.equilibrium else [_bent(calibrated)]),
        )
    return notes


def _bent(calibrated: FittedRobot) -> str:
    """Return a note on the distance between equilibrium and moments on the undeflected arm."""
    own = calibrated.with_effects(lambda effect: effect.scope == "robot" and not effect.needs)
    q = own.model.chain.robot.random_configurations(_CHECKED_POSES, np.random.default_rng(0))
    at = Conditions.at(q)
    straight, bent = (
        replace(own.model, equilibrium=e).predict(own.model_values, at)[:, :, 3]
        for e in (False, True)
    )
    most = 1e3 * float(np.linalg.norm(straight - bent, axis=1).max())
    return (
        "springs deflect the arm to equilibrium, the model takes moments on the undeflected "
        f"arm: up to {most:.4f} mm apart"
    )


def _error(model: Model, values: np.ndarray, text: str) -> float:
    """Return the largest distance between ends of paths by the bodies of a file and by the
    calibrated geometry [m].
    """
    robot = model.chain.robot
    root = ET.fromstring(text)
    q = rigid_joints(
        model, values, robot.random_configurations(_CHECKED_POSES, np.random.default_rng(0))
    )
    bodies = {body.get("name"): body for body in root.iter("body")}
    sites = {site.get("name"): _read(site) for site in root.iter("site")}
    paths = _paths(robot, model.chain.path)
    found = np.empty((len(paths), len(q), 3))
    for row, at in enumerate(q):
        T = {-1: np.eye(4)}
        for i, (name, parent) in enumerate(zip(robot.joint_names, robot.parents, strict=True)):
            body = bodies[f"{name}_body"]
            joint = next(j for j in body.findall("joint") if j.get("name") == name)
            T[i] = T[parent] @ _read(body) @ _moved(joint, float(at[i]))
        for k, path in enumerate(paths):
            start, tip = (T[joint] @ sites.get(link, np.eye(4)) for link, joint, _ in path.ends)
            found[k, row] = np.linalg.solve(start, tip)[:3, 3]
    off = [
        tips - rigid_tips(model, values, q, path)[:, :, 3]
        for tips, path in zip(found, paths, strict=True)
    ]
    return float(np.linalg.norm(off, axis=2).max())


def _paths(robot: Robot, own: LinkPath) -> tuple[LinkPath, ...]:
    """Return the path of a model, and the paths to the robot's other links."""
    return own, *(robot.between(*ends) for ends in robot.links)


def _read(element: ET.Element) -> np.ndarray:
    position, quaternion = (np.array(element.attrib[key].split(), float) for key in ("pos", "quat"))
    return transform(rotation_matrices(np.roll(quaternion, -1)[None])[0], position)


def _moved(joint: ET.Element, position: float) -> np.ndarray:
    """Return the displacement of a joint's body."""
    axis, foot = (np.array(joint.attrib[key].split(), float) for key in ("axis", "pos"))
    if joint.get("type") == "slide":
        return translation(*(position * axis))
    R = exponentials((position * axis / np.linalg.norm(axis))[None])[0]
    return transform(R, foot - R @ foot)


def _add(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
    return ET.SubElement(parent, tag, attributes)


def _pose(T: np.ndarray) -> dict[str, str]:
    return {"pos": _numbers(T[:3, 3]), "quat": _quaternion(T[:3, :3])}


def _quaternion(R: np.ndarray) -> str:
    x, y, z, w = quaternions(R[None])[0]
    return _numbers(np.array([w, x, y, z]))


def _numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)
