"""The uncertainty of predicted positions of a fitted robot at one station, by its sources."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pincal.calibration.another_day import of_its_day, unrecorded, varied_by
from pincal.calibration.discrepancy import Discrepancy
from pincal.calibration.fitted_station import FittedStation
from pincal.calibration.position_covariance import PositionCovariance, SharedErrors
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.model.motions import with_moving_drives
from pincal.thresholds import Count

# Rows per piece: with 60 parameters a piece is about 6 MB.
_PIECE: Count = 4096
# Kinds of readings whose repeatability is that of a position.
_PLACES = ("position", "pose")


@dataclass(frozen=True, eq=False)
class PointOnTip:
    """A point fixed to the tip at each of N poses.

    Attributes:
        place: shape (3,) or (N, 3), in the tip's frame [m].
        covariance: shape (3, 3) of a point that all poses have in common, or (N, 3, 3) of one of
            each pose, in the tip's frame [m^2]; None for one that is known.
    """

    place: np.ndarray
    covariance: np.ndarray | None = None

    def errors(self, rotations: np.ndarray) -> SharedErrors | None:
        """Return its errors in the frame to which rotations, shape (N, 3, 3), turn; None for one
        that is known.
        """
        if self.covariance is None:
            return None
        if self.covariance.ndim == 3:
            return SharedErrors.of_each(rotations @ self.covariance @ rotations.swapaxes(1, 2))
        return SharedErrors.of_all(rotations @ SharedErrors.of_each(self.covariance[None]).grouped)


@dataclass(frozen=True, eq=False)
class PredictionUncertainty:
    """What is not known of predicted positions, without the noise of readings.

    "parameters" are those of the calibration, base and target included; "model" is what it lacks,
    see :class:`pincal.calibration.discrepancy.Discrepancy`; "arrival" is the repeatability of the
    robot, where the calibration revisited poses; "conditions" is the variation over the
    calibration's rows of effects of a temperature or time that the poses lack; "point" is the
    uncertainty of a point on the tip.

    Attributes:
        station: where the robot was calibrated.
        values: shape (P,), of the station's model.
        covariance: shape (P, P), of these.
        discrepancy: what the model lacks; None where its residuals are noise.
    """

    station: FittedStation
    values: np.ndarray
    covariance: np.ndarray
    discrepancy: Discrepancy | None

    @property
    def arrival(self) -> float:
        """Variance of a coordinate from one visit of a pose to another [m^2]; 0 if unknown."""
        of = self.station.repeatability
        if of is None or self.station.sensor_kind not in _PLACES or not of.between_degrees[0]:
            return 0.0
        return float(of.between_stops[0] ** 2)

    def variances(self, conditions: Conditions) -> dict[str, np.ndarray]:
        """Return the variance of the target's position by each source, shape (N, 3) [m^2]."""
        lacking = unrecorded(self.station, conditions)
        conditions = of_its_day(self.station, conditions)
        n = len(conditions)
        found = {name: np.zeros((n, 3)) for name in ("parameters", "model", "arrival")}
        found["conditions"] = np.zeros((n, 3))
        for start in range(0, n, _PIECE):
            rows = slice(start, start + _PIECE)
            J, levers = self._motion(conditions.select(rows), None)
            by_parameters = np.einsum("nip,nip->ni", J @ self.covariance, J)
            found["parameters"][rows] = np.maximum(by_parameters, 0.0)
            if self.discrepancy is not None:
                blocks = self.discrepancy.variances(levers)
                found["model"][rows] = np.einsum("naa->na", blocks)
        found["arrival"] += self.arrival
        for effect in lacking:
            found["conditions"] += varied_by(self.station, self.values, effect, conditions) ** 2
        return found

    def covariance_of(
        self,
        conditions: Conditions,
        point: PointOnTip | None = None,
        stop: np.ndarray | None = None,
    ) -> PositionCovariance:
        """Return the covariance of positions with each other: of the targets, or of a point on the
        tip, of a model without targets.

        Args:
            conditions: N poses.
            point: on the tip; default: the target.
            stop: shape (N,), numbers of the stops, each with its arrival; default: equal joint
                positions are one stop.
        """
        lacking = unrecorded(self.station, conditions)
        conditions = of_its_day(self.station, conditions)
        rotations = None
        if point is not None:
            rotations = self.station.model.predict(self.values, conditions)[:, :, :3]
        offset = None if point is None or rotations is None else _turned(rotations, point.place)
        J, levers = self._motion(conditions, offset)
        found = {"parameters": SharedErrors.of_all(J @ self._root)}
        if self.discrepancy is not None:
            found["model"] = self.discrepancy.errors(conditions.q, levers)
        if self.arrival:
            where = (
                np.unique(conditions.q, axis=0, return_inverse=True)[1] if stop is None else stop
            )
            each = np.tile(np.sqrt(self.arrival) * np.eye(3), (len(J), 1, 1))
            found["arrival"] = SharedErrors.of_groups(each, np.ravel(where))
        if lacking:
            moved = [varied_by(self.station, self.values, of, conditions) for of in lacking]
            found["conditions"] = SharedErrors.of_all(np.stack(moved, axis=2))
        if point is not None and rotations is not None:
            errors = point.errors(rotations)
            if errors is not None:
                found["point"] = errors
        return PositionCovariance(found)

    @cached_property
    def _root(self) -> np.ndarray:
        """A root of the covariance of the parameters, shape (P, r)."""
        variances, axes = np.linalg.eigh(self.covariance)
        some = variances > 0.0
        return np.asarray(axes[:, some] * np.sqrt(variances[some]))

    @cached_property
    def _moving(self) -> Model:
        """The model with its drives as further parameters."""
        return with_moving_drives(self.station.model)

    def _motion(
        self, conditions: Conditions, offset: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the motion of the target, or of what is at an offset from it, shape (N, 3) [m], by
        the model's parameters, shape (N, 3, P), and by the drives, shape (n, N, 3); the latter is
        empty without a discrepancy.
        """
        model = self.station.model if self.discrepancy is None else self._moving
        n = len(self.values)
        values = np.concatenate([self.values, np.zeros(model.n_parameters - n)])
        _, J = model.linearise(values, conditions, rows=3 if offset is None else 6)
        if offset is not None:
            J = J[:, :3] + np.cross(J[:, 3:], offset[:, :, None], axis=1)
        return J[:, :, :n], np.moveaxis(J[:, :, n:], 2, 0)


def _turned(rotations: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return a place on the tip, shape (3,) or (N, 3), along the axes to which rotations turn,
    shape (N, 3).
    """
    return np.asarray(
        (rotations @ np.broadcast_to(place, (len(rotations), 3))[:, :, None])[:, :, 0]
    )
