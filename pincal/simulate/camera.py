"""Simulated measurements of a fixed calibration object with a camera in the robot's hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.machine import TrueMachine
from pincal.simulate.measure import Table, noise
from pincal.simulate.planning import plan_poses, reach


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Pinhole camera with radial distortion.

    Attributes:
        focal: Focal length [px].
        centre: Principal point (u, v) [px].
        k1: Radial distortion: r_image = r (1 + k1 r^2), r the tangent of the angle to the optical axis [-].
    """

    focal: float = 2000.0
    centre: tuple[float, float] = (1024.0, 768.0)
    k1: float = 0.0


def measure_camera(
    machine: TrueMachine,
    q: np.ndarray,
    *,
    camera_pose: np.ndarray,
    points: Mapping[str, Any],
    noise_sigma: float = 0.0,
    rng: np.random.Generator | None = None,
    lens: Lens | None = None,
    payload: Any = None,
    payload_com: Any = (0.0, 0.0, 0.0),
) -> Table:
    """Measure points of a fixed calibration object with a camera at the tip.

    Args:
        machine: The true machine.
        q: Recorded joint positions [rad or m], shape (N, n).
        camera_pose: Transform from the camera frame (z along the view, x to the right) to the tip frame,
            shape (4, 4).
        points: Position of each named point in the robot's base frame [m], shape (3,).
        noise_sigma: Standard deviation of each coordinate [m], with a lens [px].
        rng: Source of noise and scatter.
        lens: Gives image coordinates ``u v`` of the points in front of the camera; without it ``cx cy cz``.
        payload: Declared mass at the tip [kg].
        payload_com: Its centre of mass in the tip frame [m].

    Returns:
        Columns: joints, ``payload`` if declared, ``point``, and ``cx cy cz`` or ``u v``.
    """
    scatter = None if rng is None else rng.spawn(1)[0].standard_normal(np.shape(q))
    poses = machine.poses(q, payload=payload, payload_com=payload_com, scatter=scatter)
    camera = machine.equilibrium(poses).tip @ np.asarray(camera_pose, float)
    places = np.array([*points.values()], float)
    seen = np.einsum("nab,nka->nkb", camera[:, :3, :3], places - camera[:, None, :3, 3]).reshape(-1, 3)
    rows = np.repeat(poses.q, len(points), axis=0)
    table = dict(zip(machine.names, rows.T, strict=True))
    if payload is not None:
        table["payload"] = np.repeat(poses.payload, len(points))
    table["point"] = np.tile(np.array(list(points)), len(poses.q))
    if lens is None:
        return table | dict(zip(("cx", "cy", "cz"), (seen + noise(seen.shape, noise_sigma, rng)).T, strict=True))
    visible = seen[:, 2] > 0.0
    table = {name: column[visible] for name, column in table.items()}
    image = _image(lens, seen[visible])
    return table | dict(zip("uv", (image + noise(image.shape, noise_sigma, rng)).T, strict=True))


def _image(lens: Lens, seen: np.ndarray) -> np.ndarray:
    slope = seen[:, :2] / seen[:, 2:]
    stretch = 1.0 + lens.k1 * (slope**2).sum(axis=1, keepdims=True)
    image: np.ndarray = np.asarray(lens.centre) + lens.focal * stretch * slope
    return image


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

    Returns:
        Joint positions, shape (n, number of joints).

    Raises:
        BadInputError: If the arm hardly reaches such poses.
    """
    arm, found = machine.nominal, np.empty((0, len(machine.names)))
    for _ in range(20):
        views = _views(len(seed := plan_poses(arm, 4 * n, rng)), rng, np.asarray(facing, float), tilt)
        goals = np.tile(np.eye(4), (len(seed), 1, 1))
        goals[:, :3, :3] = views
        goals[:, :3, 3] = np.asarray(look_at) - rng.uniform(*distance, (len(seed), 1)) * views[:, :, 2]
        q, reached = reach(arm, seed, goals @ np.linalg.inv(camera_pose))
        found = np.vstack((found, q[reached]))
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
