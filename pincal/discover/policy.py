"""What a discovery goes by: every number that it decides with, and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


def _number(default: float, unit: str, pinned_by: str, meaning: str, origin: str) -> Any:
    """Return a field for a number: its unit, the test that fixes it, what it means, and why it has this value."""
    return field(default=default, metadata={"unit": unit, "meaning": meaning, "origin": origin, "pinned_by": pinned_by})


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


@dataclass(frozen=True, kw_only=True)
class Policy:
    """Thresholds and limits of a discovery.

    Each field says in its metadata what it means, in which unit, why it has this value and which test fixes it.

    Example:
        >>> cautious = Policy(false_name=1e-4)
        >>> cautious.least_gain(5000.0, declared=True)
        50.0
    """

    # fmt: off
    false_name: float = _number(0.005, "probability", _SOUND,
        "chance per step that sound data bring in any name at all",
        "about one false name in a hundred discoveries of one to three steps")
    elastic: float = _number(1e-4, "probability", _SOUND,
        "p-value below which elasticity enters the model",
        "every arm is elastic, so one test of it is enough; it is judged again at the end")
    tie: float = _number(6.0, _CRITERION, _DECISIONS + "test_rivals_are_those_that_leave_little",
        "difference in cost below which two effects count as equally good",
        "odds of 20 to 1 (2 log 20 = 6.0)")
    near_tie: float = _number(15.0, _CRITERION, _DECISIONS + "test_rivals_are_those_that_leave_little",
        "difference in cost up to which an effect is looked at as a rival at all",
        "2.5 ties: odds of 1800 to 1")
    without_name: float = _number(6.0, _CRITERION, _NAMED,
        "by how much a dependence without a name has to be better than a name",
        "one tie: a name is believed unless the odds against it are 20 to 1")
    across: float = _number(2.0, _CRITERION, _NO_NAME,
        "by how much more if it acts across a joint's axis",
        "what turns a joint across its axis often turns a neighbour about its own, the plainer of the two")
    hint: float = _number(0.3, "probability", _DECISIONS + "test_a_simple_curve_may_be_part_of_a_whole_one",
        "p-value below which a simple curve of a joint's position may be part of a finer one",
        "a hint, not a finding: it only adds an equivalent effect, so it may be wrong in a third of the cases")
    adds_nothing: float = _number(1e-3, "probability", _MANY_NAMED,
        "p-value above which an effect adds nothing to another that is dearer",
        "chosen: strict, because many rivals are tested against each effect")
    told_apart: float = _number(1e-5, "probability", _MANY_NAMED,
        "p-value above which an effect adds nothing to another that is as cheap",
        "of equally good effects both stay unless they are told apart beyond doubt")
    remainder: float = _number(0.02, "probability", _NO_NAME,
        "p-value below which a name leaves something of what it follows in the place where it acts",
        "the name stays among the equivalent effects, so it may be wrong in a fiftieth of the cases")
    sure: float = _number(12.0, "Wald statistic per parameter", _PAIRS,
        "above which an effect is so far from zero that it need not be judged again",
        "3.5 standard deviations; it saves a test and decides nothing by itself")
    drop: float = _number(0.1, "ratio", _SOUND,
        "part of the chance of a false name at which an effect is taken out again",
        "an effect that entered by chance among many is tested once more alone, so more is asked of it")
    rows_each: float = _number(3.0, "rows per parameter", _SMALL,
        "below which priors on effects have to speak for an effect, too",
        "with fewer, the model of so many parameters bends to a few rows, and p-values count that as evidence")
    share: float = _number(0.01, "ratio", _DECISIONS + "test_what_matters_to_nobody_is_left_out",
        "part of the weighted squares that an effect has to take off to matter; twice if the noise is not declared",
        "0.5 % of the error: less than any user would act on")
    gain: float = _number(100.0, "noise variance", _DECISIONS + "test_what_matters_to_nobody_is_left_out",
        "reduction of the weighted squares that is enough, however many readings there are",
        "ten standard deviations of one parameter: sure, whatever its share")
    close: int = _number(12, "effects", _EXAMPLES,
        "names that take part when dependences without a name are tried",
        "chosen: it bounds the size of the second table")
    most_steps: int = _number(14, "steps", _EXAMPLES,
        "effects that are added at most",
        "chosen: a bound on the time")
    most_rivals: int = _number(6, "effects", _DECISIONS + "test_each_heading_is_listed_once",
        "equivalent effects that are listed",
        "what a reader can act on")
    enough_readings: int = _number(12000, "readings", "benchmark.py",
        "readings from which effects are chosen; in the end all rows are fitted and resolve the curves",
        "what takes 100 off the squares of more readings still takes enough off these; UR10 B gives the same names")
    # fmt: on

    def least_gain(self, squares: float, *, declared: bool) -> float:
        """Return what an effect has to take off a sum of squares to matter, both in units of the noise.

        Where the noise is not declared, what is left may be other than noise, and anything takes a little off it.
        """
        return min(self.gain, (1.0 if declared else 2.0) * self.share * squares)


POLICY = Policy()
ALPHA = POLICY.false_name
