from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from pincal.errors import MeasurementError, PincalWarning
from pincal.measure.admit import admit, check_joint_values, check_reach, check_rows, check_table
from pincal.measure.table import Measurements, measurements_from_arrays
from pincal.robot.robot import Robot
from pincal.sensors.setup import Setup

REACH = 2.5
LOWER, UPPER = np.array([-3.0, -1.0, -2.0]), np.array([3.0, 1.0, 2.0])
TYPES = ("revolute", "revolute", "revolute")


def _table(q: np.ndarray | None = None, *, units: dict[str, str] | None = None, **columns: object) -> Measurements:
    rng = np.random.default_rng(1)
    q = rng.uniform(0.95 * LOWER, 0.95 * UPPER, (40, 3)) if q is None else q
    columns = columns or {"position": rng.uniform(-1, 1, (len(q), 3))}
    return measurements_from_arrays("abc", q, source="cell.csv", units=units, **columns)  # type: ignore[arg-type]


def _q() -> np.ndarray:
    return _table().q.copy()


@contextmanager
def _silence() -> Iterator[None]:
    """Turn warnings into errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def _robot() -> Robot:
    """Return an arm of the limits and about the reach that the tables of this file are made for."""
    with pytest.warns(PincalWarning, match="locked"):
        robot = Robot.from_urdf("ur10", joints=["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"])
    return replace(robot, lower=LOWER, upper=UPPER)


def test_sound_table_passes_without_a_word() -> None:
    """A plausible table causes no warning."""
    robot = _robot()
    with _silence():
        check_table(robot, _table(), minimum=10)


@pytest.mark.parametrize("limit", [np.inf, 3.0])
def test_degrees_without_a_unit_are_refused(limit: float) -> None:
    """Values that no joint reaches in rad are refused as degrees, with or without joint limits."""
    q = _q()
    q[:, 0] = np.rad2deg(q[:, 0])
    lower, upper = LOWER.copy(), UPPER.copy()
    lower[0], upper[0] = -limit, limit
    with pytest.raises(MeasurementError, match=r'"a": .* looks like degrees; write `a \[deg\]`'):
        check_joint_values(_table(q), lower, upper, TYPES)


def test_few_degrees_beyond_the_limits_are_refused() -> None:
    """Values below two turns are refused as degrees if many exceed the limits and degrees explain all."""
    q = np.random.default_rng(2).uniform(-8, 8, (40, 3))
    with pytest.raises(MeasurementError, match="looks like degrees"):
        check_joint_values(_table(q), LOWER, UPPER, TYPES)


def test_a_stated_unit_is_believed() -> None:
    """A joint whose header says rad may turn as often as it likes."""
    q = _q()
    q[:, 0] *= 10
    limits = np.full(3, np.inf)

    with _silence():
        check_joint_values(_table(q, units={"a": "rad"}), -limits, limits, TYPES)
    with pytest.raises(MeasurementError, match="looks like degrees"):
        check_joint_values(_table(q), -limits, limits, TYPES)


def test_wide_limits_allow_many_turns() -> None:
    """A joint whose finite limits allow many turns is not taken for degrees."""
    q, wide = _q(), np.array([100.0, 1.0, 2.0])
    q[:, 0] *= 20

    with _silence():
        check_joint_values(_table(q), -wide, wide, TYPES)


@pytest.mark.parametrize("limit", [2.0, np.inf])
def test_millimetres_on_a_rail_are_refused(limit: float) -> None:
    """A prismatic joint with values that are no metres is refused as millimetres."""
    q = _q()
    q[:, 0] *= 500
    with pytest.raises(MeasurementError, match=r"looks like millimetres; write `a \[mm\]`"):
        check_joint_values(_table(q), [-limit, -1, -2], [limit, 1, 2], ("prismatic", "revolute", "revolute"))


def test_value_beyond_its_limit_is_a_warning() -> None:
    """A few values beyond the limits are named with the worst and its line."""
    q = _q()
    q[3, 1], q[7, 1] = 1.2, -1.4
    with pytest.warns(PincalWarning, match=r'2 rows of "b" .* worst is -1.4 rad in line 9, 0.4 rad too far'):
        check_joint_values(_table(q), LOWER, UPPER, TYPES)


def test_tolerance_of_limits_is_silent() -> None:
    """A value beyond its limit by less than the tolerance is no finding."""
    q = _q()
    q[3, 1] = 1.04
    with _silence():
        check_joint_values(_table(q), LOWER, UPPER, TYPES)


def test_a_typing_slip_is_a_warning_not_a_unit() -> None:
    """One value that even degrees can't explain is reported as that row's."""
    q = _q()
    q[5, 1] = 1000
    with pytest.warns(PincalWarning, match=r'1 row of "b" .* worst is 1000 rad in line 7'):
        check_joint_values(_table(q), LOWER, UPPER, TYPES)


@pytest.mark.parametrize(("unit", "size"), [("", 1.0), ("deg", np.pi / 180.0), ("mrad", 1e-3)])
def test_what_lies_beyond_a_limit_is_told_in_the_unit_of_its_column(unit: str, size: float) -> None:
    """As it stands in the file, radians without one."""
    q = _q()
    q[5, 1] = UPPER[1] + 0.5
    table = _table(q, units={"b": unit} if unit else None)
    worst, excess = (UPPER[1] + 0.5) / size, 0.5 / size
    words = f"the worst is {worst:.6g} {unit or 'rad'} in line 7, {excess:.3g} {unit or 'rad'} too far"
    with pytest.warns(PincalWarning, match=re.escape(words)):
        check_joint_values(table, LOWER, UPPER, TYPES)


def test_swapped_joint_columns_are_named() -> None:
    """Two columns whose exchange brings all rows inside the limits are refused by name."""
    q = _q()[:, [0, 2, 1]]
    with pytest.raises(MeasurementError, match="columns b and c swapped"):
        check_joint_values(_table(q), LOWER, UPPER, TYPES)


def test_rare_excess_that_a_swap_cures_is_a_warning() -> None:
    """If few rows are outside, the swap is only hinted at."""
    q = _q() * 0.4
    q[0] = [0.0, 1.5, 0.5]
    with pytest.warns(PincalWarning, match="b and c swapped"):
        check_joint_values(_table(q), LOWER, UPPER, TYPES)


def test_missing_limits_limit_nothing() -> None:
    """Limits of 0 and 0, as in a URDF without any, count as none."""
    with _silence():
        check_joint_values(_table(), np.zeros(3), np.zeros(3), TYPES)


@pytest.mark.parametrize(("name", "label"), [("position", "x"), ("distance", "distance"), ("camera_point", "cx")])
def test_millimetres_without_a_unit_are_refused(name: str, label: str) -> None:
    """Positions, distances and camera points that no arm spans in metres are refused as millimetres."""
    rng = np.random.default_rng(3)
    values = rng.uniform(100, 2500, 40 if name == "distance" else (40, 3))
    columns = {name: values, **({"point": ["P"] * 40} if name == "camera_point" else {})}
    with pytest.raises(MeasurementError, match=rf"looks like millimetres: write `{label} \[mm\]`"):
        check_reach(_table(**columns), REACH)


def test_one_position_far_away_is_located() -> None:
    """A single wild position is refused with its line, not taken for a unit."""
    position = _table().position
    assert position is not None
    position = position.copy()
    position[11] += 50
    with pytest.raises(MeasurementError, match="check line 13"):
        check_reach(_table(position=position), REACH)


def test_metres_declared_as_millimetres_are_refused() -> None:
    """Positions that hardly move while the joints do are refused if a unit shrank them."""
    position = np.random.default_rng(4).uniform(-1e-3, 1e-3, (40, 3))
    with pytest.raises(MeasurementError, match=r"under `x \[mm\]`\? Then write `x \[m\]`"):
        check_reach(_table(position=position, units={"x": "mm"}), REACH)
    with pytest.warns(PincalWarning, match="held in place, or has the instrument frozen"):
        check_reach(_table(position=position / 5), REACH)


def test_fixed_distance_is_no_fault() -> None:
    """A ball bar keeps its length while the joints move, and passes."""
    check_reach(_table(distance=np.full(40, 0.3)), REACH)


@pytest.mark.parametrize(("value", "text"), [(300.0, r"write `distance \[mm\]`"), (3e-4, "expected the whole distance")])
def test_fixed_distance_in_a_wrong_unit_is_refused(value: float, text: str) -> None:
    """A length that no measuring line has is refused although it does not vary."""
    with pytest.raises(MeasurementError, match=text):
        check_reach(_table(distance=np.full(40, value)), REACH)


def test_socket_data_have_no_reach_to_check() -> None:
    """Contact data hold no length and pass."""
    check_reach(_table(socket=["A"] * 40), REACH)


def test_too_few_rows_are_refused() -> None:
    """Fewer rows than the fit needs are refused with both numbers."""
    with pytest.raises(MeasurementError, match="40 rows; expected at least 41"):
        check_rows(_table(), minimum=41)


def test_one_pose_repeated_is_refused() -> None:
    """A table with the same joint values in all rows is refused."""
    with pytest.raises(MeasurementError, match="same joint values"):
        check_rows(_table(np.ones((5, 3))), minimum=2)


def test_constant_joint_is_no_fault() -> None:
    """A joint that stands still is not refused."""
    q = _q()
    q[:, 1] = 0.3
    with _silence():
        check_rows(_table(q), minimum=2)


def test_copied_rows_are_a_warning() -> None:
    """Rows that repeat an earlier row in every column are counted with their lines."""
    table = _table().select([0, 1, 2, 1, 3, 1, 0])
    table, robot = measurements_from_arrays("abc", table.q, position=table.position), _robot()
    with pytest.warns(PincalWarning, match=r"3 rows repeat .* \(line 5, 7, 8\)"):
        check_table(robot, table)


def test_a_table_under_two_names_is_told() -> None:
    """Positions of one table that are another's to the last digit are counted; other readings at the same joints are not."""
    robot, table = _robot(), _table()
    first = measurements_from_arrays(robot.joint_names, table.q, position=table.position)
    off = np.where(np.arange(40)[:, None] < 30, 0.0, 1e-5)
    again = first.with_readings(position=table.position + off)
    given = {"monday": replace(first, source="monday.csv"), "tuesday": replace(again, source="tuesday.csv")}

    notes = admit(robot, given, lambda name: Setup()).notes
    assert [note for note in notes if "30 rows are also in monday.csv, to the last digit" in note]
    apart = given | {"tuesday": given["tuesday"].with_readings(position=table.position + 1e-5)}
    assert not [note for note in admit(robot, apart, lambda name: Setup()).notes if "also in" in note]


@pytest.mark.parametrize("column", ["position", "target", "time"])
def test_replicates_are_no_copies(column: str) -> None:
    """A pose that was measured again, with another result, target or time, is no copy."""
    table = _table()
    twice = table.select(np.repeat(np.arange(40), 2))
    assert twice.position is not None
    differs = np.tile([0.0, 1.0], 40)
    columns: dict[str, object] = {"position": twice.position, "time": np.zeros(80), "target": ["t"] * 80}
    columns[column] = {
        "position": twice.position + 1e-5 * differs[:, None],
        "time": differs,
        "target": ["s", "t"] * 40,
    }[column]
    with _silence():
        check_rows(_table(twice.q, **columns), minimum=2)
