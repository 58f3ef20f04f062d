"""Robots of one cell that come with a URDF each: as one tree, against Pinocchio on each alone, and through the commands."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from xml.etree import ElementTree

import click
import numpy as np
import pinocchio as pin
import polars as pl
import pytest

from pincal import Options, Robot, measurements_from_arrays
from pincal.calibration.located import located
from pincal.cli import main
from pincal.cli.inputs import load_tables
from pincal.cli.quantities import beside
from pincal.errors import RobotFileError
from pincal.measure.table import stations_of
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.robot.arm_of_tree import TreeRequest
from pincal.robot.cell import NOWHERE, Beside, read_cell
from pincal.robot.packages import find_mesh
from pincal.robot.se3 import rotation_of_rpy, transform
from pincal.robot.urdf_file import find_file, parse_urdf
from pincal.sensors.setup import Setup

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

PLACE = (1.3, 0.2, -0.1, 0.2, -0.3, 2.9)
T_PLACE = transform(rotation_of_rpy(np.array(PLACE[3:])), np.array(PLACE[:3]))
# Files of two robots whose names clash, and of two whose names do not.
PAIRS = [("ur5", "ur10", "tool0", "tool0", "right_"), ("ur5", "panda", "tool0", "panda_link8", "")]


def run(command: str) -> None:
    """Run a command of pincal that does what it is asked to."""
    with pytest.raises(SystemExit) as ended:
        main([*shlex.split(command), "--quiet"])
    assert not ended.value.code, command


def cell_of(first: str, second: str, tips: tuple[str, str], place: tuple[float, ...] | None = PLACE) -> Robot:
    tree = read_cell(first, [Beside(second, "right", place)])
    return Robot.from_tree(tree, TreeRequest(tips[0], paths=[(tree.root, tips[1])]))


@pytest.mark.parametrize(("first", "second", "tip", "other", "prefix"), PAIRS)
def test_each_robot_of_a_cell_is_what_it_is_alone(
    first: str, second: str, tip: str, other: str, prefix: str, rng: np.random.Generator
) -> None:
    """Hands and gravity of each, where it stands, are those of Pinocchio's model of its own file."""
    robot = cell_of(first, second, (tip, prefix + other))
    q = robot.random_configurations(5, rng)
    moments = Model(Chain.of(robot), ()).static_moments(np.zeros(0), Conditions.at(q))[:, 2::3]
    for name, end, ahead, T in ((first, tip, "", np.eye(4)), (second, other, prefix, T_PLACE)):
        model = pin.buildModelFromUrdf(str(find_file(name)))
        model.gravity.linear = T[:3, :3].T @ model.gravity.linear
        data, frame = model.createData(), model.getFrameId(end)
        hands = robot.forward_kinematics(q, robot.between(robot.base, ahead + end))
        mine = [joint for joint in model.names if ahead + joint in robot.joint_names]
        places = [robot.joint_names.index(ahead + joint) for joint in mine]
        for row, hand, moment in zip(q, hands, moments, strict=True):
            alone = pin.neutral(model)
            for joint, k in zip(mine, places, strict=True):
                alone[model.joints[model.getJointId(joint)].idx_q] = row[k]
            pin.framesForwardKinematics(model, data, alone)
            np.testing.assert_allclose(hand, T @ data.oMf[frame].homogeneous, atol=1e-12)
            expected = pin.computeGeneralizedGravity(model, data, alone)
            there = [model.joints[model.getJointId(joint)].idx_v for joint in mine]
            np.testing.assert_allclose(moment[places], -expected[there], atol=1e-10)


def test_names_get_a_prefix_only_where_two_robots_have_the_same() -> None:
    """All of them then, as a note says, in one URDF that is read again."""
    alike, different = (read_cell("ur5", [Beside(name, "right", PLACE)]) for name in ("ur10", "panda"))

    assert any("right_base" in note for note in alike.notes)
    assert {"tool0", "right_tool0", "right_shoulder_link"} <= set(alike.links)
    assert {"tool0", "panda_link8"} <= set(different.links) and not different.notes
    assert parse_urdf(alike.text).links == alike.links
    three = read_cell("ur5", [Beside("ur10", "right", PLACE), Beside("ur10", "left", NOWHERE)])
    assert {"tool0", "right_tool0", "left_tool0"} <= set(three.links)


def test_a_robot_without_a_place_or_a_name_of_its_own_is_refused() -> None:
    """With what to do."""
    with pytest.raises(RobotFileError, match=r"its placement relative to .* is unknown.*--beside right=ur10@"):
        read_cell("ur5", [Beside("ur10", "right")])
    with pytest.raises(RobotFileError, match="is already a name of another robot; expected a name other than right"):
        read_cell("ur5", [Beside("ur10", "right", PLACE), Beside("ur10", "right", PLACE)])


def test_the_command_line_says_who_stands_where() -> None:
    """With units or without, a name or that of the file, a place or none."""
    place = (1.5, 0.0, 0.0, 0.0, 0.0, pytest.approx(np.pi))
    for text, name, source, at in (
        ("right=ur10.urdf@1500mm,0,0,0,0,180deg", "right", "ur10.urdf", place),
        ("cells/my-arm.v2.urdf@1.5,0,0,0,0,3.141592653589793", "my_arm_v2", "cells/my-arm.v2.urdf", place),
        ("right=ur10", "right", "ur10", None),
    ):
        found = beside(text)
        assert (found.name, found.source, found.place) == (name, source, at)
    for text in ("ur10@1,2", "=ur10", "right=", "a b=ur10", "ur10@1,2,3,4,5,6,7", "ur10@1,2,3,4,5,x"):
        with pytest.raises(click.BadParameter):
            beside(text)


def test_meshes_of_each_robot_are_found_beside_its_own_file(tmp_path: Path) -> None:
    """Files of one name, each in the folder of its robot, and materials of one name."""
    visual = '<visual><geometry><mesh filename="meshes/arm.stl"/></geometry><material name="grey"/></visual>'
    joint = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>'
    text = f'<robot name="r"><material name="grey"/><link name="a"/><link name="b">{visual}</link>{joint}</robot>'
    for name in ("one", "two"):
        (tmp_path / name / "meshes").mkdir(parents=True)
        (tmp_path / name / "meshes" / "arm.stl").touch()
        (tmp_path / name / "r.urdf").write_text(text)
    tree = read_cell(tmp_path / "one" / "r.urdf", [Beside(str(tmp_path / "two" / "r.urdf"), "other", PLACE)])
    root = ElementTree.fromstring(tree.text)
    found = [find_mesh(mesh.get("filename", ""), tree.source) for mesh in root.iter("mesh")]

    assert [path and path.parts[-3] for path in found] == ["one", "two"]
    assert [material.get("name") for material in root.iterfind("material")] == ["grey", "other_grey"]
    assert [material.get("name") for material in root.iter("material")].count("other_grey") == 2


def test_where_a_robot_stands_is_found_from_what_one_instrument_saw_of_both(rng: np.random.Generator) -> None:
    """Without errors and noise to rounding, wherever the instrument stood."""
    robot, unknown = (cell_of("ur5", "ur10", ("tool0", "right_tool0"), place) for place in (PLACE, NOWHERE))
    q = robot.random_configurations(40, rng)
    tips = np.array(["tool0", "right_tool0"] * 20)
    T_instrument = transform(rotation_of_rpy(np.array([0.3, 1.0, -2.0])), np.array([2.0, 1.0, -0.5]))
    places = [
        robot.forward_kinematics(row[None], robot.between(robot.base, tip))[0] for row, tip in zip(q, tips, strict=True)
    ]
    seen = (T_instrument @ np.array(places) @ np.array([0.02, 0.03, 0.1, 1.0]))[:, :3]
    links = {"from_link": np.repeat(robot.base, 40), "to_link": tips}
    tables = stations_of([("hall", measurements_from_arrays(robot.joint_names, q, position=seen, **links))])

    (found,) = located(unknown, [Beside("ur10", "right")], tables, Options())
    assert found.place is not None
    np.testing.assert_allclose(found.place, PLACE, atol=1e-9)
    # What two instruments saw says nothing of it.
    apart = {name: table for name, table in stations_of([("left", tables["hall:tool0"])]).items()}
    assert located(unknown, [Beside("ur10", "right")], apart, Options())[0].place is None


def test_tables_of_one_station_are_of_one_instrument(tmp_path: Path, rng: np.random.Generator) -> None:
    """Two tables, each with the joints of its robot alone, and the same name in their column station."""
    robot = cell_of("ur5", "ur10", ("tool0", "right_tool0"))
    files = [tmp_path / "left.csv", tmp_path / "right.csv"]
    for path, tip in zip(files, ("tool0", "right_tool0"), strict=True):
        q = robot.random_configurations(30, rng)
        names = robot.joints_between(robot.base, tip)
        hands = robot.forward_kinematics(q, robot.between(robot.base, tip))[:, :3, 3]
        columns = {name: q[:, robot.joint_names.index(name)] for name in names} | dict(zip("xyz", hands.T, strict=True))
        pl.DataFrame(columns).with_columns(station=pl.lit("hall")).write_csv(path)
    tables = load_tables(robot, files)
    (found,) = located(
        cell_of("ur5", "ur10", ("tool0", "right_tool0"), NOWHERE), [Beside("ur10", "right")], tables, Options()
    )

    assert {name: table.setup for name, table in tables.items()} == {"hall:tool0": "hall", "hall:right_tool0": "hall"}
    assert found.place is not None
    np.testing.assert_allclose(found.place, PLACE, atol=1e-9)


def test_what_sees_from_another_link_is_another_instrument() -> None:
    """A tracker that sees both hands, and a camera on the head that sees one, in one table."""
    links = {"from_link": np.array(["base", "base", "head", "base"]), "to_link": np.array(["left", "right", "left", "left"])}
    table = measurements_from_arrays(["joint"], np.zeros((4, 1)), position=np.zeros((4, 3)), **links)

    found = {name: part.setup for name, part in stations_of([("day", table)]).items()}
    assert found == {"day:base:left": "day:base", "day:base:right": "day:base", "day:head:left": ""}


@pytest.fixture(scope="module")
def touching(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with contacts of two arms, and what trackers saw of each."""
    folder = tmp_path_factory.mktemp("cell")
    cell, noise = "ur5 --beside right=ur10@1.3m,0.2m,0,0,0,170deg", "--no-floor --noise 0.05mm --seed 1"
    hands = f"{cell} --from tool0 --tip right_tool0 --also tool0 --sockets 2 --poses 200"
    run(f"simulate {hands} {noise} --out {folder / 'touch.csv'}")
    for name, tip, other in (("left", "tool0", "right_tool0"), ("right", "right_tool0", "tool0")):
        run(f"simulate {cell} --tip {tip} --also {other} --poses 120 {noise} --out {folder / name}.csv")
    return folder


@pytest.mark.long
def test_where_a_robot_stands_is_found_from_contacts(touching: Path) -> None:
    """To what the errors of two arms leave of it, by the simulator that shares no code with the model."""
    table = pl.read_csv(touching / "touch.csv")
    unknown = cell_of("ur5", "ur10", ("tool0", "right_tool0"), NOWHERE)
    q = table.select(unknown.joint_names).to_numpy()
    links = {"from_link": table["from"].to_numpy(), "to_link": table["to"].to_numpy()}
    contacts = measurements_from_arrays(unknown.joint_names, q, socket=table["socket"].to_numpy(), **links)

    (found,) = located(unknown, [Beside("ur10", "right")], {"": contacts}, Options(setup=Setup()))
    np.testing.assert_allclose(found.place, (1.3, 0.2, 0.0, 0.0, 0.0, np.deg2rad(170.0)), atol=5e-3)
    few = {"": contacts.select(np.arange(6))}
    assert located(unknown, [Beside("ur10", "right")], few, Options())[0].place is None


@pytest.mark.long
def test_two_files_go_through_the_commands(touching: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A place that nobody told, joints without their prefix, and files that hold both robots."""
    left, right, touch, out = (touching / name for name in ("left.csv", "right.csv", "touch.csv", "out"))
    run(f"calibrate ur5 {left} {touch} --beside right=ur10 --noise 0.05mm --out {out}")
    # The other arm, which no tracker saw.
    capsys.readouterr()
    run(f"validate {out / 'model.json'} {right} --json")
    found = json.loads(capsys.readouterr().out)
    assert found["error"]["calibrated"]["test"]["mean_mm"] < 0.12
    whole = Robot.from_urdf(out / "calibrated.urdf", tip="tool0", paths=[("world", "right_tool0")])
    assert {"shoulder_pan_joint", "right_shoulder_pan_joint"} <= set(whole.joint_names)
    table = pl.read_csv(right)
    own = table.select(pl.col("^right_.*_joint$").name.map(lambda name: name.removeprefix("right_")), "x", "y", "z")
    own.write_csv(touching / "own.csv")
    station = "--station own:world:right_tool0 --beside right=ur10@1.3,0.2,0,0,0,170deg"
    run(f"calibrate ur5 {left} {touching / 'own.csv'} {station} --noise 0.05mm --out {touching / 'apart'}")
    result = json.loads((touching / "apart" / "result.json").read_text())
    assert result["error"]["calibrated"]["test"]["mean_mm"] < 0.12
