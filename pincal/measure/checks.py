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
from pincal.measure.table import Measurements

__all__ = ["TableFindings", "check_joint_values", "check_measurements", "check_reach", "check_rows"]

# Share of the rows beyond the limits from which on the column, not the row, is at fault.
_MANY = 0.2
# A laser tracker reaches no further.
_MOST_DISTANCE_M = 100.0
# Below this range [rad, m] a joint only shows the noise of its encoder.
_CONSTANT = 1e-4
# Joints whose median range [rad, m] exceeds this move the target visibly.
_MOVED = 0.5
# A target that moves by less than this share of the reach does not take part in the motion of the arm.
_LEAST_SPREAD = 1e-3
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
    """Check that measured positions and distances are in metres, as far as the arm's size tells.

    Args:
        measurements: The table; only its positions, distances or points in the camera are looked at.
        reach_m: Farthest distance of the flange from the base [m].
        tool_reach_m: Farthest distance of a target from the flange [m].

    Raises:
        MeasurementError: Values farther apart than the arm can reach, or closer together than the motion of
            the joints allows though a unit was given, or distances that are no lengths of a measuring line.
    """
    if len(measurements) < 2:
        return
    most = 2 * (reach_m + tool_reach_m)
    if measurements.distance is not None:
        _check_distances(measurements, measurements.distance, most=most, reach_m=reach_m)
    elif measurements.camera_point is not None:
        ranges = np.linalg.norm(measurements.camera_point, axis=1, keepdims=True)
        _check_spread(measurements, ranges, label="cx", most=most)
    elif measurements.position is not None:
        spread = _check_spread(measurements, measurements.position, label="x", most=most)
        _check_motion(measurements, spread, reach_m=reach_m, most=most)


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
    m = measurements
    numbers = (m.position, m.quaternion, m.distance, m.camera_point, m.pixel, m.sigma, m.approach)
    conditions = (m.payload, m.temperature, m.time)
    names = (np.unique(text, return_inverse=True)[1] for text in (m.target, m.socket, m.point) if text is not None)
    columns = [m.q, *(column for column in (*numbers, *conditions) if column is not None), *names]
    # Adding 0.0 turns -0.0 into 0.0, so that equal rows have equal bits.
    table = np.column_stack([np.asarray(column, dtype=float) for column in columns]) + 0.0
    odd = np.random.default_rng(0).integers(1, 2**63, table.shape[1], dtype=np.uint64)
    _, inverse, counts = np.unique((table.view(np.uint64) * odd).sum(axis=1), return_inverse=True, return_counts=True)
    candidates = np.flatnonzero(counts[inverse] > 1)
    _, first = np.unique(table[candidates], axis=0, return_index=True)
    return tuple(measurements.rows[np.delete(candidates, first)].tolist())


def _check_spread(measurements: Measurements, points: np.ndarray, *, label: str, most: float) -> float:
    """Return the distance between (nearly) the farthest points; raise if the arm can't span it."""
    from_centre = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    worst = int(from_centre.argmax())
    # From the farthest point on, the diameter is at most twice what this finds, and never less.
    spread = float(np.linalg.norm(points - points[worst], axis=1).max())
    if spread <= most:
        return spread
    text = f"{measurements.source}: values of {label} lie {spread:.4g} m apart; expected at most {most:.3g} m"
    is_unit = np.mean(from_centre > most) > _MANY and spread / 1000 <= most
    if is_unit and label not in measurements.units:
        raise MeasurementError(f"{text}; looks like millimetres: write `{label} [mm]` in the header, or their unit")
    raise MeasurementError(f"{text}; look at line {measurements.rows[worst]}, at the unit and at the robot's size")


def _check_motion(measurements: Measurements, spread: float, *, reach_m: float, most: float) -> None:
    if np.median(np.ptp(measurements.q, axis=0)) < _MOVED:
        return
    text = f"{measurements.source}: the joints move, but the positions stay within {spread * 1000:.3g} mm"
    unit = next((measurements.units[name] for name in "xyz" if name in measurements.units), "m")
    # Metres under [mm] shrink the whole workspace, at most as wide as the arm can span, a thousandfold.
    if unit != "m" and spread <= _LEAST_SPREAD * most:
        raise MeasurementError(f"{text}; values in metres under `x [{unit}]`? Then write `x [m]` in the header")
    if spread < _LEAST_SPREAD * reach_m:
        warnings.warn(f"{text}; is the target held, or the instrument stuck?", PincalWarning, stacklevel=3)


def _check_distances(measurements: Measurements, distance: np.ndarray, *, most: float, reach_m: float) -> None:
    _check_spread(measurements, distance[:, None], label="distance", most=most)
    middle, longest = float(np.median(distance)), float(distance.max())
    unit = measurements.units.get("distance", "m")
    if middle > _MOST_DISTANCE_M:
        raise MeasurementError(
            f"{measurements.source}: distance of {middle:.4g} m under the unit [{unit}]; expected at most "
            f"{_MOST_DISTANCE_M:g} m; looks like millimetres: write `distance [mm]`, or their unit"
        )
    if longest < _LEAST_SPREAD * reach_m:
        raise MeasurementError(
            f"{measurements.source}: distance of at most {longest * 1000:.3g} mm; expected the whole "
            f"distance, not a deviation; values in metres under [{unit}]? Then write `distance [m]`"
        )
