"""Normal equations of one station, and what its sensor knows beside its readings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pincal.identify.station import Station


@dataclass(frozen=True)
class Normal:
    """Normal equations, block of readings by block (position, orientation), before division by their variances.

    Attributes:
        G: shape (blocks, F, F); of each of S stations shape (S, blocks, F, F), and so on.
        g: shape (blocks, F).
        squares: shape (blocks,), weighted sums of squared residuals.
        row_squares: shape (blocks, N), each row's weighted squared residual, robust weights left out.
        believed: G, g and the sum of squares of what the sensor knows beside its readings, in units of its own noise.
    """

    G: np.ndarray
    g: np.ndarray
    squares: np.ndarray
    row_squares: np.ndarray
    believed: tuple[np.ndarray, np.ndarray, float] | None = None

    def at(self, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return G and g for standard deviations of the blocks, shape (blocks,)."""
        weight = sigma**-2.0
        G, g = np.einsum("...b,...bij->...ij", weight, self.G), np.einsum("...b,...bi->...i", weight, self.g)
        return (G, g) if self.believed is None else (G + self.believed[0], g + self.believed[1])


def accumulate(station: Station, values: np.ndarray, free: np.ndarray, robust: np.ndarray) -> Normal:
    """Return the normal equations of a station at ``values``.

    Args:
        station: the station.
        values: shape (P,).
        free: shape (P,), the F parameters that may move.
        robust: shape (N,), factor on each row's weight: 0 leaves a row out.
    """
    found = accumulate_each(station, np.array([0, len(station)]), values, free, robust)
    return replace(found, G=found.G[0], g=found.g[0], squares=found.squares[0])


def accumulate_each(station: Station, ends: np.ndarray, values: np.ndarray, free: np.ndarray, robust: np.ndarray) -> Normal:
    """Return the normal equations of each of S stations whose rows follow each other in one.

    Args:
        station: the rows of all.
        ends: shape (S + 1,), where those of each begin and end.
        values: shape (P,), or of several stations shape (P, S).
        free: shape (P,), the F parameters that may move.
        robust: shape (N,), factor on each row's weight: 0 leaves a row out.
    """
    n, blocks, n_free = len(ends) - 1, block_rows(station), int(free.sum())
    G, g = np.zeros((n, len(blocks), n_free, n_free)), np.zeros((n, len(blocks), n_free))
    squares, row_squares = np.zeros((n, len(blocks))), np.empty((len(blocks), len(station)))
    for piece, residuals, jacobian in station.linearise_shared(values, free):
        weights = station.weights[piece]
        for b, rows in enumerate(blocks):
            row_squares[b, piece] = np.einsum("in,in->n", residuals[rows], residuals[rows]) * weights**2
        weights = weights * robust[piece]
        is_uniform = bool(np.all(weights == 1.0))
        first, last = np.searchsorted(ends, [piece.start, piece.stop - 1], side="right") - 1
        here, inner = slice(first, last + 1), np.clip(ends[first : last + 2], piece.start, piece.stop) - piece.start
        for b, rows in enumerate(blocks):
            part = jacobian.part(rows, slice(0, piece.stop - piece.start))
            part.add_grams(residuals[rows], inner, G[here, b], g[here, b], weights=None if is_uniform else weights)
            r = residuals[rows] if is_uniform else residuals[rows] * weights
            squares[here, b] += [np.vdot(of, of) for of in np.split(r, inner[1:-1], axis=1)]
    return Normal(G, g, squares, row_squares, believed(station, values, free) if n == 1 else None)


def believed(station: Station, values: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return G, shape (F, F), g, shape (F,), and the sum of squares of the sensor's constraints; None where it has none."""
    J, r = belief_rows(station, values, free)
    return (J @ J.T, J @ r, float(r @ r)) if len(r) else None


def beliefs_squared(station: Station, values: np.ndarray) -> float:
    """Return the sum of squares of the sensor's constraints in units of their noise; 0 where it has none."""
    r = belief_rows(station, values, np.zeros(len(values), bool))[1]
    return float(r @ r)


def belief_rows(station: Station, values: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Jacobian, shape (F, C), and residuals, shape (C,), of the sensor's C constraints in units of their noise."""
    facts = station.sensor.constraints(station.split(values)[1])
    if facts is None:
        return np.zeros((int(free.sum()), 0)), np.zeros(0)
    of_model, of_sensor = station.split(free)
    J = (facts.jacobian / facts.sigma)[of_sensor]
    return np.vstack([np.zeros((int(of_model.sum()), J.shape[1])), J]), facts.residuals / facts.sigma


def block_rows(station: Station) -> list[slice]:
    """Return where each block of readings stands among the components of a residual."""
    ends = np.cumsum([0, *(block.size for block in station.sensor.blocks)])
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]
