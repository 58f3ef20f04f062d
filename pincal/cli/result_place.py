"""Where a command writes its results if it is not told: a folder of the current one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pincal.cli.arguments import Output, option
from pincal.io.result_folder import MODEL, RESULTS


class ResultFolder(Output):
    """A folder for all results of a run, which replace those of an earlier one."""

    def replaces(self, path: Path, source: Path) -> bool:
        """Return whether a file is one of the results in the folder."""
        files = (path / name for name in (MODEL, *RESULTS))
        return any(file.is_file() and file.samefile(source) for file in files)


def results_option(name: str) -> Any:
    """Return the field of ``--out`` of a command that writes a folder.

    Args:
        name: of the folder if none is given.
    """
    return option("Folder for the results.", Path(name), metavar="DIR", type=ResultFolder())
