r"""Regions of joint space, and how far a robot may be from its URDF, by regions that are left out.

Readings without an instrument (contacts, planes, gauges, sockets) see few directions at few places. What they do not see
keeps its prior, and one that is wider than the robot's deviations lets errors of the contacts pass for geometry, which then
does harm wherever nobody measured. The priors of geometry and of elasticity are therefore multiplied by the factors by which
rows of regions are predicted best from the others. With what all rows and the prior P say of the parameters about a point,
information H + P and gradient b, their evidence is :math:`E = (b^T (H + P)^{-1} b - \log\det (H + P)) / 2`, and region r has
the log-likelihood, given the others,

.. math:: E(H, b) - E(H - H_r, b - b_r) - s_r / 2

with its squares s_r at that point. Of factors whose likelihoods differ by less than a standard error of the difference over
the regions, or by less than is strong evidence, those count whose larger is the smallest (Breiman et al. 1984,
Classification and Regression Trees, 3.4.3).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from pincal.identify.beliefs import deviations
from pincal.identify.believed import slope_of_contacts
from pincal.identify.criteria import CRITERIA
from pincal.identify.fit import ModelFit
from pincal.identify.normal import accumulate
from pincal.identify.quadratic import Factor, Form
from pincal.model.conditions import TURN

# Factors that are tried, and regions of each station.
_SCALES, _REGIONS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001), 10
# Standard deviation of what has no prior [m or rad], so that a region without which nothing is known of it has one.
_ANYWHERE = 10.0


def joint_regions(q: np.ndarray, most: int, seed: int = 0) -> np.ndarray:
    """Return the number of the region of joint space of each row of q, shape (N, n), of at most so many, shape (N,)."""
    from scipy.cluster.vq import kmeans2

    folded = _at_one_turn(q)
    spread = np.maximum(folded.std(axis=0), 1e-9)
    n = min(most, len(np.unique(distinct_poses(q))))
    labels = kmeans2(folded / spread, n, minit="++", rng=np.random.default_rng(seed))[1]
    return np.unique(labels, return_inverse=True)[1].ravel()


def distinct_poses(q: np.ndarray) -> np.ndarray:
    """Return a number for each row of q, shape (N, n), the same for those with the same joint positions, shape (N,)."""
    return np.unique(np.round(_at_one_turn(q), 9), axis=0, return_inverse=True)[1].ravel()


def _at_one_turn(q: np.ndarray) -> np.ndarray:
    """Return joint positions, shape (N, n), those of a joint that takes more than a turn folded into one turn.

    It begins behind the largest gap, so that neighbours stay neighbours. A rail of more than 6 m is folded, too: two far
    places on it may then be held out together, which does no harm.
    """
    folded = np.array(q, float)
    for j in np.flatnonzero(np.ptp(q, axis=0) > TURN) if len(q) else ():
        angles = np.unique(np.mod(q[:, j], TURN))
        gap = int(np.argmax(np.diff(angles, append=angles[0] + TURN)))
        # The middle of the gap, where rounding can't carry a row to the other end.
        start = angles[gap] + 0.5 * (angles[(gap + 1) % len(angles)] - angles[gap]) % TURN
        folded[:, j] = np.mod(q[:, j] - start, TURN)
    return folded


def has_instrument(fit: ModelFit) -> bool:
    """Return whether something beside the robot and what it touches tells where any of its targets are."""
    return any(station.sensor.base_symbols or station.sensor.is_on_tool for station in fit.problem.stations)


def prior_scale(fit: ModelFit) -> tuple[float, float]:
    """Return the factors on the priors of geometry and of elasticity, see above; 1 where too few regions tell them."""
    free, sizes = fit.solution.free, np.minimum(fit.priors.sizes, _ANYWHERE)
    regions, offsets = _regions(fit), np.where(np.isfinite(fit.priors.sizes), fit.values, 0.0)[free]
    kinds = [kind[free] for kind in deviations(fit.problem, fit.options)]
    if len(regions) < 2 or not any(kind.any() for kind in kinds):
        return 1.0, 1.0

    def scaled(scales: tuple[float, float]) -> np.ndarray:
        return np.asarray(np.where(kinds[0], scales[0], np.where(kinds[1], scales[1], 1.0)))

    nominal = sizes[free] / scaled(fit.options.prior_scale or (1.0, 1.0))
    tried = [*product(_SCALES, _SCALES if kinds[1].any() else (1.0,))]
    likely = np.array([_likelihoods(regions, nominal * scaled(scales), offsets) for scales in tried])
    behind = likely[np.argmax(likely.sum(axis=1))] - likely
    doubt = behind.std(axis=1, ddof=1) * np.sqrt(len(regions))
    good = [
        scales
        for scales, less, by in zip(tried, behind.sum(axis=1), doubt, strict=True)
        if less <= max(by, CRITERIA.smaller_prior)
    ]
    return min(good, key=lambda scales: (max(scales), min(scales)))


def _regions(fit: ModelFit) -> list[tuple[Form, float]]:
    """Return what the rows of each region say of the free parameters, and their squares."""
    problem, solution, found = fit.problem, fit.solution, []
    rank, n_free = np.cumsum(solution.free) - 1, int(solution.free.sum())
    for (station, places, blocks), rows in zip(fit.stations, problem.rows, strict=True):
        here, robust = solution.free[places], solution.weights[rows]
        region, at, sigma = joint_regions(station.conditions.q, _REGIONS), rank[places[here]], solution.sigma[blocks]
        for each in np.unique(region):
            part = region == each
            normal = accumulate(station.select(part), solution.values[places], here, robust[part])
            own, H, g = replace(normal, believed=None).at(sigma), np.zeros((n_free, n_free)), np.zeros(n_free)
            H[np.ix_(at, at)], g[at] = own.H, own.g + int(part.sum()) * slope_of_contacts(station)[here]
            found.append((Form.of(H, g), float(np.sum(normal.squares / sigma**2))))
    return found


def _likelihoods(regions: list[tuple[Form, float]], sizes: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Return the log-likelihood of each region given the others, shape (R,).

    Args:
        regions: what each says of F parameters, and its squares.
        sizes: shape (F,), standard deviations of the priors.
        offsets: shape (F,), where the parameters stand.
    """
    H, b = sum(form.H for form, _ in regions), sum(form.g for form, _ in regions)
    A, b = H + np.diag(sizes**-2.0), b - offsets / sizes**2

    def evidence(A: np.ndarray, b: np.ndarray) -> float:
        factor = Factor.of(A)
        half = factor.half(b)
        return 0.5 * (float(half @ half) - factor.log_det)

    whole = evidence(A.copy(), b)
    return np.array([whole - evidence(A - form.H, b - form.g) - 0.5 * square for form, square in regions])
