r"""Where an instrument stood on average, whose error persists along the rows.

Of noise that is correlated along the rows (:class:`pincal.identify.whitening.Serial`) a fit knows
the instrument, or a loose target, no better than by how far such an error may have taken it; of a
random walk that is anywhere. Predictions are made for its mean place over the rows
(:func:`pincal.identify.dependence.placed_at_mean`), which the rows do tell: with B the motion of
the readings by its coordinates b, and A that by the other parameters a, it is off by

.. math:: \delta \bar b = (B^T B)^{-1} B^T (e - A \, \delta a)

with noise e that does not persist. From where it would be without the error it is off by the mean
of this, and at a single reading by what wandered about the mean, which is noise of the reading.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pincal.identify.dependence import displaced_by
from pincal.identify.fit import ModelFit
from pincal.identify.whitening import Serial
from pincal.parameters import Covariance


def wandered(fit: ModelFit, k: int, block: int = 0) -> float:
    """Return the variance of a component of a block of the k-th station by an error that persists
    along the rows, about its mean [m^2 or rad^2]; 0 without one.
    """
    station = fit.problem.stations[k]
    if station.serial is None:
        return 0.0
    sigma = float(fit.solution.sigma[fit.problem.block_spans[k].start + block])
    return sigma**2 * station.serial.about_mean(station.block_rows[block].start)


def covariance_at_mean(fit: ModelFit, *, of_rows: bool) -> Covariance:
    """Return the covariance of the free parameters of a fit, with instruments and targets at their
    mean over the rows: of the rows themselves, or of where they would be without their error.
    """
    known = fit.solution.known.joint_covariance
    all_placed = list(_all_placed(fit))
    if not all_placed:
        return known
    found = known.dense()
    for placed in all_placed:
        found = placed.carried(found, of_rows=of_rows)
    return Covariance.of(found)


def _all_placed(fit: ModelFit) -> Iterator[_Placed]:
    """Yield what the error of each station that has one displaces."""
    for k, station in enumerate(fit.problem.stations):
        if station.serial is not None:
            placed = _Placed.of(fit, k, station.serial)
            if len(placed.own):
                yield placed


@dataclass(frozen=True, eq=False)
class _Placed:
    """How the mean place of an instrument or target follows from the other parameters.

    Attributes:
        own: shape (b,), its coordinates among the free parameters.
        others: shape (a,), the other ones of the station.
        follows: shape (b, a), change of the mean place by a change of these.
        of_noise: shape (b, b), covariance of the mean place by noise that does not persist.
        of_error: shape (b, b), by the mean of what does.
    """

    own: np.ndarray
    others: np.ndarray
    follows: np.ndarray
    of_noise: np.ndarray
    of_error: np.ndarray

    @classmethod
    def of(cls, fit: ModelFit, k: int, serial: Serial) -> _Placed:
        """Return that of the k-th station."""
        station = fit.problem.stations[k]
        places = fit.problem.places[k]
        free = fit.solution.free[places]
        number = (np.cumsum(fit.solution.free) - 1)[places[free]]
        is_own = displaced_by(station, serial)[free]
        weights = station.weights * fit.solution.weights[fit.problem.rows[k]]
        plain = replace(station, whitening=None, serial=None, arrival=None)
        products = np.zeros((int(is_own.sum()), len(is_own)))
        for piece, _, J in plain.linearise_correlated(fit.solution.values[places], free):
            columns = J.weighted(weights[piece])
            columns.only(np.flatnonzero(is_own)).add_products(columns, products)
        inverse = np.linalg.pinv(products[:, is_own], hermitian=True)
        variance = float(fit.solution.sigma[fit.problem.block_spans[k].start]) ** 2
        return cls(
            own=number[is_own],
            others=number[~is_own],
            follows=-inverse @ products[:, ~is_own],
            of_noise=(variance - wandered(fit, k)) * inverse,
            of_error=variance * serial.of_mean(0) * len(station) * inverse,
        )

    def carried(self, covariance: np.ndarray, *, of_rows: bool) -> np.ndarray:
        """Return a covariance of all free parameters, shape (F, F), with the place at its mean."""
        found = covariance.copy()
        moved = self.follows @ covariance[self.others]
        found[self.own] = moved
        found[:, self.own] = moved.T
        own = np.ix_(self.own, self.own)
        found[own] = moved[:, self.others] @ self.follows.T
        found[own] += self.of_noise if of_rows else self.of_noise + self.of_error
        return np.asarray(found)
