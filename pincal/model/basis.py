"""Basis functions of curves."""

from __future__ import annotations

import numpy as np

_DEGREE = 3
FEWEST_SPLINES = _DEGREE + 1


def spline_basis(x: np.ndarray, lower: float, upper: float, size: int) -> np.ndarray:
    """Return uniform cubic B-splines over [lower, upper], constant beyond.

    Args:
        x: shape (N,), where.
        lower: the least knot.
        upper: the largest knot.
        size: number of splines, at least 4.

    Returns:
        Shape (size, N); the splines add up to 1.

    Example:
        >>> spline_basis(np.array([0.0, 0.5, 7.0]), 0.0, 1.0, 4).sum(axis=0).tolist()
        [1.0, 1.0, 1.0]
    """
    from scipy.interpolate import BSpline

    inner = np.linspace(lower, upper, size - _DEGREE + 1)
    knots = np.concatenate([np.full(_DEGREE, lower), inner, np.full(_DEGREE, upper)])
    return np.asarray(BSpline.design_matrix(np.clip(x, lower, upper), knots, _DEGREE).T.toarray(order="C"))
