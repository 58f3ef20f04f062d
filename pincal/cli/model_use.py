"""What the verbs that take a calibrated model share: columns of poses, and notes on where it extrapolates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pincal.robot.se3 import quaternions

if TYPE_CHECKING:
    from pincal.calibration.calibrated import CalibratedModel
    from pincal.calibration.covered import Outside, OutsideCurve
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


@dataclass(frozen=True)
class Extrapolation:
    """Where a model is used outside the range of the data that it was calibrated with.

    Attributes:
        values: joint positions and payloads outside the range of the training rows.
        curves: curves of the model used outside the range in which they were identified.
        lines: shape (N,), line of each row in its file.
        units: name of a joint -> unit of its position.
    """

    values: list[Outside]
    curves: list[OutsideCurve]
    lines: np.ndarray
    units: dict[str, str]

    @classmethod
    def of(cls, calibrated: CalibratedModel, conditions: Conditions, lines: np.ndarray) -> Extrapolation:
        """Return where these conditions lie outside the range of a model."""
        robot = calibrated.model.chain.robot
        units = dict(zip(robot.joint_names, robot.joint_units, strict=True))
        return cls(calibrated.outside(conditions), calibrated.outside_curves(conditions), lines, units | _UNITS)

    @property
    def rows(self) -> list[int]:
        """The rows with a joint position or payload outside the range."""
        return sorted({value.row for value in self.values})

    def to_dict(self) -> dict[str, Any]:
        """Return the entries for programs."""
        return {"outside": len(self.rows), "curves": [curve._asdict() for curve in self.curves]}

    def notes(self) -> Iterator[str]:
        """Yield what the user should know."""
        if self.rows:
            yield f"rows outside the range of the calibration data: {len(self.rows)}"
        for row, name, value, low, high in self.values[:_SHOWN]:
            yield f"line {self.lines[row]}: {name} = {value:.4g}, calibrated from {low:.4g} to {high:.4g}"
        for curve in self.curves:
            yield (
                f"{curve.rows} rows need the {curve.effect} of {curve.joint} at {curve.variable} {curve.lowest:.4g} to "
                f"{curve.highest:.4g} {self.units[curve.variable]}; it was identified from {curve.lower:.4g} to "
                f"{curve.upper:.4g} only and is held constant outside"
            )
