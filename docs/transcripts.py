"""Run what the pages show, and write what came out of it into them.

A block ``console`` has commands after ``$`` and what they print; ``sh`` has commands alone; ``python`` is run in the same
folder. The blocks of a page run one after the other, after the commands of a comment ``<!-- first:``, which readers don't
see. One that is not run here says why in a comment before it: ``<!-- held by: TEST -->``, or ``<!-- not run: REASON -->``.
``python docs/transcripts.py [PAGE...]`` writes the outputs anew; a test compares them.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import runpy
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

from pincal.cli import main
from pincal.errors import Exit

ROOT = Path(__file__).resolve().parents[1]
# Pages of docs/reference are made by docs/pages.py.
PAGES = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")} - {*ROOT.glob("docs/reference/*.md")})
LANGUAGES = ("console", "sh", "python")
_BLOCK = re.compile(
    r"^<!-- first:\n(?P<first>.*?)^-->|^(?P<marks>(?:<!-- .*? -->\n)*)```(?P<language>\S*)[^\n]*\n(?P<text>.*?)^```",
    re.MULTILINE | re.DOTALL,
)


class Block(NamedTuple):
    """A block of code: its language, and the test that holds it or the reason why it is not run, where it is marked."""

    language: str
    held_by: str | None
    not_run: str | None

    @classmethod
    def of(cls, found: re.Match[str]) -> Block:
        """Return what was found."""
        marks = dict(re.findall(r"<!-- (held by|not run): (.*?) -->", found["marks"] or ""))
        return cls(found["language"] or "", marks.get("held by"), marks.get("not run"))

    @property
    def is_played(self) -> bool:
        """Whether it is run here."""
        return self.language in LANGUAGES and not (self.held_by or self.not_run)


def blocks(page: str) -> Iterator[Block]:
    """Yield the blocks of a page."""
    yield from (Block.of(found) for found in _BLOCK.finditer(page) if found["first"] is None)


def played(page: str) -> str:
    """Return the text of a page with what its blocks print now; run in an empty folder."""
    names: dict[str, object] = {}

    def run(found: re.Match[str]) -> str:
        if found["first"] is not None:
            for command in _commands(found["first"]):
                _printed(command)
        elif (block := Block.of(found)).is_played:
            if block.language == "console":
                return f"{found['marks']}```console\n{''.join(map(_printed, _commands(found['text'])))}```"
            if block.language == "python":
                exec(compile(found["text"], "page", "exec"), names)
            else:
                for line in found["text"].splitlines():
                    _printed(line)
        return found[0]

    return _BLOCK.sub(run, page)


def _commands(text: str) -> list[str]:
    """Return the commands of a block, those of several lines as they are."""
    return re.findall(r"^\$ (.*(?:(?<=\\)\n.*)*)", text, re.MULTILINE)


def _printed(command: str) -> str:
    """Run a command, and return it with what it printed."""
    # A process of its own would import everything anew. The first lines of a command, a file that holds words of a command,
    # and a file for what an example prints are therefore taken care of here.
    asked, _, count = command.partition(" | head -n ")
    asked = re.sub(r"\$\(cat (\S+)\)", lambda file: Path(file[1]).read_text(encoding="utf-8").strip(), asked)
    words = shlex.split(asked.replace("\\\n", " "), comments=True)
    text = ""
    if words[0] == "pincal" and "$(" not in asked and "|" not in words:
        text = "".join(_called(words[1:]).splitlines(keepends=True)[: int(count) if count else None])
    elif example := re.fullmatch(r"python (examples/\S+) > (\S+)", command):
        Path(example[2]).write_text(_ran(example[1]), encoding="utf-8")
    else:
        shell = f'pincal() {{ {shlex.quote(sys.executable)} -m pincal "$@"; }}; {command}'
        done = subprocess.run(shell, shell=True, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{command}\n{done.stderr}"
        text = done.stdout
    lines = [line.rstrip() for line in text.splitlines()]
    return "\n".join([f"$ {command}", *lines, ""])


def _ran(script: str) -> str:
    """Return what a script prints, run in this process."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), patch.object(sys, "argv", [script]):
        runpy.run_path(script, run_name="__main__")
    return out.getvalue()


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
    for path in [page for page in PAGES if not sys.argv[1:] or page.stem in sys.argv[1:]]:
        with empty_folder():
            path.write_text(played(path.read_text(encoding="utf-8")), encoding="utf-8")
