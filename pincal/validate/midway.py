r"""Changes midway in a table: the instrument was moved, a joint remastered, or the tool exchanged.

Each is a motion of the targets from some row on, along a field of directions of its own: uniform
for an instrument that was moved, the lever of a joint with another zero, fixed in the tool's frame
for another tool. One scan over rows and fields finds the most significant step. With r the
residuals, C their covariance, F the columns of the fitted parameters, and U the step,

.. math:: g = r^T P U (U^T P U)^{-1} U^T P r,
          \quad P = C^{-1} - C^{-1} F (F^T C^{-1} F)^{-1} F^T C^{-1}

is its gain. Errors of consecutive rows are correlated: a model has the same error at neighbouring
poses, and instruments drift. So C is that of white noise plus a process whose correlation decays
along the rows, estimated by maximum likelihood together with the step. A step is accepted only if
it, with its C, is far more likely than the most likely C without any: a drift or a random walk is
no step.

A variable that changes most between two rows, as time does overnight, is itself nearly a step
there: an effect that follows it is no better explanation than a step unless it explains more
(``along``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.special import chdtri

from pincal.hypotheses.hypothesis import Explanation, likeliest
from pincal.identify.motion_fields import MotionField, sag_of_drives
from pincal.identify.station import Station
from pincal.sensors.row_samples import sample_rows
from pincal.thresholds import Count, Scale
from pincal.validate.causes import (
    BETWEEN_ROWS,
    JOINT,
    THERMAL_GROWTH,
    CellMotions,
    StepCause,
    event_of,
)
from pincal.validate.midway_numbers import MIDWAY

# A drift is a curve of this degree along the rows: it explains six sevenths of a step in the
# middle, less of one elsewhere, and nearly all of a robot that warms up.
_DRIFT: Count = 3
# Rows that suffice to detect a step; around it all rows within so many of these are examined.
_FEW: Count = 400
_AROUND: Count = 3
# Directions of the fitted parameters weaker than this, relative to the strongest, are excluded.
_RANK: Scale = 1e-5
# Functions of a curve that may each follow a step; of more, neighbours do together, as the curve is
# smooth: the few rows would not distinguish so many, nor leave anything of a step.
_FUNCTIONS: Count = 24
# Trial correlation lengths, in rows, and variances of the process from one row to the next, in
# units of white noise: from what 400 rows would hardly show to the process alone. The longest is a
# random walk.
_LENGTHS: tuple[Scale, ...] = (3.0, 10.0, 30.0, 100.0, 1000.0)
_WALKS: tuple[Scale, ...] = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0, 100.0)
# Largest fraction of the rows that may be missing between two of them.
_LONGEST_GAP: Scale = 0.2
# Other orders of the rows in which a step is looked for.
_ORDERS: Count = 99
# Rounds in which a step and its noise are estimated in turn; iterations of a robust estimate of a
# step's size.
_TRIES: Count = 4
_TURNS: Count = 20


@dataclass(frozen=True)
class StepChange:
    """A row from which on something is different.

    Attributes:
        line: of the first row after the change.
        cause: the best explanation.
        others: equally good ones.
    """

    line: int
    cause: StepCause
    others: tuple[StepCause, ...] = ()

    def __str__(self) -> str:
        return " Or: ".join(map(str, (self.cause, *self.others)))


@dataclass(frozen=True)
class _Rows:
    """Rows in their order.

    Attributes:
        off: shape (n, 3), displacement of each target from its prediction [m].
        fitted: shape (n, 3, r), orthonormal directions of the fitted parameters.
        fields: of possible changes.
        growth: growth about some point, as of a robot or an instrument that warms up.
        at: shape (n,), position of each row in the table, 1 apart in the median.
        pose: shape (n,), number of the pose of each row; several targets of a pose share the
            arrival of the drives.
    """

    off: np.ndarray
    fitted: np.ndarray
    fields: tuple[MotionField, ...]
    growth: MotionField
    at: np.ndarray
    pose: np.ndarray

    def in_order(self, order: np.ndarray) -> _Rows:
        """Return the rows in another order, at the same positions."""
        fields = tuple(replace(field, directions=field.directions[order]) for field in self.fields)
        growth = replace(self.growth, directions=self.growth.directions[order])
        off = self.off[order]
        return _Rows(off, self.fitted[order], fields, growth, self.at, self.pose[order])

    def residuals(self, off: np.ndarray) -> np.ndarray:
        """Return displacements, shape (n, 3), minus their projection onto the fitted parameters."""
        flat = self.fitted.reshape(off.size, -1)
        return np.asarray((off.ravel() - flat @ (flat.T @ off.ravel())).reshape(off.shape))


@dataclass(frozen=True)
class _Best:
    """The best step along a field: its first row, gain and motion."""

    field: MotionField
    row: int
    gain: float
    motion: np.ndarray

    @property
    def step(self) -> np.ndarray:
        """The field from the step on, shape (n, 3, m)."""
        return np.where(
            np.arange(len(self.field.directions))[:, None, None] >= self.row,
            self.field.directions,
            0.0,
        )


def change_in(
    station: Station,
    values: np.ndarray,
    free: np.ndarray,
    lines: np.ndarray,
    *,
    along: np.ndarray | None = None,
) -> StepChange | None:
    """Return where, in the order of the rows, something changed, and what; None if nothing did.

    Args:
        station: the calibrated model over the rows.
        values: shape (P,), of its parameters.
        free: shape (P,), which of them were fitted.
        lines: shape (N,), line of each row, or its position in the order.
        along: shape (N,), a variable such as the time: if a motion in proportion to it is far more
            likely than the step, nothing changed at once.
    """
    order = np.argsort(lines, kind="stable")
    if not station.sensor.reads_pose or len(order) < 4 * MIDWAY.each:
        return None
    few = sample_rows(len(order), _FEW)
    at = _places(lines[order], few)
    rows = _rows(station.select(order[few]), values, free, at)
    if not _is_loud(rows):
        return None
    found = _judged(rows)
    if not found.is_step or (along is not None and found.follows(along[order[few]])):
        return None
    # What sags in a rigid model is none of what changed.
    sagging = _rows(station.select(order[few]), values, free, at, sags=True)
    if sagging.fitted.shape != rows.fitted.shape and not _judged(sagging).is_step:
        return None
    first, *others = found.causes()
    place = (
        order[few[found.best.row]]
        if len(few) == len(order)
        else order[_near(station, values, free, order, few, found.best)]
    )
    return StepChange(int(lines[place]), first, tuple(others))


def _places(lines: np.ndarray, few: np.ndarray) -> np.ndarray:
    """Return the positions of some rows of a table, 1 apart in the median, for their sorted lines.

    Held-out rows are missing between others, and noise evolves there; a night counts as a limited
    number of rows.
    """
    gaps = np.diff(lines[few].astype(float), prepend=lines[0])
    gaps = np.minimum(gaps / max(float(np.median(gaps)), 1e-9), _LONGEST_GAP * len(few))
    return np.asarray(np.cumsum(gaps))


def _rows(
    station: Station, values: np.ndarray, free: np.ndarray, at: np.ndarray, *, sags: bool = False
) -> _Rows:
    """Return the data of rows in order; with ``sags``, what compliances of the drives move counts
    as fitted, too.
    """
    # Displacements follow from the readings without whitening.
    station = replace(station, whitening=None, serial=None, arrival=None)
    n = len(station)
    parts = (
        jacobian.columns(_FUNCTIONS, slice(3))
        for _, _, jacobian in station.linearise_shared(values, free)
    )
    J = np.concatenate([part.transpose(2, 1, 0) for part in parts])
    if sags:
        J = np.concatenate([J, sag_of_drives(station, values)], axis=2)
    J = J.reshape(3 * n, -1)
    J = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    sizes, axes = np.linalg.eigh(J.T @ J)
    kept = sizes > _RANK**2 * sizes[-1]
    fitted = (J @ (axes[:, kept] / np.sqrt(sizes[kept]))).reshape(n, 3, -1)
    cell = CellMotions(station, values)
    fields = tuple(field for event in BETWEEN_ROWS for field in event.fields(cell))
    (growth,) = THERMAL_GROWTH.fields(cell)
    pose = np.unique(station.conditions.q, axis=0, return_inverse=True)[1].ravel()
    return _Rows(station.displacements(values), fitted, fields, growth, at, pose)


def _clipped(off: np.ndarray) -> np.ndarray:
    long = np.linalg.norm(off, axis=1, keepdims=True)
    return np.asarray(
        off * np.minimum(1.0, MIDWAY.clipped * np.median(long) / np.maximum(long, 1e-300))
    )


def _is_loud(rows: _Rows) -> bool:
    """Return whether some step exceeds the differences between means of neighbours: a cheap test
    that few tables pass.
    """
    best = _plain(rows)
    left = rows.residuals(_clipped(rows.off) - best.step @ best.motion)
    width = int(np.sqrt(len(left)))
    means = left[: len(left) // width * width].reshape(-1, width, 3).mean(axis=1)
    return best.gain > MIDWAY.examined * max(
        width * float(np.mean(means**2)), float(np.mean(left**2))
    )


@dataclass(frozen=True)
class _Judged:
    """The best step along each field, in the noise that is likeliest with the best one.

    Attributes:
        rows: in their order.
        steps: gains in units of the noise.
        precision: of the noise of each coordinate, shape (n, n).
        likelihood: of the best step, twice the log ratio to no step.
    """

    rows: _Rows
    steps: tuple[_Best, ...]
    precision: np.ndarray
    likelihood: float

    @cached_property
    def best(self) -> _Best:
        """The most significant step."""
        return max(self.steps, key=_excess)

    @property
    def is_step(self) -> bool:
        """Whether something changed at once: no chance, no drift, and more than correlated noise
        does.
        """
        best = self.best
        if min(_excess(best), self.likelihood - _limit(best)) < 0.0:
            return False
        if best.gain < self._gain_of(_curves_along_rows(self.rows)) or self._is_noise:
            return False
        return _chance_in_any_order(self.rows) < MIDWAY.in_any_order

    def follows(self, along: np.ndarray) -> bool:
        """Return whether a motion in proportion to a variable, shape (n,), explains far more."""
        return self.best.gain + MIDWAY.distinguished < self._gain_of(_centred(along)[:, None])

    def _gain_of(self, curves: np.ndarray) -> float:
        """Return the gain of a motion that follows functions of the rows, shape (n, k), along the
        field of the step, or of growth.
        """
        return max(
            _drift(self.rows, field, curves, self.precision)
            for field in (self.best.field, self.rows.growth)
        )

    @property
    def _is_noise(self) -> bool:
        """Whether noise is correlated along the rows, and the step no larger than the residuals.

        These are of a fit to independent rows: under persistent noise, a fit keeps part of them.
        """
        after = _robust_step(self.rows, self.best)[self.best.row :]
        left = self.rows.residuals(self.rows.off)
        diagonal = np.diag(self.precision).mean()
        beside = np.abs(np.diag(self.precision, 1)).mean()
        is_correlated = beside > MIDWAY.correlated * diagonal
        smallest = MIDWAY.least_part * np.sqrt(np.mean(left**2))
        return bool(is_correlated and np.sqrt(np.mean(after**2)) < smallest)

    def causes(self) -> tuple[StepCause, ...]:
        """Return the cause that is believed, and those that are as likely."""
        ranked = sorted(self.steps, key=_excess, reverse=True)
        found = likeliest(
            [Explanation(step, -_excess(step)) for step in ranked],
            lambda least: min(least + MIDWAY.distinguished, 0.0),
        )
        causes = dict[str, StepCause]()
        for step in () if found is None else found.every:
            if step.field.name not in causes:
                causes[step.field.name] = _cause(self.rows, step)
        return tuple(causes.values())


def _judged(rows: _Rows) -> _Judged:
    """Return the best step along each field, and the noise.

    A joint with uneven arrival scatters more along its lever than in other directions: if the best
    step is along it, all gains are reduced accordingly.
    """
    best = _plain(rows)
    for _ in range(_TRIES):
        precision, likelihood = _noise_with(rows, best)
        steps = _scan(rows, precision)
        before = best
        best = max(steps, key=_excess)
        if best.row == before.row and best.field is before.field:
            break
    even = 1.0 / max(_unevenness(rows, best), _togetherness(rows, best))
    reduced = tuple(replace(step, gain=even * step.gain) for step in steps)
    return _Judged(rows, reduced, even * precision, even * likelihood)


def _chance_in_any_order(rows: _Rows) -> float:
    """Return the chance of a step as large as the best one where the order of the rows means
    nothing.

    What a model lacks is as large in any order: of few rows, or where a few are far off, some step
    explains much of it. The largest steps in random orders of the poses have a Gumbel distribution.
    """
    rng = np.random.default_rng(0)
    sizes = []
    for _ in range(_ORDERS):
        key = rng.random(int(rows.pose.max(initial=-1)) + 1)
        best = _plain(rows.in_order(np.argsort(key[rows.pose], kind="stable")))
        sizes.append(best.gain / _limit(best))
    here = _plain(rows)
    width = max(float(np.std(sizes)) * np.sqrt(6.0) / np.pi, 1e-300)
    middle = float(np.mean(sizes)) - np.euler_gamma * width
    return float(-np.expm1(-np.exp(-(here.gain / _limit(here) - middle) / width)))


def _unevenness(rows: _Rows, step: _Best) -> float:
    """Return the ratio of the variance along the lever of a joint to the average one;
    at least 1.
    """
    if step.field.freedoms > 1:
        return 1.0
    left = rows.residuals(_clipped(rows.off - _robust_step(rows, step)))
    way = step.field.directions @ step.motion
    along = float(np.sum(np.sum(left * way, axis=1) ** 2) / np.sum(way**2))
    return max(along / float(np.mean(left**2)), 1.0)


def _togetherness(rows: _Rows, step: _Best) -> float:
    """Return the variance of sums of residuals over the targets of a pose, relative to independent
    ones; at least 1.
    """
    left = rows.residuals(_clipped(rows.off - _robust_step(rows, step)))
    count = np.bincount(rows.pose)
    if count.max() == 1:
        return 1.0
    sums = np.stack([np.bincount(rows.pose, column) for column in left.T], axis=1)
    return max(float(np.sum(sums**2) / np.sum(left**2)), 1.0)


def _plain(rows: _Rows) -> _Best:
    """Return the best step for independent rows."""
    return max(_scan(rows, None), key=lambda step: step.gain / _limit(step))


def _limit(step: _Best) -> float:
    """Return the largest gain by chance, in units of the noise, over all rows and with all freedoms
    of a field.
    """
    return float(chdtri(step.field.freedoms, MIDWAY.chance / len(step.field.directions)))


def _excess(step: _Best) -> float:
    """Return the gain of a step beyond the largest one by chance."""
    return step.gain - _limit(step)


def _scan(rows: _Rows, precision: np.ndarray | None) -> list[_Best]:
    """Return the best step along each field, for a precision of each coordinate of shape (n, n);
    default: 1.
    """
    n = len(rows.off)
    off = _clipped(rows.off)
    if precision is None:
        # The directions are orthonormal already.
        left = rows.residuals(off)
        return [_best(field, None, left, rows.fitted) for field in rows.fields]
    fitted = rows.fitted.reshape(n, -1)
    seen = (precision @ fitted).reshape(rows.fitted.shape)
    inner = np.tensordot(rows.fitted, seen, axes=((0, 1), (0, 1)))
    sizes, axes = np.linalg.eigh(inner)
    kept = sizes > _RANK**2 * sizes[-1]
    basis = axes[:, kept] / np.sqrt(sizes[kept])
    seen = seen @ basis
    left = off - (rows.fitted @ basis) @ np.tensordot(seen, off, axes=((0, 1), (0, 1)))
    weighed = precision @ left
    return [_best(field, precision, weighed, seen) for field in rows.fields]


def _best(
    field: MotionField, precision: np.ndarray | None, weighed: np.ndarray, seen: np.ndarray
) -> _Best:
    """Return the best step along a field, for residuals, shape (n, 3), and parameters, shape
    (n, 3, r), weighted by a precision; default: 1.
    """
    D = field.directions
    n, _, m = D.shape
    across = D.transpose(0, 2, 1)
    sums = _after(np.einsum("nam,na->nm", D, weighed))
    parts = _after(across @ seen)
    if precision is None:
        own = _after(across @ D)
    else:
        own = np.empty((n, m, m))
        for a in range(m):
            for b in range(a, m):
                both = precision * (D[:, :, a] @ D[:, :, b].T)
                own[:, a, b] = own[:, b, a] = _after_both(both)
    normal = own - parts @ parts.transpose(0, 2, 1)
    # A motion within the span of the fitted parameters has no gain.
    scale = np.sqrt(np.maximum(np.einsum("naa->na", own), 1e-300))
    normal = normal / (scale[:, :, None] * scale[:, None, :]) + _RANK * np.eye(m)
    inside = slice(MIDWAY.each, n - MIDWAY.each + 1)
    motions = (
        np.linalg.solve(normal[inside], (sums / scale)[inside, :, None])[:, :, 0] / scale[inside]
    )
    gains = np.sum(motions * sums[inside], axis=1)
    k = int(np.argmax(gains))
    return _Best(field, k + MIDWAY.each, float(gains[k]), motions[k])


def _after(values: np.ndarray) -> np.ndarray:
    """Return the sums from each row on."""
    return np.asarray(np.cumsum(values[::-1], axis=0)[::-1])


def _after_both(values: np.ndarray) -> np.ndarray:
    """Return the sums of a matrix from each row on and the column of the same number on."""
    along_row = np.triu(values).sum(axis=1)
    down_column = np.tril(values, -1).sum(axis=0)
    return _after(along_row + down_column)


def _noise_with(rows: _Rows, step: _Best) -> tuple[np.ndarray, float]:
    """Return the precision of the residuals of a step, shape (n, n), and twice its log likelihood
    ratio to no step.

    The likelihood is restricted, with the fitted parameters marginalised.
    """
    n = len(rows.off)
    r = rows.fitted.shape[2]
    explained = _robust_step(rows, step)
    off = explained + _clipped(rows.off - explained)
    scaled = step.step / np.maximum(np.abs(step.step).max(axis=(0, 1)), 1e-300)
    columns = np.concatenate([rows.fitted, scaled, off[:, :, None]], axis=2).reshape(n, -1)
    apart = np.abs(rows.at[:, None] - rows.at)
    degrees = 3 * n - r
    without = np.inf
    best = np.inf
    precision = np.eye(n)
    for length, walk in ((1.0, 0.0), *((length, walk) for length in _LENGTHS for walk in _WALKS)):
        C = np.eye(n) + 0.5 * walk * length * np.exp(-apart / length)
        L = cholesky(C, lower=True, check_finite=False)
        white = solve_triangular(L, columns, lower=True, check_finite=False).reshape(3 * n, -1)
        R = np.asarray(np.linalg.qr(white, mode="r"))
        volume = 6.0 * np.sum(np.log(np.diag(L))) + 2.0 * np.sum(np.log(np.abs(np.diag(R)[:r])))
        squares = [max(float(np.sum(R[k:, -1] ** 2)), 1e-300) for k in (r, len(R) - 1)]
        costs = [float(degrees * np.log(square) + volume) for square in squares]
        without = min(without, costs[0])
        if costs[1] < best:
            variance = squares[1] / (degrees - step.field.freedoms)
            best = costs[1]
            precision = cho_solve((L, True), np.eye(n), check_finite=False) / variance
    return precision, without - best


def _robust_step(rows: _Rows, step: _Best) -> np.ndarray:
    """Return the displacements that a step explains, shape (n, 3), its size estimated with clipped
    residuals.
    """
    X = np.concatenate([step.step, rows.fitted], axis=2).reshape(rows.off.size, -1)
    inverse = np.linalg.pinv(X)
    fitted = np.zeros_like(rows.off)
    for _ in range(_TURNS):
        fitted = (X @ (inverse @ (fitted + _clipped(rows.off - fitted)).ravel())).reshape(
            rows.off.shape
        )
    m = step.field.freedoms
    return np.asarray(
        (X[:, :m] @ (inverse[:m] @ (fitted + _clipped(rows.off - fitted)).ravel())).reshape(
            rows.off.shape
        )
    )


def _cause(rows: _Rows, step: _Best) -> StepCause:
    """Return the cause of a step: displacement of the targets, or of a joint."""
    moved = _robust_step(rows, step)
    lever = step.step
    if event_of(step.field.name) is not JOINT:
        after = moved[step.row :]
        return StepCause(step.field.name, float(np.sqrt(np.mean(np.sum(after**2, axis=1)))), "m")
    return StepCause(
        step.field.name,
        float(abs(np.sum(moved * lever[:, :, 0]) / np.sum(lever**2))),
        step.field.unit,
    )


def _curves_along_rows(rows: _Rows) -> np.ndarray:
    """Return functions that vary smoothly along the rows, shape (n, k)."""
    return np.asarray(
        np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, len(rows.off)), _DRIFT)[:, 1:]
    )


def _centred(x: np.ndarray) -> np.ndarray:
    """Return a variable, shape (n,), about its mean and at most 1 away from it."""
    about = x - x.mean()
    return np.asarray(about / max(float(np.abs(about).max()), 1e-300))


def _drift(rows: _Rows, field: MotionField, curves: np.ndarray, precision: np.ndarray) -> float:
    """Return the gain of a motion along a field that follows some functions of the rows, shape (n,
    k).
    """
    n = len(rows.off)
    drift = (field.directions[:, :, :, None] * curves[:, None, None, :]).reshape(n, 3, -1)
    X = np.concatenate(
        [rows.fitted, drift / np.maximum(np.abs(drift).max(axis=(0, 1)), 1e-300)], axis=2
    )
    off = _clipped(rows.off)
    squares = []
    for columns in (rows.fitted, X):
        seen = (precision @ columns.reshape(n, -1)).reshape(columns.shape)
        inner = np.tensordot(columns, seen, axes=((0, 1), (0, 1)))
        right = np.tensordot(seen, off, axes=((0, 1), (0, 1)))
        squares.append(float(right @ np.linalg.lstsq(inner, right, rcond=_RANK**2)[0]))
    return squares[1] - squares[0]


def _near(
    station: Station,
    values: np.ndarray,
    free: np.ndarray,
    order: np.ndarray,
    few: np.ndarray,
    best: _Best,
) -> int:
    """Return the first row after a step, searched among all rows near it."""
    around = (
        few[max(best.row - _AROUND * MIDWAY.each, 0)],
        few[min(best.row + _AROUND * MIDWAY.each, len(few) - 1)],
    )
    places = np.arange(around[0], around[1] + 1)
    rows = _rows(station.select(order[places]), values, free, places.astype(float))
    same = [step for step in _scan(rows, None) if step.field.name == best.field.name]
    fitting = min(same, key=lambda step: abs(step.field.freedoms - best.field.freedoms))
    return int(places[fitting.row])
