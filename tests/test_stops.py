"""How rows came about: readings, stops, poses, passes and sessions."""

from __future__ import annotations

import numpy as np
import pytest

from pincal.measure.measurements import Measurements, concatenate, measurements_from_arrays
from pincal.measure.poses import by_pose
from pincal.measure.stops import by_stop, plan_of

POSES = np.array([[0.1, 0.2], [0.5, -0.3], [1.0, 0.7]])


def table(visits: list[int], **columns: object) -> Measurements:
    """Return a table that visits poses in this order; each reading is its own number."""
    readings = np.arange(len(visits), dtype=float)
    return measurements_from_arrays(["a", "b"], POSES[visits], distance=1.0 + readings, **columns)


def test_repeats_without_moving_are_one_stop() -> None:
    """Consecutive rows of a pose are one stop, and a later visit is another."""
    plan = plan_of(table([0, 0, 0, 1, 1, 0]))

    assert plan.stop.tolist() == [0, 0, 0, 1, 1, 2]
    assert plan.pose.tolist() == [0, 0, 0, 1, 1, 0]
    assert plan.visit.tolist() == [0, 0, 0, 0, 0, 1]


def test_drives_that_stop_elsewhere_within_their_repeatability_are_at_the_same_pose() -> None:
    """Joints as read back differ by some 1e-5 rad from visit to visit."""
    rows = table([0, 1, 2, 0, 1, 2])
    jittered = measurements_from_arrays(
        ["a", "b"], rows.q + 1e-5 * np.random.default_rng(0).standard_normal(rows.q.shape), distance=rows.distance
    )

    assert plan_of(jittered).pose.tolist() == [0, 1, 2, 0, 1, 2]


def test_several_reflectors_share_a_stop() -> None:
    """Rows of several targets at one pose are one stop, and each target is read once."""
    plan = plan_of(table([0, 0, 0, 1, 1, 1], target=["r1", "r2", "r3"] * 2))

    assert plan.stop.tolist() == [0, 0, 0, 1, 1, 1]
    assert plan.shares_stops
    assert not plan.is_repeated


def test_a_column_stop_divides_visits_of_the_same_pose() -> None:
    """An ISO 9283 run that logs the same pose thirty times in a row says by its column that it left it."""
    plan = plan_of(table([0, 0, 0, 0], stop=["s1", "s1", "s2", "s3"]))

    assert plan.stop.tolist() == [0, 0, 1, 2]
    assert plan.n_poses == 1


def test_time_to_leave_and_come_back_divides_stops() -> None:
    """Readings a tenth of a second apart are repeats; readings as far apart as poses are stops."""
    repeats = plan_of(table([0, 0, 1, 1, 2, 2], time=[0.0, 0.1, 8.0, 8.1, 16.0, 16.1]))
    visits = plan_of(table([0, 0, 1, 1, 2, 2], time=[0.0, 9.0, 17.0, 26.0, 34.0, 42.0]))

    assert repeats.n_stops == 3
    assert visits.n_stops == 6


def test_a_counter_of_rows_is_no_clock() -> None:
    """Times in equal steps do not tell whether the arm left between two readings."""
    plan = plan_of(table([0, 0, 0, 1, 1, 1], time=[0.0, 2.0, 4.0, 6.0, 8.0, 10.0]))

    assert plan.n_stops == 2


def test_passes_and_sessions() -> None:
    """A program that runs three times makes three passes, and a night between them two sessions."""
    time = [0.0, 8.0, 16.0, 24.0, 32.0, 40.0, 6e4, 6e4 + 8.0, 6e4 + 16.0]
    plan = plan_of(table([0, 1, 2, 0, 1, 2, 2, 1, 0], time=time))

    assert plan.passes.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert plan.session.tolist() == [0] * 6 + [1] * 3


def test_a_short_break_divides_no_session() -> None:
    """Ten minutes divide nothing, and neither do twenty times the usual time from stop to stop."""

    def sessions(usual: float, pause: float) -> int:
        return int(plan_of(table([0, 1, 2, 0], time=[0.0, usual, 2.0 * usual, 2.0 * usual + pause])).session.max()) + 1

    assert [sessions(8.0, pause) for pause in (590.0, 610.0)] == [1, 2]
    assert [sessions(60.0, pause) for pause in (1190.0, 1210.0)] == [1, 2]


def test_rows_out_of_order_are_put_in_order_by_time() -> None:
    """The order of the lines does not matter where times are given."""
    ordered = table([0, 0, 1, 0], time=[0.0, 0.1, 8.0, 16.0])
    mixed = ordered.select([3, 1, 0, 2])

    assert plan_of(mixed).stop.tolist() == [2, 0, 0, 1]


def test_means_of_stops_keep_visits_apart() -> None:
    """Each stop is one row for each target, with the number of its readings."""
    means = by_stop(table([0, 0, 1, 0]))

    assert means.distance.tolist() == [1.5, 3.0, 4.0]
    assert means.readings_per_row.tolist() == [2, 1, 1]


def test_means_of_poses_count_their_readings() -> None:
    """Five readings in two stops are one mean of a pose."""
    assert by_pose(table([0, 0, 0, 1, 0, 0])).readings_per_row.tolist() == [5, 1]


def test_a_stop_is_no_other_pose() -> None:
    """The column does not keep readings of one pose apart when poses are averaged."""
    assert len(by_pose(table([0, 1, 0, 1], stop=["1", "2", "3", "4"]))) == 2


@pytest.mark.parametrize("visits", [[0], [0, 1, 2], [0, 0]])
def test_small_tables_have_plans(visits: list[int]) -> None:
    """One row, rows without repeats and repeats alone are plans, too."""
    assert len(plan_of(table(visits))) == len(visits)


def test_joined_tables_keep_their_counts() -> None:
    """Tables of means can be joined with tables of single readings."""
    rows = table([0, 0, 1])
    both = concatenate([by_pose(rows), table([2])])

    assert both.readings_per_row.tolist() == [2, 1, 1]
