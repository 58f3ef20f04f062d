r"""Effects of motion: clock offsets, joints that lag, drives wound up by friction.

All of them depend on the joints' velocities and vanish at rest, so that a calibration from motion
applies to held poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.errors import BadInputError
from pincal.model.catalogue.drives import ORDERS, GearEccentricity
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect, Family, Locus, Term
from pincal.model.effect_bases import PLAY, DriveInMotion, recorded
from pincal.model.effects import JointElasticity
from pincal.parameters import ANYWHERE, Parameter, Scope
from pincal.robot.robot import Robot
from pincal.thresholds import Scale

# Typical size of a servo's delay [s].
_LAG: Scale = 1e-3


@dataclass(frozen=True)
class InstrumentClock(Effect):
    r"""The instrument's clock is offset from the joints' clock: its reading belongs to the pose at
    a later time.

    A reading at time t belongs to the joints at :math:`t + \tau_0 + \tau_1 (t - t_m)`, so that
    :math:`\dot q_j` times the difference is added to every drive, to first order: the times are
    synchronised to a millisecond beforehand. Like the pose of the instrument it is unconstrained.
    Where one of the clocks steps, as when a counted sample is lost, later readings belong to times
    that are later by each step.

    Distinguished by:
        motions that start and stop. An offset equals the same lag of all joints.

    Source:
        pincal's own; temporal calibration as in Furgale, Rehder and Siegwart (2013).

    Attributes:
        middle: time t_m about which the clock drifts [s]; the middle of a session is well
            conditioned.
        drifts: whether it also runs at another rate.
        steps: stamps of the first readings after steps of one of the clocks [s].
    """

    middle: float = 0.0
    drifts: bool = True
    steps: tuple[float, ...] = ()
    name: ClassVar[str] = "instrument_clock"
    meaning: ClassVar[str] = "the instrument's clock differs from that of the joints"
    family: ClassVar[Family] = Family.EXTRINSICS
    scope: ClassVar[Scope] = "station"
    locus: ClassVar[Locus] = Locus(acts_on="clock", follows="velocity")

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Offset [s], drift [1] and steps [s]."""
        symbols = [("offset", "s"), ("drift", "1")][: 1 + self.drifts]
        symbols += [(f"step_{k}", "s") for k in range(1, len(self.steps) + 1)]
        return tuple(
            Parameter(f"clock.{symbol}", unit, self.name, 0.0, ANYWHERE) for symbol, unit in symbols
        )

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        if conditions.velocity is None:
            return ()
        since = [np.ones(len(conditions))]
        if self.drifts:
            since.append(recorded(self, "time", conditions.time) - self.middle)
        for step in self.steps:
            since.append((recorded(self, "time", conditions.time) >= step).astype(float))
        pairs = zip(chain.drives.tolist(), conditions.velocity.T, strict=True)
        return tuple(
            Term(p, k, way * t) for k, way in pairs for p, t in enumerate(since) if way.any()
        )


@dataclass(frozen=True)
class JointLag(DriveInMotion):
    r"""Joint that reaches its recorded position with a delay: :math:`-\tau \dot q` is added to its
    position.

    An equal lag of all joints is an offset of the instrument's clock; differences between joints
    are due to encoders that are read one after the other, or to velocity errors of position loops.

    Distinguished by:
        the same path at two speeds and in both directions: a lag grows with the speed, friction
        does not.

    Source:
        velocity error of position control, Siciliano et al. (2009), section 8.3.
    """

    name: ClassVar[str] = "joint_lag"
    meaning: ClassVar[str] = "the joint follows its recorded position with a delay"
    symbol: ClassVar[str] = "lag"
    unit: ClassVar[str] = "s"
    typical: ClassVar[float] = _LAG

    def of_velocity(self, velocity: np.ndarray) -> np.ndarray:
        return -velocity


@dataclass(frozen=True)
class FrictionWindup(DriveInMotion):
    r"""Drive that is wound up by its own friction, against the direction of motion:
    :math:`-c \tanh(\dot q / v)`.

    Distinguished by:
        the same path at two speeds and in both directions: it changes sign with the direction and
        hardly with the speed. In held poses it is hysteresis, which depends on the direction of
        approach.

    Source:
        Coulomb friction behind a compliant gear, Ruderman, Hoffmann and Bertram (2009).

    Attributes:
        joint: the joint.
        slow: speed v over which friction changes sign [rad/s or m/s].
    """

    slow: float = 0.02
    name: ClassVar[str] = "friction_windup"
    meaning: ClassVar[str] = "friction winds the drive up against the direction of motion"
    symbol: ClassVar[str] = "friction_windup"
    typical: ClassVar[float] = PLAY

    def __post_init__(self) -> None:
        if not self.slow > 0.0:
            raise BadInputError(
                f"friction_windup of {self.joint}: slow {self.slow} rad/s; expected more than 0"
            )

    def of_velocity(self, velocity: np.ndarray) -> np.ndarray:
        return -np.tanh(velocity / self.slow)


def with_drives(robot: Robot, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return effects with the usual errors of drives, which an IMU alone would confuse with offsets
    of parallel joints.

    These are compliance of the drives if masses are known, eccentric gears, and friction, each
    constrained by its prior.
    """
    revolute = [
        name
        for name, kind in zip(robot.joint_names, robot.joint_types, strict=True)
        if kind == "revolute"
    ]
    is_rigid = robot.massless or any(isinstance(effect, JointElasticity) for effect in effects)
    more: tuple[Effect, ...] = (
        *(() if is_rigid else (JointElasticity(),)),
        *(GearEccentricity(joint, order) for joint in revolute for order in ORDERS),
        *(FrictionWindup(joint) for joint in robot.joint_names),
    )
    return (*effects, *(effect for effect in more if effect not in effects))
