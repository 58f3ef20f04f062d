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
_ODD = _SESSIONS + "test_what_is_odd_is_told"
_FRAMES = _SESSIONS + "test_a_clock_of_frames_is_told"
_SWAPPED = _SESSIONS + "test_swapped_imus_are_told_by_name"
_FAULT = _LOGS + "test_the_stream_at_fault_is_refused"
_PACKETS = _LOGS + "test_stamps_of_packets_are_those_of_their_samples_again"
_ARRIVAL = _LOGS + "test_stamps_of_arrival_are_told_from_those_of_two_devices"
_LATE = _LOGS + "test_rows_that_are_written_late_or_twice_are_put_in_order"
_LOST = _LOGS + "test_a_target_that_is_lost_is_left_out"
_STALE = _LOGS + "test_an_instrument_of_few_digits_keeps_its_rows"
_UNREAD = _LOGS + "test_sensors_of_an_imu_that_are_read_no_more_are_left_out"
_BREAKS = _LOGS + "test_joints_that_are_interrupted_go_on_behind_the_gap"
_STRAIGHT = _LOGS + "test_what_was_interpolated_is_no_reading"
_CLIPPED = _LOGS + "test_a_range_that_is_too_small_is_no_broken_axis"
_ELSE = _LOGS + "test_readings_of_something_else_are_left_out"
_ANOTHER = "test_motion.py::test_speeds_of_another_motion_are_not_taken_for_this_one"
_GAP = "test_motion.py::test_a_gap_divides_a_path"
_NO_SPLINE = "test_motion.py::test_a_log_that_no_spline_can_follow_is_refused"
_IMAGES = "test_motion_pixels.py::test_images_that_do_not_fit_the_motion_are_refused"
_SLIPS = "test_motion_stations.py::test_a_clock_that_slips_is_refused_with_the_row"
_ONE_JOINT = "test_motion_stations.py::test_a_path_of_one_joint_is_asked_for_more"
_JUMP = "test_motion.py::test_a_jump_of_a_clock_is_found_to_the_row"


# fmt: off
@dataclass(frozen=True, kw_only=True)
class StreamNumbers:
    """By which rows of a stream are left out, or the stream is refused."""

    gap: float = number(3.0, "samples", _ODD,
        "without a row, from which on a log has a gap", "chosen")
    long_gap: float = number(0.2, "s", _ODD,
        "of a gap that is reported, and within which joints may jump and come back", "chosen")
    few: float = number(0.05, "ratio", _ODD,
        "of repeated rows of an IMU that are left out as single ones, and of clipped rows",
        "chosen")
    most: float = number(0.5, "ratio", _LOST,
        "of rows that may be left out", "chosen")
    gravity: float = number(1.5, "ratio", _DOOR,
        "by which the median specific force may differ from gravity", "chosen")
    flat: int = number(3, "samples", _UNREAD,
        "of one value, at an extreme of which they may be clipped, or after which a jump "
            "shows that they were not updated", "chosen")
    often_flat: int = number(3, "occurrences", _CLIPPED,
        "of such samples, from which on they are clipped", "chosen")
    long_flat: int = number(20, "samples", _CLIPPED,
        "of which one occurrence is enough", "chosen")
    straight: int = number(8, "rows", _STRAIGHT,
        "on a straight line, from which on they are interpolated", "chosen")
    even: float = number(0.1, "ratio", _STRAIGHT,
        "of rounding to usual deviations from a straight line, above which none is told", "chosen")
    turn: float = number(0.3, "rad", _BREAKS,
        "by which a jump of a joint may differ from a revolution", "chosen")
    sudden: float = number(5.0, "ratio, rad/s or m/s", _BREAKS,
        "speed of a joint, in units of its usual highest one, that no arm reaches", "chosen")
    often_same: float = number(0.3, "ratio", _ODD,
        "of repeated rows of joints, above which their log is faster than their controller",
        "chosen")
    frozen: float = number(1.0, "s", _DOOR,
        "for which an axis of an IMU may be constant while others move", "chosen")
    moves: float = number(0.5, "standard deviations", _DOOR,
        "by which others move then", "chosen")
    jumps: float = number(8.0, "smallest steps", _UNREAD,
        "between samples after standing still that are a jump",
        "chosen: a real motion starts with its smallest steps")


@dataclass(frozen=True, kw_only=True)
class StampNumbers:
    """By which stamps are those of samples, of packets, or of a clock that was set."""

    slowest: float = number(9.0, "Hz", _CLIPPED,
        "of a log of joints or an IMU", "chosen")
    slow: float = number(2.0, "Hz", "test_motion_pixels.py::test_points_of_one_image_share_a_stamp",
        "of other instruments", "chosen")
    fastest: float = number(2e4, "Hz", _DOOR,
        "of any log", "chosen: beyond any device")
    usual: float = number(2e3, "Hz", _DOOR,
        "up to which another unit is told by the rate that it makes", "chosen: beyond most devices")
    endless: float = number(3600.0, "s", _FAULT,
        "gap within a log", "chosen: an hour")
    few: float = number(0.05, "ratio", _LATE,
        "of rows with the stamp of the row before that are left out as single ones", "chosen")
    late: float = number(2.0, "s", _DOOR,
        "by which a row may be late", "chosen")
    extra: float = number(1.5, "stamps", _LATE,
        "more than expected where rows were put in order, above which the clock was set back",
        "chosen: more than one")
    crowded: float = number(0.2, "ratio", _DOOR,
        "the same, to the expected number", "chosen")
    often_set: int = number(3, "times", _ARRIVAL,
        "that a clock is set in a log, at most", "chosen: more are stamps of arrival")
    burst: float = number(1.0 / 3.0, "ratio", _FAULT,
        "of the median step of stamps to the mean, below which rows are in bursts", "chosen")
    paired: float = number(0.25, "ratio", _ARRIVAL,
        "of the step of a pair of rows to the mean", "chosen")
    often_paired: float = number(0.2, "ratio", _ARRIVAL,
        "of such pairs, above which rows are in bursts", "chosen")
    smoother: float = number(0.7, "ratio", _ARRIVAL,
        "of roughness, below which readings show that times are by stamps, or by the count of "
            "samples", "chosen: rows in the order of sampling are smoother")
    packets: int = number(10, "packets", _PACKETS,
        "among which one is hardly delayed", "chosen")
    fewest_parts: int = number(5, "parts", _PACKETS,
        "of so many packets whose least delayed ones show an even rate", "chosen")
    uneven: float = number(0.25, "steps", _FAULT,
        "by which these may deviate from an even rate", "chosen: less than one sample")
    uneven_time: float = number(1e-3, "s", _PACKETS,
        "the same", "chosen: clocks are aligned by the nominal arm to a millisecond")
    lacking: float = number(0.75, "steps", _DOOR,
        "by which a few packets may deviate from it", "less than the one that a lost sample makes")


@dataclass(frozen=True, kw_only=True)
class ClockNumbers:
    """By which readings are of the motion of the joints, and a clock jumps or drifts."""

    same_motion: float = number(0.6, "correlation", _ANOTHER,
        "of speeds below which motions are different", "chosen")
    clear: float = number(0.03, "correlation", _ANOTHER,
        "by which that at other offsets is less", "chosen")
    apart: float = number(1.0, "s", _ANOTHER,
        "by which other offsets of the clocks differ", "chosen")
    significant: float = number(6.0, "standard deviations", _JUMP,
        "of a jump, or of a slip of a mount", "chosen: beyond chance at any of the rows tried")
    either_side: int = number(3, "blocks", _JUMP,
        "of rows on either side of a jump, at least", "chosen")
    nominal_jump: float = number(0.05, "s", _FAULT,
        "that no error of a nominal arm looks like", "smaller ones are found in the calibration")
    drift: float = number(2e-4, "1", _FRAMES,
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
    outlier: float = number(0.2, "standard deviations", _ELSE,
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

    readings_per_knot: float = number(2.0, "readings", _NO_SPLINE,
        "of a spline, at least", "chosen: twice its coefficients")
    bridged: float = number(2.0, "knots", _GAP,
        "of a gap that a spline bridges, at most", "chosen")
    ends: float = number(3.0, "knots", _GAP,
        "at either end of a path where it is not reliable", "chosen: half the order of the spline")
    window_gap: float = number(1.25, "widths", _LOGS + "test_gaps_do_no_harm",
        "of a gap in the window of a row of an IMU, at most", "chosen")


# fmt: on
STREAM = StreamNumbers()
STAMP = StampNumbers()
CLOCKS = ClockNumbers()
FOLLOWING = FollowingNumbers()
ON_PATH = PathNumbers()
