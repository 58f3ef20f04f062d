"""Stations that one pass evaluates, and their normal equations.

An evaluation has costs of its own beside those of its rows. Small stations that follow each other in a problem, of one kind
of sensor and one model but for where they stand, share them: the model is evaluated once over the rows of all, with the
values of each station's own parameters at its rows. What is summed over stations are functions of arguments that can be
pickled, so that the sums can be mapped by any executor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import compress, pairwise
from typing import Any

import numpy as np

from pincal.identify.posterior import Eliminated, eliminate
from pincal.identify.quadratic import Form, Quadratic
from pincal.identify.station import PIECE, Station
from pincal.measure.sensor import Grouped
from pincal.model.effect import Family

Task = tuple[Callable[..., Any], slice, np.ndarray, *tuple[Any, ...]]
"""A function to call with stations as one and with where the rows of each begin and end, which of a problem's stations these
are, their values as :meth:`Batch.together` wants them, and what else it takes."""


@dataclass(frozen=True)
class Batch:
    """S stations that follow each other in a problem, with the same P parameters but for their names.

    Attributes:
        stations: the stations.
        rows: where their N rows stand among all rows.
        blocks: where their blocks of readings stand among all blocks.
        places: shape (S, P), where their parameters stand in the problem's table.
        own: shape (P,), which of them belong to one station alone.
        first: the number of the first station in the problem.
    """

    stations: tuple[Station, ...]
    rows: slice
    blocks: slice
    places: np.ndarray
    own: np.ndarray
    first: int

    def alike(self, free: np.ndarray) -> Iterator[Batch]:
        """Yield parts of it in each of which the same parameters are free, given those of all stations."""
        if len(self.stations) == 1:
            yield self
            return
        changes = np.flatnonzero(np.any(np.diff(free[self.places].astype(int), axis=0), axis=1)) + 1
        cuts = [0, *changes.tolist(), len(self.stations)]
        size = (self.blocks.stop - self.blocks.start) // len(self.stations)
        for a, b in pairwise(cuts):
            yield Batch(
                self.stations[a:b],
                slice(self.rows.start + int(self.ends[a]), self.rows.start + int(self.ends[b])),
                slice(self.blocks.start + size * a, self.blocks.start + size * b),
                self.places[a:b],
                self.own,
                self.first + a,
            )

    @cached_property
    def ends(self) -> np.ndarray:
        """Where the rows of each station begin and end among theirs, shape (S + 1,)."""
        return _ends(self.stations)

    def values(self, values: np.ndarray) -> np.ndarray:
        """Return the values of its parameters, given those of all, as :meth:`together` wants them."""
        return np.asarray(values[self.places].T if len(self.stations) > 1 else values[self.places[0]])

    def work(self, function: Callable[..., Any], values: np.ndarray, *rest: Any) -> Task:
        """Return the task to call a function with the stations, their values, given those of all, and further arguments."""
        return function, slice(self.first, self.first + len(self.stations)), self.values(values), *rest

    def residuals(self, values: np.ndarray) -> list[np.ndarray]:
        """Return reading minus prediction of each station, shape (m, its rows), for values of all parameters."""
        return np.split(self.together().residuals(self.values(values)), self.ends[1:-1], axis=1)

    def together(self) -> Station:
        """Return one station with the rows of all, the parameters of each at its rows: values have shape (P, S)."""
        return _together(self.stations)


@dataclass(frozen=True, eq=False)
class Work:
    """The stations of a problem, wherever tasks are done with them; they are much larger than these."""

    stations: tuple[Station, ...]

    def __call__(self, task: Task) -> Any:
        """Do a task."""
        function, which, *rest = task
        stations = self.stations[which]
        return function(_together(stations), _ends(stations), *rest)


def _ends(stations: Sequence[Station]) -> np.ndarray:
    return np.cumsum([0, *map(len, stations)])


def _together(stations: Sequence[Station]) -> Station:
    first, n = stations[0], len(stations)
    if n == 1:
        return first
    chains = [station.model.chain for station in stations]
    bases, tools = [c.base_rotation for c in chains], [c.tool_rotations for c in chains]
    chain = first.model.chain.with_references(np.array(bases), np.concatenate(tools))
    parts = [station.conditions for station in stations]
    columns = [f.name for f in fields(parts[0]) if f.name not in ("payload_centre", "setup")]
    present = [name for name in columns if getattr(parts[0], name) is not None]
    joined: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in present}
    setup = np.repeat(np.arange(n), np.diff(_ends(stations)))
    return Station(
        model=first.model.with_chain(chain),
        conditions=replace(parts[0], **joined, setup=setup),
        sensor=first.sensor.joined([station.sensor for station in stations[1:]]),
        weights=np.concatenate([station.weights for station in stations]),
        whitening=None if first.whitening is None else np.concatenate([s.whitening for s in stations], axis=2),
    )


def runs(stations: Sequence[Station]) -> Iterator[range]:
    """Yield the numbers of stations that can be evaluated together, small enough for it to be worth while."""
    start, rows, key, is_plain = 0, len(stations[0]), _key(stations[0]), None
    for i, station in enumerate(stations[1:], 1):
        rows, other = rows + len(station), _key(station)
        is_alike = rows <= PIECE and station.serial is None and other == key
        if is_alike and is_plain is None:
            is_plain = _is_plain(stations[start])
        if not (is_alike and is_plain):
            yield range(start, i)
            start, rows, key, is_plain = i, len(station), other, None
    yield range(start, len(stations))


def _key(station: Station) -> tuple[object, ...]:
    """Return what stations have in common that one evaluation can serve: their models, and the columns that they have."""
    model, sensor, conditions = station.model, station.sensor, station.conditions
    return (
        id(model.chain.robot),
        id(model.chain.path),
        model.chain.moment_frame,
        len(model.chain.targets),
        model.chain.gravity.tobytes(),
        model.equilibrium,
        *(effect if effect.family is Family.EXTRINSICS else id(effect) for effect in model.effects),
        type(sensor),
        station.setup,
        station.whitening is None,
        *(getattr(sensor, name) is None for name in sensor.per_row),
        conditions.payload_centre.tobytes(),
        *(getattr(conditions, f.name) is None for f in fields(conditions)),
    )


def _is_plain(station: Station) -> bool:
    """Return whether a station's sensor is nothing but its rows, and its model the same however base and tool are turned."""
    sensor, chain = station.sensor, station.model.chain
    is_rows = {f.name for f in fields(sensor)} == set(sensor.per_row)  # type: ignore[arg-type]
    if (
        station.serial is not None
        or not is_rows
        or station.shares_setup
        or sensor.parameters
        or isinstance(sensor, Grouped)
        or not len(station)
    ):
        return False
    nowhere = chain.with_references(np.full((3, 3), np.nan), np.full_like(chain.tool_rotations, np.nan))
    row, moments = station.conditions.select(slice(0, 1)), np.zeros((1, 3 * chain.robot.n_joints))
    terms = (t for e in station.model.effects for t in e.terms(nowhere, row, moments if e.uses_moments else None))
    return all(term.basis is None or bool(np.isfinite(term.basis).all()) for term in terms)


# Where more than one row in so many has another weight, all of them are summed anew.
_MOST_CHANGED = 3


@dataclass(frozen=True)
class StationSquares:
    """Squares of the residuals of S stations, one after the other.

    Attributes:
        blocks: weighted sums, by block of readings (position, orientation) of each station.
        rows: shape (blocks, N), each row's weighted squared residual, robust weights left out.
        beliefs: shape (S,), of what each station's sensor knows beside its readings, in units of the variances.
    """

    blocks: np.ndarray
    rows: np.ndarray
    beliefs: np.ndarray


@dataclass(frozen=True)
class Normal:
    """Normal equations, block of readings by block (position, orientation), before division by their variances.

    Attributes:
        H: shape (blocks, F, F); of each of S stations shape (S, blocks, F, F), and so on.
        g: shape (blocks, F).
        squares: of the residuals.
        robust: shape (N,), the factor on each row's weight.
        believed: what the sensor knows beside its readings, in units of its own noise.
    """

    H: np.ndarray
    g: np.ndarray
    squares: StationSquares
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


def accumulate(station: Station, values: np.ndarray, free: np.ndarray, robust: np.ndarray) -> Normal:
    """Return the normal equations of one station; arguments as of :func:`accumulate_each`."""
    found = accumulate_each(station, np.array([0, len(station)]), values, free, robust)
    return replace(found, H=found.H[0], g=found.g[0])


def accumulate_each(station: Station, ends: np.ndarray, values: np.ndarray, free: np.ndarray, robust: np.ndarray) -> Normal:
    """Return the normal equations of each of S stations whose rows follow each other in one.

    Args:
        station: the rows of all.
        ends: shape (S + 1,), where those of each begin and end.
        values: shape (P,), or of several stations shape (P, S).
        free: shape (P,), the F parameters that may move.
        robust: shape (N,), factor on each row's weight: 0 leaves a row out.
    """
    n, blocks, n_free = len(ends) - 1, station.block_rows, int(free.sum())
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
    known = believed(station, values, free) if n == 1 else None
    beliefs = np.full(n, 0.0 if known is None else known.square)
    return Normal(H, g, StationSquares(squares.ravel(), row_squares, beliefs), robust, known)


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
    squares = replace(past.squares, blocks=np.sum(past.squares.rows * robust**2, axis=1))
    return replace(past, H=H, g=g, squares=squares, robust=robust)


def squares(station: Station, ends: np.ndarray, values: np.ndarray, robust: np.ndarray) -> StationSquares:
    """Return the squares of stations' residuals; arguments as of :func:`accumulate_each`."""
    residuals = station.whitened(station.residuals(values))
    parts = [np.einsum("in,in->n", residuals[rows], residuals[rows]) for rows in station.block_rows]
    rows = np.array(parts) * station.weights**2
    each = np.split(rows, ends[1:-1], axis=1)
    blocks = np.concatenate([of @ weights**2 for of, weights in zip(each, np.split(robust, ends[1:-1]), strict=True)])
    known = np.zeros(len(each))
    if len(each) == 1:
        r = belief_rows(station, values, np.zeros(len(values), bool))[1]
        known[0] = r @ r
    return StationSquares(blocks, rows, known)


def contribution(
    station: Station,
    ends: np.ndarray,
    values: np.ndarray,
    free: np.ndarray,
    robust: np.ndarray,
    sigma: np.ndarray,
    *prior: np.ndarray,
) -> tuple[tuple[Form, Eliminated], StationSquares]:
    """Return what stations say of the free parameters that they share with others, and the squares of their residuals.

    Arguments as of :func:`accumulate_each`, then noise, shape (S, blocks), and what :func:`eliminate` wants to know.
    """
    normal = accumulate_each(station, ends, values, free, robust)
    return eliminate(normal.at(sigma), *prior), normal.squares


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
