"""Simulated measurements of a fixed calibration object with a camera in the robot's hand."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.effect import MeasuringEffect
from pincal.simulate.lens import Lens
from pincal.simulate.machine import TrueMachine
from pincal.simulate.measure import Table, noise, pose_columns, scatter_of
from pincal.simulate.planning import is_clear, plan_poses, reach

# Points on a plate seen more slantingly than this (cosine of the angle to its normal) can't be made out.
_SLANTED = 0.25
# Random goals in one round, at least.
_TRIES = 16


def measure_camera(
    machine: TrueMachine,
    q: np.ndarray,
    *,
    camera_pose: np.ndarray,
    points: Mapping[str, Any],
    normals: Mapping[str, Any] | None = None,
    noise_sigma: float = 0.0,
    rng: np.random.Generator | None = None,
    lens: Lens | None = None,
    in_metres: bool = False,
    payload_com: Any = (0.0, 0.0, 0.0),
    hide: Collection[str] = (),
    **conditions: Any,
) -> Table:
    """Measure points of a fixed calibration object with a camera at the tip.

    Args:
        machine: The true machine.
        q: Recorded joint positions [rad or m], shape (N, n).
        camera_pose: Transform from the camera frame (z along the view, x to the right) to the tip frame,
            shape (4, 4).
        points: Position of each named point in the robot's base frame [m], shape (3,).
        normals: Direction in which the plate of each point looks, shape (3,); points seen from behind or at a
            glancing angle are left out. Without it points are seen from everywhere.
        noise_sigma: Standard deviation of each coordinate, [px] for image coordinates, else [m].
        rng: Source of noise and scatter.
        lens: Gives image coordinates ``u v`` of the points in the image; without it ``cx cy cz`` of all points.
        in_metres: Give ``cx cy cz`` even with a lens, of the points in its image.
        payload_com: Centre of mass of the payload in the tip frame [m].
        hide: Columns that the table does not show.
        **conditions: ``payload``, ``temperature``, ``time`` and ``approach`` as in
            :func:`pincal.simulate.measure.measure`.

    Returns:
        Columns: joints, conditions, ``point``, and ``cx cy cz`` or ``u v``.

    Raises:
        BadInputError: If no point is seen in any pose.
    """
    poses = machine.poses(q, payload_com=payload_com, scatter=scatter_of(machine, q, rng), **conditions)
    camera = machine.equilibrium(poses).tip @ np.asarray(camera_pose, float)
    seen = in_camera(camera, np.array([*points.values()], float)).reshape(-1, 3)
    visible = np.ones(len(seen), bool) if lens is None else lens.sees(seen)
    if normals is not None:
        visible &= _faces(camera, seen, np.array([*normals.values()], float))
    if not visible.any():
        raise BadInputError("the camera sees no point of the object in any pose; take poses that look at it")
    table = pose_columns(machine, poses, conditions, repeat=len(points)) | {
        "point": np.tile(np.array(list(points)), len(poses.q))
    }
    table = {name: column[visible] for name, column in table.items() if name not in hide}
    reading, names = _true_readings(machine, seen[visible], None if in_metres else lens)
    return table | dict(zip(names, (reading + noise(reading.shape, noise_sigma, rng)).T, strict=True))


def _true_readings(machine: TrueMachine, seen: np.ndarray, lens: Lens | None) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return what the camera reads of points in its frame without noise, and the columns that this makes."""
    for effect in machine.effects:
        if isinstance(effect, MeasuringEffect):
            seen = effect.reading(seen)
    return (seen, ("cx", "cy", "cz")) if lens is None else (lens.project(seen), ("u", "v"))


def in_camera(camera: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return points of the base frame in that of each camera.

    Args:
        camera: Transforms from camera to base frame, shape (N, 4, 4).
        places: Points in the base frame [m], shape (K, 3).

    Returns:
        Shape (N, K, 3) [m].
    """
    seen: np.ndarray = np.einsum("nab,nka->nkb", camera[:, :3, :3], places - camera[:, None, :3, 3])
    return seen


def _faces(camera: np.ndarray, seen: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return whether the plate of each point, seen as in :func:`in_camera`, looks at the camera, shape (N * K,)."""
    facing = np.einsum("nab,ka->nkb", camera[:, :3, :3], normals).reshape(-1, 3)
    cosine = -np.sum(facing * seen, axis=1) / np.maximum(np.linalg.norm(seen, axis=1), 1e-12)
    return np.asarray(cosine > _SLANTED)


def plan_camera_poses(
    machine: TrueMachine,
    n: int,
    rng: np.random.Generator,
    *,
    camera_pose: np.ndarray,
    look_at: Any,
    distance: tuple[float, float] = (0.3, 0.6),
    tilt: float = 0.6,
    facing: Any = (0.0, 0.0, 1.0),
    min_height: float | None = 0.1,
    accept: Callable[[np.ndarray], np.ndarray] | None = None,
    patience: int = 20,
) -> np.ndarray:
    """Find poses in which the camera looks at a point.

    Args:
        machine: The machine whose nominal arm is planned for.
        n: Number of poses.
        rng: Source of randomness.
        camera_pose: Transform from camera to tip frame, shape (4, 4).
        look_at: The point in the base frame [m], shape (3,).
        distance: Smallest and largest distance of the camera from it [m].
        tilt: Largest angle between view and the object's normal [rad].
        facing: Normal of the object in the base frame, towards the camera, shape (3,).
        min_height: Height of the floor from which the arm keeps off [m]; None for no floor.
        accept: What else is asked of a pose: gets transforms from camera to base frame, shape (N, 4, 4), says
            which will do, shape (N,).
        patience: Rounds of random goals before giving up.

    Returns:
        Joint positions, shape (n, number of joints).

    Raises:
        BadInputError: If the arm hardly reaches such poses.
    """
    arm, found = machine.nominal, np.empty((0, len(machine.names)))
    for _ in range(patience):
        seed = plan_poses(arm, max(4 * n, _TRIES), rng, min_height=min_height)
        goals = np.tile(np.eye(4), (len(seed), 1, 1))
        goals[:, :3, :3] = _views(len(seed), rng, np.asarray(facing, float), tilt)
        goals[:, :3, 3] = np.asarray(look_at) - rng.uniform(*distance, (len(seed), 1)) * goals[:, :3, 2]
        wanted = np.ones(len(seed), bool) if accept is None else accept(goals)
        q, reached = reach(arm, seed[wanted], goals[wanted] @ np.linalg.inv(camera_pose))
        q = q[reached]
        found = np.vstack((found, q[is_clear(arm, q, min_height)]))
        if len(found) >= n:
            return found[:n]
    raise BadInputError(f"only {len(found)} of {n} camera poses are within reach; move the object or widen the tilt")


def _views(count: int, rng: np.random.Generator, facing: np.ndarray, tilt: float) -> np.ndarray:
    """Return rotations of a camera whose view is tilted from the object's normal, shape (count, 3, 3)."""
    from scipy.spatial.transform import Rotation

    onto = Rotation.align_vectors(-facing[None], [[0.0, 0.0, 1.0]])[0]
    spin = Rotation.from_rotvec(rng.uniform(-np.pi, np.pi, (count, 1)) * [0.0, 0.0, 1.0])
    direction = rng.uniform(-np.pi, np.pi, count)
    angle = tilt * np.sqrt(rng.uniform(0.0, 1.0, (count, 1)))
    axis = np.stack((np.cos(direction), np.sin(direction), 0.0 * direction), axis=1)
    lean = Rotation.from_rotvec(angle * axis)
    rotation: np.ndarray = (onto * lean * spin).as_matrix()
    return rotation
