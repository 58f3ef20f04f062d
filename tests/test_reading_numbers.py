"""Numbers by which tables are read or refused, on both sides of where they decide."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from test_checks import REACH
from test_checks import _table as checked_table
from test_joined import HELD, MOVING, TIME, Q, joined, joints, readings
from test_stops import table as visits

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.admit import check_reach
from pincal.measure.approach import sides_of
from pincal.measure.joined import held_poses
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.measure.orientation import CONVENTIONS
from pincal.measure.parquet_sheet import open_parquet
from pincal.measure.poses import by_pose, replicate_groups
from pincal.measure.sheet import check_unpacked
from pincal.measure.stops import plan_of
from pincal.sensors.pose import span_m
from pincal.sensors.setup import NamedPoints


def said(measurements: Measurements) -> str:
    """Return what is said of the places of a table on an arm: its warnings, or its error."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            check_reach(measurements, REACH)
        except MeasurementError as error:
            return str(error)
    return "; ".join(str(each.message) for each in caught)


@pytest.mark.parametrize(("apart", "count"), [(0.9e-4, 1), (2.1e-4, 2)])
def test_means_are_of_positions_within_what_drives_repeat(apart: float, count: int) -> None:
    """A tenth of a milliradian; twice as far apart they are others, wherever the border of a grid happens to be."""
    assert len(by_pose(measurements_from_arrays(["a"], [[0.1], [0.1 + apart]], distance=[1.0, 2.0]))) == count


@pytest.mark.parametrize(("more", "groups"), [(4e-4, [0, 0]), (1.1e-3, [0, 1])])
def test_loads_of_a_pose_agree_to_a_gram(more: float, groups: list[int]) -> None:
    """As scales show them."""
    rows = measurements_from_arrays(["a"], [[0.1], [0.1]], distance=[1.0, 1.2], payload=[80.0, 80.0 + more])

    assert replicate_groups([rows])[0].tolist() == groups


def test_a_joint_arrives_from_a_side_if_it_crossed_the_play_of_its_gear() -> None:
    """A milliradian is more than any."""
    assert sides_of(np.array([0.9e-3, 1.1e-3, -0.9e-3, -1.1e-3])).tolist() == [0.0, 1.0, 0.0, -1.0]


def test_a_pose_is_held_still_for_some_tenths_of_a_second() -> None:
    """Creeping by less than 0.3 mrad in 0.3 s and by less than 2 mrad in all."""

    def held(speed: float, lasts: float) -> int:
        time = np.arange(0.0, lasts, 0.01)
        return len(held_poses(time, speed * time[:, None]))

    def stopped(lasts: float) -> int:
        time = np.arange(0.0, 4.0, 0.01)
        return len(held_poses(time, np.interp(time, [0.0, 2.0, 2.0 + lasts, 4.0], [0.0, 2.0, 2.0, 4.0])[:, None]))

    assert [held(speed, 1.5) for speed in (0.9e-3, 1.2e-3)] == [1, 0]
    assert [held(0.5e-3, lasts) for lasts in (3.8, 4.2)] == [1, 0]
    assert [stopped(lasts) for lasts in (0.28, 0.32)] == [0, 1]


@pytest.mark.parametrize(("in_motion", "is_read"), [(3, True), (4, False)])
def test_half_of_a_table_is_read_while_the_arm_is_held(in_motion: int, is_read: bool, tmp_path: Path) -> None:
    """Or its clock is not that of the log."""
    time = HELD.copy()
    time[:in_motion] += 1.5
    table = {name: values[:7] for name, values in readings(time=time).items()}
    log = joints(MOVING, time=TIME)
    if is_read:
        with pytest.warns(PincalWarning, match=f"{in_motion} rows are left out, between two poses"):
            assert len(joined(tmp_path, table, log)) == 7 - in_motion
    else:
        with pytest.raises(MeasurementError):
            joined(tmp_path, table, log)


@pytest.mark.parametrize(("apart", "is_read"), [(1.9e-3, True), (2.1e-3, False)])
def test_rows_of_one_pose_of_a_log_agree(apart: float, is_read: bool, tmp_path: Path) -> None:
    """To 2 mrad; a number that names other poses as well names none."""
    log = joints(np.vstack([Q[:1], Q[:1] + apart, Q[1:]]), pose=np.array([1, 1, 2, 3, 4, 5, 6, 7, 8]))
    if is_read:
        with pytest.warns(PincalWarning, match='by the column "pose"'):
            assert len(joined(tmp_path, readings(pose=np.arange(1.0, 9.0)), log)) == 8
    else:
        with pytest.raises(MeasurementError):
            joined(tmp_path, readings(pose=np.arange(1.0, 9.0)), log)


@pytest.mark.parametrize(("again", "stops"), [(3.8, 3), (4.2, 6)])
def test_half_the_usual_time_is_enough_to_leave_and_come_back(again: float, stops: int) -> None:
    """Of 8 s from pose to pose."""
    time = np.cumsum([0.0, again, 8.0, again, 8.0, again])

    assert plan_of(visits([0, 0, 1, 1, 2, 2], time=time)).n_stops == stops


@pytest.mark.parametrize(("size", "labels"), [(32, 32), (33, 1)])
def test_numbers_of_short_lists_are_columns(size: int, labels: int, tmp_path: Path) -> None:
    """Longer ones are images and the like."""
    pl.DataFrame({"joint_positions": np.zeros((4, size)).tolist()}).write_parquet(tmp_path / "log.parquet")

    assert len(open_parquet(tmp_path / "log.parquet").labels) == labels


@pytest.mark.parametrize(("size", "most"), [(100, 1_000_000), (100_000, 5_000_000)])
def test_a_file_holds_no_more_than_measured_numbers(size: int, most: int, tmp_path: Path) -> None:
    """A megabyte, or fifty times what it is."""
    (tmp_path / "log.xlsx").write_bytes(bytes(size))
    check_unpacked(tmp_path / "log.xlsx", most)
    with pytest.raises(MeasurementError, match="more than 50 times its size"):
        check_unpacked(tmp_path / "log.xlsx", most + 1)


@pytest.mark.parametrize(("far", "words"), [(7, "check line"), (9, "looks like millimetres")])
def test_a_fifth_of_the_rows_is_a_column_at_fault(far: int, words: str) -> None:
    """Fewer positions far away are rows at fault."""
    position = np.random.default_rng(1).uniform(-1.0, 1.0, (40, 3))
    position[:far] *= 1e3

    assert words in said(checked_table(position=position))


@pytest.mark.parametrize(("share", "words"), [(0.99, ""), (1.01, "m apart; expected at most 9 m")])
def test_a_target_is_within_two_metres_of_the_flange(share: float, words: str) -> None:
    """On either side of the arm."""
    assert span_m(REACH) == 2.0 * (REACH + 2.0)
    position = np.zeros((40, 3))
    position[0, 0] = share * span_m(REACH)
    found = said(checked_table(position=position))

    assert words in found and bool(words) == bool(found)


@pytest.mark.parametrize(
    ("spread", "unit", "is_told"), [(0.9, "mm", True), (1.1, "mm", False), (0.9, "m", True), (1.1, "m", False)]
)
def test_a_target_follows_the_arm_by_a_thousandth_of_its_reach(spread: float, unit: str, is_told: bool) -> None:
    """Or it is held in place, or its unit is none."""
    position = np.zeros((40, 3))
    position[0, 0] = spread * 1e-3 * (span_m(REACH) if unit == "mm" else REACH)

    assert ("values in metres under" in said(checked_table(position=position, units={"x": unit}))) == (
        is_told and unit == "mm"
    )
    if unit == "m":
        assert ("is the target held in place" in said(checked_table(position=position))) == is_told


@pytest.mark.parametrize(("moved", "is_told"), [(0.45, False), (0.55, True)])
def test_half_a_radian_moves_a_target(moved: float, is_told: bool) -> None:
    """By less it may stay where it is."""
    q = np.linspace(-0.5 * moved, 0.5 * moved, 40)[:, None] * np.ones(3)

    assert ("is the target held in place" in said(checked_table(q, position=np.zeros((40, 3))))) == is_told


@pytest.mark.parametrize(
    ("length", "is_refused"), [(99.0, False), (101.0, True), (1.1e-3 * REACH, False), (0.9e-3 * REACH, True)]
)
def test_distances_are_those_of_instruments(length: float, is_refused: bool) -> None:
    """Not beyond a hundred metres, nor deviations."""
    assert bool(said(checked_table(distance=np.full(40, length)))) == is_refused


@pytest.mark.parametrize(("turn", "is_read"), [(6.29, True), (6.31, False)])
def test_no_rotation_vector_is_longer_than_a_revolution(turn: float, is_read: bool) -> None:
    """But for rounding."""
    columns = {"rx": np.array([turn]), "ry": np.zeros(1), "rz": np.zeros(1)}
    if is_read:
        assert CONVENTIONS["ur"].quaternions(columns, where="log.csv").shape == (1, 4)
    else:
        with pytest.raises(MeasurementError, match="more than a revolution"):
            CONVENTIONS["ur"].quaternions(columns, where="log.csv")


@pytest.mark.parametrize(("norm", "is_read"), [(1.009, True), (0.991, True), (1.011, False), (0.989, False)])
def test_quaternions_have_the_norm_of_rounded_ones(norm: float, is_read: bool) -> None:
    """One hundredth is more than four decimals leave."""
    pose = {"position": [[0.0, 0.0, 0.0]], "quaternion": [[0.0, 0.0, 0.0, norm]]}
    if is_read:
        assert measurements_from_arrays(["a"], [[0.0]], **pose).quaternion.tolist() == [[0.0, 0.0, 0.0, 1.0]]
    else:
        with pytest.raises(MeasurementError, match="norm 1 within 1%"):
            measurements_from_arrays(["a"], [[0.0]], **pose)


@pytest.mark.parametrize(("width", "are_in_line"), [(0.8e-3, True), (0.9e-3, False)])
def test_points_in_a_line_tell_no_rotation(width: float, are_in_line: bool) -> None:
    """A thousandth of the length beside it, root mean square: 0.87 mm of a point midway between two a metre apart."""
    places = {"a": (0.0, 0.0, 0.0), "b": (1.0, 0.0, 0.0), "c": (0.5, width, 0.0)}

    assert NamedPoints(places).are_in_line == are_in_line
