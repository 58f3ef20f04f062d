"""Budgets: the GUM's own examples and tables."""

import math

import pytest

from pincal.errors import BadInputError
from pincal.features.budget import BudgetEntry, UncertaintyBudget, coverage_factor

# JCGM 100:2008, table G.2: t for 95 % and 95.45 % by degrees of freedom.
TABLE = {1: (12.71, 13.97), 2: (4.30, 4.53), 5: (2.57, 2.65), 10: (2.23, 2.28), 30: (2.04, 2.09), math.inf: (1.96, 2.0)}


@pytest.mark.parametrize("dof", TABLE)
def test_coverage_factors_are_those_of_the_table(dof: float) -> None:
    """JCGM 100, table G.2; without another wish the probability is 95.45 %."""
    assert round(coverage_factor(dof, 0.95), 2) == TABLE[dof][0]
    assert round(coverage_factor(dof), 2) == TABLE[dof][1]


def test_a_probability_whose_factor_is_infinite_is_refused() -> None:
    """The largest number below 1 leaves nothing to either tail; ten of its steps lower are something."""
    with pytest.raises(BadInputError, match="less than 1 by 1e-15"):
        coverage_factor(math.inf, math.nextafter(1.0, 0.0))

    assert math.isfinite(coverage_factor(math.inf, 1.0 - 1e-15))


def test_the_end_gauge_of_the_gum() -> None:
    """JCGM 100, H.1: 32 nm with 16 degrees of freedom, and 93 nm for 99 %."""
    budget = UncertaintyBudget(
        (
            BudgetEntry("standard", "B", 25.0, 18),
            BudgetEntry("repeated observations", "A", 5.8, 24),
            BudgetEntry("random effects of the comparator", "A", 3.9, 5),
            BudgetEntry("systematic effects of the comparator", "B", 6.7, 8),
            BudgetEntry("difference of expansion coefficients", "B", 2.9, 50),
            BudgetEntry("difference of temperatures", "B", 16.6, 2),
        )
    )

    assert budget.u == pytest.approx(31.7, abs=0.3)
    assert math.floor(budget.dof) == 16
    assert coverage_factor(16, 0.99) * 32.0 == pytest.approx(93.0, abs=0.5)
    assert sum(budget.share(entry) for entry in budget.entries) == pytest.approx(1.0)


def test_known_sources_have_no_end_of_degrees_of_freedom() -> None:
    """And very small numbers do not leave the range of floats."""
    known = UncertaintyBudget((BudgetEntry("a", "B", 1e-90), BudgetEntry("b", "B", 0.0)))
    small = UncertaintyBudget((BudgetEntry("a", "A", 1e-90, 5),))

    assert math.isinf(known.dof)
    assert small.dof == pytest.approx(5.0)
    assert math.isinf(UncertaintyBudget(()).dof)


REFUSED = {
    "negative": (lambda: BudgetEntry("a", "A", -1.0), "0 or more"),
    "dof": (lambda: BudgetEntry("a", "A", 1.0, 0.0), "more than 0"),
    "type": (lambda: BudgetEntry("a", "C", 1.0), "A or B"),  # type: ignore[arg-type]
    "coverage": (lambda: coverage_factor(3.0, 1.0), "less than 1"),
    "coverage dof": (lambda: coverage_factor(0.0), "more than 0"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_uncertainty_is_refused(case: str) -> None:
    """With what is expected."""
    make, words = REFUSED[case]

    with pytest.raises(BadInputError, match=words):
        make()
