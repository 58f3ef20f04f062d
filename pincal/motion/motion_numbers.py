"""The numbers by which streams of a motion are refused, doubted, or read one way rather than
another: each with its unit and origin.

Bounds on a computation, such as rows looked at or steps of a search, stand where they are used.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_LOGS = "test_logs_of_motion.py::"
_SESSIONS = "test_motion_sessions.py::"
_DOOR = _SESSIONS + "test_streams_that_cannot_be_right_are_refused"
_MOTION = _SESSIONS + "test_streams_that_do_not_fit_the_motion_are_refused"
_FAULT = _LOGS + "test_the_stream_at_fault_is_refused"
_PACKETS = _LOGS + "test_stamps_of_packets_are_those_of_their_samples_again"
_SET = _LOGS + "test_a_clock_that_was_set_back_by_little_goes_on"
_ARRIVAL = _LOGS + "test_stamps_of_arrival_are_told_from_those_of_two_devices"
_LATE = _LOGS + "test_rows_that_are_written_late_or_twice_are_put_in_order"
_STALE = _LOGS + "test_an_instrument_of_few_digits_keeps_its_rows"
_ELSE = _LOGS + "test_readings_of_something_else_are_left_out"
_ANOTHER = "test_motion.py::test_speeds_of_another_motion_are_not_taken_for_this_one"
_IMAGES = "test_motion_pixels.py::test_images_that_do_not_fit_the_motion_are_refused"
_ONE_JOINT = "test_motion_stations.py::test_a_path_of_one_joint_is_asked_for_more"
_HERE = "test_motion_numbers.py::"
_GAPS = _HERE + "test_gaps_are_three_samples_or_a_fifth_of_a_second"
_HALF = _HERE + "test_half_of_a_log_may_be_left_out"
_SUDDEN = _HERE + "test_no_joint_moves_at_five_radians_a_second"
_TURN = _HERE + "test_a_jump_of_nearly_a_revolution_is_one"
_TOO_FAST = _HERE + "test_a_log_that_repeats_three_rows_of_ten_is_too_fast"
_GRAVITY = _HERE + "test_gravity_is_there_and_in_its_unit"
_REPEATS = _HERE + "test_an_imu_that_repeats_a_row_of_twenty_is_logged_too_fast"
_ENDS = _HERE + "test_an_axis_is_clipped_where_it_is_often_or_long_at_its_end"
_BROKEN = _HERE + "test_an_axis_is_broken_that_stands_still_for_a_second"
_WITH_OTHERS = _HERE + "test_an_axis_may_stand_still_with_the_others"
_NOT_UPDATED = _HERE + "test_forces_that_stand_still_and_jump_were_not_updated"
_LINE = _HERE + "test_eight_readings_on_a_straight_line_are_interpolated"
_ROUNDED = _HERE + "test_no_line_is_told_that_rounding_makes"
_FAST_LOGS = _HERE + "test_a_motion_is_followed_by_fast_logs"
_UNIT = _HERE + "test_another_unit_of_time_is_told_by_a_usual_rate"
_HOUR = _HERE + "test_a_log_has_no_gap_of_an_hour"
_SAME_STAMP = _HERE + "test_a_twentieth_of_the_rows_may_have_the_stamp_of_the_row_before"
_LATER = _HERE + "test_a_row_is_late_by_two_seconds_at_most"
_BURSTS = _HERE + "test_rows_in_bursts_have_stamps_of_arrival"
_FIFTY = _HERE + "test_fifty_packets_show_an_even_rate"
_ALIKE = _HERE + "test_speeds_of_one_motion_are_alike"
_SURE = _HERE + "test_a_jump_of_a_clock_is_six_standard_deviations"
_POLLED = _LOGS + "test_an_imu_that_is_polled_has_the_times_of_its_samples"
_TOO_FAST = _LOGS + "test_an_instrument_that_is_polled_too_fast_has_the_times_of_its_samples"
_NEIGHBOURS = _HERE + "test_a_reading_off_its_neighbours_is_of_something_else"
_KNOTS = _HERE + "test_two_knots_are_bridged"
_TWO = _HERE + "test_a_knot_has_two_readings"


# fmt: off
@dataclass(frozen=True, kw_only=True)
class StreamNumbers:
    """By which rows of a stream are left out, or the stream is refused."""

    gap: float = number(3.0, "samples", _GAPS,
        "without a row, from which on a log has a gap", "chosen")
    long_gap: float = number(0.2, "s", _GAPS,
        "of a gap that is reported, and within which joints may jump and come back", "chosen")
    few: float = number(0.05, "ratio", _REPEATS,
        "of repeated rows of an IMU that are left out as single ones, and of clipped rows",
        "chosen")
    most: float = number(0.5, "ratio", _HALF,
        "of rows that may be left out", "chosen")
    gravity: float = number(1.5, "ratio", _GRAVITY,
        "by which the median specific force may differ from gravity", "chosen")
    flat: int = number(3, "samples", _ENDS,
        "of one value, at an extreme of which they may be clipped, or after which a jump "
            "shows that they were not updated", "chosen")
    often_flat: int = number(3, "occurrences", _ENDS,
        "of such samples, from which on they are clipped", "chosen")
    long_flat: int = number(20, "samples", _ENDS,
        "of which one occurrence is enough", "chosen")
    straight: int = number(8, "rows", _LINE,
        "on a straight line, from which on they are interpolated", "chosen")
    even: float = number(0.1, "ratio", _ROUNDED,
        "of rounding to usual deviations from a straight line, above which none is told", "chosen")
    turn: float = number(0.3, "rad", _TURN,
        "by which a jump of a joint may differ from a revolution", "chosen")
    sudden: float = number(5.0, "ratio, rad/s or m/s", _SUDDEN,
        "speed of a joint, in units of its usual highest one, that no arm reaches", "chosen")
    often_same: float = number(0.3, "ratio", _TOO_FAST,
        "of repeated rows of joints, above which their log is faster than their controller",
        "chosen")
    frozen: float = number(1.0, "s", _BROKEN,
        "for which an axis of an IMU may be constant while others move", "chosen")
    moves: float = number(0.5, "standard deviations", _WITH_OTHERS,
        "by which others move then", "chosen")
    jumps: float = number(8.0, "smallest steps", _NOT_UPDATED,
        "between samples after standing still that are a jump",
        "chosen: a real motion starts with its smallest steps")


@dataclass(frozen=True, kw_only=True)
class StampNumbers:
    """By which stamps are those of samples, of packets, or of a clock that was set."""

    slowest: float = number(9.0, "Hz", _FAST_LOGS,
        "of a log of joints or an IMU", "chosen")
    slow: float = number(2.0, "Hz", _FAST_LOGS,
        "of other instruments", "chosen")
    fastest: float = number(2e4, "Hz", _UNIT,
        "of any log", "chosen: beyond any device")
    usual: float = number(2e3, "Hz", _UNIT,
        "up to which another unit is told by the rate that it makes", "chosen: beyond most devices")
    endless: float = number(3600.0, "s", _HOUR,
        "gap within a log", "chosen: an hour")
    few: float = number(0.05, "ratio", _SAME_STAMP,
        "of rows with the stamp of the row before that are left out as single ones", "chosen")
    late: float = number(2.0, "s", _LATER,
        "by which a row may be late", "chosen")
    extra: float = number(1.5, "stamps", _LATE,
        "more than expected where rows were put in order, above which the clock was set back",
        "chosen: more than one")
    crowded: float = number(0.2, "ratio", _SET,
        "the same, to the expected number", "chosen")
    often_set: int = number(3, "times", _ARRIVAL,
        "that a clock is set in a log, at most", "chosen: more are stamps of arrival")
    burst: float = number(1.0 / 3.0, "ratio", _BURSTS,
        "of the median step of stamps to the mean, below which rows are in bursts", "chosen")
    paired: float = number(0.25, "ratio", _BURSTS,
        "of the step of a pair of rows to the mean", "chosen")
    often_paired: float = number(0.2, "ratio", _BURSTS,
        "of such pairs, above which rows are in bursts", "chosen")
    smoother: float = number(0.7, "ratio", _ARRIVAL,
        "of roughness, below which readings show that times are by stamps, or by the count of "
            "samples", "chosen: rows in the order of sampling are smoother")
    packets: int = number(10, "packets", _FIFTY,
        "among which one is hardly delayed", "chosen")
    fewest_parts: int = number(5, "parts", _FIFTY,
        "of so many packets whose least delayed ones show an even rate", "chosen")
    uneven: float = number(0.25, "steps", _FAULT,
        "by which these may deviate from an even rate", "chosen: less than one sample")
    uneven_time: float = number(1e-3, "s", _PACKETS,
        "the same", "chosen: clocks are aligned by the nominal arm to a millisecond")
    lacking: float = number(0.75, "steps", _DOOR,
        "by which a few packets may deviate from it", "less than the one that a lost sample makes")


@dataclass(frozen=True, kw_only=True)
class ClockNumbers:
    """By which readings are of the motion of the joints, and a clock drifts or jumps far."""

    same_motion: float = number(0.6, "correlation", _ALIKE,
        "of speeds below which motions are different", "chosen")
    clear: float = number(0.03, "correlation", _ALIKE,
        "by which that at other offsets is less", "chosen")
    apart: float = number(1.0, "s", _ANOTHER,
        "by which other offsets of the clocks differ", "chosen")
    nominal_jump: float = number(0.05, "s", _SURE,
        "that no error of a nominal arm looks like", "smaller ones are found in the calibration")
    drift: float = number(2e-4, "1", _SURE,
        "above which a clock is not one of a crystal", "chosen: crystals are better")
    unexplained: float = number(1e-2, "ratio", _IMAGES,
        "of the variance of readings at the best offset, at most", "usually 1e-5 to 1e-3")
    rivals: float = number(0.75, "ratio", _IMAGES,
        "of the log-likelihood there that other offsets may have", "chosen")
    readings_apart: float = number(1.0, "s", _IMAGES,
        "by which these differ", "as for speeds")


@dataclass(frozen=True, kw_only=True)
class FollowingNumbers:
    """By which readings follow the nominal arm, in their unit and in a right-handed frame."""

    scale: float = number(0.2, "1", _MOTION,
        "error of lengths and rates in the right unit, at most",
        "chosen: no arm differs as much from its URDF")
    unit: float = number(0.05, "1", _MOTION,
        "within which another unit is recognised", "chosen")
    turned: float = number(0.2, "rad", _MOTION,
        "angle between frames of one device, above which columns are mixed up",
        "mixed up they differ by a right angle")
    slipped: float = number(0.01, "rad", _MOTION,
        "by which a mount may turn", "chosen: errors of a nominal arm look like less")
    few_blocks: int = number(3, "blocks",
        _SESSIONS + "test_an_arm_that_rests_tells_nothing_of_the_mount",
        "on one side of a slip, for which its limit is twice as high",
        "errors of the nominal arm turn the mount as well, differently in each move")
    off: float = number(0.1, "ratio", _MOTION,
        "of the deviation of positions to their motion, at most", "chosen")
    mirrored: float = number(-0.5, "handedness", _IMAGES,
        "below which axes are mirrored", "it is 1 or -1 but for errors of the nominal arm")
    shortest: float = number(20.0, "s", _IMAGES,
        "of readings that can be located in the motion", "chosen")
    outlier: float = number(0.2, "standard deviations", _NEIGHBOURS,
        "from neighbours, above which a reading is of something else", "chosen")
    rests: float = number(3e-4, "rad, m", _STALE,
        "range of a joint at rest", "as for an arm that is held still in a log of poses")
    moved: float = number(1e-2, "rad, m", _ONE_JOINT,
        "range of a joint that moved", "chosen")
    too_few: int = number(2, "joints", _ONE_JOINT,
        "that moved, up to which other motions look alike", "chosen")
    fast: float = number(20.0, "Hz", _ELSE,
        "above which the motion within two samples is never an outlier", "chosen")
    coarse: float = number(2.5, "smallest steps", _STALE,
        "of a change up to which a reading is one of few digits, not stale",
        "chosen: one or two steps of its resolution")


@dataclass(frozen=True, kw_only=True)
class PathNumbers:
    """By which a log of joints has a path, and a row has a place on it."""

    readings_per_knot: float = number(2.0, "readings", _TWO,
        "of a spline, at least", "chosen: twice its coefficients")
    bridged: float = number(2.0, "knots", _KNOTS,
        "of a gap that a spline bridges, at most", "chosen")
    ends: float = number(3.0, "knots", _KNOTS,
        "at either end of a path where it is not reliable", "chosen: half the order of the spline")
    window_gap: float = number(1.25, "widths", _LOGS + "test_gaps_do_no_harm",
        "of a gap in the window of a row of an IMU, at most", "chosen")


@dataclass(frozen=True, kw_only=True)
class PollingNumbers:
    """By which stamps of an IMU are those of polls, and a reading has the time of its sample."""

    clear: float = number(100.0, "ratio", _POLLED,
        "of the power of a line to the median of a spectrum, from which on it is one",
        "chosen: of 1e5 powers of noise the largest is 17 times their median")
    least: float = number(0.5, "ratio", _POLLED,
        "of the delays that residuals show to those of polls, or its inverse, at least",
        "chosen: 0.90 to 1.01 were found where a simulated IMU was polled; 0.46 at most for the "
            "mirror of the rate of its samples at that of polls")
    unsure: float = number(0.03, "samples", _POLLED,
        "from the next sample or the last one, within which it is not known which was read",
        "chosen: some tenths of a millisecond, by which a stamp may be off its poll")
    gap: float = number(3.0, "medians", _POLLED,
        "of the steps of a log, above which it has a gap", "as for other streams")
    faster: float = number(1.4, "ratio", _TOO_FAST,
        "of the time between two samples of an instrument to that between two polls, from which on "
            "these are faster",
        "chosen: delays of stamps that are of no samples fill the time between two of these, of "
            "which polls that are even to a quarter then leave a tenth")
    within: float = number(1.25, "polls", _TOO_FAST,
        "by which stamps of samples at an even rate may be late",
        "1 if polls are even; chosen beyond that for their jitter")


# fmt: on
STREAM = StreamNumbers()
STAMP = StampNumbers()
CLOCKS = ClockNumbers()
FOLLOWING = FollowingNumbers()
ON_PATH = PathNumbers()
POLLING = PollingNumbers()
