"""A calibrated robot judged on new rows: whether the instrument moved, the error there, and whether it is the same robot."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from machines import kuka as true_kuka
from placed_arms import FIRST, MOVE, NOISE, measured, transform, written

from pincal import simulate as sim
from pincal.calibration.calibration import run_calibration
from pincal.calibration.checked_fit import calibrate
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.validation import validate_rows
from pincal.diagnosis.robot_diagnosis import diagnose
from pincal.errors import BadInputError
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements
from pincal.measure.table import read_measurements
from pincal.model.effect import Effect
from pincal.model.effects import ELASTIC, GEOMETRIC
from pincal.robot.robot import Robot
from pincal.simulate.paper_machine import PaperMachine
from pincal.validate.agreement import belongs_to_other_robot

AWAY = MOVE @ FIRST


def drawn(seed: int) -> sim.TrueMachine:
    """Return a machine of the type whose lengths are off by a millimetre and angles by a milliradian."""
    return true_kuka().draw_errors(np.random.default_rng(seed), sigma_length=1e-3, sigma_angle=1e-3)


@pytest.fixture(scope="module")
def machine() -> sim.TrueMachine:
    """Return the machine that is calibrated."""
    return drawn(4)


@pytest.fixture(scope="module")
def model(machine: sim.TrueMachine, kuka: Robot) -> FittedRobot:
    """Return its calibration at the first station."""
    return calibrate(kuka, measured(machine, kuka, poses=100), Options(effects=GEOMETRIC)).at()


def test_rows_of_the_same_station_stand_as_calibrated(machine: sim.TrueMachine, kuka: Robot, model: FittedRobot) -> None:
    """Nothing is fitted again where nothing calls for it."""
    found = validate_rows([model], measured(machine, kuka, seed=5))

    assert found.placed == "as calibrated" and found.moved.instrument == 0.0 and not found.found.any()
    assert found.misfit.p_value > 1e-3 and found.doubt == "" and found.model is model


def test_rows_that_were_fitted_are_not_called_held_out(
    machine: sim.TrueMachine, kuka: Robot, model: FittedRobot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They tell how well the model was fitted: said as diagnose says it, with the number of such rows."""
    fitted, new = measured(machine, kuka, poses=100), measured(machine, kuka, seed=5)
    found = validate_rows([model], fitted)
    assert found.fitted_rows == 100 and any("fitted to 100 of these 100 rows" in note.text for note in found.notes)
    assert validate_rows([model], new).fitted_rows == 0

    model.save(tmp_path / "model.json")
    assert run("validate", tmp_path / "model.json", written(tmp_path / "fitted.csv", fitted)) == 0
    told = capsys.readouterr()
    assert "held out" not in told.out and "fitted to 100 of these 100 rows" in " ".join(told.out.split())

    both = tmp_path / "fitted.csv", written(tmp_path / "new.csv", new)
    assert run("validate", tmp_path / "model.json", *both, "--json", "--quiet") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["mean_mm"] == found["stations"][1]["error"]["mean_mm"] and found["rows"]["test"] == len(new)
    assert run("validate", tmp_path / "model.json", *both) == 0
    assert f"never seen by the model: new: mean {found['mean_mm']:.4f} mm" in capsys.readouterr().out


@pytest.mark.parametrize("way", [2e-4, 5.0])
def test_a_moved_instrument_is_told(machine: sim.TrueMachine, kuka: Robot, model: FittedRobot, way: float) -> None:
    """A fifth of a millimetre or five metres: the place is found again, and the errors there are noise."""
    at = transform((0.0, 0.0, 0.0), (way, 0.0, 0.0)) @ FIRST
    found = validate_rows([model], measured(machine, kuka, seed=6, T_instrument_base=at, poses=100))

    assert found.placed == "refitted" and found.doubt == ""
    assert found.moved.instrument == pytest.approx(way, abs=2e-4)
    assert found.misfit.ratio < 1.2 and found.misfit.p_value > 1e-3


@pytest.mark.long
def test_many_changes_at_once_may_be_another_robot(machine: sim.TrueMachine, kuka: Robot, model: FittedRobot) -> None:
    """A diagnosis of another robot's rows asks whose they are."""
    found = diagnose(model, measured(drawn(5), kuka, poses=40)).found

    assert found.changed and len(found.changes) >= 4
    assert any("are of this robot" in note.text for note in found.warnings)


def altered(table: Measurements, change: str) -> Measurements:
    """Return a table of the robot with something changed."""
    q, names = table.q.copy(), list(table.joint_names)
    if change == "delayed":
        q[:, 2] = np.roll(q[:, 2], 1)
    if change == "offset":
        q[:, names.index("joint_2")] -= 1e-3
    if change == "swapped":
        q[:, [1, 2]] = q[:, [2, 1]]
    scale = 0.9 if change == "shorter" else 1.0
    return replace(table, q=q).with_readings(position=scale * table.position)


@pytest.mark.parametrize(
    ("change", "at"),
    [
        ("offset", AWAY),
        *(
            pytest.param(change, at, marks=pytest.mark.long)
            for change, at in [("swapped", AWAY), ("offset", FIRST), ("delayed", AWAY), ("shorter", AWAY)]
        ),
    ],
)
def test_a_robot_that_changed_is_doubted(
    machine: sim.TrueMachine, kuka: Robot, model: FittedRobot, change: str, at: np.ndarray
) -> None:
    """No place of the instrument explains a joint that stands elsewhere, a column that lags, or other lengths."""
    table = measured(machine, kuka, seed=7, T_instrument_base=at)

    doubt = validate_rows([model], altered(table, change)).doubt
    assert "times what noise and the uncertainty of the calibration allow" in doubt
    assert ("'joint_2' and 'joint_3' appear to be swapped" in doubt) == (change == "swapped")
    assert validate_rows([model], table).doubt == ""


def test_another_robot_of_the_type_is_doubted(kuka: Robot, model: FittedRobot) -> None:
    """Its errors are not those that were calibrated."""
    for seed in (5, 6, 7):
        assert validate_rows([model], measured(drawn(seed), kuka, T_instrument_base=AWAY)).doubt


def test_a_load_that_was_never_carried_hides_no_other_robot(kuka: Robot, model: FittedRobot) -> None:
    """A calibration that does no better than none is another robot's, with whatever load."""
    table = measured(drawn(5), kuka, T_instrument_base=AWAY)

    assert "nominal robot" in validate_rows([model], replace(table, payload=np.full(len(table), 20.0))).doubt


def test_the_demos_robot_is_known_again_and_another_is_not(kuka: Robot) -> None:
    """With the tracker elsewhere the elastic robot is right to the noise; another of its make is not."""
    other = true_kuka().draw_errors(np.random.default_rng(3), sigma_length=5e-4, sigma_angle=1e-3)
    first, again, stranger = (
        measured(machine, kuka, poses=rows, seed=seed, T_instrument_base=at)
        for machine, rows, seed, at in (
            (PaperMachine(), 200, 1, FIRST),
            (PaperMachine(), 40, 2, AWAY),
            (other, 40, 3, AWAY),
        )
    )
    options = Options(effects=ELASTIC, sigma=NOISE)
    model = calibrate(kuka, first, options).at()
    found, refused = validate_rows([model], again), validate_rows([model], stranger)

    assert found.placed == "refitted" and found.doubt == "" and np.linalg.norm(MOVE[:3, 3]) > 1.0
    assert np.linalg.norm(found.station.residuals(found.values), axis=0).mean() < 2.0 * NOISE
    assert "for any pose of instrument and target" in refused.doubt


def test_a_calibration_that_is_another_robots_does_no_good() -> None:
    """Rows off by e + a of the correction d, with e across d, are another robot's from a = 1/2 on, if d is large enough."""
    d, e = np.tile([1e-3, 0.0, 0.0], (50, 1)), np.tile([0.0, 3e-4, 0.0], (50, 1))

    assert belongs_to_other_robot(e + 0.6 * d, e - 0.4 * d, allowed=3e-4)
    assert not belongs_to_other_robot(e + 0.4 * d, e - 0.6 * d, allowed=3e-4)
    assert not belongs_to_other_robot(e + 0.6 * d, e - 0.4 * d, allowed=6e-4)


def test_rows_that_are_too_few_to_place(machine: sim.TrueMachine, kuka: Robot, model: FittedRobot) -> None:
    """They are judged where the instrument was, unless they can't be from there."""
    here, away = (measured(machine, kuka, poses=2, T_instrument_base=at) for at in (FIRST, AWAY))

    assert validate_rows([model], here).placed == "as calibrated"
    with pytest.raises(BadInputError, match=r"2 position measurements; .* as calibrated, their mean error is \d+ mm"):
        validate_rows([model], away)


def test_the_nearest_station_is_taken(machine: sim.TrueMachine, kuka: Robot) -> None:
    """Of a robot calibrated at two stations the one that the rows are of; one that is chosen stays."""
    tables = {name: measured(machine, kuka, seed=k, poses=80, T_instrument_base=at) for k, (name, at) in enumerate(ENDS)}
    monday, tuesday = calibrate(kuka, tables, Options(effects=GEOMETRIC)).each
    rows = measured(machine, kuka, seed=9, T_instrument_base=AWAY)
    found = validate_rows([monday, tuesday], rows)

    assert found.placed == "as calibrated" and found.model is tuesday
    forced = validate_rows([monday], rows, refit=False)
    assert forced.placed == "as calibrated" and "fit a different pose" in forced.notes[0].text and forced.doubt == ""


ENDS = (("monday", FIRST), ("tuesday", AWAY))


def test_the_command_tells_places_and_exits(
    machine: sim.TrueMachine, kuka: Robot, model: FittedRobot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two tables are two stations; the JSON is that of the contract; a robot that changed ends with 6 and the next step."""
    model.save(tmp_path / "model.json")
    here = written(tmp_path / "here.csv", measured(machine, kuka, seed=5))
    away = written(tmp_path / "away.csv", measured(machine, kuka, seed=6, T_instrument_base=AWAY))
    bent = written(tmp_path / "bent.csv", altered(measured(machine, kuka, seed=6, T_instrument_base=AWAY), "offset"))

    assert run("validate", tmp_path / "model.json", here, away, "--json", "--quiet") == 0
    found = json.loads(capsys.readouterr().out)
    assert [(part["name"], part["placed"]) for part in found["stations"]] == [
        ("here", "as calibrated"),
        ("away", "refitted"),
    ]
    assert found["stations"][1]["moved_mm"] == pytest.approx(1300.0, abs=0.3)
    assert found["stations"][1]["turned_mrad"] == pytest.approx(301.0, abs=2.0)
    assert found["mean_mm"] < 0.12 and found["stations"][1]["error"]["mean_mm"] < 0.12

    assert run("validate", tmp_path / "model.json", away) == 0
    assert "located again from these rows: the instrument moved by 1300 mm" in capsys.readouterr().out
    assert run("validate", tmp_path / "model.json", here, bent, "--max-error", "1um") == 6
    told = capsys.readouterr()
    assert "bent.csv: mean error" in told.err and "pincal diagnose" in told.err and "calibrated" in told.out
    assert run("validate", tmp_path / "model.json", here, "--station", "noon") == 3


def test_what_a_calibration_left_open_is_repeated(
    machine: sim.TrueMachine, kuka: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rows that bear out what a model states do not make it complete: its own doubt stands beside their verdict."""
    table = measured(machine, kuka, seed=7)
    run_calibration(kuka, table, Options(effects=GEOMETRIC, sigma=5e-6)).fit.save(tmp_path / "model.json")
    assert run("validate", tmp_path / "model.json", written(tmp_path / "new.csv", measured(machine, kuka, seed=8))) == 0
    assert "note: the calibration of this model left a doubt: the residuals are" in " ".join(capsys.readouterr().err.split())


@pytest.mark.long
@pytest.mark.rates
def test_false_alarms_are_rare(kuka: Robot) -> None:
    """Over 300 calibrations and tables none is doubted, and hardly one of the same place is placed again."""
    moved, doubts = 0, 0
    rng = np.random.default_rng(0)
    for k in range(300):
        machine = drawn(100 + k)
        fit = calibrate(kuka, measured(machine, kuka, poses=int(rng.integers(30, 120)), seed=k), Options(effects=GEOMETRIC))
        for at in (FIRST, AWAY):
            table = measured(machine, kuka, poses=int(rng.integers(6, 60)), seed=1000 + k, T_instrument_base=at)
            found = validate_rows([fit.at()], table)
            moved += found.placed == "refitted" and at is FIRST
            doubts += bool(found.doubt)
            assert found.placed == "refitted" or at is FIRST
    assert moved <= 2 and doubts == 0


@pytest.mark.long
@pytest.mark.parametrize("effects", [pytest.param(GEOMETRIC, marks=pytest.mark.rates), ELASTIC])
def test_a_real_robot_of_another_month_is_the_same(shared_data: Path, effects: tuple[Effect, ...]) -> None:
    """Calibrated on series A, the UR10 of series B is found elsewhere, blocks of A where they were; a UR5 is doubted."""
    robot = Robot.from_urdf("ur10")
    series = {name: read_measurements(shared_data / "ur10_tmac" / f"series_{name}.csv", robot.joint_names) for name in "AB"}
    model = calibrate(robot, series["A"].select(slice(None, None, 4)), Options(effects=effects)).at()

    for rows in (slice(0, 12), slice(0, 100), slice(None)):
        found = validate_rows([model], series["B"].select(rows))
        assert found.placed == "refitted" and found.doubt == ""
    for start in range(0, 11000, 2200):
        for count in (12, 30, 100, 400):
            found = validate_rows([model], series["A"].select(slice(start, start + count)))
            assert found.placed == "as calibrated" and found.doubt == ""
    other = read_measurements(shared_data / "ur5_tracker" / "grid.csv", robot.joint_names)
    assert validate_rows([model], other).doubt
