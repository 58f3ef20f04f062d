"""The arm of the true machine: placements, joint axes, bodies, limits, pins of loops.

Every joint gets a working frame whose z axis is the joint axis. Its x axis is the projection of the
URDF joint frame's x axis (the y axis if x is parallel to the joint axis). With the axis "0 0 1" the
two frames coincide.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import BadInputError, nearest_first


@dataclass(frozen=True)
class Pin:
    """A pin that closes a loop between two links.

    Attributes:
        name: Its name in the URDF.
        joints: The joints that move the two links, -1 for the base.
        places: Its frames in their working frames at joint position 0, z along its axis, shape (2,
            4, 4).
        has_axis: Whether it is a hinge and not a ball joint.
    """

    name: str
    joints: tuple[int, int]
    places: np.ndarray
    has_axis: bool


@dataclass(frozen=True)
class Arm:
    """An arm from base to tip, nominal or true, including the other links of its loops.

    Attributes:
        names: Names of the n joints, from base to tip, each after the one that carries it.
        prismatic: Whether a joint is prismatic, shape (n,).
        placements: Working frame of joint i in the working frame of the joint that carries it (or
            the base frame) at joint position 0, and last the tip in the working frame of its joint;
            lengths in m, shape (n + 1, 4, 4).
        masses: Mass that moves with joint i, up to the next joint [kg], shape (n,).
        centres: Its centre of mass in the working frame of joint i [m], shape (n, 3).
        axes: Rotation from the working frame to the URDF frame of joint i, shape (n, 3, 3).
        lower: Lower joint limits [rad or m]; -pi for a continuous joint, shape (n,).
        upper: Upper joint limits [rad or m], shape (n,).
        mimics: Joint, source joint, multiplier and offset of each mimic joint of the URDF.
        inertias: Moments of inertia about these centres in the working frames [kg m^2], shape (n,
            3, 3); None for point masses.
        parents: The joint that carries each joint, -1 for the base; by default the one before.
        tip_joint: The joint that moves the tip; by default the last.
        pins: Pins that close loops.
        passive: The joints whose positions follow from the others because of loops.
        start_joint: The joint that moves the start link, from which the tip is seen; -1 for the
            base.
        start: The start link in the working frame of its joint, or in the base frame, shape (4, 4).
    """

    names: tuple[str, ...]
    prismatic: np.ndarray
    placements: np.ndarray
    masses: np.ndarray
    centres: np.ndarray
    axes: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    mimics: tuple[tuple[int, int, float, float], ...] = ()
    inertias: np.ndarray | None = None
    parents: tuple[int, ...] = ()
    tip_joint: int = -1
    pins: tuple[Pin, ...] = ()
    passive: tuple[int, ...] = ()
    start_joint: int = -1
    start: np.ndarray = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        """By default each joint carries the next, and the last one the tip."""
        n = len(self.names)
        object.__setattr__(self, "parents", self.parents or tuple(range(-1, n - 1)))
        object.__setattr__(self, "tip_joint", self.tip_joint % n)

    @cached_property
    def carried(self) -> np.ndarray:
        """Which links, and last the payload, each joint carries, shape (n, n + 1)."""
        n = len(self.names)
        return np.stack([self._supports(joint) for joint in (*range(n), self.tip_joint)], axis=1)

    @cached_property
    def movers(self) -> np.ndarray:
        """Sign with which each joint moves the tip relative to the start link: 1 if it carries only
        the tip, shape (n,).
        """
        return np.asarray(
            self._supports(self.tip_joint).astype(float) - self._supports(self.start_joint)
        )

    def _supports(self, joint: int) -> np.ndarray:
        """Return which joints move the link of a joint, shape (n,)."""
        found = np.zeros(len(self.names), bool)
        while joint >= 0:
            found[joint] = True
            joint = self.parents[joint]
        return found

    @property
    def recorded(self) -> list[str]:
        """Names of the joints that have readings: all but the passive ones."""
        return [name for i, name in enumerate(self.names) if i not in self.passive]

    def next_joint(self, joint: int) -> int:
        """Return the first joint that a joint carries; -1 if it moves the tip or nothing more."""
        return (
            self.parents.index(joint) if joint in self.parents and joint != self.tip_joint else -1
        )

    @cached_property
    def ends(self) -> np.ndarray:
        """The far end of each link in the working frame of its joint: the next joint, the tip, or
        itself, (n, 4, 4).
        """
        following = [self.next_joint(i) for i in range(len(self.names))]
        ends = [self.placements[k] if k >= 0 else np.eye(4) for k in following]
        ends[self.tip_joint] = self.placements[-1]
        return np.array(ends)

    def mimicking(self, q: np.ndarray) -> np.ndarray:
        """Return joint positions, shape (N, n), with the mimic joints set from their sources."""
        out = np.array(q, float)
        # Repeated, as a source may be a mimic joint itself.
        for joint, source, multiplier, offset in self.mimics * len(self.mimics):
            out[:, joint] = multiplier * out[:, source] + offset
        return out

    @cached_property
    def mimicry(self) -> np.ndarray:
        """Derivatives of all joints by the m joints that mimic none, shape (n, m)."""
        moves = np.eye(len(self.names))
        for joint, *_ in self.mimics:
            moves[joint] = 0.0
        own = np.flatnonzero(moves.any(axis=1))
        return np.asarray(
            self.mimicking(moves[:, own].T).T - self.mimicking(np.zeros((len(own), len(moves)))).T
        )

    @cached_property
    def lengths(self) -> np.ndarray:
        """Distance from each joint to the next, last to the tip [m], shape (n,)."""
        return np.asarray(np.linalg.norm(self.ends[:, :3, 3], axis=1))

    @property
    def reach(self) -> float:
        """Sum of the distances from joint to joint on the path to the tip [m]; of all joints if
        there are loops.
        """
        return float(self.lengths[(self.movers != 0.0) | bool(self.pins)].sum())

    def index(self, joint: str | None) -> int:
        """Return the index of a joint by its name in the URDF, 0 at the base.

        Raises:
            BadInputError: If there is no such joint between base and tip.
        """
        if joint in self.names:
            return self.names.index(joint)
        near = ", ".join(nearest_first([str(joint)], self.names))
        raise BadInputError(f"joint {joint!r}: not between base and tip; expected one of {near}")


def frames(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return the frames of an undeformed arm at joint positions q [rad or m], shape (N, n), in the
    start link's frame.

    They are base, working frames after q, and tip, shape (N, n + 2, 4, 4).
    """
    places = frames_in_base(arm, q)
    return (
        places
        if arm.start_joint < 0
        else np.linalg.inv(places[:, arm.start_joint + 1] @ arm.start)[:, None] @ places
    )


def frames_in_base(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return :func:`frames` in the base frame."""
    moves = np.tile(np.eye(4), (*q.shape, 1, 1))
    turn = np.where(arm.prismatic, 0.0, q)
    slide = np.where(arm.prismatic, q, 0.0)
    moves[..., 0, 0] = moves[..., 1, 1] = np.cos(turn)
    moves[..., 1, 0] = np.sin(turn)
    moves[..., 0, 1] = -moves[..., 1, 0]
    moves[..., 2, 3] = slide
    chain = [np.tile(np.eye(4), (len(q), 1, 1))]
    for joint in range(len(arm.names)):
        chain.append(chain[arm.parents[joint] + 1] @ arm.placements[joint] @ moves[:, joint])
    chain.append(chain[arm.tip_joint + 1] @ arm.placements[-1])
    return np.stack(chain, axis=1)


def transform(rotation: ArrayLike | None = None, place: ArrayLike = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the transform, shape (4, 4), of a rotation, shape (3, 3), and a translation [m], shape
    (3,).
    """
    found = np.eye(4)
    found[:3, :3] = np.eye(3) if rotation is None else rotation
    found[:3, 3] = place
    return found
