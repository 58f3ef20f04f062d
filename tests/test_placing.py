"""A calibrated robot at a new station: where things stand is found again, the robot stays as it was calibrated."""

from dataclasses import replace

import numpy as np
import pytest
from placed_arms import FIRST, MOVE, NOISE, TOOL, measured, transform
from scipy.spatial.transform import Rotation

from pincal import simulate as sim
from pincal.calibration.checked_fit import calibrate
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.placing import place_station
from pincal.errors import BadInputError, MeasurementError
from pincal.identify.options import Options
from pincal.measure.measurements import measurements_from_arrays
from pincal.model.catalogue import BaseDrift
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot
from pincal.validate.accuracy import error_summary


@pytest.fixture(scope="module")
def fit(machine: sim.TrueMachine, kuka: Robot) -> FittedRobot:
    """Return the machine's calibration at its first station, whose base seemed to drift."""
    table = measured(machine, kuka, poses=100, time=np.linspace(0.0, 3600.0, 100))
    return calibrate(kuka, table, Options(effects=(*GEOMETRIC, BaseDrift.over(table.time))))


def test_a_known_move_is_found(machine: sim.TrueMachine, kuka: Robot, fit: FittedRobot) -> None:
    """Instrument and target moved by known ways: these are found, and what is left is noise; old drift is not asked for."""
    tool = TOOL + np.array([0.0, 0.02, 0.0])
    table = measured(machine, kuka, T_instrument_base=MOVE @ FIRST, tool=tool, seed=7)
    found = place_station(fit, table)

    assert found.moved.instrument == pytest.approx(1.3, abs=3e-4)
    assert found.moved.turned == pytest.approx(Rotation.from_matrix(MOVE[:3, :3]).magnitude(), abs=1e-4)
    assert found.moved.target == pytest.approx(0.02, abs=2e-4)
    assert found.misfit.p_value > 0.01 and found.misfit.found == 9
    assert error_summary(found.station, found.values)["mean_mm"] < 0.12


def test_moves_are_known_as_they_say(machine: sim.TrueMachine, kuka: Robot, fit: FittedRobot) -> None:
    """Instrument and target are found where they were moved to within what is stated of this, over twelve draws of rows."""
    tool = TOOL + np.array([0.0, 0.02, 0.0])
    true = np.array([1.3, Rotation.from_matrix(MOVE[:3, :3]).magnitude(), 0.02])
    off = []
    for seed in range(12):
        rows = measured(machine, kuka, poses=12, T_instrument_base=MOVE @ FIRST, tool=tool, seed=60 + seed)
        found = place_station(fit, rows).moved
        expanded = np.array([found.instrument_U, found.turned_U, found.target_U])
        off.append((np.array([found.instrument, found.turned, found.target]) - true) / (0.5 * expanded))

    assert (np.sqrt(np.mean(np.square(off), axis=0)) < 1.7).all()
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.4


def test_what_stood_still_may_have_moved_by_its_uncertainty(kuka: Robot, fit: FittedRobot) -> None:
    """A set-up that is where it was, to the last digit, is known no better than one that moved; it is not said to have."""
    q = kuka.random_configurations(40, np.random.default_rng(5))
    same = measurements_from_arrays(kuka.joint_names, q, position=fit.predict(q)[:, :, 3])
    found = place_station(fit, same).moved

    assert 1e-5 < found.target_U < 1e-4 and found.target < 0.1 * found.target_U
    assert "the target moved by less than can be told" in str(found)


def test_it_predicts_in_the_new_frame_within_its_uncertainty(
    machine: sim.TrueMachine, kuka: Robot, fit: FittedRobot
) -> None:
    """Predictions elsewhere, from ten rows, are off by what the placed model says of itself."""
    off = []
    for seed in range(8):
        few = measured(machine, kuka, poses=10, T_instrument_base=MOVE @ FIRST, seed=20 + seed)
        q = kuka.random_configurations(50, np.random.default_rng(seed))
        tip = MOVE @ FIRST @ machine.equilibrium(machine.poses(q)).tip
        poses, sigma = place_station(fit, few).model.predict(q, return_sigma=True)
        off.append((poses[:, :, 3] - tip[:, :3, :3] @ TOOL - tip[:, :3, 3]) / sigma)

    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_outliers_have_no_say(machine: sim.TrueMachine, kuka: Robot, fit: FittedRobot) -> None:
    """Three wrong readings of forty are left out and named by their weight."""
    table = measured(machine, kuka, T_instrument_base=MOVE @ FIRST)
    wrong = np.zeros((40, 3))
    wrong[[3, 11, 30]] = [[0.02, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 3.0]]
    found = place_station(fit, table.with_readings(position=table.position + wrong))

    assert np.flatnonzero(found.solution.weights == 0.0).tolist() == [3, 11, 30]
    assert found.moved.instrument == pytest.approx(1.3, abs=3e-4)


def test_another_instrument_can_be_placed(machine: sim.TrueMachine, kuka: Robot, fit: FittedRobot) -> None:
    """Distances see where the instrument is, not how it is turned."""
    table = measured(machine, kuka, poses=60, T_instrument_base=MOVE @ FIRST, kind="distance")
    found = place_station(fit, table)

    assert found.moved.instrument == pytest.approx(1.3, abs=1e-3) and found.moved.turned is None
    assert found.model.sensor_kind == "distance" and found.misfit.p_value > 0.01


def test_too_few_or_too_similar_rows_are_refused(machine: sim.TrueMachine, kuka: Robot, fit: FittedRobot) -> None:
    """Nine unknowns take four rows, and poses in which the tool turns."""
    with pytest.raises(MeasurementError, match="3 position measurements; expected at least 4 to determine the poses"):
        place_station(fit, measured(machine, kuka, poses=3))
    with pytest.raises(BadInputError, match="12 rows do not determine the pose of instrument and target"):
        place_station(fit, measured(machine, kuka, poses=12, turn=1e-3))


def test_a_station_of_several_can_be_placed(machine: sim.TrueMachine, kuka: Robot) -> None:
    """A robot calibrated at two stations goes to a third; the first tells how far it is."""
    tables = {
        "monday": measured(machine, kuka, poses=80, seed=2),
        "tuesday": measured(machine, kuka, poses=80, seed=3, T_instrument_base=transform((0.0, 0.0, 1.0), (1.0, 1.0, 0.0))),
    }
    stations = calibrate(kuka, tables, Options(effects=GEOMETRIC))
    found = place_station(stations.at("monday"), measured(machine, kuka, seed=4, T_instrument_base=MOVE @ FIRST))

    assert found.moved.instrument == pytest.approx(1.3, abs=3e-4) and found.misfit.p_value > 0.01


@pytest.mark.long
@pytest.mark.rates
def test_the_misfit_follows_chi_square(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Over calibrations from few rows, with a large uncertainty of their own, p values are uniform and the ratio is 1."""
    fits = [
        calibrate(kuka, measured(machine, kuka, poses=30, seed=1000 + k), Options(effects=GEOMETRIC, sigma=NOISE))
        for k in range(25)
    ]
    found = [
        place_station(fits[k % 25], measured(machine, kuka, poses=15, seed=k, T_instrument_base=MOVE @ FIRST)).misfit
        for k in range(200)
    ]
    p = np.array([each.p_value for each in found])

    assert abs(p.mean() - 0.5) < 0.08 and np.mean(p < 0.01) < 0.03
    assert np.mean([each.plain / each.expected for each in found]) == pytest.approx(1.0, abs=0.1)


def test_rows_of_their_own_noise_are_judged_by_it(machine: sim.TrueMachine, kuka: Robot, fit: FittedRobot) -> None:
    """A coarser instrument that declares its noise is no sign of a changed robot."""
    table = measured(machine, kuka, poses=60, T_instrument_base=MOVE @ FIRST)
    rough = table.position + np.random.default_rng(0).normal(0.0, 1e-3, (60, 3))
    declared = replace(table.with_readings(position=rough), sigma=np.full(60, 1e-3))

    assert place_station(fit, declared).misfit.p_value > 0.01
    assert place_station(fit, table.with_readings(position=rough)).misfit.ratio > 5.0
