"""True machines with several arms: a URDF whose joints stand elsewhere, drives that give way, all by Pinocchio.

Nothing here is shared with the model that pincal fits.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pinocchio as pin
from lxml import etree
from scipy.spatial.transform import Rotation

from pincal.robot.urdf_file import find_file


@dataclass(frozen=True)
class TrueTree:
    """A robot of example-robot-data as it really is.

    Attributes:
        name: of the robot.
        joints: the joints that move; all others are fixed.
        offsets: what is added to recorded positions [rad or m], by joint.
        placements: displacement [m] and rotation vector [rad] of each joint's frame in itself, shape (6,), by joint.
        compliance: of each drive [rad/(N m)], by joint.
    """

    name: str
    joints: tuple[str, ...]
    offsets: dict[str, float] = field(default_factory=dict)
    placements: dict[str, np.ndarray] = field(default_factory=dict)
    compliance: dict[str, float] = field(default_factory=dict)

    @classmethod
    def drawn(
        cls, name: str, joints: tuple[str, ...], rng: np.random.Generator, *, length: float, angle: float, soft: float = 0.0
    ) -> TrueTree:
        """Draw a machine: standard deviations of lengths [m] and angles [rad], and mean compliance [rad/(N m)]."""
        sizes = np.repeat([length, angle], 3)
        return cls(
            name,
            joints,
            {joint: angle * rng.standard_normal() for joint in joints},
            {joint: sizes * rng.standard_normal(6) for joint in joints},
            {joint: soft * rng.uniform(0.5, 1.5) for joint in joints},
        )

    @cached_property
    def model(self) -> pin.Model:
        """Pinocchio's model of it."""
        root = etree.fromstring(find_file(self.name).read_bytes())
        for joint in root.iterfind("joint"):
            if joint.get("name") not in self.joints:
                joint.set("type", "fixed")
                for mimic in joint.findall("mimic"):
                    joint.remove(mimic)
        found = pin.buildModelFromXML(etree.tostring(root, encoding="unicode"))
        for joint, moved in self.placements.items():
            at = found.getJointId(joint)
            change = pin.SE3(Rotation.from_rotvec(moved[3:]).as_matrix(), moved[:3])
            found.jointPlacements[at] = found.jointPlacements[at] * change
        return found

    def links(self, q: np.ndarray, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        """Return where links are in the world, shape (N, 4, 4), at recorded positions of the joints, shape (N, n)."""
        model, data = self.model, self.model.createData()
        places = [model.joints[model.getJointId(joint)] for joint in self.joints]
        frames = {name: model.getFrameId(name, pin.BODY) for name in names}
        found = {name: np.empty((len(q), 4, 4)) for name in names}
        soft = np.array([self.compliance.get(joint, 0.0) for joint in self.joints])
        for row, recorded in enumerate(np.asarray(q, float)):
            still = recorded + [self.offsets.get(joint, 0.0) for joint in self.joints]
            bent = still
            for _ in range(2 if soft.any() else 0):
                gravity = pin.computeGeneralizedGravity(model, data, self._configuration(bent))
                bent = still - soft * gravity[[place.idx_v for place in places]]
            pin.framesForwardKinematics(model, data, self._configuration(bent))
            for name, frame in frames.items():
                found[name][row] = data.oMf[frame].homogeneous
        return found

    def _configuration(self, q: np.ndarray) -> np.ndarray:
        out = pin.neutral(self.model)
        for joint, value in zip(self.joints, q, strict=True):
            place = self.model.joints[self.model.getJointId(joint)]
            out[place.idx_q : place.idx_q + place.nq] = value if place.nq == 1 else (np.cos(value), np.sin(value))
        return out


def transformed(T_world_instrument: np.ndarray, T_world_link: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return points on a link, at an offset in its frame [m], in an instrument's frame, shape (N, 3)."""
    points = T_world_link[:, :3, :3] @ offset + T_world_link[:, :3, 3]
    T = np.broadcast_to(T_world_instrument, (len(points), 4, 4))
    return np.einsum("nji,nj->ni", T[:, :3, :3], points - T[:, :3, 3])
