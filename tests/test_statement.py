"""What a calibrated model states of itself, where it is kept, and who repeats it."""

import json
from pathlib import Path

import numpy as np
import pytest

from pincal import Options, Robot, load_model, measurements_from_arrays, run_calibration
from pincal.calibration.calibration import Calibration
from pincal.calibration.model_statement import ModelStatement
from pincal.cli import main
from pincal.export import export_model
from pincal.measure.table import write_table
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.validate.misfit import Verdict

NOISE = 2e-5


@pytest.fixture(scope="module")
def rippled() -> Calibration:
    """Return the calibration of a UR10 with a ripple of one drive that no model here has, its noise declared."""
    robot = Robot.from_urdf("ur10")
    rng = np.random.default_rng(5)
    q = rng.uniform(-1.5, 1.5, (90, 6))
    turned = q.copy()
    turned[:, 1] += 3e-4 * np.sin(7.0 * q[:, 1])
    place = Model(Chain.of(robot), ()).predict(np.zeros(0), Conditions.at(turned))[:, :, 3]
    rows = measurements_from_arrays(robot.joint_names, q, position=place + NOISE * rng.standard_normal((90, 3)))
    return run_calibration(robot, rows, Options(sigma=NOISE))


def test_a_statement_says_how_good_predictions_are(rippled: Calibration, tmp_path: Path) -> None:
    """The stated uncertainty here is that of the measured poses, and is kept with the model."""
    fit, result = rippled.fit, rippled.result
    assert fit.statement is not None and fit.statement.here is not None and fit.statement.anywhere is not None
    at = fit.problem.stations[0].conditions
    assert fit.statement.here == pytest.approx(np.sqrt(np.mean(fit.position_sigma(at) ** 2)), rel=1e-9)
    assert fit.statement.rests_on == "declared noise"
    assert result.to_dict()["uncertainty"]["here_mm"] == pytest.approx(2e3 * fit.statement.here)
    fit.save(tmp_path / "model.json")
    assert load_model(tmp_path / "model.json").statement == fit.statement


def test_errors_elsewhere_have_what_the_model_lacks(rippled: Calibration) -> None:
    """At random poses the expected length is at least that of the discrepancy alone."""
    lacks = rippled.fit.discrepancy
    assert lacks is not None
    assert rippled.result.elsewhere.mean_mm > 1e3 * np.sqrt(8.0 / np.pi) * lacks.factor * np.sqrt(lacks.rest)
    assert rippled.fit.statement is not None and "mm anywhere" in rippled.fit.statement.worth
    assert not ModelStatement(verdict=Verdict.ADEQUATE).worth


def test_a_doubt_is_repeated_once(rippled: Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A prediction says that the model is not adequate, and not more than once."""
    rippled.fit.save(tmp_path / "model.json")
    q = np.zeros((2, 6))
    write_table(tmp_path / "q.csv", dict(zip(rippled.robot.joint_names, q.T, strict=True)))
    with pytest.raises(SystemExit) as ended:
        main(["predict", str(tmp_path / "model.json"), str(tmp_path / "q.csv"), "--out", str(tmp_path / "p.csv")])
    assert ended.value.code == 0
    said = capsys.readouterr().err
    assert said.count("left a doubt") + said.count("not adequate") == 1
    assert json.loads((tmp_path / "model.json").read_text())["statement"]["verdict"] == "not adequate"


def test_what_nothing_shows_is_said() -> None:
    """Without a declared noise and without repeated poses, uncertainties rest on residuals, which users hear."""
    alone = ModelStatement(verdict=Verdict.NOT_JUDGED)
    assert any("rest on the residuals" in note for note in alone.notes())
    assert not list(ModelStatement(verdict=Verdict.ADEQUATE, rests_on="repeated poses").notes())
    assert "and 1 more" in next(ModelStatement(verdict=Verdict.NOT_ADEQUATE, doubts=("this", "that")).notes())


@pytest.mark.parametrize("name", ["python", "c", "page"])
def test_exports_state_what_the_calibration_did(rippled: Calibration, name: str, tmp_path: Path) -> None:
    """Source code and the page say how good predictions are, and the doubt, once."""
    statement = rippled.fit.statement
    assert statement is not None
    path = tmp_path / {"python": "arm.py", "c": "arm", "page": "arm.html"}[name]
    export_model(rippled.fit, name, path)
    texts = [part.read_text() for part in (path.glob("*") if path.is_dir() else [path])]
    for text in texts:
        assert f"{1e3 * 2.0 * statement.here:.4f} mm a coordinate at the poses of its calibration" in text
        assert text.count(next(statement.notes())[5:40]) >= 1
