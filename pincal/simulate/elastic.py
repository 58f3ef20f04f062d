"""Hidden effects of loads (compliant drives, bearings, links and base) and of temperature, time and
payload on the arm.

A positive compliance turns a joint in the sense of the moment that gravity exerts on it: the arm
sags.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.effect import (
    WINDUP,
    DeformingEffect,
    DriveEffect,
    HiddenEffect,
    ReadBackEffect,
    Scope,
    Site,
    SizedByLoad,
)
from pincal.simulate.state import Deformation, Loads, Poses

MOMENT_FRAMES = ("paper", "before", "after")
"""Frames of a bearing's compliance.

``paper`` takes the components of the moment before q and rotates the link about the axes after q;
``before`` and ``after`` do both in one frame.
"""

# Reach of the arm for the default dimensions of the gravity compensator [m].
_COMPENSATOR_REACH = 2.6


@dataclass(frozen=True, kw_only=True)
class JointElasticity(DriveEffect, SizedByLoad):
    """Linear wind-up of a drive; ``size`` is the compliance c_z [rad/(N m)], or [m/N] for a
    prismatic joint.
    """

    effect: ClassVar[str] = "joint_elasticity"
    unit: ClassVar[str] = "rad/(N m)"
    at_largest: ClassVar[float] = 0.5 * WINDUP

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        return np.asarray(self.size * loads.drive[:, joint])


@dataclass(frozen=True, kw_only=True)
class BearingElasticity(DeformingEffect, SizedByLoad):
    """Bearing that is compliant about the transverse axes; ``size`` is the compliance about x
    [rad/(N m)].

    Attributes:
        size_y: Compliance about y [rad/(N m)]; that about x if None.
        moment_frame: One of ``MOMENT_FRAMES``.
    """

    effect: ClassVar[str] = "bearing_elasticity"
    unit: ClassVar[str] = "rad/(N m)"
    at_largest: ClassVar[float] = 0.3 * WINDUP
    size_y: float | None = None
    moment_frame: str = "paper"

    def __post_init__(self) -> None:
        if self.moment_frame not in MOMENT_FRAMES:
            raise BadInputError(
                f"moment_frame {self.moment_frame!r}; expected one of {', '.join(MOMENT_FRAMES)}"
            )

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        joint = arm.index(self.joint)
        moment = (loads.after if self.moment_frame == "after" else loads.before)[:, joint, :2]
        # A carriage tilts where it is; the axes before and after its motion are parallel.
        is_before = self.moment_frame == "before" and not arm.prismatic[joint]
        twist = deformation.before if is_before else deformation.after
        twist[:, joint, 3:5] += moment * np.array(
            [self.size, self.size if self.size_y is None else self.size_y]
        )


@dataclass(frozen=True, kw_only=True)
class NonlinearElasticity(DriveEffect, SizedByLoad):
    """Drive that stiffens with torque; ``size`` is the extra compliance near zero torque [rad/(N
    m)].

    The extra compliance falls to 1/sqrt(2) of its size at the torque ``stiffening``; its integral
    is the extra wind-up.

    Attributes:
        stiffening: Torque [N m].
    """

    effect: ClassVar[str] = "nonlinear_elasticity"
    unit: ClassVar[str] = "rad/(N m)"
    stiffening: float = 2000.0

    @classmethod
    def typical_fields(cls, site: Site) -> dict[str, Any]:
        """Return 0.3 mrad of extra wind-up at the rated moment, most of it in its first third."""
        stiffening = 0.3 * site.moment
        return {
            "size": 3e-4 / (stiffening * float(np.arcsinh(1.0 / 0.3))),
            "stiffening": stiffening,
        }

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        return np.asarray(
            self.size * self.stiffening * np.arcsinh(loads.drive[:, joint] / self.stiffening)
        )


@dataclass(frozen=True, kw_only=True)
class LoadBacklash(DriveEffect, SizedByLoad):
    """Backlash closed by the load; ``size`` is the full backlash [rad].

    Attributes:
        transition: Torque [N m] at which friction lets the joint move about 70 % of the way to one
            side.
    """

    effect: ClassVar[str] = "load_backlash"
    transition: float = 20.0

    @classmethod
    def typical_fields(cls, site: Site) -> dict[str, Any]:
        """Return a backlash of 0.2 mrad, closed by a fiftieth of the rated moment."""
        return {"size": 2e-4, "transition": 0.02 * site.moment}

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        torque = loads.drive[:, joint]
        return np.asarray(0.5 * self.size * torque / np.hypot(torque, self.transition))


@dataclass(frozen=True, kw_only=True)
class Hysteresis(DriveEffect, SizedByLoad):
    """Drive that stops wound up against Coulomb friction; ``size`` is the wind-up per moment on the
    axis [rad/(N m)].

    The joint lags behind its last motion, which is taken from the previous pose if the approach was
    not recorded.

    Attributes:
        preload: Moment added to the load's in the friction [N m].
    """

    effect: ClassVar[str] = "hysteresis"
    unit: ClassVar[str] = "rad/(N m)"
    column: ClassVar[str | None] = "approach"
    needs_order: ClassVar[bool] = True
    preload: float = 0.0

    @classmethod
    def typical_fields(cls, site: Site) -> dict[str, Any]:
        """Return 0.2 mrad at the rated moment, a fifth of it due to the preload."""
        return {"size": 1.6e-4 / site.moment, "preload": 0.25 * site.moment}

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        if poses.approach is not None:
            came = poses.approach[:, joint]
        else:
            came = np.sign(np.diff(poses.q[:, joint], prepend=poses.q[:1, joint]))
        return np.asarray(-self.size * came * (np.abs(loads.drive[:, joint]) + self.preload))


@dataclass(frozen=True, kw_only=True)
class ServoDroop(ReadBackEffect, SizedByLoad):
    """Position loop without integral action: the joint droops under load; ``size`` is its
    compliance [rad/(N m)].

    The joint positions of the table are the commanded ones.

    Attributes:
        stiction: Standard deviation of the position at which friction stops the loop [rad].
    """

    effect: ClassVar[str] = "servo_droop"
    unit: ClassVar[str] = "rad/(N m)"
    at_largest: ClassVar[float] = 2e-4
    stiction: float = 1e-4

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        return np.asarray(
            self.size * loads.drive[:, joint]
            + bool(self.size) * self.stiction * poses.scatter[:, joint]
        )


@dataclass(frozen=True, kw_only=True)
class GravityCompensator(DriveEffect, SizedByLoad):
    """Spring between two adjacent links; ``size`` is its rate [N/m].

    The spring relieves the drive: joint angle += compliance * torque of the spring.

    Attributes:
        compliance: Compliance of the joint's drive [rad/(N m)].
        anchor: Attachment of the spring to the previous link, in the frame before q [m].
        lever: Attachment to the moving link, in the frame after q [m].
        free_length: Free length of the spring [m].
    """

    effect: ClassVar[str] = "gravity_compensator"
    unit: ClassVar[str] = "N/m"
    compliance: float = 2e-7
    anchor: tuple[float, float, float] = (-0.25, 0.55, 0.0)
    lever: tuple[float, float, float] = (0.3, 0.0, 0.0)
    free_length: float = 0.3

    @classmethod
    def typical_joints(cls, arm: Arm) -> list[str]:
        """Return the second joint, which lifts the arm."""
        return [arm.names[min(1, len(arm.names) - 1)]]

    @classmethod
    def typical_fields(cls, site: Site) -> dict[str, Any]:
        """Return a spring in proportion to the arm that balances about a third of the
        rated moment.
        """
        scale = site.arm.reach / _COMPENSATOR_REACH
        lever = 0.3 * scale
        return {
            "size": 0.3 * site.moment / (lever * lever),
            "compliance": site.compliance or WINDUP / site.moment,
            "anchor": (-0.25 * scale, 0.55 * scale, 0.0),
            "lever": (lever, 0.0, 0.0),
            "free_length": 0.3 * scale,
        }

    def torque(self, q: np.ndarray) -> np.ndarray:
        """Return the torque of the spring about the joint axis [N m], shape of q [rad]."""
        x, y, z = self.lever
        c = np.cos(q)
        s = np.sin(q)
        end = np.stack((c * x - s * y, s * x + c * y, np.full_like(q, z)), axis=-1)
        span = np.asarray(self.anchor) - end
        length = np.linalg.norm(span, axis=-1, keepdims=True)
        force = self.size * (length - self.free_length) * span / length
        return np.asarray(np.cross(end, force)[..., 2])

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        return np.asarray(self.compliance * self.torque(poses.q[:, joint]))


@dataclass(frozen=True, kw_only=True)
class LinkBending(DeformingEffect, SizedByLoad):
    """Link that bends like a cantilever from its joint to the next; ``size`` is 1/(E I) [1/(N
    m^2)].
    """

    effect: ClassVar[str] = "link_bending"
    unit: ClassVar[str] = "1/(N m^2)"

    @classmethod
    def typical_joints(cls, arm: Arm) -> list[str]:
        """Return the joints whose link is longer than a tenth of the longest."""
        return [
            name
            for name, length in zip(arm.names, arm.lengths, strict=True)
            if length > 0.1 * arm.lengths.max()
        ]

    @classmethod
    def typical_fields(cls, site: Site) -> dict[str, Any]:
        """Return a flexibility that bends the link by a fifth of a drive's wind-up."""
        length = max(float(site.arm.lengths[site.joint]), 1e-3)
        return {"size": 0.2 * WINDUP / (length * site.moment)}

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        joint = arm.index(self.joint)
        span = arm.ends[joint][:3, 3]
        length = float(np.linalg.norm(span))
        if length == 0.0:
            raise BadInputError(
                f"link_bending of {self.joint}: the link has no length; name another joint"
            )
        along = span / length
        moment, force = (
            value - np.outer(value @ along, along)
            for value in (loads.end_moment[:, joint], loads.end_force[:, joint])
        )
        turn = length * moment + length**2 / 2.0 * np.cross(along, force)
        shift = length**2 / 2.0 * np.cross(moment, along) + length**3 / 3.0 * force
        deformation.add_at_end_of_link(arm, joint, self.size * np.hstack((shift, turn)))


@dataclass(frozen=True, kw_only=True)
class BaseElasticity(DeformingEffect, SizedByLoad):
    """Foundation that tilts under the arm; ``size`` is its compliance [rad/(N m)].

    Attributes:
        weights: Compliance about x, y and z of the base frame over ``size`` [-].
    """

    effect: ClassVar[str] = "base_elasticity"
    unit: ClassVar[str] = "rad/(N m)"
    at_largest: ClassVar[float] = 0.1 * WINDUP
    scope: ClassVar[Scope] = Scope.ARM
    weights: tuple[float, float, float] = (1.0, 1.0, 0.0)

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        deformation.base[:, 3:] += self.size * np.asarray(self.weights) * loads.base


@dataclass(frozen=True, kw_only=True)
class ThermalExpansion(DeformingEffect):
    """Links that expand with temperature; ``size`` is the coefficient of expansion [1/K].

    Attributes:
        joint: Joint that moves the only link that expands; None for all links, base and flange
            included.
    """

    effect: ClassVar[str] = "thermal_expansion"
    unit: ClassVar[str] = "1/K"
    typical_size: ClassVar[float] = 1.2e-5
    column: ClassVar[str | None] = "temperature"
    scope: ClassVar[Scope] = Scope.LINK_OR_ARM

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        _grow(arm, deformation, self.joint, self.size * poses.temperature)


@dataclass(frozen=True, kw_only=True)
class ThermalGrowth(DeformingEffect):
    """Links that expand as the arm warms up by itself; ``size`` is their final relative expansion
    [-].

    Attributes:
        joint: Joint that moves the only link that expands; None for all links, base and flange
            included.
        time_constant: Time after which 63 % of the expansion is reached [s].
    """

    effect: ClassVar[str] = "thermal_growth"
    unit: ClassVar[str] = "1"
    typical_size: ClassVar[float] = 1.2e-4
    column: ClassVar[str | None] = "time"
    scope: ClassVar[Scope] = Scope.LINK_OR_ARM
    time_constant: float = 3000.0

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        _grow(
            arm,
            deformation,
            self.joint,
            -self.size * np.expm1(-np.maximum(poses.time, 0.0) / self.time_constant),
        )


def _grow(arm: Arm, deformation: Deformation, joint: str | None, growth: np.ndarray) -> None:
    """Scale the link that a joint moves, or all, base and flange included, by relative growths,
    shape (N,).
    """
    for i in range(len(arm.names)) if joint is None else [arm.index(joint)]:
        shift = growth[:, None] * arm.ends[i][:3, 3]
        deformation.add_at_end_of_link(arm, i, np.hstack((shift, np.zeros_like(shift))))
    if joint is None:
        deformation.base[:, :3] += growth[:, None] * arm.placements[0][:3, 3]


@dataclass(frozen=True, kw_only=True)
class BaseDrift(DeformingEffect):
    """Base, or instrument, that drifts with time; ``size`` is the speed [m/s].

    Attributes:
        direction: Unit direction of the drift in the base frame, shape (3,).
        rotation: Angular velocity about the base axes [rad/s] per m/s of ``size``, shape (3,).
    """

    effect: ClassVar[str] = "base_drift"
    unit: ClassVar[str] = "m/s"
    typical_size: ClassVar[float] = 2e-8
    column: ClassVar[str | None] = "time"
    scope: ClassVar[Scope] = Scope.ARM
    direction: tuple[float, float, float] = (0.8, 0.6, 0.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        path = self.size * poses.time[:, None]
        deformation.base[:, :3] += path * np.asarray(self.direction)
        deformation.base[:, 3:] += path * np.asarray(self.rotation)


@dataclass(frozen=True, kw_only=True)
class PayloadError(HiddenEffect, SizedByLoad):
    """Payload that differs from the table; ``size`` is true minus declared mass [kg].

    It acts in rows with a declared payload, or in all rows if none is declared at all.

    Attributes:
        com_shift: True minus declared centre of mass of the payload in the tip frame [m], shape
            (3,).
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
        """Return the true mass [kg], shape (N,), and centre of mass [m, tip frame], shape (N, 3),
        for those of the table.
        """
        carried = mass > 0.0 if np.any(mass > 0.0) else np.ones(len(mass), bool)
        return mass + self.size * carried, com + np.asarray(self.com_shift)
