"""Whether joint columns can be a robot's by its limits: in the right unit, and in the right places.

Three kinds of hypotheses are tried where positions lie beyond the limits. With the right one undone
all of them are inside: a column in degrees or millimetres, two columns exchanged, and, which is no
mistake, a joint that reports the sum or difference of its position and its neighbour's, as coupled
drives do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from pincal.errors import MeasurementError, counted, warn
from pincal.hypotheses.hypothesis import Hypothesis, exchange_order, explaining
from pincal.measure.column_numbers import JOINT_COLUMNS
from pincal.measure.measurements import Measurements
from pincal.thresholds import Count, Scale
from pincal.units import SIZES

_Columns = Hypothesis[np.ndarray]
# Steps in which positions are written, largest first [rad]; what they may be off in parts of one,
# and the digits by which two are told apart.
_STEPS: tuple[Scale, ...] = (
    np.deg2rad(1.0),
    0.01,
    np.deg2rad(0.1),
    1e-3,
    np.deg2rad(0.01),
)
_OF_STEP: Scale = 1e-3
_DIGITS: Count = 9
# Positions that show of nearly every joint that it is not rounded.
_FIRST: Count = 8


@dataclass(frozen=True, eq=False)
class JointColumns:
    """The joint columns of a table, and the limits of the joints.

    Attributes:
        table: N rows of n joints.
        low: lower limits [rad], prismatic [m], shape (n,); -inf without a limit.
        high: upper limits, likewise.
        slides: which joints are prismatic, shape (n,).
    """

    table: Measurements
    low: np.ndarray
    high: np.ndarray
    slides: np.ndarray

    @classmethod
    def of(
        cls, table: Measurements, lower: ArrayLike, upper: ArrayLike, joint_types: Sequence[str]
    ) -> JointColumns:
        """Return the columns of a table; a joint with lower >= upper is unlimited."""
        low = np.array(lower, dtype=float)
        high = np.array(upper, dtype=float)
        unlimited = ~(low < high)
        low[unlimited] = -np.inf
        high[unlimited] = np.inf
        return cls(table, low, high, np.array([kind == "prismatic" for kind in joint_types]))

    def check(self) -> None:
        """Refuse columns in another unit or place; warn of each joint with values beyond its
        limits.

        Raises:
            MeasurementError: for degrees or millimetres without a unit, or two swapped columns.
        """
        far = np.abs(self.table.q) > np.where(
            self.slides, JOINT_COLUMNS.most_m, JOINT_COLUMNS.most_rad
        )
        far &= self._outside | ~np.isfinite(self.low) | ~np.isfinite(self.high)
        is_far = far.any(axis=0)
        is_usual = far.mean(axis=0) > JOINT_COLUMNS.many
        if is_far.any():
            self._refuse_units(is_far & (is_usual | self._is_in_small_unit))
        if not self._outside.any():
            return
        swaps = [one.words for one in explaining(self._exchanges(), self._ends, self._holds)]
        is_coupled = self._is_coupled()
        share = float(self._outside.any(axis=1).mean())
        if swaps and share > JOINT_COLUMNS.many and not is_coupled.any():
            raise MeasurementError(
                f"{self.table.source}: {share:.0%} of the rows lie beyond the joint limits, "
                "and none does with "
                f"the columns {' or '.join(swaps)} swapped; exchange their names in the header"
            )
        reach = np.maximum(np.abs(self.low), np.abs(self.high))
        is_wide = np.abs(self.table.q).max(axis=0) > JOINT_COLUMNS.far * reach
        is_usual = self._outside.mean(axis=0) > JOINT_COLUMNS.many
        self._refuse_units(is_wide & is_usual & self._is_in_small_unit & ~is_coupled)
        self._warn_outside(swaps)

    @cached_property
    def _excess(self) -> np.ndarray:
        """How far each position is beyond the limits, shape (N, n)."""
        return np.asarray(np.maximum(self.low - self.table.q, self.table.q - self.high))

    @cached_property
    def _outside(self) -> np.ndarray:
        """Which positions are beyond the limits, shape (N, n)."""
        return np.asarray(self._excess > JOINT_COLUMNS.beyond)

    @cached_property
    def _ends(self) -> np.ndarray:
        """The smallest and the largest position of each joint, shape (2, n)."""
        return np.stack([self.table.q.min(axis=0), self.table.q.max(axis=0)])

    def _inside(self, q: np.ndarray) -> np.ndarray:
        """Return which joints are within their limits at all positions, shape (..., n)."""
        is_inside = (q >= self.low - JOINT_COLUMNS.beyond) & (q <= self.high + JOINT_COLUMNS.beyond)
        return np.asarray(is_inside.all(axis=0))

    def _holds(self, q: np.ndarray) -> bool:
        return bool(self._inside(q).all())

    def _holds_of(self, i: int) -> Callable[[np.ndarray], bool]:
        """Return whether positions, shape (..., n), are within the limits of one joint."""
        return lambda q: bool(self._inside(q)[i])

    @cached_property
    def _units(self) -> tuple[_Columns, ...]:
        """For each joint, that its column is in degrees or millimetres."""
        names = self.table.joint_names
        return tuple(
            _in_small_unit(i, names[i], bool(slides)) for i, slides in enumerate(self.slides)
        )

    @cached_property
    def _is_in_small_unit(self) -> np.ndarray:
        """Which columns would be within their limits in degrees or millimetres, shape (n,)."""
        return np.array(
            [
                any(explaining([one], self._ends, self._holds_of(i)))
                for i, one in enumerate(self._units)
            ]
        )

    def _exchanges(self) -> Iterator[_Columns]:
        """Yield pairs of exchanged columns, of joints of one kind."""
        names = self.table.joint_names
        for i, j in combinations(range(len(names)), 2):
            if self.slides[i] == self.slides[j]:
                yield _exchanged(exchange_order(len(names), i, j), f"{names[i]} and {names[j]}")

    def _is_coupled(self) -> np.ndarray:
        """Return which joints exceed their limits only by what a neighbour adds or subtracts, as
        for coupled drives, shape (n,).
        """
        found = ~self._inside(self.table.q)
        for i in np.flatnonzero(found):
            couplings = self._couplings(int(i))
            found[i] = any(explaining(couplings, self.table.q, self._holds_of(int(i))))
        return found

    def _couplings(self, i: int) -> Iterator[_Columns]:
        """Yield the sums and differences with a neighbour that a joint may report."""
        names = self.table.joint_names
        for j in (i - 1, i + 1):
            if 0 <= j < len(names):
                yield _coupled(i, j, 1.0, f"minus {names[j]}")
                yield _coupled(i, j, -1.0, f"plus {names[j]}")

    def _refuse_units(self, is_wrong: np.ndarray) -> None:
        """Raise for a joint whose unit is wrong, shape (n,), unless it was stated explicitly."""
        for j in np.flatnonzero(is_wrong):
            name = self.table.joint_names[j]
            row = int(np.abs(self.table.q[:, j]).argmax())
            if name not in self.table.units:
                si = "m" if self.slides[j] else "rad"
                raise MeasurementError(
                    f'{self.table.source}, line {self.table.rows[row]}, "{name}": '
                    f"{self.table.q[row, j]:g} {si} {self._units[j].words}; {self._units[j].advice}"
                )

    def _warn_outside(self, swaps: Sequence[str]) -> None:
        """Warn of each joint with values beyond its limits."""
        hint = f"; all rows are inside with {' or '.join(swaps)} swapped" if swaps else ""
        for j in np.flatnonzero(self._outside.any(axis=0)):
            name = self.table.joint_names[j]
            unit = self.table.units.get(name, "m" if self.slides[j] else "rad")
            worst = int(self._excess[:, j].argmax())
            value, excess = (of[worst, j] / SIZES[unit] for of in (self.table.q, self._excess))
            n = int(self._outside[:, j].sum())
            warn(
                f"{self.table.source}: {counted(n, 'row')} of "
                f'"{name}" {"lie" if n > 1 else "lies"} beyond its limits, '
                f"the worst is {value:.6g} {unit} in line {self.table.rows[worst]}, "
                f"{excess:.3g} {unit} too far{hint}; check the sign, the zero and the URDF"
            )


def steps_of(q: np.ndarray) -> np.ndarray:
    """Return the step in which each joint that looks rounded is written, shape (n,) [rad], 0 for
    the others, from positions of shape (N, n).

    Its positions are all multiples of the step and hardly ever the same: those of a grid, which are
    as round, recur.

    Example:
        >>> q = np.random.default_rng(0).uniform(-90, 90, (20, 2))
        >>> q = np.deg2rad(np.column_stack([q[:, 0].round(1), q[:, 1]]))
        >>> np.rad2deg(steps_of(q)).round(3).tolist()
        [0.1, 0.0]
    """
    found = np.zeros(q.shape[1])
    for k, positions in enumerate(q.T):
        step = next((step for step in _STEPS if _is_in_steps(positions, step)), 0.0)
        if step:
            values = len(np.unique(np.round(positions, _DIGITS)))
            found[k] = step if values > JOINT_COLUMNS.various * len(positions) else 0.0
    return found


def _is_in_steps(q: np.ndarray, step: float) -> bool:
    """Return whether positions are multiples of a step, to a small part of it.

    The first of them show of nearly all joints that they are not.
    """
    return all(
        np.abs(some / step - np.round(some / step)).max(initial=0.0) < _OF_STEP
        for some in (q[:_FIRST], q)
    )


def _in_small_unit(i: int, name: str, slides: bool) -> _Columns:
    """Return the hypothesis that a column is in millimetres, or in degrees."""
    word, unit, si = ("millimetres", "mm", "m") if slides else ("degrees", "deg", "rad")

    def undo(q: np.ndarray) -> np.ndarray:
        q = q.copy()
        q[:, i] = q[:, i] / 1000 if slides else np.deg2rad(q[:, i])
        return q

    advice = (
        f"write `{name} [{unit}]` in the header (`[{unit}]` after the name of the column), "
        f"or `{name} [{si}]` if intended"
    )
    return Hypothesis(f"looks like {word}", undo, advice)


def _exchanged(order: np.ndarray, words: str) -> _Columns:
    """Return the hypothesis that columns stand in another order, shape (n,)."""
    return Hypothesis(words, lambda q: q[:, order])


def _coupled(i: int, j: int, factor: float, words: str) -> _Columns:
    """Return the hypothesis that joint i reports its position less a multiple of joint j's."""

    def undo(q: np.ndarray) -> np.ndarray:
        q = q.copy()
        q[:, i] = q[:, i] + factor * q[:, j]
        return q

    return Hypothesis(words, undo)
