"""All changes side by side: the rows of a station under a model that has every effect that is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pincal.calibration.calibrated import CalibratedModel, estimate_of
from pincal.diagnosis.changes import Change, beside_changes, changes_of
from pincal.diagnosis.evidence import Evidence, Known, Redrawn, weigh
from pincal.diagnosis.mend import Posterior, Prior, most_probable
from pincal.discover.nuisance import compliances_of
from pincal.identify.station import Station
from pincal.model.conditions import Conditions, Situation, varies
from pincal.model.sizes import largest_basis


@dataclass(frozen=True)
class Lineup:
    """The rows of a new station, what is known of the robot, and what may have happened to it.

    Values here are those of the wide model: the calibrated robot's, masses and all effects that are asked for, and the
    sensor's own.

    Attributes:
        robot: as it was, at the new station.
        known: what its calibration knows of it.
        station: the rows that count, under the wide model.
        changes: what may have happened.
        places: for each change, where its parameters stand.
        own: where the station's own parameters stand.
        beside: where parameters stand of what follows instrument and weather, known to about their size.
        start: shape (P,), the robot as it was.
    """

    robot: CalibratedModel
    known: Known
    station: Station
    changes: tuple[Change, ...]
    places: tuple[np.ndarray, ...]
    own: np.ndarray
    beside: np.ndarray
    start: np.ndarray

    @classmethod
    def of(cls, robot: CalibratedModel, station: Station, known: Known) -> Lineup:
        """Line up all that may have happened to a robot that was placed at the station of new rows."""
        model = station.model
        of_model, of_sensor = station.split(robot.values)
        compliances = tuple(compliances_of(model, of_model).tolist())
        situation = Situation(model.chain, _loaded_and_not(station.conditions), compliances)
        changes, others = changes_of(model, situation), beside_changes(model, situation)
        added = [change.effect for change in changes if change.effect is not None]
        masses = [] if known.masses is None else [known.masses]
        wide = model.with_effects([*model.effects, *masses, *known.left, *others, *added])
        n = len(model.effects) + len(masses) + len(known.left)
        beside = np.concatenate([np.zeros(0, int), *map(_span, wide.spans[n : n + len(others)])])
        spans = iter(wide.spans[n + len(others) :])
        places = [_places(change, model.names) if change.effect is None else _span(next(spans)) for change in changes]
        own = np.flatnonzero(station.split(station.is_own)[0])
        own = np.append(own, wide.n_parameters + np.flatnonzero(~station.sensor.fixed))
        nothing = np.zeros(wide.n_parameters - model.n_parameters)
        start = np.concatenate([of_model, nothing, of_sensor])
        start[[wide.index(name) for name in known.names]] = known.values
        return cls(robot, known, station.with_model(wide), changes, tuple(places), own, beside, start)

    def without(self, row: int | np.ndarray) -> Lineup:
        """Return the same without a row, or without some."""
        kept = ~np.isin(np.arange(len(self.station)), row)
        return replace(self, station=self.station.select(kept))

    def free(self, happened: Sequence[int]) -> np.ndarray:
        """Return the places of what is anything once some changes have happened."""
        return np.unique(np.concatenate([self.own, *(self.places[i] for i in happened)])).astype(int)

    def release(self, happened: Sequence[int], start: np.ndarray) -> np.ndarray:
        """Return the values with some changes found and everything else of the robot as it was, shape (P,)."""
        return self._posterior(happened, start, np.zeros(0, int), np.zeros((0, 0))).values

    def mend(self, happened: Sequence[int], start: np.ndarray) -> Posterior:
        """Return the same with the rest of the robot moved as far as its uncertainty lets it."""
        return self._posterior(happened, start, self._known, self.known.root)

    @cached_property
    def _known(self) -> np.ndarray:
        """Where the parameters stand that are known, shape (K,)."""
        model = self.station.model
        return np.array([model.index(name) for name in self.known.names], int)

    def mended(self, happened: Sequence[int], found: Posterior) -> CalibratedModel:
        """Return the robot that was found at the new station, with what changed and nothing else of the wide model."""
        model, n = self.robot.model, len(self.robot.model.effects) + (self.known.masses is not None)
        spans = self.station.model.spans[n : n + len(self.known.left)]
        added = [(effect, _span(span)) for effect, span in zip(self.known.left, spans, strict=True)]
        added += [(effect, self.places[i]) for i in happened if (effect := self.changes[i].effect) is not None]
        own = np.arange(self.station.model.n_parameters, len(found.values))
        places = np.concatenate([np.arange(model.n_parameters), *(at for _, at in added), own])
        whole = np.zeros((len(found.values),) * 2)
        whole[np.ix_(found.places, found.places)] = found.covariance
        station = self.station.with_model(model.with_effects([*model.effects, *(effect for effect, _ in added)]))
        estimate = estimate_of(station.parameters, found.values[places], whole[np.ix_(places, places)])
        return replace(self.robot, model=station.model, estimate=estimate, left=None)

    def _posterior(self, happened: Sequence[int], start: np.ndarray, known: np.ndarray, root: np.ndarray) -> Posterior:
        free, begun = self.free(happened), self.start.copy()
        begun[free] = start[free]
        precision = np.diag(self.sizes[free] ** -2.0)
        for places, belief in self._redrawn(happened):
            at = np.searchsorted(free, places)
            precision[np.ix_(at, at)] = belief
        prior = Prior(known, root, free, precision)
        return most_probable(self.station, begun, self.start, prior, self.robot.sigma)

    def weigh(self, values: np.ndarray, happened: Sequence[int]) -> Evidence:
        """Return what the rows say of everything else, once some changes have happened."""
        redrawn = [Redrawn(places, belief, (values - self.start)[places]) for places, belief in self._redrawn(happened)]
        others = [i for i in happened if self.changes[i].belief is None]
        return weigh(
            self.station,
            values,
            self.known,
            self.free(others),
            beside=self.beside,
            sigma=self.robot.sigma,
            redrawn=redrawn,
        )

    def _redrawn(self, happened: Sequence[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the places of parameters that changed together, and what is believed of them."""
        for i in happened:
            if (belief := self.changes[i].belief) is not None:
                yield self.places[i], belief

    def motion(self, values: np.ndarray) -> np.ndarray:
        """Return how the target moves with each parameter of the wide model, in the instrument's axes, shape (N, 3, P)."""
        model = self.station.model
        return model.linearise(model.own(values), self.station.conditions)[1]

    @cached_property
    def sizes(self) -> np.ndarray:
        """How large a change is that the rows do not tell, shape (P,): as errors of such robots are."""
        largest = np.ones(len(self.start))
        self.station.split(largest)[0][:] = largest_basis(self.station.model, self.station.conditions)[0]
        return np.array([parameter.size for parameter in self.station.parameters]) / largest


def _places(change: Change, names: tuple[str, ...]) -> np.ndarray:
    return np.array([names.index(name) for name in change.parameters], int)


def _span(span: slice) -> np.ndarray:
    return np.arange(span.start, span.stop)


def _loaded_and_not(conditions: Conditions) -> Conditions:
    """Return conditions in which the load varies if there is any: the calibration knows the robot without it."""
    if not conditions.payload.any() or varies(conditions.payload):
        return conditions
    twice = conditions.select(np.repeat(np.arange(len(conditions)), 2))
    return replace(twice, payload=np.where(np.arange(len(twice)) % 2, twice.payload, 0.0))
