"""The extended model as ordinary Pinocchio models, for all that Pinocchio can do with one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pincal.model.chain import Chain
from pincal.model.kernel_inputs import BLOCK, FRAME
from pincal.model.model import Model
from pincal.robot.se3 import rotation, translation

if TYPE_CHECKING:
    import pinocchio as pin


def augmented_model(chain: Chain, *, payload: float = 0.0, payload_centre: np.ndarray | None = None) -> pin.Model:
    """Return the arm with one Pinocchio joint a coordinate (60 for a 6R arm), from its base to its tip.

    Its configuration vector is the joints' part of :meth:`Model.coordinates` (joint positions included in theta or d), with
    d - h in place of d.
    Its frame Jacobian at "tip" is the kinematic Jacobian by coordinates; its generalised gravity is minus the static
    moment about each coordinate; its gravity derivatives are those of the moments.

    Args:
        chain: the chain.
        payload: mass at the tip [kg].
        payload_centre: shape (3,), its centre of mass in the tip frame [m].

    Returns:
        The model, its gravity that of the chain, with an operational frame "tip".
    """
    import pinocchio as pin

    model = pin.Model()
    model.name = f"{chain.robot.name}_augmented"
    model.gravity = pin.Motion(np.asarray(chain.gravity), np.zeros(3))
    # By the kinds of coordinates, see pincal.model.kernel_inputs.Layout.
    kinds = (pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ, pin.JointModelPX, pin.JointModelPY, pin.JointModelPZ)
    placement = pin.SE3(chain.robot.frames.T_base_first)
    parent = 0
    for i, name in enumerate(chain.robot.joint_names):
        for k in range(FRAME + i * BLOCK, FRAME + (i + 1) * BLOCK):
            joint = kinds[chain.layout.kind[k]]()
            parent = model.addJoint(parent, joint, placement, f"{name}.{chain.symbols[k]}")
            placement = pin.SE3.Identity()
        model.appendBodyToJoint(parent, _body(chain.robot.masses[i], chain.robot.centres[i]), pin.SE3.Identity())
    tip = pin.SE3(chain.robot.frames.T_last_tip)
    model.addFrame(pin.Frame("tip", parent, 0, tip, pin.OP_FRAME))
    if payload > 0.0:
        centre = np.zeros(3) if payload_centre is None else np.asarray(payload_centre, float)
        model.appendBodyToJoint(parent, _body(payload, centre), tip)
    return model


def _body(mass: float, centre: np.ndarray) -> pin.Inertia:
    """A body whose turning inertia is nil: statics knows none."""
    import pinocchio as pin

    return pin.Inertia(float(mass), np.array(centre, float), np.zeros((3, 3)))


def joint_placements(model: Model, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the calibrated geometry, without elastic effects, puts the URDF's own joint frames.

    The URDF's joint frame i turns about its own axis; its fixed place on this axis stays as the URDF has it.

    Args:
        model: the calibrated model.
        values: shape (P,), its parameters.

    Returns:
        Shape (n, 4, 4): joint frame i at q = 0 in joint frame i-1 (the first: in the base frame); and shape (4, 4): the
        tip in the last joint frame.
    """
    placed, tip, _ = _placements(model.chain, model.rigid_coordinates(values), joint_mounts(model.chain))
    return placed, tip


def joint_mounts(chain: Chain) -> np.ndarray:
    """Return the URDF's joint frames in the frames that turn with the joints, about their z, behind theta, (n, 4, 4)."""
    _, _, turning = _placements(chain, chain.nominal, np.tile(np.eye(4), (chain.robot.n_joints, 1, 1)))
    return np.asarray(np.linalg.inv(turning) @ (chain.robot.frames.T_base_link @ chain.robot.T_link_joint))


def _placements(chain: Chain, coordinates: np.ndarray, mounts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return relative placements of the joints, the tip in the last, and the turning frames in the base."""
    n = chain.robot.n_joints
    placed, turning = np.empty((n, 4, 4)), np.empty((n, 4, 4))
    before, step = np.eye(4), chain.robot.frames.T_base_first
    for i in range(n):
        at = {symbol: coordinates[chain.joint(i, symbol)] for symbol in ("s_x", "s_y", "theta", "d", "a", "alpha")}
        axis = step @ rotation("x", at["s_x"]) @ rotation("y", at["s_y"]) @ rotation("z", at["theta"])
        placed[i] = axis @ mounts[i]
        before = before @ axis
        turning[i] = before
        step = translation(at["a"], 0.0, at["d"]) @ rotation("x", at["alpha"])
        before, step = turning[i] @ mounts[i], np.linalg.inv(mounts[i]) @ step
    return placed, step @ chain.robot.frames.T_last_tip, turning


def pinocchio_model(model: Model, values: np.ndarray) -> pin.Model:
    """Return the robot's ``pin.Model`` with the calibrated joint and tip frames.

    It has the joints, names and configuration vector of :meth:`Robot.pinocchio_model`; frame ``robot.tip`` is the calibrated
    tip. Elastic effects are not in it: a ``pin.Model`` has no place for what changes with the load.

    Args:
        model: the calibrated model.
        values: shape (P,), its parameters.
    """
    import pinocchio as pin

    placed, tip = joint_placements(model, values)
    robot = model.chain.robot
    out = robot.pinocchio_model()
    data = out.createData()
    pin.framesForwardKinematics(out, data, pin.neutral(out))
    base = data.oMf[out.getFrameId(robot.base, pin.BODY)].copy()
    for i, name in enumerate(robot.joint_names):
        joint = out.getJointId(name)
        out.jointPlacements[joint] = (base if i == 0 else pin.SE3.Identity()) * pin.SE3(placed[i])
    out.frames[out.getFrameId(robot.tip, pin.BODY)].placement = pin.SE3(tip)
    return out
