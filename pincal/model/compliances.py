"""Linear compliance, which every arm has: drives are compliant about their axes and bearings across them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Self, final

import numpy as np

from pincal.model.chain import Chain
from pincal.model.conditions import MOMENT, UNFELT, Conditions, PoseSet
from pincal.model.effect import Candidate, Discoverable, Family, Locus, Term
from pincal.model.loops import inert_coordinates
from pincal.parameters import Parameter

# Size of real elastic rotations [rad], used as prior where the data can't tell.
BENDING_SIZE = 1e-3


@dataclass(frozen=True)
class Compliance(Discoverable):
    """Elastic rotations that follow the static moments of some joints (paper, III.B).

    Attributes:
        joints: the joints; default: all.
        acts_on: what of a joint is compliant.
        axes: about which it does, "x", "y" and "z" that of the joint.
    """

    joints: tuple[str, ...] | None = None
    family: ClassVar[Family] = Family.ELASTICITY
    uses_moments: ClassVar[bool] = True
    acts_on: ClassVar[str]
    axes: ClassVar[str]

    @property
    def least_moment(self) -> float:
        """None of one joint alone: where it is all that is compliant, the data see it."""
        return super().least_moment if self.only is None else 0.0

    @property
    def locus(self) -> Locus:
        """The elastic rotations of its joints, which follow the moments there."""
        return Locus(self.only, self.acts_on, MOMENT)

    @property
    def only(self) -> str | None:
        """The joint, if it is one alone."""
        return self.joints[0] if self.joints is not None and len(self.joints) == 1 else None

    @final
    def parts(self, chain: Chain) -> tuple[Self, ...]:
        """Return the compliance of each joint by itself."""
        return tuple(replace(self, joints=(joint,)) for joint in self.joints or chain.robot.measured_joints)

    @final
    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """The compliances of each joint [rad/(N m)]."""
        return tuple(
            Parameter(f"{chain.robot.joint_names[i]}.k_{axis}", "rad/(N m)", self.name, 0.0, BENDING_SIZE)
            for i, axis, _ in self._places(chain)
        )

    @final
    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add compliance times moment to the elastic rotations."""
        assert moments is not None
        return tuple(
            Term(p, k, moments[:, moment], moment)
            for p, (i, axis, k) in enumerate(self._places(chain))
            for moment in (3 * i + "xyz".index(axis),)
        )

    def _places(self, chain: Chain) -> list[tuple[int, str, int]]:
        """Return joint, axis and coordinate, those left out that loops make meaningless."""
        names, inert = chain.robot.joint_names, inert_coordinates(chain)
        joints = [names.index(name) for name in (chain.robot.measured_joints if self.joints is None else self.joints)]
        places = [(i, axis, chain.joint(i, f"gamma_{axis}")) for i in joints for axis in self.axes]
        return [place for place in places if place[2] not in inert]


@dataclass(frozen=True)
class JointElasticity(Compliance):
    """Each drive is compliant about its own axis: gamma_z = k_z n_z.

    Distinguished by:
        two payloads in the same poses: deflection grows with the load. With one load a gravity compensator, a gear
        eccentricity of order 1 or an error of the masses looks similar.

    Source:
        Radkhah et al., Eq. (3); Whitney, Lozinski and Rourke (1986).
    """

    name: ClassVar[str] = "joint_elasticity"
    meaning: ClassVar[str] = "the drive twists under the load on its axis"
    acts_on: ClassVar[str] = "gamma_z"
    axes: ClassVar[str] = "z"

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield the elasticity of all drives that these poses load.

        About a vertical axis gravity has a moment only as far as the base is not level. Any tilt goes, since the base's own
        makes up for it, so that such a compliance could take the place of a true effect of that joint's position.
        """
        heaviest = UNFELT * np.abs(situation.moments).max(initial=0.0)
        joints = situation.joints
        felt = tuple(joint for joint in joints if np.abs(situation.moment(joint)).max(initial=0.0) > heaviest)
        yield Candidate(cls() if len(felt) == len(joints) else cls(felt))


@dataclass(frozen=True)
class BearingElasticity(Compliance):
    r"""Each bearing is compliant across its axis: gamma_x = k_x n_x, gamma_y = k_y n_y.

    With the paper's moment frame it acts exactly as there: about the origin of the Denavit-Hartenberg frame, whose place is
    a convention. With "before" and "after" the moment is taken and the link rotates at the bearing, at the height h on
    its axis.

    Distinguished by:
        payloads, and poses in which the load acts across the axis. That of joint 1 resembles a compliant foundation.

    Source:
        Radkhah et al., Eq. (3); Nubiola and Bonev (2013) for joints alone.
    """

    name: ClassVar[str] = "bearing_elasticity"
    meaning: ClassVar[str] = "the bearing tilts under load across its axis"
    acts_on: ClassVar[str] = "tilt"
    axes: ClassVar[str] = "xy"

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield the elasticity of all bearings."""
        yield Candidate(cls())
