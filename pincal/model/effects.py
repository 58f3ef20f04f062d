"""The effects of every model: geometry, linear elasticity, and the base and tool frames.

The catalogue (:mod:`pincal.model.catalogue`) holds the further effects that a discovery searches
for.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, final

import numpy as np

from pincal.model.chain import MOUNT_SYMBOLS, Chain
from pincal.model.conditions import MOMENT, UNFELT, Conditions, PoseSet
from pincal.model.effect import Candidate, Discoverable, Effect, Family, Locus, Term
from pincal.model.loops import inert_coordinates
from pincal.parameters import FRAME_SYMBOLS, Parameter, Scope
from pincal.thresholds import Scale

# Sizes of real errors [rad, m], used as priors. The paper (IV.C) reports deviations of up to 1 cm
# at the tip; makers' tolerances are some tenths of a mm and of a mrad, those of cobots several
# times that.
ANGLE_SIZE: Scale = 3e-3
LENGTH_SIZE: Scale = 3e-3
# Size of real elastic rotations [rad], likewise.
BENDING_SIZE: Scale = 1e-3
# Deviation of an arm's mount next to another arm from its nominal pose [m, rad].
_MOUNT_SIZE: Scale = 1e-2
LENGTHS = ("d", "a", *MOUNT_SYMBOLS)
"""Symbols of the coordinates of a joint that are lengths."""


def _size(chain: Chain, element: str, symbol: str) -> float:
    if f"{element}.{symbol}" in chain.mounts:
        return _MOUNT_SIZE
    return LENGTH_SIZE if symbol in LENGTHS else ANGLE_SIZE


def places_of(chain: Chain) -> dict[Any, Any]:
    """Return which coordinates effects act on, by effect and moment frame, to be added to: they are
    asked for with every evaluation of a model, and depend on the arm alone.
    """
    return chain.kept.about("places", chain.robot, chain.bearing_heights)


class _Geometry(Effect):
    """Constants that are added to coordinates of every joint."""

    family: ClassVar[Family] = Family.GEOMETRY
    # Coordinates of a revolute joint, of a prismatic one, and further ones of a joint that begins a
    # branch.
    turning: ClassVar[tuple[str, ...]]
    sliding: ClassVar[tuple[str, ...]]
    branching: ClassVar[tuple[str, ...]] = ()

    @final
    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """The coordinates of each joint that deviate [rad or m]."""
        return tuple(
            Parameter(
                name=f"{element}.{symbol}",
                unit="m" if symbol in LENGTHS else "rad",
                effect=self.name,
                nominal=float(chain.nominal[k]),
                size=_size(chain, element, symbol),
            )
            for element, symbol, k in self._places(chain)
        )

    @final
    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        return tuple(Term(p, k) for p, (_, _, k) in enumerate(self._places(chain)))

    def _places(self, chain: Chain) -> tuple[tuple[str, str, int], ...]:
        """Return element, symbol and coordinate of each parameter that readings can depend on."""
        known = places_of(chain)
        key = self, chain.moment_frame
        if key not in known:
            known[key] = tuple(self._found(chain))
        found: tuple[tuple[str, str, int], ...] = known[key]
        return found

    def _found(self, chain: Chain) -> Iterator[tuple[str, str, int]]:
        """Yield what :meth:`_places` returns."""
        robot = chain.robot
        inert = inert_coordinates(chain)
        for i, (name, kind) in enumerate(zip(robot.joint_names, robot.joint_types, strict=True)):
            if name in robot.unmeasured:
                continue
            symbols = self.sliding if kind == "prismatic" else self.turning
            mount = self.branching if i in robot.frames.branches else ()
            places = ((name, symbol, chain.joint(i, symbol)) for symbol in (*mount, *symbols))
            yield from (place for place in places if place[2] not in inert)
        pins = (
            (pin.name, symbol, chain.pin(i, symbol))
            for i, pin in enumerate(chain.pins)
            for symbol in self.branching
        )
        yield from (place for place in pins if place[2] not in inert)


@dataclass(frozen=True)
class JointOffset(_Geometry):
    """The zero of each joint is off by a constant (paper: theta_i; d_i of a prismatic joint).

    Distinguished by:
        large joint motions, targets off the last axis. The offset of the first joint is equivalent
        to a rotation of the base, and the offset of the last to a rotation of the tool, unless
        these are known.

    Source:
        Radkhah et al., Eq. (1): theta_i.
    """

    name: ClassVar[str] = "joint_offset"
    meaning: ClassVar[str] = "the zero position of a joint is wrong"
    locus: ClassVar[Locus] = Locus(acts_on="drive")
    turning: ClassVar[tuple[str, ...]] = ("theta",)
    sliding: ClassVar[tuple[str, ...]] = ("d",)


@dataclass(frozen=True)
class LinkGeometry(_Geometry):
    """Link offset d, link length a and link twist alpha deviate (paper, Eq. (1)).

    A prismatic joint has theta instead of d, which is its joint offset. The first joint of a branch
    also has x and y, the position of its axis on the link that carries it; so has a pin that closes
    a loop.

    Distinguished by:
        poses over the whole range of every joint. For parallel axes only the sum of the link
        offsets is observable; offset and length of the first and the last link are equivalent to
        displacements of base and tool.

    Source:
        Denavit and Hartenberg (1955); Radkhah et al., Eq. (1).
    """

    name: ClassVar[str] = "link_geometry"
    meaning: ClassVar[str] = "lengths and angles of the links differ from the drawing"
    locus: ClassVar[Locus] = Locus(acts_on="link")
    turning: ClassVar[tuple[str, ...]] = ("d", "a", "alpha")
    sliding: ClassVar[tuple[str, ...]] = ("theta", "a", "alpha")
    branching: ClassVar[tuple[str, ...]] = MOUNT_SYMBOLS


@dataclass(frozen=True)
class AxisDistortion(_Geometry):
    """The axis of motion is tilted by s_x, s_y before the joint turns (paper, Eq. (2)).

    Distinguished by:
        poses over the whole range of the joint and of its neighbours. Between axes that are not
        parallel one of the two tilts is a link twist.

    Source:
        Radkhah et al., Eq. (2); about y for parallel axes Hayati (1983).
    """

    name: ClassVar[str] = "axis_distortion"
    meaning: ClassVar[str] = "joint axes are slightly tilted (the paper's s_x, s_y)"
    locus: ClassVar[Locus] = Locus(acts_on="tilt")
    turning: ClassVar[tuple[str, ...]] = ("s_x", "s_y")
    sliding: ClassVar[tuple[str, ...]] = ("s_x", "s_y")


@dataclass(frozen=True)
class BaseFrame(Effect):
    """Pose of the robot in the instrument's frame.

    Distinguished by:
        three or more non-collinear targets, in poses that do not move joint 1 alone. It is
        identified for every set-up.

    Source:
        Radkhah et al.

    Attributes:
        symbols: the released coordinates; a distance has no orientation, a contact neither position
            nor orientation.
    """

    symbols: tuple[str, ...] = FRAME_SYMBOLS
    name: ClassVar[str] = "base_frame"
    meaning: ClassVar[str] = "pose of the robot in the instrument's frame"
    family: ClassVar[Family] = Family.EXTRINSICS
    scope: ClassVar[Scope] = "station"
    locus: ClassVar[Locus] = Locus(acts_on="base")

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """x, y, z [m] and small angles rx, ry, rz [rad] about the chain's reference orientation."""
        return tuple(_frame_parameter("base", self.name, symbol) for symbol in self.symbols)

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        return tuple(Term(p, chain.base(symbol)) for p, symbol in enumerate(self.symbols))


@dataclass(frozen=True)
class ToolFrame(Effect):
    """Pose of each target in the tip frame; a point target has no orientation.

    Distinguished by:
        rotations of the hand. A displacement of a target along the last axis is equivalent to that
        joint's link offset; a second target off the axis decides.

    Source:
        Radkhah et al.
    """

    symbols: tuple[str, ...] = FRAME_SYMBOLS[:3]
    name: ClassVar[str] = "tool_frame"
    meaning: ClassVar[str] = "pose of the target on the tool"
    family: ClassVar[Family] = Family.EXTRINSICS
    scope: ClassVar[Scope] = "station"
    locus: ClassVar[Locus] = Locus(acts_on="tool")

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """x, y, z [m], and for poses rx, ry, rz [rad], of every target."""
        return tuple(
            _frame_parameter(t, self.name, symbol) for t in chain.targets for symbol in self.symbols
        )

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        terms = []
        for t in range(len(chain.targets)):
            here = None if len(chain.targets) == 1 else (conditions.target == t).astype(float)
            for j, symbol in enumerate(self.symbols):
                terms.append(Term(t * len(self.symbols) + j, chain.tool(symbol), here))
        return tuple(terms)


def _frame_parameter(element: str, effect: str, symbol: str) -> Parameter:
    return Parameter(
        f"{element}.{symbol}", "m" if symbol in "xyz" else "rad", effect, 0.0, float("inf")
    )


@dataclass(frozen=True)
class Compliance(Discoverable):
    """Elastic rotations in proportion to the static moments of some joints (paper, III.B).

    Attributes:
        joints: the joints; default: all.
        acts_on: as in :class:`Locus`.
        axes: the compliant axes, of "x", "y" and "z", the joint's own.
    """

    joints: tuple[str, ...] | None = None
    family: ClassVar[Family] = Family.ELASTICITY
    uses_moments: ClassVar[bool] = True
    acts_on: ClassVar[str]
    axes: ClassVar[str]

    @property
    def least_moment(self) -> float:
        """Zero for a single joint, whose compliance the data show."""
        return super().least_moment if self.only is None else 0.0

    @property
    def locus(self) -> Locus:
        return Locus(self.only, self.acts_on, MOMENT)

    @property
    def only(self) -> str | None:
        """The joint, if there is only one."""
        return self.joints[0] if self.joints is not None and len(self.joints) == 1 else None

    @final
    def parts(self, chain: Chain) -> tuple[Self, ...]:
        """Return the compliance of each joint by itself, of those on which it has a meaning."""
        joints = chain.robot.measured_joints if self.joints is None else self.joints
        parts = (replace(self, joints=(joint,)) for joint in joints)
        return tuple(part for part in parts if part._places(chain))

    @final
    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """The compliances of each joint [rad/(N m)]."""
        return tuple(
            Parameter(
                f"{chain.robot.joint_names[i]}.k_{axis}", "rad/(N m)", self.name, 0.0, BENDING_SIZE
            )
            for i, axis, _ in self._places(chain)
        )

    @final
    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        assert moments is not None
        return tuple(
            Term(p, k, moments[:, moment], moment)
            for p, (i, axis, k) in enumerate(self._places(chain))
            for moment in (3 * i + "xyz".index(axis),)
        )

    def _places(self, chain: Chain) -> list[tuple[int, str, int]]:
        """Return joint, axis and coordinate, except where a loop makes the compliance
        meaningless.
        """
        known = places_of(chain)
        key = self, chain.moment_frame
        if key not in known:
            known[key] = self._found(chain)
        found: list[tuple[int, str, int]] = known[key]
        return found

    def _found(self, chain: Chain) -> list[tuple[int, str, int]]:
        """Return what :meth:`_places` does."""
        names = chain.robot.joint_names
        inert = inert_coordinates(chain)
        joints = [
            names.index(name)
            for name in (chain.robot.measured_joints if self.joints is None else self.joints)
        ]
        places = [(i, axis, chain.joint(i, f"gamma_{axis}")) for i in joints for axis in self.axes]
        return [place for place in places if place[2] not in inert]


@dataclass(frozen=True)
class JointElasticity(Compliance):
    """Each drive is compliant about its own axis: gamma_z = k_z n_z.

    Distinguished by:
        two payloads in the same poses: deflection grows with the load. With one load it resembles a
        gravity compensator, a gear eccentricity of order 1 or an error of the masses.

    Source:
        Radkhah et al., Eq. (3); Whitney, Lozinski and Rourke (1986).
    """

    name: ClassVar[str] = "joint_elasticity"
    meaning: ClassVar[str] = "the drive twists under the load on its axis"
    acts_on: ClassVar[str] = "gamma_z"
    axes: ClassVar[str] = "z"

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield the elasticity of all drives that these poses load.

        About a vertical axis gravity has a moment only if the base is not level. The base frame
        absorbs any tilt, so that such a compliance could imitate a true effect of that joint's
        position.
        """
        heaviest = UNFELT * np.abs(situation.moments).max(initial=0.0)
        joints = situation.joints
        felt = tuple(
            joint for joint in joints if np.abs(situation.moment(joint)).max(initial=0.0) > heaviest
        )
        yield Candidate(cls() if len(felt) == len(joints) else cls(felt))


@dataclass(frozen=True)
class BearingElasticity(Compliance):
    r"""Each bearing is compliant across its axis: gamma_x = k_x n_x, gamma_y = k_y n_y.

    With the paper's moment frame it acts exactly as there: about the origin of the
    Denavit-Hartenberg frame, whose position is a convention. With "before" and "after" the moment
    is taken and the link rotates at the bearing, at the height h along its axis.

    Distinguished by:
        payloads, and poses in which the load acts across the axis. Compliance of joint 1 resembles
        a compliant foundation.

    Source:
        Radkhah et al., Eq. (3); Nubiola and Bonev (2013) for joints alone.
    """

    name: ClassVar[str] = "bearing_elasticity"
    meaning: ClassVar[str] = "the bearing tilts under load across its axis"
    acts_on: ClassVar[str] = "tilt"
    axes: ClassVar[str] = "xy"

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        yield Candidate(cls())


GEOMETRIC: tuple[Effect, ...] = (JointOffset(), LinkGeometry(), AxisDistortion())
ELASTIC: tuple[Effect, ...] = (*GEOMETRIC, JointElasticity(), BearingElasticity())
