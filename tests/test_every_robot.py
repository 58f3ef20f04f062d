"""Every robot at hand, with what its makers publish and no more: simulated with compliances, calibrated with defaults."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import run
from test_robot import ARMS

from pincal import Robot

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")]

PUBLISHED = {
    "abb/abb_irb2400_support/urdf/irb2400.urdf": (),
    "abb/abb_irb2400_support/urdf/irb2400_12_155.xacro": (),
    "abb/abb_irb5400_support/urdf/irb5400.urdf": (),
    "kuka/kuka_kr16_support/urdf/kr16_2.urdf": (),
    "kuka/kuka_kr10_support/urdf/kr10r1420.xacro": (),
    "fanuc/fanuc_m10ia_support/urdf/m10ia.xacro": (),
    "fanuc/fanuc_m10ia_support/urdf/m10ia7l.xacro": (),
    "fanuc/fanuc_lrmate200id_support/urdf/lrmate200id.xacro": (),
    "ur_description/urdf/ur.urdf.xacro": ("--xacro-arg", "name:=ur", "--xacro-arg", "ur_type:=ur5e"),
}
NOISE_M = 5e-5
# One of each kind before each commit: six and seven joints, few joints, sliding ones, a torso, arms of humanoids, files with
# and without masses, of URDF and of xacro. All of them before a release.
OF_EACH_KIND = {
    *("ur5", "panda", "so101", "bravo7_gripper", "finger_edu", "tiago_dual", "talos"),
    "abb/abb_irb2400_support/urdf/irb2400.urdf",
    "fanuc/fanuc_lrmate200id_support/urdf/lrmate200id.xacro",
    "ur_description/urdf/ur.urdf.xacro",
}
# Few joints, many and a torso, sliding ones: those whose reports have their figures drawn.
DRAWN = {"so101", "talos", "bravo7_gripper"}
# Held-out rms over the noise that is as good as the noise: 37 rows a joint tell its parameters so well.
GOOD, POSES_A_JOINT = 1.15, 50


def of_each_kind(cases: Iterable[Any]) -> Iterator[Any]:
    """Yield cases, marked as those of a release unless their robot is one for its kind."""
    for case in cases:
        values, name = getattr(case, "values", (case,)), getattr(case, "id", None)
        marks = () if values[0] in OF_EACH_KIND else pytest.mark.products
        yield pytest.param(*values, id=name, marks=marks)


def calibrated(robot: object, options: tuple[str, ...], folder: Path, *, joints: int = 6) -> dict:
    """Simulate poses of a robot, at least 300, check and calibrate them with defaults, and return the result."""
    table, noise = folder / "table.csv", ("--noise", "0.05mm")
    poses = max(300, POSES_A_JOINT * joints)
    assert run("simulate", robot, "--poses", poses, "--no-floor", *noise, "--out", table, *options) == 0
    assert run("check", robot, table, *noise, "--quiet", *options) == 0
    assert run("calibrate", robot, table, *noise, "--out", folder / "found", "--split", "random", "--quiet", *options) == 0
    return json.loads((folder / "found" / "result.json").read_text(encoding="utf-8"))


def check_held_out(result: dict) -> None:
    """Hold the error on held-out poses, drawn at random, against the noise of three coordinates."""
    before, after = (result["error"][model]["test"]["rms_mm"] * 1e-3 for model in ("nominal", "calibrated"))
    assert after <= GOOD * NOISE_M * 3**0.5 < before


@pytest.mark.parametrize("path", list(of_each_kind(PUBLISHED)))
def test_published_robots_are_calibrated_with_defaults(published_robots: Path, path: str, tmp_path: Path) -> None:
    """As they are published, most without masses: held-out poses are predicted as well as the noise allows."""
    check_held_out(calibrated(published_robots / path, PUBLISHED[path], tmp_path))


@pytest.mark.parametrize(("name", "tip", "base"), list(of_each_kind(ARMS)))
def test_arms_of_example_robot_data_are_calibrated_with_defaults(
    name: str, tip: str | None, base: str | None, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Six and seven joints, sliding ones, arms of humanoids: likewise."""
    if name in DRAWN:
        request.getfixturevalue("drawn")
    options = (*(("--tip", tip) if tip else ()), *(("--base", base) if base else ()))
    joints = Robot.from_urdf(name, tip=tip, base=base).n_joints
    check_held_out(calibrated(name, options, tmp_path, joints=joints))
