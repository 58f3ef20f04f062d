"""A folder of results is all of one run or all of another, whenever a run is stopped."""

import json
import multiprocessing
import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pincal.atomic import drafted
from pincal.calibration.earlier_files import read_model
from pincal.cli import main
from pincal.errors import ModelFileError, OutputError
from pincal.io import result_folder
from pincal.io.result_folder import RESULTS, output_folder

DISCOVERY = ("model.json", "result.json", "discovery.json", "calibrated.urdf", "residuals.csv", "report.html")
CALIBRATION = tuple(name for name in DISCOVERY if name != "discovery.json")
_STOPS = {signal.SIGINT, signal.SIGTERM}


def write(folder: Path, mark: str, names: tuple[str, ...] = CALIBRATION) -> None:
    """Write files that say which run they are of, as a run does."""
    with output_folder(folder) as draft:
        for name in names:
            (draft / name).write_text(f'{{\n"format_version": 1,\n"run": "{mark}"\n}}\n')


@pytest.mark.parametrize("is_exchangeable", [True, False])
def test_a_model_is_never_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_exchangeable: bool) -> None:
    """Results without a model, as of a measured part, are refused in a folder that has one, and leave all its files."""
    monkeypatch.setattr(result_folder, "_is_exchangeable", lambda goal: is_exchangeable)
    write(tmp_path, "calibration")

    with pytest.raises(OutputError, match="holds a calibration"):
        write(tmp_path, "part", ("measured.json", "report.html"))

    assert state(tmp_path) == {name: "calibration" for name in CALIBRATION if name in ("model.json", *RESULTS)}
    assert {file.name for file in tmp_path.iterdir()} == set(CALIBRATION)


def state(folder: Path) -> dict[str, str]:
    """Return which run each file is of."""
    return {
        file.name: json.loads(file.read_text())["run"] for file in folder.iterdir() if file.name in ("model.json", *RESULTS)
    }


def is_mixed(folder: Path) -> bool:
    """Return whether a reader refuses the model for what stands beside it, before it looks at anything else in it."""
    try:
        read_model(folder / "model.json")
    except ModelFileError as error:
        assert re.search("was not written by the same run.*calibrate again", str(error)) or "is missing" in str(error)
        return "was not written by the same run" in str(error)
    return False


@pytest.fixture(params=["exchanged", "one by one"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Publish by one exchange, and as where the system knows none."""
    if request.param == "one by one":
        monkeypatch.setattr(result_folder, "exchanged", lambda *_: False)
    return str(request.param)


def test_nothing_of_an_earlier_run_stays(tmp_path: Path, way: str) -> None:
    """A calibration into the folder of a discovery takes discovery.json away; files of the user stay, in folders, too."""
    out = tmp_path / "out"
    write(out, "old", DISCOVERY)
    (out / "mine.txt").write_text("mine")
    write(out, "new")
    assert state(out) == dict.fromkeys(CALIBRATION, "new")
    (out / "folder").mkdir()
    write(out, "newer")

    assert state(out) == dict.fromkeys(CALIBRATION, "newer")
    assert {entry.name for entry in out.iterdir()} == {*CALIBRATION, "mine.txt", "folder"}
    assert (out / "mine.txt").read_text() == "mine"
    assert list(tmp_path.iterdir()) == [out]


def test_a_folder_of_two_runs_is_refused(tmp_path: Path, way: str) -> None:
    """model.json says which files were written with it; another run's result.json beside it is an error."""
    write(tmp_path / "a", "a")
    write(tmp_path / "b", "b", DISCOVERY)
    model = tmp_path / "b" / "model.json"
    assert not is_mixed(tmp_path / "b")
    assert set(json.loads(model.read_text())["files"]) == {*DISCOVERY} - {"model.json"}
    (tmp_path / "b" / "report.html").write_text("annotated")
    (tmp_path / "b" / "result.json").unlink()
    assert not is_mixed(tmp_path / "b")
    (tmp_path / "a" / "result.json").rename(tmp_path / "b" / "result.json")

    with pytest.raises(ModelFileError, match=r"result\.json in the same folder was not written by the same run"):
        read_model(model)


@pytest.mark.parametrize("step", range(8))
def test_a_folder_that_a_killed_run_left_mixed_is_refused_and_mended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """Where files go one by one, a reader takes the old run or the new one, never both, and the next run mends it."""
    out = tmp_path / "out"
    write(out, "old", DISCOVERY)
    moves = iter(range(100))
    move = os.replace

    def replaced(source: Path, goal: Path) -> None:
        if next(moves) == step:
            raise OSError(5, "killed here")
        move(source, goal)

    monkeypatch.setattr(result_folder, "exchanged", lambda *_: False)
    monkeypatch.setattr(os, "replace", replaced)
    try:
        write(out, "new")
    except OutputError:
        assert step < len(CALIBRATION)
    found = state(out)
    if is_mixed(out):
        assert (found["model.json"], found["result.json"]) == ("old", "new")
    else:
        assert found["model.json"] == found["result.json"]
    monkeypatch.setattr(os, "replace", move)
    write(out, "newer")

    assert state(out) == dict.fromkeys(CALIBRATION, "newer")


def test_a_folder_in_which_somebody_works_keeps_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A shell that stands in the folder, or a link to it, sees the new files there."""
    out, link = tmp_path / "out", tmp_path / "link"
    write(out, "old")
    link.symlink_to(out)
    write(link, "new")
    assert link.is_symlink() and state(out) == dict.fromkeys(CALIBRATION, "new")
    before = out.stat().st_ino
    monkeypatch.chdir(out)
    write(Path("."), "newer")

    assert out.stat().st_ino == before
    assert state(Path(".")) == dict.fromkeys(CALIBRATION, "newer")


def test_leftovers_of_killed_runs_are_swept_and_drafts_of_living_ones_are_not(tmp_path: Path) -> None:
    """What nobody holds a lock on goes with the next run; a draft that is being written stays."""
    dead = tmp_path / f".{'0' * 32}-out"
    dead.mkdir()
    (dead / "model.json").write_text("half")
    other = tmp_path / f".{'0' * 32}-another"
    other.mkdir()
    with drafted(tmp_path, "out", is_folder=True) as living:
        write(tmp_path / "out", "new")
        assert living.is_dir()

    assert not dead.exists() and not living.exists() and other.exists()


def _write_for_ever(folder: Path, mark: str) -> None:
    # What tests before this one have left in this process may take a Ctrl-C for itself.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOPS)
    for n in range(10**9):
        write(folder, f"{mark}{n}", DISCOVERY if n % 2 else CALIBRATION)


def _started(process: multiprocessing.process.BaseProcess) -> None:
    """Start a process that no signal reaches before it writes: until then it would still be pytest that is stopped."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@pytest.fixture
def fork() -> Iterator[multiprocessing.context.BaseContext]:
    """Yield how to start processes that need not import anything."""
    yield multiprocessing.get_context("fork")


@pytest.mark.long
@pytest.mark.parametrize("kills", [30, pytest.param(100, marks=pytest.mark.rates)])
@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_killed_run_leaves_the_old_folder_or_the_new_one(
    tmp_path: Path, fork: multiprocessing.context.BaseContext, by: signal.Signals, kills: int
) -> None:
    """A signal at any moment, Ctrl-C among them: all files are of one run, and the user's own is there."""
    rng, out = np.random.default_rng(0), tmp_path / "out"
    write(out, "first")
    (out / "mine.txt").write_text("mine")
    begun = time.perf_counter()
    write(out, "second")
    # Beside other work one run takes as long as several do alone.
    latest = max(0.03, 6.0 * (time.perf_counter() - begun))
    seen = set()
    for k in range(kills):
        process = fork.Process(target=_write_for_ever, args=(out, f"{k}."))
        _started(process)
        time.sleep(float(rng.uniform(0.005, latest)))
        assert process.pid is not None
        # A Ctrl-C may come where Python can't raise it, and people press it again.
        while process.exitcode is None:
            os.kill(process.pid, by)
            process.join(1.0)
        found = state(out)
        assert len(set(found.values())) == 1 and set(found) in ({*CALIBRATION}, {*DISCOVERY})
        assert (out / "mine.txt").read_text() == "mine"
        assert len(list(tmp_path.iterdir())) <= 2
        assert not is_mixed(out)
        seen |= set(found.values())

    assert len(seen) > kills / 4
    write(out, "last")
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_of_two_runs_at_once_one_wins_whole(tmp_path: Path, fork: multiprocessing.context.BaseContext) -> None:
    """Two processes write into one folder as fast as they can; whenever one looks, all files are of one of them."""
    out = tmp_path / "out"
    write(out, "first")
    processes = [fork.Process(target=_write_for_ever, args=(out, mark)) for mark in "ab"]
    for process in processes:
        process.start()
    time.sleep(0.5)
    for process in processes:
        process.kill()
        process.join()

    assert len(set(state(out).values())) == 1


@pytest.mark.long
@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize("kills", [4, pytest.param(16, marks=pytest.mark.rates)])
def test_a_killed_calibration_leaves_old_results_or_new_ones(tmp_path: Path, kills: int) -> None:
    """The command itself, killed at times from its start to its end: model.json and result.json are of one run."""
    from pincal.builtin import kuka_urdf_path
    from pincal.measure.table import write_table
    from pincal.robot.robot import Robot
    from pincal.simulate.instrument import Instrument
    from pincal.simulate.paper_machine import PaperMachine

    robot, rng = Robot.from_urdf(kuka_urdf_path()), np.random.default_rng(1)
    tracker, out = Instrument(pose=np.eye(4), targets=(0.1, 0.0, 0.2), sigma=5e-5), tmp_path / "out"
    for name, rows in (("old", 60), ("new", 65)):
        q = robot.random_configurations(rows, rng)
        read = tracker.measure(PaperMachine(), q, rng=rng, payload=80.0)
        write_table(tmp_path / f"{name}.csv", read | dict(zip(robot.joint_names, q.T, strict=True)))

    def command(table: str) -> list[str]:
        given = ["--model", "geometric", "--out", str(out), "--quiet"]
        return ["calibrate", str(kuka_urdf_path()), str(tmp_path / f"{table}.csv"), *given]

    def started(table: str) -> multiprocessing.process.BaseProcess:
        process = context.Process(target=main, args=(command(table),))
        process.start()
        return process

    def rows() -> set[tuple[str, int]]:
        inputs = json.loads((out / "model.json").read_text())["provenance"]["inputs"]
        counts = json.loads((out / "result.json").read_text())["rows"]
        return {(name, counts["train"]) for name in inputs if name.endswith(".csv")}

    with pytest.raises(SystemExit) as ended:
        main(command("old"))
    assert not ended.value.code
    # Processes that begin with all imported that the command took here.
    context = multiprocessing.get_context("forkserver")
    taken = re.compile(r"(pincal|jinja2|matplotlib|numba|polars|trimesh|yourdfpy)\.(?!__main__)")
    context.set_forkserver_preload(sorted(filter(taken.match, sys.modules)))
    # The first begins the server that forks them.
    first = context.Process(target=time.sleep, args=(0.0,))
    first.start()
    first.join()
    begun = time.perf_counter()
    whole_run = started("old")
    whole_run.join()
    whole = time.perf_counter() - begun
    assert whole_run.exitcode == 0
    for k in range(kills):
        table = ("new", "old")[k % 2]
        # Most of the kills fall into the last fifth, where the files are written.
        after = whole * (rng.uniform(0.1, 1.05) if k % 4 == 0 else rng.uniform(0.8, 1.05))
        process = started(table)
        time.sleep(after)
        process.kill()
        process.join()
        assert rows() in ({("old.csv", 60)}, {("new.csv", 65)})
        read_model(out / "model.json")


def test_a_failure_leaves_no_folder_above(tmp_path: Path) -> None:
    """Folders that were there stay, with what others put into them; new ones go."""
    (tmp_path / "there").mkdir()
    with pytest.raises(ZeroDivisionError), output_folder(tmp_path / "there" / "a" / "b" / "out"):
        raise ZeroDivisionError
    assert not list((tmp_path / "there").iterdir())
    with pytest.raises(ZeroDivisionError), output_folder(tmp_path / "there" / "a" / "out"):
        (tmp_path / "there" / "a" / "other.txt").write_text("kept")
        raise ZeroDivisionError
    assert [file.name for file in (tmp_path / "there" / "a").iterdir()] == ["other.txt"]
