"""Work spread over workers: same results in the same order on any executor, sent once, and what happens when some die."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

from pincal.errors import BadInputError, WorkersLostError
from pincal.spread import _results, own_processes, spread

TASK = 0.1  # how long a nap is [s]


class Parcel:
    """Something that notes in a folder which process opened it, and how often."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        (self.folder / f"{os.getpid()}-{time.perf_counter_ns()}").touch()


def opened(parcel: Parcel, item: int) -> int:
    time.sleep(0.01)
    return item


def late_first(item: int) -> int:
    time.sleep(0.1 if item == 0 else 0.0)
    return item


def nap(item: int) -> int:
    time.sleep(TASK)
    return item


def die(item: int) -> None:
    os.kill(os.getpid(), 9)


def refuse(item: int) -> None:
    raise BadInputError(f"no {item}")


@pytest.fixture(scope="module")
def processes() -> Iterator[Executor]:
    with ProcessPoolExecutor(2, mp_context=get_context("fork")) as executor:
        yield executor


def test_results_come_in_the_order_of_the_items(processes: Executor) -> None:
    """Whoever is ready first, and whoever does the work."""
    with ThreadPoolExecutor(2) as threads:
        for executor in (None, threads, processes):
            assert list(spread(late_first, range(5), label="item", executor=executor)) == [0, 1, 2, 3, 4]


def test_a_process_is_sent_the_function_once(processes: Executor, tmp_path: Path) -> None:
    """Not with each item, and nothing is left of it."""
    before = set(Path(tempfile.gettempdir()).glob("pincal-*.pickle"))
    assert list(spread(partial(opened, Parcel(tmp_path)), range(40), label="item", executor=processes)) == [*range(40)]
    openings = [file.name.partition("-")[0] for file in tmp_path.iterdir()]
    assert len(openings) == len(set(openings)) <= 2 and str(os.getpid()) not in openings
    assert set(Path(tempfile.gettempdir()).glob("pincal-*.pickle")) <= before


def test_an_error_of_a_task_is_raised_as_it_is(processes: Executor) -> None:
    """As it would be here."""
    with pytest.raises(BadInputError, match=r"^no 0$"):
        list(spread(refuse, range(3), label="item", executor=processes))


def test_what_nobody_waits_for_is_not_begun() -> None:
    """Results that are given up before any of them was asked for: a task that runs ends, others never begin."""
    begun = []

    def noted(item: int) -> None:
        begun.append(item)
        time.sleep(TASK)

    with ThreadPoolExecutor(1) as threads:
        results = _results([threads.submit(noted, item) for item in range(5)], "item")
        del results
    assert begun in ([], [0])


def test_a_broken_pool_says_what_to_do() -> None:
    """A process that is killed takes its pool with it; so does the next work that is given to it."""
    with ProcessPoolExecutor(1, mp_context=get_context("fork")) as executor:
        for _ in range(2):
            with pytest.raises(WorkersLostError, match=r"^draw: workers died, usually for lack of memory; use fewer"):
                list(spread(die, range(3), label="draw", executor=executor))


POOL = """
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pincal.spread import end_with_parent

if __name__ == "__main__":
    with ProcessPoolExecutor(2, mp_context=get_context("spawn"), initializer=end_with_parent) as pool:
        list(pool.map(abs, range(8)))
        sleeping = [pool.submit(time.sleep, 3600) for _ in range(3)]
        print("at work", flush=True)
        sleeping[0].result()
"""


def ends_whole(command: list[Any], *, after: str, by: signal.Signals) -> None:
    """Run a command, kill it once it has written a line, and wait until nobody holds its streams any more."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    assert any(after in line for line in process.stdout), "it ended before"
    process.send_signal(by)
    process.communicate(timeout=60)
    assert process.returncode == -by


@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path, by: signal.Signals) -> None:
    """Workers in the middle of a task of an hour end, too."""
    (tmp_path / "pool.py").write_text(POOL)
    ends_whole([sys.executable, tmp_path / "pool.py"], after="at work", by=by)


@pytest.mark.long
def test_workers_of_a_discovery_that_is_killed_end(tmp_path: Path) -> None:
    """Nothing of ``pincal discover`` goes on when the command was killed amid the halves of the poses."""
    pincal, table = [sys.executable, "-m", "pincal"], tmp_path / "table.csv"
    subprocess.run([*pincal, "simulate", "ur5", "--poses", "60", "--seed", "3", "--out", table], check=True)
    command = [*pincal, "discover", "ur5", table, "--out", tmp_path / "found"]
    ends_whole(command, after="subsample 2 of 20", by=signal.SIGKILL)
    assert not (tmp_path / "found").exists()


INTERRUPTED = """import signal, sys, time
from pincal.spread import _results, own_processes, spread

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.siginterrupt(signal.SIGINT, False)
    with own_processes() as executor:
        print("waits", flush=True)
        list(spread(time.sleep, [60.0], label="nap", executor=executor))
"""


def test_a_wait_for_workers_ends_with_an_interruption(tmp_path: Path) -> None:
    """Even where a library has set SIGINT to restart what it interrupts, as polars does: it took until the next result."""
    (tmp_path / "wait.py").write_text(INTERRUPTED)
    running = subprocess.Popen(
        [sys.executable, tmp_path / "wait.py"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert running.stdout is not None and running.stdout.readline() == "waits\n"
    time.sleep(1.0)
    began = time.monotonic()
    running.send_signal(signal.SIGINT)
    assert "KeyboardInterrupt" in running.communicate(timeout=50)[1]
    assert time.monotonic() - began < 5.0


def test_a_lock_that_an_interruption_left_held_does_not_keep_the_process() -> None:
    """The thread of the pool waits for it, as after an interruption between taking a lock and using it."""
    with pytest.raises(KeyboardInterrupt), own_processes() as executor:
        tasks = [executor.submit(time.sleep, 0.0) for _ in range(50)]
        held = tasks[-1]._condition
        held.acquire()
        began = time.monotonic()
        raise KeyboardInterrupt
    took = time.monotonic() - began
    held.release()

    assert took < 3.0
