"""Better poses than any candidate: a design's joint positions moved one at a time, as long as that helps.

No position is taken that another pose has already: what a drive does there would be seen twice, and what it does elsewhere
not at all.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from pincal.design.design_model import DesignModel
from pincal.design.exchange import covariance, gains, weigh
from pincal.design.reach import Reach
from pincal.model.effects import Conditions

log = logging.getLogger(__name__)

# Positions tried of each joint, and the part of its range that they are spread over, sweep by sweep.
_STEPS = 11
_WINDOWS = (1.0, 0.4, 0.15)
# Part of its range by which a joint's positions differ from pose to pose, and that of a pose's share of the range.
_APART, _OF_SHARE = 2e-3, 0.25
# Steps of one pose lie between those of the next, by this part of a step.
_SHIFT = 0.5 * (5.0**0.5 - 1.0)
# Relative gain below which a pose stays where it is.
_WORTH = 1e-6


def refine(
    design: Conditions, design_model: DesignModel, *, reach: Reach, W: np.ndarray | None, H: np.ndarray
) -> Conditions:
    """Improve a design by coordinate exchange within the constraints (Meyer and Nachtsheim, Technometrics 37, 1995).

    Each pose in turn is taken out, and the best neighbour that differs in one joint is taken in; what else belongs to a
    pose, its payload say, stays as it is.

    Args:
        design: its poses.
        design_model: what readings tell.
        reach: which poses are allowed.
        W: shape (F, F), of the criterion tr(W C); None for the determinant.
        H: shape (F, F), information that is there before.
    """
    q, A = design.q.copy(), design_model.readings(design)
    for sweep, window in enumerate(_WINDOWS):
        log.info("refining the poses, sweep %d", sweep + 1, extra={"done": sweep, "of": len(_WINDOWS)})
        for place in range(len(q)):
            rest = np.delete(A, place, axis=0).reshape(-1, A.shape[2])
            C = covariance(H + rest.T @ rest)
            trial = _neighbours(q, place, reach, window)
            if not len(trial):
                continue
            readings = design_model.readings(replace(design.select(np.full(len(trial), place)), q=trial))
            gain = gains(*weigh(readings, C, W))
            least = float(gains(*weigh(A[place][None], C, W))[0])
            better = np.argsort(-gain)[: np.sum(gain > least + _WORTH * abs(least))]
            k = next((k for k in better if not reach.collides(trial[k : k + 1])[0]), None)
            if k is not None:
                q[place], A[place] = trial[k], readings[k]
    return replace(design, q=q)


def _neighbours(q: np.ndarray, place: int, reach: Reach, window: float) -> np.ndarray:
    """Return the poses allowed, but for self-collision, that differ from one of q, shape (N, n), in one joint."""
    lower, upper = reach.range
    half = 0.5 * window * (upper - lower)
    low, high = np.maximum(lower, q[place] - half), np.minimum(upper, q[place] + half)
    steps = low + (np.arange(_STEPS)[:, None] + place * _SHIFT % 1.0) / _STEPS * (high - low)
    taken = np.delete(q, place, axis=0)
    apart = min(_APART, _OF_SHARE / len(q)) * (upper - lower)
    trial = np.tile(q[place], (q.shape[1], _STEPS, 1))
    for joint in range(q.shape[1]):
        trial[joint, :, joint] = steps[:, joint]
    is_new = np.all(np.abs(steps[:, None] - taken) > apart, axis=1).T
    own = reach.robot.own_joints
    trial = reach.robot.following(trial[own][is_new[own]])
    return np.asarray(trial[reach.allows_apart(trial)])
