"""The thresholds by which joint columns are doubted or refused: each with its unit and origin."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

from pincal.thresholds import number

_DEGREES = "test_checks.py::test_degrees_without_a_unit_are_refused"
_FEW_DEGREES = "test_checks.py::test_few_degrees_beyond_the_limits_are_refused"
_RAIL = "test_checks.py::test_millimetres_on_a_rail_are_refused"
_TOLERANCE = "test_checks.py::test_tolerance_of_limits_is_silent"
_ONE_POSE = "test_checks.py::test_one_pose_repeated_is_refused"
_ROUNDED = "test_mistakes.py::test_rounded_joints_do_not_make_a_changed_robot"


@dataclass(frozen=True, kw_only=True)
class ColumnNumbers:
    """Thresholds by which joint columns are refused as swapped or in another unit."""

    many: float = number(
        0.2,
        "ratio",
        _FEW_DEGREES,
        "of rows beyond the limits to all, above which the column, not the row, is at fault",
        "chosen",
    )
    most_m: float = number(
        50.0,
        "m",
        _RAIL,
        "beyond which a prismatic joint is not in metres",
        "longer than any rail of a robot",
    )
    most_rad: float = number(
        4.0 * pi,
        "rad",
        _DEGREES,
        "beyond which a revolute joint is not in radians",
        "two revolutions: more than cables allow, and less than a motion of some degrees read as "
        "radians",
    )
    beyond: float = number(
        0.05,
        "rad or m",
        _TOLERANCE,
        "by which positions may exceed the limits of a URDF",
        "these are rounded, and controllers overshoot them by about as much",
    )
    far: float = number(
        2.0,
        "ratio",
        _FEW_DEGREES,
        "of a joint's largest position to its limits, above which another unit may explain it",
        "chosen",
    )
    various: float = number(
        0.7,
        "ratio",
        _ROUNDED,
        "of different positions of a joint to rows, above which they are no grid",
        "a grid of two joints has a tenth",
    )
    explained: tuple[float, float] = number(
        (0.5, 2.0),
        "ratio",
        _ROUNDED,
        "of what rows are off to what the rounding of their joints explains, between which it may "
        "be all",
        "estimated from twenty rows it is known to a fifth",
    )
    constant: float = number(
        1e-4, "rad or m", _ONE_POSE, "range of a joint that is at rest", "the noise of an encoder"
    )


JOINT_COLUMNS = ColumnNumbers()
