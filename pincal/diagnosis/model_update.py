"""Update of a calibration: new rows added permanently, if the robot has not changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.calibration.fit_evidence import KeptEvidence
from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.fitted_station import FittedStation
from pincal.calibration.information import RobotInformation
from pincal.calibration.placing import Placed
from pincal.calibration.repeatability import Repeatability
from pincal.diagnosis.robot_diagnosis import (
    FALSE_ALARM,
    changes_since,
    doubts_about,
    looked_at,
    relocated,
)
from pincal.errors import BadInputError, ChangedRobotError, IdentificationError, nearest_first
from pincal.identify.calibrate import fit_tables
from pincal.identify.options import Options
from pincal.identify.station import together
from pincal.identify.stop_scatter import shared_in_fit
from pincal.measure.measurements import Measurements
from pincal.measure.poses import by_pose
from pincal.measure.stops import StopRows
from pincal.model.effect import Effect
from pincal.model.sizes import largest_basis
from pincal.parameters import Covariance, Estimate
from pincal.sensors.registry import blocks_of
from pincal.units import show_chance


def update(
    calibrated: FittedRobot,
    measurements: Measurements,
    *,
    alpha: float = FALSE_ALARM,
    sigma: float | None = None,
    sigma_orientation: float | None = None,
    anew: Sequence[str] = (),
) -> FittedRobot:
    """Add new rows to a calibration permanently, equivalent to a joint fit of old and new rows,
    without the old ones.

    Args:
        calibrated: the robot as it was calibrated.
        measurements: new rows, with any instrument in any set-up.
        alpha: probability that the rows of a robot that has not changed are refused.
        sigma: noise of the new rows [m]; default: that of the calibration if it was declared, else
            estimated.
        sigma_orientation: likewise of orientations [rad].
        anew: effects of the model, as ``EFFECT`` or ``EFFECT:JOINT``, that are re-estimated from
            their priors, as named by a diagnosis. Whether the robot has changed is then not tested.

    Returns:
        The robot at the new station, with the information of old and new rows.

    Raises:
        ChangedRobotError: if the robot has changed since, so that old and new rows can't be
            combined.
        IdentificationError: if the rows can't be judged: too many contradict the others, or the
            instrument was touched.
        BadInputError: as :func:`diagnose`, or for an effect that the model does not have.
    """
    model = calibrated.robot_model(measurements.kind)
    measurements = measurements.in_order_of(model.model.chain.robot)
    some = looked_at(StopRows.of(measurements))
    placed = relocated(model, some, sigma_orientation=sigma_orientation)
    measurements = placed.stepping(measurements)
    noise = _Declared(sigma, sigma_orientation)
    if anew:
        released = [effect for text in anew for effect in _named(text, model)]
        return _taken_in(
            placed, model, measurements, noise, earlier=_released(model, placed, released)
        )
    verdict = changes_since(model, placed, alpha)
    if doubts := doubts_about(verdict, placed):
        raise IdentificationError(
            f"{measurements.source}: not added: {'; '.join(map(str, doubts))}"
        )
    if verdict.changed:
        raise ChangedRobotError(
            f"{measurements.source}: the robot no longer matches its model (p "
            f"{show_chance(verdict.p_value)}), so its old rows and these can't be combined; pincal "
            "diagnose identifies what has changed and re-estimates it. With --anew EFFECT:JOINT "
            "the rows are added nevertheless, and that effect is re-estimated"
        )
    wrong = placed.stops.readings.rows[np.isin(placed.stops.row_of, verdict.wrong_rows)]
    kept = measurements.select(~np.isin(measurements.rows, wrong))
    known = model.robot_estimate
    return _taken_in(placed, model, kept, noise, earlier=known, before=model.information)


def _named(text: str, model: FittedRobot) -> list[Effect]:
    """Return the effects of a robot that a user names."""
    name, _, joint = (part.strip() for part in text.partition(":"))
    of_robot = [effect for effect in model.model.effects if effect.scope == "robot"]
    found = [e for e in of_robot if e.heading[0] == name and joint in ("", e.heading[1])]
    if not found:
        known = dict.fromkeys(":".join(filter(None, effect.heading[:2])) for effect in of_robot)
        raise BadInputError(
            f"effect {text!r} is not in the model; expected one of "
            f"{', '.join(nearest_first([text], known))}"
        )
    return found


def _released(model: FittedRobot, placed: Placed, effects: Sequence[Effect]) -> Estimate:
    """Return the estimate of a robot, its covariance widened by the priors of effects that may have
    changed.
    """
    earlier = model.robot_estimate
    station = placed.station
    largest = dict(
        zip(station.model.names, largest_basis(station.model, station.conditions)[0], strict=True)
    )
    C = earlier.dense_covariance()
    for effect in effects:
        parameters = effect.parameters(station.model.chain)
        at = earlier.places(parameter.name for parameter in parameters)
        belief = effect.belief(parameters)
        sizes = np.array([parameter.size / largest[parameter.name] for parameter in parameters])
        wider = np.diag(sizes**2) if belief is None else np.linalg.inv(belief)
        C[np.ix_(at, at)] += np.where(np.isfinite(wider), wider, 0.0) * np.outer(
            earlier.free[at], earlier.free[at]
        )
    return replace(earlier, covariance=Covariance.of(C[np.ix_(earlier.free, earlier.free)]))


@dataclass(frozen=True)
class _Declared:
    """Noise of the new rows by the user [m, rad]; None where it is that of the calibration, if
    declared, else estimated.
    """

    sigma: float | None
    sigma_orientation: float | None

    @classmethod
    def of(cls, model: FittedRobot, kind: str, given: _Declared) -> _Declared:
        """Return the noise that is given, else that of the calibration for such readings if it was
        declared.
        """
        known = model.sigma if model.is_noise_declared and model.sensor_kind == kind else ()
        units = [block.unit for block in blocks_of(model.sensor_kind)]
        angles = [float(size) for size, unit in zip(known, units, strict=False) if unit == "rad"]
        sigma = float(next(iter(known))) if given.sigma is None and len(known) else given.sigma
        angle = angles[0] if given.sigma_orientation is None and angles else given.sigma_orientation
        return cls(sigma, angle)

    def of_means(self, placed: Placed, table: Measurements) -> _Declared:
        """Return the noise of the means of poses, whose readings share the arrival of
        the drives.
        """
        assert table.readings_per_row is not None
        scatter = placed.noise.scatter
        readings = float(1.0 / np.mean(1.0 / table.readings_per_row))
        stops = placed.stops.plan.n_stops / placed.stops.plan.n_poses
        units = [block.unit for block in placed.station.sensor.blocks]

        def size(declared: float | None, unit: str) -> float | None:
            if declared is None or unit not in units:
                return declared
            between = float(scatter.between[units.index(unit)])
            return float(np.sqrt(between / stops + declared**2 / readings))

        return _Declared(size(self.sigma, "m"), size(self.sigma_orientation, "rad"))

    def widened(self, placed: Placed, factor: float) -> _Declared:
        """Return the noise times a factor, that of the rows where none is declared."""
        units = [block.unit for block in placed.station.sensor.blocks]
        of_rows = dict(zip(units, placed.model.sigma.tolist(), strict=True))
        sigma = of_rows.get("m", of_rows.get("px")) if self.sigma is None else self.sigma
        angle = of_rows.get("rad") if self.sigma_orientation is None else self.sigma_orientation
        return _Declared(
            None if sigma is None else factor * sigma,
            None if angle is None else factor * angle,
        )


def _taken_in(
    placed: Placed,
    model: FittedRobot,
    measurements: Measurements,
    declared: _Declared,
    *,
    earlier: Estimate,
    before: RobotInformation | None = None,
) -> FittedRobot:
    """Return the robot at the station of new rows, fitted to them with its earlier estimate as
    prior.

    Without the information ``before`` of the earlier rows, as for a robot that has changed, its own
    is of the new rows.
    """
    noise = _Declared.of(model, measurements.kind, declared)
    means = by_pose(measurements)
    if means is not measurements:
        # By their own noise, not by the number of readings.
        noise = noise.of_means(placed, means)
        measurements = replace(means, readings_per_row=None)
    factor = _shared(placed)
    if factor > 1.0:
        noise = noise.widened(placed, factor**0.5)
    rows = model.of_its_day(measurements)
    fit = fit_tables(model.model.chain.robot, rows, _as_fitted(model, noise, earlier))
    found = FittedRobot.of(fit, model.provenance)
    new = RobotInformation.of(fit)
    station = _with_earlier_rows(found, model, repeatability=placed.noise.repeatability)
    if factor > 1.0:
        # Predictions of single rows have the noise of single rows.
        is_declared = model.is_noise_declared or declared.sigma is not None
        station = replace(station, sigma=station.sigma / factor**0.5, is_noise_declared=is_declared)
    # New rows do not describe what the model lacks.
    return replace(
        found.with_station(station),
        evidence=KeptEvidence(information=new if before is None else before + new),
        discrepancy=model.discrepancy,
        identity=model.identity,
        statement=model.statement,
    )


def _with_earlier_rows(
    found: FittedRobot, model: FittedRobot, *, repeatability: Repeatability | None
) -> FittedStation:
    """Return the station of new rows, with the earlier rows and their range."""
    return replace(
        found.station,
        covered=model.covered.over(found.covered),
        rows=together(model.rows, found.rows),
        repeated=repeatability,
    )


def _as_fitted(model: FittedRobot, noise: _Declared, earlier: Estimate) -> Options:
    """Return the options of a fit of the same robot with an earlier estimate as prior."""
    arm = model.model
    gx, gy, gz = map(float, arm.chain.gravity)
    return model.fitting_options(
        effects=tuple(effect for effect in arm.effects if effect.scope == "robot"),
        sigma=noise.sigma,
        sigma_orientation=noise.sigma_orientation,
        moment_frame=arm.chain.moment_frame,
        equilibrium=arm.equilibrium,
        gravity=(gx, gy, gz),
        setup=replace(model.setup, points={}),
        earlier=earlier,
    )


def _shared(placed: Placed) -> float:
    """Return the factor by which targets of a stop, which share its arrival, increase the variances
    of an update.
    """
    plan = placed.stops.plan
    if not plan.shares_stops:
        return 1.0
    free = placed.solution.free | (np.diag(placed.model.covariance) > 0.0)
    return shared_in_fit(placed.station, placed.values, plan, sigma=placed.model.sigma, free=free)[
        0
    ]
