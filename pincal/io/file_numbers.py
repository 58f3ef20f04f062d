"""The numbers by which a file is refused, or its text kept: each with its unit and origin.

What bounds the work on a file stands where it is used.
"""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number

_ROTATION = "test_file_numbers.py::test_rotations_of_three_decimals_are_read"
_TRANSFORM = "test_file_numbers.py::test_transforms_of_the_robot_are_exact"
_MOUNT = "test_file_numbers.py::test_the_mount_of_a_camera_is_exact"
_OTHER = "test_urdf_export.py::test_the_urdf_of_another_robot_is_refused"
_TIP = "test_urdf_export.py::test_a_tip_that_no_fixed_joint_holds_gets_a_link_behind_it"
_KEPT = "test_urdf_export.py::test_a_number_that_has_not_changed_keeps_its_text"


# fmt: off
@dataclass(frozen=True, kw_only=True)
class FileNumbers:
    """By which rotations of a file are such, and a URDF is that of the model."""

    rotation: float = number(1e-3, "1", _ROTATION,
        "by which a rotation that a user may have written differs from an orthonormal one, at most",
        "users give as few as three decimals")
    transform: float = number(1e-6, "1", _TRANSFORM,
        "the same for the robot's transforms",
        "pincal writes them in full precision: a micrometre on an arm of a metre")
    mount: float = number(1e-6, "1", _MOUNT,
        "the same for the mount of a camera", "it is used without correction")
    tip_error: float = number(1e-9, "m, 1", _OTHER,
        "of a written URDF's tip, and of an element of its rotation, to the calibrated one, "
            "at most", "a thousand times the rounding and a thousandth of any measurement")
    tip_moved: float = number(1e-12, "m, 1", _TIP,
        "by which a calibration moves a tip, at least, for a joint or a link to hold it there",
        "above rounding")
    kept: float = number(1e-15, "rad, m", _KEPT,
        "change of a number for which its text is kept", "rounding")


# fmt: on
IN_FILES = FileNumbers()
