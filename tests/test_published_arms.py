"""Arms as their descriptions are published: joints that mimic others, closed loops, equal names, grippers, odd axes."""

from __future__ import annotations

import io
import time
from pathlib import Path

import numpy as np
import pytest
import yourdfpy
from command_line import run

from pincal.calibration.calibration import run_calibration
from pincal.calibration.fitted_robot import load_model
from pincal.compensate.compensation import compensate_poses
from pincal.design.pose_design import design_poses
from pincal.design.request import DesignRequest
from pincal.errors import PincalWarning, RobotFileError
from pincal.identify.options import Options
from pincal.measure.table import read_measurements, write_table
from pincal.model.conditions import Conditions
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot
from pincal.simulate import TrueMachine, plan_poses

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

LIMITS = '<limit lower="{}" upper="{}" effort="1" velocity="1"/>'


def joint(
    name: str, parent: str, child: str, *, axis: str = "0 0 1", xyz: str = "0 0 0.3", more: str = "", ends=(-2, 2)
) -> str:
    """Return a revolute joint and its child link."""
    return (
        f'<link name="{child}"/><joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="0.1 0 0"/><axis xyz="{axis}"/>{LIMITS.format(*ends)}{more}</joint>'
    )


def arm(*parts: str) -> bytes:
    """Return a URDF that begins with the link ``l0``."""
    return f'<robot name="arm"><link name="l0"/>{"".join(parts)}</robot>'.encode()


FIVE = arm(
    joint("j1", "l0", "l1"),
    joint("j2", "l1", "l2", axis="0 1 0", xyz="0.2 0 0.4"),
    joint("j3", "l2", "l3", axis="0 1 0", xyz="0.1 0 0.8"),
    joint("j4", "l3", "l4", axis="1 0 0", xyz="0.6 0 0.1"),
    joint("j4b", "l4", "l4b", axis="0 0.6 0.8", xyz="0.1 0.1 0", ends=(-1, 4),
          more='<mimic joint="j4" multiplier="-0.5" offset="0.25"/>'),
    joint("j5", "l4b", "tool", axis="0 1 0", xyz="0.1 0 0.1"),
)  # fmt: skip


def test_a_joint_that_mimics_another_moves_with_it(rng: np.random.Generator) -> None:
    """It is a joint of the arm; its position follows, its limits bind the other, and yourdfpy puts the tip there, too."""
    robot = Robot.from_urdf(FIVE)
    q = robot.random_configurations(20, rng)
    other = yourdfpy.URDF.load(io.BytesIO(FIVE), load_meshes=False)
    tips = []
    for row in q:
        other.update_cfg({f"j{i + 1}": row[k] for i, k in enumerate(robot.own_joints)})
        tips.append(other.get_transform("tool", "l0"))

    assert robot.joint_names == ("j1", "j2", "j3", "j4", "j4b", "j5") and robot.tip == "tool"
    np.testing.assert_allclose(q[:, 4], 0.25 - 0.5 * q[:, 3], atol=1e-15)
    assert (robot.lower[3], robot.upper[3]) == (-2.0, 2.0) and (robot.lower[4], robot.upper[4]) == (-0.75, 1.25)
    np.testing.assert_allclose(robot.forward_kinematics(q), tips, atol=1e-12)
    np.testing.assert_array_equal(robot.spread(q[:, robot.own_joints]), q)
    J = rng.standard_normal((2, 3, 6))
    step = robot.spread(q[:1, robot.own_joints] + np.eye(5)) - q[:1]
    np.testing.assert_allclose(robot.gathered(J), J @ step.T, atol=1e-12)


@pytest.mark.long
def test_a_measured_column_moves_both_joints(tmp_path: Path) -> None:
    """A table without the joint that follows calibrates as one with it; both joints have errors that are found."""
    robot = Robot.from_urdf(FIVE)
    machine = TrueMachine.from_urdf(FIVE.decode(), tip="tool").draw_errors(
        np.random.default_rng(1), sigma_length=5e-4, sigma_angle=1e-3, sigma_offset=2e-3
    )
    q = plan_poses(machine.nominal, 150, np.random.default_rng(2), min_height=None)
    places = machine.tip(q)[:, :3, :3] @ [0.05, 0.02, 0.1] + machine.tip(q)[:, :3, 3]
    columns = {**dict(zip(robot.joint_names, q.T, strict=True)), **dict(zip("xyz", places.T, strict=True))}
    errors = {}
    for name in ("j4b", "none"):
        write_table(
            tmp_path / f"{name}.csv", {key: value for key, value in columns.items() if key != "j4b" or name == "j4b"}
        )
        table = read_measurements(tmp_path / f"{name}.csv", robot.joint_names, mimics=robot.mimics)
        found = run_calibration(robot, table, Options(effects=GEOMETRIC, sigma=1e-6))
        errors[name] = found.result.to_dict()["error"]["calibrated"]["test"]["mean_mm"]

    np.testing.assert_allclose(q[:, 4], 0.25 - 0.5 * q[:, 3], atol=1e-15)
    assert errors["none"] == pytest.approx(errors["j4b"], rel=1e-9) and errors["none"] < 2e-3
    # Found again by commands that keep to what the drives can do.
    found.fit.save(tmp_path / "model.json")
    calibrated = load_model(tmp_path / "model.json")
    assert calibrated.model.chain.robot.mimics == robot.mimics
    wanted = calibrated.predict(Conditions.at(q))[:, :, 3]
    moved = robot.spread(q[:, robot.own_joints] + 0.01)
    back = compensate_poses(calibrated, wanted, Conditions.at(moved), orientation="free")
    np.testing.assert_allclose(back.q, robot.following(back.q), atol=0)
    assert np.mean(back.is_ok) > 0.9 and back.error[back.is_ok].max() < 1e-9
    chosen = design_poses(robot, DesignRequest(poses=10, candidates=40), Options(effects=GEOMETRIC, sigma=5e-5)).q
    np.testing.assert_allclose(chosen, robot.following(chosen), atol=0)


def test_the_published_painting_arm_ends_at_its_tool(published_robots: Path) -> None:
    """ABB's IRB 5400 has six drives and seven joints between its base and tool0."""
    robot = Robot.from_urdf(published_robots / "abb/abb_irb5400_support/urdf/irb5400.urdf")

    assert (robot.tip, robot.n_joints, len(robot.own_joints)) == ("tool0", 7, 6)
    assert robot.joint_names[4:] == ("joint5", "joint5b", "joint6")


def mimicking(source: str, other: str = "l1") -> bytes:
    """Return an arm of two joints, of which the last mimics one."""
    return arm(joint("a", "l0", "l1"), joint("b", other, "l2", more=f'<mimic joint="{source}"/>'))


CLOSING = '<gazebo><joint name="pin" type="revolute"><parent>l2</parent><child>rod</child></joint></gazebo>'
PARALLELOGRAM = arm(joint("a", "l0", "l1"), joint("b", "l1", "l2"), joint("c", "l0", "rod"), CLOSING)
TWICE = PARALLELOGRAM.replace(
    CLOSING.encode(), b'<joint name="pin" type="fixed"><parent link="l2"/><child link="rod"/></joint>'
)
REFUSED = {
    "mimics itself": (mimicking("b"), {"tip": "l2"}, "joint 'b' between 'l0' and 'l2' mimics 'b'"),
    "mimics with words": (mimicking('a" offset="x'), {}, "'b' mimics with"),
    "a loop for Gazebo": (PARALLELOGRAM, {"tip": "l2"}, "in the loop closed by pin b can't move"),
    "a loop in the tree": (TWICE, {}, "in the loop closed by c ends stay 300 mm"),
    "an origin beyond any robot": (arm(joint("a", "l0", "l1", xyz="0 1e200 0")), {}, "1e200.* far beyond any robot"),
    "too many joints": (arm(*(joint(f"j{i}", f"l{i}", f"l{i + 1}") for i in range(600))), {}, "600 moving joints; expect"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "ends", "words"), REFUSED.values(), ids=REFUSED.keys())
def test_what_is_no_serial_arm_is_refused_by_name(text: bytes, ends: dict[str, str], words: str) -> None:
    """The joints in question are named, with what would help; nothing is left out of the arm in silence."""
    with pytest.raises(RobotFileError, match=words):
        Robot.from_urdf(text, **ends)


def test_a_loop_beside_the_arm_does_no_harm() -> None:
    """Rods that close a loop beside the arm are left out."""
    assert Robot.from_urdf(PARALLELOGRAM.replace(b"<parent>l2</parent>", b"<parent>l0</parent>"), tip="l2").n_joints == 2


def test_an_axis_without_direction_is_x_and_said() -> None:
    """Readers differ on <axis/>: it is read as URDF's default, and the user is told."""
    text = arm(joint("a", "l0", "l1"), joint("b", "l1", "l2"))
    written, plain = text.replace(b'<axis xyz="0 0 1"/>', b'<axis xyz="1 0 0"/>'), text.replace(b'axis xyz="0 0 1"', b"axis")
    with pytest.warns(PincalWarning, match=r"joint a .line 1. has an <axis> without xyz; it is read as 1 0 0"):
        robot = Robot.from_urdf(plain)
    q = np.array([[0.3, -0.5]])

    np.testing.assert_allclose(robot.forward_kinematics(q), Robot.from_urdf(written).forward_kinematics(q), atol=1e-15)
    assert len(robot.notes) == 2


def test_six_hundred_links_take_a_moment() -> None:
    """A long URDF of which a few joints are on the way costs no more than a short one: Pinocchio's tensors grow cubed."""
    links = [joint(f"j{i}", f"l{i}", f"l{i + 1}") for i in range(6)]
    beside = [joint(f"k{i}", "l0" if i % 100 == 0 else f"m{i - 1}", f"m{i}") for i in range(594)]
    start = time.process_time()
    robot = Robot.from_urdf(arm(*links, *beside), tip="l6")

    assert robot.n_joints == 6 and time.process_time() - start < 5.0


def test_frames_of_one_name_off_the_path_do_no_harm(rng: np.random.Generator) -> None:
    """A link and a joint may have one name, as URDF allows; Pinocchio can't reduce such a model, but need not."""
    text = arm(joint("a", "l0", "l1"), joint("side", "l0", "side"), joint("b", "l1", "l2"))
    robot = Robot.from_urdf(text, tip="l2")

    np.testing.assert_array_equal(robot.joint_names, ("a", "b"))
    assert Robot.from_urdf("b1_z1").joint_names[0] == "joint1"
    assert robot.forward_kinematics(robot.random_configurations(2, rng)).shape == (2, 4, 4)


@pytest.mark.parametrize(
    ("name", "tip", "last"),
    [
        ("so101", "gripper_frame_link", "wrist_roll"),
        ("z1", "link06", "joint6"),
        ("tiago", "hand_grasping_frame", "arm_7_joint"),
        ("g1_with_hands", "left_hand_palm_link", "left_wrist_yaw_joint"),
        ("baxter", "left_hand_link", "left_w2"),
        ("talos_arm", "wrist_left_ft_tool_link", "arm_left_7_joint"),
        ("finger_edu", "finger_tip_link", "finger_middle_to_lower_joint"),
    ],
)
def test_the_tip_is_no_finger(name: str, tip: str, last: str) -> None:
    """Of grippers and hands nothing moves; a robot that is a finger keeps its joints."""
    robot = Robot.from_urdf(name)

    assert (robot.tip, robot.joint_names[-1]) == (tip, last)


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
def test_a_planar_arm_of_two_joints_is_fitted(tmp_path: Path) -> None:
    """Rounding in what its frames absorb is more than its priors: no Cholesky factor exists."""
    assert run("simulate", "double_pendulum", "--poses", 60, "--seed", 1, "--out", tmp_path / "t.csv") == 0
    found = run_calibration(Robot.from_urdf("double_pendulum"), read_measurements(tmp_path / "t.csv", ("joint1", "joint2")))
    assert found.result.error["calibrated"]["test"]["rms_mm"] < 0.2
