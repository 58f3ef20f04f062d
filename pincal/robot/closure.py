"""Closed loops of a robot: which joints follow from the others, and where.

A closure joins two links that both hang on others already. Its equations hold the frame that it has on one in the frame that
it has on the other, and as many joints, the passive ones, stand where these are met. A loop in a plane meets others of
itself: of its equations in space only those are solved that the passive joints can meet, the same ones everywhere, and what
is left of the others is the play that the real joints have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pincal.robot.kinematics import Kinematics
from pincal.robot.link_path import LinkPath
from pincal.robot.se3 import rotation_vectors
from pincal.robot.urdf_loops import ClosureKind

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Closed to this [m, rad] is closed to rounding; a loop that does not come nearer than the second can't be closed.
CLOSED, _OPEN = 1e-13, 1e-9
# A pin nearer than this to the end of a rod is there [m].
_AT_END = 1e-9
# Part of the largest motion below which joints do not move a loop: axes of a calibrated one are tilted by milliradians.
STILL = 1e-2
# Known positions that others are reached from, and the longest step there [rad or m].
_KNOWN, _STEP, _MOST_STEPS = 512, 0.25, 100
NEWTON, _LONGEST, _DAMPING = 30, 0.5, 1e-14


@dataclass(frozen=True, eq=False)
class Closure:
    """What closes a loop.

    Attributes:
        name: of the joint or constraint in the URDF.
        kind: what it holds: "point", the origin; "axis", the origin and the z axis; "pose", all of the frame.
        path: from its frame on one link to its frame on the other, both placed in link frames.
        rows: those of its equations that passive joints meet.
    """

    name: str
    kind: ClosureKind
    path: LinkPath
    rows: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        """Number R of its equations."""
        return {"point": 3, "axis": 5, "pose": 6}[self.kind]

    def pinned(self, parents: Sequence[int]) -> int:
        """Return on which link its place is one of its own: 1 where its path ends, -1 where it starts, 0 on neither.

        At the end of a rod, a link that carries no other, it is where the link ends.
        """
        ends = zip(reversed(self.path.ends), (1, -1), strict=True)
        return next((side for (_, i, T), side in ends if i < 0 or i in parents or np.abs(T[:2, 3]).max() > _AT_END), 0)

    def residuals(self, T: np.ndarray) -> np.ndarray:
        """Return what it is open by, shape (N, R) [m, rad], where one frame stands at T in the other, (N, 3 or 4, 4)."""
        place = T[:, :3, 3]
        if self.kind == "point":
            return np.asarray(place)
        return np.hstack([place, T[:, :2, 2] if self.kind == "axis" else rotation_vectors(T[:, :3, :3])])

    def derivatives(self, T: np.ndarray, J: np.ndarray) -> np.ndarray:
        """Return the derivative of the residuals, shape (N, R, K), from how the frame moves and turns, shape (N, 6, K)."""
        if self.kind == "point":
            return J[:, :3]
        if self.kind == "pose":
            return J
        w, (x, y, z) = J[:, 3:], T[:, :3, 2].T[..., None]
        turned = np.stack([w[:, 1] * z - w[:, 2] * y, w[:, 2] * x - w[:, 0] * z], axis=1)
        return np.concatenate([J[:, :3], turned], axis=1)


@dataclass(frozen=True, eq=False)
class Linkage:
    """The nominal arm of a robot with loops.

    Attributes:
        kinematics: the arm with its loops open.
        closures: what closes them.
        passive: shape (p,), the joints that follow.
        lower, upper: shape (n,), joint limits [rad or m].
    """

    kinematics: Kinematics
    closures: tuple[Closure, ...]
    passive: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @cached_property
    def drivers(self) -> np.ndarray:
        """The other joints of the loops, shape (d,)."""
        loop = {joint for closure in self.closures for joint, _ in closure.path.steps(self.kinematics.parents)}
        return np.array(sorted(loop.difference(self.passive.tolist())))

    @cached_property
    def rows(self) -> np.ndarray:
        """The equations that the passive joints meet, shape (p,), among those of all closures."""
        starts = np.cumsum([0, *(closure.size for closure in self.closures)])
        return np.array([a + row for a, closure in zip(starts, self.closures, strict=False) for row in closure.rows], int)

    def equations(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals of all closures, shape (N, R), and their derivatives by the joints, shape (N, R, n)."""
        frames = self.kinematics.frames(q)
        parts = [self._of_closure(closure, frames) for closure in self.closures]
        return np.concatenate([r for r, _ in parts], axis=1), np.concatenate([C for _, C in parts], axis=1)

    def _of_closure(self, closure: Closure, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        path, kinematics = closure.path, self.kinematics
        start, end = (frames[:, i + 1] @ T for _, i, T in path.ends)
        to_start = start[:, :3, :3].swapaxes(1, 2)
        J = np.zeros((len(frames), 6, len(kinematics.types)))
        for joint, sign in path.steps(kinematics.parents):
            axis = frames[:, joint + 1] @ np.linalg.inv(kinematics.after[joint])
            w = sign * axis[:, :3, 2]
            if kinematics.types[joint] == "prismatic":
                J[:, :3, joint] = w
            else:
                J[:, :3, joint], J[:, 3:, joint] = np.cross(w, end[:, :3, 3] - axis[:, :3, 3]), w
        T = np.linalg.inv(start) @ end
        J = np.concatenate([to_start @ J[:, :3], to_start @ J[:, 3:]], axis=1)
        return closure.residuals(T), closure.derivatives(T, J)

    def rates(self, q: np.ndarray) -> np.ndarray:
        """Return how the passive joints follow the drivers, shape (N, p, d), at positions where the loops are closed."""
        C = self.equations(q)[1][:, self.rows]
        return -np.linalg.solve(C[..., self.passive], C[..., self.drivers])

    def closed(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return joint positions with the passive joints where the loops close, shape (N, n), and which rows do, shape (N,).

        Others come as near as they can. Of several ways to assemble a loop it is that of the URDF at zero positions; what
        lies beyond a dead centre, where bars are in line, is another.

        Args:
            q: shape (N, n); what stands for the passive joints means nothing.
        """
        drivers, passive, tree, side = self._known
        nearest = tree.query(q[:, self.drivers])[1]
        found, is_closed, sides = self._led(q, drivers[nearest], passive[nearest])
        return found, is_closed & (sides == side)

    def can_take(self, q: np.ndarray) -> np.ndarray:
        """Return at which positions, shape (N, n), loops close and passive joints keep to their limits, shape (N,)."""
        found, is_closed = self.closed(q)
        within = (found >= self.lower) & (found <= self.upper)
        return np.asarray(is_closed & within[:, self.passive].all(axis=1))

    def _led(self, q: np.ndarray, drivers: np.ndarray, passive: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lead the loops to joint positions, shape (N, n), from known ones, shape (N, d) and (N, p), in short steps.

        Returns:
            The positions, which rows are closed, and on which side of a dead centre they are, -1 or 1, shape (N,).
        """
        found, way = np.array(q, float), q[:, self.drivers] - drivers
        found[:, self.passive] = passive
        steps = int(np.clip(np.ceil(np.abs(way).max(initial=0.0) / _STEP), 1, _MOST_STEPS))
        for part in np.arange(1, steps + 1) / steps:
            found[:, self.drivers] = drivers + part * way
            open_by = self._newton(found)
        C = self.equations(found)[1][:, self.rows][..., self.passive]
        return found, open_by < _OPEN, np.linalg.slogdet(C)[0]

    def _newton(self, q: np.ndarray) -> np.ndarray:
        """Close the loops from near by, in place; return what they are left open by, shape (N,)."""
        left = np.arange(len(q))
        open_by, before = np.full(len(q), np.inf), np.full(len(q), np.inf)
        for _ in range(NEWTON):
            residuals, C = self.equations(q[left])
            C, missing = C[:, self.rows][..., self.passive], residuals[:, self.rows]
            before[left], open_by[left] = open_by[left], np.abs(missing).max(axis=1, initial=0.0)
            # Once near, a step that gains nothing more has reached rounding.
            is_left = (open_by[left] > CLOSED) & ((open_by[left] > _OPEN) | (open_by[left] < 0.5 * before[left]))
            left, C, missing = left[is_left], C[is_left], missing[is_left]
            if not len(left):
                break
            q[left[:, None], self.passive] -= least_step(C, missing)
        return open_by

    @cached_property
    def _known(self) -> tuple[np.ndarray, np.ndarray, cKDTree, float]:
        """Positions of drivers, shape (K, d), of passive joints there, shape (K, p), a tree of the first, and the side."""
        from scipy.spatial import cKDTree

        start = self.assembled()
        low, high = (
            np.where(np.isfinite(limit), limit, side * np.pi) for limit, side in ((self.lower, -1), (self.upper, 1))
        )
        rng = np.random.default_rng(0)
        q = np.tile(start, (_KNOWN, 1))
        q[1:, self.drivers] = rng.uniform(low, high, (_KNOWN, len(low)))[1:, self.drivers]
        drivers, passive = (np.tile(start[places], (_KNOWN, 1)) for places in (self.drivers, self.passive))
        found, is_closed, side = self._led(q, drivers, passive)
        found = found[is_closed & (side == side[0])]
        return found[:, self.drivers], found[:, self.passive], cKDTree(found[:, self.drivers]), float(side[0])

    def assembled(self) -> np.ndarray:
        """Return joint positions at which the loops are closed as far as they can be, shape (n,): zero, or the nearest."""
        q = np.zeros((1, len(self.lower)))
        if len(self.passive) and self._newton(q)[0] < _OPEN and np.abs(q).max() < np.pi:
            return np.asarray(q[0])
        moving = np.append(self.drivers, self.passive)
        q = np.zeros((1, len(self.lower)))
        for _ in range(NEWTON):
            residuals, C = self.equations(q)
            q[:, moving] -= loose_step(C[..., moving], residuals)
        return np.asarray(q[0])


def loose_step(C: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return the steps of least length, shape (N, k), that close what joints can close."""
    step = (np.linalg.pinv(C, rcond=STILL) @ missing[..., None])[..., 0]
    return np.asarray(step * np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-300)))


def least_step(C: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return the steps of least length, shape (N, k), of least squares, damped where joints don't move; none is long."""
    A = C.swapaxes(1, 2) @ C
    A += (_DAMPING * (1.0 + np.trace(A, axis1=1, axis2=2)))[:, None, None] * np.eye(A.shape[1])
    step = np.linalg.solve(A, C.swapaxes(1, 2) @ missing[..., None])[..., 0]
    return np.asarray(step * np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-300)))
