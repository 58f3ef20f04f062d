"""Stations of sessions in motion: tables of readings like any others, whose joints stand where the path has them then.

The clock of each instrument is aligned by the nominal arm first, to some tenths of a millisecond; what is left of offset and
drift, and how well they are known, is found with everything else (:class:`pincal.model.catalogue.InstrumentClock`).
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.measurements import Measurements, measurements
from pincal.measure.registry import sensor_class
from pincal.measure.sensor import Sensor
from pincal.measure.sensors.imu import FORCE, RATE, Window
from pincal.motion.clocks import Clock
from pincal.motion.imu_rows import APART, ImuRows
from pincal.motion.joint_path import JointPath
from pincal.motion.moving_arm import MovingArm
from pincal.motion.reading_starts import start_readings
from pincal.motion.sessions import Session
from pincal.motion.starts import OtherMotionError, aligned_forces, start_imu, steady
from pincal.motion.stream import Stream
from pincal.recorded import Moving
from pincal.robot.robot import Robot

# Standard deviation of the windows of an IMU's rows [s]; from 1 to 12 Hz made no difference on a real arm.
WIDTH = 0.03
# Joints that change by less than this rest [rad, m]; over a whole log, and how few that move then say too little.
_RESTS, _MOVED, _TOO_FEW = 3e-4, 1e-2, 2
# Rows a second from which on no arm turns back so far within two of them that one seems to jump.
_FAST = 20.0
# Smallest steps by which the reading of an instrument of few digits changes.
_STEPS = 2.5


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
        wrong = list[MeasurementError]()
        for what in there:
            name = session.name if session.name and len(there) == 1 else "/".join(filter(None, (session.name, what)))
            stream = parts[what]
            assert stream is not None
            try:
                found[name] = _imu_table(arm, stream, others) if what == "imu" else _tracker_table(arm, stream)
            except OtherMotionError as error:
                wrong.append(error)
        moved = np.ptp(session.joints.readings["q"], axis=0) > _MOVED
        if wrong and moved.sum() <= min(_TOO_FEW, robot.n_joints - 1):
            names = ", ".join(name for name, moves in zip(robot.joint_names, moved, strict=True) if moves) or "none"
            raise MeasurementError(
                f"{session.joints.name}: joints that moved: {names}; expected a path on which all do: by less, "
                f"readings are not told from those of another motion ({wrong[0]})"
            )
        if wrong:
            # Joints that one instrument follows are right.
            raise _at_fault(arm, session, wrong) if len(wrong) == len(there) else wrong[0]
    return found


def _at_fault(arm: MovingArm, session: Session, wrong: Sequence[MeasurementError]) -> MeasurementError:
    """Return the error that names the file at fault: the joints' where all follow other joints, or all but they."""
    name = session.joints.name
    for words, path in _mistaken(arm):
        try:
            other = MovingArm(arm.robot, path)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", PincalWarning)
                if session.imu is not None:
                    start_imu(other, session.imu)
                if session.tracker is not None:
                    start_tracker(other, session.tracker)
        except MeasurementError:
            continue
        return MeasurementError(f"{name}: the readings follow these joints {words}; they do not as they are ({wrong[0]})")
    if session.imu is None or session.tracker is None or len(wrong) < 2:
        return wrong[0]
    return MeasurementError(
        f"{name}: neither {session.imu.name} nor {session.tracker.name} follows these joints; expected joints of the same "
        f"motion: look at their session, unit, order, signs and zeros ({'; '.join(map(str, wrong))})"
    )


def _mistaken(arm: MovingArm) -> Iterator[tuple[str, JointPath]]:
    """Yield in words how joints are often mistaken, and the path that is then meant."""
    names, n = arm.robot.joint_names, arm.robot.n_joints
    one = np.eye(n)
    for i in range(n):
        yield f"with the sign of {names[i]} turned (--sign {names[i]})", arm.path.mapped(one - 2.0 * np.diag(one[i]))
    for i, j in itertools.combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        yield f"with the columns {names[i]} and {names[j]} exchanged", arm.path.mapped(one[order])
    yield "in the order from the flange to the base", arm.path.mapped(one[::-1])
    yield "in revolutions: multiply them by 2 pi", arm.path.mapped(2.0 * np.pi * one)
    for i, quarter in itertools.product(range(1, n), (1, -1, 2)):
        if arm.robot.joint_types[i] == "revolute":
            words = f"with {90 * quarter:+d} deg added to {names[i]}, whose zero differs from the URDF's"
            yield words, arm.path.mapped(one, 0.5 * np.pi * quarter * one[i])


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
    scatter = np.median(rows.sigma, axis=1)
    sigma = np.sqrt(np.prod(rows.sigma / scatter[:, None], axis=0))
    readings = {FORCE.name: rows.readings[:3].T, RATE.name: rows.readings[3:].T, "sigma": sigma}
    lines = imu.lines[np.searchsorted(imu.time, rows.time)]
    table = _table(arm, imu, clock, rows.time, at, lines, readings, offsets=rows.window.offsets)
    assert table.moving is not None
    return replace(table, moving=replace(table.moving, delay=delay, scatter=tuple(scatter.tolist())))


def ideal_imu_table(arm: MovingArm) -> Measurements:
    """Return what an ideal IMU at the nominal tip reads of a whole motion, as rows of :func:`session_tables`."""
    window, (begin, end) = Window(WIDTH), arm.path.span
    at = begin + np.arange(0.0, end - begin, APART * WIDTH)
    at = at[arm.path.covers(at, 4.0 * WIDTH)]
    ideal = arm.ideal(at, window)
    readings = {FORCE.name: ideal.force, RATE.name: ideal.rate}
    stream = Stream("imu", at, readings, {})
    return _table(arm, stream, Clock(), at, at, np.arange(2, len(at) + 2), readings, offsets=window.offsets)


def start_tracker(arm: MovingArm, tracker: Stream) -> Clock:
    """Return the clock of an instrument that reads an arm in motion.

    Raises:
        MeasurementError: for readings that do not change with the motion, or are not of it.
    """
    sensor = _sensor(tracker)
    again = tracker.repeats
    return start_readings(arm, tracker.select(~again) if again.any() else tracker, sensor)


def _sensor(tracker: Stream) -> type[Sensor]:
    sensor = sensor_class(tracker.readings)
    if sensor is None or sensor.fields[0].is_name or not sensor.reads_place:
        raise MeasurementError(
            f"{tracker.name}: {', '.join(tracker.readings)} in motion; expected readings that change with it, such as x y z "
            "or distance, or u v with point or target; what is held, such as a point in a socket, is a table of its own"
        )
    return sensor


def _tracker_table(arm: MovingArm, tracker: Stream) -> Measurements:
    clock = start_tracker(arm, tracker)
    again = tracker.repeats
    if again.any():
        tracker = _without_stale(arm, tracker, clock, again, tracker.readings[_sensor(tracker).fields[0].name])
    values = tracker.readings[_sensor(tracker).fields[0].name]
    if tracker.rate > _FAST and not tracker.things.any():
        tracker = tracker.without(~steady(values.reshape(len(values), -1)), "jump off those beside them: of something else")
    at = clock.to_joints(tracker.time)
    inside = arm.path.covers(at)
    readings = {name: values[inside] for name, values in tracker.readings.items()}
    lines = tracker.lines[inside]
    return _table(arm, tracker, clock, tracker.time[inside], at[inside], lines, readings)


def _without_stale(arm: MovingArm, tracker: Stream, clock: Clock, again: np.ndarray, values: np.ndarray) -> Stream:
    """Return what an instrument reads without rows that repeat the one before though the arm moves by more than it resolves.

    Args:
        arm: the arm.
        tracker: the stream.
        clock: of the stream.
        again: which rows repeat the one before of the same thing, shape (T,).
        values: the readings that matter, shape (T,) or (T, k).
    """
    order = np.argsort(tracker.things, kind="stable")
    q, values, again = arm.path.at(clock.to_joints(tracker.time))[order], values.reshape(len(order), -1)[order], again[order]
    starts = np.flatnonzero(~again)
    run = np.cumsum(~again) - 1
    moved = np.maximum.reduceat(np.abs(q - q[starts[run]]).max(axis=1), starts)
    # One that resolves no more goes on by its smallest step.
    steps = np.abs(np.diff(values[starts], axis=0, append=np.inf))
    finest = np.min(np.where(steps > 0.0, steps, np.inf), axis=0)
    is_stale = (moved > _RESTS) & np.any(steps > _STEPS * finest, axis=1)
    # A target that is out of sight may be given another place; else the first row is what was seen last.
    seen = np.append(starts[1:], len(q)) - starts == 1
    seen |= steady(values[starts])
    stale = np.zeros(len(q), bool)
    stale[order] = is_stale[run] & (again | ~seen[run])
    return tracker.without(stale, "repeat the one before while the arm moves: the target was lost, or the log is too fast")


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
) -> Measurements:
    """Return the rows of a stream with the poses of the arm; their times are by its clock, and by that of the joints."""
    n, robot, here = len(time), arm.robot, arm.conditions(at)
    moving = Moving(clock=(clock.offset, clock.drift, clock.middle), inertial=here.inertial)
    if offsets is not None:
        there = arm.conditions(at, offsets)
        assert there.velocity is not None
        shape = (n, len(offsets), robot.n_joints)
        loads = None if there.inertial is None else there.inertial.reshape(*shape, 6)
        moving = replace(moving, q=there.q.reshape(shape), velocity=there.velocity.reshape(shape), loads=loads)
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
    return replace(table, moving=moving)
