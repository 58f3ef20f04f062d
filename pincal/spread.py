"""One function over many items, wherever there are workers: here, in other processes, on a cluster.

Any ``concurrent.futures`` executor does: a pool of threads or processes, ``mpi4py.futures.MPIPoolExecutor``, or a Dask
cluster by its ``client.get_executor()``. What a function holds, often a whole calibration, goes to each worker once, not
with each item. Results come in the order of the items and are the same wherever they were made, to the last bit, if the
function depends on its item alone: a draw brings its own seed.
"""

from __future__ import annotations

import logging
import os
import pickle
import platform
import signal
import tempfile
import threading
import uuid
import warnings
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import import_module
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any, TypeVar

from pincal.errors import BadInputError, WorkersLostError
from pincal.plugins import load_plugin, loaded_plugins

_T = TypeVar("_T")
_R = TypeVar("_R")

# What a worker keeps of what it was sent: the present work, and what it began before.
_KEPT = 4
# A pool with a dead process does nothing more. A cluster goes on, unless its scheduler is gone, or several workers died at
# one task, which Dask calls by this name.
_BROKEN = (BrokenExecutor, CancelledError)
_GIVEN_UP = ("KilledWorker",)
# How often a wait for workers is interrupted to see whether it is still wanted [s].
_GLANCE = 0.3

log = logging.getLogger(__name__)


def spread(
    function: Callable[[_T], _R], items: Iterable[_T], *, label: str, executor: Executor | None = None
) -> Iterator[_R]:
    """Return a function's results in the order of the items; an executor begins all before the first is asked for.

    Args:
        function: what is to be done, with all that it needs but its item; picklable, if the executor needs that.
        items: small things: numbers, names, seeds.
        label: what one item is called in the log, such as "draw".
        executor: does the work; default: here, one after the other.

    Raises:
        WorkersLostError: if workers died and nobody could go on with their work.
        BadInputError: if workers lack what the function needs.

    Example:
        >>> list(spread(abs, (-1, 2), label="number"))
        [1, 2]
    """
    tasks = list(items)
    begun = map(function, tasks) if executor is None else _Sender(function, executor, label).begun(function, tasks, label)
    return _told(begun, label, len(tasks))


def wake(executor: Executor, count: int, module: str) -> None:
    """Have the workers of so many tasks begin and load a module, which takes processes seconds, before there are the tasks.

    Example:
        >>> with ThreadPoolExecutor(1) as pool:
        ...     wake(pool, 2, "pincal.spread")
    """
    with _losses(module):
        for _ in range(count):
            executor.submit(import_module, module)


def end_with_parent() -> None:
    """Have this process end once the one that started it is gone, however that ended: for the initializer of a pool.

    A worker of ``concurrent.futures`` waits for its next task for ever, as it holds both ends of the pipe of tasks.

    Example:
        >>> from concurrent.futures import ProcessPoolExecutor
        >>> from multiprocessing import get_context
        >>> pool = ProcessPoolExecutor(2, mp_context=get_context("spawn"), initializer=end_with_parent)
        >>> pool.shutdown()
    """
    from multiprocessing import parent_process

    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent.sentinel,), name="end with parent", daemon=True).start()


class _Deaf(SpawnProcess):
    """A worker that leaves Ctrl-C, which a terminal sends to all, to the process that started it."""

    def start(self) -> None:
        if not hasattr(signal, "pthread_sigmask"):
            return super().start()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def own_processes() -> Iterator[Executor]:
    """Yield an executor of processes of this machine; after an error or an interruption they end at once.

    Example:
        >>> with own_processes() as executor:
        ...     executor.submit(abs, -1).result()
        1
    """
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import active_children

    # A process that is forked from one with threads may hang.
    context = SpawnContext()
    context.Process = _Deaf  # type: ignore[misc]
    executor = ProcessPoolExecutor(mp_context=context, initializer=end_with_parent)
    try:
        yield executor
    except BaseException:
        # Nobody waits for what they do; and an import that is interrupted may fail as any other.
        for process in active_children():
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def _end_after(sentinel: int) -> None:
    from multiprocessing.connection import wait

    wait([sentinel])
    # Nobody is left to hear of anything, and what runs in other threads can't be stopped otherwise.
    os._exit(1)


def _told(results: Iterator[_R], label: str, of: int) -> Iterator[_R]:
    """Yield results, and log how many there are."""
    for done, result in enumerate(results, 1):
        log.info("%s %d of %d", label, done, of, extra={"done": done, "of": of})
        yield result


def spread_again(function: Callable[[_T], _R], items: Iterable[_T], *, label: str, executor: Executor) -> Iterator[_R]:
    """Return what :func:`spread` does, of a function that is called again: workers have it for as long as it lives here.

    Args:
        function: compared by identity, as objects are that define no equality of their own.
        items: small things.
        label: what one item is called if workers die.
        executor: does the work.
    """
    known = _AT_WORKERS.setdefault(function, [])
    sender = next((one for one in known if one.executor is executor), None)
    if sender is None:
        sender = _Sender(function, executor, label)
        known.append(sender)
    return sender.begun(function, list(items), label)


class _Sender:
    """A function where the workers of an executor find it; here it may die meanwhile."""

    def __init__(self, function: Callable[[Any], Any], executor: Executor, label: str) -> None:
        self.executor = executor
        # Of an executor that Dask's ``Client.get_executor`` made, the client.
        of_dask = type(executor).__module__ == "distributed.cfexecutor"
        self._client, self._file = vars(executor)["_client"] if of_dask else None, None
        if isinstance(executor, ThreadPoolExecutor):
            return
        if self._client is not None:
            self._held = _held_by_dask(self._client, function)
            return
        self._file = _File(pickle.dumps(function, pickle.HIGHEST_PROTOCOL))
        self._held = _Sent(uuid.uuid4().hex, loaded_plugins(), self._file.path)

    def begun(self, function: Callable[[_T], _R], tasks: Sequence[_T], label: str) -> Iterator[_R]:
        """Submit all tasks."""
        if isinstance(self.executor, ThreadPoolExecutor):
            return self.executor.map(function, tasks)
        if self._client is not None:
            return _results([self._client.submit(_call, self._held, task, pure=False) for task in tasks], label)
        with _losses(label):
            return _results([self.executor.submit(_call, self._held, task) for task in tasks], label, self._file)


# What is called again, and where its workers find it.
_AT_WORKERS: weakref.WeakKeyDictionary[Callable[[Any], Any], list[_Sender]] = weakref.WeakKeyDictionary()


def _results(futures: Sequence[Future[_R]], label: str, *needed: object) -> Iterator[_R]:
    """Yield results; what the tasks need lives for as long as there are some to come."""
    try:
        for future in futures:
            with _losses(label):
                # A wait without an end outlasts Ctrl-C where a library has it restart system calls, as polars does.
                while not future.done():
                    with suppress(TimeoutError):
                        future.exception(timeout=_GLANCE)
                result = future.result()
            yield result
    finally:
        for future in futures:
            future.cancel()


@contextmanager
def _losses(label: str) -> Iterator[None]:
    """Say what to do when workers were lost."""
    try:
        yield
    except Exception as error:
        if not isinstance(error, _BROKEN) and type(error).__name__ not in _GIVEN_UP:
            raise
        raise WorkersLostError(
            f"{label}: workers died, most often for want of memory; try fewer at once, or a Dask cluster, which outlives "
            'the death of one. A script that starts processes needs its own code under if __name__ == "__main__"'
        ) from error


@dataclass(frozen=True)
class _Sent:
    """A function on its way to workers.

    Attributes:
        name: of this function, in every process.
        plugins: modules that its classes may come from.
        content: pickled, or the file where that stands.
    """

    name: str
    plugins: tuple[str, ...] = field(compare=False)
    content: bytes | Path = field(compare=False)

    def itself(self) -> _Sent:
        """Return it: the task by which a cluster has it, and has it again when the workers that had it are dead."""
        return self


def _call(sent: _Sent, item: Any) -> Any:
    """Do one task."""
    return _received(sent)(item)


@lru_cache(maxsize=_KEPT)
def _received(sent: _Sent) -> Callable[[Any], Any]:
    """Return the function that was sent to this process, read when it is first called."""
    for name in sent.plugins:
        load_plugin(name)
    try:
        content = sent.content if isinstance(sent.content, bytes) else sent.content.read_bytes()
    except FileNotFoundError as error:
        raise BadInputError(
            f"{platform.node()}: no file {error.filename}; workers on other machines need a folder for temporary "
            "files that all of them see: set TMPDIR"
        ) from error
    found: Callable[[Any], Any] = pickle.loads(content)
    return found


class _File:
    """A temporary file that lives as long as this object."""

    def __init__(self, content: bytes) -> None:
        place, path = tempfile.mkstemp(prefix="pincal-", suffix=".pickle")
        self.path = Path(path)
        weakref.finalize(self, self.path.unlink, missing_ok=True)
        with open(place, "wb") as file:
            file.write(content)


def _held_by_dask(client: Any, function: Callable[[Any], Any]) -> Any:
    """Give a function to a Dask cluster, by its client: futures of its executor wait for ever for what is lost."""
    import cloudpickle

    sent = _Sent(uuid.uuid4().hex, loaded_plugins(), cloudpickle.dumps(function))
    # A task and not scattered, as what only workers have is lost with them; Dask warns of tasks that hold much.
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        return client.submit(_Sent.itself, sent, pure=False)
