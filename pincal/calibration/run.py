"""One calibration from table to result: check, hold out, fit, validate."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from pincal.calibration.fit import Fit, calibrate
from pincal.calibration.notes import notes_on_data
from pincal.calibration.result import Result, result_of
from pincal.identify.calibrate import doubts_of_known
from pincal.identify.options import Options
from pincal.identify.split import Split, hold_out
from pincal.identify.station import Station
from pincal.measure.admit import admit, admit_test, noted, scorable_rows, unobservable_notes, usable_rows
from pincal.measure.measurements import Measurements
from pincal.robot.robot import Robot
from pincal.validate.agreement import check_agreement


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

    def n_poses(self, *parts: str) -> int:
        """Return the number of poses, each with one reading or more, of "train", "test", or both."""
        q = np.vstack([getattr(self, part).q for part in parts or ("train", "test")])
        return len(np.unique(q, axis=0))

    def test_problem(self) -> Station | None:
        """Return the held-out rows under the calibrated model, None without any."""
        return self.fit.readings(self.test) if len(self.test) else None


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
    admitted = admit(robot, measurements, options.setup, holdout=holdout)
    with noted() as split_notes:
        if holdout is None:
            train, test = hold_out(admitted.table, test_fraction, split=split, seed=seed)
            train = usable_rows(train, options.setup)
            test = scorable_rows(test, options.setup.over(train))
        else:
            train, test = admitted.table, admit_test(robot, holdout, options.setup.over(admitted.table))
    fit = calibrate(robot, train, options)
    check_agreement(robot, train, fit)
    notes = tuple(dict.fromkeys((*admitted.notes, *split_notes)))
    notes = (*robot.notes, *notes, *admitted.idle, *unobservable_notes(train, options.setup), *map(str, notes_on_data(fit)))
    notes = (*notes, *doubts_of_known(fit))
    held = fit.readings(test) if len(test) else None
    result = result_of(fit, held, seconds=time.perf_counter() - begun, tables=(train, test), notes=notes)
    return Calibration(robot, train, test, fit, result, notes)
