"""Selection of the rows for fitting or testing, with all checks that need no fit.

Rows without information, by the rules of their sensor, are left out with a warning. Impossible
values, such as degrees, millimetres or swapped joints, are errors; unlikely ones cause warnings.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import MeasurementError, PincalWarning, few, nearest_first, warn
from pincal.measure.measurements import Measurements, sensor_like, sensor_of
from pincal.measure.sensor import Excluded, Grouped, Plausible
from pincal.measure.setup import Setup
from pincal.robot.robot import Robot

# Lines that a warning lists.
_LISTED = 8


@dataclass(frozen=True)
class Admitted:
    """Tables that can be fitted.

    Attributes:
        tables: the usable rows of each station.
        notes: warnings about unlikely values and rows left out.
        idle: known distances that no row involves.
    """

    tables: dict[str, Measurements]
    notes: tuple[str, ...]
    idle: tuple[str, ...]


def admit(
    robot: Robot,
    tables: Mapping[str, Measurements],
    setup_of: Callable[[str], Setup],
    *,
    holdout: Sequence[Measurements] = (),
) -> Admitted:
    """Return the rows of each station that a fit can use, after all checks that need no fit.

    Their joints are in the robot's order. Known distances may involve points of held-out rows.

    Raises:
        MeasurementError: if a table can't be of this robot, or its rows are too few.
    """
    tables = {name: table.in_order_of(robot) for name, table in tables.items()}
    setups = {name: setup_of(name) for name in tables}
    idle: list[str] = []
    for setup in {id(setup): setup for setup in setups.values()}.values():
        idle += _check_distances(
            setup, [*(tables[name] for name in tables if setups[name] is setup), *holdout]
        )
    found = {}
    with noted() as notes:
        for name, setup in setups.items():
            table = usable_rows(tables[name], setup)
            if len(tables) > 1:
                # The other stations determine the joint offsets.
                check_placeable(table, setup)
            else:
                purpose = (
                    f"to determine the poses of instrument and tool and {robot.n_joints} "
                    "joint offsets"
                )
                _check_count(table, setup, joints=robot.n_joints, purpose=purpose, better=50)
            check_table(robot, table)
            found[name] = table
    return Admitted(found, tuple(notes), tuple(dict.fromkeys(idle)))


def admit_test(robot: Robot, table: Measurements, setup: Setup) -> Measurements:
    """Return the rows by which a calibration with ``setup`` can be judged; unlikely values cause
    warnings.

    Raises:
        MeasurementError: if the table can't be of this robot, or no row is left.
    """
    table = scorable_rows(table.in_order_of(robot), setup)
    check_table(robot, table, minimum=1)
    return table


@contextmanager
def noted() -> Iterator[list[str]]:
    """Collect the warnings of a block of code in a list, each text once, instead of
    showing them.
    """
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield notes
    notes += dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, PincalWarning))


def usable_rows(measurements: Measurements, setup: Setup) -> Measurements:
    """Return the rows with information; each reason to leave rows out causes a `PincalWarning`.

    Left out are points behind the camera, sockets that were touched once, unknown points that were
    seen once, and unknown anchors of fewer than four distances.

    Raises:
        MeasurementError: if no row is left.
    """
    kind = measurements.sensor
    if kind is None or not issubclass(kind, Grouped):
        return measurements
    sensor = sensor_of(measurements, setup.over(measurements))
    assert isinstance(sensor, Grouped)
    excluded = list(sensor.unusable_rows())
    kept = _kept(measurements, excluded)
    if not len(kept):
        raise MeasurementError(
            f"{measurements.source}: no row is left; expected {excluded[-1].expected}"
        )
    return kept


def scorable_rows(measurements: Measurements, setup: Setup) -> Measurements:
    """Return the rows by which a calibration can be judged; rows left out cause a `PincalWarning`.

    A socket that the calibration did not have is judged by the mean of its rows, so it needs two;
    other new points can't be judged.
    """
    return _kept(measurements, _unscorable(measurements, setup))


def scorable(measurements: Measurements, setup: Setup) -> np.ndarray:
    """Return which rows :func:`scorable_rows` returns, shape (N,), without warnings."""
    lost = np.zeros(len(measurements), bool)
    for part in _unscorable(measurements, setup):
        lost |= part.rows
    return ~lost


def _unscorable(measurements: Measurements, setup: Setup) -> Iterator[Excluded]:
    kind = measurements.sensor
    if kind is not None and issubclass(kind, Grouped) and len(measurements):
        yield from kind.unscorable_rows(measurements, setup)


def unobservable_notes(measurements: Measurements, setup: Setup) -> Iterator[str]:
    """Yield in words what measurements of this kind can't determine, however many rows
    there are.
    """
    return sensor_like(measurements, setup).unobservable()


def _kept(measurements: Measurements, excluded: Iterable[Excluded]) -> Measurements:
    """Return the rows that are not excluded; warn of the others."""
    kept = np.ones(len(measurements), bool)
    for part in excluded:
        kept &= ~part.rows
        if part.rows.any():
            lines = measurements.rows[part.rows]
            listed = few(lines, _LISTED)
            warn(
                f"{measurements.source}: {len(lines)} rows {part.reason} and are left "
                f"out: lines {listed}"
            )
    return measurements if kept.all() else measurements.select(kept)


def _check_distances(setup: Setup, tables: Sequence[Measurements]) -> tuple[str, ...]:
    """Refuse a known distance between a point of the tables and an unknown one.

    Returns:
        A note on distances between points in none of the tables: they may belong to another one.
    """
    found = [table.point_names for table in tables]
    known = {str(name) for names in found if names is not None for name in np.unique(names)} | set(
        setup.points
    )
    idle = []
    for gap in setup.distances:
        unknown = [name for name in (gap.first, gap.second) if name not in known]
        if len(unknown) == 1 or not known:
            near = ", ".join(nearest_first(unknown, sorted(known))[:6]) if known else "none"
            raise MeasurementError(
                f"a known distance names {unknown[0]!r}; expected one of the points, "
                f"nearest first: {near}"
            )
        idle += [f"{gap.first} to {gap.second}"] if unknown else []
    return (
        (f"known distances between points without any row are not used: {', '.join(idle)}",)
        if idle
        else ()
    )


def check_placeable(measurements: Measurements, setup: Setup) -> None:
    """Refuse a table with too few rows to locate instrument and tool of a known robot with one
    redundant reading.
    """
    purpose = "to determine the poses of instrument and tool of a new station with redundancy"
    _check_count(measurements, setup, joints=1, purpose=purpose, better=10)


def _check_count(
    measurements: Measurements, setup: Setup, *, joints: int, purpose: str, better: int
) -> None:
    """Refuse a table with too few rows for the poses of instrument and tool, and ``joints`` joint
    offsets.
    """
    sensor = sensor_like(measurements, setup)
    tool = len(sensor.tool_symbols) * (
        len(np.unique(measurements.target)) if len(measurements) else 1
    )
    # The parameters of a lens take no further rows: each gives two readings of it.
    own = sum(parameter.unit == "m" for parameter in sensor.parameters)
    poses = len(np.unique(measurements.q, axis=0))
    fewest = -(-(tool + joints) // 6) + 1
    if sensor.pose_limit and poses < fewest:
        raise MeasurementError(
            f"{measurements.source}: {poses} poses {sensor.pose_limit}: expected at least "
            f"{fewest}, "
            f"preferably {min(better, 30)} or more"
        )
    needed = -(
        -(len(sensor.base_symbols) + own + tool + joints)
        // sum(block.size for block in sensor.blocks)
    )
    if len(measurements) < needed:
        raise MeasurementError(
            f"{measurements.source}: {len(measurements)} {measurements.kind} "
            f"measurements; expected at least {needed} "
            f"{purpose}, preferably {better} or more"
        )


# Share of rows beyond the limits above which the column, not the row, is at fault.
_MANY = 0.2
# Longer than any rail of a robot [m].
_MOST_M = 50.0
# Two revolutions: more than cables allow, and less than a motion of some degrees read as radians.
_MOST_RAD = 4 * np.pi
# Limits of URDFs are rounded and controllers overshoot them by about this much [rad, m].
_LIMIT_TOLERANCE = 0.05
# Range of a joint that is only encoder noise [rad, m].
_CONSTANT = 1e-4
_LISTED_LINES = 5


def check_table(robot: Robot, measurements: Measurements, *, minimum: int = 2) -> None:
    """Refuse impossible measurements of this robot, or fewer than ``minimum`` rows; warn of
    unlikely ones.

    Raises:
        MeasurementError: as the other functions of this module.
    """
    check_rows(measurements, minimum=minimum)
    check_joints_of(robot, measurements)
    check_reach(measurements, robot.reach)


def check_joints_of(robot: Robot, measurements: Measurements) -> None:
    """Refuse joint positions that can't be this robot's, by :func:`check_joint_values` and its
    kinematic loops.

    Raises:
        MeasurementError: if a loop can't be closed in some row.
    """
    rows = measurements.of_joints(robot)
    check_joint_values(rows, robot.lower, robot.upper, robot.joint_types)
    if robot.linkage is None or (is_closed := robot.linkage.closed(rows.q)[1]).all():
        return
    drives = ", ".join(robot.joint_names[i] for i in robot.linkage.drivers)
    raise MeasurementError(
        f"{rows.source}, line {rows.rows[~is_closed][0]}: the robot's loops can't be "
        f"closed at these positions of {drives}; "
        f"rows affected: {np.sum(~is_closed)}; check zeros, signs and units"
    )


def check_reach(measurements: Measurements, reach_m: float) -> None:
    """Check the unit of readings against the reach of the flange [m], by the rules of the sensor.

    Raises:
        MeasurementError: for values farther apart than the arm can reach, or closer together than
            the motion of the joints allows though a unit was given, or distances that are no
            lengths of a measuring line.
    """
    sensor = measurements.sensor
    if len(measurements) > 1 and sensor is not None and issubclass(sensor, Plausible):
        sensor.check_plausible(measurements, reach_m)


def check_rows(measurements: Measurements, *, minimum: int) -> None:
    """Check that there are enough rows and that they differ.

    Rows that repeat an earlier one in every column cause a `PincalWarning`; a replicate differs in
    its readings.

    Raises:
        MeasurementError: for fewer rows than needed, or the same pose in all of them.
    """
    count = len(measurements)
    source = measurements.source
    if count < max(minimum, 1):
        raise MeasurementError(
            f"{source}: {count} rows; expected at least {max(minimum, 1)}, measure more poses"
        )
    if count > 1 and (np.ptp(measurements.q, axis=0) <= _CONSTANT).all():
        raise MeasurementError(
            f"{source}: all {count} rows have the same joint values; expected different poses"
        )
    lines = _duplicate_lines(measurements)
    if lines:
        warn(
            f"{source}: {len(lines)} rows repeat an earlier row in every column (line "
            f"{few(lines, _LISTED_LINES)}); "
            "copies add weight but no information: delete them unless they were measured"
        )


def _duplicate_lines(measurements: Measurements) -> list[int]:
    arrays = {name: column for name, column in measurements.columns().items() if name != "rows"}
    numbers = [column for column in arrays.values() if column.dtype.kind in "fi"]
    names = [
        np.unique(column, return_inverse=True)[1]
        for column in arrays.values()
        if column.dtype.kind not in "fi"
    ]
    # Adding 0.0 turns -0.0 into 0.0, so that equal rows have equal bits.
    table = (
        np.column_stack([np.asarray(column, dtype=float) for column in (*numbers, *names)]) + 0.0
    )
    odd = np.random.default_rng(0).integers(1, 2**63, table.shape[1], dtype=np.uint64)
    _, inverse, counts = np.unique(
        (table.view(np.uint64) * odd).sum(axis=1), return_inverse=True, return_counts=True
    )
    candidates = np.flatnonzero(counts[inverse] > 1)
    _, first = np.unique(table[candidates], axis=0, return_index=True)
    return list(measurements.rows[np.delete(candidates, first)].tolist())


def check_joint_values(
    measurements: Measurements, lower: ArrayLike, upper: ArrayLike, joint_types: Sequence[str]
) -> None:
    """Check that joint values are in rad or m, in the right columns and within the limits.

    Each joint with values beyond its limits causes a `PincalWarning`.

    Args:
        measurements: the table, N rows of n joints.
        lower: lower joint limits [rad], prismatic [m], shape (n,); -inf without a limit.
        upper: upper joint limits, likewise; a joint with lower >= upper is unlimited.
        joint_types: "revolute" or "prismatic" for each joint.

    Raises:
        MeasurementError: for degrees or millimetres without a unit, or two swapped columns.
    """
    q = measurements.q
    slides = np.array([kind == "prismatic" for kind in joint_types])
    if not q.size:
        return
    low = np.array(lower, dtype=float)
    high = np.array(upper, dtype=float)
    unlimited = ~(low < high)
    low[unlimited] = -np.inf
    high[unlimited] = np.inf
    excess = np.maximum(low - q, q - high)
    outside = excess > _LIMIT_TOLERANCE
    in_small_unit = np.where(slides, q / 1000, np.deg2rad(q))
    fits_small_unit = _inside(in_small_unit, low, high).all(axis=0)

    far = (np.abs(q) > np.where(slides, _MOST_M, _MOST_RAD)) & (
        outside | ~np.isfinite(low) | ~np.isfinite(high)
    )
    _refuse_unit(
        measurements, far.any(axis=0) & ((far.mean(axis=0) > _MANY) | fits_small_unit), slides
    )
    swaps = _curing_swaps(measurements, low, high, slides=slides) if outside.any() else []
    share = float(outside.any(axis=1).mean())
    coupled = _seems_coupled(q, low, high) if outside.any() else np.zeros(q.shape[1], bool)
    if swaps and share > _MANY and not coupled.any():
        raise MeasurementError(
            f"{measurements.source}: {share:.0%} of the rows lie beyond the joint limits, "
            "and none does with "
            f"the columns {' or '.join(swaps)} swapped; exchange their names in the header"
        )
    is_far = np.abs(q).max(axis=0) > 2 * np.maximum(np.abs(low), np.abs(high))
    _refuse_unit(
        measurements, is_far & (outside.mean(axis=0) > _MANY) & fits_small_unit & ~coupled, slides
    )
    _warn_outside(measurements, outside, excess, swaps)


def _inside(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return (values >= low - _LIMIT_TOLERANCE) & (values <= high + _LIMIT_TOLERANCE)


def _seems_coupled(q: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return which joints exceed their limits but not when a neighbour is added or subtracted, as
    for coupled drives.
    """
    found = np.array(~_inside(q, low, high).all(axis=0))
    for i in np.flatnonzero(found):
        sums = [
            q[:, i] + s * q[:, j]
            for j in (i - 1, i + 1)
            if 0 <= j < q.shape[1]
            for s in (1.0, -1.0)
        ]
        found[i] = any(_inside(both, low[i], high[i]).all() for both in sums)
    return found


def _refuse_unit(measurements: Measurements, is_wrong: np.ndarray, slides: np.ndarray) -> None:
    """Raise for a joint whose unit is wrong, shape (n,), unless it was stated explicitly."""
    for j in np.flatnonzero(is_wrong):
        name = measurements.joint_names[j]
        row = int(np.abs(measurements.q[:, j]).argmax())
        if name not in measurements.units:
            unit, word, si = ("mm", "millimetres", "m") if slides[j] else ("deg", "degrees", "rad")
            raise MeasurementError(
                f'{measurements.source}, line {measurements.rows[row]}, "{name}": '
                f"{measurements.q[row, j]:g} "
                f"{si} looks like {word}; write `{name} [{unit}]` in the header "
                f"(`[{unit}]` after the name of the "
                f"column), or `{name} [{si}]` if intended"
            )


def _curing_swaps(
    measurements: Measurements, low: np.ndarray, high: np.ndarray, *, slides: np.ndarray
) -> list[str]:
    """Return the pairs of columns whose exchange brings all values within the limits."""
    names = measurements.joint_names
    ends = np.stack([measurements.q.min(axis=0), measurements.q.max(axis=0)])
    cures = []
    for i, j in itertools.combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[i, j]] = j, i
        if slides[i] == slides[j] and _inside(ends[:, order], low, high).all():
            cures.append(f"{names[i]} and {names[j]}")
    return cures


def _warn_outside(
    measurements: Measurements, outside: np.ndarray, excess: np.ndarray, swaps: Sequence[str]
) -> None:
    hint = f"; all rows are inside with {' or '.join(swaps)} swapped" if swaps else ""
    for j in np.flatnonzero(outside.any(axis=0)):
        worst = int(excess[:, j].argmax())
        warn(
            f"{measurements.source}: {outside[:, j].sum()} rows of "
            f'"{measurements.joint_names[j]}" lie beyond its limits, '
            f"the worst is {measurements.q[worst, j]:.6g} in line {measurements.rows[worst]}, "
            f"{excess[worst, j]:.3g} too far{hint}; check the sign, the zero and the URDF"
        )
