"""Numbers by which a calibration has improved a robot and is delivered."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_NOT_HELD = "test_contacts.py::test_what_contacts_do_not_hold_is_said"
_NO_HARM = "test_benefit.py::test_a_delivered_robot_is_not_worse_than_its_urdf"


@dataclass(frozen=True, kw_only=True)
class DeliveryNumbers:
    """When a calibration has improved a robot, and when the robot stays as in its URDF."""

    unseen_direction: float = number(
        0.03,
        "ratio",
        "test_contacts.py::test_directions_without_contact_are_named",
        "of the sum of squares in one direction to that in all, below which nothing was "
        "measured in it",
        "sin^2 of 10 degrees, the variation of contact directions by themselves",
    )
    not_improved: float = number(
        0.9,
        "ratio",
        _NOT_HELD,
        "of predictions' standard deviations after and before a calibration, above which "
        "nothing has improved",
        "chosen",
    )
    mount_moved: float = number(
        0.02,
        "m",
        _NOT_HELD,
        "displacement of an arm's mount by readings without an instrument",
        "arms are mounted to a cm of their drawings",
    )
    mount_held: float = number(
        0.1,
        "ratio",
        _NOT_HELD,
        "of its standard deviation to the displacement, above which it is undetermined",
        "ten standard deviations",
    )
    worth_it: float = number(
        0.8,
        "ratio",
        _NO_HARM,
        "of the error expected of the calibrated robot to that of its URDF, above which "
        "the robot stays nominal",
        "chosen",
    )
    no_worse: float = number(
        1.0,
        "ratio",
        _NO_HARM,
        "of these errors anywhere, up to which a robot that is better at measured poses "
        "is calibrated",
        "no harm",
    )
    as_described: float = number(
        10.0,
        "odds",
        _NO_HARM,
        "that a robot is as in its URDF against any other size of its deviations, where "
        "harm is to be excluded",
        "of 1200 sound UR5 off by 0.3 to 1 mm, 14 or 30 noisy marker poses then make none "
        "of twelve groups 2 % worse",
    )


DELIVERY = DeliveryNumbers()
