"""Diagnosis of changes of a calibrated robot from a few new rows, and a re-identified model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pincal.calibration.caveats import CaveatKind, findings_on_outliers
from pincal.calibration.change_numbers import CHANGES
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.frame_shift import FrameShift, moved
from pincal.calibration.placing import Placed, fitted_rows, place_station
from pincal.calibration.validation import stand_still
from pincal.diagnosis.change_search import ChangeVerdict, search
from pincal.diagnosis.diagnosis_file import (
    ChangedParameter,
    ChangeEntry,
    CurvesEntry,
    DiagnosisFile,
    ExcludedEntry,
    MovedEntry,
)
from pincal.diagnosis.diagnosis_numbers import DIAGNOSIS
from pincal.diagnosis.excluded import excluded, rival_names, tell_apart
from pincal.diagnosis.lineup import ChangeHypotheses, Refitted
from pincal.diagnosis.redrawn_curves import redrawn_curves
from pincal.diagnosis.row_evidence import Known
from pincal.errors import BadInputError, MeasurementError, counted
from pincal.identify.fit import Priors
from pincal.identify.noise import Noise
from pincal.identify.problem import Problem
from pincal.identify.rounded_joints import RoundedJoints
from pincal.identify.solve import solve
from pincal.identify.station import Station, count, fingerprints, together
from pincal.measure.admit import check_table
from pincal.measure.measurements import Measurements
from pincal.measure.stops import StopRows
from pincal.model.conditions import recorded_variable
from pincal.model.effect import Curve
from pincal.notes import Note, Severity, doubts_first
from pincal.sensors.row_samples import sample_rows
from pincal.thresholds import Count
from pincal.units import format_readable, show_chance
from pincal.validate.accuracy import error_summary, pose_error_sizes

# Probability of a false alarm.
FALSE_ALARM = DIAGNOSIS.false_alarm
# Rows used to search for changes at most: all are held in memory with all possible changes.
_MOST_ROWS: Count = 6_000


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """Whether a robot has changed, and what.

    Attributes:
        found: the contents of ``diagnosis.json``.
        model: the re-identified model, at the new station; as calibrated if it has not changed.
    """

    found: DiagnosisFile
    model: FittedRobot

    def __repr__(self) -> str:
        what = ", ".join(
            " of ".join(filter(None, (change.effect, change.joint))) for change in self.changes
        )
        answer = f"changed: {what or 'nothing in the catalogue'}" if self.changed else "unchanged"
        return (
            f"Diagnosis({self.model.model.chain.robot.name!r}: {answer}, p "
            f"{show_chance(self.found.p_value)})"
        )

    @property
    def changed(self) -> bool:
        """Whether the robot has changed."""
        return self.found.changed

    @property
    def changes(self) -> tuple[ChangeEntry, ...]:
        """The changes, the most significant first."""
        return self.found.changes

    @property
    def excluded(self) -> tuple[ExcludedEntry, ...]:
        """Changes that would have been detected."""
        return self.found.excluded

    @property
    def report(self) -> dict[str, Any]:
        """The contents of ``diagnosis.json`` in JSON types."""
        return msgspec.to_builtins(self.found)  # type: ignore[no-any-return]


def _require_chance(alpha: float) -> None:
    if not 0.0 < alpha < 0.5:
        raise BadInputError(
            f"alpha is {alpha:g}; expected a probability of a false alarm between 0 and "
            "0.5, such as 0.01"
        )


def diagnose(
    calibrated: FittedRobot,
    measurements: Measurements,
    *,
    alpha: float = FALSE_ALARM,
    sigma: float | None = None,
    sigma_orientation: float | None = None,
) -> Diagnosis:
    """Test whether a robot still matches its model, up to the poses of instrument and target, and
    identify what has changed.

    Readings within a stop share the arrival of the drives: their mean is one row.

    Args:
        calibrated: the robot as it was calibrated.
        measurements: new rows, with any instrument in any set-up.
        alpha: probability of an alarm on a robot that has not changed.
        sigma: noise of one component of the new readings [m]; default: the column ``sigma``. The
            residuals of the calibration, which include unmodelled errors, are a lower bound.
        sigma_orientation: noise of the new orientations about each axis [rad]; default: that of the
            calibration, which is a lower bound, or, of one without orientations, estimated from the
            rows.

    Returns:
        The changes with their equivalents, changes that are excluded, and the re-identified model.

    Raises:
        BadInputError: if the rows are too few to locate instrument and target, or the model was
            fitted to them, or they are not of this robot.

    Example:
        >>> from pincal import Options, Robot, calibrate, measurements_from_arrays
        >>> from pincal.builtin import kuka_urdf_path
        >>> from pincal.model.effects import GEOMETRIC
        >>> robot = Robot.from_urdf(kuka_urdf_path())
        >>> rng = np.random.default_rng(0)
        >>> def measured(n, offset):
        ...     q = robot.random_configurations(n, rng)
        ...     tips = robot.forward_kinematics(q + offset * np.eye(6)[2])
        ...     position = tips[:, :3, 3] + tips[:, :3, :3] @ [0.1, 0.0, 0.2]
        ...     position += 5e-5 * rng.standard_normal((n, 3))
        ...     return measurements_from_arrays(robot.joint_names, q, position=position)
        >>> fit = calibrate(robot, measured(100, 0.0), Options(effects=GEOMETRIC))
        >>> [(change.effect, change.joint) for change in diagnose(fit, measured(15, 3e-4)).changes]
        [('joint_offset', 'joint_3')]
        >>> diagnose(fit, measured(15, 0.0)).changed
        False
    """
    _require_chance(alpha)
    model = calibrated.robot_model(measurements.kind)
    measurements = measurements.in_order_of(model.model.chain.robot)
    whole = StopRows.of(measurements)
    some = looked_at(whole)
    placed = relocated(model, some, sigma=sigma, sigma_orientation=sigma_orientation)
    judged = _JudgedRows(model, placed, changes_since(model, placed, alpha))
    verdict = judged.verdict
    station = judged.reidentified.readings(placed.table)
    after = error_summary(station, judged.reidentified.values)
    _refuse_strange(model, placed.table, after["median_mm"], DIAGNOSIS.hopeless)
    changes = judged.changes()
    notes = [*judged.notes(), *_averaged(whole, len(measurements)), *_estimated(placed)]
    notes += _sampled(len(some.table), whole, len(measurements))
    found = DiagnosisFile(
        changed=verdict.changed,
        p_value=verdict.p_value,
        alpha=alpha,
        changes=changes,
        excluded=tuple(excluded(verdict, judged.searched)),
        gap={"before": error_summary(placed.station, placed.values), "after": after},
        station=_set_up(calibrated, judged, changes),
        rows=len(placed.table),
        warnings=doubts_first(notes),
        curves=judged.curves,
        is_judged=not judged.doubts,
        id=model.identity or None,
    )
    return Diagnosis(found, judged.reidentified)


def _set_up(
    calibrated: FittedRobot, judged: _JudgedRows, changes: Iterable[ChangeEntry]
) -> MovedEntry:
    """Return where instrument and target are, by the robot with its changes."""
    shift = _least_moved(calibrated, judged.reidentified, changes)
    entries: dict[str, Any] = shift.to_dict() | shift.uncertainties()
    is_still = not judged.verdict.changed and stand_still(calibrated.each, judged.placed)
    return MovedEntry(**entries, is_still=is_still)


def _least_moved(
    calibrated: FittedRobot, now: FittedRobot, changes: Iterable[ChangeEntry]
) -> FrameShift:
    """Return how far instrument and target are from where they were at the nearest station."""
    changed = {name for change in changes for name in change.parameters}
    shifts = [moved(before, now, changed) for before in calibrated.each]
    return min(shifts, key=lambda shift: np.inf if shift.instrument is None else shift.instrument)


@dataclass(frozen=True, eq=False)
class _JudgedRows:
    """New rows, and what a search for changes finds by them.

    Attributes:
        model: the robot as it was calibrated.
        placed: the same at the station of the rows.
        searched: the verdict of the search, whatever may be doubted about the rows.
    """

    model: FittedRobot
    placed: Placed
    searched: ChangeVerdict

    @cached_property
    def doubts(self) -> tuple[Note, ...]:
        """Why the rows can't decide."""
        return doubts_about(self.searched, self.placed)

    @cached_property
    def verdict(self) -> ChangeVerdict:
        """What has changed, if the rows can decide."""
        return self.searched.none() if self.doubts else self.searched

    @cached_property
    def posterior(self) -> Refitted:
        """The robot with the changes re-estimated."""
        happened = self.verdict.happened
        lineup = self.verdict.lineup
        return lineup.reidentify(happened, lineup.release(happened, self.verdict.values))

    @cached_property
    def reidentified(self) -> FittedRobot:
        """The re-identified model; as calibrated if nothing has changed."""
        lineup = self.verdict.lineup
        if not self.verdict.happened:
            return lineup.robot
        rows = together(self.model.rows, fingerprints(lineup.station))
        found = lineup.reidentified(self.verdict.happened, self.posterior)
        return found.with_station(replace(found.station, rows=rows))

    @property
    def _session(self) -> str:
        return Path(self.placed.table.source).stem

    @cached_property
    def curves(self) -> CurvesEntry | None:
        """What each drive curve contributes to the error."""
        table = self.placed.table
        kept = np.ones(len(table), bool)
        kept[list(self.verdict.wrong_rows)] = False
        return redrawn_curves(self.placed, table, kept=kept, session=self._session)

    def changes(self) -> tuple[ChangeEntry, ...]:
        """Return the changes, curves by how much each reduces the error."""
        changes = list(_entries(self.verdict, self.posterior, self._session))
        if self.curves is None:
            return tuple(changes)
        order = [entry.joint for entry in self.curves.joints]
        names = {e.name for e in self.verdict.lineup.station.model.effects if isinstance(e, Curve)}
        redrawn = [of.curve_rms is not None and of.effect in names for of in changes]
        of_curves = compress(changes, redrawn)
        ranked = iter(sorted(of_curves, key=lambda change: order.index(str(change.joint))))
        both = zip(changes, redrawn, strict=True)
        return tuple(next(ranked) if is_redrawn else change for change, is_redrawn in both)

    def notes(self) -> Iterator[Note | str]:
        """Yield doubts, and what is noticed in the rows."""
        yield from self.doubts
        yield from self.placed.notes
        yield from _unseen(self.curves)
        yield from _notes(self.verdict, self.placed, self.placed.table)


def _sampled(few: int, stops: StopRows, n: int) -> Iterator[str]:
    """Yield a note if changes were searched for in some rows of a table of n."""
    if few < len(stops.table):
        yield (f"changes were searched for in {few} of the {n} rows, sampled from the whole table")


def looked_at(stops: StopRows) -> StopRows:
    """Return the rows used to search for changes: a sample of very many, of all targets."""
    if len(stops.table) <= _MOST_ROWS:
        return stops
    target = np.unique(stops.table.target, return_inverse=True)[1]
    return stops.select(sample_rows(len(stops.table), _MOST_ROWS, target))


def changes_since(model: FittedRobot, placed: Placed, alpha: float) -> ChangeVerdict:
    """Return the changes of a calibrated robot that was located at a new station."""
    known = Known.of(model, placed.station.conditions)
    lineup = ChangeHypotheses.of(placed.model, placed.station, known, placed.shared)
    return search(
        lineup,
        alpha=alpha,
        degrees=known_degrees(model, placed.station),
        apart=row_anomalies(placed),
    )


def row_anomalies(placed: Placed) -> np.ndarray:
    """Return the indices of rows that contradict all others wherever instrument and target are.

    They are outliers among the residuals, not relative to the noise: of a robot that has changed
    all rows have errors.
    """
    station = placed.station
    start = placed.values
    problem = Problem((station,))
    free = placed.solution.free
    sizes = np.array([parameter.size for parameter in station.parameters])
    held = Priors(np.where(free, sizes, np.inf), np.full(len(sizes), np.inf))
    found = solve(problem, start, free, held, Noise((None,) * len(station.sensor.blocks)))
    return np.flatnonzero(found.weights == 0.0)


def doubts_about(verdict: ChangeVerdict, placed: Placed) -> tuple[Note, ...]:
    """Return why rows can't decide whether a robot has changed, as a calibration of them would;
    none if they can.
    """
    table = placed.table
    rejected = np.isin(np.arange(len(table)), verdict.wrong_rows) & verdict.is_undecided
    at = placed.values, placed.solution.free
    found = findings_on_outliers(placed.station, *at, table=table, rejected=rejected)
    if placed.stops.plan.shares_stops:
        # Targets of a stop share its arrival, which is no step: one of each stop is looked at.
        found = [one for one in found if one.kind is not CaveatKind.STEP]
        first = np.sort(np.unique(placed.stops.plan.stop, return_index=True)[1])
        of_each = placed.station.select(first)
        found += findings_on_outliers(
            of_each, *at, table=table.select(first), rejected=np.zeros(len(first), bool)
        )
    # A single change that explains all rows may look like a step in rows that happen to be ordered.
    explained = len(verdict.steps) == 1 and not verdict.is_unexplained
    wanted = (
        (CaveatKind.MANY_OUTLIERS,) if explained else (CaveatKind.MANY_OUTLIERS, CaveatKind.STEP)
    )
    doubts = tuple(one.note for one in found if one.kind in wanted)
    return (*doubts, *_rounded(placed))


def _rounded(placed: Placed) -> Iterator[Note]:
    """Yield a doubt if joints are written in coarse steps, and rows are off by no more than these
    explain.
    """
    rounded = RoundedJoints.of(placed.station, placed.values)
    if rounded is not None and rounded.explains():
        yield Note(
            Severity.DOUBT,
            f"{rounded.words}, and the rows are off by {rounded.off * 1e3:.2g} mm; record the "
            "joints with all digits",
        )


def _estimated(placed: Placed) -> Iterator[str]:
    """Yield a note on noise of readings that the calibration had none of, such as orientations
    after positions.
    """
    blocks = zip(
        placed.station.sensor.blocks,
        placed.noise.is_known.tolist(),
        placed.model.sigma.tolist(),
        strict=True,
    )
    for block, is_known, sigma in blocks:
        if not is_known:
            option = "; --noise-angle declares it" if block.unit == "rad" else ""
            yield (
                f"the calibration had no {block.name}: its noise, "
                f"{format_readable(sigma, block.unit, '.3g')}, is estimated from these rows, so "
                f"that a change that shows in it alone may be taken for noise{option}"
            )


def _averaged(stops: StopRows, n: int) -> Iterator[str]:
    """Yield notes if some of n rows are copies of others, or rows are means of readings within a
    stop.
    """
    several = len(stops.readings)
    if several < n:
        copies = counted(n - several, "row", "are")
        yield f"{copies} copies of others, digit by digit, and left out (of {n})"
    if len(stops.table) < several:
        yield (
            f"{several} readings at {stops.plan.n_stops} stops of the robot count as "
            f"{counted(len(stops.table), 'row')}, their means: "
            "readings within a stop share the arrival of the drives"
        )


def known_degrees(model: FittedRobot, station: Station) -> float:
    """Return the degrees of freedom of a calibration's noise estimate, for readings like a
    station's.
    """
    rows = count(model.rows)
    if not rows:
        return CHANGES.degrees
    degrees = max(rows * station.reading_size - float(model.estimate.free.sum()), 1.0)
    shared = 1.0 if model.repeatability is None else model.repeatability.shared
    return degrees / shared


def relocated(
    model: FittedRobot,
    stops: StopRows,
    *,
    sigma: float | None = None,
    sigma_orientation: float | None = None,
) -> Placed:
    """Return a calibrated robot at the station of new rows, whose noise may be declared [m, rad].

    Raises:
        BadInputError: if the noise is not a length; if the rows are too few to locate instrument
            and target, or of an IMU, which measures no position; or if the model was fitted to
            them, so that they agree whatever happened since.
    """
    measurements = stops.table
    if measurements.sensor is not None and not measurements.sensor.reads_place:
        raise MeasurementError(
            f"{measurements.source}: readings of an {measurements.sensor.kind} alone do not "
            "determine positions of the tool; expected rows of an instrument that measures "
            "positions, such as a session with tracker.csv"
        )
    check_table(model.model.chain.robot, measurements, minimum=1)
    _check_noise(sigma, sigma_orientation)
    if sigma is not None:
        stops = replace(stops, table=replace(measurements, sigma=np.full(len(measurements), sigma)))
    placed = place_station(model, stops, sigma_orientation=sigma_orientation)
    # Rows are known by their joints, which steps of a clock shift.
    known = int(np.sum(fitted_rows(model.rows, placed.model, placed.stops)))
    if known > DIAGNOSIS.same_by_chance:
        raise MeasurementError(
            f"{measurements.source}: the model was fitted to {known} of these "
            f"{len(stops.readings)} rows, so they can't "
            "show whether the robot has changed since; expected rows measured later"
        )
    _refuse_strange(
        model,
        measurements,
        error_summary(placed.station, placed.values)["median_mm"],
        DIAGNOSIS.strange,
    )
    return placed


def _check_noise(sigma: float | None, sigma_orientation: float | None) -> None:
    """Refuse a declared noise [m, rad] that is none."""
    if sigma is not None and not 0.0 < sigma < np.inf:
        raise BadInputError(f"noise of {sigma:g} m; expected a length above 0, such as 5e-5")
    if sigma_orientation is not None and not 0.0 < sigma_orientation < np.inf:
        raise BadInputError(
            f"noise of {sigma_orientation:g} rad; expected an angle above 0, such as 1e-4"
        )


def _refuse_strange(
    model: FittedRobot, measurements: Measurements, median_mm: float, limit: float
) -> None:
    """Refuse rows whose median error exceeds this fraction of the robot's reach."""
    if median_mm > 1e3 * limit * model.model.chain.robot.reach:
        raise MeasurementError(
            f"{measurements.source}: no change in the catalogue brings the model closer than "
            f"{median_mm:.3g} mm to these rows; expected rows of the calibrated robot. Are units, "
            "joint zeros and tip those of its table?"
        )


def _unseen(curves: CurvesEntry | None) -> Iterator[str]:
    """Yield a note if most of the error is due to a curve that the calibration had not determined
    everywhere.
    """
    if curves is None:
        return
    best = curves.joints[0]
    if (
        best.error_mm < DIAGNOSIS.worth_a_note * curves.as_it_was_mm
        and best.seen < DIAGNOSIS.worth_a_note
    ):
        yield (
            f"the mean error falls from {curves.as_it_was_mm:.3g} to {best.error_mm:.3g} mm with a "
            f"re-estimated curve of {best.joint}, which the calibration had determined in "
            f"{100 * best.seen:.0f} % of these rows: elsewhere this is not a change; pincal update "
            "--anew adds the rows"
        )


def _entries(verdict: ChangeVerdict, posterior: Refitted, session: str) -> Iterator[ChangeEntry]:
    """Yield what has changed, as it is written."""
    changes = verdict.lineup.changes
    for step in verdict.steps:
        change = changes[step.score.change]
        equivalent = (rival.label for rival in rival_names(changes, step))
        yield ChangeEntry(
            **msgspec.structs.asdict(change.label),
            parameters=_changed(verdict, posterior, step.score.change),
            p_value=step.p_value,
            equivalent=tuple(equivalent),
            tell_apart=tell_apart(verdict, step),
            curve_rms=_curve_rms(verdict, posterior, step.score.change),
            session=session,
        )
    if verdict.is_unexplained:
        yield ChangeEntry(
            effect="unnamed",
            joint=None,
            parameters={},
            p_value=verdict.p_value,
            equivalent=(),
            tell_apart="measure more poses over the whole range of the joints, and calibrate or "
            "discover again with them",
        )


def _changed(verdict: ChangeVerdict, posterior: Refitted, k: int) -> dict[str, ChangedParameter]:
    """Return the parameters of a change before and after it, by name."""
    lineup = verdict.lineup
    places = lineup.places[k]
    at = np.searchsorted(lineup.free(verdict.happened), places)
    found = {}
    for place, moved_by, sigma in zip(
        places, posterior.changes[at], posterior.sigma[at], strict=True
    ):
        parameter = lineup.station.parameters[place]
        before = parameter.nominal + float(lineup.start[place])
        found[parameter.name] = ChangedParameter(
            before, before + float(moved_by), float(sigma), parameter.unit
        )
    return found


def _curve_rms(verdict: ChangeVerdict, posterior: Refitted, k: int) -> float | None:
    """Return the rms of the change of a curve over the rows, without its mean, or of a function of
    two joints; None of others.
    """
    lineup = verdict.lineup
    model = lineup.station.model
    places = lineup.places[k]
    effects = zip(model.effects, model.spans, strict=True)
    curve = next((effect for effect, span in effects if span.start == places[0]), None)
    conditions = lineup.station.conditions
    if isinstance(curve, Curve) and lineup.changes[k].belief is not None:
        joint = str(curve.locus.joint)
        q = recorded_variable(model.chain, conditions, joint, span=curve.locus.span)
        basis = curve.basis(q)
    elif curve is not None and curve.locus.own_span is not None:
        terms = curve.terms(model.chain, conditions, None)
        basis = np.array([term.basis for term in terms])
    else:
        return None
    at = np.searchsorted(lineup.free(verdict.happened), places)
    return float(np.std(posterior.changes[at] @ basis))


def _notes(
    verdict: ChangeVerdict, placed: Placed, measurements: Measurements
) -> Iterator[Note | str]:
    for i in verdict.unmodelled:
        change = verdict.lineup.changes[i]
        where = "" if change.joint is None else f" of {change.joint}"
        yield (
            f"{change.name}{where} is present in these rows, but judging by its size it was "
            "already present at the calibration and is not modelled, so it is not a change; "
            "discover identifies missing effects"
        )
    if len(verdict.steps) >= DIAGNOSIS.many:
        yield Note(
            Severity.DOUBT,
            f"{len(verdict.steps)} changes at once are rare: make sure that the rows are of this "
            "robot, not of another one of its type; if they are, calibrate it again",
        )
    if verdict.wrong_rows:
        lines = ", ".join(str(measurements.rows[i]) for i in verdict.wrong_rows)
        unit, errors = next(iter(pose_error_sizes(placed.station, placed.values).items()))
        others = np.delete(errors, verdict.wrong_rows)
        yield Note(
            Severity.DOUBT,
            f"{len(verdict.wrong_rows)} of {len(measurements)} rows are excluded because "
            "they contradict all others, whose "
            f"mean error is {others.mean():.4f} {unit}; wrong readings or joints: lines {lines}",
        )
