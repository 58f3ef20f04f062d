"""Paths between two links of a tree: up to their common ancestor and down again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, eq=False)
class LinkPath:
    """Two links, and their poses on the joints that carry them.

    Attributes:
        start: name of the link relative to which a reading is taken.
        tip: name of the link that is measured.
        start_joint, tip_joint: the joints that carry them; -1 for the base.
        T_joint_start, T_joint_tip: shape (4, 4), the links in the link frames of these joints, or
            in the base frame.
    """

    start: str
    tip: str
    start_joint: int
    tip_joint: int
    T_joint_start: np.ndarray
    T_joint_tip: np.ndarray

    @property
    def ends(self) -> tuple[tuple[str, int, np.ndarray], tuple[str, int, np.ndarray]]:
        """First and last link, each with the joint that carries it and its pose in this joint's
        link frame.
        """
        first = self.start, self.start_joint, self.T_joint_start
        return first, (self.tip, self.tip_joint, self.T_joint_tip)

    def on_links(self, T_link_joint: np.ndarray) -> LinkPath:
        """Return the path with poses in link frames instead of the URDF's joint frames, given in
        them, shape (n, 4, 4).
        """
        start, tip = (T if i < 0 else T_link_joint[i] @ T for _, i, T in self.ends)
        return replace(self, T_joint_start=start, T_joint_tip=tip)

    def is_whole(self, n_joints: int) -> bool:
        """Whether it leads from the base itself to a link on the last of ``n_joints`` joints."""
        return (self.start_joint, self.tip_joint) == (-1, n_joints - 1) and np.array_equal(
            self.T_joint_start, np.eye(4)
        )

    def steps(self, parents: Sequence[int]) -> list[tuple[int, int]]:
        """Return the joints on the path, each with 1 if traversed forwards, -1 if backwards, by the
        carrier of each.
        """
        up = above(self.start_joint, parents)
        down = above(self.tip_joint, parents)
        shared = len(set(up) & set(down))
        return [(joint, -1) for joint in reversed(up[shared:])] + [
            (joint, 1) for joint in down[shared:]
        ]


def above(joint: int, parents: Sequence[int]) -> list[int]:
    """Return the joints from the base to a joint, inclusive; none for -1."""
    found = []
    while joint >= 0:
        found.append(joint)
        joint = parents[joint]
    return found[::-1]
