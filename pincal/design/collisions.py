"""Self-collision by the collision geometry of a URDF."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.robot.packages import Meshes
from pincal.robot.robot import Robot
from pincal.robot.urdf_file import arm_text, parse_xml

if TYPE_CHECKING:
    import pinocchio as pin

# Poses by which pairs of bodies are found that touch by the way the arm is built, and the part of them in which they do.
_PROBES, _ALWAYS = 100, 0.95
# Such pairs that are named.
_NAMED = 4


@dataclass(frozen=True, eq=False)
class Collisions:
    """The collision geometry of a URDF, everything off the arm locked.

    Attributes:
        robot: the arm.
        model: its Pinocchio model.
        geometry: the bodies and the pairs of them that must not touch.
        clearance: distance below which two bodies count as touching [m].
    """

    robot: Robot
    model: pin.Model
    geometry: pin.GeometryModel
    clearance: float

    def hit(self, q: np.ndarray) -> np.ndarray:
        """Return whether the arm touches itself, shape (N,), at joint positions of shape (N, n)."""
        return np.array([self._touches(row, first=True) for row in q], bool)

    def often(self, q: np.ndarray) -> np.ndarray:
        """Return in which part of the poses each pair touches, shape (pairs,)."""
        count = np.zeros(len(self.geometry.collisionPairs))
        for row in q:
            self._touches(row, first=False)
            count += [result.isCollision() for result in self._work[1].collisionResults]
        return count / max(len(q), 1)

    @cached_property
    def _work(self) -> tuple[pin.Data, pin.GeometryData]:
        """Pinocchio's room to work in."""
        found = self.geometry.createData()
        for request in found.collisionRequests:
            request.security_margin = self.clearance
        return self.model.createData(), found

    def _touches(self, q: np.ndarray, *, first: bool) -> bool:
        """Return whether any pair touches; look at all the others, too, unless the first one is enough."""
        import pinocchio as pin

        data, found = self._work
        row = self.robot.configuration(self.model, q)
        return bool(pin.computeCollisions(self.model, data, self.geometry, found, row, first))


def read_collisions(robot: Robot, clearance: float) -> tuple[Collisions | None, list[str]]:
    """Return the collision geometry of a URDF with all pairs that could touch, and in words what is missing of it.

    Two bodies closer than ``clearance`` [m] count as touching.
    """
    import pinocchio as pin
    from lxml import etree

    root = parse_xml(robot.urdf, robot.source)
    notes = list(_settle_meshes(root, robot.source))
    if root.find("link/collision") is None:
        why = "none of its collision meshes is here" if notes else "the URDF has no collision geometry"
        return None, [*notes, f"self-collision is not checked: {why}"]
    text = arm_text(etree.tostring(root), robot.joint_names, robot.source)
    model = pin.buildModelFromXML(text)
    try:
        geometry = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError) as error:
        return None, [*notes, f"self-collision is not checked: Pinocchio can't read the collision geometry ({error})"]
    for one, other in _pairs(model, geometry):
        geometry.addCollisionPair(pin.CollisionPair(one, other))
    return Collisions(robot, model, geometry, clearance), notes


def _settle_meshes(root: Any, source: str) -> Iterator[str]:
    """Give each collision mesh its absolute path, or take it out and say so."""
    meshes = Meshes(source)
    for link in root.iterfind("link"):
        for collision in link.findall("collision"):
            mesh = collision.find("geometry/mesh")
            if mesh is None:
                continue
            path, why = meshes.find(mesh.get("filename", ""))
            if path is None:
                yield f"{link.get('name')}: mesh {mesh.get('filename', '')!r} {why}, so its collisions are not checked"
                link.remove(collision)
            else:
                mesh.set("filename", os.fspath(path))


def _pairs(model: Any, geometry: Any) -> Iterator[tuple[int, int]]:
    """Yield the pairs of bodies that are neither one body nor neighbours at a joint."""
    parents = [body.parentJoint for body in geometry.geometryObjects]
    for i, one in enumerate(parents):
        for j, other in enumerate(parents[:i]):
            if one != other and model.parents[one] != other and model.parents[other] != one:
                yield j, i


def without_touching(collisions: Collisions) -> tuple[Collisions | None, list[str]]:
    """Take out the pairs that touch in nearly every pose, as they can do no harm, and name them; None if none is left."""
    import pinocchio as pin

    geometry = collisions.geometry
    probes = collisions.robot.random_configurations(_PROBES, np.random.default_rng(0))
    always = np.flatnonzero(collisions.often(probes) > _ALWAYS)
    named = []
    for k in always[::-1]:
        pair = geometry.collisionPairs[int(k)]
        bodies = (geometry.geometryObjects[pair.first], geometry.geometryObjects[pair.second])
        links = [collisions.model.frames[body.parentFrame].name for body in bodies]
        named.append(" and ".join(links))
        geometry.removeCollisionPair(pin.CollisionPair(pair.first, pair.second))
    named = sorted(set(named))
    rest = f" and {len(named) - _NAMED} pairs more" if len(named) > _NAMED else ""
    notes = [f"taken as touching by construction: {', '.join(named[:_NAMED])}{rest}"] if named else []
    # A fresh one: Pinocchio's room to work in is made for the pairs.
    return (replace(collisions) if len(geometry.collisionPairs) else None), notes
