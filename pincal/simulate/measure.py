"""Simulated measurements of the true machine, as the columns of a table of measurements."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.effect import MeasuringEffect
from pincal.simulate.machine import TrueMachine
from pincal.simulate.state import Poses

Table = dict[str, np.ndarray]
KINDS = ("position", "pose", "distance")
"""What an instrument beside the robot can measure."""


def measure(
    machine: TrueMachine,
    q: np.ndarray,
    *,
    base_pose: np.ndarray | None = None,
    targets: Any = (0.0, 0.0, 0.0),
    noise_sigma: float = 0.0,
    noise_angle: float = 0.0,
    rng: np.random.Generator | None = None,
    payload: Any = None,
    payload_com: Any = (0.0, 0.0, 0.0),
    temperature: Any = None,
    time: Any = None,
    approach: Mapping[str, Any] | np.ndarray | None = None,
    kind: str = "position",
    anchors: Mapping[str, Any] | None = None,
    noise_free: bool = False,
    hide: Collection[str] = (),
    declare_sigma: bool = False,
) -> Table:
    """Measure the tool of the true machine with an instrument beside it.

    The same ``rng`` gives the same rows whatever effects the machine has, and with ``noise_free`` the truth
    of the same rows.

    Args:
        machine: The true machine.
        q: Recorded joint positions [rad or m], shape (N, n).
        base_pose: Transform from the robot's base frame to the instrument's frame, shape (4, 4); identity if
            None.
        targets: Target in the tip frame: a position [m], shape (3,), for ``kind="pose"`` also a transform,
            shape (4, 4); or a mapping from name to one of these. Several targets give one row each for every
            pose.
        noise_sigma: Standard deviation of each coordinate, or of the distance [m].
        noise_angle: Standard deviation of the orientation about each axis [rad].
        rng: Source of noise and scatter; needed if there is any.
        payload: Declared mass at the tip [kg], shape (N,) or one number.
        payload_com: Its centre of mass in the tip frame [m], shape (3,) or (N, 3).
        temperature: Temperature [deg C], shape (N,) or one number.
        time: Time [s], shape (N,) or one number.
        approach: Direction from which the joints arrived (-1, 0, 1), shape (N, n), or by joint name.
        kind: One of ``KINDS``.
        anchors: Distances from several fixed points, one row each: their positions in the robot's base frame
            [m], shape (3,), by name; the instrument's origin if None.
        noise_free: Leave out noise and scatter.
        hide: Columns that the table does not show.
        declare_sigma: Add the column ``sigma``.

    Returns:
        Columns of the table by name: joints, ``x y z`` (with ``qx qy qz qw`` or without) or ``distance``, and
        those of ``target``, ``anchor``, ``payload``, ``temperature``, ``time``, ``approach_<joint>`` and ``sigma`` that
        apply.

    Raises:
        BadInputError: If an argument has a wrong shape or the kind is unknown.
    """
    if kind not in KINDS:
        raise BadInputError(f"kind {kind!r}; expected one of {', '.join(KINDS)}")
    if anchors is not None and kind != "distance":
        raise BadInputError(f"anchors with kind {kind!r}; expected 'distance', or no anchors")
    conditions = {"payload": payload, "temperature": temperature, "time": time, "approach": approach}
    scatter = scatter_of(machine, q, None if noise_free else rng)
    poses = machine.poses(q, payload_com=payload_com, scatter=scatter, **conditions)
    frame = np.eye(4) if base_pose is None else np.asarray(base_pose, float)
    named = dict(targets) if isinstance(targets, Mapping) else {"": targets}
    offsets = np.array([_transform(target) for target in named.values()])
    seen = ((frame @ machine.equilibrium(poses).tip)[:, None] @ offsets).reshape(-1, 4, 4)
    table = pose_columns(machine, poses, conditions, repeat=len(named))
    if len(named) > 1:
        table["target"] = np.tile(np.array(list(named)), len(poses.q))
    if anchors is not None:
        table, seen = _from_anchors(table, seen, anchors, frame)
    sigmas = (0.0, 0.0) if noise_free else (noise_sigma, noise_angle)
    table |= _readings(machine, seen, kind, sigmas, rng)
    if declare_sigma:
        table["sigma"] = np.full(len(seen), noise_sigma)
    return {name: column for name, column in table.items() if name not in hide}


def _from_anchors(table: Table, seen: np.ndarray, anchors: Mapping[str, Any], frame: np.ndarray) -> tuple[Table, np.ndarray]:
    """Return every row once for each anchor, and transforms from target to a frame at the anchor."""
    places = np.array([*anchors.values()], float) @ frame[:3, :3].T + frame[:3, 3]
    from_anchor = np.repeat(seen, len(places), axis=0)
    from_anchor[:, :3, 3] -= np.tile(places, (len(seen), 1))
    table = {name: np.repeat(column, len(places)) for name, column in table.items()}
    return table | {"anchor": np.tile(np.array(list(anchors)), len(seen))}, from_anchor


def scatter_of(machine: TrueMachine, q: np.ndarray, rng: np.random.Generator | None) -> np.ndarray | None:
    """Return scatter for poses q, drawn from a child of the generator, so that the noise does not depend on it."""
    if rng is None:
        return None
    return rng.spawn(1)[0].standard_normal((len(q), len(machine.names)))


def _transform(target: Any) -> np.ndarray:
    value = np.asarray(target, float)
    if value.shape == (4, 4):
        return value
    if value.shape != (3,):
        raise BadInputError(f"target has shape {value.shape}; expected (3,) or (4, 4)")
    transform = np.eye(4)
    transform[:3, 3] = value
    return transform


def pose_columns(machine: TrueMachine, poses: Poses, conditions: Mapping[str, Any], *, repeat: int = 1) -> Table:
    """Return the part of a table that doesn't depend on the sensor.

    Args:
        machine: The machine.
        poses: The poses that it measures in.
        conditions: Of ``payload``, ``temperature``, ``time`` and ``approach``, those declared.
        repeat: Rows for every pose.

    Returns:
        Joints, declared conditions and ``approach_<joint>``, each row repeated.
    """
    table = dict(zip(machine.names, poses.q.T, strict=True))
    for name in ("payload", "temperature", "time"):
        if conditions.get(name) is not None:
            table[name] = np.broadcast_to(np.asarray(conditions[name], float), len(poses.q))
    if poses.approach is not None:
        table |= {f"approach_{name}": poses.approach[:, j] for j, name in enumerate(machine.names)}
    return {name: np.repeat(column, repeat) for name, column in table.items()}


def _readings(
    machine: TrueMachine,
    seen: np.ndarray,
    kind: str,
    sigmas: tuple[float, float],
    rng: np.random.Generator | None,
) -> Table:
    """Return what the instrument reads of transforms from target to instrument, shape (M, 4, 4)."""
    position = seen[:, :3, 3]
    for effect in machine.effects:
        if isinstance(effect, MeasuringEffect):
            position = effect.reading(position)
    if kind == "distance":
        distance = np.linalg.norm(position, axis=1)
        return {"distance": distance + noise(distance.shape, sigmas[0], rng)}
    position = position + noise(position.shape, sigmas[0], rng)
    columns = dict(zip("xyz", position.T, strict=True))
    return columns | _quaternion(seen[:, :3, :3], sigmas[1], rng) if kind == "pose" else columns


def _quaternion(rotation: np.ndarray, sigma: float, rng: np.random.Generator | None) -> Table:
    from scipy.spatial.transform import Rotation

    jitter = Rotation.from_rotvec(noise((len(rotation), 3), sigma, rng))
    quaternion = (jitter * Rotation.from_matrix(rotation)).as_quat(canonical=True)
    return dict(zip(("qx", "qy", "qz", "qw"), quaternion.T, strict=True))


def noise(shape: tuple[int, ...], sigma: float, rng: np.random.Generator | None) -> np.ndarray:
    """Return normal noise, or zeros if sigma is 0.

    Args:
        shape: Shape of the result.
        sigma: Standard deviation.
        rng: Source of randomness; needed if sigma is not 0.

    Returns:
        New array.

    Raises:
        BadInputError: If there is noise to draw and nothing to draw it from.
    """
    if sigma == 0.0:
        return np.zeros(shape)
    if rng is None:
        raise BadInputError("noise needs rng; pass np.random.default_rng(seed), or noise_sigma=0")
    return rng.normal(0.0, sigma, shape)
