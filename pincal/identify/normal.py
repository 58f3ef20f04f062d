"""Batches of stations that are evaluated in one pass, and their normal equations.

An evaluation has fixed costs. Small consecutive stations of a problem with one kind of sensor and
one model, up to the poses of base and tool, share them: the model is evaluated once over all their
rows, with each station's own parameters at its rows. Sums over stations are functions of picklable
arguments, so that any executor can map them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import compress, pairwise
from typing import Any

import numpy as np

from pincal.identify.posterior import Eliminated, eliminate
from pincal.identify.quadratic import Form, Quadratic, taken
from pincal.identify.station import PIECE, Station
from pincal.model.effect import Family
from pincal.sensors.sensor import Grouped
from pincal.thresholds import Count

Task = tuple[Callable[..., Any], slice, np.ndarray, *tuple[Any, ...]]
"""A function, the slice of a problem's stations that it is called with (joined, with the
boundaries of their rows), their
values as for :meth:`Batch.together`, and its further arguments."""


@dataclass(frozen=True)
class Batch:
    """S consecutive stations of a problem, with the same P parameters up to their names.

    Attributes:
        stations: the stations.
        rows: slice of their N rows among all rows.
        blocks: slice of their blocks of readings among all blocks.
        places: shape (S, P), indices of their parameters in the problem's table.
        own: shape (P,), which of them belong to one station alone.
        first: number of the first station in the problem.
    """

    stations: tuple[Station, ...]
    rows: slice
    blocks: slice
    places: np.ndarray
    own: np.ndarray
    first: int

    def by_free(self, free: np.ndarray) -> Iterator[Batch]:
        """Yield parts of the batch with the same free parameters, given the mask of all
        parameters.
        """
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
        """Boundaries of the stations' rows, shape (S + 1,)."""
        return _ends(self.stations)

    def values(self, values: np.ndarray) -> np.ndarray:
        """Return the values of the batch's parameters, given all values, as for
        :meth:`together`.
        """
        return np.asarray(
            values[self.places].T if len(self.stations) > 1 else values[self.places[0]]
        )

    def work(self, function: Callable[..., Any], values: np.ndarray, *rest: Any) -> Task:
        """Return the task of calling a function with the stations, their part of all values, and
        further arguments.
        """
        return (
            function,
            slice(self.first, self.first + len(self.stations)),
            self.values(values),
            *rest,
        )

    def residuals(self, values: np.ndarray) -> list[np.ndarray]:
        """Return reading minus prediction of each station, shape (m, its rows), for values of all
        parameters.
        """
        return np.split(self.together().residuals(self.values(values)), self.ends[1:-1], axis=1)

    def note_poses(self, values: np.ndarray) -> None:
        """Let each station know its poses at values of all parameters: of several from one
        evaluation, as each alone has its fixed costs.
        """
        pairs = zip(self.stations, self.places, strict=True)
        each = [station.split(values[places])[0] for station, places in pairs]
        pairs = zip(self.stations, each, strict=True)
        if len(each) == 1 or all(station.knows_poses(of_model) for station, of_model in pairs):
            return
        together = self.together()
        poses = together.poses_read(together.split(self.values(values))[0])
        parts = np.split(poses, self.ends[1:-1])
        for station, of_model, part in zip(self.stations, each, parts, strict=True):
            station.note_poses(of_model, part)

    def together(self) -> Station:
        """Return one station with the rows of all, each station's parameters at its rows: values
        have shape (P, S).
        """
        return _together(self.stations)


# Points at which a single station's normal equations are remembered: the end of a fit, and the same
# with more columns for a test; and their largest size there [bytes], as a search has many problems.
_REMEMBERED: Count = 2
_MOST_REMEMBERED: Count = 200_000


@dataclass(frozen=True, eq=False)
class Work:
    """The stations of a problem, which are sent to a worker once, and do tasks there.

    Attributes:
        stations: the stations.
        remembered: the latest normal equations of a single station, by number of its batch, for
            what they depend on besides robust weights: those at the end of a fit are asked for
            again and again.
    """

    stations: tuple[Station, ...]
    remembered: dict[bytes, dict[int, Normal]] = field(default_factory=dict)

    def __reduce__(self) -> tuple[type[Work], tuple[tuple[Station, ...]]]:
        """Send the stations alone."""
        return Work, (self.stations,)

    def remembers(self, parameters: int) -> bool:
        """Return whether the normal equations of so many parameters are remembered: small ones of
        a single station.
        """
        size = 8 * len(self.stations[0].block_rows) * parameters**2
        return len(self.stations) == 1 and size <= _MOST_REMEMBERED

    def remember(self, point: bytes, normals: dict[int, Normal]) -> None:
        """Remember normal equations for what they depend on, if they are small."""
        if self.remembers(normals[0].g.shape[-1]):
            self.remembered.pop(point, None)
            self.remembered[point] = dict(normals)
            for oldest in list(self.remembered)[:-_REMEMBERED]:
                del self.remembered[oldest]

    def __call__(self, task: Task) -> Any:
        """Do a task."""
        function, which, *rest = task
        return function(_together(self.stations[which]), _ends(self.stations[which]), *rest)


def _ends(stations: Sequence[Station]) -> np.ndarray:
    return np.cumsum([0, *map(len, stations)])


def _together(stations: Sequence[Station]) -> Station:
    first = stations[0]
    n = len(stations)
    if n == 1:
        return first
    chains = [station.model.chain for station in stations]
    parts = [station.conditions for station in stations]
    bases = np.array([c.base_rotation for c in chains])
    tools = np.concatenate([c.tool_rotations for c in chains])
    columns = [f.name for f in fields(parts[0]) if f.name not in ("payload_centre", "setup")]
    present = [name for name in columns if getattr(parts[0], name) is not None]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in present
    }
    setup = np.repeat(np.arange(n), np.diff(_ends(stations)))
    return Station(
        model=first.model.with_chain(first.model.chain.with_references(bases, tools)),
        conditions=replace(parts[0], **joined, setup=setup),
        sensor=first.sensor.joined([station.sensor for station in stations[1:]]),
        weights=np.concatenate([station.weights for station in stations]),
        whitening=None
        if first.whitening is None
        else np.concatenate([s.whitening for s in stations], axis=2),
    )


def runs(stations: Sequence[Station]) -> Iterator[range]:
    """Yield the numbers of consecutive stations that are evaluated together, as small ones of one
    kind are.
    """
    if len(stations) == 1:
        yield range(1)
        return
    start = 0
    rows = len(stations[0])
    key = _key(stations[0])
    is_plain = None
    for i, station in enumerate(stations[1:], 1):
        rows = rows + len(station)
        other = _key(station)
        is_alike = rows <= PIECE and not station.is_correlated and other == key
        if is_alike and is_plain is None:
            is_plain = _is_plain(stations[start])
        if not (is_alike and is_plain):
            yield range(start, i)
            start = i
            rows = len(station)
            key = other
            is_plain = None
    yield range(start, len(stations))


def _key(station: Station) -> tuple[object, ...]:
    """Return what stations must have in common to be evaluated together: model, sensor, and the
    columns present.
    """
    model = station.model
    sensor = station.sensor
    conditions = station.conditions
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
    """Return whether a station's sensor consists of its rows alone, and its model does not depend
    on base and tool.
    """
    sensor = station.sensor
    chain = station.model.chain
    is_rows = {f.name for f in fields(sensor)} == set(sensor.per_row)  # type: ignore[arg-type]
    if not is_rows or sensor.parameters or isinstance(sensor, Grouped):
        return False
    if station.is_correlated or station.shares_setup or not len(station):
        return False
    nowhere = chain.with_references(
        np.full((3, 3), np.nan), np.full_like(chain.tool_rotations, np.nan)
    )
    row = station.conditions.select(slice(0, 1))
    moments = np.zeros((1, 3 * chain.robot.n_joints))
    terms = (
        t
        for e in station.model.effects
        for t in e.terms(nowhere, row, moments if e.uses_moments else None)
    )
    return all(term.basis is None or bool(np.isfinite(term.basis).all()) for term in terms)


# All rows are summed again if more than one in so many has another weight.
_MOST_CHANGED: Count = 3


@dataclass(frozen=True)
class StationSquares:
    """Squares of the residuals of S stations, one after the other.

    Attributes:
        blocks: weighted sums, by block of readings (position, orientation) of each station.
        rows: shape (blocks, N), each row's weighted squared residual, without robust weights.
        beliefs: shape (S,), from each sensor's knowledge besides its readings, in units of the
            variances.
    """

    blocks: np.ndarray
    rows: np.ndarray
    beliefs: np.ndarray


@dataclass(frozen=True)
class Normal:
    """Normal equations, one block of readings after the other, before division by their variances.

    Attributes:
        H: shape (blocks, F, F); with a leading axis for S stations, as g.
        g: shape (blocks, F).
        squares: of the residuals.
        robust: shape (N,), the factor on each row's weight.
        believed: the sensor's knowledge besides its readings, in units of its own noise.
    """

    H: np.ndarray
    g: np.ndarray
    squares: StationSquares
    robust: np.ndarray
    believed: Quadratic | None = None

    def at(self, sigma: np.ndarray) -> Form:
        """Return the information form for standard deviations of the blocks, shape (blocks,)."""
        weight = sigma**-2.0
        H = np.einsum("...b,...bij->...ij", weight, self.H)
        g = np.einsum("...b,...bi->...i", weight, self.g)
        return (
            Form.of(H, g)
            if self.believed is None
            else Form.of(H + self.believed.H, g + self.believed.g)
        )

    def carried(self, step: np.ndarray, there: StationSquares, known: Quadratic | None) -> Normal:
        """Return the equations after a step so short that H is the same, shape (F,) or (S, F),
        given what was evaluated there: the squares, and the sensor's knowledge.
        """
        g = self.g - np.einsum("...bij,...j->...bi", self.H, step)
        return replace(self, g=g, squares=there, believed=known)

    def narrowed(self, kept: np.ndarray) -> Normal:
        """Return the equations of the parameters at indices ``kept``, shape (K,)."""
        known = None if self.believed is None else self.believed.taking(kept)
        return replace(self, H=taken(self.H, kept), g=self.g[..., kept], believed=known)


def accumulate(
    station: Station, values: np.ndarray, free: np.ndarray, robust: np.ndarray
) -> Normal:
    """Return the normal equations of one station; arguments as for :func:`accumulate_each`."""
    found = accumulate_each(station, np.array([0, len(station)]), values, free, robust)
    return replace(found, H=found.H[0], g=found.g[0])


def accumulate_each(
    station: Station, ends: np.ndarray, values: np.ndarray, free: np.ndarray, robust: np.ndarray
) -> Normal:
    """Return the normal equations of each of S stations joined in one.

    Args:
        station: the rows of all.
        ends: shape (S + 1,), boundaries of the stations' rows.
        values: shape (P,), or of several stations shape (P, S).
        free: shape (P,), the F free parameters.
        robust: shape (N,), factor on each row's weight: 0 excludes a row.
    """
    n = len(ends) - 1
    blocks = station.block_rows
    n_free = int(free.sum())
    H = np.zeros((n, len(blocks), n_free, n_free))
    g = np.zeros((n, len(blocks), n_free))
    squares = np.zeros((n, len(blocks)))
    row_squares = np.empty((len(blocks), len(station)))
    for piece, residuals, jacobian in station.linearise_correlated(values, free):
        residuals = station.uncorrelated(residuals[None], piece)[0]
        weights = station.weights[piece]
        row_squares[:, piece] = _row_squares(residuals, blocks, weights)
        weights = weights * robust[piece]
        is_uniform = bool(np.all(weights == 1.0))
        here, inner = _parts_of(piece, ends)
        for b, (rows, part) in enumerate(station.by_block(jacobian, piece)):
            part.add_grams(
                residuals[rows],
                inner,
                H[here, b],
                g[here, b],
                weights=None if is_uniform else weights,
            )
            r = residuals[rows] if is_uniform else residuals[rows] * weights
            squares[here, b] += [np.vdot(of, of) for of in np.split(r, inner[1:-1], axis=1)]
    known = believed(station, values, free) if n == 1 else None
    beliefs = np.full(n, 0.0 if known is None else known.square)
    return Normal(H, g, StationSquares(squares.ravel(), row_squares, beliefs), robust, known)


def _row_squares(residuals: np.ndarray, blocks: Sequence[slice], weights: np.ndarray) -> np.ndarray:
    """Return the weighted squares of each block of each row, shape (blocks, n)."""
    squares = np.empty((len(blocks), len(weights)))
    for b, rows in enumerate(blocks):
        squares[b] = np.einsum("in,in->n", residuals[rows], residuals[rows]) * weights**2
    return squares


def reweighted(
    station: Station,
    ends: np.ndarray,
    values: np.ndarray,
    free: np.ndarray,
    robust: np.ndarray,
    past: Normal | None = None,
) -> Normal:
    """Return the normal equations of stations; of a single one only rows with changed robust
    weights are summed.

    Arguments as for :func:`accumulate_each`, and ``past``: the equations at the same values with
    other robust weights.
    """
    rows = np.arange(len(station)) if past is None else np.flatnonzero(robust != past.robust)
    if station.arrival is not None:
        # The contribution of a row depends on the others of its stop.
        rows = np.flatnonzero(np.isin(station.arrival.stop, station.arrival.stop[rows]))
    # Where rows are correlated along their order, it depends on all before.
    is_whole = len(ends) > 2 or station.sensor.is_whole or station.serial is not None
    if past is None or is_whole or _MOST_CHANGED * len(rows) > len(station):
        return accumulate_each(station, ends, values, free, robust)
    change = robust[rows] ** 2 - past.robust[rows] ** 2
    H = past.H.copy()
    g = past.g.copy()
    for some, add in ((change > 0.0, np.add), (change < 0.0, np.subtract)):
        if some.any():
            if station.arrival is None:
                weights = np.sqrt(np.abs(change[some]))
                part = station.select(rows[some])
            else:
                weights = np.sqrt(np.where(some, np.abs(change), 0.0))
                part = station.select(rows)
            found = accumulate_each(part, np.array([0, len(weights)]), values, free, weights)
            add(H, found.H, out=H)
            add(g, found.g, out=g)
    # From the rows, since the difference of large squares would consist of rounding.
    squares = replace(past.squares, blocks=np.sum(past.squares.rows * robust**2, axis=1))
    return replace(past, H=H, g=g, squares=squares, robust=robust)


def near(
    station: Station,
    ends: np.ndarray,
    values: np.ndarray,
    free: np.ndarray,
    robust: np.ndarray,
    there: Normal,
) -> Normal:
    """Return the normal equations of a station with H of those ``there``, at values near by; other
    arguments as for :func:`accumulate_each`.

    Slope and squares are exact. Where rows are correlated they take a tenth of the time of H.
    """
    blocks = station.block_rows
    g = np.zeros_like(there.g)
    row_squares = np.empty((len(blocks), len(station)))
    every = slice(0, station.reading_size)
    for piece, residuals, jacobian in station.linearise_correlated(values, free):
        residuals = station.uncorrelated(residuals[None], piece)[0]
        weights = station.weights[piece]
        row_squares[:, piece] = _row_squares(residuals, blocks, weights)
        for b, rows in enumerate(blocks):
            # Readings of other blocks may move these where rows of a stop are correlated.
            pull = np.zeros((1, *residuals.shape))
            pull[0, rows] = residuals[rows] * (weights * robust[piece]) ** 2
            if station.is_correlated:
                station.uncorrelate(pull, piece, every, transposed=True)
            jacobian.add_slope(pull[0], g.reshape(len(blocks), -1)[b])
    known = believed(station, values, free)
    beliefs = np.array([0.0 if known is None else known.square])
    found = StationSquares(summed(row_squares, ends, robust), row_squares, beliefs)
    return replace(there, g=g, squares=found, robust=robust, believed=known)


def squares(
    station: Station, ends: np.ndarray, values: np.ndarray, robust: np.ndarray
) -> StationSquares:
    """Return the squares of stations' residuals; arguments as for :func:`accumulate_each`."""
    residuals = station.whitened(station.residuals(values))
    parts = [np.einsum("in,in->n", residuals[rows], residuals[rows]) for rows in station.block_rows]
    rows = np.array(parts) * station.weights**2
    known = np.zeros(len(ends) - 1)
    if len(known) == 1:
        r = belief_rows(station, values, np.zeros(len(values), bool))[1]
        known[0] = r @ r
    return StationSquares(summed(rows, ends, robust), rows, known)


def summed(rows: np.ndarray, ends: np.ndarray, robust: np.ndarray) -> np.ndarray:
    """Return the squares of the blocks of each of S stations, from those of the rows.

    Args:
        rows: shape (blocks, N), squares without robust weights.
        ends: shape (S + 1,), boundaries of the stations' rows.
        robust: shape (N,), factor on each row's weight.
    """
    each = zip(np.split(rows, ends[1:-1], axis=1), np.split(robust, ends[1:-1]), strict=True)
    return np.concatenate([of @ weights**2 for of, weights in each])


def contribution(
    station: Station,
    ends: np.ndarray,
    values: np.ndarray,
    free: np.ndarray,
    robust: np.ndarray,
    sigma: np.ndarray,
    *prior: np.ndarray,
) -> tuple[tuple[Form, Eliminated], StationSquares]:
    """Return the information of stations on the free parameters that they share, and the squares of
    their residuals.

    Arguments as for :func:`accumulate_each`, then noise, shape (S, blocks), and those of
    :func:`eliminate`.
    """
    form, found = accumulate_at(station, ends, values, free, robust, sigma)
    known = believed(station, values, free) if len(form.g) == 1 else None
    if known is not None:
        form = Form.of(form.H + known.H, form.g + known.g)
        found = replace(found, beliefs=np.array([known.square]))
    return eliminate(form, *prior), found


def accumulate_at(
    station: Station,
    ends: np.ndarray,
    values: np.ndarray,
    free: np.ndarray,
    robust: np.ndarray,
    sigma: np.ndarray,
) -> tuple[Form, StationSquares]:
    """Return the information of each of S stations for one noise, shape (S, blocks), without what
    sensors know besides their readings, and the squares of their residuals.

    All blocks are summed together, in half of the time of two apart. Other arguments as for
    :func:`accumulate_each`.
    """
    n = len(ends) - 1
    n_free = int(free.sum())
    H = np.zeros((n, n_free, n_free))
    g = np.zeros((n, n_free))
    row_squares = np.empty((len(station.block_rows), len(station)))
    precision = np.repeat(1.0 / sigma, station.block_sizes, axis=1)[
        np.repeat(np.arange(n), np.diff(ends))
    ].T
    for piece, residuals, jacobian in station.linearise_correlated(values, free):
        residuals = station.uncorrelated(residuals[None], piece)[0]
        weights = station.weights[piece]
        row_squares[:, piece] = _row_squares(residuals, station.block_rows, weights)
        scale = precision[:, piece] * (weights * robust[piece])
        here, inner = _parts_of(piece, ends)
        for some, part in station.apart(jacobian, piece, is_one=n == 1):
            part.add_grams(residuals[some], inner, H[here], g[here], weights=scale[some])
    blocks = summed(row_squares, ends, robust)
    return Form.of(H, g), StationSquares(blocks, row_squares, np.zeros(n))


def _parts_of(piece: slice, ends: np.ndarray) -> tuple[slice, np.ndarray]:
    """Return the stations that have rows of a piece, and the boundaries of their rows within it,
    given those of all rows.
    """
    first, last = np.searchsorted(ends, [piece.start, piece.stop - 1], side="right") - 1
    inner = np.clip(ends[first : last + 2], piece.start, piece.stop) - piece.start
    return slice(first, last + 1), inner


def believed(station: Station, values: np.ndarray, free: np.ndarray) -> Quadratic | None:
    """Return the sensor's knowledge of its own parameters, over all F free ones; None where it has
    no constraints.
    """
    J, r = belief_rows(station, values, free)
    return (
        Quadratic.of_rows([p.name for p in compress(station.parameters, free)], J.T, r)
        if len(r)
        else None
    )


def belief_rows(
    station: Station, values: np.ndarray, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return Jacobian, shape (F, C), and residuals, shape (C,), of the sensor's C constraints in
    units of their noise.
    """
    facts = station.sensor.constraints(station.split(values)[1])
    if facts is None:
        return np.zeros((int(free.sum()), 0)), np.zeros(0)
    of_model, of_sensor = station.split(free)
    J = (facts.jacobian / facts.sigma)[of_sensor]
    return np.vstack(
        [np.zeros((int(of_model.sum()), J.shape[1])), J]
    ), facts.residuals / facts.sigma
