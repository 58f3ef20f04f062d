"""Specifications of pose designs, and the conditions of their poses: payloads, directions of
approach and targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pincal.errors import BadInputError
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements
from pincal.model.catalogue.candidates import needs_column
from pincal.model.conditions import Conditions
from pincal.robot.robot import Robot
from pincal.thresholds import Count

Criterion = Literal["task", "determinant"]

# Default number of random poses to choose from.
_CANDIDATES: Count = 1500


@dataclass(frozen=True, kw_only=True)
class DesignRequest:
    """Specification of a pose design.

    Attributes:
        poses: number of poses; default: as many as ``accuracy`` needs.
        accuracy: predicted error over the task to reach [m].
        criterion: "task" for the smallest predicted error over the task (I- or V-optimal, with the
            priors of the fit), "determinant" for the smallest volume of the parameters' uncertainty
            (D-optimal, with priors).
        tell_apart: two rival effects, as in :func:`pincal.design.study.find_rival`, to be
            distinguished instead.
        task: joint positions of the application, with payloads if they matter; default: the whole
            reach.
        measured: previously measured poses, with their payloads, whose information counts.
        payloads: masses at the tip [kg] to choose from, pose by pose; default: no payload.
        candidates: number of random poses to choose from; default: 1500, or twice ``poses`` if that
            is more.
        refine: whether to refine the chosen poses joint by joint.
        curve: whether to design for other numbers of poses, too, and to compute the lower bound of
            the error.
        seed: seed of all random numbers.

    Raises:
        BadInputError: if a value is invalid or two of them exclude each other.
    """

    poses: int | None = None
    accuracy: float | None = None
    criterion: Criterion = "task"
    tell_apart: tuple[str, str] | None = None
    task: Measurements | None = None
    measured: Measurements | None = None
    payloads: Sequence[float] | None = None
    candidates: int | None = None
    refine: bool = True
    curve: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if self.payloads is not None:
            object.__setattr__(self, "payloads", tuple(float(load) for load in self.payloads))
        if self.poses is None and self.accuracy is None:
            raise BadInputError(
                "neither a number of poses nor an accuracy is given; expected one of them"
            )
        if self.poses is not None and self.poses < 1:
            raise BadInputError(f"{self.poses} poses; expected 1 or more")
        if self.accuracy is not None and not self.accuracy > 0.0:
            raise BadInputError(f"accuracy {self.accuracy:g} m; expected more than 0")
        if self.n_candidates < self.fewest:
            raise BadInputError(
                f"{self.n_candidates} candidates for {self.poses or 1} poses; expected at "
                "least as many, better 1000"
            )
        if self.criterion not in ("task", "determinant"):
            raise BadInputError(f"criterion {self.criterion!r}; expected task or determinant")
        if self.accuracy is not None and (self.tell_apart or self.criterion != "task"):
            raise BadInputError("an accuracy requires the criterion task; leave it out")
        loads = self.payloads
        if loads is not None and (not loads or not all(0.0 <= load < np.inf for load in loads)):
            listed = ", ".join(f"{load:g}" for load in loads)
            raise BadInputError(f"payloads {listed or 'none'}; expected masses of 0 kg or more")
        for what, table in (("task", self.task), ("measured poses", self.measured)):
            if table is not None and len(table) == 0:
                raise BadInputError(f"{what}: {table.source} has no rows; expected joint positions")

    @property
    def n_candidates(self) -> int:
        """Number of random poses to choose from."""
        return (
            max(_CANDIDATES, 2 * (self.poses or 0)) if self.candidates is None else self.candidates
        )

    @property
    def fewest(self) -> int:
        """Smallest sufficient number of candidates."""
        return max(self.poses or 1, 2)

    def has_approach(self, robot: Robot) -> bool:
        """Return whether the direction of approach is part of the design."""
        return any(needs_column(text, "approach", robot) for text in self.tell_apart or ())


@dataclass(frozen=True)
class PoseBuilder:
    """Conversion of joint positions to conditions."""

    robot: Robot
    options: Options
    request: DesignRequest

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets: of previously measured ones, the first is measured again."""
        measured = self.request.measured
        return (
            ("tool",)
            if measured is None
            else tuple(str(name) for name in np.unique(measured.target))
        )

    @property
    def _loads(self) -> np.ndarray:
        return np.array(self.request.payloads or (0.0,), float)

    def at(self, q: np.ndarray, rng: np.random.Generator) -> Conditions:
        """Return poses with the loads in turn and, if it matters, random directions of approach."""
        n = len(q)
        loads = self._loads
        approach = (
            rng.choice([-1.0, 1.0], q.shape) if self.request.has_approach(self.robot) else None
        )
        centre = np.array(self.options.payload_centre, float)
        return Conditions(
            q, np.zeros(n, int), loads[np.arange(n) % len(loads)], centre, approach=approach
        )

    def of(self, table: Measurements) -> Conditions:
        """Return the poses of a table; rows without a payload have the first of the loads."""
        n = len(table)
        targets = self.targets
        index = np.array(
            [targets.index(str(name)) if str(name) in targets else 0 for name in table.target], int
        )
        payload = np.full(n, self._loads[0]) if table.payload is None else np.asarray(table.payload)
        ordered = table.of_joints(self.robot)
        columns = ordered.recorded()
        if columns["approach"] is None and self.request.has_approach(self.robot):
            columns["approach"] = np.zeros(ordered.q.shape)
        centre = np.array(self.options.payload_centre, float)
        return Conditions(ordered.q, index, payload, centre, **columns)


def pose_columns(
    robot: Robot, conditions: Conditions, *, has_payloads: bool, targets: Sequence[str] = ()
) -> dict[str, np.ndarray]:
    """Return a table to fill in: commanded joints, and target, payload and approach if they are
    part of the poses.
    """
    columns: dict[str, np.ndarray] = dict(
        zip(robot.joint_names, robot.as_reported(conditions.q).T, strict=True)
    )
    if len(targets) > 1:
        columns["target"] = np.array(targets)[conditions.target]
    if has_payloads:
        columns["payload"] = conditions.payload
    if conditions.approach is not None:
        for name, column in zip(robot.joint_names, conditions.approach.T, strict=True):
            columns[f"approach_{name}"] = column.astype(int)
    return columns
