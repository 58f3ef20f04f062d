r"""The posterior of normal equations and priors, and the elimination of a station's own parameters.

With H = J^T W J, g = J^T W r and priors of size D on some parameters, the step to the posterior
mode is found in the eigenvectors of the prior-scaled Schur complement: the frames of base and tool,
which have no prior, are eliminated first. An eigenvalue lambda is the information of the data in
units of the prior's. Directions with lambda far above 1 follow the data alone, those far below 1
the prior alone, and unobservable ones (lambda below rounding) remain at the prior's centre,
whatever the noise: so predictions never depend on the choice of gauge.

H squares the condition number, at no cost here: steps only have to point well enough to converge,
the residuals that they act on are exact, and a direction below 1e-7 of the largest moves
predictions by less than 1e-10 m.

For several stations, each with the Jacobian [R F] with respect to the robot's parameters and its
own, the latter are eliminated station by station, their priors P included, and only the remainders
are summed:

.. math:: A = R^T W R - R^T W F \, K \, F^T W R, \qquad
          b = R^T W r - R^T W F \, K \, (F^T W r - P x), \qquad
          K = (F^T W F + P)^{-1} .
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from pincal.identify.jacobian import span
from pincal.identify.quadratic import NULL, Form, taken
from pincal.parameters import Covariance, root_of
from pincal.thresholds import Scale

# Spurious information due to rounding, in units of the prior's, below which it may remain in a
# solve.
_ROUNDING: Scale = 1e-3


class Nonzero(NamedTuple):
    """The E entries of a symmetric matrix that are not zero: of smooth curves, few."""

    rows: np.ndarray
    columns: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, matrix: np.ndarray) -> Nonzero:
        """Return those of a matrix."""
        rows, columns = np.nonzero(matrix)
        return cls(rows, columns, matrix[rows, columns])

    @classmethod
    def joined(cls, parts: Sequence[Nonzero]) -> Nonzero:
        """Return those of the sum of matrices that have no entry in common, row by row."""
        if not parts:
            return cls(np.zeros(0, int), np.zeros(0, int), np.zeros(0))
        rows, columns, values = map(np.concatenate, zip(*parts, strict=True))
        order = np.lexsort((columns, rows))
        return cls(rows[order], columns[order], values[order])

    def times(self, matrix: np.ndarray) -> float:
        """Return the sum of the products with the entries of another matrix."""
        return float(matrix[self.rows, self.columns] @ self.values)


@dataclass(frozen=True, eq=False)
class Posterior:
    """The posterior of F parameters, in units of the noise; of each of S stations with a leading
    axis.

    Of several stations these are the shared parameters, and ``own`` holds the eliminated ones of
    each station.

    Attributes:
        form: of the F parameters; rounding is judged by its diagonal before any elimination.
        sizes: shape (F,), standard deviations of the priors; inf for none.
        offsets: shape (F,), present values minus the priors' centres.
        own: the parameters of stations that were eliminated.
        believed: the part of H that is not from data: an earlier fit, smooth curves; None for
            nothing.
    """

    form: Form
    sizes: np.ndarray
    offsets: np.ndarray
    own: tuple[Eliminated, ...] = ()
    believed: Nonzero | None = None

    def part(self, at: np.ndarray) -> Posterior:
        """Return the posterior of the parameters at some indices, conditional on the others."""
        return Posterior(self.form.part(at), self.sizes[..., at], self.offsets[..., at])

    @cached_property
    def _solved(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Step, covariance over what is determined, information and directions."""
        prior, frames = self._parts
        inverse, *_ = self._frames
        F = self._follow
        H = self.form.H
        g = self.form.g
        D = self.sizes[..., prior]
        reduced = (g[..., prior] - _times(_turned(F), g[..., frames])) * D
        # Of many parameters each matrix more is felt.
        information, V = np.linalg.eigh(_symmetric(self._scaled_complement))
        floor = np.maximum(self._floor, NULL * 1e-300)
        information = np.where(information > floor[..., None], information, 0.0)
        data = np.where(information > 0.0, _times(_turned(V), reduced), 0.0)
        shift = D * _times(
            V, (data - _times(_turned(V), self.offsets[..., prior] / D)) / (information + 1.0)
        )
        step = np.empty_like(g)
        step[..., prior] = shift
        step[..., frames] = _times(inverse, g[..., frames]) - _times(F, shift)
        C = (V / (information + 1.0)[..., None, :]) @ _turned(V)
        C *= _outer(D)
        covariance = np.empty(H.shape)
        carried = F @ C
        covariance[..., prior[:, None], prior] = C
        covariance[..., frames[:, None], prior] = -carried
        covariance[..., prior[:, None], frames] = -_turned(carried)
        covariance[..., frames[:, None], frames] = inverse + carried @ _turned(F)
        return step, covariance, information, V

    @property
    def _scaled_complement(self) -> np.ndarray:
        """Information on what has a prior, frames eliminated, in units of the priors."""
        prior, frames = self._parts
        H = self.form.H
        S = taken(H, prior)
        S -= H[..., prior[:, None], frames] @ self._follow
        S *= _outer(self.sizes[..., prior])
        return np.asarray(S)

    @property
    def step(self) -> np.ndarray:
        """From the present values to the most probable ones, shape (F,)."""
        return self._solved[0]

    @property
    def determined(self) -> np.ndarray:
        """The covariance, shape (F, F), with zero variance along undetermined
        directions of frames.
        """
        return self._solved[1]

    @cached_property
    def covariance(self) -> np.ndarray:
        """Their covariance, shape (F, F)."""
        _, axes, seen = self._frames
        _, frames = self._parts
        covariance = self.determined
        if not seen.all():
            # Variances of (1 m, 1 rad)^2 along undetermined directions.
            rest = np.where(seen, 0.0, axes)
            covariance = covariance.copy()
            rest = rest / np.maximum(np.abs(rest).max(axis=-2, keepdims=True, initial=0.0), 1e-300)
            covariance[..., frames[:, None], frames] += rest @ _turned(rest)
        return covariance

    @property
    def information(self) -> np.ndarray:
        """Eigenvalues of the data's information in units of the priors', ascending; 0 for
        unobservable directions.
        """
        return self._solved[2]

    @property
    def directions(self) -> np.ndarray:
        """Their eigenvectors in units of the priors, as columns, over the parameters
        with a prior.
        """
        return self._solved[3]

    @property
    def frame_rank(self) -> np.ndarray:
        """Number of directions of base and tool that the data determine; of several stations for
        each.
        """
        return np.asarray(np.sum(self._frames[2], axis=(-2, -1)))

    @property
    def visible_rank(self) -> int:
        """Number of directions that the data observe at all, however weakly."""
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
        """Effective number of parameters, priors accounted for."""
        shared, own = self.spent
        return shared + sum(own)

    @cached_property
    def spent(self) -> tuple[float, tuple[float, ...]]:
        """The effective number of the shared parameters, and of each station's own.

        Where rounding permits, a Cholesky factor takes a fifth of the time of the eigenvectors.
        """
        found = self._known_by_factor()
        if found is None:
            covariance = self.covariance
            known = float(np.sum(self.information / (1.0 + self.information)))
            known -= 0.0 if self.believed is None else self.believed.times(covariance)
        else:
            known, covariance = found
        own = tuple(
            float(n) for part in self.own for n in np.atleast_1d(part.effective(covariance))
        )
        return float(np.sum(self.frame_rank)) + known, own

    def _known_by_factor(self) -> tuple[float, np.ndarray] | None:
        """Return the effective number of the parameters with a prior, and, if stations have
        parameters of their own, the covariance of all, shape (F, F); None where rounding forbids.
        """
        _, frames = self._parts
        believed = self.believed
        is_apart = (self.own and len(frames)) or (
            believed is not None and not self.has_prior[believed.rows].all()
        )
        factor = None if is_apart else self._factor()
        C, failed = (None, 1) if factor is None else dpotri(factor, lower=1, overwrite_c=1)
        if C is None or failed:
            return None
        spent = float(np.sum(1.0 - np.diag(C)))
        if believed is not None:
            sizes = self.sizes[believed.rows] * self.sizes[believed.columns]
            slot = np.cumsum(self.has_prior) - 1
            pair = np.sort([slot[believed.rows], slot[believed.columns]], axis=0)
            spent -= float(C[pair[1], pair[0]] @ (sizes * believed.values))
        if not self.own:
            return spent, C
        # Not kept, as the covariance by eigenvectors would be with each fit of a search.
        covariance = np.tril(C, -1)
        covariance += covariance.T
        covariance.flat[:: len(C) + 1] = np.diag(C)
        covariance *= self.sizes
        covariance *= self.sizes[:, None]
        return spent, covariance

    @cached_property
    def is_shared(self) -> np.ndarray:
        """Which of all parameters do not belong to single stations, shape (all,)."""
        shared = np.ones(len(self.sizes) + sum(part.places.size for part in self.own), bool)
        for part in self.own:
            shared[part.places] = False
        return shared

    @property
    def joint_covariance(self) -> Covariance:
        """The covariance of all parameters, including those of stations, in their order."""
        if not self.own:
            return Covariance.of(self.covariance)
        root = root_of(self.covariance)
        factor = np.empty((len(self.is_shared), len(root)))
        groups = list[tuple[np.ndarray, np.ndarray]]()
        factor[self.is_shared] = root
        for part in self.own:
            places = part.places
            blocks = part.alone.covariance
            factor[places] = -part.carried @ root[part.shared]
            groups += [(places, blocks)] if places.ndim == 1 else zip(places, blocks, strict=True)
        return Covariance(factor, tuple(groups))

    def _everywhere(self, of: Callable[[Posterior], np.ndarray]) -> np.ndarray:
        """Return a vector over all parameters, from its parts for the shared ones and each
        station's own.
        """
        found = np.empty(len(self.is_shared))
        found[self.is_shared] = of(self)
        for part in self.own:
            found[part.places] = of(part.alone)
        return found

    @property
    def whole(self) -> np.ndarray:
        """The diagonal of all parameters' information before any elimination."""
        return self._everywhere(lambda found: found.form.whole)

    @property
    def metric(self) -> np.ndarray:
        """Influence of each of all parameters on readings and prior."""
        return self._everywhere(lambda found: np.sqrt(found.form.whole + found.sizes**-2.0))

    def step_within(
        self, bounds: np.ndarray, damping: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the most probable step of all parameters within bounds on their values, and which
        ones a bound stops.

        Args:
            bounds: largest values of all parameters.
            damping: precision, in units of the priors', of an additional prior at the present
                values (Levenberg): it stops weakly determined directions only.
        """
        at = self.offsets
        most = bounds[self.is_shared]
        form = self.form
        # The slope of the priors is unchanged.
        stiffness = 1.0 + damping
        # What is asked of the same posterior again, as of the step that ends a fit, is known.
        firm = self
        if damping:
            firm = Posterior(form, self.sizes / np.sqrt(stiffness), at / stiffness)
        step = firm._quick_step
        held = np.zeros(len(at), bool)
        for _ in range(3):
            over = ~held & (np.abs(at + step) > most)
            if not over.any():
                break
            held |= over
            step = np.where(held, np.copysign(most, at + step) - at, step)
            moved = replace(firm, form=replace(form, g=form.g - form.H[:, held] @ step[held]))
            step[~held] = moved.part(np.flatnonzero(~held))._quick_step
        whole = np.empty(len(self.is_shared))
        stopped = np.zeros(len(self.is_shared), bool)
        whole[self.is_shared] = step
        stopped[self.is_shared] = held
        for part in self.own:
            at = part.alone.offsets
            most = bounds[part.places]
            wanted = at + part.step(step)
            whole[part.places] = np.clip(wanted, -most, most) - at
            stopped[part.places] = np.abs(wanted) > most
        return whole, stopped

    def square(self, step: np.ndarray) -> float:
        """Return the squared length of a step of all parameters: how far it moves the readings, in
        units of the noise.
        """
        across = step[self.is_shared]
        return float(across @ self.form.H @ across) + sum(
            part.square(step[part.places], across) for part in self.own
        )

    def gain(self, kept: np.ndarray) -> float:
        """Return how much a step reduces the sum of squares if only some of all parameters may
        move.

        Only shared parameters count; the gain of eliminated ones by themselves is excluded.
        """
        some = self.part(np.flatnonzero(kept[self.is_shared]))
        return float((some.form.g - some.offsets / some.sizes**2) @ some._quick_step)

    def gains_beyond(self, kept: np.ndarray) -> Callable[[np.ndarray], float]:
        """Return the function that tells how much more than :meth:`gain` with some of all
        parameters a step gains if others, a mask of all, may move as well.

        The former are eliminated once for all of these.
        """
        is_kept = kept[self.is_shared]
        rest = self._beyond(np.flatnonzero(is_kept), np.flatnonzero(~is_kept))
        if rest is None:
            before = self.gain(kept)
            return lambda more: self.gain(kept | more) - before
        return lambda more: rest.gain(more[self.is_shared][~is_kept])

    def _beyond(self, kept: np.ndarray, others: np.ndarray) -> Posterior | None:
        """Return the posterior of the others, those kept at their best; None where rounding
        forbids.
        """
        base = self.part(kept)
        factor = base._factor()
        if factor is None:
            return None
        across = self.form.H[kept[:, None], others]
        slope = base.form.g - base.offsets / base.sizes**2
        solved = base._by_factor(factor, np.column_stack([across, slope]))
        H = self.form.H[others[:, None], others] - across.T @ solved[:, :-1]
        form = Form(H, self.form.g[others] - across.T @ solved[:, -1], self.form.whole[others])
        return Posterior(form, self.sizes[others], self.offsets[others])

    def _by_factor(self, factor: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return the inverse of the posterior precision times columns, shape (F, n), by the factor
        of :meth:`_factor`.
        """
        prior, frames = self._parts
        D = self.sizes[prior, None]
        found = np.empty(right.shape)
        reduced = (right[prior] - self._follow.T @ right[frames]) * D
        found[prior] = D * dpotrs(factor, reduced, lower=1)[0]
        found[frames] = self._frames[0] @ right[frames] - self._follow @ found[prior]
        return found

    @cached_property
    def _quick_step(self) -> np.ndarray:
        """The step; where rounding permits by a Cholesky factor, in a tenth of the time of the
        eigenvectors.
        """
        prior, frames = self._parts
        inverse, *_ = self._frames
        F = self._follow
        if not len(prior):
            return np.asarray(inverse @ self.form.g)
        factor = self._factor()
        if factor is None:
            return self.step
        D = self.sizes[prior]
        g = self.form.g
        reduced = (g[prior] - F.T @ g[frames]) * D - self.offsets[prior] / D
        step = np.empty(len(g))
        step[prior] = D * dpotrs(factor, reduced, lower=1)[0]
        step[frames] = inverse @ g[frames] - F @ step[prior]
        return step

    def steps_of_each(self) -> np.ndarray | None:
        """Return the steps of S posteriors with the same priors, shape (S, F), by Cholesky factors;
        None where rounding forbids one.
        """
        prior, frames = self._parts
        inverse, *_ = self._frames
        F = self._follow
        H = self.form.H
        g = self.form.g
        if not len(prior):
            return _times(inverse, g)
        if np.any(self._floor > _ROUNDING):
            return None
        D = self.sizes[prior]
        at = span(prior)
        S = H[:, at, at] if isinstance(at, slice) else taken(H, at)
        S = S - H[..., prior[:, None], frames] @ F
        S *= D
        S *= D[:, None]
        S[:, range(len(D)), range(len(D))] += 1.0
        reduced = (g[..., prior] - _times(_turned(F), g[..., frames])) * D
        reduced -= self.offsets[prior] / D
        step = np.empty_like(g)
        for of_one, precision, slope in zip(step, S, reduced, strict=True):
            factor, failed = dpotrf(precision.T, lower=1, overwrite_a=1)
            if failed:
                return None
            of_one[prior] = D * dpotrs(factor, slope, lower=1)[0]
        step[..., frames] = _times(inverse, g[..., frames]) - _times(F, step[..., prior])
        return step

    @cached_property
    def has_prior(self) -> np.ndarray:
        """Which parameters have a prior, shape (F,); the same for all stations."""
        return np.asarray(np.isfinite(self.sizes if self.sizes.ndim == 1 else self.sizes[0]))

    @cached_property
    def _parts(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the parameters with a prior, and of frames, which have none."""
        return np.flatnonzero(self.has_prior), np.flatnonzero(~self.has_prior)

    @cached_property
    def _frames(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The inverse of the frames' H over what is determined, all axes as columns, and which of
        them are determined.
        """
        frames = self._parts[1]
        H = self.form.H[..., frames[:, None], frames]
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("...ii->...i", H), 1e-300))
        values, vectors = np.linalg.eigh(H * _outer(scale))
        seen = (
            values > NULL * np.maximum(np.max(values, axis=-1, initial=0.0), 1e-300)[..., None]
        )[..., None, :]
        axes = scale[..., :, None] * vectors
        inverse = np.where(seen, axes, 0.0) / np.where(seen, values[..., None, :], 1.0)
        return inverse @ _turned(axes), axes, seen

    @cached_property
    def _follow(self) -> np.ndarray:
        """How far the parameters with a prior move the frames, with the opposite sign."""
        prior, frames = self._parts
        return np.asarray(self._frames[0] @ self.form.H[..., frames[:, None], prior])

    @cached_property
    def _floor(self) -> np.ndarray:
        """The information, in units of the priors', below which a direction may be due
        to rounding.
        """
        known = np.where(np.isfinite(self.sizes), self.sizes, 0.0)
        return np.asarray(NULL * np.max(self.form.whole * known**2, axis=-1, initial=0.0))

    def _factor(self) -> np.ndarray | None:
        """Return the lower Cholesky factor of :meth:`_reduced`; None where rounding forbids.

        Frames that the readings hardly distinguish, as of a planar arm, leave more rounding than
        the floor allows for.
        """
        if self._floor > _ROUNDING or not len(self._parts[0]):
            return None
        # By LAPACK itself: of small matrices SciPy's checks take as long.
        factor, failed = dpotrf(self._reduced(), lower=1, overwrite_a=1)
        return None if failed else np.asarray(factor)

    def _reduced(self) -> np.ndarray:
        """Return the posterior precision in units of the priors, frames eliminated; column-major
        for LAPACK.

        For large matrices copying takes the time, so as few copies as possible are made.
        """
        prior, frames = self._parts
        D = self.sizes[prior]
        H = self.form.H
        at = span(prior)
        # Mostly frames stand together, and the others are a block, which needs no copy of its own.
        S = H[at, at] if isinstance(at, slice) else taken(H, at)
        S = S - H[prior[:, None], frames] @ self._follow
        S *= D
        S *= D[:, None]
        S.flat[:: len(S) + 1] += 1.0
        return np.asarray(S.T)


@dataclass(frozen=True)
class Eliminated:
    """The E eliminated parameters of one station, or of each of S stations (leading axis S).

    Attributes:
        alone: their posterior conditional on the shared parameters.
        carried: shape (E, C), K F'WR: how far a step of the C shared parameters moves them, with
            the opposite sign.
        places: shape (E,), indices among all free parameters.
        shared: shape (C,), indices of these stations' shared parameters among all shared ones.
    """

    alone: Posterior
    carried: np.ndarray
    places: np.ndarray
    shared: np.ndarray

    @property
    def precision(self) -> np.ndarray:
        """P, shape (E,)."""
        return np.asarray(self.alone.sizes**-2.0)

    def step(self, shared_step: np.ndarray) -> np.ndarray:
        """Return their step, shape (E,), given the step of all shared parameters."""
        return np.asarray(self.alone.step - self.carried @ shared_step[self.shared])

    def square(self, step: np.ndarray, shared_step: np.ndarray) -> float:
        """Return what they add to the squared length of a step, shape (E,), in the information of
        the data alone.
        """
        along = step + self.carried @ shared_step[self.shared]
        data = along * _times(self.alone.form.H, along)
        return float(np.sum(data + self.precision * (along**2 - step**2)))

    def effective(self, covariance: np.ndarray) -> np.ndarray:
        """Return their effective number, shape () or (S,), for the covariance of all shared
        parameters.
        """
        mine = covariance[np.ix_(self.shared, self.shared)]
        variance = np.einsum("...ii->...i", self.alone.covariance) + np.sum(
            (self.carried @ mine) * self.carried, axis=-1
        )
        # A parameter without a prior counts as far as the data determine it.
        return np.asarray(
            self.alone.frame_rank
            + np.sum(self.alone.has_prior - variance * self.precision, axis=-1)
        )


def eliminate(
    form: Form, own: np.ndarray, sizes: np.ndarray, offsets: np.ndarray
) -> tuple[Form, Eliminated]:
    """Eliminate parameters from the information of one station, or of each of S stations (leading
    axis S).

    Args:
        form: of F parameters.
        own: shape (F,), which parameters to eliminate; the same for all stations.
        sizes: shape (F,), standard deviations of the priors; inf for none. Only those of eliminated
            parameters matter.
        offsets: shape (F,), present values minus the priors' centres.

    Returns:
        The form of the C others, summed over stations, and the eliminated parameters.
    """
    shared = np.flatnonzero(~own)
    own = np.flatnonzero(own)
    alone = Posterior(form, sizes, offsets).part(own)
    across = form.H[..., own[:, None], shared]
    if not len(own):
        return form.sum(), Eliminated(alone, across, own, np.arange(len(shared)))
    carried = alone.determined @ across
    # In place, as a part is a copy.
    left = form.part(shared)
    left.H[...] -= _turned(across) @ carried
    left.g[...] -= _times(_turned(across), alone.step)
    return left.sum(), Eliminated(alone, carried, own, np.arange(len(shared)))


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    """Return the symmetric part of a matrix."""
    both = matrix + _turned(matrix)
    both *= 0.5
    return np.asarray(both)


def _turned(matrix: np.ndarray) -> np.ndarray:
    return matrix.swapaxes(-1, -2)


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _outer(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector[..., :, None] * vector[..., None, :])
