r"""The uncertainty of predictions by fits without the fold of a pose.

With the covariance C of the parameters by all rows, and the information :math:`A_k` that the rows
of fold k give, the covariance without them is :math:`(C^{-1} - A_k)^{-1}`: in the axes of
:math:`L^T A_k L = V w V^T`, for :math:`C = L L^T`, it is :math:`L V (1 - w)^{-1} V^T L^T`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import LinAlgError, cholesky, eigh, solve_triangular

from pincal.calibration.wandering import covariance_at_mean
from pincal.identify.fit import ModelFit
from pincal.parameters import thin_root_of
from pincal.thresholds import Count, Scale

# Largest part of what is known of a direction that a single fold may have given: where it gave all,
# priors remain, to the accuracy of a difference.
_MOST: Scale = 0.99
# Standard deviation below which a parameter is known exactly [any unit].
_SMALLEST: Scale = 1e-300
# Rows whose motions by all parameters are held at once.
_AT_ONCE: Count = 512


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
    root = thin_root_of(covariance_at_mean(fit, of_rows=True).dense())
    found = [np.zeros((len(fit.problem.stations[at]), 3, 3)) for at in stations]
    for k in range(int(fold.max(initial=-1)) + 1):
        known = _known_by(fit, fold == k, root)
        for at, covariance in zip(stations, found, strict=True):
            mine = np.flatnonzero(fold[fit.problem.rows[at]] == k)
            for rows in _at_once(mine):
                moved = np.tensordot(_motions(fit, at, rows), root, axes=(0, 0))
                along = _without(moved.reshape(-1, root.shape[1]), known).reshape(moved.shape)
                covariance[rows] = along @ along.swapaxes(1, 2)
    return found


def fitted_variances(fit: ModelFit, stations: Sequence[int]) -> list[np.ndarray]:
    """Return the covariance of the displacement of each row's target by the parameters of a fit to
    all rows, as :func:`left_out_variances`.
    """
    root = thin_root_of(covariance_at_mean(fit, of_rows=True).dense())
    found = [np.zeros((len(fit.problem.stations[at]), 3, 3)) for at in stations]
    for at, covariance in zip(stations, found, strict=True):
        for rows in _at_once(np.arange(len(covariance))):
            # By a root, so that no variance of exact readings is less than zero by rounding.
            along = np.tensordot(_motions(fit, at, rows), root, axes=(0, 0))
            covariance[rows] = along @ along.swapaxes(1, 2)
    return found


def _at_once(rows: np.ndarray) -> list[np.ndarray]:
    return np.array_split(rows, -(-len(rows) // _AT_ONCE)) if len(rows) else []


def _motions(fit: ModelFit, at: int, rows: np.ndarray) -> np.ndarray:
    """Return the displacements of the targets of some rows of a station by the free parameters of
    the fit, shape (F, n, 3).
    """
    places = fit.problem.places[at]
    free = fit.solution.free
    own = free[places]
    number = np.cumsum(free) - 1
    found = np.zeros((int(free.sum()), len(rows), 3))
    few = fit.problem.stations[at].select(rows)
    found[number[places[own]]] = few.displacements_by(fit.solution.values[places], own)
    return found


def _without(moved: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return A, shape (n, r), with A A^T the covariance of motions without what a fold has given.

    Args:
        moved: shape (n, r), motions by the columns of a root of the covariance with it.
        known: shape (r, r), information of the fold on these.
    """
    own = np.eye(len(known))
    try:
        # A factor exists where no direction is known by the fold to more than this part.
        cholesky(_MOST * own - known, lower=True, overwrite_a=True, check_finite=False)
    except LinAlgError:
        w, V = eigh(known, subset_by_value=(_MOST, np.inf), check_finite=False)
        known = known - (V * (w - _MOST)) @ V.T
    L = cholesky(own - known, lower=True, overwrite_a=True, check_finite=False)
    return np.asarray(solve_triangular(L, moved.T, lower=True, check_finite=False).T)


def _known_by(fit: ModelFit, some: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return the information of some rows, a mask of those of all stations, on the columns of a
    root of the covariance of the free parameters, shape (r, r).
    """
    # In units of their uncertainty parameters are alike, so that products keep their digits.
    sizes = np.linalg.norm(root, axis=1)
    scaled = root / np.maximum(sizes, _SMALLEST)[:, None]
    information = sizes[:, None] * _information(fit, some) * sizes
    return np.asarray(scaled.T @ information @ scaled)


def _information(fit: ModelFit, some: np.ndarray) -> np.ndarray:
    """Return the information of some rows on the free parameters, shape (F, F)."""
    problem = fit.problem
    free = fit.solution.free
    number = np.cumsum(free) - 1
    found = np.zeros((int(free.sum()), int(free.sum())))
    parts = zip(problem.stations, problem.places, problem.rows, problem.block_spans, strict=True)
    for station, places, rows, blocks in parts:
        own = free[places]
        G = np.zeros((int(own.sum()), int(own.sum())))
        sigma = np.repeat(fit.solution.sigma[blocks], station.block_sizes)
        scale = fit.solution.weights[rows] * station.weights / sigma[:, None]
        plain = replace(station, whitening=None, serial=None, arrival=None)
        for mine in _at_once(np.flatnonzero(some[rows])):
            few = plain.select(mine)
            for piece, residuals, J in few.linearise_correlated(fit.solution.values[places], own):
                J.weighted(scale[:, mine[piece]]).add_gram(residuals, G, np.zeros(len(G)))
        at = number[places[own]]
        found[np.ix_(at, at)] += G
    return found
