"""The likeliest jump of an instrument's clock in readings of an arm in motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pincal.measure.reading_numbers import JUMPS
from pincal.thresholds import Count, Scale

# Information of a block on the clock, relative to those that tell most, from which it is used.
_MOVES: Scale = 0.05
# Rows per block, most blocks, and iterations to find the row of a jump.
_BLOCK: Count = 40
_BLOCKS: Count = 40
_TURNS: Count = 5
# Further jumps that are tried where one more makes none sure.
_AHEAD: Count = 2
OFTEN = (
    f"and so it does at more than {JUMPS.most} other times, which no step of a clock explains; log "
    "the device's own stamps"
)
"""What is said of more jumps than a clock has, behind one of them."""


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
            "missed by polling at nearly the rate of the device"
        )

    def is_sure(self, least: float) -> bool:
        """Return whether the jump is significant and larger than ``least`` [s]."""
        return abs(self.size) > max(least, JUMPS.significant * self.sigma)


Projection = Callable[[np.ndarray], np.ndarray]
"""Projects columns, shape (N, m, K), onto the complement of what is fitted."""


@dataclass(frozen=True)
class _Search:
    """A search for jumps of a clock, in readings that carry information on it.

    Attributes:
        time: stamps, shape (N,) [s].
        residuals: what the fitted parameters leave, shape (N, m), in units of their noise.
        rate: derivatives of the readings by time, shape (N, m), in the same units [1/s].
        unexplained: the projection.
        parts: rows of the blocks in which the arm moves.
        known: stamps of jumps that are among the fitted parameters [s].
    """

    time: np.ndarray
    residuals: np.ndarray
    rate: np.ndarray
    unexplained: Projection
    parts: list[np.ndarray]
    known: Sequence[float] = ()

    @classmethod
    def of(
        cls,
        time: np.ndarray,
        residuals: np.ndarray,
        rate: np.ndarray,
        unexplained: Projection,
        known: Sequence[float],
    ) -> _Search | None:
        """Return the search; None where too little of the motion tells of a clock."""
        blocks = _blocks(time)
        # An arm at rest carries no information on a clock.
        squares = [float(np.sum(rate[block] ** 2)) for block in blocks]
        pairs = zip(blocks, squares, strict=True)
        # Where the joints' clock steps, their path seems to tell more in a block or two.
        most = sorted(squares)[-min(JUMPS.either_side, len(squares))]
        parts = [block for block, size in pairs if size > _MOVES * most]
        if len(parts) < 2 * JUMPS.either_side:
            return None
        left = unexplained(residuals[:, :, None])[:, :, 0]
        return cls(time, left, rate, unexplained, parts, known)

    @property
    def reach(self) -> float:
        """Mean time between two blocks [s]."""
        return float(np.ptp(self.time)) / len(self.parts)

    def _columns(self, at: np.ndarray) -> np.ndarray:
        """Return what steps at stamps, shape (K,), add to the readings, projected, shape (N, m,
        K).
        """
        return self.unexplained(self.rate[:, :, None] * (self.time[:, None] >= at)[:, None])

    def best_with(self, others: Sequence[float]) -> float | None:
        """Return the stamp of the jump that, beside some others, explains most; None if there is no
        room for one more, as near to others as near to the ends.
        """
        ways = _orthonormal(self._columns(np.array(others)))

        def beside(columns: np.ndarray) -> np.ndarray:
            flat = columns.reshape(len(ways), -1)
            return np.asarray((flat - ways @ (ways.T @ flat)).reshape(columns.shape))

        left = beside(self.residuals[:, :, None])[:, :, 0]
        ends = self.parts[JUMPS.either_side : len(self.parts) - JUMPS.either_side + 1]
        tried = np.array([self.time[part[0]] for part in ends])
        apart = JUMPS.either_side * self.reach
        taken = (*others, *self.known)
        tried = tried[[all(abs(at - other) >= apart for other in taken) for at in tried]]
        if not len(tried):
            return None
        least = 1e-9 * float(np.sum(self.rate**2))
        for _ in range(_TURNS):
            steps = beside(self._columns(tried))
            known = np.maximum(np.sum(steps**2, axis=(0, 1)), least)
            along = np.tensordot(left, steps, axes=((0, 1), (0, 1)))
            k = int(np.argmax(along**2 / known))
            size = float(along[k] / known[k])
            rest = left - size * steps[:, :, k]
            begins = float(tried[k])
            tried = _first_after(self.time, rest, size * self.rate, tried[k], self.reach)
            if tried[0] == begins:
                break
        return begins

    def jumps(self, at: Sequence[float]) -> list[Jump]:
        """Return the jumps at some stamps, their sizes fitted together."""
        if not at:
            return []
        steps = self._columns(np.array(at))
        flat = steps.reshape(-1, len(at))
        gram = flat.T @ flat
        gram[np.diag_indices_from(gram)] += 1e-9 * float(np.sum(self.rate**2))
        covariance = np.linalg.inv(gram)
        sizes = covariance @ (flat.T @ self.residuals.ravel())
        rest = self.residuals - steps @ sizes
        # Residuals are independent between parts, not between readings.
        scatter = sum(
            float(np.sum(self.rate[part] * rest[part]) ** 2 / np.sum(self.rate[part] ** 2))
            for part in self.parts
        )
        spread = scatter / max(len(self.parts) - 2 - len(at), 1)
        sigma = np.sqrt(spread * np.diag(covariance))
        found = zip(sizes.tolist(), sigma.tolist(), at, strict=True)
        return [Jump(size, its, begins) for size, its, begins in found]

    def sure(self, at: Sequence[float], least: float) -> list[Jump]:
        """Return the jumps at some stamps without those that, beside the others, are not
        significant or smaller than ``least`` [s].
        """
        kept = list(at)
        while kept:
            found = self.jumps(kept)
            if all(jump.is_sure(least) for jump in found):
                return found
            weakest = min(found, key=lambda jump: abs(jump.size) / jump.sigma)
            small = min(found, key=lambda jump: abs(jump.size))
            kept.remove((weakest if not weakest.is_sure(0.0) else small).time)
        return []


def sure_jumps(
    time: np.ndarray,
    residuals: np.ndarray,
    rate: np.ndarray,
    unexplained: Projection,
    least: float,
    known: Sequence[float] = (),
) -> list[Jump]:
    """Return the jumps of a clock that are significant beside each other and larger than ``least``
    [s], in the order of time.

    Several jumps may hide each other, as two of one sign between which the clock seems to drift.
    The search goes on until some more jumps make none sure. Further arguments as for
    :func:`likeliest_jump`. There are at most one more than a clock may have.
    """
    search = _Search.of(time, residuals, rate, unexplained, known)
    found = list[Jump]()
    if search is None:
        return found
    tried = list[float]()
    while len(tried) <= len(found) + _AHEAD and len(found) <= JUMPS.most:
        more = search.best_with(tried)
        if more is None:
            break
        tried.append(more)
        sure = search.sure(tried, least)
        if len(sure) > len(found):
            found = sure
            tried = [jump.time for jump in sure]
    return sorted(found, key=lambda jump: jump.time)


def likeliest_jump(
    time: np.ndarray,
    residuals: np.ndarray,
    rate: np.ndarray,
    unexplained: Projection,
    known: Sequence[float] = (),
) -> Jump:
    """Return the jump of a clock that best explains residuals, conditional on all other fitted
    parameters.

    Args:
        time: stamps, shape (N,) [s].
        residuals: of the readings, shape (N, m), in units of their noise.
        rate: derivatives of the readings by time, shape (N, m), in the same units [1/s].
        unexplained: projects columns, shape (N, m, K), onto the complement of the fitted parameters
            with offset and drift.
        known: stamps of jumps that are among the fitted parameters [s]; others are apart from them.
    """
    search = _Search.of(time, residuals, rate, unexplained, known)
    at = None if search is None else search.best_with([])
    if search is None or at is None:
        return Jump(0.0, np.inf, float(time.min(initial=np.inf)))
    (found,) = search.jumps([at])
    return found


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of columns, shape (N, m, K), as (N m, K)."""
    return np.linalg.qr(columns.reshape(columns.shape[0] * columns.shape[1], -1))[0]


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
