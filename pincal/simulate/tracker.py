"""Errors of a laser tracker, derived from the true geometry of its parts.

A tracker turns its head until its beam meets the target, and reads its angle encoders and distance
meter there. An effect maps true positions in the frame of a perfect tracker (origin at the
intersection of the axes, z the standing axis) to the positions read by the imperfect one.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.simulate.effect import HiddenEffect, Scope

# Iterations of the head's pointing, each a thousandth of the one before.
_ROUNDS = 6


class ReadingEffect(HiddenEffect):
    """An error of an instrument's readings."""

    scope: ClassVar[Scope] = Scope.ARM

    @abstractmethod
    def as_read(self, position: np.ndarray) -> np.ndarray:
        """Return the positions read for true ones in the instrument's frame [m], shape (N, 3)."""


@dataclass(frozen=True, kw_only=True)
class MeasurementScale(ReadingEffect):
    """Instrument with a wrong scale; ``size`` is the relative error of every length [-]."""

    effect: ClassVar[str] = "measurement_scale"
    unit: ClassVar[str] = "1"
    typical_size: ClassVar[float] = 2e-5

    def as_read(self, position: np.ndarray) -> np.ndarray:
        return (1.0 + self.size) * position


@dataclass(frozen=True, kw_only=True)
class _Circle(ReadingEffect):
    """An angle encoder whose graduated circle is eccentric or oval.

    Attributes:
        order: 1 for a circle off centre by ``size`` radii, 2 for an oval one.
        phase: Direction of the offset on the circle [rad].
    """

    typical_size: ClassVar[float] = 2e-5
    _coordinate: ClassVar[int]
    order: int = 1
    phase: float = 0.6

    def as_read(self, position: np.ndarray) -> np.ndarray:
        """Return positions at the angles read by one reading head."""
        read = list(spherical(position))
        angle = read[self._coordinate]
        read[self._coordinate] = angle + np.arcsin(
            self.size * np.sin(self.order * angle - self.phase)
        )
        return cartesian(*read)


@dataclass(frozen=True, kw_only=True)
class InstrumentAzimuth(_Circle):
    """Azimuth encoder of a tracker, eccentric or oval; ``size`` is the amplitude of its error
    [rad].
    """

    effect: ClassVar[str] = "instrument_azimuth"
    _coordinate: ClassVar[int] = 0


@dataclass(frozen=True, kw_only=True)
class InstrumentElevation(_Circle):
    """Elevation encoder of a tracker, eccentric or oval; ``size`` is the amplitude of its error
    [rad].
    """

    effect: ClassVar[str] = "instrument_elevation"
    _coordinate: ClassVar[int] = 1


@dataclass(frozen=True, kw_only=True)
class InstrumentTilt(ReadingEffect):
    """Axes of a tracker that are not perpendicular; ``size`` scales the fields, which are in
    radians and metres.

    Attributes:
        transit: Tilt of the transit axis about the horizontal line of sight, from perpendicular to
            the standing axis.
        beam: Rotation of the beam to the right, from perpendicular to the transit axis.
        index: Elevation read with a level beam.
        behind: Offset of the transit axis behind the standing axis, seen from the target.
        right: Offset of the beam to the right of the intersection of the axes.
        below: Offset of the beam below it.
    """

    effect: ClassVar[str] = "instrument_tilt"
    typical_size: ClassVar[float] = 2e-5
    transit: float = 1.0
    beam: float = 0.5
    index: float = 0.0
    behind: float = 0.0
    right: float = 0.0
    below: float = 0.0

    def as_read(self, position: np.ndarray) -> np.ndarray:
        """Return positions at the angles and the range at which the beam meets the target."""
        read = position
        for _ in range(_ROUNDS if self.size else 0):
            read = read + position - self._met(*spherical(read))
        return read

    def _met(self, azimuth: np.ndarray, elevation: np.ndarray, distance: np.ndarray) -> np.ndarray:
        """Return the end of the beam at encoder angles and range, shape (N, 3) [m]."""
        along = np.multiply.outer(distance, np.array([1.0, 0.0, 0.0]))
        beam = _turned("z", -self.size * self.beam, along) - self.size * np.array(
            [0.0, self.right, self.below]
        )
        risen = _turned("y", self.size * self.index - elevation, beam)
        tilted = _turned("x", self.size * self.transit, risen) - self.size * np.array(
            [self.behind, 0.0, 0.0]
        )
        return _turned("z", azimuth, tilted)


def _turned(axis: str, angle: float | np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points, shape (N, 3), rotated about an axis by one angle, or one each [rad]."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler(axis, np.reshape(angle, (-1, 1))).apply(points))


@dataclass(frozen=True, kw_only=True)
class InstrumentRange(ReadingEffect):
    """Distance meter of a tracker with a zero offset; ``size`` is the offset [m]."""

    effect: ClassVar[str] = "instrument_range"
    unit: ClassVar[str] = "m"
    typical_size: ClassVar[float] = 2e-5

    def as_read(self, position: np.ndarray) -> np.ndarray:
        azimuth, elevation, distance = spherical(position)
        return cartesian(azimuth, elevation, distance + self.size)


@dataclass(frozen=True, kw_only=True)
class InstrumentStretch(ReadingEffect):
    """Instrument whose coordinates are stretched along one direction; ``size`` is the strain [-].

    Attributes:
        towards: The direction, of any length.
    """

    effect: ClassVar[str] = "instrument_stretch"
    unit: ClassVar[str] = "1"
    typical_size: ClassVar[float] = 1e-3
    towards: tuple[float, float, float] = (0.8, 0.0, 0.6)

    def as_read(self, position: np.ndarray) -> np.ndarray:
        along = np.array(self.towards) / np.linalg.norm(self.towards)
        return np.asarray(position + self.size * np.outer(position @ along, along))


def spherical(position: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return azimuth and elevation [rad] and range [m] of positions, shape (N, 3)."""
    x, y, z = position.T
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), np.linalg.norm(position, axis=1)


def cartesian(azimuth: np.ndarray, elevation: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return positions, shape (N, 3) [m], from spherical coordinates."""
    level = np.cos(elevation)
    way = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    return np.asarray(distance[:, None] * way)


def as_read(effects: tuple[HiddenEffect, ...], position: np.ndarray) -> np.ndarray:
    """Return the readings of true positions [m], shape (N, 3), by an instrument with its errors
    among the effects.
    """
    for effect in effects:
        if isinstance(effect, ReadingEffect):
            position = effect.as_read(position)
    return position
