"""New rows of another kind than those of a calibration are judged, and taken in, by a noise that is their own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from scipy.spatial.transform import Rotation

import pincal
from pincal import FittedRobot, Measurements, Options, Robot, calibrate, measurements_from_arrays
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.validation import validate_rows
from pincal.errors import BadInputError
from pincal.model.effects import GEOMETRIC

NOISE = 5e-5  # [m]
OPTIONS = Options(effects=GEOMETRIC, sigma=NOISE)


def measured(robot: Robot, machine: sim.TrueMachine, n: int, seed: int, angle: float | None = None) -> Measurements:
    """Return positions, or poses with this noise of their orientations [rad], from a new place of the instrument."""
    rng = np.random.default_rng(seed)
    q = robot.random_configurations(n, rng)
    hall = np.eye(4)
    hall[:3, :3] = Rotation.random(rng=rng).as_matrix()
    hall[:3, 3] = rng.uniform(-3.0, 3.0, 3)
    tool = np.eye(4)
    tool[:3, 3] = (0.05, 0.03, 0.10)
    tool[:3, :3] = Rotation.from_rotvec([0.2, -0.3, 0.4]).as_matrix()
    seen = hall @ machine.tip(q) @ tool
    position = seen[:, :3, 3] + NOISE * rng.standard_normal((n, 3))
    if angle is None:
        return measurements_from_arrays(robot.joint_names, q, position=position)
    turned = Rotation.from_rotvec(angle * rng.standard_normal((n, 3))) * Rotation.from_matrix(seen[:, :3, :3])
    return measurements_from_arrays(robot.joint_names, q, position=position, quaternion=turned.as_quat())


@pytest.fixture(scope="module")
def machine() -> sim.TrueMachine:
    """Return a true arm."""
    nominal = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    return nominal.draw_errors(np.random.default_rng(3), sigma_length=3e-4, sigma_angle=5e-4, sigma_offset=1e-3)


@pytest.fixture(scope="module")
def of_positions(kuka: Robot, machine: sim.TrueMachine) -> FittedRobot:
    """Return its model from positions."""
    return calibrate(kuka, measured(kuka, machine, 60, 1), OPTIONS).at()


@pytest.fixture(scope="module")
def of_poses(kuka: Robot, machine: sim.TrueMachine) -> FittedRobot:
    """Return its model from poses."""
    options = Options(effects=GEOMETRIC, sigma=NOISE, sigma_orientation=1e-4)
    return calibrate(kuka, measured(kuka, machine, 60, 2, 1e-4), options).at()


@pytest.mark.parametrize("angle", [5e-5, pytest.param(1e-4, marks=pytest.mark.long), 1e-3])
def test_poses_tell_of_a_model_of_positions(
    kuka: Robot, machine: sim.TrueMachine, of_positions: FittedRobot, angle: float
) -> None:
    """Whatever the noise of orientations, an unchanged robot is left alone, and the noise that was found is told."""
    new = measured(kuka, machine, 40, 10, angle)
    found = pincal.diagnose(of_positions, new)

    assert not found.changed
    assert found.model.sigma[1] == pytest.approx(angle, rel=0.2)
    assert any("had no orientation" in str(note) and "--noise-angle" in str(note) for note in found.found.warnings)
    judged = validate_rows([of_positions], new)
    assert not judged.doubt and judged.misfit.p_value > 1e-3


def test_a_declared_noise_of_orientations_counts(kuka: Robot, machine: sim.TrueMachine, of_positions: FittedRobot) -> None:
    """It takes the place of the estimate, without a note; what is no angle is refused."""
    new = measured(kuka, machine, 40, 11, 1e-4)
    found = pincal.diagnose(of_positions, new, sigma_orientation=1e-4)

    assert not found.changed and found.model.sigma[1] == 1e-4
    assert not any("had no orientation" in str(note) for note in found.found.warnings)
    with pytest.raises(BadInputError, match="noise of 0 rad"):
        pincal.diagnose(of_positions, new, sigma_orientation=0.0)


@pytest.mark.long
def test_a_change_is_found_in_rows_of_another_kind(
    kuka: Robot, machine: sim.TrueMachine, of_positions: FittedRobot, of_poses: FittedRobot
) -> None:
    """An offset of a joint is named from poses after positions, and from positions after poses."""
    step = 3e-4 * np.eye(6)[2]
    later = sim.TrueMachine.of_arm(
        machine.nominal, placement_errors=machine.placement_errors, joint_offsets=machine.joint_offsets + step
    )
    for model, angle in ((of_positions, 1e-4), (of_poses, None)):
        found = pincal.diagnose(model, measured(kuka, later, 40, 12, angle))
        assert [(change.effect, change.joint) for change in found.changes] == [("joint_offset", "joint_3")]


def test_rows_of_another_kind_are_taken_in(
    kuka: Robot, machine: sim.TrueMachine, of_positions: FittedRobot, of_poses: FittedRobot
) -> None:
    """An update by poses of a model of positions, and the reverse, predicts no worse, and knows the robot better."""
    for model, angle in ((of_positions, 1e-4), (of_poses, None)):
        updated = pincal.update(model, measured(kuka, machine, 40, 13, angle))
        before, after = (np.diag(each.robot_estimate.dense_covariance()) for each in (model, updated))
        judged = validate_rows([updated], measured(kuka, machine, 40, 14, angle))

        assert np.all(after[before > 0.0] <= 1.01 * before[before > 0.0])
        assert not judged.doubt and judged.misfit.p_value > 1e-3


def test_positions_are_judged_by_a_model_of_poses(kuka: Robot, machine: sim.TrueMachine, of_poses: FittedRobot) -> None:
    """With their replicates, at the place of the calibration and anywhere else."""
    rows = measured(kuka, machine, 20, 15)
    again = measured(kuka, machine, 20, 15).select(np.tile(np.arange(20), 2))
    shifted = again.position + NOISE * np.random.default_rng(0).standard_normal((40, 3))
    for table in (rows, again.with_readings(position=shifted)):
        judged = validate_rows([of_poses], table)
        assert not judged.doubt and judged.error["mean_mm"] < 0.3
        judged.replicate_statistics()
    same_place = measured(kuka, machine, 20, 2)
    assert validate_rows([of_poses], same_place).replicate_statistics() == (None, None)


@pytest.mark.long
def test_the_commands_take_rows_of_another_kind(
    shared_cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Positions under a model of poses are validated, and poses leave a model of positions as it is."""
    folder = shared_cases / "tables"
    first = folder / "C1_validate_positions_with_pose_model"
    noise = ("--noise", "0.05mm", "--noise-angle", "0.1mrad")
    assert run("calibrate", "ur5", first / "poses.csv", *noise, "--out", tmp_path / "poses") == 0
    capsys.readouterr()
    assert run("validate", tmp_path / "poses" / "model.json", first / "positions.csv", "--json") == 0
    assert json.loads(capsys.readouterr().out)["mean_mm"] < 1.0

    second = folder / "C2_diagnose_poses_with_position_model"
    model = tmp_path / "positions" / "model.json"
    assert run("calibrate", "ur5", second / "positions.csv", "--noise", "0.05mm", "--out", tmp_path / "positions") == 0
    new = second / "poses.csv"
    assert run("diagnose", model, new, "--out", tmp_path / "found") == 0
    assert run("diagnose", model, new, "--noise-angle", "0.1mrad", "--out", tmp_path / "declared") == 0
    assert run("update", model, new, "--noise-angle", "0.1mrad", "--out", tmp_path / "updated") == 0
    assert run("validate", model, new, "--noise-angle", "0.1mrad") == 0


@pytest.mark.long
@pytest.mark.rates
@pytest.mark.parametrize("angle", [5e-5, 1e-4, 1e-3])
def test_machines_of_a_maker_are_left_alone(shared_data: Path, angle: float) -> None:
    """Of eleven machines with the deviations that their maker measured none is changed by being read as poses."""
    from fleet_cases import nominal_arm, real_machines

    alarms = list[str]()
    for k, (kind, name, true) in enumerate(real_machines()):
        robot = nominal_arm(kind)
        positions = calibrate(robot, measured(robot, true, 50, k), OPTIONS)
        options = Options(effects=GEOMETRIC, sigma=NOISE, sigma_orientation=angle)
        poses = calibrate(robot, measured(robot, true, 50, 200 + k, angle), options)
        checks = (positions, measured(robot, true, 40, 100 + k, angle)), (poses, measured(robot, true, 40, 300 + k))
        alarms += [name for model, table in checks if pincal.diagnose(model, table).changed]
    assert len(alarms) <= 1
