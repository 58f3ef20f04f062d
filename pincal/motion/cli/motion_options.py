"""Arms in motion on the command line: streams, and folders of sessions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pincal.cli.arguments import option
from pincal.cli.streams import Streams

if TYPE_CHECKING:
    from pincal.measure.measurements import Measurements
    from pincal.measure.table_schema import TableOptions
    from pincal.robot.robot import Robot


@dataclass(frozen=True, kw_only=True)
class MotionOptions(Streams):
    """Streams of an arm in motion, each with its own clock, in place of a folder."""

    imu: Path | None = option(
        "Log of an IMU on the tool while the arm moves (time, ax ay az, wx wy wz); "
        "--joints is then its joint log (time and "
        "a column per joint).",
        metavar="LOG",
    )
    tracker: Path | None = option(
        "Log of an instrument that measures the tool in motion (time, and x y z, "
        "distance, or u v with point or target).",
        metavar="LOG",
    )

    @property
    def files(self) -> tuple[Path, ...]:
        """The streams that are given."""
        return tuple(path for path in (self.imu, self.tracker) if path is not None)

    def check(self, joints: Path | None, data: Sequence[Path]) -> None:
        """Refuse streams without their joints, and no input at all."""
        if self.files and joints is None:
            raise click.UsageError("--imu and --tracker need the log of the joints: --joints LOG")
        if not self.files and not data:
            raise click.UsageError(
                "Missing argument 'DATA.csv...'; or --joints, --imu and --tracker of an "
                "arm in motion"
            )

    def tables(
        self, robot: Robot, paths: Sequence[Path], reading: TableOptions
    ) -> tuple[dict[str, Measurements], list[Path]]:
        """Return the tables of stations in motion by name, and the other files."""
        from pincal.measure.log_reader import reader_of
        from pincal.motion.session_reader import SESSIONS
        from pincal.motion.sessions import Session, read_session, read_streams
        from pincal.motion.stations import session_tables

        self.check(reading.joints, paths)  # type: ignore[arg-type]
        sessions = list[Session]()
        plain: dict[str, Any] = {
            "columns": reading.columns,
            "ignore": reading.ignore,
            "orientation": reading.orientation,
        }
        if self.files:
            given: dict[str, Any] = {
                "joints": reading.joints,
                "imu": self.imu,
                "tracker": self.tracker,
            }
            sessions.append(read_streams(robot, **given, **plain))
        folders = [path for path in paths if reader_of(path) is SESSIONS]
        sessions += [read_session(robot, path, **plain) for path in folders]
        return session_tables(robot, sessions), [path for path in paths if path not in folders]
