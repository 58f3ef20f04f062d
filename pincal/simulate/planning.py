"""Measurement poses: random in the joint range, or such that the tool reaches a goal."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm, frames, frames_in_base
from pincal.simulate.rods import driving, following

# Rounds of draws after which limits on the poses count as infeasible.
_ROUNDS = 2000
# Largest joint step of the inverse kinematics [rad or m] and its damping, for a reach of about a
# metre.
_STEP = 0.3
_DAMPING = 1e-4
# Tolerance of a goal on the nominal arm [m or rad], and the largest number of steps: most goals
# take ten.
_REACHED = 1e-9
_REACHING = 60
# Fraction of the joint range that is used: the true arm needs slightly different positions than the
# nominal one.
_SPAN = 0.95
# Poses processed at once.
_PIECE = 5_000


def plan_poses(
    arm: Arm,
    n: int,
    rng: np.random.Generator,
    *,
    min_height: float | None = 0.1,
    max_radius: float | None = None,
) -> np.ndarray:
    """Draw n random joint positions within the limits [rad or m], shape (n, number of joints), with
    the arm above the floor.

    Args:
        arm: Nominal arm, ``machine.nominal``.
        n: Number of poses.
        rng: Random generator.
        min_height: Height of the floor [m], as in :func:`is_clear`; None for no floor.
        max_radius: Largest distance of the tip from the base's origin [m]; None for no limit.

    Raises:
        BadInputError: If hardly any pose of the arm fits the limits.
    """
    middle = (arm.upper + arm.lower) / 2.0
    half = _SPAN * (arm.upper - arm.lower) / 2.0

    def draw() -> np.ndarray:
        q = following(arm, middle + half * rng.uniform(-1.0, 1.0, (max(n, 16), len(arm.names))))
        q = q[np.all(np.abs(q - middle) <= half, axis=1)] if arm.pins else q
        fits = is_clear(arm, q, min_height)
        if max_radius is not None:
            fits &= np.linalg.norm(frames(arm, q)[:, -1, :3, 3], axis=1) < max_radius
        return np.asarray(q[fits])

    limits = [f"above {min_height} m"] if min_height is not None else []
    limits += [f"within {max_radius} m of the base"] if max_radius is not None else []
    return collect_poses(
        draw, n, rounds=_ROUNDS, shortage=f"lie {' and '.join(limits)}; relax these limits"
    )


def collect_poses(
    draw: Callable[[], np.ndarray], n: int, *, rounds: int, shortage: str
) -> np.ndarray:
    """Call ``draw`` for acceptable poses until there are n.

    Raises:
        BadInputError: If all rounds together give too few; ``shortage`` completes the message.
    """
    found: list[np.ndarray] = []
    for _ in range(rounds):
        found.append(draw())
        if sum(map(len, found)) >= n:
            return np.vstack(found)[:n]
    raise BadInputError(f"only {sum(map(len, found))} of {n} poses {shortage}")


def is_clear(arm: Arm, q: np.ndarray, min_height: float | None) -> np.ndarray:
    """Return whether the arm is above the floor, shape (N,), in poses q, shape (N, n).

    The tip and the origins of the third and all later joints have to be above ``min_height`` in the
    base frame [m]; None for no floor.
    """
    if min_height is None:
        return np.ones(len(q), bool)
    clear = np.empty(len(q), bool)
    for start in range(0, len(q), _PIECE):
        piece = slice(start, start + _PIECE)
        heights = frames_in_base(arm, q[piece])[:, 1:, 2, 3]
        clear[piece] = heights[:, min(2, heights.shape[1] - 1) :].min(axis=1) > min_height
    return clear


def point_at(tip: np.ndarray, tool: ArrayLike) -> np.ndarray:
    """Return a point of the tip frame [m], shape (3,), in the base frame, shape (N, 3), for tips of
    shape (N, 4, 4).
    """
    return np.asarray(tip[:, :3, :3] @ np.asarray(tool, float) + tip[:, :3, 3])


def reach(
    arm: Arm, seed: np.ndarray, *, goal: np.ndarray, tool: ArrayLike = (0.0, 0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Find joint positions that bring a tool point, or the whole tip, to a goal.

    Args:
        arm: Arm without load.
        seed: Joint positions to start from, shape (N, n).
        goal: Wanted positions of the tool point in the base frame [m], shape (N, 3), or transforms
            of the tip, (N, 4, 4).
        tool: Tool point in the tip frame [m]; used with positions only.

    Returns:
        Joint positions, shape (N, n), and whether each reaches its goal well within the joint
        limits, shape (N,). Positions are NaN where loops opened on the way.
    """
    point = np.asarray(tool, float)
    q = np.array(seed, float)
    error = np.full(len(seed), np.inf)
    for _ in range(_REACHING):
        left = np.flatnonzero((error >= _REACHED) & np.isfinite(q).all(axis=1))
        if len(left) == 0:
            break
        joint_frames = frames(arm, q[left])
        missing, jacobian = _missing(arm, joint_frames, goal=goal[left], tool=point)
        error[left] = np.linalg.norm(missing, axis=1)
        moves = driving(arm, joint_frames)
        step = newton_step(moves, jacobian, missing) * (error[left] >= _REACHED)[:, None]
        q[left] = following(arm, q[left] + step, near=q[left]) if arm.pins else q[left] + step
    # Whole turns matter to the joint limits only.
    turns = np.where(
        arm.prismatic,
        0.0,
        2.0 * np.pi * np.round((q - 0.5 * (arm.lower + arm.upper)) / (2.0 * np.pi)),
    )
    q = following(arm, np.where((q >= arm.lower) & (q <= arm.upper), q, q - turns))
    if arm.pins:
        # Closed from position 0, in whose assembly mode the machine is, the arm may be elsewhere.
        shut = np.isfinite(q).all(axis=1)
        missing, _ = _missing(arm, frames(arm, q[shut]), goal=goal[shut], tool=point)
        error[shut] = np.linalg.norm(missing, axis=1)
    middle = 0.5 * (arm.lower + arm.upper)
    half = 0.5 * _SPAN * (arm.upper - arm.lower)
    return q, (error < _REACHED) & np.all(np.abs(q - middle) <= half, axis=1)


def newton_step(moves: np.ndarray, jacobian: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return the damped joint step of bounded length towards the goal, shape (N, n).

    ``moves`` are the derivatives of all joints by the driven ones, see
    :func:`pincal.simulate.rods.driving`.
    """
    jacobian = jacobian @ moves
    transposed = np.swapaxes(jacobian, 1, 2)
    size = np.linalg.norm(missing, axis=1).clip(0.0, 1.0)
    damping = _DAMPING * size[:, None, None] * np.eye(missing.shape[1])
    solved = np.linalg.solve(jacobian @ transposed + damping, missing[..., None])
    step: np.ndarray = (moves @ (transposed @ solved))[..., 0]
    longest = np.abs(step).max(axis=1, keepdims=True)
    step *= np.minimum(1.0, _STEP / np.maximum(longest, 1e-300))
    return step


def position_jacobian(arm: Arm, joint_frames: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the derivative of points at the tip [start link's frame, m, shape (N, 3)] by the
    joints, shape (N, 3, n).
    """
    axes = arm.movers[:, None] * joint_frames[:, 1:-1, :3, 2]
    levers = point[:, None] - joint_frames[:, 1:-1, :3, 3]
    columns = np.where(arm.prismatic[:, None], axes, np.cross(axes, levers))
    return np.swapaxes(columns, 1, 2)


def _missing(
    arm: Arm, joint_frames: np.ndarray, *, goal: np.ndarray, tool: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    tip = joint_frames[:, -1]
    if goal.ndim == 2:
        point = point_at(tip, tool)
        return goal - point, position_jacobian(arm, joint_frames, point)
    from scipy.spatial.transform import Rotation

    turn = goal[:, :3, :3] @ np.swapaxes(tip[:, :3, :3], 1, 2)
    missing = np.hstack((goal[:, :3, 3] - tip[:, :3, 3], Rotation.from_matrix(turn).as_rotvec()))
    axes = np.where(arm.prismatic, 0.0, arm.movers)[:, None] * joint_frames[:, 1:-1, :3, 2]
    return missing, np.hstack(
        (position_jacobian(arm, joint_frames, tip[:, :3, 3]), np.swapaxes(axes, 1, 2))
    )
