"""The interface of effects: physical causes with named parameters and their contributions to a
chain's coordinates.

An effect addresses a chain by the names of its coordinates only, and a chain is independent of
effects. With

    x_k(pose) = nominal_k + sum over terms of  basis(pose) * parameter,

the order of effects does not matter, and a new effect is one small class: its parameters, terms and
description. Discovery, reports, the viewer and the design of measurements use effects through this
interface alone.
"""

from __future__ import annotations

import warnings
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
    """Contribution of one parameter to one coordinate: ``basis * parameter``.

    Attributes:
        parameter: index among the effect's parameters.
        coordinate: index in the chain.
        basis: shape (N,), or None for 1 at every pose.
        moment: index 3 i + component of the static moment on which the basis depends, or None.
        slope: shape (N,), derivative of the basis by this moment; None for 1. Only with ``moment``.
    """

    parameter: int
    coordinate: int
    basis: np.ndarray | None = None
    moment: int | None = None
    slope: np.ndarray | None = None


class Body(NamedTuple):
    """Contribution of one unit of a parameter to the mass of a link.

    Attributes:
        parameter: index among the effect's parameters.
        joint: index of the joint that moves the link; the next joint does not.
        mass: [kg].
        moment: first moment of mass in the joint's link frame [kg m].
    """

    parameter: int
    joint: int
    mass: float
    moment: tuple[float, float, float]


class Family(Enum):
    """Kind of cause, as far as the search for missing effects distinguishes them."""

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
        joint: the joint it acts on; None for several joints, the whole arm, its base or the
            instrument.
        acts_on: what it moves: "drive" (about or along the joint's own axis), a coordinate of the
            joint such as "gamma_x", "tilt" (both directions across its axis), "link", "lengths",
            "base" or "tool".
        follows: its independent variable: the name of a joint, for its position, "approach",
            "moment", "payload", "temperature" or "time"; None for a constant, or if there is no
            single variable.
        order: cycles per revolution.
        frame: the side of a joint in whose frame it is constant: "before" or "after".
        shape: the form of an unnamed dependence.
        place: breakpoint along the variable [unit of the variable].
        station: name of the only station that has it, if there are several; None for all of them.
        cause: name of the effect of which it is an instance, if not its own.
        span: observed range of the variable, beyond which the effect is constant.
        own_order: cycles per revolution of its joint, of a function of two joints.
        own_span: observed range of its joint, beyond which a function of two joints is constant.
        on_rail: whether the variable is the position of a prismatic joint, of which waves have a
            period [m] and no cycles per revolution.
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
    own_order: float | None = None
    own_span: tuple[float, float] | None = None
    on_rail: bool = False

    @property
    def period(self) -> float | None:
        """Length after which waves along a prismatic joint repeat [m]; None for all others."""
        return 2.0 * np.pi / self.order if self.on_rail and self.order else None

    @property
    def source(self) -> str | None:
        """The joint whose position it depends on, if not the joint it acts on."""
        is_joint = (
            self.follows is not None and self.follows != MOMENT and self.follows not in RECORDABLE
        )
        return self.follows if is_joint and self.follows != self.joint else None


class Effect(ABC):
    """A physical cause of deviations from the nominal robot.

    Attributes:
        name: its name in reports and files.
        meaning: how a machine with this effect behaves, in plain words.
        family: kind of cause.
        scope: owner of its parameters: the robot, or a station, the set-up of an instrument and its
            targets.
        is_constant: whether it is constant after a calibration, so that a diagnosis tests no change
            of it.
        uses_moments: whether its terms need the static moments.
        shares_scale: whether its basis functions are translates of one function, as those of a
            curve, and share one scale, even those that the poses hardly excite.
    """

    name: ClassVar[str]
    meaning: ClassVar[str]
    family: ClassVar[Family] = Family.CAUSE
    scope: ClassVar[Scope] = "robot"
    is_constant: ClassVar[bool] = False
    uses_moments: ClassVar[bool] = False
    shares_scale: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # Names of 0.1.0, for one release.
        for old, new in {"looks": "trials", "alike": "shares_scale"}.items():
            if old in vars(cls):
                warnings.warn(f"Effect.{old} is now Effect.{new}", DeprecationWarning, stacklevel=2)
                setattr(cls, new, vars(cls)[old])

    @property
    @abstractmethod
    def locus(self) -> Locus:
        """Where it acts and what it depends on."""

    @property
    def is_sighted(self) -> bool:
        """Whether its terms need the target's position in the instrument's frame:
        ``Conditions.sighted``.
        """
        return False

    @property
    def least_moment(self) -> float:
        """Lower bound of the moment that scales its prior, as a fraction of the largest moment on
        the arm.
        """
        return 0.1

    @abstractmethod
    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Return the effect's parameters for this chain."""

    @abstractmethod
    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        """Return the contributions of its parameters to the coordinates.

        Args:
            chain: the chain.
            conditions: the N poses.
            moments: shape (N, 3 n), static moments [N m]; None for an effect that does not use
                them.
        """

    def bodies(self, chain: Chain) -> tuple[Body, ...]:
        """Return the contributions of its parameters to the masses that cause the static moments;
        none of most effects.
        """
        return ()

    def smoothness(self) -> np.ndarray | None:
        """Return the joint prior information on its K parameters beyond their sizes, shape (K, K);
        None if independent.
        """
        return None

    def belief(self, members: Sequence[Parameter]) -> np.ndarray | None:
        """Return the joint prior information on its K parameters, shape (K, K).

        None without a known roughness, or if ``members`` are only some of its parameters.
        """
        smooth = self.smoothness()
        if smooth is None or len(smooth) != len(members):
            return None
        return smooth + np.diag([parameter.size**-2.0 for parameter in members])

    @property
    def needs(self) -> tuple[str, ...]:
        """The columns that must be recorded with the poses."""
        follows = self.locus.follows
        return (follows,) if follows in RECORDABLE else ()

    def missing(self, conditions: Conditions) -> tuple[str, ...]:
        """Return the columns that the effect needs and that these poses lack or have the same value
        of in all rows.
        """
        return tuple(column for column in self.needs if not varies(conditions.column(column)))

    @cached_property
    def identity(self) -> tuple[str, Locus]:
        """Identity: two effects with the same one are variants of each other."""
        locus = replace(self.locus, place=None, span=None, own_span=None)
        return self.locus.cause or self.name, locus

    @property
    def trials(self) -> float:
        """Number of trials among which its place or frequency was selected, for which its p-value
        is corrected.
        """
        return 1.0

    @property
    def is_nameless(self) -> bool:
        """Whether it has no physical name."""
        return self.family is Family.NAMELESS

    @property
    def is_of_loads(self) -> bool:
        """Whether it is a load effect other than the linear compliance of every arm."""
        return self.family is Family.LOAD or (
            self.uses_moments and self.family is not Family.ELASTICITY
        )

    @property
    def heading(self) -> tuple[str, str | None, str | None]:
        """Name, joint, and for a named effect the source joint: effects with the same ones share a
        line of a summary.
        """
        return (
            self.locus.cause or self.name,
            self.locus.joint,
            None if self.is_nameless else self.locus.source,
        )


@dataclass(frozen=True)
class Candidate:
    """An effect at one place of an arm, as a discovery may try it.

    Attributes:
        effect: the effect.
        variants: the forms worth distinguishing, from few parameters to many; default: the effect
            itself. Empty if it can't be tried yet.
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
        """Yield the effect at every place of an arm where it could act, whether these poses excite
        it or not.
        """


class Reducible(ABC):
    """An effect that can be expressed in fewer parameters."""

    @abstractmethod
    def reduced(self, situation: PoseSet) -> Effect:
        """Return the effect in the fewest parameters, for which its detectable size is
        predicted.
        """


class Resolvable(Effect):
    """An effect whose resolution the data determine."""

    @abstractmethod
    def resolutions(self, situation: PoseSet) -> Sequence[Effect]:
        """Return the effect from coarse to fine, as far as the poses support it; empty if there is
        no choice.
        """


class Smoothable(Resolvable):
    """An effect that may be a part of a smooth function of two joints, a field, or is one.

    Attributes:
        height: of a field, standard deviation of the error [rad].
    """

    height: float

    @abstractmethod
    def fields(self, situation: PoseSet) -> Sequence[Smoothable]:
        """Return smooth functions of several lengths of which the effect may be a part, all of one
        height; empty if it can't be.
        """

    @abstractmethod
    def of_height(self, height: float) -> Smoothable:
        """Return a field of another height."""


class Curve(Discoverable, Reducible):
    """A drive error that is a free curve of its joint's position (family ``CURVE``), with a
    resolution set by the data.
    """

    family: ClassVar[Family] = Family.CURVE
    shares_scale: ClassVar[bool] = True

    @property
    @abstractmethod
    def resolution(self) -> int:
        """Number of basis functions."""

    @abstractmethod
    def resized(self, situation: PoseSet, resolution: int) -> Curve:
        """Return the curve with another number of basis functions, over the positions that the
        poses cover.
        """

    @abstractmethod
    def smooth(
        self, situation: PoseSet, roughness: float | None, resolution: int | None = None
    ) -> Curve:
        """Return the curve with so many pieces, or with fine ones, and with a smoothness prior if a
        roughness is given.
        """

    @abstractmethod
    def basis(self, q: np.ndarray) -> np.ndarray:
        """Return the basis functions at positions of shape (N,), shape (resolution, N)."""


class Harmonic(Discoverable):
    """A wave of a joint's own position, about its own axis, of any number of cycles per
    revolution.
    """

    band: ClassVar[tuple[float, float] | None] = None
    """Range of cycles per revolution in which a discovery searches; None if it can't be searched
    for.
    """

    @abstractmethod
    def tuned(self, order: float, chosen_among: float = 1.0) -> Harmonic:
        """Return the wave with another order (cycles per revolution), selected by the data among
        ``chosen_among``.
        """

    @property
    def same(self) -> tuple[Harmonic, ...]:
        """Other causes of exactly this wave, which no data can distinguish from it."""
        return ()

    @property
    def orders(self) -> tuple[float, ...]:
        """The orders (cycles per revolution) of its components."""
        return () if self.locus.order is None else (self.locus.order,)

    def suggested(self, resolution: float) -> Harmonic:
        """Return the cause that the order suggests, if known to ``resolution`` cycles per
        revolution; else itself.
        """
        return self

    def origin(self, order: float, resolution: float, wheels: Mapping[float, str]) -> str:
        """Return the origin that an order suggests, in words; empty if none, or if the match may be
        chance.

        Args:
            order: cycles per revolution.
            resolution: tolerance on the order, either way.
            wheels: description of each rotating part by its revolutions per revolution of the
                joint.
        """
        return ""


class ExponentialDrift(Discoverable):
    """An effect with a time constant, linearised about expected values of its parameters."""

    @abstractmethod
    def about(self, values: np.ndarray) -> ExponentialDrift:
        """Return the effect linearised about values of its parameters (less nominal); itself once
        they hardly change.
        """
