"""Which sensor reads a table."""

from __future__ import annotations

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.camera import CameraPixelSensor, CameraPointSensor
from pincal.measure.measurements import Measurements
from pincal.measure.points import AnchoredDistanceSensor, ContactSensor, DistanceSensor
from pincal.measure.sensors import PoseSensor, PositionSensor, Sensor
from pincal.measure.setup import NamedPoints, Setup, point_names
from pincal.robot.se3 import rotation_matrices


def sensor_of(measurements: Measurements, setup: Setup | None = None) -> Sensor:
    """Return the sensor that made a table of measurements.

    Args:
        measurements: the table.
        setup: what is known of named points and of the camera; points that the setup does not name are refused, but for
            sockets, which are then judged by the mean of their rows. Nothing is known, and every point of the table a
            parameter, unless given.

    Raises:
        MeasurementError: if no sensor of this package reads such columns, or a point is named that the setup has not.
    """
    m = measurements
    setup = Setup().over(m) if setup is None else setup
    if m.kind == "position" and m.position is not None:
        return PositionSensor(m.position)
    if m.kind == "pose" and m.position is not None and m.quaternion is not None:
        return PoseSensor(m.position, rotation_matrices(m.quaternion))
    if m.distance is not None and m.anchor is None:
        return DistanceSensor(m.distance)
    points = setup.named()
    index = _places(m, points)
    if m.socket is not None:
        return ContactSensor(points, index)
    if m.distance is not None:
        return AnchoredDistanceSensor(points, index, m.distance)
    if m.camera_point is not None:
        return CameraPointSensor(points, index, m.camera_point)
    if m.pixel is not None:
        return CameraPixelSensor(points, index, m.pixel, setup)
    raise MeasurementError(
        f"{m.source}: no sensor reads measurements of kind {m.kind!r}; expected columns x y z, x y z with qx qy qz qw, "
        "distance, socket, cx cy cz with point, or u v with point"
    )


def _places(measurements: Measurements, points: NamedPoints) -> np.ndarray:
    """Return the index of each row's point; -1 and below for sockets that are not known."""
    names = point_names(measurements)
    if names is None:
        return np.zeros(0, int)
    found, inverse = np.unique(names, return_inverse=True)
    place = {name: i for i, name in enumerate(points.names)}
    new = [str(name) for name in found if str(name) not in place]
    if new and measurements.socket is None:
        row = int(np.flatnonzero(names == new[0])[0])
        raise MeasurementError(
            f"{measurements.source}, line {measurements.rows[row]}: point {new[0]!r} was not among those of the "
            f"calibration; expected {', '.join(points.names[:8])}{' ...' if len(points.names) > 8 else ''}"
        )
    index = np.array([place[str(name)] if str(name) in place else -1 - new.index(str(name)) for name in found], int)
    return index[inverse]
