"""Bearings that give way otherwise than along the axes of their frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.model.chain import Chain
from pincal.model.compliances import BENDING_SIZE, BearingElasticity
from pincal.model.conditions import MOMENT, Conditions, Situation
from pincal.model.effect import Candidate, Discoverable, Family, Locus, Term
from pincal.model.places import joint_index, parameters_of
from pincal.parameters import Parameter


@dataclass(frozen=True)
class ObliqueBearing(Discoverable):
    r"""Bearing whose stiff and soft directions across its axis are not those of the frame.

    Beside k_x and k_y it has :math:`\gamma_x = k_{xy} n_y, \gamma_y = k_{xy} n_x`: with all three its compliance is a
    symmetric matrix, whose principal directions are anywhere. Only with the moment frames "before" and "after", in which
    moment and tilt have the same axes.

    Attributes:
        joint: the joint.
    """

    joint: str
    name: ClassVar[str] = "oblique_bearing"
    meaning: ClassVar[str] = "the bearing tilts under load in other directions than the frame's axes"
    family: ClassVar[Family] = Family.LOAD
    uses_moments: ClassVar[bool] = True

    @property
    def locus(self) -> Locus:
        """The tilt of its bearing, which follows the moment there."""
        return Locus(self.joint, "tilt", MOMENT, cause=BearingElasticity.name)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint, where moment and tilt have the same axes."""
        if situation.chain.moment_frame != "paper":
            yield from (Candidate(cls(joint)) for joint in situation.joints)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Compliance k_xy [rad/(N m)]."""
        return parameters_of(self, self.joint, ("k_xy",), unit="rad/(N m)", size=BENDING_SIZE)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the tilt about each axis by the moment about the other."""
        assert moments is not None
        i = joint_index(chain, self.joint)
        pairs = ("gamma_x", 3 * i + 1), ("gamma_y", 3 * i)
        return tuple(Term(0, chain.joint(i, symbol), moments[:, m], m) for symbol, m in pairs)
