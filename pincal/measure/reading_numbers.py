"""The numbers by which a table is read one way rather than another, or refused: each with its unit
and origin.

Bounds on what is looked at or held in memory stand where they are used; the limits of joints, by
which rows are admitted, in :mod:`pincal.measure.admit`.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_HERE = "test_reading_numbers.py::"
_HARDLY_DIFFER = "test_replicates.py::test_joints_that_hardly_differ_are_one_pose"
_SETTLE = _HERE + "test_means_are_of_positions_within_what_drives_repeat"
_CONDITION = "test_replicates.py::test_another_condition_is_another_pose"
_PLAY = _HERE + "test_a_joint_arrives_from_a_side_if_it_crossed_the_play_of_its_gear"
_HELD = _HERE + "test_a_pose_is_held_still_for_some_tenths_of_a_second"
_LOG = "test_joined.py::test_a_table_is_a_log_by_its_rows_and_their_times"
_LEAVE = _HERE + "test_half_the_usual_time_is_enough_to_leave_and_come_back"
_SESSIONS = "test_stops.py::test_a_short_break_divides_no_session"
_TITLES = "test_formats.py::test_a_row_is_of_the_table_if_most_of_it_is_filled"
_EPOCH = "test_logs_of_motion.py::test_a_time_since_1970_is_read_in_its_unit"
_EYE = "test_table_kinds.py::test_samples_that_show_no_camera_on_the_hand_are_refused"
_KINDS = "test_table_kinds.py::test_most_kinds_need_no_option"
_SMALL = _HERE + "test_a_file_holds_no_more_than_measured_numbers"
_LOAD = _HERE + "test_loads_of_a_pose_agree_to_a_gram"
_BETWEEN = _HERE + "test_half_of_a_table_is_read_while_the_arm_is_held"
_AGREE = _HERE + "test_rows_of_one_pose_of_a_log_agree"
_LISTS = _HERE + "test_numbers_of_short_lists_are_columns"
_MATRIX = "test_table_forms.py::test_numbers_are_a_matrix_if_they_form_one"
_KEYED = "test_table_forms.py::test_keys_are_of_poses_or_of_columns"
_ALONG = "test_table_forms.py::test_poses_stand_where_the_numbers_show_it"
_PLACEHOLDERS = "test_table_forms.py::test_numbers_in_place_of_readings_by_hand"
_CUT = "test_joined.py::test_a_log_is_cut_where_the_arm_moves"
_SURE_JUMP = "test_motion_numbers.py::test_a_jump_of_a_clock_is_six_standard_deviations"
_JUMP = "test_motion.py::test_a_jump_of_a_clock_is_found_to_the_row"
_STEPS = "test_stepping_clocks.py::test_more_steps_than_a_clock_has_are_refused"


# fmt: off
@dataclass(frozen=True, kw_only=True)
class SamePoseNumbers:
    """By which rows are of one pose, and a joint arrived from a side."""

    same: float = number(1e-5, "rad, m", _HARDLY_DIFFER,
        "up to which joint positions count as the same",
        "above the resolution of encoders, below the repeatability of robots: 0.02 mm at the "
            "tip of an arm of 2 m")
    settled: float = number(1e-4, "rad, m", _SETTLE,
        "up to which they do although drives settle differently",
        "drives repeat to 1e-5 to 9e-5 rad (Slamani 2012: an IRB 1600 to 8.7e-5); means of "
            "closer rows are exact to 1e-9 m")
    load: float = number(1e-3, "kg", _LOAD,
        "up to which payloads count as the same", "a gram bends no arm")
    climate: float = number(4.0, "K", _CONDITION,
        "range of temperatures of one pose", "ISO 9283 allows 2 K in either direction")
    play: float = number(1e-3, "rad, m", _PLAY,
        "move of a joint below which it may not have crossed the play of its gear",
        "no robot has more")


@dataclass(frozen=True, kw_only=True)
class LogNumbers:
    """By which a log of joints is cut into poses, and joined with a table."""

    still: float = number(3e-4, "rad, m", _HELD,
        "motion up to which an arm is held still", "encoder noise is smaller")
    hold: float = number(0.3, "s", _HELD,
        "for which it has to be held", "chosen: some tenths")
    drift: float = number(2e-3, "rad, m", _HELD,
        "of a held pose, at most", "chosen: an arm that creeps on is not held")
    fewest_rows: int = number(100, "rows", _LOG,
        "of a log", "chosen: few tables have as many poses")
    longest_step: float = number(0.1, "s", _LOG,
        "median time from row to row of a log", "no one measures ten poses a second")
    in_motion: float = number(0.05, "ratio", _CUT,
        "of rows in motion, above which a log is cut into held poses", "chosen")
    rows_per_pose: int = number(10, "rows", _CUT,
        "of each pose, above which a log that was joined with its joints is averaged",
        "chosen: more than a pose is read by hand")
    between: float = number(0.5, "ratio", _BETWEEN,
        "of a table's rows between the poses of a log, at most, if they belong to it",
        "chosen: the other half show that the clocks agree")
    agree: float = number(2e-3, "rad, m", _AGREE,
        "difference of joint positions up to which two rows of a log are of one pose",
        "as for the drift of a held pose")


@dataclass(frozen=True, kw_only=True)
class VisitDivision:
    """By which consecutive rows are of two stops, or two sessions."""

    away: float = number(0.5, "ratio", _LEAVE,
        "of the time between rows of one pose to the usual one from pose to pose, from which "
            "on they are two stops", "the arm had time to leave and come back")
    pause: float = number(20.0, "ratio", _SESSIONS,
        "of the time between two stops to the usual one, above which two sessions are divided",
        "chosen: longer than a look at the instrument")
    least_pause: float = number(600.0, "s", _SESSIONS,
        "below which a pause divides none", "chosen: a coffee")


@dataclass(frozen=True, kw_only=True)
class LayoutNumbers:
    """By which the cells of a file are taken for one thing or another."""

    filled: float = number(0.6, "ratio", _TITLES,
        "of filled cells, below which a row is a title or a remark, not one of the table", "chosen")
    since_1970: tuple[float, float] = number((9.4e8, 4.2e9), "s", _EPOCH,
        "between which a number is a time since 1970, and shows its unit", "this century")
    clear: float = number(0.3, "ratio", _EYE,
        "of the residuals of a camera on the hand and a fixed one, below which samples tell "
            "them apart", "chosen: both are nearly equal where they do not")
    orthonormal: float = number(0.01, "1", _MATRIX,
        "by which the rows of a rotation matrix, and the last row of a 4 x 4 one, may differ from "
            "what they are", "above the rounding of three decimals")
    fewest_keys: int = number(3, "poses", _KEYED,
        "from which on keys of nested values are recognised as those of poses",
        "no calibration has fewer")
    of_pose: int = number(7, "values", _KEYED,
        "of numbered keys with lists of one length, up to which each is a pose if there are more "
            "of them, else a column", "a position and a quaternion, or the joints of most arms")
    poses_to_numbers: float = number(2.0, "ratio", _ALONG,
        "of columns to rows of numbers without names, above which each column is a pose if nothing "
            "else shows it", "chosen: a table has about ten numbers a pose, and mostly more poses")
    longest_list: int = number(32, "values", _LISTS,
        "of a list whose numbers are columns", "images are longer")
    frame_moves: float = number(1e-3, "m, 1", _KINDS,
        "by which position or quaternion of a moving frame change, and the position of one "
            "that moves freely in two directions",
        "above the noise of a broadcast frame that stands still")
    beyond: float = number(2.0, "ratio", _PLACEHOLDERS,
        "of a number in all components to all other readings, above which it is none", "chosen")
    fewest_readings: int = number(8, "rows", _PLACEHOLDERS,
        "with other readings, from which on these tell what is none",
        "fewer rows calibrate no arm")
    seldom: float = number(0.5, "ratio", _PLACEHOLDERS,
        "of rows with 0 0 0 or -1 -1 -1 to all, below which these are no readings",
        "an instrument that lost its target most of the time is another problem")
    unpacked: int = number(50, "ratio", _SMALL,
        "of unpacked to packed size, above which a file is refused",
        "measured numbers compress to a fifth in Excel, one number in all cells to an eighth; "
            "60 poses with 1000 readings each to a ninth in Parquet")
    always_unpacked: int = number(1_000_000, "bytes", _SMALL,
        "that any file may hold unpacked", "small ones are little but headers")


@dataclass(frozen=True, kw_only=True)
class ClockJumpNumbers:
    """By which the clock of an instrument jumps."""

    significant: float = number(6.0, "standard deviations", _SURE_JUMP,
        "of a jump, or of a slip of a mount", "chosen: beyond chance at any of the rows tried")
    either_side: int = number(3, "blocks", _JUMP,
        "of rows on either side of a jump, at least", "chosen")
    most: int = number(12, "jumps", _STEPS,
        "of a clock in a session, at most",
        "chosen: more are stamps of another kind, such as those of arrival")


# fmt: on
SAME_POSE = SamePoseNumbers()
LOGS = LogNumbers()
DIVISION = VisitDivision()
LAYOUT = LayoutNumbers()
JUMPS = ClockJumpNumbers()
