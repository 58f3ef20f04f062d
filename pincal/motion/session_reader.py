"""Sessions of an arm in motion read as logs: what motion hands in to calibrations in Python."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pincal.measure.measurements import Measurements
from pincal.motion.sessions import Session, joints_of_session, read_session
from pincal.robot.robot import Robot


class SessionReader:
    """Reads sessions: a :class:`~pincal.measure.log_reader.LogReader`."""

    def joints_of(self, path: str | os.PathLike[str]) -> Path | None:
        """Return the log of the joints of a session, a folder or a recording of ROS with an IMU;
        None for other paths.
        """
        return joints_of_session(path)

    def read(self, robot: Robot, path: str | os.PathLike[str], name: str) -> Session:
        """Return a session, by this name unless it is ""."""
        session = read_session(robot, path)
        return replace(session, name=name or session.name)

    def tables(self, robot: Robot, logs: Sequence[Session]) -> Mapping[str, Measurements]:
        """Return the tables of the stations of sessions."""
        from pincal.motion.stations import session_tables

        return session_tables(robot, logs)


SESSIONS = SessionReader()
