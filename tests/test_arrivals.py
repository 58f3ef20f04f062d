"""Readings of several targets in one stop share the arrival of the drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pincal import Options, Robot, Setup
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.identify.arrival_likelihood import StopSums, information_of_stations
from pincal.identify.arrivals import _shared_noise, arrival_noise, poses_of, shares_stops
from pincal.identify.calibrate import fit_tables, refit
from pincal.identify.drive_levers import drive_levers
from pincal.identify.equations import Linearised
from pincal.identify.fit import ModelFit
from pincal.identify.whitening import StopNoise
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.model.effects import ELASTIC, GEOMETRIC

URDF = kuka_urdf_path()
NOISE = 2e-5
TARGETS = ((0.2, 0.0, 0.1), (0.0, 0.2, 0.1), (-0.2, 0.0, 0.1), (0.0, -0.2, 0.3), (0.1, 0.1, 0.4))


def measured(poses: int, arrival: float | np.ndarray, *, seed: int = 0, missing: float = 0.0) -> Measurements:
    """Return readings of five targets in stops whose drives arrive to ``arrival`` [rad], without some of the rows."""
    rng = np.random.default_rng(seed)
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0").draw_errors(rng, sigma_length=3e-4, sigma_angle=3e-4)
    q = sim.plan_poses(machine.nominal, poses, rng)
    arrived = q + arrival * rng.standard_normal(q.shape)
    parts = []
    for target in TARGETS:
        columns = sim.Instrument(targets=target, sigma=NOISE).measure(machine, arrived, rng=rng)
        parts.append(np.column_stack([columns[axis] for axis in "xyz"]))
    position = np.stack(parts, axis=1).reshape(-1, 3)
    names = np.tile([f"r{k}" for k in range(len(TARGETS))], poses)
    rows = measurements_from_arrays(machine.names, np.repeat(q, len(TARGETS), axis=0), position=position, target=names)
    return rows.select(rng.random(len(rows)) >= missing)


def fitted(rows: Measurements, **options: object) -> ModelFit:
    return fit_tables(Robot.from_urdf(URDF), rows, Options(effects=GEOMETRIC, **options))  # type: ignore[arg-type]


def without_arrivals(fit: ModelFit) -> ModelFit:
    """Return the fit of the same rows as if each were of a stop of its own."""
    plain = fit.over([replace(fit.problem.stations[0], arrival=None)])
    return refit(plain, fit.options.effects)


@pytest.mark.long
def test_exact_drives_share_no_noise() -> None:
    """Where drives arrive exactly, rows of a stop are independent, and weights stay as they are."""
    for seed in range(6):
        fit = fitted(measured(40, 0.0, seed=seed, missing=0.08))
        assert shares_stops(fit.problem.stations[0])
        assert fit.problem.stations[0].arrival is None


def test_the_scatter_of_the_drives_is_found() -> None:
    """Its size, and that of the instrument apart from it, are those of the simulation."""
    fit = fitted(measured(120, 5e-5, missing=0.08))
    found = arrival_noise(without_arrivals(fit), [True])

    assert found is not None
    np.testing.assert_allclose(found.drives[:5], 5e-5, rtol=0.35)
    assert found.readings[0] == pytest.approx(NOISE, rel=0.1)
    # The noise of the fit is that of a reading with its arrival.
    arrival = fit.problem.stations[0].arrival
    assert fit.solution.sigma[0] == pytest.approx(NOISE * arrival.size[0], rel=0.1)


def test_whitening_is_that_of_the_dense_covariance() -> None:
    """V^(-1/2) with V = 1 + L L^T stop by stop, and its inverse, as from the whole matrix."""
    rng = np.random.default_rng(0)
    stop = np.array([0, 0, 0, 1, 2, 2])
    L = rng.standard_normal((2, 3, 6))
    shared = StopNoise.of(L, stop)
    flat = L.transpose(2, 1, 0).reshape(18, 2)
    V = np.eye(18) + (flat @ flat.T) * (np.repeat(stop, 3)[:, None] == np.repeat(stop, 3))
    columns = rng.standard_normal((4, 3, 6))
    white = shared.whitened(columns).transpose(0, 2, 1).reshape(4, 18)

    np.testing.assert_allclose(white @ white.T, _rows(columns) @ np.linalg.solve(V, _rows(columns).T), rtol=1e-9)
    assert shared.log_determinant == pytest.approx(np.linalg.slogdet(V)[1])
    np.testing.assert_allclose(shared.whitened(shared.coloured(columns[0])[None])[0], columns[0], rtol=1e-9)
    uneven = replace(shared, size=np.array([1.0, 2.0, 3.0]))
    there, back = uneven.whitened(columns[:2]), uneven.whitened(columns[2:], transposed=True)
    np.testing.assert_allclose(_rows(there) @ _rows(columns[2:]).T, _rows(columns[:2]) @ _rows(back).T, rtol=1e-9)


def _rows(columns: np.ndarray) -> np.ndarray:
    return columns.transpose(0, 2, 1).reshape(len(columns), -1)


def test_some_rows_of_a_stop_are_whitened_as_such() -> None:
    """A selection that divides a stop has the covariance of the rows that are left."""
    rng = np.random.default_rng(1)
    shared = StopNoise.of(rng.standard_normal((2, 3, 6)), np.array([0, 0, 0, 1, 1, 1]))
    part = shared.select(np.array([0, 1, 3, 4, 5]))
    again = StopNoise.of(part.levers, part.stop)
    columns = rng.standard_normal((2, 3, 5))

    np.testing.assert_allclose(part.whitened(columns), again.whitened(columns))


def test_weights_of_rows_are_changed_without_summing_all() -> None:
    """Rejecting a row of a stop changes the normal equations as summing them anew does."""
    fit = fitted(measured(40, 5e-5))
    solution = fit.solution
    at = (fit.problem, solution.values, solution.free)
    robust = solution.weights.copy()
    whole = Linearised(*at, robust, fit.priors.sizes)
    whole.posterior(solution.sigma)
    robust = robust.copy()
    robust[[3, 17]] = 0.0
    changed = whole.reweighted(robust).posterior(solution.sigma)
    anew = Linearised(*at, robust, fit.priors.sizes).posterior(solution.sigma)

    np.testing.assert_allclose(changed.form.H, anew.form.H, rtol=1e-9, atol=1e-6 * np.abs(anew.form.H).max())


@pytest.mark.long
def test_intervals_count_stops() -> None:
    """Five targets a stop cover the truth at fresh poses nearly as often as stated."""
    robot, inside = Robot.from_urdf(URDF), []
    for seed in range(8):
        rows = measured(60, 3e-5, seed=seed)
        fit = fitted(rows, sigma=NOISE)
        fresh = _exact(seed)
        found = fit.readings(fresh)
        error = found.residuals(fit.values).T
        sigma = _position_sigma(fit, fresh)
        inside.append(np.abs(error) < 1.96 * sigma)

    assert robot.n_joints == 6
    assert 0.88 < np.mean(inside) < 0.99


def _exact(seed: int) -> Measurements:
    """Return exact readings of the first target at other poses of the same machine."""
    rng = np.random.default_rng(seed)
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0").draw_errors(rng, sigma_length=3e-4, sigma_angle=3e-4)
    q = sim.plan_poses(machine.nominal, 100, np.random.default_rng(1000 + seed))
    columns = sim.Instrument(targets=TARGETS[0], sigma=0.0).measure(machine, q, rng=rng)
    position = np.column_stack([columns[axis] for axis in "xyz"])
    return measurements_from_arrays(machine.names, q, position=position, target=["r0"] * len(q))


def _position_sigma(fit: ModelFit, rows: Measurements) -> np.ndarray:
    """Return the standard deviation of predictions from the covariance of a fit, shape (N, 3)."""
    station = fit.readings(rows)
    C = fit.estimate.dense_covariance()
    ((_, _, J),) = station.linearise(fit.values, np.ones(len(fit.values), bool))
    return np.sqrt(np.einsum("pmn,pq,qmn->nm", J, C, J))


def test_no_columns_are_whitened_to_none() -> None:
    """A station all of whose parameters are known has residuals, and no derivatives."""
    shared = StopNoise.of(np.ones((2, 3, 6)), np.array([0, 0, 0, 1, 1, 1]))

    assert shared.whitened(np.zeros((0, 3, 6))).shape == (0, 3, 6)


def sums_of(rows: Measurements) -> tuple[ModelFit, StopSums]:
    """Return a plain fit, whose rows share nothing, and what its residuals say of its stops."""
    fit = fitted(rows)
    plain = without_arrivals(fit)
    alone = plain.alone[0]
    return plain, StopSums.of(alone, slice(0, 1), poses_of(alone.station))


def test_the_restricted_likelihood_is_that_of_the_dense_covariance() -> None:
    """Of readings whose covariance includes that of the parameters beforehand, up to a constant."""
    fit, sums = sums_of(measured(12, 3e-5, missing=0.1))
    station = fit.problem.stations[0]
    free = fit.solution.free
    noise = fit.solution.estimated[0]
    J = np.concatenate([part for _, _, part in station.linearise(fit.values, free)], axis=2)
    J = J.reshape(len(J), -1).T / noise
    L = drive_levers(station, fit.values).reshape(6, -1).T / noise
    pose = np.tile(poses_of(station), 3)
    # Base and targets have no prior; one of a decimetre is next to none, and the dense matrix not singular.
    sizes = np.minimum(fit.priors.sizes[free], 0.1)
    sums = replace(sums, beforehand=np.diag(sizes**-2.0))
    residuals = station.residuals(fit.values).ravel() / noise
    # The priors' means are those of which the fit is the optimum.
    moved = residuals + J @ (sizes**2 * (J.T @ residuals))

    def dense(rho: np.ndarray, kappa: float) -> float:
        shared = (L * rho) @ L.T * (pose[:, None] == pose)
        V = kappa * np.eye(len(moved)) + shared + (J * sizes**2) @ J.T
        return float(np.linalg.slogdet(V)[1] + moved @ np.linalg.solve(V, moved))

    choices = [(np.full(6, 1e-10), 0.5), (np.array([4.0, 1.0, 9.0, 2.0, 0.0, 5.0]) * 1e-10, 0.2), (np.zeros(6), 1.0)]
    mixed = [sums.misfit(rho, np.array([kappa]))[0] for rho, kappa in choices]
    whole = [dense(rho, kappa) for rho, kappa in choices]

    np.testing.assert_allclose(np.diff(mixed), np.diff(whole), rtol=1e-4)


def test_slopes_of_the_restricted_likelihood_are_its_derivatives() -> None:
    """By the log of each variance, against central differences."""
    _, sums = sums_of(measured(12, 3e-5, missing=0.1))
    logs = np.log(np.array([4.0, 1.0, 9.0, 2.0, 3.0, 5.0, 0.3e10]) * 1e-10)

    def at(logs: np.ndarray) -> float:
        return sums.misfit(np.exp(logs[:6]), np.exp(logs[6:]))[0]

    steps = 1e-3 * np.eye(7)
    slopes = [(at(logs + step) - at(logs - step)) / 2e-3 for step in steps]
    _, by_rho, by_kappa = sums.misfit(np.exp(logs[:6]), np.exp(logs[6:]))

    np.testing.assert_allclose(np.append(by_rho, by_kappa), slopes, rtol=1e-4, atol=1e-4)


@pytest.mark.long
def test_few_stops_show_how_drives_arrive_on_average() -> None:
    """Of 24 stops a fit takes most; their variance is the simulated one nevertheless, and so is that of readings."""
    found = []
    for seed in range(6):
        plain, _ = sums_of(measured(24, 2e-5, seed=seed))
        noise = arrival_noise(plain, [True])
        assert noise is not None
        found.append((np.sqrt(np.mean(noise.drives**2)), noise.readings[0]))

    np.testing.assert_allclose(np.mean(found, axis=0), [2e-5, NOISE], rtol=0.15)


def test_drives_that_differ_are_told() -> None:
    """One that arrives ten times as badly as the others has a variance of its own."""
    arrival = np.array([1e-5, 1e-5, 1e-4, 1e-5, 1e-5, 1e-5])
    plain, _ = sums_of(measured(60, arrival))
    found = arrival_noise(plain, [True])

    assert found is not None
    assert found.drives[2] == pytest.approx(1e-4, rel=0.25)
    assert max(found.drives[[0, 1]]) < 4e-5


@pytest.mark.long
def test_a_fit_that_weighs_stops_shows_the_same_arrivals() -> None:
    """A search estimates them again at its end, when rows are weighted by those of its first model already."""
    for seed in range(3):
        fit = fitted(measured(40, 2e-5, seed=seed))
        again = arrival_noise(fit, [True])
        plain = arrival_noise(without_arrivals(fit), [True])

        assert fit.problem.stations[0].arrival is not None and again is not None and plain is not None
        np.testing.assert_allclose(again.drives, plain.drives, rtol=0.03)
        assert again.readings[0] == pytest.approx(plain.readings[0], rel=0.02)


def test_a_fit_that_weighs_stops_by_far_too_much_shows_how_they_scatter() -> None:
    """As one whose first model lacked the elasticity, which looked like drives that stop to 150 urad."""
    fit = fitted(measured(60, 1e-5))
    station = fit.problem.stations[0]
    plain = without_arrivals(fit)
    wide = _shared_noise(plain.alone[0], np.full(6, 1.5e-4), plain.solution.estimated)
    found = arrival_noise(refit(fit.over([replace(station, arrival=wide)]), fit.options.effects), [True])

    assert found is not None
    np.testing.assert_allclose(found.drives, 1e-5, rtol=0.3)
    assert found.readings[0] == pytest.approx(NOISE, rel=0.1)


@pytest.mark.parametrize("arrival", [pytest.param(0.0, marks=pytest.mark.long), 2e-5])
def test_what_other_stations_know_of_the_robot_is_known(arrival: float) -> None:
    """Stops of one station beside single rows of another one: its drives scatter as simulated, and exact ones do not."""
    rows = measured(80, arrival)
    is_first = np.arange(len(rows)) < len(rows) // 2
    tables = {"single": rows.select(is_first & (rows.target == "r0")), "stops": rows.select(~is_first)}
    fit = fit_tables(Robot.from_urdf(URDF), tables, Options(effects=GEOMETRIC))
    plain = refit(fit.over([replace(of, arrival=None) for of in fit.problem.stations]), fit.options.effects)
    found = arrival_noise(plain, [False, True])

    if not arrival:
        assert found is None
        return
    assert found is not None
    assert np.sqrt(np.mean(found.drives[:5] ** 2)) == pytest.approx(arrival, rel=0.25)
    assert found.readings[1] == pytest.approx(NOISE, rel=0.1)


def wires(poses: int, *, seed: int = 0) -> Measurements:
    """Return distances of the same machine from three anchors in each pose."""
    rng = np.random.default_rng(seed)
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0").draw_errors(rng, sigma_length=3e-4, sigma_angle=3e-4)
    q = sim.plan_poses(machine.nominal, poses, rng)
    columns = sim.Instrument(targets=(0.1, 0.05, 0.2)).measure(machine, q)
    place = np.column_stack([columns[axis] for axis in "xyz"])
    anchors = place.mean(axis=0) + rng.uniform(-4.0, 4.0, (3, 3))
    lengths = np.linalg.norm(place[:, None] - anchors, axis=2) + NOISE * rng.standard_normal((poses, 3))
    names = np.tile(["a", "b", "c"], poses)
    return measurements_from_arrays(machine.names, np.repeat(q, 3, axis=0), distance=lengths.ravel(), anchor=names)


def test_no_station_takes_more_of_the_robot_than_it_tells() -> None:
    """Wires leave open where anchors and base stand together; rounding in that passed for a scatter of drives elsewhere."""
    tables = {"many": measured(30, 0.0), "wires": wires(60)}
    # With a point that is known, if only to another station, the base is sought in an instrument's frame.
    setup = Setup(points={"elsewhere": (0.0, 0.0, 0.0)})
    fit = fit_tables(Robot.from_urdf(URDF), tables, Options(effects=ELASTIC, setup=setup))
    for of in information_of_stations(fit):
        size = np.sqrt(np.maximum(np.diag(of), 1e-300))
        told = np.diag(of) > 0.0

        assert np.diag(of).min() >= 0.0
        assert np.linalg.eigvalsh((of / np.outer(size, size))[np.ix_(told, told)]).min() > -1e-5
    assert all(station.arrival is None for station in fit.problem.stations)
    assert fit.solution.sigma == pytest.approx([NOISE, NOISE], rel=0.2)
