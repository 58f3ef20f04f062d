"""Changes between visits of the same poses: a step, a drift along the rows, or a difference by the
number of the visit.

A fit uses the mean of all visits of a pose, in which a change between two passes is invisible: it
moves all means alike. The deviations of single visits from this mean show it, whatever the model
(:mod:`pincal.validate.visit_scan`). Readings of one stop share its arrival and are averaged before;
readings within a stop are compared with each other in the same way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import bdtrc, chdtri

from pincal.hypotheses.hypothesis import Explanation, likeliest
from pincal.identify.motion_fields import MotionField
from pincal.identify.station import Station
from pincal.identify.visit_numbers import VISITS
from pincal.identify.visit_scatter import Arrivals
from pincal.measure.measurements import Measurements
from pincal.measure.poses import without_copies
from pincal.measure.stops import Plan, plan_of
from pincal.sensors.row_samples import evenly
from pincal.thresholds import Count
from pincal.validate.causes import (
    BETWEEN_VISITS,
    INSTRUMENT,
    JOINT,
    CellMotions,
    StepCause,
    event_of,
    without_like,
)
from pincal.validate.midway import StepChange
from pincal.validate.visit_scan import Best, Pattern, Scan, Visits

# Changes looked for in one table, the most significant first.
_MOST: Count = 3
# Stops from which on a step may begin at most, spread over the table; those around the best are
# then all tried.
_CUTS: Count = 150
# Rounds in which a change and the scatter without it are estimated in turn.
_TURNS: Count = 2
# Degree of the curves of a drift that is not steady.
_DRIFT: Count = 3


@dataclass(frozen=True)
class VisitChange:
    """What differs between visits of the same poses.

    Attributes:
        kind: "step", "drift" or "order".
        causes: the best explanation first, then equally good ones.
        size: largest difference between two visits of a pose that it explains [m].
        within: whether it concerns readings within a stop.
        pattern: of visits that differ by their number, which ones, in words.
        line: of the first row after a step.
        lines: the first and the last line that are as likely.
    """

    kind: str
    causes: tuple[StepCause, ...]
    size: float
    within: bool = False
    pattern: str = ""
    line: int = 0
    lines: tuple[int, int] = (0, 0)

    @property
    def step(self) -> StepChange:
        """The step."""
        first, *others = self.causes
        return StepChange(self.line, first, tuple(others))

    def __str__(self) -> str:
        if self.kind == "step":
            return str(self.step)
        what = "readings within a stop" if self.within else "visits of the same pose"
        far = f"by up to {1e3 * self.size:.2g} mm"
        if self.kind == "drift":
            return f"{what} drift apart along the rows {far}: {self._words('drift')}"
        columns = (event_of(cause.name).column.format(name=cause.name) for cause in self.causes)
        return (
            f"{what} differ {self.pattern} {far}, {self._words('visits')}; a column would tell "
            f"why: {', '.join(dict.fromkeys(columns))}"
        )

    def _words(self, which: Literal["drift", "visits"]) -> str:
        """Return what the causes are like, in words, each once."""
        words = (
            getattr(event_of(cause.name), which).format(name=cause.name) for cause in self.causes
        )
        return " or ".join(dict.fromkeys(words))


@dataclass(frozen=True)
class _Rows:
    """Visits of poses that were visited more than once, and what they are in the table.

    Attributes:
        visits: the readings.
        first: shape (n,), index in the table of the first row of each.
        lines: shape (stops,), line of the first row of each stop of the table.
        along: shape (n,), place of its stop in the order, from -1 to 1.
        rank: shape (n,), number of the visit among those of its pose, from 0.
        passes: shape (n,), number of its pass.
        within: whether visits are readings within a stop.
    """

    visits: Visits
    first: np.ndarray
    lines: np.ndarray
    along: np.ndarray
    rank: np.ndarray
    passes: np.ndarray
    within: bool

    def patterns(self) -> list[Pattern]:
        """Return the patterns that are tried."""
        if self.within:
            return [self._order()]
        patterns = [self._steps(_CUTS), self._order(), self._drift(1), self._drift(_DRIFT)]
        return patterns if (touched := self._touched()) is None else [touched, *patterns]

    def _touched(self) -> Pattern | None:
        """Return the steps of the instrument between two passes, where it is most likely to be
        touched.
        """
        begun, first = np.unique(self.passes, return_index=True)
        if not 1 < len(begun) <= VISITS.few_passes:
            return None
        after = (self.passes[:, None] >= begun[1:]).astype(float)
        others = frozenset(field.name for field in self.visits.fields) - {INSTRUMENT.name}
        return Pattern(
            "step", after[:, :, None], others, VISITS.touched, self.visits.visit[first[1:]]
        )

    def steps(self) -> Pattern:
        """Return the steps from each stop on."""
        return self._steps(len(self.first))

    def _steps(self, most: int) -> Pattern:
        begins = self.begins(most)
        after = (self.visits.visit[:, None] >= begins).astype(float)
        never = frozenset(event.name for event in BETWEEN_VISITS if not event.step)
        return Pattern("step", after[:, :, None], never, begins=begins)

    def begins(self, most: int) -> np.ndarray:
        """Return the numbers of the stops from which a step may begin, at most so many,
        shape (K,).
        """
        numbers = np.unique(self.visits.visit)[1:]
        thing = self.visits.thing
        after = np.array([np.bincount(thing, self.visits.visit >= number) for number in numbers])
        both = (
            np.count_nonzero((after > 0) & (after < self.visits.count), axis=1)
            if len(numbers)
            else after
        )
        numbers = numbers[both >= min(VISITS.both_sides, len(self.visits.count))]
        return np.asarray(numbers[evenly(len(numbers), most)])

    def _drift(self, degree: int) -> Pattern:
        curves = np.polynomial.legendre.legvander(self.along, degree)[:, 1:]
        return Pattern("drift", curves[:, None, :])

    def _order(self) -> Pattern:
        several = [
            self.rank.astype(float),
            (self.rank > 0).astype(float),
            (self.rank % 2).astype(float),
        ]
        kinds = several if self.rank.max() > 1 else several[:1]
        return Pattern("order", np.stack(kinds, axis=1)[:, :, None])


def changes_between_visits(
    station: Station, values: np.ndarray, table: Measurements
) -> list[VisitChange]:
    """Return what changed between visits of the same poses, and between readings of the same stops.

    Args:
        station: the calibrated model over the rows of the table.
        values: shape (P,), of its parameters.
        table: the rows as measured.
    """
    found = list[VisitChange]()
    for rows in _rows_of(station, values, table):
        found += _changes(rows)
    return found


@dataclass(frozen=True)
class VisitScatter:
    """Deviations of readings from the mean of their pose, or of their stop.

    Attributes:
        visits: the readings.
        within: whether they are readings within a stop.
    """

    visits: Visits
    within: bool

    @property
    def size(self) -> float:
        """Standard deviation of one coordinate of a reading [m]."""
        return float(np.sqrt(np.sum(self.visits.off**2) / self.visits.degrees))

    @property
    def typical(self) -> float:
        """The same of a typical pose or stop, whatever a few others are like [m]."""
        squares, degrees = self._by_thing()
        return float(np.sqrt(np.median(squares / chdtri(degrees, 0.5))))

    def larger(self, noise: float) -> float:
        """Return the probability that so many poses, or stops, differ by more than the median for a
        noise [m].

        A sign test: some consecutive rows of a pose may be of two stops, which nothing tells.
        """
        squares, degrees = self._by_thing()
        above = int(np.count_nonzero(squares > noise**2 * chdtri(degrees, 0.5)))
        return float(bdtrc(above - 1, len(squares), 0.5)) if above else 1.0

    def _by_thing(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the sum of squares of each pose or stop and target, and its degrees of freedom."""
        visits = self.visits
        squares = np.bincount(visits.thing, np.sum(visits.off**2, axis=1))
        return squares, 3.0 * (visits.count - 1.0)

    def square(self, noise: float, arrival: float) -> tuple[float, float]:
        """Return the sum of squares for a noise [m] and an arrival of all joints [rad or m], and
        its degrees of freedom.

        Targets that are read in one stop share its arrival, so they count as one.
        """
        visits = self.visits
        joints = visits.levers.shape[2]
        covariance = Arrivals(np.full(3, noise), np.full(joints, arrival)).covariance(
            visits.levers
        )[visits.thing]
        squares = np.sum(visits.off * np.linalg.solve(covariance, visits.off[:, :, None])[:, :, 0])
        together = 1.0 if not arrival else len(np.unique(visits.visit)) / len(visits.visit)
        return float(squares) * together, visits.degrees * together


def scatters_of(
    station: Station, values: np.ndarray, table: Measurements
) -> Iterator[VisitScatter]:
    """Yield the scatter between visits of the same poses, then between readings of the same stops;
    arguments as before.
    """
    for rows in _rows_of(station, values, table):
        yield VisitScatter(rows.visits, rows.within)


def _changes(rows: _Rows) -> Iterator[VisitChange]:
    """Yield what changed, the most significant first, each without those before."""
    visits = rows.visits
    for _ in range(_MOST):
        scan = Scan.of(visits, np.zeros_like(visits.off))
        found = _best_pattern(scan, rows.patterns())
        if found is None:
            return
        pattern, best = found
        if pattern.begins is not None and len(pattern.begins) == _CUTS:
            pattern = rows.steps()
        for _ in range(_TURNS):
            best = next(other for other in scan.best(pattern) if other.field is best.field)
            explained = scan.motion(pattern, best)
            scan = Scan.of(visits, explained)
            best = max(scan.best(pattern), key=lambda found: found.likelihood)
        explained = scan.motion(pattern, best)
        yield _described(rows, scan, pattern=pattern, best=best)
        visits = replace(visits, off=visits.centred(visits.off - explained))
        rows = replace(rows, visits=visits)


def _best_pattern(scan: Scan, patterns: list[Pattern]) -> tuple[Pattern, Best] | None:
    """Return the pattern that visits follow, with its best field; None if they follow none.

    A step, most of all one between passes, or a difference from visit to visit, may be the same
    pattern as a drift, and explains it with less: the patterns stand in this order.
    """
    seen = [pattern for pattern in patterns if scan.chance(pattern) < pattern.limit]
    bests = [max(scan.best(pattern), key=lambda found: found.likelihood) for pattern in seen]
    found = likeliest(
        [Explanation(pair, -pair[1].likelihood) for pair in zip(seen, bests, strict=True)],
        lambda least: least + VISITS.as_good,
    )
    return None if found is None else found.best


def _described(rows: _Rows, scan: Scan, *, pattern: Pattern, best: Best) -> VisitChange:
    """Return a change with its likely causes."""
    size = _largest_difference(rows.visits, scan.motion(pattern, best))
    causes = _causes(rows, scan, pattern)
    change = VisitChange(pattern.kind, causes, size, rows.within)
    if pattern.kind == "order":
        words = ("more with each", "from the first", "by turns")
        only = "between the first and the second"
        return replace(change, pattern=words[best.pattern] if pattern.x.shape[1] > 1 else only)
    if pattern.begins is not None:
        line = int(rows.lines[pattern.begins[best.pattern]])
        return replace(change, line=line, lines=_likely_lines(rows, scan, pattern, best))
    return change


def _causes(rows: _Rows, scan: Scan, pattern: Pattern) -> tuple[StepCause, ...]:
    """Return the cause that is believed, and those that are as likely."""
    ranked = sorted(scan.best(pattern), key=lambda other: -other.likelihood)
    found = likeliest(
        [Explanation(other, -other.likelihood) for other in ranked],
        lambda least: least + VISITS.as_likely,
    )
    causes = dict[str, StepCause]()
    for other in () if found is None else found.every:
        if other.field.name not in causes:
            motion = scan.motion(pattern, other)
            causes[other.field.name] = _cause(rows, motion, pattern, other)
    return without_like(causes)


def _likely_lines(rows: _Rows, scan: Scan, pattern: Pattern, best: Best) -> tuple[int, int]:
    """Return the first and the last line at which a step is as likely to begin."""
    assert pattern.begins is not None
    gains = scan.gains(pattern, best.field)
    ratios = best.degrees * -np.log(np.maximum(scan.total - gains, 1e-12 * scan.total))
    close = pattern.begins[ratios > ratios.max() - VISITS.same_line]
    # Poses that were visited once tell nothing of what lies between the last visit before and
    # the first one after.
    before = rows.visits.visit[rows.visits.visit < close[0]].max()
    return int(rows.lines[before + 1]), int(rows.lines[close[-1]])


def _cause(rows: _Rows, motion: np.ndarray, pattern: Pattern, best: Best) -> StepCause:
    """Return the cause of a displacement of shape (n, 3): its size is that of the target [m] or of
    the joint.
    """
    visits = rows.visits
    field = best.field
    whole = motion - motion[np.unique(visits.thing, return_index=True)[1]][visits.thing]
    if event_of(field.name) is not JOINT:
        lengths = np.linalg.norm(whole, axis=1)
        moved = lengths[lengths > 0.0]
        return StepCause(field.name, float(np.sqrt(np.mean(moved**2))) if len(moved) else 0.0, "m")
    x = visits.centred(pattern.x[:, best.pattern])[:, 0]
    lever = field.directions[visits.thing, :, 0] * x[:, None]
    size = float(abs(np.sum(motion * lever)) / max(float(np.sum(lever**2)), 1e-300))
    return StepCause(field.name, size, field.unit)


def _largest_difference(visits: Visits, motion: np.ndarray) -> float:
    """Return the largest distance between two visits of a pose in a displacement of shape (n, 3)
    [m].
    """
    low = np.full((len(visits.count), 3), np.inf)
    high = -low
    np.minimum.at(low, visits.thing, motion)
    np.maximum.at(high, visits.thing, motion)
    return float(np.linalg.norm(high - low, axis=1).max())


def _rows_of(station: Station, values: np.ndarray, table: Measurements) -> Iterator[_Rows]:
    """Yield the visits of poses, then the readings within stops, where there are several."""
    if not station.sensor.reads_pose or table.is_of_motion or table.readings_per_row is not None:
        return
    plan = plan_of(table)
    if not (plan.is_revisited or plan.is_repeated):
        return
    kept = np.zeros(len(table), bool)
    kept[without_copies(table, plan.thing)] = True
    readings = _Readings(station, values, plan, table.rows, kept, station.displacements(values))
    if plan.is_revisited:
        yield from readings.grouped(_Grouping(plan.thing, plan.stop, plan.visit))
    if plan.is_repeated:
        yield from readings.grouped(_within_stops(plan))


@dataclass(frozen=True, eq=False)
class _Grouping:
    """Readings that are compared with each other, each array of shape (N,).

    Attributes:
        group: of which readings should be the same.
        visit: number of the visit; those of a group and a visit are averaged.
        rank: number of the visit among those of its group, from 0.
        within: whether groups are those of a stop.
    """

    group: np.ndarray
    visit: np.ndarray
    rank: np.ndarray
    within: bool = False


def _within_stops(plan: Plan) -> _Grouping:
    """Return the grouping by stop and target, of which each reading is a visit."""
    rank = _ranks(plan)
    pairs = np.column_stack([plan.stop, plan.thing])
    group = np.unique(pairs, axis=0, return_inverse=True)[1].ravel()
    visit = plan.stop * (int(rank.max()) + 1) + rank
    return _Grouping(group, visit, rank, within=True)


def _ranks(plan: Plan) -> np.ndarray:
    """Return the number of each reading among those of its target in its stop, from 0,
    shape (N,).
    """
    rank = np.zeros(len(plan), int)
    seen = dict[tuple[int, int], int]()
    for row in plan.order.tolist():
        key = int(plan.stop[row]), int(plan.thing[row])
        rank[row] = seen.get(key, 0)
        seen[key] = rank[row] + 1
    return rank


@dataclass(frozen=True, eq=False)
class _Readings:
    """The readings of a table.

    Attributes:
        station: the calibrated model over its rows.
        values: of its parameters, shape (P,).
        plan: how the rows came about.
        lines: shape (N,), of the rows.
        kept: shape (N,), which rows are no copies of others.
        off: shape (N, 3), displacements from the predictions [m].
    """

    station: Station
    values: np.ndarray
    plan: Plan
    lines: np.ndarray
    kept: np.ndarray
    off: np.ndarray

    def grouped(self, of: _Grouping) -> Iterator[_Rows]:
        """Yield the visits of groups with several of them, if there are enough."""
        plan = self.plan
        first, means = self._means(of)
        several = np.bincount(of.group[first], minlength=int(of.group.max()) + 1) > 1
        again = several[of.group[first]]
        first = first[again]
        thing = np.unique(of.group[first], return_inverse=True)[1].ravel()
        if len(first) - len(np.unique(thing)) < VISITS.both_sides:
            return
        visits = self._visits(first, thing, of.visit[first])
        visits = replace(visits, off=visits.centred(means[again]))
        begins = np.unique(plan.stop[plan.order], return_index=True)[1]
        along = 2.0 * plan.stop[first] / max(len(begins) - 1, 1) - 1.0
        lines = self.lines[plan.order[begins]]
        yield _Rows(visits, first, lines, along, of.rank[first], plan.passes[first], of.within)

    def _means(self, of: _Grouping) -> tuple[np.ndarray, np.ndarray]:
        """Return the first row of each group in each visit, shape (m,), and the mean of its
        displacements, shape (m, 3).
        """
        rows = self.plan.order[self.kept[self.plan.order]]
        slots = np.column_stack([of.visit, of.group])[rows]
        _, first, slot = np.unique(slots, axis=0, return_index=True, return_inverse=True)
        slot = slot.ravel()
        sums = np.stack([np.bincount(slot, column) for column in self.off[rows].T], axis=1)
        return rows[first], sums / np.bincount(slot)[:, None]

    def _visits(self, first: np.ndarray, thing: np.ndarray, visit: np.ndarray) -> Visits:
        """Return visits without deviations, by their rows, shape (n,), pose and target, and
        visit.
        """
        at = self.station.select(first[np.unique(thing, return_index=True)[1]])
        cell = CellMotions(at, self.values)
        fields = tuple(field for event in BETWEEN_VISITS for field in event.fields(cell))
        levers = (
            np.concatenate([field.directions for field in cell.joints], axis=2)
            if cell.joints
            else np.zeros((len(at), 3, 0))
        )
        return Visits(np.zeros((len(first), 3)), thing, visit, _distinct(fields), levers)


def _distinct(fields: tuple[MotionField, ...]) -> tuple[MotionField, ...]:
    """Return the fields that move any target."""
    return tuple(field for field in fields if field.freedoms and np.any(field.directions))
