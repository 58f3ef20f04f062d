"""Inertial forces and moments on the arm, by the Newton-Euler recursion over its links."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pincal.simulate.arm import Arm, frames_in_base


class LinkMotion(NamedTuple):
    """Motion of a link in N poses, in base axes, shape (N, 3) each.

    Attributes:
        rotation: Rotation from its working frame to the base, shape (N, 3, 3).
        origin: Origin of its working frame [m].
        rate: Angular velocity [rad/s].
        turning: Angular acceleration [rad/s^2].
        acceleration: Acceleration of its origin [m/s^2].
    """

    rotation: np.ndarray
    origin: np.ndarray
    rate: np.ndarray
    turning: np.ndarray
    acceleration: np.ndarray

    def at(self, place: np.ndarray) -> np.ndarray:
        """Return the acceleration of points fixed to the link, given in its frame, shape (3,) or
        (N, 3) [m].
        """
        lever = np.einsum("nab,nb->na", self.rotation, np.broadcast_to(place, self.origin.shape))
        return (
            self.acceleration
            + np.cross(self.turning, lever)
            + np.cross(self.rate, np.cross(self.rate, lever))
        )


def link_motions(
    arm: Arm, q: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
) -> Iterator[LinkMotion]:
    """Yield the motion of each link of an undeformed arm or tree, in the order of its joints, and
    finally of the tip.

    Joint positions, velocities and accelerations are of shape (N, n) [rad or m, per s, per s^2].
    """
    places = frames_in_base(arm, q)
    still = np.zeros((len(q), 3))
    known = [LinkMotion(places[:, 0, :3, :3], places[:, 0, :3, 3], still, still, still)]
    for j, parent in enumerate((*arm.parents, arm.tip_joint)):
        _, origin, rate, turning, moved = known[parent + 1]
        way = places[:, j + 1, :3, 3] - origin
        moved = moved + np.cross(turning, way) + np.cross(rate, np.cross(rate, way))
        if j < len(arm.names):
            axis = places[:, j + 1, :3, 2]
            along = axis * velocity[:, j, None]
            faster = axis * acceleration[:, j, None]
            if arm.prismatic[j]:
                moved = moved + faster + 2.0 * np.cross(rate, along)
            else:
                turning = turning + faster + np.cross(rate, along)
                rate = rate + along
        known.append(
            LinkMotion(places[:, j + 1, :3, :3], places[:, j + 1, :3, 3], rate, turning, moved)
        )
        yield known[-1]


@dataclass(frozen=True)
class Inertia:
    """Inertial forces and couples on the arm, in base axes.

    Attributes:
        forces: At the centre of mass of each link, and last of the payload [N], shape (N, n + 1,
            3).
        couples: Likewise [N m].
    """

    forces: np.ndarray
    couples: np.ndarray

    @classmethod
    def of(
        cls, arm: Arm, motion: tuple[np.ndarray, ...], payload: np.ndarray, payload_com: np.ndarray
    ) -> Inertia | None:
        """Return the inertial loads of an arm that moves as if it did not deform; None if nothing
        moves.

        ``motion`` contains joint positions, velocities and accelerations, shape (N, n) each [rad or
        m, per s, per s^2]; the payload [kg], shape (N,), has its centre of mass in the tip frame
        [m], shape (N, 3).
        """
        if not any(part.any() for part in motion[1:]):
            return None
        forces, couples = np.zeros((2, len(payload), len(arm.names) + 1, 3))
        for j, link in enumerate(link_motions(arm, *motion)):
            if j == len(arm.names):
                forces[:, j] = -payload[:, None] * link.at(payload_com)
                break
            forces[:, j] = -arm.masses[j] * link.at(arm.centres[j])
            if arm.inertias is not None:
                turned = link.rotation @ arm.inertias[j] @ np.swapaxes(link.rotation, 1, 2)
                spin = np.einsum("nab,nb->na", turned, link.rate)
                couples[:, j] = -np.einsum("nab,nb->na", turned, link.turning) - np.cross(
                    link.rate, spin
                )
        return cls(forces, couples)
