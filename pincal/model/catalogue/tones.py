r"""Fine waves of a joint's own position: teeth of a motor's or a stage's gear, and the lines of an encoder.

A wheel that turns k times per turn of the joint makes an error of k waves a turn (its eccentricity), and of 2 k and more
(its teeth, a strain wave gear's two lobes). An encoder whose two signals differ in size, offset or phase errs between its
lines: once and twice a line (Heydemann 1981).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pincal.errors import BadInputError
from pincal.model.chain import Chain
from pincal.model.conditions import TURN, Conditions, Situation
from pincal.model.effect import Candidate, Locus, Term, Tone
from pincal.model.places import WAVE, drive_terms, parameters_of, positions, waves
from pincal.parameters import Parameter

# Waves a turn among which a discovery looks for gear ripple: fewer are curves of the drive, more need ever more poses. The
# two lobes of a strain wave gear of 1:101 make 202 waves a turn, and twice as many.
_BAND = (20.0, 450.0)
# What stands for all orders where none is known: the ratio of a usual strain wave gear.
_USUAL, _LINES = 101.0, 1024.0
# Half of twice the log-likelihood that a wave chosen in the whole band has to gain, about (see ``independent_orders``).
_GAIN = 18.0
# Lines a turn of encoders that count in binary: powers of two, from the least that is no curve of the drive.
_BINARY = tuple(2.0**n for n in range(5, 17))
# Chance that any order is as near to what is proposed of it, above which nothing is proposed: a hint, as good as one in ten.
_BY_CHANCE = 0.1


@dataclass(frozen=True)
class GearRipple(Tone):
    r"""Motor or gear stage that turns many times a turn of the joint: it adds :math:`s \sin kq + c \cos kq`.

    Told apart by:
        many poses of this joint alone, closer together than half a wave; a ratio from the data sheet leaves one order to
        look for instead of hundreds. Noise of few poses resembles some wave. An encoder with a line, or half a line, a wave
        makes the same one.

    Source:
        Tuttle (1992); the chance of a false wave after Baluev (2008).

    Attributes:
        joint: the joint, a revolute one.
        order: k, waves a turn; a ratio need not be a whole number.
        chosen_among: independent orders among which this one was chosen by the data; 1 for one that was known.
    """

    joint: str
    order: float
    chosen_among: float = 1.0
    name: ClassVar[str] = "gear_ripple"
    meaning: ClassVar[str] = "motor or gear stage makes many small waves a turn"
    band: ClassVar[tuple[float, float] | None] = _BAND

    def __post_init__(self) -> None:
        """Refuse orders that are none."""
        _check(self)

    @property
    def locus(self) -> Locus:
        """The drive, in waves of its own position."""
        return Locus(self.joint, "drive", self.joint, order=self.order)

    @property
    def looks(self) -> float:
        """The orders among which this one was chosen."""
        return self.chosen_among

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint that turns; its order has to be searched for, or named."""
        for joint in situation.revolute:
            among = len(situation.revolute) * independent_orders(situation.positions(joint), _BAND)
            yield Candidate(cls(joint, _USUAL, among), variants=())

    def tuned(self, order: float, chosen_among: float = 1.0) -> GearRipple:
        """Return the ripple of another order."""
        return replace(self, order=order, chosen_among=chosen_among)

    @property
    def same(self) -> tuple[Tone, ...]:
        """An encoder with a line a wave, or with one every two waves."""
        return tuple(EncoderSubdivision(self.joint, order) for order in (self.order, self.order / 2.0))

    def suggested(self, resolution: float) -> Tone:
        """Return an encoder that counts in binary, if there is one of so many lines and few orders are as near to one."""
        power, _ = _binary(self.order, resolution)
        return EncoderSubdivision(self.joint, 2.0**power) if power else self

    def origin(self, order: float, resolution: float, wheels: Mapping[float, str]) -> str:
        """Return of which wheel it may be a harmonic: of those that are named, or of a usual strain wave gear."""
        known = {_USUAL: "the ratio of a usual strain wave gear"} | dict(wheels)
        near, chance = list[tuple[float, int, str]](), 1.0
        for turns, whose in known.items():
            if 2.0 * resolution < turns < order + resolution:
                chance *= 1.0 - 2.0 * resolution / turns
                times = round(order / turns)
                near.append((abs(order - times * turns), times, f"{f'{times} x ' if times > 1 else ''}{turns:g}, {whose}"))
        off, _, words = min(near, default=(np.inf, 0, ""))
        return f"{words}{_as_near(1.0 - chance)}" if off <= resolution and 1.0 - chance <= _BY_CHANCE else ""

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Amplitudes s and c [rad]."""
        symbols = [f"ripple_{wave}_{_digits(self.order)}" for wave in ("sin", "cos")]
        return parameters_of(self, self.joint, symbols, unit="rad", size=WAVE)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add sine and cosine of so many times the joint's angle to its drive."""
        return drive_terms(chain, self.joint, waves(self.order * positions(chain, conditions, self.joint)))


@dataclass(frozen=True)
class EncoderSubdivision(Tone):
    r"""Encoder that divides its lines unevenly: :math:`\sum_j s_j \sin jkq + c_j \cos jkq`, once and twice a line.

    Told apart by:
        the number of lines from the data sheet, and positions that divide a line evenly. Gear ripple of the same order is
        the same thing.

    Source:
        Heydemann (1981).

    Attributes:
        joint: the joint, a revolute one.
        order: k, lines a turn of the joint: of an encoder on the motor those of the motor times the ratio.
    """

    joint: str
    order: float
    name: ClassVar[str] = "encoder_subdivision"
    meaning: ClassVar[str] = "the encoder errs between its lines"

    def __post_init__(self) -> None:
        """Refuse orders that are none."""
        _check(self)

    @property
    def locus(self) -> Locus:
        """The drive, in waves of its own position."""
        return Locus(self.joint, "drive", self.joint, order=self.order)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint that turns, not to be tested until its lines are named."""
        unknown = "its lines a turn are not known; name them: --try encoder_subdivision:JOINT:order=LINES"
        yield from (Candidate(cls(joint, _LINES), variants=(), obstacle=unknown) for joint in situation.revolute)

    def tuned(self, order: float, chosen_among: float = 1.0) -> EncoderSubdivision:
        """Return the error of an encoder of other lines; they are known, not chosen."""
        return replace(self, order=order)

    @property
    def orders(self) -> tuple[float, ...]:
        """Once and twice a line."""
        return self.order, 2.0 * self.order

    def origin(self, order: float, resolution: float, wheels: Mapping[float, str]) -> str:
        """Return that it is a power of two, if it is one."""
        power, chance = _binary(order, resolution)
        return f"2^{power}, as an encoder counts that divides its lines in binary{_as_near(chance)}" if power else ""

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Amplitudes s_1, c_1, s_2, c_2 [rad]."""
        orders = self.order, 2.0 * self.order
        symbols = [f"line_{wave}_{_digits(order)}" for order in orders for wave in ("sin", "cos")]
        return parameters_of(self, self.joint, symbols, unit="rad", size=WAVE)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add sines and cosines to the joint's drive."""
        angle = self.order * positions(chain, conditions, self.joint)
        return drive_terms(chain, self.joint, (*waves(angle), *waves(2.0 * angle)))


def independent_orders(q: np.ndarray, band: tuple[float, float]) -> float:
    """Return among how many independent orders the highest of a periodogram is chosen (Baluev 2008, Eq. 5).

    Args:
        q: shape (N,), positions [rad].
        band: least and largest order [1/turn].
    """
    spread = float(np.std(q)) / TURN
    return 1.0 + (band[1] - band[0]) * spread * float(np.sqrt(4.0 * np.pi * _GAIN))


def resolution_of(q: np.ndarray) -> float:
    """Return by how much two orders have to differ to be told apart [1/turn]: one over the turns that are covered.

    Args:
        q: shape (N,), positions [rad].

    Example:
        >>> resolution_of(np.array([0.0, np.pi]))
        2.0
    """
    return TURN / float(np.ptp(q))


def _binary(order: float, resolution: float) -> tuple[int, float]:
    """Return the power of two that an order is, 0 if none, and the chance that any order of the band is as near to one."""
    powers = [lines for lines in _BINARY if lines < _BAND[1]]
    chance = 2.0 * resolution * len(powers) / (_BAND[1] - _BAND[0])
    power = round(np.log2(order))
    is_near = 2.0**power in _BINARY and abs(order - 2.0**power) <= resolution
    return (power if is_near and chance <= _BY_CHANCE else 0), chance


def _as_near(chance: float) -> str:
    return f" (any order is as near to such a number with a chance of {100.0 * chance:.1g} %)"


def _digits(order: float) -> str:
    """Return an order as part of a parameter's name, in which a point has a meaning of its own."""
    return f"{order:.10g}".replace(".", "_")


def _check(effect: GearRipple | EncoderSubdivision) -> None:
    if not effect.order > 0.0:
        raise BadInputError(f"{effect.name} of {effect.joint}: order {effect.order:g}; expected waves a turn, more than 0")
