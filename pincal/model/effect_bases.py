"""Common parts of the catalogue's effects: effects of one drive, recorded columns, tilts, moments
in other axes.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.errors import BadInputError, nearest_first
from pincal.model.chain import Chain
from pincal.model.conditions import MOMENT, Conditions, PoseSet
from pincal.model.effect import Candidate, Discoverable, Effect, Family, Locus, Term
from pincal.parameters import Parameter
from pincal.thresholds import Scale

# Typical sizes of effects on their coordinates [rad or m]: some tenths of a milliradian or of a
# millimetre, ratios of a thousandth. They serve as priors of parameters that the data do not
# determine, so only the order of magnitude matters.
PLAY: Scale = 2e-4
WAVE: Scale = 3e-4
TILT: Scale = 1e-4
GROWTH: Scale = 3e-4
RATIO: Scale = 1e-3

# Direction cosine below which a moment has no component along an axis: rounding of a URDF's
# rotations.
_ACROSS: Scale = 1e-12


def joint_index(chain: Chain, joint: str) -> int:
    """Return the index of a joint, 0 at the base.

    Raises:
        BadInputError: if the arm has no such joint.
    """
    names = chain.robot.joint_names
    if joint not in names:
        raise BadInputError(
            f"joint {joint!r}: not on this arm; expected one of "
            f"{', '.join(nearest_first([joint], names))}"
        )
    return names.index(joint)


def drive_unit(chain: Chain, joint: str) -> str:
    """Return the unit of a joint's position."""
    return chain.robot.joint_units[joint_index(chain, joint)]


def positions(chain: Chain, conditions: Conditions, joint: str) -> np.ndarray:
    """Return the recorded positions of a joint, shape (N,) [rad or m]."""
    return np.asarray(conditions.q[:, joint_index(chain, joint)])


def recorded(effect: Effect, column: str, values: np.ndarray | None) -> np.ndarray:
    """Return a column of conditions.

    Raises:
        BadInputError: if these poses lack it.
    """
    if values is None:
        raise BadInputError(
            f"{effect.name} needs the column {column}, which these poses lack; add it"
        )
    return values


def parameters_of(
    effect: Effect, element: str, symbols: Iterable[str], *, unit: str, size: float
) -> tuple[Parameter, ...]:
    """Return parameters of one element with the same unit and typical size; each is zero in the
    nominal robot.
    """
    return tuple(
        Parameter(f"{element}.{symbol}", unit, effect.name, 0.0, size) for symbol in symbols
    )


def waves(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sine and cosine of angles [rad]."""
    return np.sin(angle), np.cos(angle)


def turning(chain: Chain, conditions: Conditions, i: int) -> np.ndarray:
    """Return the rotations from the axes of joint i after q to those before q, shape (N, 3, 3), by
    nominal theta.
    """
    turned = np.zeros((len(conditions), 3, 3), conditions.q.dtype)
    turned_by = (
        conditions.q[:, i]
        if chain.robot.joint_types[i] != "prismatic"
        else np.zeros(len(conditions))
    )
    sine, cosine = waves(chain.nominal[chain.joint(i, "theta")] + turned_by)
    turned[:, 0, 0] = turned[:, 1, 1] = cosine
    turned[:, 0, 1] = -sine
    turned[:, 1, 0] = sine
    turned[:, 2, 2] = 1.0
    return turned


def tilt_terms(
    chain: Chain,
    conditions: Conditions,
    joint: str,
    *,
    seen_from: str,
    tilts: Iterable[tuple[int, int, np.ndarray]],
) -> tuple[Term, ...]:
    """Return the terms of tilts of a revolute joint's axis about its bearing.

    A bearing off the origin of its frame tilts where its compliance acts; one at the origin tilts
    by s_x and s_y. Each tilt is a parameter, an axis (0 for x, 1 for y) and a basis, shape (N,), in
    the axes "before" or "after" q (``seen_from``).
    """
    i = joint_index(chain, joint)
    side, symbol = (chain.moment_frame, "gamma") if chain.bearing_heights[i] else ("before", "s")
    at = chain.joint(i, f"{symbol}_x"), chain.joint(i, f"{symbol}_y")
    if seen_from == side:
        return tuple(Term(parameter, at[axis], basis) for parameter, axis, basis in tilts)
    turned = turning(chain, conditions, i)
    turned = turned if side == "before" else turned.transpose(0, 2, 1)
    return tuple(
        Term(p, at[c], turned[:, c, axis] * basis) for p, axis, basis in tilts for c in range(2)
    )


def moment_axes(chain: Chain, conditions: Conditions, i: int) -> np.ndarray:
    """Return the rotations from the axes in which the chain takes joint i's moment to those before
    q, (N, 3, 3).
    """
    if chain.moment_frame == "after":
        return turning(chain, conditions, i)
    return np.broadcast_to(np.eye(3), (len(conditions), 3, 3))


def moment_terms(
    parameter: int, coordinate: int, i: int, *, axis: np.ndarray, moments: np.ndarray
) -> tuple[Term, ...]:
    """Return the terms of one parameter driven by the moment of joint i about an axis, one for each
    component.

    The axis, shape (N, 3), is given in the axes of the moment; ``moments`` are the static ones,
    shape (N, 3 n) [N m].
    """
    return tuple(
        Term(
            parameter, coordinate, axis[:, c] * moments[:, 3 * i + c], 3 * i + c, axis[:, c].copy()
        )
        for c in range(3)
        if np.abs(axis[:, c]).max(initial=0.0) > _ACROSS
    )


@dataclass(frozen=True)
class DriveEffect(Discoverable):
    """An effect that rotates one joint about its axis, or moves it along: basis functions times
    parameters.

    Attributes:
        joint: the joint.
        symbol: of its parameter, if it has only one.
        unit: of its parameters; empty for the unit of the joint's position.
        typical: their typical size.
        acts_on: "drive", or "gamma_z" for the elastic rotation.
        follows: its independent variable; empty for the joint's own position.
        recorded_as: column of the table that holds this variable.
        turns: whether only revolute joints have it.
    """

    joint: str
    symbol: ClassVar[str] = ""
    unit: ClassVar[str] = ""
    typical: ClassVar[float]
    acts_on: ClassVar[str] = "drive"
    follows: ClassVar[str] = ""
    recorded_as: ClassVar[str] = ""
    turns: ClassVar[bool] = False

    @property
    def locus(self) -> Locus:
        """Its joint and the variable that it depends on."""
        return Locus(self.joint, self.acts_on, self.follows or self.joint)

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield it on every joint, or on every revolute one."""
        yield from (
            Candidate(cls(joint))
            for joint in (situation.revolute if cls.turns else situation.joints)
        )

    def symbols(self) -> Sequence[str]:
        """Return the symbols of its parameters."""
        return (self.symbol,)

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Factors of its basis functions."""
        unit = self.unit or drive_unit(chain, self.joint)
        return parameters_of(self, self.joint, self.symbols(), unit=unit, size=self.typical)

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        """Add the basis functions to the joint's position, or to its elastic rotation."""
        k = self.coordinate(chain)
        return tuple(Term(p, k, basis) for p, basis in enumerate(self.bases(chain, conditions)))

    def coordinate(self, chain: Chain) -> int:
        """Return the coordinate that it adds to."""
        return chain.joint_or_drive(joint_index(chain, self.joint), self.acts_on)

    def bases(self, chain: Chain, conditions: Conditions) -> Iterable[np.ndarray]:
        """Return the basis function of each parameter, shape (N,); by default the independent
        variable alone.
        """
        return (self.variable(chain, conditions),)

    def variable(self, chain: Chain, conditions: Conditions) -> np.ndarray:
        """Return the independent variable, shape (N,)."""
        if not self.follows:
            return positions(chain, conditions, self.joint)
        column = recorded(
            self, self.recorded_as.replace("<joint>", self.joint), conditions.column(self.follows)
        )
        return column if column.ndim == 1 else column[:, joint_index(chain, self.joint)]


class DriveInMotion(DriveEffect):
    """A function of a joint's own velocity; without recorded velocities the poses were held."""

    follows: ClassVar[str] = "velocity"
    needs: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield it on every joint that moves while it is measured."""
        velocity = situation.conditions.velocity
        moves = np.zeros(0) if velocity is None else np.ptp(velocity, axis=0)
        yield from (
            Candidate(cls(joint))
            for joint, moving in zip(situation.joints, moves, strict=False)
            if moving
        )

    def variable(self, chain: Chain, conditions: Conditions) -> np.ndarray:
        """Return the function at the joint's velocity, shape (N,); zero at rest."""
        if conditions.velocity is None:
            return np.zeros(len(conditions))
        return self.of_velocity(conditions.velocity[:, joint_index(chain, self.joint)])

    @abstractmethod
    def of_velocity(self, velocity: np.ndarray) -> np.ndarray:
        """Return the function at velocities of shape (N,) [rad/s, prismatic m/s]."""


class DriveWaves(DriveEffect):
    """Sines and cosines of multiples of a joint's own position.

    Attributes:
        pattern: format of the symbols of its amplitudes, in terms of ``wave`` and ``order``.
    """

    unit: ClassVar[str] = "rad"
    pattern: ClassVar[str]
    turns: ClassVar[bool] = True

    @property
    @abstractmethod
    def orders(self) -> tuple[float, ...]:
        """The orders (cycles per revolution) of its components."""

    def symbols(self) -> Sequence[str]:
        """Return the symbols of its amplitudes; an underscore replaces the decimal point, which
        names reserve.
        """
        marks = [f"{order:.10g}".replace(".", "_") for order in self.orders]
        return [
            self.pattern.format(wave=wave, order=mark) for mark in marks for wave in ("sin", "cos")
        ]

    def bases(self, chain: Chain, conditions: Conditions) -> Iterable[np.ndarray]:
        q = positions(chain, conditions, self.joint)
        return [wave for order in self.orders for wave in waves(order * q)]


class DriveHarmonic(DriveWaves):
    """Waves of a joint's own position, identified by their fundamental ``order`` (cycles per
    revolution).
    """

    order: float

    @property
    def orders(self) -> tuple[float, ...]:
        return (self.order,)

    @property
    def locus(self) -> Locus:
        return Locus(self.joint, self.acts_on, self.joint, order=self.order)


class LoadedDrive(DriveEffect):
    """A function of the static moment on a joint's axis, in addition to the linear compliance that
    every drive has.
    """

    follows: ClassVar[str] = MOMENT
    turns: ClassVar[bool] = True
    family: ClassVar[Family] = Family.LOAD
    uses_moments: ClassVar[bool] = True

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        """Add the function with its slope, so that the Jacobian through the moments is exact."""
        assert moments is not None
        moment = 3 * joint_index(chain, self.joint) + 2
        basis, slope = self.of_moment(chain, conditions, moments[:, moment])
        return (Term(0, self.coordinate(chain), basis, moment, slope),)

    @abstractmethod
    def of_moment(
        self, chain: Chain, conditions: Conditions, moment: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the function at moments [N m] and its derivative, both of shape (N,)."""
