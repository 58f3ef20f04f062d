"""Obstruction by the arm itself: boxes around its bodies, and self-collisions by the geometry of
its URDF.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.design.design_numbers import DESIGN_NUMBERS
from pincal.errors import counted, few
from pincal.robot.packages import Meshes
from pincal.robot.robot import Robot
from pincal.robot.se3 import perpendicular, transform, translation
from pincal.robot.urdf_file import arm_text, parse_xml
from pincal.thresholds import Count, Scale

if TYPE_CHECKING:
    import pinocchio as pin

# Number of poses by which pairs that touch by construction are found.
_PROBES: Count = 100
# Number of such pairs, and of links without their mesh, that are named.
_NAMED: Count = 4


@dataclass(frozen=True, eq=False)
class Collisions:
    """The collision geometry of an arm.

    Attributes:
        robot: the arm.
        model: its Pinocchio model, with all other joints locked.
        geometry: the bodies and the pairs of them that must not touch.
        clearance: distance below which two bodies count as touching [m].
    """

    robot: Robot
    model: pin.Model
    geometry: pin.GeometryModel
    clearance: float

    def hit(self, q: np.ndarray) -> np.ndarray:
        """Return whether the arm touches itself, shape (N,), at joint positions of shape (N, n)."""
        rows = self.robot.configurations(self.model, q)
        return np.array([self._touches(row, first=True) for row in rows], bool)

    def often(self, q: np.ndarray) -> np.ndarray:
        """Return the fraction of the poses in which each pair touches, shape (pairs,)."""
        count = np.zeros(len(self.geometry.collisionPairs))
        for row in self.robot.configurations(self.model, q):
            self._touches(row, first=False)
            count += [result.isCollision() for result in self._work[1].collisionResults]
        return count / max(len(q), 1)

    @cached_property
    def _work(self) -> tuple[pin.Data, pin.GeometryData]:
        """Pinocchio's data of model and geometry."""
        found = self.geometry.createData()
        for request in found.collisionRequests:
            request.security_margin = self.clearance
        return self.model.createData(), found

    def _touches(self, row: np.ndarray, *, first: bool) -> bool:
        """Return whether any pair touches in a configuration; with ``first``, stop at the first
        one.
        """
        import pinocchio as pin

        data, found = self._work
        return bool(pin.computeCollisions(self.model, data, self.geometry, found, row, first))


def read_collisions(robot: Robot, clearance: float) -> tuple[Collisions | None, list[str]]:
    """Return the collision geometry of a URDF with all pairs that could touch, and notes on what is
    missing.

    Two bodies closer than ``clearance`` [m] count as touching.
    """
    import pinocchio as pin
    from lxml import etree

    root = parse_xml(robot.urdf, robot.source)
    missing = list(_settle_meshes(root, robot.source))
    if root.find("link/collision") is None:
        why = "the URDF has no collision geometry"
        if missing:
            links = counted(len({mesh.link for mesh in missing}), "link")
            why = f"the collision meshes of {links} can't be read: {missing[0].why}"
        return None, [f"self-collision is not checked: {why}"]
    notes = _unchecked(missing)
    text = arm_text(etree.tostring(root), robot.joint_names, robot.source)
    model = pin.buildModelFromXML(text)
    try:
        geometry = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError) as error:
        return None, [
            *notes,
            f"self-collision is not checked: Pinocchio can't read the collision geometry ({error})",
        ]
    for one, other in _pairs(model, geometry):
        geometry.addCollisionPair(pin.CollisionPair(one, other))
    return Collisions(robot, model, geometry, clearance), notes


@dataclass(frozen=True)
class _MissingMesh:
    """A collision mesh that is not checked: its link, and what is wrong with it."""

    link: str
    why: str


def _settle_meshes(root: Any, source: str) -> Iterator[_MissingMesh]:
    """Give each collision mesh its absolute path, or remove it and yield what is missing."""
    meshes = Meshes(source)
    for link in root.iterfind("link"):
        for collision in link.findall("collision"):
            mesh = collision.find("geometry/mesh")
            if mesh is None:
                continue
            name = mesh.get("filename", "")
            path, why = meshes.find(name)
            if path is None:
                yield _MissingMesh(link.get("name", ""), f"{name!r} {why}")
                link.remove(collision)
            else:
                mesh.set("filename", os.fspath(path))


def _unchecked(missing: Sequence[_MissingMesh]) -> list[str]:
    """Return a note on the links whose collisions are not checked; one mesh stands for all."""
    if not missing:
        return []
    links = list(dict.fromkeys(mesh.link for mesh in missing))
    others = f", nor {len(missing) - 1} more" if len(missing) > 1 else ""
    return [
        f"collisions of {counted(len(links), 'link')} ({few(links, _NAMED)}) are not checked: "
        f"mesh {missing[0].why}{others}"
    ]


def _pairs(model: Any, geometry: Any) -> Iterator[tuple[int, int]]:
    """Yield the pairs of geometries on different bodies that are not neighbours at a joint."""
    parents = [body.parentJoint for body in geometry.geometryObjects]
    for i, one in enumerate(parents):
        for j, other in enumerate(parents[:i]):
            if one != other and model.parents[one] != other and model.parents[other] != one:
                yield j, i


def without_touching(collisions: Collisions) -> tuple[Collisions | None, list[str]]:
    """Remove the pairs that touch in nearly every pose, with a note; None instead if no pair
    remains.
    """
    import pinocchio as pin

    geometry = collisions.geometry
    probes = collisions.robot.random_configurations(_PROBES, np.random.default_rng(0))
    always = np.flatnonzero(collisions.often(probes) > DESIGN_NUMBERS.always)
    named = []
    for k in always[::-1]:
        pair = geometry.collisionPairs[int(k)]
        bodies = (geometry.geometryObjects[pair.first], geometry.geometryObjects[pair.second])
        links = [collisions.model.frames[body.parentFrame].name for body in bodies]
        named.append(" and ".join(links))
        geometry.removeCollisionPair(pin.CollisionPair(pair.first, pair.second))
    named = sorted(set(named))
    rest = f" and {len(named) - _NAMED} pairs more" if len(named) > _NAMED else ""
    notes = (
        [f"taken as touching by construction: {', '.join(named[:_NAMED])}{rest}"] if named else []
    )
    # A new object, as Pinocchio's data are allocated for the pairs.
    return (replace(collisions) if len(geometry.collisionPairs) else None), notes


# Half the width of a link without geometry at the base, in reaches of the arm, and its relative
# decrease towards the tip.
_WIDTH: Scale = 1.0 / 22.0
_SLIMMER: Scale = 0.6


@dataclass(frozen=True)
class Boxes:
    """A box around each body.

    Attributes:
        body: shape (B,), the joint that moves each, counted from 1; 0 for the base.
        placements: shape (B, 4, 4), centre and axes of each box in the frame of its body.
        halves: shape (B, 3), half its sides [m].
    """

    body: np.ndarray
    placements: np.ndarray
    halves: np.ndarray

    def lowest(self, frames: np.ndarray, body: int) -> np.ndarray:
        """Return the least height of the boxes from joint ``body`` on, shape (N,); inf
        without any.
        """
        chosen = self.body >= body
        placed = frames[:, self.body[chosen]] @ self.placements[chosen]
        down = np.abs(placed[:, :, 2, :3] * self.halves[chosen]).sum(axis=2)
        return np.asarray(np.min(placed[:, :, 2, 3] - down, axis=1, initial=np.inf))

    def hide(self, frames: np.ndarray, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return whether a box is between an eye, shape (3,), and a point at each pose, shape (N,
        3); shape (N,).

        Both are in the base frame [m], like the bodies' frames, shape (N, n + 1, 4, 4). A box that
        contains the point does not count, as it is larger than its body.
        """
        hidden = np.zeros(len(points), bool)
        for body, placement, half in zip(self.body, self.placements, self.halves, strict=True):
            box = frames[:, body] @ placement
            start = np.einsum("nji,nj->ni", box[:, :3, :3], eye - box[:, :3, 3])
            end = np.einsum("nji,nj->ni", box[:, :3, :3], points - box[:, :3, 3])
            hidden |= _crosses(start, end, half) & np.any(np.abs(end) > half, axis=1)
        return hidden


def _crosses(start: np.ndarray, end: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return whether segments intersect a box about the origin (slab test of Kay and Kajiya 1986),
    shape (N,).
    """
    way = end - start
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    one = (-half - start) / way
    other = (half - start) / way
    enter = np.minimum(one, other).max(axis=1)
    leave = np.maximum(one, other).min(axis=1)
    return np.asarray((enter <= leave) & (leave >= 0.0) & (enter <= 1.0))


@dataclass(frozen=True)
class Bodies:
    """Bodies of the arm that may obstruct it.

    Attributes:
        boxes: around each body, or around the lines from joint to joint if the URDF has no
            collision geometry.
        collisions: the collision geometry; None if there is nothing to check.
        notes: unchecked parts, and why.
    """

    boxes: Boxes
    collisions: Collisions | None
    notes: tuple[str, ...]

    @classmethod
    def of(cls, robot: Robot, *, clearance: float = 0.0) -> Bodies:
        """Return the bodies of an arm from its URDF's collision geometry; ``clearance`` in m."""
        collisions, notes = read_collisions(robot, clearance)
        if collisions is None:
            return cls(_bars(robot), None, tuple(notes))
        boxes = _boxes(robot, collisions)
        collisions, touching = without_touching(collisions)
        return cls(boxes, collisions, (*notes, *touching))


def _boxes(robot: Robot, collisions: Collisions) -> Boxes:
    """Return the bounding boxes of the collision bodies in their own axes."""
    import pinocchio as pin

    model = collisions.model
    T_base_world = (
        model.frames[model.getFrameId(robot.base, pin.BODY)].placement.inverse().homogeneous
    )
    joints = {model.getJointId(name): i + 1 for i, name in enumerate(robot.joint_names)}
    bodies = []
    placements = []
    halves = []
    for item in collisions.geometry.geometryObjects:
        body = joints.get(item.parentJoint, 0)
        item.geometry.computeLocalAABB()
        box = item.geometry.aabb_local
        before = robot.T_link_joint[body - 1] if body else T_base_world
        bodies.append(body)
        placements.append(
            before @ item.placement.homogeneous @ translation(*np.ravel(box.center()))
        )
        halves.append(0.5 * np.ravel(box.max_ - box.min_))
    return Boxes(np.array(bodies), np.array(placements), np.array(halves))


def _bars(robot: Robot) -> Boxes:
    """Return bars from joint to joint and to the tip, in the absence of geometry."""
    frames = [np.eye(4), *robot.frames.T_base_link]
    places = robot.frames.T_base_link @ robot.T_link_joint
    points = [np.zeros(3), *places[:, :3, 3]]
    last = robot.path.tip_joint
    ends = [
        *zip(robot.parents, points[1:], strict=True),
        (last, (frames[last + 1] @ robot.path.T_joint_tip)[:3, 3]),
    ]
    bodies = []
    placements = []
    halves = []
    for body, there in ((carrier + 1, there) for carrier, there in ends):
        here = points[body]
        width = _WIDTH * robot.reach * (1.0 - _SLIMMER * body / robot.n_joints)
        if np.linalg.norm(there - here) > 1e-6:
            bodies.append(body)
            placements.append(np.linalg.inv(frames[body]) @ _along(here, there))
            halves.append([width, width, 0.5 * float(np.linalg.norm(there - here))])
    return Boxes(
        np.array(bodies, int),
        np.array(placements).reshape(-1, 4, 4),
        np.array(halves).reshape(-1, 3),
    )


def _along(here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Return a frame midway between two points, with its z axis along the line."""
    z = (there - here) / np.linalg.norm(there - here)
    x = -perpendicular(z)
    x /= np.linalg.norm(x)
    return transform(np.column_stack([x, np.cross(z, x), z]), 0.5 * (here + there))
