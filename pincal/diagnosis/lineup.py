"""All changes side by side: the rows of a station under a model that has every effect that is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.diagnosis.changes import PossibleChange, additional_changes, changes_of
from pincal.diagnosis.row_evidence import Known, ReestimatedCurves, RowEvidence, rows_in_noise, weighted_rows
from pincal.discover.levers import compliances_of
from pincal.identify.quadratic import ROUNDING, root_of_inverse
from pincal.identify.station import Station
from pincal.model.conditions import Conditions, PoseSet, varies
from pincal.model.sizes import largest_basis
from pincal.parameters import estimate_of

# Gauss-Newton steps at most, and halvings of one that made things worse.
_MOST_STEPS, _HALVINGS = 30, 6
# A step of this square, in units of the noise, is the last.
_SHORT = 1e-6


@dataclass(frozen=True)
class Refitted:
    """Values of a robot that has changed: what changed is found anew, the rest moves as far as its uncertainty lets it.

    Attributes:
        values: shape (P,), most probable ones.
        places: shape (p,), places of parameters that may have moved.
        covariance: shape (p, p), of these.
        changes: shape (F,), of the parameters that are anything.
        sigma: shape (F,), standard deviations of the changes.
    """

    values: np.ndarray
    places: np.ndarray
    covariance: np.ndarray
    changes: np.ndarray
    sigma: np.ndarray


@dataclass(frozen=True)
class ChangeHypotheses:
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
    changes: tuple[PossibleChange, ...]
    places: tuple[np.ndarray, ...]
    own: np.ndarray
    beside: np.ndarray
    start: np.ndarray

    @classmethod
    def of(cls, robot: CalibratedModel, station: Station, known: Known) -> ChangeHypotheses:
        """Line up all that may have happened to a robot that was placed at the station of new rows."""
        model = station.model
        of_model, of_sensor = station.split(robot.values)
        compliances = tuple(compliances_of(model, of_model).tolist())
        situation = PoseSet(model.chain, _loaded_and_not(station.conditions), compliances)
        changes, others = changes_of(model, situation), additional_changes(model, situation)
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

    def without(self, row: int | np.ndarray) -> ChangeHypotheses:
        """Return the same without a row, or without some."""
        kept = ~np.isin(np.arange(len(self.station)), row)
        return replace(self, station=self.station.select(kept))

    def free(self, happened: Sequence[int]) -> np.ndarray:
        """Return the places of what is anything once some changes have happened."""
        return np.unique(np.concatenate([self.own, *(self.places[i] for i in happened)])).astype(int)

    def release(self, happened: Sequence[int], start: np.ndarray) -> np.ndarray:
        """Return the values with some changes found and everything else of the robot as it was, shape (P,)."""
        return self._refitted(happened, start, np.zeros(0, int), np.zeros((0, 0))).values

    def reidentify(self, happened: Sequence[int], start: np.ndarray) -> Refitted:
        """Return the same with the rest of the robot moved as far as its uncertainty lets it."""
        return self._refitted(happened, start, self._known, self.known.root)

    @cached_property
    def _known(self) -> np.ndarray:
        """Where the parameters stand that are known, shape (K,)."""
        model = self.station.model
        return np.array([model.index(name) for name in self.known.names], int)

    def reidentified(self, happened: Sequence[int], found: Refitted) -> CalibratedModel:
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
        return replace(self.robot, model=station.model, estimate=estimate, left_by=None)

    def _refitted(self, happened: Sequence[int], start: np.ndarray, known: np.ndarray, root: np.ndarray) -> Refitted:
        """Return the most probable values: those that changed anywhere, those known, shape (K,), by a root of covariance.

        A parameter that is known and free is the sum of what it was and a change. The noise is taken as it is: what is far
        off pulls as strongly as it does.
        """
        free, n = self.free(happened), root.shape[1]
        places = np.union1d(known, free).astype(int)
        # From one vector of uncorrelated unknowns to the parameters.
        W = np.zeros((len(places), n + len(free)))
        W[np.searchsorted(places, known), :n] = root
        W[np.searchsorted(places, free), np.arange(n, W.shape[1])] = 1.0
        precision = np.diag(np.append(np.ones(n), self.sizes[free] ** -2.0))
        for of_change, belief in self._redrawn(happened):
            at = n + np.searchsorted(free, of_change)
            precision[np.ix_(at, at)] = belief
        unknown = np.append(np.zeros(n), (start - self.start)[free])

        def at_values(unknown: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
            values = self.start.copy()
            values[places] += W @ unknown
            A, r = rows_in_noise(self.station, values, self.robot.sigma, places)
            return values, W.T @ A, r, float(r @ r + unknown @ precision @ unknown)

        values, N, r, cost = at_values(unknown)
        for _ in range(_MOST_STEPS):
            H = N @ N.T + precision
            uncertain = root_of_inverse(H, np.diag(H), ROUNDING)
            step = uncertain @ (uncertain.T @ (N @ r - precision @ unknown))
            for _ in range(_HALVINGS):
                there = at_values(unknown + step)
                if there[3] <= cost * (1.0 + 1e-9) + _SHORT:
                    break
                step = 0.5 * step
            else:
                break
            unknown, (values, N, r, cost) = unknown + step, there
            if step @ H @ step < _SHORT:
                break
        H = N @ N.T + precision
        uncertain = root_of_inverse(H, np.diag(H), ROUNDING)
        spread = W @ uncertain
        return Refitted(values, places, spread @ spread.T, unknown[n:], np.linalg.norm(uncertain[n:], axis=1))

    def weigh(self, values: np.ndarray, happened: Sequence[int]) -> RowEvidence:
        """Return what the rows say of everything else, once some changes have happened."""
        redrawn = [
            ReestimatedCurves(places, belief, (values - self.start)[places]) for places, belief in self._redrawn(happened)
        ]
        others = [i for i in happened if self.changes[i].belief is None]
        return weighted_rows(
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


def _places(change: PossibleChange, names: tuple[str, ...]) -> np.ndarray:
    return np.array([names.index(name) for name in change.parameters], int)


def _span(span: slice) -> np.ndarray:
    return np.arange(span.start, span.stop)


def _loaded_and_not(conditions: Conditions) -> Conditions:
    """Return conditions in which the load varies if there is any: the calibration knows the robot without it."""
    if not conditions.payload.any() or varies(conditions.payload):
        return conditions
    twice = conditions.select(np.repeat(np.arange(len(conditions)), 2))
    return replace(twice, payload=np.where(np.arange(len(twice)) % 2, twice.payload, 0.0))
