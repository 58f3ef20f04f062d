"""The thresholds of decisions in a calibration, and on changes of a robot: each with its unit and
origin.

Bounds on a computation (rows used, steps, rounding) are defined where they are used, the thresholds
of a discovery in ``discover/policy.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log, radians

from pincal.thresholds import number

_GAIN = "2 log likelihood"
_ODDS = "-2 log odds"
_REASON = "test_calibrate.py::test_reasons_name_the_counterpart"
_ORDER = "test_rows.py::test_correlated_noise_is_estimated_and_left_white"
_OF_BLOCKS = "test_rows.py::test_blocks_of_rows_widen_what_rows_that_hang_together_say"
_CHANGED = "test_diagnosis.py::test_a_change_of_a_drawn_robot_is_named"
_SAME = "test_diagnosis.py::test_a_robot_that_has_not_changed_is_left_alone"
_GROSS = "test_other_session.py::test_rows_of_which_many_are_gross_tell_nothing"
_REFUSED = "test_diagnosis.py::test_what_can_not_be_told_is_refused"
_CURVE = "test_other_session.py::test_the_drive_whose_curve_is_another_is_named"
_EXCLUDED = "test_diagnosis.py::test_what_is_excluded_would_have_been_noticed"
_OUTLIERS = "test_calibrate.py::test_outliers_at_five_per_cent_are_found_and_cost_nothing"
_MOMENTS = "test_link_mass.py::test_the_moments_that_are_identified_are_those_of_the_machine"
_INTERVALS = "test_moves.py::test_intervals_are_those_of_a_fit_in_which_each_day_has_its_own"
_APART = "test_diagnosis.py::test_poses_that_tell_two_changes_apart_are_named"
_SEEN_CURVE = "test_other_session.py::test_a_curve_that_was_not_seen_everywhere_is_said_to_be_so"
_JUMP = "test_moves.py::test_a_jump_between_two_days_is_named_with_its_interval"
_PRIORS = "test_contacts.py::test_priors_are_as_wide_as_the_readings_allow"
_NOT_HELD = "test_contacts.py::test_what_contacts_do_not_hold_is_said"
_WRONG = "test_screening.py::test_wrong_readings_are_named_by_their_lines"
_SHIFTED = "test_visits.py::test_a_change_between_passes_is_found_with_its_line"
_SOUND_VISITS = "test_visits.py::test_sound_visits_raise_no_doubt"
_SCATTER = "test_visits.py::test_visits_that_scatter_more_than_drives_do_are_a_doubt"
_NO_HARM = "test_benefit.py::test_a_delivered_robot_is_not_worse_than_its_urdf"
_STATIONS = "test_moves.py::test_a_robot_that_stays_the_same_moves_in_one_of_a_hundred"


@dataclass(frozen=True, kw_only=True)
class Criteria:
    """Thresholds of decisions in a calibration."""

    bearing: float = number(
        10.0,
        _GAIN,
        "test_bearings.py::test_of_bearings_and_names_what_explains_more_enters_first",
        "that a bearing feature has to gain to be accepted",
        "odds of 150 to 1; one of a sound arm's twelve features enters in one fit out of fifty",
    )
    mass: float = number(
        0.05,
        "ratio",
        "test_stability.py::test_masses_add_what_the_data_leave_of_their_priors",
        "relative uncertainty of the mass of a link in a URDF",
        "chosen: a few per cent, as for the masses of real arms",
    )
    centre: float = number(
        0.05,
        "ratio",
        "test_stability.py::test_masses_add_what_the_data_leave_of_their_priors",
        "uncertainty of a first moment of mass in a URDF, in units of mass times link size",
        "as well as the mass",
    )
    moment_frame: float = number(
        10.0,
        _GAIN,
        "test_calibrate.py::test_the_papers_convention_is_taken_among_equals",
        "by which another moment convention has to be more likely",
        "the same odds",
    )
    wider_prior: float = number(
        3.84,
        _GAIN,
        _PRIORS,
        "that readings may lose under wider priors where no instrument observes the robot",
        "one-sided limit at 2.5 %",
    )
    unseen_direction: float = number(
        0.03,
        "ratio",
        "test_contacts.py::test_directions_without_contact_are_named",
        "of the sum of squares in one direction to that in all, below which nothing was "
        "measured in it",
        "sin^2 of 10 degrees, the variation of contact directions by themselves",
    )
    not_improved: float = number(
        0.9,
        "ratio",
        _NOT_HELD,
        "of predictions' standard deviations after and before a calibration, above which "
        "nothing has improved",
        "chosen",
    )
    mount_moved: float = number(
        0.02,
        "m",
        _NOT_HELD,
        "displacement of an arm's mount by readings without an instrument",
        "arms are mounted to a cm of their drawings",
    )
    mount_held: float = number(
        0.1,
        "ratio",
        _NOT_HELD,
        "of its standard deviation to the displacement, above which it is undetermined",
        "ten standard deviations",
    )
    worth_it: float = number(
        0.8,
        "ratio",
        _NO_HARM,
        "of the error expected of the calibrated robot to that of its URDF, above which "
        "the robot stays nominal",
        "chosen",
    )
    no_worse: float = number(
        1.0,
        "ratio",
        _NO_HARM,
        "of these errors anywhere, up to which a robot that is better at measured poses "
        "is calibrated",
        "no harm",
    )
    as_described: float = number(
        10.0,
        "odds",
        _NO_HARM,
        "that a robot is as in its URDF against any other size of its deviations, where "
        "harm is to be excluded",
        "of 1200 sound UR5 off by 0.3 to 1 mm, 14 or 30 noisy marker poses then make none "
        "of twelve groups 2 % worse",
    )
    unexcited: float = number(
        1e-6,
        "probability",
        "test_calibrate.py::test_simulated_elastic_arms_are_predicted",
        "that sound data require a parameter that the nominal geometry never excites",
        "chosen: beyond the effect of noise and small deviations",
    )
    outlier: float = number(
        0.01,
        "probability",
        _OUTLIERS,
        "that screening rejects any row of a sound table",
        "one sound table in a hundred loses a row",
    )
    too_noisy: float = number(
        4.0,
        "standard deviations of chi-square",
        "test_calibrate.py::test_declared_noise_is_judged",
        "by which residuals exceed declared noise before they replace it",
        "1 in 30000 by chance",
    )
    readings_left: int = number(
        6,
        "readings",
        "test_earlier.py::test_too_few_rows_are_refused",
        "beyond the unknowns that a fit with an earlier one as prior needs: known parameters move "
        "with the noise estimate, and it with them",
        "the noise is known to 30 % then",
    )
    most_spent: float = number(
        0.9,
        "ratio",
        "test_calibrate.py::test_too_few_rows_for_the_noise_are_refused",
        "of parameters to readings, at most, until a fit has shown the effective number "
        "of parameters",
        "the noise is then at most three times the estimate",
    )
    dependent: float = number(
        4.0,
        "standard deviations",
        "test_rows.py::test_independent_rows_are_taken_for_such",
        "by which products of residuals exceed those of independent rows before rows "
        "count as dependent",
        "exceeded in one sound table of 10 000",
    )
    correlated: float = number(
        18.0,
        _GAIN,
        "test_rows.py::test_a_fit_of_independent_rows_has_no_correlated_noise",
        "that correlation along the rows has to gain",
        "two parameters at a p-value of 1e-4",
    )
    arrivals: float = number(
        9.5,
        _GAIN,
        "test_arrivals.py::test_exact_drives_share_no_noise",
        "that noise shared by the readings of a stop has to gain",
        "one variance, half the time zero by chance: 1 in 1000",
    )
    unalike: float = number(
        0.01,
        "probability",
        "test_arrivals.py::test_drives_that_differ_are_told",
        "that drives that arrive alike are taken to differ",
        "five more variances",
    )
    fewest_in_order: int = number(
        20, "rows", _ORDER, "that can show dependence along them", "the longest band of lags"
    )
    as_likely: float = number(
        2.0,
        _GAIN,
        _ORDER,
        "within which a correlation length is as likely as the best, and the longest is used",
        "twice the value at one standard deviation",
    )
    of_blocks: float = number(
        4.0,
        "standard deviations",
        _OF_BLOCKS,
        "by which scores of blocks of rows exceed those of permuted rows before they "
        "widen the uncertainty",
        "as for dependence along rows",
    )
    fewest_blocks: int = number(
        8, "blocks", _OF_BLOCKS, "of rows that can show it", "a variance is then known to 50 %"
    )
    identified: float = number(
        0.5,
        "ratio",
        _REASON,
        "of posterior to prior standard deviation, below which a parameter counts as identified",
        "the data hold three times the information of the prior (1 / 0.25 - 1)",
    )
    narrowed: float = number(
        0.97,
        "ratio",
        _REASON,
        "the same, above which the data count as uninformative",
        "no prior's size is known to 3 %",
    )
    unseen: float = number(
        1e-3,
        "ratio",
        _REASON,
        "share in unobservable directions above which a parameter is not identifiable by itself",
        "far above rounding errors, far below any relevant share",
    )
    worth_naming: float = number(
        0.05,
        "ratio",
        _REASON,
        "share of a parameter's effect below which another one is not named as its counterpart",
        "chosen: negligible",
    )
    moment: float = number(
        1.0 / 3.0,
        "ratio",
        _MOMENTS,
        "of its standard deviation to a static moment, below which it counts as identified",
        "three standard deviations",
    )


@dataclass(frozen=True, kw_only=True)
class ChangeNumbers:
    """Thresholds of decisions on changes, from station to station or since a calibration."""

    moved: float = number(
        0.01,
        "probability",
        _STATIONS,
        "that any change is reported for a robot that is the same at all stations",
        "one robot in a hundred",
    )
    usual: float = number(
        2.0 * log(10.0),
        _ODDS,
        "test_diagnosis.py::test_changes_are_named_in_97_of_100",
        "prior odds of a lost zero of a drive against any other change",
        "odds of 10 to 1",
    )
    wide: float = number(
        30.0,
        "prior sizes",
        _INTERVALS,
        "by which values of stations may differ",
        "chosen: not critical",
    )
    wrong_rows: float = number(
        0.05,
        "ratio",
        _JUMP,
        "of rejected to all rows of a station, up to which they are considered wrong readings",
        "more are unlikely to be wrong readings",
    )
    too_quiet: float = number(
        1e-3,
        "probability",
        "test_moves.py::test_each_station_has_its_repeatability",
        "of noise as low as at one station, below which the fit has mistaken something "
        "else for noise",
        "one sound station in a thousand",
    )
    uneven: float = number(
        0.05,
        "probability",
        "test_moves.py::test_what_no_model_knows_moves_nothing",
        "of differences as large between parts of a station, below which stations may "
        "differ as much",
        "usual",
    )
    matters: float = number(
        0.01,
        "ratio",
        _STATIONS,
        "of a station's squares that a changed parameter explains, above which the model "
        "is wrong there",
        "as for an effect that is named",
    )
    unmodelled: float = number(
        1e-3,
        "probability",
        "test_diagnosis.py::test_an_adequate_model_left_nothing",
        "of an unmodelled effect by chance, given all candidates, above which none is accepted",
        "a new diagnosis is compared with it, so it has to be real",
    )
    false_alarm: float = number(
        0.01,
        "probability",
        _SAME,
        "of an alarm for a robot that has not changed",
        "one check in a hundred",
    )
    for_changes: float = number(
        0.8, "ratio", _SAME, "of it allotted to single changes", "chosen: most changes have a name"
    )
    for_misfit: float = number(
        0.2, "ratio", _SAME, "of it allotted to a misfit that no change explains", "the rest"
    )
    equivalent: float = number(
        2.0 * log(100.0),
        _ODDS,
        _APART,
        "below which two changes are indistinguishable",
        "unless one is 100 times as likely",
    )
    wrong_row: float = number(
        0.001,
        "probability",
        "test_diagnosis.py::test_one_wrong_reading_is_no_change",
        "that a row of a sound table is mistaken for a wrong reading",
        "one sound table in a thousand",
    )
    fewest_rows: int = number(
        8,
        "rows",
        "test_diagnosis.py::test_one_wrong_reading_is_no_change",
        "up to which none is considered a wrong reading",
        "too few to decide",
    )
    too_many: float = number(
        0.25,
        "ratio",
        _GROSS,
        "of outlying to all rows, from which on they are not exceptions",
        "in real tables some per cent are",
    )
    part_of_noise: float = number(
        0.95,
        "ratio",
        "test_diagnosis.py::test_what_a_model_left_is_no_change",
        "of the estimated noise of a calibration that an unmodelled effect may have caused",
        "nearly all of it",
    )
    hopeless: float = number(
        0.01,
        "ratio",
        _REFUSED,
        "of the residuals after all changes to the reach, above which the rows belong to "
        "another robot",
        "a centimetre on a metre",
    )
    strange: float = number(
        0.1,
        "ratio",
        _REFUSED,
        "of the residuals before any change to the reach, above which no change is searched for",
        "a drive with an error of 0.2 rad leaves half as much",
    )
    degrees: float = number(
        200.0,
        "degrees of freedom",
        "test_diagnosis.py::test_an_instrument_with_more_noise_tells_less",
        "of a calibration's noise estimate, where its number of rows is unknown",
        "chosen: as for a typical table",
    )
    vanished: float = number(
        0.0455,
        "probability",
        "test_stop_noise.py::test_what_is_announced_exceeds_its_uncertainty",
        "of a change as large given all others, above which it is not announced",
        "two of its standard deviations",
    )
    many: int = number(
        4,
        "changes",
        _REFUSED,
        "from which on another robot of the same type is more likely",
        "chosen: a bound on what is believable",
    )
    worth_a_note: float = number(
        0.9,
        "ratio",
        _CURVE,
        "of errors, and of rows, below which another curve of a drive is worth a note",
        "a tenth better",
    )
    rows_each: int = number(
        4, "rows per parameter", _CHANGED, "below which a curve is not tried", "chosen: for time"
    )
    curve_rows: int = number(
        24, "rows", _CURVE, "that allow cross-validation", "three for each block"
    )
    curve_blocks: int = number(
        8,
        "blocks",
        _CURVE,
        "of cross-validation, each of a few regions of joint space",
        "as in a discovery",
    )
    curve_seen: float = number(
        0.5,
        "ratio",
        _SEEN_CURVE,
        "of posterior to prior standard deviation of a curve about its mean, below which "
        "it was observed",
        "a quarter of the variance; in gaps of 25 degrees of a UR10's table it is .6 and "
        "more, near its rows .1",
    )
    detected: float = number(
        0.9,
        "probability",
        _EXCLUDED,
        "that a change of the stated size would have been detected",
        "usual: a power of 0.9",
    )
    resolvable: float = number(
        1e-6,
        "m",
        _APART,
        "displacement up to which no instrument tells two changes apart",
        "the best laser trackers resolve a tenth of it, and repeat no better on a target at rest",
    )
    told_apart: float = number(
        30.0,
        "noise variance",
        _APART,
        "non-centrality at which two changes are distinguishable",
        "5.5 standard deviations of one parameter",
    )
    same_by_chance: int = number(
        1,
        "rows",
        "test_diagnosis.py::test_rows_that_the_model_was_fitted_to_tell_nothing",
        "that share the fingerprint of a row of the calibration by chance",
        "hardly one in some thousands of rows",
    )


@dataclass(frozen=True, kw_only=True)
class VisitNumbers:
    """Thresholds of decisions on the readings of poses that were visited, or read, more
    than once.
    """

    wrong: float = number(
        0.001,
        "probability",
        _WRONG,
        "that a reading of a sound table deviates as much from the others of its pose",
        "one sound table in a thousand",
    )
    fewest: int = number(
        6,
        "readings",
        "test_screening.py::test_few_visits_do_not_judge_each_other",
        "beyond one for each pose, below which readings do not show how they scatter",
        "a limit at one in a thousand is then twice that of a known scatter",
    )
    decided: float = number(
        2.0 * log(1000.0),
        _GAIN,
        _WRONG,
        "by which one of two readings has to agree better with the model for the other to be wrong",
        "odds of 1000 to 1",
    )
    too_many: float = number(
        0.25,
        "ratio",
        _SHIFTED,
        "of wrong to all readings, from which on they are not exceptions",
        "as for rows of a robot that may have changed",
    )
    chance: float = number(
        0.0005,
        "probability",
        _SOUND_VISITS,
        "that a table of sound visits shows a step, a steady or another drift, or a dependence on "
        "the number of the visit, each",
        "with these four tests, one sound table in 500 at most",
    )
    touched: float = number(
        0.008,
        "probability",
        _SOUND_VISITS,
        "that a table of a few sound passes shows a displacement of the instrument "
        "between two of them",
        "five standard deviations of the difference of two means are then seen in 19 of 20 tables",
    )
    as_likely: float = number(
        2.0 * log(1000.0),
        _GAIN,
        _SHIFTED,
        "within which another cause explains a change between visits as well",
        "odds of 1000 to 1",
    )
    as_good: float = number(
        3.84,
        _GAIN,
        _SHIFTED,
        "within which the simpler of two patterns of visits is taken",
        "95 % for one parameter",
    )
    same_line: float = number(
        3.84,
        _GAIN,
        _SHIFTED,
        "within which a step may begin at another line as well",
        "95 % for one parameter",
    )
    both_sides: int = number(
        3,
        "poses",
        _SHIFTED,
        "with visits before and after a step, at least",
        "nine coordinates for the three of a displacement",
    )
    few_passes: int = number(
        5,
        "passes",
        _SOUND_VISITS,
        "up to which a displacement of the instrument between two of them is tested by itself",
        "with more the test of any step, which looks at their seams, too, tells of it",
    )
    clipped: float = number(
        1e-4,
        "probability",
        "test_visits.py::test_wrong_readings_make_no_change_between_visits",
        "of a sound deviation to whose size larger ones are clipped",
        "single wrong readings make no pattern",
    )
    permuted: float = number(
        0.01,
        "probability",
        _SOUND_VISITS,
        "of a pattern without multiplicity, above which it is none and nothing is permuted",
        "twenty times the limit of any pattern",
    )
    arrival: float = number(
        1.5e-4,
        "rad or m",
        _SCATTER,
        "standard deviation of the arrival of a drive, above which visits scatter by more "
        "than drives do",
        "drives repeat to 1e-5 to 9e-5 rad (Slamani 2012)",
    )


_STOPS = "test_stop_noise.py::test_the_scatter_within_and_between_stops_is_found"
_SHARED = "test_stop_noise.py::test_rows_that_share_an_arrival_count_as_one_stop"


@dataclass(frozen=True, kw_only=True)
class StopNumbers:
    """Thresholds of the scatter of readings within a stop and of stops at a pose."""

    fewest: float = number(
        12.0,
        "degrees of freedom",
        _STOPS,
        "from which on a table's own scatter is used",
        "a standard deviation to 20 %, as of four differences of positions",
    )
    chance: float = number(
        1e-3,
        "probability",
        _STOPS,
        "that repeats of a sound table are left out as gross",
        "one sound table in a thousand",
    )
    gross: float = number(
        4.0,
        "ratio",
        _STOPS,
        "by which repeats scatter more at some poses than usually",
        "an arm stretched out has twice the usual lever",
    )
    sure: float = number(
        2.0,
        "standard deviations",
        "test_stop_noise.py::test_a_check_of_ten_cycles_raises_no_alarm",
        "by which what a model lacks at a pose may exceed its estimate",
        "one-sided limit at 2.5 %",
    )
    shared: float = number(
        4.0,
        _GAIN,
        _SHARED,
        "above which targets of a stop share its arrival",
        "cautious: one table of fifty that share nothing",
    )
    agrees: float = number(
        0.99,
        "probability",
        "test_visit_weights.py"
        "::test_few_poses_that_were_visited_often_have_the_noise_of_their_visits",
        "of the interval of an estimated noise within which a declared one agrees with it",
        "one sound table in a hundred",
    )


_MISTAKEN = "test_agreement.py::test_what_is_wrong_with_a_table_is_named"
_INCURABLE = "test_agreement.py::test_what_nothing_cures_is_not_to_be_used"
_REAL = "test_agreement.py::test_real_tables"
_ZEROS = "test_zeros.py::test_what_differs_from_the_urdf_is_found_and_named"
_KNOWN_ZEROS = "test_zeros.py::test_unknown_zeros_have_no_prior"


@dataclass(frozen=True, kw_only=True)
class AgreementNumbers:
    """Thresholds by which a table is refused as not of its robot, and mistakes in it are named."""

    suspicious: float = number(
        0.01,
        "ratio",
        _MISTAKEN,
        "of the error of the nominal robot to its reach, above which mistakes are searched for",
        "real robots have a fifth of it or less",
    )
    hopeless: float = number(
        0.2,
        "ratio",
        _INCURABLE,
        "of the error of the nominal robot to its reach, above which no geometric error "
        "explains the table",
        "chosen",
    )
    implausible: float = number(
        0.002,
        "ratio",
        _INCURABLE,
        "of residuals of a calibration to the reach, that no real arm has",
        "real arms have a tenth of it, an elastic one with the rigid model less than half",
    )
    implausible_m: float = number(
        0.0015, "m", _INCURABLE, "residuals that no real arm has, at least", "the same arms"
    )
    implausible_rad: float = number(
        0.02, "rad", _INCURABLE, "residual orientations that no real arm has", "the same arms"
    )
    noisy: float = number(
        5.0,
        "ratio",
        "test_agreement.py::test_a_noisy_instrument_may_be_declared_in_the_table",
        "of residuals to a declared noise, up to which they are plausible however large",
        "one in two million by chance",
    )
    computed: float = number(
        2e-6,
        "m",
        _REAL,
        "typical error below which positions are computed from the joints, and rounded",
        "instruments are ten times worse",
    )
    cured: float = number(
        4.0,
        "ratio",
        _MISTAKEN,
        "by which undoing a mistake has to reduce the error before it is named",
        "chosen",
    )
    chance: float = number(
        1e-4,
        "probability",
        "test_mistakes.py::test_a_sound_table_of_few_poses_is_not_accused",
        "that any of all hypotheses that are tried leaves as little by chance, below which one is "
        "named",
        "a thousand sound tables, each with its own search, are then refused once in ten thousand",
    )
    turned: float = number(
        0.06,
        "rad",
        "test_mistakes.py::test_a_reading_of_orientations_is_told_from_all_others",
        "of orientations of the robot as described, up to which a reading of them explains them",
        "three times what calibrated arms may have, as large as a zero that is not looked for",
    )
    senseless: float = number(
        0.3,
        "rad",
        "test_mistakes.py::test_orientations_of_nothing_are_refused",
        "that orientations alone leave, above which they are refused though nothing explains them",
        "fifteen times what no real arm has",
    )
    rival: float = number(
        2.0,
        "ratio",
        _MISTAKEN,
        "of the residuals of another correction to those of the best, below which it is as likely",
        "chosen",
    )
    alike: float = number(
        1.2,
        "ratio",
        _ZEROS,
        "of the residuals of shifted zeros to the least, below which the smallest shifts are taken",
        "chosen",
    )
    shift: float = number(
        radians(2.0), "rad", _ZEROS, "above which the error of a zero is named", "chosen"
    )
    slight: float = number(
        0.01, "rad", _ZEROS, "above which errors of other zeros are corrected with it", "chosen"
    )
    unknown: float = number(
        1.0, "rad", _KNOWN_ZEROS, "prior of a zero above which it counts as unknown", "chosen"
    )
    improved: float = number(
        1.5,
        "ratio",
        _ZEROS,
        "by which shifted zeros have to reduce the residuals of a calibration",
        "a third of them",
    )
    no_worse: float = number(
        1.1,
        "ratio",
        _ZEROS,
        "by which they may increase them where the data have pulled a zero far from its prior",
        "chosen",
    )
    pulled: float = number(
        1.2,
        "ratio",
        _ZEROS,
        "of a zero to its prior, from which on data have pulled it far",
        "chosen",
    )
    usual: float = number(
        0.1,
        "ratio",
        _REAL,
        "of residuals to those that no arm has, up to which they are those of real arms",
        "these have a tenth",
    )
    telling: float = number(
        2.0,
        "ratio",
        "test_agreement.py::test_the_table_of_another_robot_is_told",
        "of what a calibration corrects to its allowed residuals, above which it distinguishes "
        "robots",
        "chosen",
    )


_STEP = "test_midway.py::test_what_changed_midway_is_named_with_its_line"
_NO_STEP = "test_midway.py::test_a_table_in_which_nothing_changed_is_left_alone"


@dataclass(frozen=True, kw_only=True)
class MidwayNumbers:
    """Thresholds of a change between two rows."""

    each: int = number(
        10,
        "rows",
        _STEP,
        "on either side of a step, at least",
        "thirty readings show its size to a fifth",
    )
    clipped: float = number(
        5.0,
        "ratio",
        _NO_STEP,
        "of residuals to the typical one, to which larger ones are clipped",
        "single wrong readings make no step",
    )
    examined: float = number(
        25.0,
        "variances of means of neighbours",
        _NO_STEP,
        "gain above which a step is examined",
        "simulated machines have up to 12, real arms measured along a grid 31",
    )
    chance: float = number(
        1e-4,
        "probability",
        _NO_STEP,
        "of a step by chance, over all rows and fields, if the covariance were known",
        "one sound table in ten thousand",
    )
    distinguished: float = number(
        13.8, _GAIN, _STEP, "within which causes are not distinguished", "a thousand to one"
    )
    least_part: float = number(
        1.2,
        "ratio",
        "test_midway.py::test_drifts_are_no_changes",
        "of a step to the residuals, at least, where noise is correlated along the rows",
        "a model's error reaches 1.06 (a UR10 without its drives' curves), a touched target 2",
    )
    correlated: float = number(
        0.01,
        "ratio",
        "test_midway.py::test_drifts_are_no_changes",
        "of the off-diagonal part of the precision to its diagonal, above which noise is "
        "correlated",
        "chosen",
    )
    in_any_order: float = number(
        1e-3,
        "probability",
        "test_midway.py::test_what_a_model_lacks_is_no_change",
        "of as large a step in random orders of the rows",
        "one false alarm in a thousand calibrations",
    )
    clock: float = number(
        1e-3,
        "s",
        "test_motion_stations.py::test_a_clock_that_slips_has_a_step_with_its_uncertainty",
        "jump of a clock, above which it is estimated by a calibrated arm in motion",
        "neither an error of an arm nor a sound clock makes one",
    )


_CLUSTER = "test_rows.py::test_outliers_gather_or_do_not"
_BUMP = "test_rows.py::test_a_bump_of_a_drive_is_told_by_its_joint_and_place"
_IN_COMMON = "test_agreement.py::test_what_outliers_have_in_common_is_told"


@dataclass(frozen=True, kw_only=True)
class GatheringNumbers:
    """Thresholds by which rows that do not fit are said to lie in one place, or to have something
    in common.
    """

    chance: float = number(
        1e-4,
        "probability",
        _CLUSTER,
        "of a cluster of outliers anywhere in a sound table",
        "one table in ten thousand",
    )
    fewest: int = number(
        3, "outliers", _CLUSTER, "that make a cluster", "two are neighbours too often"
    )
    bump_chance: float = number(
        0.005,
        "probability",
        _BUMP,
        "of a bump anywhere on the drives of a sound arm",
        "one arm in two hundred",
    )
    in_bump: int = number(
        5, "rows", _BUMP, "in a window in which a joint may have a bump, at least", "chosen"
    )
    part: float = number(
        1 / 8,
        "ratio",
        _BUMP,
        "of the rows in a window to all, at most",
        "others have to show what windows are like",
    )
    clipped: float = number(
        4.0,
        "ratio",
        _BUMP,
        "of errors to the typical one, to which larger ones are clipped",
        "a few wrong rows make no bump",
    )
    outlier: float = number(
        8.0,
        "ratio",
        _BUMP,
        "of errors to the typical one, beyond which they are left out",
        "a few wrong rows make no bump",
    )
    permuted: float = number(
        0.25,
        "probability",
        _BUMP,
        "of a bump by disjoint windows, above which it is none and nothing is permuted",
        "it is 5 to 50 times as large as that by permutations",
    )
    explained: float = number(
        0.8,
        "ratio",
        _IN_COMMON,
        "of the squares that a misread joint has to explain to be named",
        "chosen",
    )
    mistold: float = number(
        0.3,
        "ratio",
        _IN_COMMON,
        "of the rows of a region that are classified wrongly to those that do not fit, at most",
        "chosen",
    )


CRITERIA = Criteria()
CHANGES = ChangeNumbers()
VISITS = VisitNumbers()
STOPS = StopNumbers()
AGREEMENT = AgreementNumbers()
MIDWAY = MidwayNumbers()
GATHERED = GatheringNumbers()
