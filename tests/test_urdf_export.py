"""The calibrated URDF: its kinematics by other programs, and every byte that has to stay."""

import re
import sys
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
import yourdfpy

from pincal.builtin import kuka_urdf_path
from pincal.errors import RobotFileError
from pincal.io import urdf_readers
from pincal.io.urdf_export import UrdfExport, calibrated_urdf
from pincal.io.urdf_text import rpy_of
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effects import ELASTIC, GEOMETRIC, BaseFrame, ToolFrame
from pincal.model.model import Model
from pincal.robot.robot import Robot
from pincal.robot.se3 import rotation_of_rpy
from pincal.robot.tree import UrdfTree

# Robot, tip, base; None for what the robot takes by itself.
ARMS = [
    ("ur10", "tool0", None),
    ("panda", "panda_hand_tcp", None),
    ("panda", "panda_link7", None),
    ("panda", "panda_hand_tcp", "panda_link2"),
    ("kinova", "j2s6s200_end_effector", None),
    ("tiago", "arm_tool_link", None),
    ("tiago", "arm_7_link", "torso_fixed_link"),
    (str(kuka_urdf_path()), "tool0", None),
]
# One of the two paths of an arm of twenty links is of every run.
PARAMS = [pytest.param(*arm, marks=pytest.mark.long if arm[1] == "arm_tool_link" else ()) for arm in ARMS]
BY_THEIR_ENDS = [param for param, arm in zip(PARAMS, ARMS, strict=True) if "7" not in arm[1]]
ORIGIN = re.compile(rb"<origin[^>]*>")

ARM = """<?xml version='1.0' encoding='utf-8'?>
<!-- Made by hand: é ü <origin xyz="9 9 9"/> -->
<robot name="small"  xmlns:xacro="http://www.ros.org/wiki/xacro">
  <link name="base"/>\t<link name="upper">
    <visual><origin xyz="0 0 1"/><geometry><mesh filename="a&amp;b.stl"/></geometry></visual></link>
  <link name='fore'/><link name="bracket"/><link name="flange"/><link name="tool"/>
  <link name="camera"/><link name="finger"/>
  <joint name="lift" type="revolute"><!-- <origin xyz="7 7 7"/> -->
    <origin   rpy = '0.0 -0 .5000'
              note="a > b xyz='5 5 5'" xyz="0.10 0 .4000" />
    <parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <calibration rising="0.0"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="between" type="fixed"><parent link="upper"/><child link="bracket"/>
    <origin xyz="0.5 0 0" rpy="0.1 0 0"/></joint>
  <joint name="bend" type="revolute">
      <parent link="bracket"/><child link="fore"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="end" type="fixed"><origin xyz="1 0 0"></origin><parent link="fore"/><child link="flange"/></joint>
  <joint name="mount" type="fixed"><parent link="flange"/><child link="tool"/><origin rpy="0 0 0.5"/></joint>
  <joint name="eye" type="fixed"><parent link="upper"/><child link="camera"/><origin xyz="0.2 0 0"/></joint>
  <joint name="grip" type="prismatic"><parent link="fore"/><child link="finger"/><origin xyz="0.3 0 0"/>
    <mimic joint="bend"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <gazebo reference="fore"><sensor><origin xyz="1 2 3"/></sensor></gazebo>
  <transmission name="t"><joint name="lift"><origin xyz="4 4 4"/></joint></transmission>
  <ros2_control name="c" type="system"><joint name="bend"><command_interface name="position"/></joint></ros2_control>
</robot>
<!-- the end -->
"""


def small(text: str | bytes = ARM, tip: str = "tool") -> Robot:
    """Return the hand-made arm."""
    with pytest.warns(match="locked"):
        return Robot.from_urdf(text.encode() if isinstance(text, str) else text, tip=tip)


@cache
def load(source: str, tip: str | None, base: str | None) -> Robot:
    """Return an arm, read once, its notes on locked joints not of interest."""
    return Robot.from_urdf(source, tip=tip, base=base)


def geometric(robot: Robot) -> Model:
    """Return the model that a URDF can carry."""
    return Model(Chain.of(robot), GEOMETRIC)


def deviations(model: Model, seed: int = 0, size: float = 3e-3) -> np.ndarray:
    """Return random deviations of all parameters [rad, m]."""
    return np.random.default_rng(seed).normal(0.0, size, model.n_parameters)


def export_one(robot: Robot, name: str, value: float = 1e-3) -> UrdfExport:
    """Return the export of a model with one deviation."""
    model = geometric(robot)
    values = np.zeros(model.n_parameters)
    values[model.index(name)] = value
    return calibrated_urdf(model, values)


def pinocchio_tips(text: bytes, robot: Robot, tip: str, q: np.ndarray) -> np.ndarray:
    """Return the tip in the base frame by Pinocchio, of the whole URDF, shape (N, 3, 4)."""
    model = pin.buildModelFromXML(text.decode())
    data = model.createData()
    base, end = model.getFrameId(robot.base, pin.BODY), model.getFrameId(tip, pin.BODY)
    tips = []
    for row in q:
        pin.framesForwardKinematics(
            model, data, robot.configuration(model, row) if model.nq == len(row) else _full(model, robot, row)
        )
        tips.append((data.oMf[base].actInv(data.oMf[end])).homogeneous[:3])
    return np.array(tips)


def _full(model: pin.Model, robot: Robot, q: np.ndarray) -> np.ndarray:
    full = pin.neutral(model)
    for name, value in zip(robot.joint_names, q, strict=True):
        joint = model.joints[model.getJointId(name)]
        full[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
    return full


def yourdfpy_tips(path: Path, robot: Robot, tip: str, q: np.ndarray) -> np.ndarray:
    """Return the tip in the base frame by yourdfpy, which shares no code with Pinocchio, shape (N, 3, 4)."""
    urdf = yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=True)
    tips = []
    for row in q:
        urdf.update_cfg(dict(zip(robot.joint_names, row.tolist(), strict=True)))
        tips.append(urdf.get_transform(tip, robot.base)[:3])
    return np.array(tips)


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
@pytest.mark.parametrize(("source", "tip", "base"), PARAMS)
def test_other_programs_find_the_calibrated_tip(
    source: str, tip: str | None, base: str | None, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Pinocchio and yourdfpy put the tip of the written URDF where the model predicts it, to 1e-12."""
    robot = load(source, tip, base)
    model = geometric(robot)
    values = deviations(model)
    q = robot.random_configurations(20, rng)
    export = calibrated_urdf(model, values)
    path = tmp_path / "calibrated.urdf"
    path.write_bytes(export.text)
    expected = model.predict(values, Conditions.at(q))

    assert export.max_error_m < 1e-12 and export.links_error_m < 1e-12
    assert np.abs(pinocchio_tips(export.text, robot, export.tip, q) - expected).max() < 1e-12
    assert np.abs(yourdfpy_tips(path, robot, export.tip, q) - expected).max() < 1e-12
    assert np.abs(pinocchio_tips(robot.urdf, robot, robot.tip, q) - expected).max() > 1e-3


def moved_reader(monkeypatch: pytest.MonkeyPatch, *, of: bytes) -> None:
    """Let yourdfpy put every link of a text a micrometre off."""
    as_it_is = urdf_readers._by_yourdfpy

    def off(tree: UrdfTree, *rest: Any) -> np.ndarray:
        return as_it_is(tree, *rest) + 1e-6 * (tree.text == of)

    monkeypatch.setattr(urdf_readers, "_by_yourdfpy", off)


def test_a_urdf_that_readers_take_for_two_arms_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of its links is compared; where they differ about the original, too, that is a note."""
    robot = small()
    model, original = geometric(robot), ARM.encode()
    values = deviations(model)
    written = calibrated_urdf(model, values).text
    with monkeypatch.context() as patch:
        moved_reader(patch, of=written)
        with pytest.raises(RobotFileError, match=r"ambiguous: Pinocchio and yourdfpy put \w+ up to 1e-06 m"):
            calibrated_urdf(model, values)
    moved_reader(monkeypatch, of=original)
    assert calibrated_urdf(model, values).links_error_m < 1e-12
    found = calibrated_urdf(model, np.zeros(model.n_parameters))
    assert found.text == original and found.links_error_m == pytest.approx(1e-6)
    assert any("up to 1e-06 m or rad apart, in the URDF that it was made from, too" in note for note in found.notes)


def test_a_urdf_that_yourdfpy_can_not_read_has_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    """With its reason; so has one of a small installation without yourdfpy, which Pinocchio alone reads back."""
    robot = small()
    model = geometric(robot)

    def failing(*_: Any) -> np.ndarray:
        raise KeyError("colour")

    with monkeypatch.context() as patch:
        patch.setattr(urdf_readers, "_by_yourdfpy", failing)
        found = calibrated_urdf(model, deviations(model))
    assert found.links_error_m == np.inf and any("yourdfpy can't read it (KeyError: 'colour')" in n for n in found.notes)
    monkeypatch.setitem(sys.modules, "yourdfpy", None)
    alone = calibrated_urdf(model, deviations(model))
    assert alone.text == found.text and any(
        "pip install yourdfpy): the calibrated URDF was read back" in n for n in alone.notes
    )


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
@pytest.mark.parametrize(("source", "tip", "base"), PARAMS)
def test_no_deviation_leaves_every_byte(source: str, tip: str | None, base: str | None) -> None:
    """A model without deviations writes the very file that was read."""
    robot = load(source, tip, base)
    model = geometric(robot)
    export = calibrated_urdf(model, np.zeros(model.n_parameters))

    assert export.text == robot.urdf
    assert export.edited == ()
    assert export.tip == robot.tip


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
@pytest.mark.parametrize(("source", "tip", "base"), BY_THEIR_ENDS)
def test_bytes_outside_the_origins_stay(source: str, tip: str | None, base: str | None) -> None:
    """Comments, meshes, gazebo, transmissions: all but the origins on the path is the same, byte for byte."""
    robot = load(source, tip, base)
    export = calibrated_urdf(geometric(robot), deviations(geometric(robot)))

    assert ORIGIN.split(export.text) == ORIGIN.split(robot.urdf)
    changed = [new != old for new, old in zip(ORIGIN.findall(export.text), ORIGIN.findall(robot.urdf), strict=True)]
    assert sum(changed) == len(export.edited) == robot.n_joints + 1


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "iso-8859-1"])
def test_prolog_unknown_tags_and_odd_spelling_survive(newline: str, encoding: str) -> None:
    """Only numbers change: not comments ahead of the root, unknown tags, quotes, blanks, entities, line ends or encoding."""
    text = ARM.replace("\n", newline).replace("'utf-8'", f"'{encoding.removesuffix('-sig')}'").encode(encoding)
    robot = small(text)
    export = export_one(robot, "lift.theta")
    at = text.index(b".5000")
    after = text[at + 5 :]

    assert export.edited == ("lift",)
    assert export.text.startswith(text[:at])
    assert export.text.endswith(after)
    assert float(export.text[at : -len(after)]) == pytest.approx(0.501, abs=1e-15)


def test_origins_that_are_not_of_joints_stay() -> None:
    """Origins in comments, visuals, sensors, transmissions and quoted text are not the joints'."""
    export = calibrated_urdf(geometric(small()), deviations(geometric(small())))

    for kept in (b'<origin xyz="9 9 9"/>', b'<origin xyz="0 0 1"/>', b'"7 7 7"', b"xyz='5 5 5'", b'"1 2 3"', b'"4 4 4"'):
        assert kept in export.text
    assert set(export.edited) == {"lift", "bend", "mount"}


def test_a_number_that_has_not_changed_keeps_its_text() -> None:
    """Of an origin that turns about z, roll, pitch and the position are spelt as they were."""
    export = export_one(small(), "lift.theta")

    assert re.search(rb"rpy = '0.0 -0 0.50\d+'\n", export.text)
    assert b' xyz="0.10 0 .4000" />' in export.text


def test_a_joint_without_origin_gets_one_only_where_it_moves() -> None:
    """The identity is left unsaid until the joint has to move; then an origin is put in, indented like its neighbours."""
    assert b'<joint name="bend" type="revolute">\n      <parent' in export_one(small(), "lift.theta").text

    moved = export_one(small(), "bend.theta")
    assert moved.edited == ("bend",)
    inserted = re.search(rb'<joint name="bend" type="revolute">\n      <origin rpy="[^"]*"/>\n      <parent', moved.text)
    assert inserted is not None


def test_an_attribute_that_was_missing_is_added() -> None:
    """An origin of angles alone gets a position when the tip moves."""
    export = export_one(small(), "bend.a")

    assert export.edited == ("mount",)
    assert re.search(rb'<origin rpy="0 0 0.5" xyz="[^"]*"/></joint>', export.text)


def test_fixed_joints_between_moving_ones_stay() -> None:
    """What the arm deviates by goes into moving joints and the last fixed one; brackets stay on their links."""
    export = calibrated_urdf(geometric(small()), deviations(geometric(small())))

    assert b'<child link="bracket"/>\n    <origin xyz="0.5 0 0" rpy="0.1 0 0"/>' in export.text
    assert b'<origin xyz="1 0 0"></origin><parent link="fore"/>' in export.text


def test_other_children_move_only_with_their_parent() -> None:
    """A camera on a link and a finger that mimics a joint sit on their links as before."""
    robot = small()
    before = pin.buildModelFromXML(ARM)
    after = pin.buildModelFromXML(calibrated_urdf(geometric(robot), deviations(geometric(robot))).text.decode())

    for child in ("camera", "finger"):
        frames = [(m.frames[m.getFrameId(child, pin.BODY)], m) for m in (before, after)]
        (old, m_old), (new, m_new) = frames
        assert m_old.names[old.parentJoint] == m_new.names[new.parentJoint]
        assert old.placement.isApprox(new.placement, 1e-15)
    grip = before.getJointId("grip")
    assert before.jointPlacements[grip].isApprox(after.jointPlacements[grip], 1e-15)


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
def test_a_tip_that_no_fixed_joint_holds_gets_a_link_behind_it() -> None:
    """The end of link 7 can't be moved by link 7's own origin: a link is inserted, and the notes say so."""
    robot = Robot.from_urdf("panda", tip="panda_link7")
    export = export_one(robot, "panda_joint7.d")
    root = ElementTree.fromstring(export.text)

    assert export.tip == "panda_link7_calibrated"
    assert any("panda_link7_calibrated was inserted" in note for note in export.notes)
    assert root.find("link[@name='panda_link7_calibrated']") is not None
    assert export.edited == ()
    assert (
        export.text.replace(
            export.text[export.text.index(b'  <link name="panda_link7_cal') : export.text.rindex(b"</robot>")], b""
        )
        == robot.urdf
    )


def test_an_inserted_link_takes_a_free_name() -> None:
    """A link that already has the name is not defined twice, and a name of the text is escaped."""
    text = ARM.replace('"fore"', '"a&amp;b"').replace("'fore'", "'a&amp;b'")
    text = text.replace('<link name="camera"/>', '<link name="camera"/><link name="a&amp;b_calibrated"/>')
    text = text.replace(
        "</robot>", '<joint name="n" type="fixed"><parent link="base"/><child link="a&amp;b_calibrated"/></joint></robot>'
    )

    assert export_one(small(text, "a&b"), "bend.d").tip == "a&b_calibrated_"


def test_notes_say_what_the_urdf_can_not_carry() -> None:
    """Elasticity, the instrument's frame and the target are named; a geometric model has nothing to note."""
    robot = Robot.from_urdf(kuka_urdf_path())
    model = Model(Chain.of(robot), (BaseFrame(), ToolFrame(), *ELASTIC))
    notes = calibrated_urdf(model, deviations(model)).notes

    assert [note.split(":")[0] for note in notes] == ["joint_elasticity, bearing_elasticity", "base_frame", "tool_frame"]
    assert "payload" in notes[0]
    assert calibrated_urdf(geometric(robot), deviations(geometric(robot))).notes == ()


def test_frames_and_elasticity_do_not_reach_the_urdf() -> None:
    """The URDF of the whole model is that of its geometry alone; values of a sensor behind the model's are not read."""
    robot = Robot.from_urdf(kuka_urdf_path())
    model = Model(Chain.of(robot), (*GEOMETRIC, BaseFrame(), ToolFrame(), *ELASTIC[len(GEOMETRIC) :]))
    values = np.append(deviations(model), 9.0)
    bare = geometric(robot)

    assert calibrated_urdf(model, values).text == calibrated_urdf(bare, bare.own(values)).text


def test_export_twice_changes_nothing_more() -> None:
    """The written URDF is one that pincal loads, whose own nominal model is the calibrated one."""
    robot = Robot.from_urdf(kuka_urdf_path())
    export = calibrated_urdf(geometric(robot), deviations(geometric(robot)))
    again = Robot.from_urdf(export.text, tip=export.tip)

    assert calibrated_urdf(geometric(again), np.zeros(geometric(again).n_parameters)).text == export.text


@pytest.mark.parametrize("offset", [0.0, 1e-16, 1e-12, 1e-9, 1e-8, 1e-5, 1e-2, 1.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_angles_reproduce_the_rotation_at_and_near_gimbal_lock(offset: float, side: int, rng: np.random.Generator) -> None:
    """At a pitch of +-90 degrees and at any distance from it the matrix comes back to 1e-15."""
    for _ in range(200):
        rotation = rotation_of_rpy(np.array([rng.uniform(-3, 3), side * np.pi / 2 + offset, rng.uniform(-3, 3)]))
        near = rng.choice([0.0, np.pi / 2, -np.pi, 1.57], 3)

        assert np.abs(rotation_of_rpy(rpy_of(rotation, near)) - rotation).max() < 1e-15


def test_angles_stay_near_the_old_ones() -> None:
    """Of the triples that give one rotation the one next to the old angles is taken."""
    for old in ([0.1, 2.0, -0.3], [1.2, np.pi / 2, 0.0], [0.0, -np.pi / 2, 2.5], [-2.0, 0.3, 3.0]):
        near = np.array(old)

        np.testing.assert_allclose(rpy_of(rotation_of_rpy(near), near), near, rtol=0, atol=1e-15)


def test_origins_that_follow_one_another_multiply_to_the_path() -> None:
    """Every joint of the path stands in the file with the numbers that the rebuilt robot has."""
    robot = Robot.from_urdf(kuka_urdf_path())
    export = calibrated_urdf(geometric(robot), deviations(geometric(robot)))
    again = Robot.from_urdf(export.text, tip=export.tip)
    joints = again.frames.T_base_link @ again.T_link_joint
    root = ElementTree.fromstring(export.text)

    for (a, b), name in zip(pairwise(joints), again.joint_names[1:], strict=True):
        origin = root.find(f"joint[@name='{name}']/origin")
        assert origin is not None
        xyz = np.array(origin.get("xyz", "").split(), float)
        np.testing.assert_allclose((np.linalg.inv(a) @ b)[:3, 3], xyz, rtol=0, atol=1e-12)


def test_a_model_without_urdf_needs_one() -> None:
    """A model that holds no text exports into one that is given, and says so if none is."""
    robot = Robot.from_urdf(kuka_urdf_path())
    model = geometric(replace(robot, urdf=b""))

    with pytest.raises(RobotFileError, match="holds no URDF"):
        calibrated_urdf(model, deviations(model))
    text = calibrated_urdf(model, deviations(model), urdf=robot.urdf).text
    assert text == calibrated_urdf(geometric(robot), deviations(model)).text


def test_the_urdf_of_another_robot_is_refused() -> None:
    """Joints that differ, an unknown tip, or the same joints at other places: the model does not belong to the file."""
    robot = Robot.from_urdf(kuka_urdf_path())
    model = geometric(robot)
    values = np.zeros(model.n_parameters)

    with pytest.raises(RobotFileError, match="unknown base link"):
        calibrated_urdf(model, values, urdf=ARM.encode())
    with pytest.raises(RobotFileError, match="expected those of the model, joint_1, joint_2"):
        calibrated_urdf(model, values, urdf=robot.urdf.replace(b'"joint_3"', b'"elbow"'))
    shifted = calibrated_urdf(model, np.full(len(values), 1e-3)).text
    with pytest.raises(RobotFileError, match="m from where the model does"):
        calibrated_urdf(model, values, urdf=shifted)
    with pytest.raises(RobotFileError, match="save it as UTF-8"):
        calibrated_urdf(model, values, urdf=robot.urdf.decode().replace("utf-8", "utf-16").encode("utf-16"))
