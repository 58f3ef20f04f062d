"""The joint axes of an arm, with their distortions exaggerated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.model.chain import Chain
from pincal.robot.kinematics import Kinematics
from pincal.robot.se3 import rotation, translation

# Angle [rad] as which the largest tilt of an axis is drawn, at most; and part of the reach for the largest offset.
_DRAWN_TILT = 0.25
_DRAWN_OFFSET = 0.06
# Tilts and offsets below which an axis counts as undistorted [rad, m].
_NO_TILT = 1e-12


@dataclass(frozen=True)
class Axis:
    """One joint axis, nominal and with its distortion exaggerated, in the link frame that it is mounted on.

    Attributes:
        joint: name.
        nominal: shape (2, 3), its ends [m].
        actual: shape (2, 3), likewise, tilt and offset times the factor.
        tilt: how far the calibration tilts it [rad].
        offset: how far it moves it sideways where the URDF has the joint [m].
    """

    joint: str
    nominal: np.ndarray
    actual: np.ndarray
    tilt: float
    offset: float


def axes_of(calibrated: CalibratedModel, factor: float | None = None) -> tuple[tuple[Axis, ...], float]:
    """Return the joint axes and the factor by which their distortions are exaggerated.

    Args:
        calibrated: the robot.
        factor: of tilts and offsets; default: a round number, such that the largest can be seen and none misleads.
    """
    chain = calibrated.model.chain
    coordinates = calibrated.model.rigid_coordinates(calibrated.model_values)
    # Where along its own axis the URDF has each joint, from the foot of its Denavit-Hartenberg frame [m].
    after = Kinematics.of(chain.robot).after
    heights = [float((B @ T)[2, 3]) for B, T in zip(after, chain.robot.T_link_joint, strict=True)]
    found = [_distortion(chain, coordinates, i, height) for i, height in enumerate(heights)]
    reach = chain.robot.reach
    if factor is None:
        tilt, offset = (max(float(np.linalg.norm(change[k])) for change in found) for k in (1, 2))
        room = [_DRAWN_TILT / tilt] if tilt > _NO_TILT else []
        room += [_DRAWN_OFFSET * reach / offset] if offset > _NO_TILT else []
        factor = round_down(min(room, default=1.0))
    half = 0.11 * reach
    return tuple(
        Axis(
            name,
            _line(frame, np.zeros(2), np.zeros(2), height, half),
            _line(frame, factor * tilt, factor * offset, height, half),
            float(np.linalg.norm(tilt)),
            float(np.linalg.norm(offset)),
        )
        for name, (frame, tilt, offset), height in zip(chain.robot.joint_names, found, heights, strict=True)
    ), factor


def round_down(value: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above ``value``.

    Example:
        >>> [round_down(x) for x in (730.0, 200.0, 0.19)]
        [500.0, 200.0, 0.1]
    """
    power = 10.0 ** np.floor(np.log10(value) + 1e-9)
    step = max(digit for digit in (1.0, 2.0, 5.0) if digit * power <= value * (1.0 + 1e-9))
    return float(step * power)


def _distortion(chain: Chain, coordinates: np.ndarray, i: int, height: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the nominal axis' frame in the link before it, and tilt [rad] and offset [m] across it, shape (2,) each."""

    def mounted(values: np.ndarray) -> np.ndarray:
        link = np.eye(4)
        if i:
            a, d, alpha = (values[chain.joint(i - 1, symbol)] for symbol in ("a", "d", "alpha"))
            link = translation(a, 0.0, d) @ rotation("x", alpha)
        s_x, s_y = (values[chain.joint(i, symbol)] for symbol in ("s_x", "s_y"))
        return np.asarray(link @ (rotation("x", s_x) @ rotation("y", s_y)))

    nominal = mounted(chain.nominal)
    change = np.linalg.inv(nominal) @ mounted(coordinates)
    # The nominal step from the frame before the link's to the link's own is in both.
    link = np.eye(4) if i == 0 else Kinematics.of(chain.robot).after[i - 1]
    return np.linalg.inv(link) @ nominal, change[:2, 2], change[:2, 3] + change[:2, 2] * height


def _line(frame: np.ndarray, tilt: np.ndarray, offset: np.ndarray, height: float, half: float) -> np.ndarray:
    """Return the ends of a line about the z axis of a frame, shape (2, 3)."""
    angle = float(np.linalg.norm(tilt))
    across = tilt / angle if angle > 0.0 else np.zeros(2)
    direction = np.array([*(np.sin(angle) * across), np.cos(angle)])
    middle = np.array([*offset, height])
    ends = np.array([middle - half * direction, middle + half * direction])
    return np.asarray(ends @ frame[:3, :3].T + frame[:3, 3])
