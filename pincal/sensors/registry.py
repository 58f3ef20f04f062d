"""All sensors, and the choice of the sensor of a table by its columns.

Custom sensors are added by :func:`register_sensor`, in an installed package with the entry point
``pincal.sensors`` or in a module named by the user (see :mod:`pincal.plugins`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from pincal.errors import MeasurementError
from pincal.plugins import Registry
from pincal.sensors.camera import CameraPixelSensor, CameraPointSensor, FixedCameraSensor
from pincal.sensors.distance import AnchoredDistanceSensor, DistanceSensor
from pincal.sensors.fields import CONDITIONS, SIGMA, Field
from pincal.sensors.imu import ImuSensor
from pincal.sensors.plane import GaugeSensor, PlaneContactSensor
from pincal.sensors.pose import PoseSensor, PositionSensor
from pincal.sensors.sensor import Block, Sensor, Simulatable
from pincal.sensors.socket import ContactSensor, LinkContactSensor, LinkDistanceSensor


def _check(sensor: type[Sensor]) -> None:
    """Refuse an incomplete sensor, or one whose columns already have another meaning."""
    stated = ("kind", "fields", "blocks", "tool_symbols", "twist_rows", "per_row")
    missing = [name for name in stated if not hasattr(sensor, name)] + sorted(
        getattr(sensor, "__abstractmethods__", ())
    )
    if missing:
        raise TypeError(f"sensor {sensor.__name__} lacks {', '.join(missing)}")
    others = [field for other in SENSORS.registered().values() for field in other.fields]
    for field in sensor.fields:
        for other in (*others, *CONDITIONS.values(), SIGMA):
            if set(field.columns) & set(other.columns) and (field.name, field.quantity) != (
                other.name,
                other.quantity,
            ):
                raise TypeError(
                    f"sensor {sensor.__name__}: the columns {field} are known as {other.name!r} "
                    f"({other}, {other.quantity}); choose other names"
                )


SENSORS = Registry[Sensor](
    "sensor",
    group="pincal.sensors",
    name_of=lambda sensor: " ".join(field.name for field in sensor.fields),
    check=_check,
)
"""The sensors by their fields, as two may share a kind."""

register_sensor = SENSORS.register
"""Add a sensor, as a decorator or by a call."""

_DISTANCES = (DistanceSensor, AnchoredDistanceSensor, LinkDistanceSensor, LinkContactSensor)
_CAMERAS = (CameraPointSensor, CameraPixelSensor, FixedCameraSensor)
_PLANES = (PlaneContactSensor, GaugeSensor)
for _sensor in (
    PositionSensor,
    PoseSensor,
    *_DISTANCES,
    ContactSensor,
    *_CAMERAS,
    *_PLANES,
    ImuSensor,
):
    register_sensor(_sensor)


def known_fields() -> Mapping[str, Field]:
    """Return all known fields by name: readings of all sensors, then the conditions of a pose."""
    found = {field.name: field for sensor in SENSORS.known().values() for field in sensor.fields}
    return (
        {name: field for name, field in found.items() if name not in CONDITIONS}
        | {SIGMA.name: SIGMA}
        | CONDITIONS
    )


def known_kinds() -> Mapping[str, str]:
    """Return the kinds of measurement, with the module of each one's sensor."""
    return {sensor.kind: sensor.__module__ for sensor in SENSORS.known().values()}


def blocks_of(kind: str) -> tuple[Block, ...]:
    """Return the components of the readings of a known kind."""
    return next(sensor.blocks for sensor in SENSORS.known().values() if sensor.kind == kind)


def columns_of(kind: str) -> tuple[str, ...]:
    """Return the columns of the readings of a known kind."""
    sensor = next(sensor for sensor in SENSORS.known().values() if sensor.kind == kind)
    return tuple(column for field in sensor.fields for column in field.columns)


def is_held(kind: str) -> bool:
    """Return whether readings of a kind are that a target was held at a fixed place: without the
    places, or distances between them, they have no unit of length.
    """
    sensor = simulatable().get(kind)
    return sensor is not None and sensor.needs_places


def simulatable() -> Mapping[str, type[Simulatable]]:
    """Return the sensors for which measurements can be designed, by kind."""
    return {
        sensor.kind: sensor
        for sensor in SENSORS.known().values()
        if issubclass(sensor, Simulatable)
    }


def sensor_class(fields: Collection[str]) -> type[Sensor] | None:
    """Return the sensor of a table with these fields, the one with the most fields of several; None
    without any.
    """
    found = [
        sensor
        for sensor in SENSORS.known().values()
        if all(field.name in fields for field in sensor.fields)
    ]
    return max(found, key=lambda sensor: len(sensor.fields), default=None)


def check_fields(fields: Collection[str], *, source: str) -> None:
    """Refuse a table with two kinds of measurement, or an incomplete one, naming the columns."""
    sensors = SENSORS.known().values()
    chosen = sensor_class(fields)
    read = {} if chosen is None else {field.name: field for field in chosen.fields}
    # A further field of one sensor may be the first field of another.
    mains = {
        sensor.fields[0].name: sensor.fields[0]
        for sensor in sensors
        if sensor.fields[0].name in fields
    }
    apart = [field for name, field in mains.items() if name not in read]
    if len(mains) > 1 and (chosen is None or apart):
        found = " and ".join(
            map(str, mains.values() if chosen is None else [chosen.fields[0], *apart])
        )
        raise MeasurementError(
            f"{source}: two kinds of measurement ({found}); expected one, ignore the others"
        )
    for sensor in sensors:
        _check_whole(sensor, fields, read, source=source)


def _check_whole(
    sensor: type[Sensor], fields: Collection[str], read: Collection[str], *, source: str
) -> None:
    """Refuse a table with only some of the fields of a sensor, unless they are ``read`` by the
    table's own one.
    """
    main, *others = sensor.fields
    given = [
        f for f in others if f.name in fields and f.name not in CONDITIONS and f.name not in read
    ]
    if given and main.name not in fields:
        raise MeasurementError(
            f"{source}: {given[0]} without {main}; add what is missing, or ignore {given[0]}"
        )
    missing = [field for field in others if field.name not in fields]
    if main.name in fields and missing and sensor_class(fields) is None:
        sensors = SENSORS.known().values()
        ways = [other.fields[1:] for other in sensors if other.fields[0] == main]
        needed = " or ".join(
            dict.fromkeys(" ".join(str(f) for f in way if f.name not in fields) for way in ways)
        )
        raise MeasurementError(
            f"{source}: {main} without {needed}; add what is missing, or ignore {main}"
        )


def expected_columns() -> str:
    """Return the columns of each sensor, in words."""
    known = [" with ".join(map(str, sensor.fields)) for sensor in SENSORS.known().values()]
    return ", ".join(known[:-1]) + f", or {known[-1]}"
