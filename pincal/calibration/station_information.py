r"""Information of each of several stations on the robot, and tests of parameters that differ
between stations.

G_k and g_k are the information and the gradient of the rows of station k on the robot's parameters,
its own parameters eliminated. If some of the robot's differed from the common value by d_k at
station k, the d_k would have

.. math:: M_{kl} = \delta_{kl} G_k - G_k C G_l, \qquad b_k = g_k,

in the rows and columns of these parameters, with C the covariance of the fit, and would reduce the
squares by
:math:`b^T M^{-1} b`: chi-square, with one degree of freedom less than there are stations, if
  nothing moved.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Self

import numpy as np
from scipy.special import chdtr, chdtrc, fdtrc

from pincal.calibration.change_numbers import CHANGES
from pincal.identify.fit import ModelFit, Priors
from pincal.identify.normal import accumulate
from pincal.identify.posterior import Posterior, eliminate
from pincal.identify.problem import extended
from pincal.identify.quadratic import Form, Quadratic
from pincal.identify.selection import Scored, select_stepwise
from pincal.identify.station import Station
from pincal.model.chain import Chain
from pincal.model.effect import Effect, Family
from pincal.parameters import Parameter
from pincal.thresholds import Count, Scale

# Fraction of a parameter's information that has to remain, the station's own parameters eliminated,
# to be observable.
_SEEN: Scale = 1e-4
# Fraction of a value's information that is added to it, well above rounding and far below what is
# relevant.
_ROUNDING: Scale = 1e-8
# Factor on a negative eigenvalue's size that is well above the rounding errors of all.
_BEYOND_ROUNDING: Scale = 10.0
# Groups released at most: work and memory grow with their square.
_MOST: Count = 6
# Parameters whose products at all stations are computed at once.
_AT_ONCE: Count = 256

Together = tuple[int, ...]
"""Indices of parameters that move together."""


@dataclass(frozen=True)
class StationInformation:
    """Information of a station's rows on the C free parameters of the robot that it sees, its own
    ones eliminated.

    Attributes:
        form: their squares, in units of the noise.
        places: shape (C,), their indices among all shared and free parameters.
        own_spent: effective number of the station's own parameters.
    """

    form: Quadratic
    places: np.ndarray
    own_spent: float

    @property
    def noise_squared(self) -> float:
        """Variance of the noise of the station's rows, the robot's parameters free, in units of the
        fit's variance.

        1 unless it is significantly smaller: the noise of a fit includes what moved.
        """
        gain, rank = self.form.gain(np.arange(len(self.places)), _SEEN)
        square = self.form.square - gain
        degrees = self.form.degrees - rank
        return (
            max(square, 1e-12) / degrees
            if degrees > 0 and chdtr(degrees, square) < CHANGES.too_quiet
            else 1.0
        )


@dataclass(frozen=True)
class SharedInformation:
    """Information of each of K stations on the F shared parameters, its own ones eliminated, in
    units of the noise.

    Attributes:
        parameters: the F parameters.
        G: shape (K, F, F).
        g: shape (K, F).
        whole: shape (K, F), the diagonal of G before anything was eliminated.
        sizes, offsets: shape (F,), standard deviations of their priors, and deviations from the
            nominal.
        usual: shape (F,), whether a parameter is among those that move most often, the offsets of
            joints.
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
        """Return the information of the stations of a fit, each divided into parts, interleaved or
        of rows in order.
        """
        problem = fit.problem
        shared = shared_places(fit)
        K = parts * len(problem.stations)
        F = len(shared)
        G = np.zeros((K, F, F))
        g = np.zeros((K, F))
        whole = np.zeros((K, F))
        for k, station in enumerate(problem.stations):
            if _follows_motion(station):
                continue
            together: StationInformation | None = None
            for i, one in enumerate(_of_parts(fit, k, parts, in_order=in_order), start=parts * k):
                at = one.places
                G[i][np.ix_(at, at)] = one.form.H
                g[i, at] = one.form.g
                whole[i, at] = one.form.whole
                form = one.form if together is None else together.form + one.form
                together = replace(together or one, form=form)
            noise = 1.0 if together is None else _noise_at(fit, k, together)
            for of in (G, g, whole):
                of[parts * k : parts * (k + 1)] /= noise
        model, _ = fit.arm
        zeros = (
            e for e in model.effects if e.family is Family.GEOMETRY and e.locus.acts_on == "drive"
        )
        lasting = (e for e in model.effects if e.is_constant)
        parameters = tuple(problem.parameters[place] for place in shared)
        marked = (_are_of(parameters, effects, model.chain) for effects in (zeros, lasting))
        return cls(parameters, G, g, whole, fit.priors.sizes[shared], fit.values[shared], *marked)

    def joined(self, parts: int) -> Self:
        """Return the information with so many parts of each station joined."""
        G, g, whole = (
            of.reshape(-1, parts, *of.shape[1:]).sum(axis=1) for of in (self.G, self.g, self.whole)
        )
        return replace(self, G=G, g=g, whole=whole)

    def in_shapes(self, T: np.ndarray) -> Self:
        """Return the information on n parameters x, with T x the F parameters; T of shape (F, n),
        orthonormal.
        """
        main = np.abs(T).argmax(axis=0)
        return type(self)(
            parameters=tuple(self.parameters[i] for i in main),
            G=T.T @ self.G @ T,
            g=self.g @ T,
            whole=self.whole @ T**2,
            sizes=self.sizes[main],
            offsets=self.offsets @ T,
            usual=self.usual[main],
            lasting=self.lasting[main],
        )

    @property
    def together(self) -> StationsInformation:
        """It about a joint fit of the F parameters."""
        whole = Form.of(self.G.sum(axis=0), self.g.sum(axis=0))
        found = Posterior(whole, self.sizes, self.offsets)
        return StationsInformation(
            G=self.G,
            b=self.g - self.G @ found.step,
            seen=self._seen,
            C=found.covariance,
            widths=CHANGES.wide * self.sizes,
            usual=self.usual,
            explained=float(whole.g @ found.step),
            step=found.step,
        )

    def about(self, joint: StationsInformation) -> StationsInformation:
        """Return it about a joint fit of the same sum, of which it is another division."""
        return replace(joint, G=self.G, b=self.g - self.G @ joint.step, seen=self._seen)

    @property
    def _seen(self) -> np.ndarray:
        """Whether a parameter may move and a station observes it, shape (K, F)."""
        seen = np.diagonal(self.G, axis1=1, axis2=2) > _SEEN * self.whole
        return np.asarray(seen & np.isfinite(self.sizes) & ~self.lasting)


def _follows_motion(station: Station) -> bool:
    """Return whether unmodelled errors follow a station's motion, which others do not share."""
    is_in_motion = station.sensor.reads_place and station.conditions.are_in_motion
    return station.serial is not None and is_in_motion


def _of_parts(fit: ModelFit, k: int, parts: int, *, in_order: bool) -> Iterator[StationInformation]:
    """Yield the information of parts of the k-th station."""
    weights = fit.solution.weights[fit.problem.rows[k]]
    if np.mean(weights == 0.0) > CHANGES.wrong_rows:
        # So many rejected rows are no outliers: the robot changed there.
        weights = np.ones_like(weights)
    if parts == 1:
        yield information_at(fit, k, weights)
        return
    every = np.arange(len(weights))
    interleaved = [every[i::parts] for i in range(parts)]
    split = np.array_split(every, parts) if in_order else interleaved
    yield from (information_at(fit, k, weights, rows=some) for some in split)


def _noise_at(fit: ModelFit, k: int, station: StationInformation) -> float:
    """Return the variance of the noise of the k-th station, in units of the fit's."""
    block = fit.problem.block_spans[k].start
    declared = fit.noise.declared[block] or 0.0
    return max(station.noise_squared, float((declared / fit.solution.sigma[block]) ** 2))


def _are_of(parameters: Sequence[Parameter], effects: Iterable[Effect], chain: Chain) -> np.ndarray:
    """Return which parameters are of some of the effects, a mask of shape (F,)."""
    names = {p.name for effect in effects for p in effect.parameters(chain)}
    return np.array([parameter.name in names for parameter in parameters], bool)


@dataclass(frozen=True)
class StationsInformation:
    """Information of K stations on the robot's F parameters, about a joint fit.

    Attributes:
        G: shape (K, F, F).
        b: shape (K, F), the gradients after a step to the optimum of these rows.
        seen: shape (K, F), whether a parameter may move and a station observes it.
        C: shape (F, F), covariance of a joint fit of these rows.
        widths: shape (F,), standard deviations of the priors of differences between stations.
        usual: shape (F,), as in :class:`SharedInformation`.
        explained: reduction of the squares by that step.
        step: shape (F,), that step; empty where it is not asked for.
    """

    G: np.ndarray
    b: np.ndarray
    seen: np.ndarray
    C: np.ndarray
    widths: np.ndarray
    usual: np.ndarray
    explained: float = 0.0
    step: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def released(
        self, chosen: Sequence[Together]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return station and parameter of each value of its own, shape (n,), these values, and
        their covariance.
        """
        station, parameter = self._own(chosen)
        U = self.G[station, parameter]
        values, covariance = self._estimated(station, parameter, U @ self.C @ U.T)
        return station, parameter, values, covariance

    def _own(self, chosen: Sequence[Together]) -> tuple[np.ndarray, np.ndarray]:
        """Return station and parameter of each value of its own, shape (n,)."""
        flat = [p for group in chosen for p in group]
        own = [np.flatnonzero(self.seen[:, p]) for p in flat]
        counts = np.array(list(map(len, own)), int)
        return np.concatenate([np.zeros(0, int), *own]), np.repeat(np.array(flat, int), counts)

    def _estimated(
        self, station: np.ndarray, parameter: np.ndarray, common: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return values of their own, shape (n,), and their covariance, given what the joint fit
        takes of their information, shape (n, n).
        """
        within = self.G[station[:, None], parameter[:, None], parameter]
        M = np.where(station[:, None] == station, within, 0.0) - common
        # A move common to all stations is the fit's own: only rounding remains of it here.
        information = np.diag(within)
        M.flat[:: len(M) + 1] += self.widths[parameter] ** -2.0 + _ROUNDING * information
        covariance = _inverse(M, np.sqrt(information))
        return covariance @ self.b[station, parameter], covariance

    @cached_property
    def _common(self) -> np.ndarray:
        """What the joint fit takes of the information on each parameter at each pair of stations,
        shape (F, K, K).
        """
        found = np.empty((len(self.C), len(self.G), len(self.G)))
        for start in range(0, len(found), _AT_ONCE):
            U = self.G[:, start : start + _AT_ONCE]
            found[start : start + _AT_ONCE] = np.einsum("kpf,lpf->pkl", U @ self.C, U)
        return found

    def gains(self, chosen: Sequence[Together], tried: Sequence[Together]) -> Iterator[float]:
        """Yield the gain of each tried group besides the chosen ones, as :meth:`gain` of both less
        that of these.
        """
        before = self.gain(chosen)
        known = self._own(chosen)
        carried = self.G[known] @ self.C
        for group in tried:
            own = self._own([group])
            U = self.G[own]
            across = carried @ U.T
            if len(group) == 1:
                common = self._common[group[0]][np.ix_(own[0], own[0])]
            else:
                common = U @ self.C @ U.T
            station, parameter = (np.concatenate(pair) for pair in zip(known, own, strict=True))
            whole = np.block([[carried @ self.G[known].T, across], [across.T, common]])
            values, _ = self._estimated(station, parameter, whole)
            yield float(values @ self.b[station, parameter]) - before

    def gain(self, chosen: Sequence[Together]) -> float:
        """Return the reduction of the squares by separate values at each station."""
        if not chosen:
            return 0.0
        station, parameter, values, _ = self.released(chosen)
        return float(values @ self.b[station, parameter])

    def degrees(self, group: Together) -> int:
        """Return the degrees of freedom of separate values of a group beyond a common one."""
        return int(np.maximum(self.seen[:, list(group)].sum(axis=0) - 1, 0).sum())

    def moved(
        self, candidates: Sequence[Together], *, price: float = 0.0, apart: Apart | None = None
    ) -> tuple[Together, ...]:
        """Return the groups that differ between stations, by stepwise selection.

        Args:
            candidates: groups of parameters that may have moved.
            price: cost of each released value.
            apart: information of parts of each station, to estimate the noise; default: the noise
                is known.
        """
        tried = [group for group in candidates if self.degrees(group)]
        scored = partial(self._scored, price, CHANGES.moved / max(len(tried), 1))

        def scores(chosen: tuple[Together, ...]) -> Iterator[Scored[Together]]:
            rest = [group for group in tried if group not in chosen]
            gains = dict(zip(rest, self.gains(chosen, rest), strict=True))
            quiet = [scored(group, gain) for group, gain in gains.items()]
            if apart is None:
                yield from quiet
                return
            least = np.inf
            for one in sorted(quiet, key=lambda one: one.cost):
                # More noise only costs more, so that of the others need not be known.
                if one.cost >= least:
                    break
                group = one.candidate
                one = scored(group, gains[group], *apart.noise(chosen, group))
                least = min(least, one.cost)
                yield one

        return select_stepwise((), scores, lambda chosen, group: (*chosen, group), most=_MOST)

    def _scored(
        self,
        price: float,
        limit: float,
        group: Together,
        gain: float,
        noise: float = 1.0,
        known: float = np.inf,
    ) -> Scored[Together]:
        """Return a group with its cost, and whether it differs at a p-value below a limit, given
        its gain, the variance of the noise and the degrees of freedom of this.
        """
        degrees = self.degrees(group)
        chance = (
            chdtrc(degrees, gain)
            if np.isinf(known)
            else fdtrc(degrees, known, gain / noise / degrees)
        )
        cost = price * degrees - gain / noise - CHANGES.usual * self.usual[group[0]]
        return Scored(group, cost, chance < limit)

    def own_values(
        self, chosen: Sequence[Together], group: Together
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the s stations that observe a chosen group of n parameters, its values there, and
        their covariance.

        Returns:
            Shapes (s,), (s, n) and (s, n, s, n).
        """
        station, parameter, values, covariance = self.released(chosen)
        seeing = np.flatnonzero(self.seen[:, list(group)].all(axis=1))
        place = {
            (int(k), int(p)): i for i, (k, p) in enumerate(zip(station, parameter, strict=True))
        }
        at = np.array([[place[int(k), p] for p in group] for k in seeing], int).reshape(
            len(seeing), len(group)
        )
        return seeing, values[at], covariance[at[:, :, None, None], at]


@dataclass(frozen=True)
class Apart:
    """Information of stations, ``joined``, and of ``parts`` of each of them."""

    joined: StationsInformation
    parts: StationsInformation

    @classmethod
    def of(cls, shared: SharedInformation, parts: int) -> Self:
        """Return it from the information of so many parts of each station."""
        joined = shared.joined(parts).together
        return cls(joined, shared.about(joined))

    def noise(self, chosen: Sequence[Together], group: Together) -> tuple[float, float]:
        """Return the variance by which a group differs between parts of one station, and its
        degrees of freedom.

        Unmodelled errors are correlated over many rows and larger in some directions than residuals
        are on average. A variance that is not significantly larger than the noise is 1.

        Args:
            chosen: the other groups that moved.
            group: the group.
        """
        both = (*chosen, group)
        degrees = self.parts.degrees(group) - self.joined.degrees(group)
        if degrees < 1:
            return 1.0, np.inf
        gain = (
            self.parts.gain(both)
            - self.parts.gain(chosen)
            - self.joined.gain(both)
            + self.joined.gain(chosen)
        )
        return (
            (gain / degrees, degrees) if chdtrc(degrees, gain) < CHANGES.uneven else (1.0, np.inf)
        )


def difference(covariance: np.ndarray, i: int, j: int) -> np.ndarray:
    """Return the covariance of the difference of values at two stations, shape (n, n), from theirs,
    (s, n, s, n).
    """
    C = covariance[i, :, i] + covariance[j, :, j] - covariance[i, :, j] - covariance[j, :, i]
    return np.asarray(C + 1e-300 * np.eye(len(C)))


def _inverse(M: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the inverse of M, shape (n, n), positive definite up to rounding; see
    :meth:`StationsInformation.released`.

    M is a small difference of terms whose diagonal is the square of ``scale``, shape (n,). It is
    empty where no station observes what was released, as where joints rest in all of them.
    """
    if not len(M):
        return M
    values, vectors = np.linalg.eigh(M / np.outer(scale, scale))
    values = np.maximum(values, max(_ROUNDING, -_BEYOND_ROUNDING * values[0]))
    spread = vectors / scale[:, None]
    return np.asarray((spread / values) @ spread.T)


def information_at(
    fit: ModelFit, k: int, weights: np.ndarray | None = None, *, rows: np.ndarray | None = None
) -> StationInformation:
    """Return the information of some rows, default: all, of the k-th station on the robot; weights
    default to the fit's.
    """
    problem = fit.problem
    solution = fit.solution
    station = problem.stations[k]
    places = problem.places[k]
    blocks = problem.block_spans[k]
    free = solution.free[places]
    values = solution.values[places]
    weights = solution.weights[problem.rows[k]] if weights is None else weights
    if rows is not None:
        station = station.select(rows)
        weights = weights[rows]
    normal = accumulate(station, values, free, weights)
    is_own = station.is_own[free]
    form = normal.at(solution.sigma[blocks])
    rest, own = eliminate(form, is_own, fit.priors.sizes[places][free], values[free])
    spent = float(np.sum(own.alone.frame_rank + own.alone.has_prior.sum()))
    step = own.alone.step
    square = float(
        normal.squares.blocks @ solution.sigma[blocks] ** -2.0 - step @ own.alone.form.H @ step
    )
    square -= float(own.precision @ step**2)
    readings = float(np.sum(weights > 0.0) * station.reading_size)
    shared = shared_places(fit)
    at = np.searchsorted(shared, places[free][~is_own])
    names = tuple(problem.parameters[place].name for place in shared[at])
    found = Quadratic(**vars(rest), names=names, square=square, degrees=readings - spent)
    return StationInformation(found, at, spent)


def fit_with(
    fit: ModelFit, effects: Sequence[Effect], rows: Mapping[int, np.ndarray]
) -> tuple[ModelFit, np.ndarray]:
    """Return a fit of some rows with further effects of zero size, and a mask of the parameters
    that it had before.

    The priors of the further parameters are too wide to matter. The rows are given by the index of
    their station; other stations are left out.
    """
    problem = fit.problem
    solution = fit.solution
    some = replace(
        problem, stations=tuple(problem.stations[k].select(kept) for k, kept in rows.items())
    )
    wider, _ = extended(some, effects)
    values, known, free, sizes = (
        problem.carried_over(of, wider)
        for of in (
            solution.values,
            np.ones(len(solution.values), bool),
            solution.free,
            fit.priors.sizes,
        )
    )
    found = replace(
        solution,
        values=values,
        free=free | ~known,
        weights=np.concatenate(
            [solution.weights[problem.rows[k]][kept] for k, kept in rows.items()]
        ),
        sigma=np.concatenate([solution.sigma[problem.block_spans[k]] for k in rows]),
    )
    believed = CHANGES.wide * np.array([parameter.size for parameter in wider.parameters])
    priors = Priors(np.where(known, sizes, believed), np.full(len(sizes), np.inf))
    return replace(fit, problem=wider, solution=found, priors=priors), known


def shared_places(fit: ModelFit) -> np.ndarray:
    """Return the indices of the robot's free parameters, shape (F,)."""
    robots = fit.problem.is_shared & fit.solution.free
    for station, places in zip(fit.problem.stations, fit.problem.places, strict=True):
        # A station that is alone shares all.
        robots[places[station.is_own]] = False
    return np.flatnonzero(robots)


def spent_at(fit: ModelFit, k: int) -> float:
    """Return the effective number of parameters of a station's rows: its own ones, and its part of
    the robot's.
    """
    here = information_at(fit, k)
    covariance = fit.solution.known.covariance[np.ix_(here.places, here.places)]
    return here.own_spent + float(np.sum(here.form.H * covariance))
