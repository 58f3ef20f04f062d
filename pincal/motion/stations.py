"""Stations of sessions in motion: tables of readings like any others, whose joints stand where the path has them then.

The clock of each instrument is aligned by the nominal arm first, to some tenths of a millisecond; what is left of offset and
drift, and how well they are known, is found with everything else (:class:`pincal.model.catalogue.InstrumentClock`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pincal.errors import MeasurementError
from pincal.measure.measurements import Measurements, measurements
from pincal.measure.registry import sensor_class
from pincal.measure.sensors.imu import FORCE, RATE, Window
from pincal.motion.clocks import Clock
from pincal.motion.imu_rows import APART, ImuRows
from pincal.motion.joint_path import JointPath
from pincal.motion.moving_arm import MovingArm
from pincal.motion.reading_starts import start_readings
from pincal.motion.sessions import Session, Stream
from pincal.motion.starts import aligned_forces, start_imu
from pincal.recorded import Moving
from pincal.robot.robot import Robot

# Standard deviation of the windows of an IMU's rows [s]; from 1 to 12 Hz made no difference on a real arm.
WIDTH = 0.03


def session_tables(robot: Robot, sessions: Sequence[Session]) -> dict[str, Measurements]:
    """Return the tables of the stations of some sessions by their names, such as ``monday/imu``.

    A session with one instrument beside the joints gives a station of its own name.

    Args:
        robot: the robot.
        sessions: what was logged, each of one motion.

    Raises:
        MeasurementError: for a stream that is not of its motion, or can't be right; see :mod:`pincal.motion.starts`.
    """
    arms = {session.name: MovingArm.of(robot, _path(session), payload=session.payload) for session in sessions}
    found = dict[str, Measurements]()
    for session in sessions:
        arm, others = arms[session.name], [(name, arm) for name, arm in arms.items() if name != session.name]
        parts = {"imu": session.imu, "tracker": session.tracker}
        there = [what for what, stream in parts.items() if stream is not None]
        for what in there:
            name = session.name if session.name and len(there) == 1 else "/".join(filter(None, (session.name, what)))
            stream = parts[what]
            assert stream is not None
            found[name] = _imu_table(arm, stream, others) if what == "imu" else _tracker_table(arm, stream)
    return found


def _path(session: Session) -> JointPath:
    try:
        return JointPath.through(session.joints.time, session.joints.readings["q"])
    except MeasurementError as error:
        raise MeasurementError(f"{session.joints.name}: {error}") from error


def _imu_table(arm: MovingArm, imu: Stream, others: Sequence[tuple[str, MovingArm]]) -> Measurements:
    start = start_imu(arm, imu, window=Window(WIDTH), others=others)
    delay = aligned_forces(arm, start)
    rows = ImuRows.of(imu.time, imu.readings[FORCE.name], imu.readings[RATE.name], Window(WIDTH), delay=delay)
    # The clock is that of the rates; by their delay it becomes that of the forces, at which the rows stand.
    clock = start.clock.moved(-delay, 0.0)
    at = clock.to_joints(rows.time)
    inside = arm.path.covers(at, 4.0 * WIDTH)
    rows, at = rows.select(inside), at[inside]
    # Noise of both where the arm vibrates, relative to what is usual.
    sigma = np.sqrt(np.prod(rows.sigma / np.median(rows.sigma, axis=1, keepdims=True), axis=0))
    readings = {FORCE.name: rows.readings[:3].T, RATE.name: rows.readings[3:].T, "sigma": sigma}
    lines = np.searchsorted(imu.time, rows.time) + 2
    return _table(arm, imu, clock, rows.time, at, lines, readings, offsets=rows.window.offsets, delay=delay)


def ideal_imu_table(arm: MovingArm) -> Measurements:
    """Return what an ideal IMU at the nominal tip reads of a whole motion, as rows of :func:`session_tables`."""
    window, (begin, end) = Window(WIDTH), arm.path.span
    at = begin + np.arange(0.0, end - begin, APART * WIDTH)
    at = at[arm.path.covers(at, 4.0 * WIDTH)]
    ideal = arm.ideal(at, window)
    readings = {FORCE.name: ideal.force, RATE.name: ideal.rate}
    stream = Stream("imu", at, readings, {})
    return _table(arm, stream, Clock(), at, at, np.arange(2, len(at) + 2), readings, offsets=window.offsets)


def _tracker_table(arm: MovingArm, tracker: Stream) -> Measurements:
    sensor = sensor_class(tracker.readings)
    if sensor is None or sensor.fields[0].is_name or not sensor.reads_place:
        raise MeasurementError(
            f"{tracker.name}: {', '.join(tracker.readings)} in motion; expected readings that change with it, such as x y z "
            "or distance, or u v with point or target; what is held, such as a point in a socket, is a table of its own"
        )
    clock = start_readings(arm, tracker, sensor)
    at = clock.to_joints(tracker.time)
    inside = arm.path.covers(at)
    readings = {name: values[inside] for name, values in tracker.readings.items()}
    lines = np.flatnonzero(inside) + 2
    return _table(arm, tracker, clock, tracker.time[inside], at[inside], lines, readings)


def _table(
    arm: MovingArm,
    stream: Stream,
    clock: Clock,
    time: np.ndarray,
    at: np.ndarray,
    lines: np.ndarray,
    readings: dict[str, np.ndarray],
    *,
    offsets: np.ndarray | None = None,
    delay: float = 0.0,
) -> Measurements:
    """Return the rows of a stream with the poses of the arm; their times are by its clock, and by that of the joints."""
    n, robot, here = len(time), arm.robot, arm.conditions(at)
    around = dict[str, np.ndarray | None]()
    if offsets is not None:
        there = arm.conditions(at, offsets)
        assert there.velocity is not None
        shape = (n, len(offsets), robot.n_joints)
        loads = None if there.inertial is None else there.inertial.reshape(*shape, 6)
        around = {"q": there.q.reshape(shape), "velocity": there.velocity.reshape(shape), "loads": loads}
    table = measurements(
        robot,
        robot.as_reported(here.q),
        rows=lines,
        source=stream.name,
        units=stream.units,
        velocity=here.velocity,
        time=time,
        **({"payload": np.full(n, arm.payload)} if arm.payload else {}),
        **readings,
    )
    clocked = Moving(clock=(clock.offset, clock.drift, clock.middle), delay=delay, inertial=here.inertial, **around)
    return replace(table, moving=clocked)
