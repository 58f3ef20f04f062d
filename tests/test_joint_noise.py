"""Noise that comes by way of the joints: found where it is, and rows weighed by it as generalised least squares has them."""

from dataclasses import replace

import numpy as np
import pytest
from machines import kuka as true_kuka
from scipy.stats import multivariate_normal

from pincal import simulate as sim
from pincal.discover.ending import JointNoise, joint_noise, weighed
from pincal.discover.run import run_discovery
from pincal.identify.calibrate import fit_tables, refit
from pincal.identify.equations import Linearised
from pincal.identify.fit import ModelFit
from pincal.identify.fit_levers import levers
from pincal.identify.options import Options
from pincal.identify.split import monte_carlo
from pincal.identify.station import PIECE
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot

# Of a joint [rad], and of an instrument [m, rad].
SCATTER, NOISE = 5e-5, (2e-5, 4e-5)


def measured(robot: Robot, scatter: float, *, seed: int, poses: int = 150) -> Measurements:
    """Return poses of a machine of which every joint scatters [rad]."""
    rng = np.random.default_rng(seed)
    machine = true_kuka().draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = sim.plan_poses(machine.nominal, poses, rng)
    instrument = sim.Instrument(reads="pose", targets=(0.1, 0.05, 0.2), sigma=NOISE[0], sigma_angle=NOISE[1])
    table = instrument.measure(machine, q + scatter * rng.standard_normal(q.shape), rng=rng)
    return measurements_from_arrays(
        robot.joint_names,
        q,
        position=np.column_stack([table[axis] for axis in "xyz"]),
        quaternion=np.column_stack([table[axis] for axis in ("qx", "qy", "qz", "qw")]),
    )


@pytest.fixture(scope="module")
def fit(kuka: Robot) -> ModelFit:
    """Return a fit whose joints scatter, weighed as if readings were even."""
    return fit_tables(kuka, measured(kuka, SCATTER, seed=0), Options(effects=GEOMETRIC))


def covariances(fit: ModelFit, noise: JointNoise) -> np.ndarray:
    """Return the covariance of each row, shape (N, m, m), by its definition."""
    J = levers(fit, tuple(map(int, fit.problem.chain.drives))).transpose(2, 1, 0)
    instrument = np.diag(np.repeat(noise.instrument**2, 3))
    return np.array([instrument + each @ np.diag(noise.joints**2) @ each.T for each in J])


@pytest.mark.long
def test_noise_of_the_joints_is_found_with_its_size(kuka: Robot) -> None:
    """Over six machines; that of the instrument has what a fit is off that took its rows for even, a tenth here."""
    fits = (fit_tables(kuka, measured(kuka, SCATTER, seed=seed, poses=300), Options(effects=GEOMETRIC)) for seed in range(6))
    found = [noise for noise in map(joint_noise, fits) if noise is not None]

    assert len(found) == 6
    assert np.sqrt(np.mean([noise.joints**2 for noise in found])) == pytest.approx(SCATTER, rel=0.1)
    assert np.sqrt(np.mean([noise.instrument**2 for noise in found], axis=0)) == pytest.approx(NOISE, rel=0.15)


def test_variances_are_where_residuals_are_likeliest(fit: ModelFit) -> None:
    """Against the normal density of all rows: any other size of one of them makes these less likely."""
    noise, r = joint_noise(fit), fit.station.residuals(fit.values).T
    assert noise is not None

    def likelihood(joint: int, factor: float) -> float:
        other = noise.joints * np.where(np.arange(6) == joint, factor, 1.0)
        pairs = zip(r, covariances(fit, replace(noise, joints=other)), strict=True)
        return sum(multivariate_normal.logpdf(each, cov=V) for each, V in pairs)

    for joint in np.flatnonzero(noise.joints > 1e-5):
        assert likelihood(joint, 1.0) > max(likelihood(joint, 0.95), likelihood(joint, 1.05))


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (2, 3))])
def test_even_noise_is_left_as_it_is(seed: int, kuka: Robot) -> None:
    """So is noise that was declared, and what too few readings leave."""
    sound = measured(kuka, 0.0, seed=seed)
    scattered = measured(kuka, SCATTER, seed=seed)
    few = scattered.select(np.arange(16))

    assert joint_noise(fit_tables(kuka, sound, Options(effects=GEOMETRIC))) is None
    assert joint_noise(fit_tables(kuka, scattered, Options(effects=GEOMETRIC, sigma=1e-4))) is None
    assert joint_noise(fit_tables(kuka, few, Options(effects=GEOMETRIC))) is None


def test_equations_are_those_of_generalised_least_squares(fit: ModelFit) -> None:
    """J V^-1 J^T and J V^-1 r, from the dense Jacobian; the size of a block of readings is that of one of them."""
    noise = joint_noise(fit)
    assert noise is not None
    whole, V = weighed(fit, noise), covariances(fit, noise)
    (_, r, J), *others = fit.station.linearise(fit.values, fit.solution.free)
    sigma = np.sqrt(np.array([V[:, b, b].mean() for b in range(6)]).reshape(2, 3).mean(axis=1))
    rows = np.ones(len(fit.problem))
    found = Linearised(whole.problem, fit.values, fit.solution.free, rows, fit.priors.sizes).posterior(sigma).form
    across = np.linalg.solve(V, J.transpose(2, 1, 0))

    assert not others
    np.testing.assert_allclose(found.H, np.einsum("fmn,nmg->fg", J, across), rtol=1e-9, atol=1e-9 * np.max(found.H))
    np.testing.assert_allclose(found.g, np.einsum("nmf,mn->f", across, r), rtol=1e-9, atol=1e-9 * np.max(np.abs(found.g)))


def test_whitening_goes_with_its_rows(fit: ModelFit) -> None:
    """With some of them, with pieces of a long table, and back to the noise as it is read."""
    noise = joint_noise(fit)
    assert noise is not None
    station, rows = weighed(fit, noise).station, np.arange(len(fit.problem))[::-3]
    many = station.select(np.resize(np.arange(len(station)), PIECE + 50))
    r, free = station.whitened(station.residuals(fit.values)), fit.solution.free
    pieces = np.concatenate([found for _, found, _ in many.linearise_shared(fit.values, free)], axis=1)

    np.testing.assert_allclose(station.coloured(r), station.residuals(fit.values), rtol=0.0, atol=1e-15)
    np.testing.assert_array_equal(station.select(rows).whitened(station.residuals(fit.values)[:, rows]), r[:, rows])
    np.testing.assert_allclose(pieces, np.resize(r.T, (PIECE + 50, 6)).T, rtol=1e-9, atol=1e-15)


def test_stations_have_the_joints_in_common(kuka: Robot) -> None:
    """Two tables of one robot: what each station says of it adds up as if it were alone."""
    table = measured(kuka, SCATTER, seed=1, poses=120)
    fit = fit_tables(kuka, [table.select(np.arange(60)), table.select(np.arange(60, 120))], Options(effects=GEOMETRIC))
    noise = joint_noise(fit)
    assert noise is not None and noise.instrument.shape == (4,)
    whole = weighed(fit, noise)
    again = refit(whole, whole.options.effects, start={})
    apart = [station.whitened(station.residuals(fit.values[at])) for station, at, _ in whole.stations]
    rows = np.ones(len(fit.problem))
    point = Linearised(whole.problem, fit.values, fit.solution.free, rows, fit.priors.sizes)

    assert noise.joints.mean() == pytest.approx(SCATTER, rel=0.25)
    assert point.squares == pytest.approx([np.sum(r[at] ** 2) for r in apart for at in (slice(3), slice(3, 6))], rel=1e-9)
    assert again.solution.converged


@pytest.mark.long
@pytest.mark.parametrize("scatter", [SCATTER, 0.0])
def test_a_discovery_weighs_its_last_fit_and_says_so(scatter: float, kuka: Robot) -> None:
    """By how much each joint is unsteady, in a note; none where noise is even."""
    found = run_discovery(kuka, measured(kuka, scatter, seed=2, poses=120))
    notes = [str(note) for note in found.calibration.notes if "consistent with joint noise" in str(note)]

    assert len(notes) == (scatter > 0.0) and all("joint_3 4" in note or "joint_3 5" in note for note in notes)
    assert (found.trail.final.station.whitening is not None) == (scatter > 0.0)


@pytest.mark.long
@pytest.mark.rates
def test_rows_weighed_by_the_joints_make_a_truer_model(kuka: Robot) -> None:
    """Over twenty machines, at other poses without noise; and the model knows how true it is."""
    ratios, told = [], []
    for seed in range(20):
        plain = fit_tables(kuka, measured(kuka, SCATTER, seed=seed), Options(effects=GEOMETRIC))
        noise = joint_noise(plain)
        assert noise is not None
        better = refit(weighed(plain, noise), plain.options.effects, start={})
        true = true_kuka().draw_errors(np.random.default_rng(seed), sigma_length=1e-3, sigma_angle=1e-3)
        q = sim.plan_poses(true.nominal, 200, np.random.default_rng(1000 + seed))
        exact = sim.Instrument(reads="pose", targets=(0.1, 0.05, 0.2)).measure(true, q)
        there = measurements_from_arrays(kuka.joint_names, q, position=np.column_stack([exact[axis] for axis in "xyz"]))
        tips = [f.model.predict(f.model_values, f.readings(there).conditions)[:, :, 3] for f in (plain, better)]
        off = [np.sqrt(np.mean((there.position - tip) ** 2)) for tip in tips]
        J = better.model.linearise(better.model_values, better.readings(there).conditions)[1]
        C = better.solution.known.joint_covariance.dense()
        ratios.append(off[1] / off[0])
        told.append(np.sqrt(np.mean(np.einsum("nmf,fg,nmg->nm", J, C, J))) / off[1])

    assert np.mean(ratios) < 0.9
    assert np.mean(told) == pytest.approx(1.0, rel=0.15)


@pytest.mark.long
def test_simulated_fits_scatter_as_their_covariance_says(kuka: Robot) -> None:
    """Noise that is drawn for a fit is that by which its rows are weighed."""
    fit = fit_tables(kuka, measured(kuka, SCATTER, seed=0, poses=60), Options(effects=GEOMETRIC))
    noise = joint_noise(fit)
    assert noise is not None
    better = refit(weighed(fit, noise), fit.options.effects, start={})
    drawn = monte_carlo(better, draws=100)
    conditions, of_model = better.station.conditions, slice(better.model.n_parameters)
    _, J = better.model.linearise(better.model_values, conditions)
    moved = np.einsum("nmf,df->dnm", J, (drawn - better.values)[:, of_model])
    C = better.solution.known.joint_covariance.dense()

    assert np.mean(moved**2) == pytest.approx(np.mean(np.einsum("nmf,fg,nmg->nm", J, C, J)), rel=0.1)
