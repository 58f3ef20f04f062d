"""Sensors: what an instrument reads of a pose, and how the reading moves with it.

A sensor knows the target's pose in the instrument's frame and nothing of robots. It says which coordinates of base and
tool its readings can depend on, and may own parameters (where a socket is, a focal length). Whatever is asked of
measurements elsewhere goes through this interface.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from pincal.parameters import FRAME_SYMBOLS, Parameter
from pincal.robot.se3 import exponentials, rotation_vectors


@dataclass(frozen=True)
class Block:
    """Components of a reading that share a unit and a standard deviation.

    Attributes:
        name: "position", "orientation" or "distance".
        unit: "m", "rad" or "px".
        size: number of components.
        rounding: of a prediction; noise is never taken to be less.
    """

    name: str
    unit: str
    size: int
    rounding: float = 1e-12


@dataclass(frozen=True)
class Constraints:
    """C facts on a sensor's own parameters, as if they were readings.

    Attributes:
        residuals: shape (C,), known minus predicted.
        jacobian: shape (own, C), derivative of the predicted.
        sigma: shape (C,), standard deviations.
    """

    residuals: np.ndarray
    jacobian: np.ndarray
    sigma: np.ndarray


class Sensor(ABC):
    """Readings of N poses."""

    kind: ClassVar[str]
    blocks: ClassVar[tuple[Block, ...]]
    tool_symbols: ClassVar[tuple[str, ...]]
    twist_rows: ClassVar[int]

    @property
    def base_symbols(self) -> tuple[str, ...]:
        """Coordinates of the base frame that the readings can depend on."""
        return FRAME_SYMBOLS

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def select(self, rows: slice | np.ndarray) -> Sensor:
        """Return the readings of some rows."""

    @abstractmethod
    def shifted(self, change: np.ndarray) -> Sensor:
        """Return readings that differ by ``change``, shape (m, N), in the components of the residuals."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters that the sensor owns; none unless it says so."""
        return ()

    @property
    def fixed(self) -> np.ndarray:
        """Which of its own parameters are known and stay as they are, shape (own,)."""
        return np.zeros(len(self.parameters), bool)

    @property
    def groups(self) -> np.ndarray | None:
        """What each row has to do with, shape (N,), where its own parameters need rows of everything; else None."""
        return None

    @property
    def is_whole(self) -> bool:
        """Whether the rows make sense only together, so that they can't be worked on in pieces."""
        return False

    def constraints(self, own: np.ndarray) -> Constraints | None:
        """Return what is known of the sensor's own parameters beside the readings, None where nothing is."""
        return None

    def displacement(self, residuals: np.ndarray, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return which way and how far the target is off its prediction, as far as the reading tells.

        Args:
            residuals: shape (m, N), as :meth:`residuals` has them.
            poses: shape (N, 3, 4), the target in the instrument's frame.
            own: values of the sensor's parameters.

        Returns:
            Shape (N, 3) [m], in the instrument's axes.
        """
        return residuals[:3].T

    @abstractmethod
    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction.

        Args:
            poses: shape (N, 3, 4), the target in the instrument's frame.
            own: values of the sensor's parameters.

        Returns:
            Shape (m, N), block after block.
        """

    @abstractmethod
    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the derivative of minus the residuals.

        Args:
            poses: shape (N, 3, 4).
            motion: shape (P, ``twist_rows``, N), motion of the target by parameter, in the instrument's axes.
            own: values of the sensor's parameters.

        Returns:
            Shape (P + number of own parameters, m, N).
        """


@dataclass(frozen=True)
class PositionSensor(Sensor):
    """3D: the position of the target, shape (N, 3) [m], e.g. by laser tracker and reflector."""

    position: np.ndarray
    kind: ClassVar[str] = "position"
    blocks: ClassVar[tuple[Block, ...]] = (Block("position", "m", 3),)
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS[:3]
    twist_rows: ClassVar[int] = 3

    def __len__(self) -> int:
        return len(self.position)

    def select(self, rows: slice | np.ndarray) -> PositionSensor:
        """Return the readings of some rows."""
        return replace(self, position=self.position[rows])

    def shifted(self, change: np.ndarray) -> PositionSensor:
        """Return positions moved by ``change``, shape (3, N) [m]."""
        return replace(self, position=self.position + change.T)

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return reading minus prediction, shape (3, N) [m]."""
        return np.asarray(self.position.T - poses[:, :, 3].T)

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion itself."""
        return motion


@dataclass(frozen=True)
class PoseSensor(Sensor):
    """6D: position, shape (N, 3) [m], and orientation, shape (N, 3, 3), of the tool."""

    position: np.ndarray
    rotation: np.ndarray
    kind: ClassVar[str] = "pose"
    blocks: ClassVar[tuple[Block, ...]] = (Block("position", "m", 3), Block("orientation", "rad", 3))
    tool_symbols: ClassVar[tuple[str, ...]] = FRAME_SYMBOLS
    twist_rows: ClassVar[int] = 6

    def __len__(self) -> int:
        return len(self.position)

    def select(self, rows: slice | np.ndarray) -> PoseSensor:
        """Return the readings of some rows."""
        return replace(self, position=self.position[rows], rotation=self.rotation[rows])

    def shifted(self, change: np.ndarray) -> PoseSensor:
        """Return poses moved by ``change``, shape (6, N) [m, rad]; exact to first order in the turning."""
        return replace(self, position=self.position + change[:3].T, rotation=exponentials(change[3:].T) @ self.rotation)

    def residuals(self, poses: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return position [m] and the rotation vector from predicted to measured orientation [rad], shape (6, N)."""
        turn = rotation_vectors(self.rotation @ poses[:, :, :3].transpose(0, 2, 1))
        return np.vstack([self.position.T - poses[:, :, 3].T, turn.T])

    def jacobian(self, poses: np.ndarray, motion: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Return the motion; the turning through the inverse right Jacobian of the rotation vector."""
        turn = self.residuals(poses, own)[3:].T
        out = motion.copy()
        for i, row in enumerate(_inverse_right_jacobian(turn).transpose(1, 2, 0)):
            out[:, 3 + i] = row[0] * motion[:, 3] + row[1] * motion[:, 4] + row[2] * motion[:, 5]
        return out


def _inverse_right_jacobian(phi: np.ndarray) -> np.ndarray:
    """Return J_r(phi)^-1, shape (N, 3, 3): log(exp(phi) exp(-w)) = phi - J_r^-1 w + O(w^2) [Sola et al. 2018, Eq. 144]."""
    angle2 = np.einsum("ni,ni->n", phi, phi)
    angle = np.sqrt(angle2)
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    series = 1.0 / 12.0 + angle2 / 720.0
    factor = np.where(small, series, 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe)))
    cross = np.zeros((len(phi), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -phi[:, 2], phi[:, 1], -phi[:, 0]
    cross[:, 1, 0], cross[:, 2, 0], cross[:, 2, 1] = phi[:, 2], -phi[:, 1], phi[:, 0]
    return np.eye(3) + 0.5 * cross + factor[:, None, None] * (cross @ cross)
