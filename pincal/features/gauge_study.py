r"""Whether a measurement repeats well enough for a tolerance: type-1 study, and GR&R by ANOVA.

Type 1: n readings of one feature against its reference value, with a share of the tolerance T:

.. math:: C_g = \frac{0.2 T}{6 s}, \qquad C_{gk} = \frac{0.1 T - |\bar x - x_{ref}|}{3 s} .

Gauge repeatability and reproducibility: parts, each measured several times by several operators,
which may be robots, days or passes; variances by the analysis of variance of two crossed random
factors (AIAG, Measurement Systems Analysis, 4th edition). The interval of the gauge's variance, a
sum of mean squares with positive factors, is Graybill and Wang's (1980).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pincal.errors import BadInputError
from pincal.features.decision_numbers import DECISION
from pincal.thresholds import Scale

# Shares of the tolerance in the definitions of Cg and Cgk.
_SPREAD: Scale = 0.2
_BIAS: Scale = 0.1
# Standard deviations that a process of six sigma has, and the factor of the number of categories.
_WIDTH: Scale = 6.0
_CATEGORIES: Scale = 1.41


class ConfidenceInterval(NamedTuple):
    """Limits between which a quantity is with a stated confidence."""

    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class TypeOneStudy:
    """Repeated readings of one quantity of one feature.

    Attributes:
        readings: shape (n,), in the unit of the tolerance.
        reference: the value of the feature; None: unknown, without bias and Cgk.
        tolerance: width of the interval between the limits.

    Example:
        >>> study = TypeOneStudy(np.tile([0.9, 1.1], 10), 1.0, 6.0)
        >>> round(study.cg, 3), round(study.cgk, 3)
        (1.949, 1.949)
    """

    readings: np.ndarray
    reference: float | None
    tolerance: float

    def __post_init__(self) -> None:
        """Refuse too few readings, and a tolerance that is none."""
        if self.readings.ndim != 1 or not np.isfinite(self.readings).all():
            raise BadInputError(
                f"readings of shape {self.readings.shape}; expected finite numbers, shape (n,)"
            )
        if len(self.readings) < DECISION.least_repeats:
            raise BadInputError(
                f"{len(self.readings)} repeated readings; expected {DECISION.least_repeats} or "
                "more for Cg, better 25"
            )
        if not 0.0 < self.tolerance < math.inf:
            raise BadInputError(
                f"tolerance {self.tolerance} for Cg; expected the distance of two limits, more "
                "than 0"
            )

    @cached_property
    def s(self) -> float:
        """Standard deviation of the readings."""
        return float(self.readings.std(ddof=1))

    @cached_property
    def bias(self) -> float | None:
        """Mean of the readings minus the reference value."""
        return None if self.reference is None else float(self.readings.mean()) - self.reference

    @property
    def cg(self) -> float:
        """The index of the spread, infinite without any."""
        return _SPREAD * self.tolerance / (_WIDTH * self.s) if self.s > 0.0 else math.inf

    @property
    def cgk(self) -> float | None:
        """The index of spread and bias, None without a reference value."""
        if self.bias is None:
            return None
        room = _BIAS * self.tolerance - abs(self.bias)
        if self.s == 0.0:
            return math.copysign(math.inf, room)
        return room / (_WIDTH / 2.0 * self.s)

    def cg_interval(self, confidence: float = DECISION.coverage) -> ConfidenceInterval:
        """Return the interval of Cg, by the chi-square distribution of the variance."""
        from scipy.stats import chi2

        dof = len(self.readings) - 1
        ends = chi2.ppf([(1.0 - confidence) / 2.0, (1.0 + confidence) / 2.0], dof)
        return ConfidenceInterval(*(float(self.cg * np.sqrt(end / dof)) for end in ends))

    def cgk_interval(self, confidence: float = DECISION.coverage) -> ConfidenceInterval | None:
        """Return the interval of Cgk (Bissell 1990), None without a reference value."""
        from scipy.special import ndtri

        if self.cgk is None:
            return None
        n = len(self.readings)
        sigma = math.sqrt(1.0 / (9.0 * n) + self.cgk**2 / (2.0 * (n - 1)))
        z = float(ndtri((1.0 + confidence) / 2.0))
        return ConfidenceInterval(self.cgk - z * sigma, self.cgk + z * sigma)


class MeanSquare(NamedTuple):
    """A line of an analysis of variance: mean square and its degrees of freedom."""

    value: float
    dof: int


@dataclass(frozen=True, eq=False)
class GaugeStudy:
    """Readings of several parts by several operators.

    Attributes:
        readings: shape (parts, operators, repeats); operators may be robots, days or passes.
    """

    readings: np.ndarray

    def __post_init__(self) -> None:
        """Refuse what is no balanced table of two or more of each."""
        shape = self.readings.shape
        if len(shape) != 3 or min(shape) < 2 or not np.isfinite(self.readings).all():
            raise BadInputError(
                f"readings of shape {shape}; expected finite numbers, shape (parts, operators, "
                "repeats), two or more of each: leave incomplete passes out"
            )

    @cached_property
    def of_parts(self) -> MeanSquare:
        """Mean square between parts."""
        parts, operators, repeats = self.readings.shape
        spread = self.readings.mean(axis=(1, 2)).var(ddof=1)
        return MeanSquare(float(operators * repeats * spread), parts - 1)

    @cached_property
    def of_operators(self) -> MeanSquare:
        """Mean square between operators."""
        parts, operators, repeats = self.readings.shape
        spread = self.readings.mean(axis=(0, 2)).var(ddof=1)
        return MeanSquare(float(parts * repeats * spread), operators - 1)

    @cached_property
    def of_interaction(self) -> MeanSquare:
        """Mean square of what operators do differently from part to part."""
        parts, operators, repeats = self.readings.shape
        cells = self.readings.mean(axis=2)
        off = (
            cells
            - cells.mean(axis=1, keepdims=True)
            - cells.mean(axis=0, keepdims=True)
            + cells.mean()
        )
        dof = (parts - 1) * (operators - 1)
        return MeanSquare(float(repeats * np.sum(off**2) / dof), dof)

    @cached_property
    def of_repeats(self) -> MeanSquare:
        """Mean square of repeated readings."""
        parts, operators, repeats = self.readings.shape
        off = self.readings - self.readings.mean(axis=2, keepdims=True)
        dof = parts * operators * (repeats - 1)
        return MeanSquare(float(np.sum(off**2) / dof), dof)

    @cached_property
    def is_pooled(self) -> bool:
        """Whether the interaction is no larger than chance, and counts as repeatability."""
        from scipy.stats import f

        if self.of_repeats.value == 0.0:
            return self.of_interaction.value == 0.0
        ratio = self.of_interaction.value / self.of_repeats.value
        chance = f.sf(ratio, self.of_interaction.dof, self.of_repeats.dof)
        return bool(chance > DECISION.pooled)

    @cached_property
    def _own(self) -> MeanSquare:
        """Mean square of repeatability, with the interaction where it is pooled."""
        if not self.is_pooled:
            return self.of_repeats
        dof = self.of_repeats.dof + self.of_interaction.dof
        total = self.of_repeats.value * self.of_repeats.dof
        total += self.of_interaction.value * self.of_interaction.dof
        return MeanSquare(total / dof, dof)

    @cached_property
    def _below(self) -> MeanSquare:
        """Mean square against which parts and operators are compared."""
        return self._own if self.is_pooled else self.of_interaction

    @property
    def repeatability(self) -> float:
        """Standard deviation of readings of one part by one operator (EV)."""
        return math.sqrt(self._own.value)

    @property
    def reproducibility(self) -> float:
        """Standard deviation between operators, with their interaction with parts (AV)."""
        parts, _, repeats = self.readings.shape
        between = max(self.of_operators.value - self._below.value, 0.0) / (parts * repeats)
        return math.sqrt(between + self._interaction)

    @property
    def _interaction(self) -> float:
        """Variance of the interaction."""
        if self.is_pooled:
            return 0.0
        repeats = self.readings.shape[2]
        return float(max(self.of_interaction.value - self.of_repeats.value, 0.0) / repeats)

    @property
    def gauge(self) -> float:
        """Standard deviation of repeatability and reproducibility together (GRR)."""
        return float(math.hypot(self.repeatability, self.reproducibility))

    @property
    def between_parts(self) -> float:
        """Standard deviation between parts (PV)."""
        _, operators, repeats = self.readings.shape
        between = max(self.of_parts.value - self._below.value, 0.0) / (operators * repeats)
        return math.sqrt(between)

    @property
    def total(self) -> float:
        """Standard deviation of all readings (TV)."""
        return math.hypot(self.gauge, self.between_parts)

    @property
    def share(self) -> float:
        """Standard deviation of the gauge relative to the total one (%GRR / 100)."""
        return float(self.gauge / self.total) if self.total > 0.0 else 0.0

    @property
    def categories(self) -> int:
        """Number of distinct categories of parts (ndc); 0 if the gauge tells none apart."""
        if self.gauge == 0.0:
            return 0 if self.between_parts == 0.0 else int(np.iinfo(int).max)
        return int(_CATEGORIES * self.between_parts / self.gauge)

    def of_tolerance(self, tolerance: float) -> float:
        """Return six standard deviations of the gauge relative to a tolerance's width (P/T)."""
        return float(_WIDTH * self.gauge / tolerance)

    def gauge_interval(self, confidence: float = DECISION.coverage) -> ConfidenceInterval:
        """Return the interval of the gauge's standard deviation, by a modified large-sample
        interval of its variance, the interaction not pooled.
        """
        from scipy.stats import chi2

        parts, _, repeats = self.readings.shape
        lines = (self.of_operators, self.of_interaction, self.of_repeats)
        factors = np.array([1.0, parts - 1.0, parts * (repeats - 1.0)]) / (parts * repeats)
        terms = factors * np.array([line.value for line in lines])
        dof = np.array([line.dof for line in lines], float)
        lower = 1.0 - dof / chi2.ppf((1.0 + confidence) / 2.0, dof)
        upper = dof / chi2.ppf((1.0 - confidence) / 2.0, dof) - 1.0
        variance = float(terms.sum())
        least = variance - float(np.linalg.norm(lower * terms))
        most = variance + float(np.linalg.norm(upper * terms))
        return ConfidenceInterval(math.sqrt(max(least, 0.0)), math.sqrt(most))
