"""Inverse kinematics of a calibrated model: poses that the target has to reach, and their Jacobians
by the joints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pincal.compensate.compensate_numbers import COMPENSATION
from pincal.model.conditions import Conditions
from pincal.model.effects import JointOffset
from pincal.model.model import Model
from pincal.robot.se3 import rotation_vectors
from pincal.thresholds import Scale

# Typical lever arm of a rotation, as a fraction of the robot's reach.
_LEVER: Scale = 1.0 / 3.0
# Rotations smaller than this, relative to the others, count as none.
_LOST_TURN: Scale = 1e-6
# Rounding error of a joint limit [rad or m].
_ON_LIMIT: Scale = 1e-12


@dataclass(frozen=True)
class Bounds:
    """Limits of the joint positions [rad or m]; may be infinite.

    Attributes:
        lower, upper: shape (n,), or shape (N, n) for row-wise bounds.
    """

    lower: np.ndarray
    upper: np.ndarray

    @classmethod
    def none(cls, n: int) -> Bounds:
        """Return infinite bounds."""
        return cls(np.full(n, -np.inf), np.full(n, np.inf))

    def select(self, rows: np.ndarray) -> Bounds:
        """Return the bounds of some rows."""
        return self if self.lower.ndim == 1 else Bounds(self.lower[rows], self.upper[rows])

    def contain(self, q: np.ndarray) -> np.ndarray:
        """Return which rows of joint positions, shape (N, n), are within the bounds, shape (N,)."""
        return np.asarray(
            np.all((q >= self.lower - _ON_LIMIT) & (q <= self.upper + _ON_LIMIT), axis=1)
        )

    def touched(self, q: np.ndarray) -> np.ndarray:
        """Return in which rows of joint positions, shape (N, n), a joint is at a limit,
        shape (N,).
        """
        return np.asarray(
            np.any((q <= self.lower + _ON_LIMIT) | (q >= self.upper - _ON_LIMIT), axis=1)
        )

    def around(self, q: np.ndarray, rows: np.ndarray, *, distance: float) -> Bounds:
        """Return row-wise bounds that keep masked rows, shape (N,), within a distance of joint
        positions, shape (N, n).
        """
        start = np.clip(q, self.lower, self.upper)
        narrow = rows[:, None]
        lower = np.where(narrow, np.maximum(start - distance, self.lower), self.lower)
        return Bounds(lower, np.where(narrow, np.minimum(start + distance, self.upper), self.upper))


@dataclass(frozen=True)
class IkProblem:
    """N wanted poses of the target, each under its own conditions.

    A joint position adds to the same coordinate as the joint's offset. The model's exact derivative
    by the offsets, which includes the change of the static moments, is therefore the derivative by
    the joint positions except for effects that depend on the position itself (gear errors, about
    1e-4 of it): each Newton step gains three digits.

    The unknowns are the positions of the n independent joints; mimic joints follow them.

    Attributes:
        model: the model, with a joint offset of value zero as its last effect.
        values: shape (P,), its parameters.
        conditions: the N poses; their joint positions are not used.
        wanted: shape (N, 3, 4), poses of the target in the model's instrument frame.
        with_orientation: whether the orientation has to be reached too.
    """

    model: Model
    values: np.ndarray
    conditions: Conditions
    wanted: np.ndarray
    with_orientation: bool

    @classmethod
    def of(
        cls,
        model: Model,
        values: np.ndarray,
        *,
        conditions: Conditions,
        wanted: np.ndarray,
        with_orientation: bool,
    ) -> IkProblem:
        """Return the problem for a model and its values, shape (P,)."""
        movable = model.with_effects((*model.effects, JointOffset()))
        offsets = np.zeros(movable.n_parameters - model.n_parameters)
        return cls(movable, np.concatenate([values, offsets]), conditions, wanted, with_orientation)

    def __len__(self) -> int:
        return len(self.wanted)

    def select(self, rows: slice | np.ndarray) -> IkProblem:
        """Return the problem for some rows."""
        return replace(self, conditions=self.conditions.select(rows), wanted=self.wanted[rows])

    def without_orientation(self) -> IkProblem:
        """Return the problem for the same positions with any orientation."""
        return replace(self, with_orientation=False)

    @property
    def n_equations(self) -> int:
        """Equations per pose: 3 or 6."""
        return 6 if self.with_orientation else 3

    @property
    def n_spare(self) -> int:
        """Number of joints minus equations per pose: above 0 the arm is redundant, below 0 it has
        too few joints.
        """
        return len(self.model.chain.robot.own_joints) - self.n_equations

    @cached_property
    def length(self) -> float:
        """Weight of a rotation relative to a translation [m]: a rotation by 1 rad counts as much as
        this distance.
        """
        return max(_LEVER * self.model.chain.robot.reach, 1e-3)

    def residuals(self, q: np.ndarray) -> np.ndarray:
        """Return wanted minus actual pose at joint positions of shape (N, n), shape (N,
        n_equations).

        The translation is divided by ``length``; a rotation vector [rad] follows if the orientation
        counts.
        """
        return self._residuals(self.model.predict(self.values, self._at(q)))

    def linearise(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals, shape (N, n_equations), and the pose's Jacobian in their units, (N,
        n_equations, n).
        """
        robot = self.model.chain.robot
        offsets = self.model.spans[-1]
        free = np.zeros(len(self.values), bool)
        free[offsets] = True
        poses, offset_J = self.model.linearise(
            self.values, self._at(q), free=free, rows=self.n_equations
        )
        J = np.zeros((*offset_J.shape[:2], robot.n_joints))
        J[..., [robot.joint_names.index(p.element) for p in self.model.parameters[offsets]]] = (
            offset_J
        )
        J = np.ascontiguousarray(robot.gathered(J))
        J[:, :3] /= self.length
        return self._residuals(poses), J

    def _at(self, q: np.ndarray) -> Conditions:
        return replace(self.conditions, q=self.model.chain.robot.spread(q))

    def _residuals(self, poses: np.ndarray) -> np.ndarray:
        translation = (self.wanted[:, :, 3] - poses[:, :, 3]) / self.length
        if not self.with_orientation:
            return np.asarray(translation)
        turn = rotation_vectors(self.wanted[:, :, :3] @ poses[:, :, :3].swapaxes(1, 2))
        return np.hstack([translation, turn])

    def turns_in_place(self, q: np.ndarray) -> np.ndarray:
        """Return how freely the joints rotate the target about each axis of the frame with its
        position fixed.

        Returns:
            Shape (N, 3): 1 freely, 0 not at all; for an arm with six joints all are 1 except at
            singular poses.
        """
        _, J = self.linearise(q)
        still = np.eye(J.shape[2]) - np.linalg.pinv(J[:, :3], rcond=_LOST_TURN) @ J[:, :3]
        turns = J[:, 3:] @ still
        reached = turns @ np.linalg.pinv(turns, rcond=_LOST_TURN)
        # Rounding errors are no rotation.
        is_turned = np.linalg.norm(turns, axis=(1, 2)) > _LOST_TURN
        return np.where(is_turned[:, None], np.diagonal(reached, axis1=1, axis2=2), 0.0)

    def distances(self, residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances [m] and the angles [rad] of residuals, each of shape (N,)."""
        angle = np.linalg.norm(residuals[:, 3:], axis=1)
        return self.length * np.linalg.norm(residuals[:, :3], axis=1), angle

    def is_reached(self, residuals: np.ndarray) -> np.ndarray:
        """Return which rows are reached, shape (N,)."""
        distance, angle = self.distances(residuals)
        return (distance <= COMPENSATION.reached) & (angle <= COMPENSATION.reached)
