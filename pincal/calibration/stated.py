"""What a calibration states of its model: what it lacks, and how good it is here and anywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from msgspec import UNSET

from pincal.calibration.discrepancy import discrepancy_in
from pincal.calibration.elsewhere import elsewhere_of, placed_station, random_conditions
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.model_statement import COVERAGE_FACTOR, ModelStatement, RestsOn
from pincal.calibration.result import Result
from pincal.calibration.wandering import covariance_at_mean
from pincal.identify.fit import ModelFit
from pincal.model.conditions import Conditions
from pincal.sensors.row_samples import evenly
from pincal.thresholds import Count
from pincal.validate.misfit import Verdict
from pincal.validate.outcome import Expanded

# Poses of the calibration over which its uncertainty is averaged.
_POSES: Count = 400


def stated(fit: ModelFit, result: Result, verdict: Verdict) -> tuple[FittedRobot, Result]:
    """Return the robot of a fit with what it lacks and what it states, and the result with its
    uncertainties.
    """
    robot = FittedRobot.of(fit)
    estimate = replace(robot.estimate, covariance=covariance_at_mean(fit, of_rows=False))
    robot = replace(robot, estimate=estimate, discrepancy=discrepancy_in(fit, verdict))
    statement = _statement(robot, result, verdict)
    expanded = None
    if statement.here is not None and statement.anywhere is not None:
        expanded = Expanded(
            1e3 * COVERAGE_FACTOR * statement.here,
            1e3 * COVERAGE_FACTOR * statement.anywhere,
            COVERAGE_FACTOR,
            statement.rests_on,
        )
    result = replace(result, elsewhere=elsewhere_of(robot) or UNSET, uncertainty=expanded or UNSET)
    return replace(robot, statement=statement), result


def _statement(robot: FittedRobot, result: Result, verdict: Verdict) -> ModelStatement:
    """Return what a fitted robot states, its discrepancy known."""
    found = ModelStatement(
        verdict=verdict,
        doubts=tuple(str(note) for note in result.doubts),
        rests_on=_rests_on(robot.fit),
    )
    at = placed_station(robot.fit)
    if at is None:
        return found
    model = robot.at(at.name)
    if not model.station.is_placed:
        return found
    some = evenly(len(at), _POSES)
    return ModelStatement(
        verdict=found.verdict,
        doubts=found.doubts,
        rests_on=found.rests_on,
        here=_of_coordinate(model, at.conditions.select(some)),
        anywhere=_of_coordinate(model, random_conditions(at)),
    )


def _of_coordinate(model: FittedRobot, conditions: Conditions) -> float:
    """Return the standard uncertainty of a coordinate, root mean square over poses [m]."""
    return float(np.sqrt(np.mean(model.position_sigma(conditions) ** 2)))


def _rests_on(fit: ModelFit) -> RestsOn:
    """Return by what the errors of a model were told from noise."""
    if fit.is_declared:
        return "declared noise"
    repeated = (
        np.any(scatter.within_degrees) or np.any(scatter.between_degrees)
        for scatter in fit.scatter.values()
    )
    if any(repeated):
        return "repeated poses"
    return "residuals"
