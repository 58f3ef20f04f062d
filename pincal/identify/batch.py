"""Stations that one pass evaluates: of one kind of sensor and one model but for where they stand.

An evaluation has costs of its own beside those of its rows. Small stations that follow each other in a problem share them:
the model is evaluated once over the rows of all, with the values of each station's own parameters at its rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

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
    start, rows, is_plain = 0, len(stations[0]), None
    for i, station in enumerate(stations[1:], 1):
        rows += len(station)
        is_plain = _is_plain(stations[start]) if is_plain is None else is_plain
        if rows > PIECE or not is_plain or not _are_alike(stations[start], station):
            yield range(start, i)
            start, rows, is_plain = i, len(station), None
    yield range(start, len(stations))


def _are_alike(one: Station, other: Station) -> bool:
    """Return whether one evaluation can serve two stations."""
    a, b = one.model, other.model
    return (
        a.chain.robot is b.chain.robot
        and a.chain.moment_frame == b.chain.moment_frame
        and len(a.chain.targets) == len(b.chain.targets)
        and np.array_equal(a.chain.gravity, b.chain.gravity)
        and a.equilibrium == b.equilibrium
        and len(a.effects) == len(b.effects)
        and all(x is y or (x.family is Family.EXTRINSICS and x == y) for x, y in zip(a.effects, b.effects, strict=True))
        and _shape(one) == _shape(other)
        and other.serial is None
        and np.array_equal(one.conditions.payload_centre, other.conditions.payload_centre)
    )


def _shape(station: Station) -> tuple[object, ...]:
    """Return what kind of readings a station has, and which columns are recorded."""
    absent = [getattr(station.sensor, name) is None for name in station.sensor.per_row]
    return (
        type(station.sensor),
        station.whitening is None,
        *absent,
        *(getattr(station.conditions, f.name) is None for f in fields(station.conditions)),
    )


def _is_plain(station: Station) -> bool:
    """Return whether a station's sensor is nothing but its rows, and its model the same however base and tool are turned."""
    sensor, chain = station.sensor, station.model.chain
    is_rows = {f.name for f in fields(sensor)} == set(sensor.per_row)  # type: ignore[arg-type]
    if station.serial is not None or not is_rows or sensor.parameters or isinstance(sensor, Grouped) or not len(station):
        return False
    nowhere = chain.with_references(np.full((3, 3), np.nan), np.full_like(chain.tool_rotations, np.nan))
    row, moments = station.conditions.select(slice(0, 1)), np.zeros((1, 3 * chain.robot.n_joints))
    terms = (t for e in station.model.effects for t in e.terms(nowhere, row, moments if e.uses_moments else None))
    return all(term.basis is None or bool(np.isfinite(term.basis).all()) for term in terms)
