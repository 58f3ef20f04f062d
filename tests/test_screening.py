"""A wrong reading among others of its pose is named by its own line, and only it is left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import SHARED
from visited import ROBOT, Visited, drawn

from pincal import GEOMETRIC, Options, Robot, calibrate, read_measurements, run_calibration
from pincal.measure.measurements import Measurements

PLAN = SHARED / "cases" / "plans" / "13_gross_in_cycles"
OPTIONS = Options(effects=GEOMETRIC)


def wrong_rows(table: Measurements) -> np.ndarray:
    """Return which rows a calibration leaves out as wrong readings."""
    return next(iter(calibrate(ROBOT, table, OPTIONS).fit.wrong), np.zeros(len(table), bool))


@pytest.mark.parametrize("cycles", [2, pytest.param(3, marks=pytest.mark.long), 5])
def test_wrong_readings_are_named_by_their_lines(cycles: int) -> None:
    """Four per cent of the readings are off by 3 mm: these, and no visit beside them."""
    table, is_wrong = Visited(cycles=cycles).table(cycles, wrong=0.04, size=3e-3)

    found = wrong_rows(table)

    assert is_wrong.sum() >= 2
    np.testing.assert_array_equal(table.rows[found], table.rows[is_wrong])


def test_wrong_readings_of_half_a_millimetre_are_found_among_ten_visits() -> None:
    """Eleven standard deviations of visits: the mean of ten would be off by .05 mm, which no test of means sees."""
    table, is_wrong = Visited(poses=40, cycles=10).table(5, wrong=0.04, size=5e-4)

    found = wrong_rows(table)

    assert np.count_nonzero(found & is_wrong) >= 0.95 * is_wrong.sum() and not np.any(found & ~is_wrong)


@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(seed, marks=pytest.mark.long) for seed in range(3, 8))])
def test_sound_visits_are_not_accused(seed: int) -> None:
    """Whatever the cycles, drives, targets and order, no reading is left out, and the fit is that of the means."""
    table, _ = drawn(np.random.default_rng(seed)).table(seed)

    assert not wrong_rows(table).any()


def test_where_two_of_three_visits_are_wrong_the_model_decides() -> None:
    """No two readings agree, so the one that the robot predicts is right."""
    table, _ = Visited(cycles=3, order="same").table(2)
    position = table.position.copy()
    position[[7, 127]] += [[3e-3, 0.0, 0.0], [0.0, -4e-3, 1e-3]]
    spoiled = replace(table, readings={**table.readings, "position": position})

    assert table.rows[wrong_rows(spoiled)].tolist() == table.rows[[7, 127]].tolist()


def test_few_visits_do_not_judge_each_other() -> None:
    """Five second visits do not show how far visits differ: their readings are judged by the fit alone."""
    table, _ = Visited(cycles=2, order="same").table(4)
    position = table.position.copy()
    position[60] += [3e-3, 0.0, 0.0]
    spoiled = replace(table, readings={**table.readings, "position": position}).select(np.arange(65))

    assert not wrong_rows(spoiled).any()


def test_copies_of_a_wrong_reading_are_left_out_with_it() -> None:
    """A file that holds a row twice spoils no mean."""
    table, _ = Visited(cycles=3, order="same").table(3)
    position = table.position.copy()
    position[7] += [3e-3, 0.0, 0.0]
    spoiled = replace(table, readings={**table.readings, "position": position})
    doubled = spoiled.select(np.sort(np.append(np.arange(len(table)), 7)))

    assert np.flatnonzero(wrong_rows(doubled)).tolist() == [7, 8]


def test_a_calibration_lists_them_and_keeps_the_other_visits() -> None:
    """Lines of the file in the list of outliers and in its note; nothing else is left out, and no doubt remains."""
    table, is_wrong = Visited(cycles=3).table(7, wrong=0.04, size=3e-3)

    found = run_calibration(ROBOT, table, OPTIONS)

    lines = table.rows[is_wrong].tolist()
    assert list(found.result.outliers) == lines
    assert any("rejected as outliers" in note.text and note.rows == tuple(lines) for note in found.result.warnings)
    assert not found.result.doubts
    assert len(found.station.measured[0]) == len(table) - len(lines)


@pytest.mark.long
@pytest.mark.skipif(not PLAN.exists(), reason="cases of plans of measurement are not part of the project")
def test_wrong_readings_in_cycles_are_named() -> None:
    """Seven readings of 180 are off by 1 to 7 mm; of the three of one pose, line 31 agrees with the model to 36 um."""
    robot = Robot.from_urdf(PLAN / "robot.urdf")

    result = run_calibration(robot, read_measurements(PLAN / "data.csv", robot.joint_names)).result

    assert list(result.outliers) == [91, 101, 106, 135, 151, 152, 173]
    assert not result.doubts
    assert result.error["calibrated"]["test"]["mean_mm"] < 0.035
