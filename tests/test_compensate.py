"""Compensation: commanded joints judged by codes that know nothing of the solver, and by the command as a user meets it."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from command_line import run
from machines import planar_arm
from scipy.optimize import minimize

import pincal
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.covered import Covered
from pincal.calibration.fitted_robot import FittedRobot
from pincal.cli import main
from pincal.compensate.compensation import Compensation, compensate_poses, compensate_program
from pincal.compensate.ik_problem import Bounds
from pincal.compensate.robot_frames import base_in_instrument, false_targets, program_poses
from pincal.compensate.solve_ik import STATUSES
from pincal.compensate.targets import read_targets
from pincal.errors import BadInputError
from pincal.measure.table import write_table
from pincal.model.augmented import pinocchio_model
from pincal.model.catalogue import Backlash, BaseDrift, GearEccentricity, GearRatio, TransmissionError
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.model.effects import (
    ELASTIC,
    FRAME_SYMBOLS,
    GEOMETRIC,
    BaseFrame,
    BearingElasticity,
    JointElasticity,
    JointOffset,
    ToolFrame,
)
from pincal.model.model import Model
from pincal.parameters import estimate_of
from pincal.robot.robot import Robot
from pincal.robot.se3 import compose, inverse, quaternions
from pincal.simulate import paper_machine
from pincal.simulate.planning import reach as nominal_joints
from pincal.simulate.typical import draw_typical_elasticity, draw_typical_errors

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

# What is promised of a reached pose [m and rad].
PROMISED = 1e-9
COM = np.array([0.08, -0.05, 0.22])
ARMS: dict[str, Callable[[], Robot]] = {
    "kuka": lambda: Robot.from_urdf(kuka_urdf_path()),
    "ur10": lambda: Robot.from_urdf("ur10"),
    "panda": lambda: Robot.from_urdf("panda"),
    "tiago": lambda: Robot.from_urdf("tiago", tip="arm_tool_link"),
}


@pytest.fixture(scope="module", params=ARMS)
def robot(request: pytest.FixtureRequest) -> Robot:
    """Return each of the arms: industrial, parallel axes, seven joints, eight of which one slides."""
    return ARMS[request.param]()


def known(model: Model, values: np.ndarray, kind: str = "pose", payload_centre: np.ndarray = COM) -> FittedRobot:
    """Return a calibrated model without having calibrated."""
    n, P = model.chain.robot.n_joints, model.n_parameters
    covered = Covered(np.tile([-9.0, 9.0], (n, 1)), np.array([0.0, 200.0]))
    estimate = estimate_of(model.parameters, values, 1e-12 * np.eye(P))
    return FittedRobot.given(model, estimate, covered, sensor_kind=kind, payload_centre=payload_centre, sigma=[5e-5])


def erring(robot: Robot, effects: tuple[Effect, ...], rng: np.random.Generator, size: float = 1e-3) -> FittedRobot:
    """Return a robot that errs by some mm and mrad, seen by an instrument that stands somewhere."""
    chain = Chain.of(robot).with_references(rotation(0.3, -0.7, 1.1), rotation(0.2, 0.1, -0.4)[None])
    model = Model(chain, (BaseFrame(), ToolFrame(FRAME_SYMBOLS), *effects))
    values = size * rng.standard_normal(model.n_parameters)
    compliances = np.array([p.unit.endswith("(N m)") for p in model.parameters])
    values[compliances] = np.abs(values[compliances]) * 3.0 / (robot.masses.sum() * robot.reach * 9.81)
    values[[model.index(f"base.{axis}") for axis in "xyz"]] = 2.0, -1.0, 0.5
    values[[model.index(f"tool.{axis}") for axis in "xyz"]] = 0.05, 0.03, 0.12
    return known(model, values)


def rotation(x: float, y: float, z: float) -> np.ndarray:
    """Return some rotation."""
    return np.asarray(pin.rpy.rpyToMatrix(x, y, z))


def program(robot: Robot, count: int, rng: np.random.Generator) -> Conditions:
    """Return a nominal program clear of limits and of what is singular, with payloads."""
    q = 0.6 * robot.random_configurations(8 * count, rng)
    middle = np.where(np.isfinite(robot.lower + robot.upper), robot.lower + robot.upper, 0.0) / 2.0
    q = np.clip(q + 0.4 * middle, -3.0, 3.0)
    model = robot.pinocchio_model()
    data, tip = model.createData(), model.getFrameId(robot.tip)
    least = [
        np.linalg.svd(pin.computeFrameJacobian(model, data, robot.configuration(model, row), tip), compute_uv=False)[5]
        for row in q
    ]
    q = q[np.argsort(least)[-count:]]
    return replace(Conditions.at(q, payload_centre=COM), payload=rng.uniform(0.0, 5.0, count))


def turned(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the angles between rotations [rad]."""
    return np.array([np.linalg.norm(pin.log3(a.T @ b)) for a, b in zip(A[:, :, :3], B[:, :, :3], strict=True)])


def assert_reaches(reached: np.ndarray, wanted: np.ndarray) -> None:
    """Poses agree to what is promised."""
    assert np.linalg.norm(reached[:, :3, 3] - wanted[:, :3, 3], axis=1).max() <= PROMISED
    assert turned(reached[:, :3], wanted[:, :3]).max() <= PROMISED


# --- against codes of their own -------------------------------------------------------------------------------------


def test_calibrated_pinocchio_model_is_where_the_nominal_one_should_be(robot: Robot, rng: np.random.Generator) -> None:
    """Pinocchio's kinematics of the calibrated robot, as commanded, are those of the nominal one, as programmed."""
    calibrated, wanted = erring(robot, GEOMETRIC, rng), program(robot, 40, rng)
    found = compensate_program(calibrated, wanted)
    model = pinocchio_model(calibrated.model, calibrated.values)
    data, tip, base = model.createData(), model.getFrameId(robot.tip), model.getFrameId(robot.base)
    reached = []
    for q in found.q:
        pin.framesForwardKinematics(model, data, robot.configuration(model, q))
        reached.append((data.oMf[base].inverse() * data.oMf[tip]).homogeneous)

    assert found.is_ok.all() and found.error.max() <= PROMISED
    assert np.linalg.norm(robot.forward_kinematics(wanted.q)[:, :3, 3] - np.array(reached)[:, :3, 3], axis=1).max() <= 2e-9
    assert turned(robot.forward_kinematics(wanted.q)[:, :3], np.array(reached)[:, :3]).max() <= PROMISED
    assert 1e-4 < np.abs(found.q - wanted.q).max() < 0.3


def paper_robot(kuka: Robot) -> FittedRobot:
    """Return the model that has found the real robot of Table I."""
    first = kuka.joint_names[:3]
    model = Model(Chain.of(kuka), (*GEOMETRIC, JointElasticity(first), BearingElasticity(first)))
    values = np.zeros(model.n_parameters)
    for i, joint in enumerate(kuka.joint_names):
        for symbol, ours in (("o", "theta"), ("d", "d"), ("a", "a"), ("alpha", "alpha"), ("s_x", "s_x"), ("s_y", "s_y")):
            off = paper_machine.REAL[symbol][i] - paper_machine.NOMINAL[symbol][i]
            values[model.index(f"{joint}.{ours}")] = off
        for symbol, column in paper_machine.ELASTICITY.items():
            if i < 3:
                values[model.index(f"{joint}.{symbol}")] = column[i]
    return known(model, values)


def test_the_papers_elastic_robot_goes_where_the_nominal_one_should(kuka: Robot, rng: np.random.Generator) -> None:
    """The independent program of the paper's model, payload by row: from 10 mm to 1e-9 m and 1e-9 rad."""
    given = program(kuka, 60, rng)
    given = replace(given, payload=rng.uniform(0.0, 125.0, len(given)))
    wanted = kuka.forward_kinematics(given.q)
    loaded = {"payload_mass": given.payload, "payload_com": COM}
    found = compensate_program(paper_robot(kuka), given)

    assert found.is_ok.all()
    assert_reaches(sim.paper_transform(found.q, **loaded), wanted)
    before = np.linalg.norm(sim.paper_transform(given.q, **loaded)[:, :3, 3] - wanted[:, :3, 3], axis=1)
    assert before.mean() > 2e-3 and before.max() > 7e-3
    np.testing.assert_allclose(found.seed_error, before, rtol=0, atol=1e-12)


def test_winding_drives_are_turned_back_by_their_own_moments() -> None:
    """Closed form in the plane: commanded angles plus offsets minus compliance times moment are the wanted ones."""
    robot = Robot.from_urdf(planar_arm().encode(), tip="tip")
    model = Model(Chain.of(robot), (JointOffset(), JointElasticity()))
    offsets, k, payload = np.array([3e-3, -2e-3]), np.array([2e-5, 5e-5]), np.array([0.0, 20.0, 80.0])
    q = np.array([[-0.4, 0.9], [0.2, -1.1], [0.9, 0.3]])
    given = replace(Conditions.at(q), payload=payload)
    found = compensate_program(known(model, np.concatenate([offsets, k]), payload_centre=np.zeros(3)), given)
    # Moments are taken where the joints are commanded to, offsets included; positive angles lift.
    upper, fore = np.cos(np.cumsum(found.q + offsets, axis=1)).T
    second = 9.81 * (5.0 * 0.25 + payload * 0.5) * fore
    first = 9.81 * (10.0 * 0.5 + 5.0 + payload) * upper + second

    assert found.is_ok.all()
    np.testing.assert_allclose(found.q + offsets - k * np.column_stack([first, second]), q, rtol=0, atol=1e-8)


@pytest.mark.parametrize("of", ["tip", "target"])
def test_false_targets_make_a_nominal_controller_command_the_joints(kuka: Robot, of: str, rng: np.random.Generator) -> None:
    """Nominal inverse kinematics of an independent code, given the false targets, ends at the commanded joints."""
    calibrated, given = erring(kuka, ELASTIC, rng), program(kuka, 30, rng)
    commanded = replace(given, q=compensate_program(calibrated, given).q)
    poses = false_targets(calibrated, commanded, of=of)  # type: ignore[arg-type]
    goal = np.tile(np.eye(4), (len(poses), 1, 1))
    goal[:, :3] = poses
    if of == "target":
        tool = np.eye(4)
        tool[:3] = program_poses(calibrated, Conditions.at(np.zeros((1, 6))))[0]
        T_tip_target = np.linalg.inv(kuka.forward_kinematics(np.zeros((1, 6)))[0]) @ tool
        goal = goal @ np.linalg.inv(T_tip_target)
    q, ended = nominal_joints(sim.read_arm(kuka_urdf_path(), "tool0", None), given.q, goal=goal)

    assert ended.all()
    np.testing.assert_allclose(q, commanded.q, rtol=0, atol=1e-7)


def test_a_machine_that_errs_in_more_than_the_model_knows_arrives() -> None:
    """True machine to true machine: masses that are wrong and levers that bend, from 3 mm to less than twice the noise."""
    rng, noise = np.random.default_rng(5), 5e-5
    machine = draw_typical_errors(sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0"), rng)
    machine = draw_typical_elasticity(machine, rng).draw_masses(rng, sigma=0.03)
    hall = np.eye(4)
    hall[:3] = np.column_stack([rotation(0.3, -0.2, 2.0), [3.0, -1.0, 0.4]])

    def seen(q: np.ndarray, payload: np.ndarray, sigma: float) -> np.ndarray:
        tracker = sim.Instrument(pose=hall, targets=(0.1, 0.05, 0.2), sigma=sigma)
        columns = tracker.measure(machine, q, rng=rng, payload=payload, payload_com=tuple(COM))
        return np.column_stack([columns[axis] for axis in "xyz"])

    q, other = (sim.plan_poses(machine.nominal, count, rng) for count in (150, 60))
    payload, load = rng.choice([0.0, 60.0, 120.0], 150), rng.choice([0.0, 60.0, 120.0], 60)
    table = pincal.measurements_from_arrays(machine.names, q, position=seen(q, payload, noise), payload=payload)
    robot, options = Robot.from_urdf(kuka_urdf_path()), pincal.Options(sigma=noise, payload_centre=tuple(COM))
    fit = pincal.calibrate(robot, table, options)
    given = replace(Conditions.at(other, payload_centre=COM), payload=load)
    # What the nominal robot would do, its base and tool measured in.
    wanted = fit.model.predict(fit.model.own(fit.fit.nominal.values), given)
    found = compensate_poses(pincal.FittedRobot.of(fit.fit, {}), wanted, given)
    before, after = (np.linalg.norm(seen(q, load, 0.0) - wanted[:, :, 3], axis=1).mean() for q in (other, found.q))

    # One pose of the program is stretched out, with nothing left to correct it by.
    assert found.is_ok.sum() >= 57 and (found.error > PROMISED).sum() <= 1 and found.error.max() < 3e-3
    assert before > 2e-3 and after < 2.0 * noise


# --- with every kind of effect --------------------------------------------------------------------------------------

EFFECTS: dict[str, Callable[[Robot], tuple[Effect, ...]]] = {
    "elastic": lambda robot: ELASTIC,
    "drives": lambda robot: tuple(
        effect
        for joint, kind in zip(robot.joint_names, robot.joint_types, strict=True)
        for effect in (
            GearRatio(joint),
            TransmissionError(joint, -3.2, 3.2, 8),
            *([GearEccentricity(joint), GearEccentricity(joint, 2)] if kind != "prismatic" else []),
        )
    ),
}


@pytest.mark.parametrize("effects", EFFECTS)
@pytest.mark.parametrize("frame", ["instrument", "base"])
def test_poses_are_reached_whatever_the_model_has_found(
    robot: Robot, effects: str, frame: Any, rng: np.random.Generator
) -> None:
    """Poses in either frame are reached by the model's own prediction, and joints stay close to their seeds."""
    calibrated, seeds = erring(robot, EFFECTS[effects](robot), rng), program(robot, 40, rng)
    wanted = program_poses(calibrated, seeds)
    T_instrument_base = base_in_instrument(calibrated, seeds)
    found = compensate_poses(
        calibrated, wanted if frame == "base" else compose(T_instrument_base, wanted), seeds, frame=frame
    )
    predicted = calibrated.predict(replace(seeds, q=found.q))

    assert found.is_ok.all()
    assert_reaches(predicted, compose(T_instrument_base, wanted))
    assert np.abs(found.q - seeds.q).max() < 0.2


def test_equilibrium_on_the_bent_arm_is_met(kuka: Robot, rng: np.random.Generator) -> None:
    """A model whose moments are taken on the bent arm is inverted just as well."""
    calibrated, seeds = erring(kuka, ELASTIC, rng), program(kuka, 10, rng)
    calibrated = calibrated.with_model(replace(calibrated.model, equilibrium=True), calibrated.estimate)
    found = compensate_program(calibrated, seeds)

    assert found.is_ok.all()
    wanted = compose(base_in_instrument(calibrated, seeds), program_poses(calibrated, seeds))
    assert_reaches(calibrated.predict(replace(seeds, q=found.q)), wanted)


def test_what_drifts_is_the_instrument_and_not_the_program(kuka: Robot, rng: np.random.Generator) -> None:
    """A base that creeps moves the target in the instrument's frame, so joints follow; seen from the base nothing moves."""
    calibrated, given = erring(kuka, (*GEOMETRIC, BaseDrift()), rng), program(kuka, 5, rng)
    early, late = (replace(given, time=np.full(5, t)) for t in (0.0, 5.0))
    seen = compose(base_in_instrument(calibrated, early), program_poses(calibrated, early))

    np.testing.assert_array_equal(compensate_program(calibrated, early).q, compensate_program(calibrated, late).q)
    found = compensate_poses(calibrated, seen, late)
    assert found.is_ok.all() and np.abs(found.q - compensate_poses(calibrated, seen, early).q).max() > 1e-3
    assert_reaches(calibrated.predict(replace(late, q=found.q)), seen)


def test_an_effect_without_its_column_is_refused(kuka: Robot, rng: np.random.Generator) -> None:
    """Play can't be corrected without the direction of approach."""
    with pytest.raises(BadInputError, match="backlash needs the column approach_joint_2"):
        compensate_program(erring(kuka, (Backlash("joint_2"),), rng), program(kuka, 3, rng))


# --- closest to the seed --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("orientation", ["keep", "free"])
def test_of_all_solutions_the_closest_is_taken(orientation: Any, rng: np.random.Generator) -> None:
    """A general optimiser finds nothing closer to the seed, for seven joints and for positions alone."""
    robot = ARMS["panda"]()
    calibrated, seeds = erring(robot, GEOMETRIC, rng, size=3e-3), program(robot, 3, rng)
    wanted = compose(base_in_instrument(calibrated, seeds), program_poses(calibrated, seeds))
    found = compensate_poses(calibrated, wanted[:, :, 3], seeds, orientation=orientation)
    for i, seed in enumerate(seeds.q):
        row = seeds.select(np.array([i]))

        def left(q: np.ndarray, row: Conditions = row, goal: np.ndarray = wanted[i]) -> np.ndarray:
            pose = calibrated.predict(replace(row, q=q[None]))[0]
            turn = pin.log3(goal[:, :3] @ pose[:, :3].T) if orientation == "keep" else np.zeros(0)
            return np.concatenate([goal[:, 3] - pose[:, 3], turn])

        best = minimize(
            lambda q, seed=seed: 1e4 * np.sum((q - seed) ** 2),
            seed,
            method="SLSQP",
            constraints={"type": "eq", "fun": left},
            options={"ftol": 1e-12, "maxiter": 200},
        )
        assert np.linalg.norm(left(best.x)) < 1e-7
        np.testing.assert_allclose(found.q[i], best.x, rtol=0, atol=2e-5)


def test_positions_alone_keep_the_orientation_that_the_program_meant(robot: Robot, rng: np.random.Generator) -> None:
    """Without a quaternion the same joints come out as with the nominal robot's orientation; free moves no joint further."""
    calibrated, seeds = erring(robot, GEOMETRIC, rng), program(robot, 20, rng)
    wanted = compose(base_in_instrument(calibrated, seeds), program_poses(calibrated, seeds))
    kept = compensate_poses(calibrated, wanted[:, :, 3], seeds)
    free = compensate_poses(calibrated, wanted[:, :, 3], seeds, orientation="free")

    np.testing.assert_allclose(kept.q, compensate_program(calibrated, seeds).q, rtol=0, atol=1e-8)
    assert kept.is_ok.all() and free.is_ok.all() and free.turn.max() == 0.0
    assert np.all(np.linalg.norm(free.q - seeds.q, axis=1) < np.linalg.norm(kept.q - seeds.q, axis=1))


@pytest.mark.long
@pytest.mark.parametrize("arm", ["ur10", "panda"])
def test_poses_far_from_the_seed_are_found_within_the_limits(arm: str, rng: np.random.Generator) -> None:
    """From the middle of the range nearly all poses that the arm can take are reached, and no joint passes its limit."""
    robot = ARMS[arm]()
    calibrated = erring(robot, ELASTIC, rng)
    there = Conditions.at(robot.random_configurations(60, rng), payload_centre=COM)
    wanted = calibrated.predict(there)
    middle = np.where(np.isfinite(robot.lower), (robot.lower + robot.upper) / 2.0, 0.0)
    found = compensate_poses(calibrated, wanted, replace(there, q=np.tile(middle, (60, 1))))

    assert found.is_ok.sum() >= 58
    assert np.all((found.q >= robot.lower - 1e-9) & (found.q <= robot.upper + 1e-9))
    assert_reaches(calibrated.predict(replace(there, q=found.q))[found.is_ok], wanted[found.is_ok])
    # No whole turns: the joints of the UR could go round twice.
    assert np.abs(found.q - middle)[found.is_ok].max() <= np.pi + 1e-6


def test_bounds_are_intervals_of_rows_and_joints() -> None:
    """What is within, at a limit, and the corridor of some rows, from the definition."""
    limits = Bounds(np.array([-1.0, -np.inf]), np.array([1.0, 2.0]))
    q = np.array([[0.0, -50.0], [1.0 + 1e-13, 0.0], [1.5, 0.0], [0.0, 2.5]])

    assert limits.contain(q).tolist() == [True, True, False, False]
    assert limits.touched(q).tolist() == [False, True, True, True]
    assert Bounds.none(2).contain(1e9 * q).all() and not Bounds.none(2).touched(q).any()
    corridor = limits.around(q, np.array([True, True, False, True]), distance=0.25)
    np.testing.assert_array_equal(corridor.lower, [[-0.25, -50.25], [0.75, -0.25], [-1.0, -np.inf], [-0.25, 1.75]])
    np.testing.assert_array_equal(corridor.upper, [[0.25, -49.75], [1.0, 0.25], [1.0, 2.0], [0.25, 2.0]])
    rows = np.array([3, 1])
    np.testing.assert_array_equal(corridor.select(rows).lower, corridor.lower[rows])
    assert limits.select(rows) is limits


# --- rows that can't be had -----------------------------------------------------------------------------------------


def test_rows_are_served_one_by_one(kuka: Robot, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Order and pieces mean nothing, and rows that are out of reach are flagged and leave the others as they are."""
    calibrated, seeds = erring(kuka, ELASTIC, rng), program(kuka, 30, rng)
    wanted = compose(base_in_instrument(calibrated, seeds), program_poses(calibrated, seeds))
    found = compensate_poses(calibrated, wanted, seeds)
    order = rng.permutation(30)
    shuffled = compensate_poses(calibrated, wanted[order], seeds.select(order))
    far = wanted.copy()
    far[::7, :, 3] += (30.0, 0.0, 0.0)
    mixed = compensate_poses(calibrated, far, seeds)
    good = np.arange(30) % 7 > 0
    monkeypatch.setattr("pincal.compensate.compensation._PIECE", 11)

    np.testing.assert_allclose(compensate_poses(calibrated, wanted, seeds).q, found.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(shuffled.q, found.q[order], rtol=0, atol=1e-12)
    assert set(mixed.status[~good]) == {"unreachable"} and mixed.error[~good].min() > 20.0
    np.testing.assert_allclose(mixed.q[good], found.q[good], rtol=0, atol=1e-12)
    assert mixed.is_ok[good].all() and np.isfinite(mixed.q).all()


def test_a_limit_stops_a_joint_and_the_position_is_kept(kuka: Robot, rng: np.random.Generator) -> None:
    """A program at a limit that would have to go beyond it is flagged and gets the position with the joint at the limit."""
    model = Model(Chain.of(kuka), (JointOffset(),))
    offsets = np.array([0.0, 0.0, 0.0, 0.0, -4e-3, 0.0])
    given = program(kuka, 6, rng)
    q = given.q.copy()
    q[:, 4] = kuka.upper[4] - np.array([1e-3, 3.9e-3, 4.1e-3, 0.1, 0.0, 1.0])
    found = compensate_program(known(model, offsets), replace(given, q=q))
    beyond = compensate_program(known(model, offsets), replace(given, q=q), limits=False)

    assert found.status.tolist() == ["joint_limit", "joint_limit", "ok", "ok", "joint_limit", "ok"]
    assert np.all(found.q[:, 4] <= kuka.upper[4])
    assert found.error.max() <= PROMISED
    assert np.all((found.turn > 1e-5) == ~found.is_ok) and found.turn.max() < 0.01
    assert beyond.is_ok.all()
    np.testing.assert_allclose(beyond.q, q - offsets, rtol=0, atol=1e-9)


def test_seven_joints_get_round_a_limit(rng: np.random.Generator) -> None:
    """Where six joints suffice, a redundant arm stops one at its limit and reaches the pose with the others."""
    robot = ARMS["panda"]()
    model = Model(Chain.of(robot), (JointOffset(),))
    offsets = np.array([0.0, 0.0, 0.0, -4e-3, 0.0, 0.0, 0.0])
    given = program(robot, 8, rng)
    for joint in range(7):
        q = given.q.copy()
        q[:, joint] = robot.upper[joint] - 1e-4
        found = compensate_program(known(model, offsets), replace(given, q=q))
        assert np.all(found.q <= robot.upper) and np.all(found.q >= robot.lower)
        # The elbow alone sets the distance from shoulder to wrist: nothing gets round its limit.
        assert found.status.tolist() == ["joint_limit" if joint == 3 else "ok"] * 8


def test_a_singular_wrist_keeps_the_position_and_does_not_spin() -> None:
    """A UR wrist stretched out can't tilt sideways: flagged, the position exact, the joints near those of the program."""
    robot = ARMS["ur10"]()
    q = np.array([[0.3, -1.2, 1.1, -0.8, wrist, 0.4] for wrist in (0.0, 1e-4, 1.2)])
    model = Model(Chain.of(robot), GEOMETRIC)
    values = np.zeros(model.n_parameters)
    values[model.index("wrist_1_joint.alpha")] = values[model.index("elbow_joint.s_x")] = 3e-3
    found = compensate_program(known(model, values), Conditions.at(q))

    assert found.status.tolist() == ["singular", "singular", "ok"]
    assert found.error.max() <= PROMISED
    assert np.all(found.turn[:2] > 1e-4) and found.turn.max() < 0.02
    assert np.abs(found.q - q).max() <= 0.1


def test_a_row_that_is_right_already_stays_even_where_the_arm_is_singular() -> None:
    """A perfect robot needs no correction, stretched out at zero or anywhere."""
    robot = ARMS["ur10"]()
    q = np.vstack([np.zeros(6), robot.random_configurations(5, np.random.default_rng(1))])
    found = compensate_program(known(Model(Chain.of(robot), (JointOffset(),)), np.zeros(6)), Conditions.at(q))

    assert found.is_ok.all()
    np.testing.assert_array_equal(found.q, q)


def test_an_arm_with_two_joints_keeps_what_it_can() -> None:
    """An arm of two joints reaches positions in its plane, and flags those beside it with the distance that is left."""
    robot = Robot.from_urdf(planar_arm().encode(), tip="tip")
    calibrated = known(Model(Chain.of(robot), (JointOffset(),)), np.array([4e-3, -7e-3]))
    q = np.array([[0.3, 0.8], [-0.5, 1.2], [0.4, -0.9]])
    found = compensate_program(calibrated, Conditions.at(q))
    beside = program_poses(calibrated, Conditions.at(q))[:, :, 3] + [0.0, 0.01, 0.0]
    missed = compensate_poses(calibrated, beside, Conditions.at(q), frame="base")

    assert found.is_ok.all()
    np.testing.assert_allclose(found.q, q - [4e-3, -7e-3], rtol=0, atol=1e-8)
    assert set(missed.status) == {"unreachable"}
    np.testing.assert_allclose(missed.error, 0.01, rtol=0, atol=1e-6)


def test_arguments_that_make_no_sense_are_refused(kuka: Robot, rng: np.random.Generator) -> None:
    """Shapes, frames, orientations and numbers that are none are named."""
    calibrated, seeds = erring(kuka, GEOMETRIC, rng), program(kuka, 3, rng)
    good = np.zeros((3, 3))
    for wanted, given, message in (
        (np.zeros((2, 3)), {}, r"shape \(2, 3\); expected \(3, 3, 4\) or \(3, 3\)"),
        (np.full((3, 3), np.nan), {}, "desired pose 0 is not finite"),
        (np.tile(np.eye(4)[:3] * [1.0, 1.0, -1.0, 1.0], (3, 1, 1)), {}, "desired pose 0: .* are not a rotation matrix"),
        (np.tile(1.000003 * np.eye(4)[:3], (3, 1, 1)), {}, "desired pose 0: .* are not a rotation matrix"),
        (good, {"frame": "world"}, "frame 'world'; expected one of instrument, base"),
        (good, {"orientation": "up"}, "orientation 'up'; expected one of keep, free"),
    ):
        with pytest.raises(BadInputError, match=message):
            compensate_poses(calibrated, wanted, seeds, **given)
    # Six decimals are a rotation.
    assert len(compensate_poses(calibrated, np.tile(1.000001 * np.eye(4)[:3], (3, 1, 1)), seeds).q) == 3
    for q in (np.zeros((3, 5)), np.full((3, 6), np.inf)):
        with pytest.raises(BadInputError, match=r"seeds have shape .* expected \(N, 6\), all of them numbers"):
            compensate_poses(calibrated, good, replace(seeds, q=q))


def test_the_public_names_are_there() -> None:
    """The functions are exported where users look for them."""
    assert pincal.compensate_poses is compensate_poses and pincal.compensate_program is compensate_program
    assert Compensation is Compensation and false_targets is false_targets
    assert STATUSES == ("ok", "singular", "joint_limit", "unreachable")
    assert np.allclose(compose(inverse(np.eye(4)[None, :3]), np.eye(4)[None, :3]), np.eye(4)[:3])


# --- the command ----------------------------------------------------------------------------------------------------


def columns_of(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a CSV file, numbers where they are numbers."""
    header, *rows = [line.split(",") for line in path.read_text().splitlines()]
    found: dict[str, np.ndarray] = {}
    for name, *cells in zip(header, *rows, strict=True):
        found[name] = np.array(cells) if name in ("status", "target") else np.array(cells, float)
    return found


@dataclass
class Bench:
    """A model.json, and tables of a program and of where it should go, seen by the instrument."""

    folder: Path
    robot: Robot
    calibrated: FittedRobot
    given: Conditions
    wanted: np.ndarray

    def joints(self) -> dict[str, np.ndarray]:
        """Return the columns of the program."""
        return dict(zip(self.robot.joint_names, self.given.q.T, strict=True)) | {"payload": self.given.payload}

    def poses(self, *, turns: bool = True) -> dict[str, np.ndarray]:
        """Return the columns of the wanted poses."""
        columns = dict(zip("xyz", self.wanted[:, :, 3].T, strict=True))
        names = ("qx", "qy", "qz", "qw") if turns else ()
        return columns | dict(zip(names, quaternions(self.wanted[:, :, :3]).T, strict=False))

    def compensate(self, columns: dict[str, np.ndarray], *options: object, code: int = 0) -> dict[str, np.ndarray]:
        """Write a table, run the command on it, and return what it wrote."""
        write_table(self.folder / "targets.csv", columns)
        out = self.folder / "out.csv"
        assert run("compensate", self.folder / "model.json", self.folder / "targets.csv", "--out", out, *options) == code
        return columns_of(out)

    def q(self, columns: dict[str, np.ndarray]) -> np.ndarray:
        """Return the joints of a table, shape (N, 6)."""
        return np.column_stack([columns[name] for name in self.robot.joint_names])


@pytest.fixture
def bench(tmp_path: Path, kuka: Robot, rng: np.random.Generator) -> Bench:
    """Return a bench with the KUKA."""
    calibrated, given = erring(kuka, ELASTIC, rng), program(kuka, 12, rng)
    calibrated.save(tmp_path / "model.json")
    wanted = compose(base_in_instrument(calibrated, given), program_poses(calibrated, given))
    return Bench(tmp_path, kuka, calibrated, given, wanted)


def test_a_program_becomes_joints_that_predict_calls_right(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    """The file has joints, payload, wanted pose and status; ``pincal predict`` of it gives the wanted poses."""
    found = bench.compensate(bench.joints(), "--quiet")
    told = capsys.readouterr()
    assert run("predict", bench.folder / "model.json", bench.folder / "out.csv", "--out", bench.folder / "there.csv") == 0
    there = columns_of(bench.folder / "there.csv")

    assert "12 rows: 12 ok" in told.out and "joints as given" in told.out and told.err == ""
    assert max(len(line) for line in told.out.splitlines() if not line.startswith("written")) <= 100
    assert list(found) == [
        *(*bench.robot.joint_names, "payload", "x", "y", "z", "qx", "qy", "qz", "qw"),
        *("error_mm", "error_mrad", "sigma_mm", "change_max", "status"),
    ]
    for k, axis in enumerate("xyz"):
        np.testing.assert_allclose(there[axis], bench.wanted[:, k, 3], rtol=0, atol=PROMISED)
        np.testing.assert_allclose(found[axis], bench.wanted[:, k, 3], rtol=0, atol=1e-12)
    assert found["error_mm"].max() <= 1e-6 and found["error_mrad"].max() <= 1e-6
    sigma = np.sqrt(np.sum([there[f"sigma_{axis}"] ** 2 for axis in "xyz"], axis=0))
    np.testing.assert_allclose(found["sigma_mm"], 1e3 * sigma, rtol=1e-9)
    np.testing.assert_allclose(found["change_max"], np.abs(bench.q(found) - bench.given.q).max(axis=1))


def test_every_way_to_say_where_to_go_means_the_same(bench: Bench) -> None:
    """A program, poses, positions, other units, the robot's base and the command's own output lead to the same joints."""
    expected = bench.q(bench.compensate(bench.joints()))
    in_base = compose(inverse(base_in_instrument(bench.calibrated, bench.given)), bench.wanted)
    small = {f"{name} [deg]": np.rad2deg(column) for name, column in bench.joints().items() if name != "payload"}
    small |= {f"{axis} [mm]": 1e3 * column for axis, column in bench.poses(turns=False).items()}
    small |= {"payload [g]": 1e3 * bench.given.payload}
    # What comes in degrees goes out in degrees.
    out = bench.compensate(small)
    again = np.deg2rad(np.column_stack([out[f"{name} [deg]"] for name in bench.robot.joint_names]))
    np.testing.assert_allclose(again, expected, rtol=0, atol=1e-8)
    ways: list[tuple[dict[str, np.ndarray], list[object]]] = [
        (bench.joints() | bench.poses(), []),
        (bench.joints() | bench.poses(turns=False), []),
        (bench.joints() | replace_poses(bench, in_base), ["--frame", "base"]),
        (bench.joints(), ["--frame", "base"]),
    ]
    for columns, options in ways:
        np.testing.assert_allclose(bench.q(bench.compensate(columns, *options)), expected, rtol=0, atol=1e-8)
    other = bench.folder / "again.csv"
    assert run("compensate", bench.folder / "model.json", bench.folder / "out.csv", "--out", other, "--frame", "base") == 0
    np.testing.assert_allclose(bench.q(columns_of(other)), expected, rtol=0, atol=1e-8)


def replace_poses(bench: Bench, poses: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of other poses."""
    return replace(bench, wanted=poses).poses()


def test_poses_without_joints_take_a_seed_or_none(bench: Bench) -> None:
    """With one seed in degrees for all rows or with none poses are reached, positions alone in any orientation."""
    seed = " ".join(f"{angle:.0f}" for angle in np.rad2deg(bench.given.q[0])) + " deg"
    for columns, options, turns in (
        (bench.poses(), [], True),
        (bench.poses(), ["--seed-joints", seed], True),
        (bench.poses(turns=False), [], False),
        (bench.poses(), ["--free-orientation"], False),
    ):
        found = bench.compensate(columns | {"payload": bench.given.payload}, *options)
        there = bench.calibrated.predict(replace(bench.given, q=bench.q(found)))

        assert set(found["status"]) == {"ok"} and ("error_mrad" in found) == turns
        assert "change_max" not in found
        np.testing.assert_allclose(there[:, :, 3], bench.wanted[:, :, 3], rtol=0, atol=PROMISED)
        assert not turns or turned(there, bench.wanted).max() < PROMISED


def test_rows_whose_joints_move_far_are_marked(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    """Beyond the limit, 2 deg by default, a row has large_change 1 and a note; such a table is taken again."""
    limit = f"{1e3 * 0.5 * np.abs(bench.q(bench.compensate(bench.joints())) - bench.given.q).max():.6f}mrad"
    capsys.readouterr()
    found = bench.compensate(bench.joints(), "--max-change", limit)
    said = capsys.readouterr().err

    marked = found["change_max"] > 1e-3 * float(limit.removesuffix("mrad"))
    assert marked.sum() > 0 and found["large_change"].tolist() == marked.astype(int).tolist()
    assert "a joint moves more than" in said and "large_change" in said
    assert "large_change" not in bench.compensate(bench.joints(), "--max-change", "90deg")


def test_false_targets_are_written_beside_the_joints(bench: Bench) -> None:
    """They are the nominal flange, in the robot's base frame, at the joints to command."""
    found = bench.compensate(bench.joints(), "--false-targets", "tip")
    flange = bench.robot.forward_kinematics(bench.q(found))

    for k, axis in enumerate("xyz"):
        np.testing.assert_allclose(found[f"false_{axis}"], flange[:, k, 3], rtol=0, atol=1e-9)
    Q = np.column_stack([found[f"false_q{axis}"] for axis in "xyzw"])
    np.testing.assert_allclose(np.abs(np.sum(Q * quaternions(flange[:, :3, :3]), axis=1)), 1.0, atol=1e-12)


def test_rows_that_are_not_reached_are_told_and_the_rest_is_served(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    """The file is whole, the line and what is left are told, JSON says the same, and a strict user's script stops."""
    columns = bench.joints() | bench.poses()
    columns["x"] = columns["x"] + np.where(np.arange(12) == 4, 50.0, 0.0)
    found = bench.compensate(columns, "--json")
    told = capsys.readouterr()
    result = json.loads(told.out)

    assert found["status"].tolist() == ["ok"] * 4 + ["unreachable"] + ["ok"] * 7
    assert result["status"] == {"ok": 11, "singular": 0, "joint_limit": 0, "unreachable": 1}
    assert [(row["line"], row["status"]) for row in result["not_ok"]] == [(6, "unreachable")]
    assert result["not_ok"][0]["error_mm"] > 4e4 and result["rows"] == 12
    assert "line 6: unreachable" in told.err
    bench.compensate(columns)
    said = capsys.readouterr().out
    assert re.search(r"not reached +1 row, off by up to [0-9.]+ mm \(line 6\);\n +they need other targets", said)
    assert float(re.search(r"off by up to ([0-9.]+) mm", said).group(1)) == round(result["not_ok"][0]["error_mm"], 4)  # type: ignore[union-attr]
    assert "singular" not in said
    assert bench.compensate(columns, "--quiet", "--strict", code=4)["status"][4] == "unreachable"
    assert capsys.readouterr().err == ""
    nowhere = columns | {"x": columns["x"] + 50.0}
    assert np.all(bench.compensate(nowhere, code=4)["status"] == "unreachable")


def test_singular_rows_are_no_misses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Where all positions are met, only the orientation is off, in degrees as the joints' motions, and said once."""
    robot = ARMS["ur10"]()
    model = Model(Chain.of(robot), GEOMETRIC)
    values = np.zeros(model.n_parameters)
    values[model.index("wrist_1_joint.alpha")] = values[model.index("elbow_joint.s_x")] = 3e-3
    known(model, values).save(tmp_path / "model.json")
    q = np.array([[0.3, -1.2, 1.1, -0.8, wrist, 0.4] for wrist in (0.0, 1.2)])
    write_table(tmp_path / "program.csv", dict(zip(robot.joint_names, q.T, strict=True)))
    code = run("compensate", tmp_path / "model.json", tmp_path / "program.csv", "--out", tmp_path / "out.csv")
    told = capsys.readouterr()

    assert code == 0
    assert "2 rows: 1 ok, 1 singular" in told.out
    assert "not reached" not in told.out
    off = re.search(r"singular +1 row: positions met, orientations off by up to ([0-9.]+) deg \(line 2\);", told.out)
    assert off is not None and float(off.group(1)) > 0.01
    assert "mrad" not in told.out + told.err
    assert "line 2: singular" not in told.err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: {"payload": c["payload"]}, "neither desired positions nor joints; expected columns x y z, or joint_1"),
        (lambda c: c | {"x": c["joint_1"], "y": c["joint_1"]}, "x y without z; add what is missing"),
        (lambda c: c | {"qx": c["joint_1"]}, "qx without qy qz qw"),
        (lambda c: c | {"xx": c["joint_1"]}, 'unknown column "xx"'),
        (lambda c: {k: v for k, v in c.items() if k != "joint_3"}, 'no column for joint "joint_3"'),
        (lambda c: c | {"joint_1": 100.0 * c["joint_1"]}, "looks like degrees"),
        (lambda c: c | {axis: 1e3 + c["joint_1"] for axis in "xyz"}, r"looks like millimetres: write `x \[mm\]`"),
        (lambda c: c | {"payload": np.full(12, np.nan)}, "finite number"),
    ],
)
def test_a_table_that_cannot_be_right_is_refused(
    bench: Bench, change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]], message: str, capsys: Any
) -> None:
    """Exit 3 with a word on what to do; what was there before is untouched."""
    (bench.folder / "out.csv").write_text("before\n")
    write_table(bench.folder / "targets.csv", change(bench.joints()))
    code = run("compensate", bench.folder / "model.json", bench.folder / "targets.csv", "--out", bench.folder / "out.csv")

    assert code == 3
    assert re.search(message, capsys.readouterr().err)
    assert (bench.folder / "out.csv").read_text() == "before\n"
    assert {path.name for path in bench.folder.iterdir()} == {"model.json", "targets.csv", "out.csv"}


def test_files_that_are_not_there_are_refused(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    """A table, a model or a folder that does not exist ends with exit 3."""
    write_table(bench.folder / "targets.csv", bench.joints())
    model, targets, out = (bench.folder / name for name in ("model.json", "targets.csv", "out.csv"))
    for arguments in (
        (model, bench.folder / "none.csv", "--out", out),
        (bench.folder / "none.json", targets, "--out", out),
        (model, targets, "--out", bench.folder / "none" / "out.csv"),
    ):
        assert run("compensate", *arguments) == 3
        assert "none" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("seed", ["0 0 0", "a b c d e f", "0 0 0 0 0 nan"])
def test_a_seed_that_is_none_is_a_usage_error(bench: Bench, seed: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit 2 with the number of joints, and for tables that have joints of their own."""
    write_table(bench.folder / "poses.csv", bench.poses())
    write_table(bench.folder / "program.csv", bench.joints())
    given = ("--out", bench.folder / "out.csv", "--seed-joints", seed)

    assert run("compensate", bench.folder / "model.json", bench.folder / "poses.csv", *given) == 2
    assert "expected 6" in capsys.readouterr().err
    assert run("compensate", bench.folder / "model.json", bench.folder / "program.csv", *given) == 2
    assert "leave it out" in capsys.readouterr().err


def test_each_target_has_its_own_place(tmp_path: Path, kuka: Robot, rng: np.random.Generator) -> None:
    """Rows name their target; a name that the model does not have is refused."""
    chain = Chain.of(kuka, targets=("near", "far"))
    model = Model(chain, (ToolFrame(), JointOffset()))
    calibrated = known(model, np.array([0.1, 0.0, 0.2, 0.1, 0.0, 0.4, *(1e-3 * rng.standard_normal(6))]), kind="position")
    calibrated.save(tmp_path / "model.json")
    given = program(kuka, 8, rng)
    columns = dict(zip(kuka.joint_names, given.q.T, strict=True)) | {"target": np.array(["near", "far"] * 4)}
    write_table(tmp_path / "program.csv", columns)
    assert run("compensate", tmp_path / "model.json", tmp_path / "program.csv", "--out", tmp_path / "out.csv") == 0
    found = columns_of(tmp_path / "out.csv")
    flange = kuka.forward_kinematics(given.q)
    tool = np.where(np.arange(8)[:, None] % 2, [0.1, 0.0, 0.4], [0.1, 0.0, 0.2])

    assert found["target"].tolist() == ["near", "far"] * 4
    place = np.einsum("nij,nj->ni", flange[:, :3, :3], tool) + flange[:, :3, 3]
    np.testing.assert_allclose(np.column_stack([found[axis] for axis in "xyz"]), place, rtol=0, atol=1e-9)
    write_table(tmp_path / "program.csv", columns | {"target": np.array(["near", "nowhere"] * 4)})
    assert run("compensate", tmp_path / "model.json", tmp_path / "program.csv", "--out", tmp_path / "other.csv") == 3
    with pytest.raises(BadInputError, match="target 'nowhere' is not in the model; expected one of near, far"):
        calibrated.conditions(read_targets(tmp_path / "program.csv", kuka).rows)


SCARA = "".join(
    f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="{xyz}"/><axis xyz="0 0 1"/>'
    f'<limit lower="-2" upper="2" effort="1" velocity="1"/></joint><link name="l{i + 1}"/>'
    for i, (kind, xyz) in enumerate(
        [("revolute", "0 0 0.4"), ("revolute", "0.4 0 0"), ("prismatic", "0.3 0 0"), ("revolute", "0 0 -0.1")]
    )
)


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        (f'<robot name="scara"><link name="l0"/>{SCARA}</robot>', "about x and y of its base frame"),
        ("ur10", "about 2 of three axes, which differ from pose to pose"),
        ("kuka", ""),
    ],
)
def test_an_arm_of_few_joints_says_which_orientations_it_misses(
    robot: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A SCARA turns its tool about the vertical alone; what a tilt of its axes asks for is told, and how much is left."""
    if robot == "kuka":
        arm = ARMS["kuka"]()
    else:
        arm = Robot.from_urdf("ur10", tip="wrist_1_link") if robot == "ur10" else Robot.from_urdf(robot.encode())
    model = Model(Chain.of(arm), GEOMETRIC)
    values = 1e-3 * np.random.default_rng(4).uniform(-1.0, 1.0, model.n_parameters)
    covered = Covered(np.tile([-4.0, 4.0], (arm.n_joints, 1)), np.zeros(2))
    estimate = estimate_of(model.parameters, values, np.zeros((len(values), len(values))))
    FittedRobot.given(model, estimate, covered, sensor_kind="pose", sigma=(1.0, 1.0)).save(tmp_path / "model.json")
    q = np.array([0.4, 0.9, -0.3, 0.5, 0.6, 0.2])[: arm.n_joints] + np.linspace(-0.2, 0.2, 9)[:, None]
    write_table(tmp_path / "program.csv", dict(zip(arm.joint_names, q.T, strict=True)))
    with pytest.raises(SystemExit) as end:
        main(["compensate", str(tmp_path / "model.json"), str(tmp_path / "program.csv"), "--out", str(tmp_path / "c.csv")])
    told = capsys.readouterr().err

    assert end.value.code == 0
    assert ("too few joints to turn the target" in told) == bool(words) and words in told
