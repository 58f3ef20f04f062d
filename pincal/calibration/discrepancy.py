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
squares, once plain and once weighted by the covariances found, estimate them. What is known to be
of the readings and of the parameters of the fit without the region is not of the discrepancy: the
uncertainty of predictions counts parameters beside it. A factor brings the mean square of the
residuals, in units of their uncertainty, to 1: of few poses it scatters less than a quantile of
them. As many poses as there are tell it, so that intervals are those of Student's distribution.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated

import numpy as np
from msgspec.structs import replace as changed
from scipy.linalg import block_diag, solve_triangular
from scipy.optimize import nnls
from scipy.special import ndtri, stdtrit

from pincal.calibration.calibration_numbers import DISCREPANCY
from pincal.calibration.left_out_variance import target_variances
from pincal.calibration.position_covariance import SharedErrors
from pincal.calibration.position_rows import LeftOutRows, PositionRows, gives_positions
from pincal.calibration.structure import DRIVE_LENGTHS, Structure, alike, residual_structure
from pincal.identify.fit import ModelFit
from pincal.identify.folds import left_out_residuals
from pincal.identify.split import joint_regions
from pincal.io.arrays import ArrayShape, Matrix, Numbers, Record
from pincal.io.strict_json import Fault
from pincal.thresholds import Count, Scale
from pincal.validate.misfit import Verdict

# Poses from whose pairs the variances are estimated, and their seed.
_MOST: Count = 100
_SEED: Count = 0
# Mean lever of a drive below which it displaces no target [m/rad or m/m], and, as a part of the
# largest one, below which readings do not tell its error from a rest: it may be longer elsewhere.
_LEVER: Scale = 1e-3
_SHORT: Scale = 0.15
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
# Smallest variance [m^2].
_SMALLEST: Scale = 1e-300
# Probability below the upper end of intervals of 95 %.
_LEVEL: Scale = 0.975


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

    def part(self, share: float) -> Discrepancy:
        """Return the discrepancy of which all variances are so many times as large."""
        size = float(np.sqrt(share))
        return changed(self, factor=size * self.factor, turn_factor=size * self.turn_factor)

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
        size = np.sqrt(np.mean(residuals**2 / variance[:, None]))
        return changed(self, turn_rest=rest, turn_factor=float(size) * _widened(len(residuals)))

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
        among = np.einsum("l,lab->ab", sizes, alike(angles, angles, self.lengths))
        among += _RIDGE * sizes.sum() * np.eye(len(angles))
        with_them = np.einsum("l,lab->ab", sizes, alike(position, angles, self.lengths))
        shared = solve_triangular(np.linalg.cholesky(among), with_them.T, lower=True).T
        left = sizes.sum() - np.sum(shared**2, axis=1)
        return np.asarray(shared), np.sqrt(np.maximum(left, 0.0))


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
    lever = np.sqrt(np.mean(np.sum(levers**2, axis=2), axis=1))
    moves = lever > max(_LEVER, _SHORT * float(lever.max()))
    drives = np.zeros((q.shape[1], len(DRIVE_LENGTHS)))
    drives[moves], rest = _variances(
        residuals[some], q[some][:, moves], levers[moves][:, some], known[some]
    )
    plain = Discrepancy(
        lengths=np.array(DRIVE_LENGTHS),
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
    return changed(plain, factor=factor * _widened(len(residuals))) if factor else None


def _widened(n: int) -> float:
    """Return the factor on standard deviations that n poses not fitted have shown."""
    return DISCREPANCY.farther * float(stdtrit(n, _LEVEL) / ndtri(_LEVEL))


def _factor(residuals: np.ndarray, lacking: np.ndarray, known: np.ndarray) -> float:
    """Return the factor on the standard deviations of what is lacking by which residuals are as
    large as they say; 0 where what is known says so already.

    Args:
        residuals: shape (N, 3).
        lacking: shape (N, 3), variances.
        known: shape (N, 3), variances beside these.
    """

    def covers(factor: float) -> bool:
        return bool(np.mean(residuals**2 / (factor**2 * lacking + known + _SMALLEST)) <= 1.0)

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
        np.einsum("nm,na,mb->namb", near, lever, lever).reshape(3 * n, 3 * n)
        for position, lever in zip(q.T, levers, strict=True)
        for near in alike(position, position, np.array(DRIVE_LENGTHS))
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
    """Return the discrepancy of a fit; None where readings do not give positions or are too few, or
    where no noise is known and residuals have no structure.

    Where noise was declared or readings were repeated, the verdict tells whether residuals are
    noise; what may be hidden in it is then of another estimate. Else it is their structure: of an
    e-value E the part 1 - 1 / E of what is not known to be of the readings or the parameters counts
    as the model's; of contacts, which no instrument reads, all of it.
    """
    stations = [k for k, at in enumerate(fit.problem.stations) if gives_positions(at)]
    rows = [PositionRows.of(fit, k) for k in stations]
    if sum(int(of.is_kept.sum()) for of in rows) < DISCREPANCY.fewest:
        return None
    if verdict is Verdict.NOT_ADEQUATE:
        return _shown(fit, rows)
    structure = residual_structure(fit, rows)
    if verdict is Verdict.ADEQUATE:
        return _hidden(structure)
    return _suspected(fit, rows, structure.evidence())


def _suspected(fit: ModelFit, rows: Sequence[PositionRows], evidence: float) -> Discrepancy | None:
    """Return what a model lacks where no noise is known, by the e-value that residuals are not
    noise alone.

    A contact has no instrument: what it shows is the robot's, whether it has structure or not.
    """
    doubt = min(1.0 / max(evidence, _SMALLEST), 1.0)
    if not any(of.at.sensor.is_of_joints for of in rows):
        found = _shown(fit, rows) if doubt < 1.0 else None
        return found.part(1.0 - doubt) if found else None
    return _shown(fit, [of if of.at.sensor.is_of_joints else of.with_noise(doubt) for of in rows])


def _hidden(structure: Structure) -> Discrepancy | None:
    """Return what an adequate model may lack: that nothing shows in the noise does not say that
    nothing is there.
    """
    if not structure.kernels:
        return None
    drives, rest = structure.hidden()
    return Discrepancy(
        lengths=np.array(DRIVE_LENGTHS),
        drives=drives,
        rest=rest,
        factor=1.0,
        coordinates=len(structure.kernels[0].diagonal),
    )


def _shown(fit: ModelFit, rows: Sequence[PositionRows]) -> Discrepancy | None:
    """Return what a model lacks by residuals of fits without regions of joint space.

    What these fits do not know of their parameters, more than the fit to all rows, is none of it.
    """
    fold = joint_regions(fit.problem.conditions.q, DISCREPANCY.regions)
    if not fold.max(initial=0):
        return None
    (by_station,) = left_out_residuals(fit, fit.solution, [fold])
    left_out = [LeftOutRows.of(of, by_station[of.number]) for of in rows]
    found = discrepancy_of(
        np.vstack([of.displacements for of in left_out]),
        np.vstack([of.rows.q for of in left_out]),
        np.concatenate([of.rows.levers for of in left_out], axis=1),
        _known(fit, fold, left_out),
    )
    turned = [of for of in left_out if of.turns is not None]
    if found is None or not turned:
        return found
    return found.with_turns(
        np.vstack([of.turns for of in turned if of.turns is not None]),
        np.concatenate([of.turn_levers for of in turned], axis=1),
        np.concatenate([of.turn_noise for of in turned]),
    )


def _known(fit: ModelFit, fold: np.ndarray, left_out: Sequence[LeftOutRows]) -> np.ndarray:
    """Return the covariance of the residuals of fits without each fold that is of the readings and
    of their parameters, shape (N, 3, 3) [m^2].
    """
    stations = [of.rows.number for of in left_out]
    found = zip(left_out, target_variances(fit, fold, stations), strict=True)
    return np.concatenate(
        [
            of.rows.noise[:, None, None] * np.eye(3)
            + _of_parameters(
                of,
                fold[fit.problem.rows[of.rows.number]][of.some],
                variances.without[of.some],
                variances.by_all[of.some],
            )
            for of, variances in found
        ]
    )


def _of_parameters(
    left_out: LeftOutRows, fold: np.ndarray, without: np.ndarray, by_all: np.ndarray
) -> np.ndarray:
    """Return the covariance of residuals by the parameters of fits without their fold, shape
    (N, 3, 3) [m^2].

    That of parameters which nothing but the fold determined is of their priors, which may be much
    wider than robots differ. So it is at most that of the fit to all rows and of how far
    predictions of the fold moved.

    Args:
        left_out: the rows.
        fold: shape (N,).
        without: shape (N, 3, 3), covariances as parameters without the fold have them.
        by_all: shape (N, 3, 3), as those of the fit to all rows do.
    """
    moved = np.sum((left_out.displacements - left_out.rows.fitted) ** 2, axis=1)
    most = np.bincount(fold, moved + np.einsum("naa->n", by_all))
    expected = np.bincount(fold, np.einsum("naa->n", without))
    share = np.minimum(most / np.maximum(expected, _SMALLEST), 1.0)
    return np.asarray(share[fold][:, None, None] * without)
