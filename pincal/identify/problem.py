r"""A problem: the sum of stations, and perhaps of what an earlier fit found, over one table of named parameters.

The robot's parameters are the same at every station; where an instrument stands, its targets and whatever the instrument
itself has to be asked for belong to one station. With one station the table is that station's own, in its order; with
several the robot's parameters stand first, then those of each station under its name.

With m the values and C the covariance that an earlier fit found of the robot's parameters x, whatever belonged to the
stations of that time left out, its term is :math:`(x - m)^T C^{-1} (x - m)`. It takes the place of these parameters' priors,
which are in C already. For a linear model the fit of new rows beside it is the joint fit of old and new ones.

A solver counts in units of priors, so the term is handed to it as what it says beyond them, :math:`C^{-1} - D^{-2}` for
priors of sizes D. What the old rows did not see has only the priors then, as if the rows were there. That a curve is smooth
is such a term about zero, beside the priors of its heights.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress, pairwise
from typing import Any, NamedTuple

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.normal import Batch, Work, runs
from pincal.identify.quadratic import Form
from pincal.identify.station import Station
from pincal.measure.extrinsics import sample_rows
from pincal.measure.sensor import Block
from pincal.model.chain import Chain, MomentFrame
from pincal.model.conditions import Conditions, joined_conditions, part_of
from pincal.model.effects import LENGTHS, BaseFrame, Effect, ToolFrame
from pincal.model.sizes import largest_bases
from pincal.parameters import Estimate, Parameter, carried_over

# Smallest standard deviation of a direction, in parts of the largest, each parameter in units of its own: below is rounding.
_LEAST = 1e-9


@dataclass(frozen=True, eq=False)
class Earlier:
    """A normal distribution of K parameters, or what is believed of them beside the prior of each: (x - m)^T H (x - m).

    Attributes:
        names: the parameters.
        mean: shape (K,), m.
        information: shape (K, K), H, of a distribution the inverse of its covariance.
        sigma: shape (K,), standard deviations, if the priors about zero are part of it already; None for what stands beside
            them.
        places: shape (K,), where the parameters stand in a problem's table.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    information: np.ndarray
    sigma: np.ndarray | None
    places: np.ndarray = field(default_factory=lambda: np.zeros(0, int))

    @classmethod
    def of(cls, estimate: Estimate) -> Earlier:
        """Return what an estimate of a robot's parameters says of those that were fitted.

        Raises:
            BadInputError: if there are parameters of a station among them.
        """
        foreign = [p.name for p in estimate.parameters if p.station or p.is_extrinsic]
        if foreign:
            raise BadInputError(
                f"{foreign[0]} belongs to a station; expected the robot's own parameters, such as model.robot_estimate has"
            )
        free = estimate.free
        root, sigma = estimate.covariance.root, np.sqrt(estimate.covariance.variance)
        axes, lengths, _ = np.linalg.svd(root / sigma[:, None], full_matrices=False)
        lengths = np.maximum(lengths, _LEAST * lengths.max(initial=0.0))
        inverse = axes / lengths / sigma[:, None]
        names = tuple(name for name, is_free in zip(estimate.names, free, strict=True) if is_free)
        return cls(names, estimate.values[free], inverse @ inverse.T, sigma)

    def known_zero(self, others: np.ndarray) -> Earlier:
        """Return the distribution of the other parameters if some, shape (K,), are known to be zero."""
        if not others.any():
            return self
        kept = ~others
        H = self.information[np.ix_(kept, kept)]
        C = np.linalg.inv(H)
        mean = self.mean[kept] + C @ (self.information[np.ix_(kept, others)] @ self.mean[others])
        names = tuple(name for name, is_kept in zip(self.names, kept, strict=True) if is_kept)
        return Earlier(names, mean, H, np.sqrt(np.diag(C)))

    def taken_back(self, sizes: np.ndarray) -> np.ndarray:
        """Return the sizes of the priors that are part of it, shape (K,), inf for none, given those of all parameters."""
        return np.full(len(self.places), np.inf) if self.sigma is None else sizes[self.places]


class Beliefs(NamedTuple):
    """What is believed of a problem's parameters beyond the prior of each.

    Attributes:
        terms: no parameter is in two of them.
        is_remembered: shape (P,), which parameters are known from an earlier fit.
        is_slope: whether there is nothing but the slope of contacts, which counts for nothing beside exact readings.
    """

    terms: tuple[Earlier, ...]
    is_remembered: np.ndarray
    is_slope: bool

    def recalled(self, values: np.ndarray) -> np.ndarray:
        """Return values, shape (P,), with those of an earlier fit where it has any."""
        recalled = values.copy()
        for term in self.terms:
            if term.sigma is not None:
                recalled[term.places] = term.mean
        return recalled

    def widened(self, sizes: np.ndarray) -> np.ndarray:
        """Return sizes of priors, shape (P,), no smaller than these, beyond which no earlier fit says less than nothing."""
        found = sizes.copy()
        for term in self.terms:
            if term.sigma is not None:
                wide = np.maximum(sizes[term.places], term.sigma)
                least = float(np.linalg.eigvalsh(term.information * np.outer(wide, wide)).min(initial=1.0))
                found[term.places] = wide / np.sqrt(np.clip(least, 1e-6, 1.0))
        return found

    def square(self, values: np.ndarray, sizes: np.ndarray) -> float:
        """Return what they add to the sum of squares of the priors; arguments as of :meth:`beyond_priors`."""
        total = 0.0
        for term in self.terms:
            here, off = values[term.places], values[term.places] - term.mean
            total += float(off @ term.information @ off - np.sum((here / term.taken_back(sizes)) ** 2))
        return total

    def beyond_priors(self, kept: np.ndarray, values: np.ndarray, sizes: np.ndarray) -> Form:
        """Return what they add to the priors of some parameters.

        Args:
            kept: shape (K,), their places, ascending.
            values: shape (P,), present values.
            sizes: shape (P,), standard deviations of the priors.
        """
        information, slope = np.zeros((len(kept), len(kept))), np.zeros(len(kept))
        for term in self.terms:
            back, here = term.taken_back(sizes), values[term.places]
            of = np.flatnonzero(np.isin(term.places, kept))
            at = np.searchsorted(kept, term.places[of])
            information[at[:, None], at] += (term.information - np.diag(back**-2.0))[of[:, None], of]
            slope[at] += (term.information @ (term.mean - here) + here / back**2)[of]
        return Form.of(information, slope)


def slope_of_contacts(station: Station) -> np.ndarray:
    r"""Return what keeps the noise of contacts from shrinking the robot: the slope of a row's log-likelihood, shape (P,).

    Contacts read joints q at which residuals r(q) are small. The smaller the robot, the smaller they are, whatever it is:
    the likelihood of q is the density of r times :math:`\sqrt{\det (J J^T)}` with J = dr/dq, which grows with the scale s
    of the robot as :math:`s^m` for m components of r. Without this :math:`m \ln s` of each row N rows shrink a robot whose
    scale is known to sigma by about :math:`m N \sigma^2`. The scale is that of the lengths L on the path,
    :math:`\ln s = L^T \delta / L^T L` for deviations delta of theirs.
    """
    chain, nothing = station.model.chain, np.zeros(len(station.parameters))
    if not station.sensor.is_of_joints:
        return nothing
    passed = {name for name, on in zip(chain.robot.joint_names, chain.on_path, strict=True) if on}
    lengths = np.array([p.nominal if p.symbol in LENGTHS and p.element in passed else 0.0 for p in station.parameters])
    return int(station.block_sizes.sum()) * lengths / (lengths @ lengths) if lengths.any() else nothing


def _scale_of_contacts(problem: Problem) -> Earlier | None:
    """Return :func:`slope_of_contacts` of all rows as squares about a point so far away that they are straight."""
    slope = np.zeros(len(problem.parameters))
    for station, places in zip(problem.stations, problem.places, strict=True):
        slope[places] += len(station) * slope_of_contacts(station)
    at = np.flatnonzero(slope)
    if not len(at):
        return None
    along = slope[at] / np.linalg.norm(slope)
    return Earlier(tuple(problem.parameters[k].name for k in at), slope[at], np.outer(along, along), None, at)


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
        if self.earlier is None and (scale := _scale_of_contacts(self)) is not None:
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
        first, *others = ([e for e in s.model.effects if not isinstance(e, BaseFrame | ToolFrame)] for s in self.stations)
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
            frames = [effect for effect in station.model.effects if isinstance(effect, BaseFrame | ToolFrame)]
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
