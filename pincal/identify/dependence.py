r"""Dependence of residuals on the order of the rows, the correlated noise that explains it, and
scores of blocks of rows.

Correlation and share of :class:`Serial` are the most likely ones for the residuals, the model's
parameters marginalised (restricted maximum likelihood: Patterson and Thompson 1971, Biometrika 58,
545-554).

Blocks of consecutive rows give a second account of the uncertainty, whatever correlates them. With
:math:`s_n = J_n^T r_n` the scores of the rows in units of their noise and G the normal matrix, the
covariance of the parameters is :math:`G^{-1}` if rows are independent, and

.. math:: G^{-1} \Big( \sum_b s_b s_b^T \Big) G^{-1}, \qquad s_b = \sum_{n \in b} s_n ,

if blocks b are (the sandwich: Liang and Zeger 1986, Biometrika 73, 13-22; of blocks, as in a
moving-block bootstrap). There are too few blocks for a factor per parameter, so one is taken: the
mean over all directions of the model, relative to the same rows in any order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dtrtri
from scipy.optimize import OptimizeResult, minimize, minimize_scalar
from scipy.special import expit, logit

from pincal.identify.criteria import CRITERIA
from pincal.identify.fit import AnyFit, ModelFit, posterior_of
from pincal.identify.station import Station
from pincal.identify.whitening import Serial, turned_into
from pincal.measure.poses import are_distinct
from pincal.model.conditions import spread_of_moving
from pincal.thresholds import Count, Scale

# Bands of lags [rows] whose products of residuals are summed: fast noise shows in the first, drifts
# in the last.
_BANDS: tuple[tuple[Count, Count], tuple[Count, Count], tuple[Count, Count]] = (
    (1, 1),
    (2, 5),
    (6, 20),
)
# Lags of rows that are near in the order; number of pairs of rows, far apart in the order and
# nearest in the joints.
_NEAR: Count = 5
_NEAREST: Count = 500
# Readings used to estimate the noise; rows used to test for dependence.
_READINGS: Count = 2400
_ROWS: Count = 4096
# Start values of share and correlation: fast, slow and a random walk.
_STARTS: tuple[tuple[Scale, Scale], tuple[Scale, Scale], tuple[Scale, Scale]] = (
    (0.5, 0.5),
    (0.8, 0.9),
    (0.9, 0.995),
)
# Longest memory, in rows: a random walk over any table; and longer ones, accepted if as likely, the
# longest first.
_LONGEST: Scale = 1e5
_MEMORIES: tuple[Scale, ...] = (3e4, 1e3, 300.0, 100.0, 30.0)
# Limits of the logit of the share and the log of the memory. How closely both are found: in the
# end, and at first from a second start.
_LIMITS: tuple[tuple[Scale, Scale], tuple[Scale, Scale]] = (
    (-6.0, 9.0),
    (0.01, float(np.log(_LONGEST))),
)
_NEAR_SHARE: Scale = 0.05
_ROUGH: Scale = 0.5
# First steps of both, from anywhere and from a noise that is known.
_STEPS: tuple[Scale, Scale] = (1.0, 0.25)
# How far from that of a walk of the same steps the logit of the share may be with a longer memory.
_BESIDE: Scale = 1.5
# Squares of what a sum of parameters moves, in units of the noise, below which it is left out.
_FAINT: Scale = 1e-7
# Relative change of the variance whose effect a closed form tells well enough, and the number of
# its corrections.
_SAME: Scale = 3e-3
_TURNS: Count = 8

# Rows of a block.
_LENGTHS: tuple[Count, ...] = (5, 10, 20, 40)
# Readings of a station, and stations, that the factor of blocks is estimated from.
_BLOCK_READINGS: Count = 1500
_MOST_STATIONS: Count = 8
# Mean number of points per image up to which the number of images is kept.
_MOST_AT_ONCE: Count = 20


def dependence(residuals: np.ndarray, position: np.ndarray) -> float:
    """Return by how many standard deviations residuals of neighbouring rows agree more than by
    chance.

    The reference are the same residuals in any order (a permutation test by its first two moments).

    Args:
        residuals: shape (m, N), in units of the noise.
        position: shape (N,), of each row in the order.
    """
    n = residuals.shape[1]
    if n < CRITERIA.fewest_in_order:
        return 0.0
    z = residuals[:, np.argsort(position, kind="stable")[:_ROWS]]
    z = z - z.mean(axis=1, keepdims=True)
    n = z.shape[1]
    covariance = z @ z.T / z.shape[1]
    variance = max(float(np.sum(covariance**2)), 1e-300)
    found = [0.0]
    # With zeros behind each component, all of them are one row, of which no part is copied.
    row = np.pad(z, ((0, 0), (0, _BANDS[-1][1]))).ravel()
    for first, last in _BANDS:
        lags = range(first, min(last, n - 1) + 1)
        products = sum(float(row[lag:] @ row[:-lag]) for lag in lags)
        pairs = sum(n - lag for lag in lags)
        # Centred residuals in any order agree by -1 / (n - 1).
        expected = -float(np.trace(covariance)) * pairs / (n - 1)
        found.append((products - expected) / np.sqrt(max(pairs, 1) * variance))
    return max(found)


def serial_noise(fit: ModelFit) -> tuple[Serial | None, ...]:
    """Return how the noise of each station of a fit is correlated along the rows as they were read;
    None where it is not.
    """
    return tuple(station.serial() for station in _fitted_stations(fit))


def with_serial(fit: ModelFit, found: tuple[Serial | None, ...]) -> ModelFit:
    """Return a fit, unchanged, whose rows are to be weighted by this noise."""
    stations = tuple(
        replace(s, serial=serial) for s, serial in zip(fit.problem.stations, found, strict=True)
    )
    return fit.over(stations)


def placed_at_mean(fit: ModelFit) -> ModelFit:
    """Return a fit with instruments, or targets, at their mean position, as far as an error
    persisted.

    An error that persists through a session displaces them in that session. The best estimate of
    their position without it lies off most rows, by its uncertainty; the mean of the residuals is
    as good an estimate, to a few per cent, and predicts the rows. Nothing else in the fit depends
    on it, and its covariance is kept.
    """
    values = fit.values.copy()
    for (station, places, _), rows in zip(fit.stations, fit.problem.rows, strict=True):
        if station.serial is None:
            continue
        moved = displaced_by(station, station.serial) & fit.solution.free[places]
        if moved.any():
            weights = station.weights * fit.solution.weights[rows]
            parts = list(station.linearise(values[places], moved))
            left, J = (
                np.concatenate([part[i] for part in parts], axis=-1) * weights for i in (1, 2)
            )
            values[places[moved]] += np.linalg.lstsq(
                J.reshape(len(J), -1).T, left.ravel(), rcond=None
            )[0]
    return replace(fit, solution=replace(fit.solution, values=values))


def displaced_by(station: Station, serial: Serial) -> np.ndarray:
    """Return which parameters of a station are coordinates of what an error that persists
    displaces, shape (P,): of the base in the instrument's frame, or of targets.
    """
    of_base = serial.turns is None
    return np.array(
        [
            p.is_extrinsic and p.unit == "m" and (p.element == "base") == of_base
            for p in station.parameters
        ]
    )


def is_dependent(fit: ModelFit) -> bool:
    """Return whether the weighted residuals of a fit depend on the order of the rows at any
    station.
    """
    for batch in fit.problem.batches:
        batch.note_poses(fit.values)
    return any(station.dependence > CRITERIA.dependent for station in _fitted_stations(fit))


@dataclass(frozen=True)
class _FittedStation:
    """A station of a fit: values, free and sizes, shape (P,), rows that count, shape (N,), and
    noise, shape (m, 1).
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
        """Dependence of the weighted residuals on the order, the largest of all frames."""
        first = self.first_rows
        return max((first.dependence_in(turns) for turns in first.frames), default=0.0)

    @property
    def first_rows(self) -> _FittedStation:
        """The station with its first rows in the order, as many that count as dependence is tested
        by.
        """
        station = self.station
        if (
            station.position is None
            or station.sensor.is_whole
            or np.count_nonzero(self.counted) <= _ROWS
        ):
            return self
        order = np.argsort(station.position, kind="stable")
        rows = np.sort(order[: int(np.searchsorted(np.cumsum(self.counted[order]), _ROWS)) + 1])
        return replace(self, station=station.select(rows), counted=self.counted[rows])

    @property
    def frames(self) -> tuple[np.ndarray | None, ...]:
        """Frames in which errors may persist: the readings' (None), and a target's, by its
        rotations, shape (N, 3, 3).
        """
        if self.station.position is None:
            return ()
        sensor = self.station.sensor
        (of_model, _) = self.station.split(self.values)
        if not sensor.reads_pose or any(block.size != 3 for block in sensor.blocks):
            return (None,)
        conditions = self.station.conditions
        if conditions.at_moments is not conditions:
            return None, self.station.model.predict(of_model, conditions)[:, :, :3]
        return None, self.station.poses_read(of_model)[:, :, :3]

    def residuals(self, turns: np.ndarray | None) -> np.ndarray:
        """Return the weighted residuals in units of the noise, shape (m, N), in one of
        the frames.
        """
        return self._residuals if turns is None else turned_into(turns, self._residuals)

    @cached_property
    def _residuals(self) -> np.ndarray:
        station = self.station
        found = np.asarray(
            station.whitened(station.residuals(self.values)) * station.weights / self.sigma
        )
        if station.serial is None or station.serial.turns is None:
            return found
        return turned_into(station.serial.turns.swapaxes(1, 2), found)

    def dependence_in(self, turns: np.ndarray | None) -> float:
        """Return the dependence in one of the frames."""
        assert self.station.position is not None
        residuals = self.residuals(turns)[:, self.counted]
        position = self.station.position[self.counted]
        by_rows = dependence(residuals, position)
        pose = (
            self.poses[self.counted] if by_rows > CRITERIA.dependent else np.arange(len(position))
        )
        if are_distinct(pose):
            return by_rows
        # Readings of several targets in one pose share the robot's error there.
        _, first, pose = np.unique(pose, return_index=True, return_inverse=True)
        means = np.stack([np.bincount(pose, row) for row in residuals]) / np.sqrt(np.bincount(pose))
        return dependence(means, position[first])

    def first_readings(self, most: int) -> np.ndarray:
        """Return the rows that count with the first ``most`` readings in the order, shape (n,)."""
        assert self.station.position is not None
        sound = np.flatnonzero(self.counted)
        few = max(most // self.station.reading_size, CRITERIA.fewest_in_order)
        return np.asarray(sound[np.argsort(self.station.position[sound], kind="stable")][:few])

    def first_instants(self, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Return rows as :meth:`first_readings`, and for each the number of its image, both shape
        (n,).

        Points of one image of a moving arm share one error of its path, so images count as rows do.
        """
        if not self.station.conditions.are_in_motion:
            some = self.first_readings(most)
            return some, np.arange(len(some))
        assert self.station.position is not None
        some = self.first_readings(_MOST_AT_ONCE * most)
        at_once = np.unique(self.station.position[some], return_inverse=True)[1]
        some = some[at_once < most // self.station.reading_size]
        return some, at_once[: len(some)]

    def columns(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals and D free parameters' columns, shape (1 + D, m, n), in units of the
        noise, and their indices.
        """
        few = self.station.select(rows)
        pieces = [
            (residuals, *jacobian.dense_columns())
            for _, residuals, jacobian in few.linearise_shared(self.values, self.free)
        ]
        parts = [np.concatenate([residuals[None], J]) for residuals, J, _ in pieces]
        columns = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)
        columns *= few.weights / self.sigma
        return columns, pieces[0][2]

    def serial(self) -> Serial | None:
        """Return how the noise is correlated along the rows as they were read; None where it is
        not.
        """
        plain = replace(self, station=replace(self.station, serial=None))
        first = plain.first_rows
        position = plain.station.position
        if position is None or first.station.sensor.is_whole:
            return None
        if first.dependence < CRITERIA.dependent:
            return None
        if not are_distinct(plain.poses):
            # Several readings of a pose are correlated by the pose, which is another noise.
            return None
        some = first.first_readings(_READINGS)
        every, places = first.columns(some)
        assert first.station.position is not None
        near = first.station.position[some]
        priors = plain.sizes[plain.free][places] ** -2.0, plain.values[plain.free][places]
        known = self.known
        likeliest = None
        most = 0.0
        for turns, everywhere in zip(first.frames, plain.frames, strict=True):
            if first.dependence_in(turns) < CRITERIA.dependent or first.follows_joints(some, turns):
                continue
            columns = every if turns is None else turned_into(turns[some], every)
            each = [
                _RestrictedLikelihood.of(columns[:, rows], near, *priors).likeliest(start)
                for rows, start in zip(first.station.block_rows, known, strict=True)
            ]
            # The next frame shows the same noise.
            known = [found or start for found, start in zip(each, known, strict=True)]
            gain = sum(found.gain for found in each if found is not None)
            if gain > most:
                phi, share = _by_reading(each, first.station.block_sizes)
                likeliest = Serial(phi, share, position, plain.counted, everywhere)
                most = gain
        return likeliest

    @property
    def known(self) -> list[_Remembered | None]:
        """The correlated noise that each block of readings is weighted by; None for none."""
        serial = self.station.serial
        blocks = self.station.block_rows
        if serial is None:
            return [None for _ in blocks]
        each = ((float(serial.phi[rows][0]), float(serial.share[rows][0])) for rows in blocks)
        return [_Remembered(0.0, phi, share) if share else None for phi, share in each]

    def follows_joints(self, rows: np.ndarray, turns: np.ndarray | None) -> bool:
        """Return whether residuals of rows near in all joints, or in one, agree however far apart
        they are in the order.

        They are then a function of the pose, which changes steadily along the rows, and not noise.
        """
        n = len(rows)
        residuals = self.residuals(turns)[:, rows]
        q = self.station.conditions.q[rows]
        z = residuals - residuals.mean(axis=1, keepdims=True)
        q = spread_of_moving(q)
        by_order = np.mean(
            [np.mean(np.sum(z[:, :-lag] * z[:, lag:], axis=0)) for lag in range(1, _NEAR + 1)]
        )
        # Pairs far apart in the order: their products and distances.
        first, second = np.triu_indices(n, max(n // 4, _BANDS[-1][1]))
        products = np.sum(z[:, first] * z[:, second], axis=0)
        apart = np.abs(q[first] - q[second]).T
        for distance in (np.linalg.norm(apart, axis=0), *apart):
            nearest = (
                np.argpartition(distance, _NEAREST)[:_NEAREST]
                if len(distance) > _NEAREST
                else slice(None)
            )
            if np.mean(products[nearest]) > 0.5 * by_order:
                return True
        return False

    def factor(self) -> float:
        """Return the factor on variances that blocks of consecutive rows show; 1 if not
        significantly larger.
        """
        if self.station.position is None or self.station.sensor.is_whole:
            return 1.0
        some, at_once = self.first_instants(_BLOCK_READINGS)
        if len(some) < CRITERIA.fewest_blocks * _LENGTHS[0]:
            return 1.0
        columns, places = self.columns(some)
        J = columns[1:]
        flat = J.reshape(len(J), -1)
        normal = flat @ flat.T + np.diag(self.sizes[self.free][places] ** -2.0)
        return _largest_factor(np.einsum("dmn,mn->dn", J, columns[0]), normal, at_once)


def _fitted_stations(fit: ModelFit) -> Iterator[_FittedStation]:
    problem = fit.problem
    solution = fit.solution
    for (station, places, blocks), rows in zip(fit.stations, problem.rows, strict=True):
        sigma = np.repeat(solution.estimated[blocks], station.block_sizes)[:, None]
        values, free, sizes = (
            vector[places] for vector in (solution.values, solution.free, fit.priors.sizes)
        )
        yield _FittedStation(station, values, free, sizes, solution.weights[rows] > 0.0, sigma)


def _by_reading(
    each: Sequence[_Remembered | None], sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return correlation and share of each reading of a row from those of its blocks, shape (m,)
    each.
    """
    phi = [0.0 if found is None else found.phi for found in each]
    share = [0.0 if found is None else found.share for found in each]
    return np.repeat(phi, sizes), np.repeat(share, sizes)


def _axes(columns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the principal axes of what parameters of unit size move, given their columns, shape
    (P, R), as rows, shape (K, R), and their values along these, shape (K,).

    Axes of less than ``_FAINT`` of the noise are left out.
    """
    P, R = columns.shape
    is_wide = R < P
    squares, axes = np.linalg.eigh(columns.T @ columns if is_wide else columns @ columns.T)
    seen = squares > max(_FAINT, 1e-15 * float(squares.max(initial=0.0)))
    axes = axes[:, seen]
    if not is_wide:
        return axes.T @ columns, axes.T @ values
    lengths = np.sqrt(squares[seen])
    return lengths[:, None] * axes.T, axes.T @ (values @ columns) / lengths


@dataclass(frozen=True)
class _Remembered:
    """A noise that is correlated along the rows: its gain over an independent one, in 2
    log-likelihood, its correlation, and its share of the variance.
    """

    gain: float
    phi: float
    share: float

    @property
    def at(self) -> np.ndarray:
        """The logit of the share and the log of the memory, within their limits."""
        place = [logit(self.share), -np.log1p(-self.phi)]
        return np.asarray(np.clip(place, *np.transpose(_LIMITS)))


@dataclass(frozen=True, eq=False)
class _RestrictedLikelihood:
    """Of a noise that is correlated along rows.

    Attributes:
        columns: shape (1 + P, m, N), residuals, then the model's columns, in units of the noise.
        position: shape (N,), of each row in the order.
        precision: shape (P,), inverse variances of the parameters' priors.
        values: shape (P,), present values.
    """

    columns: np.ndarray
    position: np.ndarray
    precision: np.ndarray
    values: np.ndarray

    @classmethod
    def of(
        cls, columns: np.ndarray, position: np.ndarray, precision: np.ndarray, values: np.ndarray
    ) -> _RestrictedLikelihood:
        """Return that of as few columns as move the readings, but for a constant: parameters with
        priors are told by their sums, the axes of what they move, of which mostly few are more than
        rounding.
        """
        moves = np.any(columns[1:], axis=(1, 2))
        is_known = moves & (precision > 0.0)
        free = columns[1:][moves & ~is_known]
        J = columns[1:][is_known].reshape(int(is_known.sum()), -1)
        sizes = precision[is_known] ** -0.5
        sums, at = _axes(J * sizes[:, None], values[is_known] / sizes)
        kept = np.concatenate([columns[:1], free, sums.reshape(-1, *columns.shape[1:])])
        size = len(free)
        return cls(
            kept,
            position,
            np.append(np.zeros(size), np.ones(len(sums))),
            np.append(values[moves & ~is_known], at),
        )

    @cached_property
    def white(self) -> float:
        """-2 l of independent rows."""
        return self._least(self._products, 0.0)

    @cached_property
    def _products(self) -> np.ndarray:
        """The products of the columns, shape (1 + P, 1 + P)."""
        every = self.columns.reshape(len(self.columns), -1)
        return np.asarray(every @ every.T)

    @cached_property
    def _left(self) -> float:
        """The likeliest variance of independent rows, over the mean square of the residuals."""
        return self._likeliest_variance(self._products, 1.0)[1]

    def misfit(self, share: float, memory: float) -> float:
        """Return -2 l at the logit of the share and the log of the memory, and the likeliest
        variance.

        All variances share the products of the whitened columns, which take most of the time.
        """
        _, m, n = self.columns.shape
        phi = float(1.0 - np.exp(-memory))
        shares = np.full(m, float(expit(share)))
        serial = Serial(np.full(m, phi), shares, self.position, np.ones(n, bool))
        z = serial.innovations(self.columns).reshape(len(self.columns), -1)
        return self._least(z @ z.T, serial.log_determinant)

    def _least(self, products: np.ndarray, log_determinant: float) -> float:
        """Return -2 l of the likeliest variance, by the products of the whitened columns, shape
        (1 + P, 1 + P), and the log determinant of the whitening.
        """
        try:
            return self._likeliest_variance(products, self._left)[0] + log_determinant
        except LinAlgError:
            return 1e300

    def _likeliest_variance(self, products: np.ndarray, start: float) -> tuple[float, float]:
        """Return -2 l of the likeliest variance, and this over the mean square of the residuals,
        which is ``start`` at first.

        At the optimum the variance is the sum of squares over the degrees of freedom, which hardly
        depend on it: as if they did not, what is left to the optimum has a closed form.
        """
        mean = max(float(products[0, 0]) / self.columns[0].size, 1e-300)
        noise = start * mean
        for _ in range(_TURNS):
            misfit, squares, degrees = self._at(products, noise)
            left = float(np.log(squares / degrees / noise))
            least = misfit - degrees * float(np.expm1(left) - left)
            noise = squares / degrees
            if abs(left) < _SAME:
                break
        return least, noise / mean

    def _at(self, products: np.ndarray, noise: float) -> tuple[float, float, float]:
        """Return -2 l of a variance, and squares and degrees of freedom of the residuals with its
        parameters.
        """
        readings = self.columns[0].size
        of_rows = products[1:, 1:]
        # Column-major for LAPACK, in place: copies take as long as the factor.
        H = np.array(of_rows, order="F")
        H *= 1.0 / noise
        H.flat[:: len(H) + 1] += self.precision
        pull = products[1:, 0] / noise - self.precision * self.values
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        H *= scale
        H *= scale[:, None]
        H.flat[:: len(H) + 1] += 1e-10
        L = cholesky(H, lower=True, overwrite_a=True, check_finite=False)
        step = scale * cho_solve((L, True), scale * pull, check_finite=False)
        inverse, _ = dtrtri(L, lower=1)
        variances = scale**2 * np.sum(inverse**2, axis=0)
        degrees = readings - float(np.sum(1.0 - variances * self.precision))
        squares = float(products[0, 0] + step @ (of_rows @ step - 2.0 * products[1:, 0]))
        determinant = 2.0 * float(np.sum(np.log(np.diag(L) / scale)))
        left = float(products[0, 0]) / noise - float(pull @ step)
        least = readings * float(np.log(noise)) + determinant + left
        return least, max(squares, 1e-300), max(degrees, 1.0)

    def with_memory(self, memory: float, share: float) -> tuple[float, float]:
        """Return the optimum with a given log of the memory, and the logit of the share there,
        which is near ``share``.
        """
        most = _LIMITS[0][1]
        share = min(share, most)
        found = minimize_scalar(
            lambda share: self.misfit(share, memory),
            bounds=(share - _BESIDE, min(share + _BESIDE, most)),
            method="bounded",
            options={"xatol": _NEAR_SHARE},
        )
        return float(found.fun), float(found.x)

    def likeliest(self, known: _Remembered | None = None) -> _Remembered | None:
        """Return the most likely correlated noise; None if it gains too little. One that is known
        of such rows is near it.
        """
        best = (
            self._from_anywhere() if known is None else self._near(known.at, first_step=_STEPS[1])
        )
        least = float(best.fun)
        if self.white - least < CRITERIA.correlated:
            return None
        share, memory = best.x.tolist()
        for longer in np.log(_MEMORIES).tolist():
            # The longest of the memories that are as likely: a short one takes the mean of the
            # noise for well known.
            if longer <= memory:
                break
            # The steps of a walk stay, so that its share grows as its memory does.
            misfit, there = self.with_memory(longer, best.x[0] + longer - best.x[1])
            if misfit < float(best.fun) + CRITERIA.as_likely:
                least = misfit
                share = there
                memory = longer
                break
        phi = float(1.0 - np.exp(-memory))
        return _Remembered(self.white - least, phi, float(expit(share)))

    def _from_anywhere(self) -> OptimizeResult:
        """Return the optimum near the two likeliest starts."""
        starts = [_Remembered(0.0, phi, share).at for share, phi in _STARTS]
        likely = sorted(starts, key=lambda start: self.misfit(*start.tolist()))
        best = self._near(likely[0])
        # Another optimum shows soon; mostly it is the same.
        other = self._near(likely[1], _ROUGH)
        if other.fun < best.fun + _ROUGH and np.any(np.abs(other.x - best.x) > _ROUGH):
            other = self._near(other.x)
        return min(best, other, key=lambda found: float(found.fun))

    def _near(
        self, start: np.ndarray, near: float = _NEAR_SHARE, first_step: float = _STEPS[0]
    ) -> OptimizeResult:
        """Return the optimum near a logit of the share and a log of the memory, both found to
        within ``near``.
        """
        # Away from a limit.
        steps = np.where(start + first_step > np.array(_LIMITS)[:, 1], -first_step, first_step)
        around = start + steps * np.eye(3, 2, -1)
        options = {
            "xatol": near,
            "fatol": 2.0 * near,
            "maxfev": 120,
            "initial_simplex": around,
        }
        return minimize(
            lambda at: self.misfit(*at.tolist()),
            start,
            method="Nelder-Mead",
            bounds=_LIMITS,
            options=options,
        )


def with_blocks(fit: AnyFit, beyond: float = 1.0) -> AnyFit:
    """Return a fit with a covariance as wide as blocks of consecutive rows require, times a given
    factor.

    The largest factor of all stations counts; of many stations some are tested, evenly spread.
    """
    every = list(_fitted_stations(fit))
    tested = set(np.linspace(0.0, len(every) - 1.0, _MOST_STATIONS).round().astype(int).tolist())
    factors = [(every[k].factor(), every[k].station.conditions.are_in_motion) for k in tested]
    # In motion, windows of an IMU overlap and errors of the path last for some rows: that widens,
    # but is no defect.
    of_blocks = max((factor for factor, in_motion in factors if not in_motion), default=1.0)
    widest = beyond * max((factor for factor, _ in factors), default=1.0)
    solution = replace(fit.solution, of_blocks=of_blocks, widened=1.0)
    return widened_by(replace(fit, solution=solution), widest)


def widened_by(fit: AnyFit, beyond: float) -> AnyFit:
    """Return a fit with a covariance wider than it is by a factor on its variances."""
    factor = max(beyond * fit.solution.widened, 1.0)
    solution = replace(fit.solution, widened=factor)
    if factor > 1.0:
        wider = replace(solution, sigma=solution.sigma * np.sqrt(factor))
        solution = replace(solution, wide=posterior_of(fit.problem, wider, fit.priors))
    return replace(fit, solution=solution)


def _largest_factor(
    scores: np.ndarray, normal: np.ndarray, at_once: np.ndarray | None = None
) -> float:
    """Return the most significant factor, of scores, shape (D, n), of rows in their order; 1 if
    none is significant.

    The reference is the same rows in any order, by its first two moments. Rows with one number in
    ``at_once``, shape (n,), from 0 on and ascending, are always in one block; default: each row has
    its own.
    """
    at_once = np.arange(scores.shape[1]) if at_once is None else at_once
    try:
        u = _whitened_scores(scores, normal)
    except LinAlgError:
        return 1.0
    n = u.shape[1]
    own = np.sum(u**2, axis=0)
    instants = int(at_once[-1]) + 1
    pairs = n * (n - 1)
    mean = (float(np.sum(u.sum(axis=1) ** 2)) - own.sum()) / pairs
    spread = max((float(np.sum((u @ u.T) ** 2)) - float(own @ own)) / pairs, 1e-300)
    surest = CRITERIA.of_blocks
    factor = 1.0
    for length in (1, *_LENGTHS):
        if instants < CRITERIA.fewest_blocks * length:
            break
        cuts = np.searchsorted(at_once, length * np.arange(instants // length + 1))
        rows = np.diff(cuts)
        count = int(rows @ (rows - 1))
        if not count:
            continue
        within = slice(0, int(cuts[-1]))
        of_blocks = np.add.reduceat(u[:, within], cuts[:-1], axis=1)
        beyond = float(np.sum(of_blocks**2)) - own[within].sum() - count * mean
        sure = beyond / np.sqrt(2.0 * count * spread)
        if sure > surest:
            surest = sure
            factor = 1.0 + beyond / own[within].sum()
    return float(factor)


def _whitened_scores(scores: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return scores, shape (D, n), that are white if rows are independent; a LinAlgError if the
    normal matrix is singular.
    """
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(size, size) + 1e-9 * np.eye(len(size))
    L = cholesky(scaled, lower=True, check_finite=False)
    found = solve_triangular(L, scores / size[:, None], lower=True, check_finite=False)
    return np.asarray(found)
