r"""Errors of a fit at rows that it has not seen: every row is predicted once by a fit without its
fold.

The delivered model is fitted to all rows. Its error is stated by cross-validation: poses, with all
their readings, are divided into folds, and each is predicted by the fit of the others. Folds are
regions of joint space, stretches of consecutive rows, or sessions: a model that knows the
neighbours of a pose, or the rows measured before and after it, predicts it better than others.

The fit without a fold is that of all rows less the fold's information: with the normal equations H
x = g of all rows and the fold's part of them, one Gauss-Newton step leads there,

.. math:: x_{-k} = x + (H - H_k + D^{-2})^{-1} (g - g_k) ,

which for a linear model is exact (Cook and Weisberg 1982, Residuals and Influence in Regression,
section 3.2). A step that is not short is repeated at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Literal

import numpy as np

from pincal.identify.equations import Linearised, WithoutFolds
from pincal.identify.fit import ModelFit, Solution
from pincal.identify.jacobian import Jacobian
from pincal.identify.posterior import Posterior
from pincal.identify.problem import Problem
from pincal.identify.split import joint_regions
from pincal.identify.station import Station
from pincal.measure.poses import SCATTER, same_joints
from pincal.measure.stops import sessions_by_time
from pincal.thresholds import Count, Scale

Way = Literal["regions", "stretches", "sessions", "random"]
"""In what held-out rows are apart from fitted ones: joint positions, the order of measurement, the
session, or nothing.
"""

# Folds of each way; of fewer than so many, the largest fraction of all poses in one of them.
_FOLDS: Count = 25
_MANY: Count = 10
_LARGEST: Scale = 2 / 3
# Steps at most to the fit without a fold, and the motion of predictions by the last one, in units
# of the noise, that needs no further one.
_STEPS: Count = 3
_SHORT: Scale = 0.3
# Precisions, in units of the priors', by which a step that leads up is damped.
_DAMPINGS = tuple(3.0 * 10.0**k for k in range(6))
# Largest step of a parameter [rad or m] whose predictions are taken to first order: they are off by
# half its square.
_LINEAR: Scale = 1e-3


@dataclass(frozen=True)
class Folds:
    """A division of the rows of a problem.

    Attributes:
        of_way: way -> shape (N,), the fold of each row of all stations, from 0.
        seed: of the division.
    """

    of_way: Mapping[Way, np.ndarray]
    seed: int = 0

    @classmethod
    def of(cls, problem: Problem, ways: Sequence[Way], *, seed: int = 0) -> Folds:
        """Divide the rows of a problem in some ways, without those in which a fold leaves too few
        poses to fit.

        Rows of one pose are always in one fold, at all stations.
        """
        found = {way: _together(problem, _FOLDS_OF[way](problem, seed)) for way in ways}
        return cls(
            {way: fold for way, fold in found.items() if _leaves_enough(problem, fold)}, seed
        )

    def over(self, problem: Problem) -> Folds:
        """Return the division of another problem's rows in the same ways; the same for the same
        rows.
        """
        return Folds.of(problem, tuple(self.of_way), seed=self.seed)

    def __len__(self) -> int:
        return len(self.of_way)

    def only(self, way: Way) -> Folds:
        """Return the division in one of its ways."""
        return Folds({way: self.of_way[way]}, self.seed)

    def count(self, way: Way) -> int:
        """Return the number of folds of a way."""
        return int(self.of_way[way].max()) + 1


def left_out_residuals(
    fit: ModelFit, solution: Solution, folds: Sequence[np.ndarray]
) -> list[list[np.ndarray]]:
    """Return reading minus prediction of every row by the fit of the other folds, shape (m, N), for
    each division and each station.

    Args:
        fit: the fit of all rows.
        solution: its full solution, or that of base and tool alone.
        folds: divisions, each of shape (N,): the fold of each row of all stations.

    Returns:
        For each division the residuals of each station; nan for rows of a target or point that no
        other fold has.
    """
    problem = fit.problem
    point = _at_rest(fit, solution)
    left_out = [
        _LeftOut(fold, np.array(list(_without_each(fit, solution, fold, point)))) for fold in folds
    ]
    found: list[list[np.ndarray]] = [[] for _ in folds]
    for station, places, rows in zip(problem.stations, problem.places, problem.rows, strict=True):
        of_station = [without.at(rows, places) for without in left_out]
        by_division = _residuals_without(
            station, solution.values[places], solution.free[places], of_station, point.columns
        )
        for residuals, of_division in zip(by_division, found, strict=True):
            of_division.append(residuals)
    return found


@dataclass(frozen=True, eq=False)
class _LeftOut:
    """Fits without each of K folds.

    Attributes:
        fold: shape (N,), the fold of each row.
        values: shape (K, P), the parameters without each fold.
    """

    fold: np.ndarray
    values: np.ndarray

    def at(self, rows: slice, places: np.ndarray) -> _LeftOut:
        """Return the same of some rows, and of the parameters at some places."""
        return _LeftOut(self.fold[rows], self.values[:, places])


def _residuals_without(
    station: Station,
    values: np.ndarray,
    free: np.ndarray,
    left_out: Sequence[_LeftOut],
    columns: tuple[np.ndarray, Jacobian] | None,
) -> list[np.ndarray]:
    """Return the residuals of all rows of a station by the fit without each row's fold, for each
    division, shape (m, N).

    Predictions change by the Jacobian at the values of all rows, shape (P,), times the step where
    this is small; ``columns`` are it and the residuals there, if known.
    """
    steps = [without.values - values for without in left_out]
    found = [np.empty((station.reading_size, len(station))) for _ in left_out]
    plain = replace(station, whitening=None, serial=None, arrival=None)
    pieces = (
        plain.linearise_correlated(values, free)
        if columns is None
        else [(slice(0, len(station)), *columns)]
    )
    for piece, residuals, J in pieces:
        for without, step, out in zip(left_out, steps, found, strict=True):
            out[:, piece] = residuals - J.along_each(step[:, free].T, without.fold[piece])
    for without, step, out in zip(left_out, steps, found, strict=True):
        for k in np.flatnonzero(np.abs(step).max(axis=1, initial=0.0) > _LINEAR):
            if (mine := without.fold == k).any():
                out[:, mine] = _residuals_of(station, without.values[k], mine)
        out[:, _alone_in_fold(station, without.fold)] = np.nan
    return found


def _residuals_of(station: Station, values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the residuals of some rows, a mask, shape (m, n)."""
    if station.sensor.is_whole:
        return station.residuals(values)[:, rows]
    return station.select(np.flatnonzero(rows)).residuals(values)


def _of_independent_rows(problem: Problem) -> Problem:
    """Return a problem without correlation along the rows.

    It would make the first row of a walk hold all that is known of the instrument's place: how far
    a fold pulls is told by independent rows.
    """
    stations = (replace(station, serial=None) for station in problem.stations)
    return replace(problem, stations=tuple(stations))


def _is_serial(fit: ModelFit) -> bool:
    """Return whether rows are correlated along their order."""
    return any(station.serial is not None for station in fit.problem.stations)


def _at_rest(fit: ModelFit, solution: Solution) -> Linearised:
    """Return the problem at the values of a solution of all rows."""
    problem = _of_independent_rows(fit.problem) if _is_serial(fit) else fit.problem
    return Linearised(
        problem,
        solution.values,
        solution.free,
        solution.weights,
        fit.priors.sizes,
        squares_first=True,
    )


def _without_each(
    fit: ModelFit, solution: Solution, fold: np.ndarray, point: Linearised
) -> Iterator[np.ndarray]:
    """Yield the values of the fit without each fold, shape (P,), from where that of all rows is."""
    free = solution.free
    sigma = solution.sigma
    bounds = fit.priors.bounds[free]
    readings = max(float(point.problem.readings(solution.weights).sum()), 1.0)
    most = np.inf if _is_serial(fit) else _SHORT**2 * readings
    for without in point.without_each(fold, sigma):
        # The fit of all rows may not be at rest itself.
        by_all = cache(partial(_step, without.whole, bounds))
        short = _short_steps(without, by_all(0.0), bounds, most)
        for k in without.folds:
            if k in short:
                values = solution.values.copy()
                values[free] += short[k]
                yield values
            else:
                at = point.without_rows(fold == k), without.posterior(k)
                yield _by_steps(*at, by_all, bounds, sigma, most)


def _by_steps(
    here: Linearised,
    posterior: Posterior,
    by_all: Callable[[float], np.ndarray],
    bounds: np.ndarray,
    sigma: np.ndarray,
    most: float,
) -> np.ndarray:
    """Return the values of the fit without a fold, shape (P,), step by step; arguments as for
    :func:`_short_steps`, with the step of all rows by its damping.
    """

    def beyond(damping: float) -> np.ndarray:
        return np.asarray(_step(posterior, bounds, damping) - by_all(damping))

    here, step = _descended(here, beyond, sigma)
    for _ in range(_STEPS - 1):
        if posterior.square(step) < most:
            break
        posterior = here.posterior(sigma)
        here, step = _descended(here, partial(_step, posterior, bounds), sigma)
    return here.values


def _short_steps(
    without: WithoutFolds, by_all: np.ndarray, bounds: np.ndarray, most: float
) -> dict[int, np.ndarray]:
    """Return the steps to the fits without some folds, by their numbers, that are so short that
    these are found: worked out together, in a fraction of the time of each.

    Args:
        without: the posteriors without the folds.
        by_all: the step of all rows, shape (F,), by which the fit of these is not at rest.
        bounds: largest values, shape (F,), beyond which a step is not taken as it is.
        most: square of a step below which it needs no further one.
    """
    together = without.together
    steps = None if together is None else together.steps_of_each()
    if together is None or steps is None:
        return {}
    is_bounded = np.any(np.abs(together.offsets + steps) > bounds, axis=1)
    steps = steps - by_all
    square = np.sum(steps * (together.form.H @ steps[:, :, None])[:, :, 0], axis=1)
    is_short = np.abs(steps).max(axis=1, initial=0.0) <= _LINEAR
    found = np.flatnonzero(is_short & ~is_bounded & (square < most))
    return {without.folds[k]: steps[k] for k in found.tolist()}


def _step(posterior: Posterior, bounds: np.ndarray, damping: float) -> np.ndarray:
    """Return the step of all free parameters, shape (F,)."""
    return np.asarray(posterior.step_within(bounds, damping)[0])


def _descended(
    here: Linearised, step_of: Callable[[float], np.ndarray], sigma: np.ndarray
) -> tuple[Linearised, np.ndarray]:
    """Return the end of a step and the step, which is damped if it is long and leads up.

    Where readings hardly tell base and tool apart, as of parallel axes, they may go far along what
    is no valley any more.
    """

    def at_end_of(step: np.ndarray) -> Linearised:
        values = here.values.copy()
        values[here.free] += step
        return here.moved_to(values)

    step = step_of(0.0)
    there = at_end_of(step)
    if np.abs(step).max(initial=0.0) <= _LINEAR:
        return there, step
    objective = here.objective(sigma)
    for damping in _DAMPINGS:
        if there.objective(sigma) <= objective:
            return there, step
        step = step_of(damping)
        there = at_end_of(step)
    return there, step


def _alone_in_fold(station: Station, fold: np.ndarray) -> np.ndarray:
    """Return which rows are of a target or named point that no other fold has, shape (N,)."""
    alone = np.zeros(len(fold), bool)
    for names in (station.conditions.target, station.sensor.groups):
        if names is None or not len(names):
            continue
        number = np.unique(names, return_inverse=True)[1].ravel()
        has = np.zeros((int(number.max()) + 1, int(fold.max()) + 1), bool)
        has[number, fold] = True
        alone |= np.count_nonzero(has, axis=1)[number] == 1
    return alone


def _together(problem: Problem, fold: np.ndarray) -> np.ndarray:
    """Return folds in which rows of the same joint positions share that of the first of them,
    numbered from 0.
    """
    q = problem.conditions.q
    station = problem.stations[0]
    is_plain = (
        len(problem.stations) == 1
        and station.sensor.groups is None
        and len(station.model.chain.targets) == 1
    )
    if not is_plain and len(fold):
        _, first, pose = np.unique(same_joints(q, SCATTER), return_index=True, return_inverse=True)
        fold = fold[first][pose.ravel()]
    return np.asarray(np.unique(fold, return_inverse=True)[1].ravel())


def _leaves_enough(problem: Problem, fold: np.ndarray) -> bool:
    """Return whether the poses outside of every fold are a good part of all.

    Of a session of a few poses, as of a test by ISO 9283, those of another can't be predicted.
    """
    if not len(fold):
        return False
    if fold.max() + 1 >= _MANY:
        return True
    poses = same_joints(problem.conditions.q, SCATTER)
    _, first = np.unique(poses, axis=0, return_index=True)
    in_fold = np.bincount(fold[first], minlength=int(fold.max()) + 1)
    return bool(in_fold.max() <= _LARGEST * len(first))


def _regions(problem: Problem, seed: int) -> np.ndarray:
    """Return the region of joint space of each row."""
    return joint_regions(problem.conditions.q, _FOLDS, seed)


def _stretches(problem: Problem, seed: int) -> np.ndarray:
    """Return the stretch of consecutive rows of each row, the same number of them at
    each station.
    """
    parts = []
    for station in problem.stations:
        n = len(station)
        if station.position is None:
            parts.append(np.zeros(n, int))
            continue
        place = np.argsort(np.argsort(station.position, kind="stable"), kind="stable")
        parts.append(place * min(_FOLDS, n) // max(n, 1))
    return np.concatenate(parts)


def _sessions(problem: Problem, seed: int) -> np.ndarray:
    """Return the session of each row, counted over all stations; a single one without times."""
    parts = []
    begun = 0
    for station in problem.stations:
        time = station.conditions.time
        session = np.zeros(len(station), int) if time is None else sessions_by_time(time)
        parts.append(begun + session)
        begun += int(session.max(initial=0)) + (time is not None)
    return np.concatenate(parts)


def _at_random(problem: Problem, seed: int) -> np.ndarray:
    """Return folds of rows at random."""
    n = len(problem)
    return np.random.default_rng(seed).permutation(n) % min(_FOLDS, max(n, 1))


_FOLDS_OF = {
    "regions": _regions,
    "stretches": _stretches,
    "sessions": _sessions,
    "random": _at_random,
}
