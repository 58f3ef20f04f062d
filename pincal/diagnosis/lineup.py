"""Possible changes of a calibrated robot, all in one wide model over the rows of a station.

Parameters may have moved, alone or together, and effects may be new.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pincal.calibration.change_numbers import CHANGES
from pincal.calibration.fit_evidence import KeptEvidence
from pincal.calibration.fitted_robot import FittedRobot
from pincal.diagnosis.row_evidence import Known, RowEvidence, prior_root, rows_in_noise
from pincal.discover.discovery_file import EffectName
from pincal.discover.levers import compliances_of
from pincal.identify.quadratic import ROUNDING, Quadratic, root_of_inverse
from pincal.identify.station import Station
from pincal.identify.stop_scatter import SharedNoise
from pincal.model.catalogue.candidates import elasticity, testable
from pincal.model.conditions import Conditions, PoseSet, varies
from pincal.model.effect import Curve, Effect, Family
from pincal.model.effects import Compliance
from pincal.model.model import Model
from pincal.model.sizes import largest_basis
from pincal.parameters import Parameter, estimate_of
from pincal.recorded import SURROUNDINGS
from pincal.thresholds import Count, Scale


@dataclass(frozen=True)
class PossibleChange:
    """A possible change of the robot.

    Attributes:
        name: of the effect.
        joint: on which it acts; None for the whole arm.
        parameters: names of the parameters that it moves.
        effect: the new effect; None where parameters of the model moved.
        source: the joint that drives this one, where an effect has one.
        nameless: the effect itself, new or of the model, where the catalogue has no name for it.
        is_usual: whether it is the most common change, of a joint offset.
        parts: whether it is composed of other changes, so that it is not listed among what is
            excluded.
        belief: shape (K, K), prior information on the change of its K parameters where these are
            correlated, as those of a smooth curve are; else None.
    """

    name: str
    joint: str | None
    parameters: tuple[str, ...]
    effect: Effect | None = None
    source: str | None = None
    nameless: Effect | None = None
    parts: bool = False
    is_usual: bool = False
    belief: np.ndarray | None = field(default=None, repr=False, compare=False)

    @property
    def label(self) -> EffectName:
        """Its name in reports and in ``diagnosis.json``; of an effect without a name also what it
        follows, where it acts and its shape, by which those of one joint differ.
        """
        if self.nameless is not None:
            return EffectName.of(self.nameless)
        return EffectName(effect=self.name, joint=self.joint, source=self.source)


def changes_of(
    model: Model, situation: PoseSet
) -> tuple[tuple[PossibleChange, ...], tuple[Effect, ...]]:
    """Return the possible changes of a calibrated robot that these poses can show, those of its
    parameters first.

    Returns:
        The changes, and effects that new rows may show without any change: of the station, and of
        the whole arm with temperature or time.
    """
    changes = list(_of_parameters(model))
    surroundings = []
    for effect in _catalogue(model, situation):
        at = effect.locus
        if effect.scope == "station" or (at.joint is None and at.follows in SURROUNDINGS):
            surroundings.append(effect)
        else:
            name, joint, source = effect.heading
            parameters = tuple(parameter.name for parameter in effect.parameters(model.chain))
            nameless = effect if effect.is_nameless else None
            changes.append(PossibleChange(name, joint, parameters, effect, source, nameless))
    return tuple(changes), tuple(surroundings)


def _catalogue(model: Model, situation: PoseSet) -> Iterator[Effect]:
    """Yield the compliances of single joints, and other effects that these poses can show, which
    the model lacks.
    """
    known = {parameter.name for parameter in model.parameters}
    present = {effect.identity for effect in model.effects}
    kinds = [type(effect) for effect in elasticity(situation) if isinstance(effect, Compliance)]
    for kind in kinds:
        for joint in situation.revolute:
            effect = kind(joints=(joint,))
            if known.isdisjoint(p.name for p in effect.parameters(model.chain)):
                yield effect
    for candidate in testable(situation):
        for form in candidate.forms:
            size = form.resolution if isinstance(form, Curve) else 1
            is_new = not form.is_constant and form.identity not in present
            if is_new and size * CHANGES.rows_each <= len(situation.conditions):
                yield form


def _of_parameters(model: Model) -> Iterator[PossibleChange]:
    """Yield each parameter of the robot alone, and groups: an effect's parameters of a joint, a
    bent link's.
    """
    for effect in model.effects:
        if effect.scope == "station" or effect.is_constant:
            continue
        single = effect.family in (Family.GEOMETRY, Family.ELASTICITY)
        by_element: dict[str, list[Parameter]] = {}
        for parameter in effect.parameters(model.chain):
            by_element.setdefault(parameter.element, []).append(parameter)
        for element, members in by_element.items():
            joint = element if element in model.chain.robot.joint_names else effect.locus.joint
            source = effect.heading[2]
            names = tuple(parameter.name for parameter in members)
            if single:
                usual = effect.locus.acts_on == "drive"
                yield from (
                    PossibleChange(effect.name, joint, (name,), source=source, is_usual=usual)
                    for name in names
                )
            if len(names) > 1 or not single:
                yield PossibleChange(
                    effect.name,
                    joint,
                    names,
                    source=source,
                    nameless=effect if effect.is_nameless else None,
                    parts=single,
                    belief=effect.belief(members),
                )
    yield from _bent_links(model)


def _bent_links(model: Model) -> Iterator[PossibleChange]:
    """Yield, for each link, all constants of the geometry between its joint and the next."""
    chain = model.chain
    geometry = [e for e in model.effects if e.family is Family.GEOMETRY]
    if not geometry:
        return
    name = next(
        (effect.name for effect in geometry if effect.locus.acts_on == "link"), geometry[0].name
    )
    nothing = Conditions.at(np.zeros((0, chain.robot.n_joints)))
    places = [
        (effect.parameters(chain)[term.parameter].name, term.coordinate)
        for effect in geometry
        for term in effect.terms(chain, nothing, None)
    ]
    for i, joint in enumerate(chain.robot.joint_names):
        if (following := chain.robot.next_joint(i)) is None:
            continue
        # Rotations about and displacements along the axis of a joint commute with its motion.
        here = {chain.joint(i, symbol) for symbol in ("theta", "d", "a", "alpha")}
        there = {chain.joint(following, symbol) for symbol in ("s_x", "s_y", "theta", "d")}
        members = tuple(name for name, coordinate in places if coordinate in here | there)
        yield PossibleChange(name, joint, members, parts=True)


# Gauss-Newton steps at most, and halvings of a step that increased the cost.
_MOST_STEPS: Count = 30
_HALVINGS: Count = 6
# Square of the last step, in units of the noise.
_SHORT: Scale = 1e-6


@dataclass(frozen=True)
class Refitted:
    """Values of a robot that has changed: the changes re-estimated, the rest within its
    uncertainty.

    Attributes:
        values: shape (P,), most probable values.
        places: shape (p,), indices of parameters that may have moved.
        covariance: shape (p, p), of these.
        changes: shape (F,), of the unconstrained parameters.
        of_changes: shape (F, F), covariance of the changes.
    """

    values: np.ndarray
    places: np.ndarray
    covariance: np.ndarray
    changes: np.ndarray
    of_changes: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations of the changes, shape (F,)."""
        return np.sqrt(np.diag(self.of_changes))


@dataclass(frozen=True)
class ChangeHypotheses:
    """The rows of a new station, what is known of the robot, and its possible changes.

    Values are those of the wide model: of the calibrated robot, masses, all tested effects, and the
    sensor.

    Attributes:
        robot: as calibrated, at the new station.
        known: what is known of it from its calibration.
        station: the rows that count, under the wide model.
        changes: the possible changes.
        places: for each change, the indices of its parameters.
        own: indices of the station's own parameters.
        surroundings: indices of parameters of effects of the instrument and the environment, with a
            prior of their size.
        start: shape (P,), the robot as calibrated.
        shared: noise that rows share: of the arrival in a stop, and of a pose; default: none.
    """

    robot: FittedRobot
    known: Known
    station: Station
    changes: tuple[PossibleChange, ...]
    places: tuple[np.ndarray, ...]
    own: np.ndarray
    surroundings: np.ndarray
    start: np.ndarray
    shared: SharedNoise | None = None

    @classmethod
    def of(
        cls,
        robot: FittedRobot,
        station: Station,
        known: Known,
        shared: SharedNoise | None = None,
    ) -> ChangeHypotheses:
        """Return the hypotheses for a robot that was located at the station of new rows."""
        model = station.model
        of_model, of_sensor = station.split(robot.values)
        changes, others = changes_of(model, _situation(station, of_model))
        added = [change.effect for change in changes if change.effect is not None]
        masses = [] if known.masses is None else [known.masses]
        wide = model.with_effects([*model.effects, *masses, *known.unmodelled, *others, *added])
        n = len(model.effects) + len(masses) + len(known.unmodelled)
        surroundings = np.concatenate(
            [np.zeros(0, int), *map(_span, wide.spans[n : n + len(others)])]
        )
        own = np.flatnonzero(station.split(station.is_own)[0])
        own = np.append(own, wide.n_parameters + np.flatnonzero(~station.sensor.fixed))
        nothing = np.zeros(wide.n_parameters - model.n_parameters)
        start = np.concatenate([of_model, nothing, of_sensor])
        start[[wide.index(name) for name in known.names]] = known.values
        return cls(
            robot,
            known,
            station.with_model(wide),
            changes,
            _places(model, changes, wide.spans[n + len(others) :]),
            own,
            surroundings,
            start,
            shared,
        )

    def without(self, row: int | np.ndarray) -> ChangeHypotheses:
        """Return the hypotheses without one or some rows."""
        kept = ~np.isin(np.arange(len(self.station)), row)
        shared = None if self.shared is None else self.shared.select(kept)
        return replace(self, station=self.station.select(kept), shared=shared)

    def as_certain(self) -> ChangeHypotheses:
        """Return the hypotheses on a robot that is exactly as calibrated but for its changes."""
        known = replace(
            self.known,
            root=self.known.root[:, :0],
            masses=None,
            taken_up=self.known.taken_up[:, :0],
        )
        return replace(self, known=known, surroundings=self.surroundings[:0])

    def free(self, happened: Sequence[int]) -> np.ndarray:
        """Return the indices of the unconstrained parameters, given some changes."""
        return np.unique(np.concatenate([self.own, *(self.places[i] for i in happened)])).astype(
            int
        )

    def release(self, happened: Sequence[int], start: np.ndarray) -> np.ndarray:
        """Return the values with some changes estimated and the rest of the robot held as
        calibrated, shape (P,).
        """
        return self.reidentify(happened, start, is_certain=True).values

    def reidentified(self, happened: Sequence[int], found: Refitted) -> FittedRobot:
        """Return the re-identified robot at the new station, with the changes and nothing else of
        the wide model.
        """
        model = self.robot.model
        n = len(self.robot.model.effects) + (self.known.masses is not None)
        spans = self.station.model.spans[n : n + len(self.known.unmodelled)]
        added = [
            (effect, _span(span)) for effect, span in zip(self.known.unmodelled, spans, strict=True)
        ]
        added += [
            (effect, self.places[i])
            for i in happened
            if (effect := self.changes[i].effect) is not None
        ]
        own = np.arange(self.station.model.n_parameters, len(found.values))
        places = np.concatenate([np.arange(model.n_parameters), *(at for _, at in added), own])
        whole = np.zeros((len(found.values),) * 2)
        whole[np.ix_(found.places, found.places)] = found.covariance
        station = self.station.with_model(
            model.with_effects([*model.effects, *(effect for effect, _ in added)])
        )
        estimate = estimate_of(
            station.parameters, found.values[places], whole[np.ix_(places, places)]
        )
        evidence = KeptEvidence(information=self.robot.information)
        return replace(self.robot, evidence=evidence).with_model(station.model, estimate)

    def reidentify(
        self, happened: Sequence[int], start: np.ndarray, *, is_certain: bool = False
    ) -> Refitted:
        """Return the most probable values: the changes unconstrained, the rest within its
        uncertainty, or held if certain.

        A parameter that is known and free is the sum of its calibrated value and a change. There is
        no robust weighting.
        """
        return _Refit.of(self, happened, is_certain=is_certain).run(start)

    def weigh(self, values: np.ndarray, happened: Sequence[int]) -> RowEvidence:
        """Return the evidence of the rows on everything else, given some changes, linearised about
        values, shape (P,).

        These are as calibrated, except for the changes, which are unconstrained, or have their
        joint prior if there is one.
        """
        A, r, G, S, rank = self._projected(values, happened, np.arange(len(values)))
        g = A @ r
        across = G @ S.T
        along = S @ g
        form = Quadratic(
            names=tuple(parameter.name for parameter in self.station.parameters),
            H=G - across @ across.T,
            g=g - across @ along,
            square=float(r @ r - along @ along),
            degrees=len(r) - rank,
            whole=np.diag(G).copy(),
        )
        return RowEvidence(form, len(self.station), A, S, r - (along @ S) @ A, self.shared)

    def square_given(self, values: np.ndarray, happened: Sequence[int]) -> tuple[float, int]:
        """Return the square and the degrees of freedom of :meth:`weigh`, in a fraction
        of the time.
        """
        known = np.flatnonzero(prior_root(self.station, self.known, self.surroundings).any(axis=0))
        A, r, _, S, rank = self._projected(values, happened, np.union1d(known, self.free(happened)))
        return float(r @ r - np.sum((S @ (A @ r)) ** 2)), len(r) - rank

    def _projected(
        self, values: np.ndarray, happened: Sequence[int], places: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
        """Return Jacobian A by p parameters, shape (p, R), residuals, shape (R,), A A^T, S, shape
        (q, p), and a rank.

        Q = S A is projected out: V^-1 = 1 - Q^T Q. The rank is of the unconstrained parameters;
        other parameters are known.
        """
        A, r = rows_in_noise(self.station, values, self.robot.sigma, places, shared=self.shared)
        free = np.searchsorted(
            places, self.free([i for i in happened if self.changes[i].belief is None])
        )
        uncertain = [prior_root(self.station, self.known, self.surroundings)[:, places]]
        for of_change, belief in self._redrawn(happened):
            at = np.searchsorted(places, of_change)
            root = root_of_inverse(belief, np.diag(belief), ROUNDING)
            uncertain.append(np.zeros((root.shape[1], len(places))))
            uncertain[-1][:, at] = root.T
            r = r + (values - self.start)[of_change] @ A[at]
        # Uncertain directions of unit variance, then the unconstrained ones.
        nuisance = np.vstack([*uncertain, np.eye(len(places))[free]])
        G = A @ A.T
        H = nuisance @ G @ nuisance.T
        H.flat[: (len(H) + 1) * (len(H) - len(free)) : len(H) + 1] += 1.0
        S = root_of_inverse(H, np.diag(H), ROUNDING).T @ nuisance
        return (
            A,
            r,
            G,
            S,
            root_of_inverse(G[np.ix_(free, free)], np.diag(G)[free], ROUNDING).shape[1],
        )

    def _redrawn(self, happened: Sequence[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the indices of parameters that changed together, and their joint prior."""
        for i in happened:
            if (belief := self.changes[i].belief) is not None:
                yield self.places[i], belief

    def motion(self, values: np.ndarray) -> np.ndarray:
        """Return how the target moves with each parameter of the wide model, in the instrument's
        axes, shape (N, 3, P).
        """
        model = self.station.model
        return model.linearise(model.own(values), self.station.conditions)[1]

    @cached_property
    def sizes(self) -> np.ndarray:
        """Standard deviations of the priors of changes, shape (P,): typical errors of
        such robots.
        """
        largest = np.ones(len(self.start))
        self.station.split(largest)[0][:] = largest_basis(
            self.station.model, self.station.conditions
        )[0]
        return np.array([parameter.size for parameter in self.station.parameters]) / largest


def _situation(station: Station, of_model: np.ndarray) -> PoseSet:
    """Return the poses of a station, with the parameters of its model, shape (P,).

    A single load counts as varying: the calibration includes the unloaded robot.
    """
    conditions = station.conditions
    if conditions.payload.any() and not varies(conditions.payload):
        twice = conditions.select(np.repeat(np.arange(len(conditions)), 2))
        is_loaded = np.arange(len(twice)) % 2
        conditions = replace(twice, payload=np.where(is_loaded, twice.payload, 0.0))
    compliances = tuple(compliances_of(station.model, of_model).tolist())
    return PoseSet(station.model.chain, conditions, compliances)


def _places(
    model: Model, changes: Sequence[PossibleChange], spans: Sequence[slice]
) -> tuple[np.ndarray, ...]:
    """Return the indices of the parameters of each change; ``spans`` are those of new effects."""
    index = {name: i for i, name in enumerate(model.names)}
    new = iter(spans)
    return tuple(
        np.array([index[name] for name in change.parameters], int)
        if change.effect is None
        else _span(next(new))
        for change in changes
    )


@dataclass(frozen=True, eq=False)
class _Point:
    """The unknowns of a refit, and the equations there.

    Attributes:
        unknown: shape (u,).
        values: of all parameters, shape (P,).
        H: shape (u, u), information of rows and priors.
        g: shape (u,), gradient of the rows.
        cost: square of residuals and priors.
    """

    unknown: np.ndarray
    values: np.ndarray
    H: np.ndarray
    g: np.ndarray
    cost: float

    @cached_property
    def root(self) -> np.ndarray:
        """Root of the covariance of the unknowns, shape (u, r)."""
        return root_of_inverse(self.H, np.diag(self.H), ROUNDING)


@dataclass(frozen=True, eq=False)
class _Refit:
    """A Gauss-Newton search over changes, and over the rest of the robot within its uncertainty.

    Attributes:
        lineup: the rows.
        places: shape (p,), indices of parameters that may move.
        free: shape (F,), indices of the unconstrained ones.
        W: shape (p, u), the parameters by u unknowns that are uncorrelated beforehand: directions
            of the uncertainty, then changes.
        precision: shape (u, u), of the unknowns beforehand.
    """

    lineup: ChangeHypotheses
    places: np.ndarray
    free: np.ndarray
    W: np.ndarray
    precision: np.ndarray

    @classmethod
    def of(cls, lineup: ChangeHypotheses, happened: Sequence[int], *, is_certain: bool) -> _Refit:
        """Return the search for some changes, by index; all else is held if certain."""
        root = np.zeros((0, 0)) if is_certain else lineup.known.root
        names = () if is_certain else lineup.known.names
        free = lineup.free(happened)
        n = root.shape[1]
        known = np.array([lineup.station.model.index(name) for name in names], int)
        places = np.union1d(known, free).astype(int)
        W = np.zeros((len(places), n + len(free)))
        W[np.searchsorted(places, known), :n] = root
        W[np.searchsorted(places, free), np.arange(n, W.shape[1])] = 1.0
        precision = np.diag(np.append(np.ones(n), lineup.sizes[free] ** -2.0))
        for of_change, belief in lineup._redrawn(happened):
            at = n + np.searchsorted(free, of_change)
            precision[np.ix_(at, at)] = belief
        return cls(lineup, places, free, W, precision)

    @property
    def _n(self) -> int:
        """Number of the unknowns that are no changes."""
        return int(self.W.shape[1]) - len(self.free)

    def run(self, start: np.ndarray) -> Refitted:
        """Return the most probable values, searched from some values, shape (P,)."""
        changes = (start - self.lineup.start)[self.free]
        here = self._at(np.append(np.zeros(self._n), changes))
        for _ in range(_MOST_STEPS):
            better = self._better(here)
            if better is None:
                break
            step, here = better
            if step @ here.H @ step < _SHORT:
                break
        spread = self.W @ here.root
        of_changes = here.root[self._n :] @ here.root[self._n :].T
        changes = here.unknown[self._n :]
        return Refitted(here.values, self.places, spread @ spread.T, changes, of_changes)

    def _at(self, unknown: np.ndarray) -> _Point:
        """Return the equations at some unknowns, shape (u,)."""
        lineup = self.lineup
        W = self.W
        values = lineup.start.copy()
        values[self.places] += W @ unknown
        A, r = rows_in_noise(
            lineup.station, values, lineup.robot.sigma, self.places, shared=lineup.shared
        )
        H = W.T @ (A @ A.T) @ W + self.precision
        cost = float(r @ r + unknown @ self.precision @ unknown)
        return _Point(unknown, values, H, W.T @ (A @ r), cost)

    def _better(self, here: _Point) -> tuple[np.ndarray, _Point] | None:
        """Return a step, halved until the cost does not grow, and the point after it; None if it
        does.
        """
        step = here.root @ (here.root.T @ (here.g - self.precision @ here.unknown))
        for _ in range(_HALVINGS):
            there = self._at(here.unknown + step)
            if there.cost <= here.cost * (1.0 + 1e-9) + _SHORT:
                return step, there
            step = 0.5 * step
        return None


def _span(span: slice) -> np.ndarray:
    return np.arange(span.start, span.stop)
