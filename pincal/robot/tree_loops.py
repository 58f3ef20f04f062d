"""The loops of a URDF's tree: frames of their closures, and the choice of passive joints and
equations.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.errors import RobotFileError
from pincal.robot.closure import Closure, Linkage
from pincal.robot.kinematics import Kinematics
from pincal.robot.link_path import LinkPath, above
from pincal.robot.robot_numbers import OF_LOOP
from pincal.robot.se3 import perpendicular
from pincal.robot.tree import UrdfClosure, UrdfJoint, UrdfTree
from pincal.robot.urdf_loops import KINDS, ClosureKind
from pincal.thresholds import Count, Scale

# Poses in which the joints that move a loop are determined, and the range of joint positions there
# [rad or m].
_SAMPLES: Count = 12
_SAMPLE_STEP: Scale = 0.4
# A pin closer than this to the axis of the joint that carries it has no direction from there [m].
_ON_AXIS: Scale = 1e-6


@dataclass(frozen=True, eq=False)
class Pins:
    """A closure's frames in the base frame at zero positions, z along its axis and x away from the
    joint that carries it.

    Attributes:
        closure: the closure in the URDF.
        kind: the constrained quantity.
        carriers: the joints that carry the two frames, -1 for the base.
        T_base: shape (2, 4, 4), the frames on the parent and on the child link.
    """

    closure: UrdfClosure
    kind: ClosureKind
    carriers: tuple[int, int]
    T_base: np.ndarray

    @classmethod
    def of(
        cls,
        tree: UrdfTree,
        closure: UrdfClosure,
        carriers: tuple[int, int],
        T_base_link: np.ndarray,
        lines: np.ndarray,
    ) -> Pins:
        """Return the frames of a closure whose links are at T_base_link, shape (2, 4, 4), at zero
        positions.

        ``lines``, shape (n, 2, 3), are a point on the axis of each joint and its direction.
        RobotFileError for an unsupported type of closure.
        """
        kind = KINDS.get(closure.kind)
        if kind is None:
            raise RobotFileError(
                f"{tree.origin}: {closure.name!r} closes a loop and is "
                f"{closure.kind or 'of no type'}; expected one of {', '.join(KINDS)}"
            )
        child = T_base_link[1] @ closure.T_child
        frames = np.array(
            [child if closure.T_parent is None else T_base_link[0] @ closure.T_parent, child]
        )
        if kind != "pose":
            axes = [frames[0, :3, :3] @ closure.axis_parent, frames[1, :3, :3] @ closure.axis_child]
            for frame, joint, axis in zip(frames, carriers, axes, strict=True):
                point, direction = (
                    lines[joint] if joint >= 0 else (np.zeros(3), np.array([0.0, 0.0, 1.0]))
                )
                frame[:3, :3] = _axes(direction if kind == "point" else axis, frame[:3, 3] - point)
        return cls(closure, kind, carriers, frames)

    @classmethod
    def of_tree(
        cls,
        tree: UrdfTree,
        joints: Sequence[UrdfJoint],
        T_base_links: Mapping[str, np.ndarray],
        lines: np.ndarray,
    ) -> list[Pins]:
        """Return the frames of all closures of loops of some joints, with links by name; see
        :meth:`of`.
        """
        names = {joint.name for joint in joints}
        pairs = [
            (closure, (closure.parent, closure.child))
            for closure in tree.loops
            if tree.loop(closure) <= names
        ]
        carriers = [
            (tree.carrier(joints, one), tree.carrier(joints, other)) for _, (one, other) in pairs
        ]
        placed = [np.array([T_base_links[end] for end in ends]) for _, ends in pairs]
        return [
            cls.of(tree, c, at, T, lines)
            for (c, _), at, T in zip(pairs, carriers, placed, strict=True)
        ]

    def placed(self, T_base_link: np.ndarray) -> Closure:
        """Return the closure with its frames in link frames at T_base_link, shape (n, 4, 4)."""
        carried = [
            np.linalg.inv(T_base_link[i]) @ T if i >= 0 else T
            for i, T in zip(self.carriers, self.T_base, strict=True)
        ]
        return Closure(
            self.closure.name,
            self.kind,
            LinkPath(self.closure.parent, self.closure.child, *self.carriers, *carried),
        )


def _axes(z: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Return the rotation, shape (3, 3), with a given z axis and the x axis as close as possible to
    a direction.
    """
    length = np.linalg.norm(z)
    z = z / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    x = towards - z * (z @ towards)
    if np.linalg.norm(x) < _ON_AXIS:
        x = perpendicular(z)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


@dataclass(frozen=True)
class Choice:
    """Criteria for the choice of passive joints.

    Attributes:
        source: the origin of the URDF, for messages.
        names: names of all joints.
        recorded: joints with readings; None if unknown.
        on_path: joints between the links whose pose is wanted.
        mimicked: sources of mimic joints.
    """

    source: str
    names: tuple[str, ...]
    recorded: Collection[str] | None
    on_path: Collection[str]
    mimicked: Collection[str]


def linkage_of(
    kinematics: Kinematics,
    closures: Sequence[Closure],
    limits: tuple[np.ndarray, np.ndarray],
    choice: Choice,
) -> Linkage:
    """Choose the passive joints and the equations that they satisfy.

    Joints without readings are passive if possible, then the deepest ones of the tree.

    Raises:
        RobotFileError: if the loops can't be closed or moved, or the joints with readings do not
            determine the others.
    """
    free = Linkage(kinematics, tuple(closures), np.empty(0, int), *limits)
    loop = free.drivers.tolist()
    where = f"in the loop closed by {', '.join(closure.name for closure in closures)}"
    if (gap := float(np.abs(free.equations(free.assembled()[None])[0]).max())) > OF_LOOP.loose:
        raise RobotFileError(
            f"{choice.source}: {where} ends stay {1e3 * gap:.3g} mm or mrad apart at all joint "
            "positions; expected frames on both links that joints can bring together"
        )
    C = free.equations(_samples(free))[1]
    # Rotations are weighted by the largest lever arm.
    turns = np.concatenate([np.arange(closure.size) >= 3 for closure in closures])
    C[:, turns] *= np.abs(C[:, ~turns]).max()
    rank = int(np.max(_ranks(C[..., loop])))
    if rank in (0, len(loop)):
        raise RobotFileError(
            f"{choice.source}: {where} no joint can move; expected joints that can"
        )
    passive = _followers(C, loop, rank, kinematics, choice)
    drivers = [joint for joint in loop if joint not in passive]
    _check_readings(passive, drivers, kinematics, choice, where)
    rows = _equations_of(C[..., passive])
    _check_moving(passive, C[:, rows][..., passive], C[:, rows][..., drivers], choice, where)
    starts = np.cumsum([0, *(closure.size for closure in closures)])
    used = [
        replace(closure, rows=tuple(int(row - a) for row in rows if a <= row < a + closure.size))
        for a, closure in zip(starts, closures, strict=False)
    ]
    used = [closure for closure in used if closure.rows]
    return Linkage(kinematics, tuple(used), np.array(passive), *limits)


def _check_readings(
    passive: Sequence[int],
    drivers: Sequence[int],
    kinematics: Kinematics,
    choice: Choice,
    where: str,
) -> None:
    """Refuse passive joints that can't follow, and drivers without a reading."""
    for joint in passive:
        name = choice.names[joint]
        if kinematics.types[joint] == "prismatic" or name in choice.mimicked:
            what = "slides" if kinematics.types[joint] == "prismatic" else "is mimicked"
            raise RobotFileError(
                f"{choice.source}: joint {name!r} {what} and has no reading {where}; expected one"
            )
    recorded = choice.names if choice.recorded is None else choice.recorded
    if unknown := [choice.names[i] for i in drivers if choice.names[i] not in recorded]:
        raise RobotFileError(
            f"{choice.source}: {where} {len(drivers)} joints move independently, {len(unknown)} "
            f"without a reading; expected a column of {' and '.join(unknown)}"
        )


def _check_moving(
    passive: Sequence[int],
    by_passive: np.ndarray,
    by_drivers: np.ndarray,
    choice: Choice,
    where: str,
) -> None:
    """Refuse passive joints on the path that no driver moves, by the derivatives of the equations,
    shape (N, m, p) and (N, m, d).
    """
    moves = np.abs(np.linalg.pinv(by_passive) @ by_drivers).max(axis=(0, 2))
    pairs = zip(passive, moves, strict=True)
    still = [choice.names[joint] for joint, move in pairs if move < OF_LOOP.still]
    if stuck := [name for name in still if name in choice.on_path]:
        raise RobotFileError(
            f"{choice.source}: {where} {' and '.join(stuck)} can't move; expected joints that can"
        )


def linkage_notes(linkage: Linkage, choice: Choice) -> tuple[str, ...]:
    """Return notes on the passive joints and on unused readings."""
    passive, drivers = (
        [choice.names[i] for i in joints] for joints in (linkage.passive, linkage.drivers)
    )
    verb = "follow" if len(passive) > 1 else "follows"
    loops = ", ".join(closure.name for closure in linkage.closures)
    notes: tuple[str, ...] = (
        f"{', '.join(passive)} {verb} from {', '.join(drivers)} through the loops closed "
        f"by {loops}",
    )
    if unused := [name for name in passive if name in (choice.recorded or ())]:
        notes = (
            *notes,
            f"readings of {', '.join(unused)} are not used: the loops determine these positions",
        )
    return notes


def _samples(free: Linkage) -> np.ndarray:
    """Return joint positions about zero at which loops are closed by moving all their joints, shape
    (S, n).
    """
    rng = np.random.default_rng(0)
    q = np.tile(free.assembled(), (_SAMPLES, 1))
    C = free.equations(q)[1][..., free.drivers]
    step = rng.uniform(-_SAMPLE_STEP, _SAMPLE_STEP, (_SAMPLES, len(free.drivers)))
    step -= (np.linalg.pinv(C, rcond=OF_LOOP.still) @ (C @ step[..., None]))[..., 0]
    q[:, free.drivers] += step
    q = free.loosely_closed(q, free.drivers)
    is_closed = np.abs(free.equations(q)[0]).max(axis=1) < OF_LOOP.loose
    return q[is_closed] if is_closed.any() else free.assembled()[None]


def _ranks(C: np.ndarray) -> np.ndarray:
    """Return the number of joints that move a loop independently in each sample, shape (S,)."""
    singular = np.linalg.svd(C, compute_uv=False)
    return np.asarray(
        (singular > OF_LOOP.still * np.maximum(singular[:, :1], np.abs(C).max())).sum(axis=1)
    )


def _followers(
    C: np.ndarray, loop: list[int], rank: int, kinematics: Kinematics, choice: Choice
) -> list[int]:
    """Return the passive joints, as many as equations can be satisfied."""
    depth = {joint: len(above(joint, kinematics.parents)) for joint in loop}

    def preference(joint: int) -> tuple[bool, bool, int, bool, int]:
        name = choice.names[joint]
        is_bound = kinematics.types[joint] == "prismatic" or name in choice.mimicked
        return (
            name in (choice.recorded or ()),
            is_bound,
            -depth[joint],
            name in choice.on_path,
            -joint,
        )

    found: list[int] = []
    for joint in sorted(loop, key=preference):
        if (
            len(found) < rank
            and np.mean(_ranks(C[..., [*found, joint]]) > len(found)) > OF_LOOP.mostly
        ):
            found.append(joint)
    return sorted(found)


def _equations_of(C: np.ndarray) -> list[int]:
    """Return the p equations that the joints, shape (S, R, p), affect most over all samples."""
    from scipy.linalg import qr

    _, order = qr(np.concatenate(C, axis=1).T, mode="r", pivoting=True)
    return sorted(order[: C.shape[2]].tolist())
