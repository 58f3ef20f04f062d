r"""Effects of gravity's moments beyond linear joint and bearing elasticity.

Moments are those of the chain (paper, Eq. (3)); a basis that follows one gives its slope, so that the Jacobian stays exact
through the moments.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pincal.errors import BadInputError
from pincal.model.chain import Chain
from pincal.model.compliances import BENDING_SIZE
from pincal.model.conditions import MOMENT, Conditions, Situation, nominal_moments
from pincal.model.effect import Candidate, Discoverable, Family, Locus, Reducible, Term
from pincal.model.links import end_terms, link_span, loads_at_end
from pincal.model.places import (
    PLAY,
    WAVE,
    drive_unit,
    joint_index,
    moment_axes,
    moment_terms,
    parameters_of,
    positions,
    waves,
)
from pincal.parameters import Parameter

# Part of the largest moment of an axis that friction holds before its play goes to one side.
_TRANSITION = 0.02
# Transitions that a discovery tries, over the usual one.
_WIDTHS = (0.3, 1.0, 3.0)
# Torques at which a drive stiffens that a discovery tries, over the largest in the poses.
_STIFFENING = (0.1, 0.3)
# Part of the largest moment on the arm below which nobody builds a compensator.
_WORTH_A_SPRING = 0.1
# A link shorter than this does not bend [m].
_SHORT = 1e-3
# Part of the payload's largest moment on the arm below which an axis does not feel it.
_UNFELT = 1e-3


@dataclass(frozen=True)
class NonlinearElasticity(Discoverable):
    r"""Drive whose compliance depends on its torque, beside the linear k_z n_z.

    By default it changes in proportion to the torque, gamma_z = k3_z n_z |n_z|. A drive that gives way at low torque and
    stiffens has an extra compliance k0_z near torque 0 that falls to :math:`1/\sqrt{2}` of it at the torque t, and so the
    wind-up :math:`\gamma_z = k_0 \; t \operatorname{arsinh}(n_z / t)`.

    Told apart by:
        three payloads or more: twice the load bends linear elasticity twice as far. With one payload a play that the load
        takes up, or a curve of the drive, does the same.

    Source:
        Tuttle (1992), on strain wave gears.

    Attributes:
        joint: the joint.
        stiffening: t [N m], or None.
    """

    joint: str
    stiffening: float | None = None
    name: ClassVar[str] = "nonlinear_elasticity"
    meaning: ClassVar[str] = "the drive is soft under small loads and stiffens under large ones"
    family: ClassVar[Family] = Family.LOAD
    uses_moments: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Refuse a torque that is none."""
        if self.stiffening is not None and not self.stiffening > 0.0:
            raise BadInputError(f"{self.name} of {self.joint}: stiffening {self.stiffening} N m; expected more than 0")

    @property
    def locus(self) -> Locus:
        """The elastic rotation of the drive, by the moment on its axis."""
        return Locus(self.joint, "gamma_z", MOMENT)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint that turns: in proportion to the torque, and stiffening at parts of the largest torque."""
        for joint in situation.revolute:
            largest = float(np.abs(situation.moment(joint)).max())
            stiffening = (cls(joint, part * largest) for part in _STIFFENING if largest > 0.0)
            yield Candidate(cls(joint), variants=(cls(joint), *stiffening))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Quadratic compliance [rad/(N m)^2], or extra compliance near torque 0 [rad/(N m)]."""
        symbol, unit = ("k3_z", "rad/(N m)^2") if self.stiffening is None else ("k0_z", "rad/(N m)")
        return parameters_of(self, self.joint, (symbol,), unit=unit, size=BENDING_SIZE)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the wind-up, and its slope by the moment, to gamma_z."""
        assert moments is not None
        i = joint_index(chain, self.joint)
        moment = 3 * i + 2
        n, t = moments[:, moment], self.stiffening
        if t is None:
            return (Term(0, chain.joint(i, "gamma_z"), n * np.abs(n), moment, 2.0 * np.abs(n)),)
        return (Term(0, chain.joint(i, "gamma_z"), t * np.arcsinh(n / t), moment, 1.0 / np.hypot(n / t, 1.0)),)


@dataclass(frozen=True)
class LinkBending(Discoverable):
    r"""Link that bends like a cantilever from its joint to the next, under the weight of all that is beyond it.

    Of length L along u, with force F and moment M at its end, across u (Euler, Bernoulli): the end turns by

    .. math:: b (L M + L^2/2 \; u \times F), \quad \text{and moves by} \quad b (L^2/2 \; M \times u + L^3/3 \; F).

    The link's own weight and the difference between its two planes are left out. Force and moment are those of the nominal
    arm, since errors of some mm change them by a thousandth.

    Told apart by:
        a payload far off the link: a link that bends moves its end and turns it, a bearing only turns it. Orientation (6D)
        tells the two apart in fewer poses.

    Source:
        Euler and Bernoulli's beam; in robots Judd and Knasinski (1990), Lightcap et al. (2008).

    Attributes:
        joint: the joint that moves the link; not the last.
    """

    joint: str
    name: ClassVar[str] = "link_bending"
    meaning: ClassVar[str] = "the link itself bends under load"
    family: ClassVar[Family] = Family.LOAD

    @property
    def locus(self) -> Locus:
        """The far end of the link, by all the loads there."""
        return Locus(self.joint, "link")

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every link but the last."""
        yield from (Candidate(cls(joint)) for joint in situation.joints[:-1])

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Flexibility b = 1 / (E I) [1/(N m^2)].

        Raises:
            BadInputError: if no joint follows.
        """
        self._index(chain)
        return parameters_of(self, self.joint, ("bend",), unit="1/(N m^2)", size=BENDING_SIZE)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Turn and move the far end of the link."""
        i = self._index(chain)
        span = link_span(chain, i)
        length = float(np.linalg.norm(span))
        if length < _SHORT:
            return ()
        u = span / length
        force, moment = (load - np.outer(load @ u, u) for load in loads_at_end(chain, conditions, i))
        turn = length * moment + length**2 / 2.0 * np.cross(u, force)
        shift = length**2 / 2.0 * np.cross(moment, u) + length**3 / 3.0 * force
        return end_terms(chain, i, shift=shift, turn=turn)

    def _index(self, chain: Chain) -> int:
        i = joint_index(chain, self.joint)
        if i + 1 == chain.robot.n_joints:
            others = ", ".join(chain.robot.joint_names[:-1])
            raise BadInputError(f"{self.name} of {self.joint}: no joint follows its link; expected one of {others}")
        return i


@dataclass(frozen=True)
class BaseElasticity(Discoverable):
    """Foundation that tilts under the arm: rx = k_x m_x, ry = k_y m_y, in base axes about the base's origin.

    m is the moment of the arm about the base's origin: joint 1's moment, in base axes, and where joint 1 stands beside the
    origin (seen along gravity) the arm's weight times that distance.

    Told apart by:
        a target on the base or the floor beside it. Without one the bearing of joint 1 does nearly the same, but for the
        lever from its place to the foundation.

    Source:
        Whitney, Lozinski and Rourke (1986); Lightcap et al. (2008).
    """

    name: ClassVar[str] = "base_elasticity"
    meaning: ClassVar[str] = "the foundation gives way under load"
    family: ClassVar[Family] = Family.LOAD
    uses_moments: ClassVar[bool] = True

    @property
    def locus(self) -> Locus:
        """The base, by the moment of the whole arm."""
        return Locus(None, "base", MOMENT)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it once."""
        yield Candidate(cls())

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Compliances about the base's x and y [rad/(N m)]."""
        return parameters_of(self, "base", ("k_x", "k_y"), unit="rad/(N m)", size=BENDING_SIZE)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add joint 1's moments in base axes to rx and ry."""
        assert moments is not None
        first = chain.robot.frames.T_base_first
        axes = first[:3, :3] @ moment_axes(chain, conditions, 0)
        # Moment of the whole weight, as if it hung at joint 1, about the base's origin, per kg.
        beside = np.cross(first[:3, 3], chain.gravity)
        mass = chain.robot.masses.sum() + conditions.payload
        terms: tuple[Term, ...] = ()
        for p, symbol in enumerate(("rx", "ry")):
            terms += moment_terms(p, chain.base(symbol), 0, axis=axes[:, p], moments=moments)
            terms += (Term(p, chain.base(symbol), beside[p] * mass),) if beside[p] else ()
        return terms


@dataclass(frozen=True)
class GravityCompensator(Discoverable):
    r"""Spring between two links that relieves the drive: gamma_z is the drive's compliance times the spring's torque.

    The torque is a smooth function of the joint's angle alone, whatever the payload; its first harmonics are enough:
    :math:`\gamma_z = s_1 \sin q + c_1 \cos q + s_2 \sin 2q + c_2 \cos 2q`. Gear eccentricity of both orders spans the same.

    Told apart by:
        two payloads: a compensator's spring follows the joint's position and not the load. A gear eccentricity of orders 1
        and 2 is the same function; look at whether the machine has a spring.

    Source:
        Klimchik et al. (2013), arXiv 1311.6810.
    """

    joint: str
    name: ClassVar[str] = "gravity_compensator"
    meaning: ClassVar[str] = "a spring or a counterweight acts on the joint otherwise than assumed"

    @property
    def locus(self) -> Locus:
        """The elastic rotation of the drive, by its own position."""
        return Locus(self.joint, "gamma_z", self.joint)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint that turns; there is nothing to compensate where gravity exerts no moment."""
        for joint in situation.revolute:
            is_loaded = np.abs(situation.moment(joint)).max() > _WORTH_A_SPRING * np.abs(situation.moments).max()
            unloaded = f"gravity exerts no moment about the axis of {joint} that could be compensated"
            yield Candidate(cls(joint), obstacle="" if is_loaded else unloaded)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Amplitudes s_1, c_1, s_2, c_2 [rad]."""
        symbols = [f"spring_{wave}{order}" for order in (1, 2) for wave in ("sin", "cos")]
        return parameters_of(self, self.joint, symbols, unit="rad", size=BENDING_SIZE)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add sines and cosines to gamma_z."""
        q, k = positions(chain, conditions, self.joint), chain.joint(joint_index(chain, self.joint), "gamma_z")
        return tuple(Term(p, k, wave) for p, wave in enumerate((*waves(q), *waves(2.0 * q))))


@dataclass(frozen=True)
class PayloadError(Discoverable, Reducible):
    """Payload that differs from the table, in mass or in place.

    Each elastic rotation grows by compliance times the moment that is missing. With the compliances as they are known so
    far that is one parameter for the mass, relative to the table's, and three more for the centre of mass. Without them
    gamma_z of each joint grows by p_z times the payload's own moment there, p_z being compliance times relative error.
    The moment is taken on the nominal arm, as given: it does not follow the geometry. Only where the payload varies can it
    be told from the compliance.

    Told apart by:
        the same poses without payload and with it: only the difference between them is of the payload.

    Source:
        Atkeson, An and Hollerbach (1986), on loads.

    Attributes:
        joints: the joints that feel the payload, unless compliances are given; all unless given.
        compliances: k of each joint's x, y, z in turn [rad/(N m)].
        shifted: whether the centre of mass may be elsewhere too; only with compliances.
    """

    joints: tuple[str, ...] | None = None
    compliances: tuple[float, ...] | None = None
    shifted: bool = False
    name: ClassVar[str] = "payload_error"
    meaning: ClassVar[str] = "the payload's mass or centre is not as declared"
    family: ClassVar[Family] = Family.LOAD

    @classmethod
    def over(cls, chain: Chain, conditions: Conditions) -> PayloadError:
        """Return the effect on those joints that feel the payload in some pose."""
        felt = np.abs(nominal_moments(chain, conditions, payload_only=True)).max(axis=0, initial=0.0)
        names = zip(chain.robot.joint_names, chain.robot.joint_types, felt[2::3], strict=True)
        threshold = _UNFELT * felt.max()
        return cls(tuple(name for name, kind, moment in names if kind != "prismatic" and moment > threshold))

    @property
    def locus(self) -> Locus:
        """All elastic rotations, by the payload."""
        return Locus(None, "gamma", "payload")

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it once; it is tried with the compliances that are known, of the mass alone and of its centre, too."""
        known = situation.compliances if any(situation.compliances) else None
        forms = () if known is None else tuple(cls(compliances=known, shifted=shifted) for shifted in (False, True))
        yield Candidate(cls.over(situation.chain, situation.conditions), variants=forms)

    def reduced(self, situation: Situation) -> PayloadError:
        """Return the error of the mass alone, if compliances are known."""
        return PayloadError(compliances=situation.compliances) if any(situation.compliances) else self

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """One p_z a joint [rad/(N m)], or the relative error of the mass [1] and the shift of its centre [m]."""
        if self.compliances is not None:
            mass = parameters_of(self, "arm", ("payload_mass",), unit="1", size=WAVE)
            centre = parameters_of(self, "arm", [f"payload_{axis}" for axis in "xyz"], unit="m", size=WAVE)
            return mass + centre if self.shifted else mass
        names = self._names(chain)
        return tuple(p for n in names for p in parameters_of(self, n, ("p_z",), unit="rad/(N m)", size=WAVE))

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the payload's moment, or its change, to the elastic rotations."""
        own = nominal_moments(chain, conditions, payload_only=True)
        if self.compliances is None:
            places = [joint_index(chain, name) for name in self._names(chain)]
            return tuple(Term(p, chain.joint(i, "gamma_z"), own[:, 3 * i + 2]) for p, i in enumerate(places))
        changes = [own]
        for shift in np.eye(3) if self.shifted else ():
            there = replace(conditions, payload_centre=conditions.payload_centre + shift)
            changes.append(nominal_moments(chain, there, payload_only=True) - own)
        bent = [(m, chain.joint(m // 3, f"gamma_{'xyz'[m % 3]}"), k) for m, k in enumerate(self.compliances) if k]
        return tuple(Term(p, at, k * change[:, m]) for p, change in enumerate(changes) for m, at, k in bent)

    def _names(self, chain: Chain) -> Sequence[str]:
        return chain.robot.joint_names if self.joints is None else self.joints


@dataclass(frozen=True)
class LoadBacklash(Discoverable):
    """Play that the load takes up: the joint moves by b tanh(n_z / transition) more, b half the play.

    Told apart by:
        poses on both sides of the position at which the load changes its sign, or a payload that moves this position: a
        curve of the drive stays, play moves with it.

    Source:
        Whitney, Lozinski and Rourke (1986).

    Attributes:
        joint: the joint.
        transition: torque within which the joint changes sides [N m].
    """

    joint: str
    transition: float = 20.0
    name: ClassVar[str] = "load_backlash"
    meaning: ClassVar[str] = "play: the joint falls to one side, depending on the sign of the load"
    family: ClassVar[Family] = Family.LOAD
    uses_moments: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Refuse a transition without width."""
        if not self.transition > 0.0:
            raise BadInputError(f"{self.name} of {self.joint}: transition {self.transition} N m; expected more than 0")

    @classmethod
    def over(cls, joint: str, moment: np.ndarray) -> LoadBacklash:
        """Return the effect with a transition of 2 % of the largest of the moments n_z seen, shape (N,) [N m]."""
        largest = float(np.abs(moment).max(initial=0.0))
        return cls(joint, _TRANSITION * largest) if largest > 0.0 else cls(joint)

    @property
    def locus(self) -> Locus:
        """The drive, by the moment on its axis."""
        return Locus(self.joint, "drive", MOMENT)

    @classmethod
    def candidates(cls, situation: Situation) -> Iterator[Candidate]:
        """Yield it on every joint that turns, with transitions of several widths."""
        for joint in situation.revolute:
            effect = cls.over(joint, situation.moment(joint))
            yield Candidate(effect, variants=tuple(cls(joint, width * effect.transition) for width in _WIDTHS))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Half the play [rad or m]."""
        return parameters_of(self, self.joint, ("load_backlash",), unit=drive_unit(chain, self.joint), size=PLAY)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add the smoothed sign of the moment to the joint's drive."""
        assert moments is not None
        i = joint_index(chain, self.joint)
        side = np.tanh(moments[:, 3 * i + 2] / self.transition)
        return (Term(0, int(chain.drives[i]), side, 3 * i + 2, (1.0 - side**2) / self.transition),)
