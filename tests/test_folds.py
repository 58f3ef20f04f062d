"""All rows are fitted, and every row is predicted once by a fit that has not seen it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pincal import Calibration, Options, Robot, read_measurements, run_calibration
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.held_out import headline_of
from pincal.cli import main
from pincal.identify.calibrate import fit_tables
from pincal.identify.fit import ModelFit
from pincal.identify.folds import Folds, left_out_residuals
from pincal.identify.solve import Course, solve
from pincal.measure.measurements import Measurements, concatenate, measurements_from_arrays
from pincal.model.effects import ELASTIC, GEOMETRIC

URDF = kuka_urdf_path()
NOISE = 5e-5


def measured(poses: int, cycles: int = 1, *, seed: int = 0, targets: int = 1) -> Measurements:
    """Return cycles of a plan of poses by a machine that shares no code with the model."""
    rng = np.random.default_rng(seed)
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0", compliance=np.full((6, 3), 3e-7))
    machine = machine.draw_errors(rng, sigma_length=5e-4, sigma_angle=5e-4)
    q = np.tile(sim.plan_poses(machine.nominal, poses, rng), (cycles, 1))
    parts = []
    for k in range(targets):
        offset = (0.1, 0.05 * k, 0.2 - 0.1 * k)
        columns = sim.Instrument(targets=offset, sigma=NOISE).measure(machine, q, rng=rng)
        parts.append(np.column_stack([columns[axis] for axis in "xyz"]))
    position = np.stack(parts, axis=1).reshape(-1, 3)
    names = np.tile([f"r{k}" for k in range(targets)], len(q))
    return measurements_from_arrays(
        machine.names, np.repeat(q, targets, axis=0), position=position, target=names if targets > 1 else None
    )


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_urdf(URDF)


@pytest.fixture(scope="module")
def fit(robot: Robot) -> ModelFit:
    return fit_tables(robot, measured(60), Options(effects=ELASTIC, sigma=NOISE))


@pytest.mark.parametrize("way", ["regions", "stretches", "random"])
def test_rows_are_predicted_as_by_a_fit_of_the_others(fit: ModelFit, way: str) -> None:
    """The information of the whole less the fold's and a step give what fitting the other rows from the start gives."""
    fold = Folds.of(fit.problem, (way,)).of_way[way]  # type: ignore[arg-type]
    ((found,),) = left_out_residuals(fit, fit.solution, [fold])

    for k in (0, 3, 11):
        rest = fold != k
        again = solve(fit.problem.select(rest), fit.values, fit.solution.free, fit.priors, fit.noise, Course("none"))
        held = fit.problem.stations[0].select(np.flatnonzero(~rest))
        np.testing.assert_allclose(found[:, ~rest], held.residuals(again.values), atol=0.02 * NOISE)


def test_folds_are_the_same_one_by_one(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the equations of all folds do not fit into memory, each is summed from its own rows."""
    fit = fit_tables(robot, {"a": measured(60), "b": measured(40, seed=1)}, Options(effects=ELASTIC, sigma=NOISE))
    folds = list(Folds.of(fit.problem, ("regions", "stretches")).of_way.values())
    together = left_out_residuals(fit, fit.solution, folds)
    monkeypatch.setattr("pincal.identify.equations._MOST_AT_ONCE", 1)
    apart = left_out_residuals(fit, fit.solution, folds)

    for one, other in zip(together, apart, strict=True):
        for station, again in zip(one, other, strict=True):
            np.testing.assert_allclose(again, station, rtol=0.0, atol=1e-6 * NOISE)


@pytest.mark.parametrize("model", ["solution", "nominal"])
def test_folds_are_the_same_together_and_step_by_step(fit: ModelFit, model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Short steps to the fits without folds are worked out together, by the columns of all rows; each alone gives them."""
    solution = getattr(fit, model)
    folds = list(Folds.of(fit.problem, ("regions", "stretches")).of_way.values())
    together = left_out_residuals(fit, solution, folds)
    monkeypatch.setattr("pincal.identify.folds._short_steps", lambda *_: {})
    monkeypatch.setattr("pincal.identify.equations._MOST_COLUMNS", 0)
    alone = left_out_residuals(fit, solution, folds)

    for (one,), (other,) in zip(together, alone, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-8 * NOISE)


@pytest.mark.long
def test_folds_of_parallel_axes_are_fitted_to_their_end(tmp_path: Path) -> None:
    """Base and tool of a planar arm move along its axes together; the errors are those of fits of the other rows."""
    planar = Robot.from_urdf("double_pendulum_continuous")
    with pytest.raises(SystemExit, match="0"):
        main(["simulate", planar.source, "--poses=300", "--no-floor", "--noise=0.05mm", f"--out={tmp_path / 'table.csv'}"])
    table = read_measurements(tmp_path / "table.csv", planar.joint_names)
    fit = run_calibration(planar, table, Options(sigma=NOISE)).fit
    fold = Folds.of(fit.problem, ("random",)).of_way["random"]
    ((found,),) = left_out_residuals(fit.fit, fit.solution, [fold])

    # 26 parameters at most share what 300 rows tell.
    expected = NOISE * np.sqrt(3.0 * (1.0 + 26 / 900))
    assert np.sqrt(np.mean(np.sum(found**2, axis=0))) < 1.07 * expected


def test_every_row_is_in_one_fold(fit: ModelFit) -> None:
    """Folds are numbered from 0 without gaps, and there are as many as asked for."""
    folds = Folds.of(fit.problem, ("regions", "stretches", "sessions"))

    assert set(folds.of_way) == {"regions", "stretches"}
    for way, fold in folds.of_way.items():
        assert len(fold) == 60
        assert set(fold) == set(range(folds.count(way)))


def test_targets_of_a_pose_are_left_out_together(robot: Robot) -> None:
    """Another target at the same pose would tell where the arm is."""
    fit = fit_tables(robot, measured(30, targets=3), Options(effects=GEOMETRIC))
    for fold in Folds.of(fit.problem, ("regions", "stretches", "random")).of_way.values():
        assert np.array_equal(fold.reshape(30, 3), np.repeat(fold.reshape(30, 3)[:, :1], 3, axis=1))


def test_the_delivered_model_is_that_of_all_rows(robot: Robot) -> None:
    """Cross-validation costs no row: the values are those of a calibration of the whole table."""
    rows = measured(60)
    whole = fit_tables(robot, rows, Options(effects=ELASTIC))
    found = run_calibration(robot, rows, Options(effects=ELASTIC))

    np.testing.assert_array_equal(found.fit.values, whole.values)
    assert found.result.rows == {"train": 60, "test": 60}


@pytest.mark.parametrize(
    ("poses", "cycles"), [(30, 6), *(pytest.param(*case, marks=pytest.mark.long) for case in ((50, 10), (60, 2))), (5, 30)]
)
def test_programs_that_run_in_cycles_are_calibrated(robot: Robot, poses: int, cycles: int) -> None:
    """Poses are left out with all their visits, however many there are; five poses are too few, and that is said."""
    found = run_calibration(robot, measured(poses, cycles), Options(effects=GEOMETRIC, sigma=NOISE))

    assert found.result.rows == {"train": poses * cycles, "test": poses * cycles}
    assert (str(found.result.verdict_of()) == "not judged") == (poses == 5)


@pytest.mark.long
def test_a_pose_counts_once_however_often_it_was_visited(robot: Robot) -> None:
    """Thirty visits of five poses among sixty single ones do not make the headline theirs."""
    whole = measured(65, 30)
    single, often = whole.select(slice(0, 60)), whole.select(np.arange(len(whole)) % 65 >= 60)
    q = np.vstack([single.q, often.q])
    position = np.vstack([single.position, often.position])
    rows = measurements_from_arrays(single.joint_names, q, position=position)
    found = run_calibration(robot, rows, Options(effects=ELASTIC))
    (errors,) = found.validated.lead
    per_pose = {}
    assert errors.counted.all()
    for pose, size in zip(map(tuple, rows.q), errors.sizes["mm"], strict=True):
        per_pose.setdefault(pose, []).append(size)

    assert found.result.error["calibrated"]["test"]["mean_mm"] == pytest.approx(
        np.mean([np.mean(sizes) for sizes in per_pose.values()])
    )


@pytest.mark.long
def test_the_headline_is_the_error_at_other_poses(robot: Robot) -> None:
    """Over eight tables it is that of fresh readings at poses of the same plan, to a tenth or so."""
    ratios = []
    for seed in range(8):
        rows = measured(140, seed=seed)
        found = run_calibration(robot, rows.select(slice(0, 60)), Options(effects=ELASTIC, sigma=NOISE))
        fresh = found.fit.readings(rows.select(slice(60, None)))
        true = np.linalg.norm(fresh.residuals(found.fit.values), axis=0).mean()
        ratios.append(found.result.error["calibrated"]["test"]["mean_mm"] / (1e3 * true))

    assert 0.95 < np.mean(ratios) < 1.15


def test_rows_that_are_held_out_for_good_touch_no_fit(robot: Robot) -> None:
    """With a fraction poses are held out with all their visits, and errors are theirs."""
    found = run_calibration(robot, measured(60, 3), Options(effects=GEOMETRIC), test_fraction=0.25)
    train, test = found.stations[0].measured
    fitted, held = ({tuple(q) for q in rows.q} for rows in (train, test))

    assert not fitted & held
    assert 12 <= len(held) <= 18
    assert found.validated is None
    assert found.result.validation.way == "held out"


@pytest.mark.long
def test_outliers_are_not_in_the_headline(robot: Robot) -> None:
    """A wrong reading is named and left out of fit and statistics, not averaged into them."""
    rows = measured(60)
    off = np.zeros((60, 3))
    off[[7, 31]] = 3e-3
    wrong = rows.with_readings(position=rows.position + off)
    sound, found = (run_calibration(robot, of, Options(effects=ELASTIC)) for of in (rows, wrong))

    assert found.result.outliers == (9, 33)
    assert _headline(found) == pytest.approx(_headline(sound), rel=0.1)


def _headline(found: Calibration) -> float:
    return found.result.error["calibrated"]["test"]["mean_mm"]


def test_stations_share_their_folds(robot: Robot) -> None:
    """A region of joint space is left out at all stations at once."""
    first, second = measured(40), measured(40, seed=0)
    fit = fit_tables(robot, {"a": first, "b": second}, Options(effects=GEOMETRIC))
    fold = Folds.of(fit.problem, ("regions",)).of_way["regions"]

    np.testing.assert_array_equal(fold[:40], fold[40:])


def test_a_session_is_predicted_by_the_others(robot: Robot) -> None:
    """Two days in one table with times are two folds, beside regions and stretches."""
    rows = measured(60)
    time = np.concatenate([np.arange(30) * 10.0, 9e4 + np.arange(30) * 10.0])
    fit = fit_tables(robot, replace(rows, time=time), Options(effects=GEOMETRIC))
    sessions = Folds.of(fit.problem, ("sessions",)).of_way["sessions"]

    assert sessions.tolist() == [0] * 30 + [1] * 30


def test_a_session_of_most_poses_is_not_predicted_by_the_rest(robot: Robot) -> None:
    """Five poses of a test by ISO 9283, however often visited, do not predict sixty others measured later."""
    cycles, others = measured(5, 30), measured(60, seed=1)
    rows = concatenate([cycles, others])
    time = np.concatenate([np.arange(len(cycles)) * 10.0, 9e4 + np.arange(len(others)) * 10.0])
    fit = fit_tables(robot, replace(rows, time=time), Options(effects=GEOMETRIC))

    assert list(Folds.of(fit.problem, ("regions", "sessions")).of_way) == ["regions"]


@pytest.mark.long
def test_an_error_that_persists_along_the_rows_costs_no_fold_its_instrument(robot: Robot) -> None:
    """Of a random walk only the first row tells where the instrument stands; without it predictions are as good."""
    rows = measured(120)
    walk = np.cumsum(2e-5 * np.random.default_rng(4).standard_normal((120, 3)), axis=0)
    drifting = rows.with_readings(position=rows.position + walk - walk.mean(axis=0))
    found = run_calibration(robot, drifting, Options(effects=ELASTIC))
    errors = found.result.error["calibrated"]

    assert found.fit.problem.stations[0].serial is not None
    assert errors["stretches"]["mean_mm"] < 1.3 * errors["train"]["mean_mm"]
    assert errors["stretches"]["max_mm"] < 2.0 * errors["train"]["max_mm"]


def test_rounding_decides_no_headline() -> None:
    """Regions and stretches that leave out the same rows differ by rounding; then it is that of the regions."""
    for worse in (0.3, 0.3 * (1.0 + 1e-14)):
        assert headline_of({"regions": {"mean": 0.3}, "stretches": {"mean": worse}}) == "regions"
    assert headline_of({"regions": {"mean": 0.3}, "stretches": {"mean": 0.31}}) == "stretches"
    assert headline_of({"test": {"mean": 0.1}, "regions": {"mean": 0.3}}) == "test"
