r"""The calibrated geometry as files for other programs: URDF, Denavit-Hartenberg tables, frames of
controllers.

A table of Denavit-Hartenberg parameters, standard or modified, is, between a base frame and a tool
frame, with q added to theta, or to d of a prismatic joint,

.. math::

    \text{standard:}\; \prod_i R_z(\theta_i) T_z(d_i) T_x(a_i) R_x(\alpha_i) R_y(\beta_i), \qquad
    \text{modified:}\; \prod_i T_x(a_i) R_x(\alpha_i) R_y(\beta_i) R_z(\theta_i) T_z(d_i).

:math:`\beta` is Hayati's parameter [Hayati1983]_: the common normal of two axes that are parallel
  to a fraction of a
milliradian is kilometres away, too far for the numbers of a controller; beta is zero for all other
axes.

.. [Hayati1983] S. Hayati, Robot arm geometric link parameter estimation, IEEE CDC 1983.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.errors import BadInputError
from pincal.export.export_numbers import EXPORT
from pincal.export.exported import FORMATS, Exported, Format, as_comment, machine_lines
from pincal.io.urdf_export import calibrated_urdf, rigid_notes, rigid_tips
from pincal.io.urdf_text import read_origins, rpy_of
from pincal.measure.orientation import CONVENTIONS
from pincal.model.augmented import joint_mounts, joint_placements
from pincal.model.model import Model
from pincal.robot.dh import DhFrames, dh_frames
from pincal.robot.se3 import placed, rotation, rotation_vectors, translation
from pincal.robot.tree import Mimic
from pincal.robot.urdf_file import parse_urdf
from pincal.thresholds import Count

_COLUMNS = ("theta", "d", "a", "alpha", "beta")
_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
_HEAD = ["convention", "row", "type", *(f"{c} [{'m' if c in 'da' else 'rad'}]" for c in _COLUMNS)]
_HEAD += [f"{c} [{'m' if c in 'xyz' else 'rad'}]" for c in _POSE]
_CHECKED_POSES: Count = 50


@FORMATS.register
@dataclass(frozen=True)
class DhTable(Format):
    """A CSV with a row per joint between a base frame and a tool frame, in both conventions."""

    name: ClassVar[str] = "dh"
    meaning: ClassVar[str] = "Denavit-Hartenberg parameters, standard and modified"
    of_robot: ClassVar[bool] = True

    def export(self, calibrated: FittedRobot) -> Exported:
        model = calibrated.model
        values = calibrated.model_values
        robot = model.chain.robot
        frames = _calibrated_frames(model, values)
        rows = _rows(frames)
        q = robot.random_configurations(_CHECKED_POSES, np.random.default_rng(0))
        true = rigid_tips(model, values, q)[:, :, 3]
        slides = np.array([kind == "prismatic" for kind in robot.joint_types])
        tables = {"standard": rows, "modified": _modified(rows)}
        tips = {
            name: _tips(name, table, frames, q=q, slides=slides) for name, table in tables.items()
        }
        worst = max(float(np.linalg.norm(found - true, axis=1).max()) for found in tips.values())
        if not worst <= EXPORT.geometry:
            raise BadInputError(
                f"{robot.name}: its parameters would be off by up to {worst:.2g} m; use "
                "another format"
            )
        notes = rigid_notes(model, what="table of DH parameters")
        notes += tuple(map(_mimic_words, robot.mimics))
        if np.any(rows[:, 4]):
            flat = _tips("standard", rows * [1.0, 1.0, 1.0, 1.0, 0.0], frames, q=q, slides=slides)
            off = float(np.linalg.norm(flat - true, axis=1).max())
            notes += (_parallel_words(robot.joint_names, rows, off),)
        text = [f"# {line}" for line in (*machine_lines(calibrated), *notes)]
        text.append(",".join(_HEAD))
        for name, table in tables.items():
            text += _lines(name, table, frames, names=robot.joint_names, types=robot.joint_types)
        return Exported({"": ("\n".join(text) + "\n").encode()}, notes, worst)


def _mimic_words(mimic: Mimic) -> str:
    return (
        f"{mimic.joint} follows {mimic.source}: {mimic.multiplier!r} times its "
        f"position plus {mimic.offset!r}"
    )


def _parallel_words(names: tuple[str, ...], rows: np.ndarray, off: float) -> str:
    """Return the note on axes that are nearly parallel; without beta the tip is off [m]."""
    pairs = ", ".join(f"{names[i]} and the next" for i in np.flatnonzero(rows[:, 4]).tolist())
    cost = f"without beta the tip is off by up to {1e3 * off:.3f} mm"
    return f"beta (Hayati): the axes of {pairs} are nearly parallel; {cost}"


def _calibrated_frames(model: Model, values: np.ndarray) -> DhFrames:
    """Return DH frames along the calibrated axes."""
    chain = model.chain
    x = model.rigid_coordinates(values)
    frame = chain.robot.frames.T_base_first
    origins = []
    axes = []
    for i in range(chain.robot.n_joints):
        at = {s: x[chain.joint(i, s)] for s in ("s_x", "s_y", "theta", "d", "a", "alpha")}
        frame = frame @ rotation("x", at["s_x"]) @ rotation("y", at["s_y"])
        origins.append(frame[:3, 3])
        axes.append(frame[:3, 2])
        frame = (
            frame
            @ rotation("z", at["theta"])
            @ translation(at["a"], 0.0, at["d"])
            @ rotation("x", at["alpha"])
        )
    return dh_frames(np.array(origins), np.array(axes), frame @ chain.robot.frames.T_last_tip)


def _rows(frames: DhFrames) -> np.ndarray:
    """Return theta, d, a, alpha, beta of each joint, shape (n, 5): the tilt before an axis is part
    of the previous row.
    """
    tilt = np.vstack([frames.parameters[1:, :2], np.zeros((1, 2))])
    theta, d, a, alpha = frames.parameters[:, 2:].T
    return np.column_stack([theta, d, a, alpha + tilt[:, 0], tilt[:, 1]])


def _modified(rows: np.ndarray) -> np.ndarray:
    """Return the rows with a, alpha and beta before their joint; after the last joint they are
    zero.
    """
    assert not rows[-1, 2:].any()
    return np.column_stack([rows[:, :2], np.vstack([np.zeros((1, 3)), rows[:-1, 2:]])])


def _tips(
    name: str, rows: np.ndarray, frames: DhFrames, *, q: np.ndarray, slides: np.ndarray
) -> np.ndarray:
    """Return the tip's positions by a table, shape (N, 3) [m]."""
    out = []
    for at in q:
        T = frames.T_base_first
        for (theta, d, a, alpha, beta), position, is_sliding in zip(rows, at, slides, strict=True):
            turn = theta if is_sliding else theta + position
            shift = d + position if is_sliding else d
            joint = rotation("z", turn) @ translation(0.0, 0.0, shift)
            link = translation(a, 0.0, 0.0) @ rotation("x", alpha) @ rotation("y", beta)
            T = T @ (joint @ link if name == "standard" else link @ joint)
        out.append((T @ frames.T_last_tip)[:3, 3])
    return np.array(out)


def _lines(
    name: str, rows: np.ndarray, frames: DhFrames, *, names: tuple[str, ...], types: tuple[str, ...]
) -> list[str]:
    """Return the lines of one convention; numbers in full precision."""

    def frame(what: str, T: np.ndarray) -> str:
        pose = [*T[:3, 3], *rpy_of(T[:3, :3], np.zeros(3))]
        return ",".join(
            [name, what, "frame", *[""] * len(_COLUMNS), *(repr(float(v)) for v in pose)]
        )

    joints = [
        ",".join([name, joint, kind, *(repr(float(v)) for v in row), *[""] * len(_POSE)])
        for joint, kind, row in zip(names, types, rows, strict=True)
    ]
    return [frame("base", frames.T_base_first), *joints, frame("tool", frames.T_last_tip)]


Controller = Literal["kuka", "fanuc", "abb", "ur"]
# Decimal places: a hundredth of the resolution of any controller, and of any measurement.
_DIGITS: Count = 9


@FORMATS.register
@dataclass(frozen=True)
class ControllerFrames(Format):
    """The instrument's frame seen from the robot's base, and the targets on the tip, in a
    controller's convention.

    Attributes:
        controller: "kuka" (X Y Z A B C), "fanuc" (X Y Z W P R), "abb" (x y z q1 q2 q3 q4) or "ur"
            (x y z rx ry rz).
    """

    controller: str = "kuka"
    name: ClassVar[str] = "frames"
    meaning: ClassVar[str] = "base and tool frames for a controller"

    def export(self, calibrated: FittedRobot) -> Exported:
        if self.controller not in get_args(Controller):
            raise BadInputError(
                f"controller {self.controller!r}; expected one of {', '.join(get_args(Controller))}"
            )
        convention = CONVENTIONS[self.controller]
        frames = _frames(calibrated)
        unit, per_metre = ("m", 1.0) if self.controller == "ur" else ("mm", 1e3)
        poses = {
            name: [*per_metre * T[:3, 3], *convention.values(T[:3, :3])]
            for name, T in frames.items()
        }
        cells = {name: [f"{value:.{_DIGITS}f}" for value in pose] for name, pose in poses.items()}
        angles = f" [{convention.unit}]" if convention.unit else ""
        notes = _notes(calibrated, convention.words)
        head = ",".join(
            [
                "frame",
                *(f"{axis} [{unit}]" for axis in "xyz"),
                *(f"{c}{angles}" for c in convention.columns),
            ]
        )
        body = [",".join([as_comment(name), *row]) for name, row in cells.items()]
        lost = [
            np.linalg.norm(T[:3, 3] - np.array(cells[name][:3], float) / per_metre)
            for name, T in frames.items()
        ]
        above = [f"# {line}" for line in (*machine_lines(calibrated), *notes)]
        text = "\n".join([*above, head, *body]) + "\n"
        return Exported({"": text.encode()}, notes, float(max(lost)))


def _frames(calibrated: FittedRobot) -> dict[str, np.ndarray]:
    model = calibrated.model
    estimate = calibrated.estimate
    chain = model.chain
    found = {}
    if "base.x" in estimate.names:
        found["base"] = np.linalg.inv(placed(chain.base_rotation, estimate.frame("base")))
    return found | {
        t: placed(R, estimate.frame(t))
        for t, R in zip(chain.targets, chain.tool_rotations, strict=True)
    }


def _notes(calibrated: FittedRobot, words: str) -> tuple[str, ...]:
    model = calibrated.model
    robot = calibrated.model.chain.robot
    base = as_comment(robot.base)
    tip = as_comment(robot.tip)
    turned = (
        ""
        if model.has_tool_orientation
        else "; only their positions were measured, their axes are the tip's"
    )
    moving = [e.name for e in model.effects if e.scope == "station" and e.needs]
    lacking = (f"{', '.join(moving)}: the frames are those at its reference",) if moving else ()
    return (
        f"orientation as {words}",
        f"base: the instrument's frame seen from {base}; the others: targets seen from "
        f"{tip}{turned}",
        f"a controller whose own base or flange is not {base} or {tip} needs them "
        "transformed by the difference",
        "frames hold no geometry, elasticity or other effects: they are valid with the "
        "calibrated robot only",
        *lacking,
    )


# The six transforms of the yaml by the ends of the joints' names, and the parent link of the first.
_JOINTS = {
    "shoulder_pan_joint": "shoulder", "shoulder_lift_joint": "upper_arm", "elbow_joint": "forearm",
    "wrist_1_joint": "wrist_1", "wrist_2_joint": "wrist_2", "wrist_3_joint": "wrist_3",
}  # fmt: skip
_FOOT = "base_link_inertia"


@FORMATS.register
@dataclass(frozen=True)
class UrKinematics(Format):
    """The yaml of ur_description: expanded through its xacro (``kinematics_params``) it is the
    calibrated arm.
    """

    name: ClassVar[str] = "ur-kinematics"
    meaning: ClassVar[str] = "the kinematics of ur_description"
    of_robot: ClassVar[bool] = True

    def export(self, calibrated: FittedRobot) -> Exported:
        model = calibrated.model
        robot = calibrated.model.chain.robot
        _refuse_others(calibrated)
        found = calibrated_urdf(model, calibrated.model_values)
        origins = read_origins(found.text, robot.source)
        lines = ["kinematics:"]
        for joint, part in zip(robot.joint_names, _JOINTS.values(), strict=True):
            pose = (*origins[joint].xyz, *origins[joint].rpy)
            lines.append(f"  {part}:")
            lines += [
                f"    {key}: {float(value)!r}" for key, value in zip(_POSE, pose, strict=True)
            ]
        digest = int.from_bytes(hashlib.sha256("\n".join(lines).encode()).digest()[:8]) >> 1
        lines.append(f"  hash: calib_{digest}")
        notes = (*rigid_notes(model, what="yaml of ur_description"), *_tip_note(calibrated))
        above = [*machine_lines(calibrated), *map(as_comment, notes)]
        text = "\n".join([*(f"# {line}" for line in above), *lines]) + "\n"
        return Exported({"": text.encode()}, notes, found.max_error_m)


def _refuse_others(calibrated: FittedRobot) -> None:
    """Refuse an arm that is not one of ur_description with an error that names the difference."""
    robot = calibrated.model.chain.robot
    expected = "expected a robot of ur_description, expanded from its xacro"
    if len(robot.joint_names) != len(_JOINTS) or not all(
        map(str.endswith, robot.joint_names, _JOINTS)
    ):
        raise BadInputError(
            f"{robot.name}: joints {', '.join(robot.joint_names)} are not the joints of a "
            f"UR; {expected}"
        )
    tree = parse_urdf(robot.urdf, source=robot.source)
    foot = next(joint.parent for joint in tree.joints if joint.name == robot.joint_names[0])
    axes = joint_mounts(calibrated.model.chain)[:, 2, :3]
    if not foot.endswith(_FOOT) or np.abs(axes - [0.0, 0.0, 1.0]).max() > EXPORT.moved:
        raise BadInputError(f"{robot.name}: an older description with other frames; {expected}")


def _tip_note(calibrated: FittedRobot) -> tuple[str, ...]:
    model = calibrated.model
    (_, before), (_, after) = (
        joint_placements(model, v) for v in (0.0 * calibrated.model_values, calibrated.model_values)
    )
    change = np.linalg.inv(before) @ after
    moved = change[:3, 3]
    turned = rotation_vectors(change[None, :3, :3])[0]
    if max(np.abs(moved).max(), np.abs(turned).max()) <= EXPORT.moved:
        return ()
    numbers = "x {:.6f} y {:.6f} z {:.6f} mm, rx {:.6f} ry {:.6f} rz {:.6f} mrad".format(
        *(1e3 * moved), *(1e3 * turned)
    )
    return (
        f"the tip has moved by {numbers} in its own axes, which the yaml can't hold; add "
        "it to the tool",
    )


@FORMATS.register
@dataclass(frozen=True)
class CalibratedUrdf(Format):
    """The original URDF with corrected joint origins, verified with Pinocchio."""

    name: ClassVar[str] = "urdf"
    meaning: ClassVar[str] = "the calibrated URDF"
    of_robot: ClassVar[bool] = True

    def export(self, calibrated: FittedRobot) -> Exported:
        if not calibrated.model.chain.robot.urdf:
            raise BadInputError(
                "the model holds no URDF to correct; calibrate again from a URDF file"
            )
        found = calibrated_urdf(
            calibrated.model, calibrated.values, comment=calibrated.identity.machine
        )
        return Exported({"": found.text}, found.notes, found.max_error_m)


@FORMATS.register
@dataclass(frozen=True)
class CameraJson(Format):
    """Parameters and mounting pose of the camera as JSON."""

    name: ClassVar[str] = "camera"
    meaning: ClassVar[str] = "the camera, parameters and mount"

    def export(self, calibrated: FittedRobot) -> Exported:
        return Exported({"": (json.dumps(calibrated.camera(), indent=1) + "\n").encode()})
