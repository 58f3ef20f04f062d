"""The object that a user works with: the same methods on a fit and on the model read from its file."""

import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import pincal
from pincal.builtin import kuka_urdf_path
from pincal.model.augmented import pinocchio_model
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effects import GEOMETRIC
from pincal.model.model import Model
from pincal.simulate import Instrument, TrueMachine, plan_poses


@pytest.fixture(scope="module")
def fit() -> pincal.FittedRobot:
    """Return a fit of the KUKA to 60 positions of two targets."""
    rng = np.random.default_rng(3)
    machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0").draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
    q = plan_poses(machine.nominal, 60, rng)
    targets = {"near": (0.1, 0.0, 0.2), "far": (0.1, 0.0, 0.4)}
    columns = Instrument(targets=targets, sigma=5e-5).measure(machine, q, rng=rng)
    robot = pincal.Robot.from_urdf(kuka_urdf_path())
    rows = np.column_stack([columns[name] for name in robot.joint_names])
    position = np.column_stack([columns[axis] for axis in "xyz"])
    table = pincal.measurements_from_arrays(robot.joint_names, rows, position=position, target=columns["target"])
    return pincal.calibrate(robot, table, pincal.Options(effects=GEOMETRIC))


@pytest.fixture(params=["fit", "model", "file"])
def found(request: pytest.FixtureRequest, fit: pincal.FittedRobot, tmp_path: Path) -> pincal.FittedRobot:
    """Return the fit, its calibrated model, and the model read from its file."""
    if request.param == "fit":
        return fit
    if request.param == "model":
        return fit.at()
    fit.save(tmp_path / "model.json")
    return pincal.load_model(tmp_path / "model.json")


def test_prediction_is_the_models_at_joint_positions_and_at_conditions(
    found: pincal.FittedRobot, fit: pincal.FittedRobot
) -> None:
    """Joint positions of one pose or of many, by the name of the target, or the conditions of rows."""
    q = fit.model.chain.robot.random_configurations(5, np.random.default_rng(0))
    far = fit.model.chain.targets.index("far")
    conditions = Conditions(q, np.full(5, far), np.full(5, 20.0), np.zeros(3))
    expected = fit.model.predict(fit.model_values, conditions)

    poses, sigma = found.predict(q, target="far", payload=20.0, return_sigma=True)
    np.testing.assert_array_equal(poses, expected)
    np.testing.assert_array_equal(found.predict(conditions), expected)
    np.testing.assert_allclose(found.predict(q[2], target="far"), expected[2:3], rtol=0.0, atol=1e-15)
    np.testing.assert_array_equal(sigma, found.position_sigma(conditions))
    assert sigma.shape == (5, 3) and (sigma > 0.0).all()
    with pytest.raises(pincal.BadInputError, match=r"joint positions have shape \(2,\); expected \(N, 6\)"):
        found.predict([0.0, 1.0])
    with pytest.raises(pincal.BadInputError, match="target 'middle' is not in the model; expected one of far, near"):
        found.predict(q, target="middle")


def test_parameters_are_a_table_and_their_covariance_a_matrix(found: pincal.FittedRobot, fit: pincal.FittedRobot) -> None:
    """One row per parameter, in the order of the covariance, whose diagonal is the square of sigma."""
    table = found.parameters
    sigma = [row[4].value if row[4] is not None else None for row in table.rows]  # type: ignore[union-attr]

    assert [row[0] for row in table.rows] == [p.name for p in fit.problem.parameters]
    expected = np.sqrt(np.diag(found.covariance))
    for name, free, stated, size in zip(fit.estimate.names, fit.solution.free, sigma, expected, strict=True):
        assert not free or stated == pytest.approx(size, rel=1e-12), name


def test_exports_carry_the_calibrated_geometry(found: pincal.FittedRobot, fit: pincal.FittedRobot, tmp_path: Path) -> None:
    """Pinocchio's forward kinematics of the model and of the written URDF put the tip where the calibration does."""
    robot = fit.model.chain.robot
    export = found.export_urdf(tmp_path / "calibrated.urdf")
    q = robot.random_configurations(5, np.random.default_rng(0))
    rigid = Model(Chain.of(robot), GEOMETRIC)
    values = np.array([fit.estimate[name] for name in rigid.names])
    expected = rigid.predict(values, Conditions.at(q))[:, :, 3]

    assert (tmp_path / "calibrated.urdf").read_bytes() == export.text
    for model in (found.to_pinocchio(), pin.buildModelFromXML(export.text.decode())):
        data = model.createData()
        tip = model.getFrameId(export.tip)
        for row, place in zip(q, expected, strict=True):
            pin.framesForwardKinematics(model, data, row)
            np.testing.assert_allclose(data.oMf[tip].translation, place, rtol=0.0, atol=1e-9)


def test_it_introduces_itself_in_a_few_words(found: pincal.FittedRobot) -> None:
    """The repr fits a line, the summary a few, and a notebook shows the table of parameters."""
    assert "kuka_kr125_2" in repr(found) and len(repr(found)) < 120
    assert "kuka_kr125_2, 6 joints from" in found.summary() and len(found.summary().splitlines()) <= 4
    assert "<table" in found._repr_html_() and "joint_2.s_x" in found._repr_html_().replace("<wbr>", "")


def test_what_only_base_and_tool_explain_travels_with_the_file(fit: pincal.FittedRobot, tmp_path: Path) -> None:
    """The values with base and tool fitted alone come back to the last bit."""
    fit.save(tmp_path / "model.json")
    nominal = pincal.load_model(tmp_path / "model.json").nominal_values

    assert nominal is not None
    np.testing.assert_array_equal(nominal, fit.fit.nominal.values)


def test_names_of_the_last_release_still_work_with_a_warning(fit: pincal.FittedRobot) -> None:
    """They say by what they were replaced."""
    with pytest.warns(DeprecationWarning, match=r"pincal.calibrated_model_of is now pincal.FittedRobot.of"):
        model = pincal.calibrated_model_of(fit.fit, {"seed": 1})
    assert model.provenance == {"seed": 1}
    with pytest.warns(DeprecationWarning, match=r"pincal.calibrated_model is now pincal.model.augmented.pinocchio_model"):
        assert pincal.calibrated_model is pinocchio_model
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert pincal.FittedRobot.of(fit.fit).provenance == {}


def test_a_fit_of_several_stations_is_the_same_object(fit: pincal.FittedRobot) -> None:
    """Its parameters are one table, the robot is exported as one, and what is a station's is asked of that station."""
    table = fit.fit.station.sensor
    rows = np.arange(len(table)) < len(table) / 2
    q, position = fit.fit.station.conditions.q, table.position  # type: ignore[attr-defined]
    target = np.array(fit.model.chain.targets)[fit.fit.station.conditions.target]
    robot = fit.model.chain.robot
    east, west = (
        pincal.measurements_from_arrays(robot.joint_names, q[part], position=position[part], target=target[part])
        for part in (rows, ~rows)
    )
    two = pincal.calibrate(robot, {"east": east, "west": west}, pincal.Options(effects=GEOMETRIC))
    names = [row[0] for row in two.parameters.rows]

    assert names == [p.name for p in two.problem.parameters]
    assert {"east/base.x", "west/base.x", "joint_2.theta"} <= set(names) and "base.x" not in names
    assert "east: " in two.summary() and "west: " in two.summary()
    assert two.export_urdf().max_error_m < 1e-9
    assert two.to_pinocchio().nq == 6
    tips = (two.at(name).predict(q[:3], target="far")[:, :, 3] for name in ("east", "west"))
    np.testing.assert_allclose(next(tips), next(tips), rtol=0.0, atol=1e-3)  # both stand in the same place [m]
    with pytest.raises(pincal.BadInputError, match=r"there are 2: east, west; choose one: .* or fit.at\(NAME\) in Python"):
        two.predict(q)


def test_a_robot_of_a_file_with_one_station_is_used_as_its_model(fit: pincal.FittedRobot, tmp_path: Path) -> None:
    """It predicts the same, and is saved in the same bytes; names of 0.1.0 warn."""
    paths = [tmp_path / name for name in ("model.json", "again.json")]
    fit.save(paths[0])
    robot = pincal.load_model(paths[0])
    robot.save(paths[1])
    q = np.zeros(robot.at().model.chain.robot.n_joints)

    np.testing.assert_array_equal(robot.predict(q), pincal.load_model(paths[0]).predict(q))
    assert paths[0].read_bytes() == paths[1].read_bytes()
    with pytest.raises(pincal.BadInputError, match=r"holds no fit, as one from a file.* calibrate again from the table"):
        robot.problem  # noqa: B018
    with pytest.warns(DeprecationWarning, match=r"pincal.CalibratedStations is now pincal.FittedRobot"):
        assert isinstance(robot, pincal.CalibratedStations)
