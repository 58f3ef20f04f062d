"""Admissible poses: joint limits, floor, box, line of sight, self-collision; random poses within
these constraints.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pincal.design.collisions import Bodies
from pincal.design.design_numbers import DESIGN_NUMBERS
from pincal.errors import BadInputError
from pincal.robot.robot import Robot
from pincal.robot.se3 import perpendicular
from pincal.thresholds import Count, Scale

# Half angle of the cone in which a corner-cube reflector is seen [rad]: 30 degrees by the data
# sheets.
CONE: Scale = np.pi / 6.0
# Most random poses tried per pose requested, and at once.
_TRIES: Count = 200
_BATCH: Count = 4096
# Most candidates of a design: about 200 MB (20 000: 40 MB), and minutes.
_MOST: Count = 100_000
# Steps towards a socket for the target, their damping in reaches of the arm, and the tolerance [m].
_STEPS: Count = 25
_DAMPING: Scale = 0.03
_THERE: Scale = 1e-4
# Default position of a target off and along the last axis, in reaches of the arm.
_OFF_AXIS: Scale = 0.05
_ALONG: Scale = 0.05


@dataclass(frozen=True)
class SensorSetup:
    """Sensor, its position and the target.

    Attributes:
        sensor: "position", "pose", "distance" or "socket".
        tool: approximate position of the target in the tip frame [m]; default: off the last axis by
            a twentieth of the
        reach.
        instrument: position of the instrument in the robot's base frame [m]; None if it sees
            everything.
        normal: normal of the target, in the tip frame; None if it is visible from all sides.
        cone: largest angle to the normal at which it is visible [rad].
        held_at: approximate positions of the sockets that hold the target, in the frame of the
            first link of the robot's path, its base for one arm [m].
        held_names: names of these sockets; default: socket_1, socket_2, ...
    """

    sensor: str = "position"
    tool: tuple[float, float, float] | None = None
    instrument: tuple[float, float, float] | None = None
    normal: tuple[float, float, float] | None = None
    cone: float = CONE
    held_at: tuple[tuple[float, float, float], ...] = ()
    held_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        held = [("place", place) for place in self.held_at]
        for what, place in (
            ("tool", self.tool),
            ("instrument", self.instrument),
            ("normal", self.normal),
            *held,
        ):
            if place is not None and not np.isfinite(place).all():
                raise BadInputError(
                    f"{what} {' '.join(f'{v:g}' for v in place)}; expected three finite numbers"
                )
        if self.normal is not None and self.instrument is None:
            raise BadInputError(
                "the target has a normal, but the position of the instrument is not given"
            )
        if self.normal is not None and not np.any(self.normal):
            raise BadInputError(f"normal of the target {self.normal}; expected a direction")
        if not 0.0 < self.cone <= np.pi:
            raise BadInputError(
                f"cone of {np.degrees(self.cone):g} deg about the target's normal; "
                "expected 0 to 180 deg"
            )

    @property
    def places(self) -> np.ndarray:
        """Positions of the sockets, shape (K, 3) [m]."""
        return np.array(self.held_at, float).reshape(-1, 3)

    def target(self, robot: Robot) -> np.ndarray:
        """Return the position of the target in the tip frame, shape (3,) [m]."""
        return default_target(robot) if self.tool is None else np.array(self.tool, float)


def default_target(robot: Robot) -> np.ndarray:
    """Return a position in the tip frame, shape (3,) [m], off the last axis: on it a target does
    not show the last joint.
    """
    last = robot.path.tip_joint
    T_tip_joint = np.linalg.inv(robot.path.T_joint_tip) @ robot.T_link_joint[last]
    slides = robot.joint_types[last] == "prismatic"
    axis = (robot.frames.T_base_link[last] @ robot.path.T_joint_tip)[:3, :3].T @ robot.frames.axis(
        last, robot.parents[last]
    )
    # Away from the arm: along the axis in the direction from the last joint to the tip.
    axis = axis if axis @ T_tip_joint[:3, 3] <= 0.0 or slides else -axis
    side = perpendicular(axis)
    return np.asarray(robot.reach * (_OFF_AXIS * side / np.linalg.norm(side) + _ALONG * axis))


@dataclass(frozen=True)
class Limits:
    """Limits of the workspace.

    Attributes:
        span: fraction of the joint range that is used, about its middle.
        floor: least height in the base frame of target and arm, from the third joint's link on [m];
            None for no floor.
        box: least x, y, z and largest x, y, z of the measured target, in the base frame [m]; None
            for no box.
        clearance: least distance of the arm from itself [m].
    """

    span: float = 0.95
    floor: float | None = 0.0
    box: tuple[float, float, float, float, float, float] | None = None
    clearance: float = 0.01

    def __post_init__(self) -> None:
        if not 0.0 < self.span <= 1.0:
            raise BadInputError(
                f"span {self.span:g} of the joint range; expected more than 0 and at most 1"
            )
        if self.floor is not None and not np.isfinite(self.floor):
            raise BadInputError(f"floor at {self.floor:g} m; expected a finite height")
        if not 0.0 <= self.clearance < np.inf:
            raise BadInputError(f"clearance {self.clearance:g} m; expected 0 or more")
        if self.box is not None and not all(
            low < high for low, high in zip(self.box[:3], self.box[3:], strict=True)
        ):
            raise BadInputError(
                f"box {' '.join(f'{v:g}' for v in self.box)}; expected least x y z, then "
                "larger x y z [m]"
            )


@dataclass(frozen=True)
class Draw:
    """Random poses that satisfy all constraints.

    Attributes:
        q: shape (N, n), joint positions [rad or m].
        drawn: number of poses tried.
        removed: constraint -> number of poses that it removed from those left by the preceding
            constraints.
    """

    q: np.ndarray
    drawn: int
    removed: dict[str, int]

    def in_words(self) -> str:
        """Return the number of poses tried, and of those removed by each constraint."""
        parts = [f"{name} {count}" for name, count in self.removed.items()]
        removed = f"removed: {', '.join(parts)}" if parts else "nothing else limits them"
        return f"{len(self.q)} of {self.drawn} random poses within the joint limits; {removed}"


class _Placed(NamedTuple):
    """Joint positions, and in the base frame the frames of the bodies, tips, targets and sockets,
    shape (N, K, 3).
    """

    q: np.ndarray
    frames: np.ndarray
    tips: np.ndarray
    targets: np.ndarray
    places: np.ndarray


@dataclass(frozen=True)
class Reach:
    """The admissible poses of an arm, and those in which it can be measured.

    Attributes:
        robot: the arm.
        rig: sensor set-up.
        limits: limits of the workspace.

    Example:
        >>> reach = Reach(Robot.from_urdf("ur10"), SensorSetup(instrument=(3.0, 0.0, 1.0)))
        >>> found = reach.draw(20, np.random.default_rng(0))
        >>> bool(reach.allows_apart(found.q).all())
        True
    """

    robot: Robot
    rig: SensorSetup = SensorSetup()
    limits: Limits = Limits()

    @cached_property
    def bodies(self) -> Bodies:
        """Bodies of the arm, which may obstruct it."""
        return Bodies.of(self.robot, clearance=self.limits.clearance)

    @cached_property
    def target(self) -> np.ndarray:
        """Position of the target in the tip frame, shape (3,) [m]."""
        return self.rig.target(self.robot)

    @cached_property
    def range(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest joint positions, shape (n,) each [rad or m]; a full turn for a joint
        without limits.
        """
        return self.robot.joint_range(self.limits.span)

    def allows_apart(self, q: np.ndarray) -> np.ndarray:
        """Return whether poses, shape (N, n), satisfy all constraints of a measurement but
        self-collision, shape (N,).
        """
        lower, upper = self.range
        allowed = np.asarray(np.all((q >= lower - 1e-12) & (q <= upper + 1e-12), axis=1))
        rows = np.flatnonzero(allowed)
        for _, at_fault in self._faults(self._place(q[rows]), measured=True, colliding=False):
            allowed[rows[at_fault]] = False
        return allowed

    def targets(self, q: np.ndarray) -> np.ndarray:
        """Return the positions of the target in the base frame, shape (N, 3) [m]."""
        return self._place(q).targets

    def collides(self, q: np.ndarray) -> np.ndarray:
        """Return whether the arm collides with itself, shape (N,), as far as that can
        be checked.
        """
        return (
            np.zeros(len(q), bool)
            if self.bodies.collisions is None
            else self.bodies.collisions.hit(q)
        )

    def draw(self, n: int, rng: np.random.Generator, *, measured: bool = True) -> Draw:
        """Draw random joint positions until ``n`` satisfy all constraints; fewer if hardly any do.

        With ``measured`` they also have to be in the box and in sight. BadInputError if n is too
        large.
        """
        if n > _MOST:
            raise BadInputError(
                f"{n} random poses to choose from; expected at most {_MOST}: ask for fewer"
            )
        found = np.empty((0, self.robot.n_joints))
        removed = dict[str, int]()
        drawn = 0
        while len(found) < n and drawn < _TRIES * n + _BATCH:
            # About as many as are still needed, by the acceptance rate so far.
            wanted = (n - len(found)) * (drawn + 1) / (len(found) + 1) if drawn else 1.25 * n
            placed = self._random(int(np.clip(wanted, 64, _BATCH)), rng, measured=measured)
            drawn += len(placed.q)
            left = np.ones(len(placed.q), bool)
            for name, at_fault in self._faults(placed, measured=measured, colliding=True):
                removed[name] = removed.get(name, 0) + int(np.sum(left & at_fault))
                left &= ~at_fault
            found = np.vstack([found, placed.q[left]])
        return Draw(found[:n], drawn, removed)

    def tried(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Return those of n random poses that satisfy all constraints of a measurement, shape (M,
        joints); where the target is held in sockets, of n poses brought there.
        """
        placed = self._random(n, rng, measured=True)
        left = np.ones(len(placed.q), bool)
        for _, at_fault in self._faults(placed, measured=True, colliding=True):
            left &= ~at_fault
        return placed.q[left]

    def _random(self, n: int, rng: np.random.Generator, *, measured: bool) -> _Placed:
        """Return at most n random poses within the joint limits, brought to the sockets, if any."""
        lower, upper = self.range
        q = self.robot.following(rng.uniform(lower, upper, (n, len(lower))))
        q = q if self.robot.linkage is None else q[self.robot.linkage.can_take(q)]
        return self._place(self._brought(q, rng) if measured and self.rig.held_at else q)

    def _brought(self, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return poses near q, shape (N, n), that hold the target in one of the sockets, if within
        reach.

        The steps are Levenberg's: of least length, damped near singular poses.
        """
        choice = rng.integers(len(self.rig.held_at), size=len(q))
        steps = dict(self.robot.path.steps(self.robot.parents))
        # A joint carries the target, or on the other branch of the path the sockets, or neither.
        carries = np.array([steps.get(i, 0) for i in range(self.robot.n_joints)])
        turns = np.array([kind != "prismatic" for kind in self.robot.joint_types])
        for _ in range(_STEPS):
            placed = self._place(q)
            goals = placed.places[np.arange(len(q)), choice]
            carriers = placed.frames[:, np.array(self.robot.parents) + 1]
            carriers[:, 0] = self.robot.kinematics.first
            joints = carriers @ self.robot.kinematics.before
            moved = (
                np.where((carries > 0)[:, None], placed.targets[:, None], goals[:, None])
                - joints[..., :3, 3]
            )
            axes = joints[..., :3, 2] * carries[:, None]
            J = self.robot.gathered(
                np.where(turns[:, None], np.cross(axes, moved), axes).transpose(0, 2, 1), q
            )
            damped = J @ J.transpose(0, 2, 1) + (_DAMPING * self.robot.reach) ** 2 * np.eye(3)
            step = (
                J.transpose(0, 2, 1) @ np.linalg.solve(damped, (goals - placed.targets)[..., None])
            )[..., 0]
            q = self.robot.spread(q[:, self.robot.own_joints] + step)
        # Of equivalent positions q + 2 pi k the one nearest to the middle of the range is used.
        middle = np.mean(self.range, axis=0)
        return self.robot.following(
            q - np.where(turns, 2.0 * np.pi * np.round((q - middle) / (2.0 * np.pi)), 0.0)
        )

    def _place(self, q: np.ndarray) -> _Placed:
        frames = self.robot.kinematics.frames(q)
        (_, start, T_start), (_, last, T_tip) = self.robot.path.ends
        starts = frames[:, start + 1] @ T_start
        tips = frames[:, last + 1] @ T_tip
        places = self.rig.places @ starts[:, :3, :3].transpose(0, 2, 1) + starts[:, None, :3, 3]
        return _Placed(q, frames, tips, tips[:, :3, :3] @ self.target + tips[:, :3, 3], places)

    def _faults(
        self, placed: _Placed, *, measured: bool, colliding: bool
    ) -> Iterator[tuple[str, np.ndarray]]:
        """Yield each constraint and the poses that violate it, shape (N,), except poses that
        already violate others.
        """
        limits = self.limits
        left = np.ones(len(placed.q), bool)
        if limits.floor is not None:
            lowest = self.bodies.boxes.lowest(placed.frames, DESIGN_NUMBERS.off_the_floor)
            height = np.minimum(placed.targets[:, 2], lowest)
            yield f"floor at {limits.floor:g} m", height < limits.floor
            left &= height >= limits.floor
        if measured:
            for name, at_fault in self._unseen(placed):
                yield name, at_fault
                left &= ~at_fault
        if colliding and self.bodies.collisions is not None:
            at_fault = np.zeros(len(left), bool)
            at_fault[left] = self.collides(placed.q[left])
            yield "self-collision", at_fault

    def _unseen(self, placed: _Placed) -> Iterator[tuple[str, np.ndarray]]:
        """Yield each constraint on the measurement of the target, and the poses that violate it."""
        rig = self.rig
        box = self.limits.box
        if rig.held_at:
            off = np.linalg.norm(placed.targets[:, None] - placed.places, axis=2).min(axis=1)
            lower, upper = self.range
            yield (
                "bringing the target there",
                (off > _THERE) | np.any((placed.q < lower) | (placed.q > upper), axis=1),
            )
        if box is not None:
            low = np.array(box[:3])
            high = np.array(box[3:])
            yield "box", np.any((placed.targets < low) | (placed.targets > high), axis=1)
        if rig.instrument is None:
            return
        eye = np.array(rig.instrument, float)
        if rig.normal is not None:
            normal = placed.tips[:, :3, :3] @ (np.array(rig.normal) / np.linalg.norm(rig.normal))
            sight = eye - placed.targets
            across = np.einsum("ni,ni->n", normal, sight) < np.cos(rig.cone) * np.linalg.norm(
                sight, axis=1
            )
            yield f"facing the instrument within {np.degrees(rig.cone):g} deg", across
        yield "line of sight", self.bodies.boxes.hide(placed.frames, eye, placed.targets)
