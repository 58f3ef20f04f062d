"""The extended model: a chain and the effects on its coordinates, evaluated for all poses at once
with exact Jacobians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from pincal.model import kernels
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, inertial_moments
from pincal.model.effect import Body, Effect, Term
from pincal.model.evaluated import (
    WORTH_SHARING,
    Plain,
    RowValues,
    Thin,
    coordinates_of,
    laden,
    moved_by,
    parameters_of_each,
    plain_terms,
    stacked,
)
from pincal.model.kernel_inputs import (
    Compliances,
    Layout,
    MassTerms,
    Payload,
    Places,
    Terms,
    Values,
    Wanted,
)
from pincal.model.loops import Loops, borne_moments, closed_loops, moves_tip
from pincal.model.sparse_basis import Basis, joined_rows
from pincal.parameters import Parameter
from pincal.robot.link_path import above
from pincal.thresholds import Count, Scale

# Moments of a deflected arm differ from those of a rigid one by about 1e-3, so each round gains
# three digits; a soft arm needs more rounds, and its Jacobian more sweeps.
_EQUILIBRIUM_ROUNDS: Count = 20
_SWEEPS: Count = 12
_EQUILIBRIUM_TOLERANCE: Scale = 1e-15


@dataclass(frozen=True)
class Shared:
    """Parameters with basis functions on the same coordinate.

    Attributes:
        coordinate: index in the chain.
        families: indices of some of the parameters, shape (S,), and their basis, dense of shape (S,
            N) or sparse.
    """

    coordinate: int
    families: tuple[tuple[np.ndarray, Basis], ...]


@dataclass(frozen=True, repr=False)
class Model:
    """Model of a robot: its chain and the effects that act on it.

    Attributes:
        chain: the coordinates.
        effects: the physical causes, in any order.
        equilibrium: whether the static moments are taken on the deflected arm (at equilibrium)
            instead of the undeflected one, as in the paper.

    Example:
        >>> import numpy as np
        >>> from pincal.model.effects import ELASTIC
        >>> from pincal.robot.robot import Robot
        >>> model = Model(Chain.of(Robot.from_urdf("ur10")), ELASTIC)
        >>> model.predict(np.zeros(model.n_parameters), Conditions.at(np.zeros((1, 6)))).shape
        (1, 3, 4)
    """

    chain: Chain
    effects: tuple[Effect, ...]
    equilibrium: bool = False

    def __repr__(self) -> str:
        return (
            f"Model({self.chain.robot.name!r}: {len(self.effects)} effects, "
            f"{self.n_parameters} parameters)"
        )

    @cached_property
    def spans(self) -> tuple[slice, ...]:
        """The slice of each effect's parameters."""
        starts = np.cumsum([0, *map(len, self._parameters_of_each)]).tolist()
        return tuple(slice(a, b) for a, b in pairwise(starts))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters, effect by effect."""
        return tuple(p for of_effect in self._parameters_of_each for p in of_effect)

    @cached_property
    def _parameters_of_each(self) -> list[tuple[Parameter, ...]]:
        return parameters_of_each(self.effects, self.chain)

    @cached_property
    def bodies(self) -> tuple[Body, ...]:
        """Contributions of parameters, by index among all of them, to the masses of the links."""
        pairs = zip(self.spans, self.effects, strict=True)
        return tuple(
            b._replace(parameter=of.start + b.parameter)
            for of, e in pairs
            for b in e.bodies(self.chain)
        )

    @property
    def has_tool_orientation(self) -> bool:
        """Whether the model has the orientation of the target on the tool, not only its
        position.
        """
        tools = [effect for effect in self.effects if effect.locus.acts_on == "tool"]
        return any(
            parameter.unit == "rad"
            for effect in tools
            for parameter in effect.parameters(self.chain)
        )

    @property
    def n_parameters(self) -> int:
        """Number P of parameters."""
        return len(self.parameters)

    @cached_property
    def of_station(self) -> np.ndarray:
        """Which parameters belong to a station and not to the robot, shape (P,)."""
        scopes = [
            (effect.scope, of.stop - of.start)
            for effect, of in zip(self.effects, self.spans, strict=True)
        ]
        return np.array([scope == "station" for scope, count in scopes for _ in range(count)], bool)

    @cached_property
    def affects_tip(self) -> np.ndarray:
        """Which parameters move the tip not only by moving joints off the path that load the path,
        shape (P,).
        """
        if self.chain.on_path.all():
            return np.ones(self.n_parameters, bool)
        robot = self.chain.robot
        moves = moves_tip(self.chain)
        found = np.zeros(self.n_parameters, bool)
        anywhere = Conditions.of_everything(robot.n_joints)
        moments = np.zeros((1, 3 * robot.n_joints))
        for of, effect in zip(self.spans, self.effects, strict=True):
            for term in effect.terms(
                self.chain, anywhere, moments if effect.uses_moments else None
            ):
                found[of.start + term.parameter] |= moves[term.coordinate]
        for body in self.bodies:
            found[body.parameter] |= bool(
                self.chain.on_path[above(body.joint, robot.parents)].any()
            )
        return found

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    def own(self, vector: np.ndarray) -> np.ndarray:
        """Return the model's part of a vector over its parameters followed by a
        sensor's; a view.
        """
        return vector[: self.n_parameters]

    def index(self, name: str) -> int:
        """Return the index of a parameter in the vector of values."""
        return self.names.index(name)

    def with_effects(self, effects: Sequence[Effect]) -> Model:
        """Return the model of the same chain with other effects."""
        return replace(self, effects=tuple(effects))

    def with_chain(self, chain: Chain) -> Model:
        """Return the model of the same effects on another chain."""
        return replace(self, chain=chain)

    def predict(self, values: np.ndarray, conditions: Conditions) -> np.ndarray:
        """Return the target's poses in the instrument's frame.

        Args:
            values: shape (P,), deviations from the nominal; of S set-ups shape (P, S).
            conditions: N poses.

        Returns:
            Shape (N, 3, 4): rotation and translation [m].
        """
        state = Evaluation.at(self, values, conditions)
        return np.moveaxis(
            kernels.tip_poses(self.chain.layout, state.deformed, state.places), -1, 0
        )

    def linearise(
        self,
        values: np.ndarray,
        conditions: Conditions,
        *,
        free: np.ndarray | None = None,
        rows: int = 3,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the target's poses and their exact derivative by the parameters.

        Args:
            values: shape (P,); of S set-ups shape (P, S).
            conditions: N poses.
            free: shape (P,), which parameters get a column; default: all.
            rows: 3 for the translation of the target, 6 for translation and rotation, in the
                instrument's axes.

        Returns:
            Poses, shape (N, 3, 4), and Jacobian, shape (N, rows, number of free parameters).
        """
        state = Evaluation.at(self, values, conditions)
        columns = (
            np.arange(self.n_parameters)
            if free is None
            else np.where(free, np.cumsum(free) - 1, -1)
        )
        poses, jacobian = self._linearise(state, columns, [], rows)
        return np.moveaxis(poses, -1, 0), np.moveaxis(jacobian, -1, 0).swapaxes(1, 2)

    def linearise_shared(
        self, values: np.ndarray, conditions: Conditions, *, free: np.ndarray, rows: int = 3
    ) -> tuple[np.ndarray, np.ndarray, list[Shared]]:
        """Linearise as :meth:`linearise`, with the columns of curves on one coordinate factored
        into coordinate and basis.

        Returns:
            Poses, shape (N, 3, 4); Jacobian, shape (D + L, rows, N), of the D free parameters that
            share no coordinate, in order, and of the coordinates on which the L groups of the
            others act; these groups.
        """
        state = Evaluation.at(self, values, conditions)
        shared = state.shared(free)
        apart = free.copy()
        for group in shared:
            for parameters, _ in group.families:
                apart[parameters] = False
        columns = np.where(apart, np.cumsum(apart) - 1, -1)
        poses, jacobian = self._linearise(
            state, columns, [group.coordinate for group in shared], rows
        )
        return poses.transpose(2, 0, 1), jacobian, shared

    def _linearise(
        self, state: Evaluation, columns: np.ndarray, coordinates: list[int], rows: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return poses, shape (3, 4, N), and the Jacobian by parameters and then by coordinates,
        shape (F, rows, N).
        """
        n_columns = int(columns.max(initial=-1)) + 1
        terms = state.kernel_terms(columns, coordinates, n_columns)
        compliances = state.compliances()
        if (loops := Loops.of(self.chain)) is not None:
            at = state.layout, state.rigid, state.deformed, state.payload
            terms, compliances = loops.followed(
                *at, terms, compliances, equilibrium=self.equilibrium
            )
        wanted = Wanted(
            terms,
            compliances,
            state.mass_terms(columns),
            n_columns + len(coordinates),
            rows,
            _SWEEPS if self.equilibrium else 0,
        )
        poses, _, jacobian = kernels.evaluate(
            state.layout, state.deformed, state.rigid, state.places, state.payload, wanted
        )
        return poses, jacobian

    def static_moments(self, values: np.ndarray, conditions: Conditions) -> np.ndarray:
        """Return static moments n_x, n_y, n_z of each joint (paper, Eq. (3)) plus inertial ones,
        shape (N, 3 n) [N m].
        """
        state = Evaluation.at(self, values, conditions)
        static = kernels.static_moments(state.layout, state.rigid, state.payload)
        return borne_moments(
            self.chain, state.rigid, static + np.transpose(inertial_moments(self.chain, conditions))
        ).T

    def coordinates(self, values: np.ndarray, conditions: Conditions) -> np.ndarray:
        """Return the coordinates of the chain on the deflected arm, shape (N, K) [rad or m]."""
        deformed = Evaluation.at(self, values, conditions).deformed
        out = np.tile(deformed.constant, (len(conditions), 1))
        varies = deformed.slot >= 0
        out[:, varies] = deformed.varying[deformed.slot[varies]].T
        return out

    def layout(self, values: np.ndarray) -> Layout:
        """Return the chain's constant part with the link masses at these values, shape (P,)."""
        return laden(self.chain, self.bodies, RowValues(values))

    def rigid_coordinates(self, values: np.ndarray) -> np.ndarray:
        """Return the coordinates at q = 0, shape (K,), from the constant terms: the
        geometry alone.
        """
        at_zero = Conditions.at(np.zeros((1, self.chain.robot.n_joints)))
        constant = self.chain.nominal.copy()
        for span, effect in zip(self.spans, self.effects, strict=True):
            is_varying = effect.uses_moments or effect.needs or effect.is_sighted
            for term in () if is_varying else effect.terms(self.chain, at_zero, None):
                if term.basis is None:
                    constant[term.coordinate] += values[span][term.parameter]
        return constant


def _places_of(chain: Chain, conditions: Conditions) -> Places:
    """Return the set-up and the target of each row; refuse targets that the chain lacks."""
    target = np.require(conditions.target, np.int64, ["C", "W"])
    if target.max(initial=0) >= len(chain.targets):
        raise ValueError(f"target {target.max()} of a chain with {len(chain.targets)} targets")
    if conditions.setup is None:
        return Places(np.zeros(len(target), np.int64), target)
    base = np.require(conditions.setup, np.int64, ["C", "W"])
    return Places(base, target + len(chain.targets) * base)


@dataclass(frozen=True)
class _Load:
    """What bends an arm in some poses, at values of its parameters by row.

    Attributes:
        model: the model.
        conditions: the poses.
        layout: masses of the links.
        payload: the load at the tip.
        by_row: the values.
    """

    model: Model
    conditions: Conditions
    layout: Layout
    payload: Payload
    by_row: RowValues

    def bent(
        self, unloaded: Values, rigid: Values
    ) -> tuple[list[tuple[int, Term]], Values, np.ndarray]:
        """Return the elastic terms, the deformed coordinates and the static moments on the joints,
        shape (3 n, N), in equilibrium if the model asks for it; ``rigid`` ones have closed loops.
        """
        model = self.model
        deformed = rigid
        inertial = np.transpose(inertial_moments(model.chain, self.conditions))
        for _ in range(_EQUILIBRIUM_ROUNDS if model.equilibrium else 1):
            before = deformed
            static = kernels.static_moments(
                self.layout, deformed, self.payload, bending=not model.equilibrium
            )
            moments = borne_moments(model.chain, deformed, static + inertial)
            elastic = _elastic(model, self.conditions, moments.T)
            deformed = closed_loops(model.chain, moved_by(unloaded, self.by_row, elastic))
            change = (
                np.abs(deformed.varying - before.varying)
                if deformed.varying.shape == before.varying.shape
                else 1.0
            )
            if np.max(change, initial=0.0) < _EQUILIBRIUM_TOLERANCE:
                break
        return elastic, deformed, moments


@dataclass(frozen=True)
class Evaluation:
    """Terms and coordinates of a model at one set of values."""

    model: Model
    layout: Layout
    terms: list[tuple[int, Term]]
    curves: list[Thin]
    values: RowValues
    rigid: Values
    deformed: Values
    moments: np.ndarray
    places: Places
    payload: Payload

    @classmethod
    def at(cls, model: Model, values: np.ndarray, conditions: Conditions) -> Evaluation:
        """Return the state of a model at values of its parameters, shape (P,) or (P, S), at some
        poses.
        """
        conditions = _sighted(model, values, conditions)
        places = _places_of(model.chain, conditions)
        by_row = RowValues.of(values, places.base)
        mass = np.require(conditions.payload, np.float64, ["C", "W"])
        payload = Payload(mass, np.array(conditions.payload_centre, float))
        plain, curves = _plain(model, conditions)
        if by_row.varied:
            plain = [*plain, *(term for curve in curves for term in curve.terms())]
            curves = []
        unloaded = coordinates_of(model.chain, by_row, conditions, plain, curves)
        rigid = closed_loops(model.chain, unloaded)
        layout = laden(model.chain, model.bodies, by_row)
        deformed = rigid
        moments = np.empty((0, len(mass)))
        if any(effect.uses_moments for effect in model.effects):
            load = _Load(model, conditions, layout, payload, by_row)
            elastic, deformed, moments = load.bent(unloaded, rigid)
            plain = plain + elastic
        loaded = deformed if model.equilibrium else rigid
        return cls(model, layout, plain, curves, by_row, loaded, deformed, moments, places, payload)

    def kernel_terms(self, columns: np.ndarray, coordinates: list[int], first: int) -> Terms:
        """Return the terms of the parameters that have a column, and of ``coordinates``, from
        column ``first`` on.
        """
        curves = (
            term
            for curve in self.curves
            if np.any(columns[curve.parameters] >= 0)
            for term in curve.terms()
        )
        used = [(int(columns[p]), term) for p, term in (*self.terms, *curves) if columns[p] >= 0]
        used += [(first + i, Term(0, k)) for i, k in enumerate(coordinates)]
        bases = [term.basis for _, term in used if term.basis is not None]
        varies = np.array([term.basis is not None for _, term in used], bool)
        return Terms(
            coordinate=np.array([term.coordinate for _, term in used], np.int64),
            parameter=np.array([column for column, _ in used], np.int64),
            slot=np.where(varies, np.cumsum(varies) - 1, -1),
            elastic=np.array([term.moment is not None for _, term in used], bool),
            basis=stacked(bases, len(self.places.tool)),
        )

    def mass_terms(self, columns: np.ndarray) -> MassTerms:
        """Return the contributions to masses of the parameters that have a column."""
        used = [
            (int(columns[body.parameter]), body)
            for body in self.model.bodies
            if columns[body.parameter] >= 0
        ]
        return MassTerms(
            joint=np.array([body.joint for _, body in used], np.int64),
            parameter=np.array([column for column, _ in used], np.int64),
            mass=np.array([body.mass for _, body in used], float),
            moment=np.array([body.moment for _, body in used], float).reshape(-1, 3),
        )

    def _loose(self, free: np.ndarray) -> dict[int, list[tuple[int, np.ndarray]]]:
        """Return free parameters, with their basis functions by coordinate, that have a single one
        and are not of a curve that is free as a whole.
        """
        count = np.bincount([p for p, _ in self.terms], minlength=len(free))
        half_free = (
            term
            for curve in self.curves
            if free[curve.parameters].any() and not free[curve.parameters].all()
            for term in curve.terms()
        )
        found: dict[int, list[tuple[int, np.ndarray]]] = {}
        for p, term in (*self.terms, *half_free):
            if free[p] and count[p] <= 1 and term.basis is not None and term.moment is None:
                found.setdefault(term.coordinate, []).append((p, term.basis))
        return found

    def shared(self, free: np.ndarray) -> list[Shared]:
        """Return the free parameters that have a single basis function on one coordinate, by
        coordinate.
        """
        n = len(self.places.tool)
        thin: dict[int, list[Thin]] = {}
        for curve in self.curves:
            if free[curve.parameters].all():
                thin.setdefault(curve.coordinate, []).append(curve)
        loose = self._loose(free)
        found = []
        for k in dict.fromkeys((*loose, *thin)):
            families: list[tuple[np.ndarray, Basis]] = []
            if curves := thin.get(k):
                families.append(
                    (
                        np.concatenate([c.parameters for c in curves]),
                        joined_rows([c.basis for c in curves]),
                    )
                )
            if len(group := loose.get(k, [])) >= WORTH_SHARING:
                families.append(
                    (np.array([p for p, _ in group]), stacked([basis for _, basis in group], n))
                )
            if families:
                found.append(Shared(k, tuple(families)))
        return found

    def compliances(self) -> Compliances:
        """Return the derivatives of the coordinates by the moments at these values."""
        values = self.values.of_parameter
        varied = self.values.varied
        elastic = [
            (p, term)
            for p, term in self.terms
            if term.moment is not None and (p in varied or values[p] != 0.0)
        ]
        if all(term.slope is None and p not in varied for p, term in elastic):
            rate = np.array([values[p] for p, _ in elastic], float).reshape(-1, 1)
        else:
            rate = np.empty((len(elastic), len(self.places.tool)))
            for row, (p, term) in zip(rate, elastic, strict=True):
                np.multiply(values[p], 1.0 if term.slope is None else term.slope, out=row)
        return Compliances(
            coordinate=np.array([term.coordinate for _, term in elastic], np.int64),
            moment=np.array([term.moment for _, term in elastic], np.int64),
            rate=rate,
        )


def _sighted(model: Model, values: np.ndarray, conditions: Conditions) -> Conditions:
    """Return poses with the target's position seen by the instrument: as read, or as predicted if
    the model needs it.
    """
    if conditions.sighted is not None or not any(effect.is_sighted for effect in model.effects):
        return conditions
    pairs = zip(model.effects, model.spans, strict=True)
    sighted = np.array(
        [effect.is_sighted for effect, of in pairs for _ in range(of.start, of.stop)], bool
    )
    without = model.with_effects([effect for effect in model.effects if not effect.is_sighted])
    return replace(conditions, sighted=without.predict(values[~sighted], conditions)[:, :, 3])


def _plain(model: Model, conditions: Conditions) -> Plain:
    pairs = [
        (of.start, e)
        for of, e in zip(model.spans, model.effects, strict=True)
        if not e.uses_moments
    ]
    return plain_terms(
        [effect for _, effect in pairs], [start for start, _ in pairs], model.chain, conditions
    )


def _elastic(model: Model, conditions: Conditions, moments: np.ndarray) -> list[tuple[int, Term]]:
    """Return the terms, with their indices in the vector of values, of the effects that use
    moments, shape (N, 3 n).

    Deflections off the path have no effect, and are left out, if loads are taken on the undeflected
    arm.
    """
    pairs = [
        (of.start, e) for of, e in zip(model.spans, model.effects, strict=True) if e.uses_moments
    ]
    found = [
        (at + t.parameter, t)
        for at, effect in pairs
        for t in effect.terms(model.chain, conditions, moments)
    ]
    moves = moves_tip(model.chain)
    return [(p, t) for p, t in found if model.equilibrium or moves[t.coordinate]]
