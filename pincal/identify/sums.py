"""What stations contribute to the sums of a problem: squares of residuals, and normal equations less their own parameters.

These are functions of arguments that can be pickled, so that the sums can be mapped by any executor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pincal.identify.normal import Normal, accumulate_each, beliefs_squared, block_rows
from pincal.identify.posterior import Contribution, eliminate
from pincal.identify.station import Station

# Where more than one row in so many has another weight, all of them are summed anew.
_MOST_CHANGED = 3


@dataclass(frozen=True)
class Squares:
    """Squares of the residuals of stations, one after the other.

    Attributes:
        blocks: shape (blocks,), weighted sums.
        rows: of each station, shape (its blocks, its N rows), each row's weighted squared residual, robust weights left out.
        beliefs: of what each station's sensor knows beside its readings, in units of the variances.
    """

    blocks: np.ndarray
    rows: tuple[np.ndarray, ...]
    beliefs: np.ndarray


def squares(station: Station, ends: np.ndarray, values: np.ndarray, robust: np.ndarray) -> Squares:
    """Return the squares of stations' residuals; arguments as in :func:`pincal.identify.normal.accumulate_each`."""
    residuals = station.whitened(station.residuals(values))
    parts = [np.einsum("in,in->n", residuals[rows], residuals[rows]) for rows in block_rows(station)]
    rows = np.array(parts) * station.weights**2
    each = np.split(rows, ends[1:-1], axis=1)
    blocks = np.concatenate([of @ weights**2 for of, weights in zip(each, np.split(robust, ends[1:-1]), strict=True)])
    known = [beliefs_squared(station, values)] if len(each) == 1 else np.zeros(len(each))
    return Squares(blocks, tuple(each), np.asarray(known))


def contribution(
    station: Station,
    ends: np.ndarray,
    values: np.ndarray,
    robust: np.ndarray,
    free: np.ndarray,
    own: np.ndarray,
    sigma: np.ndarray,
    sizes: np.ndarray,
) -> tuple[Contribution, Squares]:
    """Return what stations say of the free parameters that they share with others, and the squares of their residuals.

    Args:
        station: the rows of S stations, one after the other.
        ends: shape (S + 1,), where those of each begin and end.
        values: shape (P,), or of several stations shape (P, S).
        robust: shape (N,), factor on each row's weight: 0 leaves a row out.
        free: shape (P,), which parameters may move.
        own: shape (P,), which of them belong to a station alone.
        sigma: shape (S, blocks), standard deviation of one component of each block of readings.
        sizes: shape (S, P), standard deviations of the priors; inf for none.
    """
    normal = accumulate_each(station, ends, values, free, robust)
    return contribution_of(normal, values, free, own=own, sigma=sigma, sizes=sizes), squares_of(normal, ends)


def contribution_of(
    normal: Normal, values: np.ndarray, free: np.ndarray, *, own: np.ndarray, sigma: np.ndarray, sizes: np.ndarray
) -> Contribution:
    """Return what normal equations of stations contribute; arguments as of :func:`contribution`."""
    G, g = normal.at(sigma)
    return eliminate(G, g, own[free], sizes[:, free], np.atleast_2d(values.T)[:, free])


def squares_of(normal: Normal, ends: np.ndarray) -> Squares:
    """Return the squares of residuals that normal equations came with."""
    known = np.zeros(len(ends) - 1)
    if normal.believed is not None:
        known[:] = normal.believed[2]
    return Squares(normal.squares.ravel(), tuple(np.split(normal.row_squares, ends[1:-1], axis=1)), known)


@dataclass(frozen=True)
class Part:
    """What a batch of stations contributes for one noise and for one set of robust weights."""

    sigma: np.ndarray
    robust: np.ndarray
    found: Contribution
    squares: Squares

    def is_for(self, sigma: np.ndarray, robust: np.ndarray) -> bool:
        """Return whether it is for this noise and these robust weights of its own readings."""
        return np.array_equal(self.sigma, sigma) and np.array_equal(self.robust, robust)


@dataclass(frozen=True)
class Kept:
    """The normal equations of each of S stations for one set of robust weights.

    Attributes:
        robust: shape (N,), factor on each row's weight.
        normal: those of the stations.
    """

    robust: np.ndarray
    normal: Normal


def reweighted(
    station: Station, ends: np.ndarray, values: np.ndarray, free: np.ndarray, robust: np.ndarray, past: Kept | None = None
) -> Normal:
    """Return the normal equations of stations; of one that is alone summed anew only for rows of other robust weights.

    Args:
        station: the rows of S stations, one after the other.
        ends: shape (S + 1,), where those of each begin and end.
        values: shape (P,), or of several stations shape (P, S).
        free: shape (P,), which parameters may move.
        robust: shape (N,), factor on each row's weight: 0 leaves a row out.
        past: the equations at the same values with other robust weights.
    """
    rows = np.arange(len(station)) if past is None else np.flatnonzero(robust != past.robust)
    # Where the noise of rows hangs together, a row by itself is not what it is among the others.
    is_whole = len(ends) > 2 or station.sensor.is_whole or station.serial is not None
    if past is None or is_whole or _MOST_CHANGED * len(rows) > len(station):
        return accumulate_each(station, ends, values, free, robust)
    normal, change = past.normal, robust[rows] ** 2 - past.robust[rows] ** 2
    G, g = normal.G.copy(), normal.g.copy()
    for some, add in ((change > 0.0, np.add), (change < 0.0, np.subtract)):
        if some.any():
            weights, part = np.sqrt(np.abs(change[some])), station.select(rows[some])
            found = accumulate_each(part, np.array([0, len(weights)]), values, free, weights)
            add(G, found.G, out=G)
            add(g, found.g, out=g)
    # From the rows: the difference of large squares would leave their rounding.
    squares = np.sum(normal.row_squares * robust**2, axis=1)[None]
    return replace(normal, G=G, g=g, squares=squares)
