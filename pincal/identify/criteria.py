"""The thresholds of decisions in a fit, each with its unit and origin.

Those of other decisions stand in the files ``..._numbers.py`` of the room that decides, those of a
discovery that a user may change in ``discover/policy.py``. Bounds on a computation (rows used,
steps, rounding) are defined where they are used.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_GAIN = "2 log likelihood"
_REASON = "test_calibrate.py::test_reasons_name_the_counterpart"
_ORDER = "test_rows.py::test_correlated_noise_is_estimated_and_left_white"
_OF_BLOCKS = "test_rows.py::test_blocks_of_rows_widen_what_rows_that_hang_together_say"
_OUTLIERS = "test_calibrate.py::test_outliers_at_five_per_cent_are_found_and_cost_nothing"
_MOMENTS = "test_link_mass.py::test_the_moments_that_are_identified_are_those_of_the_machine"
_PRIORS = "test_contacts.py::test_priors_are_as_wide_as_the_readings_allow"


@dataclass(frozen=True, kw_only=True)
class Criteria:
    """Thresholds of decisions in a fit."""

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


CRITERIA = Criteria()
