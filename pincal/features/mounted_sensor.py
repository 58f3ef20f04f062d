"""A sensor on the flange of a calibrated robot: where it was at each reading, and what of that is
not known.

What carries it is the target of the calibration, where that was the sensor itself (the camera of an
eye-in-hand calibration, the tip of a probe), or the tip of the robot with a declared mount. A
reading is a point c in the sensor's frame; with the pose (R, t) of the sensor its place is t + R c,
and its errors are those of a point that is fixed to the arm there, and of c itself.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.position_covariance import PositionCovariance, SharedErrors
from pincal.calibration.prediction_uncertainty import PointOnTip
from pincal.compensate.robot_frames import PoseFrame, in_base_frame, tip_in_instrument
from pincal.errors import BadInputError
from pincal.features.flange_sensor import FlangeSensor
from pincal.features.readings import CAMERA_POINT, IMAGE, RANGE, FeatureReadings
from pincal.identify.beliefs import is_on_tool
from pincal.model.conditions import Conditions
from pincal.model.motions import with_moving_drives
from pincal.robot.se3 import compose
from pincal.sensors.lens import Lens
from pincal.sensors.registry import blocks_of
from pincal.thresholds import Count

# Kinds of calibrations whose target is a sensor that reads so.
_OWN = {
    CAMERA_POINT: ("camera_point", "camera_pixel"),
    IMAGE: ("camera_point", "camera_pixel"),
    RANGE: ("range",),
}
_ON_TOOL = ("camera_point", "camera_pixel", "range", "imu")
_COLUMNS = {CAMERA_POINT: "cx cy cz", IMAGE: "u v", RANGE: "range"}
# Bytes of a row's fingerprint.
_MARK: Count = 4


@dataclass(frozen=True)
class SourceEvidence:
    """What a source of uncertainty rests on.

    Attributes:
        kind: "A" by statistics, "B" by other means (JCGM 100:2008, 3.3).
        dof: degrees of freedom; infinite for a stated one.
    """

    kind: Literal["A", "B"]
    dof: float


PARAMETERS = "parameters"
"""Source of uncertainty: the parameters of the calibrated robot."""
STATED = SourceEvidence("B", np.inf)
"""A standard uncertainty that somebody states."""


@dataclass(frozen=True)
class Reservations:
    """What the calibration itself does not know of its errors.

    Attributes:
        scale: standard uncertainty of the scale of its instrument, of whose lengths the robot's are
            copies [m/m].
        drift: of a coordinate of a position by what has changed since, as of interim checks [m].
    """

    scale: float = 0.0
    drift: float = 0.0


@dataclass(frozen=True, eq=False)
class MountedSensor:
    """A sensor on a calibrated robot at the poses of N readings.

    Attributes:
        carrier: the robot, which predicts the pose of what carries the sensor in the frame of its
            base or of the instrument of the calibration.
        fitted: the robot as it was calibrated.
        declared: what is declared of the sensor.
        frame: "base" or "instrument".
        is_own: whether the sensor is the target of the calibration.
        readings: the N readings.
        since: what has to be added to the calibration's own uncertainty.
    """

    carrier: FittedRobot
    fitted: FittedRobot
    declared: FlangeSensor
    frame: PoseFrame
    is_own: bool
    readings: FeatureReadings
    since: Reservations = field(default_factory=Reservations)

    @classmethod
    def of(
        cls,
        fitted: FittedRobot,
        readings: FeatureReadings,
        declared: FlangeSensor,
        frame: PoseFrame = "instrument",
        since: Reservations | None = None,
    ) -> MountedSensor:
        """Return the sensor of readings.

        Args:
            fitted: the calibrated robot with one station.
            readings: of the sensor.
            declared: what is known of the sensor besides.
            frame: of all positions: that of the calibration's instrument, or the robot's base.
            since: what has to be added to the calibration's own uncertainty.

        Raises:
            BadInputError: if the calibration does not know the mount of such a sensor, and none is
                declared.
        """
        kind = readings.kind
        own = fitted.sensor_kind
        since = since or Reservations()
        if declared.mount is not None:
            return cls(_tip(fitted, frame), fitted, declared, frame, False, readings, since)
        is_own = own in _OWN[kind] if kind in _OWN else own not in _ON_TOOL
        if not is_own:
            what = f"readings {_COLUMNS[kind]}" if kind in _COLUMNS else "contacts"
            raise BadInputError(
                f"{readings.rows.source}: {what}, but the model was calibrated with {own}, which "
                "does not tell where such a sensor is on the arm; declare its mount: --sensor "
                "SENSOR.toml with [mount] position_mm, rotation_deg"
            )
        carrier = in_base_frame(fitted) if frame == "base" else fitted
        return cls(carrier, fitted, declared, frame, True, readings, since)

    @cached_property
    def conditions(self) -> Conditions:
        """The conditions of the readings."""
        return self.carrier.conditions(self.readings.rows)

    @cached_property
    def carried(self) -> np.ndarray:
        """Poses of the carrier, shape (N, 3, 4)."""
        return self.carrier.predict(self.conditions)

    @cached_property
    def poses(self) -> np.ndarray:
        """Poses of the sensor, shape (N, 3, 4)."""
        mount = self.declared.mount
        return self.carried if mount is None else compose(self.carried, mount[None])

    @property
    def place_sigma(self) -> float:
        """Largest standard deviation of a coordinate of the calibrated target in the tip's frame
        [m]; 0 if the mount is declared.
        """
        if not self.is_own:
            return 0.0
        estimate = self.fitted.estimate
        of_tool = np.array([is_on_tool(p) for p in estimate.parameters])
        return float(estimate.sigma[of_tool].max(initial=0.0))

    @cached_property
    def tips(self) -> np.ndarray:
        """Positions of the tip, shape (N, 3) [m]."""
        robot = _tip(self.fitted, self.frame)
        return np.asarray(robot.predict(self.conditions)[:, :, 3])

    def on_carrier(self, seen: np.ndarray) -> np.ndarray:
        """Return points in the sensor's frame, shape (N, 3), in the carrier's."""
        mount = self.declared.mount
        return seen if mount is None else seen @ mount[:, :3].T + mount[:, 3]

    def arm_errors(self, seen: np.ndarray) -> PositionCovariance:
        """Return the errors of what is at points of the sensor's frame, shape (N, 3) [m], by the
        arm and the mount.
        """
        place = self.on_carrier(seen)
        found = self.carrier.uncertainty.covariance_of(
            self.conditions, PointOnTip(place), self.readings.stop
        )
        if self.declared.mount is not None and np.any(self.declared.mount_sigma):
            found = found.with_source("mount", self._mount_errors(seen))
        if self.since.scale:
            whole = np.einsum("nij,nj->ni", self.carried[:, :, :3], place) + self.carried[:, :, 3]
            stretched = SharedErrors.of_all(self.since.scale * whole[:, :, None])
            found = found.with_source("scale", stretched)
        if self.since.drift:
            found = found.with_source("drift", self._drift_errors(place))
        return found

    def _mount_errors(self, seen: np.ndarray) -> SharedErrors:
        """Return the errors of points of the sensor's frame by its declared mount."""
        assert self.declared.mount is not None
        levers = seen @ self.declared.mount[:, :3].T
        columns = np.zeros((len(seen), 3, 6))
        columns[:, :, :3] = np.eye(3)
        for axis, e in enumerate(np.eye(3)):
            columns[:, :, 3 + axis] = np.cross(e, levers)
        turned = self.carried[:, :, :3] @ (columns * self.declared.mount_sigma)
        return SharedErrors.of_all(turned)

    def _drift_errors(self, place: np.ndarray) -> SharedErrors:
        """Return the errors of points of the carrier's frame if the drives drifted by as much each
        as displaces a coordinate by the stated size, root mean square.
        """
        moving = with_moving_drives(self.carrier.model)
        n = self.carrier.model.n_parameters
        values = np.concatenate([self.carrier.model_values, np.zeros(moving.n_parameters - n)])
        conditions = self.carrier.of_its_day(self.conditions)
        _, J = moving.linearise(values, conditions, rows=6)
        levers = np.einsum("nij,nj->ni", self.carried[:, :, :3], place)
        by_drives = J[:, :3, n:] + np.cross(J[:, 3:, n:], levers[:, :, None], axis=1)
        size = np.sqrt(np.mean(np.sum(by_drives**2, axis=2)))
        return SharedErrors.of_all(self.since.drift / size * by_drives)

    def arm_evidence(
        self, sources: Mapping[str, SharedErrors]
    ) -> Iterator[tuple[str, SourceEvidence]]:
        """Yield what each source of the arm's errors rests on."""
        station = self.fitted.station
        rest = {
            PARAMETERS: SourceEvidence("A", self.calibration_dof),
            "model": SourceEvidence("A", _dof_of_discrepancy(self.fitted)),
            "conditions": SourceEvidence("A", self.calibration_dof),
        }
        if station.repeatability is not None:
            rest["arrival"] = SourceEvidence("A", float(station.repeatability.between_degrees[0]))
        for name in sources:
            yield name, rest.get(name, STATED)

    @property
    def calibration_dof(self) -> float:
        """Degrees of freedom of the calibration: coordinates that were read minus parameters that
        were fitted; infinite where the rows are not known.
        """
        station = self.fitted.station
        rows = len(base64.b64decode(station.rows)) // _MARK
        if not rows:
            return np.inf
        components = sum(block.size for block in blocks_of(station.sensor_kind))
        return float(max(rows * components - int(self.fitted.estimate.free.sum()), 1))

    @property
    def noise(self) -> tuple[np.ndarray, SourceEvidence]:
        """Standard deviations of a point along the sensor's axes, shape (3,) [m], and what they
        rest on.
        """
        if self.declared.noise is not None:
            return self.declared.noise, STATED
        if self.is_own and self.readings.kind == self.fitted.sensor_kind:
            return np.full(3, self.fitted.sigma[0]), self._evidence_of_noise
        return np.zeros(3), STATED

    @property
    def pixel_noise(self) -> tuple[float, SourceEvidence]:
        """Standard deviation of a coordinate of an image [px], and what it rests on.

        Raises:
            BadInputError: if nothing tells it.
        """
        if self.declared.pixel_noise is not None:
            return self.declared.pixel_noise, STATED
        if self.is_own and self._has_camera:
            return float(self.fitted.sigma[0]), self._evidence_of_noise
        raise BadInputError(
            f"{self.readings.rows.source}: images, but neither the calibration nor an option tells "
            "their noise; give it: --sensor-noise 0.1px"
        )

    @property
    def _evidence_of_noise(self) -> SourceEvidence:
        is_declared = self.fitted.is_noise_declared
        return STATED if is_declared else SourceEvidence("A", self.calibration_dof)

    @property
    def _has_camera(self) -> bool:
        """Whether the calibration was by images of a camera on the tool."""
        kind = self.fitted.sensor_kind
        return kind in _ON_TOOL and blocks_of(kind)[0].unit == "px"

    @property
    def lens(self) -> Lens:
        """The camera.

        Raises:
            BadInputError: if neither the model nor the declaration has one.
        """
        if self.declared.lens is not None:
            return self.declared.lens
        if self._has_camera:
            values = self.fitted.camera()
            return Lens(**{name: v for name, v in values.items() if name != "T_tip_camera"})
        raise BadInputError(
            f"{self.readings.rows.source}: images, but the model was calibrated with "
            f"{self.fitted.sensor_kind} and has no camera; declare it: --sensor SENSOR.toml with "
            "[camera] fx fy u0 v0"
        )


def _tip(fitted: FittedRobot, frame: PoseFrame) -> FittedRobot:
    """Return the robot with the pose of its tip as its prediction."""
    return fitted.between() if frame == "base" else tip_in_instrument(fitted)


def _dof_of_discrepancy(fitted: FittedRobot) -> float:
    """Return the degrees of freedom of what a model lacks: the poses that show it."""
    found = fitted.discrepancy
    return np.inf if found is None else max(found.coordinates / 3.0 - 1.0, 1.0)
