"""Properties of a compliant bearing beyond k_x and k_y: oblique principal directions, and its
position on the axis.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.model.chain import Chain, MomentFrame
from pincal.model.conditions import MOMENT, Conditions
from pincal.model.effect import Effect, Family, Locus, Term
from pincal.model.effect_bases import joint_index, parameters_of
from pincal.model.effects import BENDING_SIZE, BearingElasticity
from pincal.parameters import Parameter


@dataclass(frozen=True)
class ObliqueBearing(Effect):
    r"""Bearing whose principal compliance directions are not those of the frame.

    In addition to k_x and k_y, :math:`\gamma_x = k_{xy} n_y, \gamma_y = k_{xy} n_x`: together they
    form a symmetric compliance matrix with any principal directions. Not in the paper's frame,
    where moment and tilt have different axes.

    Distinguished by:
        moving the joint to several positions under a constant load, or two payloads: a diagonal
        compliance stays along the frame's axes.

    Source:
        the model of Radkhah et al. with a full symmetric compliance instead of a diagonal one.

    Attributes:
        joint: the joint.
    """

    joint: str
    family: ClassVar[Family] = Family.ELASTICITY
    name: ClassVar[str] = "oblique_bearing"
    meaning: ClassVar[str] = (
        "the bearing's principal compliance directions differ from the frame's axes"
    )
    uses_moments: ClassVar[bool] = True

    @property
    def locus(self) -> Locus:
        return Locus(self.joint, "tilt", MOMENT, shape="oblique", cause=BearingElasticity.name)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Compliance k_xy [rad/(N m)]."""
        return parameters_of(self, self.joint, ("k_xy",), unit="rad/(N m)", size=BENDING_SIZE)

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        assert moments is not None
        i = joint_index(chain, self.joint)
        pairs = ("gamma_x", 3 * i + 1), ("gamma_y", 3 * i)
        return tuple(Term(0, chain.joint(i, symbol), moments[:, m], m) for symbol, m in pairs)


@dataclass(frozen=True)
class BearingPlace(Effect):
    """Bearing at another position on its axis than the URDF's joint frame.

    The position of a URDF's joint frame on its axis is arbitrary; the position of a compliant
    bearing is observable.

    Distinguished by:
        as for the bearing's compliance, from poses in which moment and force at the bearing differ,
        such as with the arm stretched out and folded.

    Source:
        the model of Radkhah et al. with an unconstrained position of the bearing on its axis.

    Attributes:
        joint: the joint.
    """

    joint: str
    family: ClassVar[Family] = Family.ELASTICITY
    is_constant: ClassVar[bool] = True
    name: ClassVar[str] = "bearing_place"
    meaning: ClassVar[str] = (
        "the bearing is at another position on its axis than the URDF's joint frame"
    )

    @property
    def locus(self) -> Locus:
        return Locus(self.joint, "place", cause=BearingElasticity.name)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Place h of the bearing on the axis [m], see :mod:`pincal.model.chain`; its typical error
        is a link's size.
        """
        robot = chain.robot
        i = joint_index(chain, self.joint)
        nominal = float(chain.nominal[chain.joint(i, "h")])
        size = robot.reach / robot.n_joints
        return (Parameter(f"{self.joint}.h", "m", self.name, nominal, size),)

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        return (Term(0, chain.joint(joint_index(chain, self.joint), "h")),)


def bearing_features(chain: Chain, effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return the further effects of each compliant bearing; none in the paper's frame."""
    bearings = [
        effect
        for effect in effects
        if isinstance(effect, BearingElasticity) and chain.moment_frame != "paper"
    ]
    joints = [
        joint for bearing in bearings for joint in (bearing.joints or chain.robot.measured_joints)
    ]
    return tuple(kind(joint) for joint in joints for kind in (ObliqueBearing, BearingPlace))


def without_idle_features(
    moment_frame: MomentFrame, effects: Iterable[Effect]
) -> tuple[Effect, ...]:
    """Return effects without these features if no bearing is compliant, or in the paper's frame."""
    effects = tuple(effects)
    if moment_frame != "paper" and any(isinstance(effect, BearingElasticity) for effect in effects):
        return effects
    return tuple(
        effect for effect in effects if not isinstance(effect, ObliqueBearing | BearingPlace)
    )
