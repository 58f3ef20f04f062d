"""The calibrated model and its file, ``model.json``: all that a prediction needs, without the URDF."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from pincal.errors import BadInputError, MeasurementError, OutputError
from pincal.identify.fit import Fit
from pincal.identify.station import Station, conditions_of, station_of
from pincal.io.model_file import (
    FORMAT_VERSION,
    CoveredEntry,
    ModelEntry,
    ModelFile,
    ParameterEntry,
    SetupEntry,
    read_model_file,
    write_model_file,
)
from pincal.io.strict_json import Fault
from pincal.measure.measurements import Measurements
from pincal.measure.setup import Setup
from pincal.model.catalogue import TransmissionError
from pincal.model.catalogue.unnamed import Unnamed, variable
from pincal.model.effects import Conditions
from pincal.model.model import Model
from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.robot.se3 import placed

# What still counts as covered beyond the training rows: this part of their range, and this much [rad, m or kg].
_MARGIN_PART, _MARGIN = 0.02, 1e-3
# Rows worked on at once: with 60 parameters a piece is about 6 MB.
_PIECE = 4096


class Outside(NamedTuple):
    """A value beyond the training rows: row index, joint name or "payload", the value and their range [rad, m or kg]."""

    row: int
    name: str
    value: float
    lower: float
    upper: float


class OutsideCurve(NamedTuple):
    """Rows beyond the range in which a curve of the model was seen; there it keeps its end value.

    Attributes:
        effect, joint: the curve.
        variable: what it follows: a joint's name, "time", "temperature" or "payload".
        rows: how many rows lie beyond.
        lowest, highest: of the variable over all rows.
        lower, upper: the range that was seen.
    """

    effect: str
    joint: str
    variable: str
    rows: int
    lowest: float
    highest: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Covered:
    """What the training rows cover: ``q``, shape (n, 2), least and largest joint positions, and ``payload``, shape (2,)."""

    q: np.ndarray
    payload: np.ndarray

    @classmethod
    def of(cls, conditions: Conditions) -> Covered:
        """Return what some rows cover."""
        q, payload = conditions.q, conditions.payload
        return cls(np.column_stack([q.min(axis=0), q.max(axis=0)]), np.array([payload.min(), payload.max()]))


@dataclass(frozen=True)
class CalibratedModel:
    """A calibrated robot, ready to predict.

    Attributes:
        model: chain and effects.
        values: shape (P,), the model's parameters and then the sensor's own, as deviations from the nominal.
        covariance: shape (P, P), of the values; zero rows and columns for those that were not fitted.
        parameters: names, units and nominal values, in the same order.
        sensor_kind: what was measured: "position", "pose", "distance" and so on.
        payload_centre: shape (3,), centre of mass of the payload in the tip frame [m].
        covered: the range of the training rows.
        sigma: shape (blocks,), noise of one component of each block of readings that the fit used [m, rad].
        provenance: version of pincal, time, input files with their SHA-256, command and seed.
        setup: named points and the camera that it was calibrated with.

    Example:
        >>> from pincal.model.chain import Chain
        >>> from pincal.robot.robot import Robot
        >>> model = Model(Chain.of(Robot.from_urdf("ur10")), ())
        >>> covered = Covered(np.tile([-1.0, 1.0], (6, 1)), np.array([0.0, 5.0]))
        >>> nothing, none = np.zeros(0), np.zeros((0, 0))
        >>> ur10 = CalibratedModel(model, nothing, none, (), "position", np.zeros(3), covered, np.array([1e-4]), {})
        >>> ur10.outside(Conditions.at(np.zeros((1, 6)), payload=8.0))
        [Outside(row=0, name='payload', value=8.0, lower=0.0, upper=5.0)]
    """

    model: Model
    values: np.ndarray
    covariance: np.ndarray
    parameters: tuple[Parameter, ...]
    sensor_kind: str
    payload_centre: np.ndarray
    covered: Covered
    sigma: np.ndarray
    provenance: dict[str, Any]
    setup: Setup = field(default_factory=Setup)

    def readings(self, measurements: Measurements) -> Station:
        """Return the model over measurements.

        Raises:
            MeasurementError: if they are of another kind than those of the calibration, or of points that it did not have.
        """
        if self.setup.points and self.sensor_kind != measurements.kind:
            raise MeasurementError(
                f"{measurements.source}: measurements of kind {measurements.kind}; expected {self.sensor_kind}, "
                "as this model was calibrated with"
            )
        return station_of(self.model, measurements, self.payload_centre, self.setup)

    def conditions(self, measurements: Measurements) -> Conditions:
        """Return the conditions of a table's rows, with the payload's centre of mass that the calibration assumed.

        Raises:
            BadInputError: for a target that the model does not have.
        """
        return conditions_of(self.model, measurements, np.array(self.payload_centre))

    def camera(self) -> dict[str, Any]:
        """Return the camera, as :func:`pincal.io.camera_file.read_camera` reads it from JSON.

        Raises:
            BadInputError: if the model was not calibrated with images.
        """
        places = {p.name.removeprefix("camera."): i for i, p in enumerate(self.parameters) if p.effect.startswith("lens")}
        if not places:
            raise BadInputError(f"this model was calibrated with {self.sensor_kind}, not with images: it has no camera")
        tool = self.values[[self.model.index(f"camera.{symbol}") for symbol in FRAME_SYMBOLS]]
        mount = placed(self.model.chain.tool_rotations[0], tool)
        lens = {name: self.parameters[i].nominal + float(self.values[i]) for name, i in places.items()}
        return {**lens, "T_tip_camera": mount.tolist()}

    def predict(self, conditions: Conditions) -> np.ndarray:
        """Return the target's poses in the instrument's frame, shape (N, 3, 4): rotation and translation [m]."""
        return self.model.predict(self.values[: self.model.n_parameters], conditions)

    def position_sigma(self, conditions: Conditions) -> np.ndarray:
        r"""Return the standard deviation of the predicted position, shape (N, 3) [m], in the instrument's axes.

        :math:`\sqrt{\mathrm{diag}(J C J^T)}`: what the calibration leaves unknown, without the noise of a measurement.
        """
        n = self.model.n_parameters
        C = self.covariance[:n, :n]
        out = np.empty((len(conditions), 3))
        for start in range(0, len(conditions), _PIECE):
            rows = slice(start, start + _PIECE)
            _, J = self.model.linearise(self.values[:n], conditions.select(rows))
            out[rows] = np.einsum("nip,nip->ni", J @ C, J)
        return np.sqrt(np.maximum(out, 0.0))

    def outside(self, conditions: Conditions) -> list[Outside]:
        """Return, row by row, what lies beyond the range of the training rows, where nobody has checked the model."""
        names = (*self.model.chain.robot.joint_names, "payload")
        values = np.column_stack([conditions.q, conditions.payload])
        lower, upper = np.vstack([self.covered.q, self.covered.payload]).T
        margin = _MARGIN_PART * (upper - lower) + _MARGIN
        beyond = (values < lower - margin) | (values > upper + margin)
        return [
            Outside(int(i), names[j], float(values[i, j]), float(lower[j]), float(upper[j])) for i, j in np.argwhere(beyond)
        ]

    def outside_curves(self, conditions: Conditions) -> list[OutsideCurve]:
        """Return the curves that some rows ask for beyond the range in which they were seen.

        A curve found in one range says nothing of another (it may even do harm there), so it keeps its end value.
        """
        found = []
        for effect in self.model.effects:
            if isinstance(effect, TransmissionError):
                name = effect.joint
            elif isinstance(effect, Unnamed) and effect.shape == "curve":
                name = effect.depends_on
            else:
                continue
            x = variable(self.model.chain, conditions, name)
            margin = _MARGIN_PART * (effect.upper - effect.lower) + _MARGIN
            beyond = int(np.sum((x < effect.lower - margin) | (x > effect.upper + margin)))
            if beyond:
                asked = float(x.min()), float(x.max())
                found.append(OutsideCurve(effect.name, effect.joint, name, beyond, *asked, effect.lower, effect.upper))
        return found


def calibrated_model_of(fit: Fit, provenance: dict[str, Any]) -> CalibratedModel:
    """Return the calibrated model of a fit.

    Args:
        fit: the fit.
        provenance: where it came from, in types that JSON knows.
    """
    problem, free = fit.station, fit.solution.free
    covariance = np.zeros((len(free), len(free)))
    covariance[np.ix_(free, free)] = fit.solution.posterior.covariance
    return CalibratedModel(
        model=fit.model,
        values=fit.values.copy(),
        covariance=covariance,
        parameters=problem.parameters,
        sensor_kind=problem.sensor.kind,
        payload_centre=np.array(fit.options.payload_centre, float),
        covered=Covered.of(problem.conditions),
        sigma=np.array(fit.solution.sigma, float),
        provenance=dict(provenance),
        setup=fit.options.setup,
    )


def save_model(path: str | os.PathLike[str], calibrated: CalibratedModel) -> None:
    """Write ``model.json``: the whole file or nothing, its numbers in full precision.

    Args:
        path: the file; an existing one is replaced only when the new one is complete.
        calibrated: the model.

    Raises:
        OutputError: if the place can't be written to, or a number is not finite.
    """
    try:
        file = _file_of(calibrated)
    except Fault as fault:
        place = fault.key.removeprefix(".")
        raise OutputError(f"{os.fspath(path)}: not finite or not whole: {place} {fault}; calibrate again") from None
    write_model_file(path, file)


def load_model(path: str | os.PathLike[str]) -> CalibratedModel:
    """Read ``model.json``.

    Raises:
        ModelFileError: if the file can't be read, is cut off or newer than this version, or a value is invalid.
    """
    file = read_model_file(path)
    return CalibratedModel(
        model=file.model.model(),
        values=file.values,
        covariance=file.covariance,
        parameters=tuple(entry.parameter() for entry in file.parameters),
        sensor_kind=file.sensor_kind,
        payload_centre=file.payload_centre,
        covered=Covered(file.covered.q, file.covered.payload),
        sigma=file.sigma,
        provenance=file.provenance,
        setup=file.setup.setup(),
    )


def _file_of(calibrated: CalibratedModel) -> ModelFile:
    c = calibrated
    return ModelFile(
        format_version=FORMAT_VERSION,
        provenance=c.provenance,
        sensor_kind=c.sensor_kind,
        sigma=c.sigma,
        payload_centre=c.payload_centre,
        covered=CoveredEntry(q=c.covered.q, payload=c.covered.payload),
        parameters=tuple(ParameterEntry.of(parameter) for parameter in c.parameters),
        values=c.values,
        covariance=c.covariance,
        model=ModelEntry.of(c.model),
        setup=SetupEntry.of(c.setup),
    )
