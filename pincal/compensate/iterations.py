r"""Iterations of inverse kinematics: Newton's method for all rows at once, and a bounded search for
the few that remain.

With the residual e and the difference to the seed, r = seed - q, the Newton step that ends closest
to the seed is

.. math:: \Delta q = r + J^+ (e - J r),

which is :math:`J^{-1} e` for an arm without redundancy. Rows that it does not solve (distant,
singular or beyond a limit) are solved by a monotone Levenberg-Marquardt search [Marquardt1963]_;
joints at their limits are held there while the step points outwards.

.. [Marquardt1963] D. W. Marquardt, An algorithm for least-squares estimation of nonlinear
  parameters, J. SIAM 11 (1963).
"""

from __future__ import annotations

import numpy as np

from pincal.compensate.ik_problem import Bounds, IkProblem
from pincal.thresholds import Count, Scale

# From an error of 10 mm three steps converge to rounding; the others are for distant seeds.
_NEWTON_STEPS: Count = 12
# The longest step of a joint [rad or m], within which an arm's poses are nearly linear.
_LONGEST: Scale = 0.3
# A smaller step [rad or m] adds no error of its own; a redundant arm continues towards the solution
# closest to its seed until its steps are as small.
_SETTLED: Scale = 1e-8
# Avoid a division by zero at exactly singular poses: relative to the square of the Jacobian, and
# absolute for joints that do not move the target at all.
_FLOOR: Scale = 1e-14
_NOTHING: Scale = 1e-30
_SEARCH_STEPS: Count = 60
_DAMPING: Scale = 1e-4
_LEAST_DAMPING: Scale = 1e-14
_MOST_DAMPING: Scale = 1e6
_SHRINK: Scale = 0.3
_GROW: Scale = 4.0
# A search has converged after several steps in a row with less relative decrease of the squares
# than this.
_ARRIVED: Scale = 1e-2
_PATIENCE: Count = 3
# Steps shorter than this do not count as motion [rad or m].
_STILL: Scale = 1e-13


def newton(
    problem: IkProblem, start: np.ndarray, *, seed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint positions closest to the seed that reach the poses, regardless of limits.

    Args:
        problem: N poses.
        start: shape (N, n), initial joint positions [rad or m].
        seed: shape (N, n), to which the solution of a redundant arm is closest [rad or m].

    Returns:
        Joint positions, shape (N, n), and which rows are reached, shape (N,).
    """
    q = np.array(start, float)
    reached = np.zeros(len(problem), bool)
    rows = np.arange(len(problem))
    part = problem
    for _ in range(_NEWTON_STEPS + 1):
        residuals, J = part.linearise(q[rows])
        is_redundant = problem.n_spare > 0
        step = _step_near(seed[rows] - q[rows] if is_redundant else None, residuals, J=J)
        is_short = np.abs(step).max(axis=1) < _SETTLED
        arrived = part.is_reached(residuals) & (is_short | (not is_redundant))
        # Two further steps lead from reached to rounding, so that the result does not depend on the
        # order of operations.
        done = arrived & reached[rows]
        reached[rows[arrived]] = True
        q[rows] += np.where((done & ~is_short)[:, None], 0.0, step)
        if done.any():
            rows = rows[~done]
            part = problem.select(rows)
        if not len(rows):
            break
    return q, reached


def _step_near(back: np.ndarray | None, residuals: np.ndarray, *, J: np.ndarray) -> np.ndarray:
    """Return Newton steps of limited length that end as close as possible to the end of ``back``,
    shape (N, n).
    """
    transposed = J.swapaxes(1, 2)
    square = J @ transposed
    square[:, range(J.shape[1]), range(J.shape[1])] += _floor(square)[:, None]
    if back is None:
        return _shortened((transposed @ np.linalg.solve(square, residuals[..., None]))[..., 0])
    back = _shortened(back)
    left = residuals[..., None] - J @ back[..., None]
    return _shortened(back + (transposed @ np.linalg.solve(square, left))[..., 0])


def _floor(square: np.ndarray) -> np.ndarray:
    return np.asarray(_FLOOR * np.trace(square, axis1=1, axis2=2) + _NOTHING)


def _shortened(step: np.ndarray) -> np.ndarray:
    longest = np.abs(step).max(axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, _LONGEST / np.maximum(longest, 1e-300)))


def bounded_search(
    problem: IkProblem, start: np.ndarray, *, bounds: Bounds, position_weight: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint positions within bounds closest to the poses, by a descent from the start.

    Args:
        problem: N poses.
        start: shape (N, n), initial joint positions [rad or m].
        bounds: the joint limits.
        position_weight: weight of the position relative to the orientation.

    Returns:
        Joint positions, shape (N, n), and which rows are reached, shape (N,).
    """
    weight = np.where(np.arange(problem.n_equations) < 3, position_weight, 1.0)
    q = np.clip(start, bounds.lower, bounds.upper)
    residuals, J = problem.linearise(q)
    damping = np.full(len(problem), _DAMPING)
    idle = np.zeros(len(problem), int)
    rows = np.flatnonzero(~problem.is_reached(residuals))
    for _ in range(_SEARCH_STEPS):
        if not len(rows):
            break
        limits = bounds.select(rows)
        left = residuals[rows] * weight
        step = _bounded_step(
            J[rows] * weight[:, None], left, damping=damping[rows], q=q[rows], bounds=limits
        )
        trial = np.clip(q[rows] + _shortened(step), limits.lower, limits.upper)
        tried, slope = problem.select(rows).linearise(trial)
        before, after = (np.einsum("ni,ni->n", r, r) for r in (left, tried * weight))
        better = after < before
        idle[rows] = np.where(after < (1.0 - _ARRIVED) * before, 0, idle[rows] + better)
        damping[rows] = np.maximum(damping[rows] * np.where(better, _SHRINK, _GROW), _LEAST_DAMPING)
        at = rows[better]
        q[at] = trial[better]
        residuals[at] = tried[better]
        J[at] = slope[better]
        moves = np.abs(step).max(axis=1) > _STILL
        goes_on = moves & (idle[rows] < _PATIENCE) & (damping[rows] < _MOST_DAMPING)
        rows = rows[goes_on & ~problem.is_reached(residuals[rows])]
    return q, problem.is_reached(residuals)


def _bounded_step(
    J: np.ndarray, residuals: np.ndarray, *, damping: np.ndarray, q: np.ndarray, bounds: Bounds
) -> np.ndarray:
    """Return damped steps in which joints at a bound do not move beyond it, shape (N, n)."""
    square = J.swapaxes(1, 2) @ J
    slope = (J.swapaxes(1, 2) @ residuals[..., None])[..., 0]
    at_bound = np.zeros(q.shape, bool)
    joints = range(q.shape[1])
    damped = damping + _floor(square)
    while True:
        system = np.where(at_bound[:, :, None] | at_bound[:, None, :], 0.0, square)
        system[:, joints, joints] += np.where(at_bound, 1.0, damped[:, None])
        step = np.linalg.solve(system, np.where(at_bound, 0.0, slope)[..., None])[..., 0]
        pushes = (
            (q <= bounds.lower) & (step < 0.0) | (q >= bounds.upper) & (step > 0.0)
        ) & ~at_bound
        if not pushes.any():
            return np.asarray(step)
        at_bound |= pushes
