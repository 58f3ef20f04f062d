r"""Restricted likelihood of the variances with which drives arrive at the stops of a station.

A fit spends many of the few degrees of freedom that stops have, and takes a part of every arrival
for the robot's: variances of its residuals are far too small. With parameters z of information P
beforehand, arrivals x_s of the stops with the variances R = diag(rho), and readings of variances
kappa by block,

.. math:: r = J z + L_s x_s + e,

the likelihood of rho and kappa with z integrated out (restricted maximum likelihood: Patterson and
Thompson 1971, Biometrika 58, 545-554) follows from the matrix of the mixed model equations
(Henderson 1975, Biometrics 31, 423-447)

.. math:: C = \begin{pmatrix} H + P & B^T \\ B & D + R^{-1} \end{pmatrix}, \quad
    H = \sum_b J_b^T J_b / \kappa_b, \; B_s = \sum_b L_{sb}^T J_b / \kappa_b, \;
    D_s = \sum_b L_{sb}^T L_{sb} / \kappa_b,

as

.. math:: -2 l = \sum_b N_b \log \kappa_b + \log|C| + S \log|R| + r^T K^{-1} r - u^T C^{-1} u,
    \quad u = \Big( \sum_b J_b^T r / \kappa_b - J^T V^{-1} r, \; \sum_b L_b^T r / \kappa_b \Big),

at the optimum of a fit with any covariance V, where priors balance its gradient. The cost is linear
in the stops, since D is block diagonal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri

from pincal.identify.criteria import CRITERIA
from pincal.identify.drive_levers import drive_levers
from pincal.identify.fit import ModelFit
from pincal.identify.quadratic import ROUNDING, root_of_inverse
from pincal.identify.visit_numbers import VISITS
from pincal.thresholds import Count, Scale

# Variances are searched within these factors of that of the readings, as seen at the target.
_BOUNDS: tuple[Scale, Scale] = (1e-6, 1e8)
# Range of the readings' variance, in units of the estimated one, which includes the arrivals.
_QUIETEST: Scale = 1e-3
_LOUDEST: Scale = 4.0
# Standard deviation of parameters without a prior [m or rad].
_ANYWHERE: Scale = 10.0
# Stops that show the variances well enough; of more a sample is evaluated.
_MOST_STOPS: Count = 300
# Smallest eigenvalue of a scaled matrix, by rounding.
_ROUNDING: Scale = 1e-14
# What moves readings by less than a hundredth of their noise is none.
_NOTHING: Scale = 1e-4


@dataclass(frozen=True)
class StopSums:
    """What a station's residuals say of its S stops, by block of readings, in units of the
    estimated noise.

    Attributes:
        blocks: numbers of the blocks among those of all stations.
        information: shape (blocks, S, n, n), D.
        coupling: shape (blocks, S, n, P), B.
        slope: shape (blocks, S, n), L^T r.
        gradient: shape (blocks, P), J^T r.
        pull: shape (P,), the same of the rows of other stops, and of priors and other stations:
            these balance what the fit weighted.
        of_parameters: shape (blocks, P, P), H.
        beforehand: shape (P, P), what priors, the rows of other stops, and other stations say of
            the parameters.
        squares: shape (blocks,), r^T r.
        counts: shape (blocks,), numbers of readings.
    """

    blocks: range
    information: np.ndarray
    coupling: np.ndarray
    slope: np.ndarray
    gradient: np.ndarray
    pull: np.ndarray
    of_parameters: np.ndarray
    beforehand: np.ndarray
    squares: np.ndarray
    counts: np.ndarray

    @classmethod
    def of(
        cls, alone: ModelFit, blocks: slice, pose: np.ndarray, others: np.ndarray | None = None
    ) -> StopSums:
        """Return them of the only station of a fit.

        Args:
            alone: the fit, whose rows may share arrivals already.
            blocks: its blocks among those of all stations.
            pose: shape (N,), number of the pose of each row.
            others: shape (P, P), what other stations say of the free parameters; default: nothing.
        """
        station = alone.station
        free = alone.solution.free
        sound = alone.solution.weights > 0.0
        at = _sampled_stops(pose, sound)
        noise = np.repeat(alone.solution.estimated, station.block_sizes)[:, None]
        fitted = np.repeat(alone.solution.sigma, station.block_sizes)[:, None]
        levers = drive_levers(station, alone.values)
        sizes = np.minimum(alone.priors.sizes[free], _ANYWHERE)
        beforehand = np.diag(sizes**-2.0) + (0.0 if others is None else others)
        n_stops = int(at.max(initial=-1)) + 1
        found = cls._none(range(blocks.start, blocks.stop), n_stops, len(levers), beforehand)
        pull = found.pull
        for piece, residuals, J in station.linearise(alone.values, free):
            stop = at[piece]
            weighted = (station.weights[piece] / fitted) * sound[piece]
            both = station.uncorrelated(np.concatenate([J, residuals[None]]), piece) * weighted
            pull -= np.einsum("pmk,mk->p", both[:-1], both[-1])
            weights = (station.weights[piece] / noise) * sound[piece]
            residuals = residuals * weights
            J = J * weights
            L = levers[:, :, piece] * weights
            here = stop >= 0
            for b, rows in enumerate(station.block_rows):
                of_block = residuals[rows][:, here], J[:, rows][:, :, here], L[:, rows][:, :, here]
                found._add(b, stop[here], *of_block)
            beforehand += _gram(J[:, :, ~here])
            pull += np.einsum("pmk,mk->p", J[:, :, ~here], residuals[:, ~here])
        return found

    @classmethod
    def _none(cls, blocks: range, n_stops: int, n: int, beforehand: np.ndarray) -> StopSums:
        """Return the sums of no rows, for n drives."""
        B = len(blocks)
        P = len(beforehand)
        return cls(
            blocks=blocks,
            information=np.zeros((B, n_stops, n, n)),
            coupling=np.zeros((B, n_stops, n, P)),
            slope=np.zeros((B, n_stops, n)),
            gradient=np.zeros((B, P)),
            pull=np.zeros(P),
            of_parameters=np.zeros((B, P, P)),
            beforehand=beforehand,
            squares=np.zeros(B),
            counts=np.zeros(B),
        )

    def _add(self, b: int, stop: np.ndarray, r: np.ndarray, J: np.ndarray, L: np.ndarray) -> None:
        """Add the rows of a block, of the stops with these numbers, in place."""
        np.add.at(self.information[b], stop, np.einsum("imk,jmk->kij", L, L))
        np.add.at(self.coupling[b], stop, np.einsum("imk,pmk->kip", L, J))
        np.add.at(self.slope[b], stop, np.einsum("imk,mk->ki", L, r))
        self.gradient[b] += np.einsum("pmk,mk->p", J, r)
        self.of_parameters[b] += _gram(J)
        self.squares[b] += float(np.sum(r**2))
        self.counts[b] += r.size

    def misfit(self, rho: np.ndarray, kappa: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return -2 l, and its slopes by log rho, shape (n,), and by the log kappa of each block.

        Args:
            rho: shape (n,), variances of the drives.
            kappa: shape (blocks,), variances of the readings, in units of the estimated.
        """
        solved = _Solved.of(self, rho, kappa)
        by_kappa = [solved.slope_of_block(self, b) for b in range(len(kappa))]
        return solved.misfit, solved.slope_of_drives(), np.array(by_kappa)


def _sampled_stops(pose: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """Return the number of the stop of each row among a sample of those with sound rows, -1 for a
    row of none of these, shape (N,).
    """
    stops = np.unique(pose[sound])
    few = np.linspace(0, len(stops) - 1, min(_MOST_STOPS, len(stops))).round().astype(int)
    number = np.full(int(pose.max(initial=0)) + 1, -1)
    number[stops[few]] = np.arange(len(few))
    return np.where(sound, number[pose], -1)


@dataclass(frozen=True)
class _Solved:
    """The mixed model equations, solved for some variances.

    Attributes:
        rho: shape (n,), variances of the drives.
        kappa: shape (blocks,), variances of the readings.
        misfit: -2 l.
        inner: shape (S, n, n), (1 + R^(1/2) D R^(1/2))^-1, so that variances may vanish.
        M: shape (S, n, n), (D + R^-1)^-1.
        MB: shape (S, n, P), M B.
        inverse: shape (P, P), block of the parameters in the inverse of C.
        crossed: shape (S, n, P), minus its block of arrivals and parameters.
        z: shape (P,), most probable parameters.
        x: shape (S, n), most probable arrivals.
    """

    rho: np.ndarray
    kappa: np.ndarray
    misfit: float
    inner: np.ndarray
    M: np.ndarray
    MB: np.ndarray
    inverse: np.ndarray
    crossed: np.ndarray
    z: np.ndarray
    x: np.ndarray

    @classmethod
    def of(cls, sums: StopSums, rho: np.ndarray, kappa: np.ndarray) -> _Solved:
        """Return the solution, by eliminating the arrivals of each stop."""
        weight = 1.0 / kappa
        D = np.einsum("b,bsij->sij", weight, sums.information)
        B = np.einsum("b,bsip->sip", weight, sums.coupling)
        u = np.einsum("b,bsi->si", weight, sums.slope)
        H = np.einsum("b,bpq->pq", weight, sums.of_parameters) + sums.beforehand
        g = weight @ sums.gradient + sums.pull
        root = np.sqrt(rho)
        values, vectors = np.linalg.eigh(np.eye(len(rho)) + D * root[:, None] * root)
        inner = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
        M = inner * root[:, None] * root
        MB = M @ B
        inverse, log_det = _inverse(H - np.einsum("sip,siq->pq", B, MB, optimize=True))
        z = inverse @ (g - np.einsum("sip,si->p", MB, u))
        x = np.einsum("sij,sj->si", M, u) - MB @ z
        determinants = float(sums.counts @ np.log(kappa) + np.sum(np.log(values)) + log_det)
        squares = float(weight @ sums.squares - np.sum(u * x) - g @ z)
        return cls(rho, kappa, determinants + squares, inner, M, MB, inverse, MB @ inverse, z, x)

    def slope_of_drives(self) -> np.ndarray:
        """Return the slope of -2 l by log rho, shape (n,)."""
        second = self.x**2 + np.einsum("sip,sip->si", self.crossed, self.MB)
        relative = np.divide(second, self.rho, out=np.zeros_like(second), where=self.rho > 0.0)
        return np.asarray(np.sum(1.0 - np.einsum("sii->si", self.inner) - relative, axis=0))

    def slope_of_block(self, sums: StopSums, b: int) -> float:
        """Return the slope of -2 l by the log kappa of a block."""
        D = sums.information[b]
        B = sums.coupling[b]
        H = sums.of_parameters[b]
        trace = np.sum(self.inverse * H) - 2.0 * np.sum(self.crossed * B) + np.sum(self.M * D)
        trace += np.einsum("sip,sij,sjp->", self.crossed, D, self.MB, optimize=True)
        square = sums.squares[b] - 2.0 * (
            np.sum(self.x * sums.slope[b]) + self.z @ sums.gradient[b]
        )
        square += self.z @ H @ self.z + 2.0 * np.sum(self.x * (B @ self.z))
        square += np.einsum("si,sij,sj->", self.x, D, self.x)
        return float(sums.counts[b] - (trace + square) / self.kappa[b])


def information_of_stations(fit: ModelFit) -> list[np.ndarray]:
    """Return what the rows of each station say of the parameters that stations share, its own
    eliminated, shape (F, F) over all parameters of the fit.
    """
    shared = fit.problem.is_shared
    found = []
    for (station, places, _), alone in zip(fit.stations, fit.alone, strict=True):
        free = alone.solution.free
        sigma = np.repeat(alone.solution.sigma, station.block_sizes)[:, None]
        sound = alone.solution.weights > 0.0
        H = np.zeros((int(free.sum()),) * 2)
        for piece, _, J in station.linearise(alone.values, free):
            weights = (station.weights[piece] / sigma) * sound[piece]
            H += _gram(station.uncorrelated(J, piece) * weights)
        at = np.arange(len(fit.values))[places][free]
        own = ~shared[at]
        sizes = np.minimum(alone.priors.sizes[free][own], _ANYWHERE)
        of_own = H[np.ix_(own, own)] + np.diag(sizes**-2.0)
        # What readings do not tell of a station, such as where anchors and base stand together,
        # takes nothing from the robot; divided by next to nothing, its rounding took more than all.
        taken = H[np.ix_(~own, own)] @ root_of_inverse(of_own, np.diag(of_own), ROUNDING)
        whole = np.zeros((len(shared),) * 2)
        whole[np.ix_(at[~own], at[~own])] = H[np.ix_(~own, ~own)] - taken @ taken.T
        found.append(whole)
    return found


def _gram(J: np.ndarray) -> np.ndarray:
    """Return J J^T of a Jacobian, shape (P, m, n)."""
    flat = J.reshape(len(J), -1)
    return np.asarray(flat @ flat.T)


def _inverse(matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the inverse and the log of the determinant of a positive matrix, scaled first."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    values = np.maximum(values, _ROUNDING)
    inverse = (vectors / values) @ vectors.T / np.outer(size, size)
    return inverse, float(np.sum(np.log(values)) + 2.0 * np.sum(np.log(size)))


@dataclass(frozen=True)
class Variances:
    """Variances of drives and readings.

    Attributes:
        drives: shape (n,) [rad^2 or m^2].
        blocks: shape (blocks,), in units of the estimated noise.
        gain: of the first over drives that arrive exactly, in 2 log-likelihood.
    """

    drives: np.ndarray
    blocks: np.ndarray
    gain: float


def likeliest_arrivals(parts: Sequence[StopSums], n_blocks: int) -> Variances | None:
    """Return the likeliest variances of drives and readings; None where drives that do not arrive
    exactly explain nothing.

    Each station is seen with what the others say of the robot, weighted as in the fit.
    Few stops show the sum of what their drives miss better than that of each: drives arrive alike
    unless the readings say otherwise.
    """
    search = _Search.of(parts, n_blocks)
    if not len(search.scale):
        return None
    exactly = search.minimum(_Alike(search), np.array([search.low]), fixed=True)
    # Residuals are smaller than the noise where rows are weighted by too large arrivals already.
    start = np.log([np.mean(search.typical[search.seen])])
    alike = search.minimum(_Alike(search), start)
    if exactly.fun - alike.fun < CRITERIA.arrivals:
        return None
    start = _Alike(search).logs(alike.x[:1])
    each = search.minimum(_Each(search), start)
    is_unalike = alike.fun - each.fun > chdtri(max(len(start) - 1, 1), CRITERIA.unalike)
    best = each if len(start) > 1 and is_unalike else alike
    logs = start if best is alike else each.x[: len(start)]
    return search.variances(logs, best.x, gain=float(exactly.fun - best.fun))


@dataclass(frozen=True)
class _Search:
    """Over the logs of variances, of drives in units in which they move readings by their noise.

    Attributes:
        parts: the stations.
        moves: shape (n,), which drives move readings at all.
        scale: shape (k,), mean square by which each of these moves a reading in units of its noise.
        most: shape (k,), largest logs: more than drives scatter by is an error of the model, which
            is for an effect to explain.
        seen: shape (blocks,), which blocks have readings.
        typical: shape (blocks,), mean squares of residuals, in units of the estimated noise.
    """

    parts: Sequence[StopSums]
    moves: np.ndarray
    scale: np.ndarray
    most: np.ndarray
    seen: np.ndarray
    typical: np.ndarray
    low: ClassVar[float] = float(np.log(_BOUNDS[0]))

    @classmethod
    def of(cls, parts: Sequence[StopSums], n_blocks: int) -> _Search:
        counts = np.zeros(n_blocks)
        squares = np.zeros(n_blocks)
        for part in parts:
            counts[list(part.blocks)] += part.counts
            squares[list(part.blocks)] += part.squares
        lengths = np.sum([np.einsum("bsii->i", part.information) for part in parts], axis=0)
        scale = lengths[lengths > 0.0] / max(counts.sum(), 1.0)
        most = np.clip(np.log(VISITS.arrival**2 * scale), *np.log(_BOUNDS))
        typical = np.maximum(squares, 1e-300) / np.maximum(counts, 1.0)
        return cls(parts, lengths > 0.0, scale, most, counts > 0.0, typical)

    def misfit(
        self, logs: np.ndarray, of_blocks: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return -2 l of all stations and its slopes by both."""
        rho = np.zeros(len(self.moves))
        rho[self.moves] = np.exp(logs) / self.scale
        kappa = np.ones(len(self.seen))
        kappa[self.seen] = np.exp(of_blocks)
        total = 0.0
        by_rho = np.zeros(len(rho))
        by_kappa = np.zeros(len(kappa))
        for part in self.parts:
            own = list(part.blocks)
            value, of_drives, of_own = part.misfit(rho, kappa[own])
            total += value
            by_rho += of_drives
            by_kappa[own] += of_own
        return total, by_rho[self.moves], by_kappa[self.seen]

    def minimum(self, drives: _Alike | _Each, start: np.ndarray, *, fixed: bool = False) -> Any:
        """Return SciPy's result for the variables of the drives and then the logs of the blocks,
        those of the drives held at their start if ``fixed``.
        """
        k = len(start)
        limits = drives.limits
        start = np.clip(start, *np.array(limits).T)
        if fixed:
            limits = [(value, value) for value in start]

        def function(vector: np.ndarray) -> tuple[float, np.ndarray]:
            total, by_rho, by_kappa = self.misfit(drives.logs(vector[:k]), vector[k:])
            return total, np.append(drives.slopes(vector[:k], by_rho), by_kappa)

        blocks = [(float(np.log(_QUIETEST)), float(np.log(_LOUDEST)))] * int(self.seen.sum())
        typical = np.clip(np.log(self.typical[self.seen]), *blocks[0])
        return minimize(
            function,
            np.append(start, typical),
            jac=True,
            method="L-BFGS-B",
            bounds=[*limits, *blocks],
        )

    def variances(self, logs: np.ndarray, vector: np.ndarray, *, gain: float) -> Variances:
        """Return the variances of a minimum."""
        drives = np.zeros(len(self.moves))
        found = np.exp(logs)
        least = _NOTHING * np.mean(self.typical[self.seen])
        drives[self.moves] = np.where(found < least, 0.0, found / self.scale)
        blocks = np.ones(len(self.seen))
        blocks[self.seen] = np.exp(vector[len(vector) - int(self.seen.sum()) :])
        return Variances(drives, blocks, gain)


@dataclass(frozen=True)
class _Each:
    """A variance of each drive."""

    search: _Search

    @property
    def limits(self) -> list[tuple[float, float]]:
        return [(self.search.low, float(most)) for most in self.search.most]

    def logs(self, own: np.ndarray) -> np.ndarray:
        """Return the logs of the drives' variances."""
        return own

    def slopes(self, own: np.ndarray, by_logs: np.ndarray) -> np.ndarray:
        """Return slopes by its variables."""
        return by_logs


@dataclass(frozen=True)
class _Alike:
    """One variance of all drives [rad^2, prismatic m^2], that of a typical lever."""

    search: _Search

    @property
    def _relative(self) -> np.ndarray:
        scale = self.search.scale
        return np.asarray(np.log(scale / np.median(scale)))

    @property
    def limits(self) -> list[tuple[float, float]]:
        relative = self._relative
        low = self.search.low - float(relative.max())
        return [(low, float(np.max(self.search.most - relative)))]

    def logs(self, own: np.ndarray) -> np.ndarray:
        """Return the logs of the drives' variances."""
        return np.asarray(np.clip(own[0] + self._relative, self.search.low, self.search.most))

    def slopes(self, own: np.ndarray, by_logs: np.ndarray) -> np.ndarray:
        """Return slopes by its variable."""
        logs = own[0] + self._relative
        is_free = (self.search.low < logs) & (logs < self.search.most)
        return np.array([np.sum(by_logs[is_free])])
