"""Joint positions to command within the limits, and the reason why a pose is not reached.

A row whose seed is already close to the wanted pose needs a small correction: its joints are kept
within a few degrees of the seed. Where a small correction would need large joint motions, the arm
is singular, and a program would make the wrist spin. Such a row is flagged, and its joints are kept
close to the seed; position has priority over orientation.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from pincal.compensate.compensate_numbers import COMPENSATION
from pincal.compensate.ik_problem import Bounds, IkProblem
from pincal.compensate.iterations import bounded_search, newton
from pincal.thresholds import Count, Scale

IkStatus = Literal["ok", "singular", "joint_limit", "unreachable"]
STATUSES: tuple[IkStatus, ...] = get_args(IkStatus)

# Small displacement [rad or m] of arms that start exactly at a singular pose, where the first step
# is zero.
_ASIDE: Scale = 0.05
# Singular value of the Jacobian, lengths over IkProblem.length, below which a start is displaced;
# regular poses have 0.1.
_LOST: Scale = 2e-3
# Weight of position relative to orientation where both can't be reached.
_POSITION_FIRST: Scale = 1e3
# Random poses among which starts for distant targets are chosen; number of starts tried, and number
# if these fail.
_POOL: Count = 4000
_STARTS: Count = 8
_MOST_STARTS: Count = 32
_TURN: Scale = 2.0 * np.pi


def solve_ik(
    problem: IkProblem, seed: np.ndarray, *, limits: Bounds
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint positions to command and the status of each row.

    Args:
        problem: N poses.
        seed: shape (N, n), joint positions to stay close to [rad or m].
        limits: the joint limits, of shape (n,).

    Returns:
        Joint positions within the limits, shape (N, n), and statuses, shape (N,).
    """
    if problem.with_orientation and problem.n_spare < 0:
        return _solve_with_few_joints(problem, seed, limits=limits)
    distance, angle = problem.distances(problem.residuals(seed))
    near = (distance <= COMPENSATION.near) & (angle <= COMPENSATION.near_angle)
    corridor = limits.around(seed, near, distance=COMPENSATION.correction)
    q, exact = newton(problem, seed, seed=seed)
    q = _unwind(problem, q, reached=exact, seed=seed, limits=limits)
    beyond = exact & ~limits.contain(q)
    done = exact & corridor.contain(q)
    rows = np.flatnonzero(~done)
    if len(rows):
        q[rows], done[rows] = _within_bounds(
            problem.select(rows), seed[rows], bounds=corridor.select(rows)
        )
    far = np.flatnonzero(~near)
    if len(far):
        part = problem.select(far)
        q[far], done[far] = _from_afar(part, q[far], done=done[far], seed=seed[far], limits=limits)
    has_position = done.copy()
    rows = np.flatnonzero(~done)
    if len(rows):
        part = problem.select(rows)
        q[rows], has_position[rows] = _best_effort(
            part, q[rows], seed=seed[rows], near=near[rows], limits=limits
        )
        beyond[rows] |= _is_beyond(part, q[rows], limits=limits)
        done[rows] = part.is_reached(part.residuals(q[rows]))
    missed = np.where(near & has_position, "singular", "unreachable")
    return q, np.where(done, "ok", np.where(beyond, "joint_limit", missed))


def _from_afar(
    problem: IkProblem, q: np.ndarray, *, done: np.ndarray, seed: np.ndarray, limits: Bounds
) -> tuple[np.ndarray, np.ndarray]:
    """Return joint positions for rows with distant seeds, and whether they reach their poses; rows
    that are not ``done`` are searched for from random starts.
    """
    q = _unwind(problem, q, reached=done, seed=seed, limits=limits)
    done = done.copy()
    rows = np.flatnonzero(~done)
    if len(rows):
        q[rows], done[rows] = _from_random_starts(
            problem.select(rows), q[rows], seed=seed[rows], limits=limits
        )
    return q, done


def _solve_with_few_joints(
    problem: IkProblem, seed: np.ndarray, *, limits: Bounds
) -> tuple[np.ndarray, np.ndarray]:
    """Reach the positions, then get as close to the orientations as the joints allow."""
    q, status = solve_ik(problem.without_orientation(), seed, limits=limits)
    rows = np.flatnonzero(status == "ok")
    if len(rows):
        nowhere = np.zeros(len(rows), bool)
        q[rows], _ = _best_effort(
            problem.select(rows), q[rows], seed=q[rows], near=nowhere, limits=limits
        )
    return q, status


def _unwind(
    problem: IkProblem, q: np.ndarray, *, reached: np.ndarray, seed: np.ndarray, limits: Bounds
) -> np.ndarray:
    """Return joint positions moved by whole turns as close to the seed as possible, within the
    limits if possible.
    """
    most = np.floor((q - limits.lower) / _TURN)
    least = np.ceil((q - limits.upper) / _TURN)
    turns = np.clip(np.round((q - seed) / _TURN), least, np.maximum(most, least))
    robot = problem.model.chain.robot
    is_revolute = np.array([robot.joint_types[i] != "prismatic" for i in robot.own_joints])
    unwound = np.where(is_revolute & (least <= most), q - _TURN * turns, q)
    rows = np.flatnonzero(reached & np.any(unwound != q, axis=1))
    if len(rows):
        # With gear errors the pose a whole turn away differs slightly.
        again, arrived = newton(problem.select(rows), unwound[rows], seed=unwound[rows])
        q[rows] = np.where((arrived & limits.contain(again))[:, None], again, q[rows])
    return q


def _within_bounds(
    problem: IkProblem, seed: np.ndarray, *, bounds: Bounds
) -> tuple[np.ndarray, np.ndarray]:
    """Search within bounds, from the seed and, if it is singular, from a displaced
    start as well.
    """
    q, reached = bounded_search(problem, seed, bounds=bounds)
    rows = np.flatnonzero(~reached)
    if len(rows):
        _, J = problem.select(rows).linearise(seed[rows])
        rows = rows[np.linalg.svd(J, compute_uv=False)[:, -1] < _LOST]
    if len(rows):
        aside = seed[rows] + _ASIDE * np.where(np.arange(seed.shape[1]) % 2, -1.0, 1.0)
        found, ended = bounded_search(problem.select(rows), aside, bounds=bounds.select(rows))
        q[rows[ended]] = found[ended]
        reached[rows[ended]] = True
    rows = np.flatnonzero(reached & (problem.n_spare > 0))
    if len(rows):
        # Redundant arms continue to the solution closest to their seed.
        closer, arrived = newton(problem.select(rows), q[rows], seed=seed[rows])
        arrived &= bounds.select(rows).contain(closer)
        q[rows[arrived]] = closer[arrived]
    return q, reached


def _is_beyond(problem: IkProblem, q: np.ndarray, *, limits: Bounds) -> np.ndarray:
    """Return which rows would be reached without the limits that joints touch, shape (N,)."""
    out = limits.touched(q)
    rows = np.flatnonzero(out)
    if len(rows):
        out[rows] = bounded_search(problem.select(rows), q[rows], bounds=Bounds.none(q.shape[1]))[1]
    return out


def _best_effort(
    problem: IkProblem, q: np.ndarray, *, seed: np.ndarray, near: np.ndarray, limits: Bounds
) -> tuple[np.ndarray, np.ndarray]:
    """Get as close as possible, with little motion if the seed is near; also return which positions
    can be reached.

    A reachable position has priority, with the orientation as close as the joints then allow. If
    the position is out of reach, sacrificing the orientation to get a little closer gains nothing.
    """
    start = np.where(near[:, None], seed, q)
    bounds = limits.around(start, near, distance=COMPENSATION.gentle)
    best, _ = bounded_search(problem, start, bounds=bounds, position_weight=_POSITION_FIRST)
    best, has_position = bounded_search(problem.without_orientation(), best, bounds=bounds)
    rows = np.flatnonzero(~has_position)
    if len(rows):
        best[rows], _ = bounded_search(
            problem.select(rows), start[rows], bounds=bounds.select(rows)
        )
    return best, has_position


def _from_random_starts(
    problem: IkProblem, q: np.ndarray, *, seed: np.ndarray, limits: Bounds
) -> tuple[np.ndarray, np.ndarray]:
    """Search from random poses close to the wanted ones, and keep the solution closest
    to the seed.
    """
    best = q.copy()
    reached = np.zeros(len(problem), bool)
    distance = np.full(len(problem), np.inf)
    starts, hopeful = _starts(problem)
    for k, start in enumerate(starts):
        rows = np.flatnonzero(hopeful & (~reached | (k < _STARTS)))
        if not len(rows):
            break
        part = problem.select(rows)
        found, ended = bounded_search(part, start[rows], bounds=limits)
        found = _unwind(part, found, reached=ended, seed=seed[rows], limits=limits)
        away = np.where(ended, np.linalg.norm(found - seed[rows], axis=1), np.inf)
        closer = away < distance[rows]
        at = rows[closer]
        best[at] = found[closer]
        distance[at] = away[closer]
        reached[at] = True
    return best, reached


def _starts(problem: IkProblem) -> tuple[np.ndarray, np.ndarray]:
    """Return the random joint positions with poses closest to the wanted ones, and which rows have
    any nearby.

    Returns:
        Shape (starts, N, n) [rad or m], and shape (N,).
    """
    from scipy.spatial import cKDTree

    robot = problem.model.chain.robot
    pool = robot.random_configurations(_POOL, np.random.default_rng(0))
    own = pool[:, robot.own_joints]
    out = np.empty((_MOST_STARTS, len(problem), own.shape[1]))
    hopeful = np.zeros(len(problem), bool)
    for target in np.unique(problem.conditions.target):
        rows = np.flatnonzero(problem.conditions.target == target)
        there = replace(problem.conditions.select(np.full(_POOL, rows[0])), q=pool)
        poses = problem.model.predict(problem.values, there)
        wanted = problem.wanted[rows]
        _, nearest = cKDTree(_features(problem, poses)).query(
            _features(problem, wanted), k=_MOST_STARTS
        )
        out[:, rows] = own[nearest.T]
        distance, _ = cKDTree(poses[:, :, 3]).query(wanted[:, :, 3])
        hopeful[rows] = distance < COMPENSATION.hopeless * robot.reach
    return out, hopeful


def _features(problem: IkProblem, poses: np.ndarray) -> np.ndarray:
    """Return poses as points, shape (N, 3) or (N, 12), whose distances approximate the residuals
    between them.
    """
    places = poses[:, :, 3] / problem.length
    if not problem.with_orientation:
        return places
    return np.hstack([places, poses[:, :, :3].reshape(len(poses), 9) / np.sqrt(2.0)])
