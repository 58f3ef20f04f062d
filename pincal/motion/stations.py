"""Stations of sessions in motion: tables of readings with the joints interpolated on their path.

The clock of each instrument is first aligned by the nominal arm, to some tenths of a millisecond;
corrections of offset and drift are fitted together with all other parameters
(:class:`pincal.model.catalogue.InstrumentClock`).
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.errors import MeasurementError, PincalWarning
from pincal.hypotheses.hypothesis import Hypothesis, exchange_order, explaining
from pincal.measure.measurements import Measurements, measurements
from pincal.model.conditions import Conditions
from pincal.motion.clocks import Clock, refuse_uncovered
from pincal.motion.imu_rows import APART, ImuRows
from pincal.motion.joint_path import JointPath
from pincal.motion.motion_numbers import FOLLOWING, ON_PATH
from pincal.motion.moving_arm import MovingArm
from pincal.motion.polling import at_even_samples, at_samples
from pincal.motion.reading_starts import start_readings
from pincal.motion.sessions import Session
from pincal.motion.starts import OtherMotionError, aligned_forces, start_imu, steady
from pincal.motion.stream import Stream
from pincal.recorded import Moving
from pincal.robot.robot import Robot
from pincal.sensors.imu import FORCE, RATE, Window
from pincal.sensors.registry import sensor_class
from pincal.sensors.sensor import Sensor
from pincal.thresholds import Scale

# Standard deviation of the windows of an IMU's rows [s]; 1 to 12 Hz made no difference on a real
# arm.
WIDTH: Scale = 0.03


def session_tables(robot: Robot, sessions: Sequence[Session]) -> dict[str, Measurements]:
    """Return the tables of the stations of sessions by name, such as ``monday/imu``.

    A session with one instrument in addition to the joints gives a station of its name.

    Raises:
        MeasurementError: for a stream that is not of its motion, or impossible; see
            :mod:`pincal.motion.starts`.
    """
    arms = {
        session.name: MovingArm.of(robot, _path(session), payload=session.payload)
        for session in sessions
    }
    found = dict[str, Measurements]()
    for session in sessions:
        found |= _tables_of(robot, session, arms)
    return found


def _tables_of(
    robot: Robot, session: Session, arms: Mapping[str, MovingArm]
) -> dict[str, Measurements]:
    """Return the tables of one session by the names of its stations; ``arms`` are those of all."""
    arm = arms[session.name]
    others = [(name, other) for name, other in arms.items() if name != session.name]
    streams = {"imu": session.imu, "tracker": session.tracker}
    there = {what: stream for what, stream in streams.items() if stream is not None}
    found = dict[str, Measurements]()
    wrong = list[MeasurementError]()
    for what, stream in there.items():
        is_alone = session.name and len(there) == 1
        name = session.name if is_alone else "/".join(filter(None, (session.name, what)))
        is_imu = what == "imu"
        try:
            found[name] = _imu_table(arm, stream, others) if is_imu else _tracker_table(arm, stream)
        except OtherMotionError as error:
            wrong.append(error)
    if wrong:
        _refuse_short_path(robot, session, wrong[0])
        # Joints are right if one instrument follows them.
        raise _at_fault(arm, session, wrong) if len(wrong) == len(there) else wrong[0]
    return found


def _refuse_short_path(robot: Robot, session: Session, wrong: MeasurementError) -> None:
    """Refuse a path on which too few joints moved to tell a motion from another, where readings
    are wrong.
    """
    moved = np.ptp(session.joints.readings["q"], axis=0) > FOLLOWING.moved
    if moved.sum() <= min(FOLLOWING.too_few, robot.n_joints - 1):
        names = (name for name, moves in zip(robot.joint_names, moved, strict=True) if moves)
        raise MeasurementError(
            f"{session.joints.name}: joints that moved: {', '.join(names) or 'none'}; expected a "
            f"path on which all do, to distinguish readings from those of another motion ({wrong})"
        )


def _at_fault(
    arm: MovingArm, session: Session, wrong: Sequence[MeasurementError]
) -> MeasurementError:
    """Return an error that names the file at fault: the joints' if all readings follow others, or
    none follows these.
    """
    name = session.joints.name

    def follow(path: JointPath) -> bool:
        try:
            other = MovingArm(arm.robot, path)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", PincalWarning)
                if session.imu is not None:
                    start_imu(other, session.imu)
                if session.tracker is not None:
                    start_tracker(other, session.tracker)
        except MeasurementError:
            return False
        return True

    mistake = next(explaining(_mistakes(arm), arm.path, follow), None)
    if mistake is not None:
        return MeasurementError(
            f"{name}: the readings follow these joints {mistake.words}, but not otherwise "
            f"({wrong[0]})"
        )
    if session.imu is None or session.tracker is None or len(wrong) < 2:
        return wrong[0]
    return MeasurementError(
        f"{name}: neither {session.imu.name} nor {session.tracker.name} follows these "
        "joints; expected joints of the same "
        f"motion: check their session, unit, order, signs and zeros ({'; '.join(map(str, wrong))})"
    )


def _mistakes(arm: MovingArm) -> Iterator[Hypothesis[JointPath]]:
    """Yield common mistakes in logs of joints: signs, columns exchanged, their order, their unit,
    zeros.
    """
    names = arm.robot.joint_names
    n = arm.robot.n_joints
    one = np.eye(n)
    for i in range(n):
        words = f"with the sign of {names[i]} changed (--sign {names[i]})"
        yield _mapped(words, one - 2.0 * np.diag(one[i]))
    for i, j in itertools.combinations(range(n), 2):
        words = f"with the columns {names[i]} and {names[j]} exchanged"
        yield _mapped(words, one[exchange_order(n, i, j)])
    yield _mapped("in the order from the flange to the base", one[::-1])
    yield _mapped("in revolutions: multiply them by 2 pi", 2.0 * np.pi * one)
    for i, quarter in itertools.product(range(1, n), (1, -1, 2)):
        if arm.robot.joint_types[i] == "revolute":
            words = (
                f"with {90 * quarter:+d} deg added to {names[i]}, whose zero differs from the "
                "URDF's"
            )
            yield _mapped(words, one, 0.5 * np.pi * quarter * one[i])


def _mapped(
    words: str, matrix: np.ndarray, offsets: np.ndarray | float = 0.0
) -> Hypothesis[JointPath]:
    """Return the hypothesis that the joints are linear functions of those in the log, shape (n, n),
    plus offsets, shape (n,) [rad or m].
    """
    return Hypothesis(words, lambda path: path.mapped(matrix, offsets))


def _path(session: Session) -> JointPath:
    try:
        return JointPath.through(session.joints.time, session.joints.readings["q"])
    except MeasurementError as error:
        raise MeasurementError(f"{session.joints.name}: {error}") from error


def _imu_table(
    arm: MovingArm, imu: Stream, others: Sequence[tuple[str, MovingArm]]
) -> Measurements:
    start = start_imu(arm, imu, window=Window(WIDTH), others=others)
    sampled = at_samples(arm, imu, start.clock, start.mount)
    if sampled is not None:
        imu = sampled
        start = start_imu(arm, imu, window=Window(WIDTH), others=others)
    delay = aligned_forces(arm, start)
    rows = ImuRows.of(
        imu.time, imu.readings[FORCE.name], imu.readings[RATE.name], Window(WIDTH), delay=delay
    )
    # From the clock of the rates to that of the forces, which rows have.
    clock = start.clock.moved(-delay, 0.0)
    at = clock.to_joints(rows.time)
    inside = arm.path.covers(at, 4.0 * WIDTH)
    inside &= clock.is_clear(rows.time, _around_steps(arm, 4.0 * WIDTH))
    refuse_uncovered(inside, source=imu.name)
    rows = rows.select(inside)
    at = at[inside]
    # Noise of both by vibration, relative to its median.
    scatter = np.median(rows.sigma, axis=1)
    sigma = np.sqrt(np.prod(rows.sigma / scatter[:, None], axis=0))
    readings = {FORCE.name: rows.readings[:3].T, RATE.name: rows.readings[3:].T, "sigma": sigma}
    lines = imu.lines[np.searchsorted(imu.time, rows.time)]
    table = _table(arm, imu, clock, rows.time, at, lines, readings, offsets=rows.window.offsets)
    assert table.moving is not None
    return replace(
        table, moving=replace(table.moving, delay=delay, scatter=tuple(scatter.tolist()))
    )


def ideal_imu_table(arm: MovingArm) -> Measurements:
    """Return the readings of an ideal IMU at the nominal tip over a whole motion, as rows of
    :func:`session_tables`.
    """
    window = Window(WIDTH)
    (begin, end) = arm.path.span
    at = begin + np.arange(0.0, end - begin, APART * WIDTH)
    at = at[arm.path.covers(at, 4.0 * WIDTH)]
    ideal = arm.ideal(at, window)
    readings = {FORCE.name: ideal.force, RATE.name: ideal.rate}
    stream = Stream("imu", at, readings, {})
    return _table(
        arm, stream, Clock(), at, at, np.arange(2, len(at) + 2), readings, offsets=window.offsets
    )


def start_tracker(arm: MovingArm, tracker: Stream) -> Clock:
    """Return the clock of an instrument that observes an arm in motion.

    Raises:
        MeasurementError: for readings that do not change with the motion, or are not of it.
    """
    sensor = _sensor(tracker)
    return start_readings(arm, tracker.select(~tracker.repeats), sensor)


def _sensor(tracker: Stream) -> type[Sensor]:
    sensor = sensor_class(tracker.readings)
    if sensor is None or sensor.fields[0].is_name or not sensor.reads_place:
        raise MeasurementError(
            f"{tracker.name}: {', '.join(tracker.readings)} in motion; expected readings that "
            "change with it, such as x y z or distance, or u v with point or target; held poses, "
            "such as a point in a socket, need a separate table"
        )
    return sensor


def _tracker_table(arm: MovingArm, tracker: Stream) -> Measurements:
    tracker = at_even_samples(tracker)
    clock = start_tracker(arm, tracker)
    name = _sensor(tracker).fields[0].name
    again = tracker.repeats
    if again.any():
        tracker = _without_stale(arm, tracker, clock, again, tracker.readings[name])
    values = tracker.readings[name]
    if tracker.rate > FOLLOWING.fast and not tracker.things.any():
        tracker = tracker.without(
            ~steady(values.reshape(len(values), -1)), "are outliers: readings of something else"
        )
    at = clock.to_joints(tracker.time)
    inside = arm.path.covers(at) & clock.is_clear(tracker.time, _around_steps(arm))
    refuse_uncovered(inside, source=tracker.name)
    readings = {name: values[inside] for name, values in tracker.readings.items()}
    lines = tracker.lines[inside]
    return _table(arm, tracker, clock, tracker.time[inside], at[inside], lines, readings)


def _without_stale(
    arm: MovingArm, tracker: Stream, clock: Clock, again: np.ndarray, values: np.ndarray
) -> Stream:
    """Return a stream without rows that repeat the one before although the arm moves by more than
    the resolution.

    ``again`` is which rows repeat the one before of the same thing, shape (T,), ``values`` the main
    readings, (T,) or (T, k).
    """
    order = np.argsort(tracker.things, kind="stable")
    q = arm.path.at(clock.to_joints(tracker.time))[order]
    values = values.reshape(len(order), -1)[order]
    again = again[order]
    starts = np.flatnonzero(~again)
    run = np.cumsum(~again) - 1
    moved = np.maximum.reduceat(np.abs(q - q[starts[run]]).max(axis=1), starts)
    # At its limit of resolution a reading changes by the smallest step.
    steps = np.abs(np.diff(values[starts], axis=0, append=np.inf))
    finest = np.min(np.where(steps > 0.0, steps, np.inf), axis=0)
    is_stale = (moved > FOLLOWING.rests) & np.any(steps > FOLLOWING.coarse * finest, axis=1)
    # A lost target may be reported at another position; else the first row is the last real
    # reading.
    seen = np.append(starts[1:], len(q)) - starts == 1
    seen |= steady(values[starts])
    stale = np.zeros(len(q), bool)
    stale[order] = is_stale[run] & (again | ~seen[run])
    return tracker.without(
        stale,
        "repeat the previous one while the arm moves: the target was lost, or the log is too fast",
    )


@dataclass(frozen=True, eq=False)
class _Course:
    """The course of an arm, as readings of a stream depend on it.

    Attributes:
        arm: the arm on its path.
        offsets: times relative to that of a row on which its reading depends, shape (K,) [s]; None
            for instantaneous ones.
    """

    arm: MovingArm
    offsets: np.ndarray | None

    def with_clock(
        self,
        table: Measurements,
        clock: tuple[float, float, float],
        steps: Sequence[tuple[float, float]],
    ) -> Measurements:
        """Return a table of its rows by another clock, see :class:`pincal.recorded.ArmCourse`."""
        before = table.moving
        assert before is not None
        assert table.time is not None
        stepping = Clock(*clock, steps=tuple(sorted(steps)))
        margin = 0.0 if self.offsets is None else float(np.abs(self.offsets).max())
        at = stepping.to_joints(table.time)
        inside = self.arm.path.covers(at, margin)
        inside &= stepping.is_clear(table.time, _around_steps(self.arm, margin))
        refuse_uncovered(inside, source=table.source)
        kept = table.select(inside)
        here, moving = _laid(self, at[inside])
        return replace(
            kept,
            q=self.arm.robot.as_reported(here.q),
            velocity=here.velocity,
            moving=replace(
                moving,
                clock=clock,
                steps=stepping.steps,
                delay=before.delay,
                scatter=before.scatter,
            ),
        )


def _around_steps(arm: MovingArm, margin: float = 0.0) -> float:
    """Return the time on either side of a step of a clock within which a row belongs to neither
    side [s].

    If it is the joints' clock that steps, their path is not known there, as at its ends.
    """
    return margin + ON_PATH.ends * arm.path.spacing


def _laid(course: _Course, at: np.ndarray) -> tuple[Conditions, Moving]:
    """Return the conditions of rows at times of the joints' clock, shape (N,) [s], and the motion
    on which their readings depend.
    """
    arm = course.arm
    here = arm.conditions(at)
    moving = Moving(inertial=here.inertial, course=course)
    if course.offsets is None:
        return here, moving
    there = arm.conditions(at, course.offsets)
    assert there.velocity is not None
    shape = (len(at), len(course.offsets), arm.robot.n_joints)
    loads = None if there.inertial is None else there.inertial.reshape(*shape, 6)
    velocity = there.velocity.reshape(shape)
    return here, replace(moving, q=there.q.reshape(shape), velocity=velocity, loads=loads)


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
    """Return the rows of a stream with the poses of the arm; ``time`` is by its clock, ``at`` by
    the joints'.
    """
    n = len(time)
    robot = arm.robot
    here, moving = _laid(_Course(arm, offsets), at)
    moving = replace(moving, clock=(clock.offset, clock.drift, clock.middle), steps=clock.steps)
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
