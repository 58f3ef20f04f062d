"""What whoever looks at a reported problem needs to know first: versions, the command and the files, without their data."""

from __future__ import annotations

import os
import platform
import shlex
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path

from pincal.errors import printable
from pincal.io.result_folder import file_hash

_PACKAGES = ("numpy", "scipy", "pin", "numba", "llvmlite", "polars", "example-robot-data")
# A header that is longer is cut.
_LONGEST_HEADER = 500


def problem_report(words: Sequence[str], files: Sequence[Path]) -> Iterator[str]:
    """Yield the lines that begin a report of a problem.

    Args:
        words: the command line after ``pincal``.
        files: files among them; of text tables the names of columns are told, of no file what it holds.
    """
    yield f"pincal {version('pincal')}, Python {platform.python_version()}, {platform.platform()}, {os.cpu_count()} cores"
    yield ", ".join(f"{package} {version(package)}" for package in _PACKAGES)
    yield f"command: {printable(shlex.join(['pincal', *words]), _LONGEST_HEADER)}"
    for file in files:
        if file.is_file():
            yield f"{file.name}: {file.stat().st_size} bytes, sha256 {file_hash(file)[:12]}{_columns(file)}"
        else:
            yield f"{printable(file.name, _LONGEST_HEADER)}: not a file"


def _columns(table: Path) -> str:
    """Return the header of a text table in words; nothing for other files, and where the first line is data."""
    if table.suffix.lower() not in (".csv", ".txt", ".tsv", ".dat"):
        return ""
    with table.open("rb") as file:
        first = file.readline(2 * _LONGEST_HEADER).decode("utf-8", "replace").strip()
    letters = sum(character.isalpha() for character in first)
    return f", first line: {printable(first, _LONGEST_HEADER)}" if letters > len(first) / 4 else ", no header"
