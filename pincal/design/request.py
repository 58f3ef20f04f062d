"""What is to be designed: the number of poses or an accuracy, the criterion, and what is known already."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pincal.errors import BadInputError
from pincal.measure.measurements import Measurements
from pincal.model.catalogue.candidates import needs_column
from pincal.robot.robot import Robot

Criterion = Literal["task", "determinant"]

CANDIDATES = 1500
"""Default number of random poses to choose from."""


@dataclass(frozen=True, kw_only=True)
class DesignRequest:
    """What is to be designed.

    Attributes:
        poses: Number of poses; None for as many as ``accuracy`` needs.
        accuracy: Predicted error over the task to reach [m]; None if the number of poses is given.
        criterion: "task" for the smallest predicted error over the task (I- or V-optimal, with the priors of the fit),
            "determinant" for the smallest volume of the parameters' uncertainty (D-optimal, with priors).
        tell_apart: Two rival effects, as in :func:`pincal.design.rivals.find_rival`; the criterion is then to tell
            them apart.
        task: Joint positions that the user cares for, with payloads where they matter; the whole reach by default.
        measured: Poses measured already, with their payloads; their information counts.
        payloads: Masses at the tip [kg] to choose from, pose by pose; None for no payload.
        candidates: Number of random poses to choose from; by default 1500, or twice ``poses`` if that is more.
        seed: Seed of all random numbers.

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
        return max(CANDIDATES, 2 * (self.poses or 0)) if self.candidates is None else self.candidates

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
