"""Validation of a calibrated robot on rows that its calibration did not use."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any, Literal

import numpy as np
from scipy.special import chdtri

from pincal.calibration.calibration_numbers import OTHER_ROWS
from pincal.calibration.caveats import findings_on_held_out
from pincal.calibration.curve_coverage import knows
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.frame_shift import FrameShift
from pincal.calibration.placing import Placed, fitted_rows, place_station
from pincal.calibration.row_noise import noise_of_rows
from pincal.errors import BadInputError, PincalWarning, warn
from pincal.identify.initial import links_of
from pincal.identify.station import Station, together
from pincal.measure.admit import scorable, scorable_rows, usable_rows
from pincal.measure.measurements import Measurements
from pincal.measure.stops import StopRows
from pincal.notes import Note, Severity, doubts_of
from pincal.robot.robot import Robot
from pincal.validate.accuracy import error_summary, pose_error_sizes
from pincal.validate.agreement import belongs_to_other_robot, mix_up, nominal_displacements
from pincal.validate.lack_of_fit import LackOfFit, replicate_statistics
from pincal.validate.misfit import (
    Misfit,
    NoiseTest,
    Verdict,
    has_moved,
    is_informative,
    judge,
    misfit_at,
)
from pincal.validate.path_accuracy import path_accuracy
from pincal.validate.pose_characteristics import PoseVisits, characteristics, error_intervals

Placement = Literal["as calibrated", "refitted"]


@dataclass(frozen=True)
class Validation:
    """A calibrated robot on rows that its calibration did not use.

    Attributes:
        name: of the rows' station.
        placed: whether instrument and targets are where they were calibrated, or were located from
            the rows.
        table: the rows that can be judged.
        model: the calibrated model that predicts them.
        station: that model over them.
        found: shape (P,), parameters that were fitted to the rows.
        moved: displacement of instrument and targets from the calibrated ones.
        misfit: the residuals against what noise and the calibration's uncertainty allow.
        doubt: why these rows can't be of the robot as it was calibrated; empty if they can.
        note: a further note on the pose of the instrument; may be empty.
        fitted: fingerprints of the rows that the model was fitted to, at all stations.
        of_day: effects of the calibration's day or set-up that could not be transferred.
    """

    name: str
    placed: Placement
    table: Measurements
    model: FittedRobot
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
        """Reservations about the errors; doubts are why the rows do not support the model."""
        doubts = [self.doubt, self.note]
        source = self.table.source
        if self.misfit.is_significant and self.misfit.ratio > OTHER_ROWS.noted and not self.doubt:
            why = (
                "beyond the loads of the calibration" if self.misfit.is_far() else "on another day"
            )
            doubts.append(
                f"{source}: residuals are {self.misfit.ratio:.3g} times what noise and the "
                f"uncertainty of the calibration allow, as happens {why}; run pincal diagnose to "
                "test whether something has changed"
            )
        if self.fitted_rows:
            doubts.append(
                f"{source}: the model was fitted to {self.fitted_rows} of these "
                f"{len(self.table)} rows, so they show "
                "how well it was fitted, not how well it predicts; validate on independent rows"
            )
        far = (found.note for found in findings_on_held_out(self.station, self.values, self.table))
        of_day = (Note(Severity.NOTE, text) for text in self.of_day)
        return (*(Note(Severity.DOUBT, text) for text in doubts if text), *far, *of_day)

    @property
    def verdict(self) -> Verdict:
        """Whether the model explains these rows down to their noise."""
        _, lack = self.replicate_statistics()
        against = None if lack is None else lack.noise_test
        if against is None and (self.model.is_noise_declared or self.table.sigma is not None):
            against = NoiseTest(
                "the declared noise of the instrument", self.misfit.ratio, self.misfit.p_value
            )
        things = self.stops.plan.thing
        distinct = len(np.unique(things)) / len(things)
        few = not is_informative(distinct * self.misfit.degrees - self.misfit.found)
        return judge(against, doubts_of(self.notes), unusable=bool(self.doubt), few=few)

    @cached_property
    def fitted_rows(self) -> int:
        """Number of rows that the model was fitted to; a single one may match by chance and does
        not count.
        """
        found = int(np.sum(fitted_rows(self.fitted, self.model, self.stops)))
        return found if found > 1 else 0

    @cached_property
    def stops(self) -> StopRows:
        """The means of the readings of each stop, by which the model is judged."""
        return StopRows.of(self.table)

    @cached_property
    def error(self) -> dict[str, float]:
        """Statistics of the errors of all rows."""
        return error_summary(self.station, self.values)

    @cached_property
    def by_coverage(self) -> dict[str, Any] | None:
        """Mean errors where the calibration had determined every curve of the model, and elsewhere;
        None without both.
        """
        known = knows(self.model, self.station.conditions)
        if known.all() or not known.any():
            return None
        unit, sizes = next(iter(pose_error_sizes(self.station, self.values).items()))
        parts = {"determined": known, "elsewhere": ~known}
        return {"unit": unit} | {
            name: {"rows": int(rows.sum()), "mean": float(sizes[rows].mean())}
            for name, rows in parts.items()
        }

    @property
    def values(self) -> np.ndarray:
        """Values of the station's parameters, shape (P,)."""
        return self.model.values

    @property
    def path_accuracy(self) -> dict[str, Any] | None:
        """Accuracy and repeatability along the path of a session in motion, by ISO 9283; None for
        held poses.
        """
        return path_accuracy(self.station, self.values, self.table)

    @cached_property
    def characteristics(self) -> dict[str, Any]:
        """Characteristics of ISO 9283 that visits of poses tell, each with its interval; empty
        where no pose was visited again, or no position was read.
        """
        stops = self.stops
        if not self.station.sensor.reads_pose or not stops.plan.is_revisited:
            return {}
        over = self.model.readings(stops.table)
        residuals = over.residuals(self.values)[:3].T
        return characteristics(
            PoseVisits(
                residuals=residuals,
                commanded=stops.table.array("position") - residuals,
                pose=stops.plan.thing,
                session=stops.plan.session,
                side=stops.table.approach,
            )
        )

    @cached_property
    def intervals(self) -> dict[str, tuple[float | None, float | None]]:
        """The 95 % intervals of the mean and the 95th percentile of the errors, by name and unit;
        readings of a stop count as one.
        """
        stops = len(np.unique(self.stops.plan.stop))
        return error_intervals(pose_error_sizes(self.station, self.values), independent=stops)

    def replicate_statistics(self) -> tuple[dict[str, Any] | None, LackOfFit | None]:
        """Return accuracy and repeatability, and lack of fit; None where no pose was visited again.

        Readings within a stop are no replicates: they share the arrival of the drives.
        """
        stops = self.stops
        return replicate_statistics(
            self.model.readings(stops.table),
            self.values,
            stops.table,
            pose=stops.plan.thing,
            sigma=self.model.sigma,
            covariance=self.model.covariance,
            found=self.found,
        )


def validate_rows(
    models: Sequence[FittedRobot],
    measurements: Measurements,
    *,
    name: str = "",
    refit: bool = True,
    sigma_orientation: float | None = None,
) -> Validation:
    """Judge a calibrated robot by rows of one station, of the calibration or new.

    Instrument and targets are held where they were calibrated unless noise and the calibration's
    uncertainty do not explain their displacement.

    Args:
        models: the calibrated robot at each station of its calibration.
        measurements: the rows.
        name: of their station.
        refit: whether instrument and targets may be located anew; else the nearest calibrated
            station is taken.
        sigma_orientation: noise of orientations [rad]; default: that of the calibration, or, of a
            model without any, estimated from the rows.

    Returns:
        The judgement; check ``doubt``.

    Raises:
        BadInputError: if the rows are not of a calibrated station, and too few to locate another.
    """
    if refit:
        measurements = _between_likely_links(models, measurements)
    found = _judged(models, measurements, name=name, refit=refit, angle=sigma_orientation)
    return replace(found, fitted=together(*(model.rows for model in models)))


def _between_likely_links(
    models: Sequence[FittedRobot], measurements: Measurements
) -> Measurements:
    """Return rows with the links between which they are, if they do not name any, and the robot was
    calibrated between two hands by other readings than theirs.

    An instrument then stands in the cell and sees one of the hands: the one that its rows fit far
    better than the others, and than the path between the hands. Otherwise they are unchanged.
    """
    robot = models[0].model.chain.robot
    is_known = measurements.kind in {model.sensor_kind for model in models}
    if measurements.from_link is not None or is_known or robot.path.start == robot.base:
        return measurements
    hands = _hands_of(robot, measurements)
    count = len(measurements)
    tables = [measurements]
    for hand in hands:
        start = np.full(count, robot.base)
        tip = np.full(count, hand)
        tables.append(replace(measurements, from_link=start, to_link=tip))
    ratios = np.array([_misfit_if_placed(models, table) for table in tables])
    order = np.argsort(ratios)
    best = int(order[0])
    second = int(order[1])
    if best == 0 or ratios[best] ** 2 > OTHER_ROWS.clear * ratios[second] ** 2:
        return measurements
    warn(
        f"{measurements.source}: the rows do not name their links; they are taken as measured from "
        f"{robot.base} to {hands[best - 1]}, which they fit {ratios[second] / ratios[best]:.3g} "
        "times better than other ways; if that is wrong, add columns from and to"
    )
    return tables[best]


def _hands_of(robot: Robot, measurements: Measurements) -> list[str]:
    """Return the hands of a robot of which rows may be: the one that they name, or all."""
    if measurements.to_link is not None and len(measurements):
        return [str(measurements.to_link[0])]
    pairs = ((robot.path.start, robot.tip), *robot.links)
    ends = dict.fromkeys(end for pair in pairs for end in pair)
    return [end for end in ends if end != robot.base]


def _misfit_if_placed(models: Sequence[FittedRobot], table: Measurements) -> float:
    """Return the residuals of rows in units of their noise once instrument and targets are placed;
    infinite if the rows do not determine these.
    """
    try:
        with warnings.catch_warnings():
            # Of ways that are rejected.
            warnings.simplefilter("ignore", PincalWarning)
            return float(place_station(_anywhere(models), table).misfit.ratio)
    except BadInputError:
        return np.inf


def _judged(
    models: Sequence[FittedRobot],
    measurements: Measurements,
    *,
    name: str,
    refit: bool,
    angle: float | None,
) -> Validation:
    def refitted(model: FittedRobot) -> Validation:
        rows = usable_rows(measurements, model.setup.over(measurements))
        return _refitted(name, rows, place_station(model, rows, sigma_orientation=angle))

    # Another session has other clock parameters.
    stands = list(_stands(models, measurements, angle)) if not measurements.is_of_motion else []
    if not stands:
        if not refit:
            raise BadInputError(
                f"{measurements.source}: these rows do not match the chosen station: "
                "sensor, target, points or columns differ"
            )
        of_kind = (model for model in models if model.sensor_kind == measurements.kind)
        return refitted(next(of_kind, _anywhere(models)))
    stand = min(stands, key=lambda stand: stand.off)
    table = stand.table
    try:
        placed = place_station(stand.model, table, sigma_orientation=angle)
    except BadInputError as error:
        return stand.unplaced(name, error, refit=refit)
    before = stand.misfit(placed.model.sigma, (placed.solution.weights > 0.0).astype(float))
    is_moved = has_moved(before, placed.misfit)
    is_part = len(table) < len(measurements)
    if is_moved and refit:
        return refitted(stand.model) if is_part else _refitted(name, table, placed)
    if is_part:
        # Called for its warning about rows left out.
        scorable_rows(measurements, stand.model.setup)
    return stand.judged_with(name, before, placed, is_moved=is_moved)


def stand_still(models: Sequence[FittedRobot], placed: Placed) -> bool:
    """Return whether noise and the calibration's uncertainty explain rows with instrument and
    targets where a calibration had them.

    Args:
        models: the calibrated robot at each station of its calibration.
        placed: the robot at the station of the rows.
    """
    stands = _stands(models, placed.table, None)
    stand = min(stands, key=lambda stand: stand.off, default=None)
    if stand is None:
        return False
    sound = (placed.solution.weights > 0.0).astype(float)
    return not has_moved(stand.misfit(placed.model.sigma, sound), placed.misfit)


def _anywhere(models: Sequence[FittedRobot]) -> FittedRobot:
    """Return the robot for rows of a new station; of several arms with the coverage of all
    stations.
    """
    first, *others = models
    if not first.model.chain.robot.links:
        return first
    covered = reduce(lambda a, b: a.over(b), (model.covered for model in others), first.covered)
    return first.with_station(replace(first.station, covered=covered))


@dataclass(frozen=True, eq=False)
class _Stand:
    """A station that rows may be of.

    Attributes:
        off: median residual in units of the noise.
        model: of the robot at the station.
        table: the rows that can be judged.
        station: these under the model.
        sigma: shape (blocks,), their noise.
    """

    off: float
    model: FittedRobot
    table: Measurements
    station: Station
    sigma: np.ndarray

    @classmethod
    def of(cls, model: FittedRobot, table: Measurements, angle: float | None) -> _Stand:
        station = model.readings(table)
        blocks = station.sensor.blocks
        noise = noise_of_rows(
            model, table.kind, blocks, declared=table.sigma, sigma_orientation=angle
        )
        residuals = station.residuals(model.values)
        squares = [np.median(np.sum(residuals[rows] ** 2, axis=0)) for rows in station.block_rows]
        usual = np.sqrt(squares / chdtri(station.block_sizes, 0.5))
        sigma = noise.estimated(usual)
        off = residuals / np.repeat(sigma, station.block_sizes)[:, None]
        return cls(float(np.median(np.linalg.norm(off, axis=0))), model, table, station, sigma)

    def misfit(self, sigma: np.ndarray, robust: np.ndarray) -> Misfit:
        """Return the misfit of the means of the stops where the station was calibrated."""
        model = self.model
        means = model.readings(StopRows.of(self.table).table)
        return misfit_at(
            means, model.values, covariance=model.covariance, sigma=sigma, robust=robust
        )

    def as_calibrated(self, name: str, found: Misfit) -> Validation:
        """Return the judgement where the station was calibrated."""
        own = self.model
        if own.sensor_kind != self.table.kind:
            # Of other readings than those of the calibration, with their noise.
            here = replace(own.station, sensor_kind=self.table.kind, sigma=self.sigma)
            own = own.with_station(here)
        none = np.zeros(len(own.values), bool)
        still = FrameShift(0.0, 0.0, 0.0)
        at = self.table, own, self.station, none, still, found
        return Validation(name, "as calibrated", *at)

    def unplaced(self, name: str, error: BadInputError, *, refit: bool) -> Validation:
        """Return the judgement of rows that do not determine another pose of the instrument.

        Raises:
            BadInputError: if these rows are far off and may be located anew.
        """
        before = self.misfit(self.sigma, np.ones(len(StopRows.of(self.table).table)))
        if refit and before.is_far():
            sizes = pose_error_sizes(self.station, self.model.values)
            unit, errors = next(iter(sizes.items()))
            raise BadInputError(
                f"{error}; as calibrated, their mean error is {errors.mean():.4g} {unit}"
            ) from None
        return self.as_calibrated(name, before)

    def judged_with(
        self, name: str, found: Misfit, placed: Placed, *, is_moved: bool
    ) -> Validation:
        """Return the judgement where the station was calibrated, with the reservations that a pose
        of the instrument located from the rows gives.
        """
        note = (
            f"{name or self.table.source}: these rows fit a different pose of instrument and "
            f"target: {placed.moved}"
        )
        return replace(
            self.as_calibrated(name, found),
            doubt=doubt_of(placed),
            note=note if is_moved else "",
            of_day=placed.notes,
        )


def _stands(
    models: Sequence[FittedRobot], measurements: Measurements, angle: float | None
) -> Iterator[_Stand]:
    """Yield the stations that rows may be of, each with the rows that can be judged."""
    for model in models:
        if not _may_have_measured(model, measurements):
            continue
        points = model.setup.points
        kept = scorable(measurements, model.setup) if points else np.ones(len(measurements), bool)
        if kept.any():
            table = measurements if kept.all() else measurements.select(kept)
            yield _Stand.of(model, table, angle)


def _may_have_measured(model: FittedRobot, measurements: Measurements) -> bool:
    """Return whether rows are of the links, targets, points and sensor of a station, and have the
    columns that its effects need.
    """
    chain = model.model.chain
    if links_of(measurements, chain.robot.path) != (chain.path.start, chain.path.tip):
        return False
    if len(chain.targets) > 1 and not set(map(str, measurements.target)) <= set(chain.targets):
        return False
    of_station = (effect for effect in model.model.effects if effect.scope == "station")
    needs = {column for effect in of_station for column in effect.needs}
    if any(getattr(measurements, column) is None for column in needs):
        return False
    has_own_points = measurements.point_names is not None
    is_of_kind = model.sensor_kind == measurements.kind
    return model.reads(measurements) and (is_of_kind or not has_own_points)


def _refitted(name: str, table: Measurements, placed: Placed) -> Validation:
    model = placed.model
    table = placed.stepping(table)
    doubt = doubt_of(placed)
    at = table, model, model.readings(table), placed.solution.free, placed.moved, placed.misfit
    return Validation(name, "refitted", *at, doubt=doubt, of_day=placed.notes)


def doubt_of(placed: Placed) -> str:
    """Return why rows can't be of the robot as it was calibrated, wherever the instrument is; empty
    if they can.

    Where drive curves were not determined the limit is wider, and beyond the calibrated loads rows
    only show whether the calibration is better than none.
    """
    known = placed.model
    conditions = placed.station.conditions
    used = placed.solution.weights > 0.0
    inside = knows(known, conditions)
    sound = used & known.covered.carries(conditions.payload)
    limits = (
        (sound & inside, 1.0),
        (sound, OTHER_ROWS.unseen),
        (used & inside, np.inf),
    )
    doubts = (_doubt_of_rows(placed, rows, factor) for rows, factor in limits)
    return next(filter(None, doubts), "")


def _doubt_of_rows(placed: Placed, rows: np.ndarray, factor: float) -> str:
    """Return why some of the rows, a mask of shape (N,), can't be of the robot as it was
    calibrated, their residuals allowed a factor more; empty if they can.
    """
    misfit = placed.misfit_of(rows)
    if not misfit.is_significant:
        return ""
    table = placed.table
    station = placed.station
    unit, errors = next(iter(pose_error_sizes(station.select(rows), placed.values).items()))
    off = (
        f"{table.source}: mean error {errors.mean():.3g} {unit} for any pose of "
        "instrument and target"
    )
    if misfit.is_far(factor):
        options = placed.model.fitting_options(effects=())
        mixed = mix_up(table, station, placed.values, options=options)
        beyond = (
            f"{off}, {misfit.ratio:.3g} times what noise and the uncertainty of the "
            "calibration allow"
        )
        return f"{beyond}; {mixed}" if mixed else beyond
    if factor == OTHER_ROWS.unseen:
        return ""
    nominal = _as_good(table, placed, misfit=misfit, rows=rows)
    if nominal is None:
        return ""
    return f"{off}, no better than the nominal robot ({1e3 * nominal:.3g} mm)"


def _as_good(
    table: Measurements, placed: Placed, *, misfit: Misfit, rows: np.ndarray
) -> float | None:
    """Return the nominal robot's mean error [m] if it explains rows as well as the calibrated one;
    else None.
    """
    known = placed.model
    station = placed.station
    nominal = nominal_displacements(
        known.model.chain.robot, table, known.fitting_options(effects=())
    )[rows]
    size = station.sensor.blocks[0].size
    allowed = (
        misfit.allowed * known.sigma[0] * np.sqrt(size) * station.metres_per_reading(placed.values)
    )
    if belongs_to_other_robot(
        station.displacements(placed.values)[rows], nominal, allowed=float(allowed)
    ):
        return float(np.linalg.norm(nominal, axis=1).mean())
    return None
