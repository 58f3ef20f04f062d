"""What the inertia of moving links exerts on the joints, by the recursion of Newton and Euler (Luh, Walker, Paul 1980)."""

from __future__ import annotations

import numpy as np

from pincal.robot.robot import Robot
from pincal.robot.se3 import rotation, translation

# Columns of DhFrames.parameters.
_D, _A, _ALPHA = 3, 4, 5


def inertial_loads(
    robot: Robot,
    q: np.ndarray,
    velocity: np.ndarray,
    acceleration: np.ndarray,
    *,
    payload: np.ndarray | None = None,
    payload_centre: np.ndarray | None = None,
) -> np.ndarray | None:
    """Return the loads of inertia on the nominal arm, as ``Conditions.inertial`` takes them.

    Args:
        robot: the arm; masses and moments of inertia are those of its URDF.
        q: joint positions [rad], prismatic [m], shape (N, n).
        velocity: their velocities, shape (N, n).
        acceleration: their accelerations, shape (N, n).
        payload: mass at the tip [kg], shape (N,); default: none.
        payload_centre: its centre of mass in the tip frame [m], shape (3,); default: the tip.

    Returns:
        Force [N] and moment [N m] on each joint, in the axes behind its motion and about the origin of the frame before,
        shape (N, n, 6); None if the URDF does not say what all links weigh.
    """
    import pinocchio as pin

    if robot.massless:
        return None
    loads = np.zeros((len(q), robot.n_joints, 6))
    mass = np.zeros(len(q)) if payload is None else payload
    centre = np.zeros(3) if payload_centre is None else payload_centre
    for kilograms in np.unique(mass):
        model = robot.pinocchio_model()
        model.gravity.setZero()
        tip = robot.path.tip_joint
        if kilograms and tip >= 0:
            place = (np.linalg.inv(robot.T_link_joint[tip]) @ robot.path.T_joint_tip @ np.append(centre, 1.0))[:3]
            model.appendBodyToJoint(
                model.getJointId(robot.joint_names[tip]), pin.Inertia(kilograms, place, np.zeros((3, 3))), pin.SE3.Identity()
            )
        data = model.createData()
        ids = [model.getJointId(name) for name in robot.joint_names]
        order = np.array([model.joints[i].idx_v for i in ids])
        v, a = np.zeros((2, model.nv))
        for row in np.flatnonzero(mass == kilograms):
            v[order], a[order] = velocity[row], acceleration[row]
            pin.rnea(model, data, robot.configuration(model, q[row]), v, a)
            for k, i in enumerate(ids):
                loads[row, k] = data.f[i].vector
    return -_about_frames_before(robot, q, loads)


def _about_frames_before(robot: Robot, q: np.ndarray, wrenches: np.ndarray) -> np.ndarray:
    """Return wrenches in the URDF's joint frames, shape (N, n, 6), about and along the frames behind the joints' motion."""
    out = np.empty_like(wrenches)
    for k, row in enumerate(robot.frames.parameters):
        way = translation(row[_A], 0.0, row[_D]) @ rotation("x", row[_ALPHA]) @ robot.T_link_joint[k]
        force, moment = wrenches[:, k, :3] @ way[:3, :3].T, wrenches[:, k, 3:] @ way[:3, :3].T
        lever = np.tile(way[:3, 3], (len(q), 1))
        if robot.joint_types[k] == "prismatic":
            lever[:, 2] += q[:, k]
        out[:, k, :3], out[:, k, 3:] = force, moment + np.cross(lever, force)
    return out
