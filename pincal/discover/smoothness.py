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
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigvalsh, lstsq
from scipy.linalg.lapack import dpotrf, dtrtri

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
        w, noise, parts = np.full(len(columns), _ROUGHNESS), 1.0, self._parts(columns, bends)
        alone = [eigvalsh(R * np.outer(self.sizes[at], self.sizes[at])) for at, R in zip(columns, bends, strict=True)]
        for _ in range(_MOVES):
            found = self._posterior(parts, w, noise)
            step = found.step
            left = self.squares - 2.0 * float(self.g @ step) + float(step[parts.kept] @ parts.G @ step[parts.kept])
            noise = max(left / max(self.readings - found.spent, 1.0), _LEAST_NOISE)
            before = w.copy()
            for j, (at, R, known, trace) in enumerate(zip(columns, bends, alone, found.traces, strict=True)):
                x = self.values[at] + step[at]
                free = float(np.sum(known / (1.0 + known / w[j] ** 2))) - trace
                factor = np.sqrt(float(x @ R @ x) / max(free, 1e-300))
                w[j] = max(w[j] * np.clip(factor, 1.0 / _FARTHEST, _FARTHEST), _LEAST)
            if np.max(np.abs(np.log(w / before))) < _SETTLED:
                break
        # Known surer, and nearer to what is believed by as much: the others are pulled as before, and move less.
        firm = np.full(len(self.sizes), 1.0 + _FIRM)
        firm[np.concatenate(columns)] = 1.0
        firmly = replace(self, sizes=self.sizes / np.sqrt(firm), values=self.values / firm)
        return w, firmly._posterior(parts, w, noise).step, noise

    def _parts(self, columns: Sequence[np.ndarray], bends: Sequence[np.ndarray]) -> _Parts:
        """Return the parameters that are solved for, and the curves by those of their heights."""
        is_kept = np.ones(len(self.sizes), bool)
        for at in columns:
            is_kept[at] = np.any(self.G[at], axis=1) | np.any(self.believed[at], axis=1)
        kept, rank = np.flatnonzero(is_kept), np.cumsum(is_kept) - 1
        curves = [
            _Heights(at[is_kept[at]], at[~is_kept[at]], rank[at[is_kept[at]]], *_quarters(R, is_kept[at]))
            for at, R in zip(columns, bends, strict=True)
        ]
        beliefs = np.flatnonzero(np.any(self.believed[kept], axis=1))
        believed = self.believed[np.ix_(kept[beliefs], kept[beliefs])]
        return _Parts(kept, self.G[np.ix_(kept, kept)], beliefs, believed, curves)

    def _posterior(self, parts: _Parts, w: np.ndarray, noise: float) -> _Found:
        """Return what data and priors say together with curves of roughness w."""
        kept, precision = parts.kept, self.sizes**-2.0
        slope = self.g / noise + self.slope - precision * self.values
        H, pull = parts.G / noise, slope[kept]
        H[np.ix_(parts.beliefs, parts.beliefs)] += parts.believed
        H.flat[:: len(H) + 1] += precision[kept]
        ties = [heights.tied(self.values, precision, slope, each) for heights, each in zip(parts.curves, w, strict=True)]
        for heights, tie in zip(parts.curves, ties, strict=True):
            H[np.ix_(heights.rank, heights.rank)] += tie.information
            pull[heights.rank] += tie.slope
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        H *= scale
        H *= scale[:, None]
        H.flat[:: len(H) + 1] += _ROUNDING
        # Column-major, which spares LAPACK copies. The covariance is the square of its root; only parts of it are asked for.
        factor, _ = dpotrf(H.T, lower=1, overwrite_a=1)
        root, _ = dtrtri(factor, lower=1, overwrite_c=1)
        root *= scale
        step = np.empty(len(slope))
        step[kept] = root.T @ (root @ pull)
        # What is known is known from the rows, but for what priors, beliefs and roughness say.
        variance, inner = np.einsum("ij,ij->j", root, root), root[:, parts.beliefs]
        spent = len(kept) - float(variance @ (precision[kept] + _ROUNDING / scale**2))
        spent -= float(np.vdot(inner.T @ inner, parts.believed))
        traces = []
        for heights, tie in zip(parts.curves, ties, strict=True):
            inner = root[:, heights.rank]
            covariance = inner.T @ inner
            spent -= float(np.vdot(covariance, tie.information))
            traces.append(tie.alone + float(np.vdot(covariance, tie.roughness)))
            step[heights.idle] = tie.idle - tie.carried @ step[heights.told]
        return _Found(step, spent, traces)


class _Found(NamedTuple):
    """What data and priors say together.

    Attributes:
        step: shape (F,), to the most probable values.
        spent: number of parameters that the data know.
        traces: of each curve, the trace of R and the covariance of its heights.
    """

    step: np.ndarray
    spent: float
    traces: list[float]


class _Parts(NamedTuple):
    """The parameters that are solved for: all but heights of curves of which no row tells, which follow those beside them.

    Attributes:
        kept: shape (K,), these parameters.
        G: shape (K, K), of them.
        beliefs, believed: shape (B,) and (B, B), those of them of which more is believed than their priors, and this.
        curves: the curves.
    """

    kept: np.ndarray
    G: np.ndarray
    beliefs: np.ndarray
    believed: np.ndarray
    curves: list[_Heights]


class _Tied(NamedTuple):
    """What the roughness of a curve says of its heights.

    Attributes:
        information, slope: shape (T, T) and (T,), of those of which rows tell, while the others follow.
        carried: shape (I, T), how far a step of the former moves the others the other way.
        idle: shape (I,), the step of the others while the former stay.
        roughness: shape (T, T), its trace with the covariance of the former is that of R with the whole one, but for
        alone: what the others add to it while the former stay.
    """

    information: np.ndarray
    slope: np.ndarray
    carried: np.ndarray
    idle: np.ndarray
    roughness: np.ndarray
    alone: float


class _Heights(NamedTuple):
    """The heights of a curve.

    Attributes:
        told, idle: shape (T,) and (I,), those of which rows tell, and the others.
        rank: shape (T,), where the former stand among the parameters that are solved for.
        near, across, far: shape (T, T), (I, T) and (I, I), parts of R.
    """

    told: np.ndarray
    idle: np.ndarray
    rank: np.ndarray
    near: np.ndarray
    across: np.ndarray
    far: np.ndarray

    def tied(self, values: np.ndarray, precision: np.ndarray, slope: np.ndarray, w: float) -> _Tied:
        """Return what roughness w says of them at some values, given the priors' precision and all else's slope."""
        told, idle = values[self.told], values[self.idle]
        inverse = np.linalg.inv(self.far / w**2 + np.diag(precision[self.idle]))
        carried = inverse @ self.across / w**2
        left = slope[self.idle] - (self.across @ told + self.far @ idle) / w**2
        beside = self.across.T @ carried
        return _Tied(
            information=(self.near - beside) / w**2,
            slope=-(self.near @ told + self.across.T @ idle) / w**2 - carried.T @ left,
            carried=carried,
            idle=inverse @ left,
            roughness=self.near - beside - beside.T + carried.T @ self.far @ carried,
            alone=float(np.vdot(inverse, self.far)),
        )


def _quarters(R: np.ndarray, is_told: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the parts of a symmetric matrix: of some, of the others with these, and of the others."""
    told, idle = np.flatnonzero(is_told), np.flatnonzero(~is_told)
    return R[np.ix_(told, told)], R[np.ix_(idle, told)], R[np.ix_(idle, idle)]
