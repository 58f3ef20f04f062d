"""What a hidden effect of the true machine is.

Every effect is a small frozen value with the name that discovery reports, the joint on which it acts and a
size whose unit its class states. A size of 0 is no effect. Effects are written from the mechanism (crank,
play, bumps), not from the linear basis functions of the fit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pincal.simulate.arm import Arm
from pincal.simulate.state import Deformation, Loads, Poses


@dataclass(frozen=True, kw_only=True)
class HiddenEffect(ABC):
    """One physical cause in the true machine.

    Attributes:
        joint: Joint on which it acts, None for an effect of the whole arm.
        size: Its size in the unit that the class states.
    """

    effect: ClassVar[str]
    joint: str | None = None
    size: float = 0.0


class DeformingEffect(HiddenEffect):
    """An effect that moves a part of the arm."""

    @abstractmethod
    def deform(self, arm: Arm, poses: Poses, loads: Loads, deformation: Deformation) -> None:
        """Add what the effect does to each pose.

        Args:
            arm: The true arm, in whose working frames everything is expressed.
            poses: Recorded poses and conditions.
            loads: Gravity loads on the deformed arm.
            deformation: Sum of all effects, added to in place.
        """


class LoadingEffect(HiddenEffect):
    """An effect that changes what the arm carries."""

    @abstractmethod
    def true_payload(self, mass: np.ndarray, com: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return true mass [kg], shape (N,), and centre of mass [m, tip frame], shape (N, 3)."""


class MeasuringEffect(HiddenEffect):
    """An effect of the instrument."""

    @abstractmethod
    def reading(self, position: np.ndarray) -> np.ndarray:
        """Return what the instrument reads for true positions in its frame [m], shape (N, 3)."""
