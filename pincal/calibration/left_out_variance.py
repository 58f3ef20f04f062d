r"""The uncertainty of predictions by fits without the fold of a pose.

With the covariance C of the parameters by all rows, and the information :math:`A_k` that the rows
of fold k give, the covariance without them is :math:`(C^{-1} - A_k)^{-1}`: in the axes of
:math:`L^T A_k L = V w V^T`, for :math:`C = L L^T`, it is :math:`L V (1 - w)^{-1} V^T L^T`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pincal.calibration.wandering import covariance_at_mean
from pincal.identify.fit import ModelFit
from pincal.thresholds import Scale

# Largest part of what is known of a direction that a single fold may have given: where it gave all,
# priors remain, to the accuracy of a difference.
_MOST: Scale = 0.99


def left_out_variances(
    fit: ModelFit, fold: np.ndarray, stations: Sequence[int]
) -> list[np.ndarray]:
    """Return the covariance of the displacement of each row's target by the parameters of a fit
    without the row's fold, for some stations, shape (N, 3, 3) each [m^2].

    Args:
        fit: the fit of all rows.
        fold: shape (N,), fold of each row of all stations, numbered from 0.
        stations: their numbers; of readings that give positions.
    """
    return list(_covariances(fit, fold, stations, _roots_without(fit, fold)))


def fitted_variances(fit: ModelFit, stations: Sequence[int]) -> list[np.ndarray]:
    """Return the covariance of the displacement of each row's target by the parameters of a fit to
    all rows, as :func:`left_out_variances`.
    """
    fold = np.zeros(len(fit.problem.conditions), int)
    return list(_covariances(fit, fold, stations, [_root(fit)]))


def _covariances(
    fit: ModelFit, fold: np.ndarray, stations: Sequence[int], roots: Sequence[np.ndarray]
) -> Iterator[np.ndarray]:
    """Yield the covariances at each of some stations, for roots of that of the free parameters for
    the rows of each fold, shape (F, r).
    """
    problem = fit.problem
    free = fit.solution.free
    number = np.cumsum(free) - 1
    for at in stations:
        station = problem.stations[at]
        places = problem.places[at]
        rows = problem.rows[at]
        own = free[places]
        moved = station.displacements_by(fit.solution.values[places], own)
        covariance = np.zeros((len(station), 3, 3))
        for k, root in enumerate(roots):
            mine = np.flatnonzero(fold[rows] == k)
            along = np.einsum("fr,fna->nar", root[number[places[own]]], moved[:, mine])
            covariance[mine] = along @ along.swapaxes(1, 2)
        yield covariance


def _roots_without(fit: ModelFit, fold: np.ndarray) -> list[np.ndarray]:
    """Return roots of the covariance of the free parameters without each fold, shape (F, r)."""
    root = _root(fit)
    found = []
    for information in _information(fit, fold):
        w, V = np.linalg.eigh(root.T @ information @ root)
        found.append(root @ V / np.sqrt(1.0 - np.clip(w, 0.0, _MOST)))
    return found


def _root(fit: ModelFit) -> np.ndarray:
    """Return a root of the covariance of the free parameters, shape (F, r)."""
    variances, axes = np.linalg.eigh(covariance_at_mean(fit, of_rows=True).dense())
    some = variances > 0.0
    return np.asarray(axes[:, some] * np.sqrt(variances[some]))


def _information(fit: ModelFit, fold: np.ndarray) -> np.ndarray:
    """Return the information of each of K folds on the free parameters, shape (K, F, F)."""
    problem = fit.problem
    free = fit.solution.free
    number = np.cumsum(free) - 1
    found = np.zeros((int(fold.max(initial=-1)) + 1, int(free.sum()), int(free.sum())))
    parts = zip(problem.stations, problem.places, problem.rows, problem.block_spans, strict=True)
    for station, places, rows, blocks in parts:
        own = free[places]
        at = np.ix_(number[places[own]], number[places[own]])
        sigma = np.repeat(fit.solution.sigma[blocks], station.block_sizes)
        scale = fit.solution.weights[rows] * station.weights / sigma[:, None]
        for piece, _, J in station.linearise(fit.solution.values[places], own):
            scaled = J * scale[:, piece]
            for k in np.unique(fold[rows][piece]):
                X = scaled[:, :, fold[rows][piece] == k].reshape(len(J), -1)
                found[k][at] += X @ X.T
    return found
