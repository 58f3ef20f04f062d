"""Score tests where a joint scatters: right p-values there, the same as ever where the noise is even."""

import numpy as np
import pytest
from scipy.stats import binom
from test_scatter import NOISE, measured

from pincal.discover.scatter import p_value_of_uneven_noise
from pincal.discover.score_tests import score_test_given_nuisances
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import without
from pincal.identify.options import Options
from pincal.model.catalogue import GearEccentricity, GearRipple
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot

RIPPLE = GearRipple("joint_3", 77.3)


def p_values(robot: Robot, scatter: float, seed: int, poses: int = 70) -> tuple[float, float]:
    """Return the p-value of the ripple by the score test, and that which holds whatever the noise is."""
    fit = fit_tables(robot, measured(robot, scatter, seed=seed, poses=poses), Options(effects=GEOMETRIC, sigma=NOISE))
    tests = score_test_given_nuisances(fit, [RIPPLE])
    return tests.score([0], 1).p_value, p_value_of_uneven_noise(fit, tests)


@pytest.mark.parametrize("seed", range(3))
def test_even_noise_changes_nothing(seed: int, kuka: Robot) -> None:
    """The noise along the effect is no more than chance explains: the score test stands."""
    plain, held = p_values(kuka, 0.0, seed)

    assert held == pytest.approx(plain, rel=1e-9)


@pytest.mark.parametrize("scatter", [0.0, 2e-4])
def test_an_effect_may_go_before_another_is_tested(scatter: float, kuka: Robot) -> None:
    """From the rows of the fit with it follows what those of the fit without it say."""
    gone = GearEccentricity("joint_2")
    table = measured(kuka, scatter, seed=4, poses=70)
    fit = fit_tables(kuka, table, Options(effects=(*GEOMETRIC, gone), sigma=NOISE))
    rest = without(fit, gone)
    tests = score_test_given_nuisances(fit, [RIPPLE, gone]).among([0], fit.names_of([gone]))
    expected = score_test_given_nuisances(rest, [RIPPLE])

    assert tests.score([0], 1).p_value == pytest.approx(expected.score([0], 1).p_value, rel=1e-3)
    assert p_value_of_uneven_noise(fit, tests) == pytest.approx(p_value_of_uneven_noise(rest, expected), rel=1e-3)


@pytest.mark.long
@pytest.mark.rates
def test_a_scattering_joint_makes_no_more_of_chance_than_it_says(kuka: Robot) -> None:
    """Three targets share what the joint does in a visit, which a fit knows of all drives only: this test knows of one."""
    drawn = np.array([p_values(kuka, 2e-4, seed) for seed in range(100, 300)])
    plain, held = (drawn < 0.05).sum(axis=0)

    assert plain > binom.ppf(0.999, 200, 0.06)
    assert binom.ppf(1e-3, 200, 0.03) <= held <= binom.ppf(0.999, 200, 0.06)
