"""A custom sensor: a line laser on the tool that measures the distance to a plane of unknown pose.

The laser is mounted on the tool, roughly along its z axis; its position and direction are identified. The plane (a granite
table, a sheet of glass) is stationary and not vertical. A table has the joints and one column ``range``, the distance along
the beam [m]:

    pincal calibrate robot.urdf ranges.csv --plugin line_laser.py --out results

With m = (a, b, -1), the plane z = c + a x + b y in the robot's base frame satisfies c + m.x = 0, so that the beam from the
laser's position p along the unit vector d hits it at the range s = -(c + m.p) / (m.d).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.sensors.extrinsics import Extrinsics
from pincal.sensors.fields import POSITIVE, Field, TableRows
from pincal.sensors.registry import register_sensor
from pincal.sensors.sensor import Block, OwnParameters, Sensor
from pincal.sensors.setup import Setup

_ROUNDS = 20  # of the search for a start: plane, then laser, then plane ...


@register_sensor
@dataclass(frozen=True)
class LineLaser(Sensor, OwnParameters):
    """1D: the range, shape (N,) [m], from the laser to the plane along the tool's z axis."""

    kind: ClassVar[str] = "range"
    fields: ClassVar[tuple[Field, ...]] = (Field("range", ("range",), "length", POSITIVE),)
    blocks: ClassVar[tuple[Block, ...]] = (Block("range", "m", 1),)
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS[:5]  # All but the rotation about the beam.
    twist_rows: ClassVar[int] = 6
    per_row: ClassVar[tuple[str, ...]] = ("range",)
    deviation_end: ClassVar[str] = "the part across the plane"
    base_symbols: ClassVar[tuple[str, ...]] = ()  # The plane stands in the robot's base frame.
    own_words: ClassVar[str] = "the unknown plane"
    own_parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("plane.offset", "m", "plane", 0.0, float("inf")),
        Parameter("plane.slope_x", "1", "plane", 0.0, float("inf")),
        Parameter("plane.slope_y", "1", "plane", 0.0, float("inf")),
    )

    range: np.ndarray

    @classmethod
    def of(cls, table: TableRows, setup: Setup) -> Self:
        """Return the ranges of a table."""
        return cls(table.array("range"))

    def shifted(self, change: np.ndarray) -> Self:
        """Return ranges longer by ``change``, shape (1, N) [m]."""
        return replace(self, range=self.range + change[0])

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction, shape (1, N) [m]."""
        return (self.range - _hit(poses, own)[0])[None]

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the derivative of the range: ds = -(dc + dm.x + m.(dp + s dd)) / (m.d) at the point x that is hit."""
        s, towards = _hit(poses, own)
        d, m = poses[:, :, 2], _normal(own)
        x = poses[:, :, 3] + s[:, None] * d
        turned = np.cross(motion[:, 3:].transpose(0, 2, 1), d)
        moved = np.einsum("pin,i->pn", motion[:, :3], m) + s * np.einsum("pni,i->pn", turned, m)
        by_plane = np.stack([np.ones(len(s)), x[:, 0], x[:, 1]])
        return (-np.concatenate([moved, by_plane]) / towards)[:, None]

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the component normal to the plane."""
        return self.least_displacement(residuals, poses, own)

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield the plane through the points that the beams hit, with the lasers at the tip, then where they fit best."""
        tools = np.tile(np.eye(4), (n_targets, 1, 1))
        R, hits = tips[:, :, :3], tips[:, :, 3] + self.range[:, None] * tips[:, :, 2]
        for rounds in (1, _ROUNDS):
            for _ in np.arange(rounds):
                x = hits + np.einsum("nij,nj->ni", R, tools[target, :3, 3])
                columns = np.column_stack([np.ones(len(x)), x[:, 0], x[:, 1]])
                own = np.linalg.lstsq(columns, x[:, 2], rcond=None)[0]
                if rounds > 1:
                    m = _normal(own)
                    for t in range(n_targets):
                        here = target == t
                        lever, miss = np.einsum("i,nij->nj", m, R[here]), -own[0] - hits[here] @ m
                        tools[t, :3, 3] = np.linalg.lstsq(lever, miss, rcond=None)[0]
            yield Extrinsics(np.eye(4), tools.copy(), own)

    def unobservable(self) -> Iterator[str]:
        """Yield the quantities that a single plane does not determine."""
        yield "ranges to a plane do not determine the position of the base in the plane or its rotation about the normal"


def _normal(own: np.ndarray) -> np.ndarray:
    return np.array([own[1], own[2], -1.0])


def _hit(poses: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ranges, shape (N,) [m], and m.d, shape (N,)."""
    m = _normal(own)
    towards = poses[:, :, 2] @ m
    return -(own[0] + poses[:, :, 3] @ m) / towards, towards
