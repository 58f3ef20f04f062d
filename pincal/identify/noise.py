"""How large the noise is, and which rows are outliers, judged by the residuals of a fit, station by station."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.special import chdtri

from pincal.identify.criteria import CRITERIA
from pincal.identify.equations import Linearised
from pincal.identify.exact import rounding
from pincal.identify.problem import Problem

Loss = Literal["screen", "huber", "none"]


@dataclass(frozen=True)
class Noise:
    """Standard deviations of one component of each block of readings, None where they are to be estimated."""

    declared: tuple[float | None, ...]

    @property
    def known(self) -> np.ndarray:
        """The declared standard deviations, shape (blocks,), nan where none are."""
        return np.array([np.nan if sigma is None else sigma for sigma in self.declared], float)

    def resolved(self, estimated: np.ndarray, degrees: np.ndarray) -> np.ndarray:
        """Return what to use, shape (blocks,): the declared unless residuals with these degrees of freedom are too large."""
        misfit = self.known * (1.0 + CRITERIA.too_noisy / np.sqrt(2.0 * degrees))
        return np.where(np.isnan(self.known) | (estimated > misfit), estimated, self.known)


@dataclass(frozen=True)
class Judgement:
    """Noise and robust weights at one point of a fit.

    Attributes:
        sigma: shape (blocks,), standard deviations to use.
        estimated: shape (blocks,), those of the residuals.
        robust: shape (N,), factor on each row's weight: 0 leaves it out.
    """

    sigma: np.ndarray
    estimated: np.ndarray
    robust: np.ndarray


def outlier_limit(rows: int, size: int) -> float:
    """Return the sum of squares, in units of the noise, beyond which a row of ``size`` readings is screened."""
    return float(chdtri(size, CRITERIA.outlier / rows))


@dataclass(frozen=True)
class Judge:
    """Estimates the noise of each station and weighs its rows.

    Attributes:
        problem: the stations.
        free: shape (P,), parameters that are fitted.
        noise: what was declared.
        loss: what to do with outliers, as in :func:`pincal.identify.solve.solve`.
    """

    problem: Problem
    free: np.ndarray
    noise: Noise
    loss: Loss

    def at(self, point: Linearised, *, hard: bool) -> Judgement:
        """Return the noise, estimated from the rows that count, and the rows' weights by it.

        Args:
            point: the stations linearised.
            hard: whether outliers, if they are screened, are known well enough to be left out.
        """
        robust = point.robust
        counted = self.counted(robust)
        if self.loss == "none" or (hard and self.loss == "screen"):
            is_shared = self.problem.is_shared
            shared = int(np.sum(self.free & is_shared & ~self.problem.beliefs.is_remembered))
            own = [int(np.sum((self.free & ~is_shared)[places])) for places in self.problem.places]
            spent = self._spread(counted, shared, own, most=CRITERIA.most_spent)
            estimated = np.sqrt(point.squares / np.maximum(counted - spent, 1.0))
        else:
            middle = np.array([chdtri(block.size, 0.5) for block in self.problem.blocks])
            medians = _medians(point.row_squares)
            estimated = np.sqrt(medians / middle)
        estimated = np.maximum(estimated, rounding(self.problem))
        sigma = self.noise.resolved(estimated, counted)
        return Judgement(sigma, estimated, self._weigh(point, sigma, hard=hard))

    def counted(self, robust: np.ndarray) -> np.ndarray:
        """Return the number of readings that count in each block, shape (blocks,)."""
        return np.asarray(np.maximum(self.problem.readings(robust), [block.size for block in self.problem.blocks]))

    def degrees(self, robust: np.ndarray, shared: float, own: tuple[float, ...]) -> np.ndarray:
        """Return the degrees of freedom that a fit leaves to each block, shape (blocks,).

        Args:
            robust: shape (N,), factor on each row's weight: 0 leaves a row out.
            shared: parameters that the data spend on what the stations share.
            own: on what each of them has itself.
        """
        counted = self.counted(robust)
        spent = self._spread(counted, shared, own)
        return np.asarray(np.maximum(counted - spent, 1.0))

    def _spread(
        self, counted: np.ndarray, shared: float, own: list[int] | tuple[float, ...], *, most: float = np.inf
    ) -> np.ndarray:
        """Return how many parameters each block pays for: its part of the shared ones and of those of its station."""
        spans = self.problem.block_spans
        of = np.repeat(np.arange(len(spans)), [span.stop - span.start for span in spans])
        whole = np.bincount(of, counted)
        numbers = np.zeros(len(whole))
        numbers[: len(own)] = own
        shared = min(shared, most * counted.sum())
        return np.asarray(counted * (shared / counted.sum() + (np.minimum(numbers, most * whole) / whole)[of]))

    def _weigh(self, point: Linearised, sigma: np.ndarray, *, hard: bool) -> np.ndarray:
        if self.loss == "none":
            return np.ones(len(self.problem))
        spans = self.problem.block_spans
        pairs = zip(point.row_squares, spans, strict=True)
        distance2 = np.concatenate([np.einsum("b,bn->n", sigma[span] ** -2.0, rows) for rows, span in pairs])
        counts = [rows.shape[1] for rows in point.row_squares]
        sizes = [int(station.block_sizes.sum()) for station in self.problem.stations]
        limits = [outlier_limit(n, size) if n else np.inf for n, size in zip(counts, sizes, strict=True)]
        limit2 = np.repeat(limits, counts)
        lighter = 0.0 if hard and self.loss == "screen" else (limit2 / np.maximum(distance2, limit2)) ** 0.25
        return np.where((distance2 > limit2) & ~self._trusted, lighter, 1.0)

    @cached_property
    def _trusted(self) -> np.ndarray:
        """Which rows are no outliers whatever is left there, shape (N,)."""
        parts = [np.zeros(len(s), bool) if s.trusted is None else s.trusted for s in self.problem.stations]
        return np.concatenate(parts)


def _medians(rows: list[np.ndarray]) -> np.ndarray:
    """Return the median of each row of each matrix, one matrix after the other; matrices of one shape in one go."""
    alike: dict[tuple[int, ...], list[int]] = {}
    for i, each in enumerate(rows):
        alike.setdefault(each.shape, []).append(i)
    found: list[np.ndarray] = [np.zeros(0)] * len(rows)
    for those in alike.values():
        for i, medians in zip(those, np.median([rows[i] for i in those], axis=2), strict=True):
            found[i] = medians
    return np.concatenate(found)
