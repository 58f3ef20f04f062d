r"""Readings of an IMU on the tool: specific force and angular rate, by finite differences of poses.

In a level frame, whose z points against gravity, the target is the IMU and its pose :math:`(R, p)`
a function of time. Poses at :math:`t - h, t, t + h` give

.. math:: f = R_0^T \left( \frac{p_+ - 2 p_0 + p_-}{h^2} + g e_z \right), \quad
          \omega = \mathrm{vee} \frac{S_+ - S_-}{2 h}, \quad \dot\omega = \mathrm{vee} \frac{S_+ +
          S_-}{h^2}, \quad S_\pm = R_0^T R_\pm ,

vee being that of the antisymmetric part. So the columns of each effect follow from the motions of
these poses. With
:math:`\delta_\pm = R_0^T (d\varphi_\pm - d\varphi_0)`,

.. math:: df = R_0^T \left( \frac{dp_+ - 2 dp_0 + dp_-}{h^2}
          - d\varphi_0 \times (a + g e_z) \right), \quad
          d\omega = \frac{T_+ \delta_+ - T_- \delta_-}{2 h}, \quad
          d\dot\omega = \frac{T_+ \delta_+ + T_- \delta_-}{h^2}, \quad
          T = \tfrac{1}{2} (\mathrm{tr}(S) I - S) .

A row is the mean over a Gaussian window in time, by which the readings are filtered, evaluated by
Gauss-Hermite quadrature. An IMU reads :math:`(I + C_a) f + b_a` and
:math:`(I + C_w)(\omega + \delta \dot\omega) + b_w`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from pincal.errors import MeasurementError
from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.robot.se3 import nearest_rotation, shortest_turn, transform
from pincal.sensors.extrinsics import Extrinsics
from pincal.sensors.fields import Field, TableRows
from pincal.sensors.sensor import Block, OwnParameters, Sensor
from pincal.sensors.setup import Setup
from pincal.thresholds import Count, Scale
from pincal.units import STANDARD_GRAVITY

FORCE = Field("specific_force", ("ax", "ay", "az"), "acceleration")
RATE = Field("angular_rate", ("wx", "wy", "wz"), "angular rate")
# Step of the differences [s]: accurate to 5e-6 for motions of 5 Hz, with rounding errors of 1e-8
# m/s^2.
_STEP: Scale = 2.5e-4
# Quadrature nodes of a window: exact for polynomials of degree 5 in time.
_MOMENTS: Count = 3
# Errors of low-cost IMUs: scale and misalignment [1], biases [m/s^2, rad/s], delay of the gyroscope
# [s].
_SCALE: Scale = 0.02
_FORCE_BIAS: Scale = 0.5
_RATE_BIAS: Scale = 0.02
_DELAY: Scale = 0.02
# Rotation of the accelerometer is part of the mount, so its matrix is triangular.
_OF_FORCE = [(i, j) for i in range(3) for j in range(i + 1)]
_OF_RATE = [(i, j) for i in range(3) for j in range(3)]


@dataclass(frozen=True)
class Window:
    """A Gaussian window in time with its quadrature nodes.

    Attributes:
        width: standard deviation [s]; 0 for an instantaneous reading.
    """

    width: float

    @cached_property
    def _rule(self) -> tuple[np.ndarray, np.ndarray]:
        if self.width == 0.0:
            return np.zeros(1), np.ones(1)
        nodes, weights = np.polynomial.hermite_e.hermegauss(_MOMENTS)
        return self.width * nodes, weights / weights.sum()

    @property
    def weights(self) -> np.ndarray:
        """Weights of the nodes, shape (K,)."""
        return self._rule[1]

    @property
    def offsets(self) -> np.ndarray:
        """Times at which poses are needed, from the middle, shape (3 K,) [s]: before, at and after
        each node.
        """
        return np.asarray((self._rule[0][:, None] + np.array([-_STEP, 0.0, _STEP])).ravel())

    def triples(self, poses: np.ndarray) -> np.ndarray:
        """Return the poses of N rows at these times as shape (N, K, 3, 3, 4)."""
        return poses.reshape(-1, len(self.weights), 3, 3, 4)


@dataclass(frozen=True)
class Inertial:
    """Readings of an ideal IMU in N windows, each of shape (N, 3).

    Attributes:
        force: specific force [m/s^2].
        rate: angular rate [rad/s].
        turning: its derivative [rad/s^2].
    """

    force: np.ndarray
    rate: np.ndarray
    turning: np.ndarray

    @classmethod
    def of(cls, poses: np.ndarray, window: Window, gravity: float = STANDARD_GRAVITY) -> Inertial:
        """Return the readings for poses at the O offsets of each row's window, in a level frame,
        shape (N O, 3, 4).
        """
        weights = window.weights[None, :, None]
        return cls(
            *((weights * part).sum(axis=1) for part in _ideal(window.triples(poses), gravity))
        )


def _ideal(poses: np.ndarray, gravity: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return force, rate and turning at all nodes, shape (N, K, 3) each."""
    R0 = poses[:, :, 1, :, :3]
    upward = _upward(poses, gravity)
    before, after = _relative(poses)
    force = np.einsum("nkba,nkb->nka", R0, upward)
    return force, _vee(after - before) / (2.0 * _STEP), _vee(after + before) / _STEP**2


def _upward(poses: np.ndarray, gravity: float) -> np.ndarray:
    """Return acceleration minus gravity, shape (N, K, 3), in the level frame."""
    p = poses[..., 3]
    # Differences of neighbours first, so that no digits are lost far from the origin.
    found = ((p[:, :, 2] - p[:, :, 1]) - (p[:, :, 1] - p[:, :, 0])) / _STEP**2
    found[..., 2] += gravity
    return np.asarray(found)


def _relative(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotations before and after each node in its axes, shape (N, K, 3, 3) each."""
    back = poses[:, :, 1, :, :3].swapaxes(-1, -2)
    return back @ poses[:, :, 0, :, :3], back @ poses[:, :, 2, :, :3]


def _vee(M: np.ndarray) -> np.ndarray:
    """Return the vectors of the antisymmetric parts of matrices, shape (..., 3)."""
    pairs = ((2, 1), (0, 2), (1, 0))
    return np.stack([0.5 * (M[..., i, j] - M[..., j, i]) for i, j in pairs], axis=-1)


def _skew(v: np.ndarray) -> np.ndarray:
    """Return the matrices of the cross products with vectors, shape (..., 3, 3)."""
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack(
        [np.stack(row, axis=-1) for row in ((o, -z, y), (z, o, -x), (-y, x, o))], axis=-2
    )


def _maps(poses: np.ndarray, gravity: float) -> np.ndarray:
    """Return the linear maps from motions, shape (N, K, 9, 3, 6): rows of force, rate, turning;
    poses; their motions.
    """
    back = poses[:, :, 1, :, :3].swapaxes(-1, -2)
    out = np.zeros((*back.shape[:2], 9, 3, 6))
    for k, weight in enumerate((1.0, -2.0, 1.0)):
        out[:, :, :3, k, :3] = weight / _STEP**2 * back
    # - dphi x u = u x dphi.
    out[:, :, :3, 1, 3:] = back @ _skew(_upward(poses, gravity))
    for k, sign, S in zip((0, 2), (-1.0, 1.0), _relative(poses), strict=True):
        T = 0.5 * (np.trace(S, axis1=2, axis2=3)[..., None, None] * np.eye(3) - S) @ back
        for rows, factor in ((slice(3, 6), sign / (2.0 * _STEP)), (slice(6, 9), 1.0 / _STEP**2)):
            out[:, :, rows, k, 3:] += factor * T
            out[:, :, rows, 1, 3:] -= factor * T
    return out


def imu_parameters() -> tuple[Parameter, ...]:
    """Return the errors of an IMU as parameters: scale and misalignment, biases, delay of the
    gyroscope.
    """
    found = [(f"acc_{'xyz'[i]}{'xyz'[j]}", "1", _SCALE) for i, j in _OF_FORCE]
    found += [(f"acc_bias_{axis}", "m/s^2", _FORCE_BIAS) for axis in "xyz"]
    found += [(f"gyro_{'xyz'[i]}{'xyz'[j]}", "1", _SCALE) for i, j in _OF_RATE]
    found += [(f"gyro_bias_{axis}", "rad/s", _RATE_BIAS) for axis in "xyz"]
    found += [("gyro_delay", "s", _DELAY)]
    return tuple(Parameter(f"imu.{name}", unit, "imu", 0.0, size) for name, unit, size in found)


@dataclass(frozen=True)
class ImuErrors:
    """Errors of an IMU.

    Attributes:
        acc: shape (3, 3), I + C_a.
        acc_bias: shape (3,) [m/s^2].
        gyro: shape (3, 3), I + C_w.
        gyro_bias: shape (3,) [rad/s].
        delay: time by which the gyroscope's stamps are too early [s].
    """

    acc: np.ndarray
    acc_bias: np.ndarray
    gyro: np.ndarray
    gyro_bias: np.ndarray
    delay: float

    @classmethod
    def of(cls, own: np.ndarray) -> ImuErrors:
        """Return the errors for values of :func:`imu_parameters`, shape (22,)."""
        acc = np.eye(3)
        gyro = np.eye(3) + own[9:18].reshape(3, 3)
        for value, place in zip(own[:6], _OF_FORCE, strict=True):
            acc[place] += value
        return cls(acc, own[6:9], gyro, own[18:21], float(own[21]))

    def readings(self, ideal: Inertial) -> np.ndarray:
        """Return the readings with errors, shape (6, N): specific force [m/s^2], angular rate
        [rad/s].
        """
        force = self.acc @ ideal.force.T + self.acc_bias[:, None]
        rate = self.gyro @ (ideal.rate + self.delay * ideal.turning).T + self.gyro_bias[:, None]
        return np.concatenate([force, rate])

    def columns(
        self,
        poses: np.ndarray,
        motion: np.ndarray,
        window: Window,
        gravity: float = STANDARD_GRAVITY,
    ) -> np.ndarray:
        """Return the derivatives of the readings with respect to P parameters that move the IMU,
        shape (P, 6, N).

        Poses are as in :meth:`Inertial.of`, with translation and rotation per parameter in the
        level frame's axes, shape (P, 6, N O).
        """
        maps = _maps(window.triples(poses), gravity) * window.weights[None, :, None, None, None]
        later = maps[:, :, 3:6] + self.delay * maps[:, :, 6:]
        read = [
            np.einsum("ab,nkbqm->mnkqa", M, of)
            for M, of in ((self.acc, maps[:, :, :3]), (self.gyro, later))
        ]
        shape = len(motion), len(maps), len(window.offsets)
        # One linear map per row for each component of the motions of its poses, without reordering
        # them.
        by_pose = np.concatenate(read, axis=-1).reshape(6, *shape[1:], 6)
        moves = motion.reshape(shape[0], 6, *shape[1:])
        columns = np.zeros((shape[1], shape[0], 6))
        for component, by_component in enumerate(by_pose):
            columns += moves[:, component].swapaxes(0, 1) @ by_component
        return np.ascontiguousarray(columns.transpose(1, 2, 0))

    def own_columns(self, ideal: Inertial) -> np.ndarray:
        """Return the derivatives of the readings with respect to the errors, shape (22, 6, N)."""
        later = ideal.rate + self.delay * ideal.turning
        out = np.zeros((22, 6, len(ideal.rate)))
        for p, (i, j) in enumerate(_OF_FORCE):
            out[p, i] = ideal.force[:, j]
        for p, (i, j) in enumerate(_OF_RATE):
            out[9 + p, 3 + i] = later[:, j]
        for axis in range(3):
            out[6 + axis, axis] = out[18 + axis, 3 + axis] = 1.0
        out[21, 3:] = self.gyro @ ideal.turning.T
        return out


@dataclass(frozen=True)
class ImuSensor(Sensor, OwnParameters):
    """IMU on the tool: specific force, shape (N, 3) [m/s^2], and angular rate, shape (N, 3)
    [rad/s], in windows of its log.

    The instrument's frame is level, with z opposite to gravity; the target is the IMU.
    """

    kind: ClassVar[str] = "imu"
    fields: ClassVar[tuple[Field, ...]] = (FORCE, RATE)
    blocks: ClassVar[tuple[Block, ...]] = (
        Block("specific_force", "m/s^2", 3, rounding=1e-7, noise=0.02),
        Block("angular_rate", "rad/s", 3, rounding=1e-8, noise=5e-4),
    )
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS
    base_symbols: ClassVar[tuple[str, ...]] = ("rx", "ry")
    twist_rows: ClassVar[int] = 6
    per_row: ClassVar[tuple[str, ...]] = ("force", "rate")
    default_target: ClassVar[str] = "imu"
    is_on_tool: ClassVar[bool] = True
    reads_place: ClassVar[bool] = False

    force: np.ndarray
    rate: np.ndarray

    @classmethod
    def of(cls, table: TableRows, setup: Setup) -> Self:
        if getattr(table, "moving", None) is None:
            raise MeasurementError(
                f"{table.source}: an IMU is read along the path of the joints; give both as "
                "streams with their times: a folder with joints.csv and imu.csv, or --joints LOG "
                "--imu LOG, which may be one file"
            )
        return cls(table.array(FORCE.name), table.array(RATE.name))

    @property
    def own_parameters(self) -> tuple[Parameter, ...]:
        return imu_parameters()

    @property
    def own_words(self) -> str:
        return ""

    def shifted(self, change: np.ndarray) -> Self:
        return replace(self, force=self.force + change[:3].T, rate=self.rate + change[3:].T)

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        ideal = Inertial.of(poses, self._window(poses))
        return np.asarray(
            np.vstack([self.force.T, self.rate.T]) - ImuErrors.of(own).readings(ideal)
        )

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        errors = ImuErrors.of(own)
        window = self._window(poses)
        return np.concatenate(
            [errors.columns(poses, motion, window), errors.own_columns(Inertial.of(poses, window))]
        )

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return zeros: acceleration and rate determine no position."""
        return np.zeros((len(self), 3))

    def _window(self, poses: np.ndarray) -> Window:
        """Return a window with as many nodes as these poses have; their offsets contain
        its width.
        """
        return Window(float(len(poses) > 3 * len(self)))

    def starts(self, tips: np.ndarray, target: np.ndarray, n_targets: int) -> Iterator[Extrinsics]:
        """Yield the mount by the rates of IMU and tip, with the lever arm and the upward direction
        by the forces.
        """
        window = self._window(tips)
        ideal = Inertial.of(tips, window, 0.0)
        R = tips[len(window.offsets) // 2 :: len(window.offsets), :, :3]
        centred = [rate - rate.mean(axis=0) for rate in (ideal.rate, self.rate)]
        mount = nearest_rotation(centred[0].T @ centred[1])
        spin = _skew(ideal.rate)
        features = [
            R.swapaxes(1, 2),
            _skew(ideal.turning) + spin @ spin,
            np.tile(np.eye(3), (len(R), 1, 1)),
        ]
        left = self.force @ mount.T - ideal.force
        solution = np.linalg.lstsq(
            np.concatenate(features, axis=2).reshape(-1, 9), left.ravel(), rcond=1e-9
        )[0]
        tools = np.tile(transform(mount, solution[3:6]), (n_targets, 1, 1))
        level = shortest_turn(
            solution[:3] / np.linalg.norm(solution[:3]), np.array([0.0, 0.0, 1.0])
        )
        yield Extrinsics(
            transform(level[:3, :3], np.zeros(3)), tools, np.zeros(len(self.own_parameters))
        )

    def unobservable(self) -> Iterator[str]:
        yield (
            "an IMU does not determine the position and heading of the robot, the zeros of the "
            "first and the last joint, those of parallel joints separately, nor lengths, which are "
            "held as in the URDF unless other rows give them"
        )
