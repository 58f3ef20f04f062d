"""Arms in motion: loads of inertia, paths of joints, clocks and streams, against closed forms and the simulated machine."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.model.chain import Chain, MomentFrame
from pincal.model.conditions import Conditions
from pincal.model.effects import ELASTIC
from pincal.model.model import Model
from pincal.motion.inertial_loads import inertial_loads
from pincal.robot.robot import Robot
from pincal.robot.urdf_file import find_file

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

ARMS: dict[str, Callable[[], Path]] = {
    "kuka": kuka_urdf_path,
    "ur10": lambda: find_file("ur10"),
    "panda": lambda: find_file("panda"),
}


@pytest.fixture(scope="module", params=ARMS)
def robot(request: pytest.FixtureRequest) -> Robot:
    """Return each of the arms: industrial, parallel axes, seven joints."""
    return Robot.from_urdf(ARMS[request.param]())


# --- loads of inertia -------------------------------------------------------------------------------------------


Frame = MomentFrame


@pytest.mark.parametrize("frame", ["before", "after"])
def test_inertia_bends_the_arm_as_it_does_the_true_one(robot: Robot, frame: Frame, rng: np.random.Generator) -> None:
    """What moving links add to the deflections is that of the simulated machine to a thousandth."""
    n, rows = robot.n_joints, 20
    q, speeds, gains = robot.random_configurations(rows, rng), *(rng.standard_normal((2, rows, n)) * [[[2.0]], [[6.0]]])
    payload, centre = rng.choice([0.0, 4.0], rows), np.array([0.1, -0.05, 0.2])
    compliance = np.tile([1e-8, 1e-8, 5e-8], (n, 1))
    machine = sim.TrueMachine.from_urdf(
        robot.urdf.decode(), tip=robot.tip, base=robot.base, compliance=compliance, moment_frame=frame
    )
    model = Model(Chain.of(robot, moment_frame=frame), ELASTIC, equilibrium=True)
    values = np.zeros(model.n_parameters)
    values[[model.index(f"{joint}.k_{axis}") for joint in robot.joint_names for axis in "xyz"]] = compliance.ravel()
    loads = inertial_loads(robot, q, speeds, gains, payload=payload, payload_centre=centre)
    conditions = Conditions(q, np.zeros(rows, int), payload, centre, velocity=speeds, inertial=loads)
    held, load = replace(conditions, velocity=None, inertial=None), {"payload": payload, "payload_com": centre}
    expected = machine.tip(q, velocity=speeds, acceleration=gains, **load) - machine.tip(q, **load)

    found = model.predict(values, conditions) - model.predict(values, held)
    assert np.abs(found - expected[:, :3]).max() < 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("frame", ["paper", "before", "after"])
def test_moments_about_the_axes_are_the_torques_of_the_drives(robot: Robot, frame: Frame, rng: np.random.Generator) -> None:
    """Static and inertial moments about each axis are what Pinocchio's rnea has the drives hold against."""
    n, rows = robot.n_joints, 5
    q, speeds, gains = robot.random_configurations(rows, rng), *rng.standard_normal((2, rows, n))
    conditions = replace(Conditions.at(q), inertial=inertial_loads(robot, q, speeds, gains))
    moments = Model(Chain.of(robot, moment_frame=frame), ()).static_moments(np.zeros(0), conditions)
    model = robot.pinocchio_model()
    order = [model.joints[model.getJointId(name)].idx_v for name in robot.joint_names]
    for row in range(rows):
        v, a = np.zeros((2, model.nv))
        v[order], a[order] = speeds[row], gains[row]
        torque = pin.rnea(model, model.createData(), robot.configuration(model, q[row]), v, a)[order]
        np.testing.assert_allclose(moments[row, 2::3], -torque, rtol=0.0, atol=1e-9 * np.abs(torque).max())


def test_an_arm_without_masses_has_no_loads_of_inertia() -> None:
    """Where the URDF does not say what links weigh, moments stay static."""
    robot = Robot.from_urdf(kuka_urdf_path(), mass=200.0)
    bare = Robot.from_urdf(re.sub(rb"<inertial>.*?</inertial>", b"", robot.urdf, flags=re.S))
    q = np.zeros((1, bare.n_joints))

    assert bare.massless and inertial_loads(bare, q, q, q) is None
