"""Simulated measurements: columns, frames, noise, planning, contacts and cameras."""

import numpy as np
import pinocchio as pin
import pytest
from machines import READY, kuka, random_poses

from pincal import simulate as sim
from pincal.errors import BadInputError


def test_seeds_reproduce_machine_poses_and_table() -> None:
    """The same seed gives the same numbers, another seed others."""

    def table(seed: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(seed)
        machine = kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3).draw_masses(rng)
        machine = machine.with_effects(sim.JointScatter(joint="joint_2", size=1e-4))
        return sim.Instrument(sigma=1e-5).measure(machine, random_poses(machine, 5, seed), rng=rng)

    first, again, other = table(1), table(1), table(2)
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert not np.allclose(first["x"], other["x"])


def test_noise_has_its_sigma_and_can_be_left_out() -> None:
    """Noisy minus noise-free readings of the same rows spread by sigma."""
    machine, q = kuka(), random_poses(kuka(), 2000)
    noisy = sim.Instrument(sigma=5e-5).measure(machine, q, rng=np.random.default_rng(1))
    truth = sim.Instrument().measure(machine, q)
    assert np.std(noisy["x"] - truth["x"]) == pytest.approx(5e-5, rel=0.05)
    np.testing.assert_array_equal(truth["x"], machine.tip(q)[:, 0, 3])
    with pytest.raises(BadInputError, match="rng"):
        sim.Instrument(sigma=5e-5).measure(machine, q)


def test_columns_are_those_of_the_contract() -> None:
    """Each kind writes its columns; conditions appear when declared and unless hidden."""
    machine, q = kuka(), random_poses(kuka(), 3)
    joints = set(machine.names)
    assert set(sim.Instrument().measure(machine, q)) == joints | {"x", "y", "z"}
    assert set(sim.Instrument(reads="pose").measure(machine, q)) == joints | {"x", "y", "z", "qx", "qy", "qz", "qw"}
    assert set(sim.Instrument(reads="distance").measure(machine, q)) == joints | {"distance"}
    conditions = {"payload": 10.0, "temperature": 25.0, "time": 0.0, "approach": {"joint_2": 1}}
    full = sim.Instrument().measure(machine, q, hide={"temperature"}, **conditions)
    assert {"payload", "time", "approach_joint_2"} <= set(full) and "temperature" not in full
    with pytest.raises(BadInputError, match="position, pose, distance"):
        sim.Instrument(reads="speed")


def test_several_targets_give_a_row_each() -> None:
    """Rows go through the targets of one pose before the next pose."""
    offsets = {"A": (0.1, 0.0, 0.0), "B": (0.0, 0.1, 0.05)}
    table = sim.Instrument(targets=offsets).measure(kuka(), np.repeat(READY, 2, axis=0))
    assert table["target"].tolist() == ["A", "B", "A", "B"]
    tip = kuka().tip(READY)[0]
    for name, row in (("A", 0), ("B", 1)):
        seen = [table[axis][row] for axis in "xyz"]
        np.testing.assert_allclose(seen, tip[:3, :3] @ offsets[name] + tip[:3, 3], atol=1e-15)


def test_instrument_frame_pose_and_distance_agree() -> None:
    """Readings are in the frame of the instrument, quaternions included."""
    from scipy.spatial.transform import Rotation

    frame = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 1.3), np.array([2.0, -1.0, 0.5])).homogeneous
    expected = frame @ kuka().tip(READY)[0]
    pose = sim.Instrument(pose=frame, reads="pose").measure(kuka(), READY)
    np.testing.assert_allclose([pose[axis][0] for axis in "xyz"], expected[:3, 3], atol=1e-14)
    turn = Rotation.from_quat([pose[f"q{axis}"][0] for axis in "xyzw"]).as_matrix()
    np.testing.assert_allclose(turn, expected[:3, :3], atol=1e-14)
    distance = sim.Instrument(pose=frame, reads="distance").measure(kuka(), READY)["distance"]
    assert distance[0] == pytest.approx(np.linalg.norm(expected[:3, 3]), abs=1e-14)


def test_planned_poses_keep_limits_and_floor() -> None:
    """All joints are within their limits, and elbow, wrist and tip above the floor."""
    machine = kuka()
    q = sim.plan_poses(machine.nominal, 200, np.random.default_rng(0), min_height=0.3, max_radius=2.5)
    assert q.shape == (200, 6)
    assert np.all((q >= machine.nominal.lower) & (q <= machine.nominal.upper))
    tip = machine.tip(q)[:, :3, 3]
    assert tip[:, 2].min() > 0.3 and np.linalg.norm(tip, axis=1).max() < 2.5
    with pytest.raises(BadInputError, match="relax"):
        sim.plan_poses(machine.nominal, 3, np.random.default_rng(0), min_height=9.0)


def test_contacts_hold_the_tool_point_in_its_socket() -> None:
    """The true machine, elastic and wrong as it is, has its tool point at the socket."""
    rng, tool = np.random.default_rng(2), (0.1, 0.0, 0.2)
    machine = kuka(compliance=np.full((6, 3), 2e-7)).draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    sockets = {"A": (1.4, 0.3, 0.8), "B": (1.2, -0.6, 0.5)}
    setup = sim.Contact(fixed=sockets, tool=tool)
    q = setup.plan(machine.nominal, 20, rng=rng)
    table = setup.measure(machine, q, rng=rng, payload=50.0)
    tip = machine.tip(np.column_stack([table[name] for name in machine.names]), payload=50.0)
    points = tip[:, :3, :3] @ tool + tip[:, :3, 3]
    expected = [sockets[str(name)] for name in table["socket"]]
    np.testing.assert_allclose(points, expected, rtol=0, atol=1e-12)


def test_camera_sees_points_where_they_are() -> None:
    """Camera coordinates lead back to the point in the base frame, and the image agrees with them."""
    machine, rng = kuka(), np.random.default_rng(4)
    camera, points = np.eye(4), {"P": (1.6, 0.0, 0.4), "Q": (1.625, 0.0, 0.4)}
    camera[:3, 3] = 0.05, 0.0, 0.1
    q = sim.plan_views(machine.nominal, 8, rng=rng, view=sim.View(camera_pose=camera, look_at=points["P"]))
    target = sim.CalibrationObject.of_points(points)
    table = sim.EyeInHand(camera_pose=camera, target=target, in_metres=True).measure(machine, q)
    seen = np.column_stack([table[name] for name in ("cx", "cy", "cz")])
    frames = np.repeat(machine.tip(q) @ camera, 2, axis=0)
    back = np.einsum("nab,nb->na", frames[:, :3, :3], seen) + frames[:, :3, 3]
    np.testing.assert_allclose(back, [points[str(name)] for name in table["point"]], atol=1e-12)
    assert np.all(np.hypot(seen[:, 0], seen[:, 1]) < 0.2 * seen[:, 2])
    image = sim.EyeInHand(camera_pose=camera, target=target, lens=sim.Lens(focal=1000.0, k1=0.1)).measure(machine, q)
    slope = seen[:, 0] / seen[:, 2]
    radius = np.hypot(seen[:, 0], seen[:, 1]) / seen[:, 2]
    np.testing.assert_allclose(image["u"], 1024 + 1000 * slope * (1 + 0.1 * radius**2), atol=1e-9)
