"""Predictions and compensation where the instrument stands now: from a few rows, or at a station of the model."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from machines import kuka as true_kuka
from placed_arms import FIRST, MOVE, TOOL, measured, written

from pincal import simulate as sim
from pincal.calibration.checked_fit import calibrate
from pincal.identify.options import Options
from pincal.measure.table import write_table
from pincal.model.catalogue import BaseDrift
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot

AWAY = MOVE @ FIRST


@pytest.fixture(scope="module")
def folder(machine: sim.TrueMachine, kuka: Robot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a model whose base drifted, one of two stations, and rows of a place five metres away."""
    path = tmp_path_factory.mktemp("places")
    table = measured(machine, kuka, poses=100, time=np.linspace(0.0, 3600.0, 100))
    calibrate(kuka, table, Options(effects=(*GEOMETRIC, BaseDrift.over(table.time)))).save(path / "model.json")
    ends = {name: measured(machine, kuka, poses=80, seed=k, T_instrument_base=at) for k, (name, at) in enumerate(ENDS)}
    calibrate(kuka, ends, Options(effects=GEOMETRIC)).save(path / "stations.json")
    written(path / "few.csv", measured(machine, kuka, poses=10, seed=8, T_instrument_base=AWAY))
    written(path / "fewer.csv", measured(machine, kuka, poses=3, seed=8, T_instrument_base=AWAY))
    q = kuka.random_configurations(20, np.random.default_rng(3))
    write_table(path / "poses.csv", dict(zip(kuka.joint_names, q.T, strict=True)))
    return path


ENDS = (("monday", FIRST), ("tuesday", AWAY))


def columns_of(path: Path, names: Iterable[str]) -> np.ndarray:
    """Return columns of numbers of a table, shape (N, columns)."""
    table = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    return np.column_stack([table[name] for name in names])


def truth(machine: sim.TrueMachine, q: np.ndarray, T_instrument_base: np.ndarray) -> np.ndarray:
    """Return where the target really is, shape (N, 3) [m]."""
    tip = T_instrument_base @ machine.equilibrium(machine.poses(q)).tip
    return tip[:, :3, :3] @ TOOL + tip[:, :3, 3]


@pytest.mark.parametrize(
    ("model", "options", "at"),
    [
        ("model.json", ["--placement", "few.csv"], AWAY),
        ("model.json", [], FIRST),
        ("stations.json", ["--station", "tuesday"], AWAY),
        ("stations.json", ["--placement", "few.csv"], AWAY),
    ],
)
def test_predictions_are_true_at_the_place(
    machine: sim.TrueMachine,
    kuka: Robot,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    model: str,
    options: list[str],
    at: np.ndarray,
) -> None:
    """Neither asks for the times of the station whose base drifted."""
    given = [folder / word if word.endswith(".csv") else word for word in options]
    assert run("predict", folder / model, folder / "poses.csv", "--out", tmp_path / "out.csv", *given, "--json") == 0
    told = capsys.readouterr()
    true = truth(machine, columns_of(folder / "poses.csv", kuka.joint_names), at)
    assert np.abs(columns_of(tmp_path / "out.csv", "xyz") - true).max() < 3e-4
    if "--placement" in options:
        assert json.loads(told.out)["placement"]["moved_mm"] == pytest.approx(1300.0, abs=0.5)
        assert "placement from 10 rows of few.csv: the instrument moved by 1300 mm" in told.err
    elif model == "model.json":
        assert "base_drift of the calibration's station is left out: poses.csv has no column time" in told.err


def test_compensation_reaches_where_it_is_measured_now(
    machine: sim.TrueMachine, kuka: Robot, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Positions wanted in the frame of the moved instrument are reached by the true machine."""
    q = columns_of(folder / "poses.csv", kuka.joint_names)
    wanted = truth(machine, q, AWAY) + 1e-3
    targets, out = tmp_path / "targets.csv", tmp_path / "joints.csv"
    write_table(targets, dict(zip((*kuka.joint_names, *"xyz"), np.hstack([q, wanted]).T, strict=True)))
    command = ["compensate", folder / "model.json", targets, "--out", out, "--ignore-limits", "--quiet"]
    assert run(*command, "--placement", folder / "few.csv") == 0

    assert np.abs(truth(machine, columns_of(out, kuka.joint_names), AWAY) - wanted).max() < 3e-4


@pytest.mark.parametrize(
    ("model", "options", "code", "words"),
    [
        ("model.json", ["--placement", "fewer.csv"], 3, "3 position measurements; expected at least 4"),
        ("model.json", ["--station", "monday"], 3, "calibrated at a single one"),
        ("stations.json", ["--station", "noon"], 3, "expected one of monday, tuesday"),
        ("stations.json", [], 3, "--station NAME for one of them, --placement FEW.csv"),
        ("stations.json", ["--station", "monday", "--placement", "few.csv"], 2, "give one of them"),
        ("model.json", ["--placement", "bent.csv"], 6, "pincal diagnose"),
    ],
)
def test_a_place_that_is_not_told_is_refused(
    machine: sim.TrueMachine,
    kuka: Robot,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    model: str,
    options: list[str],
    code: int,
    words: str,
) -> None:
    """With what to do about it; nothing is written."""
    other = true_kuka().draw_errors(np.random.default_rng(9), sigma_length=1e-3, sigma_angle=1e-3)
    written(folder / "bent.csv", measured(other, kuka, poses=20, T_instrument_base=AWAY))
    given = [folder / word if word.endswith(".csv") else word for word in options]
    for verb in ("predict", "compensate"):
        assert run(verb, folder / model, folder / "poses.csv", "--out", tmp_path / "out.csv", *given) == code
        assert words in capsys.readouterr().err and not (tmp_path / "out.csv").exists()
