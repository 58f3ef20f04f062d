"""What an arm is made of, as far as it can be in the way: boxes around its bodies, and their collisions."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pincal.design.collisions import Collisions, read_collisions, without_touching
from pincal.robot.robot import Robot
from pincal.robot.se3 import transform, translation

# Half the width of a link that a URDF says nothing of, at the base, in reaches of the arm, and what of it a tip loses.
_WIDTH, _SLIMMER = 1.0 / 22.0, 0.6


@dataclass(frozen=True)
class Boxes:
    """A box around each body.

    Attributes:
        body: shape (B,), what each moves with: joint i, counted from 1; 0 stands.
        placements: shape (B, 4, 4), middle and axes of each box in the frame of its body.
        halves: shape (B, 3), half its sides [m].
    """

    body: np.ndarray
    placements: np.ndarray
    halves: np.ndarray

    def lowest(self, frames: np.ndarray, body: int) -> np.ndarray:
        """Return the least height of the boxes that move with joint ``body`` or one after it, shape (N,); inf without."""
        chosen = self.body >= body
        placed = frames[:, self.body[chosen]] @ self.placements[chosen]
        down = np.abs(placed[:, :, 2, :3] * self.halves[chosen]).sum(axis=2)
        return np.asarray(np.min(placed[:, :, 2, 3] - down, axis=1, initial=np.inf))

    def hide(self, frames: np.ndarray, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return whether a box stands between an eye and a point at each pose, shape (N,).

        A box that the point itself lies in does not count: it is larger than the body in it.

        Args:
            frames: shape (N, n + 1, 4, 4), of the bodies.
            eye: shape (3,), in the base frame [m].
            points: shape (N, 3), likewise.
        """
        hidden = np.zeros(len(points), bool)
        for body, placement, half in zip(self.body, self.placements, self.halves, strict=True):
            box = frames[:, body] @ placement
            start = np.einsum("nji,nj->ni", box[:, :3, :3], eye - box[:, :3, 3])
            end = np.einsum("nji,nj->ni", box[:, :3, :3], points - box[:, :3, 3])
            hidden |= _crosses(start, end, half) & np.any(np.abs(end) > half, axis=1)
        return hidden


def _crosses(start: np.ndarray, end: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return whether segments meet a box about the origin (slab test of Kay and Kajiya 1986), shape (N,)."""
    way = end - start
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    one, other = (-half - start) / way, (half - start) / way
    enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.asarray((enter <= leave) & (leave >= 0.0) & (enter <= 1.0))


@dataclass(frozen=True)
class Bodies:
    """What may be in the way.

    Attributes:
        boxes: around each body; around the lines from joint to joint where the URDF has no collision geometry.
        collisions: None where there is nothing to check.
        notes: in words, what is not checked and why.
    """

    boxes: Boxes
    collisions: Collisions | None
    notes: tuple[str, ...]

    @classmethod
    def of(cls, robot: Robot, *, clearance: float = 0.0) -> Bodies:
        """Return the bodies of an arm, by the collision geometry of its URDF; ``clearance`` is in m."""
        collisions, notes = read_collisions(robot, clearance)
        if collisions is None:
            return cls(_bars(robot), None, tuple(notes))
        boxes = _boxes(robot, collisions)
        collisions, touching = without_touching(collisions)
        return cls(boxes, collisions, (*notes, *touching))


def _boxes(robot: Robot, collisions: Collisions) -> Boxes:
    """Return the boxes along the axes of each collision body's own frame."""
    import pinocchio as pin

    model, data = collisions.model, collisions.model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    T_base_world = data.oMf[model.getFrameId(robot.base, pin.BODY)].inverse().homogeneous
    joints = {model.getJointId(name): i + 1 for i, name in enumerate(robot.joint_names)}
    bodies, placements, halves = [], [], []
    for item in collisions.geometry.geometryObjects:
        body = joints.get(item.parentJoint, 0)
        item.geometry.computeLocalAABB()
        box = item.geometry.aabb_local
        before = robot.T_link_joint[body - 1] if body else T_base_world
        bodies.append(body)
        placements.append(before @ item.placement.homogeneous @ translation(*np.ravel(box.center())))
        halves.append(0.5 * np.ravel(box.max_ - box.min_))
    return Boxes(np.array(bodies), np.array(placements), np.array(halves))


def _bars(robot: Robot) -> Boxes:
    """Return bars from joint to joint and to the tip, for want of anything better."""
    frames = [np.eye(4), *robot.frames.T_base_link]
    places = robot.frames.T_base_link @ robot.T_link_joint
    points = [np.zeros(3), *places[:, :3, 3], (frames[-1] @ robot.frames.T_last_tip)[:3, 3]]
    bodies, placements, halves = [], [], []
    for body, (here, there) in enumerate(pairwise(points)):
        width = _WIDTH * robot.reach * (1.0 - _SLIMMER * body / robot.n_joints)
        if np.linalg.norm(there - here) > 1e-6:
            bodies.append(body)
            placements.append(np.linalg.inv(frames[body]) @ _along(here, there))
            halves.append([width, width, 0.5 * float(np.linalg.norm(there - here))])
    return Boxes(np.array(bodies, int), np.array(placements).reshape(-1, 4, 4), np.array(halves).reshape(-1, 3))


def _along(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Return a frame in the middle between two points, its z axis along the line."""
    z = (there - here) / np.linalg.norm(there - here)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return transform(np.column_stack([x, np.cross(z, x), z]), 0.5 * (here + there))
