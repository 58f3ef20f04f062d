"""Robots with closed loops: parallelograms, rods and four-bars, against Pinocchio's constraint models."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from command_line import run
from linkages import WAYS, four_bar, palletizer, rod_arm
from pairs import in_pairs
from test_model import (
    EFFECTS,
    TILTED,
    Augmented,
    central_differences,
    chain_of,
    conditions_of,
    unit_of,
    values_of,
)

import pincal
from pincal import Options, measurements_from_arrays
from pincal import simulate as sim
from pincal.errors import PincalWarning, RobotFileError
from pincal.model.catalogue.transmission import TransmissionError
from pincal.model.chain import MOMENT_FRAMES, Chain, MomentFrame
from pincal.model.conditions import Conditions
from pincal.model.effects import ELASTIC, GEOMETRIC, BearingElasticity, JointElasticity
from pincal.model.model import Model
from pincal.model.sparse_basis import dense_rows
from pincal.report.judgement import narrow_joints
from pincal.robot.robot import Robot
from pincal.simulate.arm import frames
from pincal.simulate.planning import plan_poses, point_at, reach
from pincal.simulate.rods import following
from pincal.validate.cures import descriptions

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

ROBOTS: dict[str, tuple[Callable[[str], bytes], str]] = {
    "palletizer": (palletizer, "tool0"),
    "palletizer on balls": (partial(palletizer, kind="spherical"), "tool0"),
    "rod arm": (rod_arm, "tool0"),
    "rod arm, no parallelogram": (partial(rod_arm, skew=0.05), "tool0"),
    "four-bar": (four_bar, "tip"),
}
READ = {"palletizer": 4, "palletizer on balls": 4, "rod arm": 6, "rod arm, no parallelogram": 6, "four-bar": 1}
CLOSED = 1e-12


def constraints(model: pin.Model, urdf: bytes) -> list[pin.RigidConstraintModel]:
    """Return Pinocchio's models of a URDF's constraints: the points of both links are one."""
    found = []
    for element in ElementTree.fromstring(urdf).iterfind("constraint"):
        ends = []
        for role in ("parent", "child"):
            frame = model.frames[model.getFrameId(element.find(role).get("link"), pin.BODY)]
            origin = np.array(element.find(f"{role}_origin").get("xyz").split(), float)
            ends += [frame.parentJoint, frame.placement * pin.SE3(np.eye(3), origin)]
        found.append(pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, model, *ends, pin.LOCAL))
    return found


def projected(model: pin.Model, loops: list[pin.RigidConstraintModel], q: np.ndarray, passive: list[int]) -> np.ndarray:
    """Return configuration q, shape (nq,), with Pinocchio's constraints met by some of its velocities."""
    data, of_loops = model.createData(), [loop.createData() for loop in loops]
    for _ in range(30):
        pin.computeJointJacobians(model, data, q)
        pairs = list(zip(loops, of_loops, strict=True))
        for loop, its in pairs:
            loop.calc(model, data, its)
        # The motion of the first point in its own axes, less that of the second.
        J = np.vstack([pin.getConstraintJacobian(model, data, loop, its) for loop, its in pairs])
        gap = np.concatenate([its.c1Mc2.translation for _, its in pairs])
        v = np.zeros(model.nv)
        v[passive] = np.linalg.lstsq(J[:, passive], gap, rcond=1e-6)[0]
        q = pin.integrate(model, q, v)
    return q


@pytest.mark.parametrize("name", ROBOTS)
def test_passive_joints_stand_where_pinocchio_closes_the_loops(name: str, rng: np.random.Generator) -> None:
    """From positions nearby Pinocchio's constraint models come back to ours, which leave them closed to rounding."""
    describe, tip = ROBOTS[name]
    robot = Robot.from_urdf(describe("constraint"), tip=tip)
    model = robot.pinocchio_model()
    loops = constraints(model, robot.urdf)
    passive = [model.joints[model.getJointId(joint)].idx_v for joint in robot.passive]
    q = robot.random_configurations(20, rng)
    near = q.copy()
    near[:, [robot.joint_names.index(joint) for joint in robot.passive]] += rng.uniform(-0.02, 0.02, (20, len(passive)))
    for row, start in zip(q, near, strict=True):
        found = projected(model, loops, robot.configuration(model, start), passive)
        np.testing.assert_allclose(found, robot.configuration(model, row), atol=CLOSED * 100)

    assert len(robot.own_joints) == READ[name]
    assert np.abs(robot.linkage.equations(q)[0]).max() < CLOSED


@pytest.mark.parametrize("name", ROBOTS)
def test_all_ways_of_writing_a_loop_mean_the_same(name: str, rng: np.random.Generator) -> None:
    """A constraint, a joint of Gazebo (which closes as it stands at zero positions) and a second joint of one link."""
    describe, tip = ROBOTS[name]
    # A URDF has no joints on balls, and where bars are not equal zero positions are none of the loop.
    unfit = {"rod arm, no parallelogram": "gazebo", "palletizer on balls": "second joint"}
    ways = [way for way in WAYS if way != unfit.get(name)]
    robots = [Robot.from_urdf(describe(way), tip=tip) for way in ways]
    own = robots[0].random_configurations(20, rng)[:, robots[0].own_joints]
    tips = [robot.forward_kinematics(robot.spread(own)) for robot in robots]

    for robot, found in zip(robots, tips, strict=True):
        assert robot.joint_names == robots[0].joint_names and robot.passive == robots[0].passive
        np.testing.assert_allclose(found, tips[0], atol=1e-11)


def test_a_mimicked_parallelogram_is_the_same_robot(rng: np.random.Generator) -> None:
    """Where bars are equal in pairs, joints that mimic others stand where the rods put them."""
    rods, mimicked = Robot.from_urdf(palletizer()), Robot.from_urdf(palletizer("mimic"))
    drives = [f"joint_{i}" for i in (1, 2, 3, 4)]
    q = rods.random_configurations(20, rng)
    own = q[:, [rods.joint_names.index(name) for name in drives]]
    other = np.zeros((20, mimicked.n_joints))
    other[:, [mimicked.joint_names.index(name) for name in drives]] = own

    assert not mimicked.passive
    tips = mimicked.forward_kinematics(mimicked.following(other))
    np.testing.assert_allclose(rods.forward_kinematics(q), tips, atol=1e-11)
    np.testing.assert_allclose(tips[:, 2, 2], 1.0, atol=1e-12)


DRIVES = ["joint_1", "joint_2", "joint_3", "joint_4"]
REFUSED = {
    "a drive without a reading": (
        palletizer(),
        {"joints": ["joint_1", "joint_2", "joint_4"]},
        "without a reading.* joint_3",
    ),
    "a rod that is too short": (
        rod_arm().replace(b'<parent_origin xyz="0 0 1.075"', b'<parent_origin xyz="0 0 0.075"'),
        {},
        r"closed by rod_head ends stay \d+ mm or mrad apart",
    ),
    "a loop that is stiff": (
        four_bar().replace(b'"knee" type="revolute"', b'"knee" type="fixed"'),
        {"tip": "tip"},
        "can move",
    ),
    "a pin that slides": (palletizer(kind="prismatic"), {}, "'rod_head' closes a loop and is prismatic; expected one of"),
    "a rod on no link": (palletizer().replace(b'<child link="hand"/><child_o', b'<child link="hnd"/><child_o'), {}, "'hnd'"),
    "a base inside": (palletizer(), {"base": "lower_arm"}, "base 'lower_arm' is in a loop"),
    "a rod of words": (
        palletizer().replace(b'xyz="0 0.01 0.9"', b'xyz="0 0.01 long"'),
        {},
        "<parent_origin>.*'0 0.01 long'",
    ),
}


@pytest.mark.parametrize(("text", "ends", "words"), REFUSED.values(), ids=REFUSED.keys())
def test_loops_that_cant_be_are_refused_by_name(text: bytes, ends: dict[str, str], words: str) -> None:
    """With the joint or constraint, and what would do."""
    with pytest.raises(RobotFileError, match=words) as caught:
        Robot.from_urdf(text, **ends)

    assert str(caught.value).startswith("URDF:")


def test_a_misspelt_drive_of_a_loop_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Beside the joint whose reading is asked for; a column of another name is no slip."""
    robot, table = tmp_path / "robot.urdf", tmp_path / "rows.csv"
    robot.write_bytes(palletizer())
    for name, hint in (("jiont_3", ' (is it "jiont_3" of rows.csv?)'), ("travel", "")):
        table.write_text(f"joint_1,joint_2,{name},joint_4,x,y,z\n0,0.1,0.2,0,1,0,1\n0.1,0.2,0.1,0.3,1,0.1,1.1\n")
        assert run("check", robot, table, "--cell", "none") == 3
        assert f"1 without a reading; expected a column of joint_3{hint}\n" in capsys.readouterr().err


def test_readings_decide_which_joints_follow() -> None:
    """Those without; of more than the loops leave free the ones that most joints carry, and that is said."""
    robot = Robot.from_urdf(palletizer(), joints=["joint_1", "joint_2", "elbow", "joint_4"])
    assert set(robot.passive) == {"joint_3", "rod_foot", "strut_1_foot", "strut_2_foot", "triangle", "wrist"}
    with pytest.warns(PincalWarning, match="readings of wrist are not used: the loops determine these positions"):
        robot = Robot.from_urdf(palletizer(), joints=[*DRIVES, "wrist"])
    assert [robot.joint_names[i] for i in robot.own_joints] == DRIVES


@pytest.mark.long
def test_rods_are_not_asked_for_couplings() -> None:
    """A table that agrees badly was refused by the name of a joint that has no column."""
    robot = Robot.from_urdf(palletizer())
    q = robot.random_configurations(9, np.random.default_rng(0))
    table = measurements_from_arrays(robot.joint_names, q, position=np.zeros((9, 3)))
    found = [c.couplings for cure in descriptions(robot, table) if (c := cure.correction) is not None and c.couplings]

    own = {robot.joint_names[i] for i in robot.own_joints}
    assert found and {name for (one,) in found for name in (one.joint, one.source)} <= own


def test_a_loop_that_mimics_is_described_by_that() -> None:
    """What closes it for a simulator is not needed beside it."""
    text = palletizer("mimic").replace(
        b"</robot>",
        b'<gazebo><joint name="rod" type="revolute"><parent>lower_arm</parent><child>hand</child></joint></gazebo></robot>',
    )
    assert not Robot.from_urdf(text).closures


@pytest.mark.parametrize("name", ROBOTS)
def test_how_passive_joints_follow_is_exact(name: str, rng: np.random.Generator) -> None:
    """Rates by the drives equal finite differences."""
    describe, tip = ROBOTS[name]
    robot = Robot.from_urdf(describe("constraint"), tip=tip)
    q, h = robot.random_configurations(10, rng), 1e-5
    rates = robot.linkage.rates(q)
    for k, joint in enumerate(robot.linkage.drivers):
        step = h * np.eye(robot.n_joints)[joint]
        slope = (robot.following(q + step) - robot.following(q - step))[:, robot.linkage.passive] / (2 * h)
        np.testing.assert_allclose(rates[:, :, k], slope, atol=1e-7 * max(1.0, np.abs(rates).max()))


def test_the_assembly_is_that_of_the_urdf() -> None:
    """A four-bar is led round from zero: it does not fold over to its other assembly on the way."""
    robot = Robot.from_urdf(four_bar(), tip="tip")
    turn = np.linspace(0.0, 4 * np.pi, 200)[:, None]
    q = robot.spread(turn)

    np.testing.assert_allclose(q[0], 0.0, atol=1e-12)
    assert np.abs(np.diff(q, axis=0)).max() < 0.3
    np.testing.assert_allclose(q[-1, 1:] % (2 * np.pi), q[0, 1:] % (2 * np.pi), atol=1e-9)


# --- the calibrated model ---------------------------------------------------------------------------------------------

MODELS = {"palletizer": palletizer(), "rod arm, no parallelogram": rod_arm(skew=0.05)}


@cache
def linkage(name: str) -> Robot:
    """Return one of the robots, read once."""
    return Robot.from_urdf(MODELS[name])


@pytest.fixture(scope="module", params=MODELS)
def looped(request: pytest.FixtureRequest) -> Robot:
    """Return robots of one loop and of three, one of them no parallelogram."""
    return linkage(request.param)


@pytest.mark.parametrize("moment_frame", MOMENT_FRAMES)
@pytest.mark.parametrize("name", ["geometric", "all"])
def test_zero_parameters_give_the_nominal_robot(
    looped: Robot, name: str, moment_frame: MomentFrame, rng: np.random.Generator
) -> None:
    """The tip stands where Pinocchio has it, and stays where passive joints are said to stand elsewhere."""
    model = Model(Chain.of(looped, moment_frame=moment_frame), EFFECTS[name])
    conditions = conditions_of(looped, 9, rng, targets=1)
    expected = looped.forward_kinematics(conditions.q)[:, :3]
    passive = [looped.joint_names.index(joint) for joint in looped.passive]
    conditions.q[:, passive] += rng.uniform(-0.05, 0.05, (9, len(passive)))

    np.testing.assert_allclose(model.predict(np.zeros(model.n_parameters), conditions), expected, rtol=0.0, atol=CLOSED)


@pytest.mark.parametrize(
    ("name", "moment_frame", "looped"),
    # All effects of three loops take a third of the time of these, and are long.
    [
        pytest.param(*of.values, marks=[*of.marks, *([pytest.mark.long] if of.values[::2] == ("all", "palletizer") else [])])
        for of in in_pairs(["geometric", "joint_elasticity", "bearing_elasticity", "all"], MOMENT_FRAMES, list(MODELS))
    ],
    indirect=["looped"],
)
def test_the_jacobian_is_exact(looped: Robot, name: str, moment_frame: MomentFrame, rng: np.random.Generator) -> None:
    """Lengths of rods, zeros of cranks, loads that loops hand on: all columns equal central differences."""
    model = Model(chain_of(looped, moment_frame), EFFECTS[name])
    conditions = conditions_of(looped, 3, rng)
    values, unit = values_of(model, conditions, rng), unit_of(model, conditions)
    poses, jacobian = model.linearise(values, conditions, rows=6)
    numeric = central_differences(model, values, conditions, 1e-5 / unit)

    np.testing.assert_array_equal(poses, model.predict(values, conditions))
    np.testing.assert_allclose(jacobian / unit, numeric / unit, rtol=0.0, atol=1e-8 * np.abs(jacobian / unit).max())


@pytest.mark.long
def test_moments_that_follow_the_bent_arm_have_slopes_to_second_order(looped: Robot, rng: np.random.Generator) -> None:
    """At equilibrium only the product of two elastic rotations is left out of the columns: a millionth at 1 mrad."""
    model = Model(chain_of(looped), EFFECTS["all"], equilibrium=True)
    conditions = conditions_of(looped, 6, rng)
    values, unit = 0.1 * values_of(model, conditions, rng), unit_of(model, conditions)
    _, jacobian = model.linearise(values, conditions, rows=6)
    numeric = central_differences(model, values, conditions, 1e-5 / unit)

    np.testing.assert_allclose(jacobian / unit, numeric / unit, rtol=0.0, atol=1e-5 * np.abs(jacobian / unit).max())


def test_shared_columns_are_those_of_their_coordinate(looped: Robot, rng: np.random.Generator) -> None:
    """Curves on the crank's drive come as one column of its coordinate, in which passive joints follow."""
    effects = (*ELASTIC, TransmissionError("joint_3", -0.5, 0.6))
    model = Model(chain_of(looped), effects)
    conditions = conditions_of(looped, 6, rng)
    values, free = values_of(model, conditions, rng), np.ones(model.n_parameters, bool)
    _, whole = model.linearise(values, conditions)
    _, parts, shared = model.linearise_shared(values, conditions, free=free)
    (group,) = shared
    ((places, basis),) = group.families
    dense = basis if isinstance(basis, np.ndarray) else dense_rows(basis)

    np.testing.assert_allclose(parts[-1] * dense[:, None], whole[:, :, places].transpose(2, 1, 0), atol=CLOSED)


@pytest.mark.parametrize("moment_frame", MOMENT_FRAMES)
def test_drives_bear_what_the_potential_energy_costs(
    looped: Robot, moment_frame: MomentFrame, rng: np.random.Generator
) -> None:
    """The moment about a drive of a loop is minus the slope of Pinocchio's potential energy, rods and hand included.

    Passive joints bear nothing about their axes, and Pinocchio's constraints are closed on the deformed geometry.
    """
    chain = Chain.of(looped, moment_frame=moment_frame, gravity=TILTED)
    model, h = Model(chain, GEOMETRIC), 1e-5
    conditions = Conditions.at(looped.random_configurations(8, rng), payload=7.5, payload_centre=(0.08, -0.05, 0.22))
    values = values_of(model, conditions, rng)
    augmented = Augmented(chain, payload=7.5, centre=np.array([0.08, -0.05, 0.22]))
    moments = model.static_moments(values, conditions)[:, 2::3]

    def energy(q: np.ndarray) -> np.ndarray:
        rows = model.coordinates(values, replace(conditions, q=q))
        data = augmented.data
        return np.array([pin.computePotentialEnergy(augmented.model, data, augmented.joints(row)) for row in rows])

    for i, joint in enumerate(looped.joint_names):
        step = h * np.eye(looped.n_joints)[i]
        slope = (energy(conditions.q + step) - energy(conditions.q - step)) / (2.0 * h)
        np.testing.assert_allclose(moments[:, i], -slope, atol=1e-7 * np.abs(moments).max(), err_msg=joint)
        assert joint not in looped.passive or not moments[:, i].any()


@pytest.mark.parametrize("name", ROBOTS)
def test_every_part_of_a_compliance_has_a_parameter_which_the_whole_has(name: str) -> None:
    """Joints that loops make inert have none, and a compliance of no joints has no part; a search took the first of none."""
    urdf, tip = ROBOTS[name]
    chain = Chain.of(Robot.from_urdf(urdf("constraint"), tip=tip))
    for effect in (JointElasticity(), BearingElasticity()):
        parts = effect.parts(chain)
        together = [p.name for part in parts for p in part.parameters(chain)]

        assert all(part.parameters(chain) for part in parts)
        assert sorted(together) == sorted(p.name for p in effect.parameters(chain))
        assert replace(effect, joints=()).parts(chain) == ()


@pytest.mark.long
def test_what_is_said_of_joints_is_said_of_those_that_move(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Coverage, narrow ranges and the largest change to command are those of drives, not of rods that follow."""
    (tmp_path / "robot.urdf").write_bytes(palletizer("constraint"))
    robot, table, noise = tmp_path / "robot.urdf", tmp_path / "rows.csv", ("--noise", "0.05mm")
    drives = {f"joint_{k}" for k in (1, 2, 3, 4)}
    assert run("simulate", robot, "--poses", 60, "--seed", 1, *noise, "--out", table, "--quiet") == 0
    assert run("check", robot, table, *noise, "--quiet") == 0
    covered = re.search(r"covered .*\((\w+)\)", capsys.readouterr().out)
    assert covered is not None and covered[1] in drives
    assert run("calibrate", robot, table, *noise, "--out", tmp_path / "r", "--quiet") == 0
    capsys.readouterr()
    (tmp_path / "program.csv").write_text("\n".join(row.rsplit(",", 3)[0] for row in table.read_text().splitlines()[:9]))
    to = ("--out", tmp_path / "o.csv", "--json")
    assert run("compensate", tmp_path / "r" / "model.json", tmp_path / "program.csv", *to) == 0
    assert json.loads(capsys.readouterr().out)["change"]["joint"] in drives

    arm = Robot.from_urdf(robot)
    few = pincal.read_measurements(table, arm).select(np.arange(30))
    narrow = narrow_joints(pincal.run_calibration(arm, few, Options(effects=GEOMETRIC)))
    assert {name for name, _ in narrow} <= drives


@pytest.mark.parametrize("name", [pytest.param("palletizer", marks=pytest.mark.long), "rod arm, no parallelogram"])
def test_arms_with_loops_are_held_in_sockets(name: str) -> None:
    """The true arm's tool point is at the socket; positions on the way at which loops open are given up, not an error."""
    urdf, tip = ROBOTS[name]
    rng, tool = np.random.default_rng(3), (0.1, 0.0, 0.1)
    robot = Robot.from_urdf(urdf("constraint"), tip=tip)
    moving = {"joints": robot.joint_names, "passive": robot.passive}
    machine = sim.TrueMachine.from_urdf(urdf("constraint").decode(), tip=tip, **moving)
    machine = machine.draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    arm = machine.nominal
    seed = plan_poses(arm, 24, rng, min_height=None)
    places = point_at(frames(arm, seed)[:, -1], tool)
    for wanted in (places, 1.5 * places):
        q, is_reached = reach(arm, seed[::-1], goal=wanted, tool=tool)
        missed = np.linalg.norm(point_at(frames(arm, q[is_reached])[:, -1], tool) - wanted[is_reached], axis=1)
        assert 0 < is_reached.sum() < 24 and missed.max() < 1e-9

    middle = places[np.argsort(np.linalg.norm(places - places.mean(axis=0), axis=1))[0]]
    setup = sim.Contact(fixed={"A": tuple(middle)}, tool=tool)
    table = setup.measure(machine, setup.plan(arm, 6, rng=rng, min_height=None), rng=rng)
    driven = [name for name in arm.names if name in table]
    q = np.zeros((6, len(arm.names)))
    q[:, [arm.names.index(name) for name in driven]] = np.column_stack([table[name] for name in driven])
    np.testing.assert_allclose(point_at(machine.tip(following(arm, q)), tool), np.tile(middle, (6, 1)), rtol=0.0, atol=1e-11)


@pytest.mark.long
def test_loops_that_no_urdf_closes_leave_a_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A palletizer fitted without its elasticity has tilts that no URDF holds: all else is written, and this is said."""
    (tmp_path / "robot.urdf").write_bytes(palletizer("constraint"))
    robot, table, noise = tmp_path / "robot.urdf", tmp_path / "rows.csv", ("--noise", "0.05mm")
    assert run("simulate", robot, "--poses", 60, "--seed", 1, *noise, "--out", table, "--quiet") == 0
    assert run("calibrate", robot, table, *noise, "--model", "geometric", "--out", tmp_path / "r", "--quiet") == 0
    assert "calibrated.urdf" not in capsys.readouterr().out and not (tmp_path / "r" / "calibrated.urdf").exists()
    page = (tmp_path / "r" / "report.html").read_text()
    assert "calibrated.urdf is not written" in page and "(--model elastic)" in page
    assert "other programs calibrated.urdf" not in page and "model.json, which alone holds the calibration" in page
    assert (tmp_path / "r" / "model.json").exists()


@pytest.mark.long
def test_a_target_is_not_said_to_move_by_what_is_not_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The hand stays level, so that no row tells how high its target is: of one that stood still no move is said."""
    (tmp_path / "robot.urdf").write_bytes(palletizer("constraint"))
    robot, noise = tmp_path / "robot.urdf", ("--noise", "0.05mm")
    first, second = tmp_path / "a.csv", tmp_path / "b.csv"
    hit = ("--pose-seed", 5, "--effect", "joint_offset:joint=joint_2,size=1e-3")
    assert run("simulate", robot, "--poses", 80, "--seed", 1, *noise, "--out", first, "--quiet") == 0
    assert run("simulate", robot, "--poses", 30, "--seed", 1, *hit, *noise, "--out", second, "--quiet") == 0
    assert run("calibrate", robot, first, *noise, "--out", tmp_path / "r", "--quiet") == 0
    capsys.readouterr()
    assert run("diagnose", tmp_path / "r" / "model.json", second, "--out", tmp_path / "d", "--quiet") == 6
    at = json.loads((tmp_path / "d" / "diagnosis.json").read_text())["station"]

    assert 1.0 < at["target_moved_mm"] < at["target_moved_U_mm"] < 50.0
    assert "the target moved by less than can be told" in " ".join(capsys.readouterr().out.split())


@pytest.mark.long
def test_a_search_on_loops_ends(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command on a palletizer finds the elasticity of its drives; it ended in an internal error."""
    (tmp_path / "robot.urdf").write_bytes(palletizer("constraint"))
    robot, table = tmp_path / "robot.urdf", tmp_path / "rows.csv"
    noise = ("--noise", "0.05mm")
    assert run("simulate", robot, "--poses", 120, "--seed", 1, *noise, "--out", table, "--quiet") == 0
    found = run("discover", robot, table, *noise, "--stability", 0, "--out", tmp_path / "found", "--quiet")
    assert found == 0 and "joint_elasticity" in capsys.readouterr().out


def test_names_of_parameters_are_those_that_loops_leave(looped: Robot) -> None:
    """Passive joints have no zero and no drive; rods have a length, their pins a place on the links that go on."""
    model = Model(Chain.of(looped), ELASTIC)
    of_passive = {name.rsplit(".", 1)[1] for name in model.names if name.rsplit(".", 1)[0] in looped.passive}

    assert not of_passive & {"theta", "k_z"} and "a" in of_passive
    assert {f"{closure.name}.{symbol}" for closure in looped.closures for symbol in "xy"} <= set(model.names)
    assert {"rod_foot.a", "joint_3.theta", "joint_3.k_z"} <= set(model.names) and "rod_foot.d" not in model.names
