"""What an effect of the true machine sees and what it changes: poses, loads and deformation."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pincal.simulate.arm import Arm


@dataclass(frozen=True)
class Poses:
    """N recorded poses and the conditions under which they were taken.

    Attributes:
        q: Recorded joint positions [rad or m], shape (N, n).
        payload: Mass at the tip [kg], shape (N,).
        payload_com: Its centre of mass in the tip frame [m], shape (N, 3).
        temperature: Temperature minus the reference temperature [K], shape (N,).
        time: Time since the start [s], shape (N,).
        approach: Direction from which each joint arrived (-1, 0, 1), shape (N, n); None: it follows from the order
            of the poses.
        scatter: Standard normal draws per joint and pose, scaled by unrepeatable effects, shape (N, n).
    """

    q: np.ndarray
    payload: np.ndarray
    payload_com: np.ndarray
    temperature: np.ndarray
    time: np.ndarray
    approach: np.ndarray | None
    scatter: np.ndarray


@dataclass(frozen=True)
class Loads:
    """Gravity loads of all bodies beyond a joint, at their deformed places.

    Attributes:
        before: Moment about the joint's origin, in the working frame before q turns it [N m], shape (N, n,
            3).
        after: The same moment in the working frame after q [N m], shape (N, n, 3).
        drive: Load along the joint's own freedom: moment about the axis, or force along it if the joint
            slides [N m or N], shape (N, n).
        end_moment: Moment of what is beyond link i about its far end, in the frame after q [N m], (N, n, 3).
        end_force: Weight of what is beyond link i, in the same frame [N], shape (N, n, 3).
        base: Moment of everything that moves about the origin of the base frame, in the base frame [N m],
            shape (N, 3).
    """

    before: np.ndarray
    after: np.ndarray
    drive: np.ndarray
    end_moment: np.ndarray
    end_force: np.ndarray
    base: np.ndarray


@dataclass(frozen=True)
class Deformation:
    """What the effects add up to. Effects write into the arrays.

    A twist holds a displacement [m] and angles [rad] about x, y and z, carried out as Rz Ry Rx.

    Attributes:
        joint: Added to the joint position [rad or m], shape (N, n).
        before: Twist in the working frame before q, shape (N, n, 6).
        after: Twist in the working frame after q, shape (N, n, 6).
        base: Twist of the base in the base frame, shape (N, 6).
        tip: Twist of the tip in the tip frame, shape (N, 6).
    """

    joint: np.ndarray
    before: np.ndarray
    after: np.ndarray
    base: np.ndarray
    tip: np.ndarray

    def add_at_end_of_link(self, arm: Arm, joint: int, twist: np.ndarray) -> None:
        """Add a twist at the far end of the link that a joint moves: at the next joint, or at the tip.

        Args:
            arm: The arm that deforms.
            joint: Index of the joint that moves the link.
            twist: Displacement and angles in the frame after q of that joint, shape (N, 6).
        """
        rotation = arm.placements[joint + 1][:3, :3]
        at_end = np.hstack((twist[:, :3] @ rotation, twist[:, 3:] @ rotation))
        if joint + 1 < len(arm.names):
            self.before[:, joint + 1] += at_end
        else:
            self.tip[:] += at_end

    def change(self, before: Deformation) -> float:
        """Return the largest change of any component [rad or m]."""
        pairs = ((getattr(self, field.name), getattr(before, field.name)) for field in fields(self))
        return max(float(np.abs(new - old).max(initial=0.0)) for new, old in pairs)


@dataclass(frozen=True)
class Equilibrium:
    """The arm at rest under gravity.

    Attributes:
        tip: Transform from the tip to the undeformed base frame, shape (N, 4, 4).
        deformation: Sum of all effects.
        loads: Gravity loads on the deformed arm.
    """

    tip: np.ndarray
    deformation: Deformation
    loads: Loads


def no_deformation(poses: int, joints: int) -> Deformation:
    """Return a deformation of zeros for N poses of n joints."""
    at_joints = (poses, joints, 6)
    return Deformation(
        np.zeros((poses, joints)), np.zeros(at_joints), np.zeros(at_joints), np.zeros((poses, 6)), np.zeros((poses, 6))
    )


def no_loads(poses: int, joints: int) -> Loads:
    """Return loads of zeros for N poses of n joints."""
    before, after, end_moment, end_force = np.zeros((4, poses, joints, 3))
    return Loads(before, after, np.zeros((poses, joints)), end_moment, end_force, np.zeros((poses, 3)))
