r"""Budgets of uncertainty as in the GUM (JCGM 100:2008).

Standard uncertainties of independent sources add in squares. The degrees of freedom of the sum
follow from Welch and Satterthwaite's formula (G.2b), and the coverage factor from Student's t:

.. math:: u^2 = \sum_i u_i^2, \quad \nu = u^4 \Big/ \sum_i \frac{u_i^4}{\nu_i},
    \quad U = k u, \quad k = t_{(1 + p) / 2}(\nu) .
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from pincal.errors import BadInputError
from pincal.features.decision_numbers import DECISION


@dataclass(frozen=True)
class BudgetEntry:
    """A source of uncertainty.

    Attributes:
        source: its name.
        type: "A", by statistics, or "B", by other means.
        u: its contribution, a standard uncertainty in the unit of the value.
        dof: degrees of freedom; infinite where u is taken as known.
    """

    source: str
    type: Literal["A", "B"]
    u: float
    dof: float = math.inf

    def __post_init__(self) -> None:
        """Refuse what is no uncertainty."""
        if not 0.0 <= self.u < math.inf:
            raise BadInputError(
                f"source {self.source!r}: standard uncertainty {self.u}; expected a finite number, "
                "0 or more"
            )
        if not self.dof > 0.0:
            raise BadInputError(
                f"source {self.source!r}: {self.dof} degrees of freedom; expected more than 0"
            )
        if self.type not in ("A", "B"):
            raise BadInputError(f"source {self.source!r}: type {self.type!r}; expected A or B")


def distribution_of(dof: float | None) -> Literal["normal", "t"]:
    """Return the distribution by which a standard uncertainty with degrees of freedom is expanded:
    Student's t, or the normal one where they are infinite or None (JCGM 100, G.3).

    Example:
        >>> distribution_of(12.0), distribution_of(math.inf)
        ('t', 'normal')
    """
    return "normal" if dof is None or math.isinf(dof) else "t"


@dataclass(frozen=True)
class UncertaintyBudget:
    """The uncertainty of one value by its independent sources.

    Attributes:
        entries: of the sources.
        coverage: probability that the expanded uncertainty covers.

    Example:
        >>> two = (BudgetEntry("repeatability", "A", 3.0, dof=4), BudgetEntry("scale", "B", 4.0))
        >>> budget = UncertaintyBudget(two)
        >>> budget.u, round(budget.dof, 2), round(budget.k, 3), round(budget.U, 2)
        (5.0, 30.86, 2.084, 10.42)
    """

    entries: tuple[BudgetEntry, ...]
    coverage: float = DECISION.coverage

    @property
    def u(self) -> float:
        """The combined standard uncertainty."""
        return math.hypot(*(entry.u for entry in self.entries))

    @property
    def dof(self) -> float:
        """The effective degrees of freedom, infinite if all sources are known."""
        if self.u == 0.0:
            return math.inf
        # Relative to u, as fourth powers of micrometres in metres leave the range of floats.
        total = sum((entry.u / self.u) ** 4 / entry.dof for entry in self.entries)
        return 1.0 / total if total > 0.0 else math.inf

    @property
    def k(self) -> float:
        """The coverage factor."""
        return coverage_factor(self.dof, self.coverage)

    @property
    def U(self) -> float:
        """The expanded uncertainty."""
        return self.k * self.u

    def share(self, entry: BudgetEntry) -> float:
        """Return the share of an entry in the variance, 0 to 1."""
        return (entry.u / self.u) ** 2 if self.u > 0.0 else 0.0


def coverage_factor(dof: float, coverage: float = DECISION.coverage) -> float:
    """Return the factor of a standard uncertainty that gives an interval of a probability.

    Args:
        dof: degrees of freedom, which need not be a whole number.
        coverage: the probability, 0 to 1.

    Raises:
        BadInputError: for a probability or degrees of freedom that are none.

    Example:
        >>> round(coverage_factor(10, 0.95), 2), round(coverage_factor(float("inf")), 2)
        (2.23, 2.0)
    """
    from scipy.special import ndtri, stdtrit

    p = (1.0 + coverage) / 2.0
    # The nearest numbers below 1 leave no probability to a tail, and the factor would be infinite.
    if not (coverage > 0.0 and p < 1.0):
        raise BadInputError(
            f"coverage probability {coverage}; expected more than 0, and less than 1 by 1e-15 or "
            "more"
        )
    if not dof > 0.0:
        raise BadInputError(f"{dof} degrees of freedom; expected more than 0")
    return float(ndtri(p) if math.isinf(dof) else stdtrit(dof, p))
