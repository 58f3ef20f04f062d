"""What readings say of a robot adds up: from tables that never meet, by files of some kilobytes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from placed_arms import measured
from scipy.spatial.transform import Rotation

import pincal
from pincal import GEOMETRIC, BadInputError, FittedRobot, Options, Robot, calibrate, load_information
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.information import RobotInformation
from pincal.errors import ModelFileError

NOISE = 5e-5  # [m]


@pytest.fixture(scope="module")
def fits() -> tuple[FittedRobot, FittedRobot, FittedRobot]:
    """Return the fits of two tables of one machine, the instrument elsewhere in the second, and the joint one."""
    robot = Robot.from_urdf(kuka_urdf_path(), tip="tool0")
    rng = np.random.default_rng(5)
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_errors(rng, sigma_length=5e-4, sigma_angle=5e-4)
    away = np.eye(4)
    away[:3, 3] = [1.0, 2.0, 0.3]
    one = measured(machine, robot, seed=1, poses=60)
    other = measured(machine, robot, seed=2, poses=40, T_instrument_base=away)
    options = Options(effects=GEOMETRIC, sigma=NOISE)
    return calibrate(robot, one, options), calibrate(robot, other, options), calibrate(robot, [one, other], options)


def test_the_sum_of_two_files_is_the_joint_fit(fits: tuple[FittedRobot, FittedRobot, FittedRobot], tmp_path: Path) -> None:
    """Values within what linearising elsewhere moves, a tenth of a standard deviation, which agree to one per cent."""
    paths = [tmp_path / "one.json", tmp_path / "other.json"]
    for fit, path in zip(fits, paths, strict=False):
        fit.information.save(path)
    found, joint = load_information(paths).estimate(), fits[2].estimate
    names = [name for name in found.names if joint.take([name]).free.all()]
    mine, theirs = found.take(names), joint.take(names)

    assert len(names) >= 25 and set(names) == set(found.names)
    assert all(path.stat().st_size < 40_000 for path in paths)
    np.testing.assert_allclose(mine.sigma, theirs.sigma, rtol=0.01)
    assert np.abs((mine.values - theirs.values) / theirs.sigma).max() < 0.1


def test_a_file_comes_back_to_the_last_digit(fits: tuple[FittedRobot, FittedRobot, FittedRobot], tmp_path: Path) -> None:
    """And one table alone with its priors is its own fit."""
    information = fits[0].information
    information.save(tmp_path / "one.json")
    again = load_information(tmp_path / "one.json")

    np.testing.assert_array_equal(again.form.H, information.form.H)
    np.testing.assert_array_equal(again.form.g, information.form.g)
    assert again.parameters == information.parameters and again.form.square == information.form.square
    own = fits[0].estimate.take(again.estimate().names)
    np.testing.assert_allclose(again.estimate().values, own.values, atol=1e-3 * own.sigma.max())


def test_what_is_not_of_one_robot_is_refused(fits: tuple[FittedRobot, FittedRobot, FittedRobot], tmp_path: Path) -> None:
    """Another arm, no file, and files that hold something else."""
    text = kuka_urdf_path().read_text().replace('xyz="0.41 0 0.865"', 'xyz="0.411 0 0.865"')
    (tmp_path / "longer.urdf").write_text(text)
    arm = Robot.from_urdf(tmp_path / "longer.urdf", tip="tool0")
    machine = sim.TrueMachine.from_urdf(tmp_path / "longer.urdf", tip="tool0")
    other = calibrate(arm, measured(machine, arm, seed=3, poses=40), Options(effects=GEOMETRIC, sigma=NOISE))
    with pytest.raises(BadInputError, match="nominal geometries differ"):
        fits[0].information + other.information
    with pytest.raises(BadInputError, match="one or more"):
        load_information([])
    path = tmp_path / "one.json"
    fits[0].information.save(path)
    content = json.loads(path.read_text())
    for change, words in (({"g": [1.0]}, "g"), ({"robot": None}, "robot"), ({"format": "else"}, "format")):
        path.write_text(json.dumps(content | change))
        with pytest.raises(ModelFileError, match=words):
            load_information(path)


def test_it_is_public() -> None:
    """From the package itself."""
    assert RobotInformation.__name__ == "RobotInformation"


# Link by link: parent, kind, where the joint is along x and z, and which way its axis points.
_SCARA = (
    ("base", "revolute", 0.0, 0.2, 1),
    ("s1", "revolute", 0.3, 0.0, 1),
    ("s2", "prismatic", 0.25, 0.0, -1),
    ("s3", "revolute", 0.0, 0.0, -1),
)


def _joint(number: int, of: tuple[str, str, float, float, int]) -> str:
    parent, kind, x, z, way = of
    return (
        f"<link name='s{number}'/><joint name='j{number}' type='{kind}'><parent link='{parent}'/><child link='s{number}'/>"
        f"<origin xyz='{x} 0 {z}'/><axis xyz='0 0 {way}'/><limit lower='-3.1' upper='3.1' effort='9' velocity='9'/></joint>"
    )


@pytest.mark.long
def test_parallel_axes_leave_a_file(tmp_path: Path) -> None:
    """What a SCARA's readings say of lengths along its axes is rounding, and may come out as less than nothing."""
    (tmp_path / "scara.urdf").write_text(
        f"<robot name='scara'><link name='base'/>{''.join(map(_joint, (1, 2, 3, 4), _SCARA))}</robot>"
    )
    robot = Robot.from_urdf(tmp_path / "scara.urdf")
    for seed in range(4):
        rng = np.random.default_rng(seed)
        q = rng.uniform([-2.0, -2.0, 0.0, -3.0], [2.0, 2.0, 0.2, 3.0], (40, 4))
        first, second, last = np.cumsum(q[:, [0, 1, 3]] * [1.0, 1.0, -1.0], axis=1).T
        arm = 0.3 * np.exp(1j * first) + 0.25 * np.exp(1j * second) + 0.05 * np.exp(1j * last)
        seen = np.column_stack([arm.real, arm.imag, 0.2 - q[:, 2]]) @ Rotation.random(rng=rng).as_matrix() + [2.0, 1.0, 0.5]
        table = pincal.measurements_from_arrays(robot.joint_names, q, position=seen + rng.normal(0.0, 2e-5, seen.shape))
        fit = calibrate(robot, table, Options(sigma=2e-5))
        fit.save(tmp_path / "model.json")
        assert np.all(np.diag(fit.information.H) >= 0.0) and pincal.load_model(tmp_path / "model.json")
