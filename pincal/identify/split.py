"""Held-out rows and repeated fits: cross-validation, bootstrap and Monte Carlo, serially or with
any executor.

Rows are held out at random, by regions of joint space, or by stretches of consecutive rows. Each
repetition is one call of a module-level function on picklable arguments with a seed of its own;
:mod:`pincal.spread` lists the executors.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.arrivals import poses_of
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit, Priors, Solution
from pincal.identify.options import Options
from pincal.identify.problem import Problem
from pincal.identify.solve import Course, solve
from pincal.identify.whitening import StopNoise
from pincal.measure.admit import scorable
from pincal.measure.measurements import Measurements
from pincal.measure.poses import pose_groups
from pincal.model.conditions import TURN, spread_of_moving
from pincal.robot.robot import Robot
from pincal.spread import spread
from pincal.thresholds import Count

Split = Literal["random", "blocked"]
HeldWay = Literal["regions", "stretches"]
"""In what rows that are held out for good are apart from fitted ones: joint positions, or the order
of measurement.
"""

# Number of regions of joint space, and of stretches of rows, in a blocked split.
_BLOCKS: Count = 25


def hold_out(
    measurements: Measurements, fraction: float, *, split: Split = "random", seed: int = 0
) -> tuple[Measurements, Measurements]:
    """Divide a table into training and held-out rows, both in the order of the table.

    Args:
        measurements: the table.
        fraction: of the rows to hold out, from 0 to below 1.
        split: "random" rows, or "blocked": whole clusters of similar joint positions, so that
            held-out poses are not next to measured ones.
        seed: of the choice.

    Raises:
        BadInputError: if the fraction is out of range.
    """
    held = np.zeros(len(measurements), bool)
    wanted = _rows_to_hold(measurements, fraction)
    if wanted:
        held = _drawn_groups(row_groups(measurements, split=split, seed=seed), wanted, seed)
    return measurements.select(~held), measurements.select(held)


def ways_held_out(
    measurements: Measurements, fraction: float, *, seed: int = 0
) -> dict[HeldWay, np.ndarray]:
    """Return which rows to hold out both ways, half of them by regions of joint space and half by
    stretches of rows.

    A model that knows the neighbours of a pose, or the rows measured before and after it, predicts
    it better than others: by curves between trained positions, or by drift between trained rows.
    What is drawn are poses, with all their readings: a stretch is of the poses in the order of
    their first visits. Arguments and errors as for :func:`hold_out`.

    Returns:
        For each way a mask, shape (N,), no row in both.
    """
    n = len(measurements)
    _rows_to_hold(measurements, fraction)
    if not fraction or not n:
        return {"regions": np.zeros(n, bool), "stretches": np.zeros(n, bool)}
    along = measurements.rows if measurements.time is None else measurements.time
    pose = pose_groups([measurements])[0]
    in_order = np.argsort(along, kind="stable")
    _, first = np.unique(pose[in_order], return_index=True)
    first = in_order[first]
    count = len(first)
    wanted = round(0.5 * fraction * count)
    if not wanted:
        return {"regions": np.zeros(n, bool), "stretches": np.zeros(n, bool)}
    regions = _drawn_groups(
        row_groups(measurements.select(first), split="blocked", seed=seed), wanted, seed
    )
    place = np.argsort(np.argsort(along[first], kind="stable"), kind="stable")
    stretches = _drawn_groups(place * min(_BLOCKS, count) // count, wanted, seed + 1) & ~regions
    return {"regions": regions[pose], "stretches": stretches[pose]}


def _rows_to_hold(measurements: Measurements, fraction: float) -> int:
    """Return the number of rows to hold out."""
    if not 0.0 <= fraction < 1.0:
        raise BadInputError(f"test fraction is {fraction:g}; expected at least 0 and below 1")
    return round(fraction * len(measurements))


def _drawn_groups(groups: np.ndarray, wanted: int, seed: int) -> np.ndarray:
    """Return the rows of randomly drawn groups, about as many as are wanted, shape (N,)."""
    sizes = np.bincount(groups).tolist()
    is_held = np.zeros(len(sizes), bool)
    count = 0
    for group in np.random.default_rng(seed).permutation(len(sizes)).tolist():
        if count + 0.5 * sizes[group] <= wanted:
            is_held[group] = True
            count += sizes[group]
    return np.asarray(is_held[groups])


def row_groups(measurements: Measurements, *, split: Split, seed: int) -> np.ndarray:
    """Return the group number of each row, shape (N,): each row its own, or clusters in joint
    space.

    Rows with the same joint positions (replicates, several targets) always share a group.
    """
    if split == "random":
        return distinct_poses(measurements.q)
    return joint_regions(measurements.q, _BLOCKS, seed)


@dataclass(frozen=True)
class CrossValidation:
    """Residuals of rows by fits without them.

    Attributes:
        residuals: shape (m, N), reading minus prediction [m, rad, px]; nan at points that no other
            fold has.
        fold: shape (N,), in which fold each row was held out.
    """

    residuals: np.ndarray
    fold: np.ndarray


def cross_validate(
    robot: Robot,
    measurements: Measurements,
    options: Options,
    *,
    folds: int = 5,
    split: Split = "random",
    seed: int = 0,
    executor: Executor | None = None,
) -> CrossValidation:
    """Fit ``folds`` times, each time without one part of the rows, and predict that part.

    Args:
        robot: the arm.
        measurements: all rows.
        options: how to calibrate.
        folds: number of parts.
        split: rows at random, or whole clusters in joint space.
        seed: of the division.
        executor: runs the fits; default: serially, in this process.

    Raises:
        BadInputError: for a table without rows.
    """
    if not len(measurements):
        raise BadInputError(
            f"{measurements.source}: no rows; expected some to leave out and some to fit"
        )
    groups = row_groups(measurements, split=split, seed=seed)
    order = np.random.default_rng(seed).permutation(groups.max() + 1)
    fold = (order % folds)[groups]
    run = partial(_held_out_residuals, robot, measurements, options, fold)
    parts = list(spread(run, range(folds), label="fold", executor=executor))
    residuals = np.empty((len(parts[0]), len(measurements)))
    for k, part in enumerate(parts):
        residuals[:, fold == k] = part
    return CrossValidation(residuals, fold)


def _held_out_residuals(
    robot: Robot, table: Measurements, options: Options, fold: np.ndarray, k: int
) -> np.ndarray:
    fit = fit_tables(robot, table.select(fold != k), options)
    held = table.select(fold == k)
    known = scorable(held, fit.options.setup)
    residuals = np.full((fit.station.reading_size, len(held)), np.nan)
    residuals[:, known] = fit.readings(held.select(known)).residuals(fit.values)
    return residuals


def bootstrap(
    fit: ModelFit, *, draws: int, seed: int = 0, executor: Executor | None = None
) -> np.ndarray:
    """Refit poses resampled with replacement, with all their targets; the spread of the values
    needs no model of the noise.

    Args:
        fit: the calibration.
        draws: number of refits, each a task for an executor.
        seed: of all draws, from which the seed of each is derived.
        executor: runs the refits; default: serially, in this process.

    Returns:
        Shape (draws, P).
    """
    return _drawn(partial(_refit_drawn_rows, fit), draws, seed, executor)


def _drawn(
    refit: Callable[[np.random.SeedSequence], np.ndarray],
    draws: int,
    seed: int,
    executor: Executor | None,
) -> np.ndarray:
    """Return the values of refits with a seed each, shape (draws, P)."""
    seeds = np.random.SeedSequence(seed).spawn(draws)
    return np.array(list(spread(refit, seeds, label="draw", executor=executor)))


def _refit_drawn_rows(fit: ModelFit, seed: np.random.SeedSequence) -> np.ndarray:
    problem = fit.problem
    poses = np.concatenate(
        [_apart(number, poses_of(station)) for number, station in enumerate(problem.stations)]
    )
    pose = np.unique(poses, axis=0, return_inverse=True)[1].ravel()
    n = int(pose.max()) + 1
    rows_of = np.split(np.argsort(pose, kind="stable"), np.cumsum(np.bincount(pose))[:-1])
    drawn = np.random.default_rng(seed).integers(0, n, n)
    rows = np.concatenate([rows_of[i] for i in drawn])
    draw = np.repeat(np.arange(n), [len(rows_of[i]) for i in drawn])
    stations = []
    for station, span in zip(problem.select(rows).stations, problem.rows, strict=True):
        if station.arrival is not None:
            # A pose that was drawn twice is two stops.
            own = draw[(rows >= span.start) & (rows < span.stop)]
            arrival = StopNoise.of(station.arrival.levers, own, station.arrival.size)
            station = replace(station, arrival=arrival)
        stations.append(station)
    return _refit(fit, replace(problem, stations=tuple(stations))).values


def _apart(station: int, poses: np.ndarray) -> np.ndarray:
    """Return the poses of a station's rows, shape (N,), with its number, shape (N, 2)."""
    return np.column_stack([np.full(len(poses), station), poses])


def bootstrap_stations(
    fit: ModelFit, *, draws: int, seed: int = 0, executor: Executor | None = None
) -> np.ndarray:
    """Refit stations resampled with replacement: the spread includes variation from day to day,
    unlike resampled rows.

    Arguments as for :func:`bootstrap`; returns shape (draws, P), nan for the own parameters of
    stations not drawn.

    Raises:
        BadInputError: if there is only one station.
    """
    if len(fit.problem.stations) < 2:
        raise BadInputError(
            "a bootstrap over stations of one station; expected several, or bootstrap() "
            "over its rows"
        )
    return _drawn(partial(_refit_drawn_stations, fit), draws, seed, executor)


def _refit_drawn_stations(fit: ModelFit, seed: np.random.SeedSequence) -> np.ndarray:
    problem = fit.problem
    n = len(fit.problem.stations)
    drawn = np.random.default_rng(seed).integers(0, n, n)
    stations = tuple(
        replace(problem.stations[j], name=f"{k} {problem.stations[j].name}")
        for k, j in enumerate(drawn)
    )
    again = Problem(stations)

    def carried(vector: np.ndarray) -> np.ndarray:
        found = np.empty(len(again.parameters), vector.dtype)
        for j, places in zip(drawn, again.places, strict=True):
            found[places] = vector[problem.places[j]]
        return found

    priors = Priors(carried(fit.priors.sizes), carried(fit.priors.bounds))
    spans = [problem.block_spans[j] for j in drawn]
    noise = fit.noise.select([b for span in spans for b in range(span.start, span.stop)])
    values = carried(fit.values)
    free = carried(fit.solution.free)
    solution = solve(again, values, free, priors, noise, Course(fit.options.loss))
    out = np.full(len(fit.values), np.nan)
    for j, places in zip(drawn, again.places, strict=True):
        out[problem.places[j]] = solution.values[places]
    return out


def monte_carlo(
    fit: ModelFit, *, draws: int, seed: int = 0, executor: Executor | None = None
) -> np.ndarray:
    """Refit simulated readings of the calibrated model with its noise, the parametric bootstrap;
    return shape (draws, P).

    Arguments as for :func:`bootstrap`.
    """
    return _drawn(partial(_refit_simulated, fit), draws, seed, executor)


def _refit_simulated(fit: ModelFit, seed: np.random.SeedSequence) -> np.ndarray:
    rng = np.random.default_rng(seed)
    problem = fit.problem
    stations = []
    for station, places, span in zip(
        problem.stations, problem.places, problem.block_spans, strict=True
    ):
        sigma = np.repeat(fit.solution.sigma[span], station.block_sizes)
        noise = rng.normal(size=(len(sigma), len(station))) * sigma[:, None] / station.weights
        sensor = station.sensor.shifted(
            station.coloured(noise) - station.residuals(fit.values[places])
        )
        stations.append(replace(station, sensor=sensor))
    return _refit(fit, replace(problem, stations=tuple(stations))).values


def _refit(fit: ModelFit, problem: Problem) -> Solution:
    return solve(
        problem, fit.values, fit.solution.free, fit.priors, fit.noise, Course(fit.options.loss)
    )


def joint_regions(q: np.ndarray, most: int, seed: int = 0) -> np.ndarray:
    """Return the number of each row's region of joint space, shape (N,), at most ``most`` regions,
    for q of shape (N, n).

    Regions differ in the joints that move: what an encoder reads of one that rests is not a place.
    """
    from scipy.cluster.vq import kmeans2

    # About their mean, or distances drown in the rounding of squares of positions.
    moving = spread_of_moving(_at_one_turn(q))
    if not moving.size:
        return np.zeros(len(q), int)
    n = min(most, len(np.unique(distinct_poses(moving))))
    labels = kmeans2(moving, n, minit="++", rng=np.random.default_rng(seed))[1]
    return np.unique(labels, return_inverse=True)[1].ravel()


def distinct_poses(q: np.ndarray) -> np.ndarray:
    """Return a number for each row of q, shape (N, n), equal for equal joint positions,
    shape (N,).
    """
    return np.unique(np.round(_at_one_turn(q), 9), axis=0, return_inverse=True)[1].ravel()


def _at_one_turn(q: np.ndarray) -> np.ndarray:
    """Return joint positions, shape (N, n), of joints that take more than a turn folded into one
    turn.

    The turn begins in the largest gap, so that neighbours stay neighbours. A rail of more than 6 m
    is folded, too: distant places on it may then be held out together, which does no harm.
    """
    folded = np.array(q, float)
    for j in np.flatnonzero(np.ptp(q, axis=0) > TURN) if len(q) else ():
        angles = np.unique(np.mod(q[:, j], TURN))
        gap = int(np.argmax(np.diff(angles, append=angles[0] + TURN)))
        # In the middle of the gap rounding can't move a row to the other end.
        start = angles[gap] + 0.5 * (angles[(gap + 1) % len(angles)] - angles[gap]) % TURN
        folded[:, j] = np.mod(q[:, j] - start, TURN)
    return folded
