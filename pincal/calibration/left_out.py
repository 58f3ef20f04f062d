"""Each station in turn predicted by the model of the others, only its own frames fitted to its rows.

This is what to expect of a set-up that the calibration never saw: rows held out of a station share its frames, its day and
its temperature with those that were fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

from pincal.calibration.fit import Fit, calibrate
from pincal.calibration.placing import place_station
from pincal.calibration.rows import LeftOut
from pincal.errors import BadInputError
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements
from pincal.model.effects import GEOMETRIC
from pincal.robot.robot import Robot
from pincal.spread import spread
from pincal.validate.accuracy import pose_error_sizes

Tables = dict[str, Measurements]
FitOthers = Callable[[Robot, Tables, Options], Fit]
"""From a robot, the tables of some stations and options to their calibration; picklable, if an executor needs that."""


def leave_out_stations(
    robot: Robot, tables: Tables, options: Options, *, fit_others: FitOthers = calibrate, executor: Executor | None = None
) -> Iterator[LeftOut]:
    """Predict each station by the model of the others; with an executor, all are begun before the first is asked for.

    Args:
        robot: the arm.
        tables: rows of each station.
        options: how to calibrate.
        fit_others: makes the model; default: a calibration.
        executor: runs one fit per station; default: one after the other, here.

    Raises:
        BadInputError: if there is only one station.
    """
    require_several(tables)
    run = partial(_left_out, robot, tables, options, fit_others)
    return spread(run, tables, label="left-out station", executor=executor)


def require_several(tables: Mapping[str, Measurements]) -> None:
    """Refuse to leave out the only station.

    Raises:
        BadInputError: saying what makes several.
    """
    if len(tables) < 2:
        source = ", ".join(table.source for table in tables.values())
        raise BadInputError(
            f"{source}: one station, so there is none to leave out; expected two tables or more, or a column station"
        )


def _left_out(robot: Robot, tables: Tables, options: Options, fit_others: FitOthers, name: str) -> LeftOut:
    others = {other: table for other, table in tables.items() if other != name}
    options = replace(options, stations={other: own for other, own in options.stations.items() if other in others})
    geometric = replace(options, effects=GEOMETRIC)
    sizes: dict[str, Mapping[str, list[float]]] = {}
    try:
        found: dict[str, Fit] = {"calibrated": fit_others(robot, others, options)}
        is_same = set(found["calibrated"].options.effects) == set(GEOMETRIC)
        found["geometric"] = found["calibrated"] if is_same else calibrate(robot, others, geometric)
        found["nominal"] = calibrate(robot, others, replace(options, effects=()))
        for model, fit in found.items():
            placed = place_station(fit, tables[name])
            sizes[model] = {unit: list(s) for unit, s in pose_error_sizes(placed.station, placed.values).items()}
    except BadInputError as error:
        return LeftOut(name, obstacle=str(error))
    return LeftOut(name, sizes)
