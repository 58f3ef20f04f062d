r"""Scatter of readings within a stop, and of stops at a pose, by moments; and the covariance of
rows that share them.

A reading is :math:`y = f(q) + m + J a + e`: e of each reading, the arrival a of the drives of each
stop, and what the model lacks, m, of each pose. Readings of one target in one stop differ by e;
means of the stops at a pose by a and by what is left of e. From n_s readings in stop s, with mean
squares

.. math:: MS_e = \frac{\sum (y - \bar y_s)^2}{\sum (n_s - 1)}, \quad
    MS_a = \frac{\sum (\bar y_s - \bar y_p)^2}{\sum (v_p - 1)}, \quad E\, MS_a = a^2 + e^2 \,
    \overline{1 / n_s}.

The noise of a calibration is that of its rows, the means of poses:
:math:`\sigma^2 = m^2 + a^2 / v + e^2 / (n v)` of n readings in each of v stops. Rows with other n
and v have another noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import chdtri, expit

from pincal.identify.drive_levers import drive_levers
from pincal.identify.station import Station
from pincal.identify.stop_numbers import STOPS
from pincal.measure.stops import Plan
from pincal.thresholds import Count, Scale

# Range in which the share of the drives is searched, log of its odds.
_LOGITS: tuple[Scale, Scale] = (-6.0, 9.0)
# Rows by which a fit's loss of information to shared stops is found, and directions that are too
# weak to count.
_MOST_ROWS: Count = 600
_RANK: Scale = 1e-4


@dataclass(frozen=True, eq=False)
class StopScatter:
    """Variances by moments of the readings of a station, per component of each block of readings,
    shape (blocks,) each.

    Attributes:
        within: variance of a reading about the mean of its stop; 0 where nothing was repeated, and
            no noise was declared.
        between: variance of a stop about the mean of its pose, without that of its readings, as far
            as this is shown or declared; 0 where no pose was revisited.
        within_degrees: degrees of freedom of the first, readings times components; 0 where nothing
            was repeated.
        between_degrees: degrees of freedom of the second.
        readings: number of readings of a target in a stop, harmonic mean.
        stops: number of stops at a pose, harmonic mean.
        shared: factor by which noise that readings of a stop share increases the variances of a fit
            that takes them to be independent; 1 if none is known.
        drives: fraction of the variance of the rows that follows the levers of the drives; 0 if
            unknown.
        of_single: whether the noise of a fit to these rows is that of a single reading in a single
            stop, by which they are weighted; else that of their means.
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

    @property
    def is_known(self) -> bool:
        """Whether the readings show anything of it."""
        repeated = np.any(self.within_degrees) or np.any(self.between_degrees)
        return bool(repeated) or self.shared > 1.0 or self.drives > 0.0

    def of_row(self, readings: np.ndarray | float, stops: np.ndarray | float = 1.0) -> np.ndarray:
        """Return the variance of the mean of so many readings in each of so many stops, shape
        (blocks, ...).
        """
        size = np.ndim(readings) * (None,)
        between = self.between[(slice(None), *size)]
        within = self.within[(slice(None), *size)]
        return np.asarray(between / stops + within / (np.asarray(readings) * stops))

    def row_variance(self, noise: np.ndarray) -> np.ndarray:
        """Return the variance of the rows that were fitted, shape (blocks,), for the noise of the
        fit, shape (blocks,).
        """
        if not self.of_single:
            return noise**2
        of_row = self.of_row(self.readings, self.stops)
        return np.asarray(np.maximum(noise**2 - self.of_row(1.0), 0.0) + of_row)

    def with_declared(self, noise: Sequence[float | None]) -> StopScatter:
        """Return the scatter with the declared noise of a reading for each block, if any, as that
        within stops, where none was read twice.

        What stops at a pose show is then without it, as they arrive; both together are as shown.

        Example:
            >>> none, shown = np.zeros(1), np.array([25.0])
            >>> arrived = StopScatter(none, shown, none, np.array([60.0])).with_declared([4.0])
            >>> arrived.within.tolist(), arrived.between.tolist()
            ([16.0], [9.0])
        """
        declared = np.array([0.0 if sigma is None else sigma**2 for sigma in noise])
        within = np.where(
            self.within_degrees > 0.0, self.within, np.minimum(declared, self.between)
        )
        between = np.where(self.within_degrees > 0.0, self.between, self.between - within)
        return replace(self, within=within, between=between)

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


class ScatterOfStations(Mapping[str, StopScatter]):
    """Scatter of the readings of the stations of a fit, by their names, where any was repeated or a
    stop has several targets.

    It is worked out when it is first asked for: no fit needs it, and it takes as long as two or
    three evaluations of the model.

    Attributes:
        of_single: names of the stations whose noise is that of a single reading, as known without
            it: see :attr:`StopScatter.of_single`.
    """

    def __init__(
        self,
        work_out: Callable[[], dict[str, StopScatter]] = dict,
        of_single: frozenset[str] = frozenset(),
    ) -> None:
        """Create it with the function that works it out."""
        self.of_single = of_single
        self._work_out = work_out
        self._known: dict[str, StopScatter] | None = None

    @property
    def _found(self) -> dict[str, StopScatter]:
        if self._known is None:
            self._known = self._work_out()
            # Its rows may be freed.
            self._work_out = dict
        return self._known

    def __getitem__(self, name: str) -> StopScatter:
        return self._found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)

    def __getstate__(self) -> dict[str, Any]:
        """Return it as found, without the rows."""
        return {"of_single": self.of_single, "_work_out": dict, "_known": self._found}


def scatter_of_stops(station: Station, values: np.ndarray, plan: Plan) -> StopScatter:
    """Return the scatter within and between the stops of a station's single readings.

    Args:
        station: the model over them; differences of recorded joints within a pose are corrected by
            it.
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
    """Return the mean square of differences from the means of groups, gross groups left out, and
    its degrees of freedom.

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
    r"""Noise that rows of a station share: of the arrival of the drives in a stop, and of what the
    model lacks at a pose.

    In units of the noise of each row, with :math:`\bar J` the readings' derivatives by the drives,
    scaled to unit variance,

    .. math:: V_{ij} = \lambda \, (\mu \, [pose] + (1 - \mu) \, [stop]) \, \bar J_i \bar J_j^T
        + \nu \, (\mu \, [thing] + (1 - \mu) \, [row]) \, I ,

    so that a row of its own has the variance :math:`\lambda + \nu`. V is whitened pose by pose.

    Attributes:
        pose: shape (N,), number of each row's pose; so are ``stop`` and ``thing``, the same target
            at the same pose.
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
    def _poses(self) -> list[np.ndarray]:
        """The rows of the poses that have as many, shape (P, n), by n."""
        order = np.argsort(self.pose, kind="stable")
        starts = np.flatnonzero(np.diff(self.pose[order], prepend=-1))
        sizes = np.diff(starts, append=len(order))
        return [order[starts[sizes == n, None] + np.arange(n)] for n in np.unique(sizes)]

    @cached_property
    def whitening(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """The rows of the poses that have as many, shape (P, n), and the matrices, shape (P, n m, n
        m), that whiten them.

        Poses of a single row, of unit variance, are left out where targets have nothing in common.
        """
        correlated = [rows for rows in self._poses if rows.shape[1] > 1 or self.of_drives]
        return [
            (rows, np.linalg.inv(np.linalg.cholesky(self.covariance(rows)))) for rows in correlated
        ]

    def covariance(self, rows: np.ndarray) -> np.ndarray:
        """Return the covariances of the n rows of each of P poses, shape (P, n), as shape (P, n m,
        n m), row by row.
        """
        poses, n = rows.shape
        m = self.levers.shape[1]
        own = np.eye(n)
        first = rows[:, :, None]
        second = rows[:, None, :]
        same_stop = self.stop[first] == self.stop[second]
        same_thing = self.thing[first] == self.thing[second]
        of_pose = np.sqrt(self.of_pose[first] * self.of_pose[second])
        of_stop = np.sqrt((1.0 - self.of_pose[first]) * (1.0 - self.of_pose[second]))
        alone = self.of_rows * (of_pose * same_thing + of_stop * own)
        V = alone[:, :, None, :, None] * np.eye(m)[:, None, :]
        if self.of_drives:
            # Shape (P, n m, drives).
            J = np.moveaxis(self.levers[..., rows], (2, 3, 1, 0), (0, 1, 2, 3)).reshape(
                poses, n * m, -1
            )
            together = self.of_drives * (of_pose + of_stop * same_stop)
            V = V + together[:, :, None, :, None] * (J @ J.transpose(0, 2, 1)).reshape(
                poses, n, m, n, m
            )
        return np.asarray(V.reshape(poses, n * m, n * m))

    def _places(self, rows: np.ndarray) -> np.ndarray:
        """Return where the readings of rows, shape (P, n), are in columns, shape (P, n m)."""
        m = self.levers.shape[1]
        return np.asarray((rows[:, :, None] * m + np.arange(m)).reshape(len(rows), -1))

    def whitened(self, columns: np.ndarray) -> np.ndarray:
        """Return columns of readings in units of the noise, shape (..., R), row by row and more
        behind, whitened.
        """
        return self._turned(columns, self.whitening)

    def back(self, columns: np.ndarray) -> np.ndarray:
        """Return columns of whitened readings, shape (..., R), times the transposed whitening."""
        return self._turned(columns, [(rows, W.transpose(0, 2, 1)) for rows, W in self.whitening])

    def _turned(
        self, columns: np.ndarray, turns: list[tuple[np.ndarray, np.ndarray]]
    ) -> np.ndarray:
        """Return columns of readings, shape (..., R), those of rows, shape (P, n), by matrices,
        shape (P, n m, n m).
        """
        columns = columns.copy()
        each = columns.reshape(-1, columns.shape[-1])
        for rows, turn in turns:
            places = self._places(rows)
            each[:, places] = (turn @ each[:, places].transpose(1, 2, 0)).transpose(2, 0, 1)
        return np.asarray(columns)

    def covariances(self, columns: np.ndarray) -> np.ndarray:
        """Return U V U^T for columns U of readings, shape (K, R), row by row; what is not whitened
        has unit variance.
        """
        found = columns @ columns.T
        for rows, _ in self.whitening:
            places = self._places(rows)
            part = columns[:, places]
            more = self.covariance(rows) - np.eye(places.shape[1])
            moved = (more @ part[..., None])[..., 0]
            found += part.reshape(len(part), -1) @ moved.reshape(len(part), -1).T
        return np.asarray(found)

    def own_precision(self) -> np.ndarray:
        """Return the block of the precision of each row, shape (N, m, m)."""
        m = self.levers.shape[1]
        found = np.tile(np.eye(m), (len(self.pose), 1, 1))
        for rows, W in self.whitening:
            poses, n = rows.shape
            P = (W.transpose(0, 2, 1) @ W).reshape(poses, n, m, n, m)
            found[rows] = np.einsum("pikil->pikl", P)
        return found

    def likeliest(self, residuals: np.ndarray, *, spent: int) -> SharedNoise:
        """Return the noise with the variances of drives and rows under which residuals, shape (m,
        N), are most likely.

        Args:
            residuals: in units of the noise.
            spent: number of parameters that were fitted to them.
        """
        from scipy.optimize import minimize_scalar

        variances, along = self._principal(residuals.T.ravel())
        squares = along**2

        def misfit(share: float) -> float:
            """Return -2 log likelihood for a share of the drives, with the likeliest size of the
            whole.
            """
            relative = share * variances + (1.0 - share)
            return len(squares) * float(np.log(np.sum(squares / relative))) + float(
                np.sum(np.log(relative))
            )

        found = minimize_scalar(
            lambda logit: misfit(float(expit(logit))), bounds=_LOGITS, method="bounded"
        )
        share = float(expit(found.x))
        if misfit(0.0) - misfit(share) < STOPS.shared:
            return replace(self, of_drives=0.0, of_rows=1.0)
        whole = np.sum(squares / (share * variances + (1.0 - share)))
        size = float(whole) / max(len(squares) - spent, 1)
        return replace(self, of_drives=size * share, of_rows=size * (1.0 - share))

    def _principal(self, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return variances by the drives along axes of unit variance by rows, and the residuals r
        there, (R,) each.
        """
        drives = replace(self, of_drives=1.0, of_rows=0.0)
        alone = replace(self, of_drives=0.0, of_rows=1.0)
        variances = []
        along = []
        for rows in self._poses:
            V = drives.covariance(rows)
            here = r[self._places(rows)]
            if rows.shape[1] > 1:
                # The part of a single row is of unit variance as it is.
                W = np.linalg.inv(np.linalg.cholesky(alone.covariance(rows)))
                V = W @ V @ W.transpose(0, 2, 1)
                here = (W @ here[:, :, None])[:, :, 0]
            found, axes = np.linalg.eigh(V)
            variances.append(np.maximum(found, 0.0).ravel())
            along.append(np.einsum("pij,pi->pj", axes, here).ravel())
        return np.concatenate(variances), np.concatenate(along)


def shared_noise(
    station: Station, values: np.ndarray, plan: Plan, *, sigma: np.ndarray, of_pose: np.ndarray
) -> SharedNoise:
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
    r"""Return the factor by which noise that readings of a stop share increases the variances of a
    fit, and its fraction.

    It is that of the arrival of the drives: in a stop of several targets, or in the coordinates of
    one. With X the Jacobian of the readings in units of the noise, it is the largest eigenvalue of
    :math:`(X^T X)^{-1} X^T V X` (White 1980): that of the direction which is most like an arrival,
      a joint offset.

    Args:
        station: the model over the fitted rows.
        values: shape (P,).
        plan: of these rows.
        sigma: shape (blocks,), noise.
        free: shape (P,), parameters that were fitted.
    """
    stops = np.unique(plan.stop)[: max(_MOST_ROWS * plan.n_stops // len(plan), 2)]
    some = plan.stop <= stops[-1]
    station = station.select(np.flatnonzero(some))
    plan = plan.select(some)
    scale = station.weights / np.repeat(sigma, station.block_sizes)[:, None]
    noise = shared_noise(station, values, plan, sigma=sigma, of_pose=np.zeros(len(station)))
    noise = noise.likeliest(station.residuals(values) * scale, spent=int(free.sum()))
    if not noise.of_drives:
        return 1.0, 0.0
    J = np.concatenate([part for _, _, part in station.linearise(values, free)], axis=2) * scale
    X = J.transpose(0, 2, 1).reshape(len(J), -1)
    X = X / np.maximum(np.linalg.norm(X, axis=1, keepdims=True), 1e-300)
    # Orthonormal directions of the readings, weak ones left out.
    squares, axes = np.linalg.eigh(X @ X.T)
    strong = squares > _RANK**2 * squares[-1]
    U = (axes[:, strong] / np.sqrt(squares[strong])).T @ X
    whole = noise.of_drives + noise.of_rows
    return max(float(np.linalg.eigvalsh(noise.covariances(U))[-1]), 1.0), float(
        noise.of_drives / whole
    )
