"""Zeros, signs and couplings that differ from the URDF are found and named; predictions and commands are as reported."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from machines import kuka as true_kuka
from placed_arms import measured, written
from zeros_study import ARMS, CASES, corrections, drawn, is_named, tried

from pincal.builtin import kuka_urdf_path
from pincal.calibration.calibration import run_calibration
from pincal.calibration.checked_fit import calibrate
from pincal.calibration.fitted_robot import load_model
from pincal.compensate.compensation import compensate_program
from pincal.errors import BadInputError, MeasurementError
from pincal.export import export_model
from pincal.identify.options import Options
from pincal.measure.admit import check_table
from pincal.measure.measurements import Measurements
from pincal.model.effects import GEOMETRIC
from pincal.robot.mastering import remastered
from pincal.robot.robot import Robot
from pincal.robot.tree import Coupling
from pincal.validate.cures import descriptions

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
PLAIN = Options(effects=GEOMETRIC)


@pytest.fixture(scope="module")
def table(kuka: Robot) -> Measurements:
    """Return what a tracker reads of a machine with errors of a millimetre and a milliradian, as the URDF has it."""
    machine = true_kuka().draw_errors(np.random.default_rng(4), sigma_length=1e-3, sigma_angle=1e-3)
    return measured(machine, kuka, poses=70, turn=0.9)


@pytest.mark.long
@pytest.mark.parametrize("turn", [0, pytest.param(1, marks=pytest.mark.rates)])
# Two arms have all that may differ between them; the others before a release.
@pytest.mark.parametrize(
    "name",
    ["KR 125", "SO-101", *(pytest.param(name, marks=pytest.mark.rates) for name in ("KR 16", "IRB 2400") if name in ARMS)],
)
def test_what_differs_from_the_urdf_is_found_and_named(name: str, turn: int) -> None:
    """Of each robot and each thing that may differ, by turns; a sound table is given none of it. The study draws ten."""
    first = (list(ARMS).index(name) + turn) % 2
    for seed, case in list(enumerate(CASES))[first::2]:
        named, ratio, _, said = tried(ARMS[name], case, seed)
        assert named, said
        assert ratio < 1.05
    assert not corrections(run_calibration(*drawn(ARMS[name], 100)))


def test_sound_tables_pay_nothing(table: Measurements, kuka: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is searched for, and nothing said."""
    monkeypatch.setattr("pincal.validate.trials.zero_shifts", None)

    assert not corrections(run_calibration(kuka, table, PLAIN))


def test_another_zero_and_sign_describe_the_same_arm(kuka: Robot) -> None:
    """Frames, limits and centres of mass move with the zero; the arm stays where it is."""
    q = kuka.random_configurations(5, np.random.default_rng(0))
    other = remastered(kuka, shifts={"joint_3": 1.3}, turned=["joint_2"])
    reported = q * [1, -1, 1, 1, 1, 1] - [0, 0, 1.3, 0, 0, 0]
    centres = [
        robot.forward_kinematics(at) @ np.linalg.inv(robot.frames.T_last_tip) @ [*robot.centres[-1], 1.0]
        for robot, at in ((kuka, q), (other, reported))
    ]

    np.testing.assert_allclose(other.forward_kinematics(reported), kuka.forward_kinematics(q), atol=1e-12)
    np.testing.assert_allclose(*centres, atol=1e-12)
    assert (other.lower[1], other.upper[1]) == (-kuka.upper[1], -kuka.lower[1])
    again = Robot.from_urdf(other.urdf, tip="tool0")
    np.testing.assert_allclose(again.lower, [*kuka.lower[:1], -kuka.upper[1], *kuka.lower[2:]])


@pytest.mark.long
def test_unknown_zeros_have_no_prior(table: Measurements, kuka: Robot) -> None:
    """All of them or some; joints by names that the robot has."""
    off = replace(table, q=table.q - np.deg2rad([0, 1.5, 0, -1.5, 0, 0]))
    held, free = (run_calibration(kuka, off, replace(PLAIN, zeros=zeros)).fit for zeros in ((), ("joint_[24]",)))

    assert free.estimate["joint_2.theta"] == pytest.approx(np.deg2rad(1.5), abs=5e-3)
    assert abs(held.estimate["joint_2.theta"]) < abs(free.estimate["joint_2.theta"])
    far = replace(table, q=table.q - np.deg2rad([7, 0, -10, 0, 0, 8]))
    found = run_calibration(kuka, far, replace(PLAIN, zeros=("*",)))
    assert len(corrections(found)) == 1 and is_named("joint_3 is shifted by -10", corrections(found))
    with pytest.raises(BadInputError, match=r"unknown joint, 'joint_9'.*joint_1"):
        run_calibration(kuka, off, replace(PLAIN, zeros=("joint_9",)))


def test_a_coupling_is_undone_wherever_joints_go_in_and_out(table: Measurements, kuka: Robot, tmp_path: Path) -> None:
    """In predictions, commands, files and formulas; the model's own joints are the URDF's."""
    coupled = kuka.with_couplings("joint_3=-joint_2", Coupling("joint_6", "joint_5", 1 / 3))
    reported = coupled.as_reported(table.q)
    one, other = (calibrate(robot, replace(table, q=q), PLAIN) for robot, q in ((kuka, table.q), (coupled, reported)))
    other.save(tmp_path / "model.json")
    loaded = load_model(tmp_path / "model.json")
    at, of_urdf = reported[:5], table.q[:5]
    np.testing.assert_allclose(coupled.from_reported(reported), table.q, atol=1e-12)
    for model in (other, loaded):
        np.testing.assert_allclose(model.predict(at), one.predict(of_urdf), atol=2e-6)

    program = loaded.conditions_at(at)
    commands = compensate_program(loaded, program)
    plain = compensate_program(load_model_of(one, tmp_path), loaded.conditions_at(at))
    np.testing.assert_allclose(coupled.from_reported(commands.q), plain.q, atol=1e-5)
    assert commands.is_ok.all()

    names: dict = {}
    exec(export_model(loaded, "python").text, names)
    np.testing.assert_allclose(names["forward"](at), loaded.predict(at), atol=1e-9)
    wanted = loaded.predict(at)
    joints, reached = names["compensate"](wanted, at + 1e-3)
    assert reached.all()
    np.testing.assert_allclose(loaded.predict(joints), wanted, atol=1e-7)


def test_a_coupled_robot_may_differ_in_another_way(table: Measurements, kuka: Robot) -> None:
    """Its two joints aren't coupled once more, the other way: from that no positions would follow."""
    coupled = kuka.with_couplings("joint_3=+joint_2")
    tried = [cure.correction.couplings for cure in descriptions(coupled, table) if cure.correction is not None]
    pairs = {frozenset((one.joint, one.source)) for couplings in tried for one in couplings}
    assert len(pairs) >= 3 and frozenset(("joint_2", "joint_3")) not in pairs


def load_model_of(fit, folder: Path):
    """Return a fit as its file has it."""
    fit.save(folder / "plain.json")
    return load_model(folder / "plain.json")


@pytest.mark.long
def test_what_is_stated_is_taken(table: Measurements, kuka: Robot, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """--coupling, --sign and --zeros; without them the default says what it found, and goes on."""
    q = table.q * [1, 1, 1, -1, 1, 1]
    q[:, 2] -= q[:, 1]
    file = written(tmp_path / "both.csv", replace(table, q=q))
    command = ("calibrate", kuka_urdf_path(), file, "--model", "geometric", "--out", tmp_path / "out", "--json")
    assert run(*command, "--coupling", "joint_3=+joint_2", "--sign", "joint_4", "--zeros", "unknown") == 0
    stated = json.loads(capsys.readouterr().out)
    assert stated["error"]["nominal"]["train"]["mean_mm"] < 20.0

    turned = written(tmp_path / "turned.csv", replace(table, q=table.q * [1, 1, 1, -1, 1, 1]))
    assert run("calibrate", kuka_urdf_path(), turned, "--model", "geometric", "--out", tmp_path / "other") == 0
    assert "joint_4 counts in the opposite sense" in capsys.readouterr().out
    for wrong in (
        ("--zeros", "known"),
        ("--coupling", "joint_3=joint_3"),
        ("--coupling", "joint_3=joint_9"),
        ("--sign", "J"),
    ):
        assert run(*command, *wrong) == 3
        assert "expected" in capsys.readouterr().err


@pytest.mark.long
def test_a_coupled_joint_may_report_more_than_its_limits(table: Measurements, kuka: Robot) -> None:
    """It is not taken for degrees or for a swapped column, if all rows are within the limits together with its neighbour."""
    narrow = replace(kuka, lower=table.q.min(axis=0) - 0.01, upper=table.q.max(axis=0) + 0.01)
    narrow.upper[2], narrow.lower[2] = 0.5, -0.5
    q = table.q.copy()
    q[:, 2] *= 0.49 / np.abs(q[:, 2]).max()
    q[:, 2] -= q[:, 1]

    check_table(narrow, replace(table, q=q))
    with pytest.raises(MeasurementError, match=r"looks like degrees|swapped"):
        check_table(narrow, replace(table, q=table.q * [1, 1, 9, 1, 1, 1]))


@pytest.mark.long
def test_a_table_of_another_order_is_still_refused(table: Measurements, kuka: Robot) -> None:
    """No zeros, signs or couplings make up for swapped columns, late rows or shuffled ones."""
    for q in (table.q[:, [0, 2, 1, 3, 4, 5]], np.roll(table.q, 1, axis=0), table.q[::-1]):
        with pytest.raises(MeasurementError):
            run_calibration(kuka, replace(table, q=q), PLAIN)
