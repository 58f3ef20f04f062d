"""A calibrated robot judged by rows that its calibration did not use: where they were measured, whether they fit it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any, Literal

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.calibration.caveats import findings_on_held_out
from pincal.calibration.placing import FrameShift, Placed, expected_noise, place_station
from pincal.errors import BadInputError
from pincal.identify.initial import links_of
from pincal.identify.station import Station, known_rows, together
from pincal.measure.admit import scorable, scorable_rows, usable_rows
from pincal.measure.measurements import Measurements
from pincal.measure.poses import SCATTER, replicate_groups
from pincal.notes import Note, Severity, doubts_of
from pincal.validate.accuracy import error_summary, pose_error_sizes
from pincal.validate.agreement import belongs_to_other_robot, mix_up, nominal_displacements
from pincal.validate.lack_of_fit import LackOfFit, replicate_statistics
from pincal.validate.misfit import Misfit, NoiseTest, Verdict, has_moved, judge, misfit_at, tells
from pincal.validate.path_accuracy import path_accuracy

Placement = Literal["as calibrated", "refitted"]
# Residuals over what is expected of them from which on that is worth a note; UR10 tables of one series have up to 1.1.
_NOTED = 1.3
# Where nobody saw a drive's curve, a robot may be off by so many times as much and still be the same.
_UNSEEN = 4.0


@dataclass(frozen=True)
class Validation:
    """A calibrated robot on rows that its calibration did not use.

    Attributes:
        name: of the rows' station.
        placed: whether its instrument and targets stand as they were calibrated, or their place was found from the rows.
        table: the rows that can be judged.
        model: the calibrated model that predicts them.
        station: that model over them.
        found: shape (P,), parameters that were found from the rows.
        moved: how far instrument and targets are from the calibrated ones.
        misfit: what is left, against what noise and the calibration's uncertainty allow.
        doubt: why these rows can't be of the robot as it was calibrated; empty if they can.
        note: what else the user should know of the place; empty for nothing.
        fitted: fingerprints of the rows that the model was fitted to, at all stations.
        of_day: what of the calibration's day or set-up could not be taken along.
    """

    name: str
    placed: Placement
    table: Measurements
    model: CalibratedModel
    station: Station
    found: np.ndarray
    moved: FrameShift
    misfit: Misfit
    doubt: str = ""
    note: str = ""
    fitted: str = ""
    of_day: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[Note, ...]:
        """What the user should know beside the errors; doubts are why such rows do not speak for the model."""
        rest = (
            f"{self.table.source}: off by {self.misfit.ratio:.3g} times what noise and the uncertainty of the calibration "
        )
        why = "arms may be beyond the loads of their calibration" if self.misfit.is_far() else "arms may be on another day"
        rest += f"allow, as {why}; run pincal diagnose to test whether something has changed"
        is_noted = self.misfit.is_significant and self.misfit.ratio > _NOTED and not self.doubt
        fitted = (
            f"{self.table.source}: the model was fitted to {self.fitted_rows} of these {len(self.table)} rows, so they show "
            "how well it was fitted, not how well it predicts; validate on independent rows"
        )
        told = (self.doubt, self.note, rest if is_noted else "", fitted if self.fitted_rows else "")
        far = (found.note for found in findings_on_held_out(self.station, self.values, self.table))
        return (*(Note(Severity.DOUBT, text) for text in told if text), *far, *(Note(Severity.NOTE, t) for t in self.of_day))

    @property
    def verdict(self) -> Verdict:
        """Whether the model explains these rows down to their noise."""
        _, lack = self.replicate_statistics()
        beside = None if lack is None else lack.beside
        if beside is None and (self.model.is_noise_declared or self.table.sigma is not None):
            beside = NoiseTest("the declared noise of the instrument", self.misfit.ratio, self.misfit.p_value)
        distinct = len(np.unique(replicate_groups([self.table], within=SCATTER)[0])) / len(self.table)
        few = not tells(distinct * self.misfit.degrees - self.misfit.found)
        return judge(beside, doubts_of(self.notes), unusable=bool(self.doubt), few=few)

    @cached_property
    def fitted_rows(self) -> int:
        """Number of the rows that the model was fitted to; one may be so by chance and counts for none."""
        found = int(np.sum(known_rows(self.fitted, self.station)))
        return found if found > 1 else 0

    @cached_property
    def error(self) -> dict[str, float]:
        """Errors of all rows: their statistics."""
        return error_summary(self.station, self.values)

    @cached_property
    def by_coverage(self) -> dict[str, Any] | None:
        """Mean errors where the calibration had determined every curve of the model, and elsewhere; None if all are so."""
        known = self.model.knows(self.station.conditions)
        if known.all() or not known.any():
            return None
        unit, sizes = next(iter(pose_error_sizes(self.station, self.values).items()))
        parts = {"determined": known, "elsewhere": ~known}
        return {"unit": unit} | {
            name: {"rows": int(rows.sum()), "mean": float(sizes[rows].mean())} for name, rows in parts.items()
        }

    @property
    def values(self) -> np.ndarray:
        """Values of the station's parameters, shape (P,)."""
        return self.model.values

    @property
    def path_accuracy(self) -> dict[str, Any] | None:
        """Accuracy and repeatability along the path of a session in motion, by ISO 9283; None for held poses."""
        return path_accuracy(self.station, self.values, self.table)

    def replicate_statistics(self) -> tuple[dict[str, Any] | None, LackOfFit | None]:
        """Return accuracy and repeatability, and lack of fit; None where the rows hold no replicates."""
        return replicate_statistics(
            self.station, self.values, self.table, sigma=self.model.sigma, covariance=self.model.covariance, found=self.found
        )


def validate_rows(
    models: Sequence[CalibratedModel], measurements: Measurements, *, name: str = "", refit: bool = True
) -> Validation:
    """Judge a calibrated robot by rows of one station, that of the calibration or another.

    Instrument and targets stand as they were calibrated unless the rows call for another place more loudly than noise and
    the calibration's uncertainty explain.

    Args:
        models: the calibrated robot at each station that it was calibrated at.
        measurements: the rows.
        name: of their station.
        refit: whether another place may be found; else they are judged at the nearest calibrated station.

    Returns:
        The judgement; look at ``doubt``.

    Raises:
        BadInputError: if the rows are not of a calibrated station, and too few to find another from.
    """
    found = _judged(models, measurements, name=name, refit=refit)
    return replace(found, fitted=together(*(model.rows for model in models)))


def _judged(models: Sequence[CalibratedModel], measurements: Measurements, *, name: str, refit: bool) -> Validation:
    """Return the judgement; arguments as in :func:`validate_rows`."""

    def refitted(model: CalibratedModel) -> Validation:
        rows = usable_rows(measurements, model.setup.over(measurements))
        return _refitted(name, rows, place_station(model, rows))

    # Clocks of another session are others, too.
    stands = list(_stands(models, measurements)) if measurements.moving is None else []
    if not stands:
        if not refit:
            raise BadInputError(
                f"{measurements.source}: these rows do not match the chosen station: sensor, target, points or columns "
                "differ"
            )
        return refitted(next((m for m in models if m.sensor_kind == measurements.kind), _anywhere(models)))
    _, model, table, station, sigma = min(stands, key=lambda stand: stand[0])

    def misfit(sigma: np.ndarray, robust: np.ndarray) -> Misfit:
        return misfit_at(station, model.values, covariance=model.covariance, sigma=sigma, robust=robust)

    def as_calibrated(left: Misfit, **told: Any) -> Validation:
        still, none = FrameShift(0.0, 0.0, 0.0), np.zeros(len(model.values), bool)
        return Validation(name, "as calibrated", table, model, station, none, still, left, **told)

    try:
        placed = place_station(model, table)
    except BadInputError as error:
        # These rows can't tell another place than the calibrated one.
        before = misfit(sigma, np.ones(len(table)))
        if refit and before.is_far():
            unit, errors = next(iter(pose_error_sizes(station, model.values).items()))
            raise BadInputError(f"{error}; as calibrated, they are off by {errors.mean():.4g} {unit}") from None
        return as_calibrated(before)
    before = misfit(placed.model.sigma, (placed.solution.weights > 0.0).astype(float))
    is_moved = has_moved(before, placed.misfit)
    if is_moved and refit:
        return refitted(model) if len(table) < len(measurements) else _refitted(name, table, placed)
    if len(table) < len(measurements):
        # Once more, for the warning of what is left out.
        scorable_rows(measurements, model.setup)
    note = f"{name or table.source}: these rows fit another pose of instrument and target: {placed.moved}"
    return as_calibrated(before, doubt=doubt_of(table, placed), note=note if is_moved else "", of_day=placed.notes)


def _anywhere(models: Sequence[CalibratedModel]) -> CalibratedModel:
    """Return the robot for rows of no station that it was calibrated at: where it has several arms, by what all covered."""
    first, *others = models
    if not first.model.chain.robot.links:
        return first
    return replace(first, covered=reduce(lambda a, b: a.over(b), (model.covered for model in others), first.covered))


def _stands(
    models: Sequence[CalibratedModel], measurements: Measurements
) -> Iterator[tuple[float, CalibratedModel, Measurements, Station, np.ndarray]]:
    """Yield the stations that rows may be of: same sensor, targets and points, and the columns that their effects need.

    With each how far typical rows are off, in units of the noise; then the rows that can be judged, under the calibrated
    model, and their noise.
    """
    for model in models:
        chain = model.model.chain
        if links_of(measurements, chain.robot.path) != (chain.path.start, chain.path.tip):
            continue
        if len(chain.targets) > 1 and not set(map(str, measurements.target)) <= set(chain.targets):
            continue
        needs = {column for effect in model.model.effects if effect.scope == "station" for column in effect.needs}
        if any(getattr(measurements, column) is None for column in needs):
            continue
        if not model.reads(measurements) or (
            measurements.point_names is not None and model.sensor_kind != measurements.kind
        ):
            continue
        kept = scorable(measurements, model.setup) if model.setup.points else np.ones(len(measurements), bool)
        if kept.any():
            table = measurements if kept.all() else measurements.select(kept)
            station = model.readings(table)
            sigma = expected_noise(model, station.sensor.blocks, table)
            off = station.residuals(model.values) / np.repeat(sigma, station.block_sizes)[:, None]
            yield float(np.median(np.linalg.norm(off, axis=0))), model, table, station, sigma


def _refitted(name: str, table: Measurements, placed: Placed) -> Validation:
    model, found, doubt = placed.model, placed.solution.free, doubt_of(table, placed)
    at = table, model, placed.station, found, placed.moved, placed.misfit
    return Validation(name, "refitted", *at, doubt=doubt, of_day=placed.notes)


def doubt_of(table: Measurements, placed: Placed) -> str:
    """Return why rows can't be of the robot as it was calibrated, wherever the instrument stands; empty if they can.

    Drives where nobody saw their curves prove little, and loads that it never carried only whether the calibration is
    better than none.
    """
    known, station, values = placed.model, placed.station, placed.values
    used, inside = placed.solution.weights > 0.0, known.knows(station.conditions)
    sound = used & known.covered.carries(station.conditions.payload)
    for rows, factor in ((sound & inside, 1.0), (sound, _UNSEEN), (used & inside, np.inf)):
        left = placed.misfit_of(rows)
        if not left.is_significant:
            continue
        unit, errors = next(iter(pose_error_sizes(station.select(rows), values).items()))
        off = f"{table.source}: off by {errors.mean():.3g} {unit} wherever instrument and target stand"
        if left.is_far(factor):
            mixed = mix_up(table, station, values, options=known.options(effects=()))
            beyond = f"{off}, {left.ratio:.3g} times what noise and the uncertainty of the calibration allow"
            return f"{beyond}; {mixed}" if mixed else beyond
        if factor != _UNSEEN and (nominal := _as_good(table, placed, left=left, rows=rows)) is not None:
            return f"{off}, no better than the nominal robot ({1e3 * nominal:.3g} mm)"
    return ""


def _as_good(table: Measurements, placed: Placed, *, left: Misfit, rows: np.ndarray) -> float | None:
    """Return the nominal robot's mean error [m] if it explains rows as well as the calibrated one; else None."""
    known, station = placed.model, placed.station
    nominal = nominal_displacements(known.model.chain.robot, table, known.options(effects=()))[rows]
    size = station.sensor.blocks[0].size
    allowed = left.allowed * known.sigma[0] * np.sqrt(size) * station.metres_per_reading(placed.values)
    if belongs_to_other_robot(station.displacements(placed.values)[rows], nominal, allowed=float(allowed)):
        return float(np.linalg.norm(nominal, axis=1).mean())
    return None
