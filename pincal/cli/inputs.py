"""From files and options of the command line to the library's objects."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.calibrate import Options
from pincal.measure.measurements import Measurements
from pincal.measure.setup import KnownDistance, Setup, read_distances, read_lens, read_mount, read_points
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


def options_of(arguments: dict[str, Any], table: Measurements) -> Options:
    """Return the calibration's options from those of the command line.

    Raises:
        BadInputError: if the noise is given in a unit that this table's readings do not have.
    """
    anchor = arguments["anchor"]
    base = np.eye(4) if arguments["points_in"] == "base" else None
    if anchor:
        base = np.eye(4)
        base[:3, 3] = -np.array(anchor)
    return Options(
        effects=GEOMETRIC if arguments["model"] == "geometric" else ELASTIC,
        sigma=_sigma(arguments["noise"], table),
        sigma_orientation=arguments["noise_angle"],
        moment_frame=arguments["moment_frame"],
        equilibrium=arguments["equilibrium"],
        gravity=arguments["gravity"] or None,
        payload_centre=arguments["payload_com"],
        base=base,
        tools=_tools(arguments, table),
        stages=arguments["stages"],
        loss=arguments["loss"],
        length_bound=arguments["length_bound"],
        setup=_setup(arguments),
    )


def _tools(arguments: dict[str, Any], table: Measurements) -> dict[str, Any] | None:
    if arguments["camera"] and not table.kind.startswith("camera"):
        raise BadInputError(f"--camera is for readings of a camera, but {table.source} holds {table.kind}; leave it out")
    mount = read_mount(arguments["camera"]) if arguments["camera"] else None
    if mount is None:
        mount = arguments["tool"] or None
    return None if mount is None else {str(table.target[0]): mount}


def _sigma(noise: tuple[float, str] | None, table: Measurements) -> float | None:
    if noise is None:
        return None
    sigma, unit = noise
    expected, example = ("px", "0.1px") if table.kind == "camera_pixel" else ("m", "0.05mm")
    if unit != expected:
        raise BadInputError(f"--noise in {unit}, but {table.source} holds {table.kind}; expected such as {example}")
    return sigma


def _setup(arguments: dict[str, Any]) -> Setup:
    points, table, camera = (arguments[name] for name in ("points", "distances", "camera"))
    gaps = [KnownDistance(first, second, length) for first, second, length in arguments["gaps"]]
    return Setup(
        points={} if points is None else read_points(points),
        distances=(*gaps, *(() if table is None else read_distances(table))),
        lens=None if camera is None else read_lens(camera),
        fit_lens=arguments["fit_camera"],
    )
