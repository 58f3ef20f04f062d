r"""The uncertainty of predictions by fits without the fold of a pose.

With the covariance :math:`C = L L^T` of the parameters by all rows, and the information :math:`A_k`
that the rows of fold k give, :math:`L^T A_k L = V w V^T` in orthonormal axes V, as few as the fold
tells of, and the covariance without the fold is

.. math:: (C^{-1} - A_k)^{-1} = C + L V \frac{w}{1 - w} V^T L^T .
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import qr

from pincal.calibration.wandering import covariance_at_mean
from pincal.identify.fit import ModelFit
from pincal.identify.jacobian import add_block
from pincal.parameters import quick_root_of
from pincal.thresholds import Count, Scale

# Largest part of what is known of a direction that a single fold may have given: where it gave all,
# priors remain, to the accuracy of a difference.
_MOST: Scale = 0.99
# Standard deviation below which a parameter is known exactly [any unit].
_SMALLEST: Scale = 1e-300
# Rows whose motions by all columns of a root are held at once: few, so that they stay in the cache.
_AT_ONCE: Count = 256


class TargetVariances(NamedTuple):
    """Covariances of the displacements of targets at N rows by the parameters, shape (N, 3, 3)
    [m^2]: of the fit to all rows, and of fits without the fold of each row.
    """

    by_all: np.ndarray
    without: np.ndarray


def target_variances(
    fit: ModelFit, fold: np.ndarray, stations: Sequence[int]
) -> list[TargetVariances]:
    """Return the covariances of the displacement of each row's target, for some stations.

    Args:
        fit: the fit of all rows.
        fold: shape (N,), fold of each row of all stations, numbered from 0.
        stations: their numbers; of readings that give positions.
    """
    root = quick_root_of(covariance_at_mean(fit, of_rows=True).dense())
    found = list[TargetVariances]()
    for at in stations:
        by_all = np.zeros((len(fit.problem.stations[at]), 3, 3))
        _add(by_all, fit, at, np.arange(len(by_all)), root)
        found.append(TargetVariances(by_all, by_all.copy()))
    for k in range(int(fold.max(initial=-1)) + 1):
        more = _lost_without(root, _information(fit, fold == k))
        for at, of in zip(stations, found, strict=True):
            rows = np.flatnonzero(fold[fit.problem.rows[at]] == k)
            _add(of.without, fit, at, rows, more)
    return found


def _add(
    covariance: np.ndarray, fit: ModelFit, at: int, rows: np.ndarray, root: np.ndarray
) -> None:
    """Add the covariance of the displacements of some rows of a station, for a root of that of the
    free parameters, shape (F, r), to those of all, shape (N, 3, 3).
    """
    places = fit.problem.places[at]
    own = fit.solution.free[places]
    steps = np.ascontiguousarray(root[(np.cumsum(fit.solution.free) - 1)[places[own]]])
    few = fit.problem.stations[at].select(rows)
    for piece, motions in few.displacements_shared(fit.solution.values[places], own):
        mine = rows[piece]
        for start in range(0, len(mine), _AT_ONCE):
            some = slice(start, min(start + _AT_ONCE, len(mine)))
            # By a root, so that no variance of exact readings is less than zero by rounding.
            along = np.ascontiguousarray(motions.poses(some).along(steps).transpose(2, 1, 0))
            covariance[mine[some]] += along @ along.swapaxes(1, 2)


def _lost_without(root: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Return a root of what the covariance of parameters has more without a fold, shape (F, v).

    Args:
        root: shape (F, r), of the covariance with it.
        information: shape (F, F), that the fold gives: of few parameters where it reaches few
            pieces of the curves.
    """
    seen = np.flatnonzero(np.diag(information) > 0.0)
    # In units of their uncertainty parameters are alike, so that products keep their digits.
    sizes = np.linalg.norm(root[seen], axis=1)
    axes, scaled = qr(
        (root[seen] / np.maximum(sizes, _SMALLEST)[:, None]).T, mode="economic", check_finite=False
    )
    known = sizes[:, None] * information[np.ix_(seen, seen)] * sizes
    w, V = np.linalg.eigh(scaled @ known @ scaled.T)
    w = np.clip(w, 0.0, _MOST)
    return np.asarray(root @ (axes @ (V * np.sqrt(w / (1.0 - w)))))


def _information(fit: ModelFit, some: np.ndarray) -> np.ndarray:
    """Return the information of some rows, a mask of those of all stations, on the free parameters,
    shape (F, F).
    """
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
        mine = np.flatnonzero(some[rows])
        few = plain.select(mine)
        for piece, residuals, J in few.linearise_correlated(fit.solution.values[places], own):
            J.weighted(scale[:, mine[piece]]).add_gram(residuals, G, np.zeros(len(G)))
        at = number[places[own]]
        add_block(found, at, at, G)
    return found
