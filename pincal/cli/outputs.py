"""Results of a verb: folders written whole or not at all, JSON on stdout, notes on stderr, and the exit code."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from pincal.errors import AccuracyGateError, OutputError


@contextmanager
def output_folder(path: Path) -> Iterator[Path]:
    """Yield a folder to write to; at a good end its files move to ``path``, else nothing there has changed.

    Raises:
        OutputError: if ``path`` is a file or can't be written.
    """
    is_new = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
        try:
            with tempfile.TemporaryDirectory(prefix=".pincal-", dir=path, ignore_cleanup_errors=True) as draft:
                yield Path(draft)
                for file in sorted(Path(draft).iterdir()):
                    os.replace(file, path / file.name)
        finally:
            if is_new and not any(path.iterdir()):
                path.rmdir()
    except OSError as error:
        raise OutputError(f"{path}: can't write here ({error.strerror}); choose another --out") from None


def print_json(contents: Mapping[str, Any]) -> None:
    """Print a result for programs."""
    click.echo(json.dumps(contents, indent=2, allow_nan=False))


def print_notes(notes: Iterable[str], *, quiet: bool) -> None:
    """Print notes on stderr unless they are not wanted."""
    for note in notes if not quiet else ():
        click.echo(f"pincal: note: {note}", err=True)


def provenance(files: Sequence[Path], *, seed: int | None = None) -> dict[str, Any]:
    """Return what a result rests on: versions, command, seed, and the input files with their hashes."""
    from importlib.metadata import version

    return {
        "pincal": version("pincal"),
        "numpy": version("numpy"),
        "pin": version("pin"),
        "python": sys.version.split()[0],
        "command": " ".join(["pincal", *sys.argv[1:]]),
        "seed": seed,
        "inputs": {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files if file.is_file()},
    }


def require_accuracy(mean_mm: float, max_error: float | None, *, rows: str) -> None:
    """Refuse a mean error that exceeds the user's limit.

    Args:
        mean_mm: the mean error [mm].
        max_error: the limit [m]; None: no limit.
        rows: the rows it was computed on, in words.

    Raises:
        AccuracyGateError: if it does.
    """
    if max_error is not None and mean_mm > max_error * 1e3:
        raise AccuracyGateError(f"mean error of {mean_mm:.4f} mm on {rows} rows exceeds --max-error {max_error * 1e3:g} mm")
