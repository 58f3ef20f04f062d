"""Files that are no plain tables, such as recordings: satellites hand in readers of sheets."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pincal.measure.sheet import Sheet
from pincal.satellites import Place


@dataclass(frozen=True, kw_only=True)
class SheetOptions:
    """What is wanted of a file.

    Attributes:
        ignore: topics of a recording, or keys of nested values, to leave out.
        only_joints: whether to read only the joints of a recording, sample by sample.
        joints: those that have to stand still in a recording, and by which the header of a table is
            recognised.
    """

    ignore: Collection[str] = ()
    only_joints: bool = False
    joints: Collection[str] = ()


class SheetReader(Protocol):
    """Reads files, or folders, of one kind."""

    def reads(self, path: Path) -> bool:
        """Return whether a file or folder is of this kind."""
        ...

    def open(self, path: Path, options: SheetOptions) -> Sheet:
        """Return its sheet.

        Raises:
            MeasurementError: if it can't be read, or has no table.
        """
        ...


SHEET_READERS: Place[SheetReader] = Place("sheets")
