"""Which tests a change concerns: ``pytest --since COMMIT`` leaves out those whose rooms are as they were in a commit."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path

import pytest

# Whatever rooms a test rests on, it also rests on how tests are set up.
EVERYWHERE = ("pyproject.toml", "tests/conftest.py", "tests/rooms.py")


def changed_since(commit: str, root: Path) -> frozenset[str] | None:
    """Return the files that differ from those of a commit, by their paths from the root; None where that is unknown."""
    found = set[str]()
    for command in (["diff", "--name-only", "--no-renames", commit, "--"], ["ls-files", "--others", "--exclude-standard"]):
        try:
            done = subprocess.run(["git", *command], capture_output=True, text=True, cwd=root, check=True)
        except (OSError, subprocess.CalledProcessError):
            return None
        found |= set(done.stdout.splitlines())
    return frozenset(found)


def is_concerned(item: pytest.Item, changed: frozenset[str]) -> bool:
    """Return whether a test has no rooms that are named, or one of them, or its own file, has changed."""
    rooms = [room for mark in item.iter_markers("rooms") for room in mark.args]
    return not rooms or touches(changed, (item.nodeid.split("::")[0], *EVERYWHERE, *rooms))


def touches(changed: Iterable[str], rooms: Iterable[str]) -> bool:
    """Return whether a file that has changed is, or stands in, one of some files and folders."""
    return any(f"{file}/".startswith(f"{room}/") for file in changed for room in rooms)
