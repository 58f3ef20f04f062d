"""Kinematics and static moments of a chain for numbers or symbols, one pose at a time; cf.
:mod:`pincal.model.kernels`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pincal.model.kernel_inputs import Layout
from pincal.model.symbols import Expression, Symbol, apply


class _Frame:
    """A frame that moves along the chain: rotation ``R``, shape (3, 3), and origin ``p``, shape
    (3,).
    """

    def __init__(self) -> None:
        self.R = np.eye(3).astype(object)
        self.p = np.zeros(3).astype(object)

    def apply(self, R: np.ndarray, p: np.ndarray | None = None) -> None:
        """Multiply by a fixed transform."""
        if p is not None:
            self.p = self.p + self.R @ p.astype(object)
        self.R = self.R @ R.astype(object)

    def step(self, kind: int, x: Expression) -> None:
        """Multiply by the transform of a coordinate."""
        axis = kind % 3
        if kind >= 3:
            self.p = self.p + self.R[:, axis] * x
        elif isinstance(x, Symbol) or x:
            j = (axis + 1) % 3
            k = (axis + 2) % 3
            c = apply("cos", x)
            s = apply("sin", x)
            R = self.R.copy()
            R[:, j] = self.R[:, j] * c + self.R[:, k] * s
            R[:, k] = self.R[:, k] * c - self.R[:, j] * s
            self.R = R


Axes = dict[int, tuple[np.ndarray, np.ndarray]]


def _walk(layout: Layout, x: Sequence[Expression], frame: _Frame, *, first: int, last: int) -> Axes:
    """Move a frame over the steps first .. last - 1 of the path; return axis and origin of each
    coordinate.

    Consecutive coordinates about one axis are a single step, as neither moves the axis of the
    other.
    """
    seen: Axes = {}
    step: Expression = 0.0
    route = layout.path
    for t in range(first, last):
        k = int(route.coordinate[t])
        sign = float(route.sign[t])
        kind = int(layout.kind[k])
        if route.fixed_before[t] >= 0:
            fixed = layout.fixed[route.fixed_before[t]]
            frame.apply(fixed[:, :3], fixed[:, 3])
        seen[k] = sign * frame.R[:, kind % 3], frame.p
        step = step + (_step(layout, x, k) if sign > 0.0 else -1.0 * _step(layout, x, k))
        following = t + 1
        if (
            following == last
            or layout.kind[route.coordinate[following]] != kind
            or route.fixed_before[following] >= 0
        ):
            frame.step(kind, step)
            step = 0.0
    return seen


def _step(layout: Layout, x: Sequence[Expression], k: int) -> Expression:
    return x[k] - x[layout.less[k]] if layout.less[k] >= 0 else x[k]


def tip_pose(
    layout: Layout, x: Sequence[Expression], tool_rotation: np.ndarray, drives: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the target's pose in the instrument's frame, shape (3, 4), and its velocities by n
    coordinates, shape (6, n).

    ``x`` are the chain's K coordinates, ``drives`` those of them by which it moves, such as those
    to which the joint positions are added, and ``tool_rotation``, shape (3, 3), is the reference
    orientation of the target.
    """
    S = len(layout.path.coordinate)
    frame = _Frame()
    seen = _walk(layout, x, frame, first=0, last=3)
    frame.apply(layout.base_rotation[0])
    seen |= _walk(layout, x, frame, first=3, last=S - 3)
    frame.apply(tool_rotation)
    seen |= _walk(layout, x, frame, first=S - 3, last=S)
    columns = []
    for k in drives:
        if k not in seen:
            columns.append(np.zeros(6, object))
            continue
        axis, origin = seen[k]
        slides = layout.kind[k] >= 3
        columns.append(
            np.concatenate([axis, 0.0 * axis] if slides else [_cross(axis, frame.p - origin), axis])
        )
    return np.column_stack([frame.R, frame.p]), np.column_stack(columns)


def _gravity(layout: Layout, x: Sequence[Expression]) -> dict[int, np.ndarray]:
    """Return gravity in the axes of the frame before each coordinate of the tree."""
    gravity = {}
    route = layout.tree
    behind = {-1: layout.gravity.astype(object)}
    for j in range(len(layout.masses)):
        g = behind[int(layout.parents[j])]
        for k in range(layout.starts[j], layout.starts[j + 1]):
            if route.fixed_before[k] >= 0:
                g = layout.fixed[route.fixed_before[k]][:, :3].T.astype(object) @ g
            gravity[k] = g
            g = _turned(g, int(layout.kind[k]), x[k], back=True) if layout.kind[k] < 3 else g
        behind[j] = g
    return gravity


def symbolic_moments(
    layout: Layout, x: Sequence[Expression], payload: Expression, payload_centre: np.ndarray
) -> list[Any]:
    """Return the static moments, components x, y, z of each joint in turn [N m].

    Gravity is propagated outwards from frame to frame, mass and first moment of mass inwards, each
    in the axes and about the origin of the current frame. ``x`` are the chain's K coordinates; the
    payload [kg] has its centre of mass, shape (3,), in the tip frame [m].
    """
    n = len(layout.masses)
    gravity = _gravity(layout, x)
    route = layout.tree
    flange = layout.fixed[layout.tip].astype(object)
    carried: dict[int, tuple[Any, Any]] = {
        layout.tip_joint: (
            payload,
            (flange[:, :3] @ payload_centre.astype(object) + flange[:, 3]) * payload,
        )
    }
    # The later of the two coordinates about whose axes a moment is taken.
    at = np.maximum(layout.moment_y, layout.moment_z)
    moments: list[Any] = []
    for j in reversed(range(n)):
        own = float(layout.masses[j])
        mass, first_moment = carried.pop(j, (0.0, np.zeros(3, object)))
        mass = mass + own
        first_moment = first_moment + layout.centres[j].astype(object) * own
        for k in reversed(range(layout.starts[j], layout.starts[j + 1])):
            first_moment = _turned(
                first_moment, int(layout.kind[k]), _step(layout, x, k), mass=mass
            )
            if k == at[j]:
                moments = [*_cross(first_moment, gravity[k]), *moments]
            if route.fixed_before[k] >= 0 and layout.parents[j] >= 0:
                fixed = layout.fixed[route.fixed_before[k]].astype(object)
                first_moment = fixed[:, :3] @ first_moment + fixed[:, 3] * mass
        parent = int(layout.parents[j])
        known = carried.get(parent, (0.0, np.zeros(3, object)))
        carried[parent] = known[0] + mass, known[1] + first_moment
    return moments


def _turned(
    vector: np.ndarray, kind: int, x: Expression, *, mass: Expression = 0.0, back: bool = False
) -> np.ndarray:
    """Return a vector in the axes before a coordinate from those after it, or ``back``.

    A first moment of mass, if its ``mass`` is given, is then about the origin before the
    coordinate.
    """
    i = kind % 3
    j = (kind + 1) % 3
    k = (kind + 2) % 3
    out = vector.copy()
    if kind >= 3:
        out[i] = vector[i] + mass * x
    elif isinstance(x, Symbol) or x:
        c = apply("cos", x)
        s = apply("sin", x)
        j, k = (k, j) if back else (j, k)
        out[j] = vector[j] * c - vector[k] * s
        out[k] = vector[j] * s + vector[k] * c
    return out


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product as an object array, which NumPy's would convert to numbers."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]], object
    )
