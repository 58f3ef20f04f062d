"""The thresholds by which points of a program are read, changed or left, each with its unit and
origin.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number


@dataclass(frozen=True, kw_only=True)
class ProgramNumbers:
    """Thresholds of the correction of a program."""

    unit: float = number(
        2e-3,
        "ratio",
        "test_program_paths.py::test_four_numbers_of_length_one_are_an_orientation",
        "by which the length of a quaternion may differ from 1; other lists of seven numbers are "
        "no poses",
        "the rounding of four digits",
    )
    longest: float = number(
        1e4,
        "m",
        "test_program_limits.py::test_numbers_that_are_no_pose_are_left",
        "from the origin of a base to a point, or from a flange to a tool, above which numbers are "
        "no pose",
        "chosen: no robot's track is longer",
    )
    heaviest: float = number(
        1e4,
        "kg",
        "test_program_loads.py::test_a_load_that_no_robot_carries_leaves_its_points",
        "of a load that a program states, above which its points are left, as for a negative one",
        "chosen: several times what the strongest robots carry",
    )
    most_turned: float = number(
        1e5,
        "deg and rad",
        "test_program_limits.py::test_numbers_that_are_no_pose_are_left",
        "of an angle, above which numbers are no pose",
        "chosen: some hundred turns; the tenth of a micrometre is still resolved",
    )
    clearly: float = number(
        0.5,
        "ratio",
        "test_program_safety.py::test_several_arms_that_are_as_near_are_not_chosen_from",
        "of the distance of the nearest solution to that of the next, above which neither is "
        "chosen and the point is left",
        "chosen: half as far",
    )
    nothing: float = number(
        1e-8,
        "m and rad",
        "test_programs.py::test_without_errors_a_program_stays_as_it_is",
        "corrections below which a point of a program is left as it is written",
        "chosen: far below what programs resolve",
    )
    on_edge: float = number(
        1e-4,
        "rad",
        "test_program_paths.py::test_a_joint_at_the_edge_of_a_turn_may_have_either_number",
        "to where the turn number of a joint changes, within which it may have either number",
        "chosen: controllers round there in their own ways",
    )


PROGRAM_NUMBERS = ProgramNumbers()
