"""Folders of results, each consistently from one run.

``model.json``, which every such folder has, lists the files that were written with it, with their
hashes. Where the system can exchange two folders in one step, a run is published so. Elsewhere the
files are replaced one by one, ``model.json`` last: until then it lists files that no longer exist,
and readers refuse it.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from pincal.atomic import drafted, exchanged, one_at_a_time
from pincal.errors import OutputError

MODEL = "model.json"
# Files that a run may write in addition to its model, and certificates of it; those of an earlier
# run are removed.
RESULTS = (
    "result.json",
    "discovery.json",
    "diagnosis.json",
    "calibrated.urdf",
    "residuals.csv",
    "report.html",
    "view3d.html",
    "certificate.html",
    "dcc.xml",
)


@contextmanager
def output_folder(path: Path) -> Iterator[Path]:
    """Yield a folder to write to; on success ``path`` holds its files, else it is unchanged.

    Results of an earlier run are removed; other files at ``path`` are kept.

    Raises:
        OutputError: if ``path`` is a file, can't be written, or holds a model that results without
            one would remove.
    """
    try:
        goal = Path(os.path.realpath(path))
        if goal.exists() and not goal.is_dir():
            raise NotADirectoryError(20, os.strerror(20))
        with _parents_of(goal):
            place = goal.parent if _is_exchangeable(goal) else goal
            with drafted(place, goal.name, is_folder=True) as draft:
                yield draft
                _keep_model(path, draft)
                model = draft / MODEL
                if model.exists():
                    listed = {
                        name: file_hash(draft / name) for name in RESULTS if (draft / name).exists()
                    }
                    model.write_bytes(_sealed(model.read_bytes(), listed))
                _publish(draft, goal)
    except OSError as error:
        raise OutputError(
            f"{path}: can't write here ({error.strerror}); choose another --out"
        ) from None


@contextmanager
def _parents_of(goal: Path) -> Iterator[None]:
    """Create the folders above a folder; those that are still empty after a failure go again."""
    missing = [folder for folder in goal.parents if not folder.exists()]
    goal.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for folder in missing:
            # Another run may have put something there.
            with suppress(OSError):
                folder.rmdir()
        raise


def _keep_model(path: Path, draft: Path) -> None:
    """Refuse to replace a calibration by results that have no model.

    A part's results written into the folder of the model that they were measured with would take
    the model, which may exist nowhere else, and its ``result.json`` with them.
    """
    if (path / MODEL).exists() and not (draft / MODEL).exists():
        raise OutputError(
            f"{path}: holds a calibration ({MODEL}), whose files would be removed; expected "
            "another folder: choose another --out"
        )


def not_written_with(model: Path, files: Mapping[str, str]) -> str:
    """Return the name of a file in a model's folder that was not written with it; empty if there is
    none.
    """
    for name, expected in files.items():
        file = model.parent / name
        # Other files may have been edited by hand.
        if (
            name in RESULTS
            and file.suffix == ".json"
            and file.is_file()
            and file_hash(file) != expected
        ):
            return name
    return ""


def _sealed(content: bytes, files: Mapping[str, str]) -> bytes:
    """Return the text of a ``model.json``, with one line per key, with the list of files written
    with it.
    """
    head, line_end, rest = content.partition(b"\n")
    return head + line_end + b'"files": ' + json.dumps(dict(files)).encode() + b",\n" + rest


def file_hash(file: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _is_exchangeable(goal: Path) -> bool:
    """Return whether a folder can probably be exchanged for another one."""
    if not os.access(goal.parent, os.W_OK | os.X_OK):
        return False
    # Processes in the folder would remain in the old one; a mounted folder is on another device.
    is_apart = goal.exists() and goal.stat().st_dev != goal.parent.stat().st_dev
    return not is_apart and not Path.cwd().is_relative_to(goal)


def _publish(draft: Path, goal: Path) -> None:
    """Move the files of a draft to their destination."""
    if not goal.exists():
        # Fails if another run was faster.
        with suppress(OSError):
            return os.rename(draft, goal)
    if draft.parent == goal.parent and _has_joined(draft, goal) and exchanged(draft, goal):
        return
    with one_at_a_time(goal):
        files = sorted(draft.iterdir(), key=lambda file: file.name == MODEL)
        for name in {*RESULTS} - {file.name for file in files}:
            (goal / name).unlink(missing_ok=True)
        for file in files:
            os.replace(file, goal / file.name)


def _has_joined(draft: Path, goal: Path) -> bool:
    """Return whether all other files could be linked into the draft, which is impossible for
    folders.
    """
    owners = [(folder.stat().st_uid, folder.stat().st_gid) for folder in (draft, goal)]
    kept = [
        entry
        for entry in goal.iterdir()
        if entry.name not in (MODEL, *RESULTS) and not (draft / entry.name).exists()
    ]
    if owners[0] != owners[1] or any(entry.is_dir() or entry.is_symlink() for entry in kept):
        return False
    joined: list[Path] = []
    try:
        for entry in kept:
            os.link(entry, draft / entry.name)
            joined.append(draft / entry.name)
        shutil.copystat(goal, draft)
    except OSError:
        for entry in joined:
            entry.unlink()
        return False
    return True
