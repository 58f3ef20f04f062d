"""The numbers by which a robot's description is refused, or read one way rather than another: each
with its unit and origin.

Steps and tolerances of a computation stand where they are used.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_LIMITS = "test_robot_numbers.py::test_a_range_beyond_any_joint_is_no_limit"
_MASS = "test_robot_numbers.py::test_a_robot_of_less_than_a_gram_is_refused"
_AXES = "test_robot_numbers.py::test_an_axis_of_an_impossible_length_is_refused"
_COUPLED = "test_robot_numbers.py::test_couplings_that_do_not_determine_the_joints_are_refused"
_ALIKE = "test_link_mass.py::test_placeholders_are_taken_for_what_they_are"
_LIGHT = "test_link_mass.py::test_masses_that_no_arm_can_have_are_no_masses"
_ROUNDED = "test_robot.py::test_half_turns_of_any_precision_make_no_long_links"
_LOOPS = "test_loops.py::test_loops_that_cant_be_are_refused_by_name"
_LOOSE = "test_robot_numbers.py::test_a_loop_may_be_as_loose_as_a_calibrated_one"
_CLOSED = "test_loops.py::test_passive_joints_stand_where_pinocchio_closes_the_loops"
_FOLLOW = "test_loops.py::test_readings_decide_which_joints_follow"


# fmt: off
@dataclass(frozen=True, kw_only=True)
class RobotNumbers:
    """By which joints, axes and masses of a URDF are what they seem."""

    unlimited: float = number(1e3, "rad, m", _LIMITS,
        "range of a joint from which on it has no limits", "how URDFs express it")
    lightest: float = number(1e-3, "kg", _MASS,
        "mass that a user may state of a robot", "chosen: a gram")
    alike: int = number(3, "links", _ALIKE,
        "of equal mass, from which on the masses are placeholders", "two may be equal by chance")
    light_arm: float = number(0.01, "ratio", _LIGHT,
        "of an arm's mass to that of an industrial one of its length, below which its masses are "
            "placeholders", "of 70 robots the lightest, a toy, has .067, a cobot .2")
    light_link: float = number(2e-3, "ratio", _LIGHT,
        "of a link's mass likewise, below which it is a placeholder",
        "of 70 robots the lightest link with a mass has .025")
    axis_lengths: tuple[float, float] = number((1e-6, 1e6), "1", _AXES,
        "of the direction of an axis, between which it is read",
        "others lose all digits when normalised")
    parallel: float = number(5e-3, "sine", _ROUNDED,
        "of the angle of two axes, below which they are parallel",
        "URDFs round their angles, the worst of them pi to 3.14")
    coupled: float = number(1e-3, "determinant", _COUPLED,
        "of the couplings of joints, at least", "chosen: far above rounding")


@dataclass(frozen=True, kw_only=True)
class LoopNumbers:
    """By which a loop of links is closed, and joints move it."""

    open: float = number(1e-9, "m, rad", _CLOSED,
        "gap above which a loop is open", "chosen: above rounding, below any reading")
    still: float = number(1e-2, "ratio", _LOOPS,
        "of a joint's motion to the largest, below which it does not move a loop",
        "axes of a calibrated one are tilted by milliradians")
    loose: float = number(4e-2, "m, rad", _LOOSE,
        "gap of a loop in directions that its joints can't close, at most",
        "of a calibrated one, three standard deviations of what ten joints add whose two "
            "angles readings leave at priors of 3 mrad")
    mostly: float = number(0.5, "ratio", _FOLLOW,
        "of the poses in which joints have to move a loop independently", "chosen")


# fmt: on
OF_ROBOT = RobotNumbers()
OF_LOOP = LoopNumbers()
