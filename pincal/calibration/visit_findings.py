"""Reservations about readings of poses that were visited, or read, more than once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.special import chdtrc

from pincal.calibration.caveats import Caveat, CaveatKind
from pincal.calibration.held_out import StationRows
from pincal.identify.fit import ModelFit
from pincal.identify.visit_numbers import VISITS
from pincal.measure.measurements import Measurements, concatenate
from pincal.measure.poses import SCATTER, replicate_groups
from pincal.measure.stops import by_stop, plan_of
from pincal.units import format_readable
from pincal.validate.accuracy import Replicates
from pincal.validate.lack_of_fit import LackOfFit
from pincal.validate.misfit import MISFIT
from pincal.validate.visits import VisitChange, changes_between_visits, scatters_of


def findings_on_visits(
    fit: ModelFit, k: int, rows: StationRows, lack: LackOfFit | None
) -> list[Caveat]:
    """Return what changed between visits of the same poses at the k-th station, or by what they
    differ without a cause.

    ``lack`` is the test of lack of fit there, if there is any.
    """
    changes = changes_at(fit, k, rows)
    if changes:
        return [_caveat(change, rows.name) for change in changes]
    found = list(_on_scatter(fit, k, rows))
    plan = plan_of(rows.measured[0])
    if lack is not None and lack.is_too_small(plan.n_stops / len(plan)) and not found:
        found.append(Caveat(CaveatKind.VISITS_APART, {"test": lack}, rows.name))
    return found


def changes_at(fit: ModelFit, k: int, rows: StationRows) -> list[VisitChange]:
    """Return what changed between visits of the same poses at the k-th station, wrong readings
    among its rows.
    """
    table = _together(*rows.as_read)
    station = fit.problem.stations[k]
    at = fit.readings(table, station=station.name)
    return changes_between_visits(at, fit.values[fit.problem.places[k]], table)


def by_visit(fit: ModelFit, station: str, parts: Sequence[Replicates]) -> list[Replicates]:
    """Return rows of a station with the mean of the readings of each stop, where poses are visited
    again.

    Readings within a stop share the arrival of the drives, so it is visits that are replicates.
    """
    plans = [plan_of(part.table) for part in parts]
    if not any(plan.is_revisited and plan.is_repeated for plan in plans):
        return list(parts)
    tables = [by_stop(part.table) for part in parts]
    found = []
    for part, table, pose in zip(
        parts, tables, replicate_groups(tables, within=SCATTER), strict=True
    ):
        is_counted = np.zeros(int(part.pose.max(initial=-1)) + 1, bool)
        is_counted[part.pose[part.counted]] = True
        at = fit.readings(table, station=station)
        found.append(Replicates(part.part, table, at, pose, is_counted[pose]))
    return found


def is_shifted(fit: ModelFit, rows: Sequence[StationRows]) -> bool:
    """Return whether something changed at once between visits of the same poses at any station."""
    return any(
        change.kind == "step" for k, part in enumerate(rows) for change in changes_at(fit, k, part)
    )


def joined_with_means(found: list[Caveat]) -> list[Caveat]:
    """Return findings with one step for each station where both visits and means of poses show one.

    Means of poses that were visited before and after a step are of both sides, so its line is that
    of the visits; that of the means, if it is as likely by the visits, as poses that were visited
    once may lie between.
    """
    of_visits = {
        one.station: one for one in found if one.kind is CaveatKind.STEP and "lines" in one.figures
    }
    kept = list[Caveat]()
    for one in found:
        by_visits = of_visits.get(one.station)
        if one.kind is not CaveatKind.STEP or by_visits is None:
            kept.append(one)
            continue
        first, last = by_visits.figures["lines"]
        is_of_means = "lines" not in one.figures
        agrees = any(
            first <= other.figures["line"] <= last
            for other in found
            if other.kind is CaveatKind.STEP
            and other.station == one.station
            and "lines" not in other.figures
        )
        if is_of_means == agrees:
            kept.append(one)
    return kept


def _caveat(change: VisitChange, station: str) -> Caveat:
    if change.kind == "step":
        figures = {"line": change.line, "what": change, "lines": change.lines}
        return Caveat(CaveatKind.STEP, figures, station, (change.line,))
    return Caveat(CaveatKind.BETWEEN_VISITS, {"what": change}, station)


def _on_scatter(fit: ModelFit, k: int, rows: StationRows) -> Iterator[Caveat]:
    """Yield whether visits, or readings within a stop, differ by more than the declared noise and
    drives explain.
    """
    station, places, blocks = list(fit.stations)[k]
    declared = fit.noise.declared[blocks.start]
    table = _together(*rows.measured)
    if declared is None or table.sigma is not None or station.whitening is not None:
        return
    at = fit.readings(table, station=station.name)
    for scatter in scatters_of(at, fit.values[places], table):
        if scatter.within:
            chance = scatter.larger(declared)
            if chance < MISFIT:
                figures = _figures(scatter.typical, declared, chance)
                yield Caveat(CaveatKind.NOISY_REPEATS, figures, station.name)
        else:
            square, degrees = scatter.square(declared, VISITS.arrival)
            chance = float(chdtrc(degrees, square))
            if chance < MISFIT:
                figures = _figures(scatter.size, declared, chance)
                figures |= {"arrival": 1e3 * VISITS.arrival}
                yield Caveat(CaveatKind.VISITS_SCATTER, figures, station.name)


def _figures(size: float, declared: float, p_value: float) -> dict[str, object]:
    return {
        "scatter": f"{format_readable(size, 'm')} per coordinate",
        "declared": format_readable(declared, "m"),
        "p_value": p_value,
    }


def _together(train: Measurements, test: Measurements) -> Measurements:
    """Return fitted and held-out rows of one file in one table, the fitted alone of two."""
    if not len(test) or train.source != test.source:
        return train
    joined = concatenate([train, test])
    return joined.select(np.argsort(joined.rows, kind="stable"))
