r"""The second leg of uncertainty: what blocks of rows that follow each other say, whatever makes them agree.

With :math:`s_n = J_n^T r_n` the scores of the rows in units of their noise and G the normal matrix, the covariance of the
parameters is :math:`G^{-1}` if rows are independent, and

.. math:: G^{-1} \Big( \sum_b s_b s_b^T \Big) G^{-1}, \qquad s_b = \sum_{n \in b} s_n ,

for blocks b that are (the sandwich: Liang and Zeger 1986, Biometrika 73, 13-22; of blocks, not of rows, as in a moving-block
bootstrap). Blocks are too few to tell it parameter by parameter, so what is taken from it is one factor: the mean over all
directions that the model can move in, beside the same rows in any order.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from pincal.identify.criteria import CRITERIA
from pincal.identify.fit import ModelFit, equations_of
from pincal.identify.station import Station

# Rows of a block.
_LENGTHS = (5, 10, 20, 40)
# Readings of a station by which it is told, and stations that are asked.
_READINGS, _MOST_STATIONS = 1500, 8


def factor_of_blocks(fit: ModelFit) -> float:
    """Return how many times as large the variances of a fit are as blocks of consecutive rows tell; 1 if not surely larger.

    Of several stations the largest factor counts; of many, some are asked, evenly spread: it widens what all say together.
    """
    every = [(*of, rows) for of, rows in zip(fit.stations, fit.problem.rows, strict=True)]
    asked = set(np.linspace(0.0, len(every) - 1.0, _MOST_STATIONS).round().astype(int).tolist())
    return max((_of_station(fit, *every[k]) for k in asked), default=1.0)


def with_blocks(fit: ModelFit, beyond: float = 1.0) -> ModelFit:
    """Return a fit with a covariance as wide as blocks of consecutive rows tell, times a factor for other doubts."""
    of_blocks = factor_of_blocks(fit)
    fit = _widened_by(fit, of_blocks * beyond)
    return replace(fit, solution=replace(fit.solution, of_blocks=of_blocks)) if of_blocks > 1.0 else fit


def _widened_by(fit: ModelFit, factor: float) -> ModelFit:
    """Return a fit with a covariance as if the variance of its noise were so many times as large."""
    if factor <= 1.0:
        return fit
    solution = fit.solution
    wide = equations_of(fit.problem, replace(solution, sigma=solution.sigma * np.sqrt(factor)), fit.priors)
    # What the data identify stays as it is.
    known = solution.posterior
    posterior = replace(known, covariance=wide.posterior.covariance, own=wide.own)
    return replace(fit, solution=replace(solution, wide=posterior))


def _of_station(fit: ModelFit, station: Station, places: np.ndarray, blocks: slice, rows: slice) -> float:
    if station.position is None or station.sensor.is_whole:
        return 1.0
    sizes = station.block_sizes
    counted = np.flatnonzero(fit.solution.weights[rows] > 0.0)
    some = counted[np.argsort(station.position[counted], kind="stable")][: _READINGS // int(sizes.sum())]
    if len(some) < CRITERIA.fewest_blocks * _LENGTHS[0]:
        return 1.0
    free, few = fit.solution.free[places], station.select(some)
    scale = few.weights / np.repeat(fit.solution.estimated[blocks], sizes)[:, None]
    scores, normal, at = list[np.ndarray](), np.diag(fit.priors.sizes[places][free] ** -2.0), np.zeros(0, int)
    for piece, residuals, jacobian in few.linearise_shared(fit.solution.values[places], free):
        J, at = jacobian.dense_columns()
        J = J * scale[:, piece]
        scores.append(np.einsum("dmn,mn->dn", J, residuals * scale[:, piece]))
        normal[np.ix_(at, at)] += np.tensordot(J, J, axes=((1, 2), (1, 2)))
    return _largest_factor(np.concatenate(scores, axis=1), normal[np.ix_(at, at)])


def _largest_factor(scores: np.ndarray, normal: np.ndarray) -> float:
    """Return the factor that is surest, of scores, shape (D, n), of rows in their order; 1 if none is sure.

    The reference is that of the same rows in any order, by its first two moments.
    """
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    try:
        L = cholesky(normal / np.outer(size, size) + 1e-9 * np.eye(len(size)), lower=True, check_finite=False)
    except LinAlgError:
        return 1.0
    u = solve_triangular(L, scores / size[:, None], lower=True, check_finite=False)
    n, own = u.shape[1], np.sum(u**2, axis=0)
    pairs = n * (n - 1)
    mean = (float(np.sum(u.sum(axis=1) ** 2)) - own.sum()) / pairs
    spread = max((float(np.sum((u @ u.T) ** 2)) - float(own @ own)) / pairs, 1e-300)
    surest, factor = CRITERIA.of_blocks, 1.0
    for length in _LENGTHS:
        if n < CRITERIA.fewest_blocks * length:
            break
        whole = n // length * length
        of_blocks = u[:, :whole].reshape(len(u), -1, length).sum(axis=2)
        count = whole * (length - 1)
        beyond = float(np.sum(of_blocks**2)) - own[:whole].sum() - count * mean
        sure = beyond / np.sqrt(2.0 * count * spread)
        if sure > surest:
            surest, factor = sure, 1.0 + beyond / own[:whole].sum()
    return float(factor)
