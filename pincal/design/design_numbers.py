"""The thresholds by which a design refuses, doubts or names something, each with its unit and
origin.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_FLOOR = "test_design.py::test_the_shoulder_may_be_below_the_floor_and_no_later_link"
_TOUCHING = "test_design.py::test_links_that_always_touch_are_named_and_not_checked"
_REFUSED = "test_design.py::test_what_can_not_be_designed_is_refused"
_FEW_POSES = "test_design.py::test_too_few_poses_are_warned_of"
_LIMIT = "test_design.py::test_an_error_that_no_number_of_poses_reduces_is_warned_of"
_ABSORBED = "test_health_check.py::test_what_new_frames_take_up_is_not_promised"
_DIRECTIONS = (
    "test_health_check.py::test_each_test_has_as_many_directions_as_its_change_moves_the_target"
)
_NO_CHECK = "test_health_check.py::test_a_check_that_makes_no_sense_is_refused"


@dataclass(frozen=True, kw_only=True)
class DesignNumbers:
    """Thresholds of a design of poses, of a health check, and of admissible poses."""

    least_noise: float = number(
        1e-7,
        "m or rad",
        _REFUSED,
        "noise below which a design is refused",
        "chosen: a hundredth of what good instruments have, and the covariances are still accurate",
    )
    mostly: float = number(
        0.9,
        "ratio",
        _LIMIT,
        "of the predicted error that any number of further poses leaves, above which they are said "
        "to be useless",
        "chosen",
    )
    comfortable: float = number(
        1.5,
        "readings per direction",
        _FEW_POSES,
        "that are recommended where the poses give fewer readings than they identify directions",
        "chosen: a third of the readings then judges the fit",
    )
    fewest: int = number(
        4,
        "poses",
        _NO_CHECK,
        "of a health check, below which it is refused",
        "three positions determine a frame, and the fourth the target",
    )
    largest: float = number(
        10.0,
        "typical sizes",
        _ABSORBED,
        "of its parameters, up to which a change has to move the target by the stated distance; "
        "otherwise it is named as one that no check detects",
        "chosen: sizes beyond it are no longer those of a change of such a robot",
    )
    seen: float = number(
        1e-3,
        "ratio",
        _DIRECTIONS,
        "of the motion of the target by one direction of a change to that by its best one, below "
        "which it is no degree of freedom of the test",
        "far above rounding errors, far below any relevant share",
    )
    off_the_floor: int = number(
        3,
        "joint, counted from 1",
        _FLOOR,
        "from whose link on the arm has to stay above the floor",
        "links before it may touch it, like the shoulder of a small arm",
    )
    always: float = number(
        0.95,
        "ratio",
        _TOUCHING,
        "of random poses in which two bodies touch, above which they are taken as touching by "
        "construction and not checked",
        "chosen: bodies that overlap by construction touch in all poses",
    )


DESIGN_NUMBERS = DesignNumbers()
