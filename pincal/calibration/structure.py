r"""How what a model lacks is told from noise: it has a structure.

Noise has none. What a model lacks is an error of drives: seen through their levers L_j, and alike
at near joint positions. With the motions J of the targets by the free parameters, the residuals r
of a fit along the directions Q that no parameter determines are of the covariance

.. math:: Q^T (\sigma^2 I + \rho^2 I + s^2 K) Q, \qquad
          K = \sum_j L_j L_j^T \, k(q, q') ,

with noise of variance :math:`\sigma^2`, errors :math:`\rho^2` of single coordinates and
:math:`s^2` of the drives (the restricted likelihood of Patterson and Thompson 1971, Biometrika 58,
545-554). Each kernel k is one idea of how near poses err alike: errors of each drive over its own
position, with several lengths; over all joints; and errors of the target itself over all joints.

Where the noise is not known, the ratio of likelihoods with and without structure, averaged over its
size and the kernels, is an e-value: noise alone exceeds E in at most 1 / E of all tables. Where it
is known, sizes are means of their posterior.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpttrf, dsytrd, dsytrd_lwork
from scipy.special import logsumexp

from pincal.calibration.position_rows import PositionRows
from pincal.identify.fit import ModelFit
from pincal.thresholds import Count, Scale

# Lengths over which drives err alike [rad or m].
DRIVE_LENGTHS: tuple[Scale, ...] = (0.05, 0.2, 0.8)
# Length over which poses err alike, in standard deviations of the joint positions.
_NEAR: Scale = 2.0
# Poses whose residuals are compared, and their seed.
_MOST: Count = 100
_SEED: Count = 0
# Mean lever of a drive below which it displaces no target [m/rad or m/m].
_LEVER: Scale = 1e-3
# Part of the noise that a parameter moves all readings together by one prior, at least, to be
# determined by them.
_DETERMINED: Scale = 1.0
# Smallest spread of a joint's positions [rad or m].
_LEAST: Scale = 1e-9
# Variances by structure in units of the noise.
_RATIOS = 10.0 ** np.linspace(-1.0, 2.0, 7)
# Sizes of what noise hides, in units of the prior's mean, and the part of them that has structure.
_SIZES = np.logspace(-2.5, 2.5, 36)
_PARTS: tuple[Scale, ...] = (0.1, 0.3, 0.5, 0.7, 0.9)


@dataclass(frozen=True, eq=False)
class Kernel:
    """How near poses err alike, along orthonormal axes in which its matrix is tridiagonal, the last
    of them that of the residuals.

    A third of the time of its eigenvectors is enough for these, and pivots of the matrix, with more
    on its diagonal, are all that a likelihood needs: the sum of their logarithms is its
    log-determinant, and one over the last one the diagonal entry of its inverse there.

    Attributes:
        length: number of the length of the errors of drives; None for errors of the target.
        diagonal: shape (M,), variances along the axes, for errors whose mean variance of a
            coordinate is that of the noise.
        beside: shape (M - 1,), covariances of neighbouring axes.
        square: of the residuals in units of the noise.
        of_drives: variance of the error of a drive that makes a coordinate as uncertain as the
            noise does [rad^2 or m^2].
    """

    length: int | None
    diagonal: np.ndarray
    beside: np.ndarray
    square: float
    of_drives: float

    def pivots(self, structured: np.ndarray, single: np.ndarray) -> np.ndarray:
        """Return the pivots of the covariance, shape (S, M), for variances in units of the known
        noise, shape (S,) each: by this kernel, and of single coordinates.
        """
        pairs = zip(structured.tolist(), single.tolist(), strict=True)
        each = [dpttrf(1.0 + rho + s * self.diagonal, s * self.beside)[0] for s, rho in pairs]
        return np.array(each)

    def log_likelihoods(self, structured: np.ndarray, single: np.ndarray) -> np.ndarray:
        """Return logarithms of the likelihood, up to a constant, for variances in units of the
        known noise, shape (S,) each: by this kernel, and of single coordinates.
        """
        pivots = self.pivots(structured, single)
        return np.asarray(-0.5 * (np.sum(np.log(pivots), axis=1) + self.square / pivots[:, -1]))

    def log_ratios(self) -> np.ndarray:
        """Return logarithms of the ratio of likelihoods with and without structure, for several of
        its sizes, of noise whose size is not known.
        """
        if not self.square:
            return np.zeros(len(_RATIOS))
        pivots = self.pivots(_RATIOS, np.zeros(len(_RATIOS)))
        M = len(self.diagonal)
        logs = np.log(pivots)
        return np.asarray(-0.5 * (np.sum(logs, axis=1) - M * logs[:, -1]))


@dataclass(frozen=True, eq=False)
class Structure:
    """The residuals of a fit, and what structure of them is compared.

    Attributes:
        kernels: with M axes each, none if residuals are too few.
        moves: shape (n,), drives that move a target.
        noise: mean variance of a coordinate of the readings [m^2].
    """

    kernels: tuple[Kernel, ...]
    moves: np.ndarray
    noise: float

    def evidence(self) -> float:
        """Return the e-value that something other than noise of one size is in the residuals."""
        if not self.kernels:
            return 0.0
        logs = np.concatenate([kernel.log_ratios() for kernel in self.kernels])
        return float(np.exp(np.minimum(logsumexp(logs) - np.log(len(logs)), 700.0)))

    def hidden(self) -> tuple[np.ndarray, float]:
        """Return what noise of known size may hide: variances of the drives, shape (n, L), and of a
        coordinate of the target beside them [m^2].

        They are means of the posterior. The whole standard deviation of a coordinate has a half
        Cauchy distribution before, its scale what the readings could just show (Gelman 2006,
        Bayesian Analysis 1, 515-534); any part of the variance may have structure.
        """
        drives = np.zeros((len(self.moves), len(DRIVE_LENGTHS)))
        rest = 0.0
        if not self.kernels:
            return drives, rest
        just = np.sqrt(2.0 / len(self.kernels[0].diagonal))
        size, part = (grid.ravel() for grid in np.meshgrid(just * _SIZES, _PARTS))
        prior = 0.5 * np.log(size) - np.log1p(size / just)
        logs = np.array([k.log_likelihoods(part * size, (1.0 - part) * size) for k in self.kernels])
        weights = np.exp(logs + prior - logsumexp(logs + prior))
        for kernel, weight in zip(self.kernels, weights, strict=True):
            structured = float(weight @ (part * size))
            rest += self.noise * float(weight @ ((1.0 - part) * size))
            if kernel.length is None:
                rest += self.noise * structured
            else:
                drives[self.moves, kernel.length] += structured * kernel.of_drives
        return drives, rest


def residual_structure(fit: ModelFit, rows: Sequence[PositionRows]) -> Structure:
    """Return how the residuals of some stations of a fit may be structured.

    Args:
        fit: the fit.
        rows: of each of these stations.
    """
    kept = [of.select(np.flatnonzero(of.is_kept)) for of in rows]
    station = np.repeat(np.arange(len(rows)), [len(of.q) for of in kept])
    chosen = np.random.default_rng(_SEED).permutation(len(station))[:_MOST]
    counts = np.cumsum([0, *(len(of.q) for of in kept)])
    some = [
        of.select(np.sort(chosen[station[chosen] == k] - counts[k])) for k, of in enumerate(kept)
    ]
    return structure_among(
        *_means_of_poses(
            np.vstack([of.fitted for of in some]),
            np.vstack([of.q for of in some]),
            np.concatenate([of.levers for of in some], axis=1),
            np.concatenate([of.motions_by(fit) for of in some], axis=1),
            np.concatenate([of.expected_noise for of in some]),
        )
    )


def _means_of_poses(
    residuals: np.ndarray,
    q: np.ndarray,
    levers: np.ndarray,
    motions: np.ndarray,
    noise: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the means over the readings of each pose; arguments as of :func:`structure_among`.

    Several targets of a stop share how the drives arrived, which is alike at no other pose: as rows
    of their own they would pass for an error that near poses share.
    """
    poses, pose, counts = np.unique(q, axis=0, return_inverse=True, return_counts=True)
    shares = np.zeros((len(poses), len(q)))
    shares[pose.ravel(), np.arange(len(q))] = 1.0 / counts[pose.ravel()]
    return (
        shares @ residuals,
        poses,
        shares @ levers,
        shares @ motions,
        shares**2 @ noise,
    )


def structure_among(
    residuals: np.ndarray,
    q: np.ndarray,
    levers: np.ndarray,
    motions: np.ndarray,
    noise: np.ndarray,
) -> Structure:
    """Return how residuals may be structured.

    Args:
        residuals: shape (N, 3), of the target's positions [m].
        q: shape (N, n), joint positions.
        levers: shape (n, N, 3), motion of the target by each drive [m/rad or m/m].
        motions: shape (F, N, 3), of the target by one prior of each free parameter [m].
        noise: shape (N,), variance of a coordinate of the readings [m^2].
    """
    scale = np.sqrt(noise)[:, None]
    moves = np.sqrt(np.mean(np.sum(levers**2, axis=2), axis=1)) > _LEVER
    left = _undetermined((motions / scale).reshape(len(motions), residuals.size).T)
    if not left.shape[1] or not np.any(moves):
        return Structure((), moves, float(np.mean(noise)))
    kernels = tuple(
        _kernel(length, matrix, left, (residuals / scale).ravel())
        for length, matrix in _matrices(q[:, moves], levers[moves] / scale)
    )
    return Structure(kernels, moves, float(np.mean(noise)))


def alike(q: np.ndarray, others: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the correlation of the errors of a drive at its positions, shape (N,), with those at
    others, shape (M,), for each length, shape (L, N, M).
    """
    return _matern(np.abs(q[:, None] - others) / np.asarray(lengths)[:, None, None])


def _matern(distance: np.ndarray) -> np.ndarray:
    """Return the correlation at a distance in units of its length, of the same shape."""
    apart = np.sqrt(3.0) * distance
    return np.asarray((1.0 + apart) * np.exp(-apart))


def _undetermined(motions: np.ndarray) -> np.ndarray:
    """Return the directions of readings, shape (R, M), orthonormal, that no parameter determines,
    for motions by one prior of each parameter in units of the noise, shape (R, F).
    """
    axes, sizes, _ = np.linalg.svd(motions)
    return np.asarray(axes[:, np.count_nonzero(sizes > _DETERMINED) :])


def _matrices(q: np.ndarray, levers: np.ndarray) -> Iterator[tuple[int | None, np.ndarray]]:
    """Yield kernels, shape (3N, 3N), each with the number of the length that stands for it in a
    discrepancy, or None for errors of the target, for positions q, shape (N, n), of the drives.
    """
    for k, length in enumerate(DRIVE_LENGTHS):
        of_drives = np.array([alike(of, of, np.array([length]))[0] for of in q.T])
        yield k, _along_levers(of_drives, levers)
    spread = q / np.maximum(q.std(axis=0), _LEAST)
    distance = np.linalg.norm(spread[:, None] - spread, axis=2) / _NEAR
    near = np.kron(_matern(distance), np.ones((3, 3)))
    flat = levers.reshape(len(levers), -1)
    # Errors that no pose with other positions of the other joints shares: the shortest length.
    yield 0, near * (flat.T @ flat)
    yield None, near * np.tile(np.eye(3), (len(q), len(q)))


def _along_levers(of_drives: np.ndarray, levers: np.ndarray) -> np.ndarray:
    """Return the kernel of errors of drives, shape (3N, 3N), for their correlation, shape
    (n, N, N), and levers, shape (n, N, 3).
    """
    n, N, _ = levers.shape
    # Of each pose with all others, drive by drive.
    across = (of_drives.transpose(1, 0, 2)[..., None] * levers).reshape(N, n, 3 * N)
    return np.asarray(levers.transpose(1, 2, 0) @ across).reshape(3 * N, 3 * N)


def _kernel(
    length: int | None, matrix: np.ndarray, left: np.ndarray, residuals: np.ndarray
) -> Kernel:
    """Return a kernel, shape (R, R), along the directions that are left, shape (R, M), for
    residuals in units of the noise, shape (R,).
    """
    size = float(np.trace(matrix)) / len(matrix)
    M = left.shape[1]
    # Bordered by the residuals, whose direction is then the last of the axes.
    bordered = np.zeros((M + 1, M + 1), order="F")
    bordered[:M, :M] = left.T @ matrix @ left / size
    bordered[:M, M] = left.T @ residuals
    room = int(dsytrd_lwork(M + 1)[0])
    _, diagonal, beside, *_ = dsytrd(bordered, lower=0, lwork=room, overwrite_a=1)
    return Kernel(length, diagonal[:M], beside[: M - 1], float(beside[M - 1] ** 2), 1.0 / size)
