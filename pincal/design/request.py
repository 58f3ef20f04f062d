"""What is to be designed, and the conditions of its poses: payloads, directions of approach and targets."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements
from pincal.model.catalogue.candidates import needs_column
from pincal.model.conditions import Conditions
from pincal.robot.robot import Robot

Criterion = Literal["task", "determinant"]

# Default number of random poses to choose from.
_CANDIDATES = 1500


@dataclass(frozen=True, kw_only=True)
class DesignRequest:
    """What is to be designed: arguments of :func:`pincal.design.design.design_poses`, checked.

    Raises:
        BadInputError: If a value is invalid or two of them exclude each other.
    """

    poses: int | None = None
    accuracy: float | None = None
    criterion: Criterion = "task"
    tell_apart: tuple[str, str] | None = None
    task: Measurements | None = None
    measured: Measurements | None = None
    payloads: tuple[float, ...] | None = None
    candidates: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse what can't be designed."""
        self._check_numbers()
        self._check_criterion()
        self._check_tables()

    @property
    def n_candidates(self) -> int:
        """Number of random poses to choose from."""
        return max(_CANDIDATES, 2 * (self.poses or 0)) if self.candidates is None else self.candidates

    @property
    def fewest(self) -> int:
        """Smallest sufficient number of candidates."""
        return max(self.poses or 1, 2)

    def has_approach(self, robot: Robot) -> bool:
        """Return whether the direction from which joints arrive is part of the design."""
        return any(needs_column(text, "approach", robot) for text in self.tell_apart or ())

    def _check_numbers(self) -> None:
        if self.poses is None and self.accuracy is None:
            raise BadInputError("neither a number of poses nor an accuracy is given; expected one of them")
        if self.poses is not None and self.poses < 1:
            raise BadInputError(f"{self.poses} poses; expected 1 or more")
        if self.accuracy is not None and not self.accuracy > 0.0:
            raise BadInputError(f"accuracy {self.accuracy:g} m; expected more than 0")
        if self.n_candidates < self.fewest:
            raise BadInputError(
                f"{self.n_candidates} candidates for {self.poses or 1} poses; expected at least as many, better 1000"
            )

    def _check_criterion(self) -> None:
        if self.criterion not in ("task", "determinant"):
            raise BadInputError(f"criterion {self.criterion!r}; expected task or determinant")
        if self.accuracy is not None and (self.tell_apart or self.criterion != "task"):
            raise BadInputError("an accuracy goes with the criterion task alone; leave it out")

    def _check_tables(self) -> None:
        loads = self.payloads
        if loads is not None and (not loads or not all(0.0 <= load < np.inf for load in loads)):
            listed = ", ".join(f"{load:g}" for load in loads)
            raise BadInputError(f"payloads {listed or 'none'}; expected masses of 0 kg or more")
        for what, table in (("task", self.task), ("measured poses", self.measured)):
            if table is not None and len(table) == 0:
                raise BadInputError(f"{what}: {table.source} has no rows; expected joint positions")


@dataclass(frozen=True)
class PoseBuilder:
    """How joint positions become conditions."""

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
        n, targets, approach = len(table), self.targets, table.approach
        index = np.array([targets.index(str(name)) if str(name) in targets else 0 for name in table.target], int)
        payload = np.full(n, self._loads[0]) if table.payload is None else np.asarray(table.payload)
        if approach is None and self.request.has_approach(self.robot):
            approach = np.zeros(table.q.shape)
        centre = np.array(self.options.payload_centre, float)
        return Conditions(table.q, index, payload, centre, table.temperature, table.time, approach)


def joined(one: Conditions, other: Conditions) -> Conditions:
    """Return the poses of both, one after the other; a column that only one of them has is left out."""
    pairs = {f.name: (getattr(one, f.name), getattr(other, f.name)) for f in fields(Conditions)}
    columns: dict[str, Any] = {
        name: None if a is None or b is None else np.concatenate([a, b]) for name, (a, b) in pairs.items()
    }
    return Conditions(**columns | {"payload_centre": one.payload_centre})
