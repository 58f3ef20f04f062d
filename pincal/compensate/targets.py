"""The table of targets: wanted poses with seeds or without, or the joint positions of a nominal program."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.errors import MeasurementError
from pincal.measure.columns import converted, match_columns, quantities_of
from pincal.measure.fields import CONDITIONS, FIELDS
from pincal.measure.joint_values import check_joint_values
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.sheet import Column, open_sheet, read_cells
from pincal.measure.table import column_names
from pincal.model.effects import Conditions
from pincal.robot.robot import Robot

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
# What the command writes beside joints, conditions and wanted poses; left unread, so that its output can be its input.
_WRITTEN = ("status", "error_mm", "error_mrad", "sigma_mm", "change_max", *(f"false_{name}" for name in POSE_COLUMNS))
_FIELDS = {name: FIELDS[name] for name in ("position", "quaternion", *CONDITIONS) if name != "point"}
# A wanted position this many reaches away from the base is in another unit.
_OTHER_UNIT = 50.0


@dataclass(frozen=True)
class Targets:
    """Rows to compensate.

    Attributes:
        rows: wanted positions or poses (kind "none" for a program), and the conditions of each row; the joint positions
            are 0 where the table has none.
        has_joints: whether the table has joint positions.
    """

    rows: Measurements
    has_joints: bool

    @property
    def is_program(self) -> bool:
        """Whether the rows are those of a nominal program: joint positions and no wanted poses."""
        return self.rows.kind == "none"

    def conditions(self, calibrated: CalibratedModel, seed: np.ndarray) -> Conditions:
        """Return the conditions of the rows; ``seed``, shape (n,), stands in for joint positions that are not there.

        Raises:
            BadInputError: for a target that the model does not know.
        """
        found = calibrated.conditions(self.rows)
        return found if self.has_joints else replace(found, q=np.tile(seed, (len(self.rows), 1)))


def read_targets(path: str | os.PathLike[str], robot: Robot, *, ignore: Sequence[str] = ()) -> Targets:
    """Read a table of targets or of a nominal program; units, separators and Parquet as in tables of measurements.

    Args:
        path: the file: columns of joints, x y z (and qx qy qz qw), or both, and conditions.
        robot: the arm.
        ignore: columns to leave unread.

    Returns:
        The rows.

    Raises:
        MeasurementError: for a file that can't be read, columns that say neither where to go nor from where, or a column,
            unit or value that can't be right.
    """
    path = Path(path)
    has_joints = bool(set(column_names(path)) & set(robot.joint_names))
    quantities = quantities_of(robot.joint_names, robot.joint_types, _FIELDS, source=path.name)
    names = robot.joint_names if has_joints else ()
    known = {k: v for k, v in quantities.items() if has_joints or k not in robot.joint_names}
    columns = match_columns(open_sheet(path), names, known, ignore=(*_WRITTEN, *ignore))
    values, lines = _read_values(path, columns)
    if not has_joints and not {"x", "y", "z"} & set(values):
        raise MeasurementError(
            f"{path.name}: neither wanted positions nor joints; expected columns x y z, or {' '.join(robot.joint_names)}"
        )
    arrays = _fields(values, robot.joint_names, len(lines), source=path.name)
    units = {column.name: column.unit for column in columns if column.unit}
    rows = measurements_from_arrays(robot.joint_names, **arrays, rows=lines, source=path.name, units=units)
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


def _read_values(path: Path, columns: list[Column]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the columns in SI units and the line of each row."""
    import polars as pl

    try:
        cells, lines = read_cells(open_sheet(path), columns)
    except MeasurementError:
        raise
    except (OSError, ValueError, pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
        reason = str(error).strip().split("\n")[0]
        raise MeasurementError(f"{path}: can't be read ({reason}); expected a CSV or .parquet table") from error
    return {column.name: converted(cells[column.name], column) for column in columns}, lines


def _fields(values: dict[str, np.ndarray], names: tuple[str, ...], count: int, *, source: str) -> dict[str, np.ndarray]:
    """Return the columns put together: joints (0 where there are none), approach, positions, quaternions and so on."""
    none = np.zeros(count)
    arrays = {"q": np.column_stack([values.get(name, none) for name in names])}
    if any(f"approach_{name}" in values for name in names):
        arrays["approach"] = np.column_stack([values.get(f"approach_{name}", none) for name in names])
    for field, (_, parts) in _FIELDS.items():
        missing = [part for part in parts if part not in values]
        if not missing:
            arrays[field] = np.column_stack([values[part] for part in parts]) if len(parts) > 1 else values[parts[0]]
        elif len(missing) < len(parts):
            given = " ".join(part for part in parts if part in values)
            raise MeasurementError(f"{source}: {given} without {' '.join(missing)}; add what is missing")
    return arrays
