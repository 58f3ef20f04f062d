r"""How rough drive curves are, by the likelihood of the data whatever the heights (empirical Bayes).

With G, g the normal equations of everything, the curves as fine as the poses carry them, L the information of all priors
and :math:`R_j / w_j^2` that of the roughness of curve j, the heights x and their covariance C are those of
:math:`C = (G + L + \sum_j R_j / w_j^2)^{-1}`, and the likelihood integrated over x is largest where

.. math:: w_j^2 = \frac{x_j^T R_j x_j}{\operatorname{tr} R_j (P_j^{-1} - C_j)} w_j^2, \qquad P_j = D_j^{-2} + R_j / w_j^2,

for priors of size D (Wood and Fasiolo 2017, Biometrics 73, 1071-1081, equation 4); the noise follows from what is left. One
pass over the data serves all iterations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigvalsh, lstsq
from scipy.linalg.lapack import dpotrf, dpotri

from pincal.discover.nuisance import situation_of
from pincal.identify.beliefs import priors_of
from pincal.identify.equations import Linearised
from pincal.identify.fit import Fit, carried
from pincal.model.effect import Curve
from pincal.model.sparse_basis import mirror

# Where the search for the roughness begins [rad^-0.5], how often it is moved at most, and the change that ends it.
_ROUGHNESS, _MOVES, _SETTLED = 0.1, 15, 0.05
# It moves by this factor at most; below the least, a curve strays from a straight line by less than 0.01 mrad in a radian.
_FARTHEST, _LEAST = 10.0, 1e-5
# Part of the variance of the noise that finer curves may leave at least: readings that they go through have none.
_LEAST_NOISE = 1e-3
# How much surer than by their priors other parameters are taken to stay, in the step from there: where compliances multiply
# places of bearings, a whole one leads far off.
_FIRM = 30.0
# Keeps a scaled matrix of information definite where rounding would not.
_ROUNDING = 1e-12
# Positions by which a curve is drawn in other pieces, for each of these.
_DENSELY = 8


def smoothed(fit: Fit, curves: Sequence[Curve]) -> tuple[dict[Curve, tuple[Curve, np.ndarray]], Fit]:
    """Return the curves of a fit as fine as the poses carry them and as rough as the data call for, with their heights.

    Beside them the other parameters move; the fit is returned with these where they are to first order.
    """
    situation, sigma = situation_of(fit), fit.solution.estimated
    finer, smooth = ({curve: curve.smooth(situation, w) for curve in curves} for w in (None, 1.0))
    problem, alike = (
        fit.problem.with_effects([by.get(e, e) if isinstance(e, Curve) else e for e in fit.options.effects])
        for by in (finer, smooth)
    )
    start = carried(fit.solution, fit.problem, problem)
    places = [problem.places_at(curve) for curve in finer.values()]
    sizes = priors_of(alike, fit.options).sizes
    for curve, at in zip(curves, places, strict=True):
        start.values[at] = _drawn_again(curve, fit.values[fit.problem.places_at(curve)], finer[curve])
        start.free[at] = True
    here = Linearised(problem, start.values, start.free, start.weights, sizes)
    found = here.equations(sigma)
    kept = np.flatnonzero(start.free & problem.is_shared)
    believed, slope = problem.beyond_priors(kept, start.values, sizes)
    counts = problem.counted_rows(start.weights)[problem.station_of_block]
    quadratic = Quadratic(
        G=found.G - believed,
        g=found.g - slope,
        believed=believed,
        slope=slope,
        sizes=sizes[kept],
        values=start.values[kept],
        squares=here.chi2(sigma),
        readings=int(counts @ problem.block_sizes),
    )
    columns = [np.searchsorted(kept, at) for at in places]
    bends = [np.asarray(curve.smoothness()) for curve in smooth.values()]
    roughness, step, noise = quadratic.likeliest(columns, bends)
    chosen = {}
    for curve, w, at, own in zip(curves, roughness, places, columns, strict=True):
        pieces = _pieces(finer[curve], found.G[np.ix_(own, own)] / noise, float(w))
        smooth[curve] = curve.smooth(situation, float(w), pieces)
        chosen[curve] = smooth[curve], _drawn_again(finer[curve], start.values[at] + step[own], smooth[curve])
    start.values[kept] += step
    others = problem.carried_over(start.values, fit.problem)
    return chosen, replace(fit, solution=replace(fit.solution, values=others))


def _pieces(curve: Curve, information: np.ndarray, roughness: float) -> int:
    """Return how many pieces are half as long as the shortest waves of which the rows say as much as the roughness does.

    Of k radians a unit the prior says k^4 / w^2 and rows of levers l the sum of l^2 over their range, whatever k.

    Args:
        curve: a curve.
        information: shape (K, K), of the rows about its heights.
        roughness: w.
    """
    q, span = _along(curve)
    wave = 0.25 * np.pi * curve.resolution / span * q
    heights = _heights(curve, np.stack([np.sin(wave), np.cos(wave)]))
    density = float(np.sum(heights * (heights @ information))) / span
    return int(np.ceil(span / np.pi * (density * roughness**2) ** 0.25))


def _drawn_again(curve: Curve, heights: np.ndarray, other: Curve) -> np.ndarray:
    """Return the heights of a curve in other pieces."""
    return _heights(other, heights @ curve.basis(_along(other)[0]))


def _heights(curve: Curve, drawn: np.ndarray) -> np.ndarray:
    """Return the heights, shape (..., K), of what is drawn at many positions along a curve, shape (..., N)."""
    return np.asarray(lstsq(curve.basis(_along(curve)[0]).T, drawn.T, lapack_driver="gelsy", check_finite=False)[0].T)


def _along(curve: Curve) -> tuple[np.ndarray, float]:
    """Return many positions along a curve, and the length of its range."""
    lower, upper = curve.locus.span or (-np.pi, np.pi)
    return np.linspace(lower, upper, _DENSELY * curve.resolution), upper - lower


@dataclass(frozen=True, eq=False)
class Quadratic:
    """The sum of squares of data and priors about present values of F parameters.

    Attributes:
        G, g: shape (F, F) and (F,), the normal equations of the data alone.
        believed, slope: what is believed beyond the priors of each parameter, but for the curves' roughness.
        sizes: shape (F,), standard deviations of the priors; inf for none.
        values: shape (F,).
        squares: of the residuals, in units of the noise.
        readings: their number.
    """

    G: np.ndarray
    g: np.ndarray
    believed: np.ndarray
    slope: np.ndarray
    sizes: np.ndarray
    values: np.ndarray
    squares: float
    readings: int

    def likeliest(self, columns: Sequence[np.ndarray], bends: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the likeliest roughness of each curve, the step of all parameters with it, and the variance of the noise.

        Args:
            columns: of each curve.
            bends: of each curve, R.
        """
        w, noise = np.full(len(columns), _ROUGHNESS), 1.0
        alone = [eigvalsh(R * np.outer(self.sizes[at], self.sizes[at])) for at, R in zip(columns, bends, strict=True)]
        for _ in range(_MOVES):
            step, C = self._posterior(columns, bends, w, noise)
            spent = float(np.sum(C * self.G)) / noise
            left = self.squares - 2.0 * float(self.g @ step) + float(step @ self.G @ step)
            noise = max(left / max(self.readings - spent, 1.0), _LEAST_NOISE)
            before = w.copy()
            for j, (at, R, known) in enumerate(zip(columns, bends, alone, strict=True)):
                x = self.values[at] + step[at]
                free = float(np.sum(known / (1.0 + known / w[j] ** 2)) - np.sum(C[np.ix_(at, at)] * R))
                factor = np.sqrt(float(x @ R @ x) / max(free, 1e-300))
                w[j] = max(w[j] * np.clip(factor, 1.0 / _FARTHEST, _FARTHEST), _LEAST)
            if np.max(np.abs(np.log(w / before))) < _SETTLED:
                break
        # Known surer, and nearer to what is believed by as much: the others are pulled as before, and move less.
        firm = np.full(len(self.sizes), 1.0 + _FIRM)
        firm[np.concatenate(columns)] = 1.0
        firmly = replace(self, sizes=self.sizes / np.sqrt(firm), values=self.values / firm)
        return w, firmly._posterior(columns, bends, w, noise)[0], noise

    def _posterior(
        self, columns: Sequence[np.ndarray], bends: Sequence[np.ndarray], w: np.ndarray, noise: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the step to the most probable values, shape (F,), and their covariance, shape (F, F)."""
        precision = self.sizes**-2.0
        H, slope = self.G / noise + self.believed, self.g / noise + self.slope - precision * self.values
        H.flat[:: len(H) + 1] += precision
        for at, R, each in zip(columns, bends, w, strict=True):
            more = R / each**2
            H[np.ix_(at, at)] += more
            slope[at] -= more @ self.values[at]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        H *= scale
        H *= scale[:, None]
        H.flat[:: len(H) + 1] += _ROUNDING
        # Column-major, which spares LAPACK a copy.
        factor, _ = dpotrf(H.T, lower=1, overwrite_a=1)
        C, _ = dpotri(factor, lower=1, overwrite_c=1)
        mirror(C, np.arange(len(C)))
        C *= scale
        C *= scale[:, None]
        return C @ slope, C
