"""The table of targets: wanted poses with seeds or without, or the joint positions of a nominal program."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.errors import MeasurementError
from pincal.measure.fields import CONDITIONS
from pincal.measure.joint_values import check_joint_values
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.reader import Schema, read_table
from pincal.measure.registry import known_fields
from pincal.model.effects import Conditions
from pincal.robot.robot import Robot

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
# Further columns that the command writes: they are ignored, so that its output can be its input.
_WRITTEN = ("status", "error_mm", "error_mrad", "sigma_mm", "change_max", *(f"false_{name}" for name in POSE_COLUMNS))
_FIELDS = tuple(known_fields()[name] for name in ("position", "quaternion", *CONDITIONS) if name != "point")
# A wanted position farther from the base than this many times the reach is in another unit.
_OTHER_UNIT = 50.0


@dataclass(frozen=True)
class Targets:
    """Rows to compensate.

    Attributes:
        rows: wanted positions or poses (kind "none" for a program), and the conditions of each row; joint positions are 0 if
            the table has none.
        has_joints: whether the table has joint positions.
    """

    rows: Measurements
    has_joints: bool

    @property
    def is_program(self) -> bool:
        """Whether the rows are those of a nominal program: joint positions and no wanted poses."""
        return self.rows.kind == "none"

    def conditions(self, calibrated: CalibratedModel, seed: np.ndarray) -> Conditions:
        """Return the conditions of the rows, with ``seed``, shape (n,), as joint positions if the table has none.

        Raises:
            BadInputError: for a target that the model does not have.
        """
        found = calibrated.conditions(self.rows)
        return found if self.has_joints else replace(found, q=np.tile(seed, (len(self.rows), 1)))


def read_targets(path: str | os.PathLike[str], robot: Robot, *, ignore: Sequence[str] = ()) -> Targets:
    """Read a table of targets or of a nominal program, with the same units and formats as measurements.

    Args:
        path: the file: columns of joints, x y z (and qx qy qz qw), or both, and conditions.
        robot: the arm.
        ignore: columns to ignore.

    Returns:
        The rows.

    Raises:
        MeasurementError: for a file that can't be read, a table with neither wanted positions nor joints, or a column, unit
            or value that is invalid.
    """
    path = Path(path)
    schema = Schema(
        _FIELDS,
        joint_names=robot.joint_names,
        joint_types=robot.joint_types,
        may_lack_joints=True,
        ignore=(*_WRITTEN, *ignore),
    )
    cells = read_table(path, schema)
    has_joints = "q" in cells.arrays
    if not has_joints and "position" not in cells.arrays:
        raise MeasurementError(
            f"{path.name}: neither wanted positions nor joints; expected columns x y z, or {' '.join(robot.joint_names)}"
        )
    arrays = {"q": np.zeros((len(cells.rows), robot.n_joints))} | cells.arrays
    rows = measurements_from_arrays(robot.joint_names, **arrays, rows=cells.rows, source=path.name, units=cells.units)
    if has_joints:
        check_joint_values(rows, robot.lower, robot.upper, robot.joint_types)
    return Targets(rows, has_joints)


def check_positions(targets: Targets, robot: Robot, *, positions: np.ndarray) -> None:
    """Reject wanted positions that are evidently in another unit.

    Args:
        targets: the table.
        robot: the arm.
        positions: shape (N, 3), the wanted positions in the robot's base frame [m].

    Raises:
        MeasurementError: if most of them are far beyond the robot's reach and the header does not give their unit.
    """
    away = float(np.median(np.linalg.norm(positions, axis=1)))
    if away > _OTHER_UNIT * robot.reach and "x" not in targets.rows.units:
        raise MeasurementError(
            f"{targets.rows.source}: wanted positions lie {away:.4g} m from the robot's base, whose reach is "
            f"{robot.reach:.3g} m; this looks like millimetres: write `x [mm]` in the header, or `x [m]` if it is correct"
        )
