r"""What the calibrated model itself expects of its position error away from the measured poses.

Held-out poses resemble the fitted ones, so their error says nothing of the rest of the workspace.
The covariance S of a predicted position does: by the covariance C of the parameters it is
:math:`J C J^T` at a pose with Jacobian J, to which what the model lacks and how the robot arrives
are added. An error :math:`e \sim N(0, S)` has the expected length

.. math:: E|e| = \sqrt{8/\pi} \; \mathrm{mean}_u \sqrt{u^T S u}

over all directions u, since a normal vector in 3D is a direction times an independent length of
mean sqrt(8 / pi). What the data leave open is as large in C as the priors are wide.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from pincal.calibration.calibration_numbers import COVERAGE
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.located_arm import LocatedArm
from pincal.identify.fit import ModelFit
from pincal.identify.prior_scale import has_instrument
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.model.conditions import Conditions
from pincal.recorded import RECORDED
from pincal.robot.robot import Robot
from pincal.thresholds import Count
from pincal.validate.outcome import Elsewhere

# Random poses, more of which change the mean by a few per cent only, and their seed.
_DRAWN: Count = 400
_SEED: Count = 0
# Directions over which lengths are averaged: exact to 1 % for the flattest covariance.
_DIRECTIONS: Count = 60
# Ends of the ranges of a joint that are compared: every twelfth of the poses.
_PARTS: Count = 12


def placed_station(fit: ModelFit) -> Station | None:
    """Return the first station that read places; None if no instrument observed any position."""
    stations = [station for station in fit.problem.stations if station.sensor.reads_place]
    return stations[0] if stations and has_instrument(fit) else None


def elsewhere_of(robot: FittedRobot, task: Measurements | None = None) -> Elsewhere | None:
    """Return the expected position error at random poses within the joint limits, or at those of a
    task.

    Loads and all else that is recorded are those of measured poses at random; a task has its own as
    far as it names them.

    Args:
        robot: a calibration, as it was fitted.
        task: joint positions that matter, of the first target unless they name another; default:
            random ones.

    Returns:
        The expected error; None if no instrument observed any position.
    """
    fit = robot.fit
    at = placed_station(fit)
    if at is None:
        return None
    model = robot.at(at.name)
    located = None
    if task is None:
        conditions = random_conditions(at)
    else:
        targets = model.model.chain.targets
        named = replace(
            task, target=np.where(np.isin(task.target, targets), task.target, targets[0])
        )
        conditions = _recorded_as(
            at.conditions, model.conditions(named), np.random.default_rng(_SEED)
        )
        # The few poses of a task would themselves be met by the placement, wherever they are.
        located = LocatedArm.where_measured(model, conditions)
    covariances = np.asarray(sum(position_covariances(model, conditions, located).values()))
    expected = 1e3 * expected_lengths(covariances)
    measured = np.vstack(
        [one.conditions.q for one in fit.problem.stations if one.sensor.reads_place]
    )
    return Elsewhere(
        mean_mm=float(expected.mean()),
        worst_mm=float(expected.max()),
        where=_where(fit.problem.chain.robot, conditions.q, expected, measured),
        poses=len(expected),
        over="" if task is None else task.source,
    )


def expected_lengths(covariances: np.ndarray) -> np.ndarray:
    """Return the expected lengths of normal vectors about zero, shape (N,), from covariances of
    shape (N, 3, 3).

    Example:
        >>> expected_lengths(np.array([np.eye(3), np.diag([1.0, 0.0, 0.0])])).round(2)
        array([1.6, 0.8])
    """
    turns = np.arange(_DIRECTIONS) + 0.5
    heights = 1.0 - 2.0 * turns / _DIRECTIONS
    azimuths = np.pi * (1.0 + np.sqrt(5.0)) * turns
    widths = np.sqrt(1.0 - heights**2)
    directions = np.column_stack([widths * np.cos(azimuths), widths * np.sin(azimuths), heights])
    squares = np.einsum("ui,nij,uj->nu", directions, covariances, directions)
    return np.asarray(np.sqrt(8.0 / np.pi) * np.sqrt(np.maximum(squares, 0.0)).mean(axis=1))


def random_conditions(station: Station) -> Conditions:
    """Return random poses within the joint limits, of the first target, in the conditions of
    measured poses.
    """
    rng = np.random.default_rng(_SEED)
    measured = station.conditions
    q = station.model.chain.robot.random_configurations(_DRAWN, rng)
    conditions = Conditions.at(q, payload_centre=measured.payload_centre)
    payload = measured.payload[rng.integers(len(measured), size=_DRAWN)]
    return _recorded_as(measured, replace(conditions, payload=payload), rng)


def _recorded_as(
    measured: Conditions, conditions: Conditions, rng: np.random.Generator
) -> Conditions:
    """Return conditions with what they lack, such as directions of approach, taken from measured
    poses at random.
    """
    rows = rng.integers(len(measured), size=len(conditions))
    lacking = [name for name in (*RECORDED, "sighted") if getattr(conditions, name) is None]
    columns: dict[str, Any] = {
        name: of[rows] for name in lacking if (of := getattr(measured, name)) is not None
    }
    return replace(conditions, **columns)


def position_covariances(
    model: FittedRobot, conditions: Conditions, located: LocatedArm | None = None
) -> dict[str, np.ndarray]:
    """Return the covariances of predicted positions by their sources, shape (N, 3, 3) each [m^2].

    Where readings tell where the base stands, these are of positions in the instrument's frame.
    Other readings leave that frame open; these are then the covariances that remain once base and
    target are located.

    Args:
        model: a fitted robot.
        conditions: N poses.
        located: the robot with base and target located; default: at these poses.
    """
    if not model.station.is_placed:
        located = located or LocatedArm.at(model, conditions)
        return located.position_covariances(conditions)
    return {name: errors.blocks for name, errors in model.covariance_of(conditions).sources.items()}


class _Range(NamedTuple):
    """A range of a joint: the share of the variance that it explains, the joint, both ends, and
    which of them are open.
    """

    explained: float
    joint: int
    low: float
    high: float
    is_lowest: bool
    is_highest: bool


def _where(robot: Robot, q: np.ndarray, expected: np.ndarray, measured: np.ndarray) -> str:
    """Return in which range of which joint the expected errors are largest, and how it was covered;
    "" if in none.
    """
    if len(q) < COVERAGE.fewest or not np.ptp(expected) > 0.0:
        return ""
    ranges = (
        found for joint in range(q.shape[1]) for found in _ranges(joint, q[:, joint], expected)
    )
    worst = max(ranges, key=lambda found: found.explained, default=None)
    if worst is None or worst.explained < COVERAGE.explained:
        return ""
    turns = robot.joint_units[worst.joint] == "rad"
    unit = "deg" if turns else "mm"
    low, high = (
        f"{np.degrees(end) if turns else 1e3 * end:z.0f}" for end in (worst.low, worst.high)
    )
    ends = f"below {high} {unit}" if worst.is_lowest else f"{low} to {high} {unit}"
    ends = f"above {low} {unit}" if worst.is_highest else ends
    return (
        f"{robot.joint_names[worst.joint]} is "
        f"{ends}{_coverage(worst, q[:, worst.joint], measured[:, worst.joint])}"
    )


def _coverage(worst: _Range, q: np.ndarray, measured: np.ndarray) -> str:
    """Return how many measured poses are in a range, in words; "" if it was covered like the
    others.
    """
    there = int(np.sum((measured >= worst.low) & (measured <= worst.high)))
    share = np.mean((q >= worst.low) & (q <= worst.high))
    if there == 0:
        return " (not measured there)"
    return (
        f" ({there} of {len(measured)} poses)"
        if there < COVERAGE.sparse * share * len(measured)
        else ""
    )


def _ranges(joint: int, q: np.ndarray, expected: np.ndarray) -> Iterator[_Range]:
    """Yield the ranges of a joint in which errors are larger than outside it."""
    edges = np.unique(np.quantile(q, np.linspace(0.0, 1.0, _PARTS + 1)))
    parts = np.clip(np.searchsorted(edges, q, side="right") - 1, 0, len(edges) - 2)
    counts = np.concatenate([[0], np.cumsum(np.bincount(parts, minlength=len(edges) - 1))])
    sums = np.concatenate(
        [[0.0], np.cumsum(np.bincount(parts, expected, minlength=len(edges) - 1))]
    )
    last = len(edges) - 1
    total = float(np.sum((expected - expected.mean()) ** 2))
    for low in range(last):
        for high in range(low + 1, last + 1):
            inside = counts[high] - counts[low]
            outside = len(q) - inside
            if not inside or not outside:
                continue
            within = sums[high] - sums[low]
            excess = within / inside - (sums[-1] - within) / outside
            if excess > 0.0:
                explained = inside * outside / len(q) * excess**2 / total
                yield _Range(
                    float(explained),
                    joint,
                    float(edges[low]),
                    float(edges[high]),
                    low == 0,
                    high == last,
                )
