"""The interface of the true machine's hidden effects.

Every effect is a small frozen value with the name that discovery reports, the joint on which it
acts and a size in the unit of its class; size 0 is no effect. Effects are derived from the
mechanism (crank, backlash, bumps), not from the linear basis functions of the fit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar

import numpy as np

from pincal.simulate.arm import Arm
from pincal.simulate.state import Deformation, Loads, Poses

HIDDEN_EFFECTS: dict[str, type[HiddenEffect]] = {}
"""The hidden effects of pincal, by the names that discovery reports."""

WINDUP = 1e-3
"""Typical wind-up of a drive under the largest moment of the arm [rad]."""


class Scope(Enum):
    """The part of the robot on which an effect acts."""

    JOINT = "joint"
    LINK_OR_ARM = "the link that a joint moves, or the whole arm without a joint"
    ARM = "the whole arm"


@dataclass(frozen=True)
class Site:
    """The location of an effect whose typical size depends on loads.

    Attributes:
        arm: The nominal arm.
        joint: Index of the joint on which the effect acts, 0 for the whole arm.
        moment: Rated moment of that joint [N m], positive.
        compliance: Compliance of its drive [rad/(N m)], 0 if rigid.
    """

    arm: Arm
    joint: int
    moment: float
    compliance: float


@dataclass(frozen=True, kw_only=True)
class HiddenEffect(ABC):
    """One physical cause in the true machine.

    Attributes:
        effect: Name of the effect.
        unit: Unit of ``size``; on a prismatic joint m instead of rad.
        scope: The part of the robot on which it acts.
        column: Column of the table without which the effect is not identifiable; None: no such
            column.
        typical_size: Typical size for any arm, in ``unit``.
        needs_order: Whether it depends on the preceding poses; if its column is the approach, only
            if that is not recorded.
        joint: Joint on which it acts, None for an effect of the whole arm.
        size: Its size in ``unit``.
    """

    effect: ClassVar[str]
    unit: ClassVar[str] = "rad"
    scope: ClassVar[Scope] = Scope.JOINT
    column: ClassVar[str | None] = None
    typical_size: ClassVar[float] = 0.0
    needs_order: ClassVar[bool] = False
    joint: str | None = None
    size: float = 0.0

    def __init_subclass__(cls) -> None:
        """Register an effect of pincal by its name."""
        super().__init_subclass__()
        if "effect" in vars(cls) and cls.__module__.startswith("pincal."):
            HIDDEN_EFFECTS[cls.effect] = cls

    @classmethod
    def typical_joints(cls, arm: Arm) -> list[str]:
        """Return the joints at which the effect is typical: all, unless the class
        states otherwise.
        """
        return list(arm.names)


def needs_order(effects: Iterable[HiddenEffect], poses: Poses) -> bool:
    """Return whether effects depend on the preceding poses."""
    return any(
        e.needs_order and (poses.approach is None or e.column != "approach") for e in effects
    )


class SizedByLoad:
    """An effect of loads: it needs an arm with masses, which determine its typical size.

    Attributes:
        at_largest: Typical deflection under the rated moment, for a size per moment [rad].
    """

    at_largest: ClassVar[float]

    @classmethod
    def typical_fields(cls, site: Site) -> dict[str, Any]:
        """Return typical values of the fields that depend on the arm, ``size`` among them."""
        return {"size": cls.at_largest / site.moment}


class DeformingEffect(HiddenEffect):
    """An effect that moves a part of the arm."""

    @abstractmethod
    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        """Add the effect in each pose, in the working frames of the true arm, to the deformation in
        place.
        """


class DriveEffect(DeformingEffect):
    """An effect that moves one joint about or along its axis."""

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        joint = arm.index(self.joint)
        deformation.joint[:, joint] += self._motion(joint, poses, loads)

    @abstractmethod
    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        """Return the addition to the position of the joint with this index [rad or m],
        shape (N,).
        """


class ReadBackEffect(DriveEffect):
    """A motion of a drive that its encoder measures: the table has ``read_<joint>`` next to the
    commanded position.
    """

    def read_back(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        """Return the encoder's reading of the joint with this index [rad or m], shape (N,)."""
        return np.asarray(poses.q[:, joint] + self._motion(joint, poses, loads))
