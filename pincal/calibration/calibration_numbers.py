"""The numbers by which the result of a calibration is doubted, and other rows are told from its
own.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_RANGE = "test_elsewhere.py::test_the_range_that_was_not_measured_is_named_with_the_cure"
_COVERED = "test_model_file.py::test_outside_names_rows_joints_and_ranges"
_STANDS = "test_cells.py::test_where_a_robot_stands_is_found_from_contacts"
_COMMANDED = "test_motion_stations.py::test_joints_that_were_commanded_are_doubted_by_an_imu"
_LACKING = "test_discrepancy.py::test_what_drives_lack_is_found_with_its_lengths"
_ORDER = "test_rows.py::test_a_joint_that_moved_steadily_with_each_load_is_told"


@dataclass(frozen=True, kw_only=True)
class DoubtNumbers:
    """When something about a calibration is doubted or noted."""

    far: float = number(
        10.0,
        "ratio",
        "test_calibrate.py::test_outliers_at_five_per_cent_are_found_and_cost_nothing",
        "of the error of a held-out row to the median, above which it is far off",
        "15 standard deviations of a normal error in 3D",
    )
    steady: float = number(
        0.95,
        "rank correlation",
        _ORDER,
        "of a joint's positions with the row order, above which the joint moved steadily",
        "chosen",
    )
    rows: int = number(20, "rows", _ORDER, "from which on that is told", "chosen")
    unlike: float = number(
        4.0,
        "ratio",
        _COMMANDED,
        "of residuals of an IMU to its scatter within a window, above which it is another noise",
        "sound logs reach 1.6, including arms with ripple and friction that no effect describes; "
        "commanded instead of measured joints give 10",
    )
    usual: float = number(
        2.0,
        "ratio",
        _COMMANDED,
        "of residuals of an IMU to the usual noise, likewise",
        "an instrument twice as noisy as usual is no mistake",
    )
    many: float = number(
        0.25,
        "ratio",
        "test_agreement.py::test_a_third_of_the_rows_is_no_exception",
        "of the rows above which outliers are no exceptions",
        "real tables have some percent",
    )
    correlated: float = number(
        0.9,
        "correlation",
        "test_report_html.py::test_all_that_a_report_owes_is_there",
        "above which a pair of parameters is listed",
        "the two share four fifths of their variance",
    )


@dataclass(frozen=True, kw_only=True)
class CoverageNumbers:
    """What counts as covered by the rows of a calibration."""

    margin_part: float = number(
        0.02,
        "ratio",
        _COVERED,
        "of the range of the fitted rows beyond it that counts as covered",
        "chosen",
    )
    margin: float = number(
        1e-3, "rad, m or kg", _COVERED, "beyond the range that counts as covered", "chosen"
    )
    fewest: int = number(
        48, "poses", _RANGE, "from which on ranges of joints are compared", "four in each twelfth"
    )
    explained: float = number(
        0.1,
        "ratio",
        _RANGE,
        "of the variance of the expected errors that a range has to explain to be named",
        "below, it is combinations of joints that are missing, not the range of one",
    )
    sparse: float = number(
        0.5,
        "ratio",
        _RANGE,
        "of the measured poses in a range to evenly spread ones, below which it is hardly covered",
        "chosen",
    )


@dataclass(frozen=True, kw_only=True)
class OtherRowsNumbers:
    """How rows of another day, or another robot, are told from those of the calibration."""

    undetermined: float = number(
        100.0,
        "standard deviations of the noise",
        "test_placing.py::test_too_few_or_too_similar_rows_are_refused",
        "of a prediction, above which rows do not determine instrument and target",
        "chosen",
    )
    rare: float = number(
        1e-3,
        "probability",
        "test_validation.py::test_rows_that_were_fitted_are_not_called_held_out",
        "that some fingerprints agree by chance, below which rows are the same",
        "one table in a thousand",
    )
    noted: float = number(
        1.3,
        "ratio",
        "test_validation.py::test_a_real_robot_of_another_month_is_the_same",
        "of residuals to their expected size, above which a note is given",
        "UR10 tables of one series reach 1.1",
    )
    unseen: float = number(
        4.0,
        "ratio",
        "test_validation.py::test_a_real_robot_of_another_month_is_the_same",
        "by which residuals of the same robot may be larger where its curves are not determined",
        "the curves of the drives of a UR10 on another day",
    )
    spare: int = number(
        12,
        "degrees of freedom",
        _STANDS,
        "that contacts have to have to place another robot of a cell",
        "chosen",
    )
    clear: float = number(
        0.5,
        "ratio",
        _STANDS,
        "of the squares of the best place of a robot to those of the next best, at most",
        "chosen",
    )
    elsewhere: float = number(
        0.2, "rad", _STANDS, "by which two places of a robot differ to be two", "chosen"
    )


DOUBTED = DoubtNumbers()


@dataclass(frozen=True, kw_only=True)
class DiscrepancyNumbers:
    """What a model lacks, as a part of the uncertainty of its predictions."""

    regions: int = number(
        8,
        "regions",
        _LACKING,
        "of joint space that are left out in turn",
        "what is predicted is then as far from fitted poses as new work is",
    )
    fewest: int = number(15, "poses", _LACKING, "from which a discrepancy is estimated", "chosen")
    farther: float = number(
        1.03,
        "ratio",
        _LACKING,
        "of errors in regions that are wholly new to those of regions that are left out in turn",
        "real series of three arms, 20 to 250 poses",
    )


COVERAGE = CoverageNumbers()
DISCREPANCY = DiscrepancyNumbers()
OTHER_ROWS = OtherRowsNumbers()
