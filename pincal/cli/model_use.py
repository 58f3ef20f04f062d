"""What the verbs that take a calibrated model share: columns of poses, and notes on where it extrapolates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.robot.se3 import quaternions

if TYPE_CHECKING:
    from pincal.calibration.calibrated import CalibratedModel
    from pincal.model.effects import Conditions

# Rows outside the calibrated range that are listed one by one.
_SHOWN = 5
_UNITS = {"time": "s", "temperature": "deg C", "payload": "kg"}


def pose_columns(poses: np.ndarray, *, with_orientation: bool) -> dict[str, np.ndarray]:
    """Return poses, shape (N, 3, 4), as the columns x y z and, if wanted, qx qy qz qw of a table."""
    columns = dict(zip("xyz", poses[:, :, 3].T, strict=True))
    if with_orientation:
        columns |= zip(("qx", "qy", "qz", "qw"), quaternions(poses[:, :, :3]).T, strict=True)
    return columns


def extrapolation(
    calibrated: CalibratedModel, conditions: Conditions, lines: np.ndarray
) -> tuple[dict[str, Any], list[str]]:
    """Return where a model is used outside the range of the data that it was calibrated with.

    Args:
        calibrated: the model.
        conditions: the N rows that it is used for.
        lines: shape (N,), line of each row in its file.

    Returns:
        Entries for programs, and notes for the user.
    """
    values, curves = calibrated.outside(conditions), calibrated.outside_curves(conditions)
    robot = calibrated.model.chain.robot
    units = dict(zip(robot.joint_names, robot.joint_units, strict=True)) | _UNITS
    rows = len({value.row for value in values})
    notes = [f"rows outside the range of the calibration data: {rows}"] if rows else []
    for row, name, value, low, high in values[:_SHOWN]:
        notes.append(f"line {lines[row]}: {name} = {value:.4g}, calibrated from {low:.4g} to {high:.4g}")
    for curve in curves:
        notes.append(
            f"{curve.rows} rows need the {curve.effect} of {curve.joint} at {curve.variable} {curve.lowest:.4g} to "
            f"{curve.highest:.4g} {units[curve.variable]}; it was identified from {curve.lower:.4g} to {curve.upper:.4g} "
            "only and is held constant outside"
        )
    return {"outside": rows, "curves": [curve._asdict() for curve in curves]}, notes
