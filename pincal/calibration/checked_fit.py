"""A robot calibrated from tables, with the checks of ``pincal calibrate``: in Python."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

from pincal.calibration.agreed import AgreedFit, fit_agreed
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.stepping import step_notes, with_steps
from pincal.errors import BadInputError, warn
from pincal.identify.calibrate import Tables, fit_tables, tables_of
from pincal.identify.options import Options
from pincal.measure.admit import admit, check_table, refuse_name
from pincal.measure.log_reader import LogReader, reader_of
from pincal.measure.measurements import Measurements
from pincal.measure.table import read_measurements, stations_of
from pincal.robot.robot import Robot
from pincal.validate.clock_jumps import SteppingClocksError

log = logging.getLogger(__name__)

File = str | os.PathLike[str]
Files = File | Sequence[File] | Mapping[str, File]


def calibrate(
    robot: Robot,
    measurements: Tables | Files,
    options: Options | None = None,
    *,
    executor: Executor | None = None,
) -> FittedRobot:
    """Calibrate a robot from measured poses.

    The rows are checked as ``pincal calibrate`` checks them: tables in another unit, with mixed-up
    columns or of another robot are refused. Joints are matched by name. Where the readings show
    that a joint has another sign or zero than described, the fit is of the robot so corrected
    (``fit.problem.chain.robot``), and a warning says so.

    Several tables are several stations: set-ups of an instrument and its targets, of the same kind
    or not. Each has its own base, targets and noise, and all share the robot.

    Args:
        robot: the arm.
        measurements: training rows, one table or several, optionally by the names of their
            stations, or their files; hold rows out before the call to validate on them.
        options: how to calibrate; defaults as documented there.
        executor: evaluates the stations in parallel; default: sequentially.

    Returns:
        The fit, ready to predict; check ``solution.converged``.

    Raises:
        MeasurementError: if the rows are too few to determine the parameters and the noise, their
            joints are not the robot's, or they can't be of this robot.

    Warns:
        PincalWarning: of rows left out, unlikely values and corrections of the robot's description.

    Example:
        >>> import numpy as np
        >>> from pincal.builtin import kuka_urdf_path
        >>> from pincal.measure.measurements import measurements_from_arrays
        >>> from pincal.model.effects import GEOMETRIC
        >>> from pincal.simulate import Instrument, TrueMachine
        >>> robot = Robot.from_urdf(kuka_urdf_path())
        >>> rng = np.random.default_rng(1)
        >>> machine = TrueMachine.from_urdf(kuka_urdf_path(), tip="tool0")
        >>> machine = machine.draw_errors(rng, sigma_length=1e-3, sigma_angle=1e-3)
        >>> q = robot.random_configurations(60, rng)
        >>> columns = Instrument(targets=(0.1, 0.0, 0.2)).measure(machine, q)
        >>> position = np.column_stack([columns[c] for c in "xyz"])
        >>> table = measurements_from_arrays(robot.joint_names, q, position=position)
        >>> fit = calibrate(robot, table, Options(effects=GEOMETRIC))
        >>> bool(np.abs(fit.predict(q)[:, :, 3] - position).max() < 1e-9)
        True
    """
    return FittedRobot.of(_checked(robot, measurements, options, executor=executor).fit)


def _checked(
    robot: Robot,
    measurements: Tables | Files,
    options: Options | None,
    *,
    executor: Executor | None = None,
) -> AgreedFit:
    """Return the fit of a robot with the checks of :func:`calibrate`."""
    options = Options() if options is None else options
    tables = tables_of(_tables(robot, measurements))
    admitted = admit(robot, tables, lambda name: options.at(name).setup)
    try:
        agreed = fit_agreed(robot, admitted.tables, options, executor=executor)
    except SteppingClocksError as found:
        return _checked(robot, with_steps(tables, found), options, executor=executor)
    for text in (*admitted.notes, *admitted.idle, *agreed.notes, *step_notes(tables)):
        warn(text)
    return agreed


def fitted(
    robot: Robot, measurements: Tables | Files, options: Options | None = None
) -> FittedRobot:
    """Return the fit of rows that were checked before, without the checks of :func:`calibrate`."""
    rows = tables_of(_tables(robot, measurements))
    in_order = {name: table.in_order_of(robot) for name, table in rows.items()}
    return FittedRobot.of(fit_tables(robot, in_order, options))


def _tables(robot: Robot, measurements: Tables | Files) -> Tables:
    """Return the tables of this robot, reading files; several files are stations named
    after them.
    """
    refuse_name(robot)
    several = (
        [measurements]
        if isinstance(measurements, Measurements | str | os.PathLike)
        else measurements
    )
    named = isinstance(several, Mapping)
    tables = list[tuple[str, Measurements]]()
    logs: dict[LogReader, list[Any]] = {}
    for name, of in (
        several.items() if isinstance(several, Mapping) else (("", of) for of in several)
    ):
        if isinstance(of, Measurements):
            tables.append((name or f"station_{len(tables) + 1}", of))
        elif (reader := reader_of(of)) is not None:
            logs.setdefault(reader, []).append(reader.read(robot, of, name))
        else:
            tables.append((name or Path(of).stem, read_measurements(of, robot)))
    for reader, read in logs.items():
        tables += reader.tables(robot, read).items()
    return stations_of(tables) if named or len(tables) > 1 else tables[0][1]


def calibrate_parts(
    robot: Robot, parts: Iterable[Measurements], options: Options | None = None
) -> FittedRobot:
    """Calibrate a robot from more rows than memory holds, one part of them at a time.

    Each part is fitted with the information of the previous ones, see ``Options.earlier``, with its
    own base, targets and noise, as a station. Where parts are similar, as parts of a table in
    random order are, no accuracy is lost.

    Args:
        robot: the arm.
        parts: the rows, each part with enough of them to place instrument and targets.
        options: how to calibrate; automatic choices are made with the first part.

    Returns:
        The fit of the last part, with the robot identified from all.

    Raises:
        BadInputError: without any part.
        MeasurementError: as :func:`calibrate`.

    Example::

        rows = (pincal.read_measurements(path, robot.joint_names, part=part) for part in
        pincal.row_parts(path)) fit = pincal.calibrate_parts(robot, rows)
    """
    fit = None
    rows = 0
    for k, part in enumerate(parts, 1):
        if fit is None:
            agreed = _checked(robot, part, options)
            robot = agreed.robot
            fit = FittedRobot.of(agreed.fit)
        else:
            # What the first part shows of the robot's description holds for all.
            check_table(robot, part.in_order_of(robot))
            fit = fitted(robot, part, options)
        rows += len(part)
        options = replace(fit.options, earlier=fit.robot_estimate)
        log.info("part %d fitted, %d rows so far", k, rows)
    if fit is None:
        raise BadInputError("no rows to calibrate with; expected at least one part")
    return fit
