r"""What an earlier fit found of a robot, as one more term of a problem.

With m the values and C the covariance that were found of the robot's parameters x, whatever belonged to the stations of that
time left out, the term is :math:`(x - m)^T C^{-1} (x - m)`. It takes the place of these parameters' priors, which are in C
already. For a linear model the fit of new rows beside it is the joint fit of old and new ones.

A solver counts in units of priors, so the term is handed to it as what it says beyond them, :math:`C^{-1} - D^{-2}` for
priors of sizes D. What the old rows did not see has only the priors then, as if the rows were there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.errors import BadInputError
from pincal.parameters import Estimate

# Smallest standard deviation of a direction, in parts of the largest, each parameter in units of its own: below is rounding.
_LEAST = 1e-9


@dataclass(frozen=True, eq=False)
class Earlier:
    """A normal distribution of K parameters of a robot.

    Attributes:
        names: the parameters.
        mean: shape (K,).
        information: shape (K, K), the inverse of the covariance.
        sigma: shape (K,), standard deviations.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    information: np.ndarray
    sigma: np.ndarray

    @classmethod
    def of(cls, estimate: Estimate) -> Earlier:
        """Return what an estimate of a robot's parameters says of those that were fitted.

        Raises:
            BadInputError: if there are parameters of a station among them.
        """
        foreign = [p.name for p in estimate.parameters if p.station or p.is_extrinsic]
        if foreign:
            raise BadInputError(
                f"{foreign[0]} belongs to a station; expected the robot's own parameters, such as model.robot_estimate has"
            )
        free = estimate.free
        root, sigma = estimate.covariance.root, np.sqrt(estimate.covariance.variance)
        axes, lengths, _ = np.linalg.svd(root / sigma[:, None], full_matrices=False)
        lengths = np.maximum(lengths, _LEAST * lengths.max(initial=0.0))
        inverse = axes / lengths / sigma[:, None]
        names = tuple(name for name, is_free in zip(estimate.names, free, strict=True) if is_free)
        return cls(names, estimate.values[free], inverse @ inverse.T, sigma)

    def known_zero(self, others: np.ndarray) -> Earlier:
        """Return the distribution of the other parameters if some, shape (K,), are known to be zero."""
        if not others.any():
            return self
        kept = ~others
        H = self.information[np.ix_(kept, kept)]
        C = np.linalg.inv(H)
        mean = self.mean[kept] + C @ (self.information[np.ix_(kept, others)] @ self.mean[others])
        names = tuple(name for name, is_kept in zip(self.names, kept, strict=True) if is_kept)
        return Earlier(names, mean, H, np.sqrt(np.diag(C)))

    def widened(self, sizes: np.ndarray) -> np.ndarray:
        """Return sizes of priors, shape (K,), no smaller than these, beyond which nothing here says less than nothing."""
        wide = np.maximum(sizes, self.sigma)
        least = float(np.linalg.eigvalsh(self.information * np.outer(wide, wide)).min(initial=1.0))
        return np.asarray(wide / np.sqrt(np.clip(least, 1e-6, 1.0)))

    def beyond(self, sizes: np.ndarray) -> np.ndarray:
        """Return the information beyond that of priors about zero, shape (K, K)."""
        return np.asarray(self.information - np.diag(sizes**-2.0))

    def pull(self, values: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """Return the slope at ``values`` towards the mean beyond that of priors about zero, shape (K,)."""
        return np.asarray(self.information @ (self.mean - values) + values / sizes**2)

    def square(self, values: np.ndarray, sizes: np.ndarray) -> float:
        """Return the square of what ``values`` are off, in units of the variances, beyond that of priors about zero."""
        off = values - self.mean
        return float(off @ self.information @ off - np.sum((values / sizes) ** 2))
