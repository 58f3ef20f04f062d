"""The built-in KUKA KR 125/2 against Table I of the paper."""

from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
import yourdfpy

from pincal.builtin import kuka_urdf_path

# Table I, initial estimates: o, d, a, alpha of joints 1 to 6 [rad and m].
TABLE_I = [
    (0.0, 0.865, 0.41, np.pi / 2),
    (0.0, 0.0, 1.0, 0.0),
    (np.pi / 2, 0.0, 0.045, np.pi / 2),
    (0.0, 1.0, 0.0, -np.pi / 2),
    (0.0, 0.0, 0.0, np.pi / 2),
    (np.pi, 0.21, 0.0, 0.0),
]
NAMES = [f"joint_{i}" for i in range(1, 7)]


def dh_product(q: np.ndarray) -> np.ndarray:
    """Return S_6 in S_0 as the product of Eq. (1)."""
    transform = np.eye(4)
    for angle, (offset, d, a, alpha) in zip(q, TABLE_I, strict=True):
        co, so = np.cos(angle + offset), np.sin(angle + offset)
        ca, sa = np.cos(alpha), np.sin(alpha)
        link = [
            [co, -so * ca, so * sa, a * co],
            [so, co * ca, -co * sa, a * so],
            [0, sa, ca, d],
            [0, 0, 0, 1],
        ]
        transform = transform @ np.array(link)
    return transform


@pytest.fixture(scope="module")
def model() -> pin.Model:
    """Return the robot as Pinocchio reads it."""
    return pin.buildModelFromUrdf(str(kuka_urdf_path()))


@pytest.fixture(scope="module")
def robot() -> yourdfpy.URDF:
    """Return the robot as yourdfpy reads it."""
    return yourdfpy.URDF.load(str(kuka_urdf_path()))


def random_joints(model: pin.Model, count: int) -> np.ndarray:
    """Return joint positions within the limits, shape (count, 6)."""
    rng = np.random.default_rng(7)
    return rng.uniform(model.lowerPositionLimit, model.upperPositionLimit, (count, 6))


def test_pinocchio_fk_is_the_dh_product_of_table_1(model: pin.Model) -> None:
    """FK from base_link to tool0 is the product of the DH matrices."""
    data = model.createData()
    for q in random_joints(model, 50):
        pin.framesForwardKinematics(model, data, q)
        tool = data.oMf[model.getFrameId("tool0")].homogeneous
        np.testing.assert_allclose(tool, dh_product(q), rtol=0, atol=1e-12)


def test_yourdfpy_fk_is_the_dh_product_of_table_1(model: pin.Model, robot: yourdfpy.URDF) -> None:
    """A second reader of the file places the flange at the same pose."""
    for q in random_joints(model, 10):
        robot.update_cfg(dict(zip(NAMES, q, strict=True)))
        np.testing.assert_allclose(robot.get_transform("tool0", "base_link"), dh_product(q), rtol=0, atol=1e-12)


def test_joints_are_named_and_turn_about_z(robot: yourdfpy.URDF) -> None:
    """Joints 1 to 6 are revolute about z of their frames."""
    assert robot.actuated_joint_names == NAMES
    for name in NAMES:
        joint = robot.joint_map[name]
        assert joint.type == "revolute"
        np.testing.assert_array_equal(joint.axis, [0, 0, 1])


def test_masses_add_up_to_975_kg() -> None:
    """All links with base_link weigh 975 kg, and the flange frame nothing."""
    root = ElementTree.parse(kuka_urdf_path()).getroot()
    masses = [float(element.attrib["value"]) for element in root.iter("mass")]
    assert sum(masses) == pytest.approx(975.0)
    assert root.find("link[@name='tool0']/inertial") is None


def test_centres_of_mass_lie_off_every_axis(model: pin.Model) -> None:
    """Every moving link's centre of mass has a part along all three axes."""
    for inertia in list(model.inertias)[1:]:
        assert np.all(np.abs(inertia.lever) > 1e-3)


def test_inertias_are_physical(model: pin.Model) -> None:
    """Principal moments are positive and none exceeds the sum of the others."""
    for inertia in list(model.inertias)[1:]:
        small, middle, large = np.linalg.eigvalsh(inertia.inertia)
        assert small > 0 and large <= small + middle


def test_limits_have_the_ranges_of_the_robot(model: pin.Model) -> None:
    """A2 sweeps 150 deg and A3 274 deg, and the arm can stand upright with the forearm to the front."""
    spans = np.degrees(model.upperPositionLimit - model.lowerPositionLimit)
    np.testing.assert_allclose(spans, [370, 150, 274, 700, np.degrees(4.2), 700], atol=0.01)
    ready = np.array([0, np.pi / 2, -np.pi / 2, 0, 0, 0])
    assert np.all((ready > model.lowerPositionLimit) & (ready < model.upperPositionLimit))
    np.testing.assert_allclose(dh_product(ready)[:3, 3], [0.41 + 1.21, 0, 0.865 + 1.0 + 0.045], atol=1e-12)


def test_every_link_is_drawn_in_colour(robot: yourdfpy.URDF) -> None:
    """Every link with mass has visuals whose materials the file defines."""
    for link in robot.robot.links:
        if link.inertial is None:
            continue
        assert link.visuals
        assert all(visual.material.name in robot._material_map for visual in link.visuals)
