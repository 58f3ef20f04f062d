"""A measuring campaign: a set-up, the poses that it measures in, and the conditions under which it does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pincal.errors import BadInputError
from pincal.simulate.effect import HiddenEffect
from pincal.simulate.machine import TrueMachine
from pincal.simulate.setup import Machine, SensorSetup, Table, draw_scatter, tips_of
from pincal.simulate.state import Conditions
from pincal.simulate.tracker import as_read

# Time from one pose to the next: drive, settle, measure [s].
_INTERVAL = 40.0
# A machine that warms up: first temperature, rise, and standard deviation of draughts [deg C].
_COLD, _WARMING, _DRAUGHT = 20.0, 10.0, 0.7


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """Poses, conditions and set-up; everything but the machine that is measured.

    Attributes:
        q: Joint positions to measure in [rad or m], shape (N, n); where contact decides, near which.
        conditions: The conditions that apply.
        setup: What measures.
        hidden: Of the conditions, those that have their effect but are not recorded.
    """

    q: np.ndarray
    conditions: Conditions
    setup: SensorSetup
    hidden: tuple[str, ...] = ()

    def measure(self, machine: Machine, rng: np.random.Generator) -> Table:
        """Return the table that the campaign gives of a machine; ``rng`` is the source of noise and scatter.

        Raises:
            BadInputError: If the set-up can't measure it, or its errors and effects are too large for any arm.
        """
        table = self.setup.measure(machine, self.q, rng=rng, hide=self.hidden, **self.conditions)
        for name, column in table.items():
            if column.dtype.kind == "f" and not np.isfinite(column).all():
                raise BadInputError(f"column {name}: not finite; make errors and effects smaller")
        return table

    def shift(self, machine: TrueMachine, effect: HiddenEffect) -> float:
        """Return how far one of the machine's effects moves what is looked at, rms over the poses [m]."""
        without = replace(machine, effects=tuple(e for e in machine.effects if e is not effect))
        moved = self._line_of_sight(machine) - self._line_of_sight(without)
        return float(np.sqrt((moved**2).sum(axis=1).mean()))

    def _line_of_sight(self, machine: TrueMachine) -> np.ndarray:
        """Return what the set-up looks at as it reads it without noise [m], shape (N, 3)."""
        scatter = draw_scatter(machine, self.q, np.random.default_rng(0))
        tip = tips_of(machine, machine.poses(self.q, scatter=scatter, **self.conditions))
        return as_read(machine.effects, self.setup.line_of_sight(tip))

    def truth(self, machine: TrueMachine, *, tip: str) -> dict[str, Any]:
        """Return errors and effects of the machine, noise and set-up, as for JSON; ``tip`` names the last frame."""
        names = machine.names
        found = {
            "poses": len(self.q),
            "sensor": self.setup.kind,
            "effects": [self._entry(machine, effect) for effect in machine.effects],
            "geometry": {
                "placement_errors": {
                    end: {"translation_m": row[:3].tolist(), "rotation_rad": row[3:].tolist()}
                    for end, row in zip((*names, tip), machine.placement_errors, strict=True)
                },
                "joint_offsets": dict(zip(names, machine.joint_offsets.tolist(), strict=True)),
            },
            "compliance": {
                name: dict(zip(("k_x", "k_y", "k_z"), row.tolist(), strict=True))
                for name, row in zip(names, machine.compliance, strict=True)
            },
            "moment_frame": machine.moment_frame,
            "mass_factors": dict(zip(names, machine.mass_factors.tolist(), strict=True)),
            "com_errors_m": dict(zip(names, machine.com_errors.tolist(), strict=True)),
            "gravity": list(machine.gravity),
            "payload_com": list(self.conditions.get("payload_com", (0.0, 0.0, 0.0))),
            "not_recorded": list(self.hidden),
        }
        return found | self.setup.truth()

    def _entry(self, machine: TrueMachine, effect: HiddenEffect) -> dict[str, Any]:
        """Return an effect with its unit and by how far it moves what is looked at."""
        values = {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(effect).items()}
        shift = 1e3 * self.shift(machine, effect)
        return {"effect": effect.effect} | values | {"unit": effect.unit, "moves_target_rms_mm": shift}


def draw_conditions(names: Sequence[str], poses: int, *, joints: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return what N poses of n joints go through: a machine that warms up, minutes that pass, joints from both sides.

    The names wanted are of ``temperature`` [deg C] and ``time`` [s], shape (N,), and ``approach`` (-1 or 1), shape (N, n);
    their values do not depend on which are wanted.
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
    """Return the payload of each of N poses [kg], shape (N,), by one of the orders ``blocks`` and ``alternating``.

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
