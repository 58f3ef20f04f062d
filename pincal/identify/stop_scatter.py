r"""Scatter of readings within a stop, and of stops at a pose, by moments; and the covariance of rows that share them.

A reading is :math:`y = f(q) + m + J a + e`: e of each reading, the arrival a of the drives of each stop, and what the model
lacks, m, of each pose. Readings of one target in one stop differ by e; means of the stops at a pose by a and by what is left
of e. From n_s readings in stop s, with mean squares

.. math:: MS_e = \frac{\sum (y - \bar y_s)^2}{\sum (n_s - 1)}, \quad
    MS_a = \frac{\sum (\bar y_s - \bar y_p)^2}{\sum (v_p - 1)}, \quad E\, MS_a = a^2 + e^2 \, \overline{1 / n_s}.

The noise of a calibration is that of its rows, the means of poses: :math:`\sigma^2 = m^2 + a^2 / v + e^2 / (n v)`
of n readings in each of v stops. Rows with other n and v have another noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import chdtri

from pincal.identify.criteria import STOPS
from pincal.identify.drive_levers import drive_levers
from pincal.identify.station import Station
from pincal.measure.stops import Plan

# Range in which the share of the drives is searched, log of its odds.
_LOGITS = (-6.0, 9.0)
# Rows by which a fit's loss of information to shared stops is found, and directions that are too weak to count.
_MOST_ROWS, _RANK = 2000, 1e-4


@dataclass(frozen=True, eq=False)
class StopScatter:
    """Variances by moments of the readings of a station, per component of each block of readings, shape (blocks,) each.

    Attributes:
        within: variance of a reading about the mean of its stop; 0 where nothing was repeated.
        between: variance of a stop about the mean of its pose, without that of its readings; 0 where no pose was revisited.
        within_degrees: degrees of freedom of the first, readings times components; 0 where nothing was repeated.
        between_degrees: degrees of freedom of the second.
        readings: number of readings of a target in a stop, harmonic mean.
        stops: number of stops at a pose, harmonic mean.
        shared: factor by which noise that readings of a stop share increases the variances of a fit that takes them to be
            independent; 1 if none is known.
        drives: fraction of the variance of the rows that follows the levers of the drives; 0 if unknown.
        of_single: whether the noise of a fit to these rows is that of a single reading in a single stop, by which they are
            weighted; else that of their means.
    """

    within: np.ndarray
    between: np.ndarray
    within_degrees: np.ndarray
    between_degrees: np.ndarray
    readings: float = 1.0
    stops: float = 1.0
    shared: float = 1.0
    drives: float = 0.0
    of_single: bool = False

    @classmethod
    def none(cls, blocks: int) -> StopScatter:
        """Return the scatter of readings of which none was repeated."""
        nothing = np.zeros(blocks)
        return cls(nothing, nothing, nothing, nothing)

    def of_row(self, readings: np.ndarray | float, stops: np.ndarray | float = 1.0) -> np.ndarray:
        """Return the variance of the mean of so many readings in each of so many stops, shape (blocks, ...)."""
        size = np.ndim(readings) * (None,)
        between = self.between[(slice(None), *size)]
        within = self.within[(slice(None), *size)]
        return np.asarray(between / stops + within / (np.asarray(readings) * stops))

    def row_variance(self, noise: np.ndarray) -> np.ndarray:
        """Return the variance of the rows that were fitted, shape (blocks,), for the noise of the fit, shape (blocks,)."""
        if not self.of_single:
            return noise**2
        of_row = self.of_row(self.readings, self.stops)
        return np.asarray(np.maximum(noise**2 - self.of_row(1.0), 0.0) + of_row)

    def known_with(self, other: StopScatter) -> StopScatter:
        """Return the variances of this table where it shows them, else those of another one."""
        has_within = self.within_degrees >= STOPS.fewest
        has_between = self.between_degrees >= STOPS.fewest
        return replace(
            self,
            within=np.where(has_within, self.within, other.within),
            between=np.where(has_between, self.between, other.between),
            within_degrees=np.where(has_within, self.within_degrees, other.within_degrees),
            between_degrees=np.where(has_between, self.between_degrees, other.between_degrees),
        )


def scatter_of_stops(station: Station, values: np.ndarray, plan: Plan) -> StopScatter:
    """Return the scatter within and between the stops of a station's single readings.

    Args:
        station: the model over them; differences of recorded joints within a pose are corrected by it.
        values: shape (P,).
        plan: by which they were measured.
    """
    blocks = station.block_rows
    if not plan.is_repeated or not len(plan):
        return StopScatter.none(len(blocks))
    residuals = station.residuals(values)
    at_stop = _numbers(np.column_stack([plan.stop, plan.thing]))
    count = np.bincount(at_stop)
    means = _means(residuals, at_stop)
    thing = plan.thing[np.unique(at_stop, return_index=True)[1]]
    at_pose = _numbers(thing[:, None])
    stops = np.bincount(at_pose)
    apart = residuals - means[:, at_stop]
    between = means - _means(means, at_pose)[:, at_pose]
    of_within = [_mean_square(apart[rows], at_stop) for rows in blocks]
    of_between = [_mean_square(between[rows], at_pose) for rows in blocks]
    within, within_degrees = np.array(of_within).T
    whole, between_degrees = np.array(of_between).T
    several = stops[at_pose] > 1
    left = float(np.mean(1.0 / count[several])) if several.any() else 0.0
    return StopScatter(
        within=within,
        between=np.maximum(whole - left * within, 0.0),
        within_degrees=within_degrees,
        between_degrees=between_degrees,
        readings=float(1.0 / np.mean(1.0 / count)),
        stops=float(1.0 / np.mean(1.0 / stops)),
    )


def _numbers(keys: np.ndarray) -> np.ndarray:
    return np.unique(keys, axis=0, return_inverse=True)[1].ravel()


def _means(columns: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the means of groups, shape (m, G)."""
    return np.stack([np.bincount(group, column) for column in columns]) / np.bincount(group)


def _mean_square(apart: np.ndarray, group: np.ndarray) -> tuple[float, float]:
    """Return the mean square of differences from the means of groups, gross groups left out, and its degrees of freedom.

    Args:
        apart: shape (m, N).
        group: shape (N,), numbers from 0.
    """
    squares = np.bincount(group, np.sum(apart**2, axis=0))
    degrees = len(apart) * (np.bincount(group) - 1.0)
    again = degrees > 0.0
    if not again.any():
        return 0.0, 0.0
    squares = squares[again]
    degrees = degrees[again]
    # A start that half of the groups, if they are gross, do not spoil.
    usual = float(np.median(squares / chdtri(degrees, 0.5)))
    kept = squares <= STOPS.gross * usual * chdtri(degrees, STOPS.chance / len(squares))
    if not kept.any():
        kept[:] = True
    return float(squares[kept].sum() / degrees[kept].sum()), float(degrees[kept].sum())


@dataclass(frozen=True, eq=False)
class SharedNoise:
    r"""Noise that rows of a station share: of the arrival of the drives in a stop, and of what the model lacks at a pose.

    In units of the noise of each row, with :math:`\bar J` the readings' derivatives by the drives, scaled to unit variance,

    .. math:: V_{ij} = \lambda \, (\mu \, [pose] + (1 - \mu) \, [stop]) \, \bar J_i \bar J_j^T
        + \nu \, (\mu \, [thing] + (1 - \mu) \, [row]) \, I ,

    so that a row of its own has the variance :math:`\lambda + \nu`. V is whitened pose by pose.

    Attributes:
        pose: shape (N,), number of each row's pose; so are ``stop`` and ``thing``, the same target at the same pose.
        stop: shape (N,).
        thing: shape (N,).
        levers: shape (n, m, N), derivatives by the n drives, in units of the noise.
        of_pose: fraction mu of the variance that all stops at a pose have in common, shape (N,).
        of_drives: variance lambda that the targets of a stop have in common.
        of_rows: variance nu that each row has of its own.
    """

    pose: np.ndarray
    stop: np.ndarray
    thing: np.ndarray
    levers: np.ndarray
    of_pose: np.ndarray
    of_drives: float = 0.0
    of_rows: float = 1.0

    def select(self, rows: Any) -> SharedNoise:
        """Return that of some rows (mask or indices)."""
        return replace(
            self,
            pose=self.pose[rows],
            stop=self.stop[rows],
            thing=self.thing[rows],
            levers=self.levers[..., rows],
            of_pose=self.of_pose[rows],
        )

    @cached_property
    def whitening(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each pose, the indices of its rows and the matrix, shape (rows m, rows m), that whitens them.

        Poses of a single row, of unit variance, are left out where targets have nothing in common.
        """
        order = np.argsort(self.pose, kind="stable")
        cuts = np.flatnonzero(np.diff(self.pose[order])) + 1
        groups = [rows for rows in np.split(order, cuts) if len(rows) > 1 or self.of_drives]
        return [(rows, np.linalg.inv(np.linalg.cholesky(self.covariance(rows)))) for rows in groups]

    def covariance(self, rows: np.ndarray) -> np.ndarray:
        """Return the covariance of some rows of a pose, shape (rows m, rows m), row by row."""
        n, m = len(rows), self.levers.shape[1]
        same_stop = self.stop[rows, None] == self.stop[rows]
        same_thing = self.thing[rows, None] == self.thing[rows]
        of_pose = np.sqrt(self.of_pose[rows, None] * self.of_pose[rows])
        of_stop = np.sqrt((1.0 - self.of_pose[rows, None]) * (1.0 - self.of_pose[rows]))
        alone = of_pose * same_thing + of_stop * np.eye(n)
        V = self.of_rows * np.kron(alone, np.eye(m))
        if self.of_drives:
            J = self.levers[..., rows].transpose(2, 1, 0).reshape(n * m, -1)
            together = of_pose + of_stop * same_stop
            V += self.of_drives * np.kron(together, np.ones((m, m))) * (J @ J.T)
        return V

    def whitened(self, columns: np.ndarray) -> np.ndarray:
        """Return columns of readings in units of the noise, shape (..., R), row by row and more behind, whitened."""
        m = self.levers.shape[1]
        columns = columns.copy()
        for rows, W in self.whitening:
            places = (rows[:, None] * m + np.arange(m)).ravel()
            columns[..., places] = columns[..., places] @ W.T
        return columns

    def covariances(self, columns: np.ndarray) -> np.ndarray:
        """Return U V U^T for columns U of readings, shape (K, R), row by row; what is not whitened has unit variance."""
        m = self.levers.shape[1]
        found = columns @ columns.T
        for rows, _ in self.whitening:
            part = columns[:, (rows[:, None] * m + np.arange(m)).ravel()]
            found += part @ (self.covariance(rows) - np.eye(part.shape[1])) @ part.T
        return np.asarray(found)

    def back(self, columns: np.ndarray) -> np.ndarray:
        """Return columns of whitened readings, shape (..., R), times the transposed whitening."""
        m = self.levers.shape[1]
        columns = columns.copy()
        for rows, W in self.whitening:
            places = (rows[:, None] * m + np.arange(m)).ravel()
            columns[..., places] = columns[..., places] @ W
        return columns

    def own_precision(self) -> np.ndarray:
        """Return the block of the precision of each row, shape (N, m, m)."""
        m = self.levers.shape[1]
        found = np.tile(np.eye(m), (len(self.pose), 1, 1))
        for rows, W in self.whitening:
            P = (W.T @ W).reshape(len(rows), m, len(rows), m)
            found[rows] = P[np.arange(len(rows)), :, np.arange(len(rows))]
        return found

    def likeliest(self, residuals: np.ndarray, *, spent: int) -> SharedNoise:
        """Return the noise with the variances of drives and rows under which residuals, shape (m, N), are most likely.

        Args:
            residuals: in units of the noise.
            spent: number of parameters that were fitted to them.
        """
        from scipy.optimize import minimize_scalar

        r = residuals.T.ravel()

        def with_share(logit: float) -> SharedNoise:
            share = 1.0 / (1.0 + np.exp(-logit))
            return replace(self, of_drives=share, of_rows=1.0 - share)

        found = minimize_scalar(lambda logit: with_share(logit)._misfit(r), bounds=_LOGITS, method="bounded")
        best = with_share(float(found.x))
        nothing = replace(self, of_drives=0.0, of_rows=1.0)
        if nothing._misfit(r) - best._misfit(r) < STOPS.shared:
            return nothing
        size = float(np.sum(best.whitened(r) ** 2)) / max(len(r) - spent, 1)
        return replace(best, of_drives=size * best.of_drives, of_rows=size * best.of_rows)

    def _misfit(self, r: np.ndarray) -> float:
        """Return -2 log likelihood of residuals, shape (R,), their size profiled out."""
        log_of_whitening = sum(float(np.sum(np.log(np.diag(W)))) for _, W in self.whitening)
        return len(r) * float(np.log(np.sum(self.whitened(r) ** 2))) - 2.0 * log_of_whitening


def shared_noise(station: Station, values: np.ndarray, plan: Plan, *, sigma: np.ndarray, of_pose: np.ndarray) -> SharedNoise:
    """Return the noise that rows of a station share by a plan, without any part of the drives yet.

    Args:
        station: the model over the rows.
        values: shape (P,).
        plan: of these rows.
        sigma: shape (blocks,), noise.
        of_pose: shape (N,), fraction of the variance that stops at a pose have in common.
    """
    levers = drive_levers(station, values)
    scale = station.weights / np.repeat(sigma, station.block_sizes)[:, None]
    levers = levers * scale
    size = float(np.sqrt(np.mean(np.sum(levers**2, axis=0)))) if levers.size else 0.0
    return SharedNoise(plan.pose, plan.stop, plan.thing, levers / max(size, 1e-300), of_pose)


def shared_in_fit(
    station: Station, values: np.ndarray, plan: Plan, *, sigma: np.ndarray, free: np.ndarray
) -> tuple[float, float]:
    r"""Return the factor by which noise that readings of a stop share increases the variances of a fit, and its fraction.

    It is that of the arrival of the drives: in a stop of several targets, or in the coordinates of one. With X the Jacobian
    of the readings in units of the noise, it is the largest eigenvalue of
    :math:`(X^T X)^{-1} X^T V X` (White 1980): that of the direction which is most like an arrival, a joint offset.

    Args:
        station: the model over the fitted rows.
        values: shape (P,).
        plan: of these rows.
        sigma: shape (blocks,), noise.
        free: shape (P,), parameters that were fitted.
    """
    some = np.isin(plan.stop, np.unique(plan.stop)[: max(_MOST_ROWS * plan.n_stops // len(plan), 2)])
    station = station.select(np.flatnonzero(some))
    plan = plan.select(some)
    scale = station.weights / np.repeat(sigma, station.block_sizes)[:, None]
    noise = shared_noise(station, values, plan, sigma=sigma, of_pose=np.zeros(len(station)))
    noise = noise.likeliest(station.residuals(values) * scale, spent=int(free.sum()))
    if not noise.of_drives:
        return 1.0, 0.0
    J = np.concatenate([part for _, _, part in station.linearise(values, free)], axis=2) * scale
    X = J.transpose(0, 2, 1).reshape(len(J), -1)
    # Singular directions of the readings, weak ones left out.
    U, s, _ = np.linalg.svd((X / np.maximum(np.linalg.norm(X, axis=1, keepdims=True), 1e-300)).T, full_matrices=False)
    U = U[:, s > _RANK * s[0]].T
    whole = noise.of_drives + noise.of_rows
    return max(float(np.linalg.eigvalsh(noise.covariances(U))[-1]), 1.0), float(noise.of_drives / whole)
