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
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigvalsh
from scipy.linalg.lapack import dpotrf, dpotri

from pincal.discover.nuisance import situation_of
from pincal.identify.beliefs import priors_of
from pincal.identify.equations import Linearised
from pincal.identify.fit import Fit, carried
from pincal.model.effect import Curve

# Where the search for the roughness begins [rad^-0.5], how often it is moved at most, and the change that ends it.
_ROUGHNESS, _MOVES, _SETTLED = 0.1, 15, 0.05
# It moves by this factor at most; below the least, a curve strays from a straight line by less than 0.01 mrad in a radian.
_FARTHEST, _LEAST = 10.0, 1e-5
# Part of the variance of the noise that finer curves may leave at least: readings that they go through have none.
_LEAST_NOISE = 1e-3
# Keeps a scaled matrix of information definite where rounding would not.
_ROUNDING = 1e-12
# Positions by which a curve is drawn in other pieces, for each of these.
_DENSELY = 8


def smoothed(fit: Fit, curves: Sequence[Curve]) -> dict[Curve, tuple[Curve, np.ndarray]]:
    """Return the curves of a fit as fine as the poses carry them and as rough as the data call for, with their heights."""
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
    roughness, step = quadratic.likeliest(columns, bends)
    return {
        curve: (curve.smooth(situation, float(w)), start.values[at] + step[here])
        for curve, w, at, here in zip(curves, roughness, places, columns, strict=True)
    }


def _drawn_again(curve: Curve, heights: np.ndarray, finer: Curve) -> np.ndarray:
    """Return the heights of a curve in other pieces."""
    lower, upper = finer.locus.span or (-np.pi, np.pi)
    q = np.linspace(lower, upper, _DENSELY * finer.resolution)
    return np.asarray(np.linalg.lstsq(finer.basis(q).T, heights @ curve.basis(q))[0])


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

    def likeliest(self, columns: Sequence[np.ndarray], bends: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return the likeliest roughness of each curve, and the step of all parameters with it.

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
        return w, step

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
        H *= np.outer(scale, scale)
        H.flat[:: len(H) + 1] += _ROUNDING
        factor, _ = dpotrf(H, lower=1, overwrite_a=1)
        C, _ = dpotri(factor, lower=1, overwrite_c=1)
        C = (np.tril(C) + np.tril(C, -1).T) * np.outer(scale, scale)
        return C @ slope, C
