"""State of the true machine: poses and their conditions, loads, and the deformation that effects
cause.

The deformable arm is a Pinocchio model with a free joint for the deformation before and after every
joint, at the base and at the tip. Pinocchio thus places all deformations, and loads are plain sums
of cross products over the displaced bodies.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, TypedDict, Unpack

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.inertia import Inertia
from pincal.simulate.rods import rates


@dataclass(frozen=True)
class Poses:
    """N recorded poses and the conditions under which they were taken.

    Attributes:
        q: Recorded joint positions [rad or m], shape (N, n).
        payload: Mass at the tip [kg], shape (N,).
        payload_com: Its centre of mass in the tip frame [m], shape (N, 3).
        temperature: Temperature minus the reference temperature [K], shape (N,).
        time: Time since the start [s], shape (N,).
        approach: Direction from which each joint arrived (-1, 0, 1), shape (N, n); None: by the
            order of the poses.
        scatter: Standard normal draws per joint and pose, scaled by unrepeatable effects, shape (N,
            n).
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
        """Yield the poses in pieces of at most ``size``."""
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        for start in range(0, len(self.q), size):
            part: dict[str, Any] = {
                name: None if of is None else of[start : start + size]
                for name, of in columns.items()
            }
            yield Poses(**part)


class Conditions(TypedDict, total=False):
    """Conditions of N poses; a number applies to all of them, and None or a missing entry means not
    declared.

    Attributes:
        payload: Declared mass at the tip [kg], shape (N,); default: 0.
        payload_com: Its centre of mass in the tip frame [m], shape (3,) or (N, 3); default: the
            tip.
        temperature: Temperature [deg C], shape (N,); default: the machine's reference temperature.
        time: Time [s], shape (N,); default: 0.
        approach: Direction from which each joint arrived (-1, 0, 1), shape (N, n), or by joint
            name, shape (N,).
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


def _joint_positions(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return a copy of joint positions, which have to be of shape (N, n)."""
    n = len(arm.names)
    found = np.array(q, float)
    if found.ndim != 2 or found.shape[1] != n:
        raise BadInputError(
            f"q has shape {found.shape}; expected (N, {n}), one column per joint: "
            f"{', '.join(arm.names)}"
        )
    return found


def poses_of(
    arm: Arm,
    q: np.ndarray,
    *,
    reference_temperature: float = 20.0,
    scatter: np.ndarray | None = None,
    **conditions: Unpack[Conditions],
) -> Poses:
    """Return poses from joint positions and conditions.

    Args:
        arm: The arm.
        q: Recorded joint positions [rad or m], shape (N, n).
        reference_temperature: Temperature without expansion [deg C].
        scatter: Standard normal draws for unrepeatable effects, shape (N, n); default: 0.
        **conditions: Conditions of the poses.

    Raises:
        BadInputError: If a shape does not fit or a name is unknown.
    """
    if unknown := sorted(conditions.keys() - Conditions.__annotations__.keys()):
        raise BadInputError(
            f"{', '.join(unknown)}: unknown; expected {', '.join(Conditions.__annotations__)}"
        )
    n = len(arm.names)
    q = _joint_positions(arm, q)
    rows = len(q)
    approach = conditions.get("approach")
    temperature = conditions.get("temperature")
    if isinstance(approach, Mapping):
        columns = {arm.index(joint): value for joint, value in approach.items()}
        approach = np.column_stack([np.broadcast_to(columns.get(j, 0.0), rows) for j in range(n)])
    warm = 0.0 if temperature is None else np.asarray(temperature, float) - reference_temperature
    payload = conditions.get("payload")
    time = conditions.get("time")
    return Poses(
        q=q,
        payload=broadcast_copy("payload", 0.0 if payload is None else payload, (rows,)),
        payload_com=broadcast_copy(
            "payload_com", conditions.get("payload_com", (0.0, 0.0, 0.0)), (rows, 3)
        ),
        temperature=broadcast_copy("temperature", warm, (rows,)),
        time=broadcast_copy("time", 0.0 if time is None else time, (rows,)),
        approach=None if approach is None else broadcast_copy("approach", approach, (rows, n)),
        scatter=broadcast_copy("scatter", 0.0 if scatter is None else scatter, (rows, n)),
        velocity=broadcast_copy("velocity", conditions.get("velocity", 0.0), (rows, n)),
        acceleration=broadcast_copy("acceleration", conditions.get("acceleration", 0.0), (rows, n)),
    )


def broadcast_copy(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a copy of a number or array in a shape; BadInputError, with its ``name``, if it does
    not broadcast.
    """
    try:
        return np.array(np.broadcast_to(np.asarray(value, float), shape))
    except ValueError:
        raise BadInputError(f"{name} has shape {np.shape(value)}; expected {shape}") from None


@dataclass(frozen=True)
class Loads:
    """Loads of all bodies beyond each joint, in the deformed configuration.

    Attributes:
        before: Moment about the joint's origin, in the working frame before q [N m], shape (N, n,
            3).
        after: The same moment in the working frame after q [N m], shape (N, n, 3).
        drive: Moment about the joint axis [N m], or force along it for a prismatic joint [N], shape
            (N, n).
        end_moment: Moment of the bodies beyond link i about its far end, in the frame after q [N
            m], shape (N, n, 3).
        end_force: Weight of the bodies beyond link i, in the same frame [N], shape (N, n, 3).
        base: Moment of all moving bodies about the origin of the base frame, in that frame [N m],
            shape (N, 3).
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
        return cls(
            before, after, np.zeros((poses, joints)), end_moment, end_force, np.zeros((poses, 3))
        )


@dataclass(frozen=True)
class Deformation:
    """Sum of all effects, which add to the arrays in place.

    A twist contains a displacement [m] and angles [rad] about x, y and z, applied as Rz Ry Rx.

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
        return cls(
            np.zeros((poses, joints)), before, after, np.zeros((poses, 6)), np.zeros((poses, 6))
        )

    def add_at_end_of_link(self, arm: Arm, joint: int, twist: np.ndarray) -> None:
        """Add a twist, shape (N, 6), at the far end of a joint's link: at the next joint, or at the
        tip.

        The twist is in the frame after q of the joint, given by its index.
        """
        rotation = arm.ends[joint][:3, :3]
        at_end = np.hstack((twist[:, :3] @ rotation, twist[:, 3:] @ rotation))
        if (following := arm.next_joint(joint)) >= 0:
            self.before[:, following] += at_end
        elif joint == arm.tip_joint:
            self.tip[:] += at_end

    def change(self, before: Deformation) -> float:
        """Return the largest change of any component [rad or m]."""
        pairs = ((getattr(self, field.name), getattr(before, field.name)) for field in fields(self))
        return max(float(np.abs(new - old).max(initial=0.0)) for new, old in pairs)


@dataclass(frozen=True)
class Equilibrium:
    """The arm in equilibrium.

    Attributes:
        tip: Transform from the tip to the start link, by default the undeformed base, shape (N, 4,
            4).
        deformation: Sum of all effects.
        loads: Loads on the deformed arm.
    """

    tip: np.ndarray
    deformation: Deformation
    loads: Loads


# Indices in the Pinocchio model of the base's joint, and of those before, at and after arm joint 0;
# the next arm joint is 3 further.
_BASE = 1
_BEFORE = 2
_JOINT = 3
_AFTER = 4


@dataclass(frozen=True)
class _Tree:
    """How the joints of an arm hang on each other.

    Attributes:
        parents: The joint that carries each joint, -1 for the base.
        prismatic: Whether a joint is prismatic.
        tip_joint: The joint that moves the tip.
    """

    parents: tuple[int, ...]
    prismatic: tuple[bool, ...]
    tip_joint: int

    @classmethod
    def of(cls, arm: Arm) -> _Tree:
        return cls(arm.parents, tuple(map(bool, arm.prismatic)), arm.tip_joint)

    def chain(self, names: Sequence[str], placements: np.ndarray) -> Any:
        """Return the ``pinocchio.Model`` with names and placements, shape (n + 1, 4, 4)."""
        import pinocchio as pin

        model = pin.Model()
        identity = pin.SE3.Identity()
        base = model.addJoint(0, pin.JointModelFreeFlyer(), identity, "base")
        # Last joint of each link, and finally of the base.
        behind = [0] * len(names) + [base]
        for i, name in enumerate(names):
            drive = pin.JointModelPZ() if self.prismatic[i] else pin.JointModelRZ()
            carrier = behind[self.parents[i]]
            placement = pin.SE3(placements[i])
            before = model.addJoint(carrier, pin.JointModelFreeFlyer(), placement, f"{name} before")
            at = model.addJoint(before, drive, identity, name)
            behind[i] = model.addJoint(at, pin.JointModelFreeFlyer(), identity, f"{name} after")
        tip = pin.SE3(placements[-1])
        model.addJoint(behind[self.tip_joint], pin.JointModelFreeFlyer(), tip, "tip")
        return model


def build_chain(arm: Arm) -> Any:
    """Return the ``pinocchio.Model`` of an arm with free joints for deformations; see
    :func:`configurations`.
    """
    return _Tree.of(arm).chain(arm.names, arm.placements)


def scratch_of(arm: Arm) -> Any:
    """Return the ``pinocchio.Data`` in which the chain of an arm is placed.

    Arms that differ in their errors alone share it: its room grows with the cube of the number of
    deformations, and its creation takes longer than a thousand poses.
    """
    return _scratch(_Tree.of(arm))


@lru_cache(maxsize=4)
def _scratch(tree: _Tree) -> Any:
    names = [f"joint {i}" for i in range(len(tree.parents))]
    return tree.chain(names, np.tile(np.eye(4), (len(names) + 1, 1, 1))).createData()


def configurations(q: np.ndarray, deformation: Deformation) -> np.ndarray:
    """Return the configurations of the model, shape (N, 15 n + 14), at joint positions q [rad or
    m], shape (N, n).
    """
    rows = len(q)
    joints = np.concatenate(
        (_free(deformation.before), (q + deformation.joint)[..., None], _free(deformation.after)),
        axis=2,
    )
    return np.hstack((_free(deformation.base), joints.reshape(rows, -1), _free(deformation.tip)))


def _free(twist: np.ndarray) -> np.ndarray:
    """Return translation and quaternion of a free joint, shape (..., 7), for twists of shape (...,
    6).
    """
    # Half angles; the quaternion of Rz Ry, times that of Rx.
    cx, cy, cz = np.cos(0.5 * twist[..., 3:]).T
    sx, sy, sz = np.sin(0.5 * twist[..., 3:]).T
    quaternion = (
        cz * cy * sx - sz * sy * cx,
        cz * sy * cx + sz * cy * sx,
        sz * cy * cx - cz * sy * sx,
        cz * cy * cx + sz * sy * sx,
    )
    return np.concatenate((twist[..., :3], np.stack(quaternion).T), axis=-1)


def place(model: Any, data: Any, q: np.ndarray) -> np.ndarray:
    """Return the poses of the joints of :func:`build_chain`, last the tip, in configurations q,
    shape (N, nq).

    They are transforms to the undeformed base frame, shape (N, number of joints, 4, 4). ``data`` is
    that of :func:`scratch_of`.
    """
    import pinocchio as pin

    transforms = list(data.oMi)
    places = np.empty((len(q), model.njoints, 4, 4))
    for row, configuration in enumerate(q):
        pin.forwardKinematics(model, data, configuration)
        places[row] = [transform.homogeneous for transform in transforms]
    return places


def joints_and_links(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames of the joints, shape (N, n, 4, 4), and of base and links, shape (N, n + 1,
    4, 4), among places.
    """
    last = places.shape[1] - 1
    links = np.concatenate((places[:, _BASE : _BASE + 1], places[:, _AFTER:last:3]), axis=1)
    return places[:, _JOINT:last:3], links


def _centres(arm: Arm, after: np.ndarray, tip: np.ndarray, payload_com: np.ndarray) -> np.ndarray:
    """Return the centres of mass of links and payload, shape (N, n + 1, 3), by the frames after the
    joints, shape (N, n, 4, 4), and the tip, shape (N, 4, 4).
    """
    links = np.einsum("njab,jb->nja", after[..., :3, :3], arm.centres) + after[..., :3, 3]
    load = np.einsum("nab,nb->na", tip[:, :3, :3], payload_com) + tip[:, :3, 3]
    return np.concatenate((links, load[:, None]), axis=1)


def gravity_loads(
    arm: Arm,
    places: np.ndarray,
    *,
    payload: np.ndarray,
    payload_com: np.ndarray,
    gravity: np.ndarray,
    inertia: Inertia | None = None,
) -> Loads:
    """Return the loads on every joint of the deformed arm.

    ``places`` are transforms of :func:`place`, shape (N, 3 n + 3, 4, 4); the payload [kg], shape
    (N,), has its centre of mass in the tip frame [m], shape (N, 3); gravity is given in the
    undeformed base frame [m/s^2], shape (3,).
    """
    last = places.shape[1] - 1
    before, joint, after = (places[:, first:last:3] for first in (_BEFORE, _JOINT, _AFTER))
    tip = places[:, -1]
    centres = _centres(arm, after, tip, payload_com)
    masses = np.column_stack((np.broadcast_to(arm.masses, after.shape[:2]), payload))
    bodies = _Bodies.of(centres, masses[..., None] * gravity, inertia)
    n = len(arm.names)
    beyond = arm.carried & ~np.eye(n, n + 1, dtype=bool)
    everything = np.ones((1, n + 1), bool)
    moments = bodies.moments(joint[..., :3, 3], arm.carried)
    base = bodies.moments(places[:, _BASE : _BASE + 1, :3, 3], everything)
    drive = np.where(
        arm.prismatic,
        _turned(joint, bodies.forces(arm.carried))[..., 2],
        _turned(after, moments)[..., 2],
    )
    if arm.pins:
        # Loads on passive joints are supported by the joints that move them (virtual work).
        motion = rates(arm, *joints_and_links(places))
        drive += np.einsum("np,npk->nk", drive[:, arm.passive], motion)
        drive[:, arm.passive] = 0.0
    ends = _ends(arm, before, after, tip)
    return Loads(
        before=_turned(before, moments),
        after=_turned(joint, moments),
        drive=drive,
        end_moment=_turned(after, bodies.moments(ends, beyond)),
        end_force=_turned(after, bodies.forces(beyond)),
        base=_turned(places[:, _BASE : _BASE + 1], base)[:, 0],
    )


def _ends(arm: Arm, before: np.ndarray, after: np.ndarray, tip: np.ndarray) -> np.ndarray:
    """Return where the link after each joint ends, shape (N, n, 3): at the next joint, or at the
    tip.
    """
    following = [arm.next_joint(i) for i in range(len(arm.names))]
    frames = [before[:, k] if k >= 0 else after[:, i] for i, k in enumerate(following)]
    ends = np.stack(frames, axis=1)[..., :3, 3]
    ends[:, arm.tip_joint] = tip[:, :3, 3]
    return ends


@dataclass(frozen=True)
class _Bodies:
    """Links and payload, on which forces act, shape (N, n + 1, 3) each, in the base frame.

    Attributes:
        centres: their centres of mass [m].
        weights: forces at these, inertial ones included [N].
        couples: on them [N m].
    """

    centres: np.ndarray
    weights: np.ndarray
    couples: np.ndarray

    @classmethod
    def of(cls, centres: np.ndarray, weights: np.ndarray, inertia: Inertia | None) -> _Bodies:
        if inertia is None:
            return cls(centres, weights, np.zeros_like(centres))
        return cls(centres, weights + inertia.forces, inertia.couples)

    def moments(self, origins: np.ndarray, carried: np.ndarray) -> np.ndarray:
        """Return the sum of (centre - origin k) x weight + couple over the bodies of mask k, shape
        (N, k, 3).
        """
        # NumPy's cross product takes longer to rearrange so few rows than to multiply them.
        centres, weights, couples = map(np.transpose, (self.centres, self.weights, self.couples))
        moments = np.empty((3, len(carried), len(self.centres)))
        for k, bodies in enumerate(carried):
            x, y, z = centres[:, bodies] - origins[:, k].T[:, None]
            fx, fy, fz = weights[:, bodies]
            mx, my, mz = couples[:, bodies]
            moments[0, k] = (y * fz - z * fy + mx).sum(axis=0)
            moments[1, k] = (z * fx - x * fz + my).sum(axis=0)
            moments[2, k] = (x * fy - y * fx + mz).sum(axis=0)
        return moments.T

    def forces(self, carried: np.ndarray) -> np.ndarray:
        """Return the sum of the weights of the bodies of each mask, shape (N, k, 3)."""
        return np.stack([self.weights[:, b][:, ::-1].sum(axis=1) for b in carried], axis=1)


def _turned(frames: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return vectors of the base frame in the axes of frames, shape (N, k, 3)."""
    x, y, z = (frames[..., axis, :3] * vectors[..., axis, None] for axis in range(3))
    return np.asarray(x + y + z)
