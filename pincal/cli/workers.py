"""Where a command has work done that it repeats: by processes of this machine, or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from pincal.cli.arguments import option
from pincal.errors import BadInputError

if TYPE_CHECKING:
    from concurrent.futures import Executor

# How long a cluster may take to answer, and then to have a worker [s].
_ANSWER, _WORKER = 5.0, 10.0

dask_option = partial(
    option,
    "Do what is repeated, such as the models of half of the poses or all stations but one, on this Dask cluster.",
    metavar="ADDRESS",
    words="this machine",
)


@contextmanager
def workers(dask: str | None, *, repeats: bool, processes: bool = True) -> Iterator[Executor | None]:
    """Yield what does the work that a command repeats, None for the command itself; what is not begun ends with the context.

    Args:
        dask: address of a Dask scheduler; default: this machine.
        repeats: whether the command repeats any.
        processes: whether this machine does it by a process for each core, which take seconds to start.

    Raises:
        BadInputError: if the cluster can't be used.
    """
    if dask is not None and not repeats:
        raise click.UsageError(
            "--dask: nothing is repeated here that a cluster could do; calibrate repeats with --split station, discover "
            "unless --stability is 0"
        )
    with ExitStack() as stack:
        executor: Executor | None = None
        if dask is not None:
            executor = _connected(dask, stack).get_executor()
        elif repeats and processes:
            executor = _processes()
            stack.callback(executor.shutdown, cancel_futures=True)
        yield executor


def _processes() -> Executor:
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    from pincal.spread import end_with_parent

    # A process that is forked from one with threads may hang.
    return ProcessPoolExecutor(mp_context=get_context("spawn"), initializer=end_with_parent)


def _connected(address: str, stack: ExitStack) -> Any:
    """Return a client of a cluster whose workers have the same pincal."""
    try:
        from distributed import Client
    except ImportError as error:
        raise BadInputError("--dask needs Dask: run pip install 'pincal[cluster]', here and on the workers") from error
    import asyncio
    from importlib.metadata import PackageNotFoundError, version

    try:
        found = asyncio.run(asyncio.wait_for(_identity(address), _ANSWER))
        if found["type"] != "Scheduler":
            raise ValueError(f"it is a {found['type'].lower()}'s")
    except (OSError, ValueError) as error:
        why = str(error) or f"no answer within {_ANSWER:g} s"
        raise BadInputError(
            f"--dask {address}: {why}; expected the address of a running Dask scheduler, such as tcp://10.0.0.5:8786"
        ) from error
    client = stack.enter_context(Client(address, timeout=_ANSWER, set_as_default=False))
    try:
        client.wait_for_workers(1, timeout=_WORKER)
    except TimeoutError as error:
        raise BadInputError(f"--dask {address}: the cluster has no workers; start some: dask worker {address}") from error
    try:
        there = client.run(version, "pincal")
    except PackageNotFoundError as error:
        raise BadInputError(
            f"--dask {address}: its workers lack pincal; install version {version('pincal')} there"
        ) from error
    if others := {found for found in there.values()} - {version("pincal")}:
        raise BadInputError(
            f"--dask {address}: its workers have pincal {', '.join(sorted(others))}; expected {version('pincal')}, as here"
        )
    return client


async def _identity(address: str) -> dict[str, Any]:
    """Ask who listens. A client would wait for ever for the answer of what is no scheduler, such as its own dashboard."""
    from distributed.core import rpc
    from distributed.security import Security

    async with rpc(address, connection_args=Security().get_connection_args("client")) as there:
        return dict(await there.identity())
