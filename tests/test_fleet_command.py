"""``pincal fleet`` and ``--type`` as a user runs them: from models and tables to a type, a store and what changed."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from fleet_cases import OPTIONS, rows_of, siblings

import pincal
from pincal import Robot, calibrate, load_model
from pincal.builtin import kuka_urdf_path
from pincal.design.design_model import DesignModel
from pincal.design.reach import SensorSetup
from pincal.diagnosis.model_update import update
from pincal.errors import Exit
from pincal.fleet.machines import Machine
from pincal.fleet.robot_type import learn_type, load_type
from pincal.fleet.store import open_store
from pincal.fleet.summary import at_tool
from pincal.io.strict_json import write_json
from pincal.measure.table import write_table
from pincal.model.conditions import Conditions

GEOMETRIC = ("--model", "geometric", "--noise", "0.05mm")


def write(path: Path, table: pincal.Measurements) -> Path:
    """Write a table of positions."""
    assert table.position is not None
    write_table(path, dict(zip(table.joint_names, table.q.T, strict=True)) | dict(zip("xyz", table.position.T, strict=True)))
    return path


@pytest.fixture(scope="module")
def arm() -> Robot:
    """Return the KUKA up to its flange."""
    return Robot.from_urdf(kuka_urdf_path(), tip="tool0")


@pytest.fixture(scope="module")
def folder(arm: Robot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the models of five machines, two tables of a sixth, and the URDF."""
    found = tmp_path_factory.mktemp("fleet")
    shutil.copy(kuka_urdf_path(), found / "robot.urdf")
    *known, further = siblings(6)
    for k, machine in enumerate(known):
        (found / f"r{k}").mkdir()
        calibrate(arm, rows_of(arm, machine, 40, k), OPTIONS).save(found / f"r{k}" / "model.json", provenance={})
    write(found / "few.csv", rows_of(arm, further, 7, 10))
    offsets = np.array([0.0, 0.0, 5e-4, 0.0, 0.0, 0.0])
    write(found / "bent.csv", rows_of(arm, replace(known[0], joint_offsets=known[0].joint_offsets + offsets), 14, 11))
    write(found / "truth.csv", rows_of(arm, further, 100, 12))
    return found


@pytest.fixture(scope="module")
def of(folder: Path) -> Path:
    """Return the file of their type."""
    assert run("fleet", "learn", *folder.glob("r?/model.json"), "--out", folder / "type.json", "--quiet") == Exit.DONE
    return folder / "type.json"


@pytest.mark.long
@pytest.mark.usefixtures("drawn")
def test_a_type_is_learned_from_models(folder: Path, of: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Printed, drawn, and the same from what the site shares."""
    assert run("fleet", "learn", *folder.glob("r?/model.json"), "--out", folder / "again.json", "--error", "0.1mm",
               "--report", folder / "type.html", "--share", folder / "site.parquet") == Exit.DONE  # fmt: skip
    printed = capsys.readouterr().out
    assert run("fleet", "learn", folder / "site.parquet", "--robot", folder / "robot.urdf", "--out", folder / "there.json",
               "--json") == Exit.DONE  # fmt: skip
    told = json.loads(capsys.readouterr().out)

    assert "5 machines, 36 parameters" in printed and "exchangeability" in printed and "with the type" in printed
    here, there = load_type(of), load_type(folder / "there.json")
    np.testing.assert_allclose(there.mean, here.mean, rtol=1e-9, atol=1e-15)
    assert f"{told['spread_mm']:.3f} mm rms at the tool" in printed
    assert {one["machine"] for one in told["machines"]} == {""}
    page = (folder / "type.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 3 and "joint_2.theta" in page


@pytest.mark.long
def test_few_poses_of_a_machine_of_a_known_type(folder: Path, of: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is known far better than alone, and that is true; a note on how it compares, and the type among the inputs."""
    assert run("calibrate", folder / "robot.urdf", folder / "few.csv", *GEOMETRIC, "--test-fraction", "0", "--quiet",
               "--out", folder / "typed", "--type", of) == Exit.DONE  # fmt: skip
    printed = capsys.readouterr().out
    model, robot = load_model(folder / "typed" / "model.json"), Robot.from_urdf(folder / "robot.urdf")
    fit, truth = calibrate(robot, folder / "few.csv", OPTIONS), pincal.read_measurements(folder / "truth.csv", robot)
    assert truth.position is not None
    error = float(np.linalg.norm(model.predict(truth.q)[:, :, 3] - truth.position, axis=1).mean())
    typed, alone = (float(np.linalg.norm(one.position_sigma(Conditions.at(truth.q)), axis=1).mean()) for one in (model, fit))

    assert typed < 0.3 * alone and error < 1.5 * typed
    assert "5 robots of its type" in printed and "type.json" in model.provenance["inputs"]
    # What it brings to a next type is its rows alone.
    assert model.information is not None
    whole = fit.information.whole
    np.testing.assert_allclose((model.information.H - fit.information.H) / np.sqrt(np.outer(whole, whole)), 0.0, atol=0.02)


@pytest.mark.long
def test_check_design_and_simulate_know_the_type(folder: Path, of: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Poses promise more, and a machine that is drawn from the type is one of it."""
    promised = []
    for more in ((), ("--type", of)):
        assert run("design", folder / "robot.urdf", "--poses", "9", "--model", "geometric", "--candidates", "60", "--out",
                   folder / "poses.csv", "--json", "--quiet", *more) == Exit.DONE  # fmt: skip
        promised.append(json.loads(capsys.readouterr().out)["random_median"]["error_rms_mm"])
    assert promised[1] < 0.5 * promised[0]
    assert run("simulate", folder / "robot.urdf", "--type", of, "--seed", "3", "--elastic", "0", "--poses", "30", "--out",
               folder / "drawn.csv", "--quiet") == Exit.DONE  # fmt: skip
    assert run("check", folder / "robot.urdf", folder / "drawn.csv", *GEOMETRIC, "--type", of, "--quiet") == Exit.DONE
    robot = Robot.from_urdf(folder / "robot.urdf")
    drawn = calibrate(robot, folder / "drawn.csv", OPTIONS)
    assert not load_type(of).judge(Machine.of(drawn.fit)).off


@pytest.mark.long
def test_tables_models_and_diagnoses_go_into_a_store(
    arm: Robot, folder: Path, of: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Then all of it is calibrated, what is done is not done again, and the robot that changed stands first."""
    store, day = folder / "store", "2026-01-05"
    assert run("fleet", "add", store, *folder.glob("r?/model.json"), "--day", day, "--label", "hall=north") == Exit.DONE
    assert "5 models" in capsys.readouterr().out
    for machine, table in (("r0", "bent.csv"), ("r1", "r1.csv"), ("r9", "r1.csv")):
        if machine == "r1":
            write(folder / table, rows_of(arm, siblings(6)[1], 14, 13))
        added = run("fleet", "add", store, folder / table, "--check", "--machine", machine, "--day", "2026-01-12")
        assert added == (Exit.BAD_INPUT if machine == "r9" else Exit.DONE)
    assert capsys.readouterr().out.endswith(": 1 check of 2026-01-12\n")
    # A program may add checks before calibrations.
    open_store(store).add_table("r9", "2026-01-12", pincal.read_measurements(folder / "r1.csv", arm), role="check")
    assert run("fleet", "check", of, store, "--quiet") == Exit.DONE
    printed = capsys.readouterr().out
    assert "no robot has been checked since its calibration" in printed and "Nothing to inspect" not in printed
    assert "next Calibrate 3 tables of the store: pincal fleet calibrate ROBOT.urdf" in " ".join(printed.split())
    found = pincal.diagnose(load_model(folder / "r2" / "model.json"), rows_of(arm, siblings(6)[1], 14, 13))
    write_json(folder / "diagnosis.json", found.report)
    assert run("fleet", "add", store, folder / "diagnosis.json", "--machine", "r2", "--day", "2026-01-12") == Exit.DONE
    capsys.readouterr()
    work = ("fleet", "calibrate", folder / "robot.urdf", store, "--type", of, *GEOMETRIC, "--quiet")
    assert run(*work) == Exit.DONE and run(*work) == Exit.DONE
    assert capsys.readouterr().out == "3 tables calibrated\n0 tables calibrated; 3 done before\n"
    assert run("fleet", "check", of, store, "--report", folder / "fleet.html", "--quiet") == Exit.CHANGED
    printed = capsys.readouterr().out

    assert "5 robots, 3 checks: 2 changed" in printed and "joint_3.theta" in printed and "see its diagnosis" in printed
    assert "ignored: checks of r9, which have no calibration" in printed
    assert len(printed.splitlines()) <= 14 and "next   Inspect r" in printed and "Inspect these first" not in printed
    assert run("fleet", "check", of, store, "--verbose") == Exit.CHANGED
    assert "Inspect these first" in capsys.readouterr().out
    page = (folder / "fleet.html").read_text(encoding="utf-8")
    assert run("fleet", "check", of, store, "--out", folder / "fleet", "--json") == Exit.CHANGED
    assert json.loads((folder / "fleet" / "fleet.json").read_text()) == json.loads(capsys.readouterr().out)
    assert (folder / "fleet" / "report.html").read_text(encoding="utf-8") == page
    # Robots on which nothing was found are counted, not listed.
    assert ">r0<" in page and ">r1<" not in page and "nothing was found on 1 other robot" in page
    assert {key.machine for key in open_store(store).keys("models")} == {f"r{k}" for k in range(5)}


def test_what_is_none_is_refused(folder: Path, of: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """With a reason, exit code 3 and nothing written."""
    (tmp_path / "odd.json").write_text("{}")
    robot, few = folder / "robot.urdf", folder / "few.csv"
    for words, reason in (
        (("fleet", "learn", tmp_path / "odd.json", "--out", tmp_path / "t.json"), "odd.json"),
        (("fleet", "learn", tmp_path / "none", "--out", tmp_path / "t.json"), "can't be read"),
        (("fleet", "add", tmp_path / "store", tmp_path / "odd.json"), "odd.json"),
        (("fleet", "add", tmp_path / "store", few), "--robot URDF"),
        (("fleet", "add", tmp_path / "store", few, "--robot", robot, "--day", "soon"), "ISO date"),
        (("fleet", "add", tmp_path / "store", folder, "--robot", robot), "add its model.json"),
        (("fleet", "check", of, tmp_path / "store"), "no store"),
        (("calibrate", robot, few, "--type", folder / "r0" / "model.json", "--out", tmp_path / "x"), "pincal fleet learn"),
        (("calibrate", "ur10", few, "--type", of, "--out", tmp_path / "x"), "joint"),
        (("design", "ur10", "--poses", "9", "--type", of, "--out", tmp_path / "p.csv"), "a different nominal geometry"),
    ):
        assert run(*words) == Exit.BAD_INPUT, words
        assert reason in capsys.readouterr().err, words
    assert [path.name for path in tmp_path.iterdir()] == ["odd.json"]


def test_a_check_that_could_not_count_is_refused(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a machine that nothing calibrates by that day: a misspelt name, that of the file, a day too early, no store yet."""
    store, check = tmp_path / "store", (folder / "few.csv", "--check", "--robot", folder / "robot.urdf")
    assert run("fleet", "add", store, *check) == Exit.BAD_INPUT
    assert "few has no calibration in" in capsys.readouterr().err and not store.exists()
    assert run("fleet", "add", store, *folder.glob("r?/model.json"), "--day", "2026-01-05") == Exit.DONE
    assert run("fleet", "add", store, folder / "few.csv", "--machine", "R17", "--day", "2026-01-05") == Exit.DONE
    for machine, day, reason in (
        ("few", "2026-01-12", "MODEL.json --machine few"),
        ("r33", "2026-01-12", "nearest first: r3, "),
        ("r3", "2026-01-04", "was first calibrated on 2026-01-05"),
    ):
        assert run("fleet", "add", store, *check, "--machine", machine, "--day", day) == Exit.BAD_INPUT
        assert reason in capsys.readouterr().err
    for machine in ("r3", "R17"):
        assert run("fleet", "add", store, *check, "--machine", machine, "--day", "2026-01-05") == Exit.DONE


def test_a_model_keeps_what_its_rows_say(arm: Robot, folder: Path) -> None:
    """To the last digit in its file; an update adds what the new rows say."""
    machine = siblings(1)[0]
    fit = calibrate(arm, rows_of(arm, machine, 40, 0), OPTIONS)
    model = load_model(folder / "r0" / "model.json")
    new = update(model, rows_of(arm, machine, 12, 50))

    assert model.information is not None and new.information is not None
    np.testing.assert_array_equal(model.information.H, fit.information.H)
    np.testing.assert_array_equal(model.information.priors, fit.information.priors)
    assert new.information.degrees == pytest.approx(model.information.degrees + 36 - 9)
    assert np.linalg.eigvalsh(new.information.H - model.information.H).min() > -1e-6 * np.abs(new.information.H).max()


@pytest.mark.long
def test_a_design_begins_with_what_is_known(arm: Robot, folder: Path, of: Path) -> None:
    """The closed form: without any row its covariance is that of the type."""
    known = load_type(of).prior_of(arm, OPTIONS.effects)
    conditions = Conditions.at(arm.random_configurations(20, np.random.default_rng(1)))
    design = DesignModel.of(arm, conditions, replace(OPTIONS, earlier=known), SensorSetup())
    covariance = np.linalg.inv(design.known) * np.outer(design.units, design.units)
    at = [design.names.index(name) for name in known.names if name in design.names]
    there = known.places(design.names[k] for k in at)

    expected = known.dense_covariance()[np.ix_(there, there)]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(covariance[np.ix_(at, at)] / scale, expected / scale, atol=1e-5)


@pytest.mark.long
def test_machines_differ_at_the_tool_as_true_ones_do(arm: Robot) -> None:
    """Predicted by the type of ten machines, and seen on true ones whose frames are placed over each other."""
    machines = siblings(10)
    learned = learn_type(Machine.of(calibrate(arm, rows_of(arm, m, 40, k), OPTIONS).fit) for k, m in enumerate(machines))
    q = arm.random_configurations(100, np.random.default_rng(3))
    tips = np.array([m.tip(q) for m in machines])
    mean, off = tips[:, :, :3].mean(axis=0), []
    x = np.einsum("nij,j->ni", mean[:, :, :3], [0.1, 0.0, 0.2]) + mean[:, :, 3]
    # Small displacements: of the base, about its origin, and of the target in the tip's axes.
    turned = np.stack([np.cross(np.eye(3)[i], x) for i in range(3)], axis=2)
    frames = np.concatenate([np.tile(np.eye(3), (100, 1, 1)), turned, mean[:, :, :3]], axis=2).reshape(300, 9)
    for tip in tips:
        d = (tip[:, :3, :3] @ [0.1, 0.0, 0.2] + tip[:, :3, 3] - x).ravel()
        off.append(d - frames @ np.linalg.lstsq(frames, d, rcond=None)[0])
    seen = np.sqrt(np.mean(np.sum(np.reshape(off, (10, 100, 3)) ** 2, axis=2)) * 10 / 9)

    assert at_tool(learned.type, arm).spread == pytest.approx(seen, rel=0.25)
