"""Set-ups that hold the tool point at fixed places: sockets, and a bar of constant length."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.contact import Point, measure_held, plan_held
from pincal.simulate.effect import MeasuringEffect
from pincal.simulate.machine import TrueMachine
from pincal.simulate.measure import Table, noise
from pincal.simulate.places import directions, tool_points
from pincal.simulate.setup import Setup, as_lists, placed

# A pose given for contact has to bring the tool point this close to a place where it can be held [m].
_NEAR = 0.02


@dataclass(frozen=True, kw_only=True)
class _Held(Setup):
    """The tool point is held at fixed places, alone or by a bar.

    Attributes:
        tool: Tool point in the tip frame [m].
        fixed: The places in the robot's base frame [m], shape (3,), by name.
        instrument: Transform from the robot's base frame to that in which the places are known, shape (4, 4).
    """

    tool: Point
    fixed: dict[str, np.ndarray]
    instrument: np.ndarray

    @property
    def points(self) -> dict[str, np.ndarray]:
        """The places in the instrument's frame."""
        return placed(self.instrument, self.fixed)

    @property
    def _names(self) -> np.ndarray:
        return np.array(list(self.fixed))

    @property
    def _places(self) -> np.ndarray:
        return np.array([*self.fixed.values()], float)

    def sight(self, tip: np.ndarray) -> np.ndarray:
        """Return the tool point in the robot's base frame."""
        return np.asarray(tip[:, :3, :3] @ np.asarray(self.tool) + tip[:, :3, 3])

    def _plan(
        self, machine: TrueMachine, count: int, rng: np.random.Generator, min_height: float | None, radius: float
    ) -> np.ndarray:
        """Return poses at one place after the other, the tool point ``radius`` away from it."""
        owner = np.arange(count) * len(self.fixed) // count
        found = []
        for i, (name, place) in enumerate(self.fixed.items()):
            try:
                found.append(
                    plan_held(
                        machine,
                        lambda tries, place=place: place + radius * directions(tries, rng),  # type: ignore[misc]
                        int(np.sum(owner == i)),
                        rng,
                        tool=self.tool,
                        min_height=min_height,
                    )
                )
            except BadInputError as error:
                raise BadInputError(f"{name}: {error}") from None
        return np.vstack(found)

    def _nearest(self, machine: TrueMachine, q: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the place that each pose belongs to, shape (N,), and the way to its tool point, shape (N, 3)."""
        ways = tool_points(machine.nominal, q, self.tool)[:, None] - self._places
        off = np.abs(np.linalg.norm(ways, axis=2) - radius)
        owner, rows = off.argmin(axis=1), np.arange(len(q))
        if off[rows, owner].max() > _NEAR:
            worst = int(off[rows, owner].argmax())
            raise BadInputError(
                f"pose {worst + 1}: the tool point is {off[worst].min():.3f} m from where it can be held "
                f"({', '.join(self.fixed)}); leave --at out, or give poses of the same machine and seed"
            )
        return owner, ways[rows, owner]


@dataclass(frozen=True, kw_only=True)
class Sockets(_Held):
    """Contact: the tool point is held in fixed sockets in many orientations; only the joints are read."""

    @property
    def kind(self) -> str:
        """Contact."""
        return "socket"

    def plan(self, machine: TrueMachine, count: int, rng: np.random.Generator, *, min_height: float | None) -> np.ndarray:
        """Return poses of the nominal arm in one socket after the other."""
        return self._plan(machine, count, rng, min_height, 0.0)

    def measure(self, machine: TrueMachine, q: np.ndarray, rng: np.random.Generator, **conditions: Any) -> Table:
        """Return the joints of the true machine in the socket that is nearest to each pose."""
        self.refuse_scale(machine, "a socket reads none")
        owner, _ = self._nearest(machine, q, 0.0)
        table = measure_held(machine, q, self._places[owner], tool=self.tool, noise_sigma=self.sigma, rng=rng, **conditions)
        return table | {"socket": self._names[owner]}

    def truth(self) -> dict[str, Any]:
        """Return places of sockets and tool point."""
        return _truth_of_held(self, "sockets")


@dataclass(frozen=True, kw_only=True)
class BallBar(_Held):
    """A bar of constant length between a fixed anchor and the tool point; its length is read with noise.

    Attributes:
        length: Length of the bar [m].
    """

    length: float

    @property
    def kind(self) -> str:
        """Distance from an anchor."""
        return "distance"

    def plan(self, machine: TrueMachine, count: int, rng: np.random.Generator, *, min_height: float | None) -> np.ndarray:
        """Return poses of the nominal arm on the upper half of a sphere about one anchor after the other."""
        return self._plan(machine, count, rng, min_height, self.length)

    def measure(self, machine: TrueMachine, q: np.ndarray, rng: np.random.Generator, **conditions: Any) -> Table:
        """Return the joints of the true machine where its tool point is as far from the anchor as the bar is long."""
        owner, way = self._nearest(machine, q, self.length)
        table = measure_held(machine, q, self._places[owner], tool=self.tool, radius=self.length, rng=rng, **conditions)
        bar = self.length * way / np.linalg.norm(way, axis=1, keepdims=True)
        for effect in machine.effects:
            if isinstance(effect, MeasuringEffect):
                bar = effect.reading(bar)
        length = np.linalg.norm(bar, axis=1)
        return table | {"distance": length + noise(length.shape, self.sigma, rng), "anchor": self._names[owner]}

    def sight(self, tip: np.ndarray) -> np.ndarray:
        """Return the bar: the way to the tool point from the anchor to which it fits, in the robot's base frame."""
        ways = super().sight(tip)[:, None] - self._places
        owner = np.abs(np.linalg.norm(ways, axis=2) - self.length).argmin(axis=1)
        return np.asarray(ways[np.arange(len(ways)), owner])

    def truth(self) -> dict[str, Any]:
        """Return length of the bar and places of anchors and tool point."""
        return _truth_of_held(self, "anchors") | {"ball_bar_m": self.length}


def _truth_of_held(held: _Held, name: str) -> dict[str, Any]:
    places = {"T_instrument_base": held.instrument.tolist(), f"{name}_in_base_m": as_lists(held.fixed)}
    return places | {"tool_m": list(held.tool)}
