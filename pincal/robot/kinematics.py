"""The nominal arm as products of constant transforms and joint motions, at many poses at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.robot.dh import DhFrames
from pincal.robot.se3 import rotation, translation


@dataclass(frozen=True)
class Kinematics:
    """The nominal arm: S_i = S_p before_i J(q_i) after_i, with p the joint that carries joint i and
    S_0 = first in the base.

    Attributes:
        first: shape (4, 4).
        before, after: shape (n, 4, 4).
        types: "revolute" or "prismatic", one per joint.
        parents: the joint that carries each joint, -1 for the base.

    Example:
        >>> from pincal.robot.robot import Robot
        >>> robot, q = Robot.from_urdf("ur10"), np.full((1, 6), 0.3)
        >>> tip = robot.kinematics.frames(q)[0, -1] @ robot.frames.T_last_tip
        >>> bool(np.allclose(tip, robot.forward_kinematics(q)[0]))
        True
    """

    first: np.ndarray
    before: np.ndarray
    after: np.ndarray
    types: tuple[str, ...]
    parents: tuple[int, ...]

    @classmethod
    def of(cls, frames: DhFrames, types: tuple[str, ...], parents: tuple[int, ...]) -> Kinematics:
        """Return the kinematics of nominal frames and joint types."""
        rows = frames.parameters
        before = [
            rotation("x", s_x) @ rotation("y", s_y) @ rotation("z", theta)
            for s_x, s_y, theta, *_ in rows
        ]
        for i, T in zip(frames.branches, frames.T_branch_first, strict=True):
            before[i] = T @ before[i]
        after = [translation(a, 0.0, d) @ rotation("x", alpha) for *_, d, a, alpha in rows]
        return cls(frames.T_base_first, np.array(before), np.array(after), types, parents)

    def part(self, start: int, stop: int) -> Kinematics:
        """Return a part of a serial arm: the joints from ``start`` to before ``stop``, in the frame
        of the link that carries the first of them.
        """
        joints = slice(start, stop)
        first = self.first if start == 0 else np.eye(4)
        parents = tuple(range(-1, stop - start - 1))
        return Kinematics(
            first, self.before[joints], self.after[joints], self.types[joints], parents
        )

    def frames(self, q: np.ndarray) -> np.ndarray:
        """Return the base frame and all link frames S_i, in the base frame, at joint positions of
        shape (N, n) [rad or m].

        Their shape is (N, n + 1, 4, 4).
        """
        frames = np.empty((len(q), len(self.types) + 1, 4, 4))
        frames[:, 0] = np.eye(4)
        for i, (kind, parent) in enumerate(zip(self.types, self.parents, strict=True)):
            start = self.first if i == 0 else frames[:, parent + 1]
            frames[:, i + 1] = start @ (self.before[i] @ _moves(q[:, i], kind) @ self.after[i])
        return frames


def _moves(q: np.ndarray, kind: str) -> np.ndarray:
    """Return the transforms of a joint at each of N positions, shape (N, 4, 4)."""
    moves = np.tile(np.eye(4), (len(q), 1, 1))
    if kind == "prismatic":
        moves[:, 2, 3] = q
        return moves
    moves[:, 0, 0] = moves[:, 1, 1] = np.cos(q)
    moves[:, 1, 0] = np.sin(q)
    moves[:, 0, 1] = -moves[:, 1, 0]
    return moves
