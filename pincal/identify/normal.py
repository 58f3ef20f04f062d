"""Normal equations of stations, of one or of several at a time, and what they say of the parameters that stations share.

These are functions of arguments that can be pickled, so that the sums can be mapped by any executor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import compress, pairwise
from typing import NamedTuple

import numpy as np

from pincal.identify.posterior import Eliminated, eliminate
from pincal.identify.quadratic import Form, Quadratic
from pincal.identify.station import Station

# Where more than one row in so many has another weight, all of them are summed anew.
_MOST_CHANGED = 3


@dataclass(frozen=True)
class StationSquares:
    """Squares of the residuals of stations, one after the other.

    Attributes:
        blocks: shape (blocks,), weighted sums.
        rows: of each station, shape (its blocks, its N rows), each row's weighted squared residual, robust weights left out.
        beliefs: of what each station's sensor knows beside its readings, in units of the variances.
    """

    blocks: np.ndarray
    rows: tuple[np.ndarray, ...]
    beliefs: np.ndarray


@dataclass(frozen=True)
class Normal:
    """Normal equations, block of readings by block (position, orientation), before division by their variances.

    Attributes:
        H: shape (blocks, F, F); of each of S stations shape (S, blocks, F, F), and so on.
        g: shape (blocks, F).
        squares: shape (blocks,), weighted sums of squared residuals.
        row_squares: shape (blocks, N), each row's weighted squared residual, robust weights left out.
        robust: shape (N,), the factor on each row's weight.
        believed: what the sensor knows beside its readings, in units of its own noise.
    """

    H: np.ndarray
    g: np.ndarray
    squares: np.ndarray
    row_squares: np.ndarray
    robust: np.ndarray
    believed: Quadratic | None = None

    def at(self, sigma: np.ndarray) -> Form:
        """Return what they say for standard deviations of the blocks, shape (blocks,)."""
        weight = sigma**-2.0
        H, g = np.einsum("...b,...bij->...ij", weight, self.H), np.einsum("...b,...bi->...i", weight, self.g)
        return Form.of(H, g) if self.believed is None else Form.of(H + self.believed.H, g + self.believed.g)

    def narrowed(self, kept: np.ndarray) -> Normal:
        """Return those of some of the parameters, by their places, shape (K,)."""
        known = None if self.believed is None else self.believed.taking(kept)
        return replace(self, H=self.H[..., kept[:, None], kept], g=self.g[..., kept], believed=known)

    def station_squares(self, ends: np.ndarray) -> StationSquares:
        """Return the squares of S stations whose rows begin and end where ``ends``, shape (S + 1,), says."""
        known = np.full(len(ends) - 1, 0.0 if self.believed is None else self.believed.square)
        return StationSquares(self.squares.ravel(), tuple(np.split(self.row_squares, ends[1:-1], axis=1)), known)


def accumulate(station: Station, values: np.ndarray, free: np.ndarray, robust: np.ndarray) -> Normal:
    """Return the normal equations of one station; arguments as of :func:`accumulate_each`."""
    found = accumulate_each(station, np.array([0, len(station)]), values, free, robust)
    return replace(found, H=found.H[0], g=found.g[0], squares=found.squares[0])


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
    H, g = np.zeros((n, len(blocks), n_free, n_free)), np.zeros((n, len(blocks), n_free))
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
            part.add_grams(residuals[rows], inner, H[here, b], g[here, b], weights=None if is_uniform else weights)
            r = residuals[rows] if is_uniform else residuals[rows] * weights
            squares[here, b] += [np.vdot(of, of) for of in np.split(r, inner[1:-1], axis=1)]
    return Normal(H, g, squares, row_squares, robust, believed(station, values, free) if n == 1 else None)


def reweighted(
    station: Station, ends: np.ndarray, values: np.ndarray, free: np.ndarray, robust: np.ndarray, past: Normal | None = None
) -> Normal:
    """Return the normal equations of stations; of one that is alone summed anew only for rows of other robust weights.

    Args:
        station: the rows of S stations, one after the other; further arguments as of :func:`accumulate_each`.
        ends: shape (S + 1,).
        values: shape (P,) or (P, S).
        free: shape (P,).
        robust: shape (N,).
        past: the equations at the same values with other robust weights.
    """
    rows = np.arange(len(station)) if past is None else np.flatnonzero(robust != past.robust)
    # Where the noise of rows hangs together, a row by itself is not what it is among the others.
    is_whole = len(ends) > 2 or station.sensor.is_whole or station.serial is not None
    if past is None or is_whole or _MOST_CHANGED * len(rows) > len(station):
        return accumulate_each(station, ends, values, free, robust)
    change = robust[rows] ** 2 - past.robust[rows] ** 2
    H, g = past.H.copy(), past.g.copy()
    for some, add in ((change > 0.0, np.add), (change < 0.0, np.subtract)):
        if some.any():
            weights, part = np.sqrt(np.abs(change[some])), station.select(rows[some])
            found = accumulate_each(part, np.array([0, len(weights)]), values, free, weights)
            add(H, found.H, out=H)
            add(g, found.g, out=g)
    # From the rows: the difference of large squares would leave their rounding.
    squares = np.sum(past.row_squares * robust**2, axis=1)[None]
    return replace(past, H=H, g=g, squares=squares, robust=robust)


def squares(station: Station, ends: np.ndarray, values: np.ndarray, robust: np.ndarray) -> StationSquares:
    """Return the squares of stations' residuals; arguments as of :func:`accumulate_each`."""
    residuals = station.whitened(station.residuals(values))
    parts = [np.einsum("in,in->n", residuals[rows], residuals[rows]) for rows in block_rows(station)]
    rows = np.array(parts) * station.weights**2
    each = np.split(rows, ends[1:-1], axis=1)
    blocks = np.concatenate([of @ weights**2 for of, weights in zip(each, np.split(robust, ends[1:-1]), strict=True)])
    known = np.zeros(len(each))
    if len(each) == 1:
        r = belief_rows(station, values, np.zeros(len(values), bool))[1]
        known[0] = r @ r
    return StationSquares(blocks, tuple(each), known)


class Beforehand(NamedTuple):
    """What is known beforehand of the P parameters and the noise of S stations.

    Attributes:
        own: shape (P,), which parameters belong to a station alone.
        sigma: shape (S, blocks), standard deviation of one component of each block of readings.
        sizes: shape (S, P), standard deviations of the priors; inf for none.
    """

    own: np.ndarray
    sigma: np.ndarray
    sizes: np.ndarray

    def contribution(self, normal: Normal, values: np.ndarray, free: np.ndarray) -> tuple[Form, Eliminated]:
        """Return what normal equations of these stations say of the parameters that they share with others, and the rest."""
        return eliminate(normal.at(self.sigma), self.own[free], self.sizes[:, free], np.atleast_2d(values.T)[:, free])


def contribution(
    station: Station, ends: np.ndarray, values: np.ndarray, free: np.ndarray, robust: np.ndarray, known: Beforehand
) -> tuple[tuple[Form, Eliminated], StationSquares]:
    """Return what stations say of the free parameters that they share with others, and the squares of their residuals.

    Arguments as of :func:`accumulate_each`.
    """
    normal = accumulate_each(station, ends, values, free, robust)
    return known.contribution(normal, values, free), normal.station_squares(ends)


def believed(station: Station, values: np.ndarray, free: np.ndarray) -> Quadratic | None:
    """Return what the sensor knows of its own parameters, of all F that are free; None where it has no constraints."""
    J, r = belief_rows(station, values, free)
    return Quadratic.of_rows([p.name for p in compress(station.parameters, free)], J.T, r) if len(r) else None


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
