"""One calibration from table to result: check, hold out, fit, validate."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass

import numpy as np

from pincal.errors import MeasurementError, PincalWarning
from pincal.identify.agreement import check_agreement
from pincal.identify.calibrate import Fit, Options, calibrate
from pincal.identify.problem import Problem
from pincal.identify.split import Split, hold_out
from pincal.measure.checks import TableFindings, check_measurements
from pincal.measure.measurements import Measurements
from pincal.report.result import Result, result_of
from pincal.robot.robot import Robot


@dataclass(frozen=True)
class Calibration:
    """A calibration with its validation.

    Attributes:
        robot: the arm.
        train: rows that the fit saw.
        test: rows that it did not see; may be empty.
        fit: the calibrated model.
        result: parameters, errors, warnings.
        notes: the warnings among them that are on robot and table, not on the fit.
    """

    robot: Robot
    train: Measurements
    test: Measurements
    fit: Fit
    result: Result
    notes: tuple[str, ...] = ()

    def test_problem(self) -> Problem | None:
        """Return the held-out rows under the calibrated model, None without any."""
        return self.fit.readings(self.test) if len(self.test) else None


def check_table(robot: Robot, measurements: Measurements, *, minimum: int = 2) -> TableFindings:
    """Refuse what can't be measurements of this robot; warn of what is merely odd."""
    return check_measurements(
        measurements,
        lower=robot.lower,
        upper=robot.upper,
        joint_types=robot.joint_types,
        reach_m=robot.reach,
        minimum=minimum,
    )


def run_calibration(
    robot: Robot,
    measurements: Measurements,
    options: Options | None = None,
    *,
    test_fraction: float = 0.25,
    split: Split = "random",
    seed: int = 0,
    holdout: Measurements | None = None,
) -> Calibration:
    """Check a table, hold rows back, calibrate on the rest and validate on what was held back.

    Args:
        robot: the arm.
        measurements: the table.
        options: how to calibrate.
        test_fraction: part of the rows held out; ignored with ``holdout``.
        split: how rows are chosen.
        seed: of the choice.
        holdout: other measurements to validate on; then all rows of ``measurements`` train.

    Returns:
        The calibration.

    Raises:
        BadInputError: if table and robot don't go together, or rows are too few.
        IdentificationError: if nothing can be identified.
    """
    begun = time.perf_counter()
    options = Options() if options is None else options
    check_count(robot, measurements)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_table(robot, measurements)
        train, test = (
            (measurements, holdout) if holdout is not None else hold_out(measurements, test_fraction, split=split, seed=seed)
        )
        if holdout is not None:
            check_table(robot, holdout, minimum=1)
    fit = calibrate(robot, train, options)
    check_agreement(robot, train, fit)
    notes = tuple(dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, PincalWarning)))
    notes = (*robot.notes, *notes, *_few_rows(fit))
    held = fit.readings(test) if len(test) else None
    result = result_of(fit, held, seconds=time.perf_counter() - begun, train_rows=train.rows, notes=notes)
    return Calibration(robot, train, test, fit, result, notes)


def check_count(robot: Robot, measurements: Measurements) -> None:
    """Refuse a table that could not even tell where instrument and tool stand."""
    size = {"position": 3, "pose": 6, "distance": 1}.get(measurements.kind, 3)
    targets = len(np.unique(measurements.target)) if len(measurements) else 1
    frames = {"position": 6 + 3 * targets, "pose": 6 + 6 * targets, "distance": 3 + 3 * targets}.get(measurements.kind, 9)
    needed = -(-(frames + robot.n_joints) // size)
    if len(measurements) < needed:
        raise MeasurementError(
            f"{measurements.source}: {len(measurements)} rows of kind {measurements.kind}; expected at least {needed} "
            f"to tell where instrument and tool stand and {robot.n_joints} joint offsets, and better 50 or more"
        )


def _few_rows(fit: Fit) -> tuple[str, ...]:
    """Say so where there are fewer readings than parameters."""
    readings = len(fit.problem) * sum(block.size for block in fit.problem.sensor.blocks)
    released = int(fit.solution.free.sum())
    if readings >= 2 * released:
        return ()
    return (
        f"{len(fit.problem)} training rows give {readings} readings for {released} parameters: much rests on what is known "
        "beforehand; measure more poses",
    )
