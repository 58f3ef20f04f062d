"""A custom effect: a hose that is too short. Wound up by one joint, it pulls at the next, which turns by p q^2 more.

Every command takes it: ``pincal discover robot.urdf tracker.csv --plugin hose_pull.py --out results``
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pincal import Conditions, register_effect
from pincal.model.chain import Chain
from pincal.model.conditions import PoseSet
from pincal.model.effect import Candidate, Discoverable, Locus, Term
from pincal.parameters import Parameter


@register_effect
@dataclass(frozen=True)
class HosePull(Discoverable):
    """The joint turns by p q_wound^2 more, as the hose stretches with the square of the angle that winds it up."""

    joint: str
    wound: str
    name = "hose_pull"
    meaning = "a hose that is too short pulls at the joint when another one winds it up"
    locus = property(lambda self: Locus(self.joint, "drive", follows=self.wound))

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield the hose at every joint, wound up by the one before it."""
        yield from (Candidate(cls(joint, wound)) for wound, joint in pairwise(situation.joints))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Turn of the joint at one radian of winding [rad]; ``size`` says how far it may move the joint at all."""
        return (Parameter(f"{self.joint}.hose", "rad", self.name, nominal=0.0, size=1e-3),)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add to the coordinate that the joint drives."""
        q = conditions.q[:, chain.robot.joint_names.index(self.wound)]
        return (Term(0, int(chain.drives[chain.robot.joint_names.index(self.joint)]), q**2),)
