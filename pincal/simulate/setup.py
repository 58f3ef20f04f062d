"""Measuring set-ups: what reads the robot, where that stands, which poses suit it, and what it writes down."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.effect import MeasuringEffect
from pincal.simulate.machine import TrueMachine
from pincal.simulate.measure import Table, measure
from pincal.simulate.planning import plan_poses


@dataclass(frozen=True, kw_only=True)
class Setup(ABC):
    """What measures the robot, and where it stands.

    Attributes:
        sigma: Noise of a coordinate or distance [m], of image coordinates [px].
    """

    sigma: float = 0.0

    @property
    @abstractmethod
    def kind(self) -> str:
        """What is measured, as :class:`pincal.measure.measurements.Measurements` names it."""

    @property
    def points(self) -> dict[str, np.ndarray]:
        """Named points as the user knows them [m], shape (3,): in the instrument's frame or the object's own."""
        return {}

    def plan(self, machine: TrueMachine, count: int, rng: np.random.Generator, *, min_height: float | None) -> np.ndarray:
        """Return poses that suit the set-up.

        Args:
            machine: The machine whose nominal arm is planned for.
            count: Number of poses.
            rng: Source of randomness.
            min_height: Height of the floor [m]; None for no floor.

        Returns:
            Joint positions [rad or m], shape (count, n).

        Raises:
            BadInputError: If hardly any pose will do.
        """
        return plan_poses(machine.nominal, count, rng, min_height=min_height)

    @abstractmethod
    def measure(self, machine: TrueMachine, q: np.ndarray, rng: np.random.Generator, **conditions: Any) -> Table:
        """Return the table of poses q, shape (N, n), under conditions as in :func:`pincal.simulate.measure.measure`."""

    @abstractmethod
    def sight(self, tip: np.ndarray) -> np.ndarray:
        """Return what is looked at in the frame of what looks [m], shape (N, 3), for tips in the base, (N, 4, 4)."""

    @abstractmethod
    def truth(self) -> dict[str, Any]:
        """Return where everything stands, for programs."""

    def refuse_scale(self, machine: TrueMachine, why: str) -> None:
        """Refuse a machine with errors of an instrument's lengths, for a set-up that reads none.

        Args:
            machine: The machine.
            why: What the set-up reads instead.

        Raises:
            BadInputError: If the machine has such an error.
        """
        for effect in machine.effects:
            if isinstance(effect, MeasuringEffect):
                raise BadInputError(f"{effect.effect}: it is an error of lengths that are read, and {why}; leave it out")


@dataclass(frozen=True, kw_only=True)
class Beside(Setup):
    """An instrument beside the robot: position, pose or distance of targets on the tool.

    Attributes:
        reads: "position", "pose" or "distance".
        instrument: Transform from the robot's base frame to the instrument's frame, shape (4, 4).
        targets: Place of each target in the tip frame [m], by its name, shape (4, 4).
        sigma_angle: Noise of the orientation about each axis [rad].
        anchors: Distances are measured from each of these points in the robot's base frame [m], shape (3,), by
            name; without any, from the instrument's origin.
    """

    reads: str = "position"
    instrument: np.ndarray
    targets: dict[str, np.ndarray]
    sigma_angle: float = 0.0
    anchors: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """What is read."""
        return self.reads

    @property
    def points(self) -> dict[str, np.ndarray]:
        """The anchors in the instrument's frame."""
        return placed(self.instrument, self.anchors)

    def measure(self, machine: TrueMachine, q: np.ndarray, rng: np.random.Generator, **conditions: Any) -> Table:
        """Return a row for every pose, target and anchor."""
        return measure(
            machine,
            q,
            kind=self.reads,
            base_pose=self.instrument,
            targets=self.targets,
            anchors=self.anchors or None,
            noise_sigma=self.sigma,
            noise_angle=self.sigma_angle,
            rng=rng,
            **conditions,
        )

    def sight(self, tip: np.ndarray) -> np.ndarray:
        """Return the first target in the frame of the instrument, or from the first anchor."""
        seen: np.ndarray = (self.instrument @ tip @ next(iter(self.targets.values())))[:, :3, 3]
        return np.asarray(seen - next(iter(self.points.values()), np.zeros(3)))

    def truth(self) -> dict[str, Any]:
        """Return places of instrument, targets and anchors."""
        found: dict[str, Any] = {
            "T_instrument_base": self.instrument.tolist(),
            "targets": {name: place.tolist() for name, place in self.targets.items()},
        }
        return found | ({"anchors_in_base_m": as_lists(self.anchors)} if self.anchors else {})


def placed(transform: np.ndarray, points: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return named points [m], shape (3,), moved by a transform, shape (4, 4)."""
    return {name: transform[:3, :3] @ place + transform[:3, 3] for name, place in points.items()}


def as_lists(points: dict[str, np.ndarray]) -> dict[str, list[float]]:
    """Return named points as lists, for JSON."""
    return {name: np.asarray(place).tolist() for name, place in points.items()}
