"""A calibration kept up: new rows taken in for good, if the robot is still the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pincal.calibration.calibrated import Calibrated, CalibratedModel
from pincal.calibration.day import rows_with_means
from pincal.calibration.stations import CalibratedStations
from pincal.diagnosis.run import ALPHA, placed_anew, verdict_of
from pincal.errors import ChangedRobotError
from pincal.identify.calibrate import calibrate
from pincal.identify.fingerprints import together
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements
from pincal.measure.registry import blocks_of


def update(
    calibrated: Calibrated | CalibratedStations,
    measurements: Measurements,
    *,
    alpha: float = ALPHA,
    sigma: float | None = None,
) -> CalibratedModel:
    """Take new rows into a calibration for good, as a joint fit of old and new rows would, without the old ones.

    Args:
        calibrated: the robot as it was calibrated.
        measurements: new rows, with any instrument, set up anew.
        alpha: chance that the rows of a robot that has not changed are refused.
        sigma: noise of the new rows [m]; default: that of the calibration if it was declared, else estimated.

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
            f"{measurements.source}: the robot is no longer what the model says (p = {verdict.p_value:.2g}), so that its "
            "old rows and these don't belong together; pincal diagnose finds out what has changed and mends the model"
        )
    kept = np.delete(np.arange(len(measurements)), verdict.wrong_rows)
    return _taken_in(model, measurements.select(kept), sigma=sigma)


def _taken_in(model: CalibratedModel, measurements: Measurements, *, sigma: float | None) -> CalibratedModel:
    """Return the robot at the station of new rows, found from them and from what is known of it as it was."""
    arm = model.model
    x, y, z = map(float, model.payload_centre)
    gx, gy, gz = map(float, arm.chain.gravity)
    declared = model.sigma if model.is_noise_declared and model.sensor_kind == measurements.kind else ()
    units = [block.unit for block in blocks_of(model.sensor_kind)]
    angles = [float(size) for size, unit in zip(declared, units, strict=False) if unit == "rad"]
    options = Options(
        effects=tuple(effect for effect in arm.effects if effect.scope == "robot"),
        sigma=float(next(iter(declared))) if sigma is None and len(declared) else sigma,
        sigma_orientation=angles[0] if angles else None,
        moment_frame=arm.chain.moment_frame,
        equilibrium=arm.equilibrium,
        gravity=(gx, gy, gz),
        payload_centre=(x, y, z),
        setup=replace(model.setup, points={}),
        earlier=model.robot_estimate,
    )
    rows = rows_with_means(measurements, arm, model.covered.days)
    found = CalibratedModel.of(calibrate(arm.chain.robot, rows, options))
    covered, marks = model.covered.over(found.covered), together(model.rows, found.rows)
    return replace(found, covered=covered, rows=marks, provenance=model.provenance)
