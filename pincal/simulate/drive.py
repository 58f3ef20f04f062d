"""Hidden effects of a joint's drive and bearing that do not depend on loads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.effect import DeformingEffect, DriveEffect
from pincal.simulate.state import Deformation, Loads, Poses


@dataclass(frozen=True, kw_only=True)
class JointOffset(DriveEffect):
    """A drive that has lost its zero, as after a collision or a replacement; ``size`` is the angle
    [rad].
    """

    effect: ClassVar[str] = "joint_offset"
    typical_size: ClassVar[float] = 3e-4

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        return np.full(len(poses.q), self.size)


@dataclass(frozen=True, kw_only=True)
class GearEccentricity(DriveEffect):
    """Eccentric or elliptical gear wheel; ``size`` is the amplitude [rad].

    Order 1 is a crank: the output points from an eccentric centre to the driven point. Order 2 is a
    pair of elliptical wheels.

    Attributes:
        order: Cycles per revolution, 1 or 2.
        phase: Direction of the eccentricity or of the long axis [rad].
    """

    effect: ClassVar[str] = "gear_eccentricity"
    typical_size: ClassVar[float] = 1.5e-4
    order: int = 1
    phase: float = 0.6

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        q = poses.q[:, joint]
        if self.order == 1:
            x = self.size * np.cos(self.phase)
            y = self.size * np.sin(self.phase)
            output = np.arctan2(np.sin(q) + y, np.cos(q) + x)
            angle = q
        elif self.order == 2:
            angle = q - self.phase
            output = np.arctan2(
                (1.0 + self.size) * np.sin(angle), (1.0 - self.size) * np.cos(angle)
            )
        else:
            raise BadInputError(
                f"gear_eccentricity of {self.joint}: order {self.order}; expected 1 or 2"
            )
        return np.asarray(np.angle(np.exp(1j * (output - angle))))


@dataclass(frozen=True, kw_only=True)
class GearRipple(DriveEffect):
    """Eccentric wheel on a shaft with ``order`` revolutions per revolution of the joint; ``size``
    is the amplitude [rad].

    The wheel drives through a point off its centre; the following stages divide its error by their
    ratio.

    Attributes:
        order: Gear ratio from the wheel's shaft to the joint.
        phase: Direction of the eccentricity [rad].
    """

    effect: ClassVar[str] = "gear_ripple"
    typical_size: ClassVar[float] = 1e-4
    order: float = 101.0
    phase: float = 0.6

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        turned = self.order * poses.q[:, joint]
        # A point on a wheel of radius 1 whose centre is off by e: its angle is the wheel's plus an
        # error.
        e = self.size * self.order
        if not e < 1.0:
            raise BadInputError(
                f"gear_ripple of {self.joint}: size {self.size:g} rad at order "
                f"{self.order:g}; make it smaller"
            )
        output = np.arctan2(
            np.sin(turned) + e * np.sin(self.phase), np.cos(turned) + e * np.cos(self.phase)
        )
        return np.asarray(np.angle(np.exp(1j * (output - turned))) / self.order)


@dataclass(frozen=True, kw_only=True)
class EncoderSubdivision(DriveEffect):
    """Encoder with interpolation errors; ``size`` is approximately its largest error [rad].

    Its two signals, sine and cosine of the line, differ in amplitude and have an offset; their
    arctangent is read.

    Attributes:
        order: Lines per revolution of the joint.
        offset: Fraction of the error due to an offset of the sine; the rest is a difference in
            amplitude.
    """

    effect: ClassVar[str] = "encoder_subdivision"
    typical_size: ClassVar[float] = 1e-4
    order: float = 1024.0
    offset: float = 0.5

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        place = self.order * poses.q[:, joint]
        share = min(max(self.offset, 0.0), 1.0)
        error = self.size * self.order
        if not error < 0.5:
            raise BadInputError(
                f"encoder_subdivision of {self.joint}: size {self.size:g} rad is more "
                "than half a line"
            )
        # The reading is the recorded position; to first order the true position is off by the
        # opposite amount.
        read = np.arctan2(
            np.sin(place) + share * error, np.cos(place) / (1.0 + 2.0 * (1.0 - share) * error)
        )
        return np.asarray(-np.angle(np.exp(1j * (read - place))) / self.order)


@dataclass(frozen=True, kw_only=True)
class TransmissionError(DriveEffect):
    """Irregular gear: a smooth random curve of the joint's angle; ``size`` is its rms value [rad].

    Attributes:
        seed: The curve's own seed.
        bumps: Number of local bumps of random position, width and height that make up the curve.
        periodic: Whether the curve repeats after a revolution; otherwise it differs from turn to
            turn.
    """

    effect: ClassVar[str] = "transmission_error"
    typical_size: ClassVar[float] = 1e-4
    seed: int = 0
    bumps: int = 14
    periodic: bool = True

    def curve(self, q: np.ndarray) -> np.ndarray:
        """Return the error [rad] at joint angles [rad] of any shape."""
        rng = np.random.default_rng(self.seed)
        half_range = np.pi if self.periodic else 2.0 * np.pi
        centre = rng.uniform(-half_range, half_range, self.bumps)
        width = rng.uniform(0.12, 0.5, self.bumps)
        height = rng.choice((-1.0, 1.0), self.bumps) * rng.uniform(0.3, 1.0, self.bumps)

        def raw(angle: np.ndarray) -> np.ndarray:
            distance = angle[..., None] - centre
            if self.periodic:
                distance = 2.0 * np.sin(distance / 2.0)
            return np.asarray((height * np.exp(-0.5 * (distance / width) ** 2)).sum(-1))

        turn = raw(np.linspace(-half_range, half_range, 1000, endpoint=False))
        return np.asarray(self.size * (raw(np.asarray(q, float)) - turn.mean()) / turn.std())

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        return self.curve(poses.q[:, joint])


@dataclass(frozen=True, kw_only=True)
class GearRatio(DriveEffect):
    """Wrong gear or encoder ratio; ``size`` is the relative error of the ratio [-]."""

    effect: ClassVar[str] = "gear_ratio"
    unit: ClassVar[str] = "1"
    typical_size: ClassVar[float] = 1e-4

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        return np.asarray(self.size * poses.q[:, joint])


@dataclass(frozen=True, kw_only=True)
class JointCoupling(DeformingEffect):
    """Coupling of one joint's motion into another; ``size`` is the ratio [-].

    Attributes:
        source: Joint whose motion couples into ``joint``.
    """

    effect: ClassVar[str] = "joint_coupling"
    unit: ClassVar[str] = "1"
    typical_size: ClassVar[float] = 2e-4
    source: str

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        leak = self.size * poses.q[:, arm.index(self.source)]
        deformation.joint[:, arm.index(self.joint)] += leak


@dataclass(frozen=True, kw_only=True)
class AxisWobble(DeformingEffect):
    """Bearing whose axis tilts as it turns; ``size`` is the tilt [rad].

    The tip of the axis describes a circle, or an ellipse, ``order`` times per revolution. In the
    frame before q a circle of order 1 is a tilt fixed to the link, which is indistinguishable from
    geometry.

    Attributes:
        order: Revolutions of the tilt direction per revolution of the joint.
        phase: Direction of the tilt at q = 0 [rad].
        roundness: Ratio of the ellipse's semi-axes: 1 for a circle, 0 for a line along x.
        frame: ``"before"`` if the tilt is seen from the previous link, ``"after"`` if from the
            moving one.
    """

    effect: ClassVar[str] = "axis_wobble"
    typical_size: ClassVar[float] = 1e-4
    order: int = 2
    phase: float = 0.4
    roundness: float = 1.0
    frame: str = "before"

    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        joint = arm.index(self.joint)
        direction = self.order * poses.q[:, joint] + self.phase
        twist = deformation.after if self.frame == "after" else deformation.before
        twist[:, joint, 3] += self.size * np.cos(direction)
        twist[:, joint, 4] += self.size * self.roundness * np.sin(direction)


@dataclass(frozen=True, kw_only=True)
class Backlash(DriveEffect):
    """Backlash of a gear; ``size`` is the full backlash [rad].

    The joint lags behind its drive by half the backlash. A recorded direction of approach
    determines the side; otherwise the joint is dragged from pose to pose in their order and does
    not move while the drive crosses the backlash.
    """

    effect: ClassVar[str] = "backlash"
    typical_size: ClassVar[float] = 2e-4
    column: ClassVar[str | None] = "approach"
    needs_order: ClassVar[bool] = True

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        q = poses.q[:, joint]
        half = 0.5 * self.size
        if poses.approach is not None:
            return np.asarray(-half * poses.approach[:, joint])
        place = 0.0
        lag = np.empty_like(q)
        for row, drive in enumerate(q):
            place = drive if row == 0 else min(max(place, drive - half), drive + half)
            lag[row] = place - drive
        return lag


@dataclass(frozen=True, kw_only=True)
class ShortOfTarget(DriveEffect):
    """Drive that is read before it has settled; ``size`` is the fraction of its move that is left
    [-].

    The move starts at the joint's true position in the previous pose. A joint that is not commanded
    to move stays at rest.
    """

    effect: ClassVar[str] = "settling"
    unit: ClassVar[str] = "1"
    typical_size: ClassVar[float] = 1e-4
    column: ClassVar[str | None] = "time"
    needs_order: ClassVar[bool] = True

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        target = poses.q[:, joint]
        place = np.empty(len(poses.q))
        for row, to in enumerate(target):
            if row == 0:
                place[row] = to
            elif to == target[row - 1]:
                place[row] = place[row - 1]
            else:
                place[row] = to - self.size * (to - place[row - 1])
        return np.asarray(place - target)


@dataclass(frozen=True, kw_only=True)
class ThermalOffset(DriveEffect):
    """Joint zero that shifts with temperature; ``size`` is the shift [rad/K]."""

    effect: ClassVar[str] = "thermal_offset"
    unit: ClassVar[str] = "rad/K"
    typical_size: ClassVar[float] = 1e-5
    column: ClassVar[str | None] = "temperature"

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        return np.asarray(self.size * poses.temperature)


@dataclass(frozen=True, kw_only=True)
class JointCreep(DriveEffect):
    """Joint zero that relaxes after the start; ``size`` is the final shift [rad].

    Attributes:
        time_constant: Time after which 63 % of the shift is reached [s].
    """

    effect: ClassVar[str] = "joint_creep"
    typical_size: ClassVar[float] = 2e-4
    column: ClassVar[str | None] = "time"
    time_constant: float = 3000.0

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        return np.asarray(-self.size * np.expm1(-np.maximum(poses.time, 0.0) / self.time_constant))


@dataclass(frozen=True, kw_only=True)
class JointScatter(DriveEffect):
    """Joint of limited repeatability; ``size`` is the standard deviation [rad]."""

    effect: ClassVar[str] = "joint_scatter"
    typical_size: ClassVar[float] = 1e-4

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        return np.asarray(self.size * poses.scatter[:, joint])


@dataclass(frozen=True, kw_only=True)
class JointLag(DriveEffect):
    """Joint that reaches its recorded position with a delay; ``size`` is the delay [s]. Held poses
    do not show it.
    """

    effect: ClassVar[str] = "joint_lag"
    unit: ClassVar[str] = "s"
    typical_size: ClassVar[float] = 1e-3

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        # Its earlier position: a step back along the path at constant acceleration.
        return np.asarray(
            -self.size * poses.velocity[:, joint]
            + 0.5 * self.size**2 * poses.acceleration[:, joint]
        )


@dataclass(frozen=True, kw_only=True)
class FrictionWindup(DriveEffect):
    """Gear wound up by its friction while it moves; ``size`` is the angle [rad]. Held poses do not
    show it.

    Attributes:
        slow: Speed at which friction reaches about 70 % of its size [rad/s].
    """

    effect: ClassVar[str] = "friction_windup"
    typical_size: ClassVar[float] = 1e-4
    slow: float = 0.01

    def _motion(self, joint: int, poses: Poses, loads: Loads) -> np.ndarray:
        speed = poses.velocity[:, joint]
        return np.asarray(-self.size * speed / np.hypot(speed, self.slow))
