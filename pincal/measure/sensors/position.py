r"""Positions of a target, as a laser tracker measures a reflector.

Where it starts: with the nominal arm's poses (R_i, p_i) in the robot's base frame, base R, b and tool t,
m_i = R p_i + R R_i t + b is linear in R, b and the products R (x) t. With several targets there is one set of products each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Self, final

import numpy as np

from pincal.errors import MeasurementError, warn
from pincal.measure.extrinsics import Extrinsics, by_target, least_squares
from pincal.measure.fields import Field, TableRows
from pincal.measure.sensor import Additive, Block, Foreseeable, Plausible
from pincal.measure.setup import Setup
from pincal.parameters import FRAME_SYMBOLS
from pincal.robot.se3 import align, nearest_rotation, transform

# Share of the rows beyond the limits from which on the column, not the row, is at fault.
_MANY = 0.2
# Farthest distance of a target from the flange [m].
_TOOL_REACH_M = 2.0


def span_m(reach_m: float) -> float:
    """Return how far apart two targets can be at most [m], for a flange that reaches so far from the base."""
    return 2 * (reach_m + _TOOL_REACH_M)


def check_spread(table: TableRows, points: np.ndarray, *, label: str, reach_m: float) -> float:
    """Return the distance between (nearly) the farthest points [m]; refuse more than the arm can span.

    Args:
        table: the table, for messages.
        points: shape (N, k) [m].
        label: the column that a message names.
        reach_m: farthest distance of the flange from the base [m].

    Raises:
        MeasurementError: naming the unit that seems to be meant.
    """
    most = span_m(reach_m)
    from_centre = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    worst = int(from_centre.argmax())
    # From the farthest point on, the diameter is at most twice what this finds, and never less.
    spread = float(np.linalg.norm(points - points[worst], axis=1).max())
    if spread <= most:
        return spread
    text = f"{table.source}: values of {label} lie {spread:.4g} m apart; expected at most {most:.3g} m"
    is_unit = np.mean(from_centre > most) > _MANY and spread / 1000 <= most
    if is_unit and label not in table.units:
        raise MeasurementError(f"{text}; looks like millimetres: write `{label} [mm]` in the header, or their unit")
    raise MeasurementError(f"{text}; look at line {table.rows[worst]}, at the unit and at the robot's size")


# Pairs of axes.
_PAIRS = ((0, 1), (1, 2), (0, 2))


def _mirrored(positions: np.ndarray, *, axes: tuple[int, ...]) -> np.ndarray:
    """Return positions with two axes swapped, or one turned round."""
    found = positions.copy()
    found[:, axes] = positions[:, axes[::-1]] if len(axes) == 2 else -positions[:, axes]
    return found


# Positions alone can't tell which of these mirrors happened; with orientations they can.
_OR = "or the frame is left-handed"
_SWAPS = ((f"the columns {'xyz'[i]!r} and {'xyz'[j]!r} look swapped, {_OR}", (i, j)) for i, j in _PAIRS)
_TURNS = ((f"the column {axis!r} looks inverted in sign, {_OR}", (i,)) for i, axis in enumerate("xyz"))
POSITION = Field(
    "position",
    ("x", "y", "z"),
    "length",
    mistakes=tuple((words, partial(_mirrored, axes=axes)) for words, axes in (*_SWAPS, *_TURNS)),
    mirror=partial(_mirrored, axes=(1,)),
)

# Joints whose median range [rad, m] exceeds this move the target visibly.
_MOVED = 0.5
# A target that moves by less than this share of the reach does not take part in the motion of the arm.
_LEAST_SPREAD = 1e-3


class PlausiblePositions(Plausible):
    """Readings with a position, which is farther apart than the arm can span, or hardly moves, in a wrong unit."""

    @classmethod
    @final
    def check_plausible(cls, table: TableRows, reach_m: float) -> None:
        """Refuse positions farther apart than the arm can span, or much closer than the motion of its joints."""
        spread = check_spread(table, table.array("position"), label="x", reach_m=reach_m)
        if np.median(np.ptp(table.q, axis=0)) < _MOVED:
            return
        text = f"{table.source}: the joints move, but the positions stay within {spread * 1000:.3g} mm"
        unit = next((table.units[name] for name in POSITION.columns if name in table.units), "m")
        # Metres under [mm] shrink the whole workspace, at most as wide as the arm can span, a thousandfold.
        if unit != "m" and spread <= _LEAST_SPREAD * span_m(reach_m):
            raise MeasurementError(f"{text}; values in metres under `x [{unit}]`? Then write `x [m]` in the header")
        if spread < _LEAST_SPREAD * reach_m:
            warn(f"{text}; is the target held, or the instrument stuck?")


@dataclass(frozen=True)
class PositionSensor(PlausiblePositions, Additive, Foreseeable):
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
        """Return the positions of a table."""
        return cls(table.array("position"))

    @classmethod
    def foreseen(cls, poses: np.ndarray, places: np.ndarray | None = None) -> Self:
        """Return the positions of poses."""
        return cls(poses[:, :, 3])

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction, shape (3, N) [m]."""
        return np.asarray(self.position.T - poses[:, :, 3].T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion itself."""
        return motion

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the residual: a position tells all of it."""
        return residuals.T

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield the base laid onto the tips, then onto the targets, which the readings place on the tool if they can."""
        m, p, R = self.position, tips[:, :, 3], tips[:, :, :3]
        tools = np.tile(np.eye(4), (n_targets, 1, 1))
        columns = by_target(R.reshape(-1, 9), target, n_targets)
        solution, complete = least_squares(np.hstack([p, columns, np.ones((len(p), 1))]), m)
        rotation = nearest_rotation(solution[:3].T)
        for t in range(n_targets if complete else 0):
            products = solution[3 + 9 * t : 12 + 9 * t].T.reshape(3, 3, 3)  # [a, c, d] = R[a, c] t[d]
            tools[t, :3, 3] = np.einsum("ac,acd->d", rotation, products) / 3.0
        yield Extrinsics(transform(*align(p, m)), tools)
        if complete:
            ends = p + np.einsum("nij,nj->ni", R, tools[target, :3, 3])
            yield Extrinsics(transform(*align(ends, m)), tools)

    def unobservable(self) -> Iterator[str]:
        """Yield nothing: positions in general poses leave nothing open."""
        yield from ()
