"""From joint positions to the conditions of poses: payloads, directions of approach and targets."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pincal.design.request import DesignRequest
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements
from pincal.model.effects import Conditions
from pincal.robot.robot import Robot


@dataclass(frozen=True)
class PoseBuilder:
    """How joint positions become conditions: loads, directions of approach and targets."""

    robot: Robot
    options: Options
    request: DesignRequest

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets: of those measured before, the first is the one that is measured again."""
        measured = self.request.measured
        return ("tool",) if measured is None else tuple(str(name) for name in np.unique(measured.target))

    @property
    def _loads(self) -> np.ndarray:
        return np.array(self.request.payloads or (0.0,), float)

    def at(self, q: np.ndarray, rng: np.random.Generator) -> Conditions:
        """Return poses with the loads in turn and, where it matters, random directions of approach."""
        n, loads = len(q), self._loads
        approach = rng.choice([-1.0, 1.0], q.shape) if self.request.has_approach(self.robot) else None
        centre = np.array(self.options.payload_centre, float)
        return Conditions(q, np.zeros(n, int), loads[np.arange(n) % len(loads)], centre, approach=approach)

    def of(self, table: Measurements) -> Conditions:
        """Return the poses of a table; rows without a payload carry the first of the loads."""
        n, targets = len(table), self.targets
        index = np.array([targets.index(str(name)) if str(name) in targets else 0 for name in table.target], int)
        payload = np.full(n, self._loads[0]) if table.payload is None else np.asarray(table.payload)
        approach = (
            np.zeros(table.q.shape) if table.approach is None and self.request.has_approach(self.robot) else table.approach
        )
        centre = np.array(self.options.payload_centre, float)
        return Conditions(table.q, index, payload, centre, table.temperature, table.time, approach)


def joined(one: Conditions, other: Conditions) -> Conditions:
    """Return the poses of both, one after the other; a column that only one of them has is left out."""

    def both(a: np.ndarray | None, b: np.ndarray | None) -> np.ndarray | None:
        return None if a is None or b is None else np.concatenate([a, b])

    columns: dict[str, Any] = {f.name: both(getattr(one, f.name), getattr(other, f.name)) for f in fields(Conditions)}
    return Conditions(**columns | {"payload_centre": one.payload_centre})
