r"""What dies away with time: a joint that creeps, links that grow as the arm warms up by itself.

Both follow :math:`a f(t), \; f = 1 - e^{-(t - t_0) / \tau}`, zero before :math:`t_0`. The time constant is a parameter as
well, linearised about the amplitude A and the time constant that are expected:

.. math:: a f(t) + \delta\tau \, A \, \frac{\partial f}{\partial\tau}, \qquad
          \frac{\partial f}{\partial\tau} = - \frac{t - t_0}{\tau^2} e^{-(t - t_0) / \tau} .

A discovery tries a few time constants without this term (A = 0), and expands about what it found until nothing moves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pincal.errors import BadInputError
from pincal.model.catalogue.environment import lengths_that_grow
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, Situation
from pincal.model.effect import Candidate, Locus, Settling, Term
from pincal.model.places import GROWTH, drive_terms, drive_unit, parameters_of, recorded
from pincal.model.symbols import held
from pincal.parameters import Parameter

# Time constants that a discovery tries, over the time of the table: the longest is nearly a steady drift.
_CONSTANTS = (0.07, 0.2, 0.6, 2.0)
# Time constants that are told from a jump, and from a steady drift, over the time of the table.
_SHORTEST, _LONGEST = 0.01, 5.0
# Step by which a time constant moves at most, as a factor.
_FAR = 2.0
# What counts as settled: change of the time constant, and of the amplitude in which it is linearised.
_SAME, _SAME_AMPLITUDE = 1e-3, 0.02
# After so many time constants nothing moves any more.
_OVER = 50.0


@dataclass(frozen=True)
class JointCreep(Settling):
    r"""Joint that creeps from its zero as time goes by, ever slower: by :math:`a (1 - e^{-(t - t_0) / \tau})`.

    Told apart by:
        the first poses repeated in the course of the day, joint by joint, and the time recorded. Links that grow with time
        move the target along the arm, a zero that creeps moves it across.

    Source:
        drift of pose characteristics in ISO 9283.

    Attributes:
        joint: the joint.
        constant: the time constant [s].
        start: t_0, when it began [s].
        span: time that was looked at [s], which limits the time constant that can be found; None for no limit.
        expected: A, amplitude about which the time constant is linearised [rad or m]; 0 to hold the time constant.
    """

    joint: str
    constant: float
    start: float = 0.0
    span: float | None = None
    expected: float = 0.0
    name: ClassVar[str] = "joint_creep"
    meaning: ClassVar[str] = "the joint's zero creeps with time, ever slower"

    def __post_init__(self) -> None:
        """Refuse a time constant that is none."""
        _check(self)

    @property
    def locus(self) -> Locus:
        """The drive, by the time."""
        return Locus(self.joint, "drive", "time")

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint, with several time constants."""
        for joint in situation.joints:
            forms = [cls(joint, constant, start, span) for constant, start, span in _tried(situation)]
            yield Candidate(forms[0], variants=tuple(forms))

    def about(self, values: np.ndarray) -> JointCreep:
        """Return the creep expanded about an amplitude and a change of the time constant."""
        constant, expected = _about(self, values)
        return replace(self, constant=constant, expected=expected)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Amplitude a [rad or m]; the time constant [s]."""
        return _parameters(self, self.joint, "creep", drive_unit(chain, self.joint))

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add what has crept to the joint's drive."""
        return drive_terms(chain, self.joint, _shapes(self, conditions))


@dataclass(frozen=True)
class ThermalGrowth(Settling):
    r"""Lengths that grow as the arm warms up, by the part :math:`a (1 - e^{-(t - t_0) / \tau})` of their nominal value.

    An arm warms up by itself, which the temperature of the air does not tell. Where it follows that of the air closely,
    thermal expansion explains the same. Which lengths grow is said there.

    Told apart by:
        the temperature of the arm itself, recorded; poses at the start repeated later, and once more after a pause in which
        the arm cooled down. A base that drifts moves all poses alike.

    Source:
        Heisel, Richter and Wurst (1997), on the warming up of an arm.

    Attributes:
        constant: the time constant [s].
        joint: the joint that moves the one link that grows; None for the whole arm.
        start: t_0, when it began to warm up [s].
        span: time that was looked at [s], which limits the time constant that can be found; None for no limit.
        expected: A, growth about which the time constant is linearised [1]; 0 to hold the time constant.
    """

    constant: float
    joint: str | None = None
    start: float = 0.0
    span: float | None = None
    expected: float = 0.0
    name: ClassVar[str] = "thermal_growth"
    meaning: ClassVar[str] = "the links grow with time, ever slower, as an arm that warms up"

    def __post_init__(self) -> None:
        """Refuse a time constant that is none."""
        _check(self)

    @property
    def locus(self) -> Locus:
        """The lengths of one link or of all, by the time."""
        return Locus(self.joint, "lengths", "time")

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every link, and on the whole arm."""
        for joint in (*situation.joints, None):
            forms = [cls(constant, joint, start, span) for constant, start, span in _tried(situation)]
            yield Candidate(forms[0], variants=tuple(forms))

    def about(self, values: np.ndarray) -> ThermalGrowth:
        """Return the growth expanded about an amplitude and a change of the time constant."""
        constant, expected = _about(self, values)
        return replace(self, constant=constant, expected=expected)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Growth in the end [1]; the time constant [s]."""
        return _parameters(self, self.joint or "arm", "growth", "1")

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add what has grown to the lengths."""
        lengths = {k: length for k, length in lengths_that_grow(chain, self.joint).items() if length}
        shapes = _shapes(self, conditions)
        return tuple(Term(p, k, length * shape) for p, shape in enumerate(shapes) for k, length in lengths.items())


def _check(effect: JointCreep | ThermalGrowth) -> None:
    if not effect.constant > 0.0:
        where = f" of {effect.joint}" if effect.joint else ""
        raise BadInputError(f"{effect.name}{where}: time constant {effect.constant:g} s; expected more than 0")


def _tried(situation: Situation) -> list[tuple[float, float, float]]:
    """Return time constants to try, with start and length of the time recorded [s]."""
    time = situation.conditions.time
    span = 0.0 if time is None else float(np.ptp(time))
    start = 0.0 if time is None else float(np.min(time))
    span = span or 1.0  # Without times it is reported as not testable, with some time constant.
    return [(part * span, start, span) for part in _CONSTANTS]


def _about(effect: JointCreep | ThermalGrowth, values: np.ndarray) -> tuple[float, float]:
    """Return time constant and amplitude to expand about: those that stand, once next to nothing moves."""
    change = float(values[1]) / effect.constant if len(values) > 1 else 0.0
    same = abs(values[0] - effect.expected) <= _SAME_AMPLITUDE * abs(values[0])
    if same and abs(change) <= _SAME:
        return effect.constant, effect.expected
    constant = effect.constant * float(np.clip(1.0 + change, 1.0 / _FAR, _FAR))
    if effect.span is not None:
        constant = float(np.clip(constant, _SHORTEST * effect.span, _LONGEST * effect.span))
    return constant, float(values[0])


def _parameters(effect: JointCreep | ThermalGrowth, element: str, symbol: str, unit: str) -> tuple[Parameter, ...]:
    amplitude = parameters_of(effect, element, (symbol,), unit=unit, size=GROWTH)
    if not effect.expected:
        return amplitude
    return (*amplitude, Parameter(f"{element}.{symbol}_tau", "s", effect.name, effect.constant, GROWTH))


def _shapes(effect: JointCreep | ThermalGrowth, conditions: Conditions) -> tuple[np.ndarray, ...]:
    """Return f, and A times its slope by the time constant where that is a parameter, shape (N,) each."""
    time = recorded(effect, "time", conditions.time)
    since = (held(time, effect.start, effect.start + _OVER * effect.constant) - effect.start) / effect.constant
    left = np.exp(-since)
    if not effect.expected:
        return (1.0 - left,)
    return 1.0 - left, -effect.expected / effect.constant * since * left
