"""Parameters by name: estimates and their covariance against plain matrices."""

import numpy as np
import pytest

from pincal.parameters import Covariance, Estimate, Parameter, carried_over


def _random_covariance(rng: np.random.Generator, n: int, k: int) -> Covariance:
    """Return a covariance of ``n`` parameters in three groups, one of them of parameters that are shared by no group."""
    order = rng.permutation(n)
    groups = []
    for places in (order[:3], order[3:5]):
        half = rng.normal(size=(len(places), len(places)))
        groups.append((places, half @ half.T))
    return Covariance(rng.normal(size=(n, k)), tuple(groups))


def _estimate(rng: np.random.Generator) -> tuple[Estimate, np.ndarray]:
    """Return an estimate of nine parameters, seven of them fitted, and its covariance with zeros for the others."""
    parameters = tuple(Parameter(f"joint_{i}.d", "m", "link_geometry", 0.0, 1e-3) for i in range(9))
    free = np.ones(9, bool)
    free[[2, 6]] = False
    covariance = _random_covariance(rng, 7, 2)
    whole = np.zeros((9, 9))
    whole[np.ix_(free, free)] = covariance.dense()
    return Estimate(parameters, rng.normal(size=9), free, covariance, np.arange(1.0, 10.0)), whole


def test_taking_parameters_takes_their_rows_and_columns_of_the_covariance(rng: np.random.Generator) -> None:
    """Whatever the order and wherever the groups lie."""
    found = _random_covariance(rng, 8, 3)
    places = np.array([6, 0, 3, 7])
    np.testing.assert_allclose(found.take(places).dense(), found.dense()[np.ix_(places, places)], rtol=1e-14)
    np.testing.assert_allclose(found.variance, np.diag(found.dense()), rtol=1e-14)


def test_take_and_drop_keep_values_and_covariance_together(rng: np.random.Generator) -> None:
    """By name, with parameters that were not fitted among them."""
    estimate, whole = _estimate(rng)
    names = [estimate.names[i] for i in (8, 2, 0, 5)]
    taken = estimate.take(names)
    assert taken.names == tuple(names)
    np.testing.assert_array_equal(taken.values, estimate.values[[8, 2, 0, 5]])
    np.testing.assert_allclose(taken.dense_covariance(), whole[np.ix_([8, 2, 0, 5], [8, 2, 0, 5])], rtol=1e-14)
    rest = estimate.drop([*names, "no such name"])
    kept = [1, 3, 4, 6, 7]
    assert rest.names == tuple(estimate.names[i] for i in kept)
    np.testing.assert_allclose(rest.dense_covariance(), whole[np.ix_(kept, kept)], rtol=1e-14)


def test_sigma_is_the_priors_where_nothing_was_fitted(rng: np.random.Generator) -> None:
    """While the fit itself knows nothing there."""
    estimate, whole = _estimate(rng)
    fitted = estimate.free
    np.testing.assert_allclose(estimate.sigma[fitted], np.sqrt(np.diag(whole))[fitted], rtol=1e-14)
    np.testing.assert_array_equal(estimate.sigma[~fitted], estimate.prior[~fitted])
    assert np.isinf(estimate.fitted_sigma[~fitted]).all() and np.isfinite(estimate.fitted_sigma[fitted]).all()


def test_values_are_carried_over_by_name(rng: np.random.Generator) -> None:
    """Parameters that are new start at zero."""
    estimate, _ = _estimate(rng)
    other = (estimate.parameters[4], Parameter("joint_1.theta", "rad", "joint_offset", 0.0, 1e-3), estimate.parameters[1])
    index = {name: i for i, name in enumerate(estimate.names)}
    found = carried_over(estimate.values, index, other)
    np.testing.assert_array_equal(found, [estimate.values[4], 0.0, estimate.values[1]])


def test_an_unknown_name_is_refused(rng: np.random.Generator) -> None:
    """As a dictionary does."""
    with pytest.raises(KeyError, match="nobody"):
        _estimate(rng)[0].take(["nobody"])


def test_a_stations_parameter_says_whose_it_is() -> None:
    """Its name is unique among several stations; alone it keeps its plain name."""
    x = Parameter("base.x", "m", "base_frame", 0.0, np.inf)
    assert (x.at("tracker").name, x.at("tracker").station, x.at("tracker").local_name) == (
        "tracker/base.x",
        "tracker",
        "base.x",
    )
    assert x.at("") is x
