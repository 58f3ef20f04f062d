"""Numbers of the tests of candidates: what counts as chance, as observable and as a prediction."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

from pincal.thresholds import number

_EXAMPLES = "test_discovery_report.py::test_hidden_examples_come_out_right"
_CRITERION = "information criterion (-2 log likelihood)"
_STAGE = "test_tones.py::test_a_stage_is_found_at_its_order"
_BLOCKS = "test_rows.py::test_one_block_does_not_veto"
_SOFT = "test_elastic_rivals.py::test_a_compliance_is_as_sure_as_a_fit_without_it_is_bad"
_TWO_SOFT = (
    "test_elastic_rivals.py::test_two_compliances_of_which_one_gives_way_are_told_for_each_other"
)
_IN_DOUBT = (
    "test_selection.py::test_priors_in_doubt_are_the_likeliest_ones_with_a_candidate_and_without"
)
_BENT = "test_selection.py::test_small_tables_of_a_bent_arm_keep_its_elasticity"
_TOGETHER = "test_stability.py::test_strong_names_enter_a_half_together"
_UNEVEN = "test_uneven.py::test_a_scattering_joint_makes_no_more_of_chance_than_it_says"
_CONSTANT = "test_settling.py::test_the_time_constant_is_found_and_its_uncertainty"


@dataclass(frozen=True, kw_only=True)
class ScoreNumbers:
    """Score tests."""

    wider: float = number(
        10.0,
        "ratio",
        "test_bearings.py::test_no_wobble_is_found_where_geometry_is_beyond_its_priors",
        "factor by which the priors of geometry are widened where effects are tested",
        "an effect distinguished from geometry only by the priors would be found wherever a "
        "machine exceeds them, as arms with nearly parallel axes do: small errors of the axes are "
        "large displacements of their common normal",
    )
    blocks: int = number(
        8,
        "blocks",
        _EXAMPLES,
        "blocks of poses that are held out in turn",
        "seven eighths determine the model nearly as well as all",
    )
    predicts: float = number(
        1.0,
        "standard errors",
        _EXAMPLES,
        "by which held-out blocks have to improve for a prediction to be called better",
        "one in six by chance; other criteria are stricter",
    )
    much: float = number(
        0.1,
        "ratio",
        _TOGETHER,
        "part of the squares that the others leave above which an expected name enters with them",
        "chosen: what explains so much enters before what explains little, in any order",
    )
    beyond_doubt: float = number(
        1e-9,
        "ratio",
        _TOGETHER,
        "fraction of the probability of a false name below which an expected name enters at once",
        "chosen: beyond doubt among millions of candidates",
    )
    searched: float = number(
        2.0,
        "standard errors",
        _STAGE,
        "the same for an effect selected among many on all blocks, such as waves of all orders",
        "selection favours chance in held-out blocks, too: of the significant ripples on a real "
        "UR10 only one is found in both series, at 2.4 and 2.2; the others reach 1.7 at most",
    )
    veto: float = number(
        2.0,
        "standard errors",
        _BLOCKS,
        "that blocks of poses have to improve for one of them not to have a veto",
        "1 in 40 by chance",
    )
    fewest_blocks: int = number(
        6,
        "blocks",
        _BLOCKS,
        "among which the extreme ones can be identified",
        "four remain without them",
    )
    against: float = number(
        2.0,
        "standard errors",
        _BENT,
        "by which the prediction of blocks has to deteriorate with a prior to contradict it",
        "1 in 40 by chance",
    )
    most_explained: float = number(
        0.999999,
        "ratio",
        _EXAMPLES,
        "largest fraction of the squares that can be removed",
        "keeps the F ratio finite",
    )
    observed: float = number(
        0.01,
        "ratio",
        "test_bearings.py::test_what_geometry_takes_of_a_wobble_is_not_counted",
        "smallest reduction of an observable parameter's prior variance by the data, as a fraction",
        "an effect distinguished only by the model's priors is not observable, such as a tilt that "
        "implausible geometry would explain",
    )
    held: float = number(
        1e6,
        "ratio",
        _TWO_SOFT,
        "prior information of held parameters, in units of that of the data",
        "a thousandth of their standard deviation: negligible",
    )
    mass_beliefs: tuple[tuple[float, float], ...] = number(
        ((0.4, 0.0), (2.0, 2.0 * log(30.0))),
        "ratio, " + _CRITERION,
        _IN_DOUBT,
        "alternative factors for these, and their costs: 2 %, or, with odds of 30 to 1 against it, "
        "10 %; the data determine which is likelier, with an effect and without",
        "gravity compensators and wrong payloads (lambda >= 60, masses 3 % off) are then "
        "named on more arms than with 5 % "
        "for all, and arms whose masses are 10 % off get no more false names",
    )
    most_taken: float = number(
        0.9,
        "ratio",
        "test_uneven.py::test_even_noise_changes_nothing",
        "largest leverage of a visit on an effect",
        "chosen: a visit that determines an effect alone does not show its noise",
    )
    uneven: float = number(
        0.05,
        "probability",
        _UNEVEN,
        "probability that even noise is mistaken for uneven",
        "usual: the resulting test is valid for even noise, too, but weaker",
    )
    drawn: int = number(
        200,
        "tables",
        "test_stability.py::test_a_bootstrap_of_noise_has_any_chance_alike",
        "tables that a bootstrap draws",
        "the smallest p-value that they can show is 1/201",
    )
    drawn_from: float = number(
        1e-10,
        "ratio",
        "test_stability.py::test_what_is_there_is_no_chance",
        "fraction of the largest eigenvalue of S', scaled to a diagonal of 1, below which "
        "one is rounding",
        "above the accumulated rounding errors of products, 1e-16 each",
    )
    order: float = number(
        0.1,
        "ratio",
        "test_rows.py::test_correlated_noise_is_estimated_and_left_white",
        "mean square of a joint's steps from row to row, over that of random ones, below "
        "which it moved along the rows",
        "a path of a few turning points, or sorted poses",
    )
    expansions: int = number(
        8,
        "times",
        _CONSTANT,
        "that an effect with a time constant is linearised again at most",
        "chosen: each is a Newton step",
    )
    sure: float = number(
        4.0,
        "standard deviations",
        _SOFT,
        "by which a compliance has to differ from zero to be named by itself",
        "1 in 16000 by chance, of some twenty compliances",
    )


TESTING = ScoreNumbers()
