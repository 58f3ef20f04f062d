"""How an arm is compliant: one drive or bearing alone, as a whole, or not at all."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from discovery_cases import SIGMA, random_urdf
from placed_arms import FIRST, TOOL
from scipy.stats import chi2

import pincal.simulate as sim
from pincal import GEOMETRIC, Options, PincalWarning, Robot, calibrate, measurements_from_arrays, read_measurements
from pincal.discover.elastic import elastic_way, significant_compliances, with_features
from pincal.discover.levers import missing_compliances
from pincal.discover.loop import elastic_ways, single_compliance
from pincal.discover.policy import POLICY
from pincal.discover.steps import elastic_step
from pincal.identify.calibrate import Tolerance, refit, with_bearings
from pincal.identify.fit import ModelFit
from pincal.model.chain import MOMENT_FRAMES
from pincal.model.effects import ELASTIC, BearingElasticity, JointElasticity


def fit_of(tmp_path: Path, *hidden: sim.HiddenEffect, drives: float = 0.0) -> ModelFit:
    """Return a geometric fit of a skew arm whose drives are as soft as told, with what is hidden."""
    path, rng = tmp_path / "arm.urdf", np.random.default_rng(3)
    path.write_text(random_urdf(rng, heavy=True, frames="skew"))
    robot, machine = Robot.from_urdf(path), sim.TrueMachine.from_urdf(path, tip="tool0", compliance=[0.0, 0.0, drives])
    q = sim.plan_poses(machine.nominal, 150, rng)
    table = sim.Instrument(pose=FIRST, targets=TOOL).measure(machine.with_effects(*hidden), q)
    position = np.column_stack([table[axis] for axis in "xyz"]) + SIGMA * rng.standard_normal((150, 3))
    rows = measurements_from_arrays(robot.joint_names, q, position=position)
    return calibrate(robot, rows, Options(effects=GEOMETRIC, sigma=SIGMA, moment_frame="before")).fit


def test_one_soft_bearing_enters_alone(tmp_path: Path) -> None:
    """In its own convention of moments, with its own directions; once it is in, nothing else is compliant."""
    soft = sim.BearingElasticity(joint="axis_3", size=6e-7, size_y=2e-7, moment_frame="before")
    fit = fit_of(tmp_path, soft)

    frame, way = single_compliance(elastic_ways(fit, MOMENT_FRAMES, POLICY), MOMENT_FRAMES, POLICY) or ("", None)

    assert frame == "before" and way is not None and way.effects == (BearingElasticity(("axis_3",)),) and way.is_single
    step = elastic_step(fit, way)
    assert elastic_way(step.after, POLICY) is None
    left = [
        joint
        for part in missing_compliances(step.after)
        if isinstance(part, BearingElasticity)
        for joint in part.joints or ()
    ]
    assert left == ["axis_1", "axis_2", "axis_4", "axis_5", "axis_6"]
    features = with_features(with_bearings(step.after), step.effects)[1:]
    assert features and all(e.heading == ("bearing_elasticity", "axis_3", None) for e in features)
    (sure,) = significant_compliances(step.after, step.effects, step.equivalent)
    assert sure.effect == step.effect and sure.p_value < 1e-10


def test_soft_drives_of_all_joints_enter_together(tmp_path: Path) -> None:
    """All that feel a load, with the bearings, as every arm has both."""
    way = elastic_way(fit_of(tmp_path, drives=1e-6), POLICY)

    assert way is not None and not way.is_single
    drives, bearings = way.effects
    assert drives.joints == ("axis_2", "axis_3", "axis_4", "axis_5", "axis_6") and bearings == BearingElasticity()


def test_none_of_a_rigid_arm_is_named_alone(tmp_path: Path) -> None:
    """Nothing enters; of compliances that the user fits and none of which is sure, each could be any other."""
    fit = fit_of(tmp_path)
    soft = refit(fit, ELASTIC)
    (sure,) = significant_compliances(soft, ELASTIC)

    assert elastic_way(fit, POLICY) is None
    assert sure.p_value > 1e-4 and len(sure.others) == POLICY.most_rivals
    every = soft.estimate.take(p.name for p in soft.estimate.parameters if p.unit == "rad/(N m)")
    z2 = every.values @ np.linalg.pinv(every.dense_covariance(), hermitian=True) @ every.values
    assert sure.p_value == pytest.approx(chi2.sf(z2, len(every)), rel=1e-6)


def test_a_wrist_alone_may_be_as_soft_as_its_load_lets_it(tmp_path: Path) -> None:
    """Beside all others, a drive that carries little is taken for one that carries a tenth of the largest moment."""
    fit = fit_of(tmp_path)
    alone, together = (refit(fit, [*GEOMETRIC, JointElasticity(j)], until=Tolerance.ROUGH) for j in (("axis_6",), None))
    sizes = [of.priors.sizes[of.estimate.names.index("axis_6.k_z")] for of in (alone, together)]

    assert sizes[0] > 3.0 * sizes[1]


@pytest.mark.long
def test_all_of_a_real_panda_gives_way(shared_data: Path) -> None:
    """From 157 poses in sockets too: one drive alone left .181 mm on rows held out, drives and bearings leave .150."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PincalWarning)
        robot = Robot.from_urdf("panda")
    table = read_measurements(shared_data / "panda_sockets" / "panda_3.csv", robot.joint_names)
    fit = calibrate(robot, table.select(np.arange(len(table)) % 5 > 0), Options(effects=GEOMETRIC))

    way = elastic_way(fit.fit, POLICY)

    assert way is not None and [effect.name for effect in way.effects] == ["joint_elasticity", "bearing_elasticity"]
