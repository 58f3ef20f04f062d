"""Random poses of instruments, targets, sockets, anchors, cameras and calibration objects; set-ups
that hold the tool point.

The tool point is held in sockets, or by a bar of constant length, while the joints are read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm, frames, transform
from pincal.simulate.planning import (
    collect_poses,
    is_clear,
    newton_step,
    plan_poses,
    point_at,
    position_jacobian,
    reach,
)
from pincal.simulate.rods import driving
from pincal.simulate.setup import (
    Machine,
    Reading,
    SensorSetup,
    as_lists,
    draw_noise,
    refuse_scale,
    tips_of,
    transformed,
)
from pincal.simulate.state import Poses
from pincal.simulate.tracker import as_read

# Distance and height of an instrument, and of a target off and along the last axis, in reaches of
# the arm.
_DISTANCE = (1.5, 2.5)
_HEIGHT = (0.0, 0.7)
_OFF_AXIS = (0.03, 0.07)
_ALONG = (0.02, 0.08)
# Positions tried for holding the tool point, trials at each, least success rate relative to the
# best, and the success rate below which a position is useless.
_PLACES = 40
_TRIALS = 24
_GOOD = 0.4
_SCARCE = 0.1
# Spacing of fixed points, in reaches of the arm, and clearance above the floor that a tool needs
# [m].
_APART = 0.25
_ROOM = 0.02
# Tilt of a camera from the last axis [rad]; distance and height, in reaches of the arm, and
# rotation [rad] of an object.
_TURNED = 0.15
_OBJECT_DISTANCE = (0.4, 0.65)
_OBJECT_HEIGHT = (0.05, 0.35)
_OBJECT_TURNED = 0.3
# Positions tried for an object.
_OBJECT_PLACES = 80


def draw_instrument(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Return T_instrument_base of an instrument in a random pose."""
    from scipy.spatial.transform import Rotation

    place = place_beside(arm, rng)
    rotation = Rotation.random(rng=rng).as_matrix()
    return transform(rotation, -rotation @ place)


def draw_targets(arm: Arm, count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return targets off the last axis (on it they would not show its joint), well separated, as
    T_tip_target.
    """
    from scipy.spatial.transform import Rotation

    reach = arm.reach
    start = rng.uniform(-np.pi, np.pi)
    found = {}
    for i in range(count):
        angle = start + 2.0 * np.pi * i / count
        radius = reach * rng.uniform(*_OFF_AXIS)
        rotation = Rotation.random(rng=rng).as_matrix()
        place = (radius * np.cos(angle), radius * np.sin(angle), reach * rng.uniform(*_ALONG))
        found[f"target_{i + 1}"] = transform(rotation, place)
    return found


def place_beside(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Return a random position for an instrument in the hall, in the robot's base frame [m], shape
    (3,).
    """
    direction = rng.uniform(-np.pi, np.pi)
    reach = arm.reach
    ground = rng.uniform(*_DISTANCE) * np.array([np.cos(direction), np.sin(direction)])
    return np.asarray(reach * np.append(ground, rng.uniform(*_HEIGHT)))


def draw_fixed_points(
    arm: Arm,
    count: int,
    rng: np.random.Generator,
    *,
    tool: Point,
    radius: float = 0.0,
    spacing: float | None = None,
    min_height: float | None = 0.0,
) -> np.ndarray:
    """Draw fixed points at which the tool point, or the far end of a bar, can be held in many
    poses.

    Args:
        arm: The nominal arm.
        count: Number of points.
        rng: Source of randomness.
        tool: Tool point in the tip frame [m].
        radius: Length of the bar from the fixed point to the tool point [m]; 0 without a bar.
        spacing: Distance of the two points of a pair [m]; None for single points.
        min_height: Height of the floor [m]; None for no floor.

    Returns:
        Positions in the robot's base frame [m], shape (count, 3).

    Raises:
        BadInputError: If there is no such point.
    """
    # Bars end at tool points of random poses, so that their other end is within reach, too.
    ends = point_at(frames(arm, plan_poses(arm, _PLACES, rng, min_height=min_height))[:, -1], tool)
    places = ends - radius * upward_directions(_PLACES, rng)
    turn = rng.uniform(-np.pi, np.pi, _PLACES)
    step = (spacing or 0.0) * np.column_stack((np.cos(turn), np.sin(turn), np.zeros(_PLACES)))
    together = np.stack((places, places + step)[: 1 if spacing is None else 2], axis=1)
    share = _success_rate(
        arm, together.reshape(-1, 3), rng, tool=tool, radius=radius, min_height=min_height
    )
    share = share.reshape(together.shape[:2]).min(axis=1)
    if share.max() < _SCARCE:
        raise BadInputError(
            "the tool point can hardly be held anywhere; check --tool, --floor and the "
            "length of the bar"
        )
    order = np.argsort(-share, kind="stable")
    order = order[share[order] >= _GOOD * share.max()]
    wanted = -(-count // together.shape[1])
    chosen = _apart(together[order], wanted, _APART * arm.reach)
    return np.asarray(chosen.reshape(-1, 3)[:count])


def _success_rate(
    arm: Arm,
    places: np.ndarray,
    rng: np.random.Generator,
    *,
    tool: Point,
    radius: float,
    min_height: float | None,
) -> np.ndarray:
    """Return the fraction of random trials in which the tool point, or a bar, can be held at
    points, shape (n, 3).
    """
    seed = np.tile(plan_poses(arm, _TRIALS, rng, min_height=min_height), (len(places), 1))
    goals = np.repeat(places, _TRIALS, axis=0) + radius * upward_directions(len(seed), rng)
    is_held = can_hold(arm, seed, goals=goals, tool=tool, min_height=min_height)[1].reshape(
        -1, _TRIALS
    )
    low = np.zeros(len(places), bool) if min_height is None else places[:, 2] < min_height + _ROOM
    return np.asarray(np.where(low, 0.0, is_held.mean(axis=1)))


def _apart(groups: np.ndarray, count: int, distance: float) -> np.ndarray:
    """Return the first ``count`` groups of points, shape (n, k, 3), so far apart, or closer if
    there are too few.
    """
    while True:
        chosen: list[np.ndarray] = []
        for group in groups:
            if (
                all(np.linalg.norm(group[0] - other[0]) >= distance for other in chosen)
                and len(chosen) < count
            ):
                chosen.append(group)
        if len(chosen) == count:
            return np.array(chosen)
        if distance < 1e-3:
            raise BadInputError(
                f"only {len(groups)} positions at which the tool point can be held well, "
                f"{count} requested; request fewer"
            )
        distance *= 0.7


def draw_camera(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Return T_tip_camera, z along the optical axis, of a camera near the last axis, looking along
    it away from the arm.
    """
    from scipy.spatial.transform import Rotation

    reach = arm.reach
    axis = arm.placements[-1][:3, :3].T @ [0.0, 0.0, 1.0]
    # Away from the arm is the mean direction from the middle joint to the tip.
    places = frames(arm, plan_poses(arm, 50, np.random.default_rng(0), min_height=None))
    ahead = np.einsum(
        "nab,na->nb",
        places[:, -1, :3, :3],
        places[:, -1, :3, 3] - places[:, max(len(arm.names) // 2, 1), :3, 3],
    )
    axis = axis * (1.0 if float((ahead @ axis).mean()) >= 0.0 else -1.0)
    onto = Rotation.align_vectors(axis[None], [[0.0, 0.0, 1.0]])[0]
    angle = rng.uniform(-np.pi, np.pi)
    place = onto.apply([reach * 0.05 * np.cos(angle), reach * 0.05 * np.sin(angle), 0.0])
    lean = Rotation.from_rotvec(rng.uniform(-_TURNED, _TURNED, 3) * [1.0, 1.0, 0.0])
    return transform((onto * lean * Rotation.from_rotvec([0.0, 0.0, angle])).as_matrix(), place)


def draw_cell_camera(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Return T_camera_base, z along the optical axis, of a camera next to the robot that looks at
    half its reach.
    """
    from scipy.spatial.transform import Rotation

    place = place_beside(arm, rng)
    towards = np.array([0.0, 0.0, 0.5 * arm.reach]) - place
    onto = Rotation.align_vectors(towards[None], [[0.0, 0.0, 1.0]])[0]
    turn = (onto * Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])).inv().as_matrix()
    return transform(turn, -turn @ place)


def draw_object(
    arm: Arm, rng: np.random.Generator, *, is_seen: Callable[[np.ndarray], bool]
) -> np.ndarray:
    """Draw T_base_object, shape (4, 4), of a calibration object that the camera can see by
    ``is_seen(T_base_object)``.

    Raises:
        BadInputError: If no position is suitable.
    """
    from scipy.spatial.transform import Rotation

    reach = arm.reach
    for _ in range(_OBJECT_PLACES):
        direction = rng.uniform(-np.pi, np.pi)
        ground = rng.uniform(*_OBJECT_DISTANCE) * np.array([np.cos(direction), np.sin(direction)])
        place = reach * np.append(ground, rng.uniform(*_OBJECT_HEIGHT))
        turned = direction + rng.uniform(-_OBJECT_TURNED, _OBJECT_TURNED)
        pose = transform(
            Rotation.from_euler("ZYX", [turned, *rng.uniform(-0.05, 0.05, 2)]).as_matrix(), place
        )
        if is_seen(pose):
            return pose
    raise BadInputError(
        f"none of {_OBJECT_PLACES} positions of the object lets the camera see all of it; "
        "use another seed, a plane grid or "
        "a lens of shorter focal length, and an arm of at least six joints"
    )


Point = tuple[float, float, float]
# Chord steps on the true arm, of which each gains about three digits, and the tolerance [m].
_STEPS = 30
_CLOSED = 5e-13
# Least singular value of the tool point's Jacobian, relative to the arm's reach per radian.
_LEAST_MOBILITY = 0.02
# Rounds of random goals before a point counts as out of reach, and the smallest number of goals in
# a round.
_ROUNDS = 20
_TRIES = 16
# Largest distance of the tool point in a given pose from where it can be held [m].
_NEAR = 0.02


@dataclass(frozen=True, kw_only=True)
class Contact(SensorSetup):
    """The tool point is held at fixed points in many orientations: directly, in sockets, or by a
    ball bar.

    With sockets only the joints are read, and ``sigma`` is the standard deviation of the seating
    along each axis [m]. With a bar its length is read, too, with noise ``sigma`` [m].

    Attributes:
        fixed: The fixed points in the robot's base frame [m], shape (3,), by name.
        tool: Tool point in the tip frame [m].
        instrument: Transform from the robot's base frame to the frame in which the points are
            known, shape (4, 4).
        length: Length of the bar between fixed point and tool point [m]; 0 for sockets.
    """

    fixed: Mapping[str, Any]
    tool: Point = (0.0, 0.0, 0.0)
    instrument: np.ndarray = field(default_factory=lambda: np.eye(4))
    length: float = 0.0

    @property
    def kind(self) -> str:
        return "distance" if self.length else "socket"

    @property
    def _label(self) -> str:
        return "anchor" if self.length else "socket"

    @property
    def points(self) -> dict[str, np.ndarray]:
        return transformed(self.instrument, self.fixed)

    @property
    def _places(self) -> np.ndarray:
        return np.array([*self.fixed.values()], float)

    def plan(
        self, arm: Arm, n: int, *, rng: np.random.Generator, min_height: float | None = 0.1
    ) -> np.ndarray:
        """Draw poses that hold the tool point at one fixed point after the other."""
        shares = np.bincount(np.arange(n) * len(self.fixed) // n, minlength=len(self.fixed))
        planned = []
        for (name, place), share in zip(self.fixed.items(), shares, strict=True):
            try:
                planned.append(
                    self._plan_at(
                        arm, np.asarray(place, float), n=share, rng=rng, min_height=min_height
                    )
                )
            except BadInputError as error:
                raise BadInputError(f"{name}: {error}") from None
        return np.vstack(planned)

    def _plan_at(
        self,
        arm: Arm,
        place: np.ndarray,
        *,
        n: int,
        rng: np.random.Generator,
        min_height: float | None,
    ) -> np.ndarray:
        def draw() -> np.ndarray:
            seed = plan_poses(arm, max(2 * n, _TRIES), rng, min_height=min_height)
            goals = place + self.length * upward_directions(len(seed), rng)
            q, is_held = can_hold(arm, seed, goals=goals, tool=self.tool, min_height=min_height)
            return np.asarray(q[is_held])

        shortage = (
            "hold the tool point there, as it is out of reach; choose a point within the "
            "arm's reach"
        )
        return collect_poses(draw, n, rounds=_ROUNDS, shortage=shortage)

    def _read(self, machine: Machine, poses: Poses, rng: np.random.Generator | None) -> Reading:
        """Return the true machine's joints at the fixed point nearest to each pose, and the reading
        there.
        """
        if not self.length:
            refuse_scale(machine, "a socket reads none")
        owner, offset = self._nearest(point_at(frames(machine.nominal, poses.q)[:, -1], self.tool))
        off = np.abs(np.linalg.norm(offset, axis=1) - self.length)
        if off.max() > _NEAR:
            worst = int(off.argmax())
            raise BadInputError(
                f"pose {worst + 1}: the tool point is {off[worst]:.3f} m from where it can be held "
                f"({', '.join(self.fixed)}); leave --at out, or give poses of the same "
                "machine and seed"
            )
        # A bar has noise in the reading of its length, a socket in the position of the tool point.
        play = draw_noise(offset.shape, 0.0 if self.length else self.sigma, rng)
        held = hold(machine, poses, self._places[owner] + play, tool=self.tool, radius=self.length)
        columns = {self._label: np.array(list(self.fixed))[owner]}
        if self.length:
            bar = self.length * offset / np.linalg.norm(offset, axis=1, keepdims=True)
            length = np.linalg.norm(as_read(machine.effects, bar), axis=1)
            columns = {"distance": length + draw_noise(length.shape, self.sigma, rng)} | columns
        return Reading(held, np.arange(len(owner)), columns)

    def _nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the index of each tool point's fixed point, shape (N,), and the vector from there
        [m], shape (N, 3).
        """
        offsets = points[:, None] - self._places
        owner = np.abs(np.linalg.norm(offsets, axis=2) - self.length).argmin(axis=1)
        return owner, offsets[np.arange(len(points)), owner]

    def line_of_sight(self, tip: np.ndarray) -> np.ndarray:
        """Return the tool point in the base frame, or the bar's vector from anchor to
        tool point.
        """
        points = point_at(tip, self.tool)
        return self._nearest(points)[1] if self.length else points

    def truth(self) -> dict[str, Any]:
        return {
            "noise": {"sigma_m": self.sigma, "sigma_rad": None},
            "T_instrument_base": self.instrument.tolist(),
            f"{self._label}s_in_base_m": as_lists(self.fixed),
            "tool_m": list(self.tool),
        } | ({"ball_bar_m": self.length} if self.length else {})


def hold(
    machine: Machine, poses: Poses, places: np.ndarray, *, tool: Point, radius: float = 0.0
) -> Poses:
    """Return the recorded poses, near some poses, with the true machine's tool point held at fixed
    points or by a bar.

    Args:
        machine: The true machine.
        poses: Poses near which it is held.
        places: The fixed points in the robot's base frame [m], shape (N, 3).
        tool: Tool point in the tip frame [m].
        radius: Length of the bar from the fixed point [m]; 0 without a bar.

    Raises:
        BadInputError: If the true arm can't be held there, as with backlash of unknown direction.
    """
    for _ in range(_STEPS):
        tip = tips_of(machine, poses)
        point = point_at(tip, tool)
        missing = places - point
        if radius:
            missing = missing * (
                1.0 - radius / np.maximum(np.linalg.norm(missing, axis=1, keepdims=True), 1e-12)
            )
        if np.abs(missing).max(initial=0.0) < _CLOSED:
            return poses
        joint_frames = frames(machine.nominal, poses.q)
        jacobian = position_jacobian(machine.nominal, joint_frames, point)
        moves = driving(machine.nominal, joint_frames)
        poses = replace(poses, q=poses.q + newton_step(moves, jacobian, missing))
    worst = int(np.abs(missing).max(axis=1).argmax())
    raise BadInputError(
        f"pose {worst + 1}: the true arm can't be held at {places[worst].round(4).tolist()}; make "
        "its errors smaller, give the approach of joints with play, or take another seed"
    )


def can_hold(
    arm: Arm, seed: np.ndarray, *, goals: np.ndarray, tool: Point, min_height: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Bring the tool point of the nominal arm to goals [m, base frame], shape (N, 3), from joint
    positions ``seed``, (N, n).

    Returns:
        Joint positions, shape (N, n), and whether they are suitable, shape (N,): at the goal,
        within the limits, above the floor, and not so stretched that the true arm could fall short.
    """
    q, reached = reach(arm, seed, goal=goals, tool=tool)
    is_held = reached & is_clear(arm, q, min_height)
    held = q[is_held]
    jacobian = position_jacobian(arm, frames(arm, held), goals[is_held])
    mobility = np.linalg.svd(jacobian, compute_uv=False)[:, -1]
    is_held[is_held] = mobility > _LEAST_MOBILITY * arm.reach
    return q, is_held


def upward_directions(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return random unit vectors, uniform over the upper hemisphere, shape (count, 3)."""
    height = rng.uniform(0.0, 1.0, count)
    turn = rng.uniform(-np.pi, np.pi, count)
    across = np.sqrt(1.0 - height**2)
    return np.column_stack((across * np.cos(turn), across * np.sin(turn), height))
