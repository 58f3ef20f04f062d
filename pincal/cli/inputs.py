"""From files and typed arguments of the command line to the library's objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from pincal.cli.common import CalibrationOptions, InputOptions, SetupOptions
from pincal.errors import BadInputError
from pincal.identify.options import Options
from pincal.identify.station import conditions_of
from pincal.io.camera_file import read_lens, read_mount
from pincal.measure.measurements import Measurements
from pincal.measure.named_points import KnownDistance
from pincal.measure.setup import Setup, read_distances, read_points
from pincal.measure.table import column_names, read_measurements
from pincal.model.catalogue.candidates import find_effect
from pincal.model.chain import Chain
from pincal.model.effects import ELASTIC, GEOMETRIC
from pincal.model.model import Model
from pincal.robot.robot import Robot, find_file
from pincal.robot.urdf import read_urdf
from pincal.units import readable_unit

EFFECTS = {"geometric": GEOMETRIC, "elastic": ELASTIC}


@dataclass(frozen=True)
class Prepared:
    """What every verb that takes a robot and measurements works on.

    Attributes:
        robot: the arm.
        table: its measurements.
        options: how to calibrate.
        files: all input files, for the provenance of the result.
    """

    robot: Robot
    table: Measurements
    options: Options
    files: tuple[Path, ...]


def prepare(source: InputOptions, chosen: CalibrationOptions) -> Prepared:
    """Load robot, table and measurement setup.

    Raises:
        BadInputError: for a file or an option that is invalid.
    """
    robot = load_robot(source)
    table = load_table(robot, source.data, ignore=source.ignore)
    setup = chosen.setup
    given = [path for path in (setup.points, setup.distances, setup.camera) if path is not None]
    options = with_effects(options_of(chosen, table), chosen.fit.add, robot=robot, table=table)
    return Prepared(robot, table, options, (source.data, *given, Path(robot.source)))


def with_effects(options: Options, added: tuple[str, ...], *, robot: Robot, table: Measurements) -> Options:
    """Return the options with the effects that the command line adds.

    Raises:
        BadInputError: for an effect that is unknown or that these poses can't show.
    """
    if not added:
        return options
    chain = Chain.of(robot, targets=tuple(str(target) for target in np.unique(table.target)))
    conditions = conditions_of(Model(chain, ()), table, np.array(options.payload_centre))
    effects = (find_effect(text, chain, conditions) for text in added)
    return replace(options, effects=(*options.effects, *effects))


def load_robot(source: InputOptions) -> Robot:
    """Return the arm whose joints are columns of the table."""
    if source.tip is not None:
        return Robot.from_urdf(source.robot, tip=source.tip, base=source.base)
    known = {joint.name for joint in read_urdf(find_file(source.robot)).joints}
    joints = [name for name in column_names(source.data) if name in known]
    return Robot.from_urdf(source.robot, base=source.base, joints=joints or None)


def load_table(robot: Robot, path: Path, *, ignore: tuple[str, ...] = (), joints_only: bool = False) -> Measurements:
    """Return the measurements (or the joint positions alone) of a file for this arm."""
    require: Literal["measurement", "joints"] = "joints" if joints_only else "measurement"
    return read_measurements(path, robot.joint_names, ignore=ignore, require=require, joint_types=robot.joint_types)


def options_of(chosen: CalibrationOptions, table: Measurements) -> Options:
    """Return the calibration's options from those of the command line.

    Raises:
        BadInputError: if the noise is given in a unit that this table's readings do not have.
    """
    model, setup, fit = chosen.model, chosen.setup, chosen.fit
    base = np.eye(4) if setup.points_in == "base" else None
    if setup.anchor:
        base = np.eye(4)
        base[:3, 3] = -np.array(setup.anchor)
    listed = () if setup.distances is None else read_distances(setup.distances)
    return Options(
        effects=EFFECTS[model.model],
        sigma=_sigma(setup.noise, table),
        sigma_orientation=setup.noise_angle,
        moment_frame=model.moment_frame or "paper",
        equilibrium=fit.equilibrium,
        gravity=model.gravity,
        payload_centre=model.payload_com,
        base=base,
        tools=_tools(setup, table),
        stages=fit.stages,
        loss=fit.loss,
        length_bound=fit.length_bound,
        setup=Setup(
            points={} if setup.points is None else read_points(setup.points),
            distances=(*(KnownDistance(*gap) for gap in setup.gaps), *listed),
            lens=None if setup.camera is None else read_lens(setup.camera),
            fit_lens=setup.fit_camera,
        ),
    )


def _tools(given: SetupOptions, table: Measurements) -> dict[str, tuple[float, float, float] | np.ndarray] | None:
    if given.camera and not (table.sensor and table.sensor.has_camera):
        raise BadInputError(f"--camera is for camera readings, but {table.source} holds {table.kind}; leave it out")
    mount = read_mount(given.camera) if given.camera else None
    known: tuple[float, float, float] | np.ndarray | None = given.tool if mount is None else mount
    return None if known is None else {str(table.target[0]): known}


def _sigma(noise: tuple[float, str] | None, table: Measurements) -> float | None:
    if noise is None:
        return None
    sigma, unit = noise
    block = None if table.sensor is None else table.sensor.blocks[0]
    if block is not None and unit != block.unit:
        factor, name = readable_unit(block.unit)
        example = f"{block.noise * factor:g}{name}"
        raise BadInputError(f"--noise in {unit}, but {table.source} holds {table.kind}; expected a value such as {example}")
    return sigma
