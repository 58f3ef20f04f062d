"""Fits to exact readings, finished to rounding with singular values of the Jacobian itself.

Real instruments are never so exact that J^T J, rounded to sixteen digits, loses what they say; simulated ones are, and the
question what a model can do at all is asked with them.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from pincal.identify.equations import Linearised
from pincal.identify.normal import belief_rows
from pincal.identify.problem import Problem

# Steps of a fit to exact readings, and the largest Jacobian (rows times parameters) that is held at once for them.
_POLISHING = 60
# Damping of a step in parts of the largest singular value of J (Levenberg, Marquardt): rounding, and more where that fails.
_DAMPING = (64.0 * np.finfo(float).eps, 1e-11, 1e-9, 1e-7)
# Parts of a step that are tried.
_PARTS = (1.0, 0.5, 0.25, 0.1, 0.02)
# Those above these parts count as strong, in turn, and the steps along them after each.
_STRONG, _CORRECTIONS = (1e-3, 1e-6), 3
# Rounding of G, in units of what priors know, from which on it is too coarse.
_COARSE = 1e-4
# What is left of exact readings by a fit that can't get better, in units of their rounding.
_EXACT = 1e-3
MOST_EXACT = 2_000_000


def rounding(problem: Problem) -> np.ndarray:
    """Return the rounding of predictions, shape (blocks,); noise is never taken to be less."""
    return np.array([block.rounding for block in problem.blocks])


def is_exact(G: np.ndarray, sizes: np.ndarray) -> bool:
    """Return whether the information of the readings, the diagonal of G, is too much for the rounding of what priors say."""
    known = np.isfinite(sizes)
    # By roots: squares of sizes that follow from an absurd mass have no place in a float.
    told = np.sqrt(np.maximum(G[known], 0.0)) * sizes[known]
    return bool(np.max(told, initial=0.0) > np.sqrt(_COARSE / np.finfo(float).eps))


def polish(point: Linearised, bounds: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, int]:
    """Go on from a fit that is nearly there.

    Priors have no say: a pull along directions that no reading sees, which are curved, would only keep the fit from getting
    on. Such directions stay where they are. A long step along weak directions leaves the valley floor, which is curved, too;
    steps along the strong ones lead back to it (a second-order correction, Nocedal and Wright 2006, section 18.3).

    Args:
        point: the problem at the values to begin with; of the priors only the sizes, by which parameters are compared.
        bounds: shape (P,), largest deviations.
        sigma: shape (blocks,), noise.

    Returns:
        The values, shape (P,), and the steps taken.
    """
    problem, values, free = point.problem, point.values, point.free
    sizes, bounds = point.sizes[free], bounds[free]
    known, weights, floor = np.isfinite(sizes), [], 0.0
    for station, rows, span in zip(problem.stations, problem.rows, problem.block_spans, strict=True):
        noise, exact = (np.repeat(of[span], station.block_sizes) for of in (sigma, _EXACT * rounding(problem)))
        weights.append(station.weights * point.robust[rows] / noise[:, None])
        floor += float(np.sum((exact[:, None] * weights[-1]) ** 2))
    J, r = _whitened(problem, values, free, weights)
    for k in range(1, _POLISHING + 1):
        norms = np.maximum(np.linalg.norm(J, axis=1), 1e-300)
        # Frames have no size of their own: they shall count like what counts most.
        scale = np.where(known, sizes, np.max((norms * sizes)[known], initial=1.0) / norms)
        U, s, Vt = np.linalg.svd((J * scale[:, None]).T, full_matrices=False)
        for least, part in product(_DAMPING, _PARTS):
            damped = s / (s**2 + (least * s[0]) ** 2)
            trial = values.copy()
            trial[free] += part * scale * (Vt.T @ (damped * (U.T @ r)))
            left = _whitened(problem, trial, free, weights)[1]
            for strong in [s > most * s[0] for most in _STRONG for _ in range(_CORRECTIONS)]:
                back = trial.copy()
                back[free] += scale * (Vt[strong].T @ ((U[:, strong].T @ left) / s[strong]))
                better = _whitened(problem, back, free, weights)[1]
                if better @ better < 0.5 * (left @ left):
                    trial, left = back, better
            if left @ left < r @ r and np.all(np.abs(trial[free]) <= bounds):
                break
        else:
            return values, k
        values = trial
        J, r = _whitened(problem, values, free, weights)
        if r @ r < floor:
            return values, k
    return values, _POLISHING


def _whitened(
    problem: Problem, values: np.ndarray, free: np.ndarray, weights: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return Jacobian, shape (F, M), and residuals, shape (M,), in units of the noise, constraints among them."""
    rank = np.cumsum(free) - 1
    columns, residuals = [], []
    for station, places, weight in zip(problem.stations, problem.places, weights, strict=True):
        at, moved = values[places], free[places]
        parts = list(station.linearise(at, moved))
        more, known = belief_rows(station, at, moved)
        J = np.concatenate([part[2] for part in parts], axis=2) * weight
        whole = np.zeros((int(free.sum()), weight.size + len(known)))
        whole[rank[places[moved]]] = np.hstack([J.reshape(len(J), weight.size), more])
        columns.append(whole)
        residuals += [(np.concatenate([part[1] for part in parts], axis=1) * weight).ravel(), known]
    return np.hstack(columns), np.concatenate(residuals)
