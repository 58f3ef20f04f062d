"""Parallel evaluation of a function over many items, in this process, in others or on a cluster.

Any ``concurrent.futures`` executor can be used: a pool of threads or processes,
``mpi4py.futures.MPIPoolExecutor``, or a Dask cluster by its ``client.get_executor()``. The data of
a function, often a whole calibration, are sent to each worker once, not with each item. Results are
in the order of the items and identical to the last bit on all workers if the function depends only
on its item: a draw has its own seed.
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
from functools import lru_cache, partial
from importlib import import_module
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any, TypeVar

from pincal.errors import BadInputError, WorkersLostError
from pincal.plugins import load_plugin, loaded_plugins
from pincal.thresholds import Count, Scale

_T = TypeVar("_T")
_R = TypeVar("_R")

# Functions that a worker keeps: the current one, and earlier ones.
_KEPT: Count = 4
# A pool with a dead process is broken. A cluster continues, unless its scheduler is gone, or
# several workers died at one task, for which Dask raises this error.
_BROKEN = (BrokenExecutor, CancelledError)
_GIVEN_UP = ("KilledWorker",)
# Interval at which a wait for workers can be interrupted [s].
_GLANCE: Scale = 0.3
# Time in which an executor that was given up ends, unless it never does [s].
_MOMENT: Scale = 0.5

log = logging.getLogger(__name__)


def spread(
    function: Callable[[_T], _R],
    items: Iterable[_T],
    *,
    label: str,
    executor: Executor | None = None,
) -> Iterator[_R]:
    """Return a function's results in the order of the items; with an executor, all tasks are
    submitted at once.

    Args:
        function: the function with all its data; picklable, if the executor needs that.
        items: small arguments: numbers, names, seeds.
        label: name of an item in the log, such as "draw".
        executor: runs the tasks; default: this process, one after the other.

    Raises:
        WorkersLostError: if workers died and no others could continue.
        BadInputError: if workers lack what the function needs.

    Example:
        >>> list(spread(abs, (-1, 2), label="number"))
        [1, 2]
    """
    tasks = list(items)
    begun = (
        map(function, tasks)
        if executor is None
        else _Sender(function, executor, label).begun(function, tasks, label)
    )
    return _logged(begun, label, len(tasks))


def wake(executor: Executor, count: int, module: str) -> None:
    """Start the workers for ``count`` tasks and load a module, which takes processes seconds, in
    advance.

    Example:
        >>> with ThreadPoolExecutor(1) as pool:
        ...     wake(pool, 2, "pincal.spread")
    """
    with _losses(module):
        for _ in range(count):
            executor.submit(import_module, module)


def end_with_parent() -> None:
    """End this process when its parent has ended in any way: an initializer for a pool.

    Otherwise a worker of ``concurrent.futures`` waits forever for its next task, as it holds both
    ends of the pipe.

    Example:
        >>> from concurrent.futures import ProcessPoolExecutor
        >>> from multiprocessing import get_context
        >>> context = get_context("spawn")
        >>> pool = ProcessPoolExecutor(2, mp_context=context, initializer=end_with_parent)
        >>> pool.shutdown()
    """
    from multiprocessing import parent_process

    parent = parent_process()
    if parent is not None:
        threading.Thread(
            target=_end_after, args=(parent.sentinel,), name="end with parent", daemon=True
        ).start()


class _Deaf(SpawnProcess):
    """A worker that ignores Ctrl-C, which a terminal sends to all processes."""

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
    """Yield an executor of local processes, which are terminated after an error or an interruption.

    Example:
        >>> with own_processes() as executor:
        ...     executor.submit(abs, -1).result()
        1
    """
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import active_children

    # A process forked from one with threads may hang.
    context = SpawnContext()
    context.Process = _Deaf  # type: ignore[misc]
    executor = ProcessPoolExecutor(mp_context=context, initializer=end_with_parent)
    try:
        yield executor
    except BaseException:
        # Their results are not needed, and an interrupted import may fail in any way.
        for process in active_children():
            process.terminate()
        _give_up(executor)
        raise
    executor.shutdown(cancel_futures=True)


def _give_up(executor: Executor) -> None:
    """Shut an executor down whose results are not needed, and wait a moment for its end.

    An interruption may have left the lock of a task held, for which its thread then waits forever.
    """
    end = partial(executor.shutdown, cancel_futures=True)
    ending = threading.Thread(target=end, name="give up", daemon=True)
    ending.start()
    ending.join(_MOMENT)


def _end_after(sentinel: int) -> None:
    from multiprocessing.connection import wait

    wait([sentinel])
    # No process is left for messages, and other threads can't be stopped otherwise.
    os._exit(1)


def _logged(results: Iterator[_R], label: str, of: int) -> Iterator[_R]:
    """Yield results, and log their count."""
    for done, result in enumerate(results, 1):
        log.info("%s %d of %d", label, done, of, extra={"done": done, "of": of})
        yield result


def spread_again(
    function: Callable[[_T], _R], items: Iterable[_T], *, label: str, executor: Executor
) -> Iterator[_R]:
    """Return the results of :func:`spread` for a function in repeated use: workers keep it as long
    as it exists here.

    The function is identified by ``id``, as objects without their own equality.
    """
    known = _AT_WORKERS.setdefault(function, [])
    sender = next((one for one in known if one.executor is executor), None)
    if sender is None:
        sender = _Sender(function, executor, label)
        known.append(sender)
    return sender.begun(function, list(items), label)


class _Sender:
    """A function at the workers of an executor, without a reference to it here."""

    def __init__(self, function: Callable[[Any], Any], executor: Executor, label: str) -> None:
        self.executor = executor
        # The client of an executor from Dask's ``Client.get_executor``.
        of_dask = type(executor).__module__ == "distributed.cfexecutor"
        self._client = vars(executor)["_client"] if of_dask else None
        self._file = None
        if isinstance(executor, ThreadPoolExecutor):
            return
        if self._client is not None:
            self._held = _held_by_dask(self._client, function)
            return
        self._file = _File(pickle.dumps(function, pickle.HIGHEST_PROTOCOL))
        self._held = _Sent(uuid.uuid4().hex, loaded_plugins(), self._file.path)

    def begun(self, function: Callable[[_T], _R], tasks: Sequence[_T], label: str) -> Iterator[_R]:
        """Submit all tasks and return their results."""
        if isinstance(self.executor, ThreadPoolExecutor):
            return self.executor.map(function, tasks)
        if self._client is not None:
            return _results(
                [self._client.submit(_call, self._held, task, pure=False) for task in tasks], label
            )
        with _losses(label):
            return _results(
                [self.executor.submit(_call, self._held, task) for task in tasks], label, self._file
            )


# Functions in repeated use, and their senders.
_AT_WORKERS: weakref.WeakKeyDictionary[Callable[[Any], Any], list[_Sender]] = (
    weakref.WeakKeyDictionary()
)


def _results(futures: Sequence[Future[_R]], label: str, *needed: object) -> Iterator[_R]:
    """Return results; tasks are cancelled that nobody waits for any more."""
    results = _awaited(futures, label, *needed)
    # What ends a generator is not done in one that was never asked for anything.
    weakref.finalize(results, _cancel, futures)
    return results


def _cancel(futures: Sequence[Future[Any]]) -> None:
    for future in futures:
        future.cancel()


def _awaited(futures: Sequence[Future[_R]], label: str, *needed: object) -> Iterator[_R]:
    """Yield results; ``needed`` objects are kept alive meanwhile."""
    try:
        for future in futures:
            with _losses(label):
                # An unlimited wait ignores Ctrl-C where a library makes signals restart system
                # calls, as polars does.
                while not future.done():
                    with suppress(TimeoutError):
                        future.exception(timeout=_GLANCE)
                result = future.result()
            yield result
    finally:
        _cancel(futures)


@contextmanager
def _losses(label: str) -> Iterator[None]:
    """Convert errors of lost workers, with advice."""
    try:
        yield
    except Exception as error:
        if not isinstance(error, _BROKEN) and type(error).__name__ not in _GIVEN_UP:
            raise
        raise WorkersLostError(
            f"{label}: workers died, usually for lack of memory; use fewer at once, or a "
            "Dask cluster, which survives the "
            "loss of one. A script that starts processes needs its own code under if "
            '__name__ == "__main__"'
        ) from error


@dataclass(frozen=True)
class _Sent:
    """A function sent to workers.

    Attributes:
        name: unique identifier in all processes.
        plugins: modules that may define its classes.
        content: the pickled function, or the file with it.
    """

    name: str
    plugins: tuple[str, ...] = field(compare=False)
    content: bytes | Path = field(compare=False)

    def itself(self) -> _Sent:
        """Return itself: the task by which a cluster gets it, again if the workers with it have
        died.
        """
        return self


def _call(sent: _Sent, item: Any) -> Any:
    """Do one task."""
    return _received(sent)(item)


@lru_cache(maxsize=_KEPT)
def _received(sent: _Sent) -> Callable[[Any], Any]:
    """Return the function that was sent to this process, read on its first call."""
    for name in sent.plugins:
        load_plugin(name)
    try:
        content = sent.content if isinstance(sent.content, bytes) else sent.content.read_bytes()
    except FileNotFoundError as error:
        raise BadInputError(
            f"{platform.node()}: no file {error.filename}; workers on other machines need a shared "
            "folder for temporary files: set TMPDIR"
        ) from error
    found: Callable[[Any], Any] = pickle.loads(content)
    return found


class _File:
    """A temporary file that exists as long as this object."""

    def __init__(self, content: bytes) -> None:
        place, path = tempfile.mkstemp(prefix="pincal-", suffix=".pickle")
        self.path = Path(path)
        weakref.finalize(self, self.path.unlink, missing_ok=True)
        with open(place, "wb") as file:
            file.write(content)


def _held_by_dask(client: Any, function: Callable[[Any], Any]) -> Any:
    """Send a function to a Dask cluster by its client, as futures of its executor wait forever for
    lost data.
    """
    import cloudpickle

    sent = _Sent(uuid.uuid4().hex, loaded_plugins(), cloudpickle.dumps(function))
    # A task, as scattered data are lost with their workers; Dask warns of large tasks.
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        return client.submit(_Sent.itself, sent, pure=False)
