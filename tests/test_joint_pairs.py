"""Errors of one joint that depend on another: waves of both positions, of any orders, in place of scatter."""

import numpy as np
import pytest
from discovery_cases import INTERACTIONS, draw_case
from interaction_study import summary
from machines import kuka as true_kuka
from rates import is_at_most
from scipy.special import chdtrc

from pincal import calibrate
from pincal import simulate as sim
from pincal.discover.joint_pairs import PairOfJoints, likely_waves_of_two
from pincal.discover.run import Discovery, run_discovery
from pincal.identify.options import Options
from pincal.measure.measurements import measurements_from_arrays
from pincal.model.catalogue.unnamed import Unnamed, wave_of_two
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot


@pytest.fixture
def pair(rng: np.random.Generator) -> PairOfJoints:
    """Return residuals of noise, and an error of orders 2 and 3."""
    own, other = rng.uniform(-2.0, 2.0, 200), rng.uniform(-3.0, 3.0, 200)
    lever = rng.standard_normal((200, 3))
    error = np.sin(2.0 * own) * np.cos(3.0 * other + 0.3)
    residuals = rng.standard_normal((200, 3)) + lever * error[:, None]
    return PairOfJoints(own, other, np.sum(lever * residuals, axis=1), np.sum(lever**2, axis=1))


@pytest.mark.parametrize(("m", "n"), [(2.0, 3.0), (0.7, 1.3), (5.5, 0.4)])
def test_gains_are_those_of_least_squares(pair: PairOfJoints, m: float, n: float) -> None:
    """Of the four products of sine and cosine, by numpy's solver."""
    basis = [f(m * pair.own) * g(n * pair.others) for f in (np.sin, np.cos) for g in (np.sin, np.cos)]
    columns = np.transpose(basis) * np.sqrt(pair.lever)[:, None]
    target = pair.along / np.sqrt(pair.lever)
    step = np.linalg.lstsq(columns, target)[0]

    np.testing.assert_allclose(pair.gains(np.array([m]), np.array([n])), np.sum((columns @ step) ** 2), rtol=1e-4)
    gain, slope = pair.gain(m, n)
    np.testing.assert_allclose(gain, pair.gains(np.array([m]), np.array([n])), rtol=1e-9)
    for along, step in zip(slope, 1e-5 * np.eye(2), strict=True):
        after, before = (pair.gain(*(np.array([m, n]) + sign * step))[0] for sign in (1.0, -1.0))
        assert along == pytest.approx((after - before) / 2e-5, rel=1e-5, abs=1e-4)


def test_the_strongest_wave_has_the_true_orders(pair: PairOfJoints) -> None:
    """To a tenth of what the ranges resolve; it gains more than any on a grid ten times as fine as the search's."""
    gain, orders = pair.strongest()
    fine = np.linspace(0.0, 6.0, 121)

    np.testing.assert_allclose(orders, [2.0, 3.0], atol=0.15)
    assert gain > 0.999 * pair.gains(fine, fine[1:]).max()


def test_what_is_not_refined_would_not_be_found(rng: np.random.Generator) -> None:
    """A few gains close to the highest of the grid see nine tenths of what refining it finds, or more."""
    seen = []
    for k in range(60):
        n, reach = int(rng.choice([60, 200, 600])), rng.uniform(0.5, 3.1, (2, 1))
        q = reach * rng.uniform(-1.0, 1.0, (2, n)) if k % 2 else reach * np.sin(rng.uniform(-1.5, 1.5, (2, n)))
        lever, orders = rng.uniform(0.0, 2.0, n), rng.uniform(0.0, 6.0, 2)
        error = rng.uniform(0.0, 2.0) * np.sin(orders[0] * q[0]) * np.cos(orders[1] * q[1] + 1.0)
        pair = PairOfJoints(q[0], q[1], np.sqrt(lever) * rng.standard_normal(n) + lever * error, lever)
        seen.append(pair.peak.gain / pair.strongest()[0])

    assert min(seen) > 0.9 and max(seen) < 1.0 + 1e-9


@pytest.fixture(scope="module")
def found(kuka: Robot) -> Discovery:
    """Return what is found, without a declared noise, of a KUKA whose third joint errs by a wave of it and of the fifth."""
    rng = np.random.default_rng(6)
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = sim.plan_poses(machine.nominal, 200, rng)
    there = q.copy()
    there[:, 2] += 1.5e-4 * np.sin(2.0 * q[:, 2] + 3.0 * q[:, 4])
    table = sim.Instrument(targets={"ball": (0.1, 0.0, 0.1)}, sigma=5e-5).measure(machine, there, rng=rng)
    position = np.column_stack([table[axis] for axis in "xyz"])
    rows = measurements_from_arrays(kuka.joint_names, q, position=position)
    return run_discovery(kuka, rows, Options(effects=GEOMETRIC, moment_frame="after"))


@pytest.mark.long
def test_a_wave_of_two_joints_is_found_with_its_orders(found: Discovery) -> None:
    """As one effect without a name, not as scatter; the error at held-out poses is within a quarter of the noise."""
    (step,) = (step for step in found.trail.steps if not step.is_elastic)
    (entry,) = (entry for entry in found.report["effects"] if "elasticity" not in entry["effect"])
    after = found.report["gap"]["after"]["rms_mm"]

    assert [entry[key] for key in ("effect", "joint", "depends_on", "shape")] == ["unnamed", "joint_3", "joint_5", "product"]
    assert isinstance(step.effect, Unnamed)
    assert step.effect.own_order == pytest.approx(2.0, abs=0.15) and step.effect.order == pytest.approx(3.0, abs=0.15)
    assert not found.report["scatter"] and not any("joint noise" in note.text for note in found.calibration.notes)
    assert after < 1.25 * np.sqrt(3.0) * 0.05


@pytest.mark.long
def test_what_was_found_is_not_sought_again(found: Discovery) -> None:
    """No further wave is worth a test once it is in the model; nor is one in noise alone."""
    assert not likely_waves_of_two(found.trail.final, found.calibration.robot.joint_names)


def test_a_joint_that_hardly_moved_has_no_waves(kuka: Robot) -> None:
    """One whose span tells no order up to the finest from none is left out, and the others are searched as without it."""
    rng = np.random.default_rng(4)
    q = kuka.random_configurations(120, rng)
    q[:, 5] = rng.uniform(0.0, 0.1, len(q))
    there = q.copy()
    there[:, 1] += 4e-4 * np.sin(2.0 * q[:, 1]) * np.cos(3.0 * q[:, 0])
    position = kuka.forward_kinematics(there)[:, :3, 3] + 2e-5 * rng.standard_normal((len(q), 3))
    rows = measurements_from_arrays(kuka.joint_names, q, position=position)
    fit = calibrate(kuka, rows, Options(effects=GEOMETRIC)).fit
    (wave,) = likely_waves_of_two(fit, ["joint_2", "joint_6"])

    assert isinstance(wave, Unnamed)
    assert (wave.joint, wave.depends_on) == ("joint_2", "joint_1")


def test_waves_of_other_orders_are_other_effects() -> None:
    """So that several may enter; without an own order it is a wave of the other joint."""
    first, second = (wave_of_two("a", "b", orders, 10.0) for orders in ((1.0, 2.0), (1.5, 2.0)))
    alone = wave_of_two("a", "b", (0.0, 2.5), 10.0)

    assert first.identity != second.identity
    assert (alone.shape, alone.order, alone.n_functions, alone.trials) == ("waves", 2.5, 2, 10.0)


@pytest.mark.long
def test_what_was_searched_is_paid_for(rng: np.random.Generator) -> None:
    """Of 200 draws of noise, of a pair of joints, the best wave passes at 5 % of its corrected chance in no more."""
    passed = []
    for _ in range(200):
        q, lever = rng.uniform(-3.0, 3.0, (2, 150)), rng.uniform(0.0, 2.0, 150)
        pair = PairOfJoints(q[0], q[1], np.sqrt(lever) * rng.standard_normal(150), lever)
        passed.append(pair.count * chdtrc(4, pair.strongest()[0]) < 0.05)

    assert is_at_most(0.05, passed)


@pytest.mark.long
def test_the_study_draws_what_it_says() -> None:
    """The error moves the tool by lambda, and the table without it is the same machine's."""
    for i, kind in enumerate(INTERACTIONS):
        case = draw_case(kind, 9100 + i, n=60, strength=400.0, arm="kuka")
        assert 380.0 < case.strength < 420.0
        assert case.truth[0][0] == "unnamed" and not np.allclose(case.clean, case.sound)
    assert summary([])[0].startswith("no table")
