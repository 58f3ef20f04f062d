"""The numbers by which features conform to their tolerances, and gauges are capable."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number


@dataclass(frozen=True, kw_only=True)
class DecisionNumbers:
    """Probabilities of intervals and decisions, and levels of studies of gauges."""

    coverage: float = number(
        0.9545,
        "probability",
        "test_uncertainty_budget.py::test_coverage_factors_are_those_of_the_table",
        "that an expanded uncertainty covers, unless the user asks for another one",
        "k = 2 for a normal distribution, as JCGM 100, 6.3.3 and calibration laboratories have it",
    )
    pooled: float = number(
        0.05,
        "probability",
        "test_gauge_study.py::test_the_example_of_the_manual",
        "of an interaction of parts and operators as large by chance, above which it counts as "
        "repeatability",
        "AIAG, Measurement Systems Analysis, 4th edition, appendix A: an interaction that is not "
        "significant is pooled",
    )
    least_repeats: int = number(
        10,
        "readings",
        "test_gauge_study.py::test_too_few_readings_are_refused",
        "of one feature, for a type-1 study at the least",
        "manufacturers ask for 50 and never fewer than 20; with 10 the interval of Cg is already "
        "from .55 to 1.45 of it",
    )


DECISION = DecisionNumbers()
