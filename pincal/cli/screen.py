"""Where results are printed: boxes and colours on a terminal, plain text of 100 columns elsewhere."""

from __future__ import annotations

import sys
import unicodedata

from rich.box import HEAVY_HEAD, Box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from pincal.cli.progress import end_progress

_WIDTH = 100
# Head and body parted by hyphens, nothing else: text that other programs can read.
_PLAIN = Box("    \n    \n -- \n    \n    \n -- \n    \n    \n", ascii=True)


def console() -> Console:
    """Return where results are printed: stdout, the line of progress taken away before."""
    end_progress()
    width = None if sys.stdout.isatty() else _WIDTH
    return Console(width=width, highlight=False, soft_wrap=False)


def new_table(title: str) -> Table:
    """Return an empty table with a title."""
    if sys.stdout.isatty():
        return Table(title=f"\n{title}", title_justify="left", box=HEAVY_HEAD)
    return Table(title=f"\n{title}", title_justify="left", box=_PLAIN, show_edge=False, pad_edge=False)


def cell(text: str) -> Text:
    r"""Return a name from a file as text to print: no markup, no control characters.

    Example:
        >>> cell("[red]a\nb").plain
        '[red]a b'
    """
    return Text("".join(" " if unicodedata.category(c) in ("Cc", "Cf", "Zl", "Zp") else c for c in text))


def hanging(mark: str, text: str) -> Table:
    """Return a paragraph whose lines stand clear of its mark."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(no_wrap=True, vertical="top")
    grid.add_column(overflow="fold")
    grid.add_row(cell(mark), cell(text))
    return grid
