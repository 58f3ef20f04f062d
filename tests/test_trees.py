"""Robots with several arms: any two links, moments of the whole tree, against Pinocchio."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pinocchio as pin
import pytest
from _pytest.mark import ParameterSet
from example_robot_data import robots_loader

from pincal.errors import RobotFileError
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.robot.robot import Robot
from pincal.robot.tree import MOVING_TYPES, UrdfTree
from pincal.robot.urdf_file import find_file, read_urdf

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

EXACT = 1e-12
# Joints of one robot of each kind: two arms, a humanoid, a lifting torso with a head.
QUICK = ("baxter", "talos", "tiago_pro")
# And before each commit: grippers with joints that turn for ever or slide, legs, legs with one or two arms, a hand, bodies
# with and without sliding joints and mimics, fingers by the dozen. Before a release all; the others are variants of these.
OF_EACH_KIND = (
    *("bravo7_gripper", "panda", "anymal", "bolt", "anymal_kinova", "centauro", "allegro_right_hand", "human", "icub"),
    *("alex_sake_hands", "romeo", "pr2", "talos_full", "tiago"),
)
# Pairs of tips of one robot that are looked at: hands have many fingers.
MOST_PAIRS = 40


def tips_of(tree: UrdfTree) -> list[str]:
    """Return the links behind which nothing moves."""
    moving = [joint for joint in tree.joints if joint.kind in MOVING_TYPES]
    carrying = {above.name for joint in moving for above in tree.above(joint.parent)}
    return [joint.child for joint in moving if joint.name not in carrying]


def trees() -> list[str]:
    """Return the robots of example-robot-data that have several tips, each file once."""
    found: dict[object, str] = {}
    for name in robots_loader.ROBOTS:
        try:
            found.setdefault(find_file(name), name)
        except RobotFileError:
            continue
    return [name for path, name in found.items() if len(tips_of(read_urdf(str(path)))) > 1]


def marked(name: str) -> ParameterSet:
    """Return a robot with the marks of when it is looked at."""
    others = () if name in OF_EACH_KIND else (pytest.mark.rates,)
    return pytest.param(name, marks=() if name in QUICK else (pytest.mark.long, *others))


TREES = [marked(name) for name in trees()]


@pytest.mark.long
@pytest.mark.parametrize("name", TREES)
def test_any_two_links_stand_to_each_other_as_pinocchio_has_them(name: str, rng: np.random.Generator) -> None:
    """From the root to every tip and from tip to tip, as a robot of its own and as a path of the whole tree."""
    tree = read_urdf(str(find_file(name)))
    tips = tips_of(tree)
    pairs = [*((tree.root, tip) for tip in tips), *combinations(tips, 2)]
    if name == "alex_psyonic_hands":
        pytest.skip("joints of its hands mimic joints that its URDF does not have")
    whole = Robot.from_urdf(name, start=tree.root, tip=tips[0], paths=[(tree.root, tip) for tip in tips[1:]])
    q = whole.random_configurations(3, rng)
    for start, tip in pairs[:: -(-len(pairs) // MOST_PAIRS)]:
        part, path = Robot.from_urdf(name, start=start, tip=tip), whole.between(start, tip)
        own = q[:, [whole.joint_names.index(joint) for joint in part.joint_names]]
        found = Model(Chain.of(part), ()).predict(np.zeros(0), Conditions.at(own))
        np.testing.assert_allclose(found, part.forward_kinematics(own)[:, :3], rtol=0.0, atol=EXACT)
        found = Model(Chain.of(whole, path=path), ()).predict(np.zeros(0), Conditions.at(q))
        np.testing.assert_allclose(found, whole.forward_kinematics(q, path)[:, :3], rtol=0.0, atol=EXACT)


@pytest.mark.parametrize("name", TREES)
def test_each_joint_bears_what_hangs_on_its_side_of_the_tree(name: str, rng: np.random.Generator) -> None:
    """The moment about each axis is minus the generalised gravity of the whole tree, whatever the path."""
    tree = read_urdf(str(find_file(name)))
    tips = tips_of(tree)
    if name == "alex_psyonic_hands":
        pytest.skip("joints of its hands mimic joints that its URDF does not have")
    robot = Robot.from_urdf(name, start=tree.root, tip=tips[0], paths=[(tree.root, tip) for tip in tips[1:]])
    if robot.massless:
        pytest.skip("not all of its links have masses")
    q = robot.random_configurations(4, rng)
    model = robot.pinocchio_model()
    data, places = model.createData(), [model.joints[model.getJointId(joint)].idx_v for joint in robot.joint_names]
    rows = (robot.configuration(model, row) for row in q)
    expected = np.array([-pin.computeGeneralizedGravity(model, data, row)[places] for row in rows])
    revolute = np.array([kind == "revolute" for kind in robot.joint_types])
    for start, tip in ((tree.root, tips[0]), (tips[0], tips[-1])):
        chain = Chain.of(robot, path=robot.between(start, tip))
        found = Model(chain, ()).static_moments(np.zeros(0), Conditions.at(q))[:, 2::3]
        np.testing.assert_allclose(found[:, revolute], expected[:, revolute], atol=EXACT * np.abs(expected).max())


def test_a_path_passes_joints_backwards_and_along() -> None:
    """Up from one hand to where both hang on, and down to the other; the torso is on neither side."""
    robot = Robot.from_urdf("talos", start="arm_right_7_link", tip="arm_left_7_link")
    steps = [(robot.joint_names[joint], sign) for joint, sign in robot.path.steps(robot.parents)]

    assert steps == [
        *((f"arm_right_{i}_joint", -1) for i in range(7, 0, -1)),
        *((f"arm_left_{i}_joint", 1) for i in range(1, 8)),
    ]
    assert set(robot.joint_names) == {joint for joint, _ in steps}


def test_joints_off_a_path_move_what_it_bears() -> None:
    """A joint that is named moves in the model, and the others of the URDF stay locked."""
    alone = Robot.from_urdf("talos", tip="arm_left_7_link")
    both = Robot.from_urdf("talos", tip="arm_left_7_link", others=("arm_right_2_joint",))
    q = np.zeros((2, both.n_joints))
    q[1, both.joint_names.index("arm_right_2_joint")] = -1.0
    moments = Model(Chain.of(both), ()).static_moments(np.zeros(0), Conditions.at(q))

    assert set(both.joint_names) - set(alone.joint_names) == {"arm_right_2_joint"}
    torso = 3 * both.joint_names.index("torso_1_joint")
    assert np.abs(np.diff(moments, axis=0))[0, torso : torso + 3].max() > 1.0


def test_links_that_are_not_there_or_locked_are_refused() -> None:
    """With what there is."""
    with pytest.raises(RobotFileError, match=r"unknown link 'arm_left_8_link'.*arm_left_7_link"):
        Robot.from_urdf("talos", start="base_link", tip="arm_left_8_link")
    with pytest.raises(RobotFileError, match="no moving joint between 'torso_2_link' and 'torso_2_link'"):
        Robot.from_urdf("talos", start="torso_2_link", tip="torso_2_link")
    with pytest.raises(RobotFileError, match="no moving joint 'elbow'"):
        Robot.from_urdf("talos", tip="arm_left_7_link", others=("elbow",))
    robot = Robot.from_urdf("talos", tip="arm_left_7_link")
    with pytest.raises(RobotFileError, match=r"'arm_right_1_joint' between .* is locked in this robot"):
        robot.between("base_link", "arm_right_7_link")
