"""Bearings are compliant where they sit: held against the simulator, on arms whose axes meet at no right angle."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from discovery_cases import discover, draw_case, fresh
from rewritten_urdf import rewritten
from scipy.spatial.transform import Rotation

import pincal.simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.discover.score_tests import score_test
from pincal.discover.shrink import _words
from pincal.errors import ModelFileError
from pincal.identify import equations
from pincal.identify.calibrate import fit_tables
from pincal.identify.options import Options
from pincal.io.entries import ModelEntry, plain, restoring
from pincal.io.strict_json import MODEL_FILE, built
from pincal.measure.measurements import measurements_from_arrays
from pincal.measure.table import read_measurements
from pincal.model.catalogue.bearing_features import BearingPlace, ObliqueBearing
from pincal.model.catalogue.drives import AxisWobble, WobbleFrame
from pincal.model.chain import Chain, MomentFrame
from pincal.model.conditions import Conditions
from pincal.model.effects import ELASTIC, GEOMETRIC, BearingElasticity
from pincal.model.model import Model
from pincal.robot.robot import Robot

JOINT = """<joint name="j{n}" type="revolute"><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>
<parent link="l{parent}"/><child link="l{n}"/><limit lower="-2.5" upper="2.5" effort="1" velocity="1"/></joint>
<link name="l{n}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
SOFT = (1e-8, 3e-8)


def words(numbers: np.ndarray) -> str:
    """Return numbers as a URDF has them."""
    return " ".join(repr(float(x)) for x in numbers)


def skew_arm(seed: int, *, turned: bool = False) -> str:
    """Return the URDF of an arm with six axes in any directions; turned has its joint frames about these axes at random."""
    rng, angles = np.random.default_rng(seed), np.random.default_rng(seed + 100).uniform(-3.0, 3.0, 6)
    text, previous = '<robot name="skew"><link name="l0"/>', np.eye(3)
    for i in range(6):
        axis = rng.normal(size=3) if i else np.array([0.2, 0.1, 1.0])
        axis /= np.linalg.norm(axis)
        xyz, rpy, centre = rng.uniform(-0.4, 0.4, 3), rng.uniform(-1.5, 1.5, 3), rng.uniform(-0.2, 0.2, 3)
        # The frame of joint and link turned by own: R' = previous^T R own, so that the machine stays what it is.
        own = Rotation.from_rotvec(axis * angles[i]).as_matrix() if turned else np.eye(3)
        placed = previous.T @ Rotation.from_euler("xyz", rpy).as_matrix() @ own
        text += JOINT.format(
            n=i + 1,
            parent=i,
            xyz=words(previous.T @ xyz),
            rpy=words(Rotation.from_matrix(placed).as_euler("xyz")),
            axis=words(axis),
            centre=words(own.T @ centre),
            mass=60.0 / (i + 1),
        )
        previous = own
    tip = previous.T
    fixed = f'<joint name="tip" type="fixed"><origin rpy="{words(Rotation.from_matrix(tip).as_euler("xyz"))}"/>'
    return text + fixed + '<parent link="l6"/><child link="tip"/></joint><link name="tip"/></robot>'


def written(path: Path, text: str) -> Path:
    """Return the path of a URDF that holds a text."""
    path.write_text(text)
    return path


def conditions_of(robot: Robot) -> Conditions:
    """Return 80 random poses with and without a payload."""
    rng = np.random.default_rng(1)
    q = robot.random_configurations(80, rng)
    return Conditions(q, np.zeros(80, int), 20.0 * rng.integers(0, 2, 80), np.array([0.1, 0.0, 0.2]))


@pytest.mark.parametrize("moment_frame", ["before", "after"])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_a_bearing_bends_as_the_true_machine(tmp_path: Path, seed: int, moment_frame: MomentFrame) -> None:
    """On every joint three compliances leave 2e-5 of what it does; their principal values are the machine's."""
    urdf = written(tmp_path / "skew.urdf", skew_arm(seed))
    robot = Robot.from_urdf(urdf)
    conditions = conditions_of(robot)
    machine = sim.TrueMachine.from_urdf(urdf, tip=robot.tip, base=robot.base, gravity=(0.0, 0.0, -9.81))

    def tip(*hidden: sim.HiddenEffect) -> np.ndarray:
        c = conditions
        return machine.with_effects(*hidden).tip(c.q, payload=c.payload, payload_com=c.payload_centre)

    plain = tip()
    for joint in robot.joint_names:
        true = tip(sim.BearingElasticity(joint=joint, size=SOFT[0], size_y=SOFT[1], moment_frame=moment_frame))
        turning = Rotation.from_matrix(true[:, :3, :3] @ plain[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
        signal = np.hstack([true[:, :3, 3] - plain[:, :3, 3], turning]).ravel()
        model = Model(Chain.of(robot, moment_frame=moment_frame), (BearingElasticity((joint,)), ObliqueBearing(joint)))
        columns = model.linearise(np.zeros(3), conditions, rows=6)[1].reshape(-1, 3)
        k_x, k_y, k_xy = np.linalg.lstsq(columns, signal)[0]

        assert np.linalg.norm(signal - columns @ [k_x, k_y, k_xy]) < 2e-5 * np.linalg.norm(signal)
        np.testing.assert_allclose(np.linalg.eigvalsh([[k_x, k_xy], [k_xy, k_y]]), SOFT, rtol=1e-4)


@pytest.mark.parametrize("moment_frame", ["before", "after"])
def test_an_axis_wobbles_as_the_true_machine(tmp_path: Path, moment_frame: MomentFrame) -> None:
    """About the URDF's joint, seen from either side; about the foot of the common normal a hundredth or more is left."""
    urdf = written(tmp_path / "skew.urdf", skew_arm(0))
    robot = Robot.from_urdf(urdf)
    conditions = conditions_of(robot)
    machine = sim.TrueMachine.from_urdf(urdf, tip=robot.tip, base=robot.base)
    plain = machine.tip(conditions.q)[:, :3, 3]
    chain = Chain.of(robot, moment_frame=moment_frame)
    at_foot = replace(chain, bearing_heights=np.zeros(robot.n_joints))

    for joint, (order, frame) in product(robot.joint_names[2:4], ((2, "before"), (1, "after"))):
        hidden = sim.AxisWobble(joint=joint, size=1e-6, order=order, frame=frame, roundness=0.4)
        signal = (machine.with_effects(hidden).tip(conditions.q)[:, :3, 3] - plain).ravel()
        left = []
        for where in (chain, at_foot):
            model = Model(where, (AxisWobble(joint, order, frame),))
            columns = model.linearise(np.zeros(4), conditions, rows=3)[1].reshape(-1, 4)
            left.append(np.linalg.norm(signal - columns @ np.linalg.lstsq(columns, signal)[0]) / np.linalg.norm(signal))

        assert left[0] < 1e-4 and left[1] > 1e-2, joint


@pytest.mark.filterwarnings("ignore:Gimbal lock")
def test_what_geometry_takes_of_a_wobble_is_not_counted() -> None:
    """Of four parameters two are a fixed tilt, also 0.7 m off the foot of the normal, where priors hold geometry back."""
    robot = Robot.from_urdf(rewritten(Path(kuka_urdf_path()).read_text(), 5, slide=0.8).encode())
    rng = np.random.default_rng(1)
    q = robot.random_configurations(60, rng)
    position = robot.forward_kinematics(q)[:, :3] @ [0.1, 0.05, 0.2, 1.0] + 5e-4 * rng.standard_normal((60, 3))
    rows = measurements_from_arrays(robot.joint_names, q, position=position)
    fit = fit_tables(robot, rows, Options(effects=GEOMETRIC, sigma=5e-4, moment_frame="after"))
    tests = score_test(fit, [AxisWobble("joint_4", 1, "after"), AxisWobble("joint_4", 2)])

    assert abs(fit.problem.chain.bearing_heights[3]) > 0.7
    assert [tests.score([i], 1).rank for i in range(2)] == [2, 4]


@pytest.mark.parametrize("seed", [30127, 71027, *(pytest.param(seed, marks=pytest.mark.long) for seed in (71238, 71251))])
def test_no_wobble_is_found_where_geometry_is_beyond_its_priors(seed: int) -> None:
    """Sound arms with two nearly parallel axes, whose common normal stands somewhere else: 3 to 6 standard deviations."""
    case = draw_case("null", seed, **(fresh(seed) | {"n": 60}))
    fit = fit_tables(case.robot, case.rows, replace(case.plain, loss="none"))
    tests = score_test(fit, [AxisWobble(f"axis_{i}", 1, frame) for i in (2, 3, 4) for frame in get_args(WobbleFrame)])

    assert np.abs(fit.values / fit.priors.sizes).max() > 2.5
    assert min(tests.score([i], 1).p_value for i in range(6)) > 1e-3


@pytest.mark.parametrize("moment_frame", ["before", "after"])
def test_turned_joint_frames_are_the_same_machine(tmp_path: Path, moment_frame: MomentFrame) -> None:
    """Whatever the frames of a URDF, the same compliances predict the same places to rounding."""
    arms = [Robot.from_urdf(written(tmp_path / f"{turned}.urdf", skew_arm(3, turned=turned))) for turned in (False, True)]
    conditions = conditions_of(arms[0])
    joints = arms[0].joint_names
    wobbles = (AxisWobble(joint, 2, frame) for joint in joints for frame in ("before", "after"))
    effects = (BearingElasticity(), *(ObliqueBearing(joint) for joint in joints), *wobbles)
    values = 1e-8 * np.random.default_rng(2).uniform(0.5, 1.5, 18 + 48)
    places = [Model(Chain.of(arm, moment_frame=moment_frame), effects).predict(values, conditions) for arm in arms]
    stiff = Model(Chain.of(arms[0]), ()).predict(np.zeros(0), conditions)

    assert np.abs(places[0] - stiff).max() > 1e-5
    np.testing.assert_allclose(places[0], places[1], atol=1e-12)


@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
def test_files_of_old_have_bearings_where_they_were() -> None:
    """A file that says nothing of bearings was made when they stood at the origins of their frames, and predicts so."""
    robot = Robot.from_urdf("panda")
    model = Model(Chain.of(robot, moment_frame="after"), (BearingElasticity(),))
    conditions, values = conditions_of(robot), np.full(14, 1e-6)
    new = plain(ModelEntry.of_model(model))
    old = new | {"chain": {key: value for key, value in new["chain"].items() if key != "bearing_heights"}}
    short = new | {"chain": new["chain"] | {"bearing_heights": [0.0, 0.3]}}

    def read(entry: dict) -> Model:
        return built(json.dumps(entry).encode(), ModelEntry, MODEL_FILE, file="model.json", hook=restoring()).model()

    at_origin = replace(model, chain=replace(model.chain, bearing_heights=np.zeros(7)))
    places = [each.predict(values, conditions) for each in (read(new), model, read(old), at_origin)]
    np.testing.assert_array_equal(places[0], places[1])
    np.testing.assert_array_equal(places[2], places[3])
    assert np.abs(places[1] - places[2]).max() > 1e-6
    with pytest.raises(ModelFileError, match=r"bearing_heights: has 2 entries; expected 7, one per joint"):
        read(short)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
@pytest.mark.parametrize(("seed", "is_last"), [(98711, True), pytest.param(98704, False, marks=pytest.mark.long)])
def test_of_bearings_and_names_what_explains_more_enters_first(seed: int, is_last: bool) -> None:
    """After the compliances; of bearings the chain of the gap tells directions and places apart from these."""
    trail = discover(draw_case("gear_eccentricity", seed, **fresh(seed)))
    entered = [change.entered for change in trail.changes]
    (features,) = (effects for effects in entered if isinstance(effects[0], ObliqueBearing | BearingPlace))
    names = [effects for effects in entered if effects[0].name == "gear_eccentricity"]

    assert entered[0][-1] == BearingElasticity()
    assert entered[1:] == ([*names, features] if is_last else [features, *names])
    said = [_words(change) for change in trail.changes if change.entered == features]
    assert said == ["+ " + ", ".join(f"{effect.name} of {effect.locus.joint}" for effect in features)]


@pytest.mark.long
def test_bearings_of_a_real_arm_are_placed_in_few_steps(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On UR10 B compliance and place of bearings trade along bent ridges: 69 linearisations, 517 with halved steps."""
    counted = []

    def count(*arguments: object) -> object:
        counted.append(1)
        return reweighted(*arguments)  # type: ignore[arg-type]

    reweighted = equations.reweighted
    monkeypatch.setattr(equations, "reweighted", count)
    robot = Robot.from_urdf("ur10")
    table = read_measurements(shared_data / "ur10_tmac" / "series_B.csv", robot.joint_names)
    fit = fit_tables(robot, table, Options(effects=ELASTIC, moment_frame="after"))
    assert any(isinstance(effect, BearingPlace) for effect in fit.options.effects)
    assert fit.solution.converged
    assert len(counted) < 130
