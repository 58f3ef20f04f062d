"""Effects of a drive: what gear, encoder and bearing add to a joint's position, whatever the load."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from pincal.errors import BadInputError
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, Situation
from pincal.model.effect import Candidate, Discoverable, Effect, Locus, Term
from pincal.model.places import (
    GROWTH,
    PLAY,
    RATIO,
    TILT,
    WAVE,
    drive_terms,
    drive_unit,
    joint_index,
    parameters_of,
    positions,
    recorded,
    tilt_terms,
    waves,
)
from pincal.parameters import Parameter

Order = Literal[1, 2]
WobbleFrame = Literal["before", "after"]
ORDERS: tuple[Order, ...] = (1, 2)
WOBBLE_FRAMES: tuple[WobbleFrame, ...] = ("before", "after")


def _check_order(effect: Effect, joint: str, order: int) -> None:
    if order not in ORDERS:
        raise BadInputError(f"{effect.name} of {joint}: order {order}; expected 1 or 2")


@dataclass(frozen=True)
class GearEccentricity(Discoverable):
    r"""An eccentric (order 1) or elliptical (order 2) wheel: the joint turns by :math:`s \sin kq + c \cos kq` more.

    Over much less than a turn order 1 is like an offset, a ratio and a compensator together.

    Told apart by:
        poses over a full turn; a second payload, where gravity follows the same sine. Two orders together are a gravity
        compensator; finer waves are a transmission error.

    Source:
        Whitney, Lozinski and Rourke (1986); Judd and Knasinski (1990).

    Attributes:
        joint: the joint, a revolute one.
        order: k, errors a turn.
    """

    joint: str
    order: Order = 1
    name: ClassVar[str] = "gear_eccentricity"
    meaning: ClassVar[str] = "a gear wheel is off centre or oval: the joint errs in a wave, once or twice a turn"

    def __post_init__(self) -> None:
        """Refuse other orders."""
        _check_order(self, self.joint, self.order)

    @property
    def locus(self) -> Locus:
        """The drive, in waves of its own position."""
        return Locus(self.joint, "drive", self.joint, order=self.order)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield both orders on every joint that turns."""
        yield from (Candidate(cls(joint, order)) for joint in situation.revolute for order in ORDERS)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Amplitudes s and c [rad]."""
        symbols = (f"eccentric_sin{self.order}", f"eccentric_cos{self.order}")
        return parameters_of(self, self.joint, symbols, unit="rad", size=WAVE)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add sine and cosine of the joint's angle to its drive."""
        return drive_terms(chain, self.joint, waves(self.order * positions(chain, conditions, self.joint)))


@dataclass(frozen=True)
class GearRatio(Discoverable):
    """Gear or encoder ratio that is off: the joint moves by r q more, r relative.

    Told apart by:
        poses over a full turn: over a part of it a sine and a straight line are alike. A position that repeats after a turn
        shows a ratio at once.

    Source:
        Judd and Knasinski (1990).
    """

    joint: str
    name: ClassVar[str] = "gear_ratio"
    meaning: ClassVar[str] = "the joint turns by a fixed part too far or too short"

    @property
    def locus(self) -> Locus:
        """The drive, in proportion to its own position."""
        return Locus(self.joint, "drive", self.joint)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint."""
        yield from (Candidate(cls(joint)) for joint in situation.joints)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Relative error of the ratio [1]."""
        return parameters_of(self, self.joint, ("ratio",), unit="1", size=RATIO)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the joint's position to its drive."""
        return drive_terms(chain, self.joint, (positions(chain, conditions, self.joint),))


@dataclass(frozen=True)
class JointCoupling(Discoverable):
    """Motion of one joint that leaks into another: ``joint`` moves by c q_source more.

    Told apart by:
        the two joints moved one without the other; in programs that move both together it is like a ratio.

    Source:
        Whitney, Lozinski and Rourke (1986).
    """

    joint: str
    source: str
    name: ClassVar[str] = "joint_coupling"
    meaning: ClassVar[str] = "moving one joint drags another along"

    @property
    def locus(self) -> Locus:
        """The drive, in proportion to the position of the source."""
        return Locus(self.joint, "drive", self.source)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint, from every other."""
        yield from (
            Candidate(cls(joint, source)) for joint in situation.joints for source in situation.joints if source != joint
        )

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """The leak over the motion [1], or rad/m and m/rad between joints that turn and slide."""
        units = drive_unit(chain, self.joint), drive_unit(chain, self.source)
        unit = "1" if units[0] == units[1] else "/".join(units)
        return parameters_of(self, self.joint, (f"coupling_{self.source}",), unit=unit, size=RATIO)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the source's position to the joint's drive."""
        return drive_terms(chain, self.joint, (positions(chain, conditions, self.source),))


@dataclass(frozen=True)
class AxisWobble(Discoverable):
    r"""A bearing whose axis tilts about x and y as it turns: each by :math:`s \sin kq + c \cos kq`.

    The tilt acts before q (on s_x, s_y), where a constant tilt is the axis distortion and where a tilt fixed to the link is
    a circle of order 1. So of order 1 before q that circle (two of four parameters) repeats constant geometry of the link,
    and of order 1 after q the circle that stands still repeats s_x, s_y. As circles a turn seen from the previous link,
    "before" spans :math:`\pm k` and "after" :math:`1 \pm k`: (1, after) is part of (2, before), (1, before) of (2, after).
    The axis tilts about the bearing: where the chain has it on the axis, in the paper the foot of the common normal.

    Told apart by:
        the joint turned alone, by many small steps, with a target far off its axis and one close to it: a wobble moves both,
        a drive error only the far one. Orientation (6D) shows it directly.

    Source:
        tilt error motion of ISO 230-7.

    Attributes:
        joint: the joint, a revolute one.
        order: k, waves a turn.
        frame: whether the tilt is seen from the previous link ("before") or from the turning one ("after").
    """

    joint: str
    order: Order = 2
    frame: WobbleFrame = "before"
    name: ClassVar[str] = "axis_wobble"
    meaning: ClassVar[str] = "the axis tilts to and fro as the joint turns"

    def __post_init__(self) -> None:
        """Refuse other orders and frames."""
        _check_order(self, self.joint, self.order)
        if self.frame not in WOBBLE_FRAMES:
            raise BadInputError(f"{self.name} of {self.joint}: frame {self.frame!r}; expected before or after")

    @property
    def locus(self) -> Locus:
        """The axis, in waves of the joint's own position."""
        return Locus(self.joint, "tilt", self.joint, order=self.order, frame=self.frame)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield both orders, seen from both sides, on every joint that turns."""
        for joint in situation.revolute:
            yield from (Candidate(cls(joint, order, frame)) for order in ORDERS for frame in WOBBLE_FRAMES)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Amplitudes of sine and cosine about x, then about y [rad]."""
        kind = "wobble" if self.frame == "before" else "wobble_after"
        symbols = [f"{kind}_{axis}_{wave}{self.order}" for axis in "xy" for wave in ("sin", "cos")]
        return parameters_of(self, self.joint, symbols, unit="rad", size=TILT)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Tilt the axis by sines and cosines."""
        both = waves(self.order * positions(chain, conditions, self.joint))
        tilts = [(2 * axis + p, axis, wave) for axis in range(2) for p, wave in enumerate(both)]
        return tilt_terms(chain, conditions, self.joint, seen_from=self.frame, tilts=tilts)


@dataclass(frozen=True)
class Backlash(Discoverable):
    """Play in a gear: the joint moves by b times its direction of approach (-1, 0, 1) more.

    A joint that lags behind its drive by half the play has b = - play / 2.

    Told apart by:
        each pose reached from both sides, and the side recorded (`approach_<joint>`). A payload decides between play and
        hysteresis, which grows with the load.

    Source:
        Slamani, Nubiola and Bonev (2012).
    """

    joint: str
    name: ClassVar[str] = "backlash"
    meaning: ClassVar[str] = "play: the joint stops short, depending on the side from which it came"

    @property
    def locus(self) -> Locus:
        """The drive, by the direction from which it arrived."""
        return Locus(self.joint, "drive", "approach")

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint."""
        yield from (Candidate(cls(joint)) for joint in situation.joints)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Shift after an approach in positive direction [rad or m]."""
        return parameters_of(self, self.joint, ("backlash",), unit=drive_unit(chain, self.joint), size=PLAY)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the direction of approach to the joint's drive."""
        approach = recorded(self, f"approach_{self.joint}", conditions.approach)
        return drive_terms(chain, self.joint, (approach[:, joint_index(chain, self.joint)],))


@dataclass(frozen=True)
class ShortOfTarget(Discoverable):
    """Drive that has not come to rest when it is measured: the joint moves by c times its last move more.

    A joint that is still short of its target by a share of the way it came has c < 0.

    Told apart by:
        each pose reached from both sides by long and by short moves, rows in the order of measurement (`--rows-in-order`, or
        a column `time`): play does not depend on how far the joint came. A pause before each reading does away with it.

    Source:
        position stabilisation time and overshoot in ISO 9283.
    """

    joint: str
    name: ClassVar[str] = "settling"
    meaning: ClassVar[str] = "the joint has not come to rest: it is short of its target by a share of its last move"

    @property
    def locus(self) -> Locus:
        """The drive, in proportion to its last move."""
        return Locus(self.joint, "drive", "move")

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint."""
        yield from (Candidate(cls(joint)) for joint in situation.joints)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Share of the last move by which the joint is further [1]."""
        return parameters_of(self, self.joint, ("settling",), unit="1", size=RATIO)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the last move to the joint's drive."""
        move = recorded(self, "time (or the word that rows stand in order, --rows-in-order)", conditions.move)
        return drive_terms(chain, self.joint, (move[:, joint_index(chain, self.joint)],))


@dataclass(frozen=True)
class ThermalOffset(Discoverable):
    """Zero of a joint that shifts with temperature: by c (T - reference).

    Told apart by:
        the same poses cold and warm, and the temperature recorded. Links that grow move the target along the arm, a zero
        that shifts moves it across.

    Source:
        Heisel, Richter and Wurst (1997).

    Attributes:
        joint: the joint.
        reference: temperature without shift [deg C]; another one only changes the joint offset.
    """

    joint: str
    reference: float = 20.0
    name: ClassVar[str] = "thermal_offset"
    meaning: ClassVar[str] = "the joint's zero moves with temperature"

    @property
    def locus(self) -> Locus:
        """The drive, in proportion to the temperature."""
        return Locus(self.joint, "drive", "temperature")

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint."""
        yield from (Candidate(cls(joint)) for joint in situation.joints)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Shift [rad/K or m/K]."""
        unit = f"{drive_unit(chain, self.joint)}/K"
        return parameters_of(self, self.joint, ("offset_T",), unit=unit, size=GROWTH)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the temperature to the joint's drive."""
        temperature = recorded(self, "temperature", conditions.temperature)
        return drive_terms(chain, self.joint, (temperature - self.reference,))
