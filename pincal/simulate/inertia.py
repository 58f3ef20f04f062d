"""What the inertia of moving bodies exerts on the arm, by the recursion of Newton and Euler over its links."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pincal.simulate.arm import Arm
from pincal.simulate.planning import frames
from pincal.simulate.state import Poses


class LinkMotion(NamedTuple):
    """How a link moves in N poses, in the axes of the base, each of shape (N, 3).

    Attributes:
        rotation: From its working frame to the base, shape (N, 3, 3).
        origin: Of its working frame [m].
        rate: Angular velocity [rad/s].
        turning: Angular acceleration [rad/s^2].
        acceleration: Of its origin [m/s^2].
    """

    rotation: np.ndarray
    origin: np.ndarray
    rate: np.ndarray
    turning: np.ndarray
    acceleration: np.ndarray

    def at(self, place: np.ndarray) -> np.ndarray:
        """Return the acceleration of points fixed to the link, given in its frame, shape (3,) or (N, 3) [m]."""
        lever = np.einsum("nab,nb->na", self.rotation, np.broadcast_to(place, self.origin.shape))
        return self.acceleration + np.cross(self.turning, lever) + np.cross(self.rate, np.cross(self.rate, lever))


def link_motions(arm: Arm, q: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Iterator[LinkMotion]:
    """Yield the motion of each link of an arm without load, from the first to that of the tip.

    Joint positions, velocities and accelerations are of shape (N, n) [rad or m, per s, per s^2].
    """
    places = frames(arm, q)
    rate, turning, moved = np.zeros((3, len(q), 3))
    for j in range(len(arm.names) + 1):
        way = places[:, j + 1, :3, 3] - places[:, j, :3, 3]
        moved = moved + np.cross(turning, way) + np.cross(rate, np.cross(rate, way))
        if j < len(arm.names):
            axis = places[:, j + 1, :3, 2]
            along, faster = axis * velocity[:, j, None], axis * acceleration[:, j, None]
            if arm.prismatic[j]:
                moved = moved + faster + 2.0 * np.cross(rate, along)
            else:
                turning = turning + faster + np.cross(rate, along)
                rate = rate + along
        yield LinkMotion(places[:, j + 1, :3, :3], places[:, j + 1, :3, 3], rate, turning, moved)


@dataclass(frozen=True)
class Inertia:
    """Forces and couples by which moving bodies load the arm, in the axes of the base.

    Attributes:
        forces: At the centre of mass of each link and last of the payload [N], shape (N, n + 1, 3).
        couples: Likewise [N m].
    """

    forces: np.ndarray
    couples: np.ndarray

    @classmethod
    def of(cls, arm: Arm, poses: Poses) -> Inertia | None:
        """Return what the bodies of an arm exert that moves as if it did not deform; None if nothing moves."""
        if not (poses.velocity.any() or poses.acceleration.any()):
            return None
        forces, couples = np.zeros((2, len(poses.q), len(arm.names) + 1, 3))
        for j, link in enumerate(link_motions(arm, poses.q, poses.velocity, poses.acceleration)):
            if j == len(arm.names):
                forces[:, j] = -poses.payload[:, None] * link.at(poses.payload_com)
                break
            forces[:, j] = -arm.masses[j] * link.at(arm.centres[j])
            if arm.inertias is not None:
                turned = link.rotation @ arm.inertias[j] @ np.swapaxes(link.rotation, 1, 2)
                spin = np.einsum("nab,nb->na", turned, link.rate)
                couples[:, j] = -np.einsum("nab,nb->na", turned, link.turning) - np.cross(link.rate, spin)
        return cls(forces, couples)
