r"""A problem: the sum of stations, and perhaps of what an earlier fit found, over one table of named parameters.

The robot's parameters are the same at every station; where an instrument stands, its targets and whatever the instrument
itself has to be asked for belong to one station. With one station the table is that station's own, in its order; with
several the robot's parameters stand first, then those of each station under its name.
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
from pincal.measure.extrinsics import sample_rows
from pincal.measure.sensor import Block
from pincal.model.chain import Chain, MomentFrame
from pincal.model.conditions import Conditions, joined_conditions, part_of
from pincal.model.effect import Effect, Family
from pincal.model.sizes import largest_bases
from pincal.parameters import Parameter, carried_over

# Rows by which sizes are judged.
_ROWS = 1000


@dataclass(frozen=True)
class Problem:
    """One station or several.

    Attributes:
        stations: the stations; several have names of their own.
        earlier: what is known of the robot's parameters from an earlier fit; of those that no station here has it says what
            it does where they are zero.
    """

    stations: tuple[Station, ...]
    earlier: Earlier | None = None

    def __post_init__(self) -> None:
        names = [station.name for station in self.stations]
        if not names:
            raise BadInputError("a problem without stations; expected one or more")
        if len(names) > 1 and (len(set(names)) < len(names) or not all(names)):
            raise BadInputError(f"stations are called {', '.join(map(repr, names))}; expected a different name for each")

    def __len__(self) -> int:
        return sum(len(station) for station in self.stations)

    @property
    def chain(self) -> Chain:
        """The chain of the first station: the robot's part of it is the same at all of them."""
        return self.stations[0].model.chain

    @cached_property
    def conditions(self) -> Conditions:
        """The poses of all stations, targets and payload's centre those of the first; columns that all of them have."""
        return joined_conditions([station.conditions for station in self.stations])

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All P parameters; those of one of several stations have its name before their own, or that of their set-up."""
        first = self.stations[0]
        if len(self.stations) == 1:
            return first.parameters
        # Of all stations the robot's parameters are the same, in the same order.
        return (*compress(first.parameters, ~first.is_own), *self._stations_own[0].values())

    @cached_property
    def _stations_own(self) -> tuple[dict[tuple[str, int], Parameter], list[list[tuple[str, int]]]]:
        """What belongs to stations by name and, as candidates may be alike, number of the name there; and these of each."""
        found, keys = dict[tuple[str, int], Parameter](), list[list[tuple[str, int]]]()
        for station in self.stations:
            seen, own = Counter[str](), [p.at(station.owner(p)) for p in compress(station.parameters, station.is_own)]
            keys.append([])
            for p in own:
                keys[-1].append((p.name, seen[p.name]))
                found.setdefault(keys[-1][-1], p)
                seen[p.name] += 1
        return found, keys

    @cached_property
    def places(self) -> tuple[np.ndarray, ...]:
        """For each station, where its parameters stand in the table."""
        if len(self.stations) == 1:
            return (np.arange(len(self.stations[0].parameters)),)
        found, keys = self._stations_own
        first = int(np.count_nonzero(~self.stations[0].is_own))
        index, places = {key: first + k for k, key in enumerate(found)}, []
        for station, own in zip(self.stations, keys, strict=True):
            local = np.cumsum(~station.is_own) - 1
            local[station.is_own] = [index[key] for key in own]
            places.append(local)
        return tuple(places)

    @cached_property
    def _index(self) -> dict[str, int]:
        """The place of each parameter by its name."""
        return {parameter.name: i for i, parameter in enumerate(self.parameters)}

    @cached_property
    def is_shared(self) -> np.ndarray:
        """Which parameters are left when those of single stations among several are eliminated, shape (P,)."""
        if len(self.stations) == 1:
            return np.ones(len(self.parameters), bool)
        found = np.bincount(np.concatenate(self.places), minlength=len(self.parameters)) > 1
        found[: int(np.count_nonzero(~self.stations[0].is_own))] = True
        return found

    @cached_property
    def beliefs(self) -> Beliefs:
        """What is believed of parameters beyond the prior of each.

        What is known from an earlier fit has the smoothness of curves already; a station's own are not known that well.
        """
        terms, is_remembered = [], np.zeros(len(self.parameters), bool)
        if self.earlier is not None:
            known = self.earlier.known_zero(np.array([name not in self._index for name in self.earlier.names], bool))
            places = np.array([self._index[name] for name in known.names], int)
            terms.append(replace(known, places=places))
            is_remembered[places] = True
        for effect in self.effects:
            if (information := effect.smoothness()) is not None:
                places = self.places_at(effect)
                if np.all(self.is_shared[places] & ~is_remembered[places]):
                    names = tuple(self.parameters[place].name for place in places)
                    terms.append(Earlier(names, np.zeros(len(places)), information, None, places))
        if self.earlier is None and (scale := scale_of_contacts(self.stations, self.places, self.parameters)) is not None:
            return Beliefs((*terms, scale), is_remembered, not terms)
        return Beliefs(tuple(terms), is_remembered, not terms)

    @cached_property
    def rows(self) -> tuple[slice, ...]:
        """For each station, where its rows stand among all rows."""
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
        """The stations, to do tasks with."""
        return Work(self.stations)

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """The blocks of readings of all stations, one station after the other."""
        return tuple(block for station in self.stations for block in station.sensor.blocks)

    @cached_property
    def block_spans(self) -> tuple[slice, ...]:
        """For each station, where its blocks stand among all blocks."""
        return _spans(len(station.sensor.blocks) for station in self.stations)

    def readings(self, robust: np.ndarray) -> np.ndarray:
        """Return how many readings of each block count by robust weights of all rows, shape (blocks,)."""
        counts, (station, size) = robust > 0.0, self._of_blocks
        return np.asarray(np.array([np.count_nonzero(counts[rows]) for rows in self.rows])[station] * size)

    @cached_property
    def _of_blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """Of each block of readings its station, by number, and its components, shape (blocks,)."""
        pairs = [(k, block.size) for k, station in enumerate(self.stations) for block in station.sensor.blocks]
        station, size = np.array(pairs).T
        return station, size

    @cached_property
    def largest_basis(self) -> tuple[np.ndarray, np.ndarray]:
        """How far a unit of each parameter moves its coordinate at most, and whether it does at all, shape (P,)."""
        largest, excited = np.zeros(len(self.parameters)), np.zeros(len(self.parameters), bool)
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
        """What may deviate, beside base and tool; those of all stations first, then what only some of them have."""
        first, *others = ([e for e in s.model.effects if e.family is not Family.EXTRINSICS] for s in self.stations)
        for effects in others:
            known = set(map(id, first))
            first += [effect for effect in effects if id(effect) not in known and effect not in first]
        return tuple(first)

    @cached_property
    def _spans(self) -> tuple[dict[int, slice], ...]:
        """For each station, where the parameters of an effect stand among its own, by the effect's identity."""
        pairs = ((station.model.effects, station.model.spans) for station in self.stations)
        return tuple({id(effect): span for effect, span in zip(*pair, strict=True)} for pair in pairs)

    def __getstate__(self) -> dict[str, Any]:
        """Return all but what is known by the identity of objects, which are others where this is unpickled."""
        return {name: value for name, value in vars(self).items() if name != "_spans"}

    def with_effects(self, effects: Sequence[Effect], *, moment_frame: MomentFrame | None = None) -> Problem:
        """Return the same readings with other effects beside base and tool."""
        stations = []
        for station in self.stations:
            frames = [effect for effect in station.model.effects if effect.family is Family.EXTRINSICS]
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
            parts = [rows[(rows >= span.start) & (rows < span.stop)] - span.start for span in self.rows]
        whole = [part.dtype == bool and bool(part.all()) for part in parts]
        pairs = zip(self.stations, parts, whole, strict=True)
        return replace(self, stations=tuple(s if is_whole else s.select(part) for s, part, is_whole in pairs))

    def places_at(self, effect: Effect) -> np.ndarray:
        """Return where the parameters of an effect of the problem, this very object, stand: those of all stations."""
        found: dict[int, None] = {}
        for spans, places in zip(self._spans, self.places, strict=True):
            found |= dict.fromkeys(places[spans.get(id(effect), slice(0))].tolist())
        return np.array(list(found), int)

    def carried_over(self, vector: np.ndarray, other: Problem) -> np.ndarray:
        """Return what a vector over this table says of another problem's, by name; zero (or False) where it says nothing."""
        return carried_over(vector, self._index, other.parameters)


def extended(problem: Problem, effects: Sequence[Effect]) -> tuple[Problem, np.ndarray]:
    """Return a problem with further effects, and where its parameters stand in the new table, shape (P,)."""
    models = [s.model.with_effects([*s.model.effects, *effects_at(effects, s.name)]) for s in problem.stations]
    wider = replace(problem, stations=tuple(s.with_model(m) for s, m in zip(problem.stations, models, strict=True)))
    known = np.empty(len(problem.parameters), int)
    for i, (station, other) in enumerate(zip(problem.stations, wider.stations, strict=True)):
        (of_model, of_sensor), (model, sensor) = station.split(problem.places[i]), other.split(wider.places[i])
        known[of_model], known[of_sensor] = model[: len(of_model)], sensor
    return wider, known


def effects_at(effects: Iterable[Effect], station: str) -> list[Effect]:
    """Return the effects that a station has: those of all stations, and its own."""
    return [effect for effect in effects if effect.locus.station in (None, station)]


def _spans(lengths: Iterable[int]) -> tuple[slice, ...]:
    ends = np.cumsum([0, *lengths]).tolist()
    return tuple(slice(a, b) for a, b in pairwise(ends))


def _sample(station: Station) -> Station:
    """Return the station with rows spread over the table, enough to judge sizes by."""
    if len(station) <= _ROWS:
        return station
    rows = sample_rows(len(station), _ROWS)
    return replace(station.select(rows), conditions=part_of(station.conditions, rows, (_ROWS,)))
