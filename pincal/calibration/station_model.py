"""The model of a robot at the station where it was calibrated, evaluated at rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pincal.calibration.covered import (
    Covered,
    CurveGap,
    Outside,
    OutsideCurve,
    Turned,
    curves_at,
    of_the_day,
)
from pincal.calibration.information import RobotInformation
from pincal.calibration.repeatability import Repeatability
from pincal.calibration.unmodelled import Unmodelled
from pincal.errors import BadInputError, MeasurementError
from pincal.identify.options import Options
from pincal.identify.station import Station, conditions_of, station_of
from pincal.measure.measurements import Measurements
from pincal.measure.setup import Setup
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.parameters import Estimate
from pincal.robot.se3 import placed
from pincal.units import format_readable

_Rows = TypeVar("_Rows", Measurements, Conditions)


@dataclass(frozen=True, repr=False)
class StationModel:
    """A model of a robot as it was calibrated at a station.

    Attributes:
        model: chain and effects.
        estimate: the model's parameters and then the sensor's own, with values and covariance.
        sensor_kind: what was measured: "position", "pose", "distance" and so on.
        payload_centre: shape (3,), centre of mass of the payload in the tip frame [m].
        covered: the range of the training rows.
        sigma: shape (blocks,), noise of one component of each block of readings that the fit used
            [m, rad].
        provenance: version of pincal, time, input files with their SHA-256, command and seed.
        setup: named points and the camera that it was calibrated with.
        nominal_values: shape (P,), the values with only base and tool fitted; None where unknown.
        rows: fingerprints of the training rows; empty where unknown.
        is_noise_declared: whether the noise was declared, not estimated.
        table_names: names of its parameters among those of all stations, where it shares some
            besides the robot's.
        repeatability: of the readings within a stop and of stops at a pose; None where nothing was
            repeated, or unknown.
        left_by: :attr:`left`, or a function that returns it, as the search takes as long as a fit.
        information_by: :attr:`information`, or a function that returns it.
    """

    model: Model
    estimate: Estimate
    sensor_kind: str
    payload_centre: np.ndarray
    covered: Covered
    sigma: np.ndarray
    provenance: dict[str, Any]
    setup: Setup = field(default_factory=Setup)
    nominal_values: np.ndarray | None = None
    rows: str = ""
    is_noise_declared: bool = False
    table_names: tuple[str, ...] = ()
    repeatability: Repeatability | None = None
    left_by: Unmodelled | Callable[[], Unmodelled | None] | None = None
    information_by: RobotInformation | Callable[[], RobotInformation] | None = None

    @property
    def left(self) -> Unmodelled | None:
        """Effects present in the rows but not in the model; None without any, or if not searched
        for.
        """
        return self.left_by() if callable(self.left_by) else self.left_by

    @property
    def information(self) -> RobotInformation | None:
        """Information of the rows of all stations on the robot, without priors; None where another
        station has it.
        """
        return self.information_by() if callable(self.information_by) else self.information_by

    @property
    def values(self) -> np.ndarray:
        """Values of all parameters, shape (P,), as deviations from the nominal."""
        return self.estimate.values

    @property
    def model_values(self) -> np.ndarray:
        """Values of the model's parameters, without the sensor's own."""
        return self.model.own(self.values)

    @cached_property
    def dense_covariance(self) -> np.ndarray:
        """The covariance as a matrix, shape (P, P)."""
        return self.estimate.dense_covariance()

    def readings(self, measurements: Measurements) -> Station:
        """Return the model over measurements.

        Raises:
            MeasurementError: if they are of another kind than those of the calibration, or of
                unknown points.
        """
        if not self.reads(measurements):
            raise MeasurementError(
                f"{measurements.source}: measurements of kind {measurements.kind}; "
                f"expected {self.sensor_kind}, "
                "as this model was calibrated with"
            )
        return station_of(
            self.model, self.of_its_day(measurements), self.payload_centre, self.setup
        )

    def unrecorded(self, rows: Measurements | Conditions) -> list[Effect]:
        """Return the effects that need temperature, time or moves that rows lack."""
        return [
            e
            for e in self.model.effects
            if any(getattr(rows, column) is None for column in of_the_day(e))
        ]

    def of_its_day(self, rows: _Rows) -> _Rows:
        """Return rows with the calibration's means of temperature, time and moves that effects need
        and they lack.
        """
        lacking = {column for effect in self.unrecorded(rows) for column in of_the_day(effect)}
        return self._at_days(
            rows, [name for name in sorted(lacking) if getattr(rows, name) is None]
        )

    def _at_days(self, rows: _Rows, names: list[str], side: float = 0.0) -> _Rows:
        """Return rows with known columns of the day at their means, shifted by so many standard
        deviations.
        """
        days = {name: self.covered.days[name] for name in names if name in self.covered.days}
        columns: dict[str, Any] = {
            name: np.full(rows.q.shape if name == "move" else len(rows.q), mean + side * spread)
            for name, (mean, spread) in days.items()
        }
        return replace(rows, **columns) if columns else rows

    def varied_by(self, effect: Effect, conditions: Conditions) -> np.ndarray:
        """Return how far the target moves, shape (N, 3) [m], if the variable of an effect changes
        by a standard deviation.

        The conditions have all columns that the model needs.
        """

        def displacement(at: Conditions) -> np.ndarray:
            without = self.model_values.copy()
            without[self.model.spans[self.model.effects.index(effect)]] = 0.0
            ends = [
                self.model.predict(values, at)[:, :, 3] for values in (self.model_values, without)
            ]
            return np.asarray(ends[0] - ends[1])

        columns = [column for column in of_the_day(effect) if column in self.covered.days]
        if columns:
            ends = [displacement(self._at_days(conditions, columns, side)) for side in (1.0, -1.0)]
            return np.asarray(0.5 * (ends[0] - ends[1]))
        found = displacement(conditions)
        # A displacement common to all poses is taken up by the pose of the instrument.
        return np.asarray(found - found.mean(axis=0))

    def note_on(
        self, effect: Effect, source: str, conditions: Conditions | None
    ) -> tuple[float, str]:
        """Return how far an effect of the day or the set-up typically moved the target [m], and how
        it is treated.

        Args:
            effect: the effect.
            source: name of the rows.
            conditions: of the rows, with all columns that the model needs; None where the model's
                file lacks their means.
        """
        name = " of ".join(filter(None, (effect.name, effect.locus.joint)))
        columns = ", ".join(of_the_day(effect))
        lacks = (
            f"{source} has no column {columns}"
            if columns
            else "it belongs to the previous set-up of the instrument"
        )
        left_out = "of the calibration's station is left out"
        at_mean = "is taken at its mean over the calibration's rows"
        treated = f"{name} {left_out if effect.scope == 'station' else at_mean}: {lacks}"
        if conditions is None:
            return 0.0, treated
        size = float(np.sqrt(np.mean(np.sum(self.varied_by(effect, conditions) ** 2, axis=1))))
        return (
            size,
            f"{treated}; its variation there adds {format_readable(size, 'm', '.2g')} of "
            "uncertainty",
        )

    def notes_on_day(self, rows: Measurements) -> tuple[str, ...]:
        """Return how effects of a temperature, time or move that rows lack are treated."""
        full = self.of_its_day(self.conditions(rows))
        return tuple(self.note_on(effect, rows.source, full)[1] for effect in self.unrecorded(rows))

    def options(self, **others: Any) -> Options:
        """Return the options of the calibration's station, with others."""
        x, y, z = map(float, self.payload_centre)
        return Options(payload_centre=(x, y, z), **{"setup": self.setup} | others)

    def reads(self, measurements: Measurements) -> bool:
        """Return whether it predicts measurements of this kind: its own, or any if it has no
        parameters of a sensor.
        """
        has_own = bool(self.setup.points) or len(self.values) > self.model.n_parameters
        return not has_own or self.sensor_kind == measurements.kind

    def conditions(self, measurements: Measurements) -> Conditions:
        """Return the conditions of a table's rows, with the payload's centre of mass that the
        calibration assumed.

        Raises:
            BadInputError: for a target that the model does not have.
        """
        return conditions_of(self.model, measurements, np.array(self.payload_centre))

    def between(self, start: str | None = None, tip: str | None = None) -> Self:
        """Return the model of the pose of a link of the robot relative to another, without any
        instrument or target.

        Args:
            start: the reference link; default: the robot's base.
            tip: the link; default: that of the calibration.

        Raises:
            RobotFileError: for an unknown link, or if a joint on the way is locked in this robot.
        """
        own = self.with_effects(lambda effect: effect.scope == "robot")
        chain = own.model.chain.between(
            start or own.model.chain.robot.base, tip or own.model.chain.path.tip
        )
        chain = chain.with_references(np.eye(3), np.tile(np.eye(3), (len(chain.targets), 1, 1)))
        return replace(own, model=own.model.with_chain(chain))

    def conditions_at(
        self, q: ArrayLike, *, payload: float = 0.0, target: str | None = None
    ) -> Conditions:
        """Return the conditions of reported joint positions with a common payload [kg] and target.

        Joints that follow from others may be left out of ``q``.

        Raises:
            BadInputError: if the joint positions have another shape, or there is no such target.
        """
        positions = np.atleast_2d(np.asarray(q, float))
        robot = self.model.chain.robot
        n = robot.n_joints
        if robot.dependent and positions.ndim == 2 and positions.shape[1] == len(robot.own_joints):
            positions = robot.spread(positions)
        if positions.ndim != 2 or positions.shape[1] != n:
            raise BadInputError(
                f"joint positions have shape {np.shape(q)}; expected (N, {n}), one row per pose"
            )
        targets = self.model.chain.targets
        if target is not None and target not in targets:
            raise BadInputError(
                f"target {target!r} is not in the model; expected one of {', '.join(targets)}"
            )
        found = Conditions.at(
            robot.from_reported(positions), payload=payload, payload_centre=self.payload_centre
        )
        return replace(
            found, target=np.full(len(positions), 0 if target is None else targets.index(target))
        )

    def camera(self) -> dict[str, Any]:
        """Return the camera, as :func:`pincal.io.camera_file.read_camera` reads it from JSON.

        Raises:
            BadInputError: if the model was not calibrated with images.
        """
        places = {
            p.name.removeprefix("camera."): p
            for p in self.estimate.parameters
            if p.effect.startswith("lens")
        }
        if not places:
            raise BadInputError(
                f"this model was calibrated with {self.sensor_kind}, not with images: it "
                "has no camera"
            )
        mount = placed(self.model.chain.tool_rotations[0], self.estimate.frame("camera"))
        lens = {
            name: parameter.nominal + self.estimate[parameter.name]
            for name, parameter in places.items()
        }
        return {**lens, "T_tip_camera": mount.tolist()}

    def outside(self, conditions: Conditions) -> list[Outside]:
        """Return, row by row, values beyond the range of the training rows, where the model is not
        validated.
        """
        return self.covered.outside(self.model.chain.robot, conditions)

    def outside_curves(self, conditions: Conditions) -> list[OutsideCurve]:
        """Return the curves that some rows need beyond their range; there they keep their end
        values, not extrapolated.
        """
        return [
            OutsideCurve(
                *(curve.effect.name, curve.joint, curve.variable, int(curve.beyond.sum())),
                *(float(curve.x.min()), float(curve.x.max()), *curve.span),
            )
            for curve in curves_at(self.model, self.of_its_day(conditions))
            if curve.beyond.any()
        ]

    def gaps(self, conditions: Conditions) -> list[CurveGap]:
        """Return the gaps in the curves of the model, where they are interpolated, in which some
        rows lie.
        """
        return [
            CurveGap(
                curve.effect.name, curve.joint, curve.variable, int(inside.sum()), *map(float, gap)
            )
            for curve in curves_at(self.model, self.of_its_day(conditions))
            for gaps in [curve.gaps(self.model.chain, self.estimate)]
            for gap, inside in zip(gaps, curve.rows_in(gaps), strict=True)
            if inside.any()
        ]

    def knows(self, conditions: Conditions) -> np.ndarray:
        """Return the rows at which the training rows determine every curve of the model, shape
        (N,).
        """
        known = np.ones(len(conditions), bool)
        for curve in curves_at(self.model, self.of_its_day(conditions)):
            known &= curve.determined(self.model.chain, self.estimate)
        return known

    def turned_curves(self, conditions: Conditions) -> list[Turned]:
        """Return the curves that some rows need a revolution away from their range, taken to be
        periodic.
        """
        return [
            Turned(curve.effect.name, curve.joint, curve.variable, rows)
            for curve in curves_at(self.model, self.of_its_day(conditions))
            if (rows := int(np.sum((curve.x != curve.recorded) & ~curve.beyond)))
        ]

    def with_effects(self, is_kept: Callable[[Effect], bool]) -> Self:
        """Return the same model without some effects, not refitted."""
        gone = [effect for effect in self.model.effects if not is_kept(effect)]
        names = {p.name for effect in gone for p in effect.parameters(self.model.chain)}
        kept = np.array([name not in names for name in self.estimate.names], bool)
        return replace(
            self,
            model=self.model.with_effects(
                [effect for effect in self.model.effects if is_kept(effect)]
            ),
            estimate=self.estimate.drop(names),
            nominal_values=None if self.nominal_values is None else self.nominal_values[kept],
        )
