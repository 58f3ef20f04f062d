"""Plausibility of a table before any fit: degrees, millimetres, swapped joints, copied rows.

Each check needs only the table and a few plain numbers of the robot. What can't be right is an error; what is
odd but possible is a warning, or is handed back.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.joint_values import check_joint_values
from pincal.measure.measurements import Measurements
from pincal.measure.sensor import Plausible

__all__ = ["TableFindings", "check_joint_values", "check_measurements", "check_reach", "check_rows"]

# Below this range [rad, m] a joint only shows the noise of its encoder.
_CONSTANT = 1e-4
_LISTED_LINES = 5


@dataclass(frozen=True)
class TableFindings:
    """What is odd, but possible, in a table.

    Example:
        >>> TableFindings(constant_joints=("joint_6",), duplicates=(), outside_limits=()).constant_joints
        ('joint_6',)
    """

    constant_joints: tuple[str, ...]
    """Joints that stand still in all rows."""
    duplicates: tuple[int, ...]
    """Lines that repeat an earlier row in every column."""
    outside_limits: tuple[str, ...]
    """Joints with values beyond their limits."""


def check_measurements(
    measurements: Measurements,
    *,
    lower: ArrayLike,
    upper: ArrayLike,
    joint_types: Sequence[str],
    reach_m: float,
    tool_reach_m: float = 2.0,
    minimum: int = 1,
) -> TableFindings:
    """Run all checks of this module.

    Args:
        measurements: The table, N rows of n joints.
        lower: Lower joint limits [rad], prismatic [m], shape (n,); -inf where there is none.
        upper: Upper joint limits, likewise.
        joint_types: "revolute" or "prismatic" for each joint.
        reach_m: Farthest distance of the flange from the base [m].
        tool_reach_m: Farthest distance of a target from the flange [m].
        minimum: Fewest rows that the fit needs.

    Returns:
        The findings that need no decision.

    Raises:
        MeasurementError: As raised by `check_rows`, `check_joint_values` and `check_reach`.
    """
    constant, duplicates = _check_rows(measurements, minimum=minimum)
    outside = check_joint_values(measurements, lower=lower, upper=upper, joint_types=joint_types)
    check_reach(measurements, reach_m=reach_m, tool_reach_m=tool_reach_m)
    return TableFindings(constant_joints=constant, duplicates=duplicates, outside_limits=outside)


def check_reach(measurements: Measurements, reach_m: float, tool_reach_m: float = 2.0) -> None:
    """Check that readings are in metres, as far as the arm's size tells; the rules are the sensor's.

    Args:
        measurements: The table.
        reach_m: Farthest distance of the flange from the base [m].
        tool_reach_m: Farthest distance of a target from the flange [m].

    Raises:
        MeasurementError: Values farther apart than the arm can reach, or closer together than the motion of
            the joints allows though a unit was given, or distances that are no lengths of a measuring line.
    """
    sensor = measurements.sensor
    if len(measurements) > 1 and sensor is not None and issubclass(sensor, Plausible):
        sensor.check_plausible(measurements, reach_m=reach_m, tool_reach_m=tool_reach_m)


def check_rows(measurements: Measurements, *, minimum: int) -> tuple[str, ...]:
    """Check that there are enough rows and that they differ.

    Args:
        measurements: The table.
        minimum: Fewest rows that the fit needs.

    Returns:
        The joints that stand still. Rows that repeat an earlier one in every column cause a `PincalWarning`;
        the same pose measured again with another result is a replicate and welcome.

    Raises:
        MeasurementError: Fewer rows than needed, or the same pose in all of them.
    """
    return _check_rows(measurements, minimum=minimum)[0]


def _check_rows(measurements: Measurements, *, minimum: int) -> tuple[tuple[str, ...], tuple[int, ...]]:
    count, source = len(measurements), measurements.source
    if count < max(minimum, 1):
        raise MeasurementError(f"{source}: {count} rows; expected at least {max(minimum, 1)}, measure more poses")
    constant = np.ptp(measurements.q, axis=0) <= _CONSTANT
    if count > 1 and constant.all():
        raise MeasurementError(f"{source}: all {count} rows have the same joint values; expected different poses")
    lines = _duplicate_lines(measurements)
    if lines:
        first = ", ".join(str(line) for line in lines[:_LISTED_LINES]) + (", ..." if len(lines) > _LISTED_LINES else "")
        warnings.warn(
            f"{source}: {len(lines)} rows repeat an earlier row in every column (line {first}); copies add "
            "weight without knowledge: delete them unless they were measured",
            PincalWarning,
            stacklevel=3,
        )
    return tuple(np.array(measurements.joint_names)[constant].tolist()), lines


def _duplicate_lines(measurements: Measurements) -> tuple[int, ...]:
    arrays = {name: column for name, column in measurements.columns().items() if name != "rows"}
    numbers = [column for column in arrays.values() if column.dtype.kind in "fi"]
    names = [np.unique(column, return_inverse=True)[1] for column in arrays.values() if column.dtype.kind not in "fi"]
    # Adding 0.0 turns -0.0 into 0.0, so that equal rows have equal bits.
    table = np.column_stack([np.asarray(column, dtype=float) for column in (*numbers, *names)]) + 0.0
    odd = np.random.default_rng(0).integers(1, 2**63, table.shape[1], dtype=np.uint64)
    _, inverse, counts = np.unique((table.view(np.uint64) * odd).sum(axis=1), return_inverse=True, return_counts=True)
    candidates = np.flatnonzero(counts[inverse] > 1)
    _, first = np.unique(table[candidates], axis=0, return_index=True)
    return tuple(measurements.rows[np.delete(candidates, first)].tolist())
