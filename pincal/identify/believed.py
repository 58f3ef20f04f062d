r"""Prior knowledge beyond each parameter's own prior: earlier fits, smooth curves, the scale of
contacts.

With m the values and C the covariance that an earlier fit found for the robot's parameters x, its
stations' parameters marginalised, the term is :math:`(x - m)^T C^{-1} (x - m)`. It replaces the
priors of these parameters, which C contains already. For a linear model a fit of new rows with this
term is the joint fit of old and new rows.

The solver works in units of priors, so it receives the difference :math:`C^{-1} - D^{-2}` for
priors of sizes D. What the old rows did not determine then has only its prior. Smoothness of a
curve is such a term about zero, in addition to the priors of its heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.posterior import Nonzero
from pincal.identify.quadratic import Form
from pincal.identify.station import Station
from pincal.model.effects import LENGTHS
from pincal.parameters import Estimate, Parameter
from pincal.thresholds import Count, Scale

# Sets of parameters of which the entries of the terms are kept.
_KEPT: Count = 2
# Smallest standard deviation of a direction relative to the largest, each parameter in units of its
# own; below is rounding.
_LEAST: Scale = 1e-9


@dataclass(frozen=True, eq=False)
class Earlier:
    """A normal distribution of K parameters, or knowledge in addition to the prior of each: (x -
    m)^T H (x - m).

    Attributes:
        names: the parameters.
        mean: shape (K,), m.
        information: shape (K, K), H; the inverse covariance of a distribution.
        sigma: shape (K,), standard deviations if the priors about zero are contained already; None
            for additional knowledge.
        places: shape (K,), indices of the parameters in a problem's table.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    information: np.ndarray
    sigma: np.ndarray | None
    places: np.ndarray = field(default_factory=lambda: np.zeros(0, int))

    @classmethod
    def of(cls, estimate: Estimate) -> Earlier:
        """Return the distribution of the fitted parameters of an estimate of a robot.

        Raises:
            BadInputError: if it contains parameters of a station.
        """
        foreign = [p.name for p in estimate.parameters if p.station or p.is_extrinsic]
        if foreign:
            raise BadInputError(
                f"{foreign[0]} belongs to a station; expected the robot's own parameters, "
                "as in model.robot_estimate"
            )
        free = estimate.free
        root = estimate.covariance.root
        sigma = np.sqrt(estimate.covariance.variance)
        axes, lengths, _ = np.linalg.svd(root / sigma[:, None], full_matrices=False)
        lengths = np.maximum(lengths, _LEAST * lengths.max(initial=0.0))
        inverse = axes / lengths / sigma[:, None]
        names = tuple(name for name, is_free in zip(estimate.names, free, strict=True) if is_free)
        return cls(names, estimate.values[free], inverse @ inverse.T, sigma)

    def given_zero(self, others: np.ndarray) -> Earlier:
        """Return the distribution of the other parameters, conditioned on ``others``, shape (K,),
        being zero.
        """
        if not others.any():
            return self
        kept = ~others
        H = self.information[np.ix_(kept, kept)]
        C = np.linalg.inv(H)
        mean = self.mean[kept] + C @ (self.information[np.ix_(kept, others)] @ self.mean[others])
        names = tuple(name for name, is_kept in zip(self.names, kept, strict=True) if is_kept)
        return Earlier(names, mean, H, np.sqrt(np.diag(C)))

    def contained_priors(self, sizes: np.ndarray) -> np.ndarray:
        """Return the sizes of the priors that the term contains, shape (K,), inf for none, given
        those of all parameters.
        """
        return np.full(len(self.places), np.inf) if self.sigma is None else sizes[self.places]


@dataclass(frozen=True, eq=False)
class Beliefs:
    """Knowledge about a problem's parameters beyond the prior of each.

    Attributes:
        terms: no parameter is in two of them.
        is_earlier: shape (P,), which parameters are known from an earlier fit.
        is_slope: whether the only term is the slope of contacts, which is negligible where readings
            are exact.
        known: cache of :meth:`entries`, the oldest first.
    """

    terms: tuple[Earlier, ...]
    is_earlier: np.ndarray
    is_slope: bool
    known: dict[bytes, Nonzero] = field(default_factory=dict, repr=False)

    def with_earlier(self, values: np.ndarray) -> np.ndarray:
        """Return values, shape (P,), with those of an earlier fit where it has any."""
        recalled = values.copy()
        for term in self.terms:
            if term.sigma is not None:
                recalled[term.places] = term.mean
        return recalled

    def widened(self, sizes: np.ndarray) -> np.ndarray:
        """Return sizes of priors, shape (P,), no smaller than these, with which no earlier fit has
        negative information.
        """
        found = sizes.copy()
        for term in self.terms:
            if term.sigma is not None:
                wide = np.maximum(sizes[term.places], term.sigma)
                least = float(
                    np.linalg.eigvalsh(term.information * np.outer(wide, wide)).min(initial=1.0)
                )
                found[term.places] = wide / np.sqrt(np.clip(least, 1e-6, 1.0))
        return found

    def square(self, values: np.ndarray, sizes: np.ndarray) -> float:
        """Return what the terms add to the sum of squares of the priors; arguments as for
        :meth:`beyond_priors`.
        """
        total = 0.0
        for term in self.terms:
            here = values[term.places]
            off = values[term.places] - term.mean
            total += float(
                off @ term.information @ off - np.sum((here / term.contained_priors(sizes)) ** 2)
            )
        return total

    def beyond_priors(self, kept: np.ndarray, values: np.ndarray, sizes: np.ndarray) -> Form:
        """Return the information of the terms beyond the priors.

        Args:
            kept: shape (K,), indices of the parameters that are asked for, ascending.
            values: shape (P,), present values.
            sizes: shape (P,), standard deviations of the priors.
        """
        information = np.zeros((len(kept), len(kept)))
        entries = self.entries(kept, sizes)
        information[entries.rows, entries.columns] = entries.values
        return Form.of(information, self.slope(kept, values, sizes))

    def entries(self, kept: np.ndarray, sizes: np.ndarray) -> Nonzero:
        """Return the information of :meth:`beyond_priors`, which is the same at all values."""
        key = kept.tobytes() + sizes.tobytes()
        if key not in self.known:
            while len(self.known) >= _KEPT:
                del self.known[next(iter(self.known))]
            every = [self._entries_of(term, kept, sizes) for term in self.terms]
            self.known[key] = Nonzero.joined(every)
        return self.known[key]

    def _entries_of(self, term: Earlier, kept: np.ndarray, sizes: np.ndarray) -> Nonzero:
        of = np.flatnonzero(np.isin(term.places, kept))
        found = Nonzero.of(
            (term.information - np.diag(term.contained_priors(sizes) ** -2.0))[of[:, None], of]
        )
        at = np.searchsorted(kept, term.places[of])
        return Nonzero(at[found.rows], at[found.columns], found.values)

    def slope(self, kept: np.ndarray, values: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """Return half of the negative gradient of :meth:`beyond_priors`, shape (K,)."""
        slope = np.zeros(len(kept))
        for term in self.terms:
            here = values[term.places]
            pull = term.information @ (term.mean - here) + here / term.contained_priors(sizes) ** 2
            of = np.isin(term.places, kept)
            slope[np.searchsorted(kept, term.places[of])] += pull[of]
        return slope


def slope_of_contacts(station: Station) -> np.ndarray:
    r"""Return the slope of a row's log-likelihood that keeps the noise of contacts from shrinking
    the robot, shape (P,).

    Contacts read joints q at which residuals r(q) are small. The smaller the robot, the smaller the
    residuals: the likelihood of q is the density of r times :math:`\sqrt{\det (J J^T)}` with J =
    dr/dq, which grows with the robot's scale s as :math:`s^m` for m components of r. Without this
    :math:`m \ln s` of each row N rows shrink a robot whose scale is known to sigma by about
    :math:`m N \sigma^2`. The scale is :math:`\ln s = L^T \delta / L^T L` for deviations delta of
    the lengths L on the path.
    """
    chain = station.model.chain
    nothing = np.zeros(len(station.parameters))
    if not station.sensor.is_of_joints:
        return nothing
    passed = {name for name, on in zip(chain.robot.joint_names, chain.on_path, strict=True) if on}
    lengths = np.array(
        [
            p.nominal if p.symbol in LENGTHS and p.element in passed else 0.0
            for p in station.parameters
        ]
    )
    return station.reading_size * lengths / (lengths @ lengths) if lengths.any() else nothing


def scale_of_contacts(
    stations: Sequence[Station], places: Sequence[np.ndarray], parameters: Sequence[Parameter]
) -> Earlier | None:
    """Return :func:`slope_of_contacts` of all rows as squares about a point so distant that they
    are linear.

    ``places`` are the indices of each station's parameters among all, ``parameters``.
    """
    slope = np.zeros(len(parameters))
    for station, local in zip(stations, places, strict=True):
        slope[local] += len(station) * slope_of_contacts(station)
    at = np.flatnonzero(slope)
    if not len(at):
        return None
    along = slope[at] / np.linalg.norm(slope)
    return Earlier(
        tuple(parameters[int(k)].name for k in at), slope[at], np.outer(along, along), None, at
    )
