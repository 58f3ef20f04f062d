r"""Effects of gravity's moments beyond linear joint and bearing elasticity.

Moments are the chain's (paper, Eq. (3)); a basis that depends on one comes with its derivative, for
exact Jacobians.

Friction grows with the load on the teeth and opposes the last motion (Coulomb), so that a joint
that arrives in direction s stops short of its drive's position by the wind-up
:math:`c \mu (m_0 + |m|)`, with the moment m on its axis.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pincal.errors import BadInputError
from pincal.model.chain import Chain
from pincal.model.conditions import MOMENT, Conditions, PoseSet, nominal_moments
from pincal.model.effect import Candidate, Discoverable, Family, Locus, Reducible, Term
from pincal.model.effect_bases import (
    PLAY,
    WAVE,
    DriveWaves,
    LoadedDrive,
    joint_index,
    moment_axes,
    moment_terms,
    parameters_of,
)
from pincal.model.effect_numbers import SHOWN
from pincal.model.effects import BENDING_SIZE
from pincal.parameters import Parameter
from pincal.thresholds import Scale

# Fraction of the largest moment on an axis that friction holds before the backlash closes to one
# side.
_TRANSITION: Scale = 0.02
# Transitions that a discovery tries, relative to the usual one.
_WIDTHS: tuple[Scale, ...] = (0.3, 1.0, 3.0)
# Stiffening torques that a discovery tries, relative to the largest torque in the poses.
_STIFFENING: tuple[Scale, ...] = (0.1, 0.3)
# Moment over which friction is smoothed as the load changes sign [N m]: negligible on any arm.
_SMOOTH: Scale = 1e-3
# Preloads that a discovery tries, relative to the largest moment in the poses.
_PRELOADS: tuple[Scale, ...] = (0.0, 0.3)


@dataclass(frozen=True)
class NonlinearElasticity(LoadedDrive):
    r"""Drive whose compliance depends on its torque, in addition to the linear k_z n_z.

    By default the compliance is proportional to the torque, gamma_z = k3_z n_z |n_z|. A drive that
    is compliant at low torque and stiffens has an extra compliance k0_z near zero torque, which
    falls to :math:`1/\sqrt{2}` of it at the torque t: its wind-up is
    :math:`\gamma_z = k_0 \; t \operatorname{arsinh}(n_z / t)`.

    Distinguished by:
        three payloads or more: linear deflection is proportional to the load. With one payload it
        resembles backlash closed by the load, or a curve of the drive.

    Source:
        Tuttle (1992), on strain wave gears.

    Attributes:
        joint: the joint.
        stiffening: t [N m], or None.
    """

    stiffening: float | None = None
    name: ClassVar[str] = "nonlinear_elasticity"
    meaning: ClassVar[str] = (
        "the drive is compliant under small loads and stiffens under large ones"
    )
    acts_on: ClassVar[str] = "gamma_z"

    def __post_init__(self) -> None:
        if self.stiffening is not None and not self.stiffening > 0.0:
            raise BadInputError(
                f"{self.name} of {self.joint}: stiffening {self.stiffening} N m; expected "
                "more than 0"
            )

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield it on every revolute joint: proportional to the torque, and stiffening at fractions
        of the largest.
        """
        for joint in situation.revolute:
            largest = float(np.abs(situation.moment(joint)).max())
            stiffening = (cls(joint, part * largest) for part in _STIFFENING if largest > 0.0)
            yield Candidate(cls(joint), variants=(cls(joint), *stiffening))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Quadratic compliance [rad/(N m)^2], or extra compliance near zero torque [rad/(N m)]."""
        symbol, unit = ("k3_z", "rad/(N m)^2") if self.stiffening is None else ("k0_z", "rad/(N m)")
        return parameters_of(self, self.joint, (symbol,), unit=unit, size=BENDING_SIZE)

    def of_moment(
        self, chain: Chain, conditions: Conditions, moment: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        n = moment
        t = self.stiffening
        if t is None:
            return n * np.abs(n), 2.0 * np.abs(n)
        return t * np.arcsinh(n / t), 1.0 / np.hypot(n / t, 1.0)


@dataclass(frozen=True)
class BaseElasticity(Discoverable):
    """Foundation that tilts under the arm: rx = k_x m_x, ry = k_y m_y, in base axes about the
    base's origin.

    m is the moment of all arms about the base's origin: joint 1's moment in base axes, plus the
    arm's weight times the horizontal distance of joint 1 from the origin. An instrument on the
    robot does not see it.

    Distinguished by:
        a target on the base or on the floor next to it. Without one, the bearing of joint 1 is
        nearly equivalent, except for the lever from the bearing to the foundation.

    Source:
        Whitney, Lozinski and Rourke (1986); Lightcap et al. (2008).
    """

    name: ClassVar[str] = "base_elasticity"
    meaning: ClassVar[str] = "the foundation is compliant"
    family: ClassVar[Family] = Family.LOAD
    uses_moments: ClassVar[bool] = True
    locus: ClassVar[Locus] = Locus(None, "base", MOMENT)

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        yield Candidate(cls())

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Compliances about the base's x and y [rad/(N m)]."""
        return parameters_of(self, "base", ("k_x", "k_y"), unit="rad/(N m)", size=BENDING_SIZE)

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        assert moments is not None
        robot = chain.robot
        terms: tuple[Term, ...] = ()
        if chain.path.start != robot.base:
            return terms
        for i in (i for i, parent in enumerate(robot.parents) if parent < 0):
            first = robot.frames.before(i)
            axes = first[:3, :3] @ moment_axes(chain, conditions, i)
            # Moment per kg about the base's origin of the whole weight, as if at joint i.
            beside = np.cross(first[:3, 3], chain.gravity)
            carried = [k for k in range(robot.n_joints) if k == i or robot.carries(i, k)]
            mass = robot.masses[carried].sum() + conditions.payload * float(
                chain.path.tip_joint in carried
            )
            for p, symbol in enumerate(("rx", "ry")):
                terms += moment_terms(p, chain.base(symbol), i, axis=axes[:, p], moments=moments)
                terms += (Term(p, chain.base(symbol), beside[p] * mass),) if beside[p] else ()
        return terms


@dataclass(frozen=True)
class GravityCompensator(DriveWaves):
    r"""Spring between two links that relieves the drive: gamma_z is the drive's compliance times
    the spring's torque.

    The torque is a smooth function of the joint's angle alone, independent of the payload; its
    first harmonics suffice:
    :math:`\gamma_z = s_1 \sin q + c_1 \cos q + s_2 \sin 2q + c_2 \cos 2q`. Gear eccentricity of
      both orders spans the same.

    Distinguished by:
        two payloads: a compensator's spring follows the joint's position and not the load. A gear
        eccentricity of orders 1 and 2 is the same function; check whether the machine has a spring.

    Source:
        Klimchik et al. (2013), arXiv 1311.6810.
    """

    name: ClassVar[str] = "gravity_compensator"
    meaning: ClassVar[str] = (
        "a spring or counterweight acts on the joint differently from the model"
    )
    acts_on: ClassVar[str] = "gamma_z"
    pattern: ClassVar[str] = "spring_{wave}{order}"
    typical: ClassVar[float] = BENDING_SIZE
    orders: ClassVar[tuple[float, ...]] = (1.0, 2.0)

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield it on every revolute joint; without a gravity moment there is nothing to
        compensate.
        """
        for joint in situation.revolute:
            is_loaded = (
                np.abs(situation.moment(joint)).max()
                > SHOWN.spring * np.abs(situation.moments).max()
            )
            unloaded = (
                f"gravity exerts no moment about the axis of {joint} that could be compensated"
            )
            yield Candidate(cls(joint), obstacle="" if is_loaded else unloaded)


@dataclass(frozen=True)
class PayloadError(Discoverable, Reducible):
    """Payload whose mass or centre of mass differs from the table.

    Each elastic rotation changes by compliance times the missing moment. With known compliances
    there is one parameter for the mass, relative to the table's, and three more for the centre of
    mass. Without them gamma_z of each joint changes by p_z times the payload's own moment there,
    with p_z the compliance times the relative error. The moment is taken on the nominal arm,
    independently of the fitted geometry. It is distinguishable from the compliance only if the
    payload varies.

    Distinguished by:
        the same poses with and without payload: only the difference is due to the payload.

    Source:
        Atkeson, An and Hollerbach (1986), on loads.

    Attributes:
        joints: the joints that the payload loads, unless compliances are given; default: all.
        compliances: k of each joint's x, y, z in turn [rad/(N m)].
        shifted: whether the centre of mass may differ, too; only with compliances.
    """

    joints: tuple[str, ...] | None = None
    compliances: tuple[float, ...] | None = None
    shifted: bool = False
    name: ClassVar[str] = "payload_error"
    meaning: ClassVar[str] = "the payload's mass or centre of mass is not as declared"
    family: ClassVar[Family] = Family.LOAD
    locus: ClassVar[Locus] = Locus(None, "gamma", "payload")

    @classmethod
    def over(cls, chain: Chain, conditions: Conditions) -> PayloadError:
        """Return the effect on the joints that the payload loads in some pose."""
        felt = np.abs(nominal_moments(chain, conditions, payload_only=True)).max(
            axis=0, initial=0.0
        )
        names = zip(chain.robot.joint_names, chain.robot.joint_types, felt[2::3], strict=True)
        threshold = SHOWN.unfelt_payload * felt.max()
        return cls(
            tuple(
                name for name, kind, moment in names if kind != "prismatic" and moment > threshold
            )
        )

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield it once; its variants, with known compliances, have the mass alone, or the centre
        of mass as well.
        """
        known = situation.compliances if any(situation.compliances) else None
        forms = (
            ()
            if known is None
            else tuple(cls(compliances=known, shifted=shifted) for shifted in (False, True))
        )
        yield Candidate(cls.over(situation.chain, situation.conditions), variants=forms)

    def reduced(self, situation: PoseSet) -> PayloadError:
        """Return the error of the mass alone, if compliances are known."""
        return (
            PayloadError(compliances=situation.compliances) if any(situation.compliances) else self
        )

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """One p_z per joint [rad/(N m)], or the relative error of the mass [1] and the shift of its
        centre [m].
        """
        if self.compliances is not None:
            mass = parameters_of(self, "arm", ("payload_mass",), unit="1", size=WAVE)
            centre = parameters_of(
                self, "arm", [f"payload_{axis}" for axis in "xyz"], unit="m", size=WAVE
            )
            return mass + centre if self.shifted else mass
        names = self._names(chain)
        return tuple(
            p for n in names for p in parameters_of(self, n, ("p_z",), unit="rad/(N m)", size=WAVE)
        )

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        own = nominal_moments(chain, conditions, payload_only=True)
        if self.compliances is None:
            places = [joint_index(chain, name) for name in self._names(chain)]
            return tuple(
                Term(p, chain.joint(i, "gamma_z"), own[:, 3 * i + 2]) for p, i in enumerate(places)
            )
        changes = [own]
        for shift in np.eye(3) if self.shifted else ():
            there = replace(conditions, payload_centre=conditions.payload_centre + shift)
            changes.append(nominal_moments(chain, there, payload_only=True) - own)
        bent = [
            (m, chain.joint(m // 3, f"gamma_{'xyz'[m % 3]}"), k)
            for m, k in enumerate(self.compliances)
            if k
        ]
        return tuple(
            Term(p, at, k * change[:, m]) for p, change in enumerate(changes) for m, at, k in bent
        )

    def _names(self, chain: Chain) -> Sequence[str]:
        return chain.robot.measured_joints if self.joints is None else self.joints


@dataclass(frozen=True)
class LoadBacklash(LoadedDrive):
    """Backlash closed by the load: b tanh(n_z / transition) is added to the joint position, with b
    half the backlash.

    Distinguished by:
        poses on both sides of the position at which the load changes sign, or a payload that shifts
        this position: backlash shifts with it, a curve of the drive does not.

    Source:
        Whitney, Lozinski and Rourke (1986).

    Attributes:
        joint: the joint.
        transition: torque over which the joint changes sides [N m].
    """

    transition: float = 20.0
    name: ClassVar[str] = "load_backlash"
    meaning: ClassVar[str] = (
        "backlash: the joint falls to one side, depending on the sign of the load"
    )
    symbol: ClassVar[str] = "load_backlash"
    typical: ClassVar[float] = PLAY

    def __post_init__(self) -> None:
        if not self.transition > 0.0:
            raise BadInputError(
                f"{self.name} of {self.joint}: transition {self.transition} N m; expected "
                "more than 0"
            )

    @classmethod
    def over(cls, joint: str, moment: np.ndarray) -> LoadBacklash:
        """Return the effect with a transition of 2 % of the largest of moments n_z, shape (N,) [N
        m].
        """
        largest = float(np.abs(moment).max(initial=0.0))
        return cls(joint, _TRANSITION * largest) if largest > 0.0 else cls(joint)

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        for joint in situation.revolute:
            effect = cls.over(joint, situation.moment(joint))
            yield Candidate(
                effect, variants=tuple(cls(joint, width * effect.transition) for width in _WIDTHS)
            )

    def of_moment(
        self, chain: Chain, conditions: Conditions, moment: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the smoothed sign of the load."""
        side = np.tanh(moment / self.transition)
        return side, (1.0 - side**2) / self.transition


@dataclass(frozen=True)
class Hysteresis(LoadedDrive):
    """Wind-up against friction: h |n_z| times the direction of approach (-1, 0, 1) is added to the
    joint position.

    A joint that lags behind its drive has h < 0. Friction of seals and preloaded teeth that does
    not depend on the load is modelled by a preload: |n_z| + preload. An error independent of the
    load altogether is backlash.

    Distinguished by:
        reaching each pose from both directions, recorded in `approach_<joint>`, with two payloads:
        backlash does not depend on the load.

    Source:
        Ruderman, Hoffmann and Bertram (2009).

    Attributes:
        joint: the joint.
        preload: moment added to the load [N m].
    """

    preload: float = 0.0
    name: ClassVar[str] = "hysteresis"
    meaning: ClassVar[str] = (
        "friction under load: the drive comes to rest wound up, depending on the "
        "direction of approach"
    )
    symbol: ClassVar[str] = "hysteresis"
    unit: ClassVar[str] = "rad/(N m)"
    typical: ClassVar[float] = PLAY
    follows: ClassVar[str] = "approach"
    recorded_as: ClassVar[str] = "approach_<joint>"

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        for joint in situation.revolute:
            largest = float(np.abs(situation.moment(joint)).max())
            preloads = _PRELOADS if largest > 0.0 else _PRELOADS[:1]
            yield Candidate(
                cls(joint), variants=tuple(cls(joint, part * largest) for part in preloads)
            )

    def of_moment(
        self, chain: Chain, conditions: Conditions, moment: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        side = self.variable(chain, conditions)
        load = np.hypot(moment, _SMOOTH)
        return side * (load + self.preload), side * moment / load
