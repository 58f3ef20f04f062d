"""The thresholds by which a wanted pose is refused, reached or given up, each with its unit and
origin.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number


@dataclass(frozen=True, kw_only=True)
class CompensationNumbers:
    """Thresholds of a compensation."""

    reached: float = number(
        1e-10,
        "m and rad",
        "test_compensate.py::test_poses_are_reached_whatever_the_model_has_found",
        "within which a pose counts as reached",
        "a tenth of the documented accuracy, a thousand times its rounding",
    )
    near: float = number(
        0.05,
        "m",
        "test_compensate.py::test_poses_far_from_the_seed_are_found_within_the_limits",
        "of a seed to the wanted position, within which it needs a correction and no motion",
        "errors of real arms are a fifth of it",
    )
    near_angle: float = number(
        0.1,
        "rad",
        "test_compensate.py::test_poses_far_from_the_seed_are_found_within_the_limits",
        "the same of the orientation",
        "errors of real arms are a fifth of it",
    )
    correction: float = number(
        0.35,
        "rad or m",
        "test_compensate.py::test_a_singular_wrist_keeps_the_position_and_does_not_spin",
        "motion of a joint by a correction, above which the row is not corrected",
        "chosen: more would be an unintended motion",
    )
    gentle: float = number(
        0.1,
        "rad or m",
        "test_compensate.py::test_a_singular_wrist_keeps_the_position_and_does_not_spin",
        "of the seed, within which joints are kept where a correction needs more and the position "
        "allows it",
        "chosen",
    )
    hopeless: float = number(
        0.3,
        "ratio",
        "test_compensate.py::test_rows_that_are_not_reached_are_told_and_the_rest_is_served",
        "of the distance of a target from all random poses to the reach, above which it is out of "
        "reach",
        "chosen: thousands of poses leave no such gap within the reach",
    )
    hardly: float = number(
        0.1,
        "ratio",
        "test_compensate.py::test_an_arm_of_few_joints_says_which_orientations_it_misses",
        "of a rotation about an axis to a free one, below which an arm is said not to rotate about "
        "it",
        "chosen",
    )
    other_unit: float = number(
        50.0,
        "ratio",
        "test_compensate.py::test_a_table_that_cannot_be_right_is_refused",
        "of a wanted position's distance from the base to the reach, above which it is in another "
        "unit",
        "between 1 and the 1000 of millimetres, where a cell may be large",
    )
    orthonormal: float = number(
        1e-5,
        "ratio",
        "test_compensate.py::test_arguments_that_make_no_sense_are_refused",
        "deviation of a rotation matrix from orthonormality, above which it is refused",
        "rounding to six decimals is below it",
    )


COMPENSATION = CompensationNumbers()
