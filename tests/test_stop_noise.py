"""Readings of a stop share the arrival of the drives: stops, not readings, are the units of every judgement of new rows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from stop_cases import NOISE, MeasuredRobot, MeasuringPlan

import pincal
from pincal import FittedRobot, Options
from pincal.calibration.placing import place_station
from pincal.calibration.validation import validate_rows
from pincal.design.detection import lineup_over
from pincal.design.reach import SensorSetup
from pincal.diagnosis.change_search import NamedChange
from pincal.diagnosis.robot_diagnosis import changes_since
from pincal.errors import MeasurementError
from pincal.identify.stop_scatter import SharedNoise
from pincal.measure.stops import by_stop
from pincal.model.conditions import Conditions
from pincal.model.effects import GEOMETRIC

# Plans of a calibration and of a check that have to agree on an unchanged robot.
PLANS = {
    "single": (MeasuringPlan(100), MeasuringPlan(30)),
    "three readings": (MeasuringPlan(100), MeasuringPlan(30, dwell=3)),
    "five readings": (MeasuringPlan(100), MeasuringPlan(30, dwell=5)),
    "twenty readings": (MeasuringPlan(100), MeasuringPlan(30, dwell=20)),
    "calibrated from means of twenty": (MeasuringPlan(100, dwell=20), MeasuringPlan(30)),
    "calibrated from ten cycles": (MeasuringPlan(100, visits=10), MeasuringPlan(30)),
    "ten cycles": (MeasuringPlan(100), MeasuringPlan(30, visits=10)),
    "five cycles each": (MeasuringPlan(60, visits=5), MeasuringPlan(30, visits=5)),
    "five targets": (MeasuringPlan(100), MeasuringPlan(30, targets=5)),
    "five targets each": (MeasuringPlan(100, targets=5), MeasuringPlan(30, targets=5)),
}


def drawn(seed: int, arrival: float | None = None) -> tuple[MeasuredRobot, np.random.Generator]:
    """Return a robot and the source of its measurements."""
    rng = np.random.default_rng([seed, 77])
    return MeasuredRobot.drawn(rng, arrival), rng


@pytest.fixture(scope="module")
def single() -> tuple[MeasuredRobot, FittedRobot]:
    """Return a robot whose drives arrive within 40 urad, and its model from single readings."""
    robot, rng = drawn(0, 4e-5)
    return robot, robot.calibrated(MeasuringPlan(100), rng)


def test_the_scatter_within_and_between_stops_is_found() -> None:
    """Noise of a reading and arrival of a stop, each with its degrees of freedom, a gross reading left out."""
    robot, rng = drawn(1, 4e-5)
    table = robot.measured(MeasuringPlan(40, dwell=4, visits=3), rng)
    position = table.position.copy()
    position[100] += 5e-3
    fit = pincal.calibrate(robot.robot, table.with_readings(position=position), Options(effects=GEOMETRIC))
    found = fit.fit.scatter[""]
    # A drive's arrival moves the target along its lever.
    levers = place_station(fit, robot.measured(MeasuringPlan(200), rng)).model
    q = table.q[::4]
    steps = 4e-5 * np.eye(6)[:, None]
    seen = [levers.predict(q + step)[:, :, 3] - levers.predict(q)[:, :, 3] for step in steps]
    expected = float(np.mean(np.sum(np.square(seen), axis=0)))

    assert found.within[0] == pytest.approx(NOISE**2, rel=0.15)
    assert found.between[0] == pytest.approx(expected, rel=0.35)
    assert found.within_degrees[0] == 3 * (120 * 3 - 1)
    assert found.between_degrees[0] == pytest.approx(3 * 40 * 2, abs=6)
    assert (found.readings, found.stops) == (pytest.approx(4.0, rel=0.01), pytest.approx(3.0))
    assert found.of_single
    assert found.drives > 0.8


@pytest.mark.parametrize("arrival", [0.0, 8e-5])
def test_a_declared_noise_is_no_arrival(arrival: float) -> None:
    """Of one reading a visit, what a pose scatters by beyond the declared noise is the robot's: noise counts once."""
    robot, rng = drawn(4, arrival)
    table = robot.measured(MeasuringPlan(60, visits=4), rng)
    declared, found = (
        pincal.calibrate(robot.robot, table, Options(effects=GEOMETRIC, sigma=sigma)).at().station.repeatability
        for sigma in (NOISE, None)
    )
    whole = found.between_stops[0]
    of_drives = declared.between_stops[0]

    assert found.within_stop[0] == 0.0 and np.hypot(declared.within_stop[0], of_drives) == pytest.approx(whole, rel=1e-3)
    assert of_drives < 0.35 * NOISE if arrival == 0.0 else of_drives == pytest.approx(np.sqrt(whole**2 - NOISE**2), rel=1e-3)
    assert declared.within_stop[0] == pytest.approx(NOISE, rel=0.1)


def test_repeatability_is_kept_with_the_model(tmp_path: Path) -> None:
    """A model of revisited poses knows the scatter of single stops from its file, too; single rows show only its levers."""
    robot, rng = drawn(2, 4e-5)
    cycles = robot.calibrated(MeasuringPlan(50, visits=4), rng)
    cycles.save(tmp_path / "model.json")
    again = pincal.load_model(tmp_path / "model.json").repeatability
    once = robot.calibrated(MeasuringPlan(50), rng)

    assert again is not None and cycles.repeatability is not None
    assert again.between_stops == pytest.approx(cycles.repeatability.between_stops)
    assert again.stops == pytest.approx(4.0)
    assert once.repeatability is not None
    assert once.repeatability.drives > 0.7
    assert once.repeatability.between_degrees.max() == once.repeatability.within_degrees.max() == 0.0
    # The noise of the model is that of a single stop, by which new rows are judged.
    placed = place_station(cycles, robot.measured(MeasuringPlan(30), rng))
    assert placed.model.sigma[0] == pytest.approx(once.sigma[0], rel=0.35)
    assert placed.model.sigma[0] == pytest.approx(cycles.sigma[0], rel=0.35)


def test_a_health_check_is_designed_for_single_stops() -> None:
    """After a calibration from ten cycles its promises are those of single visits, not of means of ten."""
    robot, rng = drawn(2, 4e-5)
    cycles = robot.calibrated(MeasuringPlan(50, visits=10), rng)
    q = robot.robot.random_configurations(60, rng)
    lineup = lineup_over(cycles, SensorSetup(sensor="position", tool=(0.05, 0.0, 0.2)), Conditions.at(q))

    assert lineup.robot.sigma[0] > 0.9 * cycles.sigma[0]


def test_rows_that_share_an_arrival_count_as_one_stop() -> None:
    """Whitened rows have the precision of the dense covariance, and its size is found from residuals."""
    rng = np.random.default_rng(3)
    stops, targets = 60, 4
    stop = np.repeat(np.arange(stops), targets)
    levers = rng.standard_normal((6, 3, len(stop)))
    levers /= np.sqrt(np.mean(np.sum(levers**2, axis=0)))
    thing = np.arange(len(stop))
    noise = SharedNoise(stop // 2, stop, thing, levers, np.zeros(len(stop)), of_drives=0.8, of_rows=0.2)
    V = np.zeros((3 * len(stop),) * 2)
    for k in np.unique(stop // 2):
        rows = np.flatnonzero(stop // 2 == k)
        places = (rows[:, None] * 3 + np.arange(3)).ravel()
        V[np.ix_(places, places)] = noise.covariance(rows[None])[0]
    columns = rng.standard_normal((5, len(V)))
    white = noise.whitened(columns)
    drawn_residuals = (np.linalg.cholesky(V) @ rng.standard_normal(len(V))).reshape(-1, 3).T
    found = replace(noise, of_drives=0.0, of_rows=1.0).likeliest(drawn_residuals, spent=0)

    np.testing.assert_allclose(white @ white.T, columns @ np.linalg.solve(V, columns.T), rtol=1e-9)
    np.testing.assert_allclose(noise.covariances(columns), columns @ V @ columns.T, rtol=1e-9)
    blocks = np.linalg.inv(V).reshape(len(stop), 3, len(stop), 3)
    np.testing.assert_allclose(noise.own_precision(), blocks[thing, :, thing], rtol=1e-8)
    assert found.of_drives == pytest.approx(0.8, rel=0.2)
    assert found.of_rows == pytest.approx(0.2, rel=0.15)


def test_a_wrong_reading_among_shared_ones_is_weighed_as_its_removal() -> None:
    """The gain of a row that is wrong is what the squares lose without it, although others share its noise."""
    robot, rng = drawn(4, 4e-5)
    model = robot.calibrated(MeasuringPlan(60), rng)
    placed = place_station(model, robot.measured(MeasuringPlan(12, targets=3), rng))
    verdict = changes_since(model, placed, 0.01)
    lineup, values = verdict.lineup, verdict.values
    whole = lineup.weigh(values, ())

    assert placed.shared is not None and placed.shared.of_drives > 0.5
    for row in (0, 7, 20):
        rest = lineup.without(row).weigh(values, ())
        assert whole.rows[row, 0] == pytest.approx(whole.form.square - rest.form.square, rel=1e-6)


@pytest.mark.parametrize("seed", [10, pytest.param(11, marks=[pytest.mark.long, pytest.mark.rates])])
@pytest.mark.parametrize(
    "plan", ["single", *(pytest.param(plan, marks=pytest.mark.long) for plan in PLANS if plan != "single")]
)
def test_a_robot_that_has_not_changed_is_left_alone_by_any_plan(plan: str, seed: int) -> None:
    """A robot or two each: repeats, cycles and targets, of the calibration or of the check, are no change."""
    before, after = PLANS[plan]
    robot, rng = drawn(seed)
    model = robot.calibrated(before, rng)
    assert not pincal.diagnose(model, robot.measured(after, rng)).changed


@pytest.mark.long
@pytest.mark.rates
@pytest.mark.parametrize("plan", PLANS)
def test_false_alarms_are_as_rare_as_promised_by_any_plan(plan: str) -> None:
    """At most two of 40 unchanged robots, of which none is expected to raise an alarm."""
    before, after = PLANS[plan]
    alarms = 0
    for seed in range(40):
        robot, rng = drawn(seed)
        alarms += pincal.diagnose(robot.calibrated(before, rng), robot.measured(after, rng)).changed
    assert alarms <= 2


def test_a_check_of_ten_cycles_raises_no_alarm(single: tuple[MeasuredRobot, FittedRobot]) -> None:
    """What a model lacks at a pose is not averaged away by cycles: the means of poses are not ten times as sure."""
    robot, model = single
    rng = np.random.default_rng(5)
    table = robot.measured(MeasuringPlan(20, visits=10), rng)
    # A model error at each pose, the same in all cycles, as large as the noise of the calibration.
    lacking = np.tile(float(model.sigma[0]) * 0.7 * rng.standard_normal((20, 3)), (10, 1))
    found = pincal.diagnose(model, table.with_readings(position=table.position + lacking))

    assert not found.changed


@pytest.mark.parametrize("dwell", [1, 5])
def test_an_offset_is_found_in_rows_of_any_dwell(single: tuple[MeasuredRobot, FittedRobot], dwell: int) -> None:
    """0.3 mrad of a joint are named, with a size beyond its uncertainty, from single readings and from five a stop."""
    robot, model = single
    rng = np.random.default_rng(6)
    later = robot.changed(2, 3e-4)
    found = pincal.diagnose(model, later.measured(MeasuringPlan(20, dwell=dwell), rng))
    named = [(change.effect, change.joint) for change in found.changes]

    assert named == [("joint_offset", "axis_3")]
    (parameter,) = found.changes[0].parameters.values()
    assert parameter.after - parameter.before == pytest.approx(3e-4, abs=4.0 * parameter.sigma)
    assert abs(parameter.after - parameter.before) > 2.0 * parameter.sigma


def test_single_readings_are_independent(single: tuple[MeasuredRobot, FittedRobot]) -> None:
    """Rows of a pose of their own have the noise of the calibration, which follows the levers if the drives scatter."""
    robot, model = single
    placed = place_station(model, robot.measured(MeasuringPlan(15), np.random.default_rng(7)))
    exact, rng = drawn(0, 0.0)
    of_exact = place_station(exact.calibrated(MeasuringPlan(100), rng), exact.measured(MeasuringPlan(15), rng))

    assert placed.model.sigma == pytest.approx(model.sigma, rel=1e-12)
    assert placed.shared is not None and placed.shared.of_drives > 0.7
    assert all(rows.shape[1] == 1 for rows, _ in placed.shared.whitening)
    assert of_exact.shared is None


def test_what_is_announced_exceeds_its_uncertainty(single: tuple[MeasuredRobot, FittedRobot]) -> None:
    """A change that others made superfluous is not announced."""
    robot, model = single
    rng = np.random.default_rng(8)
    placed = place_station(model, robot.changed(2, 3e-4).measured(MeasuringPlan(25), rng))
    verdict = changes_since(model, placed, 0.01)
    lineup = verdict.lineup
    (true,) = verdict.steps
    other = next(k for k, c in enumerate(lineup.changes) if (c.name, c.joint) == ("joint_offset", "axis_5"))
    spurious = NamedChange(replace(true.score, change=other), 1e-20, ())
    both = replace(verdict, steps=(spurious, true), values=lineup.release([other, true.score.change], verdict.values))

    assert both.without_vanished().happened == [true.score.change]
    assert verdict.without_vanished() is verdict


@pytest.mark.long
def test_copies_and_repeats_do_not_sharpen_an_update(single: tuple[MeasuredRobot, FittedRobot]) -> None:
    """Twenty readings a stop add no more than their mean does, and copies add nothing."""
    robot, model = single
    table = robot.measured(MeasuringPlan(15, dwell=20), np.random.default_rng(9))
    several = pincal.update(model, table)
    means = pincal.update(model, replace(by_stop(table), readings_per_row=None))
    copied = pincal.update(model, table.select(np.tile(np.arange(0, len(table), 20), 3)))
    single_rows = pincal.update(model, table.select(np.arange(0, len(table), 20)))

    def size(updated: FittedRobot) -> np.ndarray:
        return np.sqrt(np.diag(updated.robot_estimate.dense_covariance()))

    np.testing.assert_allclose(size(several), size(means), rtol=1e-6)
    np.testing.assert_allclose(size(copied), size(single_rows), rtol=1e-6)


def test_rows_of_a_stop_are_recognised_as_fitted(single: tuple[MeasuredRobot, FittedRobot]) -> None:
    """A model that was fitted to means of stops and cycles knows their single readings again."""
    robot, _ = single
    rng = np.random.default_rng(12)
    for plan in (MeasuringPlan(40, dwell=3), MeasuringPlan(40, dwell=2, visits=2)):
        table = robot.measured(plan, rng)
        model = pincal.calibrate(robot.robot, table, Options(effects=GEOMETRIC)).at()

        assert validate_rows([model], table).fitted_rows == len(table)
        with pytest.raises(MeasurementError, match=f"fitted to {len(table)} of these {len(table)} rows"):
            pincal.diagnose(model, table)


def test_readings_of_a_stop_are_no_replicates(single: tuple[MeasuredRobot, FittedRobot]) -> None:
    """A complete model is not called incomplete because drives arrive with more scatter than the instrument has."""
    robot, model = single
    rng = np.random.default_rng(13)
    dwell = validate_rows([model], robot.measured(MeasuringPlan(30, dwell=5), rng))
    cycles = validate_rows([model], robot.measured(MeasuringPlan(30, visits=4), rng))

    assert dwell.replicate_statistics() == (None, None)
    assert dwell.misfit.p_value > 1e-3 and not dwell.doubt
    lack = cycles.replicate_statistics()[1]
    assert lack is not None and not lack.is_significant


@pytest.mark.long
def test_five_readings_of_an_unchanged_robot_are_no_change(
    shared_cases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command leaves an unchanged robot alone, from five readings a stop and from their means."""
    folder = shared_cases / "plans" / "09_dwell5_unchanged"
    tables = [str(folder / name) for name in ("cal.csv", "chk.csv", "chk_means.csv")]
    model = str(tmp_path / "out" / "model.json")
    assert run("calibrate", folder / "robot.urdf", tables[0], "--out", tmp_path / "out") == 0
    for table in tables[1:]:
        assert run("diagnose", model, table, "--out", tmp_path / "found") == 0
        told = capsys.readouterr().err
        assert ("150 readings at 30 stops" in told) == (table == tables[1])
