"""From files and options of the command line to the library's objects."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from pincal.identify.calibrate import Options
from pincal.measure.measurements import Measurements
from pincal.measure.table import column_names, read_measurements
from pincal.model.effects import ELASTIC, GEOMETRIC
from pincal.robot.robot import Robot, find_file
from pincal.robot.urdf import read_urdf


def load_robot(source: str, table: Path, *, tip: str | None, base: str | None) -> Robot:
    """Return the arm whose joints are columns of the table."""
    if tip is not None:
        return Robot.from_urdf(source, tip=tip, base=base)
    known = {joint.name for joint in read_urdf(find_file(source)).joints}
    joints = [name for name in column_names(table) if name in known]
    return Robot.from_urdf(source, base=base, joints=joints or None)


def load_table(robot: Robot, path: Path, *, ignore: tuple[str, ...] = (), joints_only: bool = False) -> Measurements:
    """Return the measurements (or the joint positions alone) of a file for this arm."""
    require: Literal["measurement", "joints"] = "joints" if joints_only else "measurement"
    return read_measurements(path, robot.joint_names, ignore=ignore, require=require, joint_types=robot.joint_types)


def options_of(arguments: dict[str, Any]) -> Options:
    """Return the calibration's options from those of the command line."""
    anchor = arguments["anchor"]
    base = None
    if anchor:
        base = np.eye(4)
        base[:3, 3] = -np.array(anchor)
    return Options(
        effects=GEOMETRIC if arguments["model"] == "geometric" else ELASTIC,
        sigma=arguments["noise"],
        sigma_orientation=arguments["noise_angle"],
        moment_frame=arguments["moment_frame"],
        equilibrium=arguments["equilibrium"],
        gravity=arguments["gravity"] or None,
        payload_centre=arguments["payload_com"],
        base=base,
        tools={"tool": arguments["tool"]} if arguments["tool"] else None,
        stages=arguments["stages"],
        loss=arguments["loss"],
        length_bound=arguments["length_bound"],
    )
