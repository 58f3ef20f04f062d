"""Basis functions of curves."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from pincal.model.cubic import Cubic
from pincal.model.symbols import are_symbols, cubic
from pincal.thresholds import Count

_DEGREE: Count = 3
FEWEST_SPLINES = _DEGREE + 1


def spline_basis(x: np.ndarray, lower: float, upper: float, size: int) -> np.ndarray:
    """Return the values at x, shape (N,), of ``size`` (at least 4) uniform cubic B-splines, shape
    (size, N).

    Their knots lie in [lower, upper]; beyond it they are constant. They add up to 1.

    Example:
        >>> spline_basis(np.array([0.0, 0.5, 7.0]), 0.0, 1.0, 4).sum(axis=0).tolist()
        [1.0, 1.0, 1.0]
    """
    from scipy.interpolate import BSpline

    if are_symbols(x):
        return np.array(
            [[cubic(curve, at) for at in x] for curve in _splines(lower, upper, size)], object
        )
    dense = np.zeros((size, len(x)))
    if not len(x):
        # SciPy has no design matrix of no positions.
        return dense
    thin = BSpline.design_matrix(np.clip(x, lower, upper), _knots(lower, upper, size), _DEGREE)
    dense[thin.indices, np.repeat(np.arange(len(x)), np.diff(thin.indptr))] = thin.data
    return dense


@lru_cache(maxsize=32)
def spline_roughness(lower: float, upper: float, size: int) -> np.ndarray:
    """Return the integrals of products of second derivatives of these splines, shape (size, size),
    read-only.
    """
    from scipy.interpolate import BSpline

    knots = _knots(lower, upper, size)
    places = knots[_DEGREE : size + 1]
    step = (upper - lower) / (size - _DEGREE)
    # Second derivatives are linear between knots, so two-point Gauss quadrature of their products
    # is exact.
    middle = 0.5 * (places[:-1] + places[1:])
    aside = 0.5 * step / np.sqrt(3.0)
    x = np.concatenate([middle - aside, middle + aside])
    bend = BSpline(knots, np.eye(size), _DEGREE).derivative(2)(x)
    found = np.asarray(0.5 * step * bend.T @ bend)
    found.flags.writeable = False
    return found


def _knots(lower: float, upper: float, size: int) -> np.ndarray:
    inner = np.linspace(lower, upper, size - _DEGREE + 1)
    return np.concatenate([np.full(_DEGREE, lower), inner, np.full(_DEGREE, upper)])


@lru_cache(maxsize=32)
def _splines(lower: float, upper: float, size: int) -> tuple[Cubic, ...]:
    from scipy.interpolate import BSpline, PPoly

    knots = _knots(lower, upper, size)
    places = knots[_DEGREE : size + 1]
    powers = np.diff(places) ** np.arange(_DEGREE + 1)[:, None]
    local = [
        PPoly.from_spline(BSpline(knots, row, _DEGREE)).c[::-1, _DEGREE:size] * powers
        for row in np.eye(size)
    ]
    return tuple(Cubic.of(float(places[0]), float(places[-1]), pieces.T) for pieces in local)
