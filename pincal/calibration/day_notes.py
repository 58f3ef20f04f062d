"""Notes on effects of the calibration's day or set-up that rows of another one can't have."""

from __future__ import annotations

import numpy as np

from pincal.calibration.another_day import unrecorded, varied_by
from pincal.calibration.covered import of_the_day
from pincal.calibration.fitted_robot import FittedRobot
from pincal.measure.measurements import Measurements
from pincal.model.conditions import Conditions
from pincal.model.effect import Effect
from pincal.units import format_readable


def note_on(
    robot: FittedRobot, effect: Effect, source: str, conditions: Conditions | None
) -> tuple[float, str]:
    """Return how far an effect of the day or the set-up typically moved the target [m], and how it
    is treated.

    Args:
        robot: as it was calibrated.
        effect: of its model.
        source: name of the rows.
        conditions: of the rows, with all columns that the model needs; None where the model's file
            lacks their means.
    """
    name = " of ".join(filter(None, (effect.name, effect.locus.joint)))
    columns = ", ".join(of_the_day(effect))
    lacks = (
        f"{source} has no column {columns}"
        if columns
        else "it belongs to the previous set-up of the instrument"
    )
    left_out = "of the calibration's station is left out"
    at_mean = "is taken at its mean over the calibration's rows"
    treated = f"{name} {left_out if effect.scope == 'station' else at_mean}: {lacks}"
    if conditions is None:
        return 0.0, treated
    moved = varied_by(robot.station, robot.model_values, effect, conditions)
    size = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
    return (
        size,
        f"{treated}; its variation there adds {format_readable(size, 'm', '.2g')} of uncertainty",
    )


def notes_on_day(robot: FittedRobot, rows: Measurements) -> tuple[str, ...]:
    """Return how effects of a temperature, time or move that rows lack are treated."""
    full = robot.of_its_day(robot.conditions(rows))
    lacking = unrecorded(robot.station, rows)
    return tuple(note_on(robot, effect, rows.source, full)[1] for effect in lacking)
