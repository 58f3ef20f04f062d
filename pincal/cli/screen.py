"""Where results are printed: boxes and colours on a terminal, plain text of 100 columns elsewhere."""

from __future__ import annotations

import sys

from rich.console import Console

from pincal.cli.progress import end_progress

_WIDTH = 100


def console() -> Console:
    """Return where results are printed: stdout, the line of progress taken away before."""
    end_progress()
    width = None if sys.stdout.isatty() else _WIDTH
    return Console(width=width, highlight=False, soft_wrap=False)
