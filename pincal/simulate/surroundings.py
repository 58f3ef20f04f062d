"""Hidden effects of temperature, time and payload on the whole arm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from pincal.simulate.arm import Arm
from pincal.simulate.effect import DeformingEffect, HiddenEffect, Scope, Site, SizedByLoad
from pincal.simulate.state import Deformation, Loads, Poses


@dataclass(frozen=True, kw_only=True)
class ThermalExpansion(DeformingEffect):
    """Links that grow with temperature; ``size`` is the coefficient of expansion [1/K].

    Attributes:
        joint: Only the link that this joint moves grows; None for all links, base and tool flange included.
    """

    effect: ClassVar[str] = "thermal_expansion"
    unit: ClassVar[str] = "1/K"
    typical_size: ClassVar[float] = 1.2e-5
    column: ClassVar[str | None] = "temperature"
    scope: ClassVar[Scope] = Scope.LINK_OR_ARM

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        """Scale the distance from each joint to the next."""
        _grow(arm, deformation, self.joint, self.size * poses.temperature)


@dataclass(frozen=True, kw_only=True)
class ThermalGrowth(DeformingEffect):
    """Links that grow as the arm warms up by itself; ``size`` is their relative growth in the end [-].

    Attributes:
        joint: Only the link that this joint moves grows; None for all links, base and tool flange included.
        time_constant: Time after which 63 % of it are over [s].
    """

    effect: ClassVar[str] = "thermal_growth"
    unit: ClassVar[str] = "1"
    typical_size: ClassVar[float] = 1.2e-4
    column: ClassVar[str | None] = "time"
    scope: ClassVar[Scope] = Scope.LINK_OR_ARM
    time_constant: float = 3000.0

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        """Scale the distance from each joint to the next."""
        _grow(arm, deformation, self.joint, -self.size * np.expm1(-np.maximum(poses.time, 0.0) / self.time_constant))


def _grow(arm: Arm, deformation: Deformation, joint: str | None, growth: np.ndarray) -> None:
    """Scale the link that a joint moves, or all, base and flange included, by relative growths, shape (N,)."""
    for i in range(len(arm.names)) if joint is None else [arm.index(joint)]:
        shift = growth[:, None] * arm.placements[i + 1][:3, 3]
        deformation.add_at_end_of_link(arm, i, np.hstack((shift, np.zeros_like(shift))))
    if joint is None:
        deformation.base[:, :3] += growth[:, None] * arm.placements[0][:3, 3]


@dataclass(frozen=True, kw_only=True)
class BaseDrift(DeformingEffect):
    """Base, or instrument, that creeps with time; ``size`` is the speed [m/s].

    Attributes:
        direction: Direction of the creep in the base frame, shape (3,), of length 1.
        rotation: Rate of turn about the base axes [rad/s] per m/s of ``size``, shape (3,).
    """

    effect: ClassVar[str] = "base_drift"
    unit: ClassVar[str] = "m/s"
    typical_size: ClassVar[float] = 2e-8
    column: ClassVar[str | None] = "time"
    scope: ClassVar[Scope] = Scope.ARM
    direction: tuple[float, float, float] = (0.8, 0.6, 0.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        """Move the base on."""
        path = self.size * poses.time[:, None]
        deformation.base[:, :3] += path * np.asarray(self.direction)
        deformation.base[:, 3:] += path * np.asarray(self.rotation)


@dataclass(frozen=True, kw_only=True)
class PayloadError(HiddenEffect, SizedByLoad):
    """Payload that differs from the table; ``size`` is the mass that the table lacks [kg].

    It counts where the table declares a payload, and everywhere if it declares none at all.

    Attributes:
        com_shift: True minus declared centre of mass of the payload in the tip frame [m], shape (3,).
    """

    effect: ClassVar[str] = "payload_error"
    unit: ClassVar[str] = "kg"
    scope: ClassVar[Scope] = Scope.ARM
    com_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def typical_fields(cls, site: Site) -> dict[str, Any]:
        """Return an error of 1 % of the arm's mass."""
        return {"size": 0.01 * float(site.arm.masses.sum())}

    def true_payload(self, mass: np.ndarray, com: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the true mass [kg], shape (N,), and centre of mass [m, tip frame], shape (N, 3), for those of the table."""
        carried = mass > 0.0 if np.any(mass > 0.0) else np.ones(len(mass), bool)
        return mass + self.size * carried, com + np.asarray(self.com_shift)
