"""A Dask cluster of processes on this machine: nothing is lost with a worker, and what it costs; the same by MPI."""

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import run
from test_calibrate import paper_table
from test_cli_stations import URDF, tracked, written
from test_examples import EXAMPLES
from test_examples import started as run_example
from test_spread import TASK, Parcel, die, nap, opened

from pincal import GEOMETRIC, Options, Robot, calibrate, load_plugin, plugins
from pincal import simulate as sim
from pincal.errors import BadInputError, WorkersLostError
from pincal.model.effect_registry import EFFECTS
from pincal.spread import spread

pytestmark = pytest.mark.long
# So many workers, and so many of them that a task may kill.
WORKERS, FAILURES = 3, 1


def knows(name: str) -> bool:
    return name in EFFECTS.known()


@pytest.fixture(scope="module")
def client() -> Iterator[Any]:
    """Return the client of a cluster that is there for all of these tests."""
    dask = pytest.importorskip("dask", reason="Dask is not installed")
    distributed = pytest.importorskip("distributed", reason="Dask is not installed")
    options = {"n_workers": WORKERS, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": logging.CRITICAL}
    # A worker that dies is replaced by one that imports everything again, for some seconds of processor time.
    given_up = dask.config.set({"distributed.scheduler.allowed-failures": FAILURES})
    with (
        given_up,
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield client


def test_workers_cost_little_beside_tasks_of_a_tenth_of_a_second(client: Any) -> None:
    """They take less than a fifth longer than the tasks themselves, in the best of four rounds."""
    tasks = range(20 * WORKERS)
    list(spread(nap, range(WORKERS), label="nap", executor=client.get_executor()))

    def wall() -> float:
        begun = time.perf_counter()
        assert list(spread(nap, tasks, label="nap", executor=client.get_executor())) == [*tasks]
        return time.perf_counter() - begun

    assert any(wall() < 1.2 * TASK * len(tasks) / WORKERS for _ in range(4))


def test_a_worker_is_sent_the_function_once(client: Any, tmp_path: Path) -> None:
    """Not with each task."""
    found = spread(partial(opened, Parcel(tmp_path)), range(60), label="item", executor=client.get_executor())
    assert list(found) == [*range(60)]
    openings = [file.name.partition("-")[0] for file in tmp_path.iterdir()]
    assert len(openings) == len(set(openings)) <= WORKERS


def test_stations_are_summed_on_a_cluster(client: Any, kuka: Robot) -> None:
    """To the last bit as here, by workers who have the stations from the first sum on."""
    tables, options = [paper_table(kuka, 40, seed=seed) for seed in (1, 2)], Options(effects=GEOMETRIC)
    there = calibrate(kuka, tables, options, executor=client.get_executor())
    np.testing.assert_array_equal(there.values, calibrate(kuka, tables, options).values)


def test_workers_know_the_plugins(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that were loaded here; without them an effect would not be looked for, and nobody would know."""
    assert not any(client.run(knows, "hose_pull").values())
    load_plugin(str(EXAMPLES / "hose_pull.py"))
    assert all(spread(knows, ["hose_pull"] * 8, label="item", executor=client.get_executor()))
    monkeypatch.setattr(plugins, "_loaded", {"no_such_module": None})
    with pytest.raises(BadInputError, match="plugin 'no_such_module': no such module"):
        list(spread(knows, ["hose_pull"], label="item", executor=client.get_executor()))


def test_the_command_gives_the_same_on_a_cluster(client: Any, kuka: Robot, tmp_path: Path) -> None:
    """Each station predicted by the others, with --dask and without."""
    machine = sim.TrueMachine.from_urdf(URDF, tip="tool0")
    days = written(tmp_path, {name: tracked(machine, np.eye(4), poses=40, seed=i) for i, name in enumerate(("mo", "tu"))})
    command = ("calibrate", URDF, *days, "--model", "geometric", "--split", "station", "--quiet", "--out")
    address = client.scheduler.address
    assert run(*command, tmp_path / "here") == run(*command, tmp_path / "there", "--dask", address) == 0
    here, there = (json.loads((tmp_path / name / "result.json").read_text()) for name in ("here", "there"))
    assert here["stations"] == there["stations"] and here["error"] == there["error"]


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("tcp://127.0.0.1:9", "no answer within 5 s; expected the address of a running Dask scheduler"),
        ("nonsense", "missing port number"),
    ],
)
def test_an_address_where_nobody_is_is_refused(
    address: str, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Within seconds, with the exit code of invalid input."""
    begun = time.process_time()
    arguments = ("calibrate", URDF, tmp_path / "mo.csv", tmp_path / "tu.csv", "--split", "station", "--dask", address)
    assert run(*arguments, "--quiet", "--out", tmp_path / "out") == 3
    assert f"--dask {address}: {why}" in capsys.readouterr().err
    assert time.process_time() - begun < 10.0


def test_a_cluster_without_work_is_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An option is not ignored in silence."""
    assert run("calibrate", URDF, tmp_path / "mo.csv", "--dask", "tcp://127.0.0.1:9", "--out", tmp_path / "out") == 2
    assert "--dask: there are no repeated fits to distribute; calibrate has them with" in capsys.readouterr().err


def test_a_worker_is_no_scheduler(client: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nor anything else that listens."""
    address = next(iter(client.run(os.getpid)))
    arguments = ("calibrate", URDF, tmp_path / "mo.csv", tmp_path / "tu.csv", "--split", "station", "--dask", address)
    assert run(*arguments, "--quiet", "--out", tmp_path / "out") == 3
    assert f"--dask {address}: this is the address of a worker; expected" in capsys.readouterr().err


def test_the_example_makes_its_draws_on_dask(client: Any, tmp_path: Path) -> None:
    """Each as a loop would make it."""
    printed = run_example("on_a_cluster.py", "--draws", "20", "--dask", client.scheduler.address, folder=tmp_path)
    assert "20 draws; the first 4 as one loop makes them: True" in printed


def test_the_example_makes_its_draws_by_mpi(tmp_path: Path) -> None:
    """The same by mpi4py.futures, whose workers are other processes of one MPI run."""
    pytest.importorskip("mpi4py", reason="mpi4py is not installed")
    mpiexec = shutil.which("mpiexec", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if mpiexec is None:
        pytest.skip("no MPI here: no mpiexec")
    command = [mpiexec, "-n", "3", sys.executable, "-m", "mpi4py.futures", str(EXAMPLES / "on_a_cluster.py"), "--mpi"]
    done = subprocess.run([*command, "--draws", "20"], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "20 draws; the first 4 as one loop makes them: True" in done.stdout


class Killer(logging.Handler):
    """Kills a worker when a quarter of the draws is there."""

    def __init__(self, pid: int) -> None:
        super().__init__()
        self.pid, self.killed = pid, False

    def emit(self, record: logging.LogRecord) -> None:
        """Look how many there are."""
        if not self.killed and 4 * record.done >= record.of:  # type: ignore[attr-defined]
            os.kill(self.pid, signal.SIGKILL)
            self.killed = True


def test_nothing_is_lost_with_a_worker(kuka: Robot, client: Any) -> None:
    """Of 80 bootstrap draws each is what one loop makes it, bit by bit, although a worker is killed midway."""
    fit = calibrate(kuka, paper_table(kuka, 60, 0, 5e-5), Options(effects=GEOMETRIC, payload_centre=(0.08, -0.05, 0.22)))
    log, killer = logging.getLogger("pincal.spread"), Killer(next(iter(client.run(os.getpid).values())))
    level = log.level
    log.setLevel(logging.INFO)
    log.addHandler(killer)
    try:
        draws = fit.bootstrap(draws=80, executor=client.get_executor())
    finally:
        log.removeHandler(killer)
        log.setLevel(level)
    assert killer.killed
    np.testing.assert_array_equal(draws, fit.bootstrap(draws=80))


def test_a_task_that_kills_workers_is_given_up(client: Any) -> None:
    """After the second worker, with advice."""
    with pytest.raises(WorkersLostError, match="draw: workers died, usually for lack of memory"):
        list(spread(die, range(1), label="draw", executor=client.get_executor()))
