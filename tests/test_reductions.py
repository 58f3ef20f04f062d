"""Reductions over what may be nothing: rows, readings and times of a fit and of a motion, a test for each kind."""

from __future__ import annotations

import numpy as np
import pytest

from pincal.builtin import kuka_urdf_path
from pincal.errors import BadInputError, MeasurementError
from pincal.identify.calibrate import fit_tables
from pincal.identify.equations import Linearised
from pincal.identify.fit import ModelFit
from pincal.identify.noise import Judge, Noise
from pincal.identify.options import Options
from pincal.identify.solve import Course, solve
from pincal.identify.split import cross_validate
from pincal.measure.clock_jump import likeliest_jump
from pincal.measure.measurements import Measurements, measurements_from_arrays
from pincal.model.effects import GEOMETRIC
from pincal.motion.clocks import Clock, aligned
from pincal.robot.robot import Robot

ROBOT = Robot.from_urdf(kuka_urdf_path())
OPTIONS = Options(effects=GEOMETRIC)
ROWS = 60


@pytest.fixture(scope="module")
def table() -> Measurements:
    """Return a sound table."""
    rng = np.random.default_rng(0)
    q = ROBOT.random_configurations(ROWS, rng)
    position = ROBOT.forward_kinematics(q)[:, :3, 3] + 1e-4 * rng.standard_normal((ROWS, 3))
    return measurements_from_arrays(ROBOT.joint_names, q, position=position)


@pytest.fixture(scope="module")
def fit(table: Measurements) -> ModelFit:
    """Return its fit."""
    return fit_tables(ROBOT, table, OPTIONS)


def test_no_fit_is_left_without_rows(fit: ModelFit) -> None:
    """However small the noise by which rows are judged, the nearer half of a station's rows is no outlier."""
    free = fit.solution.free
    point = Linearised(fit.problem, fit.values, free, np.ones(ROWS), fit.priors.sizes)
    weights = Judge(fit.problem, free, Noise((1e-9,)), "screen").weights(point, np.array([1e-9]), hard=True)
    squares = point.row_squares[0][0]

    assert weights.sum() == ROWS / 2
    assert squares[weights > 0.0].max() <= squares[weights == 0.0].min()


def test_a_fit_to_nothing_ends(fit: ModelFit) -> None:
    """Robust weights of no rows have settled; values are those of the priors."""
    nothing = fit.problem.select(np.zeros(ROWS, bool))
    frames = fit.nominal.free
    found = solve(nothing, fit.values, frames & False, fit.priors, fit.noise, Course("screen"))
    np.testing.assert_array_equal(found.values, fit.values)


def test_a_table_without_rows_is_not_cross_validated(table: Measurements) -> None:
    """There is nothing to leave out."""
    with pytest.raises(BadInputError, match="no rows; expected some to leave out"):
        cross_validate(ROBOT, table.select(np.zeros(ROWS, bool)), OPTIONS)


def test_a_clock_of_no_readings_does_not_jump() -> None:
    """Neither where there are no readings, nor where none moves."""
    empty = np.zeros((0, 3))
    assert not likeliest_jump(np.zeros(0), empty, empty, lambda steps: steps).is_sure(0.0)
    time = np.arange(400.0)
    still = np.zeros((400, 3))
    assert not likeliest_jump(time, still, still, lambda steps: steps).is_sure(0.0)


def test_readings_that_no_joints_accompany_are_refused() -> None:
    """Joints may have been logged before and after them only; which log it is, is said."""
    time = np.arange(0.0, 60.0, 0.1)
    with pytest.raises(MeasurementError, match=r"tracker\.csv: no reading lies where the joints were logged"):
        aligned(
            time,
            np.sin(time)[:, None],
            lambda at, _: np.sin(at)[:, None],
            lambda at: np.zeros(len(at), bool),
            Clock(0.0),
            source="tracker.csv",
        )
