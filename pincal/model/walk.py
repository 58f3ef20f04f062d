"""The walk along a chain whose coordinates are numbers or symbols, one pose at a time: the compiled loops as formulas.

The mathematics is that of :mod:`pincal.model.kernels`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pincal.model.kernels import BLOCK, FRAME, Layout
from pincal.model.symbols import Symbol, apply

Number = float | Symbol


class _Frame:
    """A frame that moves along the chain: rotation ``R``, shape (3, 3), and origin ``p``, shape (3,)."""

    def __init__(self) -> None:
        self.R = np.eye(3).astype(object)
        self.p = np.zeros(3).astype(object)

    def apply(self, R: np.ndarray, p: np.ndarray | None = None) -> None:
        """Go on by a fixed transform."""
        if p is not None:
            self.p = self.p + self.R @ p.astype(object)
        self.R = self.R @ R.astype(object)

    def step(self, kind: int, x: Number) -> None:
        """Go on by a coordinate."""
        axis = kind % 3
        if kind >= 3:
            self.p = self.p + self.R[:, axis] * x
        elif isinstance(x, Symbol) or x:
            j, k = (axis + 1) % 3, (axis + 2) % 3
            c, s, R = apply("cos", x), apply("sin", x), self.R.copy()
            R[:, j], R[:, k] = self.R[:, j] * c + self.R[:, k] * s, self.R[:, k] * c - self.R[:, j] * s
            self.R = R


Axes = dict[int, tuple[np.ndarray, np.ndarray]]


def _walk(layout: Layout, x: Sequence[Number], frame: _Frame, *, first: int, last: int) -> Axes:
    """Move a frame over the coordinates first .. last - 1; return axis and origin of each.

    Coordinates about one axis that follow each other are one step: neither moves the axis of the other.
    """
    seen: Axes = {}
    step: Number = 0.0
    for k in range(first, last):
        kind = int(layout.kind[k])
        if layout.fixed_before[k] >= 0:
            fixed = layout.fixed[layout.fixed_before[k]]
            frame.apply(fixed[:, :3], fixed[:, 3])
        seen[k] = frame.R[:, kind % 3], frame.p
        step = step + x[k]
        if k + 1 == last or layout.kind[k + 1] != kind or layout.fixed_before[k + 1] >= 0:
            frame.step(kind, step)
            step = 0.0
    return seen


def tip_pose(
    layout: Layout, x: Sequence[Number], tool_rotation: np.ndarray, drives: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the target's pose in the instrument's frame, shape (3, 4), and how the joints move and turn it, (6, n).

    Args:
        layout: the chain.
        x: its K coordinates.
        tool_rotation: shape (3, 3), the reference orientation of the target.
        drives: the coordinates that the joint positions add to.
    """
    K, frame = len(x), _Frame()
    _walk(layout, x, frame, first=0, last=3)
    frame.apply(layout.base_rotation[0])
    seen = _walk(layout, x, frame, first=3, last=K - 3)
    frame.apply(tool_rotation)
    _walk(layout, x, frame, first=K - 3, last=K)
    columns = []
    for k in drives:
        axis, origin = seen[k]
        slides = layout.kind[k] >= 3
        columns.append(np.concatenate([axis, 0.0 * axis] if slides else [_cross(axis, frame.p - origin), axis]))
    return np.column_stack([frame.R, frame.p]), np.column_stack(columns)


def static_moments(layout: Layout, x: Sequence[Number], payload: Number, payload_centre: np.ndarray) -> list[Any]:
    """Return the static moments, components x, y, z of each joint in turn [N m].

    Args:
        layout: the chain.
        x: its K coordinates.
        payload: mass beyond the last link [kg].
        payload_centre: shape (3,), its centre of mass in the tip frame [m].
    """
    n, frame, g = len(layout.masses), _Frame(), layout.gravity.astype(object)
    bodies, axes = [], []
    for j in range(n):
        first = FRAME + j * BLOCK
        seen = _walk(layout, x, frame, first=first, last=first + BLOCK)
        y, z = seen[layout.moment_y[j]][0], seen[layout.moment_z[j]][0]
        axes.append((seen[first][1], (_cross(y, z), y, z)))
        own = float(layout.masses[j])
        bodies.append((own, (frame.p + frame.R @ layout.centres[j].astype(object)) * own))
    flange = layout.fixed[layout.fixed_before[FRAME + n * BLOCK]]
    frame.apply(flange[:, :3], flange[:, 3])
    mass: Number = payload
    first_moment = (frame.p + frame.R @ payload_centre.astype(object)) * payload
    moments: list[Any] = []
    for (own, place), (origin, frame_axes) in zip(bodies[::-1], axes[::-1], strict=True):
        mass, first_moment = mass + own, first_moment + place
        turning = _cross(first_moment - origin * mass, g)
        moments = [*(axis @ turning for axis in frame_axes), *moments]
    return moments


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the vector product as symbols; NumPy's makes numbers of arrays that hold none."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]], object)
