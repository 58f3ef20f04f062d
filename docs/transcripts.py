"""Run what the tutorials show, and write what came out of it into them.

A block ``console`` has commands after ``$`` and what they print; a block ``python`` is run in the same folder, the blocks of
a page one after the other. ``python docs/transcripts.py`` writes the outputs anew; a test compares them.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from pincal.cli import main
from pincal.errors import Exit

TUTORIALS = sorted((Path(__file__).parent / "tutorials").glob("*.md"))
_BLOCK = re.compile(r"^```(console|python)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def played(page: str) -> str:
    """Return the text of a page with what its blocks print now; run in an empty folder."""
    names: dict[str, object] = {}

    def block(found: re.Match[str]) -> str:
        kind, text = found.groups()
        if kind == "python":
            exec(compile(text, "tutorial", "exec"), names)
            return found[0]
        return f"```console\n{''.join(_printed(command) for command in _commands(text))}```"

    return _BLOCK.sub(block, page)


def _commands(text: str) -> list[str]:
    """Return the commands of a block, those of several lines as they are."""
    return re.findall(r"^\$ (.*(?:(?<=\\)\n.*)*)", text, re.MULTILINE)


def _printed(command: str) -> str:
    """Run a command, and return it with what it printed."""
    words = shlex.split(command.replace("\\\n", " "))
    if words[0] == "pincal" and "$(" not in command:
        text = _called(words[1:])
    else:
        shell = f'pincal() {{ {shlex.quote(sys.executable)} -m pincal "$@"; }}; {command}'
        done = subprocess.run(shell, shell=True, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{command}\n{done.stderr}"
        text = done.stdout
    lines = [line.rstrip() for line in text.splitlines()]
    return "\n".join([f"$ {command}", *lines, ""])


def _called(words: list[str]) -> str:
    """Return what pincal prints, called in this process."""
    out, progress = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(progress):
        try:
            main(words)
        except SystemExit as ended:
            assert ended.code in (Exit.DONE, Exit.CHANGED), f"{shlex.join(words)}: {progress.getvalue()}"
    return out.getvalue()


@contextlib.contextmanager
def empty_folder() -> Iterator[None]:
    """Work in a new folder that is gone afterwards."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(before)


if __name__ == "__main__":
    for tutorial in [page for page in TUTORIALS if not sys.argv[1:] or page.stem in sys.argv[1:]]:
        with empty_folder():
            tutorial.write_text(played(tutorial.read_text(encoding="utf-8")), encoding="utf-8")
