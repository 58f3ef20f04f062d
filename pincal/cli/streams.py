"""Recordings that are no tables, such as of an arm in motion, on the command line.

A satellite that reads them hands in a subclass of :class:`Streams`, with the options that name
them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pincal.cli.arguments import option_class

if TYPE_CHECKING:
    from pincal.measure.measurements import Measurements
    from pincal.measure.table_schema import TableOptions
    from pincal.robot.robot import Robot

MOTION = "Motion"
"""The heading of their options."""


@dataclass(frozen=True, kw_only=True)
class Streams:
    """Streams given by options, and folders of streams among the tables; here there are none."""

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that options name."""
        return ()

    def check(self, joints: Path | None, data: Sequence[Path]) -> None:
        """Refuse streams without the log of the joints, and no input at all."""
        if not data:
            raise click.UsageError("Missing argument 'DATA.csv...'")

    def tables(
        self, robot: Robot, paths: Sequence[Path], reading: TableOptions
    ) -> tuple[dict[str, Measurements], list[Path]]:
        """Return the tables of all streams by the names of their stations, and the other files,
        which are tables.

        Raises:
            BadInputError: for a stream that is invalid.
        """
        self.check(reading.joints, paths)  # type: ignore[arg-type]
        return {}, list(paths)

    def input_files(self, paths: Sequence[Path]) -> Iterator[Path]:
        """Yield files, and the files in folders of streams."""
        from pincal.measure.log_reader import joints_of_log

        for path in paths:
            yield from (
                (path,)
                if joints_of_log(path) is None or path.is_file()
                else sorted(filter(Path.is_file, path.iterdir()))
            )


def no_streams() -> Streams:
    """Return streams of which no option gives any; folders among the tables are read."""
    return option_class(MOTION, Streams)()
