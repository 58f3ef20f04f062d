r"""Named parameters, and estimates of them: values with covariance, looked up by name.

A fit of several stations has a robot's parameters once and each station's own parameters
(instrument pose, targets) once per station. Their joint covariance

.. math:: C = A A^T + \operatorname{diag}(K_1, K_2, \ldots)

has one row of A per parameter and one block K per station, and is never stored as a dense matrix:
shared parameters correlate all stations, the rest correlates only the parameters of one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

# Coordinates of a frame: position [m] and small angles [rad].
FRAME_SYMBOLS = ("x", "y", "z", "rx", "ry", "rz")

ANYWHERE = float("inf")
"""Size of a parameter without a prior: a coordinate of the base, a tool or an object."""

Scope = Literal["robot", "station"]
# Powers of the moment in units of compliances.
_MOMENT_POWERS = {"(N m)": -1, "(N m)^2": -2}


@dataclass(frozen=True)
class Parameter:
    """One number that a fit may estimate.

    Attributes:
        name: ``<element>.<symbol>``, e.g. ``joint_2.s_x``; unique within a fit:
            ``<station>/<element>.<symbol>`` for a parameter of one of several stations.
        unit: "rad", "m" or "rad/(N m)".
        effect: name of the effect that owns it.
        nominal: value in the URDF; a fit estimates the deviation from it.
        size: standard deviation of its prior [rad or m]; inf for unknown frames.
        station: name of its station; "" for robot parameters and for a single station.
    """

    name: str
    unit: str
    effect: str
    nominal: float
    size: float
    station: str = ""

    @property
    def element(self) -> str:
        """The element that it belongs to: a joint, "base", "tool", a target, a point, ..."""
        return split_name(self.local_name)[0]

    @property
    def symbol(self) -> str:
        """Its symbol within its element."""
        return split_name(self.name)[1]

    @property
    def moment_power(self) -> int:
        """Power with which it scales with all masses if the robot is unchanged: 1 for masses, -1
        for compliances.
        """
        return _MOMENT_POWERS.get(self.unit.partition("/")[2], 0) or int(
            self.unit in ("kg", "kg m")
        )

    @property
    def is_compliance(self) -> bool:
        """Whether it is a compliance: deflection per unit of moment."""
        return self.moment_power == -1

    @property
    def is_extrinsic(self) -> bool:
        """Whether it belongs to the pose of base, target or object, which has no prior."""
        return self.size == ANYWHERE

    def at(self, station: str) -> Parameter:
        """Return the parameter as one of a station among several; unchanged if the station has no
        name.
        """
        return replace(self, name=f"{station}/{self.name}", station=station) if station else self

    @property
    def local_name(self) -> str:
        """Its name within its station."""
        return self.name.removeprefix(f"{self.station}/") if self.station else self.name


def is_on_link(element: str) -> bool:
    """Return whether an element is a point on a link, ``LINK:NAME``."""
    return ":" in element


def split_name(name: str) -> tuple[str, str]:
    """Return element and symbol of a parameter's name; the element is empty if it has none.

    Example:
        >>> split_name("joint_2.s_x")
        ('joint_2', 's_x')
    """
    element, _, symbol = name.rpartition(".")
    return element, symbol


def root_of(covariance: np.ndarray) -> np.ndarray:
    """Return a matrix L with L L^T = C for a covariance C; both of shape (n, n).

    It is the symmetric root of the correlation matrix: variances differ by twelve orders of
    magnitude, and rounding must not carry large ones into small ones. It does not depend on the
    signs and the order of eigenvectors, so samples drawn with one seed are the same on every
    machine.
    """
    sigma = np.sqrt(np.diag(covariance))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    sizes, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * ((axes * np.sqrt(np.maximum(sizes, 0.0))) @ axes.T))


def thin_root_of(covariance: np.ndarray) -> np.ndarray:
    """Return a matrix L, shape (n, r), with L L^T = C for a covariance C, shape (n, n), of rank r:
    its principal axes, as long as their standard deviations.
    """
    variances, axes = np.linalg.eigh(covariance)
    some = variances > 0.0
    return np.asarray(axes[:, some] * np.sqrt(variances[some]))


def quick_root_of(covariance: np.ndarray) -> np.ndarray:
    """Return a matrix L, shape (n, r), with L L^T = C for a covariance C, shape (n, n): that of the
    correlations by Cholesky, in a tenth of the time of axes, or by these where rounding forbids.

    Variances differ by twelve orders of magnitude, and rounding must not carry large ones into
    small ones.
    """
    sigma = np.sqrt(np.diag(covariance))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    correlation = covariance / np.outer(scale, scale)
    try:
        root = np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        root = thin_root_of(correlation)
    return np.asarray(scale[:, None] * root)


@dataclass(frozen=True)
class Covariance:
    """Covariance of n parameters, C = A A^T + a block per group of parameters.

    Attributes:
        factor: A, shape (n, k).
        groups: indices of the parameters of each block, shape (b,), and the block, shape (b, b).

    Example:
        >>> found = Covariance(np.array([[1.0], [2.0]]), ((np.array([1]), np.array([[3.0]])),))
        >>> found.dense().tolist(), found.variance.tolist()
        ([[1.0, 2.0], [2.0, 7.0]], [1.0, 7.0])
    """

    factor: np.ndarray
    groups: tuple[tuple[np.ndarray, np.ndarray], ...] = ()

    @classmethod
    def of(cls, matrix: np.ndarray) -> Covariance:
        """Return a covariance given as a dense matrix, shape (n, n)."""
        return cls(np.zeros((len(matrix), 0)), ((np.arange(len(matrix)), matrix),))

    def __len__(self) -> int:
        return len(self.factor)

    @cached_property
    def variance(self) -> np.ndarray:
        """Its diagonal, shape (n,)."""
        found = np.asarray(np.einsum("nk,nk->n", self.factor, self.factor))
        for places, block in self.groups:
            found[places] += np.diag(block)
        return found

    @property
    def root(self) -> np.ndarray:
        """A matrix L with L L^T = C, shape (n, m)."""
        columns = [self.factor]
        for places, block in self.groups:
            part = np.zeros((len(self), len(block)))
            part[places] = root_of(block)
            columns.append(part)
        return np.hstack(columns)

    def dense(self) -> np.ndarray:
        """Return the dense matrix, shape (n, n)."""
        found = self.factor @ self.factor.T
        for places, block in self.groups:
            found[np.ix_(places, places)] += block
        return np.asarray(found)

    def take(self, places: np.ndarray) -> Covariance:
        """Return the covariance of the parameters at indices ``places``, shape (m,), in this order,
        each at most once.
        """
        where = np.full(len(self), -1)
        where[places] = np.arange(len(places))
        groups = []
        for members, block in self.groups:
            kept = where[members] >= 0
            if kept.any():
                groups.append((where[members[kept]], block[np.ix_(kept, kept)]))
        return Covariance(self.factor[places], tuple(groups))


@dataclass(frozen=True)
class Estimate:
    """Named parameters with values and covariance.

    Attributes:
        parameters: the P parameters.
        values: shape (P,), deviations from the nominal.
        free: shape (P,), which of them were fitted.
        covariance: of the fitted parameters, in their order.
        prior: shape (P,), prior standard deviations about zero; inf for none.

    Example:
        >>> a, b = (Parameter(name, "m", "frame", 0.0, np.inf) for name in ("a.x", "b.x"))
        >>> free, prior = np.array([True, False]), np.array([1.0, 2.0])
        >>> covariance = Covariance.of(np.array([[0.25]]))
        >>> found = Estimate((a, b), np.array([0.3, 0.0]), free, covariance, prior)
        >>> found["a.x"], found.sigma.tolist(), found.drop(["a.x"]).names
        (0.3, [0.5, 2.0], ('b.x',))
    """

    parameters: tuple[Parameter, ...]
    values: np.ndarray
    free: np.ndarray
    covariance: Covariance
    prior: np.ndarray

    def __len__(self) -> int:
        return len(self.parameters)

    def __getitem__(self, name: str) -> float:
        return float(self.values[self.index(name)])

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @cached_property
    def _index(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    def index(self, name: str) -> int:
        """Return the index of a parameter; a KeyError if there is none of this name."""
        return self._index[name]

    def places(self, names: Iterable[str]) -> np.ndarray:
        """Return the indices of parameters, shape (n,); a KeyError if there is none of one of the
        names.
        """
        return np.array([self._index[name] for name in names], int)

    def frame(self, element: str) -> np.ndarray:
        """Return the coordinates of a frame, shape (6,) [m, rad]; zero where they are not among the
        parameters.
        """
        names = [f"{element}.{symbol}" for symbol in FRAME_SYMBOLS]
        return np.array([self[name] if name in self._index else 0.0 for name in names])

    @cached_property
    def sigma(self) -> np.ndarray:
        """Standard deviation of each parameter, shape (P,): the prior's where it was not fitted."""
        found = np.array(self.prior, float)
        found[self.free] = np.sqrt(self.covariance.variance)
        return found

    @cached_property
    def fitted_sigma(self) -> np.ndarray:
        """Standard deviation of each parameter, shape (P,): inf where it was not fitted."""
        return np.where(self.free, self.sigma, np.inf)

    def dense_covariance(self) -> np.ndarray:
        """Return the covariance matrix, shape (P, P), zero for parameters that were not fitted."""
        found = np.zeros((len(self), len(self)))
        found[np.ix_(self.free, self.free)] = self.covariance.dense()
        return found

    def take(self, names: Iterable[str]) -> Estimate:
        """Return the estimate of some parameters, in the order of ``names``; a KeyError if there is
        none of one of them.
        """
        return self._at(self.places(names))

    def drop(self, names: Iterable[str]) -> Estimate:
        """Return the estimate without some parameters; unknown names are ignored."""
        gone = set(names)
        return self._at(np.array([i for i, name in enumerate(self.names) if name not in gone], int))

    def _at(self, places: np.ndarray) -> Estimate:
        free = self.free[places]
        rank = np.cumsum(self.free) - 1
        return Estimate(
            tuple(self.parameters[i] for i in places),
            self.values[places],
            free,
            self.covariance.take(rank[places[free]]),
            self.prior[places],
        )


def estimate_of(
    parameters: Sequence[Parameter], values: np.ndarray, covariance: np.ndarray
) -> Estimate:
    """Return an estimate of P parameters from values and covariance, shapes (P,) and (P, P).

    A parameter of zero variance counts as not fitted; values are deviations from the nominal.
    """
    free = np.diag(covariance) > 0.0
    prior = np.array([parameter.size for parameter in parameters])
    return Estimate(
        tuple(parameters), values, free, Covariance.of(covariance[np.ix_(free, free)]), prior
    )


def carried_over(
    values: np.ndarray, index: dict[str, int], parameters: Sequence[Parameter]
) -> np.ndarray:
    """Return the entries of a vector by parameter name, shape (n,); zero (or False) for names not
    in ``index``.
    """
    found = np.zeros(len(parameters), values.dtype)
    for i, parameter in enumerate(parameters):
        if parameter.name in index:
            found[i] = values[index[parameter.name]]
    return found
