"""Plausibility of a table before any fit: degrees, millimetres, swapped joints, copied rows.

What can't be right is an error; what is odd but possible is a warning.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.measurements import Measurements
from pincal.measure.sensor import Plausible
from pincal.robot.robot import Robot

# Share of the rows beyond the limits from which on the column, not the row, is at fault.
_MANY = 0.2
# Longer than the longest rail of a robot.
_MOST_M = 50.0
# Two full turns: more than any cable allows, and less than a few degrees' motion written in degrees.
_MOST_RAD = 4 * np.pi
# Limits of URDFs are rounded and controllers overshoot them by about this much [rad, m].
_LIMIT_TOLERANCE = 0.05
# Below this range [rad, m] a joint only shows the noise of its encoder.
_CONSTANT = 1e-4
_LISTED_LINES = 5


def check_table(robot: Robot, measurements: Measurements, *, minimum: int = 2) -> None:
    """Refuse what can't be measurements of this robot, or less than ``minimum`` rows; warn of what is merely odd.

    Raises:
        MeasurementError: as the other functions of this module.
    """
    check_rows(measurements, minimum=minimum)
    check_joint_values(measurements, robot.lower, robot.upper, robot.joint_types)
    check_reach(measurements, robot.reach)


def check_reach(measurements: Measurements, reach_m: float) -> None:
    """Check that readings are in metres, as far as the reach of the flange [m] tells; the rules are the sensor's.

    Raises:
        MeasurementError: for values farther apart than the arm can reach, or closer together than the motion of the joints
            allows though a unit was given, or distances that are no lengths of a measuring line.
    """
    sensor = measurements.sensor
    if len(measurements) > 1 and sensor is not None and issubclass(sensor, Plausible):
        sensor.check_plausible(measurements, reach_m)


def check_rows(measurements: Measurements, *, minimum: int) -> None:
    """Check that there are enough rows and that they differ.

    Rows that repeat an earlier one in every column cause a `PincalWarning`; the same pose measured again with another result
    is a replicate and welcome.

    Raises:
        MeasurementError: for fewer rows than needed, or the same pose in all of them.
    """
    count, source = len(measurements), measurements.source
    if count < max(minimum, 1):
        raise MeasurementError(f"{source}: {count} rows; expected at least {max(minimum, 1)}, measure more poses")
    if count > 1 and (np.ptp(measurements.q, axis=0) <= _CONSTANT).all():
        raise MeasurementError(f"{source}: all {count} rows have the same joint values; expected different poses")
    lines = _duplicate_lines(measurements)
    if lines:
        first = ", ".join(str(line) for line in lines[:_LISTED_LINES]) + (", ..." if len(lines) > _LISTED_LINES else "")
        warnings.warn(
            f"{source}: {len(lines)} rows repeat an earlier row in every column (line {first}); copies add "
            "weight without knowledge: delete them unless they were measured",
            PincalWarning,
            stacklevel=2,
        )


def _duplicate_lines(measurements: Measurements) -> list[int]:
    arrays = {name: column for name, column in measurements.columns().items() if name != "rows"}
    numbers = [column for column in arrays.values() if column.dtype.kind in "fi"]
    names = [np.unique(column, return_inverse=True)[1] for column in arrays.values() if column.dtype.kind not in "fi"]
    # Adding 0.0 turns -0.0 into 0.0, so that equal rows have equal bits.
    table = np.column_stack([np.asarray(column, dtype=float) for column in (*numbers, *names)]) + 0.0
    odd = np.random.default_rng(0).integers(1, 2**63, table.shape[1], dtype=np.uint64)
    _, inverse, counts = np.unique((table.view(np.uint64) * odd).sum(axis=1), return_inverse=True, return_counts=True)
    candidates = np.flatnonzero(counts[inverse] > 1)
    _, first = np.unique(table[candidates], axis=0, return_index=True)
    return list(measurements.rows[np.delete(candidates, first)].tolist())


def check_joint_values(measurements: Measurements, lower: ArrayLike, upper: ArrayLike, joint_types: Sequence[str]) -> None:
    """Check that joint values are in rad or m, in the right columns and within the limits.

    Each joint with values beyond its limits causes a `PincalWarning`.

    Args:
        measurements: the table, N rows of n joints.
        lower: lower joint limits [rad], prismatic [m], shape (n,); -inf where there is none.
        upper: upper joint limits, likewise; a joint with lower >= upper counts as unlimited.
        joint_types: "revolute" or "prismatic" for each joint.

    Raises:
        MeasurementError: for values that can only be degrees or millimetres though no unit says so, or two columns that are
            swapped.
    """
    q, slides = measurements.q, np.array([kind == "prismatic" for kind in joint_types])
    if not q.size:
        return
    low, high = np.array(lower, dtype=float), np.array(upper, dtype=float)
    unlimited = ~(low < high)
    low[unlimited], high[unlimited] = -np.inf, np.inf
    excess = np.maximum(low - q, q - high)
    outside = excess > _LIMIT_TOLERANCE
    in_small_unit = np.where(slides, q / 1000, np.deg2rad(q))
    fits_small_unit = _inside(in_small_unit, low, high).all(axis=0)

    far = (np.abs(q) > np.where(slides, _MOST_M, _MOST_RAD)) & (outside | ~np.isfinite(low) | ~np.isfinite(high))
    _refuse_unit(measurements, far.any(axis=0) & ((far.mean(axis=0) > _MANY) | fits_small_unit), slides)
    swaps = _curing_swaps(measurements, low, high, slides=slides) if outside.any() else []
    share = float(outside.any(axis=1).mean())
    if swaps and share > _MANY:
        raise MeasurementError(
            f"{measurements.source}: {share:.0%} of the rows lie beyond the joint limits, and none does with "
            f"the columns {' or '.join(swaps)} swapped; exchange their names in the header"
        )
    is_far = np.abs(q).max(axis=0) > 2 * np.maximum(np.abs(low), np.abs(high))
    _refuse_unit(measurements, is_far & (outside.mean(axis=0) > _MANY) & fits_small_unit, slides)
    _warn_outside(measurements, outside, excess, swaps)


def _inside(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return (values >= low - _LIMIT_TOLERANCE) & (values <= high + _LIMIT_TOLERANCE)


def _refuse_unit(measurements: Measurements, is_wrong: np.ndarray, slides: np.ndarray) -> None:
    """Raise for a joint whose unit is wrong, shape (n,), and was not stated; a stated unit is the user's word."""
    for j in np.flatnonzero(is_wrong):
        name, row = measurements.joint_names[j], int(np.abs(measurements.q[:, j]).argmax())
        if name not in measurements.units:
            unit, word, si = ("mm", "millimetres", "m") if slides[j] else ("deg", "degrees", "rad")
            raise MeasurementError(
                f'{measurements.source}, line {measurements.rows[row]}, "{name}": {measurements.q[row, j]:g} '
                f"{si} looks like {word}; write `{name} [{unit}]` in the header (`[{unit}]` behind whatever name the column "
                f"has there), or `{name} [{si}]` if meant"
            )


def _curing_swaps(measurements: Measurements, low: np.ndarray, high: np.ndarray, *, slides: np.ndarray) -> list[str]:
    """Return the pairs of columns whose exchange brings all values inside the limits."""
    names, ends = measurements.joint_names, np.stack([measurements.q.min(axis=0), measurements.q.max(axis=0)])
    cures = []
    for i, j in itertools.combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[i, j]] = j, i
        if slides[i] == slides[j] and _inside(ends[:, order], low, high).all():
            cures.append(f"{names[i]} and {names[j]}")
    return cures


def _warn_outside(measurements: Measurements, outside: np.ndarray, excess: np.ndarray, swaps: Sequence[str]) -> None:
    hint = f"; all rows are inside with {' or '.join(swaps)} swapped" if swaps else ""
    for j in np.flatnonzero(outside.any(axis=0)):
        worst = int(excess[:, j].argmax())
        warnings.warn(
            f'{measurements.source}: {outside[:, j].sum()} rows of "{measurements.joint_names[j]}" lie beyond its limits, '
            f"the worst is {measurements.q[worst, j]:.6g} in line {measurements.rows[worst]}, "
            f"{excess[worst, j]:.3g} too far{hint}; check the sign, the zero and the URDF",
            PincalWarning,
            stacklevel=3,
        )
