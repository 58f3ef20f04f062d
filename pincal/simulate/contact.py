"""Simulated measurements without a view: the tool point is held in sockets, or by a bar, and the joints are read."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.machine import TrueMachine
from pincal.simulate.measure import Table, noise, pose_columns, scatter_of
from pincal.simulate.planning import frames, is_clear, newton_step, plan_poses, position_jacobian, reach
from pincal.simulate.state import Poses
from pincal.simulate.typical import arm_reach

Point = tuple[float, float, float]
# Chord steps on the true arm, of which each gains about three digits, and what has to be left in the end [m].
_STEPS, _HELD = 30, 5e-13
# How far the tool point moves at least, in reaches of the arm, where one joint turns by a radian.
_EASE = 0.02
# Rounds of random goals before a place counts as out of reach, and how many in one, at least.
_ROUNDS, _TRIES = 20, 16


def measure_contacts(
    machine: TrueMachine,
    sockets: Mapping[str, Any],
    *,
    poses_per_socket: int,
    rng: np.random.Generator,
    tool: Point = (0.0, 0.0, 0.0),
    noise_sigma: float = 0.0,
    min_height: float | None = 0.1,
    **conditions: Any,
) -> Table:
    """Hold the tool point in sockets in many orientations and record the joints.

    Args:
        machine: The true machine.
        sockets: Position of each named socket in the robot's base frame [m], shape (3,).
        poses_per_socket: Number of orientations in each.
        rng: Source of randomness.
        tool: Tool point in the tip frame [m].
        noise_sigma: Standard deviation with which the point sits in its socket, each axis [m].
        min_height: Height of the floor from which the arm keeps off [m]; None for no floor.
        **conditions: As in :func:`measure_held`.

    Returns:
        Columns: joints, conditions, and ``socket``.

    Raises:
        BadInputError: If the arm hardly reaches a socket.
    """
    starts = []
    for name, place in sockets.items():
        try:
            goals = _same_place(np.asarray(place, float))
            starts.append(plan_held(machine, goals, poses_per_socket, rng, tool=tool, min_height=min_height))
        except BadInputError:
            raise BadInputError(
                f"socket {name!r} at {place} is out of reach; place it where the tool can be held in it"
            ) from None
    places = np.repeat(np.array([*sockets.values()], float), poses_per_socket, axis=0)
    table = measure_held(machine, np.vstack(starts), places, rng=rng, tool=tool, noise_sigma=noise_sigma, **conditions)
    return table | {"socket": np.repeat(np.array(list(sockets)), poses_per_socket)}


def _same_place(place: np.ndarray) -> Callable[[int], np.ndarray]:
    return lambda count: np.tile(place, (count, 1))


def measure_held(
    machine: TrueMachine,
    q: np.ndarray,
    places: np.ndarray,
    *,
    rng: np.random.Generator,
    tool: Point = (0.0, 0.0, 0.0),
    radius: float = 0.0,
    noise_sigma: float = 0.0,
    payload_com: Any = (0.0, 0.0, 0.0),
    hide: Collection[str] = (),
    **conditions: Any,
) -> Table:
    """Hold the tool point of the true machine at given places, or by a bar, and record the joints.

    Args:
        machine: The true machine.
        q: Joint positions near which it is held [rad or m], shape (N, n).
        places: Where the tool point is held, in the robot's base frame [m], shape (N, 3).
        rng: Source of noise and scatter.
        tool: Tool point in the tip frame [m].
        radius: Length of the bar that holds it off the place, in whatever direction [m]; 0 without a bar.
        noise_sigma: Standard deviation with which the point sits there, each axis [m].
        payload_com: Centre of mass of the payload in the tip frame [m].
        hide: Columns that the table does not show.
        **conditions: ``payload``, ``temperature``, ``time`` and ``approach`` as in
            :func:`pincal.simulate.measure.measure`.

    Returns:
        Columns: joints and conditions.

    Raises:
        BadInputError: If the true arm can't be held there, as by play whose side nobody knows.
    """
    goal = places + noise(places.shape, noise_sigma, rng)
    scatter = scatter_of(machine, q, rng)
    q = np.array(q, float)
    for _ in range(_STEPS):
        poses = machine.poses(q, payload_com=payload_com, scatter=scatter, **conditions)
        missing, jacobian = _missing(machine, poses, goal, radius, tool)
        if np.abs(missing).max(initial=0.0) < _HELD:
            table = pose_columns(machine, poses, conditions)
            return {name: column for name, column in table.items() if name not in hide}
        q = q + newton_step(jacobian, missing)
    worst = int(np.abs(missing).max(axis=1).argmax())
    raise BadInputError(
        f"pose {worst + 1}: the true arm can't be held at {places[worst].round(4).tolist()}; make its errors smaller, "
        "give the approach of joints with play, or take another seed"
    )


def _missing(
    machine: TrueMachine, poses: Poses, goal: np.ndarray, radius: float, tool: Point
) -> tuple[np.ndarray, np.ndarray]:
    """Return the way from tool point to goal, or to the sphere about it, shape (N, 3), and the nominal Jacobian."""
    tip = machine.equilibrium(poses).tip
    point = tip[:, :3, :3] @ np.asarray(tool) + tip[:, :3, 3]
    way = goal - point
    if radius:
        way = way * (1.0 - radius / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12))
    return way, position_jacobian(machine.nominal, frames(machine.nominal, poses.q), point)


def plan_held(
    machine: TrueMachine,
    goals: Callable[[int], np.ndarray],
    n: int,
    rng: np.random.Generator,
    *,
    tool: Point = (0.0, 0.0, 0.0),
    min_height: float | None = 0.1,
) -> np.ndarray:
    """Find poses in which the nominal arm holds the tool point at a goal.

    Args:
        machine: The machine whose nominal arm is planned for.
        goals: Gives so many goals in the base frame [m], shape (count, 3).
        n: Number of poses.
        rng: Source of randomness.
        tool: Tool point in the tip frame [m].
        min_height: Height of the floor from which the arm keeps off [m]; None for no floor.

    Returns:
        Joint positions, shape (n, number of joints).

    Raises:
        BadInputError: If the arm hardly reaches such goals.
    """
    found = np.empty((0, len(machine.names)))
    for _ in range(_ROUNDS):
        seed = plan_poses(machine.nominal, max(2 * n, _TRIES), rng, min_height=min_height)
        q, held = can_hold(machine, seed, goals(len(seed)), tool=tool, min_height=min_height)
        found = np.vstack((found, q[held]))
        if len(found) >= n:
            return found[:n]
    raise BadInputError(f"only {len(found)} of {n} poses hold the tool point there; place it where the arm reaches")


def can_hold(
    machine: TrueMachine, seed: np.ndarray, goals: np.ndarray, *, tool: Point, min_height: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Bring the tool point of the nominal arm to goals.

    Args:
        machine: The machine whose nominal arm it is.
        seed: Joint positions to start from [rad or m], shape (N, n).
        goals: Wanted tool points in the base frame [m], shape (N, 3).
        tool: Tool point in the tip frame [m].
        min_height: Height of the floor from which the arm keeps off [m]; None for no floor.

    Returns:
        Joint positions, shape (N, n), and whether they will do, shape (N,): at the goal, within the limits, off the
        floor, and not so stretched that the true arm could fall short.
    """
    arm = machine.nominal
    q, reached = reach(arm, seed, goals, tool=tool)
    ease = np.linalg.svd(position_jacobian(arm, frames(arm, q), goals), compute_uv=False)[:, -1]
    return q, reached & is_clear(arm, q, min_height) & (ease > _EASE * arm_reach(machine))
