r"""Fine waves of a joint's own position: teeth of a motor's or a stage's gear, and the lines of an
encoder.

A wheel that turns k times per turn of the joint makes an error of k cycles per revolution (its
eccentricity), and of 2 k and more (its teeth, a strain wave gear's two lobes). An encoder whose two
signals differ in size, offset or phase errs between its lines: once and twice a line (Heydemann
1981).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pincal.errors import BadInputError
from pincal.model.conditions import TURN, PoseSet
from pincal.model.effect import Candidate, Harmonic
from pincal.model.effect_bases import WAVE, DriveHarmonic
from pincal.model.effect_numbers import ORIGIN
from pincal.thresholds import Scale

# Placeholders of an unknown order: the ratio of a usual strain wave gear, and the lines of an
# encoder.
_USUAL: Scale = 101.0
_LINES: Scale = 1024.0
# Lines per revolution of encoders with binary subdivision, from the lowest that is not a curve of
# the drive.
_BINARY = tuple(2.0**n for n in range(5, 17))


@dataclass(frozen=True)
class _FineWaves(DriveHarmonic, Harmonic):
    """Waves of any order, not only an integer."""

    order: float
    typical: ClassVar[float] = WAVE

    def __post_init__(self) -> None:
        if not self.order > 0.0:
            raise BadInputError(
                f"{self.name} of {self.joint}: order {self.order:g}; expected cycles per "
                "revolution, more than 0"
            )


@dataclass(frozen=True)
class GearRipple(_FineWaves):
    r"""Motor or gear stage that turns many times per revolution of the joint: it adds
    :math:`s \sin kq + c \cos kq`.

    Distinguished by:
        many poses of this joint alone, spaced by less than half a period; with the ratio from the
        data sheet one order is tested instead of hundreds, of which one fits the noise of few
        poses. An encoder with one or two periods per line has the same ripple.

    Source:
        Tuttle (1992); the chance of a false wave after Baluev (2008).

    Attributes:
        joint: the joint, a revolute one.
        order: k, cycles per revolution; a ratio need not be a whole number.
        chosen_among: number of independent orders among which this one was selected; 1 for a known
            one.
    """

    chosen_among: float = 1.0
    name: ClassVar[str] = "gear_ripple"
    meaning: ClassVar[str] = "a motor or gear stage causes a ripple of many cycles per revolution"
    pattern: ClassVar[str] = "ripple_{wave}_{order}"
    band: ClassVar[tuple[float, float] | None] = ORIGIN.band

    @property
    def trials(self) -> float:
        """Number of orders among which this one was selected."""
        return self.chosen_among

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield it on every revolute joint; its order has to be searched for, or given."""
        for joint in situation.revolute:
            among = len(situation.revolute) * independent_orders(
                situation.positions(joint), ORIGIN.band
            )
            yield Candidate(cls(joint, _USUAL, among), variants=())

    def tuned(self, order: float, chosen_among: float = 1.0) -> GearRipple:
        return replace(self, order=order, chosen_among=chosen_among)

    @property
    def same(self) -> tuple[Harmonic, ...]:
        """An encoder with one line per wave, or per two waves."""
        return tuple(
            EncoderSubdivision(self.joint, order) for order in (self.order, self.order / 2.0)
        )

    def suggested(self, resolution: float) -> Harmonic:
        """Return an encoder with binary subdivision, if the order matches one and is unlikely to do
        so by chance.
        """
        power, _ = _binary(self.order, resolution)
        return EncoderSubdivision(self.joint, 2.0**power) if power else self

    def origin(self, order: float, resolution: float, wheels: Mapping[float, str]) -> str:
        """Return the wheel of which it may be a harmonic: one of those given, or of a usual strain
        wave gear.
        """
        known = {_USUAL: "the ratio of a usual strain wave gear"} | dict(wheels)
        near = list[tuple[float, int, str]]()
        chance = 1.0
        for turns, whose in known.items():
            if 2.0 * resolution < turns < order + resolution:
                chance *= 1.0 - 2.0 * resolution / turns
                times = round(order / turns)
                near.append(
                    (
                        abs(order - times * turns),
                        times,
                        f"{f'{times} x ' if times > 1 else ''}{turns:g}, {whose}",
                    )
                )
        off, _, words = min(near, default=(np.inf, 0, ""))
        return (
            f"{words}{_as_near(1.0 - chance)}"
            if off <= resolution and 1.0 - chance <= ORIGIN.by_chance
            else ""
        )


@dataclass(frozen=True)
class EncoderSubdivision(_FineWaves):
    r"""Interpolation error of an encoder: :math:`\sum_j s_j \sin jkq + c_j \cos jkq`, once and
    twice per line.

    Distinguished by:
        the number of lines from the data sheet, and positions that divide a line evenly. Gear
        ripple of the same order is equivalent.

    Source:
        Heydemann (1981).

    Attributes:
        joint: the joint, a revolute one.
        order: k, lines per revolution of the joint; for an encoder on the motor, those of the motor
            times the ratio.
    """

    name: ClassVar[str] = "encoder_subdivision"
    meaning: ClassVar[str] = "the encoder has interpolation errors between its lines"
    pattern: ClassVar[str] = "line_{wave}_{order}"

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield it on every revolute joint, not to be tested until its lines are given."""
        unknown = (
            "its lines per revolution are unknown; give them: --try "
            "encoder_subdivision:JOINT:order=LINES"
        )
        yield from (
            Candidate(cls(joint, _LINES), variants=(), obstacle=unknown)
            for joint in situation.revolute
        )

    def tuned(self, order: float, chosen_among: float = 1.0) -> EncoderSubdivision:
        """Return the error of an encoder with other lines, which are known and not selected."""
        return replace(self, order=order)

    @property
    def orders(self) -> tuple[float, ...]:
        return self.order, 2.0 * self.order

    def origin(self, order: float, resolution: float, wheels: Mapping[float, str]) -> str:
        """Return that it is a power of two, if so."""
        power, chance = _binary(order, resolution)
        return (
            f"2^{power}, as for an encoder with binary subdivision{_as_near(chance)}"
            if power
            else ""
        )


def independent_orders(q: np.ndarray, band: tuple[float, float]) -> float:
    """Return the number of independent orders in a periodogram (Baluev 2008, Eq. 5).

    Positions q have shape (N,) [rad]; ``band`` contains least and largest order [cycles per
    revolution].
    """
    spread = float(np.std(q)) / TURN
    return 1.0 + (band[1] - band[0]) * spread * float(np.sqrt(4.0 * np.pi * ORIGIN.gain))


def resolution_of(q: np.ndarray) -> float:
    """Return the resolution of orders [cycles per revolution] at positions of shape (N,) [rad]: one
    over the turns covered.

    Example:
        >>> resolution_of(np.array([0.0, np.pi]))
        2.0
    """
    return TURN / float(np.ptp(q))


def _binary(order: float, resolution: float) -> tuple[int, float]:
    """Return the exponent of the power of two that an order is, 0 if none, and the probability of a
    chance match.
    """
    powers = [lines for lines in _BINARY if lines < ORIGIN.band[1]]
    chance = 2.0 * resolution * len(powers) / (ORIGIN.band[1] - ORIGIN.band[0])
    power = round(np.log2(order))
    is_near = 2.0**power in _BINARY and abs(order - 2.0**power) <= resolution
    return (power if is_near and chance <= ORIGIN.by_chance else 0), chance


def _as_near(chance: float) -> str:
    return (
        " (a random order is as near to such a number with a probability of "
        f"{100.0 * chance:.1g} %)"
    )
