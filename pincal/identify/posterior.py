r"""What normal equations say together with priors, and how a station's own parameters are eliminated from them.

With H = J^T W J, g = J^T W r and priors of size D on some parameters, the step that the posterior wants is found in the
eigenvectors of the prior-scaled Schur complement: the frames of base and tool, which have no prior, are eliminated first.
An eigenvalue lambda is the information of the data in units of the prior's. Directions with lambda far above 1 follow the
data alone, those far below 1 the prior alone, and those that the data can't see at all (lambda below rounding) stay at the
prior's centre, whatever the noise: so predictions never depend on the choice of gauge.

H squares the condition number. That costs nothing here: steps only have to point well enough to converge, the residuals
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
from scipy.linalg import cho_solve, cholesky
from scipy.linalg.lapack import dpotri

from pincal.identify.quadratic import NULL, Form
from pincal.parameters import Covariance, root_of

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
        balance: what the station says of them and their priors if the shared parameters stay where they are.
        carried: shape (E, C), K F'WR: how far a step of the C shared parameters moves them the other way.
        places: shape (E,), where they stand among all free parameters.
        shared: shape (C,), where the parameters that these stations share with others stand among the shared ones.
    """

    balance: Balance
    carried: np.ndarray
    places: np.ndarray
    shared: np.ndarray

    @property
    def precision(self) -> np.ndarray:
        """P, shape (E,)."""
        return np.asarray(self.balance.sizes**-2.0)

    @property
    def alone(self) -> Posterior:
        """What both say together."""
        return self.balance.posterior

    def step(self, shared_step: np.ndarray) -> np.ndarray:
        """Return their step, shape (E,), once the step of all shared parameters is known."""
        return np.asarray(self.alone.step - self.carried @ shared_step[self.shared])

    def square(self, step: np.ndarray, shared_step: np.ndarray) -> float:
        """Return what they add to the square of a step, shape (E,), measured by the information of the data alone."""
        along = step + self.carried @ shared_step[self.shared]
        data = along * _times(self.balance.form.H, along)
        return float(np.sum(data + self.precision * (along**2 - step**2)))

    def effective(self, covariance: np.ndarray) -> np.ndarray:
        """Return how many parameters the data spend on them, shape () or (S,), for the covariance of all shared ones."""
        mine = covariance[np.ix_(self.shared, self.shared)]
        variance = np.einsum("...ii->...i", self.alone.covariance) + np.sum((self.carried @ mine) * self.carried, axis=-1)
        # Without a prior a parameter is spent as far as the data determine it.
        return np.asarray(self.alone.frame_rank + np.sum(self.alone.has_prior - variance * self.precision, axis=-1))


@dataclass(frozen=True, eq=False)
class Balance:
    """What readings say of F parameters, in units of the noise, and their priors; of each of S stations with a leading axis.

    Where rounding lets a Cholesky factor do, the step and the number of parameters spent are found by it, in a tenth of the
    time that the eigenvectors of :attr:`posterior` take.

    Attributes:
        form: of the F parameters; rounding is judged by what it was before anything was eliminated.
        sizes: shape (F,), standard deviations of the priors; inf for none.
        offsets: shape (F,), present values minus the priors' centres.
    """

    form: Form
    sizes: np.ndarray
    offsets: np.ndarray

    def part(self, at: np.ndarray) -> Balance:
        """Return that of some parameters, by their places, the others held."""
        return Balance(self.form.part(at), self.sizes[..., at], self.offsets[..., at])

    @cached_property
    def posterior(self) -> Posterior:
        """What they say together."""
        found = self.determined
        if not (loose := self._frames[2]).any():
            return found
        covariance, frames = found.covariance.copy(), self._parts[1]
        covariance[..., frames[:, None], frames] += loose
        return replace(found, covariance=covariance)

    @cached_property
    def determined(self) -> Posterior:
        """The same over what is determined: frames' directions that nothing determines have no variance."""
        (prior, frames), (inverse, frame_rank, _), F = self._parts, self._frames, self._follow
        H, g, D = self.form.H, self.form.g, self.sizes[..., prior]
        S = (H[..., prior[:, None], prior] - H[..., prior[:, None], frames] @ F) * _outer(D)
        reduced = (g[..., prior] - _times(_turned(F), g[..., frames])) * D
        information, V = np.linalg.eigh(0.5 * (S + _turned(S)))
        floor = np.maximum(self._floor, NULL * 1e-300)
        information = np.where(information > floor[..., None], information, 0.0)
        data = np.where(information > 0.0, _times(_turned(V), reduced), 0.0)
        shift = D * _times(V, (data - _times(_turned(V), self.offsets[..., prior] / D)) / (information + 1.0))
        step = np.empty_like(g)
        step[..., prior] = shift
        step[..., frames] = _times(inverse, g[..., frames]) - _times(F, shift)
        C = (V / (information + 1.0)[..., None, :]) @ _turned(V) * _outer(D)
        covariance, carried = np.empty(H.shape), F @ C
        covariance[..., prior[:, None], prior] = C
        covariance[..., frames[:, None], prior] = -carried
        covariance[..., prior[:, None], frames] = -_turned(carried)
        covariance[..., frames[:, None], frames] = inverse + carried @ _turned(F)
        return Posterior(step, covariance, information, V, frame_rank, self.has_prior)

    @cached_property
    def step(self) -> np.ndarray:
        """The step of the posterior, shape (F,)."""
        (prior, frames), (inverse, _, _), F = self._parts, self._frames, self._follow
        factor = self._factor()
        if factor is None:
            return self.posterior.step
        D, g = self.sizes[prior], self.form.g
        reduced = (g[prior] - F.T @ g[frames]) * D - self.offsets[prior] / D
        step = np.empty(len(g))
        step[prior] = D * cho_solve((factor, True), reduced, check_finite=False)
        step[frames] = inverse @ g[frames] - F @ step[prior]
        return step

    def spent(self, believed: np.ndarray | None = None) -> float | None:
        """Return :attr:`Posterior.shared_effective` alone; None where rounding forbids.

        Args:
            believed: shape (F, F), the part of H that is no data; default: none of it.
        """
        prior, frames = self._parts
        factor = None if believed is not None and np.any(believed[frames]) else self._factor()
        if factor is None:
            return None
        C, failed = dpotri(factor, lower=1, overwrite_c=1)
        if failed:
            return None
        spent = float(self._frames[1]) + float(np.sum(1.0 - np.diag(C)))
        if believed is None:
            return spent
        known = believed[prior[:, None], prior] * _outer(self.sizes[prior])
        return spent - float(2.0 * np.sum(np.tril(C, -1) * known) + np.diag(C) @ np.diag(known))

    @cached_property
    def has_prior(self) -> np.ndarray:
        """Which parameters have a prior, shape (F,); of all stations the same."""
        return np.asarray(np.isfinite(self.sizes if self.sizes.ndim == 1 else self.sizes[0]))

    @cached_property
    def _parts(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the parameters with a prior stand, and frames, which have none."""
        return np.flatnonzero(self.has_prior), np.flatnonzero(~self.has_prior)

    @cached_property
    def _frames(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of frames' H the inverse over what is determined, its rank, and variances of (1 m, 1 rad)^2 along the rest."""
        frames = self._parts[1]
        H = self.form.H[..., frames[:, None], frames]
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("...ii->...i", H), 1e-300))
        values, vectors = np.linalg.eigh(H * _outer(scale))
        seen = (values > NULL * np.maximum(np.max(values, axis=-1, initial=0.0), 1e-300)[..., None])[..., None, :]
        axes = scale[..., :, None] * vectors
        inverse = np.where(seen, axes, 0.0) / np.where(seen, values[..., None, :], 1.0)
        rest = np.where(seen, 0.0, axes)
        rest = rest / np.maximum(np.abs(rest).max(axis=-2, keepdims=True, initial=0.0), 1e-300)
        return inverse @ _turned(axes), np.sum(seen, axis=(-2, -1)), rest @ _turned(rest)

    @cached_property
    def _follow(self) -> np.ndarray:
        """How far the parameters with a prior move the frames the other way."""
        prior, frames = self._parts
        return np.asarray(self._frames[0] @ self.form.H[..., frames[:, None], prior])

    @cached_property
    def _floor(self) -> np.ndarray:
        """The information, in units of the priors', below which a direction may be made up by rounding."""
        known = np.where(np.isfinite(self.sizes), self.sizes, 0.0)
        return np.asarray(NULL * np.max(self.form.whole * known**2, axis=-1, initial=0.0))

    def _factor(self) -> np.ndarray | None:
        """Return the lower Cholesky factor of :meth:`_reduced`; None where rounding forbids.

        Frames that the readings hardly tell apart, as of a planar arm, leave more rounding than the floor knows of.
        """
        if self._floor > _ROUNDING or not len(self._parts[0]):
            return None
        try:
            return np.asarray(cholesky(self._reduced(), lower=True, overwrite_a=True, check_finite=False))
        except np.linalg.LinAlgError:
            return None

    def _reduced(self) -> np.ndarray:
        """Return information in units of the priors plus that of these, without what frames absorb; column-major for LAPACK.

        Of large matrices, the time goes into moving them: as few copies as can be are made.
        """
        prior, frames = self._parts
        D = self.sizes[prior]
        S = np.take(np.take(self.form.H, prior, axis=0), prior, axis=1)
        S -= self.form.H[prior[:, None], frames] @ self._follow
        S *= D
        S *= D[:, None]
        S.flat[:: len(S) + 1] += 1.0
        return S.T


def posterior(form: Form, sizes: np.ndarray, offsets: np.ndarray | None = None) -> Posterior:
    """Combine what readings say with priors; arguments as of :class:`Balance`, default of offsets: none."""
    return Balance(form, sizes, np.zeros(len(sizes)) if offsets is None else offsets).posterior


def eliminate(form: Form, own: np.ndarray, sizes: np.ndarray, offsets: np.ndarray) -> tuple[Form, Eliminated]:
    """Eliminate parameters from what one station says, or each of S stations (leading axis S).

    Args:
        form: of F parameters.
        own: shape (F,), which parameters to eliminate; of all stations the same.
        sizes: shape (F,), standard deviations of the priors; inf for none. Only those of eliminated parameters matter.
        offsets: shape (F,), present values minus the priors' centres.

    Returns:
        What is left of the C others, of several stations their sum, and the eliminated ones.
    """
    shared, own = np.flatnonzero(~own), np.flatnonzero(own)
    left, balance, across = form.part(shared), Balance(form, sizes, offsets).part(own), form.H[..., own[:, None], shared]
    carried = across
    if len(own):
        carried, step = balance.determined.covariance @ across, balance.determined.step
        left = replace(left, H=left.H - _turned(across) @ carried, g=left.g - _times(_turned(across), step))
    return left.sum(), Eliminated(balance, carried, own, np.arange(len(shared)))


def _turned(matrix: np.ndarray) -> np.ndarray:
    return matrix.swapaxes(-1, -2)


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _outer(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector[..., :, None] * vector[..., None, :])
