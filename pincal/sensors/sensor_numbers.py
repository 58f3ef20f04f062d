"""The numbers by which readings are refused, or doubted, as those of something else: each with its
unit and origin.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_HERE = "test_reading_numbers.py::"
_DECLARED = _HERE + "test_a_target_follows_the_arm_by_a_thousandth_of_its_reach"
_FIXED = _HERE + "test_distances_are_those_of_instruments"
_IN_LINE = _HERE + "test_points_in_a_line_tell_no_rotation"
_MILLIMETRES = _HERE + "test_a_fifth_of_the_rows_is_a_column_at_fault"
_MOVED = _HERE + "test_half_a_radian_moves_a_target"
_NORM = _HERE + "test_quaternions_have_the_norm_of_rounded_ones"
_PLANES = "test_cell_sensors.py::test_rows_that_tell_nothing_are_named"
_TOOL = _HERE + "test_a_target_is_within_two_metres_of_the_flange"
_TURN = _HERE + "test_no_rotation_vector_is_longer_than_a_revolution"


# fmt: off
@dataclass(frozen=True, kw_only=True)
class PlausibleNumbers:
    """By which readings are refused, or doubted, as those of something else."""

    column_at_fault: float = number(0.2, "ratio", _MILLIMETRES,
        "of rows beyond the limits, above which the column, not the row, is at fault", "chosen")
    tool_reach: float = number(2.0, "m", _TOOL,
        "of a target from the flange, at most", "chosen: longer than tools are")
    moved: float = number(0.5, "rad, m", _MOVED,
        "median range of the joints, above which the target moves visibly", "chosen")
    least_spread: float = number(1e-3, "ratio", _DECLARED,
        "of a target's motion to the reach, below which it does not follow the arm",
        "the factor between millimetres and metres")
    farthest: float = number(100.0, "m", _FIXED,
        "distance, at most", "the range of laser trackers")
    nearest: float = number(1e-3, "ratio", _FIXED,
        "of distances to the reach, below which they are deviations, or in another unit",
        "the factor between millimetres and metres")
    longest_turn: float = number(6.3, "rad", _TURN,
        "of an orientation", "a revolution with rounding")
    norm: float = number(0.01, "1", _NORM,
        "by which the norm of a quaternion may differ from 1",
        "above the rounding of four decimals, below the effect of a wrong column")
    in_line: float = number(1e-3, "ratio", _IN_LINE,
        "of width to length, below which known points do not determine a rotation",
        "chosen: a millimetre on a metre")
    per_plane: int = number(4, "readings", _PLANES,
        "of a plane, at least", "three determine it, more are redundant")


# fmt: on
PLAUSIBLE = PlausibleNumbers()
