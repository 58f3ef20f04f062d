"""Arms read from URDFs: their frames against other readers, and URDFs that are refused."""

from __future__ import annotations

import io
import warnings
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yourdfpy
from example_robot_data import robots_loader
from hypothesis import given, settings
from hypothesis import strategies as st

from pincal.errors import BadInputError, PincalWarning, RobotFileError
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.robot.robot import Robot
from pincal.robot.urdf_file import find_file, robot_name

# Lengths [m] and entries of rotations; rounding of ten products of 4x4 matrices is some 1e-15.
EXACT = 1e-12

ARMS = [
    pytest.param(name, tip, base, id="-".join(filter(None, (name, tip, base))))
    for name, tip, base in [
        ("ur3", None, None),
        ("ur5", None, None),
        ("ur10", None, None),
        ("ur3_gripper", None, None),
        ("ur5_limited", None, None),
        ("panda", None, None),
        ("kinova", None, None),
        ("z1", None, None),
        ("xarm7", None, None),
        ("so100", None, None),
        ("so101", None, None),
        ("talos_arm", None, None),
        ("bravo7_no_ee", None, None),
        ("bravo7_gripper", None, None),
        ("asr_twodof", None, None),
        ("finger_edu", None, None),
        ("double_pendulum_continuous", None, None),
        ("tiago", "arm_tool_link", None),
        ("tiago_pro", None, None),
        ("tiago_dual", "arm_left_7_link", "torso_lift_link"),
        ("talos", "arm_left_7_link", None),
        ("talos", "arm_right_7_link", "torso_2_link"),
        ("baxter", "left_gripper", None),
        ("pr2", "r_gripper_tool_frame", None),
        ("anymal_kinova", "j2s6s200_end_effector", "j2s6s200_link_base"),
        ("romeo", "l_gripper", None),
        ("icub", "l_hand_dh_frame", "chest"),
        ("centauro", "arm1_8", "pelvis"),
        ("human", "left_hand", None),
    ]
]


# --- forward kinematics, three ways -------------------------------------------------------------------------------


def turns(axis: str, angles: np.ndarray) -> np.ndarray:
    """Return rotations about x, y or z, shape (N, 4, 4)."""
    out = np.tile(np.eye(4), (len(angles), 1, 1))
    c, s = np.cos(angles), np.sin(angles)
    if axis == "x":
        out[:, 1, 1], out[:, 1, 2], out[:, 2, 1], out[:, 2, 2] = c, -s, s, c
    elif axis == "y":
        out[:, 0, 0], out[:, 0, 2], out[:, 2, 0], out[:, 2, 2] = c, s, -s, c
    else:
        out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1] = c, -s, s, c
    return out


def fk_of_frames(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the tip by the product of the Denavit-Hartenberg frames, shape (N, 4, 4)."""
    n = len(q)
    T = np.tile(robot.frames.T_base_first, (n, 1, 1))
    for i, (s_x, s_y, theta, d, a, alpha) in enumerate(robot.frames.parameters):
        slides = robot.joint_types[i] == "prismatic"
        shift = np.tile(np.eye(4), (n, 1, 1))
        shift[:, 0, 3] = a
        shift[:, 2, 3] = d + (q[:, i] if slides else 0.0)
        tilt = turns("x", np.full(n, s_x)) @ turns("y", np.full(n, s_y))
        T = T @ tilt @ turns("z", theta + (0.0 if slides else 1.0) * q[:, i]) @ shift @ turns("x", np.full(n, alpha))
    return T @ robot.frames.T_last_tip


def fk_of_yourdfpy(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the tip as yourdfpy has it, shape (N, 4, 4)."""
    arm = yourdfpy.URDF.load(io.BytesIO(robot.urdf), load_meshes=False)
    out = []
    for row in q:
        arm.update_cfg(dict(zip(robot.joint_names, map(float, row), strict=True)))
        out.append(arm.get_transform(robot.tip, robot.base))
    return np.array(out)


def assert_same_kinematics(robot: Robot, q: np.ndarray, *, by_yourdfpy: bool = True) -> None:
    """Hold the frames, Pinocchio and yourdfpy against each other."""
    expected = robot.forward_kinematics(q)
    np.testing.assert_allclose(fk_of_frames(robot, q), expected, rtol=0.0, atol=EXACT)
    if by_yourdfpy:
        np.testing.assert_allclose(fk_of_yourdfpy(robot, q), expected, rtol=0.0, atol=EXACT)


def assert_axes_and_limits(robot: Robot) -> None:
    """Check that what a robot says of its joints fits together."""
    n = robot.n_joints
    assert len(robot.joint_types) == n and robot.frames.parameters.shape == (n, 6)
    assert np.all(robot.lower < robot.upper)
    assert np.all(robot.masses >= 0.0) and robot.centres.shape == (n, 3)


@cache
def arm(name: str, tip: str | None, base: str | None) -> Robot:
    """Return an arm of example-robot-data, read once."""
    return Robot.from_urdf(name, tip=tip, base=base)


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
@pytest.mark.parametrize(("name", "tip", "base"), ARMS)
def test_frames_pinocchio_and_yourdfpy_agree(name: str, tip: str | None, base: str | None, rng: np.random.Generator) -> None:
    """The tip of every serial arm is the same by Denavit-Hartenberg frames, by Pinocchio and by yourdfpy."""
    robot = arm(name, tip, base)

    assert_axes_and_limits(robot)
    assert_same_kinematics(robot, np.vstack([np.zeros(robot.n_joints), robot.random_configurations(9, rng)]))


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
@pytest.mark.parametrize(("name", "tip", "base"), ARMS)
def test_bodies_hang_on_the_frames(name: str, tip: str | None, base: str | None, rng: np.random.Generator) -> None:
    """Centres of mass placed by the Denavit-Hartenberg frames have Pinocchio's common centre above the base."""
    import pinocchio as pin

    robot = arm(name, tip, base)
    model, q = robot.pinocchio_model(), robot.random_configurations(1, rng)
    data = model.createData()
    pin.framesForwardKinematics(model, data, robot.configuration(model, q[0]))
    T_base_world = data.oMf[model.getFrameId(robot.base, pin.BODY)].inverse()
    places = []
    for i, joint in enumerate(robot.joint_names):
        index = model.getJointId(joint)
        places.append(T_base_world.act(data.oMi[index].act(model.inertias[index].lever)))
        if joint not in robot.unweighed:
            assert robot.masses[i] == pytest.approx(model.inertias[index].mass)
    links = _link_frames(robot, q)
    centres = [T[:3, :3] @ c + T[:3, 3] for T, c in zip(links, robot.centres, strict=True)]
    known = [joint not in robot.unweighed for joint in robot.joint_names]
    np.testing.assert_allclose(np.array(centres)[known], np.array(places)[known], rtol=0.0, atol=EXACT)
    for i, T in enumerate(links):
        joint = T_base_world * data.oMi[model.getJointId(robot.joint_names[i])]
        np.testing.assert_allclose(T @ robot.T_link_joint[i], joint.homogeneous, rtol=0.0, atol=EXACT)


def _link_frames(robot: Robot, q: np.ndarray) -> list[np.ndarray]:
    """Return S_1 .. S_n in the base frame at one pose."""
    found, T = [], robot.frames.T_base_first[None]
    for i, (s_x, s_y, theta, d, a, alpha) in enumerate(robot.frames.parameters):
        slides = robot.joint_types[i] == "prismatic"
        shift = np.eye(4)
        shift[0, 3], shift[2, 3] = a, d + (q[0, i] if slides else 0.0)
        T = T @ turns("x", np.array([s_x])) @ turns("y", np.array([s_y]))
        T = T @ turns("z", np.array([theta + (0.0 if slides else q[0, i])])) @ shift @ turns("x", np.array([alpha]))
        found.append(T[0])
    return found


# --- arms that nobody built ---------------------------------------------------------------------------------------

INERTIAL = (
    '<inertial><origin xyz="0.05 0.02 0.1"/><mass value="3"/>'
    '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>'
)


@dataclass(frozen=True)
class Joint:
    """One joint of an arm to be written, as it stands in the URDF."""

    axis: tuple[float, float, float]
    xyz: tuple[float, float, float]
    rpy: tuple[float, float, float]
    kind: str = "revolute"


def write_arm(joints: list[Joint], inertial: str = INERTIAL) -> bytes:
    """Return the URDF of an arm ``link_0 .. link_n, tip`` with joints ``j1 .. jn``."""

    def words(values: tuple[float, ...]) -> str:
        return " ".join(repr(value) for value in values)

    parts = [f'<link name="link_{i}">{inertial}</link>' for i in range(len(joints) + 1)]
    for i, joint in enumerate(joints, 1):
        limit = "" if joint.kind == "continuous" else '<limit lower="-0.5" upper="1.5" effort="1" velocity="1"/>'
        parts.append(
            f'<joint name="j{i}" type="{joint.kind}"><parent link="link_{i - 1}"/><child link="link_{i}"/>'
            f'<origin xyz="{words(joint.xyz)}" rpy="{words(joint.rpy)}"/><axis xyz="{words(joint.axis)}"/>{limit}</joint>'
        )
    parts.append(
        f'<link name="tip"/><joint name="end" type="fixed"><parent link="link_{len(joints)}"/><child link="tip"/>'
        '<origin xyz="0.03 -0.02 0.1" rpy="0.2 -0.4 1.0"/></joint>'
    )
    return f'<robot name="random">{"".join(parts)}</robot>'.encode()


UNIT_AXES = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)]
ROUNDED = [0.0, 1.5708, -1.5708, 3.1416, -3.1416]
lengths = st.integers(-800, 800).map(lambda mm: mm / 1000.0)
points = st.tuples(lengths, lengths, lengths)
skew = (
    st.tuples(*[st.integers(-4, 4)] * 3).filter(any).map(lambda v: tuple(float(x) for x in np.array(v) / np.linalg.norm(v)))
)
angles = st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi, 0.3, -0.7, 1.1, 2.5])


@st.composite
def arms(draw: st.DrawFn) -> list[Joint]:
    """Draw 6 or 7 joints, each parallel, coaxial, intersecting or anyhow to the one before, some of them sliding."""
    joints: list[Joint] = []
    for _ in range(draw(st.integers(6, 7))):
        kind = draw(st.sampled_from(["revolute", "revolute", "revolute", "continuous", "prismatic"]))
        relation = draw(st.sampled_from(["any", "unit", "parallel", "antiparallel", "coaxial", "intersecting"]))
        before = np.array(joints[-1].axis if joints else (0.0, 0.0, 1.0))
        axis, xyz, rpy = draw(skew), draw(points), (draw(angles), draw(angles), draw(angles))
        if relation == "unit":
            axis = draw(st.sampled_from(UNIT_AXES))
        elif relation in ("parallel", "antiparallel"):
            axis, rpy = tuple(before if relation == "parallel" else -before), (0.0, 0.0, 0.0)
        elif relation == "coaxial":
            axis, xyz, rpy = tuple(before), tuple(draw(lengths) * before), (0.0, 0.0, 0.0)
        elif relation == "intersecting":
            xyz = tuple(draw(lengths) * before)
        joints.append(Joint(tuple(map(float, axis)), tuple(map(float, xyz)), rpy, kind))
    return joints


@given(arms())
@settings(max_examples=50, deadline=None, derandomize=True)
def test_frames_of_any_arm_are_exact(joints: list[Joint]) -> None:
    """Skew, parallel, intersecting, coaxial, tilted and sliding axes: frames and Pinocchio agree."""
    robot = Robot.from_urdf(write_arm(joints))
    q = robot.random_configurations(4, np.random.default_rng(len(joints)))

    assert robot.n_joints == len(joints) and robot.tip == "tip"
    assert_same_kinematics(robot, q, by_yourdfpy=False)


@pytest.mark.long
@given(arms())
@settings(max_examples=150, deadline=None, derandomize=True)
def test_frames_of_very_many_arms_are_exact(joints: list[Joint]) -> None:
    """Three times as many."""
    robot = Robot.from_urdf(write_arm(joints))
    q = robot.random_configurations(4, np.random.default_rng(len(joints)))

    assert_same_kinematics(robot, q, by_yourdfpy=False)


@pytest.mark.long
@given(arms())
@settings(max_examples=25, deadline=None, derandomize=True)
def test_yourdfpy_agrees_on_any_arm(joints: list[Joint]) -> None:
    """A reader that shares nothing with Pinocchio puts the tip of any arm at the same place."""
    robot = Robot.from_urdf(write_arm(joints))

    assert_same_kinematics(robot, robot.random_configurations(3, np.random.default_rng(0)))


@st.composite
def rounded_arms(draw: st.DrawFn) -> list[Joint]:
    """Draw arms as people write them: axes along x, y, z, quarter and half turns with four decimals."""
    rounded = st.sampled_from(ROUNDED)
    return [
        Joint(draw(st.sampled_from(UNIT_AXES)), draw(points), (draw(rounded), draw(rounded), draw(rounded)))
        for _ in range(draw(st.integers(6, 7)))
    ]


@pytest.mark.long
@given(rounded_arms())
@settings(max_examples=150, deadline=None, derandomize=True)
def test_rounded_angles_make_no_long_links(joints: list[Joint]) -> None:
    """Axes parallel but for rounding are taken as parallel: no link is longer than 3 times the whole arm."""
    robot = Robot.from_urdf(write_arm(joints))
    stretched = sum(float(np.linalg.norm(joint.xyz)) for joint in joints) + 0.2

    assert np.abs(robot.frames.parameters[:, 3:5]).max() < 3.0 * stretched
    assert_same_kinematics(robot, robot.random_configurations(4, np.random.default_rng(1)), by_yourdfpy=False)


@pytest.mark.parametrize("half_turn", [3.14, 3.142, 3.1416, 3.141593])
def test_half_turns_of_any_precision_make_no_long_links(half_turn: float) -> None:
    """Half turns are written with two decimals, too: 1.6 mrad off, still no link longer than 3 times the arm."""
    z = (0.0, 0.0, 1.0)
    turned = [(half_turn, 0.0, 0.0), (0.0, half_turn, 0.0), (half_turn, half_turn, 0.0), (half_turn / 2.0, 0.0, half_turn)]
    robot = Robot.from_urdf(write_arm([Joint(z, (0.3, 0.2, 0.1), rpy) for rpy in turned]))

    assert np.abs(robot.frames.parameters[:, 3:5]).max() < 3.0 * (4 * 0.374 + 0.2)
    assert_same_kinematics(robot, robot.random_configurations(4, np.random.default_rng(2)))


def test_rounding_goes_into_the_tilt_of_the_next_axis() -> None:
    """A half turn with four decimals tilts the next axis by 7.3 urad; the frames carry it as s_x, s_y."""
    down = Joint((0.0, 0.0, 1.0), (0.5, 0.0, 0.3), (3.1416, 0.0, 0.0))
    robot = Robot.from_urdf(write_arm([Joint((0.0, 0.0, 1.0), (0.0, 0.0, 0.2), (0.0, 0.0, 0.0)), down, down]))
    s = robot.frames.parameters

    assert np.hypot(s[1, 0], s[1, 1]) == pytest.approx(3.1416 - np.pi, rel=1e-6)
    np.testing.assert_allclose(s[0, 3:], [0.3, 0.5, np.pi], atol=1e-12)


def test_parallel_axes_keep_their_origins_at_the_joints() -> None:
    """The origin on a parallel axis is free; it is where the URDF has its joint."""
    z = (0.0, 0.0, 1.0)
    joints = [
        Joint(z, (0.0, 0.0, 0.1), (0.0,) * 3),
        Joint(z, (0.3, 0.4, 0.25), (0.0,) * 3),
        Joint(z, (0.2, 0.0, 0.0), (0.0,) * 3),
    ]
    robot = Robot.from_urdf(write_arm(joints))

    np.testing.assert_allclose(robot.frames.T_base_first[:3, 3], [0.0, 0.0, 0.1], atol=1e-15)
    np.testing.assert_allclose(robot.frames.T_base_link[0, :3, 3], [0.3, 0.4, 0.35], atol=1e-15)
    np.testing.assert_allclose(robot.frames.parameters[0, 3:], [0.25, 0.5, 0.0], atol=1e-15)


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
def test_a_single_joint_is_an_arm(kind: str) -> None:
    """One joint makes an arm, too: a turntable or a linear axis."""
    robot = Robot.from_urdf(write_arm([Joint((0.0, 0.6, -0.8), (0.1, 0.2, 0.3), (1.5708, 0.2, 0.0), kind)]))

    assert robot.n_joints == 1
    assert robot.joint_units == ({"prismatic": "m"}.get(kind, "rad"),)
    assert_same_kinematics(robot, robot.random_configurations(4, np.random.default_rng(3)))


def test_kuka_frames_are_those_of_table_1(kuka: Robot) -> None:
    """The frames found from the URDF of the KUKA are the paper's: Table I, initial estimates."""
    half, quarter = np.pi, np.pi / 2.0
    table = [
        [0.0, 0.865, 0.41, quarter],
        [0.0, 0.0, 1.0, 0.0],
        [quarter, 0.0, 0.045, quarter],
        [0.0, 1.0, 0.0, -quarter],
        [0.0, 0.0, 0.0, quarter],
        [half, 0.21, 0.0, 0.0],
    ]
    np.testing.assert_allclose(kuka.frames.parameters[:, :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(kuka.frames.parameters[:, 2:], table, atol=1e-12)


def test_reach_bounds_the_tip(kuka: Robot, rng: np.random.Generator) -> None:
    """No pose takes the tip further from the first frame than the stretched arm."""
    tips = kuka.forward_kinematics(kuka.random_configurations(200, rng))[:, :3, 3]
    distance = np.linalg.norm(tips - kuka.frames.T_base_first[:3, 3], axis=1)

    assert 0.5 * kuka.reach < distance.max() <= kuka.reach


# --- which arm of the URDF ----------------------------------------------------------------------------------------


def gripper_arm(flange: str = "hand") -> bytes:
    """Return a URDF of three joints, a hand and two fingers, of which one mimics the other."""
    link = f'<link name="{{}}">{INERTIAL}</link>'
    joint = (
        '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><origin xyz="0 0.1 0.3"/>'
        '<axis xyz="{}"/><limit lower="-1" upper="1" effort="1" velocity="1"/>{}</joint>'
    )
    links = ["world", "base", "upper", "fore", "wrist", flange, "finger_1", "finger_2"]
    joints = [
        joint.format("float", "floating", "world", "base", "0 0 1", ""),
        joint.format("pan", "continuous", "base", "upper", "0 0 1", ""),
        joint.format("lift", "revolute", "upper", "fore", "0 -1 0", ""),
        joint.format("roll", "revolute", "fore", "wrist", "1 0 0", ""),
        joint.format("mount", "fixed", "wrist", flange, "0 0 1", ""),
        joint.format("grip", "prismatic", flange, "finger_1", "0 1 0", ""),
        joint.format("grip_copy", "prismatic", flange, "finger_2", "0 -1 0", '<mimic joint="grip"/>'),
    ]
    return f'<robot name="gripper_arm">{"".join(map(link.format, links))}{"".join(joints)}</robot>'.encode()


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
@pytest.mark.parametrize(
    ("name", "tip", "n_joints"),
    [("ur10", "tool0", 6), ("ur3_gripper", "tool0", 6), ("panda", "panda_hand_tcp", 7), ("xarm7", "link_eef", 7)],
)
def test_default_tip_is_the_flange_without_gripper(name: str, tip: str, n_joints: int) -> None:
    """Of a robot as it comes, the arm ends at its tool frame and its fingers are no joints of the arm."""
    robot = Robot.from_urdf(name)

    assert (robot.tip, robot.n_joints) == (tip, n_joints)


def test_fingers_mimics_and_floating_bases_off_the_path_are_locked() -> None:
    """What is not between base and tip is locked with a warning and a note, and its mass stays on its link."""
    with pytest.warns(PincalWarning, match="3 joints off the path from base to hand are locked") as caught:
        robot = Robot.from_urdf(gripper_arm(), base="base")

    assert robot.joint_names == ("pan", "lift", "roll") and robot.tip == "hand"
    assert len(robot.notes) == 1 and robot.notes[0] in str(caught[0].message)
    assert all(name in robot.notes[0] for name in ("float", "grip", "grip_copy"))
    np.testing.assert_allclose(robot.masses, [3.0, 3.0, 12.0])
    assert_same_kinematics(robot, robot.random_configurations(5, np.random.default_rng(0)))


@pytest.mark.parametrize(("name", "count"), [("panda", "2 joints off the path"), ("talos_arm", "1 joint off the path")])
def test_a_robot_by_name_is_called_by_its_file_not_by_where_that_is_installed(name: str, count: str) -> None:
    """In notes and in errors."""
    with pytest.warns(PincalWarning, match=count) as caught:
        Robot.from_urdf(name)
    assert str(caught[0].message).startswith(f"{find_file(name).name}: ")
    with pytest.raises(RobotFileError, match=r"^[a-z_]*\.urdf: unknown link 'nowhere'"):
        Robot.from_urdf(name, tip="nowhere")


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
@pytest.mark.parametrize("flange", ["tool0", "robot_flange", "my_tcp", "left_ee_link"])
def test_tool_names_of_makers_are_preferred(flange: str) -> None:
    """Of the links behind the last joint, the one named like a tool or flange is the tip."""
    assert Robot.from_urdf(gripper_arm(flange), base="base").tip == flange


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
def test_joint_names_choose_the_tip() -> None:
    """A table's joint columns tell which arm is meant, in any order."""
    names = [f"panda_joint{i}" for i in (3, 1, 2, 4)]
    robot = Robot.from_urdf("panda", joints=names)

    assert robot.joint_names == tuple(sorted(names)) and robot.tip == "panda_link4"
    with pytest.raises(RobotFileError, match=r"no joint 'panda_joint9'; its joints: .*panda_joint1"):
        Robot.from_urdf("panda", joints=["panda_joint1", "panda_joint9"])


def test_nothing_locked_means_no_note_and_no_warning() -> None:
    """An arm that uses all of its URDF is read in silence."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Robot.from_urdf("ur10").notes == ()


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
def test_a_base_along_the_arm_starts_there(rng: np.random.Generator) -> None:
    """From another base the tip is where the whole arm has it, with the joints before the base at zero."""
    whole, part = Robot.from_urdf("ur10"), Robot.from_urdf("ur10", base="upper_arm_link")
    q = part.random_configurations(5, rng)
    root = Robot.from_urdf("ur10", tip="upper_arm_link").forward_kinematics(np.zeros((1, 2)))[0]

    assert part.joint_names == whole.joint_names[2:]
    tips = whole.forward_kinematics(np.hstack([np.zeros((5, 2)), q]))
    np.testing.assert_allclose(root @ part.forward_kinematics(q), tips, atol=EXACT)
    np.testing.assert_allclose(root[:3, :3] @ part.gravity, [0.0, 0.0, -9.81], atol=EXACT)


def test_continuous_joints_have_no_limits_and_turn_on() -> None:
    """A continuous joint has infinite limits, and a whole turn brings the tip back."""
    robot = Robot.from_urdf("double_pendulum_continuous")
    q = np.array([[0.3, -1.0], [0.3 + 2.0 * np.pi, -1.0 - 4.0 * np.pi]])
    here, there = robot.forward_kinematics(q)

    assert np.all(np.isinf(robot.lower)) and np.all(np.isinf(robot.upper))
    assert np.all(np.abs(robot.random_configurations(50, np.random.default_rng(0))) <= np.pi)
    np.testing.assert_allclose(here, there, atol=EXACT)
    assert_same_kinematics(robot, q)


def test_random_configurations_keep_within_the_limits(kuka: Robot, rng: np.random.Generator) -> None:
    """Drawn poses fill the range of every joint and stay in it; the same seed gives the same poses."""
    q = kuka.random_configurations(500, rng)

    assert np.all((q >= kuka.lower) & (q <= kuka.upper))
    assert np.all(np.ptp(q, axis=0) > 0.95 * (kuka.upper - kuka.lower))
    again = kuka.random_configurations(3, np.random.default_rng(5))
    np.testing.assert_array_equal(again, kuka.random_configurations(3, np.random.default_rng(5)))


# --- URDFs that are refused ---------------------------------------------------------------------------------------


def joint(name: str, parent: str, child: str, *, kind: str = "revolute", inside: str = "") -> str:
    """Return one joint of a small URDF."""
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{limit}{inside}</joint>'


def urdf(*joints: str, links: str = "abc", extra: str = "") -> str:
    """Return a small URDF with one-letter links."""
    return f'<robot name="small">{"".join(f"""<link name="{n}"/>""" for n in links)}{"".join(joints)}{extra}</robot>'


AB, BC = joint("ab", "a", "b"), joint("bc", "b", "c")
LAUGHS = (
    '<!DOCTYPE robot [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">'
    '<!ENTITY d "&c;&c;&c;&c;&c;&c;&c;&c;">]><robot name="&d;"><link name="a"/></robot>'
)
OUTSIDE = '<!DOCTYPE robot [<!ENTITY file SYSTEM "file:///etc/hostname">]><robot name="r"><link name="a"/>&file;</robot>'
NAN_ORIGIN = '<origin xyz="0 nan 0"/>'
HEAVY = '<inertial><mass value="{}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'

BAD = {
    "nothing": ("", "not XML"),
    "no XML": ("joint,x,y\n1,2,3\n", "not XML"),
    "binary": ("\x00\x01\x02", "not XML"),
    "cut off": (urdf(AB, BC)[:-40], "not XML"),
    "other root": ("<sdf><model/></sdf>", r"root element is <sdf>, expected <robot>"),
    "entity expansion": (LAUGHS, "entities"),
    "external entity": (OUTSIDE, "entities"),
    "no links": ('<robot name="empty"/>', "not form a single tree"),
    "loop": (urdf(AB, BC, joint("ac", "a", "c")), "in the loop closed by ac no joint can move"),
    "circle": (urdf(AB, BC, joint("ca", "c", "a")), "a cycle"),
    "circle beside the tree": (
        urdf(AB, BC, joint("de", "d", "e"), joint("ed", "e", "d"), links="abcde"),
        "not form a single tree",
    ),
    "several roots": (urdf(AB, links="abc"), "not form a single tree .roots: a, c"),
    "unknown parent": (urdf(AB, joint("bd", "b", "d")), "joint 'bd' names the unknown link 'd'"),
    "no child": (urdf('<joint name="ab" type="fixed"><parent link="a"/></joint>', links="a"), "'ab' names no child"),
    "joint without type": (
        urdf('<joint name="ab"><parent link="a"/><child link="b"/></joint>', links="ab"),
        "without 'type'",
    ),
    "unknown type": (urdf(joint("ab", "a", "b", kind="hinge"), links="ab"), "has type 'hinge'; expected revolute"),
    "two links of one name": (urdf(AB, BC, links="abcb"), "link 'b' is defined more than once"),
    "two joints of one name": (urdf(AB, joint("ab", "b", "c")), "joint 'ab' is defined more than once"),
    "link without name": (urdf(AB, BC, extra="<link/>"), "<link> without 'name'"),
    "zero axis": (urdf(joint("ab", "a", "b", inside='<axis xyz="0 0 0"/>'), BC), "'ab' has a zero axis"),
    "axis of two numbers": (urdf(joint("ab", "a", "b", inside='<axis xyz="0 1"/>'), BC), "three finite numbers"),
    "NaN axis": (urdf(joint("ab", "a", "b", inside='<axis xyz="0 nan 1"/>'), BC), "three finite numbers"),
    "NaN origin": (urdf(joint("ab", "a", "b", inside='<origin xyz="0 nan 0"/>'), BC), "three finite numbers"),
    "infinite origin": (urdf(joint("ab", "a", "b", inside='<origin rpy="0 inf 0"/>'), BC), "three finite numbers"),
    "words in an origin": (urdf(joint("ab", "a", "b", inside='<origin xyz="0 one 0"/>'), BC), "three finite numbers"),
    "negative mass": (
        urdf(AB, BC, links="ab", extra=f'<link name="c">{HEAVY.format(-2)}</link>'),
        "link 'c' has mass '-2'; expected a number of kg",
    ),
    "NaN mass": (
        urdf(AB, BC, links="ab", extra=f'<link name="c">{HEAVY.format("nan")}</link>'),
        "link 'c' has mass 'nan'",
    ),
    "NaN centre of mass": (
        urdf(AB, BC, links="ab", extra=f'<link name="c">{HEAVY.format(2).replace("<mass", NAN_ORIGIN + "<mass")}</link>'),
        "three finite numbers",
    ),
    "mass without inertia": (
        urdf(AB, BC, links="ab", extra='<link name="c"><inertial><mass value="2"/></inertial></link>'),
        "link 'c'.*inertia",
    ),
    "vanishing axis": (urdf(joint("ab", "a", "b", inside='<axis xyz="0 0 1e-300"/>'), BC), "'ab'.*axis"),
    "huge axis": (urdf(joint("ab", "a", "b", inside='<axis xyz="0 0 1e200"/>'), BC), "'ab'.*axis"),
    "no limits": (urdf(AB.replace("<limit", "<safety"), BC), "joint 'ab'.*limit"),
    "limit in words": (urdf(AB.replace('lower="-1"', 'lower="low"'), BC), "joint 'ab'.*limit"),
    "no name": (urdf(AB, BC).replace(' name="small"', ""), "name"),
    "name of Pinocchio's own": (urdf(joint("universe", "a", "b"), BC), "'universe'"),
    "nothing moves": (urdf(joint("ab", "a", "b", kind="fixed"), links="ab"), "no moving joint between 'a' and 'b'"),
}


@pytest.mark.parametrize(("text", "words"), BAD.values(), ids=BAD.keys())
def test_a_bad_urdf_is_refused_in_words(text: str, words: str, tmp_path: Path) -> None:
    """Each kind of broken URDF raises RobotFileError that names the file and what is wrong."""
    path = tmp_path / "broken.urdf"
    path.write_text(text)
    with pytest.raises(RobotFileError, match=words) as caught:
        Robot.from_urdf(path)

    assert "broken.urdf" in str(caught.value)
    with pytest.raises(RobotFileError, match=words):
        Robot.from_urdf(text.encode())


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "iso-8859-1"])
def test_any_encoding_of_xml_is_read(encoding: str) -> None:
    """A URDF in an encoding that its declaration names is read, letters beyond ASCII in names included."""
    text = f'<?xml version="1.0" encoding="{encoding}"?>' + urdf(joint("tür", "a", "b"), BC)
    robot = Robot.from_urdf(text.encode(encoding))

    assert robot.joint_names == ("tür", "bc")
    assert robot.forward_kinematics(np.zeros((1, 2))).shape == (1, 4, 4)


def test_messages_give_the_line(tmp_path: Path) -> None:
    """What is wrong at one element is reported with the line where it stands."""
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="r">\n<link name="a"/>\n<link name="b"/>\n' + joint("ab", "a", "b", kind="hinge") + "</robot>"
    )
    with pytest.raises(RobotFileError, match=r"arm\.urdf:4: joint 'ab'"):
        Robot.from_urdf(path)


@pytest.mark.parametrize(("role", "words"), [("tip", "link"), ("base", "base link")])
def test_an_unknown_link_names_the_nearest(role: str, words: str) -> None:
    """A misspelt tip or base is answered with the links there are, the nearest first."""
    with pytest.raises(RobotFileError, match=rf"unknown {words} 'tool_0'; known ones: tool0,"):
        Robot.from_urdf("ur10", **{role: "tool_0"})


def test_a_base_off_the_way_to_the_tip_is_refused() -> None:
    """The base has to lie between the root and the tip; the links that do are listed."""
    with pytest.raises(RobotFileError, match=r"'wrist_3_link' is not an ancestor of 'forearm_link'.*upper_arm_link"):
        Robot.from_urdf("ur10", base="wrist_3_link", tip="forearm_link")


def test_a_tip_that_nothing_moves_is_refused() -> None:
    """An arm has at least one moving joint."""
    with pytest.raises(RobotFileError, match="no moving joint between 'world' and 'base_link'"):
        Robot.from_urdf("ur10", tip="base_link")


def test_a_joint_moves_with_the_one_of_another_branch_that_it_mimics() -> None:
    """That one is a joint of the robot, too, though it is not on the path."""
    robot = Robot.from_urdf(gripper_arm(), base="base", tip="finger_2")
    q = robot.spread(np.random.default_rng(1).uniform(-0.02, 0.02, (5, len(robot.own_joints))))

    assert robot.joint_names[-2:] == ("grip_copy", "grip") and robot.parents[-1] == robot.parents[-2]
    np.testing.assert_allclose(np.abs(q[:, -2]), np.abs(q[:, -1]))
    np.testing.assert_allclose(
        Model(Chain.of(robot), ()).predict(np.zeros(0), Conditions.at(q)), robot.forward_kinematics(q)[:, :3], atol=1e-12
    )


def test_a_floating_joint_on_the_path_is_refused() -> None:
    """A floating base can't be part of a serial arm; another base can."""
    with pytest.raises(RobotFileError, match=r"'float' between 'world' and 'hand' is floating.*choose another base"):
        Robot.from_urdf(gripper_arm(), tip="hand")


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    """A path that can't be read says so with the reason of the system."""
    with pytest.raises(RobotFileError, match=r"none\.urdf: can't be read \(No such file"):
        Robot.from_urdf(tmp_path / "none.urdf")
    with pytest.raises(RobotFileError, match=r"can't be read \(Is a directory"):
        Robot.from_urdf(tmp_path)


def test_a_folder_does_not_hide_a_robot_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The results of ``--out ur10`` stand beside the robot that they are of."""
    monkeypatch.chdir(tmp_path)
    Path("ur10").mkdir()

    assert Robot.from_urdf("ur10").n_joints == 6


@pytest.mark.parametrize(("name", "near"), [("ur11", "ur10"), ("ur10e", "ur10"), ("fr3", ""), ("iiwa", "")])
def test_an_unknown_robot_is_answered_with_where_descriptions_are(name: str, near: str) -> None:
    """Nearly the name of one that is there is asked about; the others are not listed."""
    meant = rf" \(is it {near}" if near else ""
    said = rf"'{name}' is neither a file nor a robot of example-robot-data{meant}.*; expected a path .*_description"
    with pytest.raises(RobotFileError, match=said) as refused:
        Robot.from_urdf(name)
    assert "hand" not in str(refused.value) and ("is it" in str(refused.value)) == bool(near)


def test_a_missing_mesh_is_no_problem(tmp_path: Path) -> None:
    """Meshes are only looks: a URDF whose mesh files are elsewhere loads."""
    mesh = '<geometry><mesh filename="package://nowhere/link.stl"/></geometry>'
    shape = f'<link name="c">{INERTIAL}<visual>{mesh}</visual><collision>{mesh}</collision></link>'
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(AB, BC, links="ab", extra=shape))

    assert Robot.from_urdf(path).n_joints == 2


def test_all_errors_are_bad_input() -> None:
    """Callers who catch ValueError or BadInputError catch a bad URDF, too; the exit code is 3."""
    with pytest.raises(BadInputError) as caught:
        Robot.from_urdf(b"<x/>")

    assert isinstance(caught.value, ValueError) and caught.value.exit_code == 3


# --- links without mass -------------------------------------------------------------------------------------------


def test_links_without_inertia_are_named() -> None:
    """Moving links for which the URDF has no mass, or zero, are listed; a fixed one rides on its parent."""
    text = urdf(
        AB,
        BC,
        joint("cd", "c", "d"),
        joint("de", "d", "e", kind="fixed"),
        links="ab",
        extra=f'<link name="c">{HEAVY.format(0)}</link><link name="d">{HEAVY.format(2)}</link><link name="e"/>',
    )
    robot = Robot.from_urdf(text.encode())

    assert robot.massless == ("b", "c")
    assert robot.unweighed == ("ab", "bc")
    assert robot.masses[2] == 2.0 and np.all(robot.masses[:2] > 0.0)


# --- names of example-robot-data --------------------------------------------------------------------------------------


def test_a_name_is_the_robot_that_it_says() -> None:
    """No robot is one that has another name in the same table, and a UR3 has the lengths of its maker, not a UR5's."""
    known = robots_loader.ROBOTS
    for name in known:
        with suppress(RobotFileError), warnings.catch_warnings():
            warnings.simplefilter("ignore", PincalWarning)
            found = robot_name(find_file(name))
            assert found is None or found not in known or name.startswith(found), name
    with pytest.warns(
        PincalWarning, match="has ur5_robot.urdf under the name 'ur3', .*; ur3_robot.urdf in the same folder is read"
    ):
        robot = Robot.from_urdf("ur3")
    # Universal Robots, DH parameters for calculations of kinematics and dynamics: a2, a3 of the UR3.
    assert robot.name == "ur3"
    assert np.allclose(robot.frames.parameters[1:3, 4], [0.24365, 0.21325], atol=1e-5)


@pytest.mark.parametrize("other", [None, "arm7"])
def test_a_name_without_its_robot_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: str | None) -> None:
    """The message says which robot the file has, and what to do; a file beside it with a wrong robot is none."""
    (tmp_path / "arm7.urdf").write_text('<robot name="arm7"/>')
    if other is not None:
        (tmp_path / "arm9.urdf").write_text(f'<robot name="{other}"/>')
    loader = SimpleNamespace(path="", urdf_subpath="", urdf_filename="arm7.urdf")
    monkeypatch.setattr(robots_loader, "ROBOTS", {"arm7": loader, "arm9": loader, "arm7_short": loader})
    monkeypatch.setattr(robots_loader, "getModelPath", lambda _: str(tmp_path))

    assert find_file("arm7") == find_file("arm7_short") == tmp_path / "arm7.urdf"
    with pytest.raises(RobotFileError, match=r"under the name 'arm9', whose robot is called 'arm7'; expected 'arm9'"):
        find_file("arm9")


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
@pytest.mark.parametrize("name", ["ur10", "panda"])
def test_a_robot_that_yourdfpy_has_read_is_the_same(
    name: str, rng: np.random.Generator, caplog: pytest.LogCaptureFixture
) -> None:
    """Joints, limits and masses, and kinematics to rounding; nothing is logged."""
    robot = Robot.from_urdf(name)
    there = yourdfpy.URDF.load(io.BytesIO(robot.urdf), load_meshes=False)
    caplog.clear()
    found = Robot.from_urdf(there, tip=robot.tip)
    assert caplog.messages == []
    q = robot.random_configurations(5, rng)

    assert (found.joint_names, found.joint_types, found.base) == (robot.joint_names, robot.joint_types, robot.base)
    np.testing.assert_allclose(found.forward_kinematics(q), robot.forward_kinematics(q), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose([found.lower, found.upper], [robot.lower, robot.upper], rtol=1e-12)
    np.testing.assert_allclose(found.masses, robot.masses, rtol=1e-12)


def test_a_robot_that_yourdfpy_can_not_write_is_refused() -> None:
    """An object whose robot has been taken out of it."""
    there = yourdfpy.URDF.load(io.BytesIO(Robot.from_urdf("ur10").urdf), load_meshes=False)
    there.robot = None
    with pytest.raises(RobotFileError, match=r"can't be written by yourdfpy .*; give the file"):
        Robot.from_urdf(there)
