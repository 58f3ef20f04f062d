"""What a discovery goes by: every number that it decides with, and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


def _number(default: float, *, unit: str, meaning: str, origin: str, pinned_by: str) -> Any:
    """Return a field for a number: its unit, what it means, why it has this value, and the test that fixes it."""
    return field(default=default, metadata={"unit": unit, "meaning": meaning, "origin": origin, "pinned_by": pinned_by})


_RATES = "test_discovery_rates.py::"
_NAMED = _RATES + "test_a_hidden_effect_is_named_with_its_joint"
_MANY_NAMED = _RATES + "test_hidden_effects_are_found_and_named"
_PAIRS = _RATES + "test_two_hidden_effects_are_both_named"
_SOUND = _RATES + "test_sound_data_bring_in_no_name"
_NO_NAME = _RATES + "test_effects_outside_the_catalogue_get_no_name"
_EXAMPLES = "test_discovery_report.py::test_hidden_examples_come_out_right"
_DECISIONS = "test_discovery_decisions.py::"


@dataclass(frozen=True, kw_only=True)
class Policy:
    """Thresholds and limits of a discovery.

    Each field says in its metadata what it means, in which unit, why it has this value and which test fixes it.

    Example:
        >>> cautious = Policy(false_name=1e-4)
        >>> cautious.least_gain(5000.0, declared=True)
        50.0
    """

    false_name: float = _number(
        0.005,
        unit="probability",
        meaning="chance per step that sound data bring in any name at all",
        origin="about one false name in a hundred discoveries of one to three steps",
        pinned_by=_SOUND,
    )
    elastic: float = _number(
        1e-4,
        unit="probability",
        meaning="p-value below which elasticity enters the model",
        origin="every arm is elastic, so one test of it is enough; it is judged again at the end",
        pinned_by=_SOUND,
    )
    tie: float = _number(
        6.0,
        unit="information criterion (-2 log likelihood)",
        meaning="difference in cost below which two effects count as equally good",
        origin="odds of 20 to 1 (2 log 20 = 6.0)",
        pinned_by=_DECISIONS + "test_rivals_are_those_that_leave_little",
    )
    near_tie: float = _number(
        15.0,
        unit="information criterion (-2 log likelihood)",
        meaning="difference in cost up to which an effect is looked at as a rival at all",
        origin="2.5 ties: odds of 1800 to 1",
        pinned_by=_DECISIONS + "test_rivals_are_those_that_leave_little",
    )
    without_name: float = _number(
        6.0,
        unit="information criterion (-2 log likelihood)",
        meaning="by how much a dependence without a name has to be better than a name",
        origin="one tie: a name is believed unless the odds against it are 20 to 1",
        pinned_by=_NAMED,
    )
    across: float = _number(
        2.0,
        unit="information criterion (-2 log likelihood)",
        meaning="by how much more if it acts across a joint's axis",
        origin="what turns a joint across its axis often turns a neighbour about its own, the plainer of the two",
        pinned_by=_NO_NAME,
    )
    hint: float = _number(
        0.3,
        unit="probability",
        meaning="p-value below which a simple curve of a joint's position may be part of a finer one",
        origin="a hint, not a finding: it only adds an equivalent effect, so it may be wrong in a third of the cases",
        pinned_by=_DECISIONS + "test_a_simple_curve_may_be_part_of_a_whole_one",
    )
    adds_nothing: float = _number(
        1e-3,
        unit="probability",
        meaning="p-value above which an effect adds nothing to another that is dearer",
        origin="chosen: strict, because many rivals are tested against each effect",
        pinned_by=_MANY_NAMED,
    )
    told_apart: float = _number(
        1e-5,
        unit="probability",
        meaning="p-value above which an effect adds nothing to another that is as cheap",
        origin="of equally good effects both stay unless they are told apart beyond doubt",
        pinned_by=_MANY_NAMED,
    )
    sure: float = _number(
        12.0,
        unit="Wald statistic per parameter",
        meaning="above which an effect is so far from zero that it need not be judged again",
        origin="3.5 standard deviations; it saves a test and decides nothing by itself",
        pinned_by=_PAIRS,
    )
    drop: float = _number(
        0.1,
        unit="ratio",
        meaning="part of the chance of a false name at which an effect is taken out again",
        origin="an effect that entered by chance among many is tested once more alone, so more is asked of it",
        pinned_by=_SOUND,
    )
    share: float = _number(
        0.01,
        unit="ratio",
        meaning="part of the weighted squares that an effect has to take off to matter; twice if the noise is not declared",
        origin="0.5 % of the error: less than any user would act on",
        pinned_by=_DECISIONS + "test_what_matters_to_nobody_is_left_out",
    )
    gain: float = _number(
        100.0,
        unit="noise variance",
        meaning="reduction of the weighted squares that is enough, however many readings there are",
        origin="ten standard deviations of one parameter: sure, whatever its share",
        pinned_by=_DECISIONS + "test_what_matters_to_nobody_is_left_out",
    )
    tried: int = _number(
        5,
        unit="effects",
        meaning="cheapest effects that are tried on rows left out before it is said that nothing predicts",
        origin="chosen: it bounds the time of the last step",
        pinned_by=_EXAMPLES,
    )
    close: int = _number(
        12,
        unit="effects",
        meaning="names that take part when dependences without a name are tried",
        origin="chosen: it bounds the size of the second table",
        pinned_by=_EXAMPLES,
    )
    most_steps: int = _number(
        14,
        unit="steps",
        meaning="effects that are added at most",
        origin="chosen: a bound on the time",
        pinned_by=_EXAMPLES,
    )
    most_rivals: int = _number(
        6,
        unit="effects",
        meaning="equivalent effects that are listed",
        origin="what a reader can act on",
        pinned_by=_DECISIONS + "test_each_heading_is_listed_once",
    )
    enough_readings: int = _number(
        12000,
        unit="readings",
        meaning="readings from which effects are chosen; in the end all rows are fitted and resolve the curves",
        origin="what takes 100 off the squares of more readings still takes enough off these; UR10 B gives the same names",
        pinned_by="benchmark.py",
    )

    def least_gain(self, squares: float, *, declared: bool) -> float:
        """Return what an effect has to take off a sum of squares to matter, both in units of the noise.

        Where the noise is not declared, what is left may be other than noise, and anything takes a little off it.
        """
        return min(self.gain, (1.0 if declared else 2.0) * self.share * squares)


POLICY = Policy()
ALPHA = POLICY.false_name
