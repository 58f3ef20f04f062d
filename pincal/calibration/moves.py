r"""What moved on a robot from station to station, told from a fit in which it is the same at all of them.

Of station k, with its own parameters eliminated, G_k and g_k are what its rows say of the robot's. If some of these were a
value of their own at each station, off the common one by d_k, these would have the information and the gradient

.. math:: M_{kl} = \delta_{kl} G_k - G_k C G_l, \qquad b_k = g_k,

in the rows and columns of these parameters, with C the covariance of the fit, and would take :math:`b^T M^{-1} b` off the
squares: chi-square with one degree of freedom less than there are stations, if nothing moved. The parameter that explains
most is released first, the others are asked for again beside it, until none is more than chance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtr, chdtrc

from pincal.identify.fit import Fit
from pincal.identify.normal import accumulate
from pincal.identify.posterior import Contribution, eliminate, posterior
from pincal.model.effect import Effect, Family
from pincal.parameters import Parameter

# Chance that anything is said to have moved on a robot that is the same at all stations.
_ALPHA = 0.01
# Part of a parameter's information that the station's own ones must leave, for the station to tell of it.
_SEEN = 1e-4
# Part of a value's information that is added to it, well above rounding and far below what matters.
_ROUNDING = 1e-8
# What is well above the error of an eigenvalue that came out negative, over its size.
_BEYOND_ROUNDING = 10.0
# How far values of stations may be apart, in sizes that are typical of the parameter: as good as any.
_WIDE = 30.0
# Part of a station's rows up to which those that were rejected are taken for wrong readings.
_OUTLIERS = 0.05
# Chance of as little noise as a station shows by itself below which the fit has taken something else for noise.
_UNLIKELY = 1e-3
# How much likelier it is that a drive lost its zero than that anything else moved, before any row is seen: -2 log odds.
_USUAL = 2.0 * np.log(10.0)
# Parameters released at most, and stations beyond which none is looked for: work and memory grow with their square.
_MOST, _MOST_STATIONS = 6, 100


@dataclass(frozen=True)
class Move:
    """What a parameter of the robot is at a station.

    Attributes:
        parameter: the parameter.
        change: by how much it is other than at the first station that tells; what a model has of a station alone: its value.
        sigma: standard deviation of the change.
        moved: whether it is another than at the station before, more surely than by chance.
    """

    parameter: Parameter
    change: float
    sigma: float
    moved: bool


@dataclass(frozen=True)
class Said:
    """What the rows of a station say of the C parameters of the robot that are free.

    Attributes:
        places: shape (C,), where these stand among all that are shared and free.
        left: what is left with the station's own parameters eliminated.
        whole: shape (C,), the diagonal of their information before that.
        square: sum of squares of the readings in units of their noise.
        readings: number of readings.
    """

    places: np.ndarray
    left: Contribution
    whole: np.ndarray
    square: float
    readings: float

    @property
    def own_spent(self) -> float:
        """Number of parameters that the station spends on its own ones."""
        return float(np.sum(self.left.alone.frame_rank + self.left.alone.has_prior.sum()))

    @property
    def noise_squared(self) -> float:
        """Square of the noise of the station's rows, whatever the robot is there, in units of that of the fit.

        1 unless it is smaller than chance allows: a fit takes for noise what it can't follow.
        """
        values, vectors = np.linalg.eigh(self.left.G * np.outer(scale := np.maximum(self.whole, 1e-300) ** -0.5, scale))
        seen = values > _SEEN
        along = vectors[:, seen].T @ (scale * self.left.g) / np.sqrt(values[seen])
        own = self.left.alone.step @ self.left.information @ self.left.alone.step
        degrees = self.readings - self.own_spent - int(seen.sum())
        square = self.square - float(along @ along) - float(own)
        return max(square, 1e-12) / degrees if degrees > 0 and chdtr(degrees, square) < _UNLIKELY else 1.0


@dataclass(frozen=True)
class _Told:
    """What K stations say of the robot's F parameters.

    Attributes:
        G: shape (K, F, F).
        b: shape (K, F), what is left of the gradients once the fit has moved to where these rows want it.
        seen: shape (K, F), whether a station tells of a parameter.
        C: shape (F, F), covariance of a fit of these rows.
        widths: shape (F,), how far values of stations may be apart.
        usual: shape (F,), whether a parameter is what moves first: the zero of a drive.
    """

    G: np.ndarray
    b: np.ndarray
    seen: np.ndarray
    C: np.ndarray
    widths: np.ndarray
    usual: np.ndarray

    def released(self, chosen: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return station and parameter of each value of its own, shape (n,), these values, and their covariance."""
        station, parameter = (np.concatenate(part) for part in zip(*(self._where(p) for p in chosen), strict=True))
        U = self.G[station, parameter]
        M = -U @ self.C @ U.T + np.where(station[:, None] == station, U[:, parameter], 0.0)
        # What moves at all stations alike is the fit's own: nothing but rounding is left of it here.
        information = U[np.arange(len(U)), parameter]
        M.flat[:: len(M) + 1] += self.widths[parameter] ** -2.0 + _ROUNDING * information
        covariance = _inverse(M, np.sqrt(information))
        return station, parameter, covariance @ self.b[station, parameter], covariance

    def gain(self, chosen: Sequence[int]) -> float:
        """Return what values of their own take off the squares."""
        if not chosen:
            return 0.0
        station, parameter, values, _ = self.released(chosen)
        return float(values @ self.b[station, parameter])

    def _where(self, p: int) -> tuple[np.ndarray, np.ndarray]:
        station = np.flatnonzero(self.seen[:, p])
        return station, np.full(len(station), p)


def _inverse(M: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the inverse of a matrix that is positive definite up to rounding, which grows with the parameters of a fit.

    Args:
        M: shape (n, n).
        scale: shape (n,), roots of the diagonal of the terms that M is a small difference of.
    """
    values, vectors = np.linalg.eigh(M / np.outer(scale, scale))
    values = np.maximum(values, max(_ROUNDING, -_BEYOND_ROUNDING * values[0]))
    spread = vectors / scale[:, None]
    return np.asarray((spread / values) @ spread.T)


def moves_of(fit: Fit) -> tuple[tuple[Move, ...], ...]:
    """Return, for each of several stations, those parameters of the robot that are not the same at all of them."""
    n = len(fit.problem.stations)
    own = [list(_of_station(fit, k)) for k in range(n)]
    if n > _MOST_STATIONS:
        return tuple(map(tuple, own))
    shared = np.flatnonzero(fit.solution.free & fit.problem.is_shared)
    told = _told(fit, shared)
    chosen = _moved(told)
    if chosen:
        station, parameter, values, covariance = told.released(chosen)
        for p in chosen:
            rows = np.flatnonzero(parameter == p)
            for k, change, sigma, moved in _course(station[rows], values[rows], covariance[np.ix_(rows, rows)]):
                own[k].append(Move(fit.problem.parameters[shared[p]], change, sigma, moved))
    return tuple(map(tuple, own))


def _told(fit: Fit, shared: np.ndarray) -> _Told:
    problem, solution, F = fit.problem, fit.solution, len(shared)
    K = len(problem.stations)
    G, g, seen = np.zeros((K, F, F)), np.zeros((K, F)), np.zeros((K, F), bool)
    for k in range(K):
        rows, blocks = problem.rows[k], problem.block_spans[k]
        weights = solution.weights[rows]
        # So many rows do not contradict the robot by mistake: it is another one there.
        weights = weights if np.mean(weights == 0.0) <= _OUTLIERS else np.ones_like(weights)
        said = said_at(fit, k, weights)
        declared = fit.noise.declared[blocks.start] or 0.0
        at, noise = said.places, max(said.noise_squared, (declared / solution.sigma[blocks.start]) ** 2)
        G[k][np.ix_(at, at)], g[k, at] = said.left.G / noise, said.left.g / noise
        seen[k, at] = np.diag(said.left.G) > _SEEN * said.whole
    model, _ = fit.arm
    of_drives = {p.name for e in model.effects if _is_usual(e) for p in e.parameters(model.chain)}
    usual = np.array([problem.parameters[place].name in of_drives for place in shared], bool)
    sizes, offsets = fit.priors.sizes[shared], fit.values[shared]
    found = posterior(G.sum(axis=0), g.sum(axis=0), sizes, offsets)
    return _Told(G, g - G @ found.step, seen & np.isfinite(sizes), found.covariance, _WIDE * sizes, usual)


def _is_usual(effect: Effect) -> bool:
    return effect.family is Family.GEOMETRY and effect.locus.acts_on == "drive"


def said_at(fit: Fit, k: int, weights: np.ndarray | None = None) -> Said:
    """Return what a station says of the robot; with weights of its rows, shape (N,), other than those of the fit."""
    problem, solution = fit.problem, fit.solution
    station, places, blocks = problem.stations[k], problem.places[k], problem.block_spans[k]
    free, values = solution.free[places], solution.values[places]
    weights = solution.weights[problem.rows[k]] if weights is None else weights
    normal = accumulate(station, values, free, weights)
    own = ~problem.is_shared[places][free]
    G, g = normal.at(solution.sigma[blocks])
    left = eliminate(G, g, own, fit.priors.sizes[places][free], values[free])
    at = np.searchsorted(np.flatnonzero(solution.free & problem.is_shared), places[free][~own])
    square = float(normal.squares @ solution.sigma[blocks] ** -2.0)
    readings = float(np.sum(weights > 0.0) * sum(block.size for block in station.sensor.blocks))
    return Said(at, left, np.diag(G)[~own], square, readings)


def spent_at(fit: Fit, k: int) -> float:
    """Return how many parameters the rows of a station pay for: its own ones, and its part of the robot's."""
    said = said_at(fit, k)
    covariance = fit.solution.posterior.covariance[np.ix_(said.places, said.places)]
    return said.own_spent + float(np.sum(said.left.G * covariance))


def _moved(told: _Told) -> list[int]:
    """Return the parameters that are not the same at all stations, the one that explains most first."""
    candidates = [p for p in range(told.G.shape[1]) if told.seen[:, p].sum() > 1]
    chosen: list[int] = []
    while len(chosen) < _MOST:
        before = told.gain(chosen)
        gains = {p: told.gain([*chosen, p]) - before for p in candidates if p not in chosen}
        best = max(gains, key=lambda p: gains[p] + _USUAL * told.usual[p], default=None)
        if best is None or chdtrc(told.seen[:, best].sum() - 1, gains[best]) >= _ALPHA / len(candidates):
            break
        chosen.append(best)
    return chosen


def _course(station: np.ndarray, values: np.ndarray, covariance: np.ndarray) -> Iterator[tuple[int, float, float, bool]]:
    """Yield station, change since the first, its standard deviation, and whether it came since the station before."""
    yield int(station[0]), 0.0, 0.0, False
    for i in range(1, len(station)):
        (change, variance), (step, of_step) = (_between(j, i, values, covariance) for j in (0, i - 1))
        moved = chdtrc(1, step**2 / of_step) < _ALPHA / (len(station) - 1)
        yield int(station[i]), change, float(np.sqrt(variance)), bool(moved)


def _between(i: int, j: int, values: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Return the difference of two values and its variance."""
    variance = covariance[i, i] + covariance[j, j] - 2.0 * covariance[i, j]
    return float(values[j] - values[i]), float(max(variance, 1e-300))


def _of_station(fit: Fit, k: int) -> Iterator[Move]:
    """Yield what the model itself has of a joint at a station alone."""
    station, places = fit.problem.stations[k], fit.problem.places[k]
    model, sigma = station.model, fit.estimate.fitted_sigma
    for effect, span in zip(model.effects, model.spans, strict=True):
        if effect.locus.station is not None and effect.locus.joint is not None:
            for local in range(span.start, span.stop):
                place = places[local]
                yield Move(model.parameters[local], float(fit.values[place]), float(sigma[place]), moved=True)
