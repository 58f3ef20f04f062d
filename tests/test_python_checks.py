"""Python checks tables as the command does, and shows a fit by name and number."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from placed_arms import NOISE, measured

import pincal
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path

Change = Callable[[pincal.Measurements], pincal.Measurements]
GEOMETRY = pincal.Options(effects=pincal.GEOMETRIC)
# Another order of the joints.
ORDER = [5, 2, 0, 3, 1, 4]


def in_millimetres(table: pincal.Measurements) -> pincal.Measurements:
    """Return the table with millimetres that are taken for metres."""
    return table.with_readings(position=1e3 * table.readings["position"])


def in_degrees(table: pincal.Measurements) -> pincal.Measurements:
    """Return the table with degrees that are taken for radians."""
    return replace(table, q=np.rad2deg(table.q))


def swapped(table: pincal.Measurements) -> pincal.Measurements:
    """Return the table with the columns of two joints under each other's name."""
    return replace(table, q=table.q[:, [0, 1, 2, 5, 4, 3]])


def of_one_pose(table: pincal.Measurements) -> pincal.Measurements:
    """Return the table with the same joints in all rows."""
    return replace(table, q=np.tile(table.q[0], (len(table), 1)))


def too_short(table: pincal.Measurements) -> pincal.Measurements:
    """Return three rows of the table."""
    return table.select(slice(0, 3))


def renamed(table: pincal.Measurements) -> pincal.Measurements:
    """Return the table with another name of a joint."""
    return replace(table, joint_names=("a1", *table.joint_names[1:]))


WRONG: dict[Change, str] = {
    in_millimetres: "mm",
    in_degrees: "looks like degrees",
    swapped: "'joint_4' and 'joint_6' appear to be swapped",
    of_one_pose: "the same joint values",
    too_short: "expected at least",
    renamed: "unknown: a1; missing: joint_1",
}


def reordered(table: pincal.Measurements) -> pincal.Measurements:
    """Return the table with its joints in another order, names and columns alike."""
    names = tuple(table.joint_names[i] for i in ORDER)
    return replace(table, joint_names=names, q=table.q[:, ORDER])


@pytest.fixture(scope="module")
def robot() -> pincal.Robot:
    """Return a KUKA KR 125/2."""
    return pincal.Robot.from_urdf(kuka_urdf_path())


@pytest.fixture(scope="module")
def machine() -> sim.TrueMachine:
    """Return this robot with errors of a millimetre and a milliradian."""
    nominal = sim.TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
    rng = np.random.default_rng(4)
    return nominal.draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)


@pytest.fixture(scope="module")
def table(machine: sim.TrueMachine, robot: pincal.Robot) -> pincal.Measurements:
    """Return what a tracker reads of it."""
    return measured(machine, robot, poses=120)


@pytest.fixture(scope="module")
def fit(robot: pincal.Robot, table: pincal.Measurements) -> pincal.FittedRobot:
    """Return the fit to this table."""
    return pincal.calibrate(robot, table, GEOMETRY)


@pytest.mark.parametrize(
    # Columns that are swapped take all pairs to be told.
    "change",
    [pytest.param(change, marks=pytest.mark.long if change is swapped else ()) for change in WRONG],
    ids=lambda change: change.__name__,
)
def test_python_refuses_what_the_command_refuses(
    robot: pincal.Robot,
    table: pincal.Measurements,
    change: Change,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """``calibrate`` and ``run_calibration`` raise the same error with the same words."""
    # Other signs, zeros and lengths of the robot explain none of these, and take time to try.
    monkeypatch.setattr("pincal.validate.trials.Trials.described", lambda *_, **__: None)
    wrong = change(table)
    with pytest.raises(pincal.BadInputError, match=WRONG[change]) as plain:
        pincal.calibrate(robot, wrong, GEOMETRY)
    with pytest.raises(pincal.BadInputError) as checked:
        pincal.run_calibration(robot, wrong, GEOMETRY)

    assert type(plain.value) is type(checked.value)
    assert str(plain.value) == str(checked.value)


def test_joints_are_matched_by_name(
    robot: pincal.Robot,
    table: pincal.Measurements,
    fit: pincal.FittedRobot,
) -> None:
    """A table with its joints in another order gives the same fit and the same predictions."""
    other = reordered(table)
    found = pincal.calibrate(robot, other, GEOMETRY)

    np.testing.assert_array_equal(found.values, fit.values)
    np.testing.assert_array_equal(found.predict(other), fit.predict(table.q))
    assert fit.score(other) == fit.score(table)
    found = pincal.run_calibration(robot, other, GEOMETRY).fit
    np.testing.assert_array_equal(found.values, fit.values)


def test_columns_of_joints_follow_their_names(
    robot: pincal.Robot,
    table: pincal.Measurements,
) -> None:
    """Directions of approach come into the robot's order with the positions."""
    approach = np.tile(np.sign(np.arange(6) - 2.5), (len(table), 1))
    sorted_table = replace(table, approach=approach)
    shuffled = replace(reordered(table), approach=approach[:, ORDER])
    found = shuffled.in_order_of(robot)

    assert found.joint_names == robot.joint_names
    np.testing.assert_array_equal(found.q, sorted_table.q)
    np.testing.assert_array_equal(found.approach, sorted_table.approach)
    assert table.in_order_of(robot) is table


def test_later_rows_are_matched_and_checked(
    machine: sim.TrueMachine,
    robot: pincal.Robot,
    fit: pincal.FittedRobot,
) -> None:
    """All that takes later rows, ``diagnose`` and ``predict`` too, matches names and units."""
    later = measured(machine, robot, poses=30, seed=8)
    other = reordered(later)

    assert pincal.diagnose(fit, other).report == pincal.diagnose(fit, later).report
    updated = pincal.update(fit, other)
    np.testing.assert_array_equal(updated.values, pincal.update(fit, later).values)
    placed = pincal.place_station(fit, other)
    np.testing.assert_array_equal(placed.values, pincal.place_station(fit, later).values)
    for use in (pincal.diagnose, pincal.update, pincal.FittedRobot.predict, pincal.FittedRobot.score):
        with pytest.raises(pincal.BadInputError, match="looks like degrees"):
            use(fit, in_degrees(later))
        with pytest.raises(pincal.BadInputError, match="unknown: a1; missing: joint_1"):
            use(fit, renamed(later))


@pytest.mark.long
def test_a_reversed_joint_is_corrected_with_a_warning(
    robot: pincal.Robot,
    table: pincal.Measurements,
) -> None:
    """As by the command, the fit is of the corrected robot, and a warning names the joint."""
    reversed_joint = replace(table, q=table.q * [1, 1, -1, 1, 1, 1])
    with pytest.warns(pincal.PincalWarning, match="joint_3"):
        found = pincal.calibrate(robot, reversed_joint, GEOMETRY)
    command = pincal.run_calibration(robot, reversed_joint, GEOMETRY).fit

    np.testing.assert_array_equal(found.values, command.values)
    assert found.solution.estimated[0] < 2 * NOISE


@pytest.mark.parametrize("q", [np.ma.masked_array(np.zeros((2, 6)), np.eye(2, 6)), np.zeros((2, 6), complex)])
def test_positions_are_real_and_none_is_masked(robot: pincal.Robot, fit: pincal.FittedRobot, q: np.ndarray) -> None:
    """By a model and by the URDF alike; NumPy drops a mask in silence, and an imaginary part with a warning."""
    for of in (fit.predict, robot.forward_kinematics):
        with pytest.raises(pincal.BadInputError, match=r"joint positions: has (masked values|complex numbers); expected"):
            of(q)


def test_parts_are_checked(robot: pincal.Robot, table: pincal.Measurements) -> None:
    """Each part of a large table has its joints matched and its units checked."""
    halves = [table.select(slice(0, 60)), table.select(slice(60, None))]
    found = pincal.calibrate_parts(robot, [halves[0], reordered(halves[1])], GEOMETRY)
    plain = pincal.calibrate_parts(robot, halves, GEOMETRY)

    np.testing.assert_array_equal(found.values, plain.values)
    with pytest.raises(pincal.BadInputError, match="looks like degrees"):
        pincal.calibrate_parts(robot, [halves[0], in_degrees(halves[1])], GEOMETRY)


def test_a_fit_shows_its_noise(fit: pincal.FittedRobot) -> None:
    """Its ``repr`` has robot, rows and the noise of the residuals in mm."""
    noise = 1e3 * fit.solution.estimated[0]

    assert repr(fit) == f"FittedRobot('kuka_kr125_2': 120 rows, noise {noise:.3g} mm)"


def test_the_figures_of_a_calibration_are_at_hand(
    robot: pincal.Robot,
    table: pincal.Measurements,
) -> None:
    """``pincal.drawings`` returns the errors and the corrections of lengths and angles."""
    run = pincal.run_calibration(robot, table, GEOMETRY)
    titles = [title for _, title, _ in pincal.drawings(run)]

    assert titles[0].startswith("Histogram of position errors")
    assert titles[-2:] == [
        "Corrections of lengths with their uncertainty",
        "Corrections of angles with their uncertainty",
    ]


def test_parameters_are_found_by_name(fit: pincal.FittedRobot) -> None:
    """The table of parameters returns value, standard deviation and unit of one by its name."""
    k = fit.estimate.names.index("joint_2.theta")
    found = fit.parameters.row("joint_2.theta")
    nominal = fit.problem.parameters[k].nominal

    assert (found["unit"], found["status"]) == ("rad", "identified")
    assert found["value"] == nominal + fit.values[k]
    assert found["sigma"] == fit.estimate.sigma[k]
    with pytest.raises(pincal.BadInputError, match=r"nearest first: joint_2\.theta"):
        fit.parameters.row("joint_2.thetta")


def test_residuals_are_reading_minus_prediction(
    table: pincal.Measurements,
    fit: pincal.FittedRobot,
) -> None:
    """Each row of ``fit.residuals`` is a reading minus ``fit.predict`` of its joints, in m."""
    found = fit.residuals.to_polars()
    left = found.select(f"calibrated_position_{axis} [m]" for axis in "xyz").to_numpy()
    expected = table.readings["position"] - fit.predict(table)[:, :, 3]

    assert found.columns[:2] == ["row", "outlier"]
    np.testing.assert_allclose(left, expected, rtol=0.0, atol=1e-12)
    assert found["nominal_position_x [m]"].std() > 5 * found["calibrated_position_x [m]"].std()
