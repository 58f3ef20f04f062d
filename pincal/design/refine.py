"""Better poses than any candidate: a design's joint positions moved one at a time, as long as that helps."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

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


@dataclass(frozen=True)
class Refinement:
    """A coordinate exchange (Meyer and Nachtsheim, Technometrics 37, 1995) within the constraints.

    Each pose in turn is taken out of the design, and the best of its likes that differ in one joint is taken in.

    Attributes:
        design_model: what readings tell.
        reach: which poses are allowed.
        W: shape (F, F), or None for the determinant.
        H: shape (F, F), information that is there before.
    """

    design_model: DesignModel
    reach: Reach
    W: np.ndarray | None
    H: np.ndarray

    def improve(self, design: Conditions) -> Conditions:
        """Return a design that is better, or the same; what else belongs to a pose, its payload say, stays as it is."""
        q, A = design.q.copy(), self.design_model.readings(design)
        for sweep, window in enumerate(_WINDOWS):
            log.info("refining the poses, sweep %d", sweep + 1, extra={"done": sweep, "of": len(_WINDOWS)})
            for place in range(len(q)):
                rest = np.delete(A, place, axis=0).reshape(-1, A.shape[2])
                C = covariance(self.H + rest.T @ rest)
                q[place], A[place] = self._best(design, place, q[place], A[place], C, window)
        return replace(design, q=q)

    def _best(
        self, design: Conditions, place: int, q: np.ndarray, own: np.ndarray, C: np.ndarray, window: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose that lowers the criterion most beside the others, and its Jacobian, shape (m, F)."""
        trial = self._likes(q, window)
        trial = trial[self.reach.allows_apart(trial)]
        if not len(trial):
            return q, own
        A = self.design_model.readings(replace(design.select(np.full(len(trial), place)), q=trial))
        gain = gains(*weigh(A, C, self.W))
        least = float(gains(*weigh(own[None], C, self.W))[0])
        for k in np.argsort(-gain):
            if gain[k] <= least + _WORTH * abs(least):
                break
            if not self.reach.collides(trial[k : k + 1])[0]:
                return trial[k], A[k]
        return q, own

    def _likes(self, q: np.ndarray, window: float) -> np.ndarray:
        """Return poses that differ from ``q`` in one joint, shape (n steps, n)."""
        lower, upper = self.reach.range
        n = len(q)
        trial = np.tile(q, (n * _STEPS, 1))
        for joint in range(n):
            half = 0.5 * window * (upper[joint] - lower[joint])
            low, high = max(lower[joint], q[joint] - half), min(upper[joint], q[joint] + half)
            trial[joint * _STEPS : (joint + 1) * _STEPS, joint] = np.linspace(low, high, _STEPS)
        return trial
