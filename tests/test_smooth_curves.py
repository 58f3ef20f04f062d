"""Drive curves that are believed to be smooth: what that adds to a fit, and how smooth the data call for."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from machines import kuka as true_kuka
from scipy.interpolate import make_smoothing_spline
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from pincal import GEOMETRIC, Measurements, Options, Robot
from pincal import simulate as sim
from pincal.calibration.fitted_robot import FittedRobot, load_model
from pincal.discover import drive_curves
from pincal.discover.curve_numbers import CURVES
from pincal.discover.drive_curves import CurveSquares, resolved, smoothed
from pincal.discover.levers import situation_of
from pincal.discover.policy import POLICY
from pincal.discover.score_tests import GivenNuisances
from pincal.identify.calibrate import fit_tables, refit
from pincal.identify.fit import ModelFit
from pincal.identify.quadratic import Form
from pincal.measure.measurements import measurements_from_arrays
from pincal.model.basis import spline_basis, spline_roughness
from pincal.model.catalogue import TransmissionError

SIGMA = 5e-5
BUMPS = sim.TransmissionError(joint="joint_2", size=3e-4, seed=4, bumps=9, periodic=False)


def line(rng: np.random.Generator, n: int, sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return even positions, readings of a curve there, and splines whose knots are the positions."""
    x = np.linspace(0.0, 2.0, n)
    return x, np.sin(3.0 * x) + 0.3 * x + sigma * rng.standard_normal(n), spline_basis(x, 0.0, 2.0, n + 2)


def quadratic(B: np.ndarray, y: np.ndarray, sigma: float, *, size: float) -> CurveSquares:
    """Return the squares of readings about a curve of height zero."""
    K, nothing = len(B), np.zeros(len(B))
    return CurveSquares(
        rows=Form.of(B @ B.T / sigma**2, B @ y / sigma**2),
        believed=Form.of(np.zeros((K, K))),
        sizes=np.full(K, size),
        values=nothing,
        squares=float(y @ y) / sigma**2,
        readings=len(y),
    )


def test_a_curve_at_no_positions_has_no_values() -> None:
    """A table without rows is predicted as one with rows."""
    assert spline_basis(np.zeros(0), 0.0, 2.0, 5).shape == (5, 0)


def test_roughness_is_the_integral_of_squared_second_derivatives() -> None:
    """Of a cubic, which splines are exactly: integral of (2 a + 6 b x)^2; of a straight line nothing."""
    lower, upper, x = -0.5, 1.5, np.linspace(-0.5, 1.5, 200)
    B, R = spline_basis(x, lower, upper, 9), spline_roughness(lower, upper, 9)
    a, b = 0.7, -1.3
    cubic, straight = (np.linalg.lstsq(B.T, y, rcond=None)[0] for y in (a * x**2 + b * x**3, 3.0 - x))

    def antiderivative(x: float) -> float:
        return 4 * a**2 * x + 12 * a * b * x**2 + 12 * b**2 * x**3

    assert cubic @ R @ cubic == pytest.approx(antiderivative(upper) - antiderivative(lower), rel=1e-9)
    assert straight @ R @ straight == pytest.approx(0.0, abs=1e-9)
    wave = TransmissionError("joint_1", -np.pi, np.pi, 8, periodic=True, roughness=0.5)
    heights, q = np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.2]), np.linspace(0.0, 2.0 * np.pi, 2001)
    bend = -4.0 * 0.3 * np.sin(2.0 * q) - 16.0 * 0.2 * np.cos(4.0 * q)
    assert heights @ wave.smoothness() @ heights == pytest.approx(np.trapezoid(bend**2, q) / 0.25, rel=1e-6)


def test_the_most_probable_curve_is_the_smoothing_spline(rng: np.random.Generator) -> None:
    """With a knot at every reading; the smoothing spline is SciPy's, its penalty the noise over the roughness."""
    x, y, B = line(rng, 40, 0.05)
    R = spline_roughness(0.0, 2.0, len(B))
    (w,), heights, variance = quadratic(B, y, 0.05, size=1e4).likeliest([np.arange(len(B))], [R])
    fitted = heights @ B
    # The roughness still moves a little as the last step is taken.
    smooth = make_smoothing_spline(x, y, lam=0.05**2 * variance / w**2)

    np.testing.assert_allclose(fitted, smooth(x), atol=0.02 * np.sqrt(variance))
    assert np.sqrt(variance) == pytest.approx(1.0, rel=0.35)


@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_roughness_is_where_the_readings_are_likeliest(rng: np.random.Generator, gap: float) -> None:
    """Against the normal density of the readings, heights integrated out, at its largest over noise and roughness.

    No reading tells of the heights in the middle of a gap; a level of all readings is known to 10, half of it by its prior.
    """
    sigma, size = 0.05, 10.0
    x, y, B = line(rng, 60, sigma)
    kept = np.abs(x - 1.0) >= 0.5 * gap
    y, B, R = y[kept], B[:, kept], spline_roughness(0.0, 2.0, len(B))
    assert np.any(np.all(B == 0.0, axis=1)) == (gap > 0.0)

    def covariance(noise: float, w: float, level: float = size) -> tuple[np.ndarray, np.ndarray]:
        across = np.linalg.solve(R / w**2 + np.eye(len(B)) / size**2, B)
        return across, B.T @ across + level**2 + noise**2 * np.eye(len(y))

    def cost(logs: np.ndarray) -> float:
        return -float(multivariate_normal(cov=covariance(*np.exp(logs))[1]).logpdf(y))

    best = np.exp(minimize(cost, np.log([sigma, 3.0]), method="Nelder-Mead").x)
    every = quadratic(np.vstack([B, np.ones(len(y))]), y, sigma, size=size)
    level = np.arange(len(B) + 1) == len(B)
    every = replace(every, sizes=np.where(level, np.sqrt(2.0), 1.0) * size, believed=Form.of(np.diag(0.5 * level / size**2)))
    (w,), step, variance = every.likeliest([np.arange(len(B))], [R])
    # In the last step the prior of the level is 31 times as sure, what is believed beyond it is not.
    across, C = covariance(sigma * np.sqrt(variance), w, level=size / 4.0)
    np.testing.assert_allclose(step[:-1], across @ np.linalg.solve(C, y), atol=1e-6)

    assert w == pytest.approx(best[1], rel=0.1)


@pytest.fixture(scope="module")
def rows(kuka: Robot) -> Measurements:
    """Return a table of an arm whose second gear has many bumps; joint 2 hardly ever stands in the middle of its range."""
    rng = np.random.default_rng(5)
    machine = true_kuka(effects=(BUMPS,)).draw_errors(rng, sigma_length=5e-4, sigma_angle=5e-4)
    q = sim.plan_poses(machine.nominal, 400, rng)
    at = q[:, 1]
    lower, upper = np.quantile(at, [0.35, 0.65])
    q = q[(at < lower) | (at > upper) | (rng.random(len(q)) < 0.1)]
    table = sim.Instrument(targets={"ball": (0.1, 0.0, 0.1)}, sigma=SIGMA).measure(machine, q, rng=rng)
    return measurements_from_arrays(kuka.joint_names, q, position=np.column_stack([table[axis] for axis in "xyz"]))


@pytest.fixture(scope="module")
def fits(kuka: Robot, rows: Measurements) -> tuple[ModelFit, ModelFit]:
    """Return fits of the table with a coarse curve, and with the smooth one that it calls for."""
    curve = TransmissionError.over("joint_2", rows.q[:, 1], 18)
    coarse = fit_tables(kuka, rows, Options(effects=(*GEOMETRIC, curve)))
    chosen, near = smoothed(coarse, [curve])
    ((smooth, heights),) = chosen.values()
    return coarse, refit(near, [*GEOMETRIC, smooth], start={smooth: heights})


def test_a_curve_enters_as_it_would_end(fits: tuple[ModelFit, ModelFit]) -> None:
    """Of a fit without it, as of one with a coarse curve: as rough, in as many pieces, and of the same heights."""
    coarse, fine = fits
    curve = next(e for e in coarse.options.effects if isinstance(e, TransmissionError))
    smooth = next(e for e in fine.options.effects if isinstance(e, TransmissionError))
    entered, heights, _ = resolved(GivenNuisances(refit(coarse, GEOMETRIC)), curve, np.zeros(len(coarse.problem), int))

    assert isinstance(entered, TransmissionError) and entered.roughness and smooth.roughness
    assert entered.size == pytest.approx(smooth.size, abs=2)
    assert entered.roughness == pytest.approx(smooth.roughness, rel=0.2)
    q = np.linspace(curve.lower, curve.upper, 200)
    drawn = fine.values[fine.problem.places_at(smooth)] @ smooth.basis(q)
    np.testing.assert_allclose(heights @ entered.basis(q), drawn, rtol=0.0, atol=0.1 * np.ptp(drawn))


def test_a_fit_with_a_smooth_curve_is_penalised_least_squares(fits: tuple[ModelFit, ModelFit]) -> None:
    """The slope of data, priors and roughness vanishes, and their information is that of the posterior."""
    fit = fits[1]
    curve = next(e for e in fit.options.effects if isinstance(e, TransmissionError))
    free, at = fit.solution.free, fit.problem.places_at(curve)
    ((_, residuals, jacobian),) = fit.station.linearise(fit.values, free)
    J = (jacobian * np.sqrt(fit.solution.weights)).reshape(int(free.sum()), -1) / fit.solution.sigma[0]
    r = (residuals * np.sqrt(fit.solution.weights)).ravel() / fit.solution.sigma[0]
    L = np.diag(fit.priors.sizes**-2.0)
    L[np.ix_(at, at)] += spline_roughness(curve.lower, curve.upper, curve.size) / curve.roughness**2
    L = L[np.ix_(free, free)]
    H, slope = J @ J.T + L, J @ r - L @ fit.values[free]

    covariance = fit.solution.known.covariance
    assert slope @ np.linalg.solve(H, slope) < 1e-4 * r @ r
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(np.linalg.inv(H) / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=1e-4)
    spent = np.sum(covariance * (J @ J.T))
    assert fit.solution.posterior.effective == pytest.approx(spent, rel=1e-3)


def test_a_smooth_curve_is_closer_to_the_true_one(fits: tuple[ModelFit, ModelFit]) -> None:
    """Over the whole range, but for level and slope, which the geometry has; rows are few in the middle of it."""
    errors = []
    for fit in fits:
        curve = next(e for e in fit.options.effects if isinstance(e, TransmissionError))
        q = np.linspace(curve.lower, curve.upper, 200)
        B, heights = curve.basis(q), fit.values[fit.problem.places_at(curve)]
        plain = np.vander(q, 2)
        rest = heights @ B - BUMPS.curve(q)
        rest -= plain @ np.linalg.lstsq(plain, rest, rcond=None)[0]
        errors.append(np.sqrt(np.mean(rest**2)))

    assert errors[1] < 0.8 * errors[0]


def test_intervals_hold_a_curve_as_rough_as_it_is_believed() -> None:
    """The variance that is stated of it over the true one, in closed form, for pieces of the end and of the search.

    The curve has 400 pieces, far more than the rows tell.
    """
    w, sigma, x, at = 0.5, 1e-3, np.linspace(0.0, 2.0, 150), np.linspace(0.3, 1.7, 120)
    waves = 2.0 / np.pi * (75.0 / sigma**2 * w**2) ** 0.25

    def believed(pieces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        precision = spline_roughness(0.0, 2.0, pieces) / w**2 + 1e-4 * np.eye(pieces)
        return spline_basis(x, 0.0, 2.0, pieces), spline_basis(at, 0.0, 2.0, pieces), precision

    B, there, prior = believed(400)
    P = np.linalg.inv(prior)
    shares = []
    for finer in (1.0, POLICY.finer):
        coarse, drawn, precision = believed(int(np.ceil(finer * waves)))
        known = np.linalg.inv(coarse @ coarse.T / sigma**2 + precision)
        told = drawn.T @ known @ coarse / sigma**2
        missed = there.T - told @ B.T
        true = np.einsum("ij,jk,ik->i", missed, P, missed) + sigma**2 * np.sum(told**2, axis=1)
        shares.append(np.sum((drawn.T @ known) * drawn.T) / np.sum(true))

    assert shares[0] < 0.7 and 0.93 < shares[1] < 1.01


def test_a_smooth_curve_has_no_more_pieces_than_rows_carry_and_no_fewer_than_usual(fits: tuple[ModelFit, ModelFit]) -> None:
    """Asked for any number; a piece of a degree is fine, and two thirds of one the finest; smoothness carries fewer rows."""
    situation = situation_of(fits[0])
    curve = next(e for e in fits[0].options.effects if isinstance(e, TransmissionError))
    most, fine = len(fits[0].problem) // 3, int(1.5 * np.ceil(np.degrees(np.ptp(situation.positions("joint_2")))))

    assert [curve.smooth(situation, 0.1, size).size for size in (5, 30, 999)] == [24, 30, min(most, fine)]
    assert curve.smooth(situation, None).size == most // 2 < np.degrees(curve.upper - curve.lower)
    assert curve.smooth(situation, None).smoothness() is None


def test_a_curve_ends_finer_up_to_enough_pieces(fits: tuple[ModelFit, ModelFit], monkeypatch: pytest.MonkeyPatch) -> None:
    """However much finer it is asked for, unless the rows themselves tell of more."""
    curve = next(e for e in fits[0].options.effects if isinstance(e, TransmissionError))

    def ends(enough: int) -> int:
        monkeypatch.setattr(drive_curves, "CURVES", replace(CURVES, enough_pieces=enough))
        ((smooth, _),) = smoothed(fits[0], [curve], finer=100.0)[0].values()
        return smooth.resolution

    assert ends(40) == 40 and ends(1) == fits[1].options.effects[-1].resolution


def test_what_an_earlier_fit_knows_of_a_curve_has_its_smoothness(
    fits: tuple[ModelFit, ModelFit], kuka: Robot, rows: Measurements
) -> None:
    """So that it is not counted again; and a file keeps it."""
    fit = fits[1]
    options = replace(fit.options, earlier=FittedRobot.of(fit).robot_estimate)
    later = fit_tables(kuka, rows.select(slice(0, 60)), options)

    assert [term.sigma is None for term in fit.problem.beliefs.terms] == [True]
    assert all(term.sigma is not None for term in later.problem.beliefs.terms)


def test_a_file_keeps_how_rough_a_curve_is(fits: tuple[ModelFit, ModelFit], tmp_path: Path) -> None:
    """And one that says nothing of it is of a curve of which nothing was known."""
    fit = FittedRobot.of(fits[1])
    fit.save(tmp_path / "model.json")
    read = load_model(tmp_path / "model.json")
    text = (tmp_path / "model.json").read_text(encoding="utf-8")
    rough = next(e.roughness for e in fit.options.effects if isinstance(e, TransmissionError))

    assert [e.roughness for e in read.model.effects if isinstance(e, TransmissionError)] == [rough]
    old = re.sub(r',\s*"roughness": [-0-9.e]+|"check": "[^"]*",', "", text)
    (tmp_path / "old.json").write_text(old, encoding="utf-8")
    earlier = load_model(tmp_path / "old.json")
    assert [e.roughness for e in earlier.model.effects if isinstance(e, TransmissionError)] == [None]
