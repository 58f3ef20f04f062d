"""A measuring campaign: where the instrument stands, what hangs on the flange, and under which conditions it measures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.effect import HiddenEffect
from pincal.simulate.machine import TrueMachine
from pincal.simulate.measure import KINDS, Table, measure
from pincal.simulate.typical import arm_reach

# Time from one pose to the next: drive, settle, measure [s].
_INTERVAL = 40.0
# A machine that warms up: from the first temperature by so much, with draughts [deg C].
_COLD, _WARMING, _DRAUGHT = 20.0, 10.0, 0.7
# Where an instrument stands and a target sits, in reaches of the arm: distance and height; off the last axis and along it.
_DISTANCE, _HEIGHT = (1.5, 2.5), (0.0, 0.7)
_OFF_AXIS, _ALONG = (0.03, 0.07), (0.02, 0.08)


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """Poses, conditions and instrument; everything but the machine that is measured.

    Attributes:
        q: Recorded joint positions [rad or m], shape (N, n).
        conditions: Of ``payload`` [kg], ``temperature`` [deg C], ``time`` [s], each shape (N,), and ``approach``
            (-1, 0, 1), shape (N, n), those that apply.
        payload_com: Centre of mass of the payload in the tip frame [m].
        instrument: Transform from the robot's base frame to the instrument's frame, shape (4, 4).
        targets: Place of each target in the tip frame [m], by its name, shape (4, 4).
        sensor: A key of ``SENSORS``.
        sigma: Noise of each coordinate, or of the distance [m].
        sigma_angle: Noise of the orientation about each axis [rad].
        hidden: Columns that have an effect but are not recorded.
    """

    q: np.ndarray
    conditions: dict[str, np.ndarray]
    payload_com: tuple[float, float, float]
    instrument: np.ndarray
    targets: dict[str, np.ndarray]
    sensor: str = "position"
    sigma: float = 0.0
    sigma_angle: float = 0.0
    hidden: tuple[str, ...] = ()

    def measure(self, machine: TrueMachine, rng: np.random.Generator) -> Table:
        """Return the table that the campaign gives of a machine.

        Args:
            machine: The true machine.
            rng: Source of noise and scatter.

        Raises:
            BadInputError: If there is no such sensor, or the machine has effects that no arm survives.
        """
        if self.sensor not in SENSORS:
            raise BadInputError(f"sensor {self.sensor!r}; expected one of {', '.join(SENSORS)}")
        table = SENSORS[self.sensor](self, machine, rng)
        for name, column in table.items():
            if column.dtype.kind == "f" and not np.isfinite(column).all():
                raise BadInputError(f"column {name}: not finite; make errors and effects smaller")
        return table

    def shift(self, machine: TrueMachine, effect: HiddenEffect) -> float:
        """Return how far an effect moves the first target, rms over the poses [m].

        Args:
            machine: The machine with all of its effects, one of them ``effect``.
            effect: The effect.
        """
        without = replace(machine, effects=tuple(e for e in machine.effects if e is not effect))
        name = next(iter(self.targets))
        exact = replace(self, sensor="position", sigma=0.0, targets={name: self.targets[name]}, hidden=())
        tables = [exact.measure(m, np.random.default_rng(0)) for m in (machine, without)]
        moved = np.array([tables[0][axis] - tables[1][axis] for axis in "xyz"])
        return float(np.sqrt((moved**2).sum(axis=0).mean()))


def _beside(campaign: Campaign, machine: TrueMachine, rng: np.random.Generator, *, kind: str) -> Table:
    """Measure with an instrument beside the robot."""
    hidden = [f"approach_{n}" for n in machine.names] if "approach" in campaign.hidden else []
    conditions: dict[str, Any] = dict(campaign.conditions)
    return measure(
        machine,
        campaign.q,
        kind=kind,
        base_pose=campaign.instrument,
        targets=campaign.targets,
        payload_com=campaign.payload_com,
        noise_sigma=campaign.sigma,
        noise_angle=campaign.sigma_angle,
        rng=rng,
        hide=(*campaign.hidden, *hidden),
        **conditions,
    )


SENSORS: dict[str, Callable[[Campaign, TrueMachine, np.random.Generator], Table]] = {
    kind: partial(_beside, kind=kind) for kind in KINDS
}
"""How each kind of measurement is made."""


def draw_instrument(machine: TrueMachine, rng: np.random.Generator) -> np.ndarray:
    """Stand an instrument somewhere in the hall, turned in any way.

    Args:
        machine: The machine beside which it stands.
        rng: Source of randomness.

    Returns:
        Transform from the robot's base frame to the instrument's frame, shape (4, 4).
    """
    from scipy.spatial.transform import Rotation

    direction, reach = rng.uniform(-np.pi, np.pi), arm_reach(machine)
    ground = rng.uniform(*_DISTANCE) * np.array([np.cos(direction), np.sin(direction)])
    place = reach * np.append(ground, rng.uniform(*_HEIGHT))
    transform = np.eye(4)
    transform[:3, :3] = Rotation.random(rng=rng).as_matrix()
    transform[:3, 3] = -transform[:3, :3] @ place
    return transform


def draw_targets(machine: TrueMachine, count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Mount targets at the tip, off the last axis (of which nothing could be seen otherwise) and away from each other.

    Args:
        machine: The machine.
        count: How many, at least 1.
        rng: Source of randomness.

    Returns:
        Transforms from target to tip frame by name, shape (4, 4).
    """
    from scipy.spatial.transform import Rotation

    reach, start = arm_reach(machine), rng.uniform(-np.pi, np.pi)
    found = {}
    for i in range(count):
        angle, radius = start + 2.0 * np.pi * i / count, reach * rng.uniform(*_OFF_AXIS)
        transform = np.eye(4)
        transform[:3, :3] = Rotation.random(rng=rng).as_matrix()
        transform[:3, 3] = radius * np.cos(angle), radius * np.sin(angle), reach * rng.uniform(*_ALONG)
        found[f"target_{i + 1}"] = transform
    return found


def draw_conditions(names: Sequence[str], poses: int, joints: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return what a campaign goes through: a machine that warms up, minutes that pass, joints that come from both sides.

    Args:
        names: Of ``temperature``, ``time`` and ``approach``, those wanted.
        poses: Number N of poses.
        joints: Number n of joints.
        rng: Source of randomness.

    Returns:
        ``temperature`` [deg C] and ``time`` [s], shape (N,), ``approach`` (-1 or 1), shape (N, n); the same rows
        whichever are wanted.
    """
    time = _INTERVAL * np.arange(poses)
    warming = _COLD + _WARMING * (1.0 - np.exp(-3.0 * np.arange(poses) / poses))
    drawn = {
        "temperature": np.round(warming + _DRAUGHT * rng.standard_normal(poses), 2),
        "time": time,
        "approach": rng.choice([-1.0, 1.0], (poses, joints)),
    }
    return {name: drawn[name] for name in names}


def spread_payloads(values: Sequence[float], poses: int, *, order: str = "blocks") -> np.ndarray:
    """Return the payload of each pose.

    Args:
        values: The payloads [kg].
        poses: Number N of poses.
        order: ``blocks``, one payload after the other, or ``alternating`` from pose to pose.

    Returns:
        Payloads [kg], shape (N,).

    Raises:
        BadInputError: If there is no such order.

    Example:
        >>> spread_payloads([0.0, 80.0], 4)
        array([ 0.,  0., 80., 80.])
    """
    rows, loads = np.arange(poses), np.asarray(values, float)
    if order not in ("blocks", "alternating"):
        raise BadInputError(f"order {order!r} of the payloads; expected blocks or alternating")
    place = rows * len(loads) // poses if order == "blocks" else rows % len(loads)
    return np.asarray(loads[place])
