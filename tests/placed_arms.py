"""A simulated arm and what an instrument reads of it at stations that tests choose."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pincal import simulate as sim
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.table import write_table
from pincal.robot.robot import Robot

NOISE = 5e-5
TOOL = np.array([0.1, 0.05, 0.2])


def transform(angles: tuple[float, float, float], place: tuple[float, float, float]) -> np.ndarray:
    """Return a transform by angles about x, y, z [rad] and a place [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", angles).as_matrix(), place
    return T


FIRST = transform((0.1, -0.2, 1.0), (2.0, 0.5, -0.3))
MOVE = transform((0.02, -0.01, 0.3), (0.3, -0.4, 1.2))


def measured(
    machine: sim.TrueMachine,
    robot: Robot,
    *,
    poses: int = 40,
    T_instrument_base: np.ndarray = FIRST,
    tool: np.ndarray = TOOL,
    seed: int = 1,
    kind: str = "position",
    turn: float = 1.0,
    **columns: np.ndarray,
) -> Measurements:
    """Return what an instrument reads of a reflector in random poses, joints within a part ``turn`` of their limits."""
    rng = np.random.default_rng(seed)
    q = turn * robot.random_configurations(poses, rng)
    tip = T_instrument_base @ machine.equilibrium(machine.poses(q)).tip
    at = tip[:, :3, :3] @ tool + tip[:, :3, 3]
    reading = at if kind == "position" else np.linalg.norm(at, axis=1)
    reading = reading + rng.normal(size=reading.shape) * NOISE
    return measurements_from_arrays(robot.joint_names, q, **{kind: reading}, **columns)


def written(path: Path, table: Measurements) -> Path:
    """Write the joints and positions of a table."""
    columns = dict(zip(table.joint_names, table.q.T, strict=True)) | dict(zip("xyz", table.position.T, strict=True))
    write_table(path, columns)
    return path
