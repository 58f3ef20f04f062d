"""What may be recorded of a pose is known to all from one registry."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pincal.design.health import CheckRequest
from pincal.errors import BadInputError, MeasurementError
from pincal.identify.station import conditions_of
from pincal.measure.measurements import measurements
from pincal.model.augmented import augmented_model
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, joined_conditions
from pincal.model.model import Model
from pincal.recorded import RECORDABLE, RECORDED, typical_columns
from pincal.robot.robot import Robot
from pincal.sensors.fields import CONDITIONS
from pincal.units import UNITS

ROBOT = Robot.from_urdf("ur10")
N = 4


@pytest.mark.parametrize("name", RECORDABLE)
def test_what_a_table_records_reaches_effects(name: str) -> None:
    """A variable of the registry is a keyword of arrays, a column of tables, and what an effect finds at its poses."""
    q, variable = np.zeros((N, ROBOT.n_joints)), RECORDABLE[name]
    values = np.ones(q.shape if variable.of_joints else N)
    model = Model(Chain.of(ROBOT), ())

    table = measurements(ROBOT, q, position=np.zeros((N, 3)), **{name: values})
    conditions = conditions_of(model, table, np.zeros(3))

    assert (name in CONDITIONS) != variable.of_joints and variable.quantity in UNITS
    assert np.array_equal(np.asarray(conditions.column(name), float), values)
    assert len(np.asarray(conditions.select(slice(0, 1)).column(name))) == 1


@pytest.mark.parametrize("name", RECORDED)
def test_set_ups_that_lack_a_variable(name: str) -> None:
    """Joined poses have what stands for unknown, or nothing; what has a zero of its own in each set-up is dropped."""
    q, variable = np.zeros((N, ROBOT.n_joints)), RECORDED[name]
    bare = conditions_of(Model(Chain.of(ROBOT), ()), measurements(ROBOT, q), np.zeros(3))
    known = replace(bare, **{name: np.ones(q.shape if variable.of_joints else N)})

    some, both = (joined_conditions(parts).column(name) for parts in ((known, bare), (known, known)))

    assert (both is None) == variable.has_own_zero
    assert (some is None) == (variable.has_own_zero or variable.unknown is None)
    assert some is None or (np.all(some[:N] == 1.0) and np.all(some[N:] == variable.unknown))


def test_the_joined_poses_of_the_same_set_ups_are_one_object() -> None:
    """Results are kept for poses by identity, and a search joins those of its stations again for every model."""
    q = np.zeros((N, ROBOT.n_joints))
    first, second = (conditions_of(Model(Chain.of(ROBOT), ()), measurements(ROBOT, q + k), np.zeros(3)) for k in (0.0, 1.0))

    assert joined_conditions([first, second]) is joined_conditions((first, second))
    np.testing.assert_array_equal(joined_conditions([second, first]).q, np.concatenate([q + 1.0, q]))


def test_every_column_has_typical_values_before_anything_is_measured() -> None:
    """A plan, and a check of it, need no list of columns: whatever a table may hold has its shape and a value."""
    q = np.zeros((5, 6))
    columns = typical_columns(RECORDED, q)

    assert columns.keys() == RECORDED.keys()
    assert {name for name, column in columns.items() if column.shape == q.shape} == {
        name for name, variable in RECORDED.items() if variable.of_joints
    }
    assert set(columns["temperature"]) == {20.0}
    assert Conditions(q, np.zeros(5, int), np.zeros(5), np.zeros(3), **columns).column("move") is columns["move"]


@pytest.mark.parametrize(
    ("name", "value"),
    [("payload", -5000.0), ("payload", np.nan), ("payload", 1e5), ("temperature", -1e9), ("temperature", 293.15)],
)
def test_what_no_robot_has_is_refused_in_tables(name: str, value: float) -> None:
    """With its row and the range: a load below zero or of tons, kelvins without their unit."""
    values = np.array([20.0, value, 20.0, 20.0])
    with pytest.raises(MeasurementError, match=f'line 3, "{name}"'):
        measurements(ROBOT, np.zeros((N, ROBOT.n_joints)), position=np.zeros((N, 3)), **{name: values})


@pytest.mark.parametrize("value", [-5000.0, np.nan, np.inf, 1e9, None, "heavy"])
def test_what_no_robot_carries_is_refused_at_every_door_of_the_library(value: Any) -> None:
    """Alike by conditions, a health check and Pinocchio's model."""
    doors = (
        lambda: Conditions.at(np.zeros((1, 6)), payload=value),
        lambda: CheckRequest(payloads=[value]),
        lambda: augmented_model(Chain.of(ROBOT), payload=value),
    )
    for door in doors:
        with pytest.raises(BadInputError, match=r"payload: .*expected 0 to 10000 kg"):
            door()


def test_where_no_joint_is_is_refused() -> None:
    """Joint positions, and the centre of mass of a load."""
    with pytest.raises(BadInputError, match="joint positions: expected a finite number"):
        Conditions.at(np.full((1, 6), np.nan))
    with pytest.raises(BadInputError, match="centre of mass of the payload"):
        Conditions.at(np.zeros((1, 6)), payload=1.0, payload_centre=(0.0, np.nan, 0.0))
