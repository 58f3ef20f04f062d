r"""Poses of a target: its position and its orientation.

Where it starts: R_m,i = R R_i X with base R and tool X is a homogeneous linear system in R and X^T; then the positions of
base and tool are linear.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from pincal.measure.extrinsics import RANK, Extrinsics, by_target
from pincal.measure.fields import Field, Rule, Table
from pincal.measure.sensor import Block, Foreseeable, Sensor
from pincal.measure.sensors.position import POSITION, PlausiblePositions
from pincal.measure.setup import Setup
from pincal.measure.turns import turned, turns
from pincal.parameters import FRAME_SYMBOLS
from pincal.robot.se3 import exponentials, nearest_rotation, rotation_matrices, transform

# A quaternion written with four decimals is off by less; a wrong column is off by more.
_TOLERANCE = 0.01
QUATERNION = Field(
    "quaternion",
    ("qx", "qy", "qz", "qw"),
    "number",
    Rule(f"norm 1 within {_TOLERANCE:.0%}", lambda value: np.abs(np.linalg.norm(value, axis=1) - 1) <= _TOLERANCE),
    is_unit=True,
    mistakes=(
        ("the quaternion looks written with w first", lambda value: value[:, [1, 2, 3, 0]]),
        ("the quaternion looks that of the inverse rotation", lambda value: value * [-1.0, -1.0, -1.0, 1.0]),
        (
            "the quaternion looks written with w first, and that of the inverse rotation",
            lambda value: value[:, [1, 2, 3, 0]] * [-1.0, -1.0, -1.0, 1.0],
        ),
    ),
    # A mirror keeps the axis of a rotation as a vector and turns the angle round.
    mirror=lambda value: value * [-1.0, 1.0, -1.0, 1.0],
)


@dataclass(frozen=True)
class PoseSensor(PlausiblePositions, Sensor, Foreseeable):
    """6D: position, shape (N, 3) [m], and orientation, shape (N, 3, 3), of the tool in the instrument's frame."""

    kind: ClassVar[str] = "pose"
    fields: ClassVar[tuple[Field, ...]] = (POSITION, QUATERNION)
    blocks: ClassVar[tuple[Block, ...]] = (Block("position", "m", 3), Block("orientation", "rad", 3))
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS
    base_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS
    twist_rows: ClassVar[int] = 6
    per_row: ClassVar[tuple[str, ...]] = ("position", "rotation")
    reads_pose: ClassVar[bool] = True

    position: np.ndarray
    rotation: np.ndarray

    @classmethod
    def of(cls, table: Table, setup: Setup) -> Self:
        """Return the poses of a table."""
        return cls(table.array("position"), rotation_matrices(table.array("quaternion")))

    @classmethod
    def foreseen(cls, poses: np.ndarray, places: np.ndarray | None = None) -> Self:
        """Return the poses themselves."""
        return cls(poses[:, :, 3], poses[:, :, :3])

    def shifted(self, change: np.ndarray) -> Self:
        """Return poses moved by ``change``, shape (6, N) [m, rad]; exact to first order in the rotation."""
        return replace(self, position=self.position + change[:3].T, rotation=exponentials(change[3:].T) @ self.rotation)

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return position [m] and the rotation vector from predicted to measured orientation [rad], shape (6, N)."""
        return np.vstack([self.position.T - poses[:, :, 3].T, turns(self.rotation, poses)])

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion; the rotation through the inverse right Jacobian of the rotation vector."""
        return np.asarray(turned(turns(self.rotation, poses), motion))

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the residual of the position."""
        return residuals[:3].T

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield base and tools as the orientations, then the positions, have them."""
        tools = np.tile(np.eye(4), (n_targets, 1, 1))
        blocks = np.zeros((9 + 9 * n_targets, 9 + 9 * n_targets))
        for t in range(n_targets):
            here = target == t
            A = _rotation_equations(tips[here, :, :3], self.rotation[here])
            places = np.r_[0:9, 9 + 9 * t : 18 + 9 * t]
            blocks[np.ix_(places, places)] += A.T @ A
        null = np.linalg.eigh(blocks)[1][:, 0]
        base = null[:9].reshape(3, 3)
        sign = np.sign(np.linalg.det(base))
        rotation = nearest_rotation(sign * base)
        for t in range(n_targets):
            tools[t, :3, :3] = nearest_rotation(sign * null[9 + 9 * t : 18 + 9 * t].reshape(3, 3)).T
        lever = by_target(np.einsum("ab,nbc->nac", rotation, tips[:, :, :3]), np.asarray(target), n_targets)
        ones = np.tile(np.eye(3), (len(tips), 1, 1))
        A = np.concatenate([ones, lever], axis=2).reshape(3 * len(tips), -1)
        solution = np.linalg.lstsq(A, (self.position - tips[:, :, 3] @ rotation.T).ravel(), rcond=RANK)[0]
        for t in range(n_targets):
            tools[t, :3, 3] = solution[3 + 3 * t : 6 + 3 * t]
        yield Extrinsics(transform(rotation, solution[:3]), tools)

    def unobservable(self) -> Iterator[str]:
        """Yield nothing: poses leave nothing open."""
        yield from ()


def _rotation_equations(tips: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Rows of R R_i - R_m,i Y = 0 in the unknowns R and Y = X^T, each row-major, shape (9 N, 18)."""
    eye = np.eye(3)
    left = np.einsum("ac,ndb->nabcd", eye, tips)  # d(R R_i)[a, b] / d R[c, d]
    right = -np.einsum("nac,bd->nabcd", measured, eye)  # d(R_m Y)[a, b] / d Y[c, d]
    return np.concatenate([left.reshape(-1, 9), right.reshape(-1, 9)], axis=1)
