"""What a command prints: always to somewhere, never a control character of a file, and no end of a run by a full disk."""

from __future__ import annotations

import io
import os
import re
import sys

from pincal.errors import printable

# Colours, and on a terminal the cursor's moves, as far as a line of progress needs them: up, down, start, and clearing.
_ALLOWED = re.compile(r"(\x1b\[[0-9;]*[mABGKlh]|\x1b\[\?25[lh]|\r)")


class GuardedStream(io.FileIO):
    """A stream of the process that takes all that is written, wherever it can't go.

    Attributes:
        lost: why something could not be written; empty if nothing was lost, or nobody wanted to read it.
    """

    lost = ""

    def write(self, content: object) -> int:
        """Write bytes; what can't be written is dropped, since the files of a run are worth more than its words."""
        view = memoryview(content)  # type: ignore[arg-type]
        try:
            return super().write(view) or 0
        except BrokenPipeError:
            return view.nbytes
        except OSError as error:
            self.lost = error.strerror or str(error)
            return view.nbytes


class _Printable(io.TextIOWrapper):
    """Text whose control characters are escaped, but for those with which a terminal is drawn on."""

    def write(self, text: str) -> int:
        """Write a text."""
        if text.replace("\n", "").isprintable():
            return super().write(text)
        parts = _ALLOWED.split(text) if self.isatty() else [text]
        super().write("".join(part if k % 2 else printable(part) for k, part in enumerate(parts)))
        return len(text)


def guard_streams() -> GuardedStream:
    """Replace stdout and stderr by streams that never fail; return that of the results.

    A stream that is closed leads nowhere: a file that is opened later must not take its number, or prints would go there.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    found = []
    for name, number in (("stdout", 1), ("stderr", 2)):
        if (stream := getattr(sys, name)) is not None:
            stream.flush()
        raw = GuardedStream(number, "w", closefd=False)
        encoding = getattr(stream, "encoding", None) or "utf-8"
        text = _Printable(io.BufferedWriter(raw), encoding=encoding, errors="backslashreplace", line_buffering=True)
        setattr(sys, name, text)
        found.append(raw)
    return found[0]
