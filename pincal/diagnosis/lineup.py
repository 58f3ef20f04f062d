"""Possible changes of a calibrated robot, all in one wide model over the rows of a station.

Parameters may have moved, alone or together, and effects may be new.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.diagnosis.row_evidence import Known, RowEvidence, prior_root, rows_in_noise
from pincal.discover.levers import compliances_of
from pincal.identify.criteria import CHANGES
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


@dataclass(frozen=True)
class PossibleChange:
    """A possible change of the robot.

    Attributes:
        name: of the effect.
        joint: on which it acts; None for the whole arm.
        parameters: names of the parameters that it moves.
        effect: the new effect; None where parameters of the model moved.
        source: the joint that drives this one, where an effect has one.
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
    parts: bool = False
    is_usual: bool = False
    belief: np.ndarray | None = field(default=None, repr=False, compare=False)

    @property
    def heading(self) -> tuple[str, str | None, str | None]:
        """Its name in reports."""
        return self.name, self.joint, self.source

    def describe(self) -> dict[str, str | None]:
        """Return its name in the terms of ``diagnosis.json``."""
        return {"effect": self.name, "joint": self.joint} | (
            {} if self.source is None else {"source": self.source}
        )


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
            changes.append(PossibleChange(name, joint, parameters, effect, source))
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
                belief = effect.belief(members)
                yield PossibleChange(
                    effect.name, joint, names, source=source, parts=single, belief=belief
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
_MOST_STEPS = 30
_HALVINGS = 6
# Square of the last step, in units of the noise.
_SHORT = 1e-6


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

    robot: CalibratedModel
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
        robot: CalibratedModel,
        station: Station,
        known: Known,
        shared: SharedNoise | None = None,
    ) -> ChangeHypotheses:
        """Return the hypotheses for a robot that was located at the station of new rows."""
        model = station.model
        of_model, of_sensor = station.split(robot.values)
        compliances = tuple(compliances_of(model, of_model).tolist())
        conditions = station.conditions
        if conditions.payload.any() and not varies(conditions.payload):
            # A single load counts as varying: the calibration includes the unloaded robot.
            twice = conditions.select(np.repeat(np.arange(len(conditions)), 2))
            conditions = replace(
                twice, payload=np.where(np.arange(len(twice)) % 2, twice.payload, 0.0)
            )
        situation = PoseSet(model.chain, conditions, compliances)
        changes, others = changes_of(model, situation)
        added = [change.effect for change in changes if change.effect is not None]
        masses = [] if known.masses is None else [known.masses]
        wide = model.with_effects([*model.effects, *masses, *known.unmodelled, *others, *added])
        n = len(model.effects) + len(masses) + len(known.unmodelled)
        surroundings = np.concatenate(
            [np.zeros(0, int), *map(_span, wide.spans[n : n + len(others)])]
        )
        spans = iter(wide.spans[n + len(others) :])
        index = {name: i for i, name in enumerate(model.names)}
        places = [
            np.array([index[name] for name in change.parameters], int)
            if change.effect is None
            else _span(next(spans))
            for change in changes
        ]
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
            tuple(places),
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

    def reidentified(self, happened: Sequence[int], found: Refitted) -> CalibratedModel:
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
        return replace(self.robot, model=station.model, estimate=estimate, left_by=None)

    def reidentify(
        self, happened: Sequence[int], start: np.ndarray, *, is_certain: bool = False
    ) -> Refitted:
        """Return the most probable values: the changes unconstrained, the rest within its
        uncertainty, or held if certain.

        A parameter that is known and free is the sum of its calibrated value and a change. There is
        no robust weighting.
        """
        root, names = (np.zeros((0, 0)), ()) if is_certain else (self.known.root, self.known.names)
        free = self.free(happened)
        n = root.shape[1]
        known = np.array([self.station.model.index(name) for name in names], int)
        places = np.union1d(known, free).astype(int)
        # Maps a vector of uncorrelated unknowns to the parameters.
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
            A, r = rows_in_noise(self.station, values, self.robot.sigma, places, shared=self.shared)
            return (
                values,
                W.T @ (A @ A.T) @ W + precision,
                W.T @ (A @ r),
                float(r @ r + unknown @ precision @ unknown),
            )

        values, H, g, cost = at_values(unknown)
        for _ in range(_MOST_STEPS):
            uncertain = root_of_inverse(H, np.diag(H), ROUNDING)
            step = uncertain @ (uncertain.T @ (g - precision @ unknown))
            for _ in range(_HALVINGS):
                there = at_values(unknown + step)
                if there[3] <= cost * (1.0 + 1e-9) + _SHORT:
                    break
                step = 0.5 * step
            else:
                break
            unknown = unknown + step
            (values, H, g, cost) = there
            if step @ H @ step < _SHORT:
                break
        uncertain = root_of_inverse(H, np.diag(H), ROUNDING)
        spread = W @ uncertain
        return Refitted(
            values, places, spread @ spread.T, unknown[n:], uncertain[n:] @ uncertain[n:].T
        )

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


def _span(span: slice) -> np.ndarray:
    return np.arange(span.start, span.stop)
