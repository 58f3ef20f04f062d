"""What changes between visits of the same poses is found in their deviations from the mean, where means show nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import SHARED
from visited import NOISE, ROBOT, Visited, drawn

from pincal import GEOMETRIC, Options, Robot, calibrate, read_measurements, run_calibration
from pincal.calibration.result import Result
from pincal.measure.measurements import Measurements
from pincal.validate.misfit import Verdict
from pincal.validate.visit_scan import chance_of_most
from pincal.validate.visits import VisitChange, changes_between_visits

PLANS = SHARED / "cases" / "plans"
OPTIONS = Options(effects=GEOMETRIC)
needs_plans = pytest.mark.skipif(not PLANS.exists(), reason="cases of plans of measurement are not part of the project")


def seen(table: Measurements) -> list[VisitChange]:
    """Return what a calibration of a table sees between visits."""
    fit = calibrate(ROBOT, table, OPTIONS)
    return changes_between_visits(fit.readings(table), fit.values, table)


def result_of(table: Measurements, sigma: float | None = None) -> Result:
    """Return the result of a calibration, with the noise declared if it is given."""
    return run_calibration(ROBOT, table, replace(OPTIONS, sigma=sigma)).result


def shifted(size: float, cut: int) -> Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]:
    """Return readings that are shifted by a size [m] from a stop on."""
    return lambda x, visit, rng: x + np.where(np.arange(len(x)) >= cut, size, 0.0)[:, None, None] * [0.6, 0.0, 0.8]


def turned(joint: int, size: float, cut: int) -> Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]:
    """Return joint positions, one of which is off by a size [rad] from a stop on."""
    return lambda q, visit, rng: q + np.outer(np.arange(len(q)) >= cut, size * (np.arange(6) == joint))


CHANGES = {
    "instrument between two passes": (Visited(readings=shifted(9e-5, 60)), 60, "instrument"),
    "instrument by millimetres": (Visited(readings=shifted(5e-3, 60)), 60, "instrument"),
    "instrument within a pass": (Visited(order="sorted", readings=shifted(2e-4, 85)), 85, "instrument"),
    "instrument, three targets": (Visited(targets=3, readings=shifted(2e-4, 60)), 180, "instrument"),
    "a joint remastered": (Visited(joints=turned(1, 1e-3, 45)), 45, "joint_2"),
    "a joint after most of three passes": (Visited(cycles=3, joints=turned(2, 3e-4, 150)), 150, "joint_3"),
}


def some_first() -> Iterator[Any]:
    """Yield cases: a shift is in the default suite; one within a pass, targets and a joint are in long runs."""
    for k, case in enumerate(CHANGES):
        later = pytest.mark.long if k in (2, 3, 5) else (pytest.mark.long, pytest.mark.rates)
        yield pytest.param(case, marks=later if k else ())


@pytest.mark.parametrize("case", list(some_first()))
def test_a_change_between_passes_is_found_with_its_line(case: str) -> None:
    """By the row at which it happened, to within three, and by its cause, though means of poses show nothing."""
    plan, cut, cause = CHANGES[case]
    table, _ = plan.table(11)

    (found,) = seen(table)

    assert found.kind == "step" and found.causes[0].name == cause
    assert abs(found.line - int(table.rows[cut])) <= 3 * plan.targets
    assert found.lines[0] <= found.line <= found.lines[1]


@pytest.mark.long
def test_a_shift_of_five_sigma_of_a_pass_is_found() -> None:
    """Five standard deviations of the difference between the means of two passes, in 7 of 8 tables or more."""
    size = 5.0 * NOISE * np.sqrt(2.0 / 60)
    plan = Visited(arrival=0.0, readings=shifted(float(size), 60))

    found = [seen(plan.table(seed)[0]) for seed in range(8)]

    assert sum(map(bool, found)) >= 7


@pytest.mark.long
def test_a_calibration_stops_at_a_change_between_passes() -> None:
    """A doubt with the line, which is what exit code 4 follows from, and no verdict "adequate"."""
    table, _ = Visited(order="same", readings=shifted(1e-3, 60)).table(3)

    result = result_of(table)

    assert result.shift.startswith("from line 62 on readings are shifted by 0.99")
    assert result.verdict_of() is Verdict.NOT_ADEQUATE


@pytest.mark.long
def test_a_drift_between_visits_is_a_doubt() -> None:
    """A tenth of a millimetre over three passes, in any order of the poses."""

    def drifting(x: np.ndarray, visit: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return x + 1e-4 * np.linspace(0.0, 1.0, len(x))[:, None, None] * [0.0, 1.0, 0.0]

    table, _ = Visited(cycles=3, readings=drifting).table(4)

    assert [found.kind for found in seen(table)] == ["drift"]
    result = result_of(table)
    assert any("drift apart along the rows by up to 0.09" in note.text for note in result.doubts)
    assert not result.shift


def test_visits_that_alternate_between_two_sides_are_named_with_their_joint() -> None:
    """Backlash of joint 3, each pose approached from both sides in turn: the column that would tell is its approach."""

    def alternating(q: np.ndarray, visit: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return q + np.outer(visit % 2 - 0.5, 2e-4 * (np.arange(6) == 2))

    table, _ = Visited(cycles=4, order="in turn", joints=alternating).table(5)

    (found,) = seen(table)

    assert (found.kind, found.causes[0].name) == ("order", "joint_3")
    assert found.causes[0].size == pytest.approx(2e-4, rel=0.2)
    assert "approach_joint_3" in str(found) and "by turns" in str(found)


@pytest.mark.parametrize(
    "seed",
    [
        0,
        pytest.param(1, marks=pytest.mark.long),
        *(pytest.param(seed, marks=[pytest.mark.long, pytest.mark.rates]) for seed in range(2, 12)),
    ],
)
def test_sound_visits_raise_no_doubt(seed: int) -> None:
    """Whatever the cycles, drives, targets, dwell and order."""
    table, _ = drawn(np.random.default_rng(100 + seed)).table(100 + seed)

    assert seen(table) == []


def test_wrong_readings_make_no_change_between_visits() -> None:
    """Single readings that are off by millimetres are clipped."""
    table, _ = Visited(cycles=3).table(6, wrong=0.05, size=3e-3)

    assert seen(table) == []


@pytest.mark.long
def test_visits_that_scatter_more_than_drives_do_are_a_doubt() -> None:
    """Drives that stop to .3 mrad are no drives; to 60 urad they are, and the note says that the robot repeats so."""
    poor, _ = Visited(cycles=3, arrival=3e-4).table(7)
    usual, _ = Visited(cycles=3, arrival=6e-5).table(7)

    assert any("drives that arrive within 0.15 mrad" in note.text for note in result_of(poor, NOISE).doubts)
    assert not result_of(usual, NOISE).doubts


@pytest.mark.long
def test_repeats_within_a_stop_show_the_instrument() -> None:
    """They share the arrival of the drives, so they have to agree with the declared noise."""
    table, _ = Visited(dwell=4, arrival=6e-5).table(8)

    assert not result_of(table, NOISE).doubts
    assert any("repeated readings within a stop" in note.text for note in result_of(table, NOISE / 3.0).doubts)


def test_visits_that_differ_in_no_pattern_are_not_passed_over() -> None:
    """Loads without a column, in no order: visits differ by far more than means about the model allow."""

    def laden(q: np.ndarray, visit: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        # Means over the visits of a pose are those of the mean load.
        load = np.where(visit == 0, 1.0, -1.0) * rng.choice([-1.0, 1.0], 60)[np.arange(len(q)) % 60]
        return q + 1e-4 * np.outer(load, np.arange(6) == 1)

    table, _ = Visited(order="same", arrival=1e-5, joints=laden).table(9)

    doubts = result_of(table).doubts

    assert any("differ by more than the means of poses about the model allow" in note.text for note in doubts)


@pytest.mark.long
def test_a_step_among_poses_of_which_few_are_visited_again_has_the_line_of_the_means() -> None:
    """Ten of 110 poses are visited again at the end: by them it lies anywhere between, by the means at its row."""
    plan = Visited(poses=110, cycles=2, order="same", readings=shifted(4e-4, 60))
    table, _ = plan.table(10)
    table = table.select(np.arange(120))

    (found,) = [change for change in seen(table) if change.kind == "step"]
    result = result_of(table)

    assert found.lines[0] <= 62 <= found.lines[1] or abs(found.line - 62) <= 60
    assert result.shift and abs(int(result.shift.split()[2]) - 62) <= 3


@needs_plans
def test_two_passes_with_a_shift_between_them_are_told() -> None:
    """The instrument moved by 1 mm between two passes over 60 poses: "adequate, .0249 mm" was wrong by .5 mm."""
    robot, table = plan_of_case("01_two_passes_shift")

    result = run_calibration(robot, table).result

    assert result.shift.startswith("from line 62 on readings are shifted by 1 mm")


@needs_plans
def test_a_payload_that_alternates_without_a_column_is_told() -> None:
    """Each pose once with 0 kg and once with 100 kg: readings of a pose differ as a load bends the arm."""
    robot, table = plan_of_case("03_payload_alternates_no_column")

    result = run_calibration(robot, table, Options(sigma=1.5e-5)).result

    assert result.verdict_of() is Verdict.NOT_ADEQUATE
    assert any("as a load bends the arm; a column would tell why: payload" in note.text for note in result.doubts)


def plan_of_case(name: str) -> tuple[Robot, Measurements]:
    """Return robot and table of a case."""
    robot = Robot.from_urdf(PLANS / name / "robot.urdf")
    return robot, read_measurements(PLANS / name / "data.csv", robot.joint_names)


@pytest.mark.long
@pytest.mark.parametrize("patterns", [1, 4, 40])
def test_the_chance_of_the_most_significant_of_some_is_uniform(patterns: int) -> None:
    """Of independent patterns, from few permutations: as often below a level as the level says."""
    rng = np.random.default_rng(patterns)
    most = rng.exponential(size=(2000, patterns)).max(axis=1)
    permuted = rng.exponential(size=(2000, 300, patterns)).max(axis=2)
    chances = np.array([chance_of_most(one, of) for one, of in zip(most, permuted, strict=True)])

    assert 0.6 < np.mean(chances < 0.01) / 0.01 < 1.6
    assert 0.8 < np.mean(chances < 0.1) / 0.1 < 1.2
