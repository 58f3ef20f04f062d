"""What is compliant in the place of a bearing: told where data can't tell, and only there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from discovery_cases import SIGMA, draw_case, fresh, random_urdf
from placed_arms import FIRST, TOOL
from scipy.special import chdtri

import pincal.simulate as sim
from pincal import ELASTIC, GEOMETRIC, Options, Robot, calibrate, measurements_from_arrays
from pincal.discover.elastic import costs_instead, instead_of, significant_compliances, without_compliance
from pincal.discover.score_tests import score_test
from pincal.identify.calibrate import Tolerance, refit
from pincal.identify.choices import deviance
from pincal.identify.fit import ModelFit
from pincal.model.catalogue import BaseElasticity, LinkBending
from pincal.model.effect import Effect
from pincal.model.effects import BearingElasticity, JointElasticity
from pincal.parameters import Estimate


def fit_of(tmp_path: Path, *hidden: sim.HiddenEffect) -> ModelFit:
    """Return an elastic fit, bearings tilting with the link before, of an arm with soft drives and what is hidden."""
    path, rng = tmp_path / "arm.urdf", np.random.default_rng(3)
    path.write_text(random_urdf(rng, heavy=True, frames="skew"))
    robot, machine = Robot.from_urdf(path), sim.TrueMachine.from_urdf(path, tip="tool0", compliance=[0.0, 0.0, 2e-7])
    q = sim.plan_poses(machine.nominal, 150, rng)
    tracker = sim.Instrument(pose=FIRST, targets=TOOL)
    table = tracker.measure(machine.with_effects(*hidden), q)
    position = np.column_stack([table[axis] for axis in "xyz"]) + SIGMA * rng.standard_normal((150, 3))
    rows = measurements_from_arrays(robot.joint_names, q, position=position)
    return calibrate(robot, rows, Options(effects=ELASTIC, sigma=SIGMA, moment_frame="before")).fit


def bearing_of(fit: ModelFit, joint: str) -> tuple[Effect, Estimate]:
    """Return the compliance of one joint's bearing, which is sure, and its parameters."""
    sure = {
        effect.heading[:2]: (effect, estimate) for effect, estimate, *_ in significant_compliances(fit, fit.problem.effects)
    }
    return sure["bearing_elasticity", joint]


def test_a_foundation_is_told_beside_the_first_bearing(tmp_path: Path) -> None:
    """A base that tilts, taken for a bearing, stands beside it; the cost is that of a fit without the bearing."""
    fit = fit_of(tmp_path, sim.BaseElasticity(size=5e-7))
    tests = score_test(fit, [BaseElasticity(), LinkBending("axis_3")])
    found = bearing_of(fit, "axis_1")

    assert instead_of(tests, *found) == (BaseElasticity(),)

    others = fit.problem.chain.robot.joint_names[1:]
    swapped = refit(fit, [*GEOMETRIC, JointElasticity(), BearingElasticity(others), BaseElasticity()])
    spent = np.log(3 * len(fit.problem)) * (swapped.solution.posterior.effective - fit.solution.posterior.effective)
    expected = deviance(swapped) - deviance(fit) + spent
    lost = {p.name: v * p.unit.endswith("/(N m)") for p, v in zip(found[1].parameters, found[1].values, strict=True)}
    assert costs_instead(tests, [0], lost) == pytest.approx([expected], abs=6.0)


def test_a_fit_without_a_bearing_leaves_the_noise_of_one_of_everything_else(tmp_path: Path) -> None:
    """Nothing is fitted for it: what the compliance explains is in its covariance."""
    fit = fit_of(tmp_path, sim.BaseElasticity(size=5e-7))
    effect, _ = bearing_of(fit, "axis_1")
    rest = without_compliance(fit, effect)
    again = refit(fit, rest.options.effects, until=Tolerance.ROUGH)

    assert {p.name for p in effect.parameters(fit.problem.chain)}.isdisjoint(p.name for p in rest.problem.parameters)
    assert [p.name for p in again.problem.parameters] == [p.name for p in rest.problem.parameters]
    assert again.solution.estimated[0] > 1.05 * fit.solution.estimated[0]
    assert rest.solution.estimated == pytest.approx(again.solution.estimated, rel=0.1)


def test_a_bearing_that_gives_way_has_no_rival(tmp_path: Path) -> None:
    """Not at the second joint, soft in one direction: no link before it bends so, and the base turns about other axes."""
    fit = fit_of(tmp_path, sim.BearingElasticity(joint="axis_2", size=1e-6, size_y=2e-7, moment_frame="before"))
    tests = score_test(fit, [BaseElasticity(), *(LinkBending(joint) for joint in fit.problem.chain.robot.joint_names[:-1])])

    assert instead_of(tests, *bearing_of(fit, "axis_2")) == ()


def test_a_compliance_is_as_sure_as_a_fit_without_it_is_bad(tmp_path: Path) -> None:
    """Its chance is that of the score test on the fit without it, whatever k_x and k_y trade with each other."""
    fit = fit_of(tmp_path, sim.BaseElasticity(size=1.5e-7))
    bearings = [effect for effect in fit.problem.effects if effect.name == "bearing_elasticity"]
    compliance, _, p_value, *_ = significant_compliances(fit, bearings)[0]
    rest = without_compliance(fit, compliance)
    joint = str(compliance.locus.joint)
    more = [type(e)(joint) for e in fit.problem.effects if e.name == "oblique_bearing"]
    tests = score_test(rest, [compliance, *more])
    score = tests.score(range(len(tests.effects)), 1)
    # In units of the noise that the whole fit leaves.
    gain = score.gain * float(rest.solution.estimated[0] / fit.solution.estimated[0]) ** 2

    assert chdtri(score.rank, p_value) == pytest.approx(gain, rel=0.2)


def test_two_compliances_of_which_one_gives_way_are_told_for_each_other() -> None:
    """A drive turns an arm as the bearing of the joint before tilts it: together they are sure, the base beside them."""
    case = draw_case("base_elasticity", 10273, **fresh(10273))
    fit = calibrate(case.robot, case.rows, replace(case.plain, moment_frame="before", loss="none"))
    sure = {entry.effect.heading[:2]: entry for entry in significant_compliances(fit.fit, ELASTIC)}
    drive, bearing = sure["joint_elasticity", "axis_2"], sure["bearing_elasticity", "axis_1"]
    tests = score_test(fit.fit, [BaseElasticity(), LinkBending("axis_2"), LinkBending("axis_4")])

    assert drive.others == (bearing.effect,) and bearing.others == (drive.effect,)
    for one in (drive, bearing):
        size = float(np.sqrt(np.diag(one.estimate.dense_covariance())[0]))
        assert abs(one.estimate.values[0]) < 3.0 * size and one.p_value < 1e-100
    assert instead_of(tests, bearing.effect, bearing.estimate, bearing.given) == (BaseElasticity(),)
    assert instead_of(tests, drive.effect, drive.estimate, drive.given) == ()

    # What is lost without both is not the sum of what each loses beside the other.
    rest = without_compliance(fit.fit, drive.effect, bearing.effect)
    again = refit(fit.fit, rest.options.effects, until=Tolerance.ROUGH)
    assert [p.name for p in again.problem.parameters] == [p.name for p in rest.problem.parameters]
    assert again.solution.estimated[0] > 1.2 * fit.solution.estimated[0]
    assert rest.solution.estimated == pytest.approx(again.solution.estimated, rel=0.1)
