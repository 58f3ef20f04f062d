"""Arms in motion: paths with exact derivatives, and how the true tip moves along them by
Pinocchio's kinematics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.machine import TrueMachine
from pincal.simulate.planning import is_clear
from pincal.simulate.state import Deformation, build_chain, configurations, scratch_of

# Number of waves of each joint, and the range of their frequencies [Hz].
_WAVES = 8
_SLOWEST = 0.03
_FASTEST = 0.6
# Fraction of the joint range that is used; number of paths drawn, and the factor by which each next
# one is smaller.
_SPAN = 0.95
_TRIES = 60
_SMALLER = 0.97
# Step of finite differences of deformations [s], and speed at which a joint has a direction of
# approach [rad/s or m/s].
_STEP = 5e-4
_SLOW = 0.01
# Instants processed at once.
_PIECE = 5_000


@dataclass(frozen=True)
class FourierPath:
    """Joint positions as Fourier sums (Swevers et al. 1997), with all their derivatives.

    Attributes:
        centre: Mean positions [rad or m], shape (n,).
        rates: Angular frequencies [rad/s], shape (n, K).
        sines: Amplitudes [rad or m], shape (n, K).
        cosines: Likewise.
    """

    centre: np.ndarray
    rates: np.ndarray
    sines: np.ndarray
    cosines: np.ndarray

    def at(self, time: np.ndarray, order: int = 0) -> np.ndarray:
        """Return positions, or their derivatives of an order, at times [s], shape (N, n)."""
        found = np.empty((len(time), len(self.centre)))
        for start in range(0, len(time), _PIECE):
            phase = (
                np.asarray(time, float)[start : start + _PIECE, None, None] * self.rates
                + 0.5 * np.pi * order
            )
            waves = self.rates**order * (self.sines * np.sin(phase) + self.cosines * np.cos(phase))
            found[start : start + _PIECE] = waves.sum(axis=2)
        return found + self.centre if order == 0 else found

    def scaled(self, factor: np.ndarray | float) -> FourierPath:
        """Return the path with its waves scaled by a factor, shape (n,) or a number, about the same
        centre.
        """
        grown = np.broadcast_to(factor, self.centre.shape)[:, None]
        return FourierPath(self.centre, self.rates, self.sines * grown, self.cosines * grown)


@dataclass(frozen=True)
class ViaPath:
    """Joint positions that move from pose to pose and stop at each, by polynomials of degree 5
    (minimum jerk).

    Attributes:
        time: Times at which the poses are reached, shape (V,), increasing from 0 [s].
        q: The poses [rad or m], shape (V, n).
    """

    time: np.ndarray
    q: np.ndarray

    def at(self, time: np.ndarray, order: int = 0) -> np.ndarray:
        """Return positions, or their derivatives of an order, at times [s], shape (N, n); at rest
        before and after.
        """
        move = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 2)
        seconds = np.diff(self.time)[move]
        part = np.clip((np.asarray(time, float) - self.time[move]) / seconds, 0.0, 1.0)
        share = (
            np.polynomial.Polynomial([0.0, 0.0, 0.0, 10.0, -15.0, 6.0]).deriv(order)(part)
            / seconds**order
        )
        moved = share[:, None] * np.diff(self.q, axis=0)[move]
        return np.asarray(self.q[move] + moved if order == 0 else moved)

    @classmethod
    def through(
        cls, q: np.ndarray, duration: float, *, speed: float = 1.0, acceleration: float = 3.0
    ) -> ViaPath:
        """Return a path through poses, shape (V, n), always to the nearest next, that lasts at
        least a duration [s].

        Speeds and accelerations are limited as those of revolute joints in :func:`draw_path`.
        """
        left = set(range(1, len(q)))
        order = [0]
        while left:
            order.append(min(left, key=lambda i: float(np.abs(q[i] - q[order[-1]]).max())))
            left.remove(order[-1])
        far = np.abs(np.diff(q[order], axis=0)).max(axis=1)
        # The largest slope and curvature of 10 s^3 - 15 s^4 + 6 s^5.
        lasts = np.maximum(
            np.maximum(1.875 * far / speed, np.sqrt(5.774 * far / acceleration)), 1e-3
        )
        return cls(
            np.append(0.0, np.cumsum(lasts)) * max(duration / float(lasts.sum()), 1.0), q[order]
        )


Motion = FourierPath | ViaPath
"""A motion of an arm's joints."""


def draw_path(
    arm: Arm,
    duration: float,
    rng: np.random.Generator,
    *,
    speed: float = 1.0,
    acceleration: float = 3.0,
    min_height: float | None = 0.1,
) -> FourierPath:
    """Draw a path within the limits of the joints.

    Args:
        arm: Nominal arm.
        duration: Time during which the arm has to stay above the floor [s].
        rng: Source of randomness.
        speed: Largest speed of a joint [rad/s]; half of it for a prismatic one [m/s].
        acceleration: Likewise [rad/s^2].
        min_height: Height of the floor [m], as in :func:`pincal.simulate.planning.is_clear`; None
            for no floor.

    Raises:
        BadInputError: If the arm hits the floor on every path tried.
    """
    n = len(arm.names)
    time = np.arange(0.0, duration, 0.1)
    middle = 0.5 * (arm.upper + arm.lower)
    half = 0.5 * _SPAN * (arm.upper - arm.lower)
    least = np.where(arm.prismatic, 0.5, 1.0)
    size = 1.0
    for _ in range(_TRIES):
        rates = 2.0 * np.pi * np.exp(rng.uniform(np.log(_SLOWEST), np.log(_FASTEST), (n, _WAVES)))
        amplitudes = rng.standard_normal((2, n, _WAVES)) / rates
        shape = FourierPath(np.zeros(n), rates, *amplitudes)
        largest = [np.abs(shape.at(time, order)).max(axis=0) for order in range(3)]
        factor = np.minimum(
            half / largest[0], least * np.minimum(speed / largest[1], acceleration / largest[2])
        )
        # Centres lie in the middle half of the joint range that the waves leave.
        centre = middle + (half - size * factor * largest[0]) * rng.uniform(-0.5, 0.5, n)
        path = _following(arm, shape.scaled(size * factor), centre)
        if is_clear(arm, path.at(time), min_height).all():
            return path
        size *= _SMALLER
    raise BadInputError(
        f"the arm goes below {min_height} m on each of {_TRIES} random paths; give a "
        "lower --floor, or --no-floor"
    )


def _following(arm: Arm, path: FourierPath, centre: np.ndarray) -> FourierPath:
    """Return the path with the mimic joints following their sources."""
    sources = np.arange(len(centre))
    factors = np.ones(len(centre))
    for joint, source, multiplier, _ in arm.mimics:
        sources[joint] = source
        factors[joint] = multiplier
    moved = path.scaled(1.0)
    return FourierPath(
        arm.mimicking(centre[None])[0],
        moved.rates[sources],
        factors[:, None] * moved.sines[sources],
        factors[:, None] * moved.cosines[sources],
    )


class TipMotion(NamedTuple):
    """Motion of the tip at N instants, in its own axes.

    Attributes:
        T: Transform to the base frame, shape (N, 4, 4).
        rate: Angular velocity [rad/s], shape (N, 3).
        turning: Angular acceleration [rad/s^2], shape (N, 3).
        acceleration: Of its origin [m/s^2], shape (N, 3).
    """

    T: np.ndarray
    rate: np.ndarray
    turning: np.ndarray
    acceleration: np.ndarray


def conditions_along(path: Motion, time: np.ndarray, **others: Any) -> dict[str, Any]:
    """Return the conditions of a path's poses at times [s], shape (N,): time, motion, direction of
    approach.
    """
    velocity = path.at(time, 1)
    moved = {
        "velocity": velocity,
        "acceleration": path.at(time, 2),
        "approach": np.tanh(velocity / _SLOW),
    }
    return {"time": np.asarray(time, float)} | moved | others


def tip_motion(machine: TrueMachine, path: Motion, time: np.ndarray, **others: Any) -> TipMotion:
    """Return the tip's motion along a path of the recorded joints, at times of shape (N,) [s].

    Rigid motion is differentiated exactly, deformations, a thousandth of it, by differences.
    ``others`` are further conditions, such as the payload.
    """
    parts = [
        _tip_motion(machine, path, time[k : k + _PIECE], others)
        for k in range(0, len(time), _PIECE)
    ]
    return TipMotion(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _tip_motion(
    machine: TrueMachine, path: Motion, time: np.ndarray, others: dict[str, Any]
) -> TipMotion:
    import pinocchio as pin

    model = build_chain(machine.arm)
    data = scratch_of(machine.arm)
    tip = model.njoints - 1
    drives = [model.joints[model.getJointId(name)].idx_v for name in machine.names]
    steps = [_deformed(machine, path, time + shift, others) for shift in (-_STEP, 0.0, _STEP)]
    is_rigid = all(step.change(Deformation.zero(*step.joint.shape)) == 0.0 for step in steps)
    v, a = np.zeros((2, len(time), model.nv))
    here = configurations(path.at(time) + machine.joint_offsets, steps[1])
    if not is_rigid:
        before, after = (
            configurations(path.at(time) + machine.joint_offsets, steps[k]) for k in (0, 2)
        )
        for i in range(len(time)):
            ahead = pin.difference(model, here[i], after[i])
            behind = pin.difference(model, before[i], here[i])
            v[i] = (ahead + behind) / (2.0 * _STEP)
            a[i] = (ahead - behind) / _STEP**2
    v[:, drives] += path.at(time, 1)
    a[:, drives] += path.at(time, 2)
    T = np.empty((len(time), 4, 4))
    velocity, change = np.empty((2, len(time), 6))
    for i in range(len(time)):
        pin.forwardKinematics(model, data, here[i], v[i], a[i])
        T[i] = data.oMi[tip].homogeneous
        velocity[i] = data.v[tip].vector
        change[i] = data.a[tip].vector
    rate = velocity[:, 3:]
    return TipMotion(T, rate, change[:, 3:], change[:, :3] + np.cross(rate, velocity[:, :3]))


def _deformed(
    machine: TrueMachine, path: Motion, time: np.ndarray, others: dict[str, Any]
) -> Deformation:
    poses = machine.poses(path.at(time), **conditions_along(path, time, **others))
    return machine.equilibrium(poses).deformation
