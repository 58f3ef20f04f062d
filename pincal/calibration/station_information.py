r"""What each of several stations says of the robot, and how far what it wants is from what all of them have.

Of station k, with its own parameters eliminated, G_k and g_k are what its rows say of the robot's. If some of these were a
value of their own at each station, off the common one by d_k, these would have the information and the gradient

.. math:: M_{kl} = \delta_{kl} G_k - G_k C G_l, \qquad b_k = g_k,

in the rows and columns of these parameters, with C the covariance of the fit, and would take :math:`b^T M^{-1} b` off the
squares: chi-square with one degree of freedom less than there are stations, if nothing moved.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import chdtr, chdtrc, fdtrc

from pincal.identify.criteria import CHANGES
from pincal.identify.fit import ModelFit, Priors
from pincal.identify.normal import accumulate
from pincal.identify.posterior import Posterior, eliminate
from pincal.identify.problem import extended
from pincal.identify.quadratic import Form, Quadratic
from pincal.identify.selection import Scored, select_stepwise
from pincal.model.effect import Effect, Family
from pincal.parameters import Parameter

# Part of a parameter's information that the station's own ones must leave, for the station to tell of it.
_SEEN = 1e-4
# Part of a value's information that is added to it, well above rounding and far below what matters.
_ROUNDING = 1e-8
# What is well above the error of an eigenvalue that came out negative, over its size.
_BEYOND_ROUNDING = 10.0
# Groups released at most: work and memory grow with their square.
_MOST = 6

Together = tuple[int, ...]
"""Places of parameters that move together."""


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
class SharedInformation:
    """What each of K stations says of the F parameters that they share, its own ones eliminated, in units of the noise.

    Attributes:
        parameters: the F parameters.
        G: shape (K, F, F).
        g: shape (K, F).
        whole: shape (K, F), the diagonal of G before anything was eliminated.
        sizes, offsets: shape (F,), of their priors, and how far they are off the nominal.
        usual: shape (F,), whether a parameter is what moves first: the zero of a drive.
        lasting: shape (F,), whether it never moves.
    """

    parameters: tuple[Parameter, ...]
    G: np.ndarray
    g: np.ndarray
    whole: np.ndarray
    sizes: np.ndarray
    offsets: np.ndarray
    usual: np.ndarray
    lasting: np.ndarray

    @classmethod
    def of(cls, fit: ModelFit, parts: int = 1, *, in_order: bool = False) -> Self:
        """Return what the stations of a fit say, of each so many parts, one after the other.

        A part is every so-manieth row, or rows in order.
        """
        problem, solution, shared = fit.problem, fit.solution, shared_places(fit)
        K, F = parts * len(problem.stations), len(shared)
        G, g, whole = np.zeros((K, F, F)), np.zeros((K, F)), np.zeros((K, F))
        for k, station in enumerate(problem.stations):
            rows, blocks = problem.rows[k], problem.block_spans[k]
            if station.serial is not None and station.sensor.reads_place and station.conditions.are_in_motion:
                # What the model lacks follows the motion, which is another one at each station.
                continue
            weights = solution.weights[rows]
            # So many rows do not contradict the robot by mistake: it is another one there.
            weights = weights if np.mean(weights == 0.0) <= CHANGES.wrong_rows else np.ones_like(weights)
            every = np.arange(len(weights))
            split = np.array_split(every, parts) if in_order else [every[i::parts] for i in range(parts)]
            said = [information_at(fit, k, weights, rows=None if parts == 1 else some) for some in split]
            together = replace(said[0], form=sum((one.form for one in said[1:]), start=said[0].form))
            declared = fit.noise.declared[blocks.start] or 0.0
            noise = max(together.noise_squared, (declared / solution.sigma[blocks.start]) ** 2)
            for i, one in enumerate(said, start=parts * k):
                at, form = one.places, one.form
                G[i][np.ix_(at, at)], g[i, at], whole[i, at] = form.H / noise, form.g / noise, form.whole / noise
        model, _ = fit.arm
        zeros = (e for e in model.effects if e.family is Family.GEOMETRY and e.locus.acts_on == "drive")
        lasting = (e for e in model.effects if e.stays)
        parameters = tuple(problem.parameters[place] for place in shared)
        marks = ({p.name for effect in some for p in effect.parameters(model.chain)} for some in (zeros, lasting))
        marked = (np.array([parameter.name in names for parameter in parameters], bool) for names in marks)
        return cls(parameters, G, g, whole, fit.priors.sizes[shared], fit.values[shared], *marked)

    def joined(self, parts: int) -> Self:
        """Return what so many parts of each station say as one."""
        G, g, whole = (of.reshape(-1, parts, *of.shape[1:]).sum(axis=1) for of in (self.G, self.g, self.whole))
        return replace(self, G=G, g=g, whole=whole)

    def together(self, T: np.ndarray) -> StationsInformation:
        """Return it about a fit of all stations by n parameters, T times which are these; T of shape (F, n), orthonormal."""
        main = np.abs(T).argmax(axis=0)
        G, g, sizes = T.T @ self.G @ T, self.g @ T, self.sizes[main]
        whole = Form.of(G.sum(axis=0), g.sum(axis=0))
        found = Posterior(whole, sizes, self.offsets @ T)
        seen = np.diagonal(G, axis1=1, axis2=2) > _SEEN * (self.whole @ T**2)
        b, seen, explained = g - G @ found.step, seen & np.isfinite(sizes) & ~self.lasting[main], float(whole.g @ found.step)
        return StationsInformation(G, b, seen, found.covariance, CHANGES.wide * sizes, self.usual[main], explained)


@dataclass(frozen=True)
class StationsInformation:
    """What K stations say of the robot's F parameters.

    Attributes:
        G: shape (K, F, F).
        b: shape (K, F), what is left of the gradients once the fit has moved to where these rows want it.
        seen: shape (K, F), whether a station tells of a parameter that may move.
        C: shape (F, F), covariance of a fit of these rows.
        widths: shape (F,), how far values of stations may be apart.
        usual: shape (F,), whether a parameter is what moves first: the zero of a drive.
        explained: what the fit takes off the squares by that.
    """

    G: np.ndarray
    b: np.ndarray
    seen: np.ndarray
    C: np.ndarray
    widths: np.ndarray
    usual: np.ndarray
    explained: float = 0.0

    def released(self, chosen: Sequence[Together]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return station and parameter of each value of its own, shape (n,), these values, and their covariance."""
        flat = [p for group in chosen for p in group]
        own = [np.flatnonzero(self.seen[:, p]) for p in flat]
        station, parameter = np.concatenate(own), np.repeat(flat, list(map(len, own)))
        U = self.G[station, parameter]
        M = -U @ self.C @ U.T + np.where(station[:, None] == station, U[:, parameter], 0.0)
        # What moves at all stations alike is the fit's own: nothing but rounding is left of it here.
        information = U[np.arange(len(U)), parameter]
        M.flat[:: len(M) + 1] += self.widths[parameter] ** -2.0 + _ROUNDING * information
        covariance = _inverse(M, np.sqrt(information))
        return station, parameter, covariance @ self.b[station, parameter], covariance

    def gain(self, chosen: Sequence[Together]) -> float:
        """Return what values of their own take off the squares."""
        if not chosen:
            return 0.0
        station, parameter, values, _ = self.released(chosen)
        return float(values @ self.b[station, parameter])

    def degrees(self, group: Together) -> int:
        """Return how many values of their own a group has beyond those that are common to the stations."""
        return int(np.maximum(self.seen[:, list(group)].sum(axis=0) - 1, 0).sum())

    def moved(
        self, candidates: Sequence[Together], *, price: float = 0.0, apart: Apart | None = None
    ) -> tuple[Together, ...]:
        """Return what is not the same at all stations, what explains most first, then what explains most beside it.

        Args:
            candidates: groups of parameters that may have moved.
            price: what each value that is released costs.
            apart: what parts of each station say; default: what stations say has the noise that it is said to have.
        """
        tried = [group for group in candidates if self.degrees(group)]

        def scores(chosen: tuple[Together, ...]) -> Iterator[Scored[Together]]:
            before = self.gain(chosen)
            for group in (group for group in tried if group not in chosen):
                gain, degrees = self.gain((*chosen, group)) - before, self.degrees(group)
                noise, known = (1.0, np.inf) if apart is None else apart.noise(chosen, group)
                chance = chdtrc(degrees, gain) if np.isinf(known) else fdtrc(degrees, known, gain / noise / degrees)
                cost = price * degrees - gain / noise - CHANGES.usual * self.usual[group[0]]
                yield Scored(group, cost, chance < CHANGES.moved / len(tried))

        return select_stepwise((), scores, lambda chosen, group: (*chosen, group), most=_MOST)

    def own_values(self, chosen: Sequence[Together], group: Together) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the s stations that see all of a group of n parameters, among those chosen, and what these are there.

        Returns:
            The stations, shape (s,), the values, shape (s, n), and their covariance, shape (s, n, s, n).
        """
        station, parameter, values, covariance = self.released(chosen)
        seeing = np.flatnonzero(self.seen[:, list(group)].all(axis=1))
        place = {(int(k), int(p)): i for i, (k, p) in enumerate(zip(station, parameter, strict=True))}
        at = np.array([[place[int(k), p] for p in group] for k in seeing], int).reshape(len(seeing), len(group))
        return seeing, values[at], covariance[at[:, :, None, None], at]


@dataclass(frozen=True)
class Apart:
    """What stations say, and what parts of each of them say.

    Attributes:
        joined: what stations say.
        parts: what parts of them say.
    """

    joined: StationsInformation
    parts: StationsInformation

    @classmethod
    def of(cls, said: SharedInformation, T: np.ndarray, parts: int) -> Self:
        """Return what so many parts of each station say by parameters T times which are those of what is said."""
        return cls(said.joined(parts).together(T), said.together(T))

    def noise(self, chosen: Sequence[Together], group: Together) -> tuple[float, float]:
        """Return the square of the noise by which a group differs between parts of one station, and its degrees of freedom.

        What a model lacks errs in directions of its own, for many rows in a row, and more so there than residuals do on
        average. Noise that is no larger than chance allows is 1.

        Args:
            chosen: what moved besides.
            group: the group.
        """
        both, degrees = (*chosen, group), self.parts.degrees(group) - self.joined.degrees(group)
        if degrees < 1:
            return 1.0, np.inf
        gain = self.parts.gain(both) - self.parts.gain(chosen) - self.joined.gain(both) + self.joined.gain(chosen)
        return (gain / degrees, degrees) if chdtrc(degrees, gain) < CHANGES.uneven else (1.0, np.inf)


def difference(covariance: np.ndarray, i: int, j: int) -> np.ndarray:
    """Return the covariance of values at one station less those at another, shape (n, n), of theirs, (s, n, s, n)."""
    C = covariance[i, :, i] + covariance[j, :, j] - covariance[i, :, j] - covariance[j, :, i]
    return np.asarray(C + 1e-300 * np.eye(len(C)))


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


def information_at(
    fit: ModelFit, k: int, weights: np.ndarray | None = None, *, rows: np.ndarray | None = None
) -> StationInformation:
    """Return what a station says of the robot.

    Args:
        fit: a fit.
        k: place of the station.
        weights: of its rows, shape (N,); default: those of the fit.
        rows: the rows that are asked; default: all.
    """
    problem, solution = fit.problem, fit.solution
    station, places, blocks = problem.stations[k], problem.places[k], problem.block_spans[k]
    free, values = solution.free[places], solution.values[places]
    weights = solution.weights[problem.rows[k]] if weights is None else weights
    if rows is not None:
        station, weights = station.select(rows), weights[rows]
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


def fit_with(fit: ModelFit, effects: Sequence[Effect], rows: Mapping[int, np.ndarray]) -> tuple[ModelFit, np.ndarray]:
    """Return a fit of some rows whose model has further effects, all of them zero, and which of its parameters it had.

    The priors of the further ones are so wide that they don't pull.

    Args:
        fit: the fit.
        effects: the effects.
        rows: those that are kept, by the place of their station; other stations are left out.
    """
    problem, solution = fit.problem, fit.solution
    some = replace(problem, stations=tuple(problem.stations[k].select(kept) for k, kept in rows.items()))
    wider, _ = extended(some, effects)
    values, known, free, sizes = (
        problem.carried_over(of, wider)
        for of in (solution.values, np.ones(len(solution.values), bool), solution.free, fit.priors.sizes)
    )
    found = replace(
        solution,
        values=values,
        free=free | ~known,
        weights=np.concatenate([solution.weights[problem.rows[k]][kept] for k, kept in rows.items()]),
        sigma=np.concatenate([solution.sigma[problem.block_spans[k]] for k in rows]),
    )
    believed = CHANGES.wide * np.array([parameter.size for parameter in wider.parameters])
    priors = Priors(np.where(known, sizes, believed), np.full(len(sizes), np.inf))
    return replace(fit, problem=wider, solution=found, priors=priors), known


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
