"""A calibration kept up: new rows taken in for good, if the robot is still the same."""

from __future__ import annotations

import numpy as np

from pincal.calibration.calibrated import Calibrated, CalibratedModel
from pincal.diagnosis.run import ALPHA, placed_anew, verdict_of
from pincal.diagnosis.take_in import taken_in
from pincal.errors import ChangedRobotError
from pincal.measure.measurements import Measurements


def update(
    calibrated: Calibrated, measurements: Measurements, *, alpha: float = ALPHA, sigma: float | None = None
) -> CalibratedModel:
    """Take new rows into a calibration for good, as a joint fit of old and new rows would, without the old ones.

    Args:
        calibrated: the robot as it was calibrated.
        measurements: new rows, with any instrument, set up anew.
        alpha: chance that the rows of a robot that has not changed are refused.
        sigma: noise of the new rows [m]; unless given that of the calibration if it was declared, else estimated.

    Returns:
        The robot at the new station, with all that is known of it now.

    Raises:
        ChangedRobotError: if the robot has changed since: old and new rows don't belong together.
        BadInputError: as :func:`diagnose`.
    """
    model = calibrated.robot_model()
    placed = placed_anew(model, measurements)
    verdict = verdict_of(model, placed, alpha)
    if verdict.changed:
        raise ChangedRobotError(
            f"{measurements.source}: the robot is not any more what the model says (p = {verdict.p_value:.2g}), so that its "
            "old rows and these don't belong together; pincal diagnose finds out what has changed and mends the model"
        )
    kept = np.delete(np.arange(len(measurements)), verdict.wrong_rows)
    return taken_in(model, measurements.select(kept), sigma=sigma)
