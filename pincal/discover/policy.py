"""Thresholds of a discovery that a user may change, each with its origin.

Those that are the same in every search stand in the files ``..._numbers.py`` beside this one, one
for each subject. docs/criteria.md derives the criteria that use them.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_RATES = "test_discovery_rates.py::"
_NAMED = _RATES + "test_a_hidden_effect_is_named_with_its_joint"
_MANY_NAMED = _RATES + "test_hidden_effects_are_found_and_named"
_PAIRS = _RATES + "test_two_hidden_effects_are_both_named"
_SOUND = _RATES + "test_sound_data_bring_in_no_name"
_NO_NAME = _RATES + "test_effects_outside_the_catalogue_get_no_name"
_EXAMPLES = "test_discovery_report.py::test_hidden_examples_come_out_right"
_SMALL = "test_selection.py::test_priors_on_effects_decide_on_small_tables"
_DECISIONS = "test_discovery_decisions.py::"
_CRITERION = "information criterion (-2 log likelihood)"
_FINER = "test_smooth_curves.py::test_intervals_hold_a_curve_as_rough_as_it_is_believed"


@dataclass(frozen=True, kw_only=True)
class Policy:
    """Thresholds and limits of a discovery.

    The metadata of each field give its meaning, unit, origin and the test that pins it.

    Example:
        >>> cautious = Policy(false_name=1e-4)
        >>> cautious.least_gain(5000.0, declared=True)
        50.0
    """

    false_name: float = number(
        0.005,
        "probability",
        _SOUND,
        "probability per step that data without an effect lead to any name",
        "about one false name in a hundred discoveries of one to three steps",
    )
    elastic: float = number(
        1e-4,
        "probability",
        _SOUND,
        "p-value below which elasticity enters the model",
        "every arm is elastic, so one test is enough; it is tested again at the end",
    )
    tie: float = number(
        6.0,
        _CRITERION,
        _DECISIONS + "test_rivals_are_those_that_leave_little",
        "difference in cost below which two effects count as equally good",
        "odds of 20 to 1 (2 log 20 = 6.0)",
    )
    near_tie: float = number(
        15.0,
        _CRITERION,
        _DECISIONS + "test_rivals_are_those_that_leave_little",
        "difference in cost up to which an effect is considered as a rival",
        "2.5 ties: odds of 1800 to 1",
    )
    without_name: float = number(
        6.0,
        _CRITERION,
        _NAMED,
        "by how much an unnamed effect has to be better than a named one",
        "one tie: a named effect is preferred unless the odds against it are 20 to 1",
    )
    across: float = number(
        2.0,
        _CRITERION,
        _NO_NAME,
        "by how much more if it acts across a joint's axis",
        "a rotation of a joint across its axis often resembles one of a neighbour about "
        "its own, which is simpler",
    )
    hint: float = number(
        0.3,
        "probability",
        "test_whole_curves.py::test_a_simple_curve_may_be_part_of_a_whole_one",
        "p-value below which a simple curve of a joint's position may be part of a finer one",
        "a hint, not a finding: it only adds an equivalent effect, so it may be wrong in "
        "a third of the cases",
    )
    adds_nothing: float = number(
        1e-3,
        "probability",
        _MANY_NAMED,
        "p-value above which an effect adds nothing to another of higher cost",
        "chosen: strict, because many rivals are tested against each effect",
    )
    told_apart: float = number(
        1e-5,
        "probability",
        _MANY_NAMED,
        "p-value above which an effect adds nothing to another of equal cost",
        "of equally good effects both are kept unless clearly distinguished",
    )
    remainder: float = number(
        0.02,
        "probability",
        _NO_NAME,
        "p-value below which an effect leaves a dependence on its variable where it acts",
        "it stays among the equivalent effects, so it may be wrong in 2 % of the cases",
    )
    sure: float = number(
        12.0,
        "Wald statistic per parameter",
        _PAIRS,
        "above which an effect is so far from zero that it is not tested again",
        "3.5 standard deviations; it saves a test and decides nothing by itself",
    )
    drop: float = number(
        0.1,
        "ratio",
        _SOUND,
        "fraction of the probability of a false name at which an effect is removed",
        "an effect selected among many is tested again alone, so the limit is stricter",
    )
    rows_each: float = number(
        3.0,
        "rows per parameter",
        _SMALL,
        "below which the priors on effects have to support an effect, too",
        "with fewer, the model adapts to a few rows, and p-values count that as evidence",
    )
    share: float = number(
        0.01,
        "ratio",
        _DECISIONS + "test_what_matters_to_nobody_is_left_out",
        "fraction of the weighted squares that a relevant effect has to remove; twice if "
        "the noise is not declared",
        "0.5 % of the error: less than any user would act on",
    )
    gain: float = number(
        100.0,
        "noise variance",
        _DECISIONS + "test_what_matters_to_nobody_is_left_out",
        "reduction of the weighted squares that is enough, however many readings there are",
        "ten standard deviations of one parameter: certain, however small its share",
    )
    close: int = number(
        12,
        "effects",
        _EXAMPLES,
        "named effects that take part when unnamed ones are tested",
        "chosen: it bounds the size of the second table",
    )
    most_steps: int = number(
        14, "steps", _EXAMPLES, "effects that are added at most", "chosen: a bound on the time"
    )
    finer: float = number(
        2.0,
        "ratio",
        _FINER,
        "resolution of final curves relative to the shortest waves of which rows have as "
        "much information as the prior",
        "a curve cut off there states 65 % of its variance, cut off at half of them 95 %; "
        "1 in subsamples",
    )
    most_rivals: int = number(
        6,
        "effects",
        _DECISIONS + "test_each_heading_is_listed_once",
        "equivalent effects that are listed",
        "what a reader can act on",
    )
    enough_readings: int = number(
        9000,
        "readings",
        "benchmark.py",
        "readings from which effects are chosen; in the end all rows are fitted and "
        "resolve the curves",
        "an effect that reduces the squares of more readings by 100 still reduces these enough; "
        "12000 leave a real UR10 1 % more exact, in up to three times the time",
    )

    def least_gain(self, squares: float, *, declared: bool) -> float:
        """Return the smallest relevant reduction of a sum of squares by an effect, both in units of
        the noise.

        Where the noise is not declared, the residuals may contain other errors, of which any effect
        explains a little.
        """
        return min(self.gain, (1.0 if declared else 2.0) * self.share * squares)


POLICY = Policy()
