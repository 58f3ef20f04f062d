"""What dies away with time: one effect, whose time constant is a parameter with an uncertainty of its own."""

from __future__ import annotations

import numpy as np
import pytest
from discovery_cases import SIGMA

from pincal import GEOMETRIC, Options, Robot, measurements_from_arrays, run_discovery
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.discover.steps import linearised_about_itself
from pincal.identify.calibrate import fit_tables
from pincal.measure.measurements import Measurements
from pincal.model.catalogue import JointCreep, ThermalGrowth
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import ExponentialDrift

pytestmark = pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")

TAU, N = 3000.0, 160


def measured(*hidden: sim.HiddenEffect, seed: int = 0, temperature: np.ndarray | None = None, n: int = N) -> Measurements:
    """Return noisy positions of a stiff KUKA over 160 minutes, with hidden effects; the time is recorded."""
    rng = np.random.default_rng(seed)
    machine = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    q, time = sim.plan_poses(machine.nominal, n, rng), 60.0 * N / n * np.arange(n)
    tip = machine.with_effects(*hidden).tip(q, time=time, temperature=20.0 if temperature is None else temperature)
    position = tip[:, :3, 3] + tip[:, :3, :3] @ [0.1, 0.05, 0.2] + SIGMA * rng.standard_normal((n, 3))
    return measurements_from_arrays(machine.names, q, position=position, time=time, temperature=temperature)


CASES = [
    (sim.JointCreep(joint="joint_2", size=1e-4, time_constant=TAU), JointCreep("joint_2", 9e3), 1e-4),
    (sim.ThermalGrowth(size=2e-4, time_constant=TAU), ThermalGrowth(600.0), 2e-4),
]


@pytest.mark.parametrize(("hidden", "start", "size"), CASES, ids=lambda case: getattr(case, "effect", ""))
def test_the_time_constant_is_found_and_its_uncertainty(
    hidden: sim.HiddenEffect, start: ExponentialDrift, size: float
) -> None:
    """From one that is 3 or 5 times too long or short; amplitude and time constant lie within 3 sigma of the truth."""
    robot = Robot.from_urdf(kuka_urdf_path(), tip="tool0")
    fit = fit_tables(robot, measured(hidden), Options(effects=(*GEOMETRIC, start), sigma=SIGMA))
    fit, effect = linearised_about_itself(fit, start)
    found = fit.estimate.take(fit.names_of([effect]))
    values = found.values + [parameter.nominal for parameter in found.parameters]

    assert [parameter.unit for parameter in found.parameters][1] == "s"
    assert np.all(np.abs(values - [size, TAU]) < 3.0 * found.sigma), (values, found.sigma)
    assert np.all(found.sigma < 0.3 * values), "it says something"
    assert effect.about(found.values) == effect, "nothing moves any more"


def test_the_slope_is_that_of_the_shape() -> None:
    """Expanded, the change of the time constant moves the joint as the shape of another time constant does."""
    chain = Chain.of(Robot.from_urdf(kuka_urdf_path(), tip="tool0"))
    at = Conditions.at(np.zeros((50, 6)))
    conditions = Conditions(at.q, at.target, at.payload, at.payload_centre, time=np.linspace(-500.0, 3e4, 50))
    amplitude, h = 2e-4, 1.0
    shape, slope = (
        term.basis for term in JointCreep("joint_3", TAU, 100.0, expected=amplitude).terms(chain, conditions, None)
    )
    (longer,), (shorter,) = (JointCreep("joint_3", TAU + s * h, 100.0).terms(chain, conditions, None) for s in (1, -1))

    assert shape is not None and slope is not None and longer.basis is not None and shorter.basis is not None
    np.testing.assert_allclose(shape, 1.0 - np.exp(-np.maximum(conditions.time - 100.0, 0.0) / TAU), rtol=0, atol=1e-14)
    np.testing.assert_allclose(slope, amplitude * (longer.basis - shorter.basis) / (2 * h), rtol=0, atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize(("hidden", "start", "size"), CASES, ids=lambda case: getattr(case, "effect", ""))
def test_it_is_one_effect(hidden: sim.HiddenEffect, start: ExponentialDrift, size: float) -> None:
    """A discovery names it alone, no curve of time and no drift beside it, with its time constant."""
    robot = Robot.from_urdf(kuka_urdf_path(), tip="tool0")
    (found,) = run_discovery(robot, measured(hidden), Options(effects=GEOMETRIC, sigma=SIGMA)).findings.effects
    (constant,) = (parameter for parameter in found.parameters.values() if parameter.unit == "s")

    assert (found.effect, found.joint) == (hidden.effect, hidden.joint)
    assert constant.sigma is not None and abs(constant.value - TAU) < 3.0 * constant.sigma


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.rates)])
def test_many_rows_tell_the_same_of_it(seed: int) -> None:
    """Of 6000 rows 4000 choose, and would tell a curve of the time from a time constant that is a third off."""
    hidden, _, size = CASES[0]
    table = measured(hidden, n=6000, seed=seed)
    found = run_discovery(Robot.from_urdf(kuka_urdf_path(), tip="tool0"), table, test_fraction=0.0)
    fit = found.trail.final
    (effect,) = (step.effect for step in found.trail.steps)
    assert isinstance(effect, JointCreep) and effect.joint == "joint_2"
    again, about = linearised_about_itself(fit, effect)
    before, after = (f.estimate.take(f.names_of([e])) for f, e in ((fit, effect), (again, about)))
    values = [found.values + [parameter.nominal for parameter in found.parameters] for found in (before, after)]

    assert np.all(np.abs(values[1] - [size, TAU]) < 3.0 * after.sigma)
    assert np.all(np.abs(values[1] - values[0]) < 0.1 * after.sigma)


@pytest.mark.long
@pytest.mark.parametrize(
    "hidden",
    [
        sim.ThermalGrowth(size=2e-4, time_constant=TAU),
        pytest.param(sim.ThermalExpansion(size=2e-5), marks=pytest.mark.rates),
    ],
)
def test_a_recorded_temperature_is_not_taken_for_that_of_the_arm(hidden: sim.HiddenEffect) -> None:
    """While the hall warms up as well, links that grow by time or by temperature are named so, or both stand as a tie."""
    air = 20.0 + 12.0 * -np.expm1(-60.0 * np.arange(N) / 4500.0) + np.random.default_rng(3).normal(0.0, 0.5, N)
    robot, rows = Robot.from_urdf(kuka_urdf_path(), tip="tool0"), measured(hidden, temperature=air)
    (found,) = run_discovery(robot, rows, Options(effects=GEOMETRIC, sigma=SIGMA)).findings.effects

    assert hidden.effect in {found.effect, *(other.effect for other in found.equivalent)}
    assert {found.effect, *(e.effect for e in found.equivalent)} <= {"thermal_growth", "thermal_expansion"}
