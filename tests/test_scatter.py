"""Scatter of a joint: found where it is, and once a visit, however many things are read in one."""

import numpy as np
import pytest
from machines import kuka as true_kuka

from pincal import simulate as sim
from pincal.discover.scatter import find_scatter, visits
from pincal.identify.calibrate import calibrate
from pincal.identify.options import Options
from pincal.identify.station import station_of
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.model.chain import Chain
from pincal.model.effects import GEOMETRIC
from pincal.model.model import Model
from pincal.robot.robot import Robot

TARGETS = {"a": (0.1, 0.0, 0.1), "b": (-0.05, 0.08, 0.12), "c": (-0.05, -0.08, 0.15)}
NOISE = 5e-5


def measured(robot: Robot, scatter: float, *, seed: int) -> Measurements:
    """Return three targets in each of 70 poses of a machine whose third joint scatters [rad]."""
    rng = np.random.default_rng(seed)
    effects = [sim.hidden_effect("joint_scatter", joint="joint_3", size=scatter)] if scatter else []
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3).with_effects(*effects)
    q = sim.plan_poses(machine.nominal, 70, rng)
    table = sim.Instrument(targets=TARGETS, sigma=NOISE).measure(machine, q, rng=rng)
    return measurements_from_arrays(
        robot.joint_names,
        np.column_stack([table[name] for name in robot.joint_names]),
        position=np.column_stack([table[axis] for axis in "xyz"]),
        target=table["target"],
    )


@pytest.mark.parametrize("size", [1e-4, 5e-5])
def test_scatter_of_a_joint_is_found_with_its_size(size: float, kuka: Robot) -> None:
    """It is the same for all targets of a visit: 70 draws of it tell its size to about a tenth."""
    found = find_scatter(calibrate(kuka, measured(kuka, size, seed=3), Options(effects=GEOMETRIC, sigma=NOISE)))

    assert found is not None and found.joint == "joint_3"
    assert found.sigma_rad == pytest.approx(size, rel=0.3)


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_several_targets_is_no_scatter(seed: int, kuka: Robot) -> None:
    """Sound readings raise no alarm."""
    assert find_scatter(calibrate(kuka, measured(kuka, 0.0, seed=seed), Options(effects=GEOMETRIC, sigma=NOISE))) is None


def test_rows_of_one_pose_are_one_visit_unless_they_read_the_same_again(kuka: Robot) -> None:
    """Two targets of a pose belong together; the second round of the same poses does not."""
    q = np.tile([[0.0], [0.0], [1.0]], (2, 6))
    table = measurements_from_arrays(kuka.joint_names, q, position=np.zeros((6, 3)), target=[*"aba"] * 2)
    found = visits(station_of(Model(Chain.of(kuka, targets=("a", "b")), ()), table, np.zeros(3)))

    assert found[0] == found[1] and found[3] == found[4]
    assert len(set(found)) == 4 and found[0] != found[3] and found[2] != found[5]
