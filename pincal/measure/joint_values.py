"""Plausibility of joint values: degrees, millimetres, swapped columns, limits."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.measurements import Measurements

# Share of the rows beyond the limits from which on the column, not the row, is at fault.
_MANY = 0.2
# Longer than the longest rail of a robot.
_MOST_M = 50.0
# Two full turns: more than any cable allows, and less than a few degrees' motion written in degrees.
_MOST_RAD = 4 * np.pi
# Limits of URDFs are rounded and controllers overshoot them by about this much [rad, m].
_LIMIT_TOLERANCE = 0.05


def check_joint_values(
    measurements: Measurements, lower: ArrayLike, upper: ArrayLike, joint_types: Sequence[str]
) -> tuple[str, ...]:
    """Check that joint values are in rad or m, in the right columns and within the limits.

    Args:
        measurements: The table, N rows of n joints.
        lower: Lower joint limits [rad], prismatic [m], shape (n,); -inf where there is none.
        upper: Upper joint limits, likewise; a joint with lower >= upper counts as unlimited.
        joint_types: "revolute" or "prismatic" for each joint.

    Returns:
        The joints with values beyond their limits, each of which also caused a `PincalWarning`.

    Raises:
        MeasurementError: Values that can only be degrees or millimetres though no unit says so, or two
            columns that are swapped.
    """
    low, high = np.array(lower, dtype=float), np.array(upper, dtype=float)
    unlimited = ~(low < high)
    low[unlimited], high[unlimited] = -np.inf, np.inf
    limits = np.stack([low, high])
    excess = np.maximum(low - measurements.q, measurements.q - high)
    outside = excess > _LIMIT_TOLERANCE
    if not len(measurements) or not measurements.joint_names:
        return ()
    _check_far_values(measurements, outside, limits, joint_types=joint_types)
    swaps = _curing_swaps(measurements, limits, joint_types=joint_types) if outside.any() else []
    share = float(outside.any(axis=1).mean())
    if swaps and share > _MANY:
        raise MeasurementError(
            f"{measurements.source}: {share:.0%} of the rows lie beyond the joint limits, and none does with "
            f"the columns {' or '.join(swaps)} swapped; exchange their names in the header"
        )
    _check_small_units(measurements, outside, limits, joint_types=joint_types)
    return _warn_outside(measurements, outside, excess, swaps)


def _check_far_values(
    measurements: Measurements, outside: np.ndarray, limits: np.ndarray, *, joint_types: Sequence[str]
) -> None:
    for j, kind in enumerate(joint_types):
        values, (low, high) = measurements.q[:, j], limits[:, j]
        is_unlimited = not np.isfinite([low, high]).all()
        far = (np.abs(values) > (_MOST_M if kind == "prismatic" else _MOST_RAD)) & (outside[:, j] | is_unlimited)
        if far.any() and (far.mean() > _MANY or _is_inside(_in_small_unit(values, kind), low, high)):
            _refuse_unit(measurements, j, kind, int(np.abs(values).argmax()))


def _check_small_units(
    measurements: Measurements, outside: np.ndarray, limits: np.ndarray, *, joint_types: Sequence[str]
) -> None:
    for j, kind in enumerate(joint_types):
        values, (low, high) = measurements.q[:, j], limits[:, j]
        is_far = np.abs(values).max() > 2 * max(abs(low), abs(high))
        if is_far and outside[:, j].mean() > _MANY and _is_inside(_in_small_unit(values, kind), low, high):
            _refuse_unit(measurements, j, kind, int(np.abs(values).argmax()))


def _in_small_unit(values: np.ndarray, kind: str) -> np.ndarray:
    return values / 1000 if kind == "prismatic" else np.deg2rad(values)


def _is_inside(values: np.ndarray, low: float, high: float) -> bool:
    return bool(values.min() >= low - _LIMIT_TOLERANCE and values.max() <= high + _LIMIT_TOLERANCE)


def _refuse_unit(measurements: Measurements, j: int, kind: str, row: int) -> None:
    """Raise for a joint whose unit was not stated; a stated unit is the user's word."""
    name = measurements.joint_names[j]
    if name not in measurements.units:
        unit, word, si = ("mm", "millimetres", "m") if kind == "prismatic" else ("deg", "degrees", "rad")
        raise MeasurementError(
            f'{measurements.source}, line {measurements.rows[row]}, "{name}": {measurements.q[row, j]:g} '
            f"{si} looks like {word}; write `{name} [{unit}]` in the header, or `{name} [{si}]` if meant"
        )


def _curing_swaps(measurements: Measurements, limits: np.ndarray, *, joint_types: Sequence[str]) -> list[str]:
    """Return the pairs of columns whose exchange brings all values inside the limits."""
    names, ranges = (
        measurements.joint_names,
        np.stack([measurements.q.min(axis=0), measurements.q.max(axis=0)]),
    )
    cures = []
    for i, j in itertools.combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[i, j]] = j, i
        is_inside = all(_is_inside(ranges[:, k], *limits[:, n]) for n, k in enumerate(order))
        if joint_types[i] == joint_types[j] and is_inside:
            cures.append(f"{names[i]} and {names[j]}")
    return cures


def _warn_outside(
    measurements: Measurements, outside: np.ndarray, excess: np.ndarray, swaps: Sequence[str]
) -> tuple[str, ...]:
    odd = [int(j) for j in np.flatnonzero(outside.any(axis=0))]
    for j in odd:
        name, worst, count = measurements.joint_names[j], int(excess[:, j].argmax()), outside[:, j].sum()
        hint = f"; all rows are inside with {' or '.join(swaps)} swapped" if swaps else ""
        warnings.warn(
            f'{measurements.source}: {count} rows of "{name}" lie beyond its limits, '
            f"the worst is {measurements.q[worst, j]:.6g} in line {measurements.rows[worst]}, "
            f"{excess[worst, j]:.3g} too far{hint}; check the sign, the zero and the URDF",
            PincalWarning,
            stacklevel=3,
        )
    return tuple(measurements.joint_names[j] for j in odd)
