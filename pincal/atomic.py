"""Atomic writing of files and folders.

A draft is in the same folder as its destination and locked by the process that writes it. A killed
process leaves its draft unlocked; the next one that writes to the same path removes it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import platform
import re
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from pincal.errors import OutputError
from pincal.thresholds import Count

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:
    # Without locks it is unknown whether the process that wrote a draft still runs: none is
    # removed.
    fcntl = None

ELSEWHERE = "choose a folder that exists and is writable"

# Drafts that are tried if others remove them as leftovers before they are locked, which takes a
# coincidence for each.
_TRIES: Count = 20

# renameat2(2): paths relative to the working directory, and both names exchanged. renamex_np(2) of
# macOS: likewise.
_AT_FDCWD: Count = -100
_RENAME_EXCHANGE: Count = 2


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], *, advice: str = ELSEWHERE) -> Iterator[Path]:
    """Yield a draft in the folder of ``path`` that replaces it on success; after an error ``path``
    is unchanged.

    Args:
        path: the file to write.
        advice: what the user can do if it can't be written.

    Yields:
        The draft's path, with the ending of ``path``, by which some writers choose their format.

    Raises:
        OutputError: if the file can't be written.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "a.txt"
        >>> with replacing(file) as draft:
        ...     _ = draft.write_text("whole")
        >>> file.read_text(), len(list(file.parent.iterdir()))
        ('whole', 1)
    """
    path = Path(path)
    # A draft would replace the device itself, for all users of the machine.
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OutputError(f"{path}: a device or a pipe, which a file would replace; {advice}")
    try:
        with drafted(path.parent, path.name) as draft:
            yield draft
            os.replace(draft, path)
    except OSError as error:
        raise OutputError(
            f"{path}: can't be written ({error.strerror or error}); {advice}"
        ) from None


def write_atomic(
    path: str | os.PathLike[str], content: str | bytes, *, advice: str = ELSEWHERE
) -> None:
    """Write a file atomically; text as UTF-8 with unchanged line ends.

    Raises:
        OutputError: if the file can't be written.
    """
    with replacing(path, advice=advice) as draft:
        draft.write_bytes(content.encode() if isinstance(content, str) else content)


@contextlib.contextmanager
def drafted(place: Path, name: str, *, is_folder: bool = False) -> Iterator[Path]:
    """Yield an empty, locked file or folder in ``place``, and remove it afterwards if it still
    exists.

    Drafts of the same name that killed processes left there are removed first.

    Raises:
        OSError: if the folder can't be written to.
    """
    _sweep(place, name)
    for _ in range(_TRIES):
        draft = place / f".{uuid.uuid4().hex}-{name}"
        with contextlib.suppress(FileNotFoundError):
            if is_folder:
                draft.mkdir()
            lock = os.open(
                draft, os.O_RDONLY if is_folder else os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666
            )
            # Another process may have removed it as a leftover before it was locked; then the next
            # name is tried.
            if _locked(lock) is not False and draft.exists():
                break
            os.close(lock)
        if not place.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
    else:
        # Folders such as /proc exist, but nothing can be created in them.
        raise FileNotFoundError(errno.ENOENT, "no file can be created in this folder")
    try:
        yield draft
    finally:
        _remove(draft)
        os.close(lock)


def exchanged(one: Path, other: Path) -> bool:
    """Exchange the names of two folders in one step; return False, without a change, where the
    system can't.
    """
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        paths = os.fsencode(one), os.fsencode(other)
        if platform.system() == "Darwin":
            return bool(libc.renamex_np(*paths, _RENAME_EXCHANGE) == 0)
        return bool(libc.renameat2(_AT_FDCWD, paths[0], _AT_FDCWD, paths[1], _RENAME_EXCHANGE) == 0)
    except (OSError, AttributeError, TypeError):
        return False


@contextlib.contextmanager
def one_at_a_time(folder: Path) -> Iterator[None]:
    """Let only one process at a time enter this context for a folder, where the system
    has locks.
    """
    if fcntl is None:
        yield
        return
    lock = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


def _sweep(place: Path, name: str) -> None:
    """Remove the unlocked drafts of a name."""
    pattern = re.compile(rf"\.[0-9a-f]{{32}}-{re.escape(name)}")
    with contextlib.suppress(OSError):
        for leftover in [entry for entry in os.listdir(place) if pattern.fullmatch(entry)]:
            lock = os.open(place / leftover, os.O_RDONLY | os.O_NOFOLLOW)
            try:
                if _locked(lock):
                    _remove(place / leftover)
            finally:
                os.close(lock)


def _locked(descriptor: int) -> bool | None:
    """Return whether this process got the lock of an open file; None where there are no locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        return
    with contextlib.suppress(OSError):
        path.unlink()
