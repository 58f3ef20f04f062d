"""The frame of a part in the frame of the measured points, and features seen from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pincal.features.feature_kinds import OF_DIRECTION, OF_POSITION
from pincal.robot.se3 import exponentials
from pincal.thresholds import Scale

# Step of central differences [m, 1]: their errors are 1e-10 of the derivatives.
_STEP: Scale = 1e-5


def differentiate(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray) -> np.ndarray:
    """Return the derivatives of a smooth function, shape (m, n), at a place, shape (n,), by central
    differences.
    """
    columns = []
    for step in _STEP * np.eye(len(at)):
        columns.append((function(at + step) - function(at - step)) / (2.0 * _STEP))
    return np.array(columns).T


@dataclass(frozen=True, eq=False)
class PartFrame:
    """The part's frame in that of the points: a place X of the part is at R X + origin.

    Attributes:
        rotation: R, shape (3, 3).
        origin: shape (3,) [m].
        by_numbers: shape (6, 7F), a turn about the origin by a rotation vector [rad] and a shift
            [m], both in the frame of the points, by the numbers of all features of a set.
    """

    rotation: np.ndarray
    origin: np.ndarray
    by_numbers: np.ndarray

    @classmethod
    def identity(cls, n_numbers: int) -> PartFrame:
        """Return the frame of the points itself, beside a number of features' numbers."""
        return cls(np.eye(3), np.zeros(3), np.zeros((6, n_numbers)))

    def moved(self, motion: np.ndarray) -> PartFrame:
        """Return the frame after a turn [rad] and a shift [m], shape (6,)."""
        turned = exponentials(motion[None, :3])[0] @ self.rotation
        return PartFrame(turned, self.origin + motion[3:], self.by_numbers)

    def motion_to(self, other: PartFrame) -> np.ndarray:
        """Return the turn [rad] and the shift [m] to a frame nearby, shape (6,)."""
        from pincal.robot.se3 import rotation_vectors

        turn = rotation_vectors((other.rotation @ self.rotation.T)[None])[0]
        return np.concatenate([turn, other.origin - self.origin])

    def see(self, numbers: np.ndarray) -> np.ndarray:
        """Return the seven numbers of a feature in the part's frame, shape (7,)."""
        found = numbers.copy()
        found[OF_POSITION] = self.rotation.T @ (numbers[OF_POSITION] - self.origin)
        size = max(float(np.linalg.norm(numbers[OF_DIRECTION])), np.finfo(float).tiny)
        found[OF_DIRECTION] = self.rotation.T @ numbers[OF_DIRECTION] / size
        return found
