"""The extended model as ordinary Pinocchio models, for use with any of Pinocchio's algorithms."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pincal.model.chain import Chain
from pincal.model.model import Model
from pincal.recorded import RECORDABLE
from pincal.robot.closure import Closure
from pincal.robot.se3 import rotation, translation

if TYPE_CHECKING:
    import pinocchio as pin


def augmented_model(
    chain: Chain, *, payload: float = 0.0, payload_centre: np.ndarray | None = None
) -> pin.Model:
    """Return the robot with one Pinocchio joint per coordinate (60 for a 6R arm), from its base on.

    Its configuration vector is the joints' part of :meth:`Model.coordinates` (joint positions
    included in theta or d), with d - h instead of d. Its frame Jacobian at "tip" is the kinematic
    Jacobian by coordinates; its generalised gravity is minus the static moment about each
    coordinate; its gravity derivatives are those of the moments.

    It has the chain's gravity, operational frames "start" and "tip" at the ends of the path, and a
    payload [kg] with its centre of mass, shape (3,), in the tip frame [m].

    Raises:
        BadInputError: if the payload is none that a robot can carry.
    """
    import pinocchio as pin

    RECORDABLE["payload"].checked(payload)
    model = pin.Model()
    model.name = f"{chain.robot.name}_augmented"
    model.gravity = pin.Motion(np.asarray(chain.gravity), np.zeros(3))
    path = chain.path
    last = _add_links(model, chain)
    tip = pin.SE3(path.T_joint_tip)
    model.addFrame(
        pin.Frame("start", last[path.start_joint], 0, pin.SE3(path.T_joint_start), pin.OP_FRAME)
    )
    model.addFrame(pin.Frame("tip", last[path.tip_joint], 0, tip, pin.OP_FRAME))
    if payload > 0.0 and path.tip_joint >= 0:
        centre = np.zeros(3) if payload_centre is None else np.asarray(payload_centre, float)
        model.appendBodyToJoint(last[path.tip_joint], _body(payload, centre), tip)
    return model


def _add_links(model: pin.Model, chain: Chain) -> dict[int, int]:
    """Add a joint for each coordinate of each of the chain's joints, and its link; return the last
    one of each, 0 for the base, -1.
    """
    import pinocchio as pin

    # Indexed by the kind of a coordinate, see pincal.model.kernel_inputs.Layout.
    kinds = (
        pin.JointModelRX,
        pin.JointModelRY,
        pin.JointModelRZ,
        pin.JointModelPX,
        pin.JointModelPY,
        pin.JointModelPZ,
    )
    layout = chain.layout
    last = {-1: 0}
    for i, name in enumerate(chain.robot.joint_names):
        placement = pin.SE3(chain.robot.frames.before(i))
        parent = last[chain.robot.parents[i]]
        for k in range(layout.starts[i], layout.starts[i + 1]):
            parent = model.addJoint(
                parent, kinds[layout.kind[k]](), placement, f"{name}.{chain.symbols[k]}"
            )
            placement = pin.SE3.Identity()
        last[i] = parent
        model.appendBodyToJoint(
            parent, _body(chain.robot.masses[i], chain.robot.centres[i]), pin.SE3.Identity()
        )
    return last


def _body(mass: float, centre: np.ndarray) -> pin.Inertia:
    """Return a body without rotational inertia, which statics does not need."""
    import pinocchio as pin

    return pin.Inertia(float(mass), np.array(centre, float), np.zeros((3, 3)))


def joint_placements(model: Model, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the calibrated poses of the URDF's joint frames and of the tip, without elastic
    effects.

    Joint frame i rotates about its own axis; its position along and angle about this axis are those
    of the URDF.

    Returns:
        Shape (n, 4, 4): joint frame i at q = 0 in the joint frame that carries it, or in the base
        frame; and shape (4, 4): the tip in the joint frame that carries it.
    """
    placed, behind = link_placements(model, values)
    return placed, behind[model.chain.path.tip_joint + 1] @ model.chain.path.T_joint_tip


def link_placements(model: Model, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the calibrated poses of the URDF's joint frames, and of the link frames in them.

    Returns:
        Shape (n, 4, 4), as :func:`joint_placements`; and shape (n + 1, 4, 4): the base frame, then
        the link frame of each joint in its URDF joint frame, in which the joint's links are fixed.
    """
    placed, behind, _ = _placements(
        model.chain, model.rigid_coordinates(values), joint_mounts(model.chain)
    )
    return placed, behind


def closure_frames(
    model: Model, values: np.ndarray
) -> list[tuple[Closure, tuple[np.ndarray, np.ndarray]]]:
    """Return each loop closure with the calibrated frames at the start and end of its path.

    The frames, shape (4, 4), are given in the URDF's joint frame of the joint that carries them, or
    in the base frame.
    """
    chain = model.chain
    behind = link_placements(model, values)[1]
    x = model.rigid_coordinates(values)
    found = []
    for closure in chain.robot.closures:
        side = closure.pinned(chain.robot.parents)
        along, across = (
            x[chain.pin(chain.pins.index(closure), symbol)] if side else 0.0 for symbol in "xy"
        )
        start, end = (
            behind[joint + 1] @ T @ (translation(along, across, 0.0) if side == here else np.eye(4))
            for (_, joint, T), here in zip(closure.path.ends, (-1, 1), strict=True)
        )
        found.append((closure, (start, end)))
    return found


def joint_mounts(chain: Chain) -> np.ndarray:
    """Return the URDF's joint frames in the frames after theta, which turn with the joints about z,
    shape (n, 4, 4).
    """
    _, _, turning = _placements(
        chain, chain.nominal, np.tile(np.eye(4), (chain.robot.n_joints, 1, 1))
    )
    return np.asarray(
        np.linalg.inv(turning) @ (chain.robot.frames.T_base_link @ chain.robot.T_link_joint)
    )


def _placements(
    chain: Chain, coordinates: np.ndarray, mounts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the joints' placements relative to their carriers, the link frames in the joint
    frames, and frames after theta.

    ``mounts`` are the joint frames in the frames after theta; the link frames begin with the
    base's.
    """
    robot = chain.robot
    n = chain.robot.n_joints
    placed = np.empty((n, 4, 4))
    turning = np.empty((n, 4, 4))
    behind = np.tile(np.eye(4), (n + 1, 1, 1))
    frames = {-1: np.eye(4)}
    for i, parent in enumerate(robot.parents):
        at = {symbol: coordinates[k] for symbol, k in chain.joint_coordinates(i).items()}
        axis = (
            behind[parent + 1]
            @ robot.frames.before(i)
            @ translation(at.get("x", 0.0), at.get("y", 0.0), 0.0)
        )
        axis = (
            axis @ rotation("x", at["s_x"]) @ rotation("y", at["s_y"]) @ rotation("z", at["theta"])
        )
        placed[i] = axis @ mounts[i]
        turning[i] = frames[parent] @ axis
        frames[i] = turning[i] @ mounts[i]
        behind[i + 1] = (
            np.linalg.inv(mounts[i])
            @ translation(at["a"], 0.0, at["d"])
            @ rotation("x", at["alpha"])
        )
    return placed, behind, turning


def pinocchio_model(model: Model, values: np.ndarray) -> pin.Model:
    """Return the robot's ``pin.Model`` with the calibrated joint and tip frames, at parameter
    values of shape (P,).

    It has the joints, names and configuration vector of :meth:`Robot.pinocchio_model`; the frame of
    the path's tip is the calibrated tip. Elastic effects are left out, as a ``pin.Model`` can't
    represent a dependence on the load.
    """
    import pinocchio as pin

    placed, tip = joint_placements(model, values)
    robot = model.chain.robot
    out = robot.pinocchio_model()
    base = out.frames[out.getFrameId(robot.base, pin.BODY)].placement.copy()
    for i, name in enumerate(robot.joint_names):
        joint = out.getJointId(name)
        out.jointPlacements[joint] = (
            base if robot.parents[i] < 0 else pin.SE3.Identity()
        ) * pin.SE3(placed[i])
    out.frames[out.getFrameId(model.chain.path.tip, pin.BODY)].placement = pin.SE3(tip)
    return out
