"""An arm in motion: the conditions of its poses at any time of the joints' log, with inertial
loads.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.motion.joint_path import DEGREE, JointPath
from pincal.robot.robot import Robot
from pincal.robot.se3 import rotation, shortest_turn, translation
from pincal.sensors.imu import Inertial, Window
from pincal.thresholds import Count

# Interpolation points of inertial loads per knot of the joints.
_PER_KNOT: Count = 4
# Columns of DhFrames.parameters.
_D, _A, _ALPHA = range(3, 6)


@dataclass(frozen=True, repr=False)
class MovingArm:
    """A robot on its path.

    Attributes:
        robot: the robot.
        path: the positions of its joints.
        payload: mass at the tip [kg].
        payload_centre: its centre of mass in the tip frame [m].
        loads: inertial loads, 6 n functions of time, see :func:`inertial_loads`; None for none.
    """

    robot: Robot
    path: JointPath
    payload: float = 0.0
    payload_centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    loads: JointPath | None = None

    @classmethod
    def of(
        cls,
        robot: Robot,
        path: JointPath,
        *,
        payload: float = 0.0,
        payload_centre: Iterable[float] = (0.0, 0.0, 0.0),
    ) -> MovingArm:
        """Return the arm with its inertial loads."""
        from scipy.interpolate import make_interp_spline

        x, y, z = payload_centre
        parts = []
        for part in path.parts:
            count = _PER_KNOT * (len(part.t) - 2 * DEGREE)
            own = np.linspace(part.t[0], part.t[-1], max(count, DEGREE + 1))
            found = inertial_loads(
                robot,
                *(part(own, order) for order in range(3)),
                payload=np.full(len(own), payload),
                payload_centre=np.array([x, y, z]),
            )
            if found is None:
                return cls(robot, path, payload, (x, y, z))
            parts.append(make_interp_spline(own, found.reshape(len(own), -1), DEGREE))
        loads = JointPath(tuple(parts), path.spacing, np.zeros(6 * robot.n_joints), path.origin)
        return cls(robot, path, payload, (x, y, z), loads)

    def conditions(self, time: np.ndarray, offsets: np.ndarray | None = None) -> Conditions:
        """Return the conditions at times by the joints' clock, shape (N,) [s], or at offsets from
        each, shape (O,) [s].

        Rows of one time are consecutive and all have this time.
        """
        at = (
            np.asarray(time, float)
            if offsets is None
            else np.repeat(np.asarray(time, float), len(offsets))
        )
        return Conditions(
            self.path.at(time, offsets=offsets),
            np.zeros(len(at), int),
            np.full(len(at), self.payload),
            np.array(self.payload_centre),
            time=at,
            velocity=self.path.at(time, 1, offsets=offsets),
            inertial=None
            if self.loads is None
            else self.loads.at(time, offsets=offsets).reshape(len(at), -1, 6),
        )

    def tips(self, time: np.ndarray) -> np.ndarray:
        """Return the poses of the nominal tip at times, shape (N, 3, 4), in the base frame."""
        return Model(Chain.of(self.robot), ()).predict(
            np.zeros(0), Conditions.at(self.path.at(time))
        )

    def ideal(self, time: np.ndarray, window: Window | None = None) -> Inertial:
        """Return the readings of an ideal IMU at the nominal tip at times, or in windows about
        them.
        """
        window = Window(0.0) if window is None else window
        chain = level_chain(Chain.of(self.robot))
        poses = Model(chain, ()).predict(
            np.zeros(0), Conditions.at(self.path.at(time, offsets=window.offsets))
        )
        return Inertial.of(poses, window, float(np.linalg.norm(chain.gravity)))


def level_chain(chain: Chain) -> Chain:
    """Return a chain whose instrument's frame is level, with z opposite to gravity."""
    size = float(np.linalg.norm(chain.gravity))
    turned = shortest_turn(chain.gravity / size, np.array([0.0, 0.0, -1.0]))[:3, :3]
    return chain.with_references(turned, chain.tool_rotations)


def inertial_loads(
    robot: Robot,
    q: np.ndarray,
    velocity: np.ndarray,
    acceleration: np.ndarray,
    *,
    payload: np.ndarray | None = None,
    payload_centre: np.ndarray | None = None,
) -> np.ndarray | None:
    """Return the inertial loads on the nominal arm, as for ``Conditions.inertial`` (Luh, Walker,
    Paul 1980).

    Args:
        robot: the arm, with masses and moments of inertia from its URDF.
        q: joint positions [rad], prismatic [m], shape (N, n).
        velocity: their velocities, shape (N, n).
        acceleration: their accelerations, shape (N, n).
        payload: mass at the tip [kg], shape (N,); default: none.
        payload_centre: its centre of mass in the tip frame [m], shape (3,); default: the tip.

    Returns:
        Force [N] and moment [N m] on each joint, in the axes behind its motion and about the origin
        of the frame before, shape (N, n, 6); None if the URDF lacks masses of links.
    """
    import pinocchio as pin

    if robot.massless:
        return None
    loads = np.zeros((len(q), robot.n_joints, 6))
    mass = np.zeros(len(q)) if payload is None else payload
    centre = np.zeros(3) if payload_centre is None else payload_centre
    for kilograms in np.unique(mass):
        model = _weightless(robot, kilograms, centre)
        data = model.createData()
        ids = [model.getJointId(name) for name in robot.joint_names]
        order = np.array([model.joints[i].idx_v for i in ids])
        v, a = np.zeros((2, model.nv))
        rows = np.flatnonzero(mass == kilograms)
        for row, at in zip(rows, robot.configurations(model, q[rows]), strict=True):
            v[order] = velocity[row]
            a[order] = acceleration[row]
            pin.rnea(model, data, at, v, a)
            for k, i in enumerate(ids):
                loads[row, k] = data.f[i].vector
    return -_about_frames_before(robot, q, loads)


def _weightless(robot: Robot, kilograms: float, centre: np.ndarray) -> Any:
    """Return a model of an arm without gravity, carrying a mass at a centre in its tip frame, shape
    (3,) [m].
    """
    import pinocchio as pin

    model = robot.pinocchio_model()
    model.gravity.setZero()
    tip = robot.path.tip_joint
    if kilograms and tip >= 0:
        place = (
            np.linalg.inv(robot.T_link_joint[tip]) @ robot.path.T_joint_tip @ np.append(centre, 1.0)
        )[:3]
        model.appendBodyToJoint(
            model.getJointId(robot.joint_names[tip]),
            pin.Inertia(kilograms, place, np.zeros((3, 3))),
            pin.SE3.Identity(),
        )
    return model


def _about_frames_before(robot: Robot, q: np.ndarray, wrenches: np.ndarray) -> np.ndarray:
    """Return wrenches in the URDF's joint frames, shape (N, n, 6), about and along the frames
    behind the joints' motion.
    """
    out = np.empty_like(wrenches)
    for k, row in enumerate(robot.frames.parameters):
        T = translation(row[_A], 0.0, row[_D]) @ rotation("x", row[_ALPHA]) @ robot.T_link_joint[k]
        force = wrenches[:, k, :3] @ T[:3, :3].T
        moment = wrenches[:, k, 3:] @ T[:3, :3].T
        lever = np.tile(T[:3, 3], (len(q), 1))
        if robot.joint_types[k] == "prismatic":
            lever[:, 2] += q[:, k]
        out[:, k, :3] = force
        out[:, k, 3:] = moment + np.cross(lever, force)
    return out
