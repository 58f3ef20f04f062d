"""Closed loops of a robot: passive joints, whose positions follow from the others.

A closure joins two links of the tree. Its equations constrain its frame on one link relative to its
frame on the other, and determine the positions of as many joints, the passive ones. A planar loop
satisfies some of the spatial equations identically: only those that the passive joints can satisfy
are solved, the same ones in every pose, and the residuals of the others are the play of the real
joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pincal.robot.kinematics import Kinematics
from pincal.robot.link_path import LinkPath
from pincal.robot.robot_numbers import OF_LOOP
from pincal.robot.se3 import rotation_vectors
from pincal.robot.urdf_loops import ClosureKind
from pincal.thresholds import Count, Scale

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Gap [m, rad] of a loop that is closed to rounding.
CLOSED: Scale = 1e-13
# A pin closer than this to the end of a rod is taken to be there [m].
_AT_END: Scale = 1e-9
# Number of known positions from which others are reached, the longest step [rad or m], and the most
# steps.
_KNOWN: Count = 512
_STEP: Scale = 0.25
_MOST_STEPS: Count = 100
_MOST_NEWTON: Count = 30
_LONGEST: Scale = 0.5
_DAMPING: Scale = 1e-14


@dataclass(frozen=True, eq=False)
class Closure:
    """A loop closure.

    Attributes:
        name: name of the joint or constraint in the URDF.
        kind: the constrained quantity: "point", the origin; "axis", the origin and the z axis;
            "pose", the whole frame.
        path: from its frame on one link to its frame on the other, both in link frames.
        rows: its equations that passive joints satisfy.
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
        """Return on which link its position is independent: 1 at the end of its path, -1 at the
        start, 0 on neither.

        On a rod, a link that carries no other, it is at the end of the link.
        """
        ends = zip(reversed(self.path.ends), (1, -1), strict=True)
        return next(
            (
                side
                for (_, i, T), side in ends
                if i < 0 or i in parents or np.abs(T[:2, 3]).max() > _AT_END
            ),
            0,
        )

    def residuals(self, T: np.ndarray) -> np.ndarray:
        """Return its gaps, shape (N, R) [m, rad], with one frame at T in the other, shape (N, 3 or
        4, 4).
        """
        place = T[:, :3, 3]
        if self.kind == "point":
            return np.asarray(place)
        return np.hstack(
            [place, T[:, :2, 2] if self.kind == "axis" else rotation_vectors(T[:, :3, :3])]
        )

    def derivatives(self, T: np.ndarray, J: np.ndarray) -> np.ndarray:
        """Return the derivatives of the residuals, shape (N, R, K), from the frame's velocities,
        shape (N, 6, K).
        """
        if self.kind == "point":
            return J[:, :3]
        if self.kind == "pose":
            return J
        w = J[:, 3:]
        (x, y, z) = T[:, :3, 2].T[..., None]
        turned = np.stack([w[:, 1] * z - w[:, 2] * y, w[:, 2] * x - w[:, 0] * z], axis=1)
        return np.concatenate([J[:, :3], turned], axis=1)


@dataclass(frozen=True, eq=False)
class Linkage:
    """The nominal arm of a robot with loops.

    Attributes:
        kinematics: the arm with its loops open.
        closures: the loop closures.
        passive: shape (p,), the passive joints.
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
        loop = {
            joint
            for closure in self.closures
            for joint, _ in closure.path.steps(self.kinematics.parents)
        }
        return np.array(sorted(loop.difference(self.passive.tolist())))

    @cached_property
    def rows(self) -> np.ndarray:
        """Indices among all equations of those that the passive joints satisfy, shape (p,)."""
        starts = np.cumsum([0, *(closure.size for closure in self.closures)])
        return np.array(
            [
                a + row
                for a, closure in zip(starts, self.closures, strict=False)
                for row in closure.rows
            ],
            int,
        )

    def equations(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals of all closures, shape (N, R), and their derivatives by the joints,
        shape (N, R, n).
        """
        frames = self.kinematics.frames(q)
        parts = [self._of_closure(closure, frames) for closure in self.closures]
        return np.concatenate([r for r, _ in parts], axis=1), np.concatenate(
            [C for _, C in parts], axis=1
        )

    @cached_property
    def _T_link_axis(self) -> np.ndarray:
        """The z axis and the origin of each joint in the frame of its link, shape (n, 4, 2)."""
        return np.linalg.inv(self.kinematics.after)[..., 2:]

    def _of_closure(self, closure: Closure, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        path = closure.path
        kinematics = self.kinematics
        start, end = (frames[:, i + 1] @ T for _, i, T in path.ends)
        to_start = start[:, :3, :3].swapaxes(1, 2)
        J = np.zeros((len(frames), 6, len(kinematics.types)))
        for joint, sign in path.steps(kinematics.parents):
            w, origin = (frames[:, joint + 1, :3] @ self._T_link_axis[joint]).transpose(2, 0, 1)
            w = sign * w
            if kinematics.types[joint] == "prismatic":
                J[:, :3, joint] = w
            else:
                J[:, :3, joint] = _crossed(w, end[:, :3, 3] - origin)
                J[:, 3:, joint] = w
        # Of a frame, the inverse is the transpose of its axes.
        place = to_start @ (end[:, :3, 3] - start[:, :3, 3])[..., None]
        T = np.concatenate([to_start @ end[:, :3, :3], place], axis=2)
        J = np.concatenate([to_start @ J[:, :3], to_start @ J[:, 3:]], axis=1)
        return closure.residuals(T), closure.derivatives(T, J)

    def rates(self, q: np.ndarray) -> np.ndarray:
        """Return the derivatives of the passive joints by the drivers, shape (N, p, d), at
        positions with closed loops.
        """
        C = self.equations(q)[1][:, self.rows]
        return -np.linalg.solve(C[..., self.passive], C[..., self.drivers])

    def closed(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return joint positions with the loops closed, shape (N, n), and which rows are, shape
        (N,).

        Others are as nearly closed as possible. The assembly mode is the URDF's at zero positions;
        beyond a dead centre, with bars in line, there is another one. In q, shape (N, n), the
        positions of passive joints are ignored.
        """
        drivers, passive, tree, side = self._known
        nearest = tree.query(q[:, self.drivers])[1]
        found, is_closed, sides = self._led(q, drivers[nearest], passive[nearest])
        return found, is_closed & (sides == side)

    def can_take(self, q: np.ndarray) -> np.ndarray:
        """Return at which positions, shape (N, n), loops close with passive joints within their
        limits, shape (N,).
        """
        found, is_closed = self.closed(q)
        within = (found >= self.lower) & (found <= self.upper)
        return np.asarray(is_closed & within[:, self.passive].all(axis=1))

    def _led(
        self, q: np.ndarray, drivers: np.ndarray, passive: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Continue the loops to joint positions, shape (N, n), from known ones, shape (N, d) and
        (N, p), in short steps.

        Returns the positions, which rows are closed, and their side of a dead centre, -1 or 1,
        shape (N,).
        """
        found = np.array(q, float)
        way = q[:, self.drivers] - drivers
        found[:, self.passive] = passive
        steps = int(np.clip(np.ceil(np.abs(way).max(initial=0.0) / _STEP), 1, _MOST_STEPS))
        for part in np.arange(1, steps + 1) / steps:
            found[:, self.drivers] = drivers + part * way
            open_by = self._newton(found)
        C = self.equations(found)[1][:, self.rows][..., self.passive]
        return found, open_by < OF_LOOP.open, np.linalg.slogdet(C)[0]

    def _newton(self, q: np.ndarray) -> np.ndarray:
        """Close the loops by Newton's method, in place; return the remaining gaps, shape (N,)."""
        left = np.arange(len(q))
        open_by = np.full(len(q), np.inf)
        before = np.full(len(q), np.inf)
        for _ in range(_MOST_NEWTON):
            residuals, C = self.equations(q[left])
            C = C[:, self.rows][..., self.passive]
            missing = residuals[:, self.rows]
            before[left] = open_by[left]
            open_by[left] = np.abs(missing).max(axis=1, initial=0.0)
            # Near the solution, a step without improvement has reached rounding.
            is_left = (open_by[left] > CLOSED) & (
                (open_by[left] > OF_LOOP.open) | (open_by[left] < 0.5 * before[left])
            )
            left = left[is_left]
            C = C[is_left]
            missing = missing[is_left]
            if not len(left):
                break
            q[left[:, None], self.passive] -= least_step(C, missing)
        return open_by

    @cached_property
    def _known(self) -> tuple[np.ndarray, np.ndarray, cKDTree, float]:
        """Positions of drivers, shape (K, d), and passive joints, shape (K, p), a search tree of
        the first, and the side.
        """
        from scipy.spatial import cKDTree

        start = self.assembled()
        low, high = (
            np.where(np.isfinite(limit), limit, side * np.pi)
            for limit, side in ((self.lower, -1), (self.upper, 1))
        )
        rng = np.random.default_rng(0)
        q = np.tile(start, (_KNOWN, 1))
        q[1:, self.drivers] = rng.uniform(low, high, (_KNOWN, len(low)))[1:, self.drivers]
        drivers, passive = (
            np.tile(start[places], (_KNOWN, 1)) for places in (self.drivers, self.passive)
        )
        found, is_closed, side = self._led(q, drivers, passive)
        found = found[is_closed & (side == side[0])]
        return (
            found[:, self.drivers],
            found[:, self.passive],
            cKDTree(found[:, self.drivers]),
            float(side[0]),
        )

    def assembled(self) -> np.ndarray:
        """Return joint positions with the loops closed as nearly as possible, shape (n,): zero, or
        the nearest ones.
        """
        q = np.zeros((1, len(self.lower)))
        if len(self.passive) and self._newton(q)[0] < OF_LOOP.open and np.abs(q).max() < np.pi:
            return np.asarray(q[0])
        moving = np.append(self.drivers, self.passive)
        return np.asarray(self.loosely_closed(np.zeros((1, len(self.lower))), moving)[0])

    def loosely_closed(self, q: np.ndarray, moving: np.ndarray) -> np.ndarray:
        """Return joint positions, shape (N, n), near others at which some joints close the loops as
        far as they can.
        """
        q = q.copy()
        for _ in range(_MOST_NEWTON):
            residuals, C = self.equations(q)
            step = _loose_step(C[..., moving], residuals)
            q[:, moving] -= step
            # Those that follow are no more than rounding.
            if np.abs(step).max(initial=0.0) < CLOSED:
                break
        return q


def _crossed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors, shape (N, 3); ``np.cross`` spends most on its axes."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def _loose_step(C: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return the steps of least length, shape (N, k), that close the gaps as far as joints can."""
    step = (np.linalg.pinv(C, rcond=OF_LOOP.still) @ missing[..., None])[..., 0]
    return np.asarray(
        step
        * np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-300))
    )


def least_step(C: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Return damped least-squares steps of bounded length, shape (N, k)."""
    A = C.swapaxes(1, 2) @ C
    A += (_DAMPING * (1.0 + np.trace(A, axis1=1, axis2=2)))[:, None, None] * np.eye(A.shape[1])
    step = np.linalg.solve(A, C.swapaxes(1, 2) @ missing[..., None])[..., 0]
    return np.asarray(
        step
        * np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-300))
    )
