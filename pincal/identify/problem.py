r"""A problem: the sum of stations, and perhaps of an earlier fit, over one table of named
parameters.

The robot's parameters are common to all stations; the instrument's pose, the targets and unknowns
of the instrument itself belong to one station. With one station the table is that station's own, in
its order; with several, the robot's parameters come first, then those of each station under its
name.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress, pairwise
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.believed import Beliefs, Earlier, scale_of_contacts
from pincal.identify.normal import Batch, Work, runs
from pincal.identify.station import Station
from pincal.model.chain import Chain, MomentFrame
from pincal.model.conditions import Conditions, joined_conditions, part_of
from pincal.model.effect import Effect, Family
from pincal.model.sizes import largest_bases
from pincal.parameters import Parameter, carried_over
from pincal.sensors.row_samples import sample_rows
from pincal.sensors.sensor import Block
from pincal.thresholds import Count

# Rows from which sizes are determined.
_ROWS: Count = 1000


@dataclass(frozen=True)
class Problem:
    """One station or several.

    Attributes:
        stations: the stations; several have names of their own.
        earlier: knowledge of the robot's parameters from an earlier fit, conditioned on zero for
            those that no station has.
    """

    stations: tuple[Station, ...]
    earlier: Earlier | None = None

    def __post_init__(self) -> None:
        names = [station.name for station in self.stations]
        if not names:
            raise BadInputError("a problem without stations; expected one or more")
        if len(names) > 1 and (len(set(names)) < len(names) or not all(names)):
            raise BadInputError(
                f"stations are called {', '.join(map(repr, names))}; expected a different "
                "name for each"
            )

    def __len__(self) -> int:
        return sum(len(station) for station in self.stations)

    @property
    def chain(self) -> Chain:
        """The chain of the first station; the robot's part of it is the same at all stations."""
        return self.stations[0].model.chain

    @cached_property
    def conditions(self) -> Conditions:
        """The poses of all stations, with the first one's targets and payload centre; columns that
        all of them have.
        """
        return joined_conditions([station.conditions for station in self.stations])

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All P parameters; those of one of several stations are prefixed by its name, or by that
        of its set-up.
        """
        first = self.stations[0]
        if len(self.stations) == 1:
            return first.parameters
        # The robot's parameters are the same at all stations, in the same order.
        return (*compress(first.parameters, ~first.is_own), *self._stations_own[0].values())

    @cached_property
    def _stations_own(self) -> tuple[dict[tuple[str, int], Parameter], list[list[tuple[str, int]]]]:
        """Parameters of stations, keyed by name and its repetition (candidates may share names);
        and each station's keys.
        """
        found = dict[tuple[str, int], Parameter]()
        keys = list[list[tuple[str, int]]]()
        for station in self.stations:
            seen = Counter[str]()
            own = [p.at(station.owner(p)) for p in compress(station.parameters, station.is_own)]
            keys.append([])
            for p in own:
                keys[-1].append((p.name, seen[p.name]))
                found.setdefault(keys[-1][-1], p)
                seen[p.name] += 1
        return found, keys

    @cached_property
    def places(self) -> tuple[np.ndarray, ...]:
        """For each station, the indices of its parameters in the table."""
        if len(self.stations) == 1:
            return (np.arange(len(self.stations[0].parameters)),)
        found, keys = self._stations_own
        first = int(np.count_nonzero(~self.stations[0].is_own))
        index = {key: first + k for k, key in enumerate(found)}
        places = []
        for station, own in zip(self.stations, keys, strict=True):
            local = np.cumsum(~station.is_own) - 1
            local[station.is_own] = [index[key] for key in own]
            places.append(local)
        return tuple(places)

    @cached_property
    def _index(self) -> dict[str, int]:
        """The index of each parameter by its name."""
        return {parameter.name: i for i, parameter in enumerate(self.parameters)}

    @cached_property
    def is_shared(self) -> np.ndarray:
        """Which parameters remain when those of single stations among several are eliminated, shape
        (P,).
        """
        if len(self.stations) == 1:
            return np.ones(len(self.parameters), bool)
        found = np.bincount(np.concatenate(self.places), minlength=len(self.parameters)) > 1
        found[: int(np.count_nonzero(~self.stations[0].is_own))] = True
        return found

    @cached_property
    def beliefs(self) -> Beliefs:
        """Knowledge of parameters beyond the prior of each.

        An earlier fit already includes the smoothness of curves; a station's own curves are not
        known that well.
        """
        terms = []
        is_earlier = np.zeros(len(self.parameters), bool)
        if self.earlier is not None:
            known = self.earlier.given_zero(
                np.array([name not in self._index for name in self.earlier.names], bool)
            )
            places = np.array([self._index[name] for name in known.names], int)
            terms.append(replace(known, places=places))
            is_earlier[places] = True
        for effect in self.effects:
            if (information := effect.smoothness()) is not None:
                places = self.places_at(effect)
                if np.all(self.is_shared[places] & ~is_earlier[places]):
                    names = tuple(self.parameters[place].name for place in places)
                    terms.append(Earlier(names, np.zeros(len(places)), information, None, places))
        if (
            self.earlier is None
            and (scale := scale_of_contacts(self.stations, self.places, self.parameters))
            is not None
        ):
            return Beliefs((*terms, scale), is_earlier, not terms)
        return Beliefs(tuple(terms), is_earlier, not terms)

    @cached_property
    def rows(self) -> tuple[slice, ...]:
        """For each station, the slice of its rows among all rows."""
        return _spans(len(station) for station in self.stations)

    @cached_property
    def batches(self) -> tuple[Batch, ...]:
        """The stations as they are evaluated, several small ones at a time."""
        return tuple(
            Batch(
                self.stations[run.start : run.stop],
                slice(self.rows[run[0]].start, self.rows[run[-1]].stop),
                slice(self.block_spans[run[0]].start, self.block_spans[run[-1]].stop),
                np.array(self.places[run.start : run.stop]),
                ~self.is_shared[self.places[run[0]]],
                run[0],
            )
            for run in runs(self.stations)
        )

    @cached_property
    def work(self) -> Work:
        """The stations, for tasks on workers."""
        return Work(self.stations)

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """The blocks of readings of all stations, one station after the other."""
        return tuple(block for station in self.stations for block in station.sensor.blocks)

    @cached_property
    def block_spans(self) -> tuple[slice, ...]:
        """For each station, the slice of its blocks among all blocks."""
        return _spans(len(station.sensor.blocks) for station in self.stations)

    def readings(self, robust: np.ndarray) -> np.ndarray:
        """Return the number of readings of each block that count, shape (blocks,), given robust
        weights of all rows.
        """
        (station, size) = self._of_blocks
        counts = [np.count_nonzero(robust[rows] > 0.0) for rows in self.rows]
        return np.asarray(np.array(counts)[station] * size)

    @cached_property
    def _of_blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """Station number and number of components of each block of readings, shape (blocks,)."""
        pairs = [
            (k, block.size)
            for k, station in enumerate(self.stations)
            for block in station.sensor.blocks
        ]
        station, size = np.array(pairs).T
        return station, size

    @cached_property
    def largest_basis(self) -> tuple[np.ndarray, np.ndarray]:
        """Largest motion of each parameter's coordinate per unit, and whether it moves at all,
        shape (P,).
        """
        largest = np.zeros(len(self.parameters))
        excited = np.zeros(len(self.parameters), bool)
        for batch in self.batches:
            sample = replace(batch, stations=tuple(map(_sample, batch.stations)))
            model = sample.stations[0].model
            found = largest_bases(model, sample.together().conditions, sample.ends[:-1])
            n_sensor = batch.places.shape[1] - model.n_parameters
            size, acts = (np.pad(of, ((0, 0), (0, n_sensor)), constant_values=1) for of in found)
            np.maximum.at(largest, batch.places, size)
            np.logical_or.at(excited, batch.places, acts)
        return largest, excited

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """Effects besides base and tool; those of the first station first, then the others' own."""
        first, *others = (
            [e for e in s.model.effects if e.family is not Family.EXTRINSICS] for s in self.stations
        )
        for effects in others:
            known = set(map(id, first))
            first += [
                effect for effect in effects if id(effect) not in known and effect not in first
            ]
        return tuple(first)

    @cached_property
    def _spans(self) -> tuple[dict[int, slice], ...]:
        """For each station, the slice of each effect's parameters among its own, by the effect's
        identity.
        """
        pairs = ((station.model.effects, station.model.spans) for station in self.stations)
        return tuple(
            {id(effect): span for effect, span in zip(*pair, strict=True)} for pair in pairs
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return all but what is keyed by the identity of objects, which changes where this is
        unpickled.
        """
        return {name: value for name, value in vars(self).items() if name != "_spans"}

    def with_effects(
        self, effects: Sequence[Effect], *, moment_frame: MomentFrame | None = None
    ) -> Problem:
        """Return the same readings with other effects besides base and tool."""
        stations = []
        for station in self.stations:
            frames = [
                effect for effect in station.model.effects if effect.family is Family.EXTRINSICS
            ]
            model = station.model.with_effects([*frames, *effects_at(effects, station.name)])
            if moment_frame is not None:
                model = model.with_chain(model.chain.with_moment_frame(moment_frame))
            stations.append(station.with_model(model))
        return replace(self, stations=tuple(stations))

    def select(self, rows: np.ndarray) -> Problem:
        """Return the problem of some rows (a mask over all rows, or indices)."""
        if rows.dtype == bool:
            parts = [rows[span] for span in self.rows]
        else:
            parts = [
                rows[(rows >= span.start) & (rows < span.stop)] - span.start for span in self.rows
            ]
        whole = [part.dtype == bool and bool(part.all()) for part in parts]
        pairs = zip(self.stations, parts, whole, strict=True)
        return replace(
            self, stations=tuple(s if is_whole else s.select(part) for s, part, is_whole in pairs)
        )

    def places_at(self, effect: Effect) -> np.ndarray:
        """Return the indices of the parameters of an effect of the problem (this very object), at
        all stations.
        """
        each = [
            places[spans.get(id(effect), slice(0))]
            for spans, places in zip(self._spans, self.places, strict=True)
        ]
        if len(each) == 1:
            return each[0].copy()
        return np.array(list(dict.fromkeys(np.concatenate(each).tolist())), int)

    def carried_over(self, vector: np.ndarray, other: Problem) -> np.ndarray:
        """Return a vector over another problem's table by parameter name; zero (or False) for
        unknown names.
        """
        return carried_over(vector, self._index, other.parameters)


def extended(problem: Problem, effects: Sequence[Effect]) -> tuple[Problem, np.ndarray]:
    """Return a problem with further effects, and the indices of its parameters in the new table,
    shape (P,).
    """
    models = [
        s.model.with_effects([*s.model.effects, *effects_at(effects, s.name)])
        for s in problem.stations
    ]
    wider = replace(
        problem,
        stations=tuple(s.with_model(m) for s, m in zip(problem.stations, models, strict=True)),
    )
    known = np.empty(len(problem.parameters), int)
    for i, (station, other) in enumerate(zip(problem.stations, wider.stations, strict=True)):
        of_model, of_sensor = station.split(problem.places[i])
        model, sensor = other.split(wider.places[i])
        known[of_model] = model[: len(of_model)]
        known[of_sensor] = sensor
    return wider, known


def effects_at(effects: Iterable[Effect], station: str) -> list[Effect]:
    """Return the effects at a station: those of all stations, and its own."""
    return [effect for effect in effects if effect.locus.station in (None, station)]


def _spans(lengths: Iterable[int]) -> tuple[slice, ...]:
    ends = np.cumsum([0, *lengths]).tolist()
    return tuple(slice(a, b) for a, b in pairwise(ends))


def _sample(station: Station) -> Station:
    """Return the station with rows spread over the table, enough to determine sizes."""
    if len(station) <= _ROWS:
        return station
    rows = sample_rows(len(station), _ROWS)
    return replace(station.select(rows), conditions=part_of(station.conditions, rows, (_ROWS,)))
