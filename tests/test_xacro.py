"""Robots written as xacro, in ROS packages, as their makers' communities publish them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from pincal.cli import main
from pincal.errors import PincalWarning, RobotFileError
from pincal.robot.packages import find_mesh, neighbouring_packages
from pincal.robot.robot import Robot

ARM = """<robot name="$(arg name)" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="name" default="arm"/>
  <xacro:arg name="long" default="0.5"/>
  <xacro:include filename="$(find parts)/urdf/joint.xacro"/>
  <link name="l0"/>
  <xacro:turn i="0" j="1" axis="0 0 1" z="0.2"/>
  <xacro:turn i="1" j="2" axis="0 1 0" z="$(arg long)"/>
</robot>"""
MACRO = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="turn" params="i j axis z">
    <link name="l${j}"><visual><geometry><mesh filename="package://parts/mesh/link.stl"/></geometry></visual></link>
    <joint name="j${j}" type="revolute"><parent link="l${i}"/><child link="l${j}"/><origin xyz="0 0 ${z}"/>
      <axis xyz="${axis}"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  </xacro:macro>
</robot>"""


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """Return an arm's xacro file in a workspace of two packages, one of them in a folder of another name."""
    for folder, name, file, text in (("arm", "arm", "arm.xacro", ARM), ("group/parts_v2", "parts", "joint.xacro", MACRO)):
        home = tmp_path / "src" / folder
        (home / "urdf").mkdir(parents=True)
        (home / "package.xml").write_text(f"<package><name> {name} </name></package>")
        (home / "urdf" / file).write_text(text)
    return tmp_path / "src" / "arm" / "urdf" / "arm.xacro"


def test_packages_are_found_around_the_file(workspace: Path) -> None:
    """Packages go by the name in their package.xml, wherever in the workspace they lie; so do the meshes in them."""
    found = neighbouring_packages(workspace)
    mesh = workspace.parents[2] / "group/parts_v2/mesh/link.stl"

    assert found == {"arm": workspace.parents[1], "parts": mesh.parents[1]}
    assert find_mesh("package://parts/mesh/link.stl", str(workspace)) is None
    mesh.parent.mkdir()
    mesh.write_bytes(b"")
    assert find_mesh("package://parts/mesh/link.stl", str(workspace)) == mesh
    assert find_mesh("package://[parts/mesh/link.stl", str(workspace)) is None


def test_a_xacro_file_is_the_robot_that_it_describes(workspace: Path) -> None:
    """Macros, includes by package, defaults and arguments are expanded; missing meshes do not matter."""
    short, long = Robot.from_urdf(workspace), Robot.from_urdf(workspace, xacro_args={"long": "0.9", "name": "other"})

    assert (short.name, long.name, short.joint_names) == ("arm", "other", ("j1", "j2"))
    for robot, height in ((short, 0.7), (long, 1.1)):
        np.testing.assert_allclose(robot.forward_kinematics(np.zeros((1, 2)))[0, :3, 3], [0.0, 0.0, height], atol=1e-12)


def test_includes_are_found_beside_the_file_that_has_them(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever the program runs, and whatever failed before; in an included file, they are beside that one."""
    beside = workspace.with_name("beside.xacro")
    beside.write_text(ARM.replace("$(find parts)/urdf/joint.xacro", "macros/all.xacro"))
    macros = workspace.parent / "macros"
    macros.mkdir()
    (macros / "all.xacro").write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="joint.xacro"/></robot>'
    )
    (macros / "joint.xacro").write_text("<robot")
    for folder in (workspace.parents[2], macros):
        (folder / "elsewhere").mkdir()
        monkeypatch.chdir(folder / "elsewhere")
        with pytest.raises(RobotFileError, match="xacro can't expand it"):
            Robot.from_urdf(beside)
    (macros / "joint.xacro").write_text(MACRO)

    found, whole = Robot.from_urdf(beside), Robot.from_urdf(workspace)
    assert found.joint_names == whole.joint_names == ("j1", "j2")
    monkeypatch.chdir(workspace.parent)
    assert Robot.from_urdf("beside.xacro").reach == found.reach == whole.reach


def test_what_is_wrong_with_a_xacro_file_is_said(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each failure names the file and the next step."""
    part = workspace.parents[2] / "group/parts_v2/urdf/joint.xacro"
    with pytest.raises(RobotFileError, match=r"joint\.xacro: expands to no link, as it only defines macros; expected the"):
        Robot.from_urdf(part)
    (part.parent / "user.xacro").write_bytes(b"<!-- in Latin-1: \xe9 --> joint.xacro")
    with pytest.raises(RobotFileError, match=r"joint\.xacro: .*expected user\.xacro"):
        Robot.from_urdf(part)
    with pytest.raises(RobotFileError, match=r"arm\.xacro: xacro can't expand it .*arguments, .*: name:=arm, long:=\$"):
        Robot.from_urdf(workspace, xacro_args={"long": "${1/0}"})
    with pytest.warns(PincalWarning, match="does not declare the xacro argument 'lang'; its arguments: long, name"):
        Robot.from_urdf(workspace, xacro_args={"lang": "0.9"})
    with pytest.raises(RobotFileError, match="not a xacro file"):
        Robot.from_urdf("ur10", xacro_args={"long": "1"})
    (part.parents[1] / "package.xml").unlink()
    needs = r"arm\.xacro: needs the ROS package 'missing', which was not found; .*ROS_PACKAGE_PATH=FOLDER"
    with pytest.raises(RobotFileError, match=needs):
        workspace.write_text(ARM.replace("find parts", "find missing"))
        Robot.from_urdf(workspace)
    monkeypatch.setitem(sys.modules, "xacrodoc", None)
    with pytest.raises(RobotFileError, match=r"pip install 'pincal\[xacro\]'"):
        Robot.from_urdf(workspace)


@pytest.mark.parametrize(("variable", "end"), [("ROS_PACKAGE_PATH", ""), ("AMENT_PREFIX_PATH", "share")])
def test_packages_elsewhere_are_found_where_ros_looks(
    workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str, end: str
) -> None:
    """The refusal of a missing package names the variable that makes it known; only what it says is tried."""
    elsewhere = tmp_path / "other" / end
    elsewhere.mkdir(parents=True)
    (workspace.parents[2] / "group").rename(elsewhere / "group")
    with pytest.raises(RobotFileError, match=f"needs the ROS package 'parts', .*{variable}") as refused:
        Robot.from_urdf(workspace)
    assert "class" not in str(refused.value)

    monkeypatch.setenv(variable, str(tmp_path / "other"))
    assert Robot.from_urdf(workspace).joint_names == ("j1", "j2")
    monkeypatch.delenv(variable)
    with pytest.raises(RobotFileError, match="needs the ROS package 'parts'"):
        Robot.from_urdf(workspace)


def test_every_verb_that_takes_a_robot_takes_a_xacro_file(
    workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Simulate, design and check read it with the same arguments."""
    table, poses = str(tmp_path / "t.csv"), str(tmp_path / "d.csv")
    for words, argument, code in (
        (["simulate", "--poses", "40", "--elastic", "0", "--no-floor", "--out", table], "long:=0.9", 0),
        (
            ["design", "--poses", "8", "--candidates", "20", "--model", "geometric", "--no-floor", "--out", poses],
            "long:=0.9",
            0,
        ),
        (["check", table, "--model", "geometric"], "long:=0.9", 0),
        (["check", table, "--model", "geometric"], "long=0.9", 2),
    ):
        with pytest.raises(SystemExit) as ended:
            main([words[0], str(workspace), *words[1:], "--xacro-arg", argument, "--quiet"])
        assert ended.value.code == code, capsys.readouterr().err
    assert "expected NAME:=VALUE" in capsys.readouterr().err


@pytest.mark.parametrize(
    "file",
    ["abb/abb_irb2400_support/urdf/irb2400", "abb/abb_irb5400_support/urdf/irb5400", "kuka/kuka_kr16_support/urdf/kr16_2"],
)
def test_published_xacro_is_the_published_urdf(published_robots: Path, file: str, rng: np.random.Generator) -> None:
    """Where a maker's community publishes both, the tip is the same by both."""
    written, expanded = (Robot.from_urdf(published_robots / f"{file}{ending}") for ending in (".urdf", ".xacro"))
    q = written.random_configurations(10, rng)

    assert written.joint_names == expanded.joint_names
    np.testing.assert_allclose(expanded.forward_kinematics(q), written.forward_kinematics(q), atol=1e-9)


def test_the_universal_robot_has_the_lengths_of_its_kinematics_file(published_robots: Path) -> None:
    """Stretched out at q = 0, a UR5e reaches as far as its default_kinematics.yaml says."""
    robot = Robot.from_urdf(published_robots / "ur_description/urdf/ur.urdf.xacro", xacro_args={"ur_type": "ur5e"})
    tip = robot.forward_kinematics(np.zeros((1, 6)))[0]

    np.testing.assert_allclose(np.abs(tip[:3, 3]), [0.425 + 0.3922, 0.1333 + 0.0996, 0.1625 - 0.0997], atol=1e-9)
