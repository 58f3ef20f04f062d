"""All stations of a problem linearised at one point: squares of residuals, and normal equations for
one noise.

The contributions of stations are computed by functions of picklable arguments, so that any
``concurrent.futures`` executor can map them. They are added in the order of the stations, so the
result does not depend on the executor, but for rounding where it decides whether they are kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from pincal.identify.jacobian import Jacobian, block, span
from pincal.identify.normal import (
    Batch,
    Normal,
    StationSquares,
    Task,
    accumulate_at,
    believed,
    contribution,
    near,
    reweighted,
    squares,
    summed,
)
from pincal.identify.posterior import Eliminated, Posterior, eliminate
from pincal.identify.problem import Problem
from pincal.identify.quadratic import Form
from pincal.identify.station import Station
from pincal.spread import spread_again
from pincal.thresholds import Count

# The number of a batch, its noise and its robust weights; and its contribution for these.
_Key = tuple[int, bytes, bytes]
_Sums = tuple[tuple[Form, Eliminated], StationSquares]

# Largest size of the normal equations of single stations that is kept at one point, and of few
# stations, whose rows take long to sum again for another noise [bytes].
_MOST_KEPT: Count = 2_000_000
_MOST_OF_FEW: Count = 64_000_000
_FEW: Count = 10
# Largest number of numbers in the columns of a station that are kept (16 MB).
_MOST_COLUMNS: Count = 2_000_000
# Size of the normal equations of folds that are summed at once [bytes].
_MOST_AT_ONCE: Count = 64_000_000
# Size of those of which posteriors are worked out together; for larger ones it saves no time.
_MOST_TOGETHER: Count = 4_000_000


@dataclass(frozen=True, eq=False)
class Linearised:
    """A problem at one set of values.

    The Gram matrices of each station are kept per block of readings, since another noise only
    changes their weights. Where there are too many stations for that, only squares and sums over
    batches of stations for one noise are kept.

    Attributes:
        problem: the stations.
        values: shape (P,).
        free: shape (P,), the F free parameters.
        robust: shape (N,), factor on each row's weight: 0 excludes a row.
        sizes: shape (P,), standard deviations of the priors; inf for none.
        executor: computes the stations' contributions; default: serially, in this process.
        sigma: shape (blocks,), the noise for which equations will be needed, if known before the
            residuals: one pass over several stations then serves both.
        squares_first: whether the values may be rejected by their squares, which are then computed
            first, in a tenth of the time.
        normals: the latest normal equations of batches at these values, by number, perhaps with
            other robust weights.
        sums: contributions of batches for the latest noise, and the squares of their residuals.
        posteriors: the latest posterior at these values, by noise and robust weights.
        weighed: the same point with other robust weights, from whose rows the squares are summed.
        near: normal equations of batches of a single station each at values near by, whose H then
            stands for that of these values; slope and squares are exact. Default: all is.
    """

    problem: Problem
    values: np.ndarray
    free: np.ndarray
    robust: np.ndarray
    sizes: np.ndarray
    executor: Executor | None = None
    sigma: np.ndarray | None = None
    squares_first: bool = False
    normals: dict[int, Normal] = field(default_factory=dict)
    sums: dict[_Key, _Sums] = field(default_factory=dict)
    posteriors: dict[tuple[bytes, bytes], Posterior] = field(default_factory=dict)
    weighed: Linearised | None = None
    near: tuple[Normal, ...] | None = None

    def reweighted(self, robust: np.ndarray) -> Linearised:
        """Return the same point with other robust weights; stations whose weights are unchanged are
        not recomputed.
        """
        return replace(self, robust=robust, squares_first=False, weighed=None)

    def without_rows(self, rows: np.ndarray) -> Linearised:
        """Return the same point without some rows, a mask of shape (N,); its squares follow from
        those of the rows here, and its normal equations are computed on demand.
        """
        robust = np.where(rows, 0.0, self.robust)
        return replace(self, robust=robust, normals={}, sums={}, posteriors={}, weighed=self)

    def moved_to(self, values: np.ndarray) -> Linearised:
        """Return the problem at other values, its squares computed before its normal equations."""
        return replace(
            self,
            values=values,
            squares_first=True,
            normals={},
            sums={},
            posteriors={},
            weighed=None,
        )

    @property
    def may_be_carried(self) -> bool:
        """Whether normal equations are those of this point, and kept whatever computes them."""
        if self.near is not None:
            return False
        return len(self.problem.stations) == 1 or self._size <= _MOST_KEPT

    def carried_to(self, values: np.ndarray) -> Linearised:
        """Return the problem at values so near that only residuals differ, not the normal matrix:
        in a third of the time.
        """
        there = self.moved_to(values)
        each = zip(self._batches, self._normals, there._squares, strict=True)
        for k, (of, normal, found) in enumerate(each):
            may = self.free[of.places[0]]
            step = (values - self.values)[of.places[:, may]]
            if len(of.stations) == 1:
                known = believed(of.stations[0], of.values(values), may)
                there.normals[k] = normal.carried(step[0], found, known)
            else:
                there.normals[k] = normal.carried(step, found, None)
        there.problem.work.remember(there._point, there.normals)
        return there

    def exactly(self) -> Linearised:
        """Return the same point with normal equations that are its own."""
        if self.near is None:
            return self
        return replace(
            self,
            squares_first=False,
            normals={},
            sums={},
            posteriors={},
            weighed=None,
            near=None,
        )

    def known_normals(self) -> tuple[Normal, ...] | None:
        """Return the normal equations of each batch, if they are kept, summed, and of a single
        station each.
        """
        is_single = all(len(of.stations) == 1 for of in self._batches)
        if not self._are_kept or not is_single or len(self.normals) < len(self._batches):
            return None
        return tuple(self.normals[k] for k in range(len(self._batches)))

    def narrowed(self, free: np.ndarray) -> Linearised:
        """Return the same point with fewer free parameters, shape (P,); known normal equations are
        not recomputed.
        """
        if np.array_equal(free, self.free):
            return self
        found = replace(self, free=free, normals={}, sums={}, posteriors={}, weighed=None)
        if [batch.first for batch in found._batches] == [batch.first for batch in self._batches]:
            for k, normal in self.normals.items():
                places = self._batches[k].places[0]
                found.normals[k] = normal.narrowed(np.flatnonzero(free[places[self.free[places]]]))
        return found

    def with_columns(self, free: np.ndarray) -> Linearised:
        """Return the same point with the columns of these parameters, shape (P,), of which it may
        then be narrowed to some.
        """
        found = replace(
            self, free=free, squares_first=False, normals={}, sums={}, posteriors={}, weighed=None
        )
        if found._are_kept:
            # Known from here on.
            assert found._normals
        return found

    def is_at(self, other: Linearised) -> bool:
        """Return whether it is at the values of another one, with its robust weights."""
        return np.array_equal(self.values, other.values) and np.array_equal(
            self.robust, other.robust
        )

    def release(self) -> None:
        """Free the memory of many stations' equations; they are recomputed on demand.

        Of few stations the posterior stays: it is smaller by far than what it was summed from, and
        every step that is refused asks for it again.
        """
        if not self._are_kept and self._squares:
            self.normals.clear()
            self.sums.clear()
            if len(self.problem.stations) > _FEW:
                self.posteriors.clear()

    @cached_property
    def _are_kept(self) -> bool:
        """Whether the normal equations of each station are kept."""
        stations = len(self.problem.stations)
        most = _MOST_OF_FEW if stations <= _FEW and self.executor is None else _MOST_KEPT
        return stations == 1 or self._size <= most

    @property
    def _size(self) -> int:
        """Size of the normal equations of each station together [bytes]."""
        n_free = np.count_nonzero(self.free[self.problem.places[0]])
        return 8 * len(self.problem.blocks) * int(n_free) ** 2

    @cached_property
    def _batches(self) -> list[Batch]:
        return [part for batch in self.problem.batches for part in batch.by_free(self.free)]

    @property
    def _normals(self) -> list[Normal]:
        """The normal equations of the stations of each batch."""
        normals = self.normals
        if not normals and self.near is None:
            normals |= self.problem.work.remembered.get(self._point, {})
        every = range(len(self._batches))
        robust = [self.robust[batch.rows] for batch in self._batches]
        todo = [
            k for k in every if k not in normals or not np.array_equal(normals[k].robust, robust[k])
        ]
        sum_of = reweighted if self.near is None else near
        known = normals if self.near is None else dict(enumerate(self.near))
        works = (
            of.work(sum_of, self.values, self.free[of.places[0]], robust[k], known.get(k))
            for k, of in ((k, self._batches[k]) for k in todo)
        )
        normals |= zip(todo, self._done(works), strict=True)
        if todo and self.near is None:
            self.problem.work.remember(self._point, normals)
        return [normals[k] for k in every]

    @cached_property
    def _point(self) -> bytes:
        """What normal equations depend on besides robust weights."""
        return self.values.tobytes() + self.free.tobytes()

    @cached_property
    def _squares(self) -> list[StationSquares]:
        if self.weighed is not None:
            pairs = zip(self.weighed._squares, self._batches, strict=True)
            return [
                replace(found, blocks=summed(found.rows, of.ends, self.robust[of.rows]))
                for found, of in pairs
            ]
        if self._are_kept and not self.squares_first:
            return [normal.squares for normal in self._normals]
        if self.sigma is not None and not self.squares_first:
            return [found for _, found in self._contributions(self.sigma)]
        return list(
            self._done(
                batch.work(squares, self.values, self.robust[batch.rows]) for batch in self._batches
            )
        )

    @property
    def squares(self) -> np.ndarray:
        """Weighted sums of squared residuals of all blocks of readings, shape (blocks,)."""
        return np.concatenate([found.blocks for found in self._squares])

    @cached_property
    def row_squares(self) -> list[np.ndarray]:
        """For each station, each row's weighted squared residual, shape (its blocks, its rows),
        without robust weights.
        """
        pairs = zip(self._squares, self._batches, strict=True)
        return [rows for found, of in pairs for rows in np.split(found.rows, of.ends[1:-1], axis=1)]

    def chi2(self, sigma: np.ndarray) -> float:
        """Return the sum of squares in units of the variances, for standard deviations of all
        blocks.
        """
        return float(np.sum(self.squares / sigma**2))

    @cached_property
    def group_of(self) -> np.ndarray:
        """The fit that each parameter belongs to, shape (P,): stations that share nothing have one
        each.
        """
        found = np.zeros(len(self.values), int)
        if not np.any(self.free & self.problem.is_shared):
            for i, places in enumerate(self.problem.places):
                found[places[~self.problem.is_shared[places]]] = i
        return found

    def objectives(self, sigma: np.ndarray) -> np.ndarray:
        """Return the sums of squares of these fits, each as in :meth:`objective`."""
        n = int(self.group_of.max(initial=0)) + 1
        if n == 1:
            return np.array([self.objective(sigma)])
        starts = [span.start for span in self.problem.block_spans]
        known = np.flatnonzero(self.free & np.isfinite(self.sizes))
        prior = np.bincount(
            self.group_of[known], (self.values[known] / self.sizes[known]) ** 2, minlength=n
        )
        beliefs = np.concatenate([found.beliefs for found in self._squares])
        return np.asarray(np.add.reduceat(self.squares / sigma**2, starts) + beliefs + prior)

    def objective(self, sigma: np.ndarray) -> float:
        """Return the sum of squares of readings, of the sensors' other knowledge and of priors, in
        units of variances.
        """
        known = self.free & np.isfinite(self.sizes)
        prior = float(np.sum((self.values[known] / self.sizes[known]) ** 2))
        beliefs = sum(float(found.beliefs.sum()) for found in self._squares)
        return (
            self.chi2(sigma)
            + beliefs
            + prior
            + self.problem.beliefs.square(self.values, self.sizes)
        )

    def posterior(self, sigma: np.ndarray) -> Posterior:
        """Return the posterior for standard deviations of all blocks of readings, shape
        (blocks,).
        """
        key = sigma.tobytes(), self.robust.tobytes()
        if key not in self.posteriors:
            found = self._sum(sigma)
            self.posteriors.clear()
            self.posteriors[key] = found
        return self.posteriors[key]

    def _sum(self, sigma: np.ndarray) -> Posterior:
        return self._assembled([found for found, _ in self._contributions(sigma)])

    def _assembled(self, contributions: Iterable[tuple[Form, Eliminated]]) -> Posterior:
        """Return the posterior from the contribution of each batch."""
        free = self.free
        problem = self.problem
        rank = np.cumsum(free) - 1
        slot = np.cumsum(problem.is_shared[free]) - 1
        places = np.flatnonzero(free & problem.is_shared)
        known = problem.beliefs.beyond_priors(places, self.values, self.sizes)
        believed = problem.beliefs.entries(places, self.sizes) if problem.beliefs.terms else None
        H = known.H
        g = known.g
        whole = known.whole.copy()
        eliminated = []
        for batch, (form, own) in zip(self._batches, contributions, strict=True):
            moved = free[batch.places[0]]
            mine = batch.places[:, moved & batch.own]
            ours = slot[rank[batch.places[0, moved & ~batch.own]]]
            at = span(ours)
            H[block(at, at)] += form.H
            g[at] += form.g
            whole[at] += form.whole
            if mine.size:
                eliminated.append(replace(own, places=rank[mine], shared=ours))
        return Posterior(
            Form(H, g, whole), self.sizes[places], self.values[places], tuple(eliminated), believed
        )

    def without_each(self, fold: np.ndarray, sigma: np.ndarray) -> Iterator[WithoutFolds]:
        """Yield the posteriors without the rows of each fold, of as many folds at once as can be
        kept together: of all of them from one pass over the rows, or else from two.

        Args:
            fold: shape (N,), the fold of each row, from 0.
            sigma: shape (blocks,), standard deviations of the blocks of readings.
        """
        batches = self._batches
        count = int(fold.max()) + 1
        size = sum(8 * len(of.stations) * int(self.free[of.places[0]].sum()) ** 2 for of in batches)
        at_once = max(_MOST_AT_ONCE // max(size, 1), 1)
        known = [None if at_once >= count else self._of_all_rows(of, sigma) for of in batches]
        whole = None
        for first in range(0, count, at_once):
            some = range(first, min(first + at_once, count))
            parts = [
                self._by_fold(of, fold, some, sigma, form)
                for of, form in zip(batches, known, strict=True)
            ]
            if whole is None:
                whole = self._assembled(part.all_rows for part in parts)
            yield WithoutFolds(self, some, whole, parts)

    @cached_property
    def columns(self) -> tuple[np.ndarray, Jacobian] | None:
        """Residuals and Jacobian of all rows of a single station, neither weighted nor whitened,
        for sums over several divisions of its rows; None where rows are many or not independent, or
        parameters are of curves.
        """
        station, *others = self.problem.stations
        size = len(station) * station.reading_size * np.count_nonzero(self.free)
        is_plain = station.whitening is None and not station.is_correlated
        if others or not is_plain or station.sensor.is_whole or size > _MOST_COLUMNS:
            return None
        (places,) = self.problem.places
        at = self.values[places], self.free[places]
        pieces = list(station.linearise_correlated(*at))
        _, residuals, jacobian = pieces[0]
        return None if len(pieces) > 1 or jacobian.families else (residuals, jacobian)

    def _of_all_rows(self, batch: Batch, sigma: np.ndarray) -> Form:
        """Return the information of all rows of each station of a batch."""
        may = self.free[batch.places[0]]
        values = batch.values(self.values)
        together = batch.together()
        noise = sigma[batch.blocks].reshape(len(batch.stations), -1)
        robust = self.robust[batch.rows]
        form, _ = accumulate_at(together, batch.ends, values, may, robust, noise)
        return _with_beliefs(form, together, values, may)

    def _by_fold(
        self, batch: Batch, fold: np.ndarray, some: range, sigma: np.ndarray, known: Form | None
    ) -> _Folded:
        """Return the contribution of a batch without each fold among ``some``; ``known`` is that of
        all rows, if known.
        """
        n = len(batch.stations)
        may = self.free[batch.places[0]]
        values = batch.values(self.values)
        together = batch.together()
        # Rows that depend on others are evaluated with these.
        is_apart = not (together.sensor.is_whole or together.is_correlated)
        order, ends = _rows_of_parts(batch, fold, some, alone=is_apart and known is not None)
        robust = self.robust[batch.rows][order]
        if self.columns is not None:
            scale = np.repeat(1.0 / sigma, together.block_sizes)[:, None] * together.weights[order]
            found = _sums_of_parts(*self.columns, order, ends, scale * robust)
        else:
            noise = np.repeat(sigma[batch.blocks].reshape(n, -1), (len(ends) - 1) // n, axis=0)
            found, _ = accumulate_at(together.select(order), ends, values, may, robust, noise)
        of_part = Form.of(_by_part(found.H, n), _by_part(found.g, n))
        if known is None:
            form = Form.of(of_part.H.sum(axis=1), of_part.g.sum(axis=1))
            known = _with_beliefs(form, together, values, may)
        sizes = self.sizes[batch.places][:, may]
        offsets = self.values[batch.places][:, may]
        return _Folded(of_part.H, of_part.g, known, (batch.own[may], sizes, offsets))

    def _key(self, k: int, sigma: np.ndarray) -> tuple[int, bytes, bytes]:
        """Return what the contribution of a batch is known by: its noise and robust weights."""
        of = self._batches[k]
        return k, sigma[of.blocks].tobytes(), self.robust[of.rows].tobytes()

    def _contributions(self, sigma: np.ndarray) -> list[_Sums]:
        """Return the contribution of each batch, computed where it is not known for this noise and
        these robust weights.
        """
        batches = self._batches
        sums = self.sums
        keys = [self._key(k, sigma) for k in range(len(batches))]
        todo = [key for key in keys if key not in sums]
        new = [batches[k] for k, _, _ in todo]
        free = [self.free[of.places[0]] for of in new]
        noise = [sigma[of.blocks].reshape(len(of.stations), -1) for of in new]
        priors = [
            (of.own[may], *(by[of.places][:, may] for by in (self.sizes, self.values)))
            for of, may in zip(new, free, strict=True)
        ]
        found: Iterable[_Sums]
        if self._are_kept:
            normals = self._normals
            given = zip([normals[k] for k, _, _ in todo], noise, priors, strict=True)
            found = (
                (eliminate(normal.at(sizes), *prior), normal.squares)
                for normal, sizes, prior in given
            )
        else:
            found = self._done(
                of.work(contribution, self.values, may, self.robust[of.rows], sizes, *prior)
                for of, may, sizes, prior in zip(new, free, noise, priors, strict=True)
            )
        sums |= zip(todo, found, strict=True)
        for key in sums.keys() - keys:
            del sums[key]
        return [sums[key] for key in keys]

    def _done(self, tasks: Iterable[Task]) -> Iterable[Any]:
        """Do tasks, here or on the workers, which receive the stations once."""
        work = self.problem.work
        return (
            map(work, tasks)
            if self.executor is None
            else spread_again(work, tasks, label="station", executor=self.executor)
        )


@dataclass(frozen=True, eq=False)
class _Folded:
    """Normal equations of S stations with F free parameters each, by fold.

    Attributes:
        H, g: of each of K folds, perhaps of the rows of none of them last: shapes (S, K, F, F) and
            (S, K, F).
        whole: of all rows of each station, with what the sensor knows otherwise.
        prior: which parameters are eliminated, their sizes and their offsets.
    """

    H: np.ndarray
    g: np.ndarray
    whole: Form
    prior: tuple[np.ndarray, np.ndarray, np.ndarray]

    @property
    def all_rows(self) -> tuple[Form, Eliminated]:
        """The contribution of all rows."""
        return eliminate(self.whole, *self.prior)

    def without(self, i: int) -> tuple[Form, Eliminated]:
        """Return the contribution of all rows but those of a fold."""
        form = Form.of(self.whole.H - self.H[:, i], self.whole.g - self.g[:, i])
        return eliminate(form, *self.prior)


@dataclass(frozen=True, eq=False)
class WithoutFolds:
    """A problem without the rows of each of some folds.

    Attributes:
        point: the problem at the values of all rows.
        folds: the numbers of the folds.
        whole: the posterior of all rows.
        parts: the contribution of each batch of stations.
    """

    point: Linearised
    folds: range
    whole: Posterior
    parts: Sequence[_Folded]

    def posterior(self, fold: int) -> Posterior:
        """Return the posterior without a fold."""
        i = fold - self.folds.start
        return self.point._assembled(part.without(i) for part in self.parts)

    @property
    def together(self) -> Posterior | None:
        """The posteriors without each fold, with a leading axis; None where parameters of stations
        are eliminated, or equations are large.
        """
        whole = self.whole
        if whole.own or len(self.parts) > 1:
            return None
        (part,) = self.parts
        H = part.H[0, : len(self.folds)]
        if H.nbytes > _MOST_TOGETHER:
            return None
        g = part.g[0, : len(self.folds)]
        lost = np.diagonal(H, axis1=-2, axis2=-1)
        form = Form(whole.form.H - H, whole.form.g - g, whole.form.whole - lost)
        return Posterior(form, whole.sizes, whole.offsets)


def _with_beliefs(form: Form, station: Station, values: np.ndarray, free: np.ndarray) -> Form:
    """Return the information of stations, with a leading axis, and what the sensor of a single one
    knows besides its readings.
    """
    known = believed(station, values, free) if len(form.g) == 1 else None
    return form if known is None else Form.of(form.H + known.H, form.g + known.g)


def _rows_of_parts(
    batch: Batch, fold: np.ndarray, some: range, *, alone: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of a batch station by station and fold by fold, and where each of these parts
    ends, after 0.

    Unless those of the folds among ``some`` are wanted ``alone``, rows of no such fold are a part
    more, the last of a station.
    """
    n = len(batch.stations)
    k = len(some)
    here = fold[batch.rows] - some.start
    part = np.where((here >= 0) & (here < k), here, k)
    station = np.repeat(np.arange(n), np.diff(batch.ends))
    order = np.lexsort((part, station))
    sizes = np.bincount(station * (k + 1) + part, minlength=n * (k + 1)).reshape(n, k + 1)
    if alone:
        order = order[part[order] < k]
        sizes = sizes[:, :k]
    return order, np.cumsum([0, *sizes.ravel()])


def _sums_of_parts(
    residuals: np.ndarray,
    jacobian: Jacobian,
    order: np.ndarray,
    ends: np.ndarray,
    weights: np.ndarray,
) -> Form:
    """Return the information of parts of the rows of a station.

    Args:
        residuals: of all rows, shape (m, N).
        jacobian: of all rows.
        order: the rows of the parts, one after the other, shape (n,).
        ends: boundaries of the parts.
        weights: of the readings of these rows, shape (m, n).
    """
    n_parts = len(ends) - 1
    H = np.zeros((n_parts, jacobian.size, jacobian.size))
    g = np.zeros((n_parts, jacobian.size))
    part = replace(jacobian, dense=jacobian.dense[:, :, order])
    part.add_grams(residuals[:, order], ends, H, g, weights=weights)
    return Form.of(H, g)


def _by_part(sums: np.ndarray, stations: int) -> np.ndarray:
    """Return sums over parts of stations, shape (S parts, ...), with an axis for each."""
    return sums.reshape(stations, -1, *sums.shape[1:])
