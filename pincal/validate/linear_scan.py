"""What positions of a target leave of many corrections of a serial arm at once, by a linear fit
each.

A target that is fixed on the last link is at :math:`m = R p + R R_n t + b` for the last link's
position p and orientation R_n, which is linear in 13 unknowns of each component if R, t and b are
free of each other. Corrections differ in few ways at each joint: the two halves of the arm are
computed once for each way in which their joints differ, and joined for each correction.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pincal.robot.robot import Robot
from pincal.thresholds import Count, Scale
from pincal.validate.cures import Correction

UNKNOWNS: Count = 13
"""Unknowns of each component of a position."""
# Corrections that are looked at together, so that their poses fit into the cache.
_AT_ONCE: Count = 128
# Part of the squares of the columns that is added to them, so that columns which others give, as
# where joints rest, leave a fit that has a solution.
_RIDGE: Scale = 1e-13


@dataclass(frozen=True)
class LinearScan:
    """Linear fits of a target's positions under corrections of the robot's description.

    Attributes:
        robot: a serial arm as described, n joints.
        reported: shape (N, n), the reported positions of its joints.
        position: shape (N, 3), the target's positions by any instrument [m].
    """

    robot: Robot
    reported: np.ndarray
    position: np.ndarray

    def left(self, corrections: Sequence[Correction]) -> np.ndarray:
        """Return the sum of squares that the fit leaves of each correction, shape (k,) [m^2].

        Lengths are those of the description.
        """
        m = self.position - self.position.mean(axis=0)
        explained = [_explained(columns, m) for columns in self._columns(corrections)]
        return np.asarray(np.sum(m**2) - np.concatenate(explained))

    @cached_property
    def _middle(self) -> int:
        """The number of joints of the first half."""
        return self.robot.n_joints // 2

    def _columns(self, corrections: Sequence[Correction]) -> Iterator[np.ndarray]:
        """Yield the last link's positions and orientations, shape (k, 12, N), of some corrections
        after the other.
        """
        ways = _Ways.of(self.robot, self.reported, corrections)
        first, of_first = self._half(ways, 0, self._middle)
        second, of_second = self._half(ways, self._middle, self.robot.n_joints)
        for start in range(0, len(corrections), _AT_ONCE):
            some = slice(start, start + _AT_ONCE)
            A = first[of_first[some]]
            B = second[of_second[some]]
            found = sum(A[:, :, k, None] * B[:, None, k] for k in range(3))
            found[:, :, 3] += A[:, :, 3]
            yield found.reshape(len(found), 12, -1)

    def _half(self, ways: _Ways, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the transforms of a part of the joints, shape (l, 3, 4, N), in each of l ways, and
        which of these is each correction's.
        """
        q, of_each = ways.of_joints(slice(start, stop))
        part = self.robot.kinematics.part(start, stop)
        frames = part.frames(q.reshape(-1, q.shape[-1]))[:, -1, :3]
        frames = frames.reshape(*q.shape[:2], 3, 4)
        return np.ascontiguousarray(np.moveaxis(frames, 1, -1)), of_each


@dataclass(frozen=True)
class _Ways:
    """In what ways the joints are at other positions by k corrections.

    Attributes:
        sources: shape (c, N, n), positions of the joints by the URDF under c sets of couplings.
        coupled: shape (k, n), which of them each joint takes: the first that has its positions.
        signs: shape (k, n), 1 or -1.
        shifts: shape (k, n) [rad].
    """

    sources: np.ndarray
    coupled: np.ndarray
    signs: np.ndarray
    shifts: np.ndarray

    @classmethod
    def of(cls, robot: Robot, reported: np.ndarray, corrections: Sequence[Correction]) -> _Ways:
        """Return the ways of some corrections."""
        couplings = {one.couplings: None for one in corrections}
        robots = [robot.with_couplings(*some) if some else robot for some in couplings]
        sources = np.array([one.from_reported(reported) for one in robots])
        # Most joints are where they are without a coupling.
        same = (sources[:, None] == sources).all(axis=2)
        place = {some: row for some, row in zip(couplings, same.argmax(axis=1), strict=True)}
        joints = {name: i for i, name in enumerate(robot.joint_names)}
        signs = np.ones((len(corrections), robot.n_joints))
        shifts = np.zeros_like(signs)
        for k, one in enumerate(corrections):
            for name in one.turned:
                signs[k, joints[name]] = -1.0
            for name, shift in one.shifts.items():
                shifts[k, joints[name]] = shift
        coupled = np.array([place[one.couplings] for one in corrections])
        return cls(sources, coupled, signs, shifts)

    def of_joints(self, joints: slice) -> tuple[np.ndarray, np.ndarray]:
        """Return the different positions of some joints, shape (l, N, j), and which of these is
        each correction's, shape (k,).
        """
        parts = (self.coupled, self.signs, self.shifts)
        columns = np.hstack([part[:, joints] for part in parts])
        values, places = zip(*(np.unique(c, return_inverse=True) for c in columns.T), strict=True)
        code = np.ravel_multi_index(places, tuple(map(len, values)))
        _, which, of_each = np.unique(code, return_index=True, return_inverse=True)
        here = self.sources[:, :, joints]
        q = here[self.coupled[which, joints], :, np.arange(here.shape[2])]
        signs, shifts = (part[which, joints][..., None] for part in (self.signs, self.shifts))
        return np.swapaxes(q * signs + shifts, 1, 2), of_each


def _explained(columns: np.ndarray, m: np.ndarray) -> np.ndarray:
    """Return what fits of columns, shape (k, 12, N), and a constant explain of readings without
    their mean, shape (N, 3): sums of squares, shape (k,).
    """
    columns = columns - columns.mean(axis=2, keepdims=True)
    products = columns @ m
    squares = columns @ np.swapaxes(columns, 1, 2)
    diagonal = np.arange(squares.shape[1])
    squares[:, diagonal, diagonal] += _RIDGE * np.trace(squares, axis1=1, axis2=2)[:, None]
    return np.asarray(np.sum(products * np.linalg.solve(squares, products), axis=(1, 2)))
