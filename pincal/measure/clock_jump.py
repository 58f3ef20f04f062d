"""The likeliest jump of an instrument's clock in readings of an arm in motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pincal.measure.reading_numbers import JUMPS
from pincal.thresholds import Count, Scale

# Information of a block on the clock, relative to the best one, from which it is used.
_MOVES: Scale = 0.05
# Rows per block, most blocks, and iterations to find the row of a jump.
_BLOCK: Count = 40
_BLOCKS: Count = 40
_TURNS: Count = 5


@dataclass(frozen=True)
class Jump:
    """The jump of a clock that best explains the residuals.

    Attributes:
        size: time to be added to later stamps relative to earlier ones [s].
        sigma: standard deviation of the size, by the scatter between blocks [s].
        time: stamp of the first reading after it [s].
    """

    size: float
    sigma: float
    time: float

    def __str__(self) -> str:
        return (
            f"its clock, or that of the joints, jumps by about {1e3 * abs(self.size):.2g} ms at "
            f"{self.time:.6g} s of its stamps, as when a counted frame is lost, or a sample is "
            "missed by polling at nearly the rate of the device; give the parts before and after "
            "as separate sessions, or log the device's own stamps"
        )

    def is_sure(self, least: float) -> bool:
        """Return whether the jump is significant and larger than ``least`` [s]."""
        return abs(self.size) > max(least, JUMPS.significant * self.sigma)


def likeliest_jump(
    time: np.ndarray,
    residuals: np.ndarray,
    rate: np.ndarray,
    unexplained: Callable[[np.ndarray], np.ndarray],
) -> Jump:
    """Return the jump of a clock that best explains residuals, conditional on all other fitted
    parameters.

    Args:
        time: stamps, shape (N,) [s].
        residuals: of the readings, shape (N, m), in units of their noise.
        rate: derivatives of the readings by time, shape (N, m), in the same units [1/s].
        unexplained: projects columns, shape (N, m, K), onto the complement of the fitted parameters
            with offset and drift.
    """
    blocks = _blocks(time)
    # An arm at rest carries no information on a clock.
    squares = [float(np.sum(rate[block] ** 2)) for block in blocks]
    parts = [
        block for block, size in zip(blocks, squares, strict=True) if size > _MOVES * max(squares)
    ]
    if len(parts) < 2 * JUMPS.either_side:
        return Jump(0.0, np.inf, float(time.min(initial=np.inf)))
    residuals = unexplained(residuals[:, :, None])[:, :, 0]
    reach = float(np.ptp(time)) / len(parts)
    tried = np.array(
        [time[part[0]] for part in parts[JUMPS.either_side : len(parts) - JUMPS.either_side + 1]]
    )
    for _ in range(_TURNS):
        steps = unexplained(rate[:, :, None] * (time[:, None] >= tried)[:, None])
        known = np.maximum(np.sum(steps**2, axis=(0, 1)), 1e-9 * sum(squares))
        k = int(np.argmax(np.tensordot(residuals, steps, axes=((0, 1), (0, 1))) ** 2 / known))
        size = float(np.sum(residuals * steps[:, :, k]) / known[k])
        rest = residuals - size * steps[:, :, k]
        begins = float(tried[k])
        tried = _first_after(time, rest, size * rate, tried[k], reach)
        if tried[0] == begins:
            break
    # Residuals are independent between parts, not between readings.
    scatter = sum(
        float(np.sum(rate[part] * rest[part]) ** 2 / np.sum(rate[part] ** 2)) for part in parts
    )
    return Jump(size, float(np.sqrt(scatter / (len(parts) - 3) / known[k])), begins)


def _blocks(time: np.ndarray) -> list[np.ndarray]:
    """Return blocks of consecutive rows, in order of their stamps, shape (N,)."""
    count = min(max(len(time) // _BLOCK, 1), _BLOCKS)
    return np.array_split(np.argsort(time, kind="stable"), count)


def _first_after(
    time: np.ndarray, rest: np.ndarray, shift: np.ndarray, at: float, reach: float
) -> np.ndarray:
    """Return the stamp, shape (1,), of the first of the readings within a reach of a jump [s] that
    fits better after it.

    Residuals ``rest`` are those with the jump there; ``shift``, shape (N, m), is what it changes.
    """
    near = np.flatnonzero(np.abs(time - at) <= reach)
    near = near[np.argsort(time[near], kind="stable")]
    after = rest[near] - shift[near] * (time[near] < at)[:, None]
    gained = np.cumsum(np.sum((after + shift[near]) ** 2 - after**2, axis=1)[::-1])[::-1]
    return np.asarray(time[near[[int(np.argmax(gained))]]])
