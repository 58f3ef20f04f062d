r"""Pose designs: the poses to measure for a robot and constraints, and the predicted accuracy.

They include observability indices, numbered as in the literature (Sun and Hollerbach 2008). With
the singular values
:math:`\sigma_1 \ge \dots \ge \sigma_r` of the identification Jacobian at n poses:

.. math:: O_1 = \frac{(\sigma_1 \cdots \sigma_r)^{1/r}}{\sqrt n} \quad
    O_2 = \frac{\sigma_r}{\sigma_1} \quad O_3 = \sigma_r \quad O_4 = \frac{\sigma_r^2}{\sigma_1}
    \quad O_5 = \Big(\sum_i \frac{1}{\sigma_i}\Big)^{-1}

Such indices depend on units and on the choice of parameters. Here parameters are in units of the
priors (some mm, mrad), readings in units of the noise, and base and tool are projected out. The r
directions are those that n average candidates determine better than the priors do, the same for all
designs that are compared.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pincal.design.design_model import DesignModel, held_columns, predicted_station
from pincal.design.design_numbers import DESIGN_NUMBERS
from pincal.design.exchange import order_by_load, total
from pincal.design.reach import Draw, Limits, Reach, SensorSetup
from pincal.design.request import DesignRequest, pose_columns
from pincal.design.study import CurvePoint, Quality, Study
from pincal.errors import warn
from pincal.identify.options import Options
from pincal.identify.quadratic import NULL
from pincal.measure.admit import noted
from pincal.model.catalogue.masses import notes_on_masses
from pincal.model.conditions import Conditions
from pincal.robot.robot import Robot
from pincal.thresholds import Scale

PREDICTED_BY = {
    "O1": "Borm and Menq 1989",
    "O2": "Driels and Pathre 1990",
    "O3": "Nahvi, Hollerbach and Hayward 1994",
    "O4": "Nahvi and Hollerbach 1996",
    "O5": "Sun and Hollerbach 2008",
}
"""Source of each index."""


def observed_directions(design_model: DesignModel, mean: np.ndarray, n: int) -> np.ndarray:
    """Return the directions that n average candidates identify, orthonormal in units of the priors,
    shape (H, r).

    They are directions of the H parameters with a prior; ``mean`` is the information of one
    candidate, shape (F, F).
    """
    posterior = design_model.posterior(n * mean)
    return posterior.directions[:, posterior.information > 1.0]


def observability(
    design_model: DesignModel, directions: np.ndarray, H: np.ndarray, n: int
) -> dict[str, float]:
    """Return O1 to O5, in these directions, of n poses with information H, shape (F, F); empty
    without directions.
    """
    if not directions.shape[1]:
        return {}
    posterior = design_model.posterior(H)
    overlap = directions.T @ posterior.directions
    squares = np.linalg.eigvalsh((overlap * posterior.information) @ overlap.T)
    if squares[0] <= NULL * squares[-1]:
        return dict.fromkeys(PREDICTED_BY, 0.0)
    sigma = np.sqrt(squares)
    return {
        "O1": float(np.exp(np.mean(np.log(sigma))) / np.sqrt(n)),
        "O2": float(sigma[0] / sigma[-1]),
        "O3": float(sigma[0]),
        "O4": float(sigma[0] ** 2 / sigma[-1]),
        "O5": float(1.0 / np.sum(1.0 / sigma)),
    }


# Practically unlimited number of poses.
_MANY: Scale = 1e6


@dataclass(frozen=True, repr=False)
class Design:
    """Poses to measure, ordered for short motions, and the predicted accuracy.

    Attributes:
        robot: the arm.
        conditions: the N poses, with the approach if it was part of the design.
        has_payloads: whether payloads were part of the design.
        rig: sensor set-up.
        criterion: "task", "determinant" or "tell apart".
        rivals: names of the effects to be distinguished; empty with the other criteria.
        design_model: the parameters and their priors.
        drawn: the candidates, and the number removed by each constraint.
        found: the design compared with random poses.
        before: the previously measured poses alone; None without any.
        bound: lower bound of the predicted error for N of the candidates, with the criterion task
            [m]; else None.
        curve: designs of other numbers of poses and of this one, all chosen among the candidates
            and not refined.
        needed: smallest number of candidates that reaches the requested accuracy; None without one.
        observability: indices O1 to O5 of the poses, including previously measured ones.
        observability_random: their medians over random poses.
        rank: number of directions that such poses determine better than the priors do, including
            base and tool.
        path_length: length of the path through the poses, in ranges of the joint that moves
            farthest.
        path_length_unordered: the same in the order in which they were found.
        notes: messages to the user.
        seconds: computing time.
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
        return (
            f"Design({self.robot.name!r}: {self.found.poses} poses, {error:.4g} mm rms predicted)"
        )

    @property
    def q(self) -> np.ndarray:
        """Joint positions, shape (N, n) [rad or m]."""
        return self.conditions.q

    def columns(self) -> dict[str, np.ndarray]:
        """Return the table to be filled in: joints, and target, payload and approach if they are
        part of the design.
        """
        targets = self.design_model.model.chain.targets
        poses = pose_columns(
            self.robot, self.conditions, has_payloads=self.has_payloads, targets=targets
        )
        station = predicted_station(
            self.design_model.model, self.design_model.values, self.rig, self.conditions
        )
        return poses | held_columns(station)

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
            "candidates": {
                "found": len(self.drawn.q),
                "drawn": self.drawn.drawn,
                "removed": self.drawn.removed,
            },
            **_plain_point(self.found),
            "measured_before": None if self.before is None else _plain(self.before),
            "bound_mm": None if self.bound is None else 1e3 * self.bound,
            "needed": self.needed,
            "curve": [_plain_point(point) for point in self.curve],
            "observability": {
                "designed": self.observability,
                "random_median": self.observability_random,
            },
            "way": {"ordered": self.path_length, "unordered": self.path_length_unordered},
            "notes": list(self.notes),
            "seconds": self.seconds,
        }


def _plain(quality: Quality) -> dict[str, Any]:
    apart = {"noncentrality": list(quality.apart)} if quality.apart else {}
    return {"error_rms_mm": 1e3 * quality.error} | apart


def _plain_point(point: CurvePoint) -> dict[str, Any]:
    return {
        "poses": point.poses,
        "designed": _plain(point.designed),
        "random_median": _plain(point.random),
    }


def design_poses(
    robot: Robot,
    request: DesignRequest | int | None = None,
    options: Options | None = None,
    *,
    rig: SensorSetup | None = None,
    limits: Limits | None = None,
    **earlier: Any,
) -> Design:
    """Choose the most informative poses.

    Args:
        robot: the arm.
        request: the specification, or the number of poses alone.
        options: as for the calibration: effects, noise, moment frame, centre of mass of the
            payload. Base and tool are taken as unknown.
        rig: sensor set-up.
        limits: limits of the workspace.
        **earlier: fields of the request, deprecated.

    Returns:
        The design; note its ``notes``.

    Raises:
        BadInputError: for constraints that leave too few poses, an unreachable accuracy, an unknown
            effect, or an unsupported sensor or model.

    Example:
        >>> from pincal.model.effects import GEOMETRIC
        >>> request = DesignRequest(poses=20, candidates=200, curve=False)
        >>> found = design_poses(Robot.from_urdf("ur10"), request, Options(effects=GEOMETRIC))
        >>> found.q.shape, found.found.designed.error < found.found.random.error
        ((20, 6), True)
    """
    if not isinstance(request, DesignRequest):
        if earlier:
            warnings.warn(
                "design_poses takes what is to be designed as a DesignRequest",
                DeprecationWarning,
                stacklevel=2,
            )
        request = DesignRequest(**{"poses": request} | earlier)
    return _design(
        request, Reach(robot, rig or SensorSetup(), limits or Limits()), options or Options()
    )


def _design(request: DesignRequest, reach: Reach, options: Options) -> Design:
    begun = time.perf_counter()
    with noted() as notes:
        study, needed = _studied(request, reach, options)
    n = request.poses or needed or 1
    picked = _picked(study, n, request, reach)
    H = study.H + total(study.design_model.readings(picked))
    at_random = study.random(n)
    found = CurvePoint(n, study.quality(H), Quality.median([study.quality(R) for R in at_random]))
    indices, indices_random = _indices(study, n, H, at_random)
    criterion: str = "tell apart" if request.tell_apart else request.criterion
    return Design(
        robot=reach.robot,
        **_ordered(picked, reach),
        has_payloads=request.payloads is not None,
        rig=reach.rig,
        criterion=criterion,
        rivals=tuple(request.tell_apart or ()),
        design_model=study.design_model,
        drawn=study.drawn,
        found=found,
        before=study.quality(study.H) if study.n_measured else None,
        bound=study.bound(n) if request.curve and criterion == "task" else None,
        curve=study.curve(found) if request.curve else (),
        needed=needed,
        observability=indices,
        observability_random=indices_random,
        rank=study.rank(n),
        notes=(*_notes_on_robot(reach, options), *notes),
        seconds=time.perf_counter() - begun,
    )


def _studied(request: DesignRequest, reach: Reach, options: Options) -> tuple[Study, int | None]:
    """Return the study of a request, and how many poses its accuracy needs; warn if they determine
    too little.
    """
    study = Study.of(reach, options=options, request=request)
    needed = None if request.accuracy is None else study.smallest(request.accuracy)
    n = request.poses or needed or 1
    _check_count(study, n)
    _check_limit(study, n)
    return study, needed


def _ordered(picked: Conditions, reach: Reach) -> dict[str, Any]:
    """Return the poses in an order of short motions, and the length of the path before and
    after.
    """
    order, unordered, ordered = order_by_load(picked.q, picked.payload, reach.range)
    return {
        "conditions": picked.select(order),
        "path_length": ordered,
        "path_length_unordered": unordered,
    }


def _picked(study: Study, n: int, request: DesignRequest, reach: Reach) -> Conditions:
    """Return the n poses, refined if that is wanted and possible."""
    picked = study.candidates.select(np.array(study.design(n)))
    # A pose in which the target is held can't be refined.
    return study.refine(picked, reach) if request.refine and not reach.rig.held_at else picked


def _notes_on_robot(reach: Reach, options: Options) -> tuple[str, ...]:
    return (
        *reach.robot.notes,
        *reach.bodies.notes,
        *notes_on_masses(reach.robot, options.effects),
    )


def _check_count(study: Study, n: int) -> None:
    size = study.A.shape[1]
    rank = study.rank(n)
    count = n + study.n_measured
    if size * count < rank:
        fewest = -(-rank // size)
        good = int(np.ceil(DESIGN_NUMBERS.comfortable * rank / size))
        warn(
            f"{count} poses give {size * count} readings for {rank} directions of the parameters "
            f"that such poses can identify, so the rest relies on the priors; expected {fewest} "
            f"poses or more, better {good}"
        )


def _check_limit(study: Study, n: int) -> None:
    """Warn if most of the error remains with any number of such readings."""
    error, limit = (study.quality(study.H + count * study.mean).error for count in (n, _MANY))
    if limit > DESIGN_NUMBERS.mostly * error:
        warn(
            f"{1e3 * limit:.3g} mm of the predicted error remain however many such poses are "
            "measured: they do not determine all that the task depends on (contacts without a "
            "known length do not determine the scale); expected a known length or an instrument as "
            "well, or --criterion determinant for the best of what they do determine"
        )


def _indices(
    study: Study, n: int, H: np.ndarray, at_random: Sequence[np.ndarray]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the indices of the design, and their medians over random ones, including previously
    measured poses.
    """
    directions = observed_directions(study.design_model, study.mean, n)
    prior = study.design_model.known
    found, *random = (
        observability(study.design_model, directions, X - prior, n + study.n_measured)
        for X in (H, *at_random)
    )
    return found, {name: float(np.median([i[name] for i in random])) for name in random[0]}
