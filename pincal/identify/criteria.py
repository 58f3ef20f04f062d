"""The numbers by which a calibration decides, and what is said to have changed: each with its unit and where it comes from.

What bounds a computation (rows looked at, steps, rounding) stands where it is used. The numbers of a discovery stand in
``discover/policy.py``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import log
from typing import Any


def number(default: object, unit: str, pinned_by: str, meaning: str, origin: str) -> Any:
    """Return a field for a number: its unit, the test that fixes it, what it means, and why it has this value."""
    return field(default=default, metadata={"unit": unit, "meaning": meaning, "origin": origin, "pinned_by": pinned_by})


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
_STATIONS = "test_moves.py::test_a_robot_that_stays_the_same_moves_in_one_of_a_hundred"


# fmt: off
@dataclass(frozen=True, kw_only=True)
class Criteria:
    """What a calibration decides by."""

    bearing: float = number(10.0, _GAIN, "test_bearings.py::test_of_bearings_and_names_what_explains_more_enters_first",
        "what a feature of a bearing has to take off the sum of squares",
        "odds of 150 to 1; of a sound arm's twelve one enters in one fit out of fifty")
    moment_frame: float = number(10.0, _GAIN, "test_calibrate.py::test_the_papers_convention_is_taken_among_equals",
        "by how much another convention of moments has to be likelier", "the same odds")
    wider_prior: float = number(3.84, _GAIN, _PRIORS,
        "by how much readings may be less likely under wider priors where no instrument sees the robot",
        "one-sided limit at 2.5 %")
    unseen_direction: float = number(0.03, "ratio", "test_contacts.py::test_directions_without_contact_are_named",
        "part of the squares of all directions of readings below which nothing was measured in one",
        "sin^2 of 10 degrees, as far as directions of contact vary by themselves")
    not_improved: float = number(0.9, "ratio", _NOT_HELD,
        "standard deviation of predictions after and before a calibration above which nothing is improved", "chosen")
    mount_moved: float = number(0.02, "m", _NOT_HELD,
        "how far readings without an instrument move where an arm is mounted", "arms stand within a cm of their drawings")
    mount_held: float = number(0.1, "ratio", _NOT_HELD,
        "its standard deviation over its way above which nothing holds it", "ten standard deviations")
    unexcited: float = number(1e-6, "probability", "test_calibrate.py::test_simulated_elastic_arms_are_predicted",
        "that sound data call for a parameter that the nominal geometry never excites",
        "chosen: beyond what noise and small deviations bring up")
    outlier: float = number(0.01, "probability", _OUTLIERS,
        "that screening takes any sound row of a table for an outlier", "one sound table in a hundred loses a row")
    too_noisy: float = number(4.0, "standard deviations of chi-square", "test_calibrate.py::test_declared_noise_is_judged",
        "by which residuals exceed what declared noise leaves before they replace it", "1 in 30000 by chance")
    readings_left: int = number(6, "readings", "test_earlier.py::test_too_few_rows_are_refused",
        "beyond the unknowns, demanded beside an earlier fit: the parameters that it knows move as far as the noise "
        "seems small, and the noise seems small as far as they do", "the noise is known to 30 % then")
    most_spent: float = number(0.9, "ratio", "test_calibrate.py::test_too_few_rows_for_the_noise_are_refused",
        "part of the readings that parameters spend at most, before a fit has shown how many they do spend",
        "the noise is then at most three times what it seems")
    dependent: float = number(4.0, "standard deviations", "test_rows.py::test_independent_rows_are_taken_for_such",
        "by which sums of products of residuals exceed those of independent rows before rows are taken for dependent",
        "sound tables get there once in 10 000")
    correlated: float = number(18.0, _GAIN, "test_rows.py::test_a_fit_of_independent_rows_has_no_correlated_noise",
        "what correlation along the rows has to gain", "two parameters at a chance of 1e-4")
    fewest_in_order: int = number(20, "rows", _ORDER, "that can show a dependence along them", "the longest band of lags")
    as_likely: float = number(2.0, _GAIN, _ORDER,
        "within which a memory along the rows is as likely as the likeliest, and the longest is taken",
        "one standard deviation of a parameter, twice")
    of_blocks: float = number(4.0, "standard deviations", _OF_BLOCKS,
        "by which scores of blocks of rows exceed those of rows in any order before they widen what is stated",
        "as for dependence along rows")
    fewest_blocks: int = number(8, "blocks", _OF_BLOCKS,
        "of rows, at the least, that show it", "a variance is known to a half")
    identified: float = number(0.5, "ratio", _REASON,
        "of posterior to prior standard deviation, below which a parameter counts as identified",
        "the data hold three times the information of the prior (1 / 0.25 - 1)")
    narrowed: float = number(0.97, "ratio", _REASON,
        "the same above which the data count as adding nothing", "no prior's size is known to 3 %")
    unseen: float = number(1e-3, "ratio", _REASON,
        "share in directions that no reading sees above which a parameter is not identifiable by itself",
        "far above rounding, far below any share that matters")
    worth_naming: float = number(0.05, "ratio", _REASON,
        "share of a parameter's action below which another one is not named as its counterpart",
        "chosen: too small to be what it is exchanged for")
    moment: float = number(1.0 / 3.0, "ratio", _MOMENTS,
        "standard deviation over a static moment itself below which it counts as identified", "three standard deviations")


@dataclass(frozen=True, kw_only=True)
class ChangeNumbers:
    """What is said to have changed, from station to station or since a calibration, and what is not."""

    moved: float = number(0.01, "probability", _STATIONS,
        "that anything is said to have moved on a robot that is the same at all stations", "a robot in a hundred")
    usual: float = number(2.0 * log(10.0), _ODDS, "test_diagnosis.py::test_changes_are_named_in_97_of_100",
        "how much likelier than anything else it is that a drive lost its zero, before any row is seen", "odds of 10 to 1")
    wide: float = number(30.0, "prior sizes", _INTERVALS,
        "how far values of stations may be apart", "chosen: as good as any")
    wrong_rows: float = number(0.05, "ratio", _JUMP,
        "part of a station's rows up to which those that were rejected are wrong readings",
        "so many rows do not contradict the robot by mistake")
    too_quiet: float = number(1e-3, "probability", "test_moves.py::test_each_station_has_its_repeatability",
        "of as little noise as a station shows by itself below which the fit has taken something else for noise",
        "one sound station in a thousand")
    uneven: float = number(0.05, "probability", "test_moves.py::test_what_no_model_knows_moves_nothing",
        "that parts of a station differ as much by chance, below which stations may differ by as much, too", "usual")
    matters: float = number(0.01, "ratio", _STATIONS,
        "part of a station's squares that a parameter which moved explains, above which the model is not right there",
        "as of an effect that is named")
    unmodelled: float = number(1e-3, "probability", "test_diagnosis.py::test_an_adequate_model_left_nothing",
        "of an effect that a model left, all candidates counted, beyond which none is taken for real",
        "a new diagnosis compares with it, so it has to be there")
    false_alarm: float = number(0.01, "probability", _SAME, "that a robot that has not changed raises an alarm",
        "one check in a hundred")
    for_changes: float = number(0.8, "ratio", _SAME, "part of it for any one change", "chosen: most changes have a name")
    for_misfit: float = number(0.2, "ratio", _SAME, "part of it for a misfit that no change explains", "the rest")
    equivalent: float = number(2.0 * log(100.0), _ODDS, _APART,
        "below which two changes can't be told apart", "unless one is 100 times as likely")
    wrong_row: float = number(0.001, "probability", "test_diagnosis.py::test_one_wrong_reading_is_no_change",
        "that a sound row is taken for a wrong reading", "one sound table in a thousand")
    fewest_rows: int = number(8, "rows", "test_diagnosis.py::test_one_wrong_reading_is_no_change",
        "of which none is thought wrong", "too few to tell")
    too_many: float = number(0.25, "ratio", _GROSS,
        "part of the rows from which on those that stand apart are no exceptions", "of real tables some percent do")
    part_of_noise: float = number(0.95, "ratio", "test_diagnosis.py::test_what_a_model_left_is_no_change",
        "part of what a calibration took for noise that an effect which it left may have been", "nearly all of it")
    hopeless: float = number(0.01, "ratio", _REFUSED,
        "what is left after all changes, over the reach, beyond which the rows are not of this robot",
        "a centimetre on a metre")
    strange: float = number(0.1, "ratio", _REFUSED,
        "what is left before any, beyond which it is not worth while to look for them",
        "a drive that is off by 0.2 rad leaves half as much")
    degrees: float = number(200.0, "degrees of freedom", "test_diagnosis.py::test_an_instrument_with_more_noise_tells_less",
        "by which a calibration is taken to know its noise, where nobody knows how many rows it had",
        "chosen: that of a usual table")
    many: int = number(4, "changes", _REFUSED,
        "from which on another robot of the same type is likelier than one to which so much has happened",
        "chosen: a bound on what is believable")
    worth_a_word: float = number(0.9, "ratio", _CURVE,
        "part of an error, and of the rows, below which another curve of a drive is worth a word", "a tenth better")
    rows_each: int = number(4, "rows per parameter", _CHANGED, "below which a curve is not tried", "chosen: for time")
    curve_rows: int = number(24, "rows", _CURVE, "from which on there is something to leave out", "three for each block")
    curve_blocks: int = number(8, "blocks", _CURVE, "that are left out in turn, each of a few regions of joint space",
        "as in a discovery")
    curve_seen: float = number(0.5, "ratio", _SEEN_CURVE,
        "a curve's standard deviation, its mean apart, over what was believed of it, below which it was seen",
        "a quarter of the variance; in gaps of 25 degrees of a UR10's table it is .6 and more, beside its rows .1")
    detected: float = number(0.9, "probability", _EXCLUDED,
        "that a change of the size that is given would have been noticed", "usual: a power of 0.9")
    told_apart: float = number(30.0, "noise variance", _APART,
        "non-centrality at which two changes are told apart", "5.5 standard deviations of one parameter")
    same_by_chance: int = number(1, "rows", "test_diagnosis.py::test_rows_that_the_model_was_fitted_to_tell_nothing",
        "with the fingerprint of a row of the calibration that are met by chance", "of some thousands of rows hardly one")


# fmt: on
CRITERIA = Criteria()
CHANGES = ChangeNumbers()
