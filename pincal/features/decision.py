r"""Whether a measured value conforms to its limits (JCGM 106:2012, ISO 14253-1).

With the standard uncertainty u, the probability that the true value is within the limits is

.. math:: p_c = F((T_U - y) / u) - F((T_L - y) / u),

F being the distribution function of the normal distribution, or of Student's t for few degrees of
freedom. Guarded acceptance says that it conforms where y is within the limits by a guard band, the
expanded uncertainty U = k u, that it does not where it is outside by U, and leaves the rest open.
A part at a limit is then accepted with at most half of the probability that U does not cover, and
one between two narrow limits with at most all of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from pincal.errors import BadInputError
from pincal.features.budget import coverage_factor
from pincal.features.decision_numbers import DECISION
from pincal.features.part_feature import ToleranceLimits

ConformityVerdict = Literal["conforms", "does not conform", "undecided"]
RuleKind = Literal["guarded", "simple"]


@dataclass(frozen=True)
class ConformityDecision:
    """A decision on one value.

    Attributes:
        verdict: "conforms", "does not conform" or "undecided".
        guard_band: by which a value has to be within the limits, or outside, in its unit.
        probability: that the true value is within the limits.
    """

    verdict: ConformityVerdict
    guard_band: float
    probability: float

    @property
    def risk(self) -> float:
        """Probability that the decision is wrong: of a false acceptance if it conforms, of a false
        rejection if it does not, and 0 where nothing is decided.
        """
        if self.verdict == "conforms":
            return 1.0 - self.probability
        return self.probability if self.verdict == "does not conform" else 0.0


@dataclass(frozen=True)
class DecisionRule:
    """How it is decided.

    Attributes:
        kind: "guarded": with the expanded uncertainty as guard band on both sides of a limit;
            "simple": without guard bands, so that nothing is undecided and the risk at a limit is
            shared, one half.
        coverage: probability that the expanded uncertainty covers.

    Example:
        >>> rule = DecisionRule()
        >>> rule.decide(10.18, 0.02, ToleranceLimits(9.8, 10.2)).verdict
        'undecided'
        >>> DecisionRule("simple").decide(10.18, 0.02, ToleranceLimits(9.8, 10.2)).verdict
        'conforms'
    """

    kind: RuleKind = "guarded"
    coverage: float = DECISION.coverage

    def __post_init__(self) -> None:
        """Refuse an unknown rule."""
        if self.kind not in ("guarded", "simple"):
            raise BadInputError(f"decision rule {self.kind!r}; expected guarded or simple")
        coverage_factor(math.inf, self.coverage)

    @property
    def most_risk(self) -> float:
        """The largest probability with which a part that does not conform is accepted."""
        return 1.0 - self.coverage if self.kind == "guarded" else 0.5

    @property
    def words(self) -> str:
        """The rule in words, with its guard band and its risk."""
        if self.kind == "simple":
            return "simple acceptance (JCGM 106, 8.2): no guard band, risk at a limit up to 50 %"
        return (
            "guarded acceptance (ISO 14253-1; JCGM 106, 8.3): guard band U of "
            f"{100.0 * self.coverage:.4g} % coverage, risk of a false acceptance up to "
            f"{100.0 * self.most_risk:.2g} %"
        )

    def guard_band(self, u: float, dof: float = math.inf) -> float:
        """Return the guard band for a standard uncertainty with its degrees of freedom."""
        return coverage_factor(dof, self.coverage) * u if self.kind == "guarded" else 0.0

    def decide(
        self, value: float, u: float, limits: ToleranceLimits, dof: float = math.inf
    ) -> ConformityDecision:
        """Decide on a value.

        Args:
            value: that was measured.
            u: its standard uncertainty, in the same unit.
            limits: between which it has to be.
            dof: degrees of freedom of u.

        Raises:
            BadInputError: for a value or an uncertainty that is not finite, or limits of which the
                lower is above the upper.
        """
        if not (math.isfinite(value) and 0.0 <= u < math.inf):
            raise BadInputError(
                f"value {value} with standard uncertainty {u}; expected finite numbers, u 0 or more"
            )
        if not limits.lower <= limits.upper:
            raise BadInputError(
                f"limits {limits.lower:g} to {limits.upper:g}; expected the lower before the upper"
            )
        guard = self.guard_band(u, dof)
        verdict: ConformityVerdict = "undecided"
        if limits.lower + guard <= value <= limits.upper - guard:
            verdict = "conforms"
        elif value < limits.lower - guard or value > limits.upper + guard:
            verdict = "does not conform"
        return ConformityDecision(verdict, guard, conformance_probability(value, u, limits, dof))


def conformance_probability(
    value: float, u: float, limits: ToleranceLimits, dof: float = math.inf
) -> float:
    """Return the probability that the true value is within the limits, 0 to 1."""
    if u == 0.0:
        return float(limits.lower <= value <= limits.upper)
    below = _probability((limits.upper - value) / u, dof)
    return max(below - _probability((limits.lower - value) / u, dof), 0.0)


def _probability(t: float, dof: float) -> float:
    """Return the distribution function of the normal or Student's t distribution."""
    from scipy.special import ndtr, stdtr

    return float(ndtr(t) if math.isinf(dof) or math.isinf(t) else stdtr(dof, t))


def overall_verdict(verdicts: tuple[ConformityVerdict, ...]) -> ConformityVerdict:
    """Return the verdict on a part by those on all its values: it does not conform if one does
    not, and conforms if all do.
    """
    if "does not conform" in verdicts:
        return "does not conform"
    return "undecided" if "undecided" in verdicts else "conforms"
