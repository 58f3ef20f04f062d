"""Where a command writes its results if it is not told: a folder of the current one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pincal.cli.arguments import Output, option


def results_option(name: str) -> Any:
    """Return the field of ``--out`` of a command that writes a folder.

    Args:
        name: of the folder if none is given.
    """
    return option("Folder for the results.", Path(name), metavar="DIR", type=Output())
