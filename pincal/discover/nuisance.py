"""What may be wrong without being worth a name: masses that a URDF knows to some per cent only, and where bearings sit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import log
from typing import ClassVar

import numpy as np

from pincal.discover.score_tests import WIDER, ScoreTests, tests_beside
from pincal.discover.tangent import Tangent
from pincal.identify.fit import Fit
from pincal.model import kernels
from pincal.model.catalogue.bearings import bearing_features
from pincal.model.catalogue.candidates import elasticity
from pincal.model.chain import Chain
from pincal.model.conditions import MOMENT, Conditions, Situation
from pincal.model.effect import Effect, Family, Locus, Term
from pincal.model.effects import Compliance
from pincal.model.kernels import Payload, Values
from pincal.model.latest import Latest
from pincal.model.model import Model
from pincal.parameters import Parameter

# How well a URDF knows masses and first moments of mass: fractions of the link's own.
MASS_SIZE = 0.05
CENTRE_SIZE = 0.05
# What tests may take instead, by which factor and at which cost (an information criterion): that it knows them to 2 %, or,
# with odds of 30 to 1 against it, to 10 %. Each table says itself which of these is likelier, with an effect and without.
# Gravity compensators and wrong payloads (lambda >= 60, masses 3 % off) are then named on more arms than beside 5 % for all,
# and sound arms whose masses are 10 % off get no more names.
MASS_BELIEFS = ((0.4, 0.0), (2.0, 2.0 * log(30.0)))


@dataclass(frozen=True)
class MassError(Effect):
    """Mass and first moment of each link are off, seen through compliances as they are known so far.

    The static moments are linear in mass and first moment of mass, so one evaluation a parameter gives the basis:
    gamma_l += k_l d n_l / d parameter. They are those of the nominal geometry: that of the fit changes them by far less than
    masses are off, and nominal ones serve all fits of one table.

    Attributes:
        compliances: coordinates that bend, each with the moment that it follows and its k [rad/(N m)].
        links: the joints that move the links whose masses a URDF tells; of the others they are parameters of the model.
    """

    compliances: tuple[tuple[int, int, float], ...]
    links: tuple[int, ...]
    name: ClassVar[str] = "mass_error"
    meaning: ClassVar[str] = "masses and centres of mass of the links differ from the URDF"
    family: ClassVar[Family] = Family.LOAD

    @classmethod
    def of(cls, model: Model, values: np.ndarray) -> MassError | None:
        """Return the effect for a model's present compliances, None for a rigid model, or one that has all masses itself."""
        chain, found = model.chain, {body.joint for body in model.bodies}
        links = tuple(i for i in range(chain.robot.n_joints) if i not in found)
        n, bent = chain.robot.n_joints, []
        for span, effect in zip(model.spans, model.effects, strict=True):
            if effect.family is Family.ELASTICITY:
                terms = effect.terms(chain, Conditions.at(np.zeros((1, n))), np.ones((1, 3 * n)))
                own = values[span]
                bent += [(t.coordinate, t.moment, float(own[t.parameter])) for t in terms if t.moment is not None]
        compliances = tuple(entry for entry in bent if entry[2])
        return cls(compliances, links) if compliances and links else None

    @property
    def locus(self) -> Locus:
        """All elastic rotations."""
        return Locus(acts_on="gamma", follows=MOMENT)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Relative error of mass, and of the first moment along x, y, z in units of mass times link size."""
        return tuple(
            Parameter(f"{joint}.{symbol}", "1", self.name, 0.0, MASS_SIZE if symbol == "mass" else CENTRE_SIZE)
            for joint in (chain.robot.joint_names[i] for i in self.links)
            for symbol in ("mass", "mc_x", "mc_y", "mc_z")
        )

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add each compliance times the change of its moment."""
        known, terms = _MOMENTS.of(chain, conditions), list[Term]()
        for p, i in enumerate(self.links):
            if i not in known:
                known[i] = tuple(_moments_of_link(chain, conditions, i))
            for c, change in enumerate(known[i]):
                terms += [Term(4 * p + c, at, k * change[m]) for at, m, k in self.compliances if m // 3 <= i]
        return tuple(terms)


# By link, of the latest poses.
_MOMENTS = Latest[tuple[np.ndarray, ...]](2)


def _moments_of_link(chain: Chain, conditions: Conditions, i: int) -> Iterator[np.ndarray]:
    """Yield the static moments, shape (3 n, N), of one unit of each parameter of link i alone, on the nominal arm."""
    robot, drives = chain.robot, chain.drives
    slot = np.full(len(chain.nominal), -1)
    slot[drives] = np.arange(len(drives))
    values = Values(chain.nominal.copy(), slot, np.ascontiguousarray((conditions.q + chain.nominal[drives]).T))
    masses, centres = np.zeros_like(robot.masses), np.zeros_like(robot.centres)
    masses[i] = robot.masses[i]
    no_load = Payload(np.zeros(len(conditions)), np.zeros(3))

    def moments_at(centre: np.ndarray) -> np.ndarray:
        centres[i] = centre
        layout = chain.layout._replace(masses=masses, centres=centres)
        return np.asarray(kernels.static_moments(layout, values, no_load))

    straight = moments_at(np.zeros(3))
    size = max(float(np.linalg.norm(robot.centres[i])), 0.2 * float(np.hypot(*robot.frames.parameters[i, 3:5])), 0.02)
    along = [moments_at(size * axis) - straight for axis in np.eye(3)]
    yield straight + sum(part * of for part, of in zip(robot.centres[i] / size, along, strict=True))
    yield from along


def compliances_of(model: Model, values: np.ndarray) -> np.ndarray:
    """Return the linear compliances that a model has, k of each joint's x, y, z in turn, shape (3 n,) [rad/(N m)]."""
    joints = model.chain.robot.joint_names
    k = np.zeros(3 * len(joints))
    for effect in model.effects:
        if not isinstance(effect, Compliance):
            continue
        for parameter in effect.parameters(model.chain):
            joint, symbol = parameter.name.rsplit(".", 1)
            k[3 * joints.index(joint) + "xyz".index(symbol[-1])] = values[model.index(parameter.name)]
    return k


def situation_of(fit: Fit) -> Situation:
    """Return where effects look for what they could do beyond a fit."""
    compliances = tuple(compliances_of(*fit.arm).tolist())
    return Situation(fit.problem.chain, fit.problem.conditions, compliances)


def missing_compliances(fit: Fit) -> tuple[Compliance, ...]:
    """Return the linear compliances that the poses excite and a fit does not have yet."""
    chain = fit.problem.chain
    present = {p.name for e in fit.problem.effects if isinstance(e, Compliance) for p in e.parameters(chain)}
    found = []
    for effect in elasticity(situation_of(fit)):
        assert isinstance(effect, Compliance)
        parts = effect.parts(chain)
        left = tuple(str(part.only) for part in parts if part.parameters(chain)[0].name not in present)
        if left:
            found.append(effect if len(left) == len(parts) else replace(effect, joints=left))
    return tuple(found)


def nuisances(fit: Fit, effects: Sequence[Effect]) -> list[Effect]:
    """Return what effects are tested beside: errors of masses, and what a fit and they do not have of its bearings.

    A bearing that gives way elsewhere or in other directions than the drawing says is no effect that a name may stand for.
    """
    masses, named = MassError.of(*fit.arm), {effect.identity for effect in effects}
    features = [feature for feature in missing_features(fit) if feature.identity not in named]
    return [masses, *features] if masses else features


def missing_features(fit: Fit) -> list[Effect]:
    """Return the places and directions of bearings that a fit takes from the drawing."""
    present = {effect.identity for effect in fit.problem.effects}
    features = bearing_features(fit.problem.chain, fit.problem.effects)
    return [feature for feature in features if feature.identity not in present]


@dataclass(frozen=True)
class BesideNuisances:
    """Tests effects against a fit with what is nobody's name projected out; what all tests share is made once.

    Attributes:
        fit: the fit.
    """

    fit: Fit
    _tangents: dict[object, Tangent] = field(default_factory=dict, repr=False)

    def __call__(self, effects: Sequence[Effect], groups: np.ndarray | None = None, *, wider: float = WIDER) -> ScoreTests:
        """Return the tests of candidates; arguments as of :func:`score_test`."""
        beside = nuisances(self.fit, effects)
        key = (tuple(effect.identity for effect in beside), None if groups is None else groups.tobytes())
        if key not in self._tangents:
            self._tangents[key] = Tangent.at(self.fit, beside, groups)
        masses = [effect for effect in self._tangents[key].nuisance if isinstance(effect, MassError)]
        return tests_beside(self._tangents[key], effects, wider=wider, doubtful=masses, beliefs=MASS_BELIEFS)


def score_test_beside_nuisances(
    fit: Fit, effects: Sequence[Effect], groups: np.ndarray | None = None, *, wider: float = WIDER
) -> ScoreTests:
    """Test effects against a fit with what is nobody's name projected out, masses as far as they may be off.

    See :func:`nuisances` and :func:`score_test`.
    """
    return BesideNuisances(fit)(effects, groups, wider=wider)
