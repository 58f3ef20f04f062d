"""Thresholds of a discovery: every number by which it decides, and its origin.

A user may change those of :class:`Policy`. The others are the same in every search: one class and
one object of it for each subject. docs/criteria.md derives the criteria that use them.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log

from pincal.thresholds import number as _number

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
_REPORT = "test_discovery_report.py::"
_LOCATED = _REPORT + "test_the_hidden_effect_is_named_and_was_located_before"
_NOWHERE = _REPORT + "test_nothing_is_located_where_there_is_only_noise"
_PERIOD = _REPORT + "test_period_is_that_of_a_tone_and_none_of_anything_else"
_POWER = _REPORT + "test_effects_of_detectable_size_are_found_nine_times_of_ten"
_APART = _REPORT + "test_tell_apart_stands_exactly_where_there_are_equivalents"
_SCATTER = "test_scatter.py::test_scatter_of_a_joint_is_found_with_its_size"
_NEIGHBOURS = "test_scatter.py::test_neighbours_tell_scatter_from_a_function"
_JOINT_NOISE = "test_joint_noise.py::test_noise_of_the_joints_is_found_with_its_size"
_STAGE = "test_tones.py::test_a_stage_is_found_at_its_order"
_QUIET = "test_tones.py::test_sound_residuals_show_no_wave"
_LINE = "test_tones.py::test_what_the_span_does_not_tell_apart_is_one_line"
_REMAINDER = "test_remainder.py::test_a_smooth_error_of_all_joints_is_predicted"
_WORSE = "test_remainder.py::test_a_region_that_is_worse_refuses_it"
_SOUND_REMAINDER = "test_remainder.py::test_noise_has_no_remainder"
_PEAK = "test_joint_pairs.py::test_what_is_not_refined_would_not_be_found"
_OF_TWO = "test_joint_pairs.py::test_a_wave_of_two_joints_is_found_with_its_orders"
_FINER = "test_smooth_curves.py::test_intervals_hold_a_curve_as_rough_as_it_is_believed"
_SMOOTH = "test_smooth_curves.py::test_a_smooth_curve_is_closer_to_the_true_one"
_LIKELIEST = "test_smooth_curves.py::test_roughness_is_where_the_readings_are_likeliest"
_REPEATS = "test_repeats.py::"
_BLOCKS = "test_rows.py::test_one_block_does_not_veto"
_SCAN = "test_tones.py::test_the_scan_is_least_squares_of_a_sine_and_a_cosine"
_SOFT = "test_elastic_rivals.py::test_a_compliance_is_as_sure_as_a_fit_without_it_is_bad"
_TWO_SOFT = (
    "test_elastic_rivals.py::test_two_compliances_of_which_one_gives_way_are_told_for_each_other"
)
_IN_DOUBT = (
    "test_selection.py::test_priors_in_doubt_are_the_likeliest_ones_with_a_candidate_and_without"
)
_BENT = "test_selection.py::test_small_tables_of_a_bent_arm_keep_its_elasticity"
_UNEVEN = "test_uneven.py::test_a_scattering_joint_makes_no_more_of_chance_than_it_says"
_CONSTANT = "test_settling.py::test_the_time_constant_is_found_and_its_uncertainty"


@dataclass(frozen=True, kw_only=True)
class Policy:
    """Thresholds and limits of a discovery.

    The metadata of each field give its meaning, unit, origin and the test that pins it.

    Example:
        >>> cautious = Policy(false_name=1e-4)
        >>> cautious.least_gain(5000.0, declared=True)
        50.0
    """

    false_name: float = _number(
        0.005,
        "probability",
        _SOUND,
        "probability per step that data without an effect lead to any name",
        "about one false name in a hundred discoveries of one to three steps",
    )
    elastic: float = _number(
        1e-4,
        "probability",
        _SOUND,
        "p-value below which elasticity enters the model",
        "every arm is elastic, so one test is enough; it is tested again at the end",
    )
    tie: float = _number(
        6.0,
        _CRITERION,
        _DECISIONS + "test_rivals_are_those_that_leave_little",
        "difference in cost below which two effects count as equally good",
        "odds of 20 to 1 (2 log 20 = 6.0)",
    )
    near_tie: float = _number(
        15.0,
        _CRITERION,
        _DECISIONS + "test_rivals_are_those_that_leave_little",
        "difference in cost up to which an effect is considered as a rival",
        "2.5 ties: odds of 1800 to 1",
    )
    without_name: float = _number(
        6.0,
        _CRITERION,
        _NAMED,
        "by how much an unnamed effect has to be better than a named one",
        "one tie: a named effect is preferred unless the odds against it are 20 to 1",
    )
    across: float = _number(
        2.0,
        _CRITERION,
        _NO_NAME,
        "by how much more if it acts across a joint's axis",
        "a rotation of a joint across its axis often resembles one of a neighbour about "
        "its own, which is simpler",
    )
    hint: float = _number(
        0.3,
        "probability",
        "test_whole_curves.py::test_a_simple_curve_may_be_part_of_a_whole_one",
        "p-value below which a simple curve of a joint's position may be part of a finer one",
        "a hint, not a finding: it only adds an equivalent effect, so it may be wrong in "
        "a third of the cases",
    )
    adds_nothing: float = _number(
        1e-3,
        "probability",
        _MANY_NAMED,
        "p-value above which an effect adds nothing to another of higher cost",
        "chosen: strict, because many rivals are tested against each effect",
    )
    told_apart: float = _number(
        1e-5,
        "probability",
        _MANY_NAMED,
        "p-value above which an effect adds nothing to another of equal cost",
        "of equally good effects both are kept unless clearly distinguished",
    )
    remainder: float = _number(
        0.02,
        "probability",
        _NO_NAME,
        "p-value below which an effect leaves a dependence on its variable where it acts",
        "it stays among the equivalent effects, so it may be wrong in 2 % of the cases",
    )
    sure: float = _number(
        12.0,
        "Wald statistic per parameter",
        _PAIRS,
        "above which an effect is so far from zero that it is not tested again",
        "3.5 standard deviations; it saves a test and decides nothing by itself",
    )
    drop: float = _number(
        0.1,
        "ratio",
        _SOUND,
        "fraction of the probability of a false name at which an effect is removed",
        "an effect selected among many is tested again alone, so the limit is stricter",
    )
    rows_each: float = _number(
        3.0,
        "rows per parameter",
        _SMALL,
        "below which the priors on effects have to support an effect, too",
        "with fewer, the model adapts to a few rows, and p-values count that as evidence",
    )
    share: float = _number(
        0.01,
        "ratio",
        _DECISIONS + "test_what_matters_to_nobody_is_left_out",
        "fraction of the weighted squares that a relevant effect has to remove; twice if "
        "the noise is not declared",
        "0.5 % of the error: less than any user would act on",
    )
    gain: float = _number(
        100.0,
        "noise variance",
        _DECISIONS + "test_what_matters_to_nobody_is_left_out",
        "reduction of the weighted squares that is enough, however many readings there are",
        "ten standard deviations of one parameter: certain, however small its share",
    )
    close: int = _number(
        12,
        "effects",
        _EXAMPLES,
        "named effects that take part when unnamed ones are tested",
        "chosen: it bounds the size of the second table",
    )
    most_steps: int = _number(
        14, "steps", _EXAMPLES, "effects that are added at most", "chosen: a bound on the time"
    )
    finer: float = _number(
        2.0,
        "ratio",
        _FINER,
        "resolution of final curves relative to the shortest waves of which rows have as "
        "much information as the prior",
        "a curve cut off there states 65 % of its variance, cut off at half of them 95 %; "
        "1 in subsamples",
    )
    most_rivals: int = _number(
        6,
        "effects",
        _DECISIONS + "test_each_heading_is_listed_once",
        "equivalent effects that are listed",
        "what a reader can act on",
    )
    enough_readings: int = _number(
        12000,
        "readings",
        "benchmark.py",
        "readings from which effects are chosen; in the end all rows are fitted and "
        "resolve the curves",
        "an effect that reduces the squares of more readings by 100 still reduces these enough; "
        "UR10 B gives the same names",
    )

    def least_gain(self, squares: float, *, declared: bool) -> float:
        """Return the smallest relevant reduction of a sum of squares by an effect, both in units of
        the noise.

        Where the noise is not declared, the residuals may contain other errors, of which any effect
        explains a little.
        """
        return min(self.gain, (1.0 if declared else 2.0) * self.share * squares)


@dataclass(frozen=True, kw_only=True)
class ScoreNumbers:
    """Score tests."""

    wider: float = _number(
        10.0,
        "ratio",
        "test_bearings.py::test_no_wobble_is_found_where_geometry_is_beyond_its_priors",
        "factor by which the priors of geometry are widened where effects are tested",
        "an effect distinguished from geometry only by the priors would be found wherever a "
        "machine exceeds them, as arms with nearly parallel axes do: small errors of the axes are "
        "large displacements of their common normal",
    )
    blocks: int = _number(
        8,
        "blocks",
        _EXAMPLES,
        "blocks of poses that are held out in turn",
        "seven eighths determine the model nearly as well as all",
    )
    predicts: float = _number(
        1.0,
        "standard errors",
        _EXAMPLES,
        "by which held-out blocks have to improve for a prediction to be called better",
        "one in six by chance; other criteria are stricter",
    )
    searched: float = _number(
        2.0,
        "standard errors",
        _STAGE,
        "the same for an effect selected among many on all blocks, such as waves of all orders",
        "selection favours chance in held-out blocks, too: of the significant ripples on a real "
        "UR10 only one is found in both series, at 2.4 and 2.2; the others reach 1.7 at most",
    )
    veto: float = _number(
        2.0,
        "standard errors",
        _BLOCKS,
        "that blocks of poses have to improve for one of them not to have a veto",
        "1 in 40 by chance",
    )
    fewest_blocks: int = _number(
        6,
        "blocks",
        _BLOCKS,
        "among which the extreme ones can be identified",
        "four remain without them",
    )
    against: float = _number(
        2.0,
        "standard errors",
        _BENT,
        "by which the prediction of blocks has to deteriorate with a prior to contradict it",
        "1 in 40 by chance",
    )
    most_explained: float = _number(
        0.999999,
        "ratio",
        _EXAMPLES,
        "largest fraction of the squares that can be removed",
        "keeps the F ratio finite",
    )
    observed: float = _number(
        0.01,
        "ratio",
        "test_bearings.py::test_what_geometry_takes_of_a_wobble_is_not_counted",
        "smallest reduction of an observable parameter's prior variance by the data, as a fraction",
        "an effect distinguished only by the model's priors is not observable, such as a tilt that "
        "implausible geometry would explain",
    )
    held: float = _number(
        1e6,
        "ratio",
        _TWO_SOFT,
        "prior information of held parameters, in units of that of the data",
        "a thousandth of their standard deviation: negligible",
    )
    mass_beliefs: tuple[tuple[float, float], ...] = _number(
        ((0.4, 0.0), (2.0, 2.0 * log(30.0))),
        "ratio, " + _CRITERION,
        _IN_DOUBT,
        "alternative factors for these, and their costs: 2 %, or, with odds of 30 to 1 against it, "
        "10 %; the data determine which is likelier, with an effect and without",
        "gravity compensators and wrong payloads (lambda >= 60, masses 3 % off) are then "
        "named on more arms than with 5 % "
        "for all, and arms whose masses are 10 % off get no more false names",
    )
    most_taken: float = _number(
        0.9,
        "ratio",
        "test_uneven.py::test_even_noise_changes_nothing",
        "largest leverage of a visit on an effect",
        "chosen: a visit that determines an effect alone does not show its noise",
    )
    uneven: float = _number(
        0.05,
        "probability",
        _UNEVEN,
        "probability that even noise is mistaken for uneven",
        "usual: the resulting test is valid for even noise, too, but weaker",
    )
    drawn: int = _number(
        200,
        "tables",
        "test_stability.py::test_a_bootstrap_of_noise_has_any_chance_alike",
        "tables that a bootstrap draws",
        "the smallest p-value that they can show is 1/201",
    )
    drawn_from: float = _number(
        1e-10,
        "ratio",
        "test_stability.py::test_what_is_there_is_no_chance",
        "fraction of the largest eigenvalue of S', scaled to a diagonal of 1, below which "
        "one is rounding",
        "above the accumulated rounding errors of products, 1e-16 each",
    )
    order: float = _number(
        0.1,
        "ratio",
        "test_rows.py::test_correlated_noise_is_estimated_and_left_white",
        "mean square of a joint's steps from row to row, over that of random ones, below "
        "which it moved along the rows",
        "a path of a few turning points, or sorted poses",
    )
    expansions: int = _number(
        8,
        "times",
        _CONSTANT,
        "that an effect with a time constant is linearised again at most",
        "chosen: each is a Newton step",
    )
    sure: float = _number(
        4.0,
        "standard deviations",
        _SOFT,
        "by which a compliance has to differ from zero to be named by itself",
        "1 in 16000 by chance, of some twenty compliances",
    )


@dataclass(frozen=True, kw_only=True)
class WaveNumbers:
    """Search for waves of high order, maps of two joints, and periods."""

    step: float = _number(
        0.25,
        "periods over the whole range",
        _SCAN,
        "steps of a periodogram",
        "the highest is then seen at 95 % of its square or more",
    )
    fine: int = _number(
        48,
        "steps",
        _SCAN,
        "of one of the two small matrices; the other has the rest",
        "chosen for time: about the root of all steps",
    )
    closer: int = _number(
        16,
        "steps",
        _STAGE,
        "on either side of the highest gain, to refine its order",
        "a sixtieth of a resolution",
    )
    piece: int = _number(
        4096,
        "rows",
        _STAGE,
        "whose exponentials are held in memory at once",
        "chosen for memory: some megabytes",
    )
    worth: float = _number(
        0.05,
        "probability",
        _QUIET,
        "p-value of the highest wave, and of the best map, below which it becomes a candidate",
        "the subsequent test is exact and stricter",
    )
    aliases: int = _number(
        3,
        "waves",
        "test_tones.py::test_a_grid_of_positions_does_not_tell_orders_apart",
        "other orders that explain as much, at most",
        "what a reader can act on",
    )
    phases: float = _number(
        1e-3,
        "ratio",
        "test_tones.py::test_a_grid_of_positions_does_not_tell_orders_apart",
        "fraction of V^2 by which two phases of a wave have to differ to be distinguished",
        "less is rounding of positions on a grid",
    )
    digits: int = _number(
        2, "digits", _STAGE, "after the decimal point of an order", "finer than any span resolves"
    )
    close: float = _number(
        1.0,
        "cycles per revolution",
        "test_tones.py::test_a_wave_found_again_close_by_came_in_so",
        "orders closer than this are the same wave",
        "stages of a drive differ by more",
    )
    line: float = _number(
        2.0,
        "resolutions",
        _LINE,
        "up to which two waves may be one line",
        "each is within one resolution of their mean",
    )
    map_forms: int = _number(
        3,
        "resolutions",
        "test_maps.py::test_a_map_is_as_fine_as_rows_and_positions_allow",
        "of the likeliest map, of which the coarsest and the finest are tested",
        "chosen: its other resolutions are tried once it has entered",
    )
    map_seen: float = _number(
        1e-6,
        "ratio",
        "test_maps.py::test_a_function_of_two_joints_is_found_with_both",
        "fraction of the largest diagonal below which a cell of a map has no pose",
        "a thousandth of the largest lever",
    )
    smooth: float = _number(
        6.0,
        "cycles per revolution",
        _OF_TWO,
        "of each of two joints, up to which their waves count as smooth",
        "a period is 60 degrees; a table of some hundreds of poses has several in it",
    )
    pair_step: float = _number(
        0.5,
        "periods over the whole range",
        _OF_TWO,
        "steps of the search for waves of two joints",
        "the highest is then seen at three quarters of its square or more, and refined",
    )
    pair_closer: int = _number(
        4,
        "steps",
        _PEAK,
        "on either side of the highest gain of two joints, to bound what refining it finds",
        "an eighth of a period each, so the highest is seen at 97 % of its square or more",
    )
    pair_seen: float = _number(
        0.9,
        "ratio",
        _PEAK,
        "fraction of the refined gain of two joints that these steps see at least",
        "97 %, with a margin",
    )
    periods: float = _number(
        1.8,
        "periods",
        _PERIOD,
        "that have to be observed for a curve to be called periodic",
        "nearly two",
    )
    tone: float = _number(
        0.7,
        "ratio",
        _PERIOD,
        "fraction of the excess that one tone has to explain for that",
        "chosen: most of it",
    )
    period: float = _number(
        1e-3,
        "probability",
        _PERIOD,
        "p-value of the strongest tone for that",
        "chosen: it only affects the wording of a report",
    )
    fewest: int = _number(
        20, "rows", _PERIOD, "below which no period is searched for", "chosen: ten per period"
    )
    finest: float = _number(
        0.25,
        "periods per row",
        _PERIOD,
        "that are searched for at most",
        "half of what evenly spaced rows resolve",
    )
    oversampled: int = _number(
        8,
        "steps per period",
        _REPORT + "test_gains_of_tones_are_those_of_least_squares",
        "over the whole range, of the search for periods",
        "a tone between two steps is seen at 98 % of its square",
    )


@dataclass(frozen=True, kw_only=True)
class RemainderNumbers:
    """What is smooth in the joints and has no name."""

    lengths: tuple[float, ...] = _number(
        (0.25, 0.5, 1.0, 2.0, 4.0),
        "rad",
        _REMAINDER,
        "over which errors may be alike",
        "chosen: shorter ones are drive curves, longer ones are geometry",
    )
    sizes: tuple[float, ...] = _number(
        (1e-5, 2e-5, 4e-5, 8e-5, 1.6e-4, 3.2e-4, 6.4e-4),
        "rad or m",
        _REMAINDER,
        "that errors of drives, and displacements, may have",
        "from what no one measures to 2 arcmin, by factors of 2",
    )
    together: int = _number(
        2,
        "joints",
        _REMAINDER,
        "on which each part of an error depends",
        "as functions of all joints no table of hundreds of poses resolves them; on a real UR5 "
        "the evidence was exp(88) for pairs of joints against all of them",
    )
    waves: int = _number(
        2,
        "waves",
        _REMAINDER,
        "of each pair of joints",
        "chosen: with six drives 360 amplitudes, of which readings tell some dozens; twice as many "
        "waves predicted no better in as many sums, and lengthen the file",
    )
    rows: int = _number(
        400,
        "rows",
        _REMAINDER,
        "of which the likelihood is computed",
        "chosen: two sizes and two lengths need no more",
    )
    tried_together: int = _number(
        2,
        "lengths",
        _REMAINDER,
        "of each kind that are tried with those of the other kind",
        "chosen: only the time depends on it",
    )
    tried: int = _number(
        3,
        "remainders",
        _REMAINDER,
        "that are fitted at most, the likeliest ones, until regions that are left out are "
        "predicted better",
        "chosen: only the time depends on it",
    )
    noise: tuple[float, float] = _number(
        (0.05, 1.2),
        "ratio",
        _REMAINDER,
        "least and largest variance of the noise beside a remainder, to that without",
        "chosen: a remainder that explains 95 % of the squares is a missing name",
    )
    noises: int = _number(
        30,
        "variances",
        _REMAINDER,
        "between these two that are tried",
        "chosen: steps of a tenth",
    )
    told: float = _number(
        0.3,
        "ratio",
        _REMAINDER,
        "information of all rows on a direction of the amplitudes, to that of its prior, at least",
        "chosen: the variance of what is left out would be a quarter smaller at most",
    )
    most: int = _number(
        96,
        "amplitudes",
        _REMAINDER,
        "at most, those of which readings tell most",
        "chosen: at new poses of an arm displaced by .25 mm .164 mm are left with 64, .144 with "
        "96, .139 with 128, whose file is half as large again",
    )
    digits: int = _number(
        4,
        "digits",
        _REMAINDER,
        "behind the point, of a wave's part in a sum",
        "chosen: the file is shorter, and the sums are what the file says",
    )
    evidence: float = _number(
        4.6,
        "log odds",
        _SOUND_REMAINDER,
        "in favour of a remainder, at least",
        "100 to 1, as for a name",
    )
    region: int = _number(
        10,
        "rows",
        _WORSE,
        "of a region that is left out, at least, that its mean error counts; one of fewer rows is "
        "one with its neighbour",
        "chosen: of fewer the mean is not known to a sixth",
    )
    worse: float = _number(
        0.05,
        "probability",
        "test_names_by_region.py::test_what_is_beyond_scatter_is_a_doubt",
        "that names predict any of the regions that are left out as much worse than geometry and "
        "elasticity by chance, below which they are doubted",
        "as for any doubt; of 24 drawn tables with a true name none came below",
    )
    judged: int = _number(
        3000,
        "rows",
        "test_remainder.py::test_of_many_rows_some_are_judged_first",
        "of which remainders are judged; what passes is judged by all rows again",
        "chosen: with 120 a region means are known to a twentieth, and a fit takes seconds",
    )
    regions: int = _number(
        4,
        "regions",
        "test_remainder.py::test_few_poses_have_none",
        "of so many rows, at least, that may tell whether something is predicted better",
        "chosen: the scatter of their gains is known to a half",
    )
    narrower: tuple[float, ...] = _number(
        (0.5, 0.25),
        "ratio",
        _WORSE,
        "of the sizes of a remainder with less freedom to the likeliest ones, which is tried where "
        "a region that is left out is predicted worse than by geometry and elasticity",
        "chosen: less still would gain little",
    )


@dataclass(frozen=True, kw_only=True)
class CurveNumbers:
    """Resolution and roughness of drive curves."""

    enough: int = _number(
        44,
        "positions",
        _REPEATS + "test_what_repeated_positions_can_not_tell_is_said",
        "distinct positions of a joint that are enough for most gears",
        "fewer are worth a note if there are more poses",
    )
    forms: int = _number(
        3,
        "resolutions",
        _RATES + "test_a_whole_curve_takes_the_place_of_its_part",
        "of a whole curve, the coarsest ones, that are tested in addition to a simple one",
        "chosen: three are enough to detect a remainder, and p-values are corrected for "
        "their number",
    )
    roughness: float = _number(
        0.1,
        "rad^-0.5",
        _LIKELIEST,
        "where the search for the roughness begins",
        "chosen: only the time depends on it",
    )
    moves: int = _number(
        15,
        "times",
        _LIKELIEST,
        "that the roughness is updated at most",
        "chosen: a bound on the time",
    )
    settled: float = _number(
        0.05,
        "ratio",
        _LIKELIEST,
        "relative change below which the updates end",
        "a curve hardly depends on that",
    )
    farthest: float = _number(
        10.0,
        "ratio",
        _LIKELIEST,
        "of an update at most",
        "chosen: a step that is too long is reversed by the next",
    )
    least: float = _number(
        1e-5,
        "rad^-0.5",
        _SMOOTH,
        "least roughness",
        "below it a curve strays from a straight line by less than 0.01 mrad in a radian",
    )
    least_noise: float = _number(
        1e-3,
        "ratio",
        _SMOOTH,
        "lower bound on the estimated noise, as a fraction of its variance",
        "curves through all readings leave no noise",
    )
    firm: float = _number(
        30.0,
        "ratio",
        _SMOOTH,
        "additional prior information of other parameters in the step with the curves, in "
        "units of their priors'",
        "a full step diverges where compliances multiply positions of bearings",
    )
    enough_pieces: int = _number(
        180,
        "pieces",
        "test_smooth_curves.py::test_a_curve_ends_finer_up_to_enough_pieces",
        "up to which a curve ends finer than the shortest resolved wave",
        "for time: 12000 poses resolve more",
    )
    densely: int = _number(
        8,
        "positions per piece",
        _SMOOTH,
        "at which a curve is resampled when its resolution changes",
        "chosen: a spline is smooth between them",
    )


@dataclass(frozen=True, kw_only=True)
class PlaceNumbers:
    """Places and regions of misfit that are reported."""

    chance: float = _number(
        0.01,
        "probability",
        _NOWHERE,
        "that data without an effect show a place, or a range of the workspace",
        "one line of a report in a hundred may be chance",
    )
    share: float = _number(
        0.05,
        "ratio",
        _LOCATED,
        "fraction of the excess below which a further place is not reported",
        "chosen: too small to be relevant",
    )
    places: int = _number(
        3,
        "places",
        _LOCATED,
        "and regions, of one station and of all together, that are reported",
        "what a reader can act on",
    )
    pieces: int = _number(
        8, "functions", _LOCATED, "of a smooth curve of a position", "two periods over the range"
    )
    own_pieces: tuple[int, ...] = _number(
        (24, 60),
        "functions",
        _LOCATED,
        "of a curve of the joint's own position, in addition",
        "as fine as the harmonics of a gear",
    )
    slow_pieces: int = _number(
        5, "functions", _LOCATED, "of a curve of payload, temperature and time", "they vary slowly"
    )
    distinct: int = _number(
        10,
        "values",
        _REPORT + "test_a_range_is_named_only_if_most_sits_in_it",
        "of a variable below which it has no narrow range",
        "chosen: a range of four of them, at most",
    )
    most: float = _number(
        0.6,
        "ratio",
        _REPORT + "test_a_range_is_named_only_if_most_sits_in_it",
        "fraction of the misfit that one range has to contain",
        "chosen: most of it",
    )
    narrow: float = _number(
        0.4,
        "ratio",
        _REPORT + "test_a_range_is_named_only_if_most_sits_in_it",
        "fraction of the whole range and of the rows that this range contains at most",
        "chosen: evenly spread, two fifths would contain two fifths",
    )
    rows: int = _number(
        1000,
        "rows",
        _LOCATED,
        "beyond which they are thinned",
        "for time: a place worth reporting shows in fewer",
    )
    shuffles: int = _number(
        300,
        "permutations",
        _NOWHERE,
        "of the rows in the test of a range of the workspace",
        "three of them exceed the limit by chance",
    )
    pointed: float = _number(
        0.55,
        "ratio",
        _LOCATED,
        "fraction of the excess that a direction has to contain",
        "more than half; a third would be isotropic",
    )
    above: float = _number(
        4.0,
        "standard deviations",
        _NOWHERE,
        "by which it has to exceed the noise",
        "1 in 30000 by chance",
    )


@dataclass(frozen=True, kw_only=True)
class NoiseNumbers:
    """Scatter of one joint, and noise of all joints."""

    scatter: float = _number(
        25.0,
        "2 log likelihood",
        "test_scatter.py::test_noise_of_several_targets_is_no_scatter",
        "smallest gain by scatter of a joint",
        "5 standard deviations of one parameter, so that no joint exceeds it by chance: neither "
        "noise nor several targets do, 50 urad of scatter do",
    )
    beyond_alike: float = _number(
        6.0,
        "2 log likelihood",
        "test_scatter.py::test_drives_alike_are_no_model_error",
        "gain of one joint over all alike, below which an excess that may be scatter is that of "
        "all",
        "the largest of six joints exceeds it by chance in one sound table of twenty-five; 60 "
        "urad of one joint gain 9 to 46 in 24 poses",
    )
    ratios: tuple[float, float, int] = _number(
        (-2.0, 3.0, 101),
        "log10, log10, number",
        _SCATTER,
        "candidate variances of the joint, in units of the noise seen at the joint's mean lever",
        "an eighth apart: a likelihood is flatter",
    )
    chance: float = _number(
        0.01,
        "probability",
        _NEIGHBOURS,
        "that scatter is mistaken for a function of the pose, and noise of replicates for scatter",
        "one line of a report in a hundred may be chance",
    )
    neighbours: int = _number(
        6,
        "poses",
        _NEIGHBOURS,
        "nearest to a pose",
        "chosen: twice as many as joints on which a function depends",
    )
    smooth: float = _number(
        0.15,
        "ratio",
        _NEIGHBOURS,
        "fraction of a joint's range over which a smooth function keeps most of its value",
        "one period per range",
    )
    most_joints: int = _number(
        3,
        "joints",
        "test_scatter.py::test_a_function_of_two_joints_is_no_scatter",
        "on which a function depends, if not on all",
        "chosen: of more, no table has near poses",
    )
    near_joints: int = _number(
        2,
        "joints",
        _NEIGHBOURS,
        "of which neighbours have to be near for a function of them to be excluded",
        "as many as those on which an effect of the catalogue depends",
    )
    beyond: float = _number(
        2.0,
        "standard deviations",
        _NEIGHBOURS,
        "beyond the critical value at which a smooth function is expected, for its "
        "absence to exclude it",
        "1 in 40 by chance",
    )
    draws: int = _number(
        299,
        "permutations",
        _NEIGHBOURS,
        "of the errors",
        "three of them exceed the limit by chance",
    )
    visits: int = _number(1000, "visits", _SCATTER, "beyond which they are thinned", "for time")
    turns: int = _number(
        3,
        "rounds",
        "test_common_scatter.py::test_a_joint_that_scatters_more_than_the_others_is_named",
        "in which the scatter of one joint and that of all are estimated in turn",
        "the likelihood then changes by less than 1",
    )
    joints: float = _number(
        25.0,
        "2 log likelihood",
        "test_joint_noise.py::test_even_noise_is_left_as_it_is",
        "smallest gain by noise of the joints",
        "without any, 120 tables had up to 13, half of them up to 2",
    )
    readings_each: float = _number(
        5.0,
        "readings per parameter",
        _JOINT_NOISE,
        "below which a fit absorbs too much of the residuals",
        "then a fifth of their variance",
    )
    rows: int = _number(
        1000, "rows", _JOINT_NOISE, "that determine the variances well enough", "to 5 %"
    )
    start: float = _number(
        0.3,
        "noise variance",
        "test_joint_noise.py::test_variances_are_where_residuals_are_likeliest",
        "where the search for the variances begins",
        "chosen: only the time depends on it",
    )
    bounds: tuple[float, float] = _number(
        (1e-6, 1e4),
        "noise variance",
        "test_joint_noise.py::test_variances_are_where_residuals_are_likeliest",
        "bounds on these variances",
        "negligible, and dominant",
    )


@dataclass(frozen=True, kw_only=True)
class SightNumbers:
    """Detectability of effects, and measurements that would distinguish them."""

    power: float = _number(
        0.9, "probability", _POWER, "probability of finding an effect of detectable size", "usual"
    )
    fewest: float = _number(
        10.0,
        "degrees of freedom",
        _REPORT + "test_survey_assumes_noise_where_rows_are_too_few_to_tell",
        "below which an effect can't be tested",
        "the noise is known to 22 % then",
    )
    hopeless: float = _number(
        1e7,
        "noise variance",
        _REPORT + "test_survey_assumes_noise_where_rows_are_too_few_to_tell",
        "non-centrality beyond which no size is detectable",
        "the readings are too few for it",
    )
    shapes: int = _number(
        400,
        "shapes",
        _POWER,
        "of an effect of several parameters over which its power is averaged",
        "to 1.5 % at a power of 0.9",
    )
    told_apart: float = _number(
        30.0,
        "noise variance",
        _APART,
        "non-centrality above which two effects count as distinguished",
        "5.5 standard deviations of one parameter",
    )
    telling: float = _number(
        1.5,
        "ratio",
        _APART,
        "by which a further run has to be better than repeating the same poses",
        "chosen: repeating the poses is the simpler advice",
    )
    repetitions: float = _number(
        50.0,
        "ratio",
        _APART,
        "times the poses of a table above which no further run of its kind is advised",
        "too many to be measured",
    )
    warmer: float = _number(
        10.0,
        "K",
        _APART,
        "change of temperature that another run could make",
        "an arm between a cold start and an hour of work",
    )
    moves: tuple[float, ...] = _number(
        (-1.5, -0.1, 0.1, 1.5),
        "rad, m",
        _APART,
        "moves by which another run could reach its poses",
        "a large motion, and one as short as in a program",
    )


POLICY = Policy()
TESTING = ScoreNumbers()
WAVES = WaveNumbers()
CURVES = CurveNumbers()
REMAINDER = RemainderNumbers()
WHERE = PlaceNumbers()
NOISE = NoiseNumbers()
SIGHT = SightNumbers()
