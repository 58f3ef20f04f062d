r"""Whether what a fit leaves depends on the order of its rows, the noise of which that speaks, and what blocks of rows say.

Correlation and share of :class:`Serial` are those by which the residuals are likeliest whatever the model's parameters are
(restricted maximum likelihood: Patterson and Thompson 1971, Biometrika 58, 545-554).

The second leg of uncertainty is what blocks of rows that follow each other say, whatever makes them agree.
With :math:`s_n = J_n^T r_n` the scores of the rows in units of their noise and G the normal matrix, the covariance of the
parameters is :math:`G^{-1}` if rows are independent, and

.. math:: G^{-1} \Big( \sum_b s_b s_b^T \Big) G^{-1}, \qquad s_b = \sum_{n \in b} s_n ,

for blocks b that are (the sandwich: Liang and Zeger 1986, Biometrika 73, 13-22; of blocks, not of rows, as in a moving-block
bootstrap). Blocks are too few to tell it parameter by parameter, so what is taken from it is one factor: the mean over all
directions that the model can move in, beside the same rows in any order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, solve_triangular
from scipy.optimize import OptimizeResult, minimize
from scipy.special import expit

from pincal.identify.criteria import CRITERIA
from pincal.identify.fit import ModelFit, posterior_of
from pincal.identify.station import Station
from pincal.identify.whitening import Serial, turned_into

# Bands of lags [rows] whose products of residuals are added up: noise that changes fast shows in the first, drifts in the
# last.
_BANDS = ((1, 1), (2, 5), (6, 20))
# Rows that are near each other in the order; and pairs of rows far apart in it, nearest in the joints, that tell.
_NEAR, _NEAREST = 5, 500
# Readings by which it is estimated; and rows by which dependence is looked for.
_READINGS, _ROWS = 2400, 4096
# Where the search for share and correlation begins: fast, slow and a walk.
_STARTS = ((0.5, 0.5), (0.8, 0.9), (0.9, 0.995))
# Longest memory, in rows: a walk over any table; and longer ones that are taken if they are as likely, the longest first.
_LONGEST, _MEMORIES = 1e5, (3e4, 1e3, 300.0, 100.0, 30.0)
# Logarithms of sizes of white noise, in units of that of the residuals, that are tried.
_SIZES = np.linspace(-0.4, 0.4, 9)

# Rows of a block.
_LENGTHS = (5, 10, 20, 40)
# Readings of a station by which it is told, and stations that are asked.
_BLOCK_READINGS, _MOST_STATIONS = 1500, 8
# Points of an image at most, in the mean, by which as many images tell it.
_MOST_AT_ONCE = 20


def dependence(residuals: np.ndarray, position: np.ndarray) -> float:
    """Return by how many standard deviations residuals of rows near each other in the order agree more than by chance.

    The reference is that of the same residuals in any order (a permutation test by its first two moments).

    Args:
        residuals: shape (m, N), in units of the noise.
        position: shape (N,), where each row stands in the order.
    """
    n = residuals.shape[1]
    if n < CRITERIA.fewest_in_order:
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
    return tuple(seen.serial() for seen in _seen(fit))


def with_serial(fit: ModelFit, found: tuple[Serial | None, ...]) -> ModelFit:
    """Return a fit as it is whose rows are to be weighed by this noise."""
    stations = tuple(replace(s, serial=serial) for s, serial in zip(fit.problem.stations, found, strict=True))
    return fit.over(stations)


def placed_at_mean(fit: ModelFit) -> ModelFit:
    """Return a fit whose instruments, or targets, stand where they were on average, as far as an error persisted.

    An error that persists through a session moves them for what the session shows. The best estimate of where they are
    without it lies off most of the rows, by as much as it is unsure; the mean of what is left is as good an estimate, to a
    few per cent, and the rows are predicted. Nothing else in the fit depends on it, and its covariance stays.
    """
    values = fit.values.copy()
    for (station, places, _), rows in zip(fit.stations, fit.problem.rows, strict=True):
        if station.serial is None:
            continue
        parameters, of_base = station.parameters, station.serial.turns is None
        moved = np.array([p.is_extrinsic and p.unit == "m" and (p.element == "base") == of_base for p in parameters])
        moved &= fit.solution.free[places]
        if moved.any():
            weights, parts = station.weights * fit.solution.weights[rows], list(station.linearise(values[places], moved))
            left, J = (np.concatenate([part[i] for part in parts], axis=-1) * weights for i in (1, 2))
            values[places[moved]] += np.linalg.lstsq(J.reshape(len(J), -1).T, left.ravel(), rcond=None)[0]
    return replace(fit, solution=replace(fit.solution, values=values))


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
    def poses(self) -> np.ndarray:
        """The pose of each row, shape (N,)."""
        return np.unique(self.station.conditions.q, axis=0, return_inverse=True)[1].ravel()

    @property
    def dependence(self) -> float:
        """By how much more than chance what is left agrees at rows near each other, as the fit weighs it."""
        begun = self.begun
        return max((begun.dependence_in(turns) for turns in begun.frames), default=0.0)

    @property
    def begun(self) -> _Seen:
        """It with as many rows that count, the first in the order, as dependence is looked for by."""
        station = self.station
        if station.position is None or station.sensor.is_whole or np.count_nonzero(self.counted) <= _ROWS:
            return self
        order = np.argsort(station.position, kind="stable")
        rows = np.sort(order[: int(np.searchsorted(np.cumsum(self.counted[order]), _ROWS)) + 1])
        return replace(self, station=station.select(rows), counted=self.counted[rows])

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
        return self._left if turns is None else turned_into(turns, self._left)

    @cached_property
    def _left(self) -> np.ndarray:
        station = self.station
        left = np.asarray(station.whitened(station.residuals(self.values)) * station.weights / self.sigma)
        if station.serial is None or station.serial.turns is None:
            return left
        return turned_into(station.serial.turns.swapaxes(1, 2), left)

    def dependence_in(self, turns: np.ndarray | None) -> float:
        """Return the same in one of the frames."""
        assert self.station.position is not None
        left, position = self.left(turns)[:, self.counted], self.station.position[self.counted]
        by_rows = dependence(left, position)
        pose = self.poses[self.counted] if by_rows > CRITERIA.dependent else np.arange(len(position))
        if len(np.unique(pose)) == len(pose):
            return by_rows
        # What is read in one pose, of several targets, shares what the robot does there.
        _, first, pose = np.unique(pose, return_index=True, return_inverse=True)
        means = np.stack([np.bincount(pose, row) for row in left]) / np.sqrt(np.bincount(pose))
        return dependence(means, position[first])

    def first(self, most: int) -> np.ndarray:
        """Return the rows that count with the first so many readings in the order, shape (n,)."""
        assert self.station.position is not None
        sound = np.flatnonzero(self.counted)
        few = max(most // self.station.reading_size, CRITERIA.fewest_in_order)
        return np.asarray(sound[np.argsort(self.station.position[sound], kind="stable")][:few])

    def first_instants(self, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Return rows as :meth:`first` does, and which of them are one block at the least, both shape (n,).

        Points of one image of a moving arm have one error of its path: of these there are as many images.
        """
        if not self.station.conditions.are_in_motion:
            some = self.first(most)
            return some, np.arange(len(some))
        assert self.station.position is not None
        some = self.first(_MOST_AT_ONCE * most)
        at_once = np.unique(self.station.position[some], return_inverse=True)[1]
        some = some[at_once < most // self.station.reading_size]
        return some, at_once[: len(some)]

    def columns(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals and columns of D free parameters, shape (1 + D, m, n), in units of the noise, and which ones."""
        few = self.station.select(rows)
        pieces = [
            (residuals, *jacobian.dense_columns()) for _, residuals, jacobian in few.linearise_shared(self.values, self.free)
        ]
        columns = np.concatenate([np.concatenate([residuals[None], J]) for residuals, J, _ in pieces], axis=2)
        return columns * (few.weights / self.sigma), pieces[0][2]

    def serial(self) -> Serial | None:
        """Return how the noise is correlated along the rows as they were read; None where it is not."""
        seen = replace(self, station=replace(self.station, serial=None))
        begun, position = seen.begun, seen.station.position
        if position is None or begun.station.sensor.is_whole or begun.dependence < CRITERIA.dependent:
            return None
        if len(np.unique(seen.poses)) < len(seen.station):
            # Several readings of a pose hang together by the pose, which is another noise.
            return None
        some = begun.first(_READINGS)
        every, places = begun.columns(some)
        assert begun.station.position is not None
        near = begun.station.position[some]
        priors = seen.sizes[seen.free][places] ** -2.0, seen.values[seen.free][places]
        ends, likeliest, gained = np.cumsum([0, *begun.station.block_sizes]).tolist(), None, 0.0
        for turns, everywhere in zip(begun.frames, seen.frames, strict=True):
            if begun.dependence_in(turns) < CRITERIA.dependent or begun.follows_joints(some, turns):
                continue
            columns, gains = every if turns is None else turned_into(turns[some], every), 0.0
            phi, share = np.zeros(ends[-1]), np.zeros(ends[-1])
            for a, b in pairwise(ends):
                found = _likeliest(columns[:, a:b], near, *priors)
                if found is not None:
                    gain, phi[a:b], share[a:b] = found
                    gains += gain
            if gains > gained:
                likeliest, gained = Serial(phi, share, position, seen.counted, everywhere), gains
        return likeliest

    def follows_joints(self, rows: np.ndarray, turns: np.ndarray | None) -> bool:
        """Return whether rows near each other in the joints, or in one, agree however far apart they are in the order.

        What is left is then a function of the pose, along which the rows follow each other, and no noise.
        """
        n, left, q = len(rows), self.left(turns)[:, rows], self.station.conditions.q[rows]
        left = left - left.mean(axis=1, keepdims=True)
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

    def factor(self) -> float:
        """Return how many times as large variances are as blocks of consecutive rows tell; 1 if not surely larger."""
        if self.station.position is None or self.station.sensor.is_whole:
            return 1.0
        some, at_once = self.first_instants(_BLOCK_READINGS)
        if len(some) < CRITERIA.fewest_blocks * _LENGTHS[0]:
            return 1.0
        columns, places = self.columns(some)
        J = columns[1:]
        normal = np.tensordot(J, J, axes=((1, 2), (1, 2))) + np.diag(self.sizes[self.free][places] ** -2.0)
        return _largest_factor(np.einsum("dmn,mn->dn", J, columns[0]), normal, at_once)


def _seen(fit: ModelFit) -> Iterator[_Seen]:
    problem, solution = fit.problem, fit.solution
    for (station, places, blocks), rows in zip(fit.stations, problem.rows, strict=True):
        sigma = np.repeat(solution.estimated[blocks], station.block_sizes)[:, None]
        values, free, sizes = (vector[places] for vector in (solution.values, solution.free, fit.priors.sizes))
        yield _Seen(station, values, free, sizes, solution.weights[rows] > 0.0, sigma)


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

    white = min(misfit(np.array([log, -30.0, 0.1])) for log in _SIZES)
    starts = [np.array([0.0, np.log(s / (1.0 - s)), -np.log(1.0 - phi)]) for s, phi in _STARTS]
    tried = [_least(misfit, start) for start in sorted(starts, key=misfit)[:2]]
    best = min(tried, key=lambda found: float(found.fun))
    if white - float(best.fun) < CRITERIA.correlated:
        return None
    for memory in np.log(_MEMORIES).tolist():
        # Of memories that the rows can't tell apart the longest: a short one takes the mean of the noise for well known.
        longer = _least(lambda at, memory=memory: misfit(np.append(at, memory)), best.x[:2])  # type: ignore[misc]
        if memory > best.x[2] and float(longer.fun) < float(best.fun) + CRITERIA.as_likely:
            return white - float(longer.fun), float(1.0 - np.exp(-memory)), float(expit(longer.x[1]))
    return white - float(best.fun), float(1.0 - np.exp(-best.x[2])), float(expit(best.x[1]))


def _least(misfit: Callable[[np.ndarray], float], start: np.ndarray) -> OptimizeResult:
    limits, options = [(-6.0, 6.0), (-6.0, 9.0), (0.01, np.log(_LONGEST))], {"xatol": 0.05, "fatol": 0.1, "maxfev": 120}
    return minimize(misfit, start, method="Nelder-Mead", bounds=limits[: len(start)], options=options)


def with_blocks(fit: ModelFit, beyond: float = 1.0) -> ModelFit:
    """Return a fit with a covariance as wide as blocks of consecutive rows tell, times a factor for other doubts.

    Of several stations the largest factor counts; of many, some are asked, evenly spread: it widens what all say together.
    """
    every = list(_seen(fit))
    asked = set(np.linspace(0.0, len(every) - 1.0, _MOST_STATIONS).round().astype(int).tolist())
    factors = [(every[k].factor(), every[k].station.conditions.are_in_motion) for k in asked]
    # In motion windows of an IMU overlap, and errors of the joints' path last for some rows: that widens, and is no doubt.
    of_blocks = max((factor for factor, in_motion in factors if not in_motion), default=1.0)
    widest = beyond * max((factor for factor, _ in factors), default=1.0)
    solution = replace(fit.solution, of_blocks=of_blocks, widened=max(widest, 1.0))
    if widest > 1.0:
        sigma = solution.sigma * np.sqrt(widest)
        solution = replace(solution, wide=posterior_of(fit.problem, replace(solution, sigma=sigma), fit.priors))
    return replace(fit, solution=solution)


def _largest_factor(scores: np.ndarray, normal: np.ndarray, at_once: np.ndarray | None = None) -> float:
    """Return the factor that is surest, of scores, shape (D, n), of rows in their order; 1 if none is sure.

    The reference is that of the same rows in any order, by its first two moments. Rows with the same number in ``at_once``,
    shape (n,), from 0 on, are in one block always; default: each is one.
    """
    at_once = np.arange(scores.shape[1]) if at_once is None else at_once
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    try:
        L = cholesky(normal / np.outer(size, size) + 1e-9 * np.eye(len(size)), lower=True, check_finite=False)
    except LinAlgError:
        return 1.0
    u = solve_triangular(L, scores / size[:, None], lower=True, check_finite=False)
    n, own, instants = u.shape[1], np.sum(u**2, axis=0), int(at_once[-1]) + 1
    pairs = n * (n - 1)
    mean = (float(np.sum(u.sum(axis=1) ** 2)) - own.sum()) / pairs
    spread = max((float(np.sum((u @ u.T) ** 2)) - float(own @ own)) / pairs, 1e-300)
    surest, factor = CRITERIA.of_blocks, 1.0
    for length in (1, *_LENGTHS):
        if instants < CRITERIA.fewest_blocks * length:
            break
        within = at_once < instants // length * length
        block = at_once[within] // length
        of_blocks = np.add.reduceat(u[:, within], np.flatnonzero(np.diff(block, prepend=-1)), axis=1)
        rows = np.bincount(block)
        count = int(rows @ (rows - 1))
        beyond = float(np.sum(of_blocks**2)) - own[within].sum() - count * mean
        sure = beyond / np.sqrt(2.0 * max(count, 1) * spread)
        if sure > surest:
            surest, factor = sure, 1.0 + beyond / own[within].sum()
    return float(factor)
