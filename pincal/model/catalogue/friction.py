r"""What servo and friction leave behind: a drive that droops, or stops wound up.

Friction grows with the load on the teeth and opposes the last motion (Coulomb), so that a joint which arrives in direction
s stops short of where its drive stands by the wind-up under it, :math:`c \mu (m_0 + |m|)` with the moment m on its axis.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, Situation
from pincal.model.effect import Candidate, Discoverable, Family, Locus, Term
from pincal.model.places import PLAY, drive_terms, joint_index, parameters_of, recorded
from pincal.parameters import Parameter

# Moment within which friction changes smoothly as the load changes sides [N m]: less than any arm feels.
_SMOOTH = 1e-3
# Preloads that a discovery tries, over the largest moment in the poses.
_PRELOADS = (0.0, 0.3)


@dataclass(frozen=True)
class Hysteresis(Discoverable):
    """Joint that stops wound up against friction: it moves by h |n_z| times its direction of approach (-1, 0, 1) more.

    A joint that lags behind its drive has h < 0. Friction of seals and preloaded teeth, which the load does not make, is
    that of a preload: |n_z| + preload. What does not depend on the load at all is play.

    Told apart by:
        each pose reached from both sides, with two payloads, and the side recorded (`approach_<joint>`): play does not
        depend on the load.

    Source:
        Ruderman, Hoffmann and Bertram (2009).

    Attributes:
        joint: the joint.
        preload: moment that adds to the load [N m].
    """

    joint: str
    preload: float = 0.0
    name: ClassVar[str] = "hysteresis"
    meaning: ClassVar[str] = "friction under load: the joint stops wound up, depending on the side from which it came"
    family: ClassVar[Family] = Family.LOAD
    uses_moments: ClassVar[bool] = True

    @property
    def locus(self) -> Locus:
        """The drive, by the direction from which it arrived."""
        return Locus(self.joint, "drive", "approach")

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint that turns, by the load alone and with a preload."""
        for joint in situation.revolute:
            largest = float(np.abs(situation.moment(joint)).max())
            preloads = _PRELOADS if largest > 0.0 else _PRELOADS[:1]
            yield Candidate(cls(joint), variants=tuple(cls(joint, part * largest) for part in preloads))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Shift after an approach in positive direction, per moment [rad/(N m)]."""
        return parameters_of(self, self.joint, ("hysteresis",), unit="rad/(N m)", size=PLAY)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the direction of approach, times the load, to the joint's drive."""
        assert moments is not None
        i = joint_index(chain, self.joint)
        moment = 3 * i + 2
        side = recorded(self, f"approach_{self.joint}", conditions.approach)[:, i]
        load = np.hypot(moments[:, moment], _SMOOTH)
        basis = side * (load + self.preload)
        return (Term(0, int(chain.drives[i]), basis, moment, side * moments[:, moment] / load),)


@dataclass(frozen=True)
class ServoDroop(Discoverable):
    """Joint that does not stand where the fitted record has it: it moves by p (commanded - read back) more.

    Where the positions read back are fitted p is 0 if the encoder sees all of the droop, 1 if the joint stands as
    commanded after all; where the commanded ones are fitted, -1 if the encoder sees all of it. A droop in proportion to the
    torque is like linear elasticity: what friction and integrators make of it tells them apart.

    Told apart by:
        commanded and read positions, both recorded (`commanded_<joint>` or `read_<joint>`), with two payloads: the droop of
        a controller without an integrator is in proportion to the load, as elasticity is.

    Source:
        steady-state error of position control, Siciliano et al. (2009), section 8.5.
    """

    joint: str
    name: ClassVar[str] = "servo_droop"
    meaning: ClassVar[str] = "the joint stands between the position commanded and the one read back, not as fitted"

    @property
    def locus(self) -> Locus:
        """The drive, by the droop."""
        return Locus(self.joint, "drive", "droop")

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint."""
        yield from (Candidate(cls(joint)) for joint in situation.joints)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Part of the droop by which the joint is off [1]."""
        return parameters_of(self, self.joint, ("droop",), unit="1", size=PLAY)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the droop to the joint's drive."""
        droop = recorded(self, f"commanded_{self.joint} (or read_{self.joint})", conditions.droop)
        return drive_terms(chain, self.joint, (droop[:, joint_index(chain, self.joint)],))
