"""Identification: what a fit must reach, and what must not change its answer."""

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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
from pincal.calibration.checked_fit import fitted
from pincal.errors import MeasurementError
from pincal.identify import many_rows
from pincal.identify.calibrate import expected_fit, fit_tables, refit
from pincal.identify.equations import Linearised
from pincal.identify.explain import explain
from pincal.identify.fit import posterior_of
from pincal.identify.noise import is_exact
from pincal.identify.normal import accumulate, accumulate_each, reweighted
from pincal.identify.split import hold_out
from pincal.identify.station import Station
from pincal.model.catalogue import TransmissionError
from pincal.model.effects import BearingElasticity, JointElasticity
from pincal.simulate import paper_positions
from pincal.simulate.paper_machine import PAYLOAD_COM
from pincal.validate.agreement import check_agreement

TOOL = (0.05, 0.03, 0.12)
OPTIONS = Options(payload_centre=PAYLOAD_COM)


def paper_table(kuka, n, seed, sigma=0.0):
    """Readings of the paper's true machine, an independent NumPy program."""
    rng = np.random.default_rng(seed)
    q = kuka.random_configurations(n, rng)
    p = paper_positions(q, tool_offset=TOOL)
    return measurements_from_arrays(
        kuka.joint_names, q, position=p + sigma * rng.normal(size=p.shape), payload=np.full(n, 125.0)
    )


def errors(fit, table):
    return np.linalg.norm(fit.readings(table).residuals(fit.values)[:3], axis=0)


@pytest.fixture(scope="module")
def noisy(kuka):
    table = paper_table(kuka, 120, 0, 5e-5)
    return table, calibrate(kuka, table, OPTIONS)


@pytest.mark.parametrize(
    ("known", "stages"),
    [
        (True, "joint"),
        pytest.param(False, "paper", marks=pytest.mark.long),
        *(pytest.param(*of, marks=[pytest.mark.long, pytest.mark.rates]) for of in [(True, "paper"), (False, "joint")]),
    ],
)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=[pytest.mark.long, pytest.mark.rates]) for seed in (1, 2))])
def test_noise_free_paper_machine_is_found_to_rounding(kuka, seed, known, stages):
    """Table I's machine with 36 + 9 released parameters is identified to 1e-10 m on other poses, within 20 iterations."""
    first = kuka.joint_names[:3]
    options = Options(
        effects=(*GEOMETRIC, JointElasticity(first), BearingElasticity(first)),
        payload_centre=PAYLOAD_COM,
        base=np.eye(4) if known else None,
        tools={"tool": TOOL} if known else None,
        stages=stages,
    )
    # Errors of so many millimetres are looked for in the table as well, which takes most of a calibration.
    fit = fitted(kuka, paper_table(kuka, 60, seed), options)

    assert fit.solution.converged
    assert errors(fit, paper_table(kuka, 500, 100 + seed)).max() < 1e-10
    assert fit.fit.iterations <= 20


@pytest.mark.long
@pytest.mark.parametrize("draws", [50, pytest.param(200, marks=pytest.mark.rates)])
def test_noisy_paper_machine_has_chi_square_one_and_intervals_that_cover(kuka, draws):
    """Over draws of noise, chi-square is 1 and 95 % intervals of predictions and strong directions cover 95 %."""
    first = kuka.joint_names[:3]
    effects = (*GEOMETRIC, JointElasticity(first), BearingElasticity(first))
    options = Options(effects=effects, payload_centre=PAYLOAD_COM, base=np.eye(4), tools={"tool": TOOL}, sigma=5e-5)
    exact = paper_table(kuka, 100, 0)
    truth = fitted(kuka, exact, replace(options, sigma=None))
    others = paper_table(kuka, 100, 1)
    rng = np.random.default_rng(7)
    chi2, inside_prediction, inside_direction = [], [], []
    for _ in range(draws):
        noisy = exact.with_readings(position=exact.position + 5e-5 * rng.normal(size=exact.position.shape))
        fit = calibrate(kuka, noisy, options)
        chi2.append(fit.solution.cost)
        problem = fit.readings(others)
        free = fit.solution.free
        _, J = fit.model.linearise(fit.values, problem.conditions, free=free)
        sigma = np.sqrt(np.einsum("nij,jk,nik->ni", J, fit.solution.known.covariance, J))
        inside_prediction.append(np.abs(problem.residuals(fit.values).T) < 1.96 * sigma)
        told = fit.solution.posterior
        sizes = fit.fit.priors.sizes[free]
        strong = told.information > 1e3
        difference = told.directions[:, strong].T @ ((fit.values - truth.values)[free] / sizes)
        inside_direction.append(np.abs(difference) < 1.96 / np.sqrt(1.0 + told.information[strong]))

    assert 0.95 < np.mean(chi2) < 1.05
    assert 0.93 < np.mean(inside_prediction) < 0.97
    assert 0.93 < np.mean(np.concatenate(inside_direction)) < 0.97


@pytest.mark.parametrize(("size", "information", "exact"), [(1e-3, 1e19, True), (1e-3, 1e16, False), (1e170, 1e-10, True)])
def test_how_exact_readings_are_is_told_of_any_size(size: float, information: float, exact: bool) -> None:
    """What readings and a prior say of a parameter are compared without an overflow, whose warning ends a test."""
    G, sizes = np.array([1.0, information, 1.0]), np.array([1.0, size, np.inf])

    assert is_exact(G, sizes) == exact


@pytest.mark.long
def test_wide_priors_make_no_reading_exact(noisy, kuka, monkeypatch):
    """Readings of 50 um are fitted with priors, however wide: as exact ones they would be fitted without any."""
    monkeypatch.setattr("pincal.identify.solve.polish", None)

    calibrate(kuka, noisy[0], replace(OPTIONS, priors={"*.theta": np.inf}))


def test_order_of_rows_means_nothing(kuka, noisy):
    """Predictions of a fit to shuffled rows are the same."""
    table, fit = noisy
    shuffled = calibrate(kuka, table.select(np.random.default_rng(1).permutation(len(table))), OPTIONS)
    np.testing.assert_allclose(shuffled.values, fit.values, atol=1e-10)


def test_order_of_effects_means_nothing(kuka, noisy):
    """The same parameters have the same values whatever the order in which effects are given."""
    table, fit = noisy
    turned = calibrate(kuka, table, replace(OPTIONS, effects=tuple(reversed(ELASTIC))))
    places = [turned.model.index(name) for name in fit.model.names]
    np.testing.assert_allclose(turned.values[places], fit.values, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_place_of_instrument_means_nothing(kuka, noisy, seed):
    """A tracker anywhere, upside down too, gives the same robot."""
    table, fit = noisy
    turn = Rotation.from_euler("x", np.pi) if seed == 0 else Rotation.random(random_state=seed)
    shift = np.array([5.0, -3.0, 2.0])
    moved = calibrate(kuka, table.with_readings(position=turn.apply(np.array(table.position)) + shift), OPTIONS)
    inner = [i for i, p in enumerate(fit.fit.station.parameters) if np.isfinite(p.size)]
    np.testing.assert_allclose(moved.values[inner], fit.values[inner], atol=1e-8)


@pytest.mark.long
def test_place_of_target_means_nothing(kuka):
    """A longer tool changes no prediction beyond noise; noise-free it changes none at all."""
    q = kuka.random_configurations(80, np.random.default_rng(3))
    far = measurements_from_arrays(
        kuka.joint_names, q, position=paper_positions(q, tool_offset=(0.4, -0.3, 0.6)), payload=np.full(80, 125.0)
    )
    fit = calibrate(kuka, far, OPTIONS)
    others = kuka.random_configurations(100, np.random.default_rng(4))
    there = measurements_from_arrays(
        kuka.joint_names, others, position=paper_positions(others, tool_offset=(0.4, -0.3, 0.6)), payload=np.full(100, 125.0)
    )
    assert errors(fit, there).max() < 1e-10


def test_stages_of_the_paper_end_where_the_joint_solve_ends(kuka, noisy):
    """Both ways minimise the same thing."""
    table, fit = noisy
    staged = calibrate(kuka, table, replace(OPTIONS, stages="paper"))
    conditions = fit.readings(table).conditions
    assert np.abs(staged.model.predict(staged.values, conditions) - fit.model.predict(fit.values, conditions)).max() < 1e-7
    assert [stage.name[0] for stage in staged.fit.stages[:4]] == ["1", "2", "3", "4"]


@pytest.mark.parametrize("size", [1e-3, 0.05, 1.0])
def test_outliers_at_five_per_cent_are_found_and_cost_nothing(kuka, noisy, size):
    """Every gross outlier is left out, no sound row is, and the held-out error stays what it was."""
    table, fit = noisy
    rng = np.random.default_rng(11)
    bad = rng.choice(len(table), 6, replace=False)
    position = table.position.copy()
    direction = rng.normal(size=(6, 3))
    position[bad] += size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    screened = calibrate(kuka, table.with_readings(position=position), OPTIONS)
    others = paper_table(kuka, 300, 9)

    assert set(np.flatnonzero(screened.solution.weights == 0.0)) == set(bad)
    assert errors(screened, others).mean() < 1.2 * errors(fit, others).mean()


def test_a_fit_begun_by_some_of_very_many_rows_is_that_of_all(kuka, monkeypatch):
    """Values, standard deviations, outliers and "before" are those of a fit to all rows from the start."""
    table, rng = paper_table(kuka, 2000, 1, 5e-5), np.random.default_rng(2)
    bad = rng.choice(len(table), 60, replace=False)
    position = table.position.copy()
    position[bad] += rng.normal(size=(60, 3)) * 0.02
    table = table.with_readings(position=position)
    whole = calibrate(kuka, table, OPTIONS)
    monkeypatch.setattr(many_rows, "MANY", 300)
    monkeypatch.setattr(many_rows, "EACH", 100)
    begun = calibrate(kuka, table, OPTIONS)

    free, sigma = whole.solution.free, np.where(whole.estimate.sigma > 0.0, whole.estimate.sigma, np.inf)
    np.testing.assert_array_equal(begun.solution.free, free)
    np.testing.assert_allclose((begun.values - whole.values) / sigma, 0.0, rtol=0.0, atol=0.1)
    np.testing.assert_allclose(begun.estimate.sigma, whole.estimate.sigma, rtol=0.02)
    np.testing.assert_array_equal(begun.solution.weights, whole.solution.weights)
    assert set(bad) <= set(np.flatnonzero(begun.solution.weights == 0.0))
    np.testing.assert_allclose(begun.fit.nominal.values, whole.fit.nominal.values, rtol=0.0, atol=1e-7)


def test_declared_noise_is_judged(kuka):
    """Noise declared five times too small shows in chi-square, and uncertainties are scaled up to what is seen."""
    table = paper_table(kuka, 120, 0, 5e-5)
    fit = calibrate(kuka, table, replace(OPTIONS, sigma=1e-5))
    assert 20 < fit.solution.cost < 30
    assert fit.solution.sigma[0] == pytest.approx(5e-5, rel=0.15)


def test_rows_of_other_weight_count_by_their_sigma(kuka):
    """Rows with ten times the noise, declared so, hardly spoil the fit."""
    table = paper_table(kuka, 240, 0, 5e-5)
    sigma = np.where(np.arange(240) < 120, 5e-5, 5e-4)
    rng = np.random.default_rng(5)
    position = table.position + np.where(sigma > 1e-4, 5e-4, 0.0)[:, None] * rng.normal(size=(240, 3))
    weighted = calibrate(kuka, replace(table.with_readings(position=position), sigma=sigma), OPTIONS)
    equal = calibrate(kuka, table.with_readings(position=position), OPTIONS)
    others = paper_table(kuka, 300, 9)
    assert errors(weighted, others).mean() < 0.5 * errors(equal, others).mean()


def test_a_column_of_sigma_declares_the_noise(kuka):
    """As validate and diagnose have it; an option stands above it, and repeated poses tell it by their scatter."""
    table = replace(paper_table(kuka, 60, 0, 5e-5), sigma=np.where(np.arange(60) < 30, 3e-5, 6e-5))
    twice = table.select(np.arange(60) // 2)
    declared = [
        calibrate(kuka, rows, replace(OPTIONS, sigma=sigma)).fit.noise.declared[0]
        for rows, sigma in ((table, None), (table, 1e-4), (twice, None))
    ]
    assert declared == [pytest.approx(np.sqrt((3e-5**2 + 6e-5**2) / 2.0)), 1e-4, None]


def test_reasons_name_the_counterpart(kuka, noisy):
    """The parallel axes 2 and 3, the base, the tool and the vertical axis are all named."""
    _, fit = noisy
    found = {finding.name: finding for finding in explain(fit.fit)}
    assert found["joint_2.d"].status == "unidentifiable"
    assert "joint_3.d + joint_2.d" in str(found["joint_2.d"].reason)
    assert "parallel" in str(found["joint_2.d"].reason)
    assert "base frame absorbs" in str(found["joint_1.d"].reason)
    assert "tool frame absorbs" in str(found["joint_6.theta"].reason)
    assert "gravity" in str(found["joint_1.k_z"].reason)
    assert found["joint_2.k_z"].status == "identified"


def test_no_uncertainty_is_zero_or_nan(kuka, noisy):
    """Whatever the data say of it, a parameter keeps an honest standard deviation."""
    from pincal.calibration.result_tables import parameter_rows

    for row in parameter_rows(noisy[1].fit):
        assert row.sigma is not None
        assert row.sigma > 0.0


def test_known_base_and_tool_stay_fixed(kuka):
    """What the user gives is not touched, and is reported as fixed."""
    options = replace(OPTIONS, base=np.eye(4), tools={"tool": TOOL})
    fit = calibrate(kuka, paper_table(kuka, 60, 0, 5e-5), options)
    found = {finding.name: finding.status for finding in explain(fit.fit)}
    assert found["base.x"] == found["tool.z"] == "fixed"
    assert fit.values[fit.model.index("tool.x")] == TOOL[0]


@pytest.mark.long
def test_length_bound_holds(kuka):
    """A length that would have to deviate more stays at its bound and says so."""
    rng = np.random.default_rng(0)
    q = kuka.random_configurations(100, rng)
    wrong = replace(kuka, frames=replace(kuka.frames, parameters=kuka.frames.parameters + _longer(kuka, 0.02)))
    table = measurements_from_arrays(kuka.joint_names, q, position=paper_positions(q, with_elasticity=False))
    fit = calibrate(wrong, table, Options(effects=GEOMETRIC))
    found = {finding.name: finding for finding in explain(fit.fit)}
    assert found["joint_2.a"].status == "at bound"
    assert abs(fit.values[fit.model.index("joint_2.a")]) == pytest.approx(0.01)


def _longer(robot, by):
    change = np.zeros_like(robot.frames.parameters)
    change[1, 4] = by
    return change


@pytest.mark.long
def test_two_columns_swapped_are_named(kuka):
    """A table whose header mixes up two joints is refused with their names."""
    table = paper_table(kuka, 60, 0, 5e-5)
    order = [0, 2, 1, 3, 4, 5]
    mixed = replace(table, q=table.q[:, order])
    with pytest.raises(MeasurementError, match=r"joint_2.*joint_3.*swapped"):
        check_agreement(kuka, [mixed], calibrate(kuka, mixed, Options(effects=GEOMETRIC)).fit)


def test_too_few_rows_for_the_noise_are_refused(kuka):
    """Readings that the parameters could fit exactly tell nothing of the noise; declaring it helps."""
    table = paper_table(kuka, 12, 0, 5e-5)
    with pytest.raises(MeasurementError, match="declare the noise"):
        calibrate(kuka, table, OPTIONS)
    assert calibrate(kuka, table, replace(OPTIONS, sigma=5e-5)).solution.converged


@pytest.mark.parametrize("split", ["random", "blocked"])
def test_held_out_rows_are_disjoint_and_as_many_as_asked(kuka, split):
    """A split loses no row and takes about the asked share."""
    table = paper_table(kuka, 200, 0)
    train, test = hold_out(table, 0.25, split=split, seed=3)
    assert sorted([*train.rows, *test.rows]) == sorted(table.rows)
    assert 40 <= len(test) <= 75


def test_rows_that_are_held_out_have_no_part_in_the_fit(kuka):
    """Moved by millimetres, they change the error that is reported of them, and no bit of what was fitted."""
    table = paper_table(kuka, 100, 1, 5e-5)
    _, test = hold_out(table, 0.25, split="random", seed=0)
    held = np.isin(table.rows, test.rows)
    off = np.random.default_rng(0).normal(size=(len(table), 3)) * 0.003 * held[:, None]
    moved = table.with_readings(position=table.position + off)
    first, second = (run_calibration(kuka, rows, OPTIONS, split="random", test_fraction=0.25) for rows in (table, moved))

    np.testing.assert_array_equal(first.fit.values, second.fit.values)
    told, told_of_moved = (run.result.error["calibrated"]["test"]["mean_mm"] for run in (first, second))
    assert told < 0.2 and told_of_moved > 3.0


def test_which_rows_are_held_out_is_settled_group_by_group() -> None:
    """Groups are dealt out in random order, each held out if that comes no farther from the part asked for, in one pass."""
    rng = np.random.default_rng(1)
    q = 1e-4 * rng.integers(0, 40_000, (60_000, 1))
    table = measurements_from_arrays(["joint_1"], q, distance=np.ones(len(q)))
    begun = time.process_time()
    _, held = hold_out(table, 0.25, seed=5)
    taken = time.process_time() - begun
    _, group = np.unique(q[:, 0], return_inverse=True)
    counts, expected, rows = np.bincount(group), [], 0
    for g in np.random.default_rng(5).permutation(len(counts)):
        if rows + 0.5 * counts[g] <= 15_000:
            expected.append(g)
            rows += counts[g]
    np.testing.assert_array_equal(held.q, table.q[np.isin(group, expected)])
    assert taken < 2.0  # a loop over the rows of each group takes most of a minute


@pytest.mark.parametrize(
    ("folder", "moment_frame", "limit_um"), [("elastic_after", "after", 11.0), ("elastic_paper", "paper", 13.0)]
)
def test_simulated_elastic_arms_are_predicted(shared_data, folder, moment_frame, limit_um):
    """Independent generators' arms are predicted on held-out poses as well as the noise allows (PEERS 3.2)."""
    robot = Robot.from_urdf(shared_data / folder / "robot.urdf")
    train = read_measurements(shared_data / folder / "train.csv", robot.joint_names)
    held = read_measurements(shared_data / folder / "heldout.csv", robot.joint_names)
    fit = calibrate(robot, train, Options(moment_frame=moment_frame))
    assert np.sqrt(np.mean(errors(fit, held) ** 2)) * 1e6 <= limit_um


@pytest.mark.long
@pytest.mark.parametrize(("folder", "frame"), [("elastic_after", "after"), ("elastic_paper", "paper")])
def test_the_convention_of_moments_that_fits_best_is_taken_and_named(shared_data, folder, frame):
    """Left open, it is found from a part of the rows, said where it is not the paper's, and expected of a check, too."""
    robot = Robot.from_urdf(shared_data / folder / "robot.urdf")
    train = read_measurements(shared_data / folder / "train.csv", robot.joint_names)
    found = run_calibration(robot, train, Options(moment_frame="auto"))
    named = [note.text for note in found.result.warnings if "--moment-frame" in note.text]

    assert found.fit.options.moment_frame == found.fit.model.chain.moment_frame == frame
    assert named == (
        [] if frame == "paper" else ["moments are computed as with --moment-frame after, which fits better than paper"]
    )
    there = calibrate(robot, found.train, Options(moment_frame=frame))
    np.testing.assert_allclose(found.fit.predict(train.q)[:, :, 3], there.predict(train.q)[:, :, 3], rtol=0.0, atol=1e-7)
    assert expected_fit(robot, train, Options(moment_frame="auto")).model.chain.moment_frame == frame


def test_the_papers_convention_is_taken_among_equals(kuka):
    """Where nothing bends, and where there are no moments in the model, none fits better than another."""
    q = kuka.random_configurations(60, np.random.default_rng(3))
    noise = 5e-5 * np.random.default_rng(4).standard_normal((60, 3))
    rigid = measurements_from_arrays(kuka.joint_names, q, position=paper_positions(q, with_elasticity=False) + noise)
    for effects in (ELASTIC, GEOMETRIC):
        fit = calibrate(kuka, rigid, Options(effects=effects, moment_frame="auto"))
        assert fit.options.moment_frame == fit.model.chain.moment_frame == "paper"


@pytest.mark.long
@pytest.mark.parametrize(
    ("robot_name", "file", "limit_mm"),
    [("ur5", "ur5_tracker/grid.csv", 0.096), ("ur10", "ur10_tmac/series_B.csv", 0.37)],
)
def test_real_arms_are_predicted(shared_data, robot_name, file, limit_mm):
    """Five-fold cross-validated mean error on real tracker data."""
    from pincal import cross_validate

    robot = Robot.from_urdf(robot_name)
    table = read_measurements(shared_data / file, robot.joint_names)
    found = cross_validate(robot, table, Options())
    assert np.linalg.norm(found.residuals[:3], axis=0).mean() * 1e3 <= limit_mm


# Drive curves.


@pytest.fixture(scope="module")
def curved(kuka):
    """The paper's machine with a drive curve, seen from two regions with few poses between, and curves of each kind."""
    rng = np.random.default_rng(11)
    q = kuka.random_configurations(400, rng)
    # A hole, and a pose just inside it.
    q[:, 1] = np.where(q[:, 1] > -1.2, np.maximum(q[:, 1], -0.5), q[:, 1])
    q[0, 1] = -1.19
    off = q.copy()
    off[:, 1] += 3e-4 * np.sin(9.0 * q[:, 1])
    p = paper_positions(off, tool_offset=TOOL)
    table = measurements_from_arrays(
        kuka.joint_names, q, position=p + 5e-5 * rng.normal(size=p.shape), payload=np.full(len(q), 125.0)
    )
    fine = TransmissionError.over(kuka.joint_names[1], q[:, 1], 60)
    others = [TransmissionError.over(kuka.joint_names[i], q[:, i], 8) for i in (3, 5)]
    return table, refit(calibrate(kuka, table, OPTIONS).fit, [*ELASTIC, fine, *others]), fine


def test_normal_equations_are_those_of_the_whole_jacobian(curved):
    """Bases kept sparse, dense and periodic give the G and g of the plain Jacobian with weights."""
    fit = curved[1]
    weights = np.linspace(0.2, 1.0, len(fit.station))
    free = fit.solution.free.copy()
    free[5] = False

    normal = accumulate(fit.station, fit.values, free, weights)

    ((_, residuals, J),) = fit.station.linearise(fit.values, free)
    A, r = (J * weights).reshape(len(J), -1), (residuals * weights).ravel()
    scale = np.sqrt(np.maximum(np.sum(A**2, axis=1), 1e-300))
    np.testing.assert_allclose(normal.H[0] / np.outer(scale, scale), A @ A.T / np.outer(scale, scale), atol=1e-12)
    np.testing.assert_allclose(normal.g[0] / scale, A @ r / scale, atol=1e-12 * np.linalg.norm(r))


def test_what_is_asked_at_the_end_of_a_fit_needs_no_further_linearisation(kuka, noisy, monkeypatch):
    """The problem remembers the latest normal equations; of other row weights only the change is summed."""
    fit = fit_tables(kuka, noisy[0], OPTIONS)
    again = replace(fit.problem)
    counted = []
    plain = Station.linearise_correlated
    monkeypatch.setattr(Station, "linearise_correlated", lambda *at: counted.append(1) or plain(*at))

    def covariance(problem, weights):
        return posterior_of(problem, replace(fit.solution, weights=weights), fit.priors).covariance

    known = covariance(fit.problem, fit.solution.weights)
    assert not counted
    np.testing.assert_array_equal(covariance(again, fit.solution.weights), known)
    assert counted
    fewer = np.where(np.arange(len(fit.problem)) < 20, 0.0, fit.solution.weights)
    whole = covariance(again, fewer)
    np.testing.assert_allclose(covariance(fit.problem, fewer), whole, atol=1e-9 * np.diag(whole).max())
    assert not np.array_equal(covariance(fit.problem, fewer), known)


@pytest.mark.parametrize("stations", [1, 3])
def test_equations_carried_over_a_short_step_are_those_at_its_end(kuka, noisy, stations):
    """They give the next step, the squares and the uncertainty of a linearisation there, without another one."""
    table = noisy[0]
    fit = fit_tables(kuka, [table.select(np.arange(k, len(table), stations)) for k in range(stations)], OPTIONS)
    free, sigma = fit.solution.free, fit.solution.sigma
    here = Linearised(replace(fit.problem), fit.values, free, fit.solution.weights, fit.priors.sizes)
    values = fit.values.copy()
    sizes = np.minimum(fit.priors.sizes[free], 1e-3)
    values[free] += 1e-5 * sizes * np.random.default_rng(3).standard_normal(len(sizes))

    carried = here.carried_to(values)

    there = Linearised(replace(fit.problem), values, free, fit.solution.weights, fit.priors.sizes)
    known, found = there.posterior(sigma), carried.posterior(sigma)
    np.testing.assert_allclose(carried.squares, there.squares, rtol=1e-12)
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(known.covariance), rtol=1e-4)
    step, wanted = (of.step_within(fit.priors.bounds[free])[0] for of in (found, known))
    assert known.square(step - wanted) < 1e-6 * known.square(wanted)


def test_a_point_with_products_from_elsewhere_has_its_own_again(kuka, noisy):
    """After that nothing is left of these, and until then nothing is carried on from them or kept for the point."""
    fit = fit_tables(kuka, [noisy[0]], OPTIONS)
    free, sigma = fit.solution.free, fit.solution.sigma
    rest = fit.solution.weights, fit.priors.sizes
    values = fit.values.copy()
    values[free] += 0.1 * np.minimum(fit.priors.sizes[free], 1e-3)
    elsewhere = Linearised(replace(fit.problem), values, free, *rest)
    elsewhere.posterior(sigma)
    own = Linearised(replace(fit.problem), fit.values, free, *rest).posterior(sigma)

    of_others = Linearised(replace(fit.problem), fit.values, free, *rest, near=elsewhere.known_normals())
    H = of_others.posterior(sigma).form.H
    again = of_others.exactly().posterior(sigma).form

    np.testing.assert_array_equal(H, elsewhere.posterior(sigma).form.H)
    np.testing.assert_array_equal(again.H, own.form.H)
    np.testing.assert_array_equal(again.g, own.form.g)
    assert not np.allclose(H, own.form.H, rtol=1e-6) and not of_others.may_be_carried


@pytest.mark.parametrize("changed", [7, 300])
def test_new_weights_of_some_rows_give_the_normal_equations_of_all(curved, changed):
    """Summed anew for rows whose weights changed, outliers of metres among them, or for all: the same equations."""
    fit = curved[1]
    station = fit.station.select(np.arange(len(fit.station)))
    position = station.sensor.position.copy()
    position[3] += 2.0
    station = replace(station, sensor=replace(station.sensor, position=position))
    before, free = np.linspace(0.2, 1.0, len(station)), fit.solution.free
    after = before.copy()
    after[3], after[-changed:] = 0.0, 0.7

    ends = np.array([0, len(station)])
    known = reweighted(station, ends, fit.values, free, before)
    found = reweighted(station, ends, fit.values, free, after, known)

    whole = accumulate_each(station, ends, fit.values, free, after)
    scale = np.sqrt(np.maximum(np.diag(whole.H[0, 0]), 1e-300))
    np.testing.assert_allclose(found.H[0, 0] / np.outer(scale, scale), whole.H[0, 0] / np.outer(scale, scale), atol=1e-12)
    np.testing.assert_allclose(found.g[0, 0] / scale, whole.g[0, 0] / scale, atol=1e-12)
    np.testing.assert_allclose(found.squares.blocks, whole.squares.blocks, rtol=1e-12)


def test_a_refit_from_near_the_end_ends_there(curved):
    """The last stage alone, from heights that are about right, finds what all stages find from zero."""
    fit, fine = curved[1:]
    others = [effect for effect in fit.options.effects if effect is not fine]
    places = fit.problem.places_at(fine)

    found = refit(refit(fit, others), fit.options.effects, start={fine: 1.02 * fit.values[places]})

    assert [stage.name for stage in found.stages] == ["final"]
    np.testing.assert_array_equal(found.solution.weights, fit.solution.weights)
    moved = np.linalg.norm(found.station.residuals(found.values) - fit.station.residuals(fit.values), axis=0)
    assert moved.max() < 0.02 * 5e-5


def test_a_spline_that_no_pose_is_near_is_like_the_others(curved):
    """Every spline of a curve is free and has one prior: a hole neither slows a fit down nor lets the curve swing."""
    table, fit, fine = curved
    names = [parameter.name for parameter in fine.parameters(fit.model.chain)]
    places = [fit.model.index(name) for name in names]

    assert len(set(fit.priors.sizes[places])) == 1
    assert fit.solution.free[places].all()
    assert fit.solution.converged and fit.stages[-1].iterations < 10
    assert np.abs(fit.values[places]).max() < 1e-3
    assert errors(fit, table).mean() < 1e-4


# What the reader is told of held-out rows.


def test_held_out_rows_that_are_far_off_are_told(kuka):
    """Two wrong readings among the held-out ones are named with their lines, and what the others leave."""
    table, held = paper_table(kuka, 80, 1, 5e-5), paper_table(kuka, 60, 2, 5e-5)
    wrong = held.position.copy()
    wrong[[7, 31]] += 0.004

    sound, found = (
        run_calibration(kuka, table, OPTIONS, holdout=rows).result for rows in (held, held.with_readings(position=wrong))
    )

    assert not any("held-out rows are off" in note.text for note in sound.warnings)
    (far,) = [note for note in found.warnings if "held-out rows are off" in note.text]
    assert far.is_doubt and far.rows == (held.rows[7], held.rows[31])
    assert far.text.startswith("2 of 60 held-out rows are off by up to 6.9")
    assert far.text.endswith(f"see lines {held.rows[7]}, {held.rows[31]}")
