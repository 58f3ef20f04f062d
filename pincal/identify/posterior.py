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
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri, dpstrf

from pincal.parameters import Covariance, root_of

# Eigenvalues below this part of the largest are rounding: the data do not see such a direction.
NULL = 1e-13
# Information that rounding makes up, in units of the prior's, below which it may be left in a solve.
_ROUNDING = 1e-3
# How many times as much as rounding parameters may show, one after the other, where directions among them may be unseen.
_NEARLY = 1e4


@dataclass(frozen=True)
class Posterior:
    """What data and priors say together about F parameters.

    Of several stations it holds the robot's parameters, and in ``own`` what is left of each station's.

    Attributes:
        step: shape (F,), from the present values to the most probable ones.
        covariance: shape (F, F).
        information: eigenvalues of the data's information in units of the priors', ascending; 0 for what is unseen.
        directions: shape (H, H), their eigenvectors in units of the priors, as columns.
        frame_rank: number of directions among base and tool that the data determine; of several stations each one's.
        has_prior: shape (F,), which parameters the H rows of ``directions`` belong to.
        own: the parameters of stations that were eliminated beforehand.
        remembered: number of parameters that were known from an earlier fit and not from these data.
    """

    step: np.ndarray
    covariance: np.ndarray
    information: np.ndarray
    directions: np.ndarray
    frame_rank: int | np.ndarray
    has_prior: np.ndarray
    own: tuple[Eliminated, ...] = ()
    remembered: float = 0.0

    @property
    def visible_rank(self) -> int:
        """Number of directions that the data see at all, however faintly."""
        rank = int(np.sum(self.frame_rank)) + int(np.count_nonzero(self.information))
        return rank + sum(part.alone.visible_rank for part in self.own)

    @property
    def identifiable_rank(self) -> int:
        """Number of directions that the data determine better than the priors do."""
        rank = int(np.sum(self.frame_rank)) + int(np.count_nonzero(self.information > 1.0))
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
        spent = float(np.sum(self.information / (1.0 + self.information)))
        return float(np.sum(self.frame_rank)) + spent - self.remembered

    @cached_property
    def own_effective(self) -> tuple[float, ...]:
        """The same of each station's own parameters."""
        return tuple(float(n) for part in self.own for n in np.atleast_1d(part.effective(self.covariance)))

    @property
    def joint_covariance(self) -> Covariance:
        """The covariance of all parameters, those of stations included, in their order."""
        if not self.own:
            return Covariance.of(self.covariance)
        n = len(self.covariance) + sum(part.places.size for part in self.own)
        shared = np.ones(n, bool)
        for part in self.own:
            shared[part.places] = False
        root = root_of(self.covariance)
        factor = np.empty((n, len(root)))
        factor[shared] = root
        for part in self.own:
            factor[part.places] = -part.carried @ root[part.shared]
        groups: list[tuple[np.ndarray, np.ndarray]] = []
        for part in self.own:
            places, blocks = part.places, part.alone.covariance
            groups += [(places, blocks)] if places.ndim == 1 else zip(places, blocks, strict=True)
        return Covariance(factor, tuple(groups))


@dataclass(frozen=True)
class Eliminated:
    """The E parameters of one station, or of each of S stations (leading axis S), that were eliminated.

    Attributes:
        places: shape (E,), where they stand among all free parameters.
        shared: shape (C,), where the parameters that these stations share with others stand among the shared ones.
        information: shape (E, E), F'WF + P.
        carried: shape (E, C), K F'WR: how far a step of the shared parameters moves them the other way.
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
        return float(np.sum(along * _times(self.information, along)) - np.sum(self.precision * step**2))

    def effective(self, covariance: np.ndarray) -> np.ndarray:
        """Return how many parameters the data spend on them, shape () or (S,), for the covariance of all shared ones."""
        mine = covariance[np.ix_(self.shared, self.shared)]
        variance = _diagonal(self.alone.covariance) + np.sum((self.carried @ mine) * self.carried, axis=-1)
        # Without a prior a parameter is spent as far as the data determine it.
        return np.asarray(self.alone.frame_rank + np.sum(self.alone.has_prior - variance * self.precision, axis=-1))


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
    S = _reduced(G, prior, G[prior[:, None], frames] @ F, D)
    reduced = (g[prior] - F.T @ g[frames]) * D - offsets[prior] / D
    step = np.empty(len(g))
    step[prior] = D * cho_solve(cho_factor(S, overwrite_a=True, check_finite=False), reduced, check_finite=False)
    step[frames] = inverse @ g[frames] - F @ step[prior]
    return step


def posterior_covariance(G: np.ndarray, sizes: np.ndarray, *, diagonal: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """Return the covariance of :func:`posterior` alone, in a fifth of the time where rounding lets a Cholesky factor do.

    Args:
        G: shape (F, F).
        sizes: shape (F,), standard deviations of the priors; inf for none.
        diagonal: shape (F,), as there.
        unseen: shape (H, K), directions that are known to be unseen: what rounding makes up along them is left out.
    """
    has_prior = np.isfinite(sizes)
    prior, frames = np.flatnonzero(has_prior), np.flatnonzero(~has_prior)
    D, failed = sizes[prior], True
    inverse, _, loose = _invert_frames(G[frames[:, None], frames])
    F = inverse @ G[frames[:, None], prior]
    if len(prior) and _floor(diagonal, sizes) <= _ROUNDING:
        S = _reduced(G, prior, G[prior[:, None], frames] @ F, D)
        made_up = S @ unseen - unseen
        S -= (across := made_up @ unseen.T) + across.T - unseen @ (unseen.T @ made_up) @ unseen.T
        half, failed = dpotri(cholesky(S, lower=True, overwrite_a=True, check_finite=False), lower=1, overwrite_c=1)
    if failed:
        nothing = np.zeros(len(G))
        return posterior(G, nothing, sizes, nothing, diagonal=diagonal).covariance
    C = np.tril(half)
    C += np.tril(half, -1).T
    C *= np.outer(D, D)
    return _with_frames(C, F, inverse + loose, prior, frames)


def unseen_directions(G: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions of :func:`posterior` that the data do not see at all, in a tenth of the time.

    Returns:
        Which parameters have a prior, shape (F,), and the directions, shape (H, K), over those that do, as columns.
    """
    has_prior = np.isfinite(sizes)
    prior, frames = np.flatnonzero(has_prior), np.flatnonzero(~has_prior)
    acts = np.diag(G)[prior] > 0.0
    shown, idle = prior[acts], np.eye(len(prior))[:, ~acts]
    if not len(shown):
        return has_prior, idle
    inverse, _, _ = _invert_frames(G[frames[:, None], frames])
    across = G[shown[:, None], frames]
    S = (G[shown[:, None], shown] - across @ inverse @ across.T) * _outer(sizes[shown])
    floor = max(float(_floor(np.diag(G), sizes)), NULL * 1e-300)
    # Once the parameters are known of which most is seen, one after the other, little is seen of the others' directions.
    factor, pivots, rank, _ = dpstrf(S, tol=_NEARLY * floor, lower=1)
    known, others = np.split(pivots - 1, [rank])
    nearly = np.zeros((len(S), len(others)))
    nearly[others] = np.eye(len(others))
    nearly[known] = -solve_triangular(factor[:rank, :rank], factor[rank:, :rank].T, lower=True, trans="T")
    nearly, _ = np.linalg.qr(nearly)
    information, axes = np.linalg.eigh(nearly.T @ S @ nearly)
    directions = np.zeros((len(prior), int(np.count_nonzero(information <= floor))))
    directions[acts] = nearly @ axes[:, information <= floor]
    return has_prior, np.hstack([idle, directions])


def spent_parameters(G: np.ndarray, sizes: np.ndarray, believed: np.ndarray | None = None) -> float | None:
    """Return :attr:`Posterior.shared_effective` alone, in a tenth of the time; None where rounding forbids.

    Args:
        G: shape (F, F).
        sizes: shape (F,), standard deviations of the priors; inf for none.
        believed: shape (F, F), the part of G that is no data; default: none of it.
    """
    has_prior = np.isfinite(sizes)
    prior, frames = np.flatnonzero(has_prior), np.flatnonzero(~has_prior)
    if _floor(np.diag(G), sizes) > _ROUNDING or not len(prior) or (believed is not None and np.any(believed[frames])):
        return None
    D = sizes[prior]
    inverse, frame_rank, _ = _invert_frames(G[frames[:, None], frames])
    F = G[frames[:, None], prior]
    S = _reduced(G, prior, F.T @ inverse @ F, D)
    C, failed = dpotri(cholesky(S, lower=True, overwrite_a=True, check_finite=False), lower=1, overwrite_c=1)
    if failed:
        return None
    spent = float(frame_rank) + float(np.sum(1.0 - np.diag(C)))
    if believed is None:
        return spent
    known = believed[prior[:, None], prior] * np.outer(D, D)
    return spent - float(2.0 * np.sum(np.tril(C, -1) * known) + np.diag(C) @ np.diag(known))


def _reduced(G: np.ndarray, prior: np.ndarray, absorbed: np.ndarray, D: np.ndarray) -> np.ndarray:
    """Return information in units of the priors plus that of these, what frames absorb taken out; column-major for LAPACK.

    Of large matrices, the time goes into moving them: as few copies as can be are made.
    """
    S = np.take(np.take(G, prior, axis=0), prior, axis=1)
    S -= absorbed
    S *= D
    S *= D[:, None]
    S.flat[:: len(S) + 1] += 1.0
    return S.T


@dataclass(frozen=True)
class Contribution:
    """What a station says of the C parameters that it shares with others, its E own ones eliminated.

    Attributes:
        G: shape (C, C), of several stations their sum.
        g: shape (C,), likewise.
        diagonal: shape (C + E,), of the normal equations before, in the order of the station's free parameters; that of each
            of several, shape (S, C + E).
        information: shape (E, E), see :class:`Eliminated`; so are the others.
        carried: shape (E, C).
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
    """Eliminate parameters from the normal equations of one station, or of each of S stations (leading axis S).

    Args:
        G: shape (F, F).
        g: shape (F,).
        own: shape (F,), which parameters to eliminate; of all stations the same.
        sizes: shape (F,), standard deviations of the priors; inf for none. Only those of eliminated parameters matter.
        offsets: shape (F,), present values minus the priors' centres.
    """
    shared, own = np.flatnonzero(~own), np.flatnonzero(own)
    inner, across = G[..., own[:, None], own], G[..., own[:, None], shared]
    precision = sizes[..., own] ** -2.0
    alone, loose = _determined(inner, g[..., own], sizes[..., own], offsets[..., own], _diagonal(inner))
    carried = alone.covariance @ across
    several = tuple(range(G.ndim - 2))
    return Contribution(
        G=np.sum(G[..., shared[:, None], shared] - _turned(across) @ carried, axis=several),
        g=np.sum(g[..., shared] - _times(_turned(across), alone.step), axis=several),
        diagonal=_diagonal(G).copy(),
        information=inner + precision[..., None] * np.eye(len(own)),
        carried=carried,
        alone=_with_loose(alone, loose),
        precision=precision,
    )


def _diagonal(matrix: np.ndarray) -> np.ndarray:
    return np.diagonal(matrix, axis1=-2, axis2=-1)


def _turned(matrix: np.ndarray) -> np.ndarray:
    return matrix.swapaxes(-1, -2)


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _outer(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector[..., :, None] * vector[..., None, :])


def _determined(
    G: np.ndarray, g: np.ndarray, sizes: np.ndarray, offsets: np.ndarray, diagonal: np.ndarray
) -> tuple[Posterior, np.ndarray]:
    """Return the posterior over what is determined, and the variances of the frames' directions that nothing determines."""
    has_prior = np.isfinite(sizes if sizes.ndim == 1 else sizes[0])
    prior, frames = np.flatnonzero(has_prior), np.flatnonzero(~has_prior)
    D = sizes[..., prior]
    inverse, frame_rank, loose = _invert_frames(G[..., frames[:, None], frames])
    F = inverse @ G[..., frames[:, None], prior]
    S = (G[..., prior[:, None], prior] - G[..., prior[:, None], frames] @ F) * _outer(D)
    reduced = (g[..., prior] - _times(_turned(F), g[..., frames])) * D
    information, V = np.linalg.eigh(0.5 * (S + _turned(S)))
    floor = np.maximum(_floor(diagonal, sizes), NULL * 1e-300)
    information = np.where(information > floor[..., None], information, 0.0)
    data = np.where(information > 0.0, _times(_turned(V), reduced), 0.0)
    shift = D * _times(V, (data - _times(_turned(V), offsets[..., prior] / D)) / (information + 1.0))
    step = np.empty_like(g)
    step[..., prior] = shift
    step[..., frames] = _times(inverse, g[..., frames]) - _times(F, shift)
    C = (V / (information + 1.0)[..., None, :]) @ _turned(V) * _outer(D)
    covariance = _with_frames(C, F, inverse, prior, frames)
    return Posterior(step, covariance, information, V, frame_rank, has_prior), loose


def _with_frames(C: np.ndarray, F: np.ndarray, inverse: np.ndarray, prior: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Return the covariance of all parameters, given that of those with a prior, which frames follow by -F."""
    n = len(prior) + len(frames)
    covariance, carried = np.empty((*C.shape[:-2], n, n)), F @ C
    covariance[..., prior[:, None], prior] = C
    covariance[..., frames[:, None], prior] = -carried
    covariance[..., prior[:, None], frames] = -_turned(carried)
    covariance[..., frames[:, None], frames] = inverse + carried @ _turned(F)
    return covariance


def _with_loose(found: Posterior, loose: np.ndarray) -> Posterior:
    if not loose.any():
        return found
    covariance, frames = found.covariance.copy(), np.flatnonzero(~found.has_prior)
    covariance[..., frames[:, None], frames] += loose
    return replace(found, covariance=covariance)


def _floor(diagonal: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the information, in units of the priors', below which a direction may be made up by rounding."""
    known = np.where(np.isfinite(sizes), sizes, 0.0)
    return np.asarray(NULL * np.max(diagonal * known**2, axis=-1, initial=0.0))


def _invert_frames(G: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the inverse over what is determined, its rank, and variances of (1 m, 1 rad)^2 along the rest."""
    scale = 1.0 / np.sqrt(np.maximum(_diagonal(G), 1e-300))
    values, vectors = np.linalg.eigh(G * _outer(scale))
    seen = (values > NULL * np.maximum(np.max(values, axis=-1, initial=0.0), 1e-300)[..., None])[..., None, :]
    axes = scale[..., :, None] * vectors
    inverse = np.where(seen, axes, 0.0) / np.where(seen, values[..., None, :], 1.0)
    rest = np.where(seen, 0.0, axes)
    rest = rest / np.maximum(np.abs(rest).max(axis=-2, keepdims=True, initial=0.0), 1e-300)
    return inverse @ _turned(axes), np.sum(seen, axis=(-2, -1)), rest @ _turned(rest)
