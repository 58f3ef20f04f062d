"""A robot with a camera on its flange, and readings of a part, for tests of ``pincal measure``."""

from dataclasses import replace

import numpy as np

from pincal import Robot
from pincal.calibration.covered import Covered
from pincal.calibration.fitted_robot import FittedRobot
from pincal.compensate.robot_frames import in_base_frame
from pincal.features.readings import FeatureReadings, readings_of
from pincal.measure.measurements import measurements_from_arrays
from pincal.model.chain import Chain
from pincal.model.effects import BaseFrame, JointOffset, ToolFrame
from pincal.model.model import Model
from pincal.parameters import estimate_of
from pincal.sensors.lens import Lens
from pincal.sensors.setup import Setup

ROBOT = Robot.from_urdf("ur10")
LENS = Lens(1500.0, 1480.0, 640.0, 512.0, k1=-0.05, p1=1e-3)


def robot_with(kind: str, *, seed: int = 3, size: float = 1e-5, sigma: float = 5e-5) -> FittedRobot:
    """Return a UR10 with uncertain base, tool and offsets [m, rad], as calibrated with readings of a kind."""
    model = Model(Chain.of(ROBOT), (BaseFrame(), ToolFrame(), JointOffset()))
    rng = np.random.default_rng(seed)
    mixed = rng.normal(0.0, size / np.sqrt(model.n_parameters), (model.n_parameters, model.n_parameters))
    values = rng.normal(0.0, 1e-2, model.n_parameters)
    covered = Covered(np.tile([-3.2, 3.2], (6, 1)), np.array([0.0, 0.0]))
    estimate = estimate_of(model.parameters, values, mixed @ mixed.T)
    return FittedRobot.given(model, estimate, covered, sensor_kind=kind, sigma=(sigma,))


def changed(robot: FittedRobot, k: int, step: float) -> FittedRobot:
    """Return the robot with another value of its k-th parameter."""
    values = robot.values.copy()
    values[k] += step
    return replace(robot, estimate=estimate_of(robot.model.parameters, values, robot.covariance))


def poses_near(rng: np.random.Generator, n: int, spread: float = 0.25) -> np.ndarray:
    """Return joint positions about one pose, shape (n, 6) [rad]."""
    return np.array([0.3, -1.2, 1.4, -0.8, -1.3, 0.4]) + rng.uniform(-spread, spread, (n, 6))


def seen_by(robot: FittedRobot, q: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return places of the instrument's frame in the frame of the robot's target at poses, shape (N, 3) [m]."""
    poses = robot.predict(q)
    return np.einsum("nij,ni->nj", poses[:, :, :3], places - poses[:, :, 3])


def ahead(robot: FittedRobot, q: np.ndarray, distance: float = 0.4) -> np.ndarray:
    """Return a place in front of the target at the mean of some poses, shape (3,) [m]."""
    poses = robot.predict(q)
    return np.asarray(np.mean(poses[:, :, 3] + distance * poses[:, :, 2], axis=0))


def towards(robot: FittedRobot, q: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the joint positions at which the target's z axis points at a place, by a search from each pose."""
    from scipy.optimize import least_squares

    def miss(at: np.ndarray) -> np.ndarray:
        seen = seen_by(robot, at[None], place[None])[0]
        return np.asarray(np.append(seen[:2], 1e-2 * (at - start)))

    found = []
    for start in q:
        found.append(least_squares(miss, start).x)
    return np.array(found)


def reaching(robot: FittedRobot, start: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the joint positions near a start at which the target is at a place, shape (6,)."""
    from scipy.optimize import least_squares

    def miss(at: np.ndarray) -> np.ndarray:
        return np.append(1e3 * (robot.predict(at[None])[0, :, 3] - place), 1e-6 * (at - start))

    return np.asarray(least_squares(miss, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).x)


def table(q: np.ndarray, feature: list[str] | np.ndarray, **read: np.ndarray) -> FeatureReadings:
    """Return readings at poses; conditions such as ``point`` or ``stop`` go to the rows."""
    seen = {name: read.pop(name) for name in ("camera_point", "pixel", "distance", "pass_name") if name in read}
    rows = measurements_from_arrays(ROBOT.joint_names, q, **read)
    return readings_of(rows, np.asarray(feature), **seen)


def mount_of(robot: FittedRobot) -> np.ndarray:
    """Return the pose of the target in the tip's frame, shape (3, 4)."""
    q = np.zeros((1, 6))
    tip = robot.between().predict(q)[0]
    target = in_base_frame(robot).predict(q)[0]
    turned = tip[:, :3].T @ target
    turned[:, 3] -= tip[:, :3].T @ tip[:, 3]
    return np.asarray(turned)


def with_camera(robot: FittedRobot, seed: int = 5) -> FittedRobot:
    """Return the robot with a calibrated camera, whose errors are correlated with those of the arm."""
    own = Setup(lens=LENS, fit_lens=True).lens_parameters()
    parameters = (*robot.model.parameters, *own)
    sizes = np.concatenate([np.full(len(robot.values), 1e-5), np.full(4, 0.2), np.full(5, 1e-4)])
    mixed = sizes[:, None] * np.random.default_rng(seed).normal(0.0, 0.2, (len(sizes), len(sizes)))
    values = np.append(robot.values, np.zeros(len(own)))
    station = replace(robot.station, parameter_names=tuple(p.name for p in parameters))
    return replace(robot, stations=(station,), estimate=estimate_of(parameters, values, mixed @ mixed.T))
