"""Tables of machines of the KUKA's type whose poses are visited in several passes, and what changes between these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pincal import Robot
from pincal import simulate as sim
from pincal.builtin import kuka_urdf_path
from pincal.measure.measurements import Measurements, measurements_from_arrays

URDF = kuka_urdf_path()
ROBOT = Robot.from_urdf(URDF)
NOISE = 15e-6
TARGETS = {"r1": (0.1, 0.0, 0.2), "r2": (-0.1, 0.05, 0.15), "r3": (0.0, -0.12, 0.25)}


@dataclass(frozen=True)
class Visited:
    """How poses are visited.

    Attributes:
        poses, cycles: their number, and the visits of each.
        arrival: standard deviation of where drives stop [rad].
        order: of the poses in each pass: "same", "random", or "sorted" by joint 1; "in turn": all visits of a pose at once,
            told by a column ``stop``.
        targets: number of reflectors read in each stop.
        dwell: readings of each in a stop.
        joints: returns the true joint positions of stops from those planned, shape (S, 6), the visits of each pose, from 0,
            shape (S,), and random numbers.
        readings: returns the positions of targets at stops, likewise, from the true ones, shape (S, targets, 3).
    """

    poses: int = 60
    cycles: int = 2
    arrival: float = 2e-5
    order: str = "random"
    targets: int = 1
    dwell: int = 1
    joints: Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray] = field(default=lambda q, visit, rng: q)
    readings: Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray] = field(default=lambda x, visit, rng: x)

    def table(self, seed: int, *, wrong: float = 0.0, size: float = 0.0) -> tuple[Measurements, np.ndarray]:
        """Return a table, and which of its rows are wrong readings: a part of them, off by a size [m]."""
        rng = np.random.default_rng(seed)
        machine = sim.TrueMachine.from_urdf(URDF, tip="tool0").draw_errors(rng, sigma_length=5e-4, sigma_angle=5e-4)
        q = sim.plan_poses(machine.nominal, self.poses, rng)
        pose = self._route(q, rng)
        visit = np.array([np.count_nonzero(pose[:i] == at) for i, at in enumerate(pose)])
        true = self.joints(q[pose], visit, rng) + self.arrival * rng.standard_normal((len(pose), 6))
        targets = dict(list(TARGETS.items())[: self.targets])
        columns = sim.Instrument(targets=targets).measure(machine, true, rng=rng)
        at = np.column_stack([columns[axis] for axis in "xyz"]).reshape(len(pose), self.targets, 3)
        at = np.repeat(self.readings(at, visit, rng), self.dwell, axis=0).reshape(-1, 3)
        position = at + NOISE * rng.standard_normal(at.shape)
        is_wrong = rng.random(len(at)) < wrong
        away = rng.standard_normal(at.shape)
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        position += np.where(is_wrong[:, None], size * away, 0.0)
        more: dict[str, object] = {}
        if self.targets > 1:
            more["target"] = list(targets) * (len(pose) * self.dwell)
        if self.order == "in turn":
            more["stop"] = np.repeat(np.arange(len(pose)), self.dwell * self.targets).astype(str)
        read = np.repeat(q[pose], self.dwell * self.targets, axis=0)
        return measurements_from_arrays(machine.names, read, position=position, **more), is_wrong

    def _route(self, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return the pose of each stop, shape (S,)."""
        if self.order == "in turn":
            return np.repeat(np.arange(self.poses), self.cycles)
        if self.order == "random":
            return np.concatenate([rng.permutation(self.poses) for _ in range(self.cycles)])
        one = np.argsort(q[:, 0]) if self.order == "sorted" else np.arange(self.poses)
        return np.tile(one, self.cycles)


def drawn(rng: np.random.Generator) -> Visited:
    """Return sound visits: 2 to 10 cycles, drives that stop to 0 to 60 urad, one or three targets, dwell, any order."""
    cycles = int(rng.choice([2, 3, 5, 10]))
    return Visited(
        poses=50 if cycles < 10 else 30,
        cycles=cycles,
        arrival=float(rng.choice([0.0, 1e-5, 2e-5, 3e-5, 6e-5])),
        order=str(rng.choice(["random", "sorted", "same", "in turn"])),
        targets=int(rng.choice([1, 1, 3])),
        dwell=int(rng.choice([1, 1, 3])),
    )
