r"""Scan of deviations of readings from the mean of their pose for patterns along the rows.

A change between visits moves the targets along a motion field G
(:mod:`pincal.identify.motion_fields`) times a pattern x over the visits: a step from some stop on,
a curve along the rows, the number of the visit. Deviations d from the mean of the pose and target
need no model of the robot. With W the inverse covariance of their scatter and :math:`\tilde x` the
pattern without its mean at each pose,

.. math:: g = s^T N^{-1} s, \quad s = \sum_i \tilde x_i G_i^T W_i d_i, \quad
          N = \sum_i \tilde x_i^2 G_i^T W_i G_i

is the gain of a field and a pattern. Stops are exchanged with others of their pose, whole with all
their readings, to find how large the most significant gain over all fields and patterns is by
chance: a permutation test, which is valid whatever the scatter of readings depends on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtri, digamma, fdtrc, polygamma

from pincal.identify.motion_fields import MotionField
from pincal.identify.visit_numbers import VISITS
from pincal.identify.visit_scatter import Arrivals, arrivals_of
from pincal.thresholds import Count, Scale

# Iterations of a robust estimate of a size.
_TURNS: Count = 20
# Number of permutations, and of them at once; gains beyond theirs are judged by the
# distribution of the largest of some.
_ORDERS: Count = 300
_AT_ONCE: Count = 20
# Rounds in which the number of independent patterns and their scale are found in turn.
_ROUNDS: Count = 3
# Directions weaker than this relative to the strongest are excluded.
_RANK: Scale = 1e-6
# Smallest scatter [m].
_LEAST: Scale = 1e-9


@dataclass(frozen=True)
class Pattern:
    """Patterns of one kind.

    Attributes:
        kind: "step", "drift" or "order".
        x: shape (n, K, C), K patterns of C curves each.
        without: names of fields that do not move in this way.
        limit: probability below which one is no chance.
        begins: shape (K,), numbers of the stops from which steps begin; None of other kinds.
    """

    kind: str
    x: np.ndarray
    without: frozenset[str] = frozenset()
    limit: float = VISITS.chance
    begins: np.ndarray | None = None


@dataclass(frozen=True)
class Best:
    """The best pattern of a kind along a field: its number, gain, and that of the residuals."""

    field: MotionField
    pattern: int
    gain: float
    total: float
    freedoms: int
    degrees: int

    @property
    def surprise(self) -> float:
        """Minus the log of the p-value of an F test, without multiplicity."""
        return float(_surprise(np.array(self.gain), self.total, self.freedoms, self.degrees))

    @property
    def likelihood(self) -> float:
        """Minus twice the log of that p-value, by which patterns and fields of unequal freedoms are
        compared.
        """
        return 2.0 * self.surprise


@dataclass(frozen=True, eq=False)
class Visits:
    """Readings, one for each target in each visit, in the order of the visits.

    Attributes:
        off: shape (n, 3), deviation from the mean of the pose and target [m].
        thing: shape (n,), number of the pose and target, from 0 without gaps.
        visit: shape (n,), number of the visit, whose readings share the arrival of the drives.
        fields: motion fields, directions of shape (things, 3, m).
        levers: shape (things, 3, J), of the joints.
    """

    off: np.ndarray
    thing: np.ndarray
    visit: np.ndarray
    fields: tuple[MotionField, ...]
    levers: np.ndarray

    @cached_property
    def count(self) -> np.ndarray:
        """Number of readings of each thing, shape (things,)."""
        return np.bincount(self.thing)

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the deviations."""
        return 3 * (len(self.thing) - len(self.count))

    def centred(self, values: np.ndarray) -> np.ndarray:
        """Return values, shape (n, ...), without the mean of each thing."""
        flat = values.reshape(len(values), -1)
        sums = np.stack([np.bincount(self.thing, column) for column in flat.T], axis=1)
        return np.asarray((flat - (sums / self.count[:, None])[self.thing]).reshape(values.shape))

    def scatter(self, off: np.ndarray) -> Arrivals:
        """Return the scatter that deviations, shape (n, 3), show."""
        share = 1.0 - 1.0 / self.count[self.thing]
        least = np.full(3, _LEAST)
        return arrivals_of(off, self.levers[self.thing], share, blocks=[slice(0, 3)], least=least)

    def permuted(self, rng: np.random.Generator, times: int) -> np.ndarray:
        """Return places of readings with the visits of each pose exchanged, shape (times, n)."""
        number = np.unique(self.visit, return_inverse=True)[1].ravel()
        places = np.lexsort((number, self.thing))
        keys = rng.random((times, int(number.max()) + 1))[:, number]
        drawn = np.argsort(self.thing + keys, axis=1)
        found = np.empty_like(drawn)
        found[:, places] = drawn
        return found


@dataclass(frozen=True, eq=False)
class Scan:
    """Deviations in units of their scatter, and their products with all fields.

    Attributes:
        visits: the readings.
        white: shape (things, 3, 3), matrices that whiten deviations.
        clipped: shape (n, 3), whitened deviations, the largest clipped.
    """

    visits: Visits
    white: np.ndarray
    clipped: np.ndarray

    @classmethod
    def of(cls, visits: Visits, explained: np.ndarray) -> Scan:
        """Return the scan of readings of which a part, shape (n, 3), is explained already, up to
        its size.
        """
        left = visits.off - explained
        covariance = visits.scatter(left).covariance(visits.levers)
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        turned = np.einsum("nab,nb->na", white[visits.thing], left)
        size = np.linalg.norm(turned, axis=1, keepdims=True)
        limit = np.sqrt(chdtri(3, VISITS.clipped))
        turned = turned * np.minimum(1.0, limit / np.maximum(size, 1e-300))
        whole = turned + np.einsum("nab,nb->na", white[visits.thing], explained)
        return cls(visits, white, visits.centred(whole))

    @cached_property
    def fields(self) -> list[np.ndarray]:
        """Whitened directions of each field, shape (things, 3, m)."""
        return [self.white @ field.directions for field in self.visits.fields]

    @property
    def total(self) -> float:
        """Sum of squares."""
        return float(np.sum(self.clipped**2))

    def best(self, pattern: Pattern) -> list[Best]:
        """Return the best pattern along each field."""
        found = []
        for field, gains, freedoms in self._gains(pattern, self.clipped[None]):
            k = int(np.argmax(gains[0]))
            found.append(
                Best(field, k, float(gains[0, k]), self.total, freedoms, self.visits.degrees)
            )
        return found

    def gains(self, pattern: Pattern, field: MotionField) -> np.ndarray:
        """Return the gain of each pattern along a field, shape (K,)."""
        found = (gains for of, gains, _ in self._gains(pattern, self.clipped[None]) if of is field)
        return np.asarray(next(found)[0])

    def chance(self, pattern: Pattern) -> float:
        """Return the probability that sound visits show a pattern of this kind that is as
        significant.
        """
        surprise = max((best.surprise for best in self.best(pattern)), default=0.0)
        if np.exp(-surprise) > VISITS.permuted:
            return 1.0
        rng = np.random.default_rng(0)
        drawn: list[np.ndarray] = []
        for _ in range(0, _ORDERS, _AT_ONCE):
            exchanged = self.clipped[self.visits.permuted(rng, _AT_ONCE)]
            every = [
                _surprise(gains.max(axis=1), self.total, freedoms, self.visits.degrees)
                for _, gains, freedoms in self._gains(pattern, exchanged)
            ]
            drawn.append(np.max(every, axis=0))
        return chance_of_most(surprise, np.concatenate(drawn))

    def motion(self, pattern: Pattern, best: Best) -> np.ndarray:
        """Return the displacements that a pattern explains, shape (n, 3) [m], by a robust estimate
        of its size.
        """
        visits = self.visits
        x = visits.centred(pattern.x[:, best.pattern])
        off = visits.off
        turn = self.white[visits.thing]
        directions = best.field.directions[visits.thing]
        columns = (directions[:, :, None, :] * x[:, None, :, None]).reshape(len(x), 3, -1)
        X = (turn @ columns).reshape(off.size, -1)
        inverse = np.linalg.pinv(X, rcond=np.sqrt(_RANK))
        white = np.einsum("nab,nb->na", turn, off)
        limit = np.sqrt(chdtri(3, VISITS.clipped))
        size = inverse @ self.clipped.ravel()
        for _ in range(_TURNS):
            fitted = (X @ size).reshape(off.shape)
            left = white - fitted
            long = np.linalg.norm(left, axis=1, keepdims=True)
            left = left * np.minimum(1.0, limit * _middle(long) / np.maximum(long, 1e-300))
            size = inverse @ (fitted + left).ravel()
        return np.asarray(columns @ size)

    def _gains(
        self, pattern: Pattern, white: np.ndarray
    ) -> Iterator[tuple[MotionField, np.ndarray, int]]:
        """Yield each field, its gains for B sets of whitened deviations, shape (B, n, 3), as (B,
        K), and its freedoms.
        """
        visits = self.visits
        n, K, C = pattern.x.shape
        if not K:
            return
        x = visits.centred(pattern.x)
        flat = x.reshape(n, K * C)
        order = np.argsort(visits.thing, kind="stable")
        starts = np.append(0, np.cumsum(visits.count)[:-1])
        pairs = np.stack(
            [x[order][:, :, a] * x[order][:, :, b] for a in range(C) for b in range(C)], axis=2
        )
        inner = np.add.reduceat(pairs, starts, axis=0).reshape(len(visits.count), K, C, C)
        for field, directions in zip(visits.fields, self.fields, strict=True):
            m = field.freedoms
            if not m or field.name in pattern.without:
                continue
            squares = np.einsum("tam,tan->tmn", directions, directions)
            normal = np.einsum("tkcd,tmn->kcmdn", inner, squares, optimize=True).reshape(
                K, C * m, C * m
            )
            inverse = _inverses(normal)
            along = np.einsum("nam,Bna->Bnm", directions[visits.thing], white, optimize=True)
            score = np.einsum("nk,Bnm->Bkm", flat, along, optimize=True).reshape(
                len(white), K, C * m
            )
            yield field, np.einsum("Bkp,kpq,Bkq->Bk", score, inverse, score, optimize=True), C * m


def chance_of_most(surprise: float, by_chance: np.ndarray) -> float:
    """Return the probability of a surprise, the largest of some, from those that permuted rows
    show.

    The largest of K independent surprises is that of K exponential variables, of mean
    H_K = digamma(K + 1) + gamma and variance pi^2 / 6 - trigamma(K + 1), times a scale where the
    scatter of readings is not the same everywhere.
    """
    mean = float(by_chance.mean())
    scale = 1.0
    for _ in range(_ROUNDS):
        log_K = _log_number(mean / scale)
        variance = np.pi**2 / 6.0 - float(polygamma(1, np.exp(log_K) + 1.0))
        scale = max(float(by_chance.std()) / np.sqrt(variance), 1.0)
    return -float(np.expm1(np.exp(log_K) * np.log1p(-np.exp(-surprise / scale))))


def _log_number(mean: float) -> float:
    """Return the log of the number of independent exponential variables whose largest has a mean,
    at least 0.
    """

    def excess(log_K: float) -> float:
        return float(digamma(np.exp(log_K) + 1.0)) + np.euler_gamma - mean

    return 0.0 if mean <= 1.0 else float(brentq(excess, 0.0, mean + 1.0))


def _middle(long: np.ndarray) -> float:
    """Return the typical length of whitened residuals over that of a standard normal one, at least
    1.
    """
    return max(float(np.median(long)) / float(np.sqrt(chdtri(3, 0.5))), 1.0)


def _inverses(normal: np.ndarray) -> np.ndarray:
    """Return pseudo-inverses of scaled matrices of shape (K, p, p)."""
    scale = np.sqrt(np.maximum(np.einsum("kpp->kp", normal), 1e-300))
    both = scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.pinv(normal / both, rcond=_RANK, hermitian=True) / both)


def _surprise(gain: np.ndarray, total: float, freedoms: int, degrees: int) -> np.ndarray:
    """Return minus the log of the p-values of F tests of gains."""
    left = degrees - freedoms
    if left < 1:
        return np.zeros_like(gain)
    rest = np.maximum(total - gain, 1e-12 * total)
    p_value = fdtrc(freedoms, left, gain / freedoms / (rest / left))
    # Far beyond any chance the p-value underflows.
    far = 0.5 * left * np.log(total / rest)
    return np.asarray(
        np.where(p_value > 1e-280, -np.log(np.maximum(p_value, 1e-300)), np.maximum(far, 644.0))
    )
