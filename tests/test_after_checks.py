"""What interim checks mean elsewhere: measure refuses or widens, predict and exports say it, certificates show it."""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import feature_cases as cases
import msgspec
import numpy as np
import pytest
from command_line import run
from test_certificate import RESULT
from test_interim import arm, five_days, write
from test_measure import part_in, seen_panel, write_readings

from pincal import FittedRobot
from pincal.calibration.check_record import ALARM, CheckedChange, CheckRecord, model_mark

DRIFT = 2e-4  # [m]


def record_for(fitted: FittedRobot, *, alarm: bool = False, drift: float = DRIFT) -> CheckRecord:
    """Return a record of another robot's checks as if they were of this one."""
    change = CheckedChange(what="joint_3", since="2026-01-06", joint="joint_3")
    facts = {"verdict": ALARM, "change": change} if alarm else {}
    check = msgspec.structs.replace(five_days().record.checks[-1], drift=drift, **facts)
    return CheckRecord(model=model_mark(fitted), robot="arm", checks=(check,))


@pytest.fixture
def words(tmp_path: Path) -> Iterator[list[str]]:
    """Yield a command that measures a part with a robot that may have a record."""
    robot, rng = cases.robot_with("camera_point"), np.random.default_rng(0)
    robot.save(tmp_path / "model.json", provenance={})
    write_readings(tmp_path / "readings.csv", seen_panel(robot, rng, noise=1e-5))
    model, readings = str(tmp_path / "model.json"), str(tmp_path / "readings.csv")
    yield ["measure", model, readings, "--features", str(part_in(tmp_path)), "--out", str(tmp_path / "out")]


def budget_of(folder: Path) -> dict[str, float]:
    """Return the standard uncertainties of what was measured [mm]."""
    found = json.loads((folder / "out" / "measured.json").read_text())
    return {line["source"]: line["u"] for line in found["budget"]}


def test_a_part_is_not_measured_after_an_alarm(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 3 with what to do, and no folder; the user may know better, and a doubt says so."""
    record_for(cases.robot_with("camera_point"), alarm=True).save(tmp_path / "model.checks.json")
    assert run(*words) == 3
    said = capsys.readouterr().err
    assert "raised an alarm (joint_3 moved)" in said and "--despite-check" in said
    assert not (tmp_path / "out").exists()
    assert run(*words, "--despite-check") in (0, 5)
    warnings = json.loads((tmp_path / "out" / "measured.json").read_text())["warnings"]
    assert any(one["severity"] == "doubt" and "raised an alarm" in one["text"] for one in warnings)


def test_the_drift_since_is_a_line_of_the_budget(words: list[str], tmp_path: Path) -> None:
    """As if it were stated; the larger of both counts, and it widens U."""
    run(*words)
    before = budget_of(tmp_path)
    assert "drift" not in before
    run(*words, "--drift", "0.2mm")
    stated = budget_of(tmp_path)
    record_for(cases.robot_with("camera_point")).save(tmp_path / "model.checks.json")
    run(*words)
    assert budget_of(tmp_path) == stated and stated["drift"] > 0.0
    run(*words, "--drift", "0.1mm")
    assert budget_of(tmp_path) == stated
    run(*words, "--drift", "0.4mm")
    # Not exactly twice as much: features are fitted with other weights.
    assert 1.5 * stated["drift"] < budget_of(tmp_path)["drift"] < 3.0 * stated["drift"]


def test_the_record_of_another_model_counts_for_nothing(words: list[str], tmp_path: Path) -> None:
    """A calibration into the same folder makes it another; a note says so."""
    record = msgspec.structs.replace(record_for(cases.robot_with("camera_point"), alarm=True), model="0" * 64)
    record.save(tmp_path / "model.checks.json")
    assert run(*words) in (0, 5)
    warnings = json.loads((tmp_path / "out" / "measured.json").read_text())["warnings"]
    assert any("of another calibration" in one["text"] for one in warnings)
    assert "drift" not in budget_of(tmp_path)


def test_a_record_that_is_named_has_to_be_there(words: list[str], tmp_path: Path) -> None:
    """It is that of --record."""
    record_for(cases.robot_with("camera_point")).save(tmp_path / "r.json")
    assert run(*words, "--checks", str(tmp_path / "r.json")) in (0, 5)
    assert "drift" in budget_of(tmp_path)
    assert run(*words, "--checks", str(tmp_path / "none.json")) == 3
    (tmp_path / "model.checks.json").write_text("{}")
    assert run(*words) == 3


@pytest.mark.parametrize("alarm", [False, True])
def test_predictions_and_exports_say_it_once(alarm: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They go on, whatever the last check found."""
    model = tmp_path / "model.json"
    arm().fitted.save(model)
    record_for(arm().fitted, alarm=alarm).save(tmp_path / "model.checks.json")
    write(arm().table(), tmp_path / "poses.csv")
    table = [str(tmp_path / "poses.csv"), "--out", str(tmp_path / "out.csv")]
    for command in (["predict", str(model), *table], ["compensate", str(model), *table]):
        run(*command)
        said = capsys.readouterr().err
        assert said.count("interim check") == 1 and ("alarm" in said) == alarm
    assert run("export", str(model), "--urdf", str(tmp_path / "out.urdf")) == 0
    printed = capsys.readouterr()
    assert (printed.out + printed.err).count("interim check") == 1


@pytest.mark.parametrize("alarm", [False, True])
def test_a_certificate_shows_the_last_check(alarm: bool, tmp_path: Path) -> None:
    """Its day and verdict; an alarm is a doubt of the certificate."""
    model = tmp_path / "model.json"
    arm().fitted.save(model)
    names = [{"name": name, "unit": "m", "nominal": 0.0, "value": 0.0, "sigma": 1.0} for name in arm().fitted.estimate.names]
    rest = {"status": "identified", "reason": ""}
    result = RESULT | {"parameters": [one | rest for one in names]}
    (tmp_path / "result.json").write_text(json.dumps(result))
    assert run("certificate", str(model), "--out", str(tmp_path / "c")) == 0
    page = (tmp_path / "c" / "certificate.html").read_text()
    assert "interim checks" in page
    record_for(arm().fitted, alarm=alarm).save(tmp_path / "model.checks.json")
    assert run("certificate", str(model), "--out", str(tmp_path / "c")) == 0
    page = (tmp_path / "c" / "certificate.html").read_text()
    assert five_days().record.checks[-1].day in page and "model.checks.json" in page
    assert ("raised an alarm" in page) == alarm


@pytest.mark.parametrize("command", ["update", "diagnose"])
def test_models_of_update_and_diagnose_are_certified(command: str, tmp_path: Path) -> None:
    """By what they say of themselves; errors are not stated of them, and the sheet says so."""
    model = tmp_path / "model.json"
    arm().fitted.save(model, provenance={"command": f"pincal {command} old/model.json new.csv --out DIR"})
    assert run("certificate", str(model), "--out", str(tmp_path / "c")) == 0
    page = (tmp_path / "c" / "certificate.html").read_text()
    assert f"pincal {command}, of an earlier calibration" in page and "validate tells the errors" in page
    arm().fitted.save(model, provenance={"command": "pincal calibrate robot.urdf t.csv --out DIR"})
    assert run("certificate", str(model), "--out", str(tmp_path / "c")) == 3


def test_a_sheet_says_that_rows_lie_outside_the_calibrated_range(words: list[str], tmp_path: Path) -> None:
    """How many of them and in which joints, in the file, on the page and on the certificate."""
    robot = cases.robot_with("camera_point")
    lower = robot.covered.q[:, 0] + 3.0
    covered = msgspec.structs.replace(robot.covered, q=np.column_stack([lower, lower + 0.1]))
    robot.with_station(replace(robot.station, covered=covered)).save(tmp_path / "model.json", provenance={})
    assert run(*words) in (0, 5)
    found = json.loads((tmp_path / "out" / "measured.json").read_text())
    assert "of 24 rows (" in found["outside"]
    assert "outside the calibrated range" in (tmp_path / "out" / "report.html").read_text()
    assert run("certificate", str(tmp_path / "out"), "--out", str(tmp_path / "c")) == 0
    assert "outside the calibrated range" in (tmp_path / "c" / "certificate.html").read_text()


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda of: of["covariance"]["matrix"].pop(), r"covariance\.matrix"),
        (lambda of: of["budget"][0].update(share=1.5), r"budget\[0\]\.share"),
        (lambda of: of["budget"][0].update(u=-1.0), r"budget\[0\]\.u"),
        (lambda of: of["features"][0]["values"]["diameter"].update(U=-0.1), r"\.U"),
        (lambda of: of["features"][0]["values"]["diameter"].update(limits=[2.0, 1.0]), r"\.limits"),
    ],
)
def test_a_measured_file_is_checked_at_the_door(
    change: Callable[[dict[str, Any]], Any], key: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An edited one is refused with the key, before a certificate repeats it."""
    assert run(*words) in (0, 5)
    path = tmp_path / "out" / "measured.json"
    found = json.loads(path.read_text())
    change(found)
    path.write_text(json.dumps(found))
    capsys.readouterr()
    assert run("certificate", str(tmp_path / "out"), "--out", str(tmp_path / "c")) == 3
    assert re.search(rf"measured\.json: .*{key}.*expected", capsys.readouterr().err)
    assert not (tmp_path / "c").exists()
