r"""What normal equations say together with priors, and how a station's own parameters are eliminated from them.

With G = J^T W J, g = J^T W r and priors of size D on some parameters, the step that the posterior wants is found in the
eigenvectors of the prior-scaled Schur complement: the frames of base and tool, which have no prior, are eliminated first.
An eigenvalue lambda is the information of the data in units of the prior's. Directions with lambda far above 1 follow the
data alone, those far below 1 the prior alone, and those that the data can't see at all (lambda below rounding) stay at the
prior's centre, whatever the noise: so predictions never depend on the choice of gauge.

G squares the condition number. That costs nothing here: steps only have to point well enough to converge, the residuals
they act on are exact, and a direction below 1e-7 of the largest moves predictions by less than 1e-10 m.

Of several stations, each with the Jacobian [R F] by the robot's parameters and its own, these own parameters are eliminated
station by station, their priors P included, and only what remains is added up:

.. math:: A = R^T W R - R^T W F \, K \, F^T W R, \qquad b = R^T W r - R^T W F \, K \, (F^T W r - P x), \qquad
          K = (F^T W F + P)^{-1} .
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pincal.parameters import Covariance, root_of

# Eigenvalues below this part of the largest are rounding: the data do not see such a direction.
NULL = 1e-13
# Information that rounding makes up, in units of the prior's, below which it may be left in a solve.
_ROUNDING = 1e-3


@dataclass(frozen=True)
class Posterior:
    """What data and priors say together about F parameters.

    Of several stations it holds the robot's parameters, and in ``own`` what is left of each station's.

    Attributes:
        step: shape (F,), from the present values to the most probable ones.
        covariance: shape (F, F).
        information: eigenvalues of the data's information in units of the priors', ascending; 0 for what is unseen.
        directions: shape (H, H), their eigenvectors in units of the priors, as columns.
        frame_rank: number of directions among base and tool that the data determine.
        has_prior: shape (F,), which parameters the H rows of ``directions`` belong to.
        own: the parameters of stations that were eliminated beforehand.
        remembered: number of parameters that were known from an earlier fit and not from these data.
    """

    step: np.ndarray
    covariance: np.ndarray
    information: np.ndarray
    directions: np.ndarray
    frame_rank: int
    has_prior: np.ndarray
    own: tuple[Eliminated, ...] = ()
    remembered: float = 0.0

    @property
    def visible_rank(self) -> int:
        """Number of directions that the data see at all, however faintly."""
        rank = self.frame_rank + int(np.count_nonzero(self.information))
        return rank + sum(part.alone.visible_rank for part in self.own)

    @property
    def identifiable_rank(self) -> int:
        """Number of directions that the data determine better than the priors do."""
        rank = self.frame_rank + int(np.count_nonzero(self.information > 1.0))
        return rank + sum(part.alone.identifiable_rank for part in self.own)

    @property
    def condition(self) -> float:
        """Ratio of the best to the worst of these directions, in units of the priors."""
        known = self.information[self.information > 1.0]
        return float(np.sqrt(known[-1] / known[0])) if len(known) else 1.0

    @property
    def effective(self) -> float:
        """Number of parameters that the data spend, priors counted."""
        return self.shared_effective + float(sum(self.own_effective))

    @property
    def shared_effective(self) -> float:
        """The same without the parameters of stations that were eliminated."""
        return self.frame_rank + float(np.sum(self.information / (1.0 + self.information))) - self.remembered

    @cached_property
    def own_effective(self) -> tuple[float, ...]:
        """The same of each station's own parameters."""
        return tuple(part.effective(self.covariance) for part in self.own)

    @property
    def joint_covariance(self) -> Covariance:
        """The covariance of all parameters, those of stations included, in their order."""
        if not self.own:
            return Covariance.of(self.covariance)
        n = len(self.covariance) + sum(len(part.places) for part in self.own)
        shared = np.ones(n, bool)
        for part in self.own:
            shared[part.places] = False
        root = root_of(self.covariance)
        factor = np.empty((n, len(root)))
        factor[shared] = root
        for part in self.own:
            factor[part.places] = -part.carried @ root[part.shared]
        return Covariance(factor, tuple((part.places, part.alone.covariance) for part in self.own))


@dataclass(frozen=True)
class Eliminated:
    """The E parameters of one station that were eliminated.

    Attributes:
        places: shape (E,), where they stand among all free parameters.
        shared: shape (S,), where the parameters that this station shares with others stand among the shared ones.
        information: shape (E, E), F'WF + P.
        carried: shape (E, S), K F'WR: how far a step of the shared parameters moves them the other way.
        alone: what the station says of them if the shared parameters stay where they are.
        precision: shape (E,), P.
    """

    places: np.ndarray
    shared: np.ndarray
    information: np.ndarray
    carried: np.ndarray
    alone: Posterior
    precision: np.ndarray

    def step(self, shared_step: np.ndarray) -> np.ndarray:
        """Return their step, shape (E,), once the step of all shared parameters is known."""
        return np.asarray(self.alone.step - self.carried @ shared_step[self.shared])

    def square(self, step: np.ndarray, shared_step: np.ndarray) -> float:
        """Return what they add to the square of a step, shape (E,), measured by the information of the data alone."""
        along = step + self.carried @ shared_step[self.shared]
        return float(along @ self.information @ along - step @ (self.precision * step))

    def effective(self, covariance: np.ndarray) -> float:
        """Return how many parameters the data spend on them, for the covariance of all shared parameters."""
        mine = covariance[np.ix_(self.shared, self.shared)]
        variance = np.diag(self.alone.covariance) + np.einsum("es,st,et->e", self.carried, mine, self.carried)
        known = self.precision > 0.0
        return self.alone.frame_rank + float(np.sum(1.0 - variance[known] * self.precision[known]))


def posterior(
    G: np.ndarray, g: np.ndarray, sizes: np.ndarray, offsets: np.ndarray, *, diagonal: np.ndarray | None = None
) -> Posterior:
    """Combine normal equations (in units of the noise) with priors.

    Args:
        G: shape (F, F).
        g: shape (F,).
        sizes: shape (F,), standard deviations of the priors; inf for none.
        offsets: shape (F,), present values minus the priors' centres.
        diagonal: shape (F,), the diagonal of G before anything was eliminated from it, by which rounding is judged.
    """
    found, loose = _determined(G, g, sizes, offsets, np.diag(G) if diagonal is None else diagonal)
    return _with_loose(found, loose)


def posterior_step(
    G: np.ndarray, g: np.ndarray, sizes: np.ndarray, offsets: np.ndarray, *, diagonal: np.ndarray | None = None
) -> np.ndarray:
    """Return the step of :func:`posterior` alone, in a tenth of the time where rounding lets a Cholesky solve do."""
    has_prior = np.isfinite(sizes)
    prior, frames = np.flatnonzero(has_prior), np.flatnonzero(~has_prior)
    floor = _floor(np.diag(G) if diagonal is None else diagonal, sizes)
    if floor > _ROUNDING or not len(prior):
        return posterior(G, g, sizes, offsets, diagonal=diagonal).step
    D = sizes[prior]
    inverse, _, _ = _invert_frames(G[frames[:, None], frames])
    F = inverse @ G[frames[:, None], prior]
    S = (G[prior[:, None], prior] - G[prior[:, None], frames] @ F) * np.outer(D, D)
    S.flat[:: len(S) + 1] += 1.0
    reduced = (g[prior] - F.T @ g[frames]) * D - offsets[prior] / D
    step = np.empty(len(g))
    step[prior] = D * cho_solve(cho_factor(S, overwrite_a=True, check_finite=False), reduced, check_finite=False)
    step[frames] = inverse @ g[frames] - F @ step[prior]
    return step


@dataclass(frozen=True)
class Contribution:
    """What one station says of the S parameters that it shares with others, its E own ones eliminated.

    Attributes:
        G: shape (S, S).
        g: shape (S,).
        diagonal: shape (S + E,), of the normal equations before, in the order of the station's free parameters.
        information: shape (E, E), see :class:`Eliminated`; so are the others.
        carried: shape (E, S).
        alone: of the own parameters.
        precision: shape (E,).
    """

    G: np.ndarray
    g: np.ndarray
    diagonal: np.ndarray
    information: np.ndarray
    carried: np.ndarray
    alone: Posterior
    precision: np.ndarray

    def eliminated(self, places: np.ndarray, shared: np.ndarray) -> Eliminated:
        """Return the own parameters by their places among those of all stations."""
        return Eliminated(places, shared, self.information, self.carried, self.alone, self.precision)


def eliminate(G: np.ndarray, g: np.ndarray, own: np.ndarray, sizes: np.ndarray, offsets: np.ndarray) -> Contribution:
    """Eliminate parameters from normal equations.

    Args:
        G: shape (F, F).
        g: shape (F,).
        own: shape (F,), which parameters to eliminate.
        sizes: shape (F,), standard deviations of the priors; inf for none. Only those of eliminated parameters matter.
        offsets: shape (F,), present values minus the priors' centres.
    """
    shared, own = np.flatnonzero(~own), np.flatnonzero(own)
    inner, across = G[own[:, None], own], G[own[:, None], shared]
    precision = sizes[own] ** -2.0
    alone, loose = _determined(inner, g[own], sizes[own], offsets[own], np.diag(inner))
    carried = alone.covariance @ across
    return Contribution(
        G=G[shared[:, None], shared] - across.T @ carried,
        g=g[shared] - across.T @ alone.step,
        diagonal=np.diag(G).copy(),
        information=inner + np.diag(precision),
        carried=carried,
        alone=_with_loose(alone, loose),
        precision=precision,
    )


def _determined(
    G: np.ndarray, g: np.ndarray, sizes: np.ndarray, offsets: np.ndarray, diagonal: np.ndarray
) -> tuple[Posterior, np.ndarray]:
    """Return the posterior over what is determined, and the variances of the frames' directions that nothing determines."""
    has_prior = np.isfinite(sizes)
    prior, frames = np.flatnonzero(has_prior), np.flatnonzero(~has_prior)
    D = sizes[prior]
    inverse, frame_rank, loose = _invert_frames(G[frames[:, None], frames])
    F = inverse @ G[frames[:, None], prior]
    S = (G[prior[:, None], prior] - G[prior[:, None], frames] @ F) * np.outer(D, D)
    reduced = (g[prior] - F.T @ g[frames]) * D
    information, V = np.linalg.eigh(0.5 * (S + S.T))
    floor = max(_floor(diagonal, sizes), NULL * 1e-300)
    information = np.where(information > floor, information, 0.0)
    data = np.where(information > 0.0, V.T @ reduced, 0.0)
    shift = D * (V @ ((data - V.T @ (offsets[prior] / D)) / (information + 1.0)))
    step = np.empty(len(g))
    step[prior] = shift
    step[frames] = inverse @ g[frames] - F @ shift
    C = (V / (information + 1.0)) @ V.T * np.outer(D, D)
    covariance = np.empty_like(G)
    covariance[prior[:, None], prior] = C
    covariance[frames[:, None], prior] = -F @ C
    covariance[prior[:, None], frames] = -(F @ C).T
    covariance[frames[:, None], frames] = inverse + F @ C @ F.T
    return Posterior(step, covariance, information, V, frame_rank, has_prior), loose


def _with_loose(found: Posterior, loose: np.ndarray) -> Posterior:
    if not loose.any():
        return found
    covariance = found.covariance.copy()
    covariance[np.ix_(~found.has_prior, ~found.has_prior)] += loose
    return replace(found, covariance=covariance)


def _floor(diagonal: np.ndarray, sizes: np.ndarray) -> float:
    """Return the information, in units of the priors', below which a direction may be made up by rounding."""
    prior = np.isfinite(sizes)
    return NULL * float(np.max(diagonal[prior] * sizes[prior] ** 2, initial=0.0))


def _invert_frames(G: np.ndarray) -> tuple[np.ndarray, int, np.ndarray]:
    """Return the inverse over what is determined, its rank, and variances of (1 m, 1 rad)^2 along the rest."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(G), 1e-300))
    values, vectors = np.linalg.eigh(G * np.outer(scale, scale))
    seen = values > NULL * max(float(values.max(initial=0.0)), 1e-300)
    U = scale[:, None] * vectors[:, seen]
    rest = scale[:, None] * vectors[:, ~seen]
    rest = rest / np.maximum(np.abs(rest).max(axis=0, initial=0.0), 1e-300)
    return (U / values[seen]) @ U.T, int(seen.sum()), rest @ rest.T
