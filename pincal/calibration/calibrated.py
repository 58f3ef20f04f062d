"""The calibrated model, the one object to predict with, and its file ``model.json``."""

from __future__ import annotations

import html
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from pincal.atomic import write_whole
from pincal.calibration.covered import Covered, Outside, OutsideCurve, Turned, outside_curves, turned_curves
from pincal.calibration.day import rows_with_means, unrecorded, varied_by, with_means, words_of
from pincal.calibration.left import Left
from pincal.calibration.tables import estimate_table
from pincal.errors import BadInputError, MeasurementError, OutputError
from pincal.identify.fingerprints import fingerprints
from pincal.identify.fit import Fit
from pincal.identify.station import Station, conditions_of, station_of
from pincal.io.entries import ModelEntry, ParameterEntry
from pincal.io.model_file import FORMAT_VERSION, MeasuredEntry, ModelFile, read_model_file, write_model_file
from pincal.io.strict_json import Fault
from pincal.io.urdf_export import UrdfExport, calibrated_urdf
from pincal.measure.measurements import Measurements
from pincal.measure.setup import Setup
from pincal.model.augmented import pinocchio_model
from pincal.model.effects import Conditions, Effect
from pincal.model.model import Model
from pincal.parameters import FRAME_SYMBOLS, Covariance, Estimate, Parameter
from pincal.robot.se3 import placed
from pincal.tables import Table

if TYPE_CHECKING:
    import pinocchio as pin

# Rows worked on at once: with 60 parameters a piece is about 6 MB.
_PIECE = 4096


class Calibrated(ABC):
    """What a calibration is good for, whether it was made just now or read from a file."""

    @abstractmethod
    def to_model(self) -> CalibratedModel:
        """Return the calibrated model, all that a prediction or a diagnosis needs."""

    @abstractmethod
    def _predictor(self) -> CalibratedModel:
        """Return what a prediction needs of it: to find what it left takes as long as a fit."""

    @abstractmethod
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``model.json``, from which :func:`pincal.load_model` returns the calibrated model."""

    @property
    @abstractmethod
    def parameters(self) -> Table:
        """The parameters with their standard deviations, as a table."""

    @abstractmethod
    def summary(self) -> str:
        """Return what was calibrated and how well, in a few lines."""

    @property
    def models(self) -> Mapping[str, CalibratedModel]:
        """The calibrated model of each station by its name; of a single one, which needs none, under ""."""
        return {"": self.to_model()}

    def robot_model(self) -> CalibratedModel:
        """Return a calibrated model of the robot itself, whatever it was measured with."""
        return self.to_model()

    def robot_predictor(self) -> CalibratedModel:
        """Return the same as far as it predicts: to find what it left may take as long as a fit."""
        return self._predictor()

    @property
    @abstractmethod
    def left(self) -> Left | None:
        """Effects that the rows of the calibration showed and the model does not have, as far as that is known."""

    @property
    @abstractmethod
    def robot_estimate(self) -> Estimate:
        """What is known of the robot's own parameters, whatever it was measured with: ``Options.earlier`` of a next fit."""

    @overload
    def predict(
        self,
        at: Conditions | ArrayLike,
        *,
        payload: float = 0.0,
        target: str | None = None,
        return_sigma: Literal[False] = False,
    ) -> np.ndarray: ...

    @overload
    def predict(
        self, at: Conditions | ArrayLike, *, payload: float = 0.0, target: str | None = None, return_sigma: Literal[True]
    ) -> tuple[np.ndarray, np.ndarray]: ...

    def predict(
        self,
        at: Conditions | ArrayLike,
        *,
        payload: float = 0.0,
        target: str | None = None,
        return_sigma: bool = False,
    ) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
        """Return the target's poses in the instrument's frame (of contacts: in the robot's base frame).

        Args:
            at: joint positions, shape (N, n) or (n,) [rad, prismatic m], or the conditions of N poses, for models that need
                temperature, time or the direction of approach. Temperature and time that they lack are those of the mean of
                the calibration's rows, for what follows them.
            payload: mass at the tip [kg]; not with conditions.
            target: name of the target; default: the first one; not with conditions.
            return_sigma: whether to return the standard deviation of the position, too.

        Returns:
            Rotation and translation [m], shape (N, 3, 4), and with ``return_sigma`` the standard deviation of the position,
            shape (N, 3) [m], see :meth:`position_sigma`.

        Raises:
            BadInputError: if the joint positions have another shape, or there is no such target.
        """
        model = self._predictor()
        conditions = at if isinstance(at, Conditions) else model.conditions_at(at, payload=payload, target=target)
        poses = model.model.predict(model.model_values, model.of_its_day(conditions))
        return (poses, self.position_sigma(conditions)) if return_sigma else poses

    def position_sigma(self, conditions: Conditions) -> np.ndarray:
        r"""Return the standard deviation of the predicted position, shape (N, 3) [m], in the instrument's axes.

        :math:`\sqrt{\mathrm{diag}(J C J^T)}`: what the calibration leaves unknown, without the noise of a measurement; and
        what is unknown beside that, where an effect follows temperature or time and the conditions lack them: as much as it
        varied over the calibration's rows.
        """
        found = self._predictor()
        unknown = found.unknown_motion(conditions)
        conditions = found.of_its_day(conditions)
        n = found.model.n_parameters
        C = found.covariance[:n, :n]
        out = np.empty((len(conditions), 3))
        for start in range(0, len(conditions), _PIECE):
            rows = slice(start, start + _PIECE)
            _, J = found.model.linearise(found.model_values, conditions.select(rows))
            out[rows] = np.einsum("nip,nip->ni", J @ C, J)
        return np.asarray(np.sqrt(np.maximum(out, 0.0) + unknown))

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the values, shape (P, P); zero rows and columns for those that were not fitted."""
        return self._predictor().dense_covariance

    def export_urdf(self, path: str | os.PathLike[str] | None = None) -> UrdfExport:
        """Return the robot's URDF with the calibrated geometry, and write it to a file if one is named.

        Raises:
            RobotFileError: if the model has no URDF.
            OutputError: if the place can't be written to.
        """
        found = self.robot_predictor()
        export = calibrated_urdf(found.model, found.values)
        if path is not None:
            write_whole(path, export.text)
        return export

    def to_pinocchio(self) -> pin.Model:
        """Return the robot's Pinocchio model with the calibrated geometry; elastic effects are not in it."""
        found = self.robot_predictor()
        return pinocchio_model(found.model, found.model_values)

    def _repr_html_(self) -> str:
        lines = "<br>".join(html.escape(line) for line in self.summary().splitlines())
        return f"<p>{lines}</p>{self.parameters._repr_html_()}"


@dataclass(frozen=True, repr=False)
class CalibratedModel(Calibrated):
    """A calibrated robot, ready to predict.

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

    Example:
        >>> from pincal.model.chain import Chain
        >>> from pincal.robot.robot import Robot
        >>> model = Model(Chain.of(Robot.from_urdf("ur10")), ())
        >>> covered = Covered(np.tile([-1.0, 1.0], (6, 1)), np.array([0.0, 5.0]))
        >>> nothing = estimate_of((), np.zeros(0), np.zeros((0, 0)))
        >>> ur10 = CalibratedModel(model, nothing, "position", np.zeros(3), covered, np.array([1e-4]), {})
        >>> ur10.outside(Conditions.at(np.zeros((1, 6)), payload=8.0))
        [Outside(row=0, name='payload', value=8.0, lower=0.0, upper=5.0)]
        >>> ur10.predict(np.zeros(6)).shape, ur10
        ((1, 3, 4), CalibratedModel('ur10': 0 parameters, position))
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
    left: Left | None = None

    @classmethod
    def of(cls, fit: Fit, provenance: dict[str, Any] | None = None, *, station: str | None = None) -> CalibratedModel:
        """Return the calibrated model of a fit.

        Args:
            fit: the fit.
            provenance: where it came from, in types that JSON knows.
            station: name of the station; default: the only one.

        Raises:
            BadInputError: if no station is named and there are several.
        """
        name = fit.station.name if station is None else station
        k = [found.name for found in fit.problem.stations].index(name)
        at, options = fit.problem.stations[k], fit.options.at(name)
        estimate, places = estimate_at(fit.estimate, name, at.model)
        return cls(
            model=at.model,
            estimate=replace(estimate, prior=np.array([parameter.size for parameter in estimate.parameters])),
            sensor_kind=at.sensor.kind,
            payload_centre=np.array(options.payload_centre, float),
            covered=Covered.of(at.conditions),
            sigma=np.array(fit.solution.sigma[fit.problem.block_spans[k]], float),
            provenance=dict(provenance or {}),
            setup=options.setup,
            nominal_values=fit.nominal.values[places],
            rows=fingerprints(at),
            is_noise_declared=options.sigma is not None,
        )

    @classmethod
    def of_entry(
        cls,
        entry: MeasuredEntry,
        model: Model,
        *,
        estimate: Estimate,
        nominal_values: np.ndarray | None,
        provenance: dict[str, Any],
    ) -> CalibratedModel:
        """Return the calibrated model of a station of a file; the others as they stand in :class:`CalibratedModel`."""
        return cls(
            model=model,
            estimate=estimate,
            sensor_kind=entry.sensor_kind,
            payload_centre=entry.payload_centre,
            covered=Covered(
                entry.covered.q, entry.covered.payload, {str(name): day for name, day in (entry.covered.days or {}).items()}
            ),
            sigma=entry.sigma,
            provenance=provenance,
            setup=entry.setup.setup(),
            nominal_values=nominal_values,
            rows=entry.rows,
            is_noise_declared=entry.is_noise_declared,
            left=None if entry.left is None else Left(*entry.left.parts()),
        )

    def __repr__(self) -> str:
        robot = self.model.chain.robot.name
        return f"CalibratedModel({robot!r}: {len(self.estimate)} parameters, {self.sensor_kind})"

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

    @property
    def robot_estimate(self) -> Estimate:
        """What is known of the robot's own parameters, whatever it was measured with: ``Options.earlier`` of a next fit."""
        chain, effects = self.model.chain, self.model.effects
        return self.estimate.take(p.name for e in effects if e.scope == "robot" for p in e.parameters(chain))

    def to_model(self) -> CalibratedModel:
        """Return the model itself."""
        return self

    def _predictor(self) -> CalibratedModel:
        return self

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``model.json``: the whole file or nothing, its numbers in full precision.

        Args:
            path: the file; an existing one is replaced only when the new one is complete.

        Raises:
            OutputError: if the place can't be written to, or a number is not finite.
        """
        try:
            file = ModelFile.of_station(
                self,
                format_version=FORMAT_VERSION,
                parameters=tuple(map(ParameterEntry.of_parameter, self.estimate.parameters)),
                model=ModelEntry.of_model(self.model),
                files=None,
            )
        except Fault as fault:
            place = fault.key.removeprefix(".")
            raise OutputError(f"{os.fspath(path)}: not finite or not whole: {place} {fault}; calibrate again") from None
        write_model_file(path, file)

    @property
    def parameters(self) -> Table:
        """Value and standard deviation of each parameter."""
        return estimate_table(self.estimate)

    def summary(self) -> str:
        """Return which robot it is, what it was calibrated with and how many parameters were found."""
        robot = self.model.chain.robot
        effects = ", ".join(dict.fromkeys(effect.name for effect in self.model.effects))
        return (
            f"{robot.name}, {robot.n_joints} joints from {robot.base} to {robot.tip}, calibrated with {self.sensor_kind} "
            f"measurements\n{int(self.estimate.free.sum())} of {len(self.estimate)} parameters fitted: {effects}"
        )

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
        rows = rows_with_means(measurements, self.model, self.covered.days)
        return station_of(self.model, rows, self.payload_centre, self.setup)

    def of_its_day(self, conditions: Conditions) -> Conditions:
        """Return conditions with the calibration's mean temperature and time, where effects need them and they lack them."""
        return with_means(conditions, self.model, self.covered.days)

    def unknown_motion(self, conditions: Conditions) -> np.ndarray:
        """Return the variance of the target's position by effects that follow what conditions lack, shape (N, 3) [m^2]."""
        lacking = unrecorded(self.model, lambda column: conditions.column(column) is not None)
        at, days = self.of_its_day(conditions), self.covered.days
        ways = [varied_by(effect, self.model, self.model_values, at, days) for effect in lacking]
        return np.sum(np.square(ways), axis=0) if ways else np.zeros((len(conditions), 3))

    def notes_on_day(self, rows: Measurements) -> tuple[str, ...]:
        """Return what is done about effects that follow a temperature or time that rows lack."""
        full, days, notes = self.of_its_day(self.conditions(rows)), self.covered.days, []
        for effect in unrecorded(self.model, lambda column: getattr(rows, column) is not None):
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

        Joints that mimic another one may be left out of ``q``.

        Raises:
            BadInputError: if the joint positions have another shape, or there is no such target.
        """
        positions, robot = np.atleast_2d(np.asarray(q, float)), self.model.chain.robot
        n = robot.n_joints
        if robot.mimics and positions.ndim == 2 and positions.shape[1] == len(robot.own_joints):
            positions = robot.spread(positions)
        if positions.ndim != 2 or positions.shape[1] != n:
            raise BadInputError(f"joint positions have shape {np.shape(q)}; expected (N, {n}), one row per pose")
        targets = self.model.chain.targets
        if target is not None and target not in targets:
            raise BadInputError(f"target {target!r} is not in the model; expected one of {', '.join(targets)}")
        found = Conditions.at(positions, payload=payload, payload_centre=self.payload_centre)
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
        return outside_curves(self.model, self.of_its_day(conditions))

    def turned_curves(self, conditions: Conditions) -> list[Turned]:
        """Return the curves that some rows ask for a turn away from where they were seen, taken as if they repeated."""
        return turned_curves(self.model, self.of_its_day(conditions))

    def with_effects(self, is_kept: Callable[[Effect], bool]) -> CalibratedModel:
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


def estimate_of(parameters: Sequence[Parameter], values: np.ndarray, covariance: np.ndarray) -> Estimate:
    """Return an estimate of parameters from a covariance over all of them, zero for those that were not fitted.

    Args:
        parameters: the P parameters.
        values: shape (P,), deviations from the nominal.
        covariance: shape (P, P).
    """
    free = np.diag(covariance) > 0.0
    prior = np.array([parameter.size for parameter in parameters])
    return Estimate(tuple(parameters), values, free, Covariance.of(covariance[np.ix_(free, free)]), prior)


def estimate_at(estimate: Estimate, station: str, model: Model) -> tuple[Estimate, np.ndarray]:
    """Return the estimate of one station's parameters by their names within it, and their places among all, shape (P,)."""
    of_sensor = [p.name for p in estimate.parameters if p.station == station]
    of_model = [f"{station}/{n}" if f"{station}/{n}" in estimate.names else n for n in model.names]
    names = [*of_model, *(n for n in of_sensor if n not in of_model)]
    found = estimate.take(names)
    local = tuple(replace(p, name=p.local_name, station="") for p in found.parameters)
    return replace(found, parameters=local), estimate.places(names)


def save_model(path: str | os.PathLike[str], calibrated: CalibratedModel) -> None:
    """Write ``model.json``; see :meth:`CalibratedModel.save`."""
    calibrated.save(path)


def load_model(path: str | os.PathLike[str]) -> CalibratedModel:
    """Read ``model.json``.

    Raises:
        ModelFileError: if the file can't be read, is cut off or newer than this version, or a value is invalid.
    """
    return model_of_file(read_model_file(path))


def model_of_file(file: ModelFile) -> CalibratedModel:
    """Return the model that a ``model.json`` of one station describes."""
    parameters = [entry.parameter() for entry in file.parameters]
    estimate = estimate_of(parameters, file.values, file.covariance)
    nominal, provenance = file.nominal_values, file.provenance
    return CalibratedModel.of_entry(
        file, file.model.model(), estimate=estimate, nominal_values=nominal, provenance=provenance
    )
