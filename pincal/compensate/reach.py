"""Which joint positions to command within the limits, and what stands in the way where none will do.

A row whose seed already stands near the wanted pose asks for a small correction: its joints stay within some degrees of the
seed. Where a small correction would take a large motion of joints, the arm is singular, and a program would make the wrist
spin; such a row is flagged, and its joints stay near the seed: the position first, the orientation as near as it goes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from pincal.compensate.solve import newton, search
from pincal.compensate.task import Task
from pincal.robot.robot import Robot

Status = Literal["ok", "singular", "joint_limit", "unreachable"]
STATUSES: tuple[Status, ...] = get_args(Status)

# A seed this near to the wanted pose [m, rad] asks for a correction and not for a way; errors of real arms are a fifth.
_NEAR, _NEAR_ANGLE = 0.05, 0.1
# How far a correction may take a joint [rad or m]: more is a motion that no program asked for. Where it would take more,
# the joints stay this close to the seed if the position allows it.
_CORRECTION, _GENTLE = 0.35, 0.1
# Rounding of a limit [rad or m].
_ON_LIMIT = 1e-12
# Small steps aside [rad or m] for arms that start exactly in a singular pose, where no first step leads anywhere.
_ASIDE = 0.05
# Singular value of the Jacobian, lengths over Task.length, below which a direction is lost; of sound poses it is 0.1.
_LOST = 2e-3
# Weight of position over orientation where both can't be had.
_POSITION_FIRST = 1e3
# Random poses among which starts for far targets are looked for; how many are tried, and how many where these fail.
_POOL, _STARTS, _MOST_STARTS = 4000, 8, 32
# A target farther than this part of the reach from every one of them is out of reach.
_HOPELESS = 0.3
_TURN = 2.0 * np.pi


def reach(task: Task, seed: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint positions to command and how each row ended.

    Args:
        task: N poses.
        seed: shape (N, n), joint positions to stay close to [rad or m].
        lower: shape (n,), lower joint limits; may be infinite.
        upper: shape (n,), upper joint limits, likewise.

    Returns:
        Joint positions within the limits, shape (N, n), and statuses, shape (N,).
    """
    if task.is_overdetermined:
        return _reach_with_few_joints(task, seed, lower, upper)
    near = _is_near(task, seed)
    low, high = _corridor(seed, near, lower, upper, _CORRECTION)
    q, exact = _without_limits(task, seed, lower, upper)
    beyond = exact & ~_is_within(q, lower, upper)
    done = exact & _is_within(q, low, high)
    rows = np.flatnonzero(~done)
    if len(rows):
        q[rows], done[rows] = _within_limits(task.select(rows), seed[rows], low[rows], high[rows])
    rows = np.flatnonzero(~near)
    if len(rows):
        part = task.select(rows)
        q[rows] = _unwind(part, q[rows], done[rows], seed[rows], lower, upper)
    rows = rows[~done[rows]]
    if len(rows):
        q[rows], done[rows] = _from_elsewhere(task.select(rows), q[rows], seed[rows], lower, upper)
    placed = done.copy()
    rows = np.flatnonzero(~done)
    if len(rows):
        part = task.select(rows)
        q[rows], placed[rows] = _best_effort(part, q[rows], seed[rows], near[rows], lower, upper)
        beyond[rows] |= _is_beyond(part, q[rows], lower, upper)
        done[rows] = part.is_reached(part.missing(q[rows]))
    status = np.where(done, "ok", np.where(beyond, "joint_limit", np.where(near & placed, "singular", "unreachable")))
    return q, status


def _reach_with_few_joints(
    task: Task, seed: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Reach the positions, then turn as near to the orientations as the joints allow."""
    q, status = reach(task.without_orientation(), seed, lower, upper)
    rows = np.flatnonzero(status == "ok")
    if len(rows):
        anywhere = np.zeros(len(rows), bool)
        q[rows], _ = _best_effort(task.select(rows), q[rows], q[rows], anywhere, lower, upper)
    return q, status


def _is_near(task: Task, seed: np.ndarray) -> np.ndarray:
    distance, angle = task.distances(task.missing(seed))
    return np.asarray((distance <= _NEAR) & (angle <= _NEAR_ANGLE))


def _corridor(
    seed: np.ndarray, near: np.ndarray, lower: np.ndarray, upper: np.ndarray, most: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits of each row, shape (N, n): those of the joints, and of a correction where the seed is near."""
    start = np.clip(seed, lower, upper)
    low = np.where(near[:, None], np.maximum(start - most, lower), lower)
    return low, np.where(near[:, None], np.minimum(start + most, upper), upper)


def _turns(robot: Robot) -> np.ndarray:
    return np.array([kind != "prismatic" for kind in robot.joint_types])


def _is_within(q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    return np.asarray(np.all((q >= lower - _ON_LIMIT) & (q <= upper + _ON_LIMIT), axis=1))


def _without_limits(task: Task, seed: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reach the poses wherever the joints have to go; return which rows are reached."""
    q, reached = newton(task, seed, seed)
    return _unwind(task, q, reached, seed, lower, upper), reached


def _unwind(
    task: Task, q: np.ndarray, reached: np.ndarray, seed: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """Return joint positions as near to the seed as whole turns bring them, within the limits where possible."""
    most, least = np.floor((q - lower) / _TURN), np.ceil((q - upper) / _TURN)
    turns = np.clip(np.round((q - seed) / _TURN), least, np.maximum(most, least))
    unwound = np.where(_turns(task.model.chain.robot) & (least <= most), q - _TURN * turns, q)
    rows = np.flatnonzero(reached & np.any(unwound != q, axis=1))
    if len(rows):
        # To errors of gears a whole turn may be another pose.
        again, arrived = newton(task.select(rows), unwound[rows], unwound[rows])
        q[rows] = np.where((arrived & _is_within(again, lower, upper))[:, None], again, q[rows])
    return q


def _closest(task: Task, q: np.ndarray, reached: np.ndarray, seed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move redundant arms that have arrived on to the solution closest to their seed."""
    rows = np.flatnonzero(reached) if task.is_redundant else np.arange(0)
    if len(rows):
        closer, arrived = newton(task.select(rows), q[rows], seed[rows])
        q[rows] = np.where(arrived[:, None], closer, q[rows])
    return q, reached


def _within_limits(task: Task, seed: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Search with joints that stop at their limits, from the seed and, where that leads nowhere, from beside it."""
    q, reached = search(task, seed, low, high)
    rows = np.flatnonzero(~reached)
    rows = rows[_is_singular(task.select(rows), seed[rows])]
    if len(rows):
        aside = seed[rows] + _ASIDE * np.where(np.arange(seed.shape[1]) % 2, -1.0, 1.0)
        found, ended = search(task.select(rows), aside, low[rows], high[rows])
        q[rows[ended]], reached[rows[ended]] = found[ended], True
    closer, _ = _closest(task, q.copy(), reached, seed)
    inside = _is_within(closer, low, high)
    return np.where(inside[:, None], closer, q), reached


def _is_singular(task: Task, q: np.ndarray) -> np.ndarray:
    """Return at which joint positions the arm has lost a direction, shape (N,)."""
    if not len(q):
        return np.zeros(0, bool)
    _, J = task.linearise(q)
    return np.asarray(np.linalg.svd(J, compute_uv=False)[:, -1] < _LOST)


def _is_beyond(task: Task, q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return which rows would be reached if joints that stand at a limit could go on."""
    out = np.any((q <= lower + _ON_LIMIT) | (q >= upper - _ON_LIMIT), axis=1)
    rows = np.flatnonzero(out)
    if len(rows):
        free = np.full(q[rows].shape, np.inf)
        out[rows] = search(task.select(rows), q[rows], -free, free)[1]
    return np.asarray(out)


def _best_effort(
    task: Task, q: np.ndarray, seed: np.ndarray, near: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Come as near as can be, with little motion where the seed is near; return which positions can be reached.

    The position comes first where it can be had, with the orientation as near as the joints then allow. Where it can't,
    nothing is gained by giving up the orientation for a little of it.
    """
    start = np.where(near[:, None], seed, q)
    low, high = _corridor(start, near, lower, upper, _GENTLE)
    best, _ = search(task, start, low, high, first=_POSITION_FIRST)
    best, placed = search(task.without_orientation(), best, low, high)
    rows = np.flatnonzero(~placed)
    if len(rows):
        best[rows], _ = search(task.select(rows), start[rows], low[rows], high[rows])
    return best, placed


def _from_elsewhere(
    task: Task, q: np.ndarray, seed: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Start from random poses that are near the wanted ones; of what reaches them take the closest to the seed."""
    best, reached = q.copy(), np.zeros(len(task), bool)
    distance = np.full(len(task), np.inf)
    starts, hopeful = _starts(task)
    for k, start in enumerate(starts):
        rows = np.flatnonzero(hopeful & (~reached | (k < _STARTS)))
        if not len(rows):
            break
        part, limits = task.select(rows), [np.broadcast_to(limit, (len(rows), len(limit))) for limit in (lower, upper)]
        found, ended = search(part, start[rows], *limits)
        found = _unwind(part, found, ended, seed[rows], lower, upper)
        away = np.where(ended, np.linalg.norm(found - seed[rows], axis=1), np.inf)
        closer = away < distance[rows]
        at = rows[closer]
        best[at], distance[at], reached[at] = found[closer], away[closer], True
    return best, reached


def _starts(task: Task) -> tuple[np.ndarray, np.ndarray]:
    """Return random joint positions whose poses are the nearest to the wanted ones, and which rows have any that are near.

    Returns:
        Shape (starts, N, n) [rad or m], and shape (N,).
    """
    from scipy.spatial import cKDTree

    robot = task.model.chain.robot
    pool = robot.random_configurations(_POOL, np.random.default_rng(0))
    out, hopeful = np.empty((_MOST_STARTS, len(task), robot.n_joints)), np.zeros(len(task), bool)
    for target in np.unique(task.conditions.target):
        rows = np.flatnonzero(task.conditions.target == target)
        there = replace(task.conditions.select(np.full(_POOL, rows[0])), q=pool)
        poses, wanted = task.model.predict(task.values, there), task.wanted[rows]
        _, nearest = cKDTree(_features(task, poses)).query(_features(task, wanted), k=_MOST_STARTS)
        out[:, rows] = pool[nearest.T]
        gap, _ = cKDTree(poses[:, :, 3]).query(wanted[:, :, 3])
        hopeful[rows] = gap < _HOPELESS * robot.reach
    return out, hopeful


def _features(task: Task, poses: np.ndarray) -> np.ndarray:
    """Return poses as points whose distances are about those that are to be overcome."""
    places = poses[:, :, 3] / task.length
    return np.hstack([places, poses[:, :, :3].reshape(len(poses), 9) / np.sqrt(2.0)]) if task.turns else places
