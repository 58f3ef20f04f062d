"""The uncertainty of predicted positions of a fitted robot at one station, by its sources."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from pincal.calibration.another_day import of_its_day, unrecorded, varied_by
from pincal.calibration.discrepancy import Discrepancy
from pincal.calibration.fitted_station import FittedStation
from pincal.calibration.position_covariance import PositionCovariance, SharedErrors
from pincal.errors import BadInputError
from pincal.model.conditions import Conditions
from pincal.model.model import Model
from pincal.model.motions import with_moving_drives
from pincal.parameters import quick_root_of
from pincal.thresholds import Count
from pincal.units import real_array

# What makes predictions uncertain, as budgets name it, besides a point on the tip.
POSITION_SOURCES = ("parameters", "model", "arrival", "conditions")
# Rows per piece: with 60 parameters a piece is about 6 MB.
_PIECE: Count = 4096
# Kinds of readings whose repeatability is that of a position.
_PLACES = ("position", "pose")


@dataclass(frozen=True, eq=False)
class PointOnTip:
    """A point fixed to the tip at each of N poses.

    Attributes:
        place: shape (N, 3), in the tip's frame [m].
        covariance: shape (3, 3) of a point that all poses have in common, or (N, 3, 3) of one of
            each pose, in the tip's frame [m^2]; None for one that is known.
    """

    place: np.ndarray
    covariance: np.ndarray | None = None

    @classmethod
    def given(cls, place: ArrayLike, covariance: ArrayLike | None, n: int) -> PointOnTip:
        """Return a point at each of n poses as a user gives it.

        Args:
            place: shape (3,) or (n, 3), in the tip's frame [m].
            covariance: shape (3, 3) or (n, 3, 3), likewise [m^2]; None for a known point.
            n: number of poses.

        Raises:
            BadInputError: for points or covariances of another shape.
        """
        at = real_array(place, "points on the tip")
        if at.shape not in ((3,), (n, 3)):
            raise BadInputError(
                f"points on the tip have shape {at.shape}; expected (3,), or ({n}, 3), one per pose"
            )
        at = np.asarray(np.broadcast_to(at, (n, 3)))
        if covariance is None:
            return cls(at)
        known = real_array(covariance, "covariances of points on the tip")
        if known.shape not in ((3, 3), (n, 3, 3)):
            raise BadInputError(
                f"covariances of points on the tip have shape {known.shape}; expected (3, 3), or "
                f"({n}, 3, 3), one per pose"
            )
        return cls(at, known)

    def offsets(self, rotations: np.ndarray) -> np.ndarray:
        """Return where it is relative to the tip, shape (N, 3) [m], along the axes to which
        rotations, shape (N, 3, 3), turn.
        """
        return np.asarray(np.einsum("nij,nj->ni", rotations, self.place))

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
        """Variance of a coordinate of a position from one visit of a pose to another [m^2]; 0 if
        unknown.
        """
        return self._arrival(0)

    def variances(self, conditions: Conditions, *, turns: bool = False) -> dict[str, np.ndarray]:
        """Return the variance of the target's position by each source, shape (N, 3) [m^2]; with
        ``turns`` also that of its orientation, of a rotation vector in the instrument's axes, shape
        (N, 6) [m^2, rad^2].

        What conditions that are not recorded do to orientations is not known, and 0.
        """
        lacking = unrecorded(self.station, conditions)
        conditions = of_its_day(self.station, conditions)
        size = 6 if turns else 3
        found = {name: np.zeros((len(conditions), size)) for name in POSITION_SOURCES}
        for rows in _pieces(len(conditions)):
            J, levers = self._motion(conditions.select(rows), size)
            found["parameters"][rows] = self._along(J)
            if self.discrepancy is not None:
                found["model"][rows] = _lacking(self.discrepancy, levers)
        found["arrival"] += np.repeat([self._arrival(0), self._arrival(1)], 3)[:size]
        for effect in lacking:
            moved = varied_by(self.station, self.values, effect, conditions)
            found["conditions"][:, :3] += moved**2
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
        found: dict[str, SharedErrors] = {}
        if point is None:
            J, levers = self._motion(conditions, 3)
        else:
            rotations = self.station.model.predict(self.values, conditions)[:, :, :3]
            J, levers = self._motion_of(conditions, point.offsets(rotations))
            if (errors := point.errors(rotations)) is not None:
                found["point"] = errors
        found["parameters"] = SharedErrors.of_all(
            np.ascontiguousarray(self._through(J).transpose(2, 1, 0))
        )
        if self.discrepancy is not None:
            found["model"] = self.discrepancy.errors(conditions.q, levers)
        if arrival := self._arrival(0):
            of_pose = np.unique(conditions.q, axis=0, return_inverse=True)[1].ravel()
            each = np.tile(np.sqrt(arrival) * np.eye(3), (len(J), 1, 1))
            found["arrival"] = SharedErrors.of_groups(each, of_pose if stop is None else stop)
        if lacking:
            moved = [varied_by(self.station, self.values, of, conditions) for of in lacking]
            found["conditions"] = SharedErrors.of_all(np.stack(moved, axis=2))
        return PositionCovariance(found)

    @cached_property
    def _root(self) -> np.ndarray:
        """A root of the covariance of the parameters, shape (P, r)."""
        known = np.flatnonzero(np.diag(self.covariance) > 0.0)
        of_known = quick_root_of(self.covariance[np.ix_(known, known)])
        root = np.zeros((len(self.covariance), of_known.shape[1]))
        root[known] = of_known
        return root

    @cached_property
    def _moving(self) -> Model:
        """The model with its drives as further parameters."""
        return with_moving_drives(self.station.model)

    def _arrival(self, block: int) -> float:
        """Return the variance of a component of a block, position [m^2] or orientation [rad^2],
        from one visit of a pose to another; 0 if unknown.
        """
        of = self.station.repeatability
        if of is None or self.station.sensor_kind not in _PLACES:
            return 0.0
        if len(of.between_stops) <= block or not of.between_degrees[block]:
            return 0.0
        return float(of.between_stops[block] ** 2)

    def _along(self, J: np.ndarray) -> np.ndarray:
        """Return the variances by the parameters through J, shape (N, m, P), as shape (N, m)."""
        along = self._through(J)
        return np.asarray(np.einsum("rmn,rmn->nm", along, along))

    def _through(self, J: np.ndarray) -> np.ndarray:
        """Return J, shape (N, m, P), times the root of the covariance, shape (r, m, N)."""
        # In the order in which a Jacobian is made, so that nothing is copied.
        by_parameter = J.transpose(2, 1, 0).reshape(J.shape[2], -1)
        return np.asarray((self._root.T @ by_parameter).reshape(-1, *J.shape[1::-1]))

    def _motion_of(
        self, conditions: Conditions, offsets: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return as :meth:`_motion` the motion of what is at offsets from the target, shape (N, 3)
        [m].
        """
        J, levers = self._motion(conditions, 6)
        return (
            J[:, :3] + np.cross(J[:, 3:], offsets[:, :, None], axis=1),
            levers[:, :, :3] + np.cross(levers[:, :, 3:], offsets),
        )

    def _motion(self, conditions: Conditions, rows: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the motion of the target, 3 rows of its position or 6 with its rotation, by the
        model's parameters, shape (N, rows, P), and by the drives, shape (n, N, rows); the latter is
        empty without a discrepancy.
        """
        model = self.station.model if self.discrepancy is None else self._moving
        n = len(self.values)
        values = np.concatenate([self.values, np.zeros(model.n_parameters - n)])
        _, J = model.linearise(values, conditions, rows=rows)
        return J[:, :, :n], np.moveaxis(J[:, :, n:], 2, 0)


def _lacking(discrepancy: Discrepancy, levers: np.ndarray) -> np.ndarray:
    """Return the variances by what a model lacks, shape (N, 3) or (N, 6), for levers of its drives,
    shape (n, N, 3) or (n, N, 6).
    """
    of_position = np.einsum("naa->na", discrepancy.variances(levers[:, :, :3]))
    if levers.shape[2] == 3:
        return np.asarray(of_position)
    return np.hstack([of_position, discrepancy.turn_variances(levers[:, :, 3:])])


def _pieces(n: int) -> Iterator[slice]:
    """Yield the rows of a table of n, piece by piece."""
    for start in range(0, n, _PIECE):
        yield slice(start, start + _PIECE)
