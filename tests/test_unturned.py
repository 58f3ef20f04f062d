"""Plans that hardly turn the tool, such as a raster in one orientation, which leave the target's place on it open."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pincal import Options, Robot, calibrate, measurements_from_arrays
from pincal.calibration.calibration import Calibration, run_calibration
from pincal.calibration.precheck import precheck
from pincal.measure.measurements import Measurements
from pincal.report.judgement import next_steps

_ALONG = ('prismatic" name="x', "1 0 0"), ('prismatic" name="y', "0 1 0"), ('prismatic" name="z', "0 0 1")
_WRIST = ('revolute" name="a', "0 0 1"), ('revolute" name="b', "0 1 0"), ('revolute" name="c', "1 0 0")
_TOOL, _NOISE = np.array([0.05, -0.03, 0.12]), 5e-5
_WARNING = "these poses turn the tool about one axis or not at all"


def gantry(*joints: tuple[str, str]) -> Robot:
    """Return an arm of these joints, each 0.1 m behind the one before."""
    text = "".join(
        f'<joint type="{kind}"><parent link="l{k}"/><child link="l{k + 1}"/><origin xyz="0 0.02 0.1"/><axis xyz="{axis}"/>'
        f'<limit lower="-1" upper="1" effort="1" velocity="1"/></joint><link name="l{k + 1}"/>'
        for k, (kind, axis) in enumerate(joints)
    )
    return Robot.from_urdf(f'<robot name="gantry"><link name="l0"/>{text}</robot>'.encode())


def raster(robot: Robot, turns: tuple[float, ...], seed: int = 1) -> Measurements:
    """Return readings over a plane, other joints moved by parts of their ranges, with a smooth error without a parameter."""
    rng = np.random.default_rng(seed)
    x, y = (at.ravel() for at in np.meshgrid(np.linspace(-0.9, 0.9, 9), np.linspace(-0.9, 0.9, 9)))
    others = rng.uniform(-1.0, 1.0, (len(x), robot.n_joints - 2)) * turns
    q = np.column_stack([x, y, others])
    off = q + 1e-4 * np.sin(5.0 * np.roll(q, 1, axis=1))
    tip = robot.forward_kinematics(off)
    at = tip[:, :3, :3] @ _TOOL + tip[:, :3, 3]
    at = at @ Rotation.from_euler("xyz", [0.1, -0.2, 0.9]).as_matrix().T + [2.0, -1.0, 0.4]
    return measurements_from_arrays(robot.joint_names, q, position=at + rng.normal(0.0, _NOISE, at.shape))


def doubts(run: Calibration) -> list[str]:
    """Return what is said of the tool."""
    return [str(note) for note in run.result.warnings if _WARNING in str(note)]


@pytest.mark.parametrize("turn", [1e-5, *(pytest.param(turn, marks=pytest.mark.long) for turn in (0.0, 1e-6, 1e-4))])
def test_a_raster_in_one_orientation_ends_near_the_arm_and_says_what_is_open(turn: float) -> None:
    """Residuals fit a target that is metres away better than one nearby if rounding alone turns the tool."""
    robot = gantry(*_ALONG, *_WRIST)
    table = raster(robot, (0.0, turn, turn, turn))
    run = run_calibration(robot, table, Options(sigma=_NOISE))
    names = [p.name for p in run.fit.problem.parameters]
    tool = run.fit.estimate.values[[names.index(f"tool.{axis}") for axis in "xyz"]]

    assert run.result.converged
    assert np.linalg.norm(tool) < 3.0 * robot.reach
    assert len(doubts(run)) == 1
    assert any(step.startswith("Add poses with the wrist turned about two axes") for step in next_steps(run))
    assert any(_WARNING in str(note) for note in precheck(robot, table, Options(sigma=_NOISE)).warnings)


def test_with_its_place_or_turns_there_is_no_doubt() -> None:
    """What is given is not asked for; what is turned is found."""
    robot = gantry(*_ALONG, *_WRIST)
    still = raster(robot, (0.0, 1e-5, 1e-5, 1e-5))
    given = run_calibration(robot, still, Options(sigma=_NOISE, tools={"tool": _TOOL}))
    turned = calibrate(robot, raster(robot, (0.5, 0.5, 0.5, 0.5)), Options(sigma=_NOISE))

    assert not doubts(given)
    assert turned.problem.stations and not turned.options.unturned


@pytest.mark.long
def test_two_orientations_leave_the_direction_of_their_axis_open() -> None:
    """As a grid of people who turn the wrist once."""
    robot = gantry(*_ALONG, *_WRIST)
    one, other = (raster(robot, (0.3, 1e-5, 1e-5, 1e-5), seed) for seed in (1, 2))
    q = np.vstack([one.q, other.q + np.eye(6)[3] / 2.0])
    tip = robot.forward_kinematics(q)
    at = tip[:, :3, :3] @ _TOOL + tip[:, :3, 3] + np.random.default_rng(3).normal(0.0, _NOISE, (len(q), 3))
    run = run_calibration(robot, measurements_from_arrays(robot.joint_names, q, position=at), Options(sigma=_NOISE))

    assert len(doubts(run)) == 1


def test_an_arm_that_can_not_turn_is_not_asked_to() -> None:
    """Whatever a gantry without a wrist does, its base takes up where the target is."""
    robot = gantry(*_ALONG)
    run = run_calibration(robot, raster(robot, (0.9,)), Options(sigma=_NOISE))

    assert not run.fit.options.unturned
    assert not doubts(run)
    assert replace(run.fit.options, unturned=()) == run.fit.options
