r"""Several features of one part, with the errors that they share.

Features whose readings are correlated are correlated, too: the covariance of features i and j is
A_i C_ij A_j^T. With the sensitivities of all features in one matrix, any source of errors of the
points goes through all of them at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pincal.errors import BadInputError, few, nearest_first
from pincal.features.feature_fit import FittedFeature, fit_feature
from pincal.thresholds import Count

# Names that a message lists.
_LISTED: Count = 5


@dataclass(frozen=True, eq=False)
class FeatureSet:
    """F features through N points.

    Attributes:
        fits: the features by name.
        rows: of each feature, the indices of its points.
        n_points: N.
    """

    fits: Mapping[str, FittedFeature]
    rows: Mapping[str, np.ndarray]
    n_points: int

    @classmethod
    def fit(
        cls,
        kinds: Mapping[str, str],
        feature: np.ndarray,
        points: np.ndarray,
        covariance: np.ndarray | None = None,
    ) -> FeatureSet:
        """Fit all features that have points.

        Args:
            kinds: of the features, by name.
            feature: shape (N,), the feature of each point.
            points: shape (N, 3), in one frame [m].
            covariance: shape (3N, 3N), of all points with each other [m^2]; None: unknown, see
                :func:`pincal.features.feature_fit.fit_feature`.

        Raises:
            BadInputError: for points of an unknown feature, or such as do not determine theirs.
            IdentificationError: if a fit does not converge.

        Example:
            >>> places = np.array([[0.0, 0, 0], [0, 0, 0], [0.1, 0, 0]])
            >>> names = np.array(["a", "a", "b"])
            >>> found = FeatureSet.fit({"a": "point", "b": "point"}, names, places, np.eye(9) / 1e8)
            >>> [round(1e6 * fit.sigma("x")) for fit in found.fits.values()]
            [71, 100]
        """
        feature = np.asarray(feature)
        points = np.asarray(points, float)
        n = len(points)
        if feature.shape != (n,):
            raise BadInputError(
                f"features of shape {feature.shape} for {n} points; expected ({n},)"
            )
        named = list(dict.fromkeys(feature.tolist()))
        strange = [name for name in named if name not in kinds]
        if strange:
            known = ", ".join(nearest_first(strange, kinds)[:_LISTED])
            raise BadInputError(
                f"points of {few([repr(name) for name in strange], _LISTED)}, which the part does "
                f"not have; expected one of its features, such as {known}"
            )
        rows = {name: np.flatnonzero(feature == name) for name in kinds if name in named}
        fits = {}
        for name, its in rows.items():
            C = None if covariance is None else covariance[np.ix_(_thrice(its), _thrice(its))]
            fits[name] = fit_feature(kinds[name], points[its], C, name=name)
        return cls(fits, rows, n)

    @property
    def names(self) -> tuple[str, ...]:
        """The features, in the order of the matrices."""
        return tuple(self.fits)

    def at(self, name: str) -> slice:
        """Return where the seven numbers of a feature are in the matrices."""
        i = self.names.index(name)
        return slice(7 * i, 7 * i + 7)

    @property
    def numbers(self) -> np.ndarray:
        """The seven numbers of all features, shape (7F,)."""
        return np.concatenate([fit.numbers for fit in self.fits.values()])

    @property
    def sensitivity(self) -> np.ndarray:
        """Motion of the numbers by errors of the points, shape (7F, 3N)."""
        found = np.zeros((7 * len(self.fits), 3 * self.n_points))
        for name, fit in self.fits.items():
            found[self.at(name), _thrice(self.rows[name])] = fit.sensitivity
        return found

    @property
    def form_blocks(self) -> np.ndarray:
        """What deviations of the surfaces from their form add to the covariance of each point,
        shape (N, 3, 3) [m^2]: a source of uncertainty like others.
        """
        found = np.zeros((self.n_points, 3, 3))
        for name, fit in self.fits.items():
            found[self.rows[name]] = fit.form_covariance
        return found

    @property
    def form_dof(self) -> int:
        """Degrees of freedom behind :attr:`form_blocks`: of the features with such deviations."""
        return sum(fit.dof for fit in self.fits.values() if fit.form_sigma > 0.0)


def _thrice(rows: np.ndarray) -> np.ndarray:
    """Return the indices of the coordinates of points."""
    return np.asarray((3 * rows[:, None] + np.arange(3)).ravel())


def plus_own_errors(covariance: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Return a covariance of points, shape (3N, 3N), plus what each point has of its own, shape
    (N, 3, 3).
    """
    n = len(blocks)
    found = np.array(covariance, float).reshape(n, 3, n, 3)
    each = np.arange(n)
    found[each, :, each] += blocks
    return found.reshape(3 * n, 3 * n)
