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

from pincal.identify.criteria import CHANGES
from pincal.identify.fit import ModelFit
from pincal.identify.normal import accumulate
from pincal.identify.posterior import Posterior, eliminate
from pincal.identify.quadratic import Form, Quadratic
from pincal.identify.selection import Scored, select_stepwise
from pincal.model.effect import Family
from pincal.parameters import Parameter
from pincal.validate.outcome import MovedParameter

# Part of a parameter's information that the station's own ones must leave, for the station to tell of it.
_SEEN = 1e-4
# Part of a value's information that is added to it, well above rounding and far below what matters.
_ROUNDING = 1e-8
# What is well above the error of an eigenvalue that came out negative, over its size.
_BEYOND_ROUNDING = 10.0
# Parameters released at most, and stations beyond which none is looked for: work and memory grow with their square.
_MOST, _MOST_STATIONS = 6, 100


@dataclass(frozen=True)
class StationInformation:
    """What the rows of a station say of the C parameters of the robot that are free, its own ones eliminated.

    Attributes:
        form: their squares, in units of the noise.
        places: shape (C,), where these stand among all that are shared and free.
        own_spent: number of parameters that the station spends on its own ones.
    """

    form: Quadratic
    places: np.ndarray
    own_spent: float

    @property
    def noise_squared(self) -> float:
        """Square of the noise of the station's rows, whatever the robot is there, in units of that of the fit.

        1 unless it is smaller than chance allows: a fit takes for noise what it can't follow.
        """
        gain, rank = self.form.gain(np.arange(len(self.places)), _SEEN)
        square, degrees = self.form.square - gain, self.form.degrees - rank
        return max(square, 1e-12) / degrees if degrees > 0 and chdtr(degrees, square) < CHANGES.too_quiet else 1.0


@dataclass(frozen=True)
class _StationsInformation:
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
        own = [np.flatnonzero(self.seen[:, p]) for p in chosen]
        station, parameter = np.concatenate(own), np.repeat(chosen, list(map(len, own)))
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


def moves_of(fit: ModelFit) -> tuple[tuple[MovedParameter, ...], ...]:
    """Return, for each of several stations, those parameters of the robot that are not the same at all of them."""
    n = len(fit.problem.stations)
    own = [list(_of_station(fit, k)) for k in range(n)]
    if n > _MOST_STATIONS:
        return tuple(map(tuple, own))
    shared = shared_places(fit)
    told = _information_of(fit, shared)
    chosen = _moved(told)
    if chosen:
        station, parameter, values, covariance = told.released(chosen)
        for p in chosen:
            rows = np.flatnonzero(parameter == p)
            for k, change, sigma, moved in _course(station[rows], values[rows], covariance[np.ix_(rows, rows)]):
                own[k].append(_entry(fit.problem.parameters[shared[p]], change, sigma, moved))
    return tuple(map(tuple, own))


def _information_of(fit: ModelFit, shared: np.ndarray) -> _StationsInformation:
    problem, solution, F = fit.problem, fit.solution, len(shared)
    K = len(problem.stations)
    G, g, seen = np.zeros((K, F, F)), np.zeros((K, F)), np.zeros((K, F), bool)
    for k in range(K):
        rows, blocks, station = problem.rows[k], problem.block_spans[k], problem.stations[k]
        if station.serial is not None and station.sensor.reads_place and station.conditions.are_in_motion:
            # What the model lacks follows the motion, which is another one at each station.
            continue
        weights = solution.weights[rows]
        # So many rows do not contradict the robot by mistake: it is another one there.
        weights = weights if np.mean(weights == 0.0) <= CHANGES.wrong_rows else np.ones_like(weights)
        said = information_at(fit, k, weights)
        declared = fit.noise.declared[blocks.start] or 0.0
        at, noise = said.places, max(said.noise_squared, (declared / solution.sigma[blocks.start]) ** 2)
        G[k][np.ix_(at, at)], g[k, at] = said.form.H / noise, said.form.g / noise
        seen[k, at] = np.diag(said.form.H) > _SEEN * said.form.whole
    model, _ = fit.arm
    zeros = (e for e in model.effects if e.family is Family.GEOMETRY and e.locus.acts_on == "drive")
    of_drives = {p.name for effect in zeros for p in effect.parameters(model.chain)}
    usual = np.array([problem.parameters[place].name in of_drives for place in shared], bool)
    sizes, offsets = fit.priors.sizes[shared], fit.values[shared]
    found = Posterior(Form.of(G.sum(axis=0), g.sum(axis=0)), sizes, offsets)
    return _StationsInformation(
        G, g - G @ found.step, seen & np.isfinite(sizes), found.covariance, CHANGES.wide * sizes, usual
    )


def information_at(fit: ModelFit, k: int, weights: np.ndarray | None = None) -> StationInformation:
    """Return what a station says of the robot; with weights of its rows, shape (N,), other than those of the fit."""
    problem, solution = fit.problem, fit.solution
    station, places, blocks = problem.stations[k], problem.places[k], problem.block_spans[k]
    free, values = solution.free[places], solution.values[places]
    weights = solution.weights[problem.rows[k]] if weights is None else weights
    normal = accumulate(station, values, free, weights)
    is_own, form = station.is_own[free], normal.at(solution.sigma[blocks])
    left, own = eliminate(form, is_own, fit.priors.sizes[places][free], values[free])
    spent, step = float(np.sum(own.alone.frame_rank + own.alone.has_prior.sum())), own.alone.step
    square = float(normal.squares.blocks @ solution.sigma[blocks] ** -2.0 - step @ own.alone.form.H @ step)
    square -= float(own.precision @ step**2)
    readings = float(np.sum(weights > 0.0) * station.reading_size)
    shared = shared_places(fit)
    at = np.searchsorted(shared, places[free][~is_own])
    names = tuple(problem.parameters[place].name for place in shared[at])
    found = Quadratic(**vars(left), names=names, square=square, degrees=readings - spent)
    return StationInformation(found, at, spent)


def shared_places(fit: ModelFit) -> np.ndarray:
    """Return the places of the robot's parameters that are free, shape (F,)."""
    robots = fit.problem.is_shared & fit.solution.free
    for station, places in zip(fit.problem.stations, fit.problem.places, strict=True):
        # A station that is alone shares all.
        robots[places[station.is_own]] = False
    return np.flatnonzero(robots)


def spent_at(fit: ModelFit, k: int) -> float:
    """Return how many parameters the rows of a station pay for: its own ones, and its part of the robot's."""
    said = information_at(fit, k)
    covariance = fit.solution.known.covariance[np.ix_(said.places, said.places)]
    return said.own_spent + float(np.sum(said.form.H * covariance))


def _moved(told: _StationsInformation) -> tuple[int, ...]:
    """Return the parameters that are not the same at all stations, the one that explains most first."""
    candidates = [p for p in range(told.G.shape[1]) if told.seen[:, p].sum() > 1]

    def gains(chosen: tuple[int, ...]) -> Iterator[Scored[int]]:
        before = told.gain(chosen)
        for p in (p for p in candidates if p not in chosen):
            gain = told.gain([*chosen, p]) - before
            chance = chdtrc(told.seen[:, p].sum() - 1, gain)
            yield Scored(p, -gain - CHANGES.usual * told.usual[p], chance < CHANGES.moved / len(candidates))

    return select_stepwise((), gains, lambda chosen, p: (*chosen, p), most=_MOST)


def _course(station: np.ndarray, values: np.ndarray, covariance: np.ndarray) -> Iterator[tuple[int, float, float, bool]]:
    """Yield station, change since the first, its standard deviation, and whether it came since the station before."""
    yield int(station[0]), 0.0, 0.0, False
    own = np.diag(covariance)
    for i in range(1, len(station)):
        since = np.array([0, i - 1])
        variance = np.maximum(own[since] + own[i] - 2.0 * covariance[since, i], 1e-300)
        change, step = values[i] - values[since]
        moved = chdtrc(1, step**2 / variance[1]) < CHANGES.moved / (len(station) - 1)
        yield int(station[i]), float(change), float(np.sqrt(variance[0])), bool(moved)


def _of_station(fit: ModelFit, k: int) -> Iterator[MovedParameter]:
    """Yield what the model itself has of a joint at a station alone."""
    station, places = fit.problem.stations[k], fit.problem.places[k]
    model, sigma = station.model, fit.estimate.fitted_sigma
    for effect, span in zip(model.effects, model.spans, strict=True):
        if effect.locus.station is not None and effect.locus.joint is not None:
            for local in range(span.start, span.stop):
                place = places[local]
                yield _entry(model.parameters[local], float(fit.values[place]), float(sigma[place]), True)


def _entry(parameter: Parameter, change: float, sigma: float, moved: bool) -> MovedParameter:
    return {"name": parameter.name, "unit": parameter.unit, "change": change, "sigma": sigma, "moved": moved}
