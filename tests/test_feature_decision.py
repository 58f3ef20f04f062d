"""Decisions on tolerances: risks at the limit are those that the rule states."""

import math

import numpy as np
import pytest

from pincal.errors import BadInputError
from pincal.features.decision import ConformityVerdict, DecisionRule, conformance_probability, overall_verdict
from pincal.features.part_feature import ToleranceLimits

LIMITS = ToleranceLimits(9.8, 10.2)


@pytest.mark.parametrize("dof", [math.inf, 6.0])
def test_wrong_acceptances_at_the_limit_are_within_the_stated_risk(dof: float) -> None:
    """1000 parts just beyond a limit, with u known or estimated from a few readings."""
    rng = np.random.default_rng(5)
    rule = DecisionRule()
    accepted = 0
    for _ in range(1000):
        u = 0.02 if math.isinf(dof) else 0.02 * math.sqrt(rng.chisquare(dof) / dof)
        accepted += rule.decide(10.2000001 + 0.02 * rng.normal(), u, LIMITS, dof).verdict == "conforms"

    assert accepted <= 1000 * rule.most_risk


def test_a_narrow_tolerance_is_within_the_stated_risk() -> None:
    """Limits as near as two guard bands: nothing but the middle is accepted."""
    rng = np.random.default_rng(6)
    rule = DecisionRule()
    narrow = ToleranceLimits(-0.0405, 0.0405)
    values = 0.041 * rng.choice([-1.0, 1.0], 1000) + 0.02 * rng.normal(size=1000)
    accepted = sum(rule.decide(float(value), 0.02, narrow).verdict == "conforms" for value in values)

    assert accepted <= 1000 * rule.most_risk


CASES: dict[str, tuple[float, ConformityVerdict, ConformityVerdict]] = {
    "middle": (10.0, "conforms", "conforms"),
    "at the guard band": (10.16, "conforms", "conforms"),
    "within it": (10.17, "undecided", "conforms"),
    "beyond the limit": (10.21, "undecided", "does not conform"),
    "beyond the guard band": (10.241, "does not conform", "does not conform"),
    "below": (9.7, "does not conform", "does not conform"),
}


@pytest.mark.parametrize("case", CASES)
def test_values_are_decided_by_the_rule(case: str) -> None:
    """The guard band is 2 u on both sides of a limit; simple acceptance has none."""
    value, guarded, simple = CASES[case]

    assert DecisionRule().decide(value, 0.019999, LIMITS).verdict == guarded
    assert DecisionRule("simple").decide(value, 0.019999, LIMITS).verdict == simple


def test_the_probability_is_that_of_the_distribution() -> None:
    """JCGM 106, 7.3: one half at a limit, and 97.7 % at two standard uncertainties from it."""
    assert conformance_probability(10.2, 0.01, LIMITS) == pytest.approx(0.5)
    assert conformance_probability(10.18, 0.01, LIMITS) == pytest.approx(0.97725, abs=1e-5)
    assert conformance_probability(10.18, 0.01, ToleranceLimits(upper=10.2)) == pytest.approx(0.97725, abs=1e-5)
    assert conformance_probability(10.18, 0.01, LIMITS, 3.0) < 0.94
    assert conformance_probability(10.18, 0.0, LIMITS) == 1.0
    decision = DecisionRule().decide(10.17, 0.01, LIMITS)
    assert decision.risk == pytest.approx(0.00135, abs=1e-5)


def test_one_bad_feature_makes_a_bad_part() -> None:
    """And one that is open leaves the part open."""
    assert overall_verdict(("conforms", "undecided", "does not conform")) == "does not conform"
    assert overall_verdict(("conforms", "undecided")) == "undecided"
    assert overall_verdict(("conforms",)) == "conforms"


def test_the_rule_names_its_risk() -> None:
    """With its guard band."""
    assert "guard band U of 95.45 % coverage, risk of a false acceptance up to 4.5 %" in DecisionRule().words
    assert "up to 50 %" in DecisionRule("simple").words


def test_what_is_no_decision_is_refused() -> None:
    """Unknown rules, numbers that are none, limits that are turned round."""
    with pytest.raises(BadInputError, match="guarded or simple"):
        DecisionRule("strict")  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match="finite"):
        DecisionRule().decide(math.nan, 1.0, LIMITS)
    with pytest.raises(BadInputError, match="lower before"):
        DecisionRule().decide(1.0, 1.0, ToleranceLimits(2.0, 1.0))
