"""Numbers by which the description of a robot is refused or read, on both sides of where they decide."""

from __future__ import annotations

import numpy as np
import pytest
from linkages import rod_arm

from pincal.errors import BadInputError, RobotFileError
from pincal.robot.robot import Robot
from pincal.robot.tree import Coupling

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")


def arm(*, limits: str = 'lower="-1" upper="1"', axis: str = "0 0 1") -> bytes:
    """Return the URDF of an arm of two joints, of which the second is described."""
    rest = 'effort="1" velocity="1"/>'
    return (
        '<robot name="two"><link name="a"/><link name="b"/><link name="c"/>'
        f'<joint name="ab" type="revolute"><parent link="a"/><child link="b"/><limit lower="-1" upper="1" {rest}</joint>'
        '<joint name="bc" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.5 0 0" rpy="1 0 0"/>'
        f'<axis xyz="{axis}"/><limit {limits} {rest}</joint></robot>'
    ).encode()


def read(text: bytes) -> Robot:
    return Robot.from_urdf(text)


def test_a_range_beyond_any_joint_is_no_limit() -> None:
    """A thousand radians are how URDFs say that a joint turns on."""
    bounded = read(arm(limits='lower="-499" upper="500"'))
    free = read(arm(limits='lower="-500" upper="501"'))

    assert (bounded.lower[1], bounded.upper[1]) == (-499.0, 500.0)
    assert (free.lower[1], free.upper[1]) == (-np.inf, np.inf)


def test_a_robot_of_less_than_a_gram_is_refused() -> None:
    """A mass is stated in kg."""
    assert Robot.from_urdf("ur10", mass=1.1e-3).masses.sum() > 0.0
    with pytest.raises(BadInputError, match=r"mass of the robot is 0\.0009 kg; expected 0\.001 to"):
        Robot.from_urdf("ur10", mass=0.9e-3)


@pytest.mark.parametrize(("length", "is_read"), [(1.1e-6, True), (0.9e6, True), (0.9e-6, False), (1.1e6, False)])
def test_an_axis_of_an_impossible_length_is_refused(length: float, is_read: bool) -> None:
    """An axis is a direction, of length 1 or somewhat off it; others have no digits left."""
    text = arm(axis=f"0 0 {length!r}")
    if is_read:
        np.testing.assert_allclose(read(text).frames.parameters, read(arm()).frames.parameters, rtol=0.0, atol=1e-12)
    else:
        with pytest.raises(RobotFileError, match=r"joint 'bc' has an axis of length .*; expected a direction of length 1"):
            read(text)


def test_couplings_that_do_not_determine_the_joints_are_refused() -> None:
    """Two joints that report nearly each other's position tell only one of the two."""
    robot = Robot.from_urdf("ur10")
    one, other = "elbow_joint", "shoulder_lift_joint"
    reported = np.full((1, 6), 0.3)

    def coupled(share: float) -> Robot:
        return robot.with_couplings(Coupling(one, other, 1.0), Coupling(other, one, share))

    found = coupled(0.998)
    np.testing.assert_allclose(found.as_reported(found.from_reported(reported)), reported, atol=1e-9)
    with pytest.raises(BadInputError, match="do not determine the positions of the joints"):
        coupled(0.9995)


def rods(gap: float) -> Robot:
    """Return an arm whose rod leaves its plane by an amount that no joint can close [m]."""
    return read(rod_arm().replace(b'<parent_origin xyz="0 0 1.075"', f'<parent_origin xyz="0 {gap!r} 1.075"'.encode()))


def test_a_loop_may_be_as_loose_as_a_calibrated_one() -> None:
    """Joints close a loop but for the directions in which they do not move it, by 40 mm at most."""
    assert len(rods(0.035).passive) == len(rods(0.0).passive)
    with pytest.raises(RobotFileError, match=r"ends stay 4\d(\.\d)? mm or mrad apart"):
        rods(0.045)
