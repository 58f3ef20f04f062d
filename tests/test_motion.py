"""Arms in motion: loads of inertia, paths of joints, clocks and streams, against closed forms and the simulated machine."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.errors import MeasurementError
from pincal.measure.clock_jump import likeliest_jump
from pincal.model.catalogue import FrictionWindup, InstrumentClock, JointLag
from pincal.model.chain import Chain, MomentFrame
from pincal.model.conditions import Conditions
from pincal.model.effects import ELASTIC, BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.motion.clocks import Clock, aligned, correlate
from pincal.motion.imu_rows import ImuRows
from pincal.motion.joint_path import JointPath
from pincal.motion.moving_arm import MovingArm, inertial_loads, level_chain
from pincal.motion.starts import start_positions
from pincal.motion.stream import Stream
from pincal.parameters import FRAME_SYMBOLS
from pincal.robot.robot import Robot
from pincal.robot.urdf_file import find_file
from pincal.sensors.imu import ImuErrors, Inertial, Window, imu_parameters
from pincal.simulate.inertia import link_motions
from pincal.simulate.moving import FourierPath, draw_path, tip_motion
from pincal.simulate.session import Clock as TrueClock
from pincal.simulate.session import ImuSetup, MovingSession

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

ARMS: dict[str, Callable[[], Path]] = {
    "kuka": kuka_urdf_path,
    "ur10": lambda: find_file("ur10"),
    "panda": lambda: find_file("panda"),
}


@pytest.fixture(scope="module", params=ARMS)
def robot(request: pytest.FixtureRequest) -> Robot:
    """Return each of the arms: industrial, parallel axes, seven joints."""
    return Robot.from_urdf(ARMS[request.param]())


# --- loads of inertia -------------------------------------------------------------------------------------------


Frame = MomentFrame


@pytest.mark.parametrize("frame", ["before", "after"])
def test_inertia_bends_the_arm_as_it_does_the_true_one(robot: Robot, frame: Frame, rng: np.random.Generator) -> None:
    """What moving links add to the deflections is that of the simulated machine to a thousandth."""
    n, rows = robot.n_joints, 20
    q, speeds, gains = robot.random_configurations(rows, rng), *(rng.standard_normal((2, rows, n)) * [[[2.0]], [[6.0]]])
    payload, centre = rng.choice([0.0, 4.0], rows), np.array([0.1, -0.05, 0.2])
    compliance = np.tile([1e-8, 1e-8, 5e-8], (n, 1))
    machine = sim.TrueMachine.from_urdf(
        robot.urdf.decode(), tip=robot.tip, base=robot.base, compliance=compliance, moment_frame=frame
    )
    model = Model(Chain.of(robot, moment_frame=frame), ELASTIC, equilibrium=True)
    values = np.zeros(model.n_parameters)
    values[[model.index(f"{joint}.k_{axis}") for joint in robot.joint_names for axis in "xyz"]] = compliance.ravel()
    loads = inertial_loads(robot, q, speeds, gains, payload=payload, payload_centre=centre)
    conditions = Conditions(q, np.zeros(rows, int), payload, centre, velocity=speeds, inertial=loads)
    held, load = replace(conditions, velocity=None, inertial=None), {"payload": payload, "payload_com": centre}
    expected = machine.tip(q, velocity=speeds, acceleration=gains, **load) - machine.tip(q, **load)

    found = model.predict(values, conditions) - model.predict(values, held)
    assert np.abs(found - expected[:, :3]).max() < 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("frame", ["paper", "before", "after"])
def test_moments_about_the_axes_are_the_torques_of_the_drives(robot: Robot, frame: Frame, rng: np.random.Generator) -> None:
    """Static and inertial moments about each axis are what Pinocchio's rnea has the drives hold against."""
    n, rows = robot.n_joints, 5
    q, speeds, gains = robot.random_configurations(rows, rng), *rng.standard_normal((2, rows, n))
    conditions = replace(Conditions.at(q), inertial=inertial_loads(robot, q, speeds, gains))
    moments = Model(Chain.of(robot, moment_frame=frame), ()).static_moments(np.zeros(0), conditions)
    model = robot.pinocchio_model()
    order = [model.joints[model.getJointId(name)].idx_v for name in robot.joint_names]
    for row in range(rows):
        v, a = np.zeros((2, model.nv))
        v[order], a[order] = speeds[row], gains[row]
        torque = pin.rnea(model, model.createData(), robot.configuration(model, q[row]), v, a)[order]
        np.testing.assert_allclose(moments[row, 2::3], -torque, rtol=0.0, atol=1e-9 * np.abs(torque).max())


def test_an_arm_without_masses_has_no_loads_of_inertia() -> None:
    """Where the URDF does not say what links weigh, moments stay static."""
    robot = Robot.from_urdf(kuka_urdf_path(), mass=200.0)
    bare = Robot.from_urdf(re.sub(rb"<inertial>.*?</inertial>", b"", robot.urdf, flags=re.S))
    q = np.zeros((1, bare.n_joints))

    assert bare.massless and inertial_loads(bare, q, q, q) is None


# --- paths of joints --------------------------------------------------------------------------------------------

STEP = 2e-5


def driven(robot: Robot, seconds: float = 40.0) -> tuple[sim.TrueMachine, FourierPath]:
    """Return the machine of a robot without errors, and a path that it drives."""
    machine = sim.TrueMachine.from_urdf(robot.urdf.decode(), tip=robot.tip, base=robot.base)
    return machine, draw_path(machine.nominal, seconds, np.random.default_rng(3))


def logged(path: FourierPath, seconds: float = 40.0) -> tuple[np.ndarray, np.ndarray]:
    """Return what a log of 150 Hz has of a path: rounded, one row in fifty lost."""
    time = np.arange(0.0, seconds, 1.0 / 150.0)
    time = time[np.random.default_rng(4).random(len(time)) > 0.02]
    return time, STEP * np.round(path.at(time) / STEP)


def test_splines_have_the_motion_that_the_joints_had(robot: Robot) -> None:
    """Positions, velocities, accelerations and jerks of a rounded log are those of the waves that were driven."""
    truth = driven(robot)[1]
    path = JointPath.through(*logged(truth))
    time = np.linspace(2.0, 38.0, 5000)

    assert path.covers(time).all() and not path.covers(np.array([0.0, 39.99, 50.0])).any()
    for order, bound in enumerate((2e-6, 4e-5, 1e-3, 3e-2)):
        assert np.sqrt(np.mean((path.at(time, order) - truth.at(time, order)) ** 2, axis=0)).max() < bound
    np.testing.assert_allclose(path.scatter, STEP / 12**0.5, rtol=0.1)


def test_knots_are_as_close_as_the_motion_asks_for() -> None:
    """Cross-validation puts more knots where a joint moves in quicker waves, and few where it does not."""
    time = np.arange(0.0, 60.0, 0.005)
    noise = 1e-4 * np.random.default_rng(0).standard_normal((len(time), 1))
    slow, quick = (JointPath.through(time, np.sin(2.0 * np.pi * f * time)[:, None] + noise) for f in (0.3, 4.0))

    assert slow.spacing == 1.0 / 4.0 and quick.spacing <= 1.0 / 16.0
    assert np.abs(quick.at(time[1000:-1000]) - np.sin(8.0 * np.pi * time[1000:-1000])[:, None]).max() < 4e-4


def test_a_gap_divides_a_path() -> None:
    """Where a log has no readings for two knots nothing is made up, and nothing near it is trusted."""
    time = np.concatenate([np.arange(0.0, 20.0, 0.01), np.arange(23.0, 40.0, 0.01)]) + 1.6e9
    path = JointPath.through(time, np.sin(time - 1.6e9)[:, None], knots_per_second=10.0)
    asked = 1.6e9 + np.array([10.0, 19.9, 21.0, 23.1, 30.0])

    assert len(path.parts) == 2 and path.covers(asked).tolist() == [True, False, False, False, True]
    np.testing.assert_allclose(path.at(asked[[0, 4]], 1)[:, 0], np.cos([10.0, 30.0]), atol=1e-6)


def test_a_log_that_no_spline_can_follow_is_refused() -> None:
    """Times that run back, and a log of which nothing hangs together."""
    with pytest.raises(MeasurementError, match="do not increase"):
        JointPath.through(np.array([0.0, 1.0, 1.0]), np.zeros((3, 1)))
    with pytest.raises(MeasurementError, match="expected readings at 20 Hz or more"):
        JointPath.through(np.arange(0.0, 60.0), np.zeros((60, 1)), knots_per_second=8.0)


# --- readings of an IMU -----------------------------------------------------------------------------------------


def arm_on(path: FourierPath, robot: Robot) -> MovingArm:
    """Return an arm on a path that is known to the last digit: as dense a log as splines need for that."""
    time = np.arange(0.0, 12.0, 1.0 / 400.0)
    return MovingArm(robot, JointPath.through(time, path.at(time), knots_per_second=32.0))


def test_an_ideal_imu_reads_the_motion_of_the_tip(robot: Robot) -> None:
    """Specific force, rate and angular acceleration from three poses are those of Pinocchio's derivatives."""
    machine, path = driven(robot)
    time = np.linspace(1.0, 11.0, 200)
    found, motion = arm_on(path, robot).ideal(time), tip_motion(machine, path, time)
    upright = motion.acceleration - np.einsum("nba,b->na", motion.T[:, :3, :3], robot.gravity)

    np.testing.assert_allclose(found.force, upright, rtol=0.0, atol=2e-5)
    np.testing.assert_allclose(found.rate, motion.rate, rtol=0.0, atol=2e-7)
    np.testing.assert_allclose(found.turning, motion.turning, rtol=0.0, atol=2e-5)


def test_stamps_since_1970_leave_accelerations_as_they_are(kuka: Robot) -> None:
    """A double has 0.2 us of such a stamp, which must not come into differences over a fraction of a millisecond."""
    epoch, time = 2.0**31, np.linspace(1.0, 11.0, 200).round(3)
    path = arm_on(driven(kuka)[1], kuka).path
    arm, later = (MovingArm(kuka, replace(path, origin=origin)) for origin in (0.0, epoch))
    at = (later.path.origin + time) - later.path.origin  # what the stamps say
    window = Window(0.03)

    for name, bound in (("force", 1e-7), ("turning", 1e-7)):
        found, expected = later.ideal(epoch + time, window), arm.ideal(at, window)
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=0.0, atol=bound)
    there, here = later.conditions(epoch + time, window.offsets), arm.conditions(at, window.offsets)
    np.testing.assert_allclose(there.q, here.q, rtol=0.0, atol=1e-15)


def test_the_simulated_tip_moves_as_its_links_do(robot: Robot) -> None:
    """Pinocchio's derivatives of the free chain are those of a recursion over rigid links."""
    machine, path = driven(robot)
    machine = machine.draw_errors(np.random.default_rng(1), sigma_length=1e-3, sigma_angle=1e-3, sigma_offset=1e-3)
    time = np.linspace(0.0, 40.0, 20)
    motion = tip_motion(machine, path, time)
    *_, tip = link_motions(machine.arm, path.at(time) + machine.joint_offsets, path.at(time, 1), path.at(time, 2))

    for own, base in ((motion.acceleration, tip.acceleration), (motion.rate, tip.rate), (motion.turning, tip.turning)):
        np.testing.assert_allclose(np.einsum("nab,nb->na", motion.T[:, :3, :3], own), base, rtol=0.0, atol=1e-12)


def test_a_row_is_the_mean_over_its_window(kuka: Robot) -> None:
    """Three moments a window are as good as hundreds, to a thousandth of an IMU's noise."""
    arm, window = arm_on(driven(kuka)[1], kuka), Window(0.03)
    time, fine = np.linspace(2.0, 10.0, 50), 0.03 * np.linspace(-5.0, 5.0, 201)
    weights = np.exp(-0.5 * (fine / 0.03) ** 2)
    dense = arm.ideal((time[:, None] + fine).ravel())
    found = arm.ideal(time, window)

    for name, bound in (("force", 1e-5), ("rate", 1e-6), ("turning", 1e-5)):
        mean = np.einsum("nka,k->na", getattr(dense, name).reshape(50, 201, 3), weights / weights.sum())
        np.testing.assert_allclose(getattr(found, name), mean, rtol=0.0, atol=bound)


@pytest.mark.parametrize("width", [0.0, 0.03])
def test_columns_of_an_imu_are_exact(robot: Robot, width: float, rng: np.random.Generator) -> None:
    """Derivatives by geometry, compliances, clock, lag, friction, mount and the IMU's own errors equal differences."""
    arm, window, joint = MovingArm.of(robot, arm_on(driven(robot)[1], robot).path), Window(width), robot.joint_names[1]
    chain = level_chain(Chain.of(robot, moment_frame="after"))
    moving = (JointLag(joint), FrictionWindup(joint), InstrumentClock(6.0))
    model = Model(chain, (*ELASTIC, *moving, BaseFrame(("rx", "ry")), ToolFrame(FRAME_SYMBOLS)))
    conditions, P = arm.conditions(np.linspace(1.0, 11.0, 7), window.offsets), model.n_parameters
    sizes = np.array([1e-9 if p.unit == "rad/(N m)" else 1e-4 for p in (*model.parameters, *imu_parameters())])
    values = sizes * rng.standard_normal(len(sizes))

    def read(at: np.ndarray) -> np.ndarray:
        return ImuErrors.of(at[P:]).readings(Inertial.of(model.predict(at[:P], conditions), window))

    poses, motion = model.linearise(values[:P], conditions, rows=6)
    errors = ImuErrors.of(values[P:])
    columns = errors.columns(poses, motion.transpose(2, 1, 0), window)
    whole = np.concatenate([columns, errors.own_columns(Inertial.of(poses, window))])
    # In sums of all columns, whose signs are drawn, a wrong one would show.
    for _ in range(6):
        direction = sizes * rng.choice([-1.0, 1.0], len(sizes))
        slope = (read(values + 3.0 * direction) - read(values - 3.0 * direction)) / 6.0
        np.testing.assert_allclose(
            np.tensordot(direction, whole, 1), slope, rtol=0.0, atol=2e-6 * np.abs(slope).max() + 1e-7
        )
    assert (
        whole.shape == (len(sizes), 6, 7)
        and ImuErrors.of(np.zeros(22)).readings(ideal := Inertial.of(poses, window)).T.tolist()
        == np.hstack([ideal.force, ideal.rate]).tolist()
    )


def test_readings_are_filtered_as_predictions_are(kuka: Robot) -> None:
    """At stamps that come unevenly, some of them lost, filtered readings are predicted to a fiftieth of the noise."""
    arm, window, rng = arm_on(driven(kuka)[1], kuka), Window(0.03), np.random.default_rng(0)
    stamps = np.arange(0.5, 11.5, 0.01)
    stamps = (stamps + rng.uniform(-2e-3, 2e-3, len(stamps)))[rng.random(len(stamps)) > 0.02]
    stamps = stamps[(stamps < 5.0) | (stamps > 5.2)]
    read = arm.ideal(stamps)
    rows = ImuRows.of(stamps, read.force, read.rate, window)
    ideal = arm.ideal(rows.time, window)

    assert not np.any((rows.time > 4.95) & (rows.time < 5.25)) and len(rows) > 0.85 * 11.0 / (2.5 * 0.03)
    assert np.sqrt(np.mean((rows.readings[:3].T - ideal.force) ** 2)) < 4e-4
    assert np.sqrt(np.mean((rows.readings[3:].T - ideal.rate) ** 2)) < 4e-5


def test_the_noise_of_a_row_is_that_of_the_readings_about_it() -> None:
    """White noise gives rows of the size that they are said to have, beside motion of any speed; more where more shakes."""
    rng, stamps = np.random.default_rng(0), np.arange(0.0, 200.0, 0.01)
    grows = np.where(stamps < 100.0, 1.0, 3.0)[:, None]
    moved = 3.0 * np.sin(2.0 * np.pi * 0.6 * stamps)[:, None]
    noise = grows * rng.standard_normal((2, len(stamps), 3))
    quiet, rows = (ImuRows.of(stamps, moved + k * noise[0], moved + k * noise[1], Window(0.03)) for k in (0.0, 1.0))
    left, late = rows.readings - quiet.readings, rows.time > 100.0

    for which in (late, ~late):
        assert left[:, which].std() == pytest.approx(rows.sigma[:, which].mean(), rel=0.05)
    assert rows.sigma[:, late].mean() == pytest.approx(3.0 * rows.sigma[:, ~late].mean(), rel=0.05)


# --- clocks -----------------------------------------------------------------------------------------------------

TRUE = {"imu": TrueClock(1.234, -7e-5, 20.0), "tracker": TrueClock(-0.75, 1062e-6, 20.0)}


@pytest.fixture(scope="module")
def session() -> tuple[MovingArm, dict[str, dict[str, np.ndarray]]]:
    """Return an arm and what was logged of it in 40 s: joints, IMU and tracker, each on a clock of its own."""
    robot = Robot.from_urdf(kuka_urdf_path())
    machine, path = driven(robot)
    machine = machine.draw_errors(np.random.default_rng(2), sigma_length=3e-4, sigma_angle=1e-3, sigma_offset=1e-3)
    imu = ImuSetup.draw(np.random.default_rng(5), acc_density=0.01, gyro_density=1.7e-4, vibration=0.1)
    tracker = sim.Instrument(pose=np.eye(4), targets=(0.05, 0.1, 0.2), sigma=3e-5)
    whole = MovingSession(
        path=path, duration=40.0, imu=replace(imu, delay=0.0), tracker=tracker, clocks=TRUE, resolution=STEP, dropped=0.01
    )
    tables = whole.measure(machine, np.random.default_rng(6))
    joints = tables["joints"]
    q = np.column_stack([joints[name] for name in robot.joint_names])
    return MovingArm(robot, JointPath.through(joints["time"], q)), tables


@pytest.mark.long
def test_the_clock_of_an_imu_is_found(session: tuple[MovingArm, dict[str, dict[str, np.ndarray]]]) -> None:
    """By its rates alone, whatever its mount: to a millisecond at once, with the mount and the right hand."""
    arm, table = session[0], session[1]["imu"]
    rate = np.column_stack([table[f"w{axis}"] for axis in "xyz"])
    grid = np.arange(1.0, 39.0, 0.02)
    speeds = np.linalg.norm(arm.ideal(grid).rate, axis=1)
    start = correlate(grid, speeds, table["time"], np.linalg.norm(rate, axis=1))
    clock = Clock(start.offset)
    found = aligned(table["time"], rate, lambda at, _: arm.ideal(at).rate, arm.path.covers, clock, source="imu")
    stamps = np.linspace(2.0, 37.0, 20)

    assert start.is_same and start.is_clear and abs(start.offset - 1.234) < 0.05
    off = np.abs(found.clock.to_joints(stamps) - TRUE["imu"].to_joints(stamps)).max()
    assert off < 1e-3 and off < 6.0 * (found.clock.sigma[0] + 20.0 * found.clock.sigma[1])
    assert np.linalg.det(found.matrix) == pytest.approx(1.0, abs=0.05)


def test_a_clock_that_runs_at_another_rate_is_caught(session: tuple[MovingArm, dict[str, dict[str, np.ndarray]]]) -> None:
    """A tracker whose stamps count frames of another rate, 1062 ppm off, is found by the nominal arm."""
    arm, table = session[0], session[1]["tracker"]
    position, stamps = np.column_stack([table[axis] for axis in "xyz"]), table["time"]

    def poses(at: np.ndarray, _: np.ndarray) -> np.ndarray:
        tips = arm.tips(at)
        return np.hstack([tips[:, :, 3], tips[:, :, :3].reshape(len(at), -1)])

    found = aligned(stamps, position, poses, arm.path.covers, Clock(-0.75 + 0.1), source="tracker")
    assert found.clock.drift == pytest.approx(1062e-6, abs=60e-6)
    assert np.abs(found.clock.to_joints(stamps) - TRUE["tracker"].to_joints(stamps)).max() < 2e-3


def test_a_clock_that_was_set_by_seconds_is_read_on_both_sides(kuka: Robot) -> None:
    """The gap that it leaves in its stamps is none in the motion; a gap of both, such as a lost target, is no step."""
    _, path = driven(kuka, 60.0)
    joints, time = logged(path, 60.0), np.arange(2.0, 58.0, 0.02)
    arm = MovingArm(kuka, JointPath.through(*joints))
    position = kuka.forward_kinematics(path.at(time)) @ np.array([0.1, 0.0, 0.2, 1.0])
    was_set = time + 0.7 + 5.0 * (time > 30.0)
    seen = (time < 30.0) | (time > 35.0)
    for stamps, rows, steps in ((was_set, slice(None), [(35.72, -5.0)]), (time + 0.7, seen, [])):
        stream = Stream("tracker.csv", stamps[rows], {"position": position[rows, :3]}, {})
        clock = start_positions(arm, stream, position[rows, :3])
        assert [at for at, _ in clock.steps] == pytest.approx([at for at, _ in steps], abs=0.03)
        assert [size for _, size in clock.steps] == pytest.approx([size for _, size in steps], abs=1e-4)
        assert clock.to_joints(stamps[:1])[0] == pytest.approx(2.0, abs=1e-4)


def test_a_jump_of_a_clock_is_found_to_the_row(rng: np.random.Generator) -> None:
    """Beside an offset and a drift, in whatever order the rows stand; without one none is sure."""
    time, rate = rng.permutation(np.arange(3000) * 0.02), rng.standard_normal((3000, 2))
    noise = 1e-3 * rng.standard_normal((3000, 2))
    Q = np.linalg.qr((rate[:, :, None] * np.stack([np.ones(3000), time], axis=1)[:, None]).reshape(6000, 2))[0]

    def beside(columns: np.ndarray) -> np.ndarray:
        flat = columns.reshape(6000, -1)
        return (flat - Q @ (Q.T @ flat)).reshape(columns.shape)

    for size in (5e-3, 0.0):
        left = (2e-3 + 1e-4 * time + size * (time > 29.99))[:, None] * rate + noise
        found = likeliest_jump(time, left, rate, beside)
        assert found.size == pytest.approx(size, abs=4.0 * found.sigma) and found.sigma < 1e-4
        assert found.is_sure(1e-3) == (size > 0.0) and (not size or found.time == pytest.approx(30.0, abs=0.05))


def test_speeds_of_another_motion_are_not_taken_for_this_one() -> None:
    """Correlation tells whether two logs are of one motion, and whether the motion repeats."""
    rng, time = np.random.default_rng(0), np.arange(0.0, 60.0, 0.01)
    speeds = [np.abs(np.convolve(rng.standard_normal(len(time)), np.ones(100) / 10.0, "same")) for _ in range(2)]
    repeated = np.abs(np.sin(2.0 * np.pi * time / 5.0))

    assert correlate(time, speeds[0], time + 3.0, speeds[0]).offset == pytest.approx(-3.0, abs=0.02)
    assert not correlate(time, speeds[0], time, speeds[1]).is_same
    assert not correlate(time, repeated, time, repeated).is_clear
