"""Several stations in one model file: it predicts at each what the fit does, and is refused where it is damaged."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

import pincal
from pincal.builtin import kuka_urdf_path
from pincal.calibration.fitted_robot import load_model
from pincal.errors import ModelFileError
from pincal.model.effects import GEOMETRIC
from pincal.schemas import shipped
from pincal.simulate import Instrument, TrueMachine, plan_poses

BASE = np.array([[0.0, -1.0, 0.0, 2.0], [1.0, 0.0, 0.0, 0.5], [0.0, 0.0, 1.0, -0.3], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def fit() -> pincal.FittedRobot:
    """Return a fit of a tracker in two places, in the second one reading poses of another target."""
    rng = np.random.default_rng(3)
    robot = pincal.Robot.from_urdf(kuka_urdf_path())
    machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    tables = {}
    for name, reads, pose in (("east", "position", np.eye(4)), ("west", "pose", BASE)):
        q = plan_poses(machine.nominal, 40, rng)
        tracker = Instrument(reads=reads, pose=pose, targets=(0.1, 0.0, 0.2), sigma=5e-5, sigma_angle=5e-5)
        columns = tracker.measure(machine, q, rng=rng)
        readings: dict[str, Any] = {"position": np.column_stack([columns[axis] for axis in "xyz"])}
        if reads == "pose":
            readings["quaternion"] = np.column_stack([columns[axis] for axis in ("qx", "qy", "qz", "qw")])
        tables[name] = pincal.measurements_from_arrays(robot.joint_names, q, **readings)
    return pincal.calibrate(robot, tables, pincal.Options(effects=GEOMETRIC))


@pytest.fixture
def path(fit: pincal.FittedRobot, tmp_path: Path) -> Path:
    """Return its file."""
    fit.save(tmp_path / "model.json")
    return tmp_path / "model.json"


def test_each_station_predicts_what_the_fit_does(fit: pincal.FittedRobot, path: Path) -> None:
    """From the file as from the fit: poses, their uncertainty, names, ranges and provenance."""
    again = load_model(path)
    assert again.names == ("east", "west")
    for station, places in zip(fit.problem.stations, fit.problem.places, strict=True):
        model, read = fit.at(station.name), again.at(station.name)
        poses = station.model.predict(station.split(fit.values[places])[0], station.conditions)

        np.testing.assert_array_equal(model.predict(station.conditions), poses)
        np.testing.assert_array_equal(read.predict(station.conditions), poses)
        np.testing.assert_array_equal(read.position_sigma(station.conditions), model.position_sigma(station.conditions))
        assert read.estimate.parameters == station.parameters
        assert read.sensor_kind == station.sensor.kind
        assert read.outside(station.conditions) == []


def test_uncertainty_of_a_station_is_that_of_the_joint_covariance(fit: pincal.FittedRobot) -> None:
    """J C J^T with the columns of the station's own parameters and the robot's, by the dense covariance of all."""
    station, places = fit.problem.stations[1], fit.problem.places[1]
    rows = station.conditions.select(np.arange(3))
    own = station.model.own(places)
    C = fit.estimate.dense_covariance()[np.ix_(own, own)]
    _, J = station.model.linearise(fit.values[own], rows)

    expected = np.sqrt(np.einsum("nip,pq,niq->ni", J, C, J))
    np.testing.assert_allclose(fit.at("west").position_sigma(rows), expected, rtol=1e-9)


def test_the_file_is_valid_and_refused_where_damaged(path: Path) -> None:
    """By the shipped schema; a parameter that is missing and a group beyond the fitted ones are named."""
    contents = json.loads(path.read_text())
    jsonschema.validate(contents, json.loads(shipped("model").read_text()))
    for edit, words in (
        (lambda c: c["stations"][1].pop("sensor_kind"), r"stations\[1\]\.sensor_kind: is missing"),
        (lambda c: c["covariance"]["groups"][0]["parameters"].__setitem__(0, 999), r"groups\[0\]\.parameters: has an entry"),
        (lambda c: c["parameters"][0].__setitem__("name", "red"), "parameters: are not those of the effects"),
        (lambda c: c["values"].pop(), r"values: has shape"),
        (lambda c: c.__setitem__("format_version", 4), "written by a newer pincal"),
    ):
        damaged = json.loads(path.read_text())
        edit(damaged)  # type: ignore[no-untyped-call]
        path.write_text(json.dumps(damaged))
        with pytest.raises(ModelFileError, match=words):
            load_model(path)
        path.write_text(json.dumps(contents))


def test_a_station_has_to_be_chosen_to_predict(fit: pincal.FittedRobot, path: Path) -> None:
    """One model to predict with is that of a station; the message names them."""
    with pytest.raises(pincal.BadInputError, match="2: east, west; choose one"):
        pincal.load_model(path).predict(np.zeros(6))
    with pytest.raises(pincal.BadInputError, match="2: east, west; choose one"):
        fit.predict(np.zeros(6))
    with pytest.raises(pincal.BadInputError, match="station 'north' is not in the model; expected one of east, west"):
        fit.at("north")
