"""The true machine and its equilibrium against closed forms and independent code."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import yourdfpy
from machines import G, angles, kuka, planar, planar_arm, random_poses, sweep

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.errors import BadInputError, RobotFileError
from pincal.simulate import setup


def test_machine_without_errors_is_the_urdf() -> None:
    """FK equals yourdfpy's."""
    machine, robot = kuka(), yourdfpy.URDF.load(str(kuka_urdf_path()))
    q = random_poses(machine, 20)
    for joints, tip in zip(q, machine.tip(q), strict=True):
        robot.update_cfg(dict(zip(machine.names, joints, strict=True)))
        np.testing.assert_allclose(tip, robot.get_transform("tool0", "base_link"), rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", ["1 0 0", "0 -1 0", "0 0 -1", "0.6 0 0.8", "-1 0 0"])
def test_any_joint_axis_is_the_urdf(axis: str) -> None:
    """The working frames change nothing about where the tip is."""
    machine, model = (
        sim.TrueMachine.from_urdf(planar_arm(axis), tip="tip"),
        pin.buildModelFromXML(planar_arm(axis)),
    )
    data, q = model.createData(), random_poses(machine, 5)
    for joints, tip in zip(q, machine.tip(q), strict=True):
        pin.framesForwardKinematics(model, data, joints)
        expected = data.oMf[model.getFrameId("tip")].homogeneous
        np.testing.assert_allclose(tip, expected, rtol=0, atol=1e-13)
    products = machine.nominal.axes @ np.swapaxes(machine.nominal.axes, 1, 2)
    np.testing.assert_allclose(products, [np.eye(3)] * 2, atol=1e-15)


def test_a_base_frame_on_the_arm_leaves_the_joints_before_it_out() -> None:
    """Positions are given in the named base, and only the joints beyond it belong to the arm."""
    machine = sim.TrueMachine.from_urdf(planar_arm(), tip="tip", base="upper")
    assert machine.names == ("bend",)
    np.testing.assert_allclose(machine.tip([[0.0]])[0, :3, 3], [1.5, 0, 0], atol=1e-15)


def test_placement_errors_act_in_the_urdf_joint_frame() -> None:
    """An error of the second joint shifts the tip along the axes of that joint's frame."""
    errors = np.zeros((3, 6))
    errors[1, :3] = 1e-3, 2e-3, 3e-3
    moved = planar(placement_errors=errors).tip(np.zeros((1, 2))) - planar().tip(np.zeros((1, 2)))
    np.testing.assert_allclose(moved[0, :3, 3], [1e-3, 2e-3, 3e-3], atol=1e-15)


def test_joint_offsets_add_to_the_recorded_angle() -> None:
    """An offset equals a turned joint."""
    np.testing.assert_allclose(
        planar(joint_offsets=[0.01, -0.02]).tip(np.zeros((1, 2))), planar().tip([[0.01, -0.02]]), atol=1e-15
    )


# Loads and equilibrium


def test_drive_loads_are_pinocchios_generalised_gravity() -> None:
    """Without deformation the moment about each axis is minus Pinocchio's gravity torque, with a payload."""
    machine, model = kuka(), pin.buildModelFromUrdf(str(kuka_urdf_path()))
    com, q = np.array([0.1, -0.05, 0.2]), random_poses(kuka(), 10)
    tool = model.frames[model.getFrameId("tool0")]
    body = pin.Inertia(125.0, tool.placement.act(com), np.zeros((3, 3)))
    model.inertias[6] = model.inertias[6] + body
    loads = machine.equilibrium(machine.poses(q, payload=125.0, payload_com=com)).loads
    data = model.createData()
    torques = [-pin.computeGeneralizedGravity(model, data, joints) for joints in q]
    np.testing.assert_allclose(loads.drive, torques, rtol=0, atol=1e-9)


def test_a_soft_joint_sags_by_the_closed_form() -> None:
    """The forearm sags by c m g l cos(q), and exactly by that at the angle where it comes to rest."""
    c, q = 1e-6, sweep(joint=1)
    sag = angles(planar(compliance=[[0, 0, 0], [0, 0, c]]), q)
    np.testing.assert_allclose(sag, -c * 5 * G * 0.25 * np.cos(q[:, 1] + sag), rtol=0, atol=1e-13)
    np.testing.assert_allclose(sag, -c * 5 * G * 0.25 * np.cos(q[:, 1]), rtol=1e-4, atol=1e-10)
    assert np.all(sag[1:-1] < 0)


@pytest.mark.parametrize("moment_frame", ["paper", "before", "after"])
def test_the_arm_is_at_rest(moment_frame: str) -> None:
    """The deformation is the one that the loads on the deformed arm make."""
    machine = kuka(compliance=np.full((6, 3), 4e-7), moment_frame=moment_frame)
    rest = machine.equilibrium(machine.poses(random_poses(machine, 30), payload=125.0))
    np.testing.assert_allclose(rest.deformation.joint, 4e-7 * rest.loads.drive, rtol=0, atol=1e-12)
    twist = rest.deformation.before if moment_frame == "before" else rest.deformation.after
    moment = rest.loads.after if moment_frame == "after" else rest.loads.before
    np.testing.assert_allclose(twist[..., 3:5], 4e-7 * moment[..., :2], rtol=0, atol=1e-12)


def test_moment_frames_differ_as_stated() -> None:
    """A column under a load sinks alike before and after q, and with cos(q) in the paper's frame."""
    c, q = 1e-6, np.column_stack((np.linspace(-2, 2, 9), np.zeros(9)))
    moment = G * (10 * 0.5 + 5 * 1.25)
    for frame, expected in (("before", 1.0), ("after", 1.0), ("paper", np.cos(q[:, 0]))):
        compliance = [[c, c, 0], [0, 0, 0]]
        machine = sim.TrueMachine.from_urdf(planar_arm("0 0 1"), tip="tip", compliance=compliance, moment_frame=frame)
        drop = machine.tip(q)[:, 2, 3] - 0.4
        np.testing.assert_allclose(drop, -1.5 * c * moment * expected, rtol=0, atol=1e-7)


def test_gravity_can_point_elsewhere() -> None:
    """On a wall mount gravity along the arm makes no moment when it hangs straight."""
    rest = planar(gravity=(G, 0.0, 0.0))
    loads = rest.equilibrium(rest.poses(np.zeros((1, 2)))).loads
    np.testing.assert_allclose(loads.drive, 0.0, atol=1e-12)


def test_true_masses_change_the_loads() -> None:
    """Twice the mass, or twice the lever, makes twice the load."""
    q = np.zeros((1, 2))
    for errors in ({"mass_factors": [2, 2]}, {"com_errors": [[0, 0, 0], [0.25, 0, 0]]}):
        machine = planar(**errors)
        loads = machine.equilibrium(machine.poses(q)).loads
        assert loads.drive[0, 1] == pytest.approx(-2 * 5 * G * 0.25)


def test_an_arm_too_soft_is_refused() -> None:
    """A compliance under which the arm collapses is an error."""
    with pytest.raises(BadInputError, match="no equilibrium"):
        planar(compliance=np.full((2, 3), 1.0)).tip(np.zeros((1, 2)))


def test_unknown_frames_files_and_attributes_are_refused() -> None:
    """The arm has to exist and its attributes have to fit."""
    with pytest.raises(RobotFileError, match="expected one of base"):
        sim.TrueMachine.from_urdf(planar_arm(), tip="flange")
    with pytest.raises(RobotFileError, match="no joint between"):
        sim.TrueMachine.from_urdf(planar_arm(), tip="tip", base="fore")
    with pytest.raises(RobotFileError, match="several freedoms"):
        sim.TrueMachine.from_urdf(planar_arm().replace("revolute", "floating"), tip="tip")
    with pytest.raises(RobotFileError, match="URDF text"):
        sim.TrueMachine.from_urdf("<robot", tip="tip")
    with pytest.raises(RobotFileError, match="no such file"):
        sim.TrueMachine.from_urdf("missing.urdf", tip="tip")
    with pytest.raises(BadInputError, match="stiffness: unknown"):
        planar(stiffness=1.0)
    with pytest.raises(BadInputError, match=r"compliance has shape \(3, 3\); expected \(2, 3\)"):
        planar(compliance=np.zeros((3, 3)))
    with pytest.raises(BadInputError, match=r"expected \(N, 2\)"):
        planar().tip(np.zeros((4, 3)))


@pytest.mark.long
def test_tips_are_the_same_piece_by_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses are worked out a few at a time, in less memory; a joint that is dragged along follows them all the same."""
    monkeypatch.setattr(setup, "_PIECE", 40)
    soft = replace(kuka(), compliance=np.full((6, 3), 1e-7))
    poses = soft.poses(random_poses(soft, 500), payload=125.0)
    peaks = []
    for machine in (soft, soft.with_effects(sim.Backlash(joint="joint_2", size=2e-4))):
        whole = machine.equilibrium(poses).tip.copy()
        tracemalloc.start()
        found = setup.tips_of(machine, poses)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        np.testing.assert_allclose(found, whole, rtol=0.0, atol=1e-11)  # at rest to 1e-12 rad, some metres away
    assert peaks[0] < 0.25 * peaks[1]
