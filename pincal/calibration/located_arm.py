r"""What is not known of the positions of an arm once its base and its target are located, where
readings leave open where the base stands.

Contacts, distances and an IMU tell positions relative to each other only. In the frame of the base
its open turn is part of every position; who uses the arm locates base and target first. With J and
B the derivatives of positions by the parameters and by this placement, at the poses at which it is
located, :math:`B^+ J` is what it takes up of each parameter. Elsewhere
:math:`J - B\,(B_0^+ J_0)` remains, with these poses marked by 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.improvement import placement_motions
from pincal.model.conditions import Conditions
from pincal.thresholds import Count

# Poses at which base and target are located, and their seed.
_POSES: Count = 400
_SEED: Count = 0
# Rows per piece, as many as where positions are predicted.
_PIECE: Count = 4096


@dataclass(frozen=True, eq=False)
class LocatedArm:
    """A fitted robot whose base and target are located at some poses.

    Attributes:
        robot: as it was fitted.
        taken: shape (9, P), what the placement takes up of each parameter of its model.
    """

    robot: FittedRobot
    taken: np.ndarray

    @classmethod
    def at(cls, robot: FittedRobot, conditions: Conditions) -> LocatedArm:
        """Return a robot located at poses."""
        poses, J = _motions(robot, conditions)
        B = placement_motions(poses).reshape(-1, 9)
        return cls(robot, np.linalg.lstsq(B, J.reshape(len(B), -1), rcond=None)[0])

    @classmethod
    def where_measured(cls, robot: FittedRobot, like: Conditions) -> LocatedArm:
        """Return a robot located at random poses within the range of its calibration, in other
        respects like the poses where it is used.
        """
        rng = np.random.default_rng(_SEED)
        arm = robot.model.chain.robot
        lower, upper = robot.covered.q[arm.own_joints].T
        q = arm.spread(lower + (upper - lower) * rng.random((_POSES, len(lower))))
        rows = rng.integers(len(like), size=_POSES)
        return cls.at(robot, replace(like.select(rows), q=q))

    def position_covariances(self, conditions: Conditions) -> dict[str, np.ndarray]:
        """Return the covariance of each of N positions by its sources, shape (N, 3, 3) each
        [m^2].
        """
        sources = self.robot.covariance_of(conditions).sources
        found = {name: errors.blocks for name, errors in sources.items()}
        return found | {"parameters": self._by_parameters(conditions)}

    def position_sigma(self, conditions: Conditions) -> np.ndarray:
        """Return the standard uncertainty of each of N positions, shape (N, 3) [m]."""
        variances = self.robot.position_variances(conditions)
        for start in range(0, len(conditions), _PIECE):
            rows = slice(start, start + _PIECE)
            found = self._by_parameters(conditions.select(rows))
            variances["parameters"][rows] = np.einsum("naa->na", found)
        return np.asarray(np.sqrt(sum(variances.values())))

    def _by_parameters(self, conditions: Conditions) -> np.ndarray:
        """Return the covariances of positions by the parameters, shape (N, 3, 3) [m^2]."""
        poses, J = _motions(self.robot, conditions)
        remains = J - placement_motions(poses) @ self.taken
        n = remains.shape[2]
        C = self.robot.covariance[:n, :n]
        found = np.einsum("nip,pq,njq->nij", remains, C, remains, optimize=True)
        return np.asarray(found)


def _motions(robot: FittedRobot, conditions: Conditions) -> tuple[np.ndarray, np.ndarray]:
    """Return poses of the target and the motion of its position by the parameters, shapes (N, 3, 4)
    and (N, 3, P).
    """
    poses, J = robot.model.linearise(robot.model_values, robot.of_its_day(conditions), rows=3)
    return poses, J
