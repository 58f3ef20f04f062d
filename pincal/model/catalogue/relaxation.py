r"""Exponential relaxation with time: creep of a joint offset, expansion of links as the arm warms
up by itself.

Both are :math:`a f(t), \; f = 1 - e^{-(t - t_0) / \tau}`, zero before :math:`t_0`. The time
constant is a parameter, too, linearised about the expected amplitude A and time constant:

.. math:: a f(t) + \delta\tau \, A \, \frac{\partial f}{\partial\tau}, \qquad
          \frac{\partial f}{\partial\tau} = - \frac{t - t_0}{\tau^2} e^{-(t - t_0) / \tau} .

A discovery tries a few time constants without this term (A = 0), and then linearises about the
estimate until it converges.
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from pincal.errors import BadInputError
from pincal.model.catalogue.environment import lengths_that_grow
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet
from pincal.model.effect import Candidate, ExponentialDrift, Locus, Term
from pincal.model.effect_bases import GROWTH, DriveEffect, drive_unit, recorded
from pincal.model.symbols import held
from pincal.parameters import Parameter
from pincal.thresholds import Scale

# Time constants that a discovery tries, relative to the duration of the table: the longest is
# nearly a steady drift.
_CONSTANTS: tuple[Scale, ...] = (0.07, 0.2, 0.6, 2.0)
# Time constants distinguishable from a jump, and from a steady drift, relative to the duration of
# the table.
_SHORTEST: Scale = 0.01
_LONGEST: Scale = 5.0
# Largest step of a time constant, as a factor.
_FAR: Scale = 2.0
# Convergence: relative change of the time constant, and of the amplitude about which it is
# linearised.
_SAME: Scale = 1e-3
_SAME_AMPLITUDE: Scale = 0.02
# Number of time constants after which the relaxation is over.
_OVER: Scale = 50.0


class _Relaxing(ABC):
    """An exponential relaxation; its fields are the effects'."""

    name: ClassVar[str]
    joint: str | None
    constant: float
    start: float
    span: float | None
    expected: float

    def __post_init__(self) -> None:
        if not self.constant > 0.0:
            where = f" of {self.joint}" if self.joint else ""
            raise BadInputError(
                f"{self.name}{where}: time constant {self.constant:g} s; expected more than 0"
            )

    def about(self, values: np.ndarray) -> Self:
        """Return the effect about an amplitude and a changed time constant; itself once these have
        converged.
        """
        change = float(values[1]) / self.constant if len(values) > 1 else 0.0
        same = abs(values[0] - self.expected) <= _SAME_AMPLITUDE * abs(values[0])
        if same and abs(change) <= _SAME:
            return self
        constant = self.constant * float(np.clip(1.0 + change, 1.0 / _FAR, _FAR))
        if self.span is not None:
            constant = float(np.clip(constant, _SHORTEST * self.span, _LONGEST * self.span))
        return replace(self, constant=constant, expected=float(values[0]))  # type: ignore[type-var]

    def _named(self, element: str, symbol: str, unit: str) -> tuple[Parameter, ...]:
        """Return the amplitude and, if it is a parameter, the time constant."""
        amplitude = Parameter(f"{element}.{symbol}", unit, self.name, 0.0, GROWTH)
        if not self.expected:
            return (amplitude,)
        return amplitude, Parameter(
            f"{element}.{symbol}_tau", "s", self.name, self.constant, GROWTH
        )

    def _shapes(self, time: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return f at times [s] and, if the time constant is a parameter, A times its derivative,
        shape (N,) each.
        """
        since = (
            held(time, self.start, self.start + _OVER * self.constant) - self.start
        ) / self.constant
        left = np.exp(-since)
        if not self.expected:
            return (1.0 - left,)
        return 1.0 - left, -self.expected / self.constant * since * left


@dataclass(frozen=True)
class JointCreep(_Relaxing, DriveEffect, ExponentialDrift):
    r"""Creep of a joint offset with time: by :math:`a (1 - e^{-(t - t_0) / \tau})`.

    Distinguished by:
        repeating the first poses during the day, joint by joint, with the time recorded. Expansion
        moves the target along the arm, creep of an offset across it.

    Source:
        drift of pose characteristics in ISO 9283.

    Attributes:
        joint: the joint.
        constant: the time constant [s].
        start: t_0, when it began [s].
        span: time span of the data [s], which limits the time constant; None for no limit.
        expected: A, amplitude about which the time constant is linearised [rad or m]; 0 to hold the
            time constant fixed.
    """

    constant: float
    start: float = 0.0
    span: float | None = None
    expected: float = 0.0
    name: ClassVar[str] = "joint_creep"
    meaning: ClassVar[str] = "the joint offset creeps with time at a decreasing rate"
    follows: ClassVar[str] = "time"
    recorded_as: ClassVar[str] = "time"

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        for joint in situation.joints:
            forms = [
                cls(joint, constant, start, span) for constant, start, span in _tried(situation)
            ]
            yield Candidate(forms[0], variants=tuple(forms))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Amplitude a [rad or m]; the time constant [s]."""
        return self._named(self.joint, "creep", drive_unit(chain, self.joint))

    def bases(self, chain: Chain, conditions: Conditions) -> tuple[np.ndarray, ...]:
        return self._shapes(self.variable(chain, conditions))


@dataclass(frozen=True)
class ThermalGrowth(_Relaxing, ExponentialDrift):
    r"""Expansion as the arm warms up: lengths grow by the fraction
    :math:`a (1 - e^{-(t - t_0) / \tau})` of nominal.

    The arm warms up by itself, independently of the air temperature. If it follows the air closely,
    thermal expansion is equivalent; it has the same lengths.

    Distinguished by:
        recording the temperature of the arm itself; repeating the first poses later, and again
        after the arm has cooled down. A drift of the base moves all poses by the same amount.

    Source:
        Heisel, Richter and Wurst (1997), on the warming up of an arm.

    Attributes:
        constant: the time constant [s].
        joint: the joint that moves the only link that expands; None for the whole arm.
        start: t_0, when it began to warm up [s].
        span: time span of the data [s], which limits the time constant; None for no limit.
        expected: A, growth about which the time constant is linearised [1]; 0 to hold the time
            constant fixed.
    """

    constant: float
    joint: str | None = None
    start: float = 0.0
    span: float | None = None
    expected: float = 0.0
    name: ClassVar[str] = "thermal_growth"
    meaning: ClassVar[str] = "the links expand with time at a decreasing rate as the arm warms up"

    @property
    def locus(self) -> Locus:
        return Locus(self.joint, "lengths", "time")

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        for joint in (*situation.joints, None):
            forms = [
                cls(constant, joint, start, span) for constant, start, span in _tried(situation)
            ]
            yield Candidate(forms[0], variants=tuple(forms))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Final growth [1]; the time constant [s]."""
        return self._named(self.joint or "arm", "growth", "1")

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        lengths = {
            k: length for k, length in lengths_that_grow(chain, self.joint).items() if length
        }
        shapes = self._shapes(recorded(self, "time", conditions.time))
        return tuple(
            Term(p, k, length * shape)
            for p, shape in enumerate(shapes)
            for k, length in lengths.items()
        )


def _tried(situation: PoseSet) -> list[tuple[float, float, float]]:
    """Return time constants to try, with start and duration of the recorded time [s]."""
    time = situation.conditions.time
    span = 0.0 if time is None else float(np.ptp(time))
    start = 0.0 if time is None else float(np.min(time))
    span = span or 1.0  # Without times it is reported as not testable, with some time constant.
    return [(part * span, start, span) for part in _CONSTANTS]
