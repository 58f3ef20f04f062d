r"""Likelihood of the scatter of one joint beside that which all joints have alike, on a grid of
variances.

With levers :math:`L_v` of all joints at visit v, and :math:`l_v` that of one, the covariance of the
readings of a visit in units of the noise is

.. math:: V_v = M_v + b \, l_v l_v^T, \qquad M_v = I + a \, L_v^T L_v .

Eigenvectors of the Gram matrix :math:`L_v L_v^T` give :math:`M_v^{-1}` for all variances a at once,
and the one joint changes it by rank one (Sherman and Morrison 1950, Ann. Math. Stat. 21, 124-127),
so that no matrix of a visit is inverted for any variances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class BesideAlike:
    """Scatter of one joint beside R variances that joints have alike.

    Attributes:
        readings: their number.
        volume: shape (R,), sum of log det M over the visits.
        left: shape (R,), squares of the residuals weighted by M.
        lever: shape (R, V), squares of the lever of the joint weighted by M.
        along: shape (R, V), products of lever and residuals weighted by M.
    """

    readings: int
    volume: np.ndarray
    left: np.ndarray
    lever: np.ndarray
    along: np.ndarray

    def likelihood(
        self, at: int | slice, extra: np.ndarray | float, sigma2: float | None = None
    ) -> np.ndarray:
        """Return 2 log-likelihood, shape (K,), at variances alike, by index, and K of the joint, or
        at R alike and one of the joint.

        Args:
            at: index of the variance that joints have alike, or all.
            extra: shape (K,) or (), variances of the joint, relative to the noise's.
            sigma2: variance of the noise; default: the likeliest.
        """
        more = np.atleast_1d(extra)[:, None]
        scale = 1.0 + more * self.lever[at]
        left = self.left[at] - np.sum(more * self.along[at] ** 2 / scale, axis=1)
        left = np.maximum(left, 1e-300)
        variance = left / self.readings if sigma2 is None else sigma2
        volume = self.volume[at] + np.sum(np.log(scale), axis=1)
        return np.asarray(-self.readings * np.log(variance) - volume - left / variance)


@dataclass(frozen=True)
class AlikeScatter:
    """Scatter that some joints have alike, for R variances.

    Attributes:
        gram: shape (V, n, n), products of the levers at each visit.
        along: shape (V, n), products of levers and residuals.
        crossed: shape (V, n, k), products of the levers with the principal ones of the k joints.
        projected: shape (V, k), products of these with the residuals.
        shrunk: shape (R, V, k), what a variance takes of each.
        nothing: all variances without any other joint.
    """

    gram: np.ndarray
    along: np.ndarray
    crossed: np.ndarray
    projected: np.ndarray
    shrunk: np.ndarray
    nothing: BesideAlike

    @classmethod
    def of(
        cls,
        gram: np.ndarray,
        along: np.ndarray,
        alike: np.ndarray,
        *,
        ratios: np.ndarray,
        squares: float,
        readings: int,
    ) -> AlikeScatter:
        """Return that of joints ``alike``, shape (n,), for variances relative to the noise's, shape
        (R,), from sums over the visits.
        """
        those = np.flatnonzero(alike)
        values, axes = np.linalg.eigh(gram[:, those[:, None], those])
        grown = ratios[:, None, None] * np.maximum(values, 0.0)
        crossed = gram[:, :, those] @ axes
        projected = (along[:, None, those] @ axes)[:, 0]
        shrunk = ratios[:, None, None] / (1.0 + grown)
        volume = np.sum(np.log1p(grown), axis=(1, 2))
        left = squares - np.einsum("rvk,vk->r", shrunk, projected**2)
        none = np.zeros((len(ratios), len(gram)))
        return cls(
            gram,
            along,
            crossed,
            projected,
            shrunk,
            BesideAlike(readings, volume, left, none, none),
        )

    def beside(self, joint: int) -> BesideAlike:
        """Return the scatter of a joint beside it."""
        crossed = self.crossed[:, joint]
        taken = np.einsum("rvk,vk->rv", self.shrunk, crossed**2)
        lever = np.maximum(self.gram[:, joint, joint] - taken, 0.0)
        along = self.along[:, joint] - np.einsum(
            "rvk,vk->rv", self.shrunk, crossed * self.projected
        )
        nothing = self.nothing
        return BesideAlike(nothing.readings, nothing.volume, nothing.left, lever, along)
