"""Static equilibrium of the true machine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.chain import configurations, gravity_loads, place
from pincal.simulate.effect import DeformingEffect
from pincal.simulate.state import Deformation, Loads, Poses, no_deformation, no_loads

# Change of the deformation in one round below which the arm is at rest [rad and m]; far below any
# measurement.
_AT_REST = 1e-12
# A round gains about three digits on an industrial arm, so that many more than five mean that it collapses.
_ROUNDS = 100


@dataclass(frozen=True)
class Equilibrium:
    """The arm at rest under gravity.

    Attributes:
        tip: Transform from the tip to the undeformed base frame, shape (N, 4, 4).
        deformation: What all effects add up to.
        loads: Gravity loads on the deformed arm.
    """

    tip: np.ndarray
    deformation: Deformation
    loads: Loads


@dataclass(frozen=True)
class Settler:
    """What it takes to let an arm come to rest.

    Attributes:
        arm: The true arm without load.
        chain: Its ``pinocchio.Model`` of :func:`pincal.simulate.chain.build_chain`.
        data: The ``pinocchio.Data`` of the chain.
        effects: What deforms it.
        gravity: Acceleration in the base frame [m/s^2], shape (3,).
    """

    arm: Arm
    chain: Any
    data: Any
    effects: tuple[DeformingEffect, ...]
    gravity: np.ndarray

    def settle(self, poses: Poses, q: np.ndarray) -> Equilibrium:
        """Deform the arm under the loads that it has when it is deformed.

        Args:
            poses: Poses and conditions, with the payload that is really carried.
            q: Joint positions without deformation [rad or m], shape (N, n).

        Returns:
            The arm at rest in every pose.

        Raises:
            BadInputError: If the arm is too soft to carry itself.
        """
        deformation = self._deformed(poses, no_loads(*q.shape))
        for _ in range(_ROUNDS):
            places = place(self.chain, self.data, configurations(q, deformation))
            loads = gravity_loads(
                self.arm, places, payload=poses.payload, payload_com=poses.payload_com, gravity=self.gravity
            )
            settled = self._deformed(poses, loads)
            if _change(settled, deformation) < _AT_REST:
                return Equilibrium(tip=places[:, -1], deformation=deformation, loads=loads)
            deformation = settled
        raise BadInputError(f"the arm does not come to rest in {_ROUNDS} rounds; use a smaller compliance")

    def _deformed(self, poses: Poses, loads: Loads) -> Deformation:
        deformation = no_deformation(*poses.q.shape)
        for effect in self.effects:
            effect.deform(self.arm, poses, loads, deformation)
        return deformation


def _change(new: Deformation, old: Deformation) -> float:
    """Return the largest change of any component of a deformation."""
    arrays = ("joint", "before", "after", "base", "tip")
    return max(float(np.abs(getattr(new, name) - getattr(old, name)).max(initial=0.0)) for name in arrays)
