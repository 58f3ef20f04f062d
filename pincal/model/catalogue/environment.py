"""Effects of temperature, time and instrument on lengths and base."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet
from pincal.model.effect import Candidate, Discoverable, Locus, Term
from pincal.model.effect_bases import GROWTH, TILT, joint_index, parameters_of, recorded
from pincal.parameters import FRAME_SYMBOLS, Parameter, Scope


@dataclass(frozen=True)
class ThermalExpansion(Discoverable):
    """Thermal expansion of lengths: by alpha_T (T - reference) times their nominal value.

    For the whole arm these are d and a of every joint, and the constant offsets from the base to
    joint 1 and from the last link to the tip, which act on base and tool x, y, z: the URDF's frames
    determine which of a robot's lengths are d and a. For one joint it is the vector from the URDF's
    joint to the next joint, or to the tip: d and a, without the parts of d and of the next joint's
    d beyond these joints.

    Distinguished by:
        the same poses cold and warm, stretched out and folded: expansion is proportional to the
        arm's length. A temperature-dependent scale of the instrument is equivalent, unless it
        measures a known length.

    Source:
        Heisel, Richter and Wurst (1997).

    Attributes:
        joint: the joint that moves the only link that expands; None for the whole arm.
        reference: temperature at which lengths are nominal [deg C]; another value only changes the
            lengths.
    """

    joint: str | None = None
    reference: float = 20.0
    name: ClassVar[str] = "thermal_expansion"
    meaning: ClassVar[str] = "the links expand with temperature"

    @property
    def locus(self) -> Locus:
        return Locus(self.joint, "lengths", "temperature")

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        yield from (Candidate(cls(joint)) for joint in (*situation.joints, None))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Coefficient of expansion [1/K]."""
        return parameters_of(self, self.joint or "arm", ("alpha_T",), unit="1/K", size=GROWTH)

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        warm = recorded(self, "temperature", conditions.temperature) - self.reference
        return tuple(
            Term(0, k, length * warm)
            for k, length in lengths_that_grow(chain, self.joint).items()
            if length
        )


@dataclass(frozen=True)
class BaseDrift(Discoverable):
    """Drift of base or instrument: its coordinates change by rate times (time - reference).

    Distinguished by:
        measuring one target on the base or the floor repeatedly, which shows the instrument's own
        drift. Repeating the first poses of the robot at the end shows the rest.

    Source:
        drift of pose characteristics in ISO 9283.

    Attributes:
        reference: time without drift [s]; the mean is well conditioned, another value only changes
            the base.
        turns: whether it also rotates.
    """

    reference: float = 0.0
    turns: bool = True
    name: ClassVar[str] = "base_drift"
    meaning: ClassVar[str] = "robot and instrument drift relative to each other"
    scope: ClassVar[Scope] = "station"
    locus: ClassVar[Locus] = Locus(None, "base", "time")

    @classmethod
    def over(cls, time: np.ndarray, *, turns: bool = True) -> BaseDrift:
        """Return the drift about the mean of the times [s]."""
        return cls(float(np.mean(time)), turns)

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        """Yield it once: translation alone, and with rotation."""
        time = situation.conditions.time
        effect = cls() if time is None else cls.over(time)
        yield Candidate(effect, variants=(replace(effect, turns=False), effect))

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Rates along the instrument's axes [m/s] and about the base's [rad/s]."""
        shift = parameters_of(
            self, "base", [f"{s}_t" for s in FRAME_SYMBOLS[:3]], unit="m/s", size=GROWTH
        )
        if not self.turns:
            return shift
        return shift + parameters_of(
            self, "base", [f"{s}_t" for s in FRAME_SYMBOLS[3:]], unit="rad/s", size=GROWTH
        )

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        since = recorded(self, "time", conditions.time) - self.reference
        return tuple(
            Term(p, chain.base(symbol), since)
            for p, symbol in enumerate(FRAME_SYMBOLS[: 6 if self.turns else 3])
        )


@dataclass(frozen=True)
class MeasurementScale(Discoverable):
    """Scale error of an instrument: every length is measured (1 + s) times as long.

    To first order d and a of every joint (and the travel of a prismatic one) grow by s; base and
    tool are constants, absorbed by their own parameters. With all lengths free this adds nothing
    (rank 0): it needs a known length, such as links fixed at their nominal lengths.

    Distinguished by:
        a known length, such as a scale bar next to the robot: with all link lengths free, a larger
        robot and a smaller unit of length are equivalent.

    Source:
        length measurement errors of laser trackers in ISO 10360-10.
    """

    name: ClassVar[str] = "measurement_scale"
    meaning: ClassVar[str] = "the instrument's lengths have a scale error"
    scope: ClassVar[Scope] = "station"
    locus: ClassVar[Locus] = Locus(None, "lengths")

    @classmethod
    def candidates(cls, situation: PoseSet) -> Iterator[Candidate]:
        yield Candidate(cls())

    def parameters(self, chain: Chain) -> tuple[Parameter, ...]:
        """Relative error of the scale [1]."""
        return parameters_of(self, "instrument", ("scale",), unit="1", size=TILT)

    def terms(
        self, chain: Chain, conditions: Conditions, moments: np.ndarray | None
    ) -> tuple[Term, ...]:
        ones = np.ones(len(conditions))
        types = chain.robot.joint_types
        ways = {
            int(k): conditions.q[:, i]
            for i, k in enumerate(chain.drives)
            if types[i] == "prismatic"
        }
        lengths = {k: length * ones + ways.get(k, 0.0) for k, length in _lengths(chain).items()}
        return tuple(Term(0, k, length) for k, length in lengths.items() if np.any(length))


def lengths_that_grow(chain: Chain, joint: str | None) -> dict[int, float]:
    """Return the expanding lengths of the link that a joint moves, or of the whole arm, by
    coordinate [m].
    """
    return _whole(chain) if joint is None else _link(chain, joint_index(chain, joint))


def _lengths(chain: Chain) -> dict[int, float]:
    """Return the nominal lengths of the links by coordinate [m]: d and a of every joint, and the
    mounts of branches.
    """
    places = [chain.joint(i, symbol) for i in range(chain.robot.n_joints) for symbol in "da"]
    lengths = {k: float(chain.nominal[k]) for k in places}
    for i, T in zip(chain.robot.frames.branches, chain.robot.frames.T_branch_first, strict=True):
        for symbol, way in zip(("x", "y", "d"), T[:3, :3].T @ T[:3, 3], strict=True):
            k = chain.joint(i, symbol)
            lengths[k] = lengths.get(k, 0.0) + float(way)
    return lengths


def _whole(chain: Chain) -> dict[int, float]:
    """Return all lengths from the base to the tip by coordinate [m]."""
    to_first = chain.base_rotation @ chain.robot.frames.T_base_first[:3, 3]
    base = {chain.base(symbol): float(way) for symbol, way in zip("xyz", to_first, strict=True)}
    return base | _lengths(chain) | _flange(chain)


def _flange(chain: Chain) -> dict[int, float]:
    """Return the vector from the last link's frame to the tip, in the axes of the tip, by
    coordinate [m].
    """
    T = chain.path.T_joint_tip
    return {
        chain.tool(symbol): float(way)
        for symbol, way in zip("xyz", T[:3, :3].T @ T[:3, 3], strict=True)
    }


def _link(chain: Chain, i: int) -> dict[int, float]:
    """Return the vector from joint i to the next, as the URDF places them, by coordinate [m].

    With u_i the height of the URDF's joint i on its axis:  p_(i+1) - p_i = (d_i - u_i) z_i + a_i
    x_i + u_(i+1) z_(i+1).
    """
    d = chain.joint(i, "d")
    a = chain.joint(i, "a")
    way = {d: float(chain.nominal[d]) - chain.height_on_axis(i), a: float(chain.nominal[a])}
    if i == chain.path.tip_joint:
        return way | _flange(chain)
    following = chain.robot.next_joint(i)
    return (
        way
        if following is None
        else way | {chain.joint(following, "d"): chain.height_on_axis(following)}
    )
