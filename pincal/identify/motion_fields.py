"""Motion fields: how the targets move, as far as readings determine it, if something in a cell
differs from its model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from pincal.identify.station import Station
from pincal.model.effects import JointElasticity
from pincal.model.motions import with_moving_drives
from pincal.thresholds import Scale

# Differences [rad or m] for numerical derivatives.
_MOVED: Scale = 1e-5
# Largest motion [m/m or m/rad] that counts as none.
_NOTHING: Scale = 1e-5


@dataclass(frozen=True)
class MotionField:
    """A motion of the targets: its cause, and its m directions at each row, shape (n, 3, m) [m per
    unit of the cause].
    """

    name: str
    directions: np.ndarray
    unit: str = "m"

    @property
    def freedoms(self) -> int:
        """Number of its directions, m."""
        return int(self.directions.shape[2])


def fields_of_setup(station: Station, values: np.ndarray) -> Iterator[MotionField]:
    """Yield growth about a point, then the motions of a displaced instrument, or of the tool.

    ``station`` is the calibrated model over n rows, ``values``, shape (P,), are its parameters.
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
    """Yield the motion of the targets by each joint that moves them; arguments as for
    :func:`fields_of_setup`.
    """
    robot = station.model.chain.robot
    by_joint = displacements_by_drives(station, values)
    for name, unit, directions in zip(robot.joint_names, robot.joint_units, by_joint, strict=True):
        # A joint that these poses do not observe moves nothing.
        if np.abs(directions).max() > _NOTHING:
            yield MotionField(name, directions[:, :, None], unit)


def displacements_by_drives(station: Station, values: np.ndarray) -> np.ndarray:
    """Return the displacements of the targets by each drive, as far as readings determine them,
    shape (n, N, 3) [m per rad or m].

    The load on the arm is taken as it is.
    """
    moving = station.with_model(with_moving_drives(station.model))
    of_model, own = station.split(values)
    still = np.zeros(moving.model.n_parameters - len(of_model))
    free = np.zeros(len(moving.parameters), bool)
    free[len(of_model) : len(of_model) + len(still)] = True
    return moving.displacements_by(np.concatenate([of_model, still, own]), free)


def field_of_load(station: Station, values: np.ndarray) -> MotionField:
    r"""Return the motion of the targets by compliant drives under another payload; arguments as
    before.

    A weight along the unit vector g turns drive j, with the lever l_j of the target, by its
    compliance times
    :math:`l_j \cdot g`: the target moves along :math:`l_j (l_j \cdot g)`, a direction for each
      drive.
    """
    levers = [
        field.directions[:, :, 0]
        for field in fields_of_joints(station, values)
        if field.unit == "rad"
    ]
    chain = station.model.chain
    gravity = np.asarray(chain.base_rotation).reshape(-1, 3, 3)[0] @ chain.gravity
    down = gravity / max(float(np.linalg.norm(gravity)), 1e-300)
    directions = [lever * (lever @ down)[:, None] for lever in levers]
    felt = [direction for direction in directions if np.abs(direction).max() > _NOTHING]
    return MotionField("load", np.stack(felt, axis=2) if felt else np.zeros((len(station), 3, 0)))


def sag_of_drives(station: Station, values: np.ndarray) -> np.ndarray:
    """Return the displacements of the targets by a compliance of each drive under the arm's own
    weight, which a rigid model lacks, shape (n, 3, J) [m per unit]; no columns if the URDF has no
    masses.
    """
    robot = station.model.chain.robot
    if robot.massless:
        return np.zeros((len(station), 3, 0))
    effects = station.model.effects
    if any(isinstance(effect, JointElasticity) for effect in effects):
        return np.zeros((len(station), 3, 0))
    whole = station.with_model(station.model.with_effects((*effects, JointElasticity())))
    of_model, own = station.split(values)
    size = whole.model.n_parameters - len(of_model)
    free = np.zeros(len(whole.parameters), bool)
    free[len(of_model) : len(of_model) + size] = True
    moved = whole.displacements_by(np.concatenate([of_model, np.zeros(size), own]), free)
    return np.moveaxis(moved, 0, -1)


def _motions(
    station: Station, values: np.ndarray
) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """Return a function from moved flange poses, (n, 3, 4), to the targets' motion, (n, 3), and the
    poses themselves.
    """
    of_model, own = station.split(values)
    sensor = station.sensor
    poses = station.model.predict(of_model, station.conditions)
    here = sensor.displacement(sensor.residuals(poses, own), poses, own)

    def motion(moved: np.ndarray) -> np.ndarray:
        return (
            np.asarray(here - sensor.displacement(sensor.residuals(moved, own), moved, own))
            / _MOVED
        )

    return motion, poses
