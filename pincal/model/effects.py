"""Effects: physical causes, each with named parameters and what they add to the coordinates of the chain.

An effect knows no chain but by the names of coordinates, and the chain knows no effect. Coordinates are sums over effects,

    x_k(pose) = nominal_k + sum over terms of  basis(pose) * parameter,

so the order of effects means nothing, and a new effect is one small class: its parameters and its terms.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.model.chain import Chain
from pincal.parameters import FRAME_SYMBOLS, Parameter, Scope

# Size of real errors by kind [rad, m], used as prior where the data can't tell. The paper (IV.C) knows of deviations of
# up to 1 cm at the tip; makers' tolerances are some tenths of a mm and of a mrad, cobots' several times that.
ANGLE_SIZE = 3e-3
LENGTH_SIZE = 3e-3
BENDING_SIZE = 1e-3


@dataclass(frozen=True)
class Conditions:
    """What is known of each of N poses before anything is measured.

    Attributes:
        q: shape (N, n), joint positions [rad or m].
        target: shape (N,), index into the chain's targets.
        payload: shape (N,), mass at the tip [kg].
        payload_centre: shape (3,), its centre of mass in the tip frame [m].
        temperature: shape (N,) [deg C], or None.
        time: shape (N,) [s], or None.
        approach: shape (N, n), direction from which each joint arrived (-1, 0, 1), or None.
    """

    q: np.ndarray
    target: np.ndarray
    payload: np.ndarray
    payload_centre: np.ndarray
    temperature: np.ndarray | None = None
    time: np.ndarray | None = None
    approach: np.ndarray | None = None

    @classmethod
    def at(cls, q: np.ndarray, *, payload: float = 0.0, payload_centre: Iterable[float] = (0.0, 0.0, 0.0)) -> Conditions:
        """Return the conditions of bare joint positions, shape (N, n), with one payload [kg] and the first target."""
        q = np.atleast_2d(np.asarray(q, float))
        n = len(q)
        return cls(q, np.zeros(n, int), np.full(n, float(payload)), np.array(list(payload_centre), float))

    def __len__(self) -> int:
        return len(self.q)

    def select(self, rows: slice | np.ndarray) -> Conditions:
        """Return the conditions of some rows."""
        pick = [None if v is None else v[rows] for v in (self.temperature, self.time, self.approach)]
        return Conditions(self.q[rows], self.target[rows], self.payload[rows], self.payload_centre, *pick)


@dataclass(frozen=True)
class Term:
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


class Effect(ABC):
    """A physical cause of deviations from the nominal robot.

    Attributes:
        name: its name in reports and files.
        scope: whose parameters it has: the robot's, or those of a station, the set-up of an instrument and its targets.
        uses_moments: whether its terms need the static moments.
        needs: what must be recorded of the poses: "temperature", "time", "approach", "payload".
        alike: whether its basis functions are one function in several places, as those of a curve: one that the poses
            hardly touch is as large as the others then, and its coefficient no larger.
    """

    name: ClassVar[str]
    scope: ClassVar[Scope] = "robot"
    uses_moments: ClassVar[bool] = False
    alike: ClassVar[bool] = False
    needs: ClassVar[tuple[str, ...]] = ()

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

    def missing(self, conditions: Conditions) -> tuple[str, ...]:
        """Return what the effect needs and these poses lack: columns that are absent or the same in all rows."""
        return tuple(column for column in self.needs if not _varies(getattr(conditions, column)))


def _varies(column: np.ndarray | None) -> bool:
    return column is not None and bool(np.any(column != column[:1]))


def _constants(name: str, chain: Chain, joints: Iterable[int], symbols: dict[str, float]) -> tuple[Parameter, ...]:
    """Parameters that shift one coordinate each by a constant."""
    return tuple(
        Parameter(
            name=f"{chain.robot.joint_names[i]}.{symbol}",
            unit="m" if symbol in "da" else "rad",
            effect=name,
            nominal=float(chain.nominal[chain.joint(i, symbol)]),
            size=size,
        )
        for i in joints
        for symbol, size in symbols.items()
    )


def _constant_terms(chain: Chain, joints: Iterable[int], symbols: Iterable[str]) -> tuple[Term, ...]:
    names = list(symbols)
    places = [(i, symbol) for i in joints for symbol in names]
    return tuple(Term(p, chain.joint(i, symbol)) for p, (i, symbol) in enumerate(places))


@dataclass(frozen=True)
class JointOffset(Effect):
    """The zero of each joint is off by a constant (paper: theta_i; d_i of a prismatic joint)."""

    name: ClassVar[str] = "joint_offset"

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """One offset a joint, named theta (d for a prismatic joint)."""
        found: tuple[Parameter, ...] = ()
        for i in range(chain.robot.n_joints):
            prismatic = chain.robot.joint_types[i] == "prismatic"
            symbols = {"d": LENGTH_SIZE} if prismatic else {"theta": ANGLE_SIZE}
            found += _constants(self.name, chain, [i], symbols)
        return found

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add to the coordinate that the joint drives."""
        return tuple(Term(i, int(k)) for i, k in enumerate(chain.drives))


@dataclass(frozen=True)
class LinkGeometry(Effect):
    """Link offset d, link length a and link twist alpha deviate (paper, Eq. (1))."""

    name: ClassVar[str] = "link_geometry"

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """d, a, alpha of each joint; theta in place of d for a prismatic joint, whose d is its joint offset."""
        found: tuple[Parameter, ...] = ()
        for i in range(chain.robot.n_joints):
            found += _constants(self.name, chain, [i], self._symbols(chain, i))
        return found

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add constants."""
        places = [(i, symbol) for i in range(chain.robot.n_joints) for symbol in self._symbols(chain, i)]
        return tuple(Term(p, chain.joint(i, symbol)) for p, (i, symbol) in enumerate(places))

    @staticmethod
    def _symbols(chain: Chain, i: int) -> dict[str, float]:
        if chain.robot.joint_types[i] == "prismatic":
            return {"theta": ANGLE_SIZE, "a": LENGTH_SIZE, "alpha": ANGLE_SIZE}
        return {"d": LENGTH_SIZE, "a": LENGTH_SIZE, "alpha": ANGLE_SIZE}


@dataclass(frozen=True)
class AxisDistortion(Effect):
    """The axis of motion is tilted by s_x, s_y before the joint turns (paper, Eq. (2))."""

    name: ClassVar[str] = "axis_distortion"
    _symbols: ClassVar[dict[str, float]] = {"s_x": ANGLE_SIZE, "s_y": ANGLE_SIZE}

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """s_x, s_y of each joint [rad]."""
        return _constants(self.name, chain, range(chain.robot.n_joints), self._symbols)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add constants."""
        return _constant_terms(chain, range(chain.robot.n_joints), self._symbols)


@dataclass(frozen=True)
class Compliance(Effect):
    """Elastic rotations gamma_l = k_l n_l about chosen axes of some joints (paper, III.B)."""

    joints: tuple[str, ...] | None = None
    axes: ClassVar[str] = ""
    uses_moments: ClassVar[bool] = True

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """One compliance an axis and joint [rad/(N m)]."""
        return tuple(
            Parameter(f"{chain.robot.joint_names[i]}.k_{axis}", "rad/(N m)", self.name, 0.0, BENDING_SIZE)
            for i in self._indices(chain)
            for axis in self.axes
        )

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add compliance times moment to the elastic rotation about the same axis."""
        assert moments is not None
        places = [(i, axis) for i in self._indices(chain) for axis in self.axes]
        terms = []
        for p, (i, axis) in enumerate(places):
            moment = 3 * i + "xyz".index(axis)
            terms.append(Term(p, chain.joint(i, f"gamma_{axis}"), moments[:, moment], moment))
        return tuple(terms)

    def _indices(self, chain: Chain) -> list[int]:
        names = chain.robot.joint_names
        return list(range(len(names))) if self.joints is None else [names.index(name) for name in self.joints]


@dataclass(frozen=True)
class JointElasticity(Compliance):
    """Each drive gives way about its own axis: gamma_z = k_z n_z."""

    name: ClassVar[str] = "joint_elasticity"
    axes: ClassVar[str] = "z"


@dataclass(frozen=True)
class BearingElasticity(Compliance):
    """Each bearing gives way across its axis: gamma_x = k_x n_x, gamma_y = k_y n_y."""

    name: ClassVar[str] = "bearing_elasticity"
    axes: ClassVar[str] = "xy"


@dataclass(frozen=True)
class BaseFrame(Effect):
    """Where the robot stands in the instrument's frame.

    Attributes:
        symbols: the released coordinates; a distance knows nothing of orientation, a contact nothing of either.
    """

    symbols: tuple[str, ...] = FRAME_SYMBOLS
    name: ClassVar[str] = "base_frame"
    scope: ClassVar[Scope] = "station"

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """x, y, z [m] and small angles rx, ry, rz [rad] about the chain's reference orientation."""
        return tuple(_frame_parameter("base", self.name, symbol) for symbol in self.symbols)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add constants."""
        return tuple(Term(p, chain.base(symbol)) for p, symbol in enumerate(self.symbols))


@dataclass(frozen=True)
class ToolFrame(Effect):
    """Where each target sits in the tip frame; a point target has no orientation."""

    symbols: tuple[str, ...] = FRAME_SYMBOLS[:3]
    name: ClassVar[str] = "tool_frame"
    scope: ClassVar[Scope] = "station"

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """x, y, z [m], and for poses rx, ry, rz [rad], of every target."""
        return tuple(_frame_parameter(t, self.name, symbol) for t in chain.targets for symbol in self.symbols)

    def terms(self, chain: Chain, conditions: Conditions, moments: np.ndarray | None) -> tuple[Term, ...]:
        """Add to the tool coordinates at the poses of the target."""
        terms = []
        for t in range(len(chain.targets)):
            here = None if len(chain.targets) == 1 else (conditions.target == t).astype(float)
            for j, symbol in enumerate(self.symbols):
                terms.append(Term(t * len(self.symbols) + j, chain.tool(symbol), here))
        return tuple(terms)


def _frame_parameter(element: str, effect: str, symbol: str) -> Parameter:
    return Parameter(f"{element}.{symbol}", "m" if symbol in "xyz" else "rad", effect, 0.0, float("inf"))


GEOMETRIC: tuple[Effect, ...] = (JointOffset(), LinkGeometry(), AxisDistortion())
ELASTIC: tuple[Effect, ...] = (*GEOMETRIC, JointElasticity(), BearingElasticity())
