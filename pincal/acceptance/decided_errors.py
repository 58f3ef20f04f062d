"""Outcomes of acceptance tests, by the rule that decides on features of a part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from pincal.features.decision import ConformityVerdict, DecisionRule
from pincal.features.part_feature import ToleranceLimits

AcceptanceOutcome = Literal["pass", "fail", "undecided"]
_OUTCOMES: dict[ConformityVerdict, AcceptanceOutcome] = {
    "conforms": "pass",
    "does not conform": "fail",
    "undecided": "undecided",
}


def decided(error: float, permitted: float, uncertainty: float) -> AcceptanceOutcome:
    """Return whether the size of an error is proven to be permitted, or not to be, by the same rule
    as features of a part.

    Args:
        error: with either sign [m].
        permitted: the MPE [m].
        uncertainty: standard uncertainty of the test [m].

    Example:
        >>> [decided(error, 2e-4, 1e-5) for error in (1.7e-4, -1.9e-4, 2.3e-4)]
        ['pass', 'undecided', 'fail']
    """
    limits = ToleranceLimits(-permitted, permitted)
    return _OUTCOMES[DecisionRule().decide(error, uncertainty, limits).verdict]


def outcome_of_all(outcomes: Sequence[AcceptanceOutcome]) -> AcceptanceOutcome:
    """Return the outcome of a test with several: all have to pass."""
    if "fail" in outcomes:
        return "fail"
    return "undecided" if "undecided" in outcomes else "pass"
