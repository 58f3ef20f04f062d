"""What belongs to the day of a calibration keeps no model from another day: the robot's part is given, and sigma says so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pincal
from pincal import ELASTIC, GEOMETRIC, Conditions, Measurements, Options, Robot
from pincal.calibration.placing import place_station
from pincal.calibration.validation import validate_rows
from pincal.errors import BadInputError
from pincal.measure.table import write_table
from pincal.model.catalogue.environment import BaseDrift, MeasurementScale, ThermalExpansion
from pincal.model.chain import Chain
from pincal.model.effect import Effect
from pincal.model.model import Model
from pincal.validate.misfit import Verdict

# Growth of steel [1/K], and a drift of half a millimetre in the course of the calibration [m/s].
ALPHA, DRIFT, HOUR = 1.2e-5, 1e-7, 3600.0


@pytest.fixture(scope="module")
def robot() -> Robot:
    """Return an arm."""
    return Robot.from_urdf("ur10")


def measured(robot: Robot, n: int, *, seed: int, shift: float = 0.0, days: bool = True) -> Measurements:
    """Return rows of a machine that grows with temperature and creeps with time, the instrument anywhere."""
    rng = np.random.default_rng(seed)
    truth = Model(Chain.of(robot), (BaseDrift(), ThermalExpansion()))
    values = np.zeros(truth.n_parameters)
    values[truth.index("base.x_t")], values[truth.index("arm.alpha_T")] = DRIFT, ALPHA
    q = robot.random_configurations(n, rng)
    warm, time = rng.uniform(20.0, 30.0, n), rng.uniform(0.0, HOUR, n)
    poses = truth.predict(values, replace(Conditions.at(q), temperature=warm, time=time))
    position = poses[:, :, 3] + poses[:, :, :3] @ [0.1, 0.05, 0.2] + shift + 1e-5 * rng.standard_normal((n, 3))
    columns = {"temperature": warm, "time": time} if days else {}
    return pincal.measurements_from_arrays(robot.joint_names, q, position=position, **columns)


def calibrated(robot: Robot, *effects: Effect) -> pincal.FittedRobot:
    """Return the robot as it was calibrated, with what it shows of the day."""
    return pincal.calibrate(robot, measured(robot, 150, seed=0), Options(effects=(*ELASTIC, *effects))).at()


@pytest.fixture(scope="module")
def model(robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> pincal.FittedRobot:
    """Return a model from a file whose robot grows with the day's temperature and drifts with its time."""
    path: Path = tmp_path_factory.mktemp("day") / "model.json"
    calibrated(robot, BaseDrift.over(np.array([0.0, HOUR])), ThermalExpansion()).save(path)
    return pincal.load_model(path)


def test_a_prediction_without_the_day_is_that_of_its_mean(robot: Robot, model: pincal.FittedRobot) -> None:
    """Sigma holds as much as growth and drift varied over the calibration's rows, by their closed forms."""
    days = model.covered.days
    q = robot.random_configurations(20, np.random.default_rng(3))
    bare = model.conditions_at(q)
    means = replace(bare, **{name: np.full(20, mean) for name, (mean, _) in days.items()})

    np.testing.assert_allclose(model.predict(bare), model.predict(means), atol=1e-12)
    added = model.position_sigma(bare) ** 2 - model.position_sigma(means) ** 2
    _, J = model.model.linearise(model.model_values, means)
    growth = J[:, :, model.model.index("arm.alpha_T")] * model.estimate["arm.alpha_T"] / (days["temperature"][0] - 20.0)
    drift = np.array([model.estimate[f"base.{s}_t"] for s in "xyz"]) * days["time"][1]
    plain = (growth * days["temperature"][1]) ** 2 + drift**2
    # The base also turns a little with time, which the closed form of the shift leaves out.
    np.testing.assert_allclose(added.sum(axis=1), plain.sum(axis=1), rtol=0.1)


def test_rows_of_another_day_are_judged_without_its_columns(robot: Robot, model: pincal.FittedRobot) -> None:
    """Placed, validated and diagnosed as the robot that they are of: each absence is said once, and no change is found."""
    new = measured(robot, 40, seed=1, shift=0.3, days=False)
    placed = place_station(model, new)
    found = pincal.diagnose(model, new)

    assert [note.split(" of ")[0].split(" is ")[0] for note in placed.notes] == ["base_drift", "thermal_expansion"]
    assert placed.model.sigma[0] > 2.0 * model.sigma[0]
    assert placed.notes == validate_rows([model], new).of_day
    # What is only said speaks against nothing.
    assert validate_rows([model], replace(new, sigma=np.full(40, 1e-5))).verdict is Verdict.ADEQUATE
    assert not found.changed and set(placed.notes) <= set(map(str, found.found.warnings))
    assert pincal.update(model, new).covered.days["temperature"] == pytest.approx(model.covered.days["temperature"])


def test_the_scale_of_another_instrument_is_not_taken_along(robot: Robot) -> None:
    """It belongs to the instrument: left out at a new place, said, and sigma is wider by what it did to these poses."""
    model = calibrated(robot, MeasurementScale())
    is_scale = np.array(model.estimate.names) == "instrument.scale"
    scale = replace(model.estimate, values=np.where(is_scale, 1e-4, model.values))
    new = measured(robot, 40, seed=1, shift=0.3)
    placed = place_station(replace(model, estimate=scale), new)

    assert "measurement_scale" in placed.notes[0] and len(placed.notes) == 1
    # 1e-4 of about a metre about the middle of the poses, per axis.
    assert 3e-5 < np.sqrt(placed.model.sigma[0] ** 2 - model.sigma[0] ** 2) < 1e-4


def test_directions_of_approach_are_still_asked_for(robot: Robot) -> None:
    """How a pose was reached is the pose's own, not the day's: the robot's part can't be told without it."""
    from pincal.model.catalogue.drives import Backlash

    rows = measured(robot, 60, seed=0)
    sides = np.random.default_rng(0).choice([-1, 1], rows.q.shape)
    fit = pincal.calibrate(robot, replace(rows, approach=sides), Options(effects=(*ELASTIC, Backlash("elbow_joint"))))
    with pytest.raises(BadInputError, match="backlash needs the column approach_elbow_joint"):
        fit.predict(rows.q)


def test_a_model_of_rows_in_order_is_read_again(robot: Robot, tmp_path: Path) -> None:
    """Their times tell how each joint moved before, of which the file has a mean and a spread like those of the times."""
    rows = measured(robot, 60, seed=4)
    assert rows.time is not None and rows.position is not None
    columns = {"time": rows.time} | dict(zip((*robot.joint_names, *"xyz"), (*rows.q.T, *rows.position.T), strict=True))
    write_table(tmp_path / "rows.csv", columns)
    table = pincal.read_measurements(tmp_path / "rows.csv", robot.joint_names)
    fit = pincal.calibrate(robot, table, Options(effects=GEOMETRIC))
    fit.save(tmp_path / "model.json")

    assert table.move is not None and np.any(table.move)
    assert pincal.load_model(tmp_path / "model.json").covered.days == fit.at().covered.days
    assert set(fit.at().covered.days) == {"time", "move"}
