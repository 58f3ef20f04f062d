"""Logs that are no tables, such as of an arm in motion: satellites hand in what makes tables of
them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from pincal.measure.measurements import Measurements
from pincal.robot.robot import Robot
from pincal.satellites import Place


class LogReader(Protocol):
    """Reads logs of one kind."""

    def joints_of(self, path: str | os.PathLike[str]) -> Path | None:
        """Return the file with the joints of a log of this kind, a file or a folder; None for other
        paths.
        """
        ...

    def read(self, robot: Robot, path: str | os.PathLike[str], name: str) -> Any:
        """Return a log; "" is the name of its file.

        Raises:
            MeasurementError: if it can't be read.
        """
        ...

    def tables(self, robot: Robot, logs: Sequence[Any]) -> Mapping[str, Measurements]:
        """Return the tables of logs that were read by this reader, by the names of their stations.

        Raises:
            MeasurementError: if a log is not of this robot, or impossible.
        """
        ...


_READERS: Place[LogReader] = Place("logs")


def reader_of(path: str | os.PathLike[str]) -> LogReader | None:
    """Return the reader of a log; None for other files, which are tables."""
    return next((reader for reader in _READERS.all() if reader.joints_of(path) is not None), None)


def joints_of_log(path: str | os.PathLike[str]) -> Path | None:
    """Return the file with the joints of a log; None for other files, which are tables."""
    found = (reader.joints_of(path) for reader in _READERS.all())
    return next((joints for joints in found if joints is not None), None)
