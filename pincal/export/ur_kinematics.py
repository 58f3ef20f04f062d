"""The calibrated geometry of a robot of Universal Robots as the yaml that ur_description's xacro reads."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.errors import BadInputError
from pincal.export.exported import FORMATS, Exported, Format
from pincal.export.source import as_comment
from pincal.io.urdf_export import calibrated_urdf, rigid_notes
from pincal.io.urdf_text import read_origins
from pincal.model.augmented import joint_mounts, joint_placements
from pincal.robot.se3 import rotation_vectors
from pincal.robot.urdf_file import parse_urdf

# The six transforms of the yaml by the ends of the joints' names, and the link that the first stands on.
_JOINTS = {
    "shoulder_pan_joint": "shoulder", "shoulder_lift_joint": "upper_arm", "elbow_joint": "forearm",
    "wrist_1_joint": "wrist_1", "wrist_2_joint": "wrist_2", "wrist_3_joint": "wrist_3",
}  # fmt: skip
_FOOT = "base_link_inertia"
# What a tip has to move by [m or rad] to be worth a note.
_MOVED = 1e-9


@FORMATS.register
@dataclass(frozen=True)
class UrKinematics(Format):
    """The yaml of ur_description: expanded through its xacro (``kinematics_params``) it is the calibrated arm."""

    name: ClassVar[str] = "ur-kinematics"
    meaning: ClassVar[str] = "the kinematics of ur_description"
    of_robot: ClassVar[bool] = True

    def export(self, calibrated: CalibratedModel) -> Exported:
        """Return the yaml."""
        model, robot = calibrated.model, calibrated.model.chain.robot
        _refuse_others(calibrated)
        found = calibrated_urdf(model, calibrated.model_values)
        origins = read_origins(found.text, robot.source)
        lines = ["kinematics:"]
        for joint, part in zip(robot.joint_names, _JOINTS.values(), strict=True):
            pose = (*origins[joint].xyz, *origins[joint].rpy)
            lines.append(f"  {part}:")
            lines += [f"    {key}: {float(value)!r}" for key, value in zip(_KEYS, pose, strict=True)]
        digest = int.from_bytes(hashlib.sha256("\n".join(lines).encode()).digest()[:8]) >> 1
        lines.append(f"  hash: calib_{digest}")
        notes = (*rigid_notes(model, what="yaml of ur_description"), *_tip_note(calibrated))
        text = "\n".join([*(f"# {as_comment(note)}" for note in notes), *lines]) + "\n"
        return Exported({"": text.encode()}, notes, found.max_error_m)


_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")


def _refuse_others(calibrated: CalibratedModel) -> None:
    """Refuse an arm that is not one of ur_description.

    Raises:
        BadInputError: saying what is different.
    """
    robot = calibrated.model.chain.robot
    expected = "expected a robot of ur_description, expanded from its xacro"
    matches = len(robot.joint_names) == len(_JOINTS) and all(
        name.endswith(end) for name, end in zip(robot.joint_names, _JOINTS, strict=True)
    )
    if not matches:
        raise BadInputError(f"{robot.name}: joints {', '.join(robot.joint_names)} are not those of a UR; {expected}")
    tree = parse_urdf(robot.urdf, source=robot.source)
    foot = next(joint.parent for joint in tree.joints if joint.name == robot.joint_names[0])
    axes = joint_mounts(calibrated.model.chain)[:, 2, :3]
    if not foot.endswith(_FOOT) or np.abs(axes - [0.0, 0.0, 1.0]).max() > _MOVED:
        raise BadInputError(f"{robot.name}: an older description, whose frames stand elsewhere; {expected}")


def _tip_note(calibrated: CalibratedModel) -> tuple[str, ...]:
    """Say how the tip moved on the last link, which the xacro takes from the drawing."""
    model = calibrated.model
    (_, before), (_, after) = (joint_placements(model, v) for v in (0.0 * calibrated.model_values, calibrated.model_values))
    change = np.linalg.inv(before) @ after
    moved, turned = change[:3, 3], rotation_vectors(change[None, :3, :3])[0]
    if max(np.abs(moved).max(), np.abs(turned).max()) <= _MOVED:
        return ()
    numbers = "x {:.6f} y {:.6f} z {:.6f} mm, rx {:.6f} ry {:.6f} rz {:.6f} mrad".format(*(1e3 * moved), *(1e3 * turned))
    return (f"the tip has moved by {numbers} in its own axes, which the yaml can't hold; add it to the tool",)
