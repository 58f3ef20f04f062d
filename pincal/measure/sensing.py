"""The sensor that made a table."""

from __future__ import annotations

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.measurements import Measurements
from pincal.measure.registry import expected_columns
from pincal.measure.sensor import Sensor
from pincal.measure.sensors.pose import PoseSensor
from pincal.measure.sensors.position import PositionSensor
from pincal.measure.setup import Setup


def sensor_of(measurements: Measurements, setup: Setup | None = None) -> Sensor:
    """Return the sensor that made a table of measurements.

    Points that the setup does not name are refused, but for sockets, which are then judged by the mean of their rows. By
    default nothing is known, and every point of the table is a parameter.

    Raises:
        MeasurementError: if no sensor reads such columns, or a point is named that the setup does not have.
    """
    found = measurements.sensor
    if found is None:
        raise MeasurementError(
            f"{measurements.source}: no sensor reads measurements of kind {measurements.kind!r}; expected columns "
            f"{expected_columns()}"
        )
    return found.of(measurements, Setup().over(measurements) if setup is None else setup)


def sensor_like(measurements: Measurements, setup: Setup) -> Sensor:
    """Return the sensor of a table over its first row alone: all that does not depend on the rows is that of the table."""
    return sensor_of(measurements.select(slice(0, 1)), setup.over(measurements))


def ideal_readings(poses: np.ndarray, *, with_orientation: bool) -> Sensor:
    """Return what an instrument without errors reads of poses, shape (N, 3, 4): positions, or positions and orientations."""
    return (PoseSensor if with_orientation else PositionSensor).foreseen(poses)
