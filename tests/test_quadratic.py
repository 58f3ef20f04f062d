"""The information form: sums, elimination and gains against least squares on the rows themselves."""

from __future__ import annotations

import numpy as np
import pytest

from pincal.identify.quadratic import Factor, Quadratic

NAMES = ("a", "b", "c", "d", "e")


@pytest.fixture
def rows() -> tuple[np.ndarray, np.ndarray]:
    """Return columns of very different units, and residuals."""
    rng = np.random.default_rng(0)
    return rng.standard_normal((40, 5)) * np.logspace(-3, 4, 5), rng.standard_normal(40)


def left(J: np.ndarray, r: np.ndarray) -> float:
    """Return the squares that a fit by these columns leaves."""
    scale = np.linalg.norm(J, axis=0)
    return float(np.sum((r - J / scale @ np.linalg.lstsq(J / scale, r, rcond=None)[0]) ** 2))


def test_the_sum_of_two_is_that_of_all_rows(rows: tuple[np.ndarray, np.ndarray]) -> None:
    """Whatever the order of the parameters, and if one of the two does not have them all."""
    J, r = rows
    J[20:, 1] = 0.0
    other = [4, 2, 0, 3]
    parts = Quadratic.of_rows(NAMES, J[:20], r[:20]) + Quadratic.of_rows([NAMES[i] for i in other], J[20:, other], r[20:])
    whole = Quadratic.of_rows(NAMES, J, r)

    assert parts.names == NAMES and parts.degrees == 40
    for name in ("H", "g", "whole", "square"):
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), rtol=1e-12, atol=1e-12)


def test_released_parameters_are_fitted_by_least_squares(rows: tuple[np.ndarray, np.ndarray]) -> None:
    """What is left of the squares is what a fit by these columns leaves; what others take off besides, too."""
    J, r = rows
    form, some, more = Quadratic.of_rows(NAMES, J, r), np.array([1, 3]), np.array([0, 4])
    after = form.released(some)
    gain, rank = after.gain(more)

    assert after.square == pytest.approx(left(J[:, some], r), rel=1e-10)
    assert (after.degrees, rank) == (38, 2)
    assert after.square - gain == pytest.approx(left(J[:, [0, 1, 3, 4]], r), rel=1e-10)
    assert after.released(some).square == pytest.approx(after.square)


def test_estimates_are_those_of_least_squares(rows: tuple[np.ndarray, np.ndarray]) -> None:
    """All together, and once others are eliminated: the same values, the same covariance."""
    J, r = rows
    form = Quadratic.of_rows(NAMES, J, r)
    values, covariance = form.estimate(np.arange(5))
    some, others = np.array([0, 2]), np.array([1, 3, 4])
    part, part_covariance = form.released(others).held(others).estimate(np.arange(2))
    expected = np.linalg.inv(J.T @ J)

    np.testing.assert_allclose(values, np.linalg.lstsq(J, r, rcond=None)[0], rtol=1e-8)
    np.testing.assert_allclose(covariance, expected, rtol=1e-8)
    np.testing.assert_allclose(part, values[some], rtol=1e-8)
    np.testing.assert_allclose(part_covariance, expected[np.ix_(some, some)], rtol=1e-8)
    assert form.at(values).square == pytest.approx(left(J, r))
    np.testing.assert_allclose(form.at(values).g / np.sqrt(form.whole), 0.0, atol=1e-9)


def test_priors_are_rows(rows: tuple[np.ndarray, np.ndarray]) -> None:
    """A prior adds what rows of the parameters themselves would; one that is infinitely wide adds nothing."""
    J, r = rows
    sizes, offsets = np.array([2e3, np.inf, 0.5, 1e-2, 1e-4]), np.array([1e2, 3.0, 0.1, 0.0, 1e-5])
    form = Quadratic.of_rows(NAMES, J, r) + Quadratic.of_prior(NAMES, sizes, offsets)
    kept = np.isfinite(sizes)
    wide = np.vstack([J, np.diag(1.0 / sizes)[kept]])
    expected = Quadratic.of_rows(NAMES, wide, np.append(r, (-offsets / sizes)[kept]))

    assert form.degrees == expected.degrees == 44
    assert form.square == pytest.approx(expected.square)
    np.testing.assert_allclose(form.H, expected.H, rtol=1e-12)
    np.testing.assert_allclose(form.g, expected.g, rtol=1e-12)


def test_what_is_not_seen_has_no_rank(rows: tuple[np.ndarray, np.ndarray]) -> None:
    """Of columns that are alike there is one direction, and none of those that were eliminated."""
    J, r = rows
    J[:, 3] = 7.0 * J[:, 1]
    form = Quadratic.of_rows(NAMES, J, r)

    assert form.gain(np.array([1, 3]))[1] == 1
    assert form.released(np.array([1])).gain(np.array([3])) == (0.0, 0)
    assert form.released(np.array([1])).chance(np.array([3])) == 1.0


def test_information_that_rounding_makes_less_than_none_is_factorised(rows: tuple[np.ndarray, np.ndarray]) -> None:
    """What remains of rows that were taken out again, where a direction is told by no other; not if it is far from that."""
    J, r = rows
    J[:, 4] = J[:, 3] * 2.0
    scale = np.linalg.norm(J, axis=0)
    nothing = np.outer([0.0, 0.0, 0.0, 1.0, -1.0], [0.0, 0.0, 0.0, 1.0, -1.0]) * np.outer(scale, scale)
    taken = float(np.sum(r**2)) - left(J[:, :4], r)

    assert np.sum(Factor.of(J.T @ J - 1e-11 * nothing).half(J.T @ r) ** 2) == pytest.approx(taken, rel=1e-6)
    with pytest.raises(np.linalg.LinAlgError):
        Factor.of(J.T @ J - 1e-3 * nothing)
