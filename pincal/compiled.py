"""Compiled loops, cached on each machine and recompiled if the cache is damaged.

Numba trusts the machine code in its cache: a truncated file ends the program, and other bytes may
crash it or give wrong results.
"""

from __future__ import annotations

import gc
import logging
import os
import pickle
import warnings
import zlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from numba import njit
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps

from pincal.errors import PincalWarning

log = logging.getLogger(__name__)


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function on its first call and caches it for later runs.

    Args:
        options: of ``numba.njit``, except ``cache``.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        loop = njit(**options)(function)
        try:
            # As njit(cache=True) does.
            loop._cache = _Cache(function)
        except RuntimeError as error:
            log.info("each run compiles its loops: %s", error)
        return loop

    return decorate


class _Summed(CompileResultCacheImpl):
    """A cached loop: its bytes, and their checksum."""

    def reduce(self, result: Any) -> tuple[int, bytes]:
        """Return checksum and bytes."""
        content = dumps(super().reduce(result))
        return zlib.crc32(content), content

    def rebuild(self, context: Any, kept: tuple[int, bytes]) -> Any:
        """Return the compiled loop, if the checksum is right."""
        checksum, content = kept
        if zlib.crc32(content) != checksum:
            raise ValueError("wrong checksum")
        return super().rebuild(context, pickle.loads(content))


class _Cache(FunctionCache):
    """A cache whose faults never prevent compilation."""

    _impl_class = _Summed

    def __init__(self, function: Any) -> None:
        """Invalidate the cache when any file with parts of the loop changes."""
        super().__init__(function)
        others = sorted(_files_of(function, set()) - {function.__code__.co_filename})
        changed = [(status.st_mtime, status.st_size) for status in map(os.stat, others)]
        self._cache_file._source_stamp = (self._cache_file._source_stamp, *changed)

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return the cached loop; None if there is none, or if it is damaged, which empties the
        cache.
        """
        try:
            return super().load_overload(signature, context)
        except Exception as error:
            log.info(
                "the cache of compiled loops is damaged; recompiling: %s: %r",
                self.cache_path,
                error,
            )
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Cache a compiled loop, if possible."""
        try:
            super().save_overload(signature, result)
        except Exception as error:
            log.info("compiled loops can't be cached: %s: %r", self.cache_path, error)


def _files_of(function: Any, known: set[str]) -> set[str]:
    """Return the files of a loop and of all loops it may call."""
    if function.__code__.co_filename not in known:
        known.add(function.__code__.co_filename)
        for other in function.__globals__.values():
            if isinstance(other, Dispatcher):
                _files_of(other.py_func, known)
    return known


def announce(module: str) -> None:
    """Log once if the loops of a module have to be compiled."""
    event.register("numba:compile", _Compiling(module))


def _tell(words: str) -> None:
    """Log a message; warn where nobody reads the log, as in a session of Python."""
    if log.isEnabledFor(logging.INFO):
        log.info(words)
        return
    # In a session that makes errors of warnings, this one is none.
    with suppress(PincalWarning):
        warnings.warn(f"pincal is {words}", PincalWarning, stacklevel=2)


class _Compiling(event.Listener):
    """Logs once that the loops of a module are being compiled, for which the first command on a
    machine waits.

    Garbage collection, which would take a sixth of the time and find nothing, is disabled
    meanwhile.
    """

    def __init__(self, module: str) -> None:
        self._module = module
        self._is_due = True
        self._depth = 0
        self._collects = False

    def on_start(self, event: event.Event) -> None:
        """Log the first loop, and disable garbage collection."""
        if not self._is_ours(event):
            return
        if self._is_due:
            self._is_due = False
            _tell("compiling once for this machine, ten to twenty seconds")
        if not self._depth:
            self._collects = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        """Enable garbage collection after the last one."""
        if self._is_ours(event):
            self._depth -= 1
            if not self._depth and self._collects:
                gc.enable()

    def _is_ours(self, event: event.Event) -> bool:
        return bool(event.data["dispatcher"].py_func.__module__ == self._module)
