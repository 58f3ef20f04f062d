r"""How readings of one pose scatter: noise of the instrument, and drives that arrive elsewhere.

Readings of a pose differ by the noise of the instrument, and by the arrival a of the drives, which
differs from stop to stop. With the levers L of the joints, the covariance of readings of a pose is

.. math:: \Sigma = R + L\,\mathrm{diag}(a_1^2, \dots, a_n^2)\,L^T , \quad R = \mathrm{diag}(s_b^2) .

The variances follow from the products of deviations of readings from the others of their pose,
without a model of the robot's errors: non-negative least squares, repeated with the covariance that
follows as weight (Fisher's scoring, which ends at the most likely variances) and without deviations
that are too large. What rows of one stop share beyond this, whatever the visit, is another noise
(:mod:`pincal.identify.arrivals`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.special import chdtri

from pincal.identify.drive_levers import drive_levers
from pincal.identify.station import Station
from pincal.thresholds import Count, Scale

# Rounds in which variances and weights are estimated in turn.
_ROUNDS: Count = 6
# Probability of a sound deviation beyond which deviations have no part in the estimate.
_BEYOND: Scale = 1e-4
# Smallest noise of a component, relative to the scatter of readings at a typical pose.
_LEAST: Scale = 0.05
# Combinations of variances weaker than this, relative to the strongest, are excluded.
_RANK: Scale = 1e-10
# Deviations that suffice to estimate the variances.
_FEW: Count = 3000


@dataclass(frozen=True)
class Arrivals:
    """Scatter of readings between visits of a pose.

    Attributes:
        noise: shape (m,), standard deviation of each component of a reading at one stop [m, rad,
            px].
        sizes: shape (J,), standard deviation of the arrival of each joint [rad or m].
    """

    noise: np.ndarray
    sizes: np.ndarray

    def covariance(self, levers: np.ndarray) -> np.ndarray:
        """Return the covariance of a reading for levers of shape (N, m, J), shape (N, m, m)."""
        turned = levers * self.sizes
        return np.asarray(np.diag(self.noise**2) + turned @ turned.swapaxes(1, 2))

    def distances(self, deviations: np.ndarray, levers: np.ndarray) -> np.ndarray:
        """Return the squares of deviations, shape (N, m), in units of this scatter, shape (N,)."""
        solved = np.linalg.solve(self.covariance(levers), deviations[:, :, None])[:, :, 0]
        return np.asarray(np.sum(deviations * solved, axis=1))


def levers_of(station: Station, values: np.ndarray) -> np.ndarray:
    """Return the motion of the readings by each drive, shape (N, m, J) [m/rad, ...]; ``values`` are
    of shape (P,).
    """
    return np.ascontiguousarray(drive_levers(station, values).transpose(2, 1, 0))


def arrivals_of(
    deviations: np.ndarray,
    levers: np.ndarray,
    share: np.ndarray,
    *,
    blocks: list[slice],
    least: np.ndarray,
) -> Arrivals:
    """Return the scatter of readings that deviations from the others of their pose show.

    Args:
        deviations: shape (N, m).
        levers: shape (N, m, J), from :func:`levers_of`.
        share: shape (N,), variance of a deviation relative to that of a reading, 1 - 1/n for one
            from the mean of n.
        blocks: components with the same noise.
        least: shape (m,), smallest noise, as of rounding.
    """
    step = max(len(deviations) // _FEW, 1)
    scaled = deviations[::step] / np.sqrt(share[::step])[:, None]
    levers = levers[::step]
    m = scaled.shape[1]
    sizes = [b.stop - b.start for b in blocks]
    whole = np.sqrt(np.repeat(_typical_squares(scaled, blocks), sizes))
    least = np.maximum(_LEAST * whole, least)
    found = Arrivals(np.maximum(whole, least), np.zeros(levers.shape[2]))
    limit = float(chdtri(m, _BEYOND))
    for _ in range(_ROUNDS):
        sound = found.distances(scaled, levers) < limit
        if not sound.any():
            break
        white = np.linalg.inv(np.linalg.cholesky(found.covariance(levers[sound])))
        variances = _variances(white, scaled[sound], levers[sound], blocks)
        noise = np.sqrt(np.repeat(variances[: len(blocks)], sizes))
        found = Arrivals(np.maximum(noise, least), np.sqrt(variances[len(blocks) :]))
    return found


def _typical_squares(deviations: np.ndarray, blocks: Sequence[slice]) -> list[float]:
    """Return the variance of a component of each block by the median of all deviations."""
    return [
        np.median(np.sum(deviations[:, b] ** 2, axis=1)) / chdtri(b.stop - b.start, 0.5)
        for b in blocks
    ]


def _variances(
    white: np.ndarray, deviations: np.ndarray, levers: np.ndarray, blocks: Sequence[slice]
) -> np.ndarray:
    """Return the variances of blocks and of joints, shape (blocks + J,), that explain products of
    deviations best.

    Args:
        white: shape (N, m, m), which makes deviations of the last estimate white.
        deviations: shape (N, m).
        levers: shape (N, m, J).
        blocks: components with the same noise.
    """
    components = np.arange(deviations.shape[1])
    of_block = [
        np.diag(((b.start <= components) & (components < b.stop)).astype(float)) for b in blocks
    ]
    unit = np.einsum("nab,nb->na", white, deviations)
    lever = white @ levers
    by_noise = [white @ B @ white.swapaxes(1, 2) for B in of_block]
    by_joint = [x[:, :, None] * x[:, None, :] for x in np.moveaxis(lever, 2, 0)]
    design = np.stack([matrix.ravel() for matrix in (*by_noise, *by_joint)], axis=1)
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    normal = (design / scale).T @ (design / scale)
    right = (design / scale).T @ (unit[:, :, None] * unit[:, None, :]).ravel()
    return np.asarray(_nonnegative(normal, right) / scale)


def _nonnegative(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the non-negative least-squares solution of normal equations, shape (p,)."""
    sizes, axes = np.linalg.eigh(normal)
    kept = sizes > _RANK * sizes[-1]
    root = np.sqrt(sizes[kept])
    return np.asarray(nnls(root[:, None] * axes[:, kept].T, (axes[:, kept].T @ right) / root)[0])
