"""Whether what a fit leaves depends on the order of its rows, and the noise of which that speaks.

Correlation and share of :class:`Serial` are those by which the residuals are likeliest whatever the model's parameters are
(restricted maximum likelihood: Patterson and Thompson 1971, Biometrika 58, 545-554).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.optimize import OptimizeResult, minimize
from scipy.special import expit

from pincal.identify.criteria import CRITERIA
from pincal.identify.fit import ModelFit
from pincal.identify.serial import Serial, turned_into
from pincal.identify.station import Station

# Bands of lags [rows] whose products of residuals are added up: noise that changes fast shows in the first, drifts in the
# last.
_BANDS = ((1, 1), (2, 5), (6, 20))
# Rows that are near each other in the order; and pairs of rows far apart in it, nearest in the joints, that tell.
_NEAR, _NEAREST = 5, 500
# Fewest rows that show it.
_FEWEST = 20
# Readings by which it is estimated; and rows by which dependence is looked for.
_READINGS, _ROWS = 2400, 4096
# Where the search for share and correlation begins: fast, slow and a walk.
_STARTS = ((0.5, 0.5), (0.8, 0.9), (0.9, 0.995))
# Longest memory, in rows: a walk over any table; and longer ones that are taken if they are as likely, the longest first.
_LONGEST, _MEMORIES = 1e5, (3e4, 1e3, 300.0, 100.0, 30.0)
# Twice the log-likelihood within which a memory is as likely as the likeliest: one standard deviation of a parameter, twice.
_AS_LIKELY = 2.0
# Logarithms of sizes of white noise, in units of that of the residuals, that are tried.
_SIZES = np.linspace(-0.4, 0.4, 9)


def dependence(residuals: np.ndarray, position: np.ndarray) -> float:
    """Return by how many standard deviations residuals of rows near each other in the order agree more than by chance.

    The reference is that of the same residuals in any order (a permutation test by its first two moments).

    Args:
        residuals: shape (m, N), in units of the noise.
        position: shape (N,), where each row stands in the order.
    """
    n = residuals.shape[1]
    if n < _FEWEST:
        return 0.0
    z = residuals[:, np.argsort(position, kind="stable")[:_ROWS]]
    z = z - z.mean(axis=1, keepdims=True)
    n, covariance = z.shape[1], z @ z.T / z.shape[1]
    variance, found = max(float(np.sum(covariance**2)), 1e-300), [0.0]
    for first, last in _BANDS:
        lags = range(first, min(last, n - 1) + 1)
        products = sum(float(np.vdot(z[:, lag:], z[:, :-lag])) for lag in lags)
        pairs = sum(n - lag for lag in lags)
        # Centred residuals in any order agree by -1 / (n - 1).
        expected = -float(np.trace(covariance)) * pairs / (n - 1)
        found.append((products - expected) / np.sqrt(max(pairs, 1) * variance))
    return max(found)


def serial_noise(fit: ModelFit) -> tuple[Serial | None, ...]:
    """Return how the noise of each station of a fit is correlated along its rows; None where it is not.

    Rows that were weighed by it already are taken as they were read.
    """
    return tuple(map(_of_station, _seen(fit)))


def with_serial(fit: ModelFit, found: tuple[Serial | None, ...]) -> ModelFit:
    """Return a fit as it is whose rows are to be weighed by this noise."""
    stations = tuple(replace(s, serial=serial) for s, serial in zip(fit.problem.stations, found, strict=True))
    return replace(fit, problem=replace(fit.problem, stations=stations))


def is_dependent(fit: ModelFit) -> bool:
    """Return whether what a fit leaves, as it weighs it, depends on the order of the rows at any station."""
    return any(seen.dependence > CRITERIA.dependent for seen in _seen(fit))


@dataclass(frozen=True)
class _Seen:
    """A station of a fit.

    Attributes:
        station: the station.
        values, free, sizes: shape (P,), of its parameters.
        counted: shape (N,), rows that count.
        sigma: shape (m, 1), noise of each component of a reading.
    """

    station: Station
    values: np.ndarray
    free: np.ndarray
    sizes: np.ndarray
    counted: np.ndarray
    sigma: np.ndarray

    @property
    def dependence(self) -> float:
        """By how much more than chance what is left agrees at rows near each other, as the fit weighs it."""
        return max((self.dependence_in(turns) for turns in self.frames), default=0.0)

    @property
    def frames(self) -> tuple[np.ndarray | None, ...]:
        """Where errors may persist: in the frame of the readings, and in a target's, by its rotations, shape (N, 3, 3)."""
        if self.station.position is None:
            return ()
        sensor, (of_model, _) = self.station.sensor, self.station.split(self.values)
        if not sensor.reads_pose or any(block.size != 3 for block in sensor.blocks):
            return (None,)
        return None, self.station.model.predict(of_model, self.station.conditions)[:, :, :3]

    def left(self, turns: np.ndarray | None) -> np.ndarray:
        """Return what is left, as the fit weighs it, in units of its noise, shape (m, N), in one of the frames."""
        station = self.station
        left = station.whitened(station.residuals(self.values)) * station.weights / self.sigma
        if station.serial is not None and station.serial.turns is not None:
            left = turned_into(station.serial.turns.swapaxes(1, 2), left)
        return left if turns is None else turned_into(turns, left)

    def dependence_in(self, turns: np.ndarray | None) -> float:
        """Return the same in one of the frames."""
        station = self.station
        assert station.position is not None
        left, position = self.left(turns)[:, self.counted], station.position[self.counted]
        by_rows = dependence(left, position)
        pose = self.poses[self.counted] if by_rows > CRITERIA.dependent else np.arange(len(position))
        if len(np.unique(pose)) == len(pose):
            return by_rows
        # What is read in one pose, of several targets, shares what the robot does there.
        _, first, pose = np.unique(pose, return_index=True, return_inverse=True)
        means = np.stack([np.bincount(pose, row) for row in left]) / np.sqrt(np.bincount(pose))
        return dependence(means, position[first])

    @property
    def poses(self) -> np.ndarray:
        """The pose of each row, shape (N,)."""
        return np.unique(self.station.conditions.q, axis=0, return_inverse=True)[1].ravel()


def _seen(fit: ModelFit) -> Iterator[_Seen]:
    problem, solution = fit.problem, fit.solution
    for (station, places, blocks), rows in zip(fit.stations, problem.rows, strict=True):
        sigma = np.repeat(solution.estimated[blocks], station.block_sizes)[:, None]
        values, free, sizes = (vector[places] for vector in (solution.values, solution.free, fit.priors.sizes))
        yield _Seen(station, values, free, sizes, solution.weights[rows] > 0.0, sigma)


def _of_station(seen: _Seen) -> Serial | None:
    seen = replace(seen, station=replace(seen.station, serial=None))
    station, free, position = seen.station, seen.free, seen.station.position
    if position is None or station.sensor.is_whole or seen.dependence < CRITERIA.dependent:
        return None
    if len(np.unique(seen.poses)) < len(station):
        # Several readings of a pose hang together by the pose, which is another noise.
        return None
    sizes = [block.size for block in station.sensor.blocks]
    sound = np.flatnonzero(seen.counted)
    some = sound[np.argsort(position[sound], kind="stable")][: max(_READINGS // sum(sizes), _FEWEST)]
    few = station.select(some)
    ((_, residuals, jacobian),) = few.linearise_shared(seen.values, free)
    J, places = jacobian.dense_columns()
    every = np.concatenate([residuals[None], J]) * (few.weights / seen.sigma)
    priors = seen.sizes[free][places] ** -2.0, seen.values[free][places]
    ends, likeliest, gained = np.cumsum([0, *sizes]).tolist(), None, 0.0
    for turns in seen.frames:
        if seen.dependence_in(turns) < CRITERIA.dependent or _follows_joints(seen, some, turns):
            continue
        columns, gains = every if turns is None else turned_into(turns[some], every), 0.0
        phi, share = np.zeros(sum(sizes)), np.zeros(sum(sizes))
        for a, b in pairwise(ends):
            found = _likeliest(columns[:, a:b], position[some], *priors)
            if found is not None:
                gain, phi[a:b], share[a:b] = found
                gains += gain
        if gains > gained:
            likeliest, gained = Serial(phi, share, position, seen.counted, turns), gains
    return likeliest


def _follows_joints(seen: _Seen, rows: np.ndarray, turns: np.ndarray | None) -> bool:
    """Return whether rows near each other in the joints, or in one, agree however far apart they are in the order.

    What is left is then a function of the pose, along which the rows follow each other, and no noise.

    Args:
        seen: the station.
        rows: shape (n,), rows in their order.
        turns: the frame in which they agree.
    """
    station, n = seen.station, len(rows)
    left = seen.left(turns)[:, rows]
    left = left - left.mean(axis=1, keepdims=True)
    q = station.conditions.q[rows]
    q = q / np.maximum(q.std(axis=0), 1e-12)
    by_order = np.mean([np.mean(np.sum(left[:, :-lag] * left[:, lag:], axis=0)) for lag in range(1, _NEAR + 1)])
    # Pairs far apart in the order: how alike they are, and how near.
    first, second = np.triu_indices(n, max(n // 4, _BANDS[-1][1]))
    alike = np.sum(left[:, first] * left[:, second], axis=0)
    apart = np.abs(q[first] - q[second]).T
    for distance in (np.linalg.norm(apart, axis=0), *apart):
        nearest = np.argpartition(distance, _NEAREST)[:_NEAREST] if len(distance) > _NEAREST else slice(None)
        if np.mean(alike[nearest]) > 0.5 * by_order:
            return True
    return False


def _likeliest(
    columns: np.ndarray, position: np.ndarray, precision: np.ndarray, values: np.ndarray
) -> tuple[float, float, float] | None:
    """Return what the likeliest noise of some components gains, its correlation and share; None if that is too little.

    Args:
        columns: shape (1 + P, m, N), residuals, then the model's columns, in units of the noise.
        position: shape (N,), where each row stands in the order.
        precision: shape (P,), inverse variances of the parameters' priors.
        values: shape (P,), of the parameters now.
    """
    _, m, n = columns.shape
    everywhere = np.ones(n, bool)

    def misfit(at: np.ndarray) -> float:
        noise, share, phi = float(np.exp(at[0])), float(expit(at[1])), float(1.0 - np.exp(-at[2]))
        serial = Serial(np.full(m, phi), np.full(m, share), position, everywhere)
        z = serial.innovations(columns).reshape(len(columns), -1)
        H = z[1:] @ z[1:].T / noise
        H.flat[:: len(H) + 1] += precision
        pull = z[1:] @ z[0] / noise - precision * values
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        try:
            factor = cho_factor(H * np.outer(scale, scale) + 1e-10 * np.eye(len(H)), lower=True)
        except LinAlgError:
            return 1e300
        gained = float((scale * pull) @ cho_solve(factor, scale * pull))
        determinant = 2.0 * float(np.sum(np.log(np.diag(factor[0]) / scale)))
        left = float(z[0] @ z[0]) / noise - gained
        return float(m * n * at[0] + serial.log_determinant + determinant + left)

    def at_memory(memory: float, at: np.ndarray) -> float:
        return misfit(np.append(at, memory))

    white = min(misfit(np.array([log, -30.0, 0.1])) for log in _SIZES)
    starts = [np.array([0.0, np.log(s / (1.0 - s)), -np.log(1.0 - phi)]) for s, phi in _STARTS]
    tried = [_least(misfit, start) for start in sorted(starts, key=misfit)[:2]]
    best = min(tried, key=lambda found: float(found.fun))
    if white - float(best.fun) < CRITERIA.correlated:
        return None
    for memory in np.log(_MEMORIES).tolist():
        # Of memories that the rows can't tell apart the longest: a short one takes the mean of the noise for well known.
        longer = _least(partial(at_memory, memory), best.x[:2])
        if memory > best.x[2] and float(longer.fun) < float(best.fun) + _AS_LIKELY:
            return white - float(longer.fun), float(1.0 - np.exp(-memory)), float(expit(longer.x[1]))
    return white - float(best.fun), float(1.0 - np.exp(-best.x[2])), float(expit(best.x[1]))


def _least(misfit: Callable[[np.ndarray], float], start: np.ndarray) -> OptimizeResult:
    limits, options = [(-6.0, 6.0), (-6.0, 9.0), (0.01, np.log(_LONGEST))], {"xatol": 0.05, "fatol": 0.1, "maxfev": 120}
    return minimize(misfit, start, method="Nelder-Mead", bounds=limits[: len(start)], options=options)
