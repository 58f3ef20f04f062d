r"""What a calibrated model lacks, as part of the uncertainty of its predictions.

The covariance of the parameters says nothing of effects that the model does not describe: on real
arms 95 % intervals by it alone cover a fifth to four fifths of the readings. Residuals at poses
that a fit has not seen, by folds of whole regions of joint space, do tell (Kennedy and O'Hagan
2001, J. R. Stat. Soc. B 63, 425-464). At a pose q with the levers L_j of its drives the discrepancy
of the position is taken to be

.. math:: \delta(q) = \sum_j L_j(q) \, f_j(q_j) + w(q),

with an error f_j of each drive, a Gaussian process in its own angle, and a rest w that no other
pose shares. So what is near in joint space errs alike, and differences of near poses are known
better than the poses. The covariance of f_j is a sum over lengths,

.. math:: \operatorname{cov}(f_j(a), f_j(b)) = \sum_l s_{jl}^2 \, (1 + d) e^{-d},
          \qquad d = \sqrt 3 \, |a - b| / l ,

and all variances are linear in the products of the residuals of two poses: non-negative least
squares, once plain and once weighted by the covariances found, estimate them. A factor brings the
intervals to what the residuals show (a conformal quantile: Barber et al. 2021, Ann. Stat. 49,
486-507).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from msgspec.structs import replace as changed
from scipy.linalg import block_diag, solve_triangular
from scipy.optimize import nnls
from scipy.special import log_ndtr

from pincal.calibration.calibration_numbers import DISCREPANCY
from pincal.calibration.left_out_variance import left_out_variances
from pincal.calibration.position_covariance import SharedErrors
from pincal.identify.fit import ModelFit
from pincal.identify.folds import left_out_residuals
from pincal.identify.motion_fields import displacements_by_drives
from pincal.identify.split import joint_regions
from pincal.identify.station import Station
from pincal.io.arrays import ArrayShape, Matrix, Numbers, Record
from pincal.io.strict_json import Fault
from pincal.measure.poses import SCATTER, same_joints
from pincal.model.motions import with_moving_drives
from pincal.thresholds import Count, Scale
from pincal.validate.misfit import Verdict

# Lengths over which drives err alike [rad or m].
_LENGTHS: tuple[Scale, ...] = (0.05, 0.2, 0.8)
# Poses from whose pairs the variances are estimated, and their seed.
_MOST: Count = 100
_SEED: Count = 0
# Mean lever of a drive below which it displaces no target [m/rad or m/m].
_LEVER: Scale = 1e-3
# Part of the mean variance that weights take at least to be of single poses: where the first
# estimate has none, they would else rest on differences of a few near poses alone.
_SINGLE: Scale = 0.1
# Largest factor on standard deviations, and the accuracy of a factor.
_LARGEST: Scale = 30.0
_CLOSE: Scale = 1e-4
# Angles of a drive between which its errors are interpolated, and the part of their variance that
# keeps their covariance regular where angles nearly coincide.
_ANGLES: Count = 128
_RIDGE: Scale = 1e-10
# Standard deviations that hold 95 % of a normal variable.
_NORMAL: Scale = 1.959964


class Discrepancy(Record, frozen=True, kw_only=True):
    """The covariance of what a model lacks, for an arm with n joints.

    Attributes:
        lengths: shape (L,), over which drives err alike [rad or m].
        drives: shape (n, L), variances of the errors of the drives [rad^2 or m^2].
        rest: variance of a coordinate of the target that no other pose shares [m^2].
        factor: on all standard deviations, by which intervals cover what they say.
        coordinates: number of coordinates of residuals at poses not fitted on which it rests.
        turn_rest: variance of a component of the target's orientation beside that of the drives, of
            no other pose [rad^2]; 0 where no orientations were read.
        turn_factor: on standard deviations of orientations.
    """

    lengths: Annotated[Numbers, ArrayShape("lengths")]
    drives: Annotated[Matrix, ArrayShape("joints", "lengths")]
    rest: float
    factor: float
    coordinates: int
    turn_rest: float = 0.0
    turn_factor: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.any(self.drives < 0.0):
            raise Fault("has a negative entry", "variances of 0 or more", key=".drives")
        if np.any(self.lengths <= 0.0):
            raise Fault("has an entry of 0 or less", "positive lengths", key=".lengths")
        for name in ("rest", "factor", "turn_rest", "turn_factor"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise Fault(f"is {getattr(self, name)}", "a number of 0 or more", key=f".{name}")

    def variances(self, levers: np.ndarray) -> np.ndarray:
        """Return the covariance of the target's position at each of N poses, shape (N, 3, 3) [m^2].

        Args:
            levers: shape (n, N, 3), motion of the target by each drive [m/rad or m/m].
        """
        of_drives = np.einsum("j,jna,jnb->nab", self.drives.sum(axis=1), levers, levers)
        return np.asarray(self.factor**2 * (of_drives + self.rest * np.eye(3)))

    def turn_variances(self, turns: np.ndarray) -> np.ndarray:
        """Return the variance of the target's orientation at each of N poses, shape (N, 3) [rad^2].

        Args:
            turns: shape (n, N, 3), rotation of the target by each drive [rad/rad or rad/m].
        """
        of_drives = np.einsum("j,jna->na", self.drives.sum(axis=1), turns**2)
        return np.asarray(self.turn_factor**2 * (of_drives + self.turn_rest))

    def with_turns(
        self, residuals: np.ndarray, turns: np.ndarray, noise: np.ndarray
    ) -> Discrepancy:
        """Return the discrepancy with what orientations show of it.

        Args:
            residuals: shape (N, 3), rotation from predicted to read orientations at poses not
                fitted [rad].
            turns: shape (n, N, 3), rotation of the target by each drive [rad/rad or rad/m].
            noise: shape (N,), variance of a component that is known to be of the readings [rad^2].
        """
        # The axes of the residuals are not those of the levers: a mean over them needs none.
        of_drives = np.einsum("j,jna->n", self.drives.sum(axis=1), turns**2) / 3.0
        left = np.mean(residuals**2) - np.mean(of_drives + noise)
        rest = max(float(left), 0.0)
        variance = of_drives + rest + noise
        if not np.all(variance > 0.0):
            return self
        reached = np.quantile(np.abs(residuals) / np.sqrt(variance)[:, None], DISCREPANCY.covered)
        return changed(self, turn_rest=rest, turn_factor=float(reached) / _NORMAL)

    def errors(self, q: np.ndarray, levers: np.ndarray) -> SharedErrors:
        """Return the errors of the target's positions at N poses, as far as they share them.

        Drives at more angles than can be told apart here are interpolated between as many; what
        this leaves is then of each pose alone.

        Args:
            q: shape (N, n), joint positions [rad or m]; equal ones are one pose.
            levers: shape (n, N, 3), motion of the target by each drive [m/rad or m/m].
        """
        common = [np.zeros((len(q), 3, 0))]
        grouped = [np.tile(self.factor * np.sqrt(self.rest) * np.eye(3), (len(q), 1, 1))]
        for j, shared, alone in self.of_drives(q):
            common.append(levers[j][:, :, None] * shared[:, None])
            grouped.append((levers[j] * alone[:, None])[:, :, None])
        pose = np.unique(q, axis=0, return_inverse=True)[1].ravel()
        return SharedErrors(np.concatenate(common, axis=2), np.concatenate(grouped, axis=2), pose)

    def of_drives(self, q: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield each drive that errs, by its number, and its errors at N poses: by common ones of
        unit variance, shape (N, r), and what each pose has beside, shape (N,) [rad or m].

        Args:
            q: shape (N, n), joint positions [rad or m].
        """
        for j, (position, sizes) in enumerate(zip(q.T, self.drives, strict=True)):
            if np.any(sizes):
                shared, alone = self._of_drive(position, sizes)
                yield j, self.factor * shared, self.factor * alone

    def _of_drive(self, position: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors of a drive by common ones, shape (N, r), and what each has beside,
        shape (N,).
        """
        angles = np.unique(position)
        if len(angles) > _ANGLES:
            angles = np.linspace(angles[0], angles[-1], _ANGLES)
        among = np.einsum("l,lab->ab", sizes, _alike(angles, angles, self.lengths))
        among += _RIDGE * sizes.sum() * np.eye(len(angles))
        with_them = np.einsum("l,lab->ab", sizes, _alike(position, angles, self.lengths))
        shared = solve_triangular(np.linalg.cholesky(among), with_them.T, lower=True).T
        left = sizes.sum() - np.sum(shared**2, axis=1)
        return np.asarray(shared), np.sqrt(np.maximum(left, 0.0))


def _alike(q: np.ndarray, others: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the correlation of the errors of a drive at its positions, shape (N,), with those at
    others, shape (M,), for each length, shape (L, N, M).
    """
    apart = np.sqrt(3.0) * np.abs(q[:, None] - others) / np.asarray(lengths)[:, None, None]
    return np.asarray((1.0 + apart) * np.exp(-apart))


def errs_with_drives(residuals: np.ndarray, q: np.ndarray, levers: np.ndarray) -> float:
    """Return how significantly the residuals of a fit follow the position of some drive, in
    standard deviations.

    Residuals along the lever of a drive, sorted by its position, are compared with their
    neighbours: the products are zero on average if they are noise.

    Args:
        residuals: shape (N, 3), of the target's positions [m].
        q: shape (N, n), joint positions.
        levers: shape (n, N, 3), motion of the target by each drive.
    """
    # Readings of a pose share how its drives arrived: they are one.
    pose = np.unique(same_joints(q, SCATTER), return_inverse=True)[1].ravel()
    _, first = np.unique(pose, return_index=True)
    found = [0.0]
    for position, lever in zip(q[first].T, levers, strict=True):
        squares = np.bincount(pose, np.sum(lever**2, axis=1))
        projected = np.bincount(pose, np.einsum("na,na->n", residuals, lever))
        moved = squares > _LEVER**2
        if np.count_nonzero(moved) < DISCREPANCY.fewest or not np.ptp(position[moved]):
            continue
        along = projected[moved] / np.sqrt(squares[moved])
        sign = np.sign(along) * np.sqrt(np.abs(along))
        in_order = sign[np.argsort(position[moved], kind="stable")]
        products = in_order[1:] * in_order[:-1]
        size = np.sqrt(np.sum(products**2))
        found.append(float(np.sum(products) / size) if size else 0.0)
    return max(found)


def discrepancy_of(
    residuals: np.ndarray, q: np.ndarray, levers: np.ndarray, known: np.ndarray
) -> Discrepancy | None:
    """Return the discrepancy that residuals at poses not fitted show; None for too few.

    Args:
        residuals: shape (N, 3), reading minus prediction by a fit without the region of the pose,
            as displacements of the target [m].
        q: shape (N, n), joint positions.
        levers: shape (n, N, 3), motion of the target by each drive.
        known: shape (N, 3, 3), covariance of these that is known to be of the readings and of the
            parameters of the fit [m^2].
    """
    if len(residuals) < DISCREPANCY.fewest:
        return None
    rng = np.random.default_rng(_SEED)
    some = np.sort(rng.permutation(len(residuals))[:_MOST])
    moves = np.sqrt(np.mean(np.sum(levers**2, axis=2), axis=1)) > _LEVER
    drives = np.zeros((q.shape[1], len(_LENGTHS)))
    drives[moves], rest = _variances(
        residuals[some], q[some][:, moves], levers[moves][:, some], known[some]
    )
    plain = Discrepancy(
        lengths=np.array(_LENGTHS),
        drives=drives,
        rest=rest,
        factor=1.0,
        coordinates=residuals.size,
    )
    factor = _factor(
        residuals,
        np.einsum("naa->na", plain.variances(levers)),
        np.einsum("naa->na", known),
    )
    return changed(plain, factor=factor) if factor else None


def hidden_in_noise(
    residuals: np.ndarray, levers: np.ndarray, known: np.ndarray
) -> Discrepancy | None:
    """Return the discrepancy to expect of an adequate model; None for too few residuals.

    That nothing shows in the noise does not say that nothing is there. What is lacking is taken to
    be half of all drives alike, half of no other pose; its variance is the mean of the posterior,
    with the exponential prior of a mean that residuals could just show.

    Args:
        residuals: shape (N, 3), as for :func:`discrepancy_of`.
        levers: shape (n, N, 3).
        known: shape (N, 3, 3).
    """
    size = float(np.mean(np.sum(levers**2, axis=0)))
    if len(residuals) < DISCREPANCY.fewest or not size:
        return None
    drives = np.zeros((len(levers), len(_LENGTHS)))
    drives[:, -1] = 0.5 / size
    unit = Discrepancy(
        lengths=np.array(_LENGTHS), drives=drives, rest=0.5, factor=1.0, coordinates=residuals.size
    )
    shape = np.einsum("naa->na", unit.variances(levers))
    variance = np.einsum("naa->na", known)
    weight = shape / (2.0 * variance**2)
    information = float(np.sum(weight * shape))
    if not 0.0 < information < np.inf:
        return None
    spread = information**-0.5
    found = float(np.sum(weight * (residuals**2 - variance))) / information
    # A normal variable of positive values, its mean shifted by the prior.
    shifted = found / spread - 1.0
    mean = shifted + float(np.exp(-0.5 * shifted**2 - log_ndtr(shifted))) / np.sqrt(2.0 * np.pi)
    return changed(unit, factor=float(np.sqrt(mean * spread)))


def _factor(residuals: np.ndarray, lacking: np.ndarray, known: np.ndarray) -> float:
    """Return the factor on the standard deviations of what is lacking by which intervals cover what
    they say; 0 where what is known does already.

    Args:
        residuals: shape (N, 3).
        lacking: shape (N, 3), variances.
        known: shape (N, 3), variances beside these.
    """

    def covers(factor: float) -> bool:
        u = np.sqrt(factor**2 * lacking + known)
        return bool(np.mean(np.abs(residuals) <= _NORMAL * u) >= DISCREPANCY.covered)

    if covers(0.0) or not np.any(lacking):
        return 0.0
    if not covers(_LARGEST):
        return _LARGEST
    low = 0.0
    high = _LARGEST
    while high - low > _CLOSE * high:
        middle = 0.5 * (low + high)
        if covers(middle):
            high = middle
        else:
            low = middle
    return high


def _variances(
    residuals: np.ndarray, q: np.ndarray, levers: np.ndarray, blocks: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the variances of the drives, shape (n, L), and of the rest, by least squares on the
    products of residuals of all pairs of poses, the second time weighted.
    """
    n = len(residuals)
    known = block_diag(*blocks)
    terms = [
        np.einsum("nm,na,mb->namb", alike, lever, lever).reshape(3 * n, 3 * n)
        for position, lever in zip(q.T, levers, strict=True)
        for alike in _alike(position, position, np.array(_LENGTHS))
    ]
    same = np.all(q[:, None] == q[None], axis=2)
    terms.append(np.kron(same.astype(float), np.eye(3)))
    products = np.outer(residuals.ravel(), residuals.ravel()) - known
    sizes = _least_squares(terms, products)
    covariance = known + sum(size * term for size, term in zip(sizes, terms, strict=True))
    covariance += _SINGLE * np.trace(covariance) / len(covariance) * np.eye(3 * n)
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    sizes = _least_squares([white @ term @ white.T for term in terms], white @ products @ white.T)
    return sizes[:-1].reshape(q.shape[1], -1), float(sizes[-1])


def _least_squares(terms: list[np.ndarray], products: np.ndarray) -> np.ndarray:
    """Return the coefficients, none negative, of the terms of a matrix of products."""
    columns = np.array([term.ravel() for term in terms])
    gram = columns @ columns.T
    scale = np.sqrt(np.diag(gram))
    found, _ = nnls(gram / np.outer(scale, scale), columns @ products.ravel() / scale)
    return np.asarray(found / scale)


def discrepancy_in(fit: ModelFit, verdict: Verdict) -> Discrepancy | None:
    """Return the discrepancy of a fit; None where readings do not give positions, or where no noise
    is known and residuals follow no drive.

    Where noise was declared or readings were repeated, the verdict tells whether residuals are
    noise; what may be hidden in it is then of another estimate. Else what is not known to be of the
    readings or the parameters counts as the model's.
    """
    stations = [k for k, at in enumerate(fit.problem.stations) if _gives_positions(at)]
    if not stations:
        return None
    rows = [_Rows.of(fit, k) for k in stations]
    if verdict is Verdict.NOT_JUDGED:
        follows = max(errs_with_drives(of.fitted, of.q, of.levers) for of in rows)
        if follows < DISCREPANCY.significant:
            return None
    fold = joint_regions(fit.problem.conditions.q, DISCREPANCY.regions)
    if not fold.max(initial=0):
        return None
    (by_station,) = left_out_residuals(fit, fit.solution, [fold])
    left_out = [_LeftOut.of(rows[i], by_station[k]) for i, k in enumerate(stations)]
    if verdict is Verdict.ADEQUATE:
        return _hidden(left_out, left_out_variances(fit, fold, stations))
    return _shown(left_out)


def _hidden(
    left_out: Sequence[_LeftOut], by_parameters: Sequence[np.ndarray]
) -> Discrepancy | None:
    """Return what noise may hide, given the covariances of the predictions by the parameters."""
    known = [
        found[of.some] + of.rows.noise[:, None, None] * np.eye(3)
        for found, of in zip(by_parameters, left_out, strict=True)
    ]
    return hidden_in_noise(
        np.vstack([of.displacements for of in left_out]),
        np.concatenate([of.rows.levers for of in left_out], axis=1),
        np.concatenate(known),
    )


def _shown(left_out: Sequence[_LeftOut]) -> Discrepancy | None:
    """Return what a model lacks by residuals that show it.

    Its parameters err by what it lacks, not by the noise: what fits without a region miss there is
    all of the model.
    """
    noise = np.concatenate([of.rows.noise for of in left_out])
    found = discrepancy_of(
        np.vstack([of.displacements for of in left_out]),
        np.vstack([of.rows.q for of in left_out]),
        np.concatenate([of.rows.levers for of in left_out], axis=1),
        noise[:, None, None] * np.eye(3),
    )
    turned = [of for of in left_out if of.turns is not None]
    if found is None or not turned:
        return found
    return found.with_turns(
        np.vstack([of.turns for of in turned if of.turns is not None]),
        np.concatenate([of.turn_levers for of in turned], axis=1),
        np.concatenate([of.turn_noise for of in turned]),
    )


def _gives_positions(station: Station) -> bool:
    """Return whether each reading of a station that stands still gives a position in 3D."""
    block = station.sensor.blocks[0]
    is_still = not station.conditions.are_of_motion and station.conditions.around is None
    return is_still and block.unit == "m" and block.size == 3


def _gives_turns(station: Station) -> bool:
    """Return whether each reading of a station gives a position, and then an orientation."""
    blocks = station.sensor.blocks
    return len(blocks) > 1 and blocks[1].unit == "rad" and blocks[1].size == 3


@dataclass(frozen=True, eq=False)
class _Rows:
    """What the rows of a station say of a discrepancy.

    Attributes:
        at: the station.
        values: shape (P,), its parameters.
        q: shape (N, n), joint positions.
        levers: shape (n, N, 3), motion of the target by each drive.
        noise: shape (N,), variance of a coordinate that is known to be of the readings [m^2].
        is_kept: shape (N,), rows that are no outliers.
        turn_noise: as ``noise``, of a component of orientations [rad^2]; None where none are read.
    """

    at: Station
    values: np.ndarray
    q: np.ndarray
    levers: np.ndarray
    noise: np.ndarray
    is_kept: np.ndarray
    turn_noise: np.ndarray | None

    @classmethod
    def of(cls, fit: ModelFit, k: int) -> _Rows:
        """Return those of the k-th station of a fit."""
        at = fit.problem.stations[k]
        values = fit.solution.values[fit.problem.places[k]]
        return cls(
            at,
            values,
            at.conditions.q,
            displacements_by_drives(at, values),
            _known_noise(fit, k),
            fit.solution.weights[fit.problem.rows[k]] > 0.0,
            _known_noise(fit, k, 1) if _gives_turns(at) else None,
        )

    def select(self, rows: np.ndarray) -> _Rows:
        """Return what some rows say (mask or indices)."""
        return replace(
            self,
            at=self.at.select(rows),
            q=self.q[rows],
            levers=self.levers[:, rows],
            noise=self.noise[rows],
            is_kept=self.is_kept[rows],
            turn_noise=None if self.turn_noise is None else self.turn_noise[rows],
        )

    @property
    def fitted(self) -> np.ndarray:
        """Residuals of the fit, shape (N, 3) [m]."""
        return self.at.displacements(self.values)


@dataclass(frozen=True, eq=False)
class _LeftOut:
    """Rows of a station with their residuals by fits without them.

    Attributes:
        rows: the N rows that are no outliers and have such residuals.
        displacements: shape (N, 3), of the target's position [m].
        turns: shape (N, 3), rotation from predicted to read orientations [rad]; None where none are
            read.
        some: shape (N,), their places among all of the station.
    """

    rows: _Rows
    displacements: np.ndarray
    turns: np.ndarray | None
    some: np.ndarray

    @classmethod
    def of(cls, rows: _Rows, residuals: np.ndarray) -> _LeftOut:
        """Return the rows of residuals, shape (m, N), that are finite."""
        displacements = rows.at.displacements(rows.values, residuals)
        some = np.flatnonzero(rows.is_kept & np.isfinite(displacements).all(axis=1))
        turns = residuals[3:6, some].T if rows.turn_noise is not None else None
        return cls(rows.select(some), displacements[some], turns, some)

    @property
    def turn_noise(self) -> np.ndarray:
        """Variance of a component that is known to be of the readings, shape (N,) [rad^2]."""
        noise = self.rows.turn_noise
        return np.zeros(len(self.displacements)) if noise is None else noise

    @property
    def turn_levers(self) -> np.ndarray:
        """Rotation of the target by each drive, shape (n, N, 3) [rad/rad or rad/m]."""
        station = self.rows.at
        model = with_moving_drives(station.model)
        of_model, _ = station.split(self.rows.values)
        values = np.concatenate([of_model, np.zeros(model.n_parameters - len(of_model))])
        _, J = model.linearise(values, station.conditions, rows=6)
        return np.moveaxis(J[:, 3:, len(of_model) :], 2, 0)


def _known_noise(fit: ModelFit, k: int, block: int = 0) -> np.ndarray:
    """Return the variance of a component of a block of each row that is known to be of the
    readings, shape (N,) [m^2 or rad^2]: the declared noise, or what the stops of its pose show,
    whichever is more.
    """
    at = fit.problem.stations[k]
    scatter = fit.scatter.get(at.name)
    declared = fit.noise.declared[fit.problem.block_spans[k].start + block]
    size = 0.0 if declared is None else declared**2
    if scatter is not None:
        of_row = (1.0, 1.0) if scatter.of_single else (scatter.readings, scatter.stops)
        shown = scatter.of_row(*of_row)
        size = max(size, float(shown[block]))
    return np.asarray(size / np.maximum(at.weights, 1e-300) ** 2)
