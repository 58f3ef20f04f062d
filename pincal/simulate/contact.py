"""Simulated measurements without an instrument: the tool point is held in sockets and the joints are read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.machine import TrueMachine
from pincal.simulate.measure import Table, noise
from pincal.simulate.planning import frames, newton_step, plan_poses, position_jacobian, reach

# Rounds of chord steps on the true arm; each gains about three digits.
_ROUNDS = 12


def measure_contacts(
    machine: TrueMachine,
    sockets: Mapping[str, Any],
    *,
    poses_per_socket: int,
    rng: np.random.Generator,
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0),
    noise_sigma: float = 0.0,
    payload: Any = None,
    payload_com: Any = (0.0, 0.0, 0.0),
) -> Table:
    """Hold the tool point in sockets in many orientations and record the joints.

    Args:
        machine: The true machine.
        sockets: Position of each named socket in the robot's base frame [m], shape (3,).
        poses_per_socket: Number of orientations in each.
        rng: Source of randomness.
        tool: Tool point in the tip frame [m].
        noise_sigma: Standard deviation with which the point sits in its socket, each axis [m].
        payload: Declared mass at the tip [kg].
        payload_com: Its centre of mass in the tip frame [m].

    Returns:
        Columns: joints, ``payload`` if declared, and ``socket``.

    Raises:
        BadInputError: If the arm hardly reaches a socket.
    """
    starts = [_starts(machine, name, place, poses_per_socket, rng, tool) for name, place in sockets.items()]
    goal = np.repeat(np.array([*sockets.values()], float), poses_per_socket, axis=0)
    goal = goal + noise(goal.shape, noise_sigma, rng)
    q, scatter = np.vstack(starts), rng.spawn(1)[0].standard_normal((len(goal), len(machine.names)))
    for _ in range(_ROUNDS):
        poses = machine.poses(q, payload=payload, payload_com=payload_com, scatter=scatter)
        tip = machine.equilibrium(poses).tip
        point = tip[:, :3, :3] @ np.asarray(tool) + tip[:, :3, 3]
        jacobian = position_jacobian(machine.nominal, frames(machine.nominal, q), point)
        q = q + newton_step(jacobian, goal - point)
    table = dict(zip(machine.names, q.T, strict=True))
    if payload is not None:
        table["payload"] = np.array(np.broadcast_to(np.asarray(payload, float), len(q)))
    return table | {"socket": np.repeat(np.array(list(sockets)), poses_per_socket)}


def _starts(
    machine: TrueMachine,
    name: str,
    place: Any,
    n: int,
    rng: np.random.Generator,
    tool: tuple[float, float, float],
) -> np.ndarray:
    """Return n poses in which the nominal arm holds the tool point at a place."""
    found = np.empty((0, len(machine.names)))
    for _ in range(20):
        seed = plan_poses(machine.nominal, 4 * n, rng)
        goal = np.tile(np.asarray(place, float), (len(seed), 1))
        q, reached = reach(machine.nominal, seed, goal, tool=tool)
        found = np.vstack((found, q[reached]))
        if len(found) >= n:
            return found[:n]
    raise BadInputError(f"socket {name!r} at {place} is out of reach; place it where the tool can be held in it")
