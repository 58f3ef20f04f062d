"""Draws where the parts of a set-up stand: instrument, targets, sockets, anchors, camera and calibration object."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm, transform
from pincal.simulate.contact import Point, can_hold, upward_directions
from pincal.simulate.planning import frames, plan_poses, point_at

# Where an instrument stands and a target sits, in reaches of the arm: distance and height; off the last axis and along it.
_DISTANCE, _HEIGHT = (1.5, 2.5), (0.0, 0.7)
_OFF_AXIS, _ALONG = (0.03, 0.07), (0.02, 0.08)
# Places tried for holding the tool point, trials per place, least share of successes relative to the best place's, and
# the share below which a place is useless.
_PLACES, _TRIALS, _GOOD, _SCARCE = 40, 24, 0.4, 0.1
# How far fixed points are from each other, in reaches of the arm, and the room above the floor that a tool needs [m].
_APART, _ROOM = 0.25, 0.02
# A camera's view is turned from the last axis by so much [rad]; an object stands so far and high, in reaches of the arm.
_TURNED = 0.15
_OBJECT_DISTANCE, _OBJECT_HEIGHT, _OBJECT_TURNED = (0.4, 0.65), (0.05, 0.35), 0.3
# Places tried for an object.
_OBJECT_PLACES = 80


def draw_instrument(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Return T_instrument_base of an instrument at a random place."""
    from scipy.spatial.transform import Rotation

    place = place_beside(arm, rng)
    rotation = Rotation.random(rng=rng).as_matrix()
    return transform(rotation, -rotation @ place)


def draw_targets(arm: Arm, count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return targets off the last axis (on it they would not show that joint), away from each other, as T_tip_target."""
    from scipy.spatial.transform import Rotation

    reach, start = arm.reach, rng.uniform(-np.pi, np.pi)
    found = {}
    for i in range(count):
        angle, radius = start + 2.0 * np.pi * i / count, reach * rng.uniform(*_OFF_AXIS)
        rotation = Rotation.random(rng=rng).as_matrix()
        place = (radius * np.cos(angle), radius * np.sin(angle), reach * rng.uniform(*_ALONG))
        found[f"target_{i + 1}"] = transform(rotation, place)
    return found


def place_beside(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Return a place somewhere in the hall where an instrument can stand, in the robot's base frame [m], shape (3,)."""
    direction, reach = rng.uniform(-np.pi, np.pi), arm.reach
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
    """Find places where the tool point, or the end of a bar, can be held in many ways.

    Args:
        arm: The nominal arm.
        count: How many places.
        rng: Source of randomness.
        tool: Tool point in the tip frame [m].
        radius: Length of the bar from the place to the tool point [m]; 0 without a bar.
        spacing: Put them in pairs so far apart [m]; None: each by itself.
        min_height: Height of the floor [m]; None for no floor.

    Returns:
        Places in the robot's base frame [m], shape (count, 3).

    Raises:
        BadInputError: If the arm holds it nowhere.
    """
    # The end of a bar is where the tool point was: its other end then is within reach, too.
    ends = point_at(frames(arm, plan_poses(arm, _PLACES, rng, min_height=min_height))[:, -1], tool)
    places = ends - radius * upward_directions(_PLACES, rng)
    turn = rng.uniform(-np.pi, np.pi, _PLACES)
    step = (spacing or 0.0) * np.column_stack((np.cos(turn), np.sin(turn), np.zeros(_PLACES)))
    together = np.stack((places, places + step)[: 1 if spacing is None else 2], axis=1)
    share = _success_rate(arm, together.reshape(-1, 3), rng, tool=tool, radius=radius, min_height=min_height)
    share = share.reshape(together.shape[:2]).min(axis=1)
    if share.max() < _SCARCE:
        raise BadInputError("the tool point can hardly be held anywhere; look at --tool, --floor and the length of the bar")
    order = np.argsort(-share, kind="stable")
    order = order[share[order] >= _GOOD * share.max()]
    wanted = -(-count // together.shape[1])
    chosen = _apart(together[order], wanted, _APART * arm.reach)
    return np.asarray(chosen.reshape(-1, 3)[:count])


def _success_rate(
    arm: Arm, places: np.ndarray, rng: np.random.Generator, *, tool: Point, radius: float, min_height: float | None
) -> np.ndarray:
    """Return in which part of random trials the tool point can be held at places, shape (n, 3), or a bar about them."""
    seed = np.tile(plan_poses(arm, _TRIALS, rng, min_height=min_height), (len(places), 1))
    goals = np.repeat(places, _TRIALS, axis=0) + radius * upward_directions(len(seed), rng)
    is_held = can_hold(arm, seed, goals=goals, tool=tool, min_height=min_height)[1].reshape(-1, _TRIALS)
    low = np.zeros(len(places), bool) if min_height is None else places[:, 2] < min_height + _ROOM
    return np.asarray(np.where(low, 0.0, is_held.mean(axis=1)))


def _apart(groups: np.ndarray, count: int, distance: float) -> np.ndarray:
    """Return the first groups of places, shape (n, k, 3), that are so far apart, or closer where there are not enough."""
    while True:
        chosen: list[np.ndarray] = []
        for group in groups:
            if all(np.linalg.norm(group[0] - other[0]) >= distance for other in chosen) and len(chosen) < count:
                chosen.append(group)
        if len(chosen) == count:
            return np.array(chosen)
        if distance < 1e-3:
            raise BadInputError(
                f"only {len(groups)} places where the tool point can well be held, {count} wanted; ask for fewer"
            )
        distance *= 0.7


def draw_camera(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Return T_tip_camera, z along the view, of a camera beside the last axis that looks along it and away from the arm."""
    from scipy.spatial.transform import Rotation

    reach = arm.reach
    axis = arm.placements[-1][:3, :3].T @ [0.0, 0.0, 1.0]
    # Away from the arm is where the tip lies, seen from the joints before, on the average.
    places = frames(arm, plan_poses(arm, 50, np.random.default_rng(0), min_height=None))
    ahead = np.einsum(
        "nab,na->nb", places[:, -1, :3, :3], places[:, -1, :3, 3] - places[:, max(len(arm.names) // 2, 1), :3, 3]
    )
    axis = axis * (1.0 if float((ahead @ axis).mean()) >= 0.0 else -1.0)
    onto = Rotation.align_vectors(axis[None], [[0.0, 0.0, 1.0]])[0]
    angle = rng.uniform(-np.pi, np.pi)
    place = onto.apply([reach * 0.05 * np.cos(angle), reach * 0.05 * np.sin(angle), 0.0])
    lean = Rotation.from_rotvec(rng.uniform(-_TURNED, _TURNED, 3) * [1.0, 1.0, 0.0])
    return transform((onto * lean * Rotation.from_rotvec([0.0, 0.0, angle])).as_matrix(), place)


def draw_object(arm: Arm, rng: np.random.Generator, *, is_seen: Callable[[np.ndarray], bool]) -> np.ndarray:
    """Stand a calibration object before the robot where the camera can look at all of it.

    Both the pose returned and the argument of ``is_seen`` are transforms from object to base frame, shape (4, 4).

    Raises:
        BadInputError: If no place is suitable.
    """
    from scipy.spatial.transform import Rotation

    reach = arm.reach
    for _ in range(_OBJECT_PLACES):
        direction = rng.uniform(-np.pi, np.pi)
        ground = rng.uniform(*_OBJECT_DISTANCE) * np.array([np.cos(direction), np.sin(direction)])
        place = reach * np.append(ground, rng.uniform(*_OBJECT_HEIGHT))
        turned = direction + rng.uniform(-_OBJECT_TURNED, _OBJECT_TURNED)
        pose = transform(Rotation.from_euler("ZYX", [turned, *rng.uniform(-0.05, 0.05, 2)]).as_matrix(), place)
        if is_seen(pose):
            return pose
    raise BadInputError(
        f"{_OBJECT_PLACES} places, and the arm can bring the camera before all of the object in none of them; take another "
        "seed, a plane grid or a lens of shorter focal length, and an arm of at least six joints"
    )
