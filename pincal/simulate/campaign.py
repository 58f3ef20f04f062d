"""A measuring campaign: a set-up, the poses that it measures in, what hangs on the flange, and under which conditions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.effect import HiddenEffect, MeasuringEffect
from pincal.simulate.machine import TrueMachine
from pincal.simulate.measure import Table, scatter_of
from pincal.simulate.setup import Setup

# Time from one pose to the next: drive, settle, measure [s].
_INTERVAL = 40.0
# A machine that warms up: from the first temperature by so much, with draughts [deg C].
_COLD, _WARMING, _DRAUGHT = 20.0, 10.0, 0.7


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """Poses, conditions and set-up; everything but the machine that is measured.

    Attributes:
        q: Joint positions to measure in [rad or m], shape (N, n); where contact decides, near which.
        conditions: Of ``payload`` [kg], ``temperature`` [deg C], ``time`` [s], each shape (N,), and ``approach``
            (-1, 0, 1), shape (N, n), those that apply.
        payload_com: Centre of mass of the payload in the tip frame [m].
        setup: What measures.
        hidden: Of the conditions, those that have their effect but are not recorded.
    """

    q: np.ndarray
    conditions: dict[str, np.ndarray]
    payload_com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    setup: Setup
    hidden: tuple[str, ...] = ()

    def measure(self, machine: TrueMachine, rng: np.random.Generator) -> Table:
        """Return the table that the campaign gives of a machine.

        Args:
            machine: The true machine.
            rng: Source of noise and scatter.

        Raises:
            BadInputError: If the set-up can't measure it, or the machine has effects that no arm survives.
        """
        approaches = [f"approach_{name}" for name in machine.names] if "approach" in self.hidden else []
        hide = (*self.hidden, *approaches)
        table = self.setup.measure(machine, self.q, rng, payload_com=self.payload_com, hide=hide, **self.conditions)
        for name, column in table.items():
            if column.dtype.kind == "f" and not np.isfinite(column).all():
                raise BadInputError(f"column {name}: not finite; make errors and effects smaller")
        return table

    def shift(self, machine: TrueMachine, effect: HiddenEffect) -> float:
        """Return how far an effect moves what is looked at, rms over the poses [m].

        Args:
            machine: The machine with all of its effects, one of them ``effect``.
            effect: The effect.
        """
        without = replace(machine, effects=tuple(e for e in machine.effects if e is not effect))
        moved = self._sight(machine) - self._sight(without)
        return float(np.sqrt((moved**2).sum(axis=1).mean()))

    def _sight(self, machine: TrueMachine) -> np.ndarray:
        """Return what the set-up looks at as it reads it without noise [m], shape (N, 3)."""
        scatter = scatter_of(machine, self.q, np.random.default_rng(0))
        seen = self.setup.sight(machine.tip(self.q, payload_com=self.payload_com, scatter=scatter, **self.conditions))
        for effect in machine.effects:
            if isinstance(effect, MeasuringEffect):
                seen = effect.reading(seen)
        return seen


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
