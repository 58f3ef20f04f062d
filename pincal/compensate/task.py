"""The equations of compensation: poses that joints have to reach by a model, and how the poses move with the joints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pincal.model.effects import Conditions, JointOffset
from pincal.model.model import Model
from pincal.robot.se3 import rotation_vectors

# What counts as reached [m and rad]: a tenth of what is promised, a thousand times the rounding of a pose.
REACHED = 1e-10
# Part of the reach by which a turning of 1 rad moves the target of a typical pose.
_LEVER = 1.0 / 3.0


@dataclass(frozen=True)
class Task:
    """N poses that an arm has to reach, each under its own conditions.

    A joint position adds to the same coordinate as the joint's offset, so the model's exact derivative by the offsets,
    the motion of the static moments included, is that by the joint positions but for effects that follow the position
    itself (gear errors, some 1e-4 of it): Newton steps gain three digits each.

    Attributes:
        model: the model, a joint offset of value zero its last effect.
        values: shape (P,), its parameters.
        conditions: the N poses; the joint positions among them don't count.
        wanted: shape (N, 3, 4), poses of the target in the model's instrument frame.
        turns: whether the orientation is wanted, too.
    """

    model: Model
    values: np.ndarray
    conditions: Conditions
    wanted: np.ndarray
    turns: bool

    @classmethod
    def of(cls, model: Model, values: np.ndarray, conditions: Conditions, wanted: np.ndarray, *, turns: bool) -> Task:
        """Return the task of a model and its values, shape (P,)."""
        n = model.chain.robot.n_joints
        movable = model.with_effects((*model.effects, JointOffset()))
        return cls(movable, np.concatenate([values, np.zeros(n)]), conditions, wanted, turns)

    def __len__(self) -> int:
        return len(self.wanted)

    def select(self, rows: slice | np.ndarray) -> Task:
        """Return the task of some rows."""
        return replace(self, conditions=self.conditions.select(rows), wanted=self.wanted[rows])

    def without_orientation(self) -> Task:
        """Return the task of the same positions, whatever the orientation."""
        return replace(self, turns=False)

    @property
    def rows(self) -> int:
        """Equations of a pose: 3 or 6."""
        return 6 if self.turns else 3

    @cached_property
    def length(self) -> float:
        """What weighs a turning against a motion [m]: 1 rad counts as much as this way."""
        return max(_LEVER * self.model.chain.robot.reach, 1e-3)

    @cached_property
    def is_redundant(self) -> bool:
        """Whether the arm has more joints than a pose has equations."""
        return self.model.chain.robot.n_joints > self.rows

    @cached_property
    def is_overdetermined(self) -> bool:
        """Whether the arm has too few joints for any orientation that may be wanted."""
        return self.turns and self.model.chain.robot.n_joints < self.rows

    def missing(self, q: np.ndarray) -> np.ndarray:
        """Return what is missing at joint positions of shape (N, n): motion over ``length``, turning [rad], (N, rows)."""
        return self._missing(self.model.predict(self.values, replace(self.conditions, q=q)))

    def linearise(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what is missing, shape (N, rows), and how it shrinks with the joints, shape (N, rows, n)."""
        n = q.shape[1]
        free = np.zeros(len(self.values), bool)
        free[-n:] = True
        there = replace(self.conditions, q=q)
        poses, J = self.model.linearise(self.values, there, free=free, rows=self.rows)
        J = np.ascontiguousarray(J)
        J[:, :3] /= self.length
        return self._missing(poses), J

    def _missing(self, poses: np.ndarray) -> np.ndarray:
        way = (self.wanted[:, :, 3] - poses[:, :, 3]) / self.length
        if not self.turns:
            return np.asarray(way)
        turn = rotation_vectors(self.wanted[:, :, :3] @ poses[:, :, :3].swapaxes(1, 2))
        return np.hstack([way, turn])

    def distances(self, missing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances [m] and the angles [rad] of what is missing, each of shape (N,)."""
        angle = np.linalg.norm(missing[:, 3:], axis=1)
        return self.length * np.linalg.norm(missing[:, :3], axis=1), angle

    def is_reached(self, missing: np.ndarray) -> np.ndarray:
        """Return which rows are reached, shape (N,)."""
        distance, angle = self.distances(missing)
        return (distance <= REACHED) & (angle <= REACHED)
