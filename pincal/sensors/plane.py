r"""Fixed planes of unknown pose: a probe touches them, or a dial gauge measures its distance from
them.

A plane is n.x = d in the robot's base frame; the probe's tip at x reads (n.x - d) / |n|, zero where
it touches. A ball of some radius and the sign of a dial are absorbed in d and n. The length of n is
arbitrary and constrained to 1.

Starts: with the nominal arm's poses (R_i, p_i) and the tip t on the tool, n.p_i + (n (x) t):R_i - d
= s r_i is linear in n, n (x) t, d and s up to one factor.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Self, final

import numpy as np

from pincal.errors import MeasurementError
from pincal.parameters import ANYWHERE, FRAME_SYMBOLS, Parameter
from pincal.robot.se3 import transform
from pincal.sensors.extrinsics import Extrinsics, by_target
from pincal.sensors.fields import Field, TableRows
from pincal.sensors.point_sensor import index_of, poor_groups, rows_of_new
from pincal.sensors.sensor import Block, Constraints, Excluded, Grouped, OwnParameters, Sensor
from pincal.sensors.sensor_numbers import PLAUSIBLE
from pincal.sensors.setup import Setup
from pincal.thresholds import Count, Scale

PLANE = Field("plane", ("plane",), "name")
_SYMBOLS = ("nx", "ny", "nz", "d")
# Tolerance of the length of a normal: tighter than measurements, and loose enough to let it rotate.
_LENGTH: Scale = 1e-5
# Alternations between planes and tips in the search for a start with few rows.
_ROUNDS: Count = 20


@dataclass(frozen=True)
class PlaneSensor(Sensor, OwnParameters, Grouped):
    """1D: the distance of the probe's tip from a plane.

    Attributes:
        planes: their names.
        index: shape (N,), each row's plane.
        reading: shape (N,) [m]; zero where the probe touches.
    """

    blocks: ClassVar[tuple[Block, ...]] = (Block("distance", "m", 1),)
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS[:3]
    base_symbols: ClassVar[tuple[str, ...]] = ()
    twist_rows: ClassVar[int] = 3
    per_row: ClassVar[tuple[str, ...]] = ("index", "reading")
    names_points: ClassVar[str | None] = "plane"
    deviation_end: ClassVar[str] = "the part across the plane"
    own_words: ClassVar[str] = "the unknown planes"
    needs_all_rows: ClassVar[bool] = False

    planes: tuple[str, ...]
    index: np.ndarray
    reading: np.ndarray

    @classmethod
    @final
    def of(cls, table: TableRows, setup: Setup) -> Self:
        """Return the readings of a table; refuse a plane with a known position, or that the setup
        does not have.
        """
        points = setup.named()
        index = index_of(table, points)
        if points.known[index].any():
            name = points.names[int(index[points.known[index]][0])]
            raise MeasurementError(
                f"{table.source}: plane {name!r} is one of the known points; a plane's "
                "pose is identified"
            )
        planes = tuple(name for name, place in points.places.items() if place is None)
        return cls(planes, points.slot[index], cls.read(table))

    @classmethod
    @abstractmethod
    def read(cls, table: TableRows) -> np.ndarray:
        """Return the readings of a table, shape (N,) [m]."""

    @property
    def own_parameters(self) -> tuple[Parameter, ...]:
        units = ("1", "1", "1", "m")
        both = list(zip(_SYMBOLS, units, strict=True))
        return tuple(
            Parameter(f"{name}.{s}", unit, "plane", 0.0, ANYWHERE)
            for name in self.planes
            for s, unit in both
        )

    @property
    def row_groups(self) -> np.ndarray:
        return self.index

    @final
    def facts(self, own: np.ndarray) -> Constraints:
        """Return the constraints that normals have the length 1."""
        normals = own.reshape(-1, 4)[:, :3]
        length = np.linalg.norm(normals, axis=1)
        jacobian = np.zeros((len(self.planes), 4, len(self.planes)))
        each = np.arange(len(self.planes))
        jacobian[each, :3, each] = normals / length[:, None]
        return Constraints(
            1.0 - length, jacobian.reshape(len(own), -1), np.full(len(self.planes), _LENGTH)
        )

    @final
    def unusable_rows(self) -> Iterator[Excluded]:
        """Yield planes with too few readings to do more than locate them."""
        fewest = PLAUSIBLE.per_plane
        rows, listed = poor_groups(np.array(self.planes)[self.index], fewest)
        reason = (
            f"are of a plane with fewer than {fewest} readings, which only determine its "
            f"pose ({listed})"
        )
        yield Excluded(rows, reason, f"{fewest} readings and more of a plane, in other poses")

    @classmethod
    @final
    def unscorable_rows(cls, table: TableRows, setup: Setup) -> Iterator[Excluded]:
        rows, listed = rows_of_new(table, setup)
        yield Excluded(
            rows,
            f"are of planes not used in the calibration ({listed})",
            "planes of the calibration",
        )

    def shifted(self, change: np.ndarray) -> Self:
        return replace(self, reading=self.reading + change[0])

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        _, length, height = self._heights(poses, own)
        return np.asarray(self.reading - height / length)[None]

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion across the plane, of the tip and of the plane."""
        normal, length, height = self._heights(poses, own)
        across = normal / length[:, None]
        moved = np.einsum("ni,pin->pn", across, motion)
        by_normal = poses[:, :, 3] / length[:, None] - (height / length**2)[:, None] * across
        by_plane = np.zeros((len(self.planes), 4, len(self)))
        rows = np.arange(len(self))
        by_plane[self.index, :3, rows] = by_normal
        by_plane[self.index, 3, rows] = -1.0 / length
        return np.concatenate([moved, by_plane.reshape(-1, len(self))])[:, None]

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        normal, length, _ = self._heights(poses, own)
        return np.asarray(residuals[0][:, None] * normal / length[:, None])

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield the planes through the tips, then with the probe at its best fit to all planes."""
        yield Extrinsics(
            np.eye(4), np.tile(np.eye(4), (n_targets, 1, 1)), self._through(tips[:, :, 3])
        )
        tools = transform(np.eye(3), self._probes(tips, target, n_targets))
        for _ in range(_ROUNDS):
            own = self._through(self._ends(tips, target, tools))
            normal, _, height = self._heights(tips, own)
            columns = by_target(np.einsum("ni,nij->nj", normal, tips[:, :, :3]), target, n_targets)
            solution = np.linalg.lstsq(columns, self.reading - height, rcond=None)[0]
            tools[:, :3, 3] = solution.reshape(n_targets, 3)
        yield Extrinsics(np.eye(4), tools, self._through(self._ends(tips, target, tools)))

    def unobservable(self) -> Iterator[str]:
        yield "planes determine only the relative geometry of the arm, not the pose of its base"
        yield (
            "planes of unknown pose do not determine the scale of the arm, which relies on "
            "its nominal lengths"
        )

    def _heights(
        self, poses: np.ndarray, own: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return each row's normal, shape (N, 3), its length and n.x - d, shape (N,) each."""
        plane = own.reshape(-1, 4)[self.index]
        normal = plane[:, :3]
        return (
            normal,
            np.linalg.norm(normal, axis=1),
            np.einsum("ni,ni->n", normal, poses[:, :, 3]) - plane[:, 3],
        )

    @staticmethod
    def _ends(tips: np.ndarray, target: np.ndarray, tools: np.ndarray) -> np.ndarray:
        return np.asarray(
            tips[:, :, 3] + np.einsum("nij,nj->ni", tips[:, :, :3], tools[target, :3, 3])
        )

    def _through(self, ends: np.ndarray) -> np.ndarray:
        """Return the planes at the measured distances from points, shape (N, 3), as shape (4
        planes,).
        """
        own = np.tile([0.0, 0.0, 1.0, 0.0], (len(self.planes), 1))
        for k in range(len(self.planes)):
            x = ends[self.index == k]
            reading = self.reading[self.index == k]
            found = []
            for sign in (1.0, -1.0) if len(x) else ():
                normal = np.zeros(3)
                for _ in range(_ROUNDS):
                    foot = x - sign * reading[:, None] * normal
                    axes = np.linalg.svd(foot - foot.mean(axis=0), full_matrices=False)[2]
                    side = float(axes[-1] @ normal)
                    normal = axes[-1] if side >= 0.0 else -axes[-1]
                d = float(foot.mean(axis=0) @ normal)
                miss = float(np.sum((x @ normal - d - sign * reading) ** 2))
                found.append((miss, np.append(sign * normal, sign * d)))
            own[k] = min(found, key=lambda each: each[0])[1] if found else own[k]
        return own.ravel()

    def _probes(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> np.ndarray:
        """Return the positions of the probes on the tool, shape (targets, 3), zero if no plane has
        enough rows.
        """
        total = np.zeros((n_targets, 3))
        count = 0
        for k in range(len(self.planes)):
            here = self.index == k
            p = tips[here, :, 3]
            reading = self.reading[here]
            products = by_target(tips[here, :, :3].reshape(-1, 9), target[here], n_targets)
            size = max(float(np.abs(p).max(initial=0.0)), 1e-12)
            A = np.hstack(
                [p / size, products, np.ones((len(p), 1))]
                + ([reading[:, None] / size] if reading.any() else [])
            )
            if len(A) <= A.shape[1]:
                continue
            null = np.linalg.eigh(A.T @ A)[1][:, 0]
            normal = null[:3] / size
            n_t = null[3 : 3 + 9 * n_targets].reshape(n_targets, 3, 3)
            total += (
                len(A) * np.einsum("c,tcd->td", normal, n_t) / max(float(normal @ normal), 1e-300)
            )
            count += len(A)
        return total / max(count, 1)


@dataclass(frozen=True)
class PlaneContactSensor(PlaneSensor):
    """1D: contact of the probe's tip with a plane."""

    kind: ClassVar[str] = "plane"
    is_of_joints: ClassVar[bool] = True
    fields: ClassVar[tuple[Field, ...]] = (PLANE,)

    @classmethod
    def read(cls, table: TableRows) -> np.ndarray:
        return np.zeros(len(table.rows))


@dataclass(frozen=True)
class GaugeSensor(PlaneSensor):
    """1D: reading of a dial gauge on the tool against a plane."""

    kind: ClassVar[str] = "gauge"
    fields: ClassVar[tuple[Field, ...]] = (PLANE, Field("gauge", ("gauge",), "length"))

    @classmethod
    def read(cls, table: TableRows) -> np.ndarray:
        return table.array("gauge")
