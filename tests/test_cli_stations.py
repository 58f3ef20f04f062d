"""Several stations on the command line: tables of different instruments in one calibration, each judged by itself."""

import json
import re
import shlex
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from command_line import run
from machines import kuka as true_kuka
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import pincal
from pincal import Conditions
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.calibration.fitted_robot import load_model
from pincal.calibration.held_out import leave_out_stations
from pincal.measure.table import write_table

URDF = str(kuka_urdf_path())
NOISE = 5e-5
PLACES = {"A": (1.4, 0.3, 0.6), "B": (1.2, -0.9, 0.9), "C": (0.9, 1.1, 1.1)}
TURNED = np.array([[0.0, -1.0, 0.0, 3.0], [1.0, 0.0, 0.0, 0.5], [0.0, 0.0, 1.0, -0.3], [0.0, 0.0, 0.0, 1.0]])

Columns = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def machine() -> sim.TrueMachine:
    """Return a machine whose lengths are off by half a millimetre and angles by a milliradian."""
    return true_kuka().draw_errors(np.random.default_rng(4), sigma_length=5e-4, sigma_angle=1e-3)


def tracked(machine: sim.TrueMachine, pose: np.ndarray, *, poses: int = 70, seed: int = 0, sigma: float = NOISE) -> Columns:
    """Return what a tracker reads of a reflector."""
    rng = np.random.default_rng(seed)
    q = sim.plan_poses(machine.nominal, poses, rng)
    return dict(sim.Instrument(pose=pose, targets=(0.1, 0.0, 0.2), sigma=sigma).measure(machine, q, rng=rng))


@pytest.fixture(scope="module")
def tables(machine: sim.TrueMachine) -> dict[str, Columns]:
    """Return a tracker's table and one of a ball that was held in three sockets."""
    rng = np.random.default_rng(1)
    sockets = sim.Contact(fixed=PLACES, tool=(0.0, 0.05, 0.15), sigma=NOISE)
    held = sockets.measure(machine, sockets.plan(machine.nominal, 48, rng=rng), rng=rng)
    return {"tracker": tracked(machine, TURNED), "sockets": dict(held)}


def written(folder: Path, tables: dict[str, Columns]) -> list[Path]:
    """Write tables to files of their names."""
    for name, columns in tables.items():
        write_table(folder / f"{name}.csv", columns)
    return [folder / f"{name}.csv" for name in tables]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory, tables: dict[str, Columns]) -> Path:
    """Return the folder of a calibration of both tables."""
    folder = tmp_path_factory.mktemp("stations")
    files = written(folder, tables)
    options = ("--model", "geometric", "--split", "random", "--quiet", "--out", folder / "out")
    assert run("calibrate", URDF, *files, *options) == 0
    return folder / "out"


def of(results: Path) -> dict[str, Any]:
    """Return a result."""
    found: dict[str, Any] = json.loads((results / "result.json").read_text())
    return found


def test_each_station_has_its_errors(results: Path) -> None:
    """Kind, rows and errors stand station by station; both are down to the noise of their own."""
    tracker, sockets = of(results)["stations"]
    assert (tracker["name"], tracker["kind"], tracker["rows"]) == ("tracker", "position", {"train": 70, "test": 70})
    assert (sockets["name"], sockets["kind"], sockets["rows"]) == ("sockets", "socket", {"train": 48, "test": 48})
    for station in (tracker, sockets):
        assert station["error"]["nominal"]["test"]["mean_mm"] > 0.5
        assert station["error"]["calibrated"]["test"]["mean_mm"] < 0.13
        assert station["noise"]["sigma_m"] == pytest.approx(NOISE, rel=0.4)
    assert of(results)["rows"] == {"train": 118, "test": 118}


def test_errors_of_all_stations_are_those_of_their_rows(results: Path) -> None:
    """Means over all rows, and over a station's, follow from the residuals in residuals.csv."""
    rows = pl.read_csv(results / "residuals.csv")
    sizes = np.sqrt(sum(rows[f"left_out_{name} [m]"].to_numpy() ** 2 for name in _positions(rows)))
    held = (rows["outlier"] == 0).to_numpy()
    assert of(results)["error"]["calibrated"]["test"]["mean_mm"] == pytest.approx(1e3 * sizes[held].mean())
    for station in of(results)["stations"]:
        here = held & (rows["station"] == station["name"]).to_numpy()
        assert station["error"]["calibrated"]["test"]["mean_mm"] == pytest.approx(1e3 * sizes[here].mean())


def _positions(rows: pl.DataFrame) -> list[str]:
    return [c.removeprefix("calibrated_").removesuffix(" [m]") for c in rows.columns if c.startswith("calibrated_")]


def test_the_model_predicts_at_each_station(results: Path, machine: sim.TrueMachine) -> None:
    """At new poses it is as close to the true machine as the noise of some fifty rows allows."""
    new = tracked(machine, TURNED, poses=200, seed=7, sigma=0.0)
    q = np.column_stack([new[name] for name in machine.names])
    found = load_model(results / "model.json").at("tracker").predict(q)[:, :, 3]
    true = np.column_stack([new[axis] for axis in "xyz"])
    assert np.linalg.norm(found - true, axis=1).mean() < 5e-5


def test_the_report_shows_each_station(results: Path) -> None:
    """A section with a bar and a line for each; the list of contents leads to it."""
    page = (results / "report.html").read_text()
    assert 'href="#stations"' in page and "tracker: mean error" in page and "sockets: mean error" in page


def test_the_next_step_of_several_stations_runs(
    tmp_path: Path,
    machine: sim.TrueMachine,
    tables: dict[str, Columns],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A program is corrected at one of them: the command names that of the instrument, not the first, of sockets."""
    monkeypatch.chdir(tmp_path)
    both = {"sockets": tables["sockets"], "tracker": tables["tracker"]}
    written(tmp_path, both)
    options = ("--model", "geometric", "--noise", f"{NOISE}m", "--quiet", "--out", "out")
    assert run("calibrate", URDF, *(f"{name}.csv" for name in both), *options) == 0
    step = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("next "))
    write_table(tmp_path / "PROGRAM.csv", {name: tables["tracker"][name][:3] for name in machine.names})
    pincal, *words = shlex.split(step.removeprefix("next "), comments=True)

    assert (pincal, words[0]) == ("pincal", "compensate")
    assert words[words.index("--station") + 1] == "tracker"
    assert run(*words) == 0


@pytest.mark.long
def test_a_column_does_what_files_do(tmp_path: Path, machine: sim.TrueMachine, capsys: pytest.CaptureFixture[str]) -> None:
    """One table whose rows name their stations gives the numbers of two files, and says how far the tracker moved."""
    days = {"mo": tracked(machine, np.eye(4), poses=30), "tu": tracked(machine, TURNED, poses=30, seed=1)}
    both = {name: np.concatenate([day[name] for day in days.values()]) for name in days["mo"]}
    (whole,) = written(tmp_path, {"both": both | {"station": np.repeat(list(days), 30)}})
    found = []
    for files in (written(tmp_path, days), [whole]):
        assert run("calibrate", URDF, *files, "--model", "geometric", "--json", "--quiet", "--out", tmp_path / "out") == 0
        found.append(json.loads(capsys.readouterr().out))
    assert found[0]["error"] == found[1]["error"] and found[0]["parameters"] == found[1]["parameters"]
    apart = np.linalg.norm(np.linalg.inv(TURNED)[:3, 3])
    # The tracker's place in the robot's base frame; what the base absorbs of the robot's errors is common to both.
    assert found[0]["stations"][1]["moved_mm"] == pytest.approx(1e3 * apart, abs=20.0)


def test_bad_stations_are_refused(
    tmp_path: Path, tables: dict[str, Columns], machine: sim.TrueMachine, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each with exit code 3 and the next step, and nothing is written."""
    few = {name: column[:2] for name, column in tracked(machine, np.eye(4), seed=3).items()}
    tracker, sockets, short = written(tmp_path, tables | {"few": few})
    again = tmp_path / "again" / "tracker.csv"
    again.parent.mkdir()
    write_table(again, tables["sockets"])
    for arguments, said in (
        ((tracker, tracker), "two stations are called 'tracker'"),
        ((tracker, again), "different kinds (position and socket)"),
        ((tracker, short), "2 position measurements; expected at least 4 to determine the poses of instrument"),
        ((tracker, sockets, "--holdout", short), "validation rows of an unknown station, 'few'"),
    ):
        assert run("calibrate", URDF, *arguments, "--model", "geometric", "--quiet", "--out", tmp_path / "none") == 3
        assert said in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "none").exists()


def test_check_looks_at_all_stations(tmp_path: Path, tables: dict[str, Columns], capsys: pytest.CaptureFixture[str]) -> None:
    """Rows, kinds and what may be found are those of both tables; what sockets do not see the tracker does."""
    assert run("check", URDF, *written(tmp_path, tables), "--model", "geometric", "--json", "--quiet") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["rows"], found["kind"]) == (118, "position and socket")
    status = {row["name"]: row["status"] for row in found["parameters"]}
    assert status["joint_2.theta"] == "identified" and "tracker/base.x" in status
    assert not any("contacts" in warning["text"] for warning in found["warnings"])
    sizes = {e["effect"]: e["size"] for e in found["detectable"]["effects"] if e["joint"] == "joint_2"}
    assert 0.0 < sizes["gear_eccentricity"] < 1e-3


@pytest.fixture(scope="module")
def elastic_machine() -> sim.TrueMachine:
    """Return the machine of two days."""
    machine = true_kuka(compliance=np.tile([0.0, 0.0, 1e-6], (6, 1)))
    return machine.draw_errors(np.random.default_rng(4), sigma_length=5e-4, sigma_angle=1e-3)


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory, elastic_machine: sim.TrueMachine) -> list[Path]:
    """Return the tables of an elastic machine on two days, the tracker moved."""
    first, second = (tracked(elastic_machine, at, poses=80, seed=i) for i, at in enumerate((np.eye(4), TURNED)))
    tables = {"mo": first, "tu": second}
    return written(tmp_path_factory.mktemp("days"), tables)


@pytest.mark.long
@pytest.mark.usefixtures("here")
def test_a_station_is_predicted_by_the_others(days: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each by a model that never saw it, up to the place of tracker and target: as SciPy's least squares finds that."""
    assert run("calibrate", URDF, *days, "--split", "station", "--quiet", "--out", tmp_path) == 0
    first = capsys.readouterr().out.splitlines()[0]
    result = of(tmp_path)
    alone = pincal.Robot.from_urdf(URDF)
    means, geometric = [], []
    for fitted, left, record in zip(days, days[::-1], result["stations"][::-1], strict=True):
        table = pincal.read_measurements(left, alone.joint_names)
        fit = pincal.calibrate(alone, pincal.read_measurements(fitted, alone.joint_names))
        means.append(aligned(fit, table))
        assert record["left_out"]["mean_mm"] == pytest.approx(means[-1], rel=2e-3)
        geometric.append(record["left_out_geometric"]["mean_mm"])
        assert record["left_out"]["mean_mm"] < 0.12 and geometric[-1] > 2.0 * means[-1]
    assert first == (
        f"On a new set-up: mean {np.mean([r['left_out']['mean_mm'] for r in result['stations']]):.4f} mm; "
        f"geometry alone {np.mean(geometric):.4f} mm"
    )
    assert result["error"]["calibrated"]["test"]["mean_mm"] == pytest.approx(np.mean(means), rel=2e-3)
    assert "errors on set-ups not used by the calibration" in (tmp_path / "report.html").read_text()


def aligned(fit: pincal.FittedRobot, table: pincal.Measurements) -> float:
    """Return the mean error of a fit's robot [mm], base and target fitted by SciPy."""
    assert table.position is not None
    station = fit.station.model
    gone = [name for name in station.names if name.startswith(("base.", "tool."))]
    values = fit.model_values.copy()
    values[[station.index(name) for name in gone]] = 0.0
    chain = station.chain.with_references(np.eye(3), np.eye(3)[None])
    tips = station.with_chain(chain).predict(values, Conditions.at(table.q))

    def off(x: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(x[3:6]).as_matrix()
        point = tips[:, :, 3] + tips[:, :, :3] @ x[6:9]
        return (point @ turn.T + x[:3] - table.position).ravel()

    starts = [np.r_[0.0, 0.0, 0.0, turn, 0.1, 0.0, 0.2] for turn in ([0.0] * 3, [0.0, 0.0, 1.5])]
    best = min((least_squares(off, start, x_scale="jac", xtol=1e-15) for start in starts), key=lambda found: found.cost)
    return float(1e3 * np.linalg.norm(best.fun.reshape(-1, 3), axis=1).mean())


@pytest.mark.long
def test_a_robot_of_several_stations_is_diagnosed(
    results: Path, machine: sim.TrueMachine, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At a third place: unchanged, and its rows added; hit, and named; rows of any station are known again."""
    sound = tracked(machine, np.eye(4), poses=15, seed=11)
    hit = sound | {"joint_3": sound["joint_3"] - 1e-3}
    sound_file, hit_file = written(tmp_path, {"sound": sound, "hit": hit})
    model, old = results / "model.json", results.parent
    assert run("diagnose", model, sound_file, "--out", tmp_path / "d") == 0
    assert run("diagnose", model, hit_file, "--out", tmp_path / "d") == 6
    (change,) = json.loads((tmp_path / "d" / "diagnosis.json").read_text())["changes"]
    assert ("joint_offset", "joint_3") in {(c["effect"], c["joint"]) for c in (change, *change["equivalent"])}
    assert run("update", model, sound_file, "--out", tmp_path / "u") == 0
    assert run("update", model, hit_file, "--out", tmp_path / "v") == 6 and not (tmp_path / "v").exists()
    capsys.readouterr()
    for table, rows in (("tracker", 70), ("sockets", 48)):
        assert run("diagnose", model, old / f"{table}.csv", "--out", tmp_path / "d") == 3
        assert f"fitted to {rows} of these" in capsys.readouterr().err


@pytest.mark.long
def test_a_move_counts_from_the_nearest_station(days: list[Path], elastic_machine: sim.TrueMachine, tmp_path: Path) -> None:
    """The tracker stands where it stood on Tuesday, three metres from where it stood on Monday."""
    (new,) = written(tmp_path, {"new": tracked(elastic_machine, TURNED, poses=20, seed=7)})

    assert run("calibrate", URDF, *days, "--quiet", "--out", tmp_path / "out") == 0
    assert run("diagnose", tmp_path / "out" / "model.json", new, "--quiet", "--out", tmp_path / "d") == 0
    assert json.loads((tmp_path / "d" / "diagnosis.json").read_text())["station"]["moved_mm"] < 1.0


def test_a_fit_of_several_stations_is_diagnosed_as_its_file_is(days: list[Path], elastic_machine: sim.TrueMachine) -> None:
    """From Python, too, a move counts from the nearest station, and rows of every station are known again."""
    robot = pincal.Robot.from_urdf(URDF)
    tables = {path.stem: pincal.read_measurements(path, robot.joint_names) for path in days}
    fit = pincal.calibrate(robot, tables)
    seen = tracked(elastic_machine, TURNED, poses=20, seed=7)
    q, position = (np.column_stack([seen[name] for name in names]) for names in (robot.joint_names, "xyz"))
    found = pincal.diagnose(fit, pincal.measurements_from_arrays(robot.joint_names, q, position=position)).found

    assert not found.changed and found.station.moved_mm is not None and found.station.moved_mm < 1.0
    assert found.station.is_still
    for name, table in tables.items():
        with pytest.raises(pincal.BadInputError, match=f"{name}.csv: the model was fitted to 80 of these 80 rows"):
            pincal.diagnose(fit, table)


@pytest.mark.long
def test_left_out_stations_do_not_depend_on_the_executor(days: list[Path]) -> None:
    """Processes give what one loop does, bit by bit."""
    robot = pincal.Robot.from_urdf(URDF)
    tables = {path.stem: pincal.read_measurements(path, robot.joint_names) for path in days}
    here = list(leave_out_stations(robot, tables, pincal.Options(effects=pincal.GEOMETRIC)))
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        there = list(leave_out_stations(robot, tables, pincal.Options(effects=pincal.GEOMETRIC), executor=executor))
    assert [one.sizes for one in here] == [one.sizes for one in there] and here[0].sizes["calibrated"]


def test_the_only_station_is_not_left_out(days: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The error says what makes several."""
    assert run("calibrate", URDF, days[0], "--split", "station", "--quiet", "--out", tmp_path / "out") == 3
    assert "only one station, so none can be left out" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.usefixtures("here")
def test_discovery_finds_what_both_days_show(
    tmp_path: Path, days: list[Path], machine: sim.TrueMachine, capsys: pytest.CaptureFixture[str]
) -> None:
    """Elasticity is found from the sum of both tables, and each day is predicted by what was found on the other."""
    assert (
        run(
            "discover",
            URDF,
            *days,
            "--split",
            "station",
            "--noise",
            "0.05mm",
            "--stability",
            "0",
            "--quiet",
            "--out",
            tmp_path,
        )
        == 0
    )
    first = capsys.readouterr().out.splitlines()[0]
    assert re.fullmatch(r"On a new set-up: mean 0\.\d+ mm; geometry alone \d\.\d+ mm", first)
    found = json.loads((tmp_path / "discovery.json").read_text())
    assert {entry["effect"] for entry in found["effects"]} == {"joint_elasticity"} and found["verdict"] == "adequate"
    for station in of(tmp_path)["stations"]:
        assert station["left_out"]["mean_mm"] < 0.13 < 0.5 * station["left_out_geometric"]["mean_mm"]
    assert "Stations" in (tmp_path / "report.html").read_text()


@pytest.mark.long
def test_an_offset_that_jumped_is_named_with_its_station(tmp_path: Path, machine: sim.TrueMachine) -> None:
    """A joint that stands 0.3 mrad elsewhere on the second day is found there, as large as it is, and nothing else."""
    days = {"mo": tracked(machine, np.eye(4), poses=100), "tu": tracked(machine, TURNED, poses=100, seed=1)}
    rng = np.random.default_rng(9)
    q = sim.plan_poses(machine.nominal, 100, rng)
    jump = 3e-4 * (np.arange(6) == 2)
    days["we"] = dict(sim.Instrument(targets=(0.1, 0.0, 0.2), sigma=NOISE).measure(machine, q + jump, rng=rng))
    days["we"] |= dict(zip(machine.names, q.T, strict=True))
    files = written(tmp_path, days)
    assert run("discover", URDF, *files, "--noise", "0.05mm", "--stability", "0", "--quiet", "--out", tmp_path / "out") == 0
    found = json.loads((tmp_path / "out" / "discovery.json").read_text())
    named = [entry for entry in found["effects"] if entry["effect"] != "joint_elasticity"]
    assert [(e["effect"], e["joint"], e.get("station")) for e in named] == [("joint_offset", "joint_3", "we")]
    ((name, value),) = named[0]["parameters"].items()
    assert name == "we/joint_3.theta_here" and value["value"] == pytest.approx(3e-4, abs=4.0 * value["sigma"])
    assert value["sigma"] < 3e-5 and found["verdict"] == "adequate"
    again = load_model(tmp_path / "out" / "model.json").at("we").predict(q)[:, :, 3]
    assert np.linalg.norm(again - np.column_stack([days["we"][a] for a in "xyz"]), axis=1).mean() < 2.0 * NOISE


@pytest.mark.long
@pytest.mark.usefixtures("here")
def test_placements_of_a_pair_of_sockets_are_stations(shared_data: Path, tmp_path: Path) -> None:
    """A Panda's ball in two sockets at two places: each is predicted by the other to a seventh of the nominal error."""
    table = pl.read_csv(shared_data / "panda_sockets" / "panda_3.csv")
    places = ("backcenter", "frontleft")
    for place in places:
        table.filter(pl.col("socket").str.starts_with(place)).write_csv(tmp_path / f"{place}.csv")
    lengths = [word for place in places for word in ("--socket-distance", f"{place}/0", f"{place}/1", "0.05")]
    options = ("--split", "station", "--model", "geometric", "--quiet", "--out", tmp_path / "out", *lengths)
    assert run("calibrate", "panda", *(tmp_path / f"{place}.csv" for place in places), *options) == 0
    for station, place in zip(of(tmp_path / "out")["stations"], places, strict=True):
        assert (station["name"], station["kind"]) == (place, "socket")
        assert station["left_out"]["mean_mm"] < 0.15 * station["error"]["nominal"]["train"]["mean_mm"]


def test_a_robot_of_several_stations_is_exported_as_one(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is of the robot alone needs no station; poses in an instrument's frame do."""
    model, source = results / "model.json", tmp_path / "arm.py"
    assert run("export", model, "--urdf", tmp_path / "arm.urdf", "--dh", tmp_path / "arm.csv", "--quiet") == 0
    assert (tmp_path / "arm.urdf").read_bytes() == (results / "calibrated.urdf").read_bytes()
    assert run("export", model, "--python", source, "--quiet") == 3
    assert "--station NAME for one of them" in capsys.readouterr().err
    assert run("export", model, "--python", source, "--station", "tracker", "--quiet") == 0
    assert "in the instrument frame" in source.read_text()
