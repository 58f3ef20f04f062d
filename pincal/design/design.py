"""Which poses to measure: from a robot and constraints to a list of poses and what they will tell."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.design.design_model import DesignModel
from pincal.design.observability import observability, observed_directions
from pincal.design.reach import Draw, Limits, Reach, SensorSetup
from pincal.design.refine import refine as refined
from pincal.design.request import Criterion, DesignRequest
from pincal.design.route import order_by_load
from pincal.design.study import CurvePoint, Quality, Study, total
from pincal.errors import BadInputError, PincalWarning
from pincal.identify.options import Options
from pincal.measure.measurements import Measurements
from pincal.model.catalogue.masses import notes_on_masses
from pincal.model.effects import Conditions
from pincal.robot.robot import Robot

# Readings beyond the directions that they could tell, below which little is left to judge a fit by.
_COMFORTABLE = 1.5


@dataclass(frozen=True, repr=False)
class Design:
    """Poses to measure, in an order of short ways, and what they will tell.

    Attributes:
        robot: the arm.
        conditions: the N poses; approach where it was part of the design.
        has_payloads: whether payloads were.
        rig: with what they are measured.
        criterion: "task", "determinant" or "tell apart".
        rivals: the effects to be told apart, as they were named; none with the other criteria.
        design_model: the parameters and their priors.
        drawn: the candidates, and what the constraints removed.
        found: the design beside random poses.
        before: the poses measured before alone; None without any.
        bound: predicted error that no choice of N of the candidates can fall below, by the criterion task [m]; else None.
        curve: designs of other numbers of poses and of this one, all chosen among the candidates and not refined.
        needed: smallest number of candidates that reaches the accuracy asked for; None where none was.
        observability: indices O1 to O5 of the poses, those measured before among them.
        observability_random: their medians of random poses.
        rank: directions that such poses tell better than the priors do, base and tool among them.
        path_length: length of the way through the poses, in ranges of the joint that moves farthest.
        path_length_unordered: in the order in which they were found.
        notes: what the user should know, in words.
        seconds: that it took.
    """

    robot: Robot
    conditions: Conditions
    has_payloads: bool
    rig: SensorSetup
    criterion: str
    rivals: tuple[str, ...]
    design_model: DesignModel
    drawn: Draw
    found: CurvePoint
    before: Quality | None
    bound: float | None
    curve: tuple[CurvePoint, ...]
    needed: int | None
    observability: dict[str, float]
    observability_random: dict[str, float]
    rank: int
    path_length: float
    path_length_unordered: float
    notes: tuple[str, ...]
    seconds: float

    def __repr__(self) -> str:
        error = 1e3 * self.found.designed.error
        return f"Design({self.robot.name!r}: {self.found.poses} poses, {error:.4g} mm rms foreseen)"

    @property
    def q(self) -> np.ndarray:
        """Joint positions, shape (N, n) [rad or m]."""
        return self.conditions.q

    def columns(self) -> dict[str, np.ndarray]:
        """Return the table to be filled in: joints, and target, payload and approach where they belong to the poses."""
        columns: dict[str, np.ndarray] = dict(zip(self.robot.joint_names, self.q.T, strict=True))
        targets = self.design_model.model.chain.targets
        if len(targets) > 1:
            columns["target"] = np.array(targets)[self.conditions.target]
        if self.has_payloads:
            columns["payload"] = self.conditions.payload
        if self.conditions.approach is not None:
            for name, column in zip(self.robot.joint_names, self.conditions.approach.T, strict=True):
                columns[f"approach_{name}"] = column.astype(int)
        return columns

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data, without the poses."""
        return {
            "robot": self.robot.name,
            "base": self.robot.base,
            "tip": self.robot.tip,
            "sensor": self.rig.sensor,
            "tool": self.rig.target(self.robot).tolist(),
            "instrument": None if self.rig.instrument is None else list(self.rig.instrument),
            "criterion": self.criterion,
            "rivals": list(self.rivals),
            "noise": self.design_model.sigma.tolist(),
            "parameters": self.design_model.n_free,
            "rank": self.rank,
            "candidates": {"found": len(self.drawn.q), "drawn": self.drawn.drawn, "removed": self.drawn.removed},
            **_plain_point(self.found),
            "measured_before": None if self.before is None else _plain(self.before),
            "bound_mm": None if self.bound is None else 1e3 * self.bound,
            "needed": self.needed,
            "curve": [_plain_point(point) for point in self.curve],
            "observability": {"designed": self.observability, "random_median": self.observability_random},
            "way": {"ordered": self.path_length, "unordered": self.path_length_unordered},
            "notes": list(self.notes),
            "seconds": self.seconds,
        }


def _plain(quality: Quality) -> dict[str, Any]:
    apart = {"noncentrality": list(quality.apart)} if quality.apart else {}
    return {"error_rms_mm": 1e3 * quality.error} | apart


def _plain_point(point: CurvePoint) -> dict[str, Any]:
    return {"poses": point.poses, "designed": _plain(point.designed), "random_median": _plain(point.random)}


def design_poses(
    robot: Robot,
    poses: int | None = None,
    options: Options | None = None,
    *,
    rig: SensorSetup | None = None,
    limits: Limits | None = None,
    criterion: Criterion = "task",
    tell_apart: tuple[str, str] | None = None,
    accuracy: float | None = None,
    task: Measurements | None = None,
    measured: Measurements | None = None,
    payloads: Sequence[float] | None = None,
    candidates: int | None = None,
    refine: bool = True,
    curve: bool = True,
    seed: int = 0,
) -> Design:
    """Choose the poses that tell most.

    Args:
        robot: the arm.
        poses: number of poses; default: as many as ``accuracy`` needs.
        options: as for the calibration: effects, noise, moment frame, centre of mass of the payload. Base and tool are
            taken as unknown.
        rig: sensor, and from where it measures.
        limits: where the arm may go.
        criterion: "task" for the smallest predicted error over the task (I- or V-optimal, with the priors of the fit),
            "determinant" for the smallest volume of the parameters' uncertainty (D-optimal, with priors).
        tell_apart: two rival effects, as in :func:`pincal.design.study.find_rival`, to be told apart instead.
        accuracy: predicted error over the task to reach [m].
        task: joint positions that the user cares for, with payloads where they matter; default: the whole reach.
        measured: poses measured already, with their payloads; their information counts.
        payloads: masses at the tip [kg] to choose from, pose by pose; default: no payload.
        candidates: number of random poses to choose from; default: 1500, or twice ``poses`` if that is more.
        refine: whether to move the chosen poses joint by joint to where they tell more.
        curve: whether to design for other numbers of poses, too, and to bound what any choice can reach.
        seed: seed of all random numbers.

    Returns:
        The design; look at its ``notes``.

    Raises:
        BadInputError: for constraints that leave too few poses, an accuracy that no number of poses reaches, an unknown
            effect, or a sensor or model that a design can't be made for.

    Example:
        >>> from pincal.model.effects import GEOMETRIC
        >>> found = design_poses(Robot.from_urdf("ur10"), 20, Options(effects=GEOMETRIC), candidates=200, curve=False)
        >>> found.q.shape, found.found.designed.error < found.found.random.error
        ((20, 6), True)
    """
    request = DesignRequest(
        poses=poses,
        accuracy=accuracy,
        criterion=criterion,
        tell_apart=tell_apart,
        task=task,
        measured=measured,
        payloads=None if payloads is None else tuple(float(load) for load in payloads),
        candidates=candidates,
        seed=seed,
    )
    reach = Reach(robot, rig or SensorSetup(), limits or Limits())
    if reach.rig.held_at:
        raise BadInputError(
            f"sensor {reach.rig.sensor}: poses in which the target is held are designed for a health check alone; expected "
            "--check (design_check), or another sensor"
        )
    return _design(request, reach, options or Options(), refine=refine, curve=curve)


def _design(request: DesignRequest, reach: Reach, options: Options, *, refine: bool, curve: bool) -> Design:
    begun = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        study = Study.of(reach, options=options, request=request)
        needed = None if request.accuracy is None else study.smallest(request.accuracy)
        n = request.poses or needed or 1
        _check_count(study, n)
    picked = study.candidates.select(np.array(study.design(n)))
    if refine:
        picked = refined(picked, study.design_model, reach=reach, W=study.W, H=study.H)
    H, at_random = study.H + total(study.design_model.readings(picked)), study.random(n)
    found = CurvePoint(n, study.quality(H), Quality.median([study.quality(R) for R in at_random]))
    order, unordered, ordered = order_by_load(picked.q, picked.payload, reach.range)
    indices, indices_random = _indices(study, n, H, at_random)
    criterion: str = "tell apart" if request.tell_apart else request.criterion
    return Design(
        robot=reach.robot,
        conditions=picked.select(order),
        has_payloads=request.payloads is not None,
        rig=reach.rig,
        criterion=criterion,
        rivals=tuple(request.tell_apart or ()),
        design_model=study.design_model,
        drawn=study.drawn,
        found=found,
        before=study.quality(study.H) if study.n_measured else None,
        bound=study.bound(n) if curve and criterion == "task" else None,
        curve=study.curve(found) if curve else (),
        needed=needed,
        observability=indices,
        observability_random=indices_random,
        rank=study.rank(n),
        path_length=ordered,
        path_length_unordered=unordered,
        notes=(*reach.robot.notes, *reach.bodies.notes, *notes_on_masses(reach.robot, options.effects), *_messages(caught)),
        seconds=time.perf_counter() - begun,
    )


def _check_count(study: Study, n: int) -> None:
    """Warn of fewer poses than the parameters need."""
    size, rank, count = study.A.shape[1], study.rank(n), n + study.n_measured
    if size * count < rank:
        fewest, good = -(-rank // size), int(np.ceil(_COMFORTABLE * rank / size))
        warnings.warn(
            f"{count} poses give {size * count} readings for {rank} directions of the parameters that such poses can tell, "
            f"so the rest stays as it was known beforehand; expected {fewest} poses or more, better {good}",
            PincalWarning,
            stacklevel=3,
        )


def _indices(
    study: Study, n: int, H: np.ndarray, at_random: Sequence[np.ndarray]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the indices of the design, and their medians over random ones, what was measured before included."""
    directions, prior = observed_directions(study.design_model, study.mean, n), np.eye(len(H))
    found, *random = (
        observability(study.design_model, directions, X - prior, n + study.n_measured) for X in (H, *at_random)
    )
    return found, {name: float(np.median([i[name] for i in random])) for name in random[0]}


def _messages(caught: list[warnings.WarningMessage]) -> tuple[str, ...]:
    return tuple(str(w.message) for w in caught if issubclass(w.category, PincalWarning))
