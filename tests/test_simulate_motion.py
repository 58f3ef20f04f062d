"""``pincal simulate --path``: what is logged of an arm that moves is what the truth says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run

from pincal.builtin import kuka_urdf_path
from pincal.motion.joint_path import JointPath
from pincal.motion.moving_arm import MovingArm
from pincal.robot.robot import Robot
from pincal.simulate.moving import FourierPath
from pincal.simulate.session import Clock

URDF = str(kuka_urdf_path())
JOINTS = tuple(f"joint_{i}" for i in range(1, 7))
EXACT = ["--errors", "0", "--elastic", "0", "--noise", "0mm", "--imu-noise", "0mg,0deg/s", "--vibration", "0"]


def session(folder: Path, *arguments: str, name: str = "day") -> tuple[dict[str, dict[str, np.ndarray]], dict[str, Any]]:
    """Run the command for a path of ten seconds; return the columns of its tables and the truth."""
    given = ["--path", "10s", "--out", folder / name, "--truth", folder / f"{name}.json", "--quiet", *arguments]
    assert run("simulate", URDF, *given) == 0
    tables = {}
    for path in (folder / name).glob("*.csv"):
        header, *rows = path.read_text().splitlines()
        cells = np.array([row.split(",") for row in rows], float).T
        tables[path.stem] = dict(zip(header.split(","), cells, strict=True))
    return tables, json.loads((folder / f"{name}.json").read_text())


def driven(truth: dict[str, Any]) -> FourierPath:
    return FourierPath(*(np.array(truth["path"][name]) for name in ("centre", "rates", "sines", "cosines")))


def clock(truth: dict[str, Any], name: str) -> Clock:
    return Clock(**truth["clocks"][name])


def test_logs_are_of_the_path_by_their_clocks(tmp_path: Path) -> None:
    """Rounded joints, positions that the nominal arm has at the tracker's time, and the readings of an ideal IMU."""
    tables, truth = session(tmp_path, "--imu", "--sensor", "position", "--clock-drift", "800", *EXACT)
    path, joints, tracker, imu = driven(truth), tables["joints"], tables["tracker"], tables["imu"]
    q = np.column_stack([joints[name] for name in JOINTS])
    assert np.abs(q - path.at(joints["time"])).max() == pytest.approx(0.5 * truth["resolution"], rel=0.01)

    robot, at = Robot.from_urdf(URDF), clock(truth, "tracker").to_joints(tracker["time"])
    (target,) = truth["targets"].values()
    seen = np.array(truth["T_instrument_base"]) @ robot.forward_kinematics(path.at(at[::50])) @ np.array(target)
    np.testing.assert_allclose(np.column_stack([tracker[axis] for axis in "xyz"])[::50], seen[:, :3, 3], atol=1e-9)
    assert truth["clocks"]["tracker"]["drift"] == truth["clocks"]["imu"]["drift"] == pytest.approx(8e-4)

    fine = np.arange(-4.0, 14.0, 1.0 / 400.0)
    arm = MovingArm(robot, JointPath.through(fine, path.at(fine), knots_per_second=32.0))
    own = truth["imu"]
    R, lever = np.array(own["mount"])[:3, :3], np.array(own["mount"])[:3, 3]
    ideal = arm.ideal(clock(truth, "imu").to_joints(imu["time"]))
    force = ideal.force + np.cross(ideal.turning, lever) + np.cross(ideal.rate, np.cross(ideal.rate, lever))
    later = arm.ideal(clock(truth, "imu").to_joints(imu["time"]) + own["delay"]).rate
    for letter, values, matrix, bias in (("a", force, "acc_matrix", "acc_bias"), ("w", later, "gyro_matrix", "gyro_bias")):
        expected = values @ R @ np.array(own[matrix]).T + own[bias]
        np.testing.assert_allclose(np.column_stack([imu[letter + axis] for axis in "xyz"]), expected, rtol=0.0, atol=1e-4)


def test_cameras_take_thirty_images_a_second(tmp_path: Path) -> None:
    """As cameras do; a tracker is read 250 times."""
    for sensor, rate in (("fixed_camera_pixel", 30.0), ("position", 250.0)):
        given = [
            "--path",
            "5s",
            "--sensor",
            sensor,
            "--out",
            tmp_path / sensor,
            "--truth",
            tmp_path / "truth.json",
            "--quiet",
        ]
        assert run("simulate", URDF, *given) == 0
        assert json.loads((tmp_path / "truth.json").read_text())["rates_hz"]["tracker"] == rate


@pytest.mark.long
def test_the_same_seed_drives_the_same_path(tmp_path: Path) -> None:
    """Byte for byte; another pose seed drives the same machine along another path, with the same IMU."""
    (_, one), _, (_, other) = (
        session(tmp_path, "--imu", "--elastic", "0", "--pose-seed", seed, name=name)
        for name, seed in (("a", "1"), ("b", "1"), ("c", "2"))
    )
    a, b, c = ((tmp_path / name / "imu.csv").read_bytes() for name in "abc")

    assert a == b != c and one["path"] != other["path"]
    assert one["imu"] == other["imu"] and one["geometry"] == other["geometry"] and "tracker" not in one["clocks"]


def test_effects_of_motion_are_in_the_truth(tmp_path: Path) -> None:
    """A lag moves the tracker's target; the truth says by how much."""
    effect = ["--effect", "joint_lag:joint_1:size=2e-3", "--effect", "friction_windup:joint_2:size=1e-4"]
    with_lag, truth = session(tmp_path, *effect, *EXACT)
    without, _ = session(tmp_path, *EXACT, name="plain")
    lag, friction = truth["effects"]
    moved = np.linalg.norm([with_lag["tracker"][axis] - without["tracker"][axis] for axis in "xyz"], axis=0)

    assert set(with_lag) == {"joints", "tracker"}
    assert (lag["effect"], friction["effect"]) == ("joint_lag", "friction_windup")
    together = np.hypot(lag["moves_target_rms_mm"], friction["moves_target_rms_mm"])
    assert 1e3 * np.sqrt(np.mean(moved**2)) == pytest.approx(together, rel=0.2) and together > 0.3


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--poses", "5", "--imu", "--out", "t.csv"], 2, "--imu is for an arm in motion; add --path"),
        (["--path", "10s", "--out", "t.csv"], 3, "a folder is written"),
        (["--poses", "5", "--out", "t"], 3, "end the name in .csv"),
        (["--path", "10s", "--sockets", "3", "--out", "t"], 2, "not by socket"),
        (["--path", "10s", "--poses", "3", "--out", "t"], 2, "--poses is for poses at rest"),
        (["--path", "10s", "--imu", "--imu-noise", "1mg", "--out", "t"], 2, "such as 1mg,0.01deg/s"),
        (["--path", "10s", "--log-rates", "150,0,250", "--out", "t"], 2, "rates of joints, IMU and tracker"),
        (["--path", "10s", "--effect", "settling:joint_1", "--out", "t"], 3, "settling: depends on a sequence"),
    ],
)
def test_what_does_not_go_together_is_refused(
    arguments: list[str],
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With the words that say what to change; nothing is written."""
    monkeypatch.chdir(tmp_path)

    assert run("simulate", URDF, *arguments) == code
    assert said in capsys.readouterr().err and not any(tmp_path.rglob("*.csv"))
