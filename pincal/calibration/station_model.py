"""The model of a robot at the station where it was calibrated, and what it makes of rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from pincal.calibration.covered import (
    Covered,
    Outside,
    OutsideCurve,
    Turned,
    curves_at,
    unrecorded,
    varied_by,
    with_means,
    words_of,
)
from pincal.calibration.unmodelled import Unmodelled
from pincal.errors import BadInputError, MeasurementError
from pincal.identify.station import Station, conditions_of, station_of
from pincal.measure.measurements import Measurements
from pincal.measure.setup import Setup
from pincal.model.effects import Conditions, Effect
from pincal.model.model import Model
from pincal.parameters import FRAME_SYMBOLS, Estimate
from pincal.robot.se3 import placed


@dataclass(frozen=True, repr=False)
class StationModel:
    """A model of a robot as it was calibrated at a station.

    Attributes:
        model: chain and effects.
        estimate: the model's parameters and then the sensor's own, with values and covariance.
        sensor_kind: what was measured: "position", "pose", "distance" and so on.
        payload_centre: shape (3,), centre of mass of the payload in the tip frame [m].
        covered: the range of the training rows.
        sigma: shape (blocks,), noise of one component of each block of readings that the fit used [m, rad].
        provenance: version of pincal, time, input files with their SHA-256, command and seed.
        setup: named points and the camera that it was calibrated with.
        nominal_values: shape (P,), the values with only base and tool fitted; None where nobody knows them.
        rows: fingerprints of the training rows; empty where nobody knows them.
        is_noise_declared: whether the noise was declared, not estimated.
        left: effects that the rows showed and the model does not have; None where there were none, or nobody looked.
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
    left: Unmodelled | None = None

    @property
    def values(self) -> np.ndarray:
        """Values of all parameters, shape (P,), as deviations from the nominal."""
        return self.estimate.values

    @property
    def model_values(self) -> np.ndarray:
        """Values of the model's parameters; the sensor's own left out."""
        return self.model.own(self.values)

    @cached_property
    def dense_covariance(self) -> np.ndarray:
        """The covariance as a matrix, shape (P, P)."""
        return self.estimate.dense_covariance()

    def readings(self, measurements: Measurements) -> Station:
        """Return the model over measurements.

        Raises:
            MeasurementError: if they are of another kind than those of the calibration, or of points that it did not have.
        """
        if not self.reads(measurements):
            raise MeasurementError(
                f"{measurements.source}: measurements of kind {measurements.kind}; expected {self.sensor_kind}, "
                "as this model was calibrated with"
            )
        rows = with_means(measurements, self.model, self.covered.days)
        return station_of(self.model, rows, self.payload_centre, self.setup)

    def of_its_day(self, conditions: Conditions) -> Conditions:
        """Return conditions with the calibration's mean temperature and time, where effects need them and they lack them."""
        return with_means(conditions, self.model, self.covered.days)

    def unknown_motion(self, conditions: Conditions) -> np.ndarray:
        """Return the variance of the target's position by effects that follow what conditions lack, shape (N, 3) [m^2]."""
        lacking = unrecorded(self.model, conditions)
        at, days = self.of_its_day(conditions), self.covered.days
        ways = [varied_by(effect, self.model, self.model_values, at, days) for effect in lacking]
        return np.sum(np.square(ways), axis=0) if ways else np.zeros((len(conditions), 3))

    def notes_on_day(self, rows: Measurements) -> tuple[str, ...]:
        """Return what is done about effects that follow a temperature or time that rows lack."""
        full, days, notes = self.of_its_day(self.conditions(rows)), self.covered.days, []
        for effect in unrecorded(self.model, rows):
            way = varied_by(effect, self.model, self.model_values, full, days)
            size = float(np.sqrt(np.mean(np.sum(way**2, axis=1))))
            notes.append(words_of(effect, rows.source, size=size, is_left_out=effect.scope == "station"))
        return tuple(notes)

    def reads(self, measurements: Measurements) -> bool:
        """Return whether it predicts measurements of this kind: its own, or any if it needs no sensor's parameters."""
        has_own = bool(self.setup.points) or len(self.values) > self.model.n_parameters
        return not has_own or self.sensor_kind == measurements.kind

    def conditions(self, measurements: Measurements) -> Conditions:
        """Return the conditions of a table's rows, with the payload's centre of mass that the calibration assumed.

        Raises:
            BadInputError: for a target that the model does not have.
        """
        return conditions_of(self.model, measurements, np.array(self.payload_centre))

    def conditions_at(self, q: ArrayLike, *, payload: float = 0.0, target: str | None = None) -> Conditions:
        """Return the conditions of joint positions that share a payload [kg] and a target.

        They are those that the controller reports; joints that follow from others may be left out of ``q``.

        Raises:
            BadInputError: if the joint positions have another shape, or there is no such target.
        """
        positions, robot = np.atleast_2d(np.asarray(q, float)), self.model.chain.robot
        n = robot.n_joints
        if robot.dependent and positions.ndim == 2 and positions.shape[1] == len(robot.own_joints):
            positions = robot.spread(positions)
        if positions.ndim != 2 or positions.shape[1] != n:
            raise BadInputError(f"joint positions have shape {np.shape(q)}; expected (N, {n}), one row per pose")
        targets = self.model.chain.targets
        if target is not None and target not in targets:
            raise BadInputError(f"target {target!r} is not in the model; expected one of {', '.join(targets)}")
        found = Conditions.at(robot.from_reported(positions), payload=payload, payload_centre=self.payload_centre)
        return replace(found, target=np.full(len(positions), 0 if target is None else targets.index(target)))

    def camera(self) -> dict[str, Any]:
        """Return the camera, as :func:`pincal.io.camera_file.read_camera` reads it from JSON.

        Raises:
            BadInputError: if the model was not calibrated with images.
        """
        places = {p.name.removeprefix("camera."): p for p in self.estimate.parameters if p.effect.startswith("lens")}
        if not places:
            raise BadInputError(f"this model was calibrated with {self.sensor_kind}, not with images: it has no camera")
        tool = np.array([self.estimate[f"camera.{symbol}"] for symbol in FRAME_SYMBOLS])
        mount = placed(self.model.chain.tool_rotations[0], tool)
        lens = {name: parameter.nominal + self.estimate[parameter.name] for name, parameter in places.items()}
        return {**lens, "T_tip_camera": mount.tolist()}

    def outside(self, conditions: Conditions) -> list[Outside]:
        """Return, row by row, what lies beyond the range of the training rows, where nobody has checked the model."""
        return self.covered.outside(self.model.chain.robot, conditions)

    def outside_curves(self, conditions: Conditions) -> list[OutsideCurve]:
        """Return the curves that some rows ask for beyond the range in which they were seen.

        A curve found in one range says nothing of another (it may even do harm there), so it keeps its end value.
        """
        return [
            OutsideCurve(
                *(curve.effect.name, curve.joint, curve.variable, int(curve.beyond.sum())),
                *(float(curve.x.min()), float(curve.x.max()), *curve.span),
            )
            for curve in curves_at(self.model, self.of_its_day(conditions))
            if curve.beyond.any()
        ]

    def turned_curves(self, conditions: Conditions) -> list[Turned]:
        """Return the curves that some rows need a revolution away from where they were seen, taken as periodic."""
        found = []
        for curve in curves_at(self.model, self.of_its_day(conditions)):
            if rows := int(np.sum((curve.x != curve.recorded) & ~curve.beyond)):
                found.append(Turned(curve.effect.name, curve.joint, curve.variable, rows))
        return found

    def with_effects(self, is_kept: Callable[[Effect], bool]) -> Self:
        """Return the same model without some effects; nothing is fitted again."""
        gone = [effect for effect in self.model.effects if not is_kept(effect)]
        names = {p.name for effect in gone for p in effect.parameters(self.model.chain)}
        kept = np.array([name not in names for name in self.estimate.names], bool)
        return replace(
            self,
            model=self.model.with_effects([effect for effect in self.model.effects if is_kept(effect)]),
            estimate=self.estimate.drop(names),
            nominal_values=None if self.nominal_values is None else self.nominal_values[kept],
        )
