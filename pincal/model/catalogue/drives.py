"""Effects of a drive: errors of gear, encoder and bearing that do not depend on the load."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from pincal.errors import BadInputError
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet
from pincal.model.effect import Candidate, Discoverable, Effect, Locus, Term
from pincal.model.effect_bases import (
    GROWTH,
    PLAY,
    RATIO,
    TILT,
    WAVE,
    DriveEffect,
    DriveHarmonic,
    drive_unit,
    parameters_of,
    positions,
    tilt_terms,
    waves,
)
from pincal.parameters import Parameter

Order = Literal[1, 2]
WobbleFrame = Literal["before", "after"]
ORDERS: tuple[Order, ...] = get_args(Order)
WOBBLE_FRAMES: tuple[WobbleFrame, ...] = ("before", "after")


def _check_order(effect: Effect, joint: str, order: int) -> None:
    if order not in ORDERS:
        raise BadInputError(f"{effect.name} of {joint}: order {order}; expected 1 or 2")


@dataclass(frozen=True)
class GearEccentricity(DriveHarmonic):
    r"""An eccentric (order 1) or elliptical (order 2) wheel: the joint turns by
    :math:`s \sin kq + c \cos kq` more.

    Over much less than a revolution, order 1 resembles an offset, a ratio and a compensator
    together.

    Distinguished by:
        poses over a full revolution; a second payload, if gravity has the same sine. The two orders
        together are equivalent to a gravity compensator; higher orders are a transmission error.

    Source:
        Whitney, Lozinski and Rourke (1986); Judd and Knasinski (1990).

    Attributes:
        joint: the joint, a revolute one.
        order: k, cycles per revolution.
    """

    order: Order = 1
    name: ClassVar[str] = "gear_eccentricity"
    meaning: ClassVar[str] = (
        "a gear wheel is eccentric or elliptical: a sinusoidal joint error, once or twice "
        "per revolution"
    )
    pattern: ClassVar[str] = "eccentric_{wave}{order}"
    typical: ClassVar[float] = WAVE

    def __post_init__(self) -> None:
        _check_order(self, self.joint, self.order)

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        yield from (
            Candidate(cls(joint, order)) for joint in situation.revolute for order in ORDERS
        )


@dataclass(frozen=True)
class GearRatio(DriveEffect):
    """Relative error r of a gear or encoder ratio: r q is added to the joint position.

    Distinguished by:
        poses over a full revolution: over a part of it a sine and a straight line are similar. A
        position repeated after a revolution shows a ratio at once.

    Source:
        Judd and Knasinski (1990).
    """

    name: ClassVar[str] = "gear_ratio"
    meaning: ClassVar[str] = "the joint moves too far or not far enough by a constant factor"
    symbol: ClassVar[str] = "ratio"
    unit: ClassVar[str] = "1"
    typical: ClassVar[float] = RATIO


@dataclass(frozen=True)
class JointCoupling(DriveEffect):
    """Coupling of one joint into another: c q_source is added to the position of ``joint``.

    Distinguished by:
        moving each joint without the other; where both move together it resembles a ratio.

    Source:
        Whitney, Lozinski and Rourke (1986).
    """

    source: str
    name: ClassVar[str] = "joint_coupling"
    meaning: ClassVar[str] = "the motion of one joint moves another"
    typical: ClassVar[float] = RATIO

    @property
    def locus(self) -> Locus:
        return Locus(self.joint, "drive", self.source)

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        robot = situation.chain.robot
        joints = [(situation.index(joint), joint) for joint in situation.joints]
        yield from (
            Candidate(cls(joint, source))
            for i, joint in joints
            for k, source in joints
            if robot.carries(i, k) or robot.carries(k, i)
        )

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """The leak over the motion [1], or rad/m and m/rad between revolute and
        prismatic joints.
        """
        units = drive_unit(chain, self.joint), drive_unit(chain, self.source)
        unit = "1" if units[0] == units[1] else "/".join(units)
        return parameters_of(self, self.joint, (f"coupling_{self.source}",), unit=unit, size=RATIO)

    def variable(self, chain: Chain, conditions: Conditions) -> np.ndarray:
        return positions(chain, conditions, self.source)


@dataclass(frozen=True)
class AxisWobble(Discoverable):
    r"""A bearing whose axis tilts about x and y as it turns: each by :math:`s \sin kq + c \cos kq`.

    The tilt acts before q (on s_x, s_y), where a constant tilt is the axis distortion and a tilt
    fixed to the link is a circle of order 1. Hence the forward circle of order 1 before q (two of
    four parameters) duplicates constant geometry of the link, and the stationary circle of order 1
    after q duplicates s_x, s_y. In cycles per revolution seen from the previous link, "before"
    spans :math:`\pm k` and "after" :math:`1 \pm k`: (1, after) is part of (2, before), (1, before)
    of (2, after). The axis tilts about the bearing: at its position on the axis, in the paper the
    foot of the common normal.

    Distinguished by:
        moving the joint alone in many small steps, with one target far off its axis and one close
        to it: a wobble moves both, a drive error only the far one. Orientation (6D) shows it
        directly.

    Source:
        tilt error motion of ISO 230-7.

    Attributes:
        joint: the joint, a revolute one.
        order: k, cycles per revolution.
        frame: whether the tilt is seen from the previous link ("before") or from the moving one
            ("after").
    """

    joint: str
    order: Order = 2
    frame: WobbleFrame = "before"
    name: ClassVar[str] = "axis_wobble"
    meaning: ClassVar[str] = "the axis tilts periodically as the joint turns"

    def __post_init__(self) -> None:
        _check_order(self, self.joint, self.order)
        if self.frame not in WOBBLE_FRAMES:
            raise BadInputError(
                f"{self.name} of {self.joint}: frame {self.frame!r}; expected before or after"
            )

    @property
    def locus(self) -> Locus:
        return Locus(self.joint, "tilt", self.joint, order=self.order, frame=self.frame)

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        for joint in situation.revolute:
            yield from (
                Candidate(cls(joint, order, frame)) for order in ORDERS for frame in WOBBLE_FRAMES
            )

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Amplitudes of sine and cosine about x, then about y [rad]."""
        kind = "wobble" if self.frame == "before" else "wobble_after"
        symbols = [f"{kind}_{axis}_{wave}{self.order}" for axis in "xy" for wave in ("sin", "cos")]
        return parameters_of(self, self.joint, symbols, unit="rad", size=TILT)

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        both = waves(self.order * positions(chain, conditions, self.joint))
        tilts = [(2 * axis + p, axis, wave) for axis in range(2) for p, wave in enumerate(both)]
        return tilt_terms(chain, conditions, self.joint, seen_from=self.frame, tilts=tilts)


@dataclass(frozen=True)
class Backlash(DriveEffect):
    """Backlash of a gear: b times the direction of approach (-1, 0, 1) is added to the joint
    position.

    A joint that lags behind its drive by half the backlash has b = - backlash / 2.

    Distinguished by:
        reaching each pose from both directions, recorded in `approach_<joint>`. A payload
        distinguishes backlash from hysteresis, which grows with the load.

    Source:
        Slamani, Nubiola and Bonev (2012).
    """

    name: ClassVar[str] = "backlash"
    meaning: ClassVar[str] = (
        "backlash: the joint stops short, depending on the direction of approach"
    )
    symbol: ClassVar[str] = "backlash"
    typical: ClassVar[float] = PLAY
    follows: ClassVar[str] = "approach"
    recorded_as: ClassVar[str] = "approach_<joint>"


@dataclass(frozen=True)
class ShortOfTarget(DriveEffect):
    """Drive that has not settled when it is measured: c times the last move is added to the joint
    position.

    A joint that falls short of its target by a fraction of its move has c < 0.

    Distinguished by:
        reaching each pose from both directions by long and short moves, rows in the order of
        measurement (`--rows-in-order`, or a column `time`): backlash does not depend on the
        distance moved. A pause before each reading eliminates it.

    Source:
        position stabilization time and overshoot in ISO 9283.
    """

    name: ClassVar[str] = "settling"
    meaning: ClassVar[str] = (
        "the joint has not settled: it falls short by a fraction of its last move"
    )
    symbol: ClassVar[str] = "settling"
    unit: ClassVar[str] = "1"
    typical: ClassVar[float] = RATIO
    follows: ClassVar[str] = "move"
    recorded_as: ClassVar[str] = "time (or --rows-in-order)"


@dataclass(frozen=True)
class ThermalOffset(DriveEffect):
    """Joint offset that shifts with temperature: by c (T - reference).

    Distinguished by:
        the same poses cold and warm, with the temperature recorded. Thermal expansion moves the
        target along the arm, an offset shift moves it across.

    Source:
        Heisel, Richter and Wurst (1997).

    Attributes:
        joint: the joint.
        reference: temperature without shift [deg C]; another value only changes the joint offset.
    """

    reference: float = 20.0
    name: ClassVar[str] = "thermal_offset"
    meaning: ClassVar[str] = "the joint offset changes with temperature"
    typical: ClassVar[float] = GROWTH
    follows: ClassVar[str] = "temperature"
    recorded_as: ClassVar[str] = "temperature"

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Shift [rad/K or m/K]."""
        unit = f"{drive_unit(chain, self.joint)}/K"
        return parameters_of(self, self.joint, ("offset_T",), unit=unit, size=self.typical)

    def variable(self, chain: Chain, conditions: Conditions) -> np.ndarray:
        return super().variable(chain, conditions) - self.reference


@dataclass(frozen=True)
class ServoDroop(DriveEffect):
    """Steady-state position error: p (commanded - read back) is added to the fitted joint position.

    If the positions read back are fitted, p is 0 if the encoder measures all of the error and 1 if
    the joint is where it was commanded; if the commanded ones are fitted, p is -1 if the encoder
    measures all of it. An error proportional to the torque resembles linear elasticity; friction
    and integral action distinguish them.

    Distinguished by:
        commanded and read positions, both recorded (`commanded_<joint>` or `read_<joint>`), with
        two payloads: the steady-state error of a controller without integral action is proportional
        to the load, like elasticity.

    Source:
        steady-state error of position control, Siciliano et al. (2009), section 8.5.
    """

    name: ClassVar[str] = "servo_droop"
    meaning: ClassVar[str] = (
        "steady-state position error: the joint rests between the commanded and the "
        "read-back position"
    )
    symbol: ClassVar[str] = "droop"
    unit: ClassVar[str] = "1"
    typical: ClassVar[float] = PLAY
    follows: ClassVar[str] = "droop"
    recorded_as: ClassVar[str] = "commanded_<joint> (or read_<joint>)"
