"""Values of a robot that has changed: what changed is found anew, the rest moves as far as its uncertainty lets it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.diagnosis.evidence import root_of_inverse, whitened
from pincal.identify.station import Station

# Gauss-Newton steps at most, and halvings of one that made things worse.
_MOST_STEPS, _HALVINGS = 30, 6
# A step of this square, in units of the noise, is the last.
_SHORT = 1e-6
# Directions of a scaled matrix of information below this are rounding.
_ROUNDING = 1e-13


@dataclass(frozen=True)
class Prior:
    """What is known of parameters before new rows.

    A parameter that is known and free is the sum of what it was and a change.

    Attributes:
        known: shape (K,), places of parameters that are known with a covariance.
        root: shape (K, n), of this covariance.
        free: shape (F,), places of parameters that change.
        precision: shape (F, F), information about how far they may change; zero for anywhere.
    """

    known: np.ndarray
    root: np.ndarray
    free: np.ndarray
    precision: np.ndarray


@dataclass(frozen=True)
class Posterior:
    """What rows and prior say together.

    Attributes:
        values: shape (P,), most probable ones.
        places: shape (p,), places of parameters that may have moved.
        covariance: shape (p, p), of these.
        changes: shape (F,), of the free parameters.
        sigma: shape (F,), standard deviations of the changes.
    """

    values: np.ndarray
    places: np.ndarray
    covariance: np.ndarray
    changes: np.ndarray
    sigma: np.ndarray


def most_probable(station: Station, start: np.ndarray, centre: np.ndarray, prior: Prior, sigma: np.ndarray) -> Posterior:
    """Return the most probable values.

    The noise is taken as it is: what is far off pulls as strongly as it does.

    Args:
        station: model and rows.
        start: shape (P,), where to begin.
        centre: shape (P,), what the prior says.
        prior: of what may move.
        sigma: shape (blocks,), noise of one component of each block of readings.
    """
    n, places = prior.root.shape[1], np.union1d(prior.known, prior.free).astype(int)
    # From one vector of uncorrelated unknowns to the parameters.
    W = np.zeros((len(places), n + len(prior.free)))
    W[np.searchsorted(places, prior.known), :n] = prior.root
    W[np.searchsorted(places, prior.free), np.arange(n, W.shape[1])] = 1.0
    precision = np.eye(W.shape[1])
    precision[n:, n:] = prior.precision
    unknown = np.append(np.zeros(n), (start - centre)[prior.free])

    def at(unknown: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        values = start.copy()
        values[places] = centre[places] + W @ unknown
        A, r = whitened(station, values, sigma, places)
        return values, W.T @ A, r, float(r @ r + unknown @ precision @ unknown)

    values, N, r, cost = at(unknown)
    for _ in range(_MOST_STEPS):
        H = N @ N.T + precision
        root = root_of_inverse(H, np.diag(H), _ROUNDING)
        step = root @ (root.T @ (N @ r - precision @ unknown))
        for _ in range(_HALVINGS):
            there = at(unknown + step)
            if there[3] <= cost * (1.0 + 1e-9) + _SHORT:
                break
            step = 0.5 * step
        else:
            break
        unknown, (values, N, r, cost) = unknown + step, there
        if step @ H @ step < _SHORT:
            break
    H = N @ N.T + precision
    root = root_of_inverse(H, np.diag(H), _ROUNDING)
    spread = W @ root
    return Posterior(values, places, spread @ spread.T, unknown[n:], np.linalg.norm(root[n:], axis=1))
