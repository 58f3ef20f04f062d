r"""The covariance of positions with each other, by its sources.

Positions that a calibrated robot gives share what is wrong: a parameter, the temperature, a drive
near the same angle. A feature of several readings, or a distance of two, needs what they share. Of
each source the deviations of N positions are

.. math:: \delta = F z + \left[S_i \, w_{g(i)}\right]_i ,

with z of unit variance common to all, and a w of unit variance for each group g of positions, those
of one stop for instance, which other groups do not share. Nothing of the size 3N by 3N is needed to
carry it through a linear map.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pincal.errors import BadInputError


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """The errors of N positions by one source.

    Attributes:
        common: shape (N, 3, r), displacement of each position by each of r independent errors of
            unit variance that all positions share [m].
        grouped: shape (N, 3, m), displacement by each of m independent errors of unit variance that
            only positions of the same group share [m].
        group: shape (N,), number of the group of each position.
    """

    common: np.ndarray
    grouped: np.ndarray
    group: np.ndarray

    @classmethod
    def of_all(cls, common: np.ndarray) -> SharedErrors:
        """Return errors that all positions share, shape (N, 3, r) [m]."""
        n = len(common)
        return cls(np.asarray(common, float), np.zeros((n, 3, 0)), np.arange(n))

    @classmethod
    def of_groups(cls, grouped: np.ndarray, group: np.ndarray) -> SharedErrors:
        """Return errors that positions of a group share, shapes (N, 3, m) [m] and (N,)."""
        numbers = np.unique(group, return_inverse=True)[1].ravel()
        return cls(np.zeros((len(grouped), 3, 0)), np.asarray(grouped, float), numbers)

    @classmethod
    def of_each(cls, blocks: np.ndarray) -> SharedErrors:
        """Return errors that no two positions share, from their covariances, shape (N, 3, 3)
        [m^2].
        """
        variances, axes = np.linalg.eigh(blocks)
        roots = axes * np.sqrt(np.maximum(variances, 0.0))[:, None, :]
        return cls.of_groups(roots, np.arange(len(roots)))

    def __len__(self) -> int:
        return len(self.common)

    @property
    def blocks(self) -> np.ndarray:
        """The covariance of each position, shape (N, 3, 3) [m^2]."""
        of_all = self.common @ self.common.swapaxes(1, 2)
        return np.asarray(of_all + self.grouped @ self.grouped.swapaxes(1, 2))

    @property
    def matrix(self) -> np.ndarray:
        """The covariance of the positions with each other, shape (3N, 3N) [m^2], x, y, z of the
        first before those of the second.
        """
        size = 3 * len(self)
        common = self.common.reshape(size, -1)
        grouped = self.grouped.reshape(size, -1)
        group = np.repeat(self.group, 3)
        of_groups = np.where(group[:, None] == group, grouped @ grouped.T, 0.0)
        return np.asarray(common @ common.T + of_groups)

    def through(self, A: np.ndarray) -> np.ndarray:
        """Return the covariance of linear functions of the positions, shape (p, p), for their
        derivatives A, shape (p, 3N).
        """
        by_all = A @ self.common.reshape(3 * len(self), -1)
        of_each = A.reshape(len(A), -1, 3).swapaxes(0, 1) @ self.grouped
        by_group = np.zeros((int(self.group.max(initial=-1)) + 1, *of_each.shape[1:]))
        np.add.at(by_group, self.group, of_each)
        flat = by_group.swapaxes(0, 1).reshape(len(A), -1)
        return np.asarray(by_all @ by_all.T + flat @ flat.T)

    def select(self, rows: np.ndarray) -> SharedErrors:
        """Return those of some positions (mask or indices)."""
        return SharedErrors(self.common[rows], self.grouped[rows], self.group[rows])


@dataclass(frozen=True, eq=False)
class PositionCovariance:
    """The covariance of N positions with each other, as the sum of independent sources.

    Memory and time grow with N, but those of :attr:`matrix`, which is dense.

    Attributes:
        sources: the errors by each source, by its name in a budget.

    Example:
        >>> shift = SharedErrors.of_all(np.tile(1e-4 * np.eye(3), (2, 1, 1)))
        >>> sensor = SharedErrors.of_each(np.tile(1e-10 * np.eye(3), (2, 1, 1)))
        >>> both = PositionCovariance({"placement": shift, "sensor": sensor})
        >>> difference = np.hstack([-np.eye(3), np.eye(3)])
        >>> round(float(both.through(difference)[0, 0]), 15), both.matrix.shape
        (2e-10, (6, 6))
    """

    sources: Mapping[str, SharedErrors]

    def __post_init__(self) -> None:
        sizes = {name: len(errors) for name, errors in self.sources.items()}
        if len(set(sizes.values())) > 1:
            raise BadInputError(
                f"sources of a covariance are of different numbers of positions: {sizes}; "
                "expected one number"
            )

    def __len__(self) -> int:
        return next((len(errors) for errors in self.sources.values()), 0)

    @property
    def blocks(self) -> np.ndarray:
        """The covariance of each position, shape (N, 3, 3) [m^2]."""
        return np.asarray(sum(errors.blocks for errors in self.sources.values()))

    @property
    def matrix(self) -> np.ndarray:
        """The covariance of the positions with each other, shape (3N, 3N) [m^2]."""
        return np.asarray(sum(errors.matrix for errors in self.sources.values()))

    def through(self, A: np.ndarray) -> np.ndarray:
        """Return the covariance of linear functions of the positions, shape (p, p), for their
        derivatives A, shape (p, 3N).
        """
        return np.asarray(sum(errors.through(A) for errors in self.sources.values()))

    def contributions(self, A: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
        """Yield each source and the covariance of linear functions by it, see :meth:`through`."""
        for name, errors in self.sources.items():
            yield name, errors.through(A)

    def with_source(self, name: str, errors: SharedErrors) -> PositionCovariance:
        """Return the covariance with a further source, such as a sensor on the flange."""
        return PositionCovariance({**self.sources, name: errors})

    def without_source(self, name: str) -> PositionCovariance:
        """Return the covariance as if there were no errors by a source."""
        return self.with_source(name, SharedErrors.of_all(np.zeros((len(self), 3, 0))))

    def select(self, rows: np.ndarray) -> PositionCovariance:
        """Return the covariance of some positions (mask or indices)."""
        return PositionCovariance({k: errors.select(rows) for k, errors in self.sources.items()})
