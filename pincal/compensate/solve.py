r"""Joint positions that reach poses: Newton's method for all rows at once, and a bounded search for the few that resist.

Newton's step for what is missing, e, and the way back to the seed, r = seed - q, is the one that ends nearest to the seed,

.. math:: \Delta q = r + J^+ (e - J r),

which is :math:`J^{-1} e` on an arm without redundancy. Rows that it does not solve (far, singular or beyond a limit) go
through a Levenberg-Marquardt search that never gets worse [Marquardt1963]_, joints at their limits held there while they
push outwards.

.. [Marquardt1963] D. W. Marquardt, An algorithm for least-squares estimation of nonlinear parameters, J. SIAM 11 (1963).
"""

from __future__ import annotations

import numpy as np

from pincal.compensate.task import Task

# From 10 mm off, three steps reach rounding; the rest is for seeds that are far.
_NEWTON_STEPS = 12
# The longest step of a joint [rad or m]: an arm's poses are about linear within it.
_LONGEST = 0.3
# A step below this changes nothing worth having [rad or m]: redundant arms go on to the closest solution.
_SETTLED = 1e-8
# Keeps an exactly singular pose from ending in a division by zero; relative to the square of the Jacobian, and for joints
# that don't move the target at all.
_FLOOR, _NOTHING = 1e-14, 1e-30
_SEARCH_STEPS = 60
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-4, 1e-14, 1e6
_SHRINK, _GROW = 0.3, 4.0
# Relative decrease of the squares, in several steps in a row, below which a search has arrived; a step that is none.
_ARRIVED, _PATIENCE = 1e-2, 3
_STILL = 1e-13


def newton(task: Task, start: np.ndarray, seed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint positions closest to the seed that reach the poses, limits not regarded.

    Args:
        task: N poses.
        start: shape (N, n), where to begin [rad or m].
        seed: shape (N, n), what a redundant arm stays close to.

    Returns:
        Joint positions, shape (N, n), and which rows are reached, shape (N,).
    """
    q, reached = np.array(start, float), np.zeros(len(task), bool)
    rows, part = np.arange(len(task)), task
    for _ in range(_NEWTON_STEPS):
        missing, J = part.linearise(q[rows])
        step = _step_near(seed[rows] - q[rows] if task.is_redundant else None, missing, J)
        settled = np.abs(step).max(axis=1) < _SETTLED if task.is_redundant else True
        done = part.is_reached(missing) & settled
        reached[rows[done]] = True
        if done.any():
            rows, step = rows[~done], step[~done]
            part = task.select(rows)
        if not len(rows):
            break
        q[rows] += step
    return q, reached


def _step_near(back: np.ndarray | None, missing: np.ndarray, J: np.ndarray) -> np.ndarray:
    """Return Newton's steps that end nearest to where ``back`` leads, shape (N, n), none too long."""
    transposed = J.swapaxes(1, 2)
    square = J @ transposed
    square[:, range(J.shape[1]), range(J.shape[1])] += _floor(square)[:, None]
    if back is None:
        return _shortened((transposed @ np.linalg.solve(square, missing[..., None]))[..., 0])
    back = _shortened(back)
    left = missing[..., None] - J @ back[..., None]
    return _shortened(back + (transposed @ np.linalg.solve(square, left))[..., 0])


def _floor(square: np.ndarray) -> np.ndarray:
    return np.asarray(_FLOOR * np.trace(square, axis1=1, axis2=2) + _NOTHING)


def _shortened(step: np.ndarray) -> np.ndarray:
    longest = np.abs(step).max(axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, _LONGEST / np.maximum(longest, 1e-300)))


def search(
    task: Task, start: np.ndarray, lower: np.ndarray, upper: np.ndarray, *, first: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return joint positions within limits that come as near to the poses as can be found from the start.

    Args:
        task: N poses.
        start: shape (N, n), where to begin [rad or m].
        lower: shape (N, n), lower limits; may be infinite.
        upper: shape (N, n), upper limits, likewise.
        first: weight of the position over the orientation.

    Returns:
        Joint positions, shape (N, n), and which rows are reached, shape (N,).
    """
    weight = np.where(np.arange(task.rows) < 3, first, 1.0)
    q = np.clip(start, lower, upper)
    missing, J = task.linearise(q)
    damping, idle = np.full(len(task), _DAMPING), np.zeros(len(task), int)
    rows = np.flatnonzero(~task.is_reached(missing))
    for _ in range(_SEARCH_STEPS):
        if not len(rows):
            break
        limits = lower[rows], upper[rows]
        step = _bounded_step(J[rows] * weight[:, None], missing[rows] * weight, damping[rows], q[rows], limits)
        trial = np.clip(q[rows] + _shortened(step), *limits)
        tried, slope = task.select(rows).linearise(trial)
        before, after = _squares(missing[rows] * weight), _squares(tried * weight)
        better, moves = after < before, np.abs(step).max(axis=1) > _STILL
        idle[rows] = np.where(after < (1.0 - _ARRIVED) * before, 0, idle[rows] + better)
        damping[rows] = np.maximum(damping[rows] * np.where(better, _SHRINK, _GROW), _LEAST_DAMPING)
        at = rows[better]
        q[at], missing[at], J[at] = trial[better], tried[better], slope[better]
        rows = rows[moves & (idle[rows] < _PATIENCE) & (damping[rows] < _MOST_DAMPING) & ~task.is_reached(missing[rows])]
    return q, task.is_reached(missing)


def _squares(missing: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("ni,ni->n", missing, missing))


def _bounded_step(
    J: np.ndarray, missing: np.ndarray, damping: np.ndarray, q: np.ndarray, limits: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return damped steps in which joints at a limit don't push beyond it, shape (N, n)."""
    lower, upper = limits
    square, slope = J.swapaxes(1, 2) @ J, (J.swapaxes(1, 2) @ missing[..., None])[..., 0]
    held = np.zeros(q.shape, bool)
    while True:
        step = _step_of_free(square, slope, damping, held)
        pushes = ((q <= lower) & (step < 0.0) | (q >= upper) & (step > 0.0)) & ~held
        if not pushes.any():
            return step
        held |= pushes


def _step_of_free(square: np.ndarray, slope: np.ndarray, damping: np.ndarray, held: np.ndarray) -> np.ndarray:
    n = held.shape[1]
    system = np.where(held[:, :, None] | held[:, None, :], 0.0, square)
    system[:, range(n), range(n)] += np.where(held, 1.0, (damping + _floor(square))[:, None])
    return np.asarray(np.linalg.solve(system, np.where(held, 0.0, slope)[..., None])[..., 0])
