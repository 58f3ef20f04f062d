"""Loops that are compiled once for a machine: what was kept of them is used if it is whole, and compiled anew if it isn't.

Numba keeps machine code in files and takes what it finds there for its own: a file that was cut off ends the program, one
with other bytes may crash it or compute something else.
"""

from __future__ import annotations

import logging
import pickle
import zlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.serialize import dumps

log = logging.getLogger(__name__)


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function when it is first called, and keeps what came of it for later runs.

    Args:
        options: those of ``numba.njit``, but for ``cache``.
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
    """What is kept of a loop: its bytes, and their checksum."""

    def reduce(self, result: Any) -> tuple[int, bytes]:
        """Return what is written."""
        content = dumps(super().reduce(result))
        return zlib.crc32(content), content

    def rebuild(self, context: Any, kept: tuple[int, bytes]) -> Any:
        """Return the compiled loop, if what was read is what was written."""
        checksum, content = kept
        if zlib.crc32(content) != checksum:
            raise ValueError("wrong checksum")
        return super().rebuild(context, pickle.loads(content))


class _Cache(FunctionCache):
    """A place for what is compiled that never keeps a program from compiling it."""

    _impl_class = _Summed

    def load_overload(self, signature: Any, context: Any) -> Any:
        """Return what was kept, None if nothing was or it is damaged, which is then dropped."""
        try:
            return super().load_overload(signature, context)
        except Exception as error:
            log.info("what was compiled earlier is damaged and is compiled anew: %s: %r", self.cache_path, error)
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep what was compiled, if there is a place for it."""
        try:
            super().save_overload(signature, result)
        except Exception as error:
            log.info("what was compiled can't be kept: %s: %r", self.cache_path, error)
