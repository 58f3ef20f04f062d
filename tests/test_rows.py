"""Rows as they were measured: one observation for each pose, in an order, with outliers that gather."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from row_cases import draw_rows_case

from pincal import (
    ELASTIC,
    GEOMETRIC,
    Options,
    Robot,
    calibrate,
    measurements_from_arrays,
    read_measurements,
    run_calibration,
)
from pincal.builtin import kuka_urdf_path
from pincal.calibration.fitted_robot import FittedRobot
from pincal.discover.decisions import standard_errors
from pincal.discover.policy import POLICY
from pincal.discover.run import Subsamples, run_discovery
from pincal.discover.steps import History
from pincal.identify.calibrate import refit
from pincal.identify.dependence import (
    _largest_factor,
    _RestrictedLikelihood,
    dependence,
    is_dependent,
    serial_noise,
)
from pincal.identify.fit import ModelFit
from pincal.identify.split import ways_held_out
from pincal.identify.whitening import Serial
from pincal.measure.measurements import Measurements
from pincal.measure.poses import by_pose
from pincal.sensors.row_samples import spread_rows
from pincal.simulate import paper_positions
from pincal.validate.gathered import bump_in, gathering_of

NOISE = 5e-5  # [m]


@pytest.fixture(scope="module")
def kuka() -> Robot:
    return Robot.from_urdf(kuka_urdf_path())


def autoregression(rng: np.random.Generator, n: int, phi: float) -> np.ndarray:
    """Return a stationary autoregression of variance 1, shape (n, 3), by its definition."""
    noise = np.empty((n, 3))
    noise[0] = rng.standard_normal(3)
    for t in range(1, n):
        noise[t] = phi * noise[t - 1] + np.sqrt(1.0 - phi**2) * rng.standard_normal(3)
    return noise


def table(robot: Robot, n: int, noise: np.ndarray, seed: int = 0, **columns: np.ndarray) -> Measurements:
    """Return n poses of the paper's machine, seen with noise [m]."""
    q = robot.random_configurations(n, np.random.default_rng(seed))
    position = paper_positions(q, tool_offset=(0.05, 0.03, 0.12), with_elasticity=False) + noise
    return measurements_from_arrays(robot.joint_names, q, position=position, **columns)


# One observation for each pose


def test_few_rows_beside_many_are_in_a_sample() -> None:
    """Eight poses beside the rows of an IMU, which tell no lengths; stations of one size are sampled as one table."""
    rows = spread_rows([8, 13_000, 40], 2_000)

    assert set(range(8)) | set(range(13_008, 13_048)) <= set(rows.tolist()) and 1_900 < len(rows) < 2_050
    np.testing.assert_array_equal(spread_rows([5_000, 6_000, 5_000], 4_000), np.linspace(0, 15_999, 4_000).astype(int))


def test_copies_of_rows_change_nothing(kuka: Robot) -> None:
    """Each row three times: values, standard deviations and noise are those of the table without copies."""
    rows = table(kuka, 60, NOISE * np.random.default_rng(1).standard_normal((60, 3)))
    copied = rows.select(np.repeat(np.arange(60), 3))
    once, thrice = (calibrate(kuka, of, Options(effects=GEOMETRIC)) for of in (rows, copied))

    np.testing.assert_allclose(thrice.values, once.values, atol=1e-12)
    np.testing.assert_allclose(thrice.estimate.sigma, once.estimate.sigma, rtol=1e-9)
    np.testing.assert_allclose(thrice.solution.estimated, once.solution.estimated, rtol=1e-9)


def test_means_of_poses_weigh_as_the_declared_noise_says(kuka: Robot) -> None:
    """Four readings of each pose with declared noise: standard deviations are half of those of one reading."""
    rng = np.random.default_rng(2)
    rows = table(kuka, 60, np.zeros((60, 3)))
    four = rows.select(np.tile(np.arange(60), 4))
    four = four.with_readings(position=four.position + NOISE * rng.standard_normal((240, 3)))
    single = rows.with_readings(position=rows.position + NOISE * rng.standard_normal((60, 3)))
    options = Options(effects=GEOMETRIC, sigma=NOISE)
    one, mean = (calibrate(kuka, of, options) for of in (single, four))
    told = _told(one.fit)

    np.testing.assert_allclose(mean.estimate.sigma[told], 0.5 * one.estimate.sigma[told], rtol=0.05)


def test_drives_that_arrive_anew_are_the_pose_s_not_the_reading_s(kuka: Robot) -> None:
    """Three readings that agree to 2 um where drives arrive to 20 urad: neither shows whether the model is complete."""
    rng = np.random.default_rng(3)
    q = kuka.random_configurations(80, rng)
    arrived = q + 20e-6 * rng.standard_normal(q.shape)
    position = np.repeat(paper_positions(arrived, tool_offset=(0.05, 0.03, 0.12), with_elasticity=False), 3, axis=0)
    position += 2e-6 * rng.standard_normal(position.shape)
    rows = measurements_from_arrays(kuka.joint_names, np.repeat(q, 3, axis=0), position=position)
    found = run_calibration(kuka, rows, Options(effects=GEOMETRIC))

    assert found.result.rows["train"] == 240
    assert len(found.fit.problem) == 80
    assert found.result.lack_of_fit is None
    assert found.result.to_dict()["verdict"] == "not judged"


def test_opposite_quaternions_are_one_orientation(kuka: Robot) -> None:
    """The mean of q and -q is q."""
    turn = np.array([[0.0, 0.0, 0.6, 0.8], [0.0, 0.0, -0.6, -0.8]])
    q, position = np.zeros((2, 6)), np.array([[1.0, 0.0, 0.0], [1.002, 0.0, 0.0]])
    mean = by_pose(measurements_from_arrays(kuka.joint_names, q, position=position, quaternion=turn))

    np.testing.assert_allclose(mean.quaternion, turn[:1], atol=1e-12)
    np.testing.assert_allclose(mean.position, [[1.001, 0.0, 0.0]])


# The order of rows


@pytest.mark.long
def test_predictions_are_as_uncertain_as_an_instrument_that_wanders_makes_them(kuka: Robot) -> None:
    """Of a random walk the rows tell where the instrument was on average: u is about what predictions are off, not mm."""
    rng = np.random.default_rng(8)
    others = kuka.random_configurations(100, rng)
    truth = paper_positions(others, tool_offset=(0.05, 0.03, 0.12), with_elasticity=False)
    off, u = [], []
    for seed in range(4):
        walk = np.cumsum(6e-6 * rng.standard_normal((150, 3)), axis=0)
        rows = table(kuka, 150, walk + 0.2 * NOISE * rng.standard_normal((150, 3)), seed)
        found = run_calibration(kuka, rows, Options(effects=GEOMETRIC)).fit
        assert found.fit.problem.stations[0].serial is not None
        poses, sigma = found.predict(others, return_sigma=True)
        off.append(poses[:, :, 3] - truth)
        u.append(sigma)
    assert np.mean(np.abs(off) < 1.96 * np.array(u)) > 0.85
    assert np.sqrt(np.mean(np.square(u))) < 2.0 * np.sqrt(np.mean(np.square(off)))


def test_innovations_weigh_by_the_inverse_of_the_covariance() -> None:
    """Products of innovations are those with V^-1, rows in any order, with gaps, some that tell nothing of the next."""
    rng = np.random.default_rng(4)
    place = rng.permutation(np.sort(rng.choice(60, 30, replace=False)).astype(float))
    phi, share = np.array([0.9, 0.5]), np.array([0.7, 0.3])
    serial = Serial(phi, share, place, np.ones(30, bool))
    columns = rng.standard_normal((4, 2, 30))
    found = serial.innovations(columns)

    for i in range(2):
        V = (1.0 - share[i]) * np.eye(30) + share[i] * phi[i] ** np.abs(place[:, None] - place)
        expected = columns[:, i] @ np.linalg.solve(V, columns[:, i].T)
        ratio = (found[:, i] @ found[:, i].T) / expected
        np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-9)
    np.testing.assert_allclose(serial.coloured(found[0]), columns[0], atol=1e-12)


@pytest.mark.parametrize("pause", [0.0, 1e4])
@pytest.mark.parametrize("gap", [1, 4, 12])
def test_the_variance_of_a_mean_of_correlated_rows_is_raised(gap: int, pause: float) -> None:
    """By the sum of their covariance, however uneven their gaps; the component that is raised most counts."""
    place = gap * np.arange(300.0) + pause * (np.arange(300) // 20)
    phi, share = np.array([0.9, 0.5, 0.99]), np.array([0.7, 0.3, 0.0])
    covariance = 0.7 * 0.9 ** np.abs(place - place[:, None])
    np.fill_diagonal(covariance, 1.0)
    expected = covariance.sum() / 300

    assert Serial(phi, share, place, np.ones(300, bool)).inflation == pytest.approx(expected)


def test_the_transpose_of_what_whitens_serves_the_other_columns() -> None:
    """Whitened columns times others are columns times the others by the transpose: turned, weighted, in any order."""
    rng = np.random.default_rng(5)
    turns = np.linalg.qr(rng.standard_normal((600, 3, 3)))[0]
    serial = Serial(np.full(3, 0.9), np.full(3, 0.7), rng.permutation(600) * 1.5, rng.random(600) < 0.9, turns)
    weights = rng.uniform(0.5, 2.0, 600)
    columns, others = rng.standard_normal((2, 11, 3, 600))
    back = others.copy()
    serial.whiten(back, weights, transposed=True)

    expected = np.tensordot(serial.innovations(columns, weights), others, axes=((1, 2), (1, 2)))
    np.testing.assert_allclose(np.tensordot(columns, back, axes=((1, 2), (1, 2))), expected, atol=1e-11)
    # The same of columns that are stored row by row.
    for stored, transposed, found in ((columns, False, serial.innovations(columns, weights)), (others, True, back)):
        rows = np.ascontiguousarray(stored.transpose(2, 1, 0))
        serial.whiten_rows(rows, weights, transposed=transposed)
        np.testing.assert_allclose(rows.transpose(2, 1, 0), found, atol=1e-12)


def least(misfit: Callable[[float], float]) -> float:
    """Return the least value of a misfit by the logarithm of a variance."""
    coarse = np.linspace(-3.0, 3.0, 61)
    best = coarse[np.argmin([misfit(log) for log in coarse])]
    return min(misfit(log) for log in np.linspace(best - 0.1, best + 0.1, 201))


def test_the_likelihood_of_a_noise_along_the_rows_is_that_of_its_covariance() -> None:
    """Of the dense covariance, parameters integrated out with their priors, at the likeliest of many variances."""
    rng = np.random.default_rng(7)
    n, m, P = 40, 2, 5
    place = np.sort(rng.choice(80, n, replace=False)).astype(float)
    columns = rng.standard_normal((1 + P, m, n))
    precision, values = np.array([0.0, 0.0, 0.5, 4.0, 30.0]), rng.standard_normal(P)
    # A parameter that moves no reading adds a constant, and so do the sizes of the priors, which are left out.
    idle = np.insert(columns, 3, 0.0, axis=0), place, np.insert(precision, 2, 7.0), np.insert(values, 2, 1.0)
    likelihood = _RestrictedLikelihood.of(*idle)
    phi, share = 0.9, 0.7
    serial = Serial(np.full(m, phi), np.full(m, share), place, np.ones(n, bool))
    of_rows = np.stack([serial.coloured(np.eye(m * n)[k].reshape(m, n)).ravel() for k in range(m * n)], axis=1)
    r, J = columns[0].ravel(), columns[1:].reshape(P, -1)

    def misfit(log: float) -> float:
        V = np.exp(log) * of_rows @ of_rows.T
        H = J @ np.linalg.solve(V, J.T) + np.diag(precision)
        pull = J @ np.linalg.solve(V, r) - precision * values
        volume = np.linalg.slogdet(V)[1] + np.linalg.slogdet(H)[1] - np.sum(np.log(precision[2:]))
        return float(volume + r @ np.linalg.solve(V, r) - pull @ np.linalg.solve(H, pull))

    expected = least(misfit)
    found = likelihood.misfit(float(np.log(share / (1.0 - share))), float(-np.log(1.0 - phi)))
    assert found == pytest.approx(expected, abs=1e-4)
    of_rows = np.eye(m * n)
    independent = least(misfit)
    assert likelihood.white == pytest.approx(independent, abs=1e-4)


def test_more_parameters_than_readings_are_told_by_their_axes() -> None:
    """Their likelihood differs from that of each of them by a constant."""
    rng = np.random.default_rng(8)
    n, m, P = 15, 2, 70
    columns = rng.standard_normal((1 + P, m, n))
    precision, values = rng.uniform(0.5, 50.0, P), 0.1 * rng.standard_normal(P)
    place = np.arange(n, dtype=float)
    whole = _RestrictedLikelihood(columns, place, precision, values)
    few = _RestrictedLikelihood.of(columns, place, precision, values)
    assert len(few.columns) == 1 + m * n
    found = [(few.misfit(*at) - whole.misfit(*at)) for at in ((0.0, 1.0), (2.0, 3.0), (-2.0, 0.5))]
    np.testing.assert_allclose(found, few.white - whole.white, atol=1e-6)


def test_rows_in_any_order_of_a_table_are_one_fit(kuka: Robot) -> None:
    """With a time, rows of a correlated noise may stand in any order."""
    rng = np.random.default_rng(5)
    rows = table(kuka, 120, NOISE * autoregression(rng, 120, 0.9), time=np.arange(120) * 40.0)
    mixed = rows.select(rng.permutation(120))
    fits = [calibrate(kuka, of, Options(effects=GEOMETRIC)) for of in (rows, mixed)]

    assert all(fit.problem.stations[0].serial is not None for fit in fits)
    np.testing.assert_allclose(fits[1].values, fits[0].values, atol=1e-6)


def test_an_instrument_stands_where_the_rows_saw_it_on_average(kuka: Robot) -> None:
    """Nothing is left of an error that persists, on average, and all but where the instrument stands is the weighed fit."""
    rows = table(kuka, 150, NOISE * autoregression(np.random.default_rng(3), 150, 0.98), 3)
    fit = calibrate(kuka, rows, Options(effects=GEOMETRIC))
    weighed = refit(fit.fit, fit.options.effects, start={})
    moved = np.abs(weighed.values - fit.values) > 0.01 * fit.estimate.sigma

    assert fit.problem.stations[0].serial is not None
    assert np.linalg.norm(fit.problem.stations[0].residuals(fit.values).mean(axis=1)) < 1e-9
    assert np.linalg.norm(fit.problem.stations[0].residuals(weighed.values).mean(axis=1)) > 0.1 * NOISE
    assert {fit.problem.parameters[k].name for k in np.flatnonzero(moved)} <= {"base.x", "base.y", "base.z"}
    np.testing.assert_allclose(fit.estimate.sigma, weighed.estimate.sigma, rtol=1e-6)


@pytest.mark.long
def test_correlated_noise_is_estimated_and_left_white(kuka: Robot) -> None:
    """An autoregression of 0.9 is told to 0.05, median of 8 tables, and nothing is left once rows are weighed by it."""
    found = []
    for seed in range(8):
        noise = NOISE * autoregression(np.random.default_rng(seed), 200, 0.9)
        fit = calibrate(kuka, table(kuka, 200, noise, seed), Options(effects=GEOMETRIC))
        serial = fit.problem.stations[0].serial
        assert serial is not None and not is_dependent(fit.fit)
        found.append(serial.phi[0])

    assert abs(np.median(found) - 0.9) < 0.05


def test_a_target_that_wanders_on_the_tool_is_correlated_noise_of_the_target(kuka: Robot) -> None:
    """An autoregression of 0.95 in the tool's frame: found, said to be the target's, white by its weights."""
    rng = np.random.default_rng(11)
    rows = table(kuka, 200, np.zeros((200, 3)), 11)
    flange = _without_noise(kuka, 11).predict(rows.q)[:, :, :3]
    wandering = np.einsum("nij,nj->ni", flange, NOISE * autoregression(rng, 200, 0.95))
    rows = rows.with_readings(position=rows.position + wandering + 0.2 * NOISE * rng.standard_normal((200, 3)))
    found = run_calibration(kuka, rows, Options(effects=GEOMETRIC, sigma=NOISE), test_fraction=0.0)
    serial = found.fit.problem.stations[0].serial

    assert serial is not None and serial.turns is not None and np.all(serial.phi > 0.85)
    assert not is_dependent(found.fit.fit) and any("target's place on the tool" in note.text for note in found.result.doubts)
    columns = rng.standard_normal((1, 3, 200))
    np.testing.assert_allclose(serial.coloured(serial.innovations(columns)[0]), columns[0], atol=1e-12)
    weights = rng.uniform(0.5, 2.0, columns.shape[2])
    np.testing.assert_allclose(
        serial.innovations(columns, weights), serial.innovations(columns * weights) / weights, atol=1e-12
    )


@pytest.mark.long
@pytest.mark.parametrize("tables", [20, pytest.param(60, marks=pytest.mark.rates)])
def test_intervals_cover_under_correlated_noise(kuka: Robot, tables: int) -> None:
    """95 % intervals hold the truth at least as often as they say, over all tables: a long memory is believed."""
    covered = []
    for seed in range(tables):
        noise = NOISE * autoregression(np.random.default_rng(1000 + seed), 150, 0.9)
        fit = calibrate(kuka, table(kuka, 150, noise, seed), Options(effects=GEOMETRIC, sigma=NOISE))
        truth = _without_noise(kuka, seed)
        told = _told(fit.fit)
        covered.append(np.mean(np.abs(fit.values - truth.values)[told] < 1.96 * fit.estimate.sigma[told]))

    assert np.mean(covered) > 0.95 - 4.0 * np.std(covered) / np.sqrt(tables)


def _told(fit: ModelFit) -> np.ndarray:
    """Return which parameters the data tell, not their priors, shape (P,)."""
    return np.asarray(np.isfinite(fit.priors.sizes) & (fit.estimate.sigma < 0.03 * fit.priors.sizes))


def _without_noise(kuka: Robot, seed: int) -> FittedRobot:
    return calibrate(kuka, table(kuka, 150, np.zeros((150, 3)), seed), Options(effects=GEOMETRIC, sigma=NOISE, serial=False))


def test_independent_rows_are_taken_for_such() -> None:
    """Of 2000 tables of independent noise at most 3 reach what counts as dependence, which is expected of a fifth of one."""
    rng = np.random.default_rng(6)
    reached = [dependence(rng.standard_normal((3, 150)), np.arange(150.0)) > 4.0 for _ in range(2000)]

    assert sum(reached) <= 3


def test_a_fit_of_independent_rows_has_no_correlated_noise(kuka: Robot) -> None:
    """White noise: rows weigh as before, to the last digit."""
    rows = table(kuka, 80, NOISE * np.random.default_rng(7).standard_normal((80, 3)))
    fits = [calibrate(kuka, rows, Options(effects=ELASTIC, serial=serial)) for serial in (True, False)]

    assert serial_noise(fits[0].fit) == (None,)
    np.testing.assert_array_equal(fits[0].values, fits[1].values)


@pytest.mark.long
@pytest.mark.first
@pytest.mark.parametrize(
    # Some 5 % more than what was measured.
    ("every", "regions", "stretches"),
    [(3, 0.0625, 0.0625), pytest.param(1, 0.0515, 0.053, marks=pytest.mark.products)],
)
def test_a_real_arm_read_in_the_order_of_a_grid_is_predicted(
    shared_data: Path, monkeypatch: pytest.MonkeyPatch, every: int, regions: float, stretches: float
) -> None:
    """A UR5 whose errors persist along the rows: held out .0489 mm by regions and .0503 by stretches, .0595 of a third."""
    monkeypatch.setattr("pincal.identify.solve.polish", None)
    robot = Robot.from_urdf("ur5")
    table = read_measurements(shared_data / "ur5_tracker" / "grid.csv", robot.joint_names).select(slice(None, None, every))
    found = run_discovery(robot, table, Options(effects=GEOMETRIC, moment_frame="before"))
    errors = found.calibration.result.error["calibrated"]

    assert found.trail.final.problem.stations[0].serial is not None
    assert errors["regions"]["mean_mm"] < regions and errors["stretches"]["mean_mm"] < stretches


@pytest.mark.parametrize(("phi", "words"), [(0.7, "fitting all"), pytest.param(0.995, "repeating", marks=pytest.mark.long)])
def test_a_sample_of_rows_far_apart_is_searched_once(
    kuka: Robot, phi: float, words: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every twentieth row of an autoregression of 0.7 is independent: its names stand, and all rows are weighted.

    Halves begin once, with what the sample named last, before all rows are fitted.
    """
    begun = []

    def begin(trail: History, *rest: object, **more: object) -> Callable[[], Subsamples]:
        begun.append(trail)
        return lambda: Subsamples((), 0)

    monkeypatch.setattr("pincal.discover.run.begin_subsamples", begin)
    n = 1200
    rng = np.random.default_rng(5)
    noise = NOISE * (0.8 * autoregression(rng, n, phi) + 0.6 * rng.standard_normal((n, 3)))
    rows = table(kuka, n, noise, 5)
    caplog.set_level("INFO", "pincal.discover.loop")
    found = run_discovery(kuka, rows, Options(effects=GEOMETRIC), policy=replace(POLICY, enough_readings=3 * n // 20))
    serial = found.trail.final.problem.stations[0].serial

    assert any(words in record.message for record in caplog.records)
    assert serial is not None and abs(serial.phi[0] - phi) < 0.1 and not is_dependent(found.trail.final)
    (named,) = begun
    (station,) = named.final.problem.stations
    assert len(station) < n and (station.serial is not None) == (words == "repeating")


# What is held out


def test_rows_are_held_out_both_ways(kuka: Robot) -> None:
    """Regions and stretches share no row, readings of a pose stay together, and stretches are consecutive rows."""
    rows = table(kuka, 100, np.zeros((100, 3)))
    rows = replace(rows.select(np.repeat(np.arange(100), 2)), rows=np.arange(2, 202))
    held = ways_held_out(rows, 0.2)

    assert not np.any(held["regions"] & held["stretches"])
    for mask in held.values():
        assert 16 <= mask.sum() <= 24
        assert np.array_equal(mask[::2], mask[1::2])
    assert np.count_nonzero(np.diff(held["stretches"].astype(int))) <= 2 * 24 / 8 + 2


def test_the_worse_way_leads(kuka: Robot) -> None:
    """The part "test" is that of the two ways in which the model predicts worse."""
    noise = NOISE * np.random.default_rng(8).standard_normal((120, 3))
    errors = run_calibration(kuka, table(kuka, 120, noise), Options(effects=GEOMETRIC)).result.error["calibrated"]

    assert errors["test"]["mean_mm"] == max(errors[way]["mean_mm"] for way in ("regions", "stretches"))


def test_blocks_of_rows_widen_what_rows_that_hang_together_say(kuka: Robot) -> None:
    """Closed form of blocks of an autoregression; standard deviations of a fit by independent rows are as much wider."""
    rng, phi, n = np.random.default_rng(8), 0.6, 4000
    scores = np.ascontiguousarray(autoregression(rng, n, phi).T)
    factor = _largest_factor(scores, n * np.eye(3))
    forms = [1.0 + 2.0 * sum((1.0 - k / length) * phi**k for k in range(1, length)) for length in (5, 10, 20, 40)]

    assert min(abs(factor / form - 1.0) for form in forms) < 0.1
    assert _largest_factor(rng.standard_normal((3, n)), n * np.eye(3)) == 1.0

    options = Options(effects=GEOMETRIC, serial=False)
    along, even = (table(kuka, 300, NOISE * e) for e in (autoregression(rng, 300, 0.95), rng.standard_normal((300, 3))))
    wide, plain = calibrate(kuka, along, options).solution, calibrate(kuka, even, options).solution

    assert plain.of_blocks == 1.0 and plain.wide is None
    assert wide.of_blocks > 1.2 and wide.wide is not None
    ratio = np.sqrt(np.diag(wide.known.covariance) / np.diag(wide.posterior.covariance))
    np.testing.assert_allclose(ratio.max(), np.sqrt(wide.of_blocks), rtol=0.01)


def test_points_of_one_image_count_as_often_as_they_tell_anything_new() -> None:
    """Closed form of rows of which k at a time share a part s of their variance: 1 + (k - 1) s."""
    rng, k, s, images = np.random.default_rng(8), 25, 0.1, 300
    shared, own = rng.standard_normal((3, images)), rng.standard_normal((3, k * images))
    scores = np.sqrt(s) * np.repeat(shared, k, axis=1) + np.sqrt(1.0 - s) * own
    at_once = np.repeat(np.arange(images), k)

    assert _largest_factor(scores, np.eye(3), at_once) == pytest.approx(1.0 + (k - 1) * s, rel=0.15)
    assert _largest_factor(own, np.eye(3), at_once) == 1.0


def test_a_joint_that_moved_steadily_with_each_load_is_told(kuka: Robot) -> None:
    """Poses sorted by a joint, then again with a load, leave no row that tells a drift from the joint; shuffled ones do."""
    rows = table(kuka, 120, NOISE * np.random.default_rng(4).standard_normal((120, 3)), payload=np.repeat([0.0, 90.0], 60))
    order = np.concatenate([60 * half + np.argsort(rows.q[60 * half : 60 * half + 60, 0]) for half in (0, 1)])

    def notes(of: Measurements) -> str:
        return " ".join(map(str, run_calibration(kuka, of, Options(effects=GEOMETRIC, sigma=NOISE)).result.warnings))

    assert "joint_1 moved steadily" in notes(
        table(kuka, 120, NOISE * np.zeros((120, 3)), payload=rows.payload).select(order)
    )
    assert "moved steadily" not in notes(rows)


# Outliers, and blocks of poses


def test_one_block_does_not_veto() -> None:
    """What eight blocks of a UR10 gain by a joint's play; and blocks that don't agree gain nothing."""
    assert standard_errors(np.array([159.0, 76.0, 90.0, 117.0, 6.0, 88.0, 21.0, -310.0])) > 2.0
    assert standard_errors(np.array([159.0, -76.0, 90.0, -117.0, 6.0, -88.0, 21.0, -310.0])) < 0.0


def test_outliers_gather_or_do_not(kuka: Robot) -> None:
    """Those within 5 deg of one joint are found there; of 200 draws of outliers anywhere none is said to gather."""
    rng = np.random.default_rng(9)
    fit = calibrate(kuka, table(kuka, 300, NOISE * rng.standard_normal((300, 3))), Options(effects=GEOMETRIC))
    q = fit.fit.station.conditions.q[:, 2]
    near = np.abs(q - np.median(q)) < np.deg2rad(2.5)
    found = gathering_of(fit.fit.station, near)

    assert found is not None and found.variable == kuka.joint_names[2] and found.among == near.sum()
    for _ in range(200):
        anywhere = np.zeros(300, bool)
        anywhere[rng.choice(300, 15, replace=False)] = True
        assert gathering_of(fit.fit.station, anywhere) is None


@pytest.mark.long
@pytest.mark.parametrize("draws", [6, pytest.param(50, marks=pytest.mark.rates)])
def test_a_bump_of_a_drive_is_told_by_its_joint_and_place(kuka: Robot, draws: int) -> None:
    """.15 mrad on ten neighbouring rows of 300; of draws without, half of them with gross errors, none has one."""
    rng = np.random.default_rng(3)

    def fitted(positions: np.ndarray, q: np.ndarray) -> ModelFit:
        return calibrate(
            kuka, measurements_from_arrays(kuka.joint_names, q, position=positions), Options(effects=GEOMETRIC)
        ).fit

    for draw in range(draws):
        q = kuka.random_configurations(300, rng)
        noise = NOISE * rng.standard_normal((300, 3))
        noise[rng.choice(300, 15 * (draw % 2), replace=False)] += 2e-3
        positions = paper_positions(q, tool_offset=(0.05, 0.03, 0.12), with_elasticity=False) + noise
        fit = fitted(positions, q)
        assert bump_in(fit.station, fit.values) is None
    at = float(np.median(q[:, 2]))
    near = np.argsort(np.abs(q[:, 2] - at))[:10]
    moved = q.copy()
    moved[near, 2] += 1.5e-4
    positions = paper_positions(moved, tool_offset=(0.05, 0.03, 0.12), with_elasticity=False) + noise
    fit = fitted(positions, q)
    found = bump_in(fit.station, fit.values)

    assert found is not None and found.variable == kuka.joint_names[2] and found.size == pytest.approx(1.5e-4, rel=0.4)
    assert set(found.rows) <= set(near) and len(found.rows) >= 5


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pincal.errors.PincalWarning")
@pytest.mark.parametrize(
    ("kind", "seed", "words"),
    [("tool_exchanged", 45002, "tool"), pytest.param("remastered", 45001, "axis_2", marks=pytest.mark.rates)],
)
def test_names_beside_a_change_midway_are_taken_back(kind: str, seed: int, words: str) -> None:
    """What is other midway is told with its line, and nothing that it looks like is said of the robot."""
    case = draw_rows_case(kind, seed)
    found = run_discovery(case.robot, case.rows, case.options)
    result = found.calibration.result

    assert words in result.shift and abs(int(result.shift.split()[2]) - case.line) <= 3
    assert {entry.effect for entry in found.findings.effects} <= {"joint_elasticity", "bearing_elasticity"}
    assert any("withdrawn" in str(note) for note in result.warnings) == (kind == "remastered")
