"""What intervals of predictions hold: rates with exact intervals that count what is alike once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from feature_maps import APART, FEATURES, difference, near_rows, pairs_apart
from rates import interval_of_blocks

from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.position_covariance import PositionCovariance, SharedErrors
from pincal.identify.split import joint_regions
from pincal.model.conditions import Conditions

# Pairs and features of each kind that are drawn from the rows, and as few pairs as are worth a rate.
SETS, FEWEST = 150, 30
# Blocks of rows within which what is off is alike: regions of joint space, or stretches of the rows.
BLOCKS = 12
# Standard deviations of an interval of 95 % and of 68 %.
SPANS = (1.96, 1.0)


@dataclass(frozen=True, eq=False)
class Held:
    """How far linear functions of predicted positions are off, and their standard uncertainties, shape (M,) each.

    Attributes:
        off: errors.
        u: standard uncertainties.
        block: shape (M,), the block of rows of each.
        alone: mean u as a part of that of independent positions; nan for positions.
    """

    off: np.ndarray
    u: np.ndarray
    block: np.ndarray
    alone: float = float("nan")

    def hits(self, span: float) -> np.ndarray:
        """Return whether each is within so many standard uncertainties, shape (M,)."""
        return np.asarray(np.abs(self.off) < span * self.u)

    @property
    def width(self) -> float:
        """Width of the intervals as a multiple of the narrowest that hold 95 %."""
        return SPANS[0] / float(np.quantile(np.abs(self.off) / self.u, 0.95))

    def __str__(self) -> str:
        words = []
        for span in SPANS:
            hit = self.hits(span)
            low, high = interval_of_blocks(np.bincount(self.block, hit).tolist(), np.bincount(self.block).tolist())
            words.append(f"{100.0 * np.mean(hit):.1f} ({100.0 * low:.0f} to {100.0 * high:.0f})")
        alone = "" if np.isnan(self.alone) else f", u/alone {self.alone:.2f}"
        return f"{words[0]} %, 68: {words[1]} %, width {self.width:.2f}{alone}"


@dataclass(frozen=True, eq=False)
class Judged:
    """Rows that were not fitted, with their predictions.

    Attributes:
        model: the fitted robot.
        conditions: of N rows.
        off: shape (N, 3), reading minus prediction [m].
        noise: standard uncertainty of a coordinate that was declared of readings [m].
        block: shape (N,), the block of each row; default: regions of joint space.
        apart: sources of uncertainty that what was read does not have, such as the arrival of a true pose.
        socket: shape (N,), in which of several places the target was, if the coordinates of these are not known.
    """

    model: FittedRobot
    conditions: Conditions
    off: np.ndarray
    noise: float
    block: np.ndarray | None = None
    socket: np.ndarray | None = None
    apart: tuple[str, ...] = ()

    @property
    def blocks(self) -> np.ndarray:
        """The block of each row, shape (N,)."""
        return joint_regions(self.conditions.q, BLOCKS) if self.block is None else self.block

    def of_points(self) -> Held:
        """Return the coordinates of all positions."""
        by_source = self.model.position_variances(self.conditions)
        variance = sum(of for name, of in by_source.items() if name not in self.apart) + self.noise**2
        return Held(self.off.ravel(), np.sqrt(variance).ravel(), np.repeat(self.blocks, 3))

    def of_map(self, sets: list[np.ndarray], make: Callable[[np.ndarray], np.ndarray]) -> Held:
        """Return what maps make of sets of rows."""
        places = self.model.predict(self.conditions)[:, :, 3]
        off, together, alone, block = [], [], [], []
        for rows in sets:
            A = make(places[rows])
            sources = self.model.covariance_of(self.conditions.select(rows)).sources
            covariance = PositionCovariance({k: of for k, of in sources.items() if k not in self.apart})
            noise = self.noise**2 * A @ A.T
            of_each = SharedErrors.of_each(covariance.blocks)
            off.append(A @ self.off[rows].ravel())
            together.append(np.sqrt(np.diag(covariance.through(A) + noise)))
            alone.append(np.sqrt(np.diag(of_each.through(A) + noise)))
            block.append(np.full(len(A), self.blocks[rows[0]]))
        u = np.concatenate(together)
        part = float(np.mean(u) / np.mean(np.concatenate(alone)))
        return Held(np.concatenate(off), u, np.concatenate(block), part)

    def figures(self, seed: int) -> Iterator[tuple[str, Held]]:
        """Yield what is held of positions, differences and features, by name."""
        rng = np.random.default_rng(seed)
        if self.socket is not None:
            yield "same place", self.of_map(list(_pairs_within(self.socket, rng)), difference)
            return
        yield "points", self.of_points()
        places = self.model.predict(self.conditions)[:, :, 3]
        for apart in APART:
            pairs = pairs_apart(places, apart, SETS, rng)
            if len(pairs) >= FEWEST:
                yield f"{1e3 * apart:.0f} mm apart", self.of_map(pairs, difference)
        for name, (n, make) in FEATURES.items():
            if len(places) >= 2 * n:
                yield name, self.of_map([near_rows(places, n, rng) for _ in range(SETS)], make)


def _pairs_within(group: np.ndarray, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Yield pairs of rows of the same group."""
    for first in rng.integers(0, len(group), SETS):
        others = np.setdiff1d(np.flatnonzero(group == group[first]), [first])
        if len(others):
            yield np.array([first, rng.choice(others)])


class Totals:
    """Rates of several calibrations together, of which each is one block."""

    def __init__(self) -> None:
        self.of: dict[str, list[Held]] = {}

    def add(self, name: str, held: Held) -> None:
        """Add a figure of one calibration."""
        self.of.setdefault(name, []).append(held)

    def words(self) -> Iterator[str]:
        """Yield a line for each figure: means over calibrations with their intervals, and the ranges."""
        for name, parts in self.of.items():
            rates = []
            for span in SPANS:
                hits = [float(np.sum(part.hits(span))) for part in parts]
                counts = [float(len(part.off)) for part in parts]
                low, high = interval_of_blocks(hits, counts)
                each = np.array(hits) / counts
                mean, least, most = (100.0 * float(of) for of in (np.mean(each), min(each), max(each)))
                rates.append(f"{mean:.1f} ({100.0 * low:.1f} to {100.0 * high:.1f}; each {least:.1f} to {most:.1f})")
            widths = [part.width for part in parts]
            width = f"{np.exp(np.mean(np.log(widths))):.2f} ({min(widths):.2f} to {max(widths):.2f})"
            alone = [part.alone for part in parts]
            end = "" if np.isnan(alone[0]) else f", u/alone {np.mean(alone):.2f} ({min(alone):.2f} to {max(alone):.2f})"
            yield f"{name}, {len(parts)} calibrations: {rates[0]} %, 68: {rates[1]} %, width {width}{end}"
