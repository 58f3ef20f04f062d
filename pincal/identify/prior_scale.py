r"""How far a robot may be from its URDF, estimated from readings without an instrument.

Contacts, planes, gauges and sockets observe few directions at few places. What they do not observe
keeps its prior, and a prior wider than the robot's deviations lets errors of the contacts pass for
geometry, which does harm wherever nobody measured. What they do observe shows how wide it should
be: the priors of lengths, of angles, of drive compliances and of other compliances are multiplied
by factors that maximise the likelihood of all readings, the parameters marginalised (type II
maximum likelihood; MacKay 1992, Bayesian Interpolation, Neural Computation 4, section 4). With
information H and gradient b of the readings about offsets x from the nominal, and priors of
covariance P, this evidence E is:

.. math:: 2 \log E = \tilde b^T A^{-1} \tilde b - \log\det A - \log\det P - x^T P^{-1} x,
    \quad A = H + P^{-1}, \; \tilde b = b - P^{-1} x

Each factor is the largest that is not excluded, so that weakly informative readings leave the prior
wide.

The same holds for an IMU alone, which observes angles but no positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.identify.beliefs import deviations
from pincal.identify.believed import slope_of_contacts
from pincal.identify.criteria import CRITERIA
from pincal.identify.fit import ModelFit
from pincal.identify.normal import accumulate
from pincal.identify.options import PriorScale
from pincal.identify.quadratic import Factor
from pincal.thresholds import Count, Scale

# Trial factors, largest first, and the largest number of rounds over all kinds.
_SCALES: tuple[Scale, ...] = (
    1.0,
    0.5,
    0.3,
    0.2,
    0.1,
    0.05,
    0.03,
    0.02,
    0.01,
    0.005,
    0.003,
    0.002,
    0.001,
)
_ROUNDS: Count = 10
# Standard deviation of parameters without a prior [m or rad].
_ANYWHERE: Scale = 10.0


def has_instrument(fit: ModelFit) -> bool:
    """Return whether an instrument apart from robot and contacts observes any target."""
    return any(
        station.sensor.base_symbols or station.sensor.is_on_tool for station in fit.problem.stations
    )


def observes_places(fit: ModelFit) -> bool:
    """Return whether an instrument observes target positions, which an IMU does not."""
    return has_instrument(fit) and any(
        station.sensor.reads_place for station in fit.problem.stations
    )


def prior_scale(fit: ModelFit) -> PriorScale:
    """Return the factors on the priors; 1 for kinds of parameters that the fit does not have."""
    evidence = _Evidence.of(fit)
    seen = [
        name for name, kind in zip(PriorScale._fields, evidence.kinds, strict=True) if kind.any()
    ]
    best = PriorScale()
    for _ in range(_ROUNDS):
        before = best
        for name in seen:
            likeliest = int(np.argmax(evidence.of_scales(best, name)))
            best = best._replace(**{name: _SCALES[likeliest]})
        if best == before:
            break
    widest = {name: evidence.of_scales(best, name) for name in seen}
    return best._replace(
        **{
            name: _SCALES[int(np.argmax(of >= of.max() - CRITERIA.wider_prior))]
            for name, of in widest.items()
        }
    )


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What the readings say of the sizes of F free parameters.

    Attributes:
        H: shape (F, F), information of the readings.
        b: shape (F,), their gradient.
        offsets: shape (F,), deviations from the nominal.
        nominal: shape (F,), sizes by priors that are not scaled.
        kinds: of each kind of deviation, which parameters are of it, shape (F,).
    """

    H: np.ndarray
    b: np.ndarray
    offsets: np.ndarray
    nominal: np.ndarray
    kinds: list[np.ndarray]

    @classmethod
    def of(cls, fit: ModelFit) -> _Evidence:
        free = fit.solution.free
        sizes = np.minimum(fit.priors.sizes, _ANYWHERE)[free]
        offsets = np.where(np.isfinite(fit.priors.sizes), fit.values, 0.0)[free]
        kinds = [kind[free] for kind in deviations(fit.problem, fit.options)]
        given = np.select(kinds, fit.options.prior_scale or PriorScale(), 1.0)
        H, b = _information(fit)
        return cls(H, b, offsets, sizes / given, kinds)

    def at(self, scales: Sequence[float]) -> float:
        """Return the log evidence of a factor for each kind, twice and but for a constant."""
        sigma = self.nominal * np.select(self.kinds, scales, 1.0)
        factor = Factor.of(self.H + np.diag(sigma**-2.0))
        half = factor.half(self.b - self.offsets / sigma**2)
        squares = float(np.sum((self.offsets / sigma) ** 2))
        return float(half @ half) - factor.log_det - 2.0 * float(np.log(sigma).sum()) - squares

    def of_scales(self, best: PriorScale, kind: str) -> np.ndarray:
        """Return the log evidence of each trial factor for one kind."""
        return np.array([self.at(best._replace(**{kind: scale})) for scale in _SCALES])


def _information(fit: ModelFit) -> tuple[np.ndarray, np.ndarray]:
    """Return information and gradient of all rows on the F free parameters, shapes (F,
    F) and (F,).
    """
    problem = fit.problem
    solution = fit.solution
    rank = np.cumsum(solution.free) - 1
    n_free = int(solution.free.sum())
    H = np.zeros((n_free, n_free))
    b = np.zeros(n_free)
    for (station, places, blocks), rows in zip(fit.stations, problem.rows, strict=True):
        here = solution.free[places]
        normal = accumulate(station, solution.values[places], here, solution.weights[rows])
        form = replace(normal, believed=None).at(solution.sigma[blocks])
        at = rank[places[here]]
        H[np.ix_(at, at)] += form.H
        b[at] += form.g + len(station) * slope_of_contacts(station)[here]
    return H, b
