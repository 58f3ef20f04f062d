"""Files written as a whole or not at all."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path

from pincal.errors import OutputError


@contextlib.contextmanager
def replacing(
    path: str | os.PathLike[str], *, advice: str = "choose a folder that exists and is writable"
) -> Iterator[Path]:
    """Yield a draft beside ``path``, which replaces it at a good end; else what was there before is untouched.

    Args:
        path: the file to write.
        advice: what the user can do if this place can't be written to.

    Yields:
        The draft's path; it has the same ending as ``path``, since some writers choose their format by it.

    Raises:
        OutputError: if the place can't be written to.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "a.txt"
        >>> with replacing(file) as draft:
        ...     _ = draft.write_text("whole")
        >>> file.read_text(), len(list(file.parent.iterdir()))
        ('whole', 1)
    """
    path = Path(path)
    draft = path.with_name(f".{uuid.uuid4().hex}-{path.name}")
    try:
        yield draft
        os.replace(draft, path)
    except OSError as error:
        raise OutputError(f"{path}: can't be written ({error.strerror or error}); {advice}") from None
    finally:
        with contextlib.suppress(OSError):
            draft.unlink()


def write_whole(
    path: str | os.PathLike[str], content: str | bytes, *, advice: str = "choose a folder that exists and is writable"
) -> None:
    """Write a file as a whole or not at all; text as UTF-8 with the line ends that it has.

    Raises:
        OutputError: if the place can't be written to.
    """
    with replacing(path, advice=advice) as draft:
        draft.write_bytes(content.encode() if isinstance(content, str) else content)
