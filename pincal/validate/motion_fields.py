"""Which way the targets move, as far as readings tell, if something of a cell is other than its model says."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from pincal.identify.station import Station

# Differences [rad or m] by which things are moved for a derivative.
_MOVED = 1e-5
# Largest motion [m/m or m/rad] that is none.
_NOTHING = 1e-5


@dataclass(frozen=True)
class MotionField:
    """A motion of the targets: what it is of, and shape (n, 3, m), its directions at each row.

    The motion is in metres per metre, or per radian, of what it is of.
    """

    name: str
    directions: np.ndarray
    unit: str = "m"

    @property
    def freedoms(self) -> int:
        """Number of its directions, m."""
        return int(self.directions.shape[2])


def fields_of_setup(station: Station, values: np.ndarray) -> Iterator[MotionField]:
    """Yield growth about a point, then the motions of an instrument that was touched, or of the tool.

    Args:
        station: the calibrated model over n rows.
        values: shape (P,), of its parameters.
    """
    motion, poses = _motions(station, values)

    def shifted(along: np.ndarray) -> np.ndarray:
        moved = poses.copy()
        moved[:, :, 3] += _MOVED * along
        return motion(moved)

    centred = poses[:, :, 3] - poses[:, :, 3].mean(axis=0)
    shifts = [shifted(axis) for axis in np.eye(3)]
    turns = [shifted(np.cross(axis, centred)) for axis in np.eye(3)]
    yield MotionField("growth", np.stack([*shifts, shifted(centred)], axis=2))
    yield MotionField("instrument", np.stack(shifts, axis=2))
    yield MotionField("instrument", np.stack([*shifts, *turns], axis=2))
    yield MotionField("tool", np.stack([shifted(poses[:, :, a]) for a in range(3)], axis=2))


def fields_of_joints(station: Station, values: np.ndarray) -> Iterator[MotionField]:
    """Yield the motion of the targets by each joint that moves them; arguments are those of :func:`fields_of_setup`."""
    motion, _ = _motions(station, values)
    of_model, _ = station.split(values)
    robot = station.model.chain.robot
    for j, (name, unit) in enumerate(zip(robot.joint_names, robot.joint_units, strict=True)):
        moved = station.conditions.q.copy()
        moved[:, j] += _MOVED
        directions = motion(station.model.predict(of_model, replace(station.conditions, q=moved)))
        # One that these poses do not see moves nothing.
        if np.abs(directions).max() > _NOTHING:
            yield MotionField(name, directions[:, :, None], unit)


def _motions(station: Station, values: np.ndarray) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """Return what gives the motion of the targets, (n, 3), from moved flange poses, (n, 3, 4), and these not moved."""
    of_model, own = station.split(values)
    sensor, poses = station.sensor, station.model.predict(of_model, station.conditions)
    here = sensor.displacement(sensor.residuals(poses, own), poses, own)

    def motion(moved: np.ndarray) -> np.ndarray:
        return np.asarray(here - sensor.displacement(sensor.residuals(moved, own), moved, own)) / _MOVED

    return motion, poses
