"""Steps of the clocks of logs in motion: several may hide each other, and each is estimated like offset and drift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_motion_numbers import of_stamps

from pincal.calibration.stepping import step_notes, with_steps
from pincal.errors import MeasurementError
from pincal.measure.clock_jump import Jump, sure_jumps
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.reading_numbers import JUMPS
from pincal.model.catalogue.motion import InstrumentClock
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.motion.clocks import Alignment, Clock, aligned
from pincal.motion.motion_numbers import CLOCKS
from pincal.motion.starts import check_clock
from pincal.recorded import Moving
from pincal.robot.robot import Robot
from pincal.validate.clock_jumps import SteppingClock, SteppingClocksError

NOISE = 1e-3


def unexplained_by(*shapes: np.ndarray) -> tuple[np.ndarray, object]:
    """Return rates of change of readings, and the projection that leaves out these functions of time."""
    rate = np.random.default_rng(1).standard_normal((len(shapes[0]), 2))
    columns = rate[:, :, None] * np.stack(shapes, axis=1)[:, None]
    Q = np.linalg.qr(columns.reshape(rate.size, -1))[0]

    def projected(steps: np.ndarray) -> np.ndarray:
        flat = steps.reshape(rate.size, -1)
        return np.asarray((flat - Q @ (Q.T @ flat)).reshape(steps.shape))

    return rate, projected


@pytest.mark.parametrize(
    "steps",
    [
        [],
        [(30.0, 8.3e-3)],
        # Between two of one sign the clock seems to drift.
        [(20.0, 9e-3), (40.0, 9e-3)],
        [(15.0, 9e-3), (30.0, -9e-3), (45.0, 9e-3)],
    ],
)
def test_steps_that_hide_each_other_are_found(steps: list[tuple[float, float]]) -> None:
    """Each to its interval and to the row, beside offset and drift; without any, none is sure."""
    time = np.arange(3000) * 0.02
    rate, projected = unexplained_by(np.ones(3000), time)
    shift = sum((size * (time >= at - 1e-6) for at, size in steps), np.zeros(3000))
    noise = NOISE * np.random.default_rng(2).standard_normal((3000, 2))
    found = sure_jumps(time, (2e-3 + 1e-4 * time + shift)[:, None] * rate + noise, rate, projected, 1e-3)  # type: ignore[arg-type]

    assert [jump.time for jump in found] == pytest.approx([at for at, _ in steps], abs=0.05)
    for jump, (_, size) in zip(found, steps, strict=True):
        assert jump.size == pytest.approx(size, abs=4.0 * jump.sigma) and jump.sigma < 2e-4


def test_a_sound_clock_has_no_step() -> None:
    """Of a hundred draws of noise, which is common to the readings of a block, none has."""
    time = np.arange(1000) * 0.06
    rate, projected = unexplained_by(np.ones(1000), time)
    for seed in range(100):
        rng = np.random.default_rng(seed)
        common = np.repeat(rng.standard_normal((40, 2)), 25, axis=0)
        noise = NOISE * (rng.standard_normal((1000, 2)) + common)
        assert not sure_jumps(time, noise, rate, projected, 0.0)  # type: ignore[arg-type]


def test_a_step_is_found_beside_readings_that_seem_to_tell_more() -> None:
    """As those about a step of the joints' clock, across which their path is none of the arm's."""
    time = np.arange(800) * 0.075
    rate = np.random.default_rng(1).standard_normal((800, 2))
    rate[400:406] *= 40.0
    Q = np.linalg.qr((rate[:, :, None] * np.stack([np.ones(800), time], axis=1)[:, None]).reshape(rate.size, -1))[0]

    def projected(steps: np.ndarray) -> np.ndarray:
        flat = steps.reshape(rate.size, -1)
        return np.asarray((flat - Q @ (Q.T @ flat)).reshape(steps.shape))

    noise = 1e-4 * np.random.default_rng(2).standard_normal((800, 2))
    (found,) = sure_jumps(time, 0.016 * (time >= 30.0)[:, None] * rate + noise, rate, projected, 1e-3)
    assert found.time == pytest.approx(30.0, abs=0.5) and found.size == pytest.approx(0.016, abs=2e-4)


def test_a_clock_has_its_steps_added() -> None:
    """From each stamp on; they stay when the clock is moved, or its offset is given at another stamp."""
    time = np.array([0.0, 9.9, 10.0, 20.0])
    clock = Clock(0.5, 1e-3, 5.0).stepping(Jump(2e-3, 0.0, 20.0)).stepping(Jump(8e-3, 0.0, 10.0))
    expected = time + 0.5 + 1e-3 * (time - 5.0) + np.array([0.0, 0.0, 8e-3, 1e-2])

    np.testing.assert_allclose(clock.to_joints(time), expected, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(clock.about(100.0).to_joints(time), expected, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(clock.moved(0.1, 0.0, [0.0, 1e-3]).to_joints(time)[[0, 3]], expected[[0, 3]] + [0.1, 0.101])
    assert clock.is_clear(time, 0.5).tolist() == [True, False, False, False]


def test_large_steps_are_found_by_the_nominal_arm() -> None:
    """Those that no error of an arm looks like, with offset and drift, whatever the readings are."""
    time = np.arange(0.0, 100.0, 0.02)

    def course(at: np.ndarray) -> np.ndarray:
        return np.column_stack([np.sin(at), np.cos(1.7 * at), np.sin(0.6 * at + 1.0)])

    true = Clock(0.02, 1e-4, 50.0, steps=((30.0, 0.12), (70.0, -0.08)))
    readings = course(true.to_joints(time)) @ np.array([[1.0, 0.2, 0.0], [0.0, 0.9, 0.1], [0.3, 0.0, 1.1]])
    readings += 1e-4 * np.random.default_rng(0).standard_normal(readings.shape)
    found = aligned(
        time, readings, lambda at, _: course(at), lambda at: np.ones(len(at), bool), Clock(0.0), source="tracker.csv"
    ).clock

    assert [at for at, _ in found.steps] == pytest.approx([30.0, 70.0], abs=0.05)
    assert [size for _, size in found.steps] == pytest.approx([0.12, -0.08], abs=1e-4)
    assert found.about(0.0).offset == pytest.approx(true.about(0.0).offset, abs=2e-4)


def test_a_clock_that_was_set_on_by_long_is_aligned() -> None:
    """By a quarter of an hour, in the middle of which there are no stamps at all."""
    time = np.arange(0.0, 100.0, 0.02)

    def course(at: np.ndarray) -> np.ndarray:
        return np.column_stack([np.sin(at), np.cos(1.7 * at), np.sin(0.6 * at + 1.0)])

    readings = course(time + 0.02) + 1e-4 * np.random.default_rng(0).standard_normal((len(time), 3))
    stamps = time + 866.0 * (time >= 45.0)
    start = Clock(0.0, steps=((45.0 + 866.0, -866.1),))
    found = aligned(stamps, readings, lambda at, _: course(at), lambda at: abs(at - 50.0) < 60.0, start, source="imu.csv")

    np.testing.assert_allclose(found.clock.to_joints(stamps), time + 0.02, rtol=0.0, atol=1e-4)


def test_more_steps_than_a_clock_has_are_refused() -> None:
    """They are stamps of another kind; what to log instead is said."""
    jump = Jump(2.0 * CLOCKS.nominal_jump, 1e-4, 0.5)
    clock = Clock(steps=tuple((float(k), 0.1) for k in range(JUMPS.most)))
    found = Alignment(clock, np.eye(3), np.zeros(3), np.ones(3), jump)
    with pytest.raises(MeasurementError, match=rf"more than {JUMPS.most} other times.*log the device's own stamps"):
        check_clock(of_stamps(np.arange(100) / 100.0), found)


def test_a_step_moves_all_drives_from_its_stamp_on(robot: Robot) -> None:
    """By their velocities, as an offset does; its derivative is that of the offset times 0 or 1."""
    n = robot.n_joints
    rng = np.random.default_rng(3)
    q, speeds = robot.random_configurations(6, rng), rng.standard_normal((6, n))
    time = np.arange(6.0)
    conditions = replace(Conditions.at(q), velocity=speeds, time=time)
    clock = InstrumentClock(2.0, steps=(3.0, 5.0))
    chain = Chain.of(robot)
    ways = np.zeros((4, n, 6))
    for term in clock.terms(chain, conditions, None):
        assert term.basis is not None
        ways[term.parameter, chain.drives.tolist().index(term.coordinate)] += term.basis

    assert [p.name for p in clock.parameters(chain)] == ["clock.offset", "clock.drift", "clock.step_1", "clock.step_2"]
    np.testing.assert_array_equal(ways[0], speeds.T)
    np.testing.assert_array_equal(ways[2], speeds.T * (time >= 3.0))
    np.testing.assert_array_equal(ways[3], speeds.T * (time >= 5.0))


@pytest.fixture
def robot() -> Robot:
    """Return an arm."""
    return Robot.from_urdf("ur5")


def test_a_table_whose_course_is_not_known_is_refused(robot: Robot) -> None:
    """As one made from arrays, or with its joints in another order; steps of a table are told."""
    table: Measurements = measurements_from_arrays(
        robot.joint_names, robot.random_configurations(5, np.random.default_rng(0)), position=np.eye(5)[:, :3]
    )
    error = SteppingClocksError("it jumps", {"": SteppingClock((0.0, 0.0, 0.0), ((1.0, 8e-3),))})
    with pytest.raises(SteppingClocksError, match="it jumps"):
        with_steps({"": table}, error)
    stepping = table.__class__(**{**vars(table), "moving": Moving(steps=((1.0, 8.3e-3),))})
    assert not list(step_notes({"": table}))
    assert "steps by +8.3 ms at 1 s of its stamps" in next(iter(step_notes({"": stepping})))
