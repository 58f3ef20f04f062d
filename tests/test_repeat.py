"""Repeated fits: the same on any executor, and their spread what the covariance says."""

from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
from test_calibrate import paper_table

from pincal import GEOMETRIC, Options, calibrate, cross_validate

OPTIONS = Options(effects=GEOMETRIC, payload_centre=(0.08, -0.05, 0.22))


@pytest.fixture(scope="module")
def fit(kuka):
    return calibrate(kuka, paper_table(kuka, 150, 0, 5e-5), OPTIONS)


def test_executors_give_the_same_draws(fit):
    """Threads and the plain loop agree to the last digit: seeds belong to the draws."""
    with ThreadPoolExecutor(2) as executor:
        np.testing.assert_array_equal(fit.monte_carlo(draws=4, executor=executor), fit.monte_carlo(draws=4))


@pytest.mark.long
def test_other_processes_give_the_same_draws(fit):
    """Everything a fit needs can be sent to another process."""
    with ProcessPoolExecutor(2) as executor:
        np.testing.assert_array_equal(fit.bootstrap(draws=4, executor=executor), fit.bootstrap(draws=4))


def test_cross_validation_predicts_every_row_once(kuka):
    """All rows get a residual, by a fit that did not see them, about as large as the noise of a good model."""
    table = paper_table(kuka, 150, 0, 5e-5)
    found = cross_validate(kuka, table, Options(payload_centre=OPTIONS.payload_centre), folds=5, split="blocked")
    assert set(found.fold) == {0, 1, 2, 3, 4}
    assert np.sqrt(np.mean(found.residuals**2)) < 2e-4


@pytest.mark.long
def test_monte_carlo_spread_is_the_posterior(fit):
    """The spread of predictions over simulated readings equals that of the covariance within its own scatter."""
    conditions = fit.problem.conditions.select(slice(0, 40))
    draws = fit.monte_carlo(draws=60, seed=1)
    places = np.array([fit.model.predict(values, conditions)[:, :, 3] for values in draws])
    _, J = fit.model.linearise(fit.values, conditions, free=fit.solution.free)
    sigma = np.sqrt(np.einsum("nij,jk,nik->ni", J, fit.solution.known.covariance, J))
    assert np.mean(places.std(axis=0) / sigma) == pytest.approx(1.0, abs=0.1)
