"""Poses of a target: its position and its orientation.

Where it starts: R_m,i = R R_i X with base R and tool X is a homogeneous linear system in R and X^T;
then the positions of base and tool are linear.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Self, final

import numpy as np

from pincal.compiled import compiled
from pincal.errors import MeasurementError, warn
from pincal.parameters import FRAME_SYMBOLS
from pincal.robot.se3 import align, exponentials, nearest_rotation, rotation_matrices, transform
from pincal.sensors.extrinsics import RANK, Extrinsics, by_target, least_squares
from pincal.sensors.fields import Field, Rule, TableRows
from pincal.sensors.sensor import Additive, Block, Plausible, Sensor, Simulatable
from pincal.sensors.sensor_numbers import PLAUSIBLE
from pincal.sensors.setup import Setup
from pincal.thresholds import Count, Scale

# Residuals of a start, relative to the least of any, below which no other start is tried.
_AS_GOOD: Scale = 2.0


def span_m(reach_m: float) -> float:
    """Return the largest distance of two targets [m], for the reach of the flange from the base."""
    return 2 * (reach_m + PLAUSIBLE.tool_reach)


def check_spread(table: TableRows, points: np.ndarray, *, label: str, reach_m: float) -> float:
    """Return the approximate diameter of points, shape (N, k) [m]; refuse more than the arm can
    span.

    A message names the column ``label``, and the unit that seems to be meant.
    """
    most = span_m(reach_m)
    from_centre = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    worst = int(from_centre.argmax())
    # The diameter is between this and twice this.
    spread = float(np.linalg.norm(points - points[worst], axis=1).max())
    if spread <= most:
        return spread
    text = (
        f"{table.source}: values of {label} lie {spread:.4g} m apart; expected at most {most:.3g} m"
    )
    is_unit = np.mean(from_centre > most) > PLAUSIBLE.column_at_fault and spread / 1000 <= most
    if is_unit and label not in table.units:
        raise MeasurementError(
            f"{text}; looks like millimetres: write `{label} [mm]` in the header, or their unit"
        )
    raise MeasurementError(f"{text}; check line {table.rows[worst]}, the unit and the robot's size")


def _mirrored(positions: np.ndarray, *, axes: tuple[int, ...]) -> np.ndarray:
    """Return positions with two axes swapped, or one reversed."""
    found = positions.copy()
    found[:, axes] = positions[:, axes[::-1]] if len(axes) == 2 else -positions[:, axes]
    return found


# Positions alone do not distinguish these reflections; orientations do.
_OR = "or the frame is left-handed"
_SWAPS = (
    (f"the columns {'xyz'[i]!r} and {'xyz'[j]!r} appear to be swapped, {_OR}", (i, j))
    for i, j in ((0, 1), (1, 2), (0, 2))
)
_TURNS = (
    (f"the column {axis!r} appears to have the wrong sign, {_OR}", (i,))
    for i, axis in enumerate("xyz")
)
POSITION = Field(
    "position",
    ("x", "y", "z"),
    "length",
    mistakes=tuple((words, partial(_mirrored, axes=axes)) for words, axes in (*_SWAPS, *_TURNS)),
    mirror=partial(_mirrored, axes=(1,)),
)


class PlausiblePositions(Plausible):
    """Readings with positions, which exceed the span of the arm, or hardly move, in a
    wrong unit.
    """

    @classmethod
    @final
    def check_plausible(cls, table: TableRows, reach_m: float) -> None:
        spread = check_spread(table, table.array("position"), label="x", reach_m=reach_m)
        if np.median(np.ptp(table.q, axis=0)) < PLAUSIBLE.moved:
            return
        text = (
            f"{table.source}: the joints move, but the positions stay within {spread * 1000:.3g} mm"
        )
        unit = next((table.units[name] for name in POSITION.columns if name in table.units), "m")
        # Metres under [mm] shrink the whole workspace by a factor of 1000.
        if unit != "m" and spread <= PLAUSIBLE.least_spread * span_m(reach_m):
            raise MeasurementError(
                f"{text}; values in metres under `x [{unit}]`? Then write `x [m]` in the header"
            )
        if spread < PLAUSIBLE.least_spread * reach_m:
            warn(f"{text}; is the target held in place, or has the instrument frozen?")


@dataclass(frozen=True)
class PositionSensor(PlausiblePositions, Additive, Simulatable):
    """3D: the position of the target, shape (N, 3) [m], in the instrument's frame."""

    kind: ClassVar[str] = "position"
    fields: ClassVar[tuple[Field, ...]] = (POSITION,)
    blocks: ClassVar[tuple[Block, ...]] = (Block("position", "m", 3),)
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS[:3]
    base_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS
    twist_rows: ClassVar[int] = 3
    per_row: ClassVar[tuple[str, ...]] = ("position",)
    reads_pose: ClassVar[bool] = True

    position: np.ndarray

    @classmethod
    def of(cls, table: TableRows, setup: Setup) -> Self:
        return cls(table.array("position"))

    @classmethod
    def simulated(cls, poses: np.ndarray, places: np.ndarray | None = None) -> Self:
        return cls(poses[:, :, 3])

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.asarray(self.position.T - poses[:, :, 3].T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        return motion

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return residuals.T

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield the base fitted to the tips, then to the targets, if the readings determine their
        positions on the tool; only the latter where no placement leaves much less.
        """
        m = self.position
        p = tips[:, :, 3]
        R = tips[:, :, :3]
        tools = np.tile(np.eye(4), (n_targets, 1, 1))
        columns = by_target(R.reshape(-1, 9), target, n_targets)
        A = np.hstack([p, columns, np.ones((len(p), 1))])
        solution, complete = least_squares(A, m)
        if complete:
            tools[:, :3, 3] = _offsets(solution)
        ends = p + np.einsum("nij,nj->ni", R, tools[target, :3, 3])
        to_targets = transform(*align(ends, m))
        left = ends @ to_targets[:3, :3].T + to_targets[:3, 3] - m
        # Every placement solves the linear system, too, so none leaves less than its solution.
        least = A @ solution - m
        is_best = complete and np.linalg.norm(left) < _AS_GOOD * np.linalg.norm(least)
        if not is_best:
            yield Extrinsics(transform(*align(p, m)), tools)
        if complete:
            yield Extrinsics(to_targets, tools)

    def unobservable(self) -> Iterator[str]:
        yield from ()


def _offsets(solution: np.ndarray) -> np.ndarray:
    """Return the positions of T targets on the tool, shape (T, 3), that solve the linear system of
    :meth:`PositionSensor.starts`, whose unknowns are the base's rotation R, the products of R with
    these, and the base's position, shape (4 + 9 T, 3).
    """
    rotation = nearest_rotation(solution[:3].T)
    # Products [t, c, d, a] = R[a, c] offset[t, d].
    products = solution[3:-1].reshape(-1, 3, 3, 3)
    return np.asarray(np.einsum("ac,tcda->td", rotation, products) / 3.0)


QUATERNION = Field(
    "quaternion",
    ("qx", "qy", "qz", "qw"),
    "number",
    Rule(
        f"norm 1 within {PLAUSIBLE.norm:.0%}",
        lambda value: np.abs(np.linalg.norm(value, axis=1) - 1) <= PLAUSIBLE.norm,
    ),
    is_unit=True,
    mistakes=(
        ("the quaternion appears to be written with w first", lambda value: value[:, [1, 2, 3, 0]]),
        ("the quaternion appears to be inverted", lambda value: value * [-1.0, -1.0, -1.0, 1.0]),
        (
            "the quaternion appears to be inverted and written with w first",
            lambda value: value[:, [1, 2, 3, 0]] * [-1.0, -1.0, -1.0, 1.0],
        ),
    ),
    # A reflection reverses the axis of a rotation as a pseudovector.
    mirror=lambda value: value * [-1.0, 1.0, -1.0, 1.0],
)


@dataclass(frozen=True)
class PoseSensor(PlausiblePositions, Sensor, Simulatable):
    """6D: position, shape (N, 3) [m], and orientation, shape (N, 3, 3), of the tool in the
    instrument's frame.
    """

    kind: ClassVar[str] = "pose"
    fields: ClassVar[tuple[Field, ...]] = (POSITION, QUATERNION)
    blocks: ClassVar[tuple[Block, ...]] = (
        Block("position", "m", 3),
        Block("orientation", "rad", 3),
    )
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS
    base_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS
    twist_rows: ClassVar[int] = 6
    per_row: ClassVar[tuple[str, ...]] = ("position", "rotation")
    reads_pose: ClassVar[bool] = True

    position: np.ndarray
    rotation: np.ndarray

    @classmethod
    def of(cls, table: TableRows, setup: Setup) -> Self:
        return cls(table.array("position"), rotation_matrices(table.array("quaternion")))

    @classmethod
    def simulated(cls, poses: np.ndarray, places: np.ndarray | None = None) -> Self:
        return cls(poses[:, :, 3], poses[:, :, :3])

    def shifted(self, change: np.ndarray) -> Self:
        """Return poses moved by ``change``, shape (6, N) [m, rad]; exact to first order in the
        rotation.
        """
        return replace(
            self,
            position=self.position + change[:3].T,
            rotation=exponentials(change[3:].T) @ self.rotation,
        )

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return position [m] and the rotation vector from predicted to measured orientation [rad],
        shape (6, N).
        """
        return np.vstack([self.position.T - poses[:, :, 3].T, turns(self.rotation, poses)])

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion; the rotation through the inverse right Jacobian of the rotation
        vector.
        """
        return np.asarray(turned(turns(self.rotation, poses), motion))

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        return residuals[:3].T

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield base and tools, with rotations by the orientations, then translations by the
        positions.
        """
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
        lever = by_target(
            np.einsum("ab,nbc->nac", rotation, tips[:, :, :3]), np.asarray(target), n_targets
        )
        ones = np.tile(np.eye(3), (len(tips), 1, 1))
        A = np.concatenate([ones, lever], axis=2).reshape(3 * len(tips), -1)
        solution = np.linalg.lstsq(
            A, (self.position - tips[:, :, 3] @ rotation.T).ravel(), rcond=RANK
        )[0]
        for t in range(n_targets):
            tools[t, :3, 3] = solution[3 + 3 * t : 6 + 3 * t]
        yield Extrinsics(transform(rotation, solution[:3]), tools)

    def unobservable(self) -> Iterator[str]:
        yield from ()


def _rotation_equations(tips: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the rows of R R_i - R_m,i Y = 0 in the unknowns R and Y = X^T, each row-major, shape
    (9 N, 18).
    """
    eye = np.eye(3)
    left = np.einsum("ac,ndb->nabcd", eye, tips)  # d(R R_i)[a, b] / d R[c, d]
    right = -np.einsum("nac,bd->nabcd", measured, eye)  # d(R_m Y)[a, b] / d Y[c, d]
    return np.concatenate([left.reshape(-1, 9), right.reshape(-1, 9)], axis=1)


# Angle below which series are exact to rounding [rad].
_SMALL: Scale = 1e-3
# Poses processed at once, so that their data fit into the cache.
_TILE: Count = 512


@compiled(nogil=True)
def turns(measured: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return the rotation vectors from predicted to measured orientations, shape (3, N) [rad].

    Args:
        measured: shape (N, 3, 3), rotation matrices.
        poses: shape (N, 3, 4), predicted rotations and translations.

    By quaternions, whose largest element is found first (Shepperd 1978).
    """
    n = len(measured)
    out = np.empty((3, n))
    R = np.empty((3, 3))
    q = np.empty(4)
    for k in range(n):
        for i in range(3):
            for j in range(3):
                R[i, j] = (
                    measured[k, i, 0] * poses[k, j, 0]
                    + measured[k, i, 1] * poses[k, j, 1]
                    + measured[k, i, 2] * poses[k, j, 2]
                )
        trace = R[0, 0] + R[1, 1] + R[2, 2]
        a = 0
        for i in range(1, 3):
            if R[i, i] > R[a, a]:
                a = i
        b = (a + 1) % 3
        c = (a + 2) % 3
        if trace >= R[a, a]:
            q[0] = R[2, 1] - R[1, 2]
            q[1] = R[0, 2] - R[2, 0]
            q[2] = R[1, 0] - R[0, 1]
            q[3] = 1.0 + trace
        else:
            q[a] = 1.0 - trace + 2.0 * R[a, a]
            q[b] = R[b, a] + R[a, b]
            q[c] = R[c, a] + R[a, c]
            q[3] = R[c, b] - R[b, c]
        if q[3] < 0.0:
            for i in range(4):
                q[i] = -q[i]
        size = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
        norm = np.sqrt(size**2 + q[3] ** 2)
        angle = 2.0 * np.arctan2(size, q[3])
        scale = (
            angle / size
            if angle > _SMALL
            else (2.0 + angle**2 / 12.0 + 7.0 * angle**4 / 2880.0) / norm
        )
        for i in range(3):
            out[i, k] = scale * q[i]
    return out


@compiled(nogil=True)
def turned(turn: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Return motions, shape (D, 6, N), with rotations converted to changes of rotation vectors
    ``turn``, shape (3, N).

    These are by the inverse right Jacobian: log(exp(phi) exp(-w)) = phi - J_r^-1 w + O(w^2) [Sola
    et al. 2018, Eq. 144].
    """
    n_columns, _, n = motion.shape
    out = np.empty(motion.shape)
    rows = np.empty((3, 3, _TILE))
    for first in range(0, n, _TILE):
        end = min(first + _TILE, n)
        for k in range(first, end):
            x = turn[0, k]
            y = turn[1, k]
            z = turn[2, k]
            angle2 = x * x + y * y + z * z
            angle = np.sqrt(angle2)
            if angle < _SMALL:
                factor = 1.0 / 12.0 + angle2 / 720.0
            else:
                factor = 1.0 / angle2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
            i = k - first
            rows[0, 0, i] = 1.0 - factor * (y * y + z * z)
            rows[1, 1, i] = 1.0 - factor * (x * x + z * z)
            rows[2, 2, i] = 1.0 - factor * (x * x + y * y)
            rows[0, 1, i] = factor * x * y - 0.5 * z
            rows[1, 0, i] = factor * x * y + 0.5 * z
            rows[0, 2, i] = factor * x * z + 0.5 * y
            rows[2, 0, i] = factor * x * z - 0.5 * y
            rows[1, 2, i] = factor * y * z - 0.5 * x
            rows[2, 1, i] = factor * y * z + 0.5 * x
        for d in range(n_columns):
            # Loops over slices are vectorised; a slice assigned at once takes seconds to compile.
            for i in range(3):
                own = motion[d, i, first:end]
                kept = out[d, i, first:end]
                for k in range(len(kept)):
                    kept[k] = own[k]
            u = motion[d, 3, first:end]
            v = motion[d, 4, first:end]
            w = motion[d, 5, first:end]
            for i in range(3):
                a = rows[i, 0]
                b = rows[i, 1]
                c = rows[i, 2]
                to = out[d, 3 + i, first:end]
                for k in range(len(to)):
                    to[k] = a[k] * u[k] + b[k] * v[k] + c[k] * w[k]
    return out
