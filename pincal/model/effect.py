"""The interface of effects: physical causes, each with named parameters and what they add to a chain's coordinates.

An effect knows no chain but by the names of coordinates, and the chain knows no effect. Coordinates are sums over effects,

    x_k(pose) = nominal_k + sum over terms of  basis(pose) * parameter,

so the order of effects means nothing, and a new effect is one small class: its parameters, its terms, and what it says of
itself. All that discovery, reports, the viewer and the design of measurements know of an effect, they know from here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from pincal.model.chain import Chain
from pincal.model.conditions import MOMENT, Conditions, PoseSet, varies
from pincal.parameters import Parameter, Scope
from pincal.recorded import RECORDABLE


class Term(NamedTuple):
    """What one parameter adds to one coordinate: ``basis * parameter``.

    Attributes:
        parameter: index among the effect's parameters.
        coordinate: index in the chain.
        basis: shape (N,), or None for 1 at every pose.
        moment: index 3 i + component of the static moment that the basis is a function of, or None.
        slope: shape (N,), derivative of the basis by this moment; None for 1. Only with ``moment``.
    """

    parameter: int
    coordinate: int
    basis: np.ndarray | None = None
    moment: int | None = None
    slope: np.ndarray | None = None


class Body(NamedTuple):
    """What one unit of a parameter adds to the mass that a joint moves.

    Attributes:
        parameter: index among the effect's parameters.
        joint: index of the joint; the mass moves with it but not with the next.
        mass: [kg].
        moment: first moment of mass in the joint's link frame [kg m].
    """

    parameter: int
    joint: int
    mass: float
    moment: tuple[float, float, float]


class Family(Enum):
    """What kind of cause an effect is, as far as it matters to whoever looks for missing ones."""

    EXTRINSICS = "where the robot and its targets are"
    GEOMETRY = "constant deviations of links and joints"
    ELASTICITY = "linear compliance, which every arm has"
    LOAD = "load effects other than linear compliance"
    CURVE = "a drive error that is a free curve of the joint's position"
    CAUSE = "any other named cause"
    NAMELESS = "a dependence without a physical name"


@dataclass(frozen=True)
class Locus:
    """Where an effect acts, what it depends on, and what identifies it.

    Attributes:
        joint: the joint it acts on; None for several joints, the whole arm, its base or the instrument.
        acts_on: what it moves: "drive" (about or along the joint's own axis), a coordinate of the joint such as "gamma_x",
            "tilt" (both directions across its axis), "link", "lengths", "base" or "tool".
        follows: the variable that it is a function of: the name of a joint, for its position, "approach", "moment",
            "payload", "temperature" or "time"; None for a constant, or where there is no one variable.
        order: cycles per revolution.
        frame: the side of a joint from which it is seen: "before" or "after".
        shape: the form of a dependence without a name.
        place: where along the variable it breaks [unit of the variable].
        station: name of the station that alone has it, where there are several; None for all of them.
        cause: name of the effect that it is an instance of, where that is another's.
        span: lower and upper end of the variable as far as it was seen, beyond which it keeps its end value.
    """

    joint: str | None = None
    acts_on: str = ""
    follows: str | None = None
    order: float | None = None
    frame: str | None = None
    shape: str | None = None
    place: float | None = None
    station: str | None = None
    cause: str = ""
    span: tuple[float, float] | None = None

    @property
    def source(self) -> str | None:
        """The joint whose position it follows, if that is another one than it acts on."""
        is_joint = self.follows is not None and self.follows != MOMENT and self.follows not in RECORDABLE
        return self.follows if is_joint and self.follows != self.joint else None


class Effect(ABC):
    """A physical cause of deviations from the nominal robot.

    Attributes:
        name: its name in reports and files.
        meaning: what a machine with this effect does, in plain words.
        family: what kind of cause it is.
        scope: whose parameters it has: the robot's, or those of a station, the set-up of an instrument and its targets.
        stays: whether it stays as a calibration found it, so that rows of another day are not asked for a change of it.
        uses_moments: whether its terms need the static moments.
        alike: whether its basis functions are one function in several places, as those of a curve: one that the poses
            hardly touch is as large as the others then, and its coefficient no larger.
    """

    name: ClassVar[str]
    meaning: ClassVar[str]
    family: ClassVar[Family] = Family.CAUSE
    scope: ClassVar[Scope] = "robot"
    stays: ClassVar[bool] = False
    uses_moments: ClassVar[bool] = False
    alike: ClassVar[bool] = False

    @property
    @abstractmethod
    def locus(self) -> Locus:
        """Where it acts and what it follows."""

    @property
    def is_sighted(self) -> bool:
        """Whether its terms need where the instrument sees the target: ``Conditions.sighted``."""
        return False

    @property
    def least_moment(self) -> float:
        """Part of the largest moment on the arm that a moment it follows is taken as at least, when its size is judged."""
        return 0.1

    @abstractmethod
    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Return the effect's parameters for this chain."""

    @abstractmethod
    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Return what each parameter adds to which coordinate.

        Args:
            chain: the chain.
            conditions: the N poses.
            moments: shape (N, 3 n), static moments [N m]; None for an effect that does not use them.
        """

    def bodies(self, chain: Chain) -> tuple[Body, ...]:
        """Return what each parameter adds to the masses of which the static moments are taken; most add nothing."""
        return ()

    def smoothness(self) -> np.ndarray | None:
        """Return what is believed of its K parameters together, as information beyond their sizes, shape (K, K).

        None, as for most effects, if they are independent.
        """
        return None

    def belief(self, members: Sequence[Parameter]) -> np.ndarray | None:
        """Return what is believed of its K parameters if it is as rough as is known, as information, shape (K, K).

        None where no roughness is known, or these are some of the parameters only.
        """
        smooth = self.smoothness()
        if smooth is None or len(smooth) != len(members):
            return None
        return smooth + np.diag([parameter.size**-2.0 for parameter in members])

    @property
    def needs(self) -> tuple[str, ...]:
        """The columns that must be recorded of the poses."""
        follows = self.locus.follows
        return (follows,) if follows in RECORDABLE else ()

    def missing(self, conditions: Conditions) -> tuple[str, ...]:
        """Return what the effect needs and these poses lack: columns that are absent or the same in all rows."""
        return tuple(column for column in self.needs if not varies(conditions.column(column)))

    @cached_property
    def identity(self) -> tuple[str, Locus]:
        """What distinguishes it from other effects: two effects of one identity are variants of each other."""
        return self.locus.cause or self.name, replace(self.locus, place=None, span=None)

    @property
    def looks(self) -> float:
        """How many others its place or frequency was chosen among before it was tested: its p-value pays for them."""
        return 1.0

    @property
    def is_nameless(self) -> bool:
        """Whether it has no physical name."""
        return self.family is Family.NAMELESS

    @property
    def is_of_loads(self) -> bool:
        """Whether it is a load effect other than the linear compliance of every arm."""
        return self.family is Family.LOAD or (self.uses_moments and self.family is not Family.ELASTICITY)

    @property
    def heading(self) -> tuple[str, str | None, str | None]:
        """Name, joint, and of a named effect the source joint: effects that a summary calls the same have the same."""
        return self.locus.cause or self.name, self.locus.joint, None if self.is_nameless else self.locus.source


@dataclass(frozen=True)
class Candidate:
    """An effect in one place of an arm, as a discovery may try it.

    Attributes:
        effect: the effect.
        variants: the forms that are worth telling apart, from few parameters to many; default: itself. None of them
            if it can't be tried before more is known.
        obstacle: why it can't be tested, if the effect itself gives a reason; empty otherwise.
    """

    effect: Effect
    variants: tuple[Effect, ...] | None = None
    obstacle: str = ""

    @property
    def forms(self) -> tuple[Effect, ...]:
        """The variants, or the effect itself."""
        return (self.effect,) if self.variants is None else self.variants


class Discoverable(Effect):
    """An effect that a discovery searches for automatically."""

    @classmethod
    @abstractmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield the effect in every place of an arm where it could act, whether these poses show it or not."""


class Reducible(ABC):
    """An effect that can be stated in fewer parameters."""

    @abstractmethod
    def reduced(self, situation: PoseSet) -> Effect:
        """Return the effect in the fewest parameters, in which its detectable size is predicted."""


class Resolvable(Effect):
    """An effect that can be stated more or less finely, and that the data tell how finely."""

    @abstractmethod
    def resolutions(self, situation: PoseSet) -> Sequence[Effect]:
        """Return the effect from coarse to fine, as far as the poses carry it; none if there is nothing to choose."""


class Curve(Discoverable, Reducible):
    """A drive error that is any curve of its joint's position (family ``CURVE``), in a resolution that the data decide."""

    family: ClassVar[Family] = Family.CURVE
    alike: ClassVar[bool] = True

    @property
    @abstractmethod
    def resolution(self) -> int:
        """Number of basis functions."""

    @abstractmethod
    def resized(self, situation: PoseSet, resolution: int) -> Curve:
        """Return the curve with another number of basis functions, over the positions that the poses cover."""

    @abstractmethod
    def smooth(self, situation: PoseSet, roughness: float | None, resolution: int | None = None) -> Curve:
        """Return the curve in so many pieces, or in fine ones, as smooth as a roughness says, if one is given."""

    @abstractmethod
    def basis(self, q: np.ndarray) -> np.ndarray:
        """Return the basis functions at positions of shape (N,), shape (resolution, N)."""


class Harmonic(Discoverable):
    """A wave of a joint's own position, about its own axis, of any number of cycles per revolution."""

    band: ClassVar[tuple[float, float] | None] = None
    """Waves a turn among which a discovery searches; None if it can't be searched for."""

    @abstractmethod
    def tuned(self, order: float, chosen_among: float = 1.0) -> Harmonic:
        """Return the wave of another number of cycles per revolution, chosen among so many by what the data show."""

    @property
    def same(self) -> tuple[Harmonic, ...]:
        """Other causes of this very wave, which no data can tell from it."""
        return ()

    @property
    def orders(self) -> tuple[float, ...]:
        """The cycles per revolution that it consists of."""
        return () if self.locus.order is None else (self.locus.order,)

    def suggested(self, resolution: float) -> Harmonic:
        """Return the cause that the order of this wave suggests, known to so many cycles a revolution; else itself."""
        return self

    def origin(self, order: float, resolution: float, wheels: Mapping[float, str]) -> str:
        """Return what an order suggests of where a wave comes from, in words; empty if nothing, or as well by chance.

        Args:
            order: cycles per revolution.
            resolution: by how much they may be off, either way.
            wheels: what may turn so many times a turn, in words by this number.
        """
        return ""


class ExponentialDrift(Discoverable):
    """An effect with a time constant, linearised about what is expected of its parameters."""

    @abstractmethod
    def about(self, values: np.ndarray) -> ExponentialDrift:
        """Return the effect linearised about values of its parameters (less nominal); itself once they hardly move."""
