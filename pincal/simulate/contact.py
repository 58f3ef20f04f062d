"""Set-ups that hold the tool point, in sockets or by a bar of constant length, while the joints are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.arm import Arm
from pincal.simulate.planning import (
    collect_poses,
    frames,
    is_clear,
    newton_step,
    plan_poses,
    point_at,
    position_jacobian,
    reach,
)
from pincal.simulate.setup import Machine, Reading, SensorSetup, as_lists, draw_noise, refuse_scale, tips_of, transformed
from pincal.simulate.state import Poses
from pincal.simulate.tracker import as_read

Point = tuple[float, float, float]
# Chord steps on the true arm, of which each gains about three digits, and the distance that may be left [m].
_STEPS, _CLOSED = 30, 5e-13
# The tool point has to move by at least this part of the arm's reach when one joint turns by a radian.
_LEAST_MOBILITY = 0.02
# Rounds of random goals before a place counts as out of reach, and the smallest number of goals in a round.
_ROUNDS, _TRIES = 20, 16
# A pose given for contact has to bring the tool point this close to a place where it can be held [m].
_NEAR = 0.02


@dataclass(frozen=True, kw_only=True)
class Contact(SensorSetup):
    """The tool point is held at fixed places in many orientations: directly, in sockets, or by a ball bar.

    Of sockets only the joints are read, and ``sigma`` is the standard deviation with which the point sits in its
    socket, each axis [m]. Of a bar the length is read, too, with noise ``sigma`` [m].

    Attributes:
        fixed: The places in the robot's base frame [m], shape (3,), by name.
        tool: Tool point in the tip frame [m].
        instrument: Transform from the robot's base frame to that in which the places are known, shape (4, 4).
        length: Length of the bar between place and tool point [m]; 0 for sockets.
    """

    fixed: Mapping[str, Any]
    tool: Point = (0.0, 0.0, 0.0)
    instrument: np.ndarray = field(default_factory=lambda: np.eye(4))
    length: float = 0.0

    @property
    def kind(self) -> str:
        """Distance from an anchor with a bar, else contact."""
        return "distance" if self.length else "socket"

    @property
    def _label(self) -> str:
        return "anchor" if self.length else "socket"

    @property
    def points(self) -> dict[str, np.ndarray]:
        """The places in the instrument's frame."""
        return transformed(self.instrument, self.fixed)

    @property
    def _places(self) -> np.ndarray:
        return np.array([*self.fixed.values()], float)

    def plan(self, arm: Arm, n: int, *, rng: np.random.Generator, min_height: float | None = 0.1) -> np.ndarray:
        """Draw poses that hold the tool point at one place after the other."""
        shares = np.bincount(np.arange(n) * len(self.fixed) // n, minlength=len(self.fixed))
        planned = []
        for (name, place), share in zip(self.fixed.items(), shares, strict=True):
            try:
                planned.append(self._plan_at(arm, np.asarray(place, float), n=share, rng=rng, min_height=min_height))
            except BadInputError as error:
                raise BadInputError(f"{name}: {error}") from None
        return np.vstack(planned)

    def _plan_at(
        self, arm: Arm, place: np.ndarray, *, n: int, rng: np.random.Generator, min_height: float | None
    ) -> np.ndarray:
        def draw() -> np.ndarray:
            seed = plan_poses(arm, max(2 * n, _TRIES), rng, min_height=min_height)
            goals = place + self.length * upward_directions(len(seed), rng)
            q, is_held = can_hold(arm, seed, goals=goals, tool=self.tool, min_height=min_height)
            return np.asarray(q[is_held])

        shortage = "hold the tool point there, so that it is out of reach; choose a place within the arm's reach"
        return collect_poses(draw, n, rounds=_ROUNDS, shortage=shortage)

    def _read(self, machine: Machine, poses: Poses, rng: np.random.Generator | None) -> Reading:
        """Return the joints of the true machine at the place that is nearest to each pose, and what is read there."""
        if not self.length:
            refuse_scale(machine, "a socket reads none")
        owner, offset = self._nearest(point_at(frames(machine.nominal, poses.q)[:, -1], self.tool))
        off = np.abs(np.linalg.norm(offset, axis=1) - self.length)
        if off.max() > _NEAR:
            worst = int(off.argmax())
            raise BadInputError(
                f"pose {worst + 1}: the tool point is {off[worst]:.3f} m from where it can be held "
                f"({', '.join(self.fixed)}); leave --at out, or give poses of the same machine and seed"
            )
        # Noise of a bar is in the reading of its length, noise of a socket in the place of the point.
        play = draw_noise(offset.shape, 0.0 if self.length else self.sigma, rng)
        held = hold(machine, poses, self._places[owner] + play, tool=self.tool, radius=self.length)
        columns = {self._label: np.array(list(self.fixed))[owner]}
        if self.length:
            bar = self.length * offset / np.linalg.norm(offset, axis=1, keepdims=True)
            length = np.linalg.norm(as_read(machine.effects, bar), axis=1)
            columns = {"distance": length + draw_noise(length.shape, self.sigma, rng)} | columns
        return Reading(held, np.arange(len(owner)), columns)

    def _nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the place to which each tool point belongs, shape (N,), and the tool point from there [m], (N, 3)."""
        offsets = points[:, None] - self._places
        owner = np.abs(np.linalg.norm(offsets, axis=2) - self.length).argmin(axis=1)
        return owner, offsets[np.arange(len(points)), owner]

    def line_of_sight(self, tip: np.ndarray) -> np.ndarray:
        """Return the tool point in the base frame, or the bar: the way to the tool point from its anchor."""
        points = point_at(tip, self.tool)
        return self._nearest(points)[1] if self.length else points

    def truth(self) -> dict[str, Any]:
        """Return where the places and the tool point are, and the length of the bar."""
        return {
            "noise": {"sigma_m": self.sigma, "sigma_rad": None},
            "T_instrument_base": self.instrument.tolist(),
            f"{self._label}s_in_base_m": as_lists(self.fixed),
            "tool_m": list(self.tool),
        } | ({"ball_bar_m": self.length} if self.length else {})


def hold(machine: Machine, poses: Poses, places: np.ndarray, *, tool: Point, radius: float = 0.0) -> Poses:
    """Return what is recorded near some poses when the tool point of the true machine is held at places, or by a bar.

    Args:
        machine: The true machine.
        poses: Poses near which it is held.
        places: Where the tool point is held, in the robot's base frame [m], shape (N, 3).
        tool: Tool point in the tip frame [m].
        radius: Length of the bar that holds it off the place, in any direction [m]; 0 without a bar.

    Raises:
        BadInputError: If the true arm can't be held there, as with backlash of unknown direction.
    """
    for _ in range(_STEPS):
        tip = tips_of(machine, poses)
        point = point_at(tip, tool)
        missing = places - point
        if radius:
            missing = missing * (1.0 - radius / np.maximum(np.linalg.norm(missing, axis=1, keepdims=True), 1e-12))
        if np.abs(missing).max(initial=0.0) < _CLOSED:
            return poses
        jacobian = position_jacobian(machine.nominal, frames(machine.nominal, poses.q), point)
        poses = replace(poses, q=poses.q + newton_step(machine.nominal, jacobian, missing))
    worst = int(np.abs(missing).max(axis=1).argmax())
    raise BadInputError(
        f"pose {worst + 1}: the true arm can't be held at {places[worst].round(4).tolist()}; make its errors smaller, "
        "give the approach of joints with play, or take another seed"
    )


def can_hold(
    arm: Arm, seed: np.ndarray, *, goals: np.ndarray, tool: Point, min_height: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Bring the tool point of the nominal arm to goals [m, base frame], shape (N, 3), from joint positions ``seed``, (N, n).

    Returns:
        Joint positions, shape (N, n), and whether they are suitable, shape (N,): at the goal, within the limits, off the
        floor, and not so stretched that the true arm could fall short.
    """
    q, reached = reach(arm, seed, goal=goals, tool=tool)
    mobility = np.linalg.svd(position_jacobian(arm, frames(arm, q), goals), compute_uv=False)[:, -1]
    return q, reached & is_clear(arm, q, min_height) & (mobility > _LEAST_MOBILITY * arm.reach)


def upward_directions(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return unit vectors spread over the upper half of all directions, shape (count, 3)."""
    height, turn = rng.uniform(0.0, 1.0, count), rng.uniform(-np.pi, np.pi, count)
    across = np.sqrt(1.0 - height**2)
    return np.column_stack((across * np.cos(turn), across * np.sin(turn), height))
