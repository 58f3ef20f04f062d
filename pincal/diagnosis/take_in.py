"""New rows taken into a calibration whose own rows are gone: its posterior stands for them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from pincal.calibration.calibrated import Calibrated, CalibratedModel
from pincal.identify.calibrate import calibrate
from pincal.identify.fingerprints import together
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements
from pincal.measure.registry import blocks_of
from pincal.model.effect import Effect


def taken_in(
    calibrated: Calibrated,
    measurements: Measurements,
    *,
    added: tuple[Effect, ...] = (),
    forgotten: Collection[str] = (),
    sigma: float | None = None,
) -> CalibratedModel:
    """Return the robot at the station of new rows, found from them and from what is known of it as it was.

    Args:
        calibrated: the robot as it was.
        measurements: rows of a new station.
        added: effects that the robot did not have.
        forgotten: names of parameters that are not what they were.
        sigma: noise of the new rows [m]; unless given that of the calibration if it was declared, else estimated.
    """
    model = calibrated.robot_model()
    arm = model.model
    x, y, z = map(float, model.payload_centre)
    gx, gy, gz = map(float, arm.chain.gravity)
    declared = model.sigma if model.is_noise_declared and model.sensor_kind == measurements.kind else ()
    units = [block.unit for block in blocks_of(model.sensor_kind)]
    angles = [float(size) for size, unit in zip(declared, units, strict=False) if unit == "rad"]
    options = Options(
        effects=tuple(effect for effect in arm.effects if effect.scope == "robot") + added,
        sigma=float(next(iter(declared))) if sigma is None and len(declared) else sigma,
        sigma_orientation=angles[0] if angles else None,
        moment_frame=arm.chain.moment_frame,
        equilibrium=arm.equilibrium,
        gravity=(gx, gy, gz),
        payload_centre=(x, y, z),
        setup=replace(model.setup, points={}),
        earlier=model.robot_estimate.drop(forgotten),
    )
    found = CalibratedModel.of(calibrate(arm.chain.robot, measurements, options))
    covered, rows = model.covered.over(found.covered), together(model.rows, found.rows)
    return replace(found, covered=covered, rows=rows, provenance=model.provenance)
