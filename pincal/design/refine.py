"""Better poses than any candidate: a design's joint positions moved one at a time, as long as that helps."""

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
            trial = _neighbours(q[place], reach, window)
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


def _neighbours(q: np.ndarray, reach: Reach, window: float) -> np.ndarray:
    """Return the poses allowed, but for self-collision, that differ from q, shape (n,), in one joint."""
    lower, upper = reach.range
    half = 0.5 * window * (upper - lower)
    steps = np.linspace(np.maximum(lower, q - half), np.minimum(upper, q + half), _STEPS)
    trial = np.tile(q, (len(q), _STEPS, 1))
    for joint in range(len(q)):
        trial[joint, :, joint] = steps[:, joint]
    trial = reach.robot.following(trial[reach.robot.own_joints].reshape(-1, len(q)))
    return np.asarray(trial[reach.allows_apart(trial)])
