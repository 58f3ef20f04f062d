"""What an effect of the true machine sees and what it changes: poses and their conditions, loads, deformation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, TypedDict, Unpack

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm


@dataclass(frozen=True)
class Poses:
    """N recorded poses and the conditions under which they were taken.

    Attributes:
        q: Recorded joint positions [rad or m], shape (N, n).
        payload: Mass at the tip [kg], shape (N,).
        payload_com: Its centre of mass in the tip frame [m], shape (N, 3).
        temperature: Temperature minus the reference temperature [K], shape (N,).
        time: Time since the start [s], shape (N,).
        approach: Direction from which each joint arrived (-1, 0, 1), shape (N, n); None: by the order of the poses.
        scatter: Standard normal draws per joint and pose, scaled by unrepeatable effects, shape (N, n).
        velocity: Velocity of the joints [rad/s or m/s], shape (N, n); zero where poses are held.
        acceleration: Acceleration of the joints [rad/s^2 or m/s^2], shape (N, n).
    """

    q: np.ndarray
    payload: np.ndarray
    payload_com: np.ndarray
    temperature: np.ndarray
    time: np.ndarray
    approach: np.ndarray | None
    scatter: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray

    def pieces(self, size: int) -> Iterator[Poses]:
        """Yield the poses piece by piece, at most ``size`` at a time."""
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        for start in range(0, len(self.q), size):
            part: dict[str, Any] = {name: None if of is None else of[start : start + size] for name, of in columns.items()}
            yield Poses(**part)


class Conditions(TypedDict, total=False):
    """Conditions of N poses; a number stands for all of them, and what is None or missing is not declared.

    Attributes:
        payload: Declared mass at the tip [kg], shape (N,); default: 0.
        payload_com: Its centre of mass in the tip frame [m], shape (3,) or (N, 3); default: the tip.
        temperature: Temperature [deg C], shape (N,); default: the machine's reference temperature.
        time: Time [s], shape (N,); default: 0.
        approach: Direction from which each joint arrived (-1, 0, 1), shape (N, n), or by joint name, shape (N,).
        velocity: Velocity of the joints [rad/s or m/s], shape (N, n); default: at rest.
        acceleration: Acceleration of the joints [rad/s^2 or m/s^2], shape (N, n).
    """

    payload: Any
    payload_com: Any
    temperature: Any
    time: Any
    approach: Mapping[str, Any] | np.ndarray | None
    velocity: np.ndarray
    acceleration: np.ndarray


def poses_of(
    arm: Arm,
    q: np.ndarray,
    *,
    reference_temperature: float = 20.0,
    scatter: np.ndarray | None = None,
    **conditions: Unpack[Conditions],
) -> Poses:
    """Put together joint positions of an arm [rad or m], shape (N, n), and the conditions of these poses.

    Args:
        arm: The arm whose joints they are.
        q: Recorded joint positions.
        reference_temperature: Temperature at which nothing has grown [deg C].
        scatter: Standard normal draws for unrepeatable effects, shape (N, n); default: 0.
        **conditions: Conditions of the poses.

    Raises:
        BadInputError: If a shape does not fit or a name is unknown.
    """
    if unknown := sorted(conditions.keys() - Conditions.__annotations__.keys()):
        raise BadInputError(f"{', '.join(unknown)}: unknown; expected {', '.join(Conditions.__annotations__)}")
    n = len(arm.names)
    q = np.array(q, float)
    if q.ndim != 2 or q.shape[1] != n:
        raise BadInputError(f"q has shape {q.shape}; expected (N, {n}), one column per joint: {', '.join(arm.names)}")
    rows = len(q)
    approach, temperature = conditions.get("approach"), conditions.get("temperature")
    if isinstance(approach, Mapping):
        columns = {arm.index(joint): value for joint, value in approach.items()}
        approach = np.column_stack([np.broadcast_to(columns.get(j, 0.0), rows) for j in range(n)])
    warm = 0.0 if temperature is None else np.asarray(temperature, float) - reference_temperature
    payload, time = conditions.get("payload"), conditions.get("time")
    return Poses(
        q=q,
        payload=broadcast_copy("payload", 0.0 if payload is None else payload, (rows,)),
        payload_com=broadcast_copy("payload_com", conditions.get("payload_com", (0.0, 0.0, 0.0)), (rows, 3)),
        temperature=broadcast_copy("temperature", warm, (rows,)),
        time=broadcast_copy("time", 0.0 if time is None else time, (rows,)),
        approach=None if approach is None else broadcast_copy("approach", approach, (rows, n)),
        scatter=broadcast_copy("scatter", 0.0 if scatter is None else scatter, (rows, n)),
        velocity=broadcast_copy("velocity", conditions.get("velocity", 0.0), (rows, n)),
        acceleration=broadcast_copy("acceleration", conditions.get("acceleration", 0.0), (rows, n)),
    )


def broadcast_copy(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a copy of a number or array in a shape; BadInputError, which calls it ``name``, if it does not broadcast."""
    try:
        return np.array(np.broadcast_to(np.asarray(value, float), shape))
    except ValueError:
        raise BadInputError(f"{name} has shape {np.shape(value)}; expected {shape}") from None


@dataclass(frozen=True)
class Loads:
    """Gravity loads of all bodies beyond a joint, at their deformed places.

    Attributes:
        before: Moment about the joint's origin, in the working frame before q [N m], shape (N, n, 3).
        after: The same moment in the working frame after q [N m], shape (N, n, 3).
        drive: Load along the joint's own freedom: moment about the axis [N m], or force along it if the joint slides [N],
            shape (N, n).
        end_moment: Moment of what is beyond link i about its far end, in the frame after q [N m], shape (N, n, 3).
        end_force: Weight of what is beyond link i, in the same frame [N], shape (N, n, 3).
        base: Moment of everything that moves about the origin of the base frame, in that frame [N m], shape (N, 3).
    """

    before: np.ndarray
    after: np.ndarray
    drive: np.ndarray
    end_moment: np.ndarray
    end_force: np.ndarray
    base: np.ndarray

    @classmethod
    def zero(cls, poses: int, joints: int) -> Loads:
        """Return loads of zeros for N poses of n joints."""
        before, after, end_moment, end_force = np.zeros((4, poses, joints, 3))
        return cls(before, after, np.zeros((poses, joints)), end_moment, end_force, np.zeros((poses, 3)))


@dataclass(frozen=True)
class Deformation:
    """What the effects add up to. Effects write into the arrays.

    A twist holds a displacement [m] and angles [rad] about x, y and z, carried out as Rz Ry Rx.

    Attributes:
        joint: Added to the joint position [rad or m], shape (N, n).
        before: Twist in the working frame before q, shape (N, n, 6).
        after: Twist in the working frame after q, shape (N, n, 6).
        base: Twist of the base in the base frame, shape (N, 6).
        tip: Twist of the tip in the tip frame, shape (N, 6).
    """

    joint: np.ndarray
    before: np.ndarray
    after: np.ndarray
    base: np.ndarray
    tip: np.ndarray

    @classmethod
    def zero(cls, poses: int, joints: int) -> Deformation:
        """Return a deformation of zeros for N poses of n joints."""
        before, after = np.zeros((2, poses, joints, 6))
        return cls(np.zeros((poses, joints)), before, after, np.zeros((poses, 6)), np.zeros((poses, 6)))

    def add_at_end_of_link(self, arm: Arm, joint: int, twist: np.ndarray) -> None:
        """Add a twist, shape (N, 6), at the far end of the link that a joint moves: at the next joint, or at the tip.

        The twist is in the frame after q of the joint, which is given by its index.
        """
        rotation = arm.placements[joint + 1][:3, :3]
        at_end = np.hstack((twist[:, :3] @ rotation, twist[:, 3:] @ rotation))
        if joint + 1 < len(arm.names):
            self.before[:, joint + 1] += at_end
        else:
            self.tip[:] += at_end

    def change(self, before: Deformation) -> float:
        """Return the largest change of any component [rad or m]."""
        pairs = ((getattr(self, field.name), getattr(before, field.name)) for field in fields(self))
        return max(float(np.abs(new - old).max(initial=0.0)) for new, old in pairs)


@dataclass(frozen=True)
class Equilibrium:
    """The arm at rest under gravity.

    Attributes:
        tip: Transform from the tip to the undeformed base frame, shape (N, 4, 4).
        deformation: Sum of all effects.
        loads: Gravity loads on the deformed arm.
    """

    tip: np.ndarray
    deformation: Deformation
    loads: Loads
