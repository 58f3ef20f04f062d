"""Joints that a pendant shows with few digits: said, and the noise of known size that it is."""

import numpy as np
import pytest
from mistakes_study import NOISE, PLAIN, machine_of, poses_of, robot_of

from pincal.calibration.calibration import Calibration, run_calibration
from pincal.identify.options import Options
from pincal.identify.rounded_joints import RoundedJoints
from pincal.measure.joint_columns import steps_of
from pincal.measure.measurements import measurements_from_arrays
from pincal.model.effects import GEOMETRIC
from pincal.validate.misfit import Verdict

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
DECLARED = Options(effects=GEOMETRIC, sigma=NOISE)


def calibrated(options: Options, *, was_sent: bool) -> Calibration:
    """Return a calibration by joints in tenths of a degree, at which the robot stood if it was sent to them."""
    robot, _ = robot_of("ur5")
    rng = np.random.default_rng(1)
    machine = machine_of(robot, rng)
    q = 0.9 * robot.random_configurations(60, rng)
    written = np.deg2rad(np.round(np.rad2deg(q), 1))
    position = poses_of(machine, written if was_sent else q)[0] + NOISE * rng.normal(size=(60, 3))
    return run_calibration(robot, measurements_from_arrays(robot.joint_names, written, position=position), options)


def notes_of(found: Calibration) -> list[str]:
    """Return the notes on rounded joints."""
    return [note.text for note in found.result.warnings if "multiples of" in note.text]


def test_declared_noise_has_the_rounding_in_addition() -> None:
    """The model is adequate, no row is an outlier, and a note says the step and what it costs."""
    found = calibrated(DECLARED, was_sent=False)
    assert found.result.verdict_of() is Verdict.ADEQUATE
    assert not found.result.outliers
    (note,) = notes_of(found)
    assert "6 joints are all multiples of 0.1 deg" in note and "beside the declared one" in note
    assert found.fit.problem.stations[0].arrival is not None


def test_a_robot_that_was_sent_there_has_no_such_noise() -> None:
    """It stands where the table says, and is judged by the declared noise alone."""
    found = calibrated(DECLARED, was_sent=True)
    assert found.result.verdict_of() is Verdict.ADEQUATE
    assert not notes_of(found)
    assert found.fit.problem.stations[0].arrival is None
    assert found.result.noise["sigma_m"] == NOISE


def test_without_declared_noise_it_is_said() -> None:
    """What rows are off is the noise; nothing is judged by it."""
    found = calibrated(PLAIN, was_sent=False)
    assert found.result.verdict_of() is Verdict.NOT_JUDGED
    (note,) = notes_of(found)
    assert "no noise is declared" in note


def test_what_a_step_costs_follows_from_levers() -> None:
    """A target that a step of h moves by d is off by d / sqrt(12); joints of a grid are not rounded."""
    fit = calibrated(PLAIN, was_sent=False).fit
    station = fit.problem.stations[0]
    steps = np.deg2rad([0.0, 0.1, 0.0, 0.0, 0.02, 0.0])
    q = station.conditions.q
    moved = [fit.predict(q + step) - fit.predict(q) for step in np.diag(steps)]
    expected = np.sqrt(np.mean(np.sum(np.array(moved)[..., 3] ** 2, axis=(0, 2))) / 12.0)
    assert RoundedJoints(station, fit.values, steps).moved == pytest.approx(expected, rel=1e-3)
    grid = np.repeat(np.deg2rad([10.0, 20.0, 30.0]), 10)[:, None]
    assert not steps_of(grid).any()
