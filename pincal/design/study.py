"""The common basis of all designs for one robot and rig: candidates, their information, and the
criterion.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from pincal.design.design_model import DesignModel, noncentrality, weights
from pincal.design.exchange import (
    choose_greedily,
    covariance,
    exchange,
    gains,
    information,
    lower_bound,
    spread_of,
    total,
    value,
)
from pincal.design.reach import Draw, Reach
from pincal.design.request import DesignRequest, PoseBuilder
from pincal.errors import BadInputError, warn
from pincal.identify.options import Options
from pincal.model.catalogue.candidates import find_effect
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions, PoseSet
from pincal.model.effect import Effect, Reducible
from pincal.thresholds import Count, Scale

log = logging.getLogger(__name__)

RANDOM_DESIGNS: Count = 50
"""Number of random designs with whose median a design is compared."""

# Number of poses over which the task's error is averaged.
_TASK_POSES: Count = 400
# Numbers of poses of the curve, and its extent as a multiple of the requested number, at least.
_LADDER: tuple[Count, ...] = (10, 15, 20, 30, 40, 50, 70, 100, 150, 200, 300, 500)
_BEYOND: Scale = 2.0
_AT_LEAST: Count = 100
# Passes of an exchange from a nearly optimal design.
_FEW_PASSES: Count = 2
# Positions tried of each joint, and the fraction of its range over which they are spread, sweep by
# sweep.
_STEPS: Count = 11
_WINDOWS: tuple[Scale, ...] = (1.0, 0.4, 0.15)
# Least difference of a joint's positions between poses, as a fraction of its range, and of a pose's
# share of the range.
_APART: Scale = 2e-3
_OF_SHARE: Scale = 0.25
# Offset of the trial positions from pose to pose, as a fraction of a step.
_SHIFT: Scale = 0.5 * (5.0**0.5 - 1.0)
# Relative gain below which a pose is not moved.
_WORTH: Scale = 1e-6


@dataclass(frozen=True)
class Quality:
    """Predicted quality of a set of poses.

    Attributes:
        error: predicted rms error of a calibrated model over the task [m], of the position, or of a
            measured distance. It is due to the posterior uncertainty of the parameters, without
            noise of a new measurement or model error.
        apart: non-centrality after a refit of each rival of typical size; empty without rivals.
    """

    error: float
    apart: tuple[float, ...] = ()

    @classmethod
    def median(cls, found: Sequence[Quality]) -> Quality:
        """Return the medians over several sets."""
        apart = np.median([quality.apart for quality in found], axis=0)
        return cls(
            float(np.median([quality.error for quality in found])), tuple(float(x) for x in apart)
        )


@dataclass(frozen=True)
class CurvePoint:
    """Designed poses compared with random ones (the median of many draws), both including
    previously measured poses.
    """

    poses: int
    designed: Quality
    random: Quality


@dataclass(frozen=True)
class Study:
    """Candidates and the information of each.

    Attributes:
        design_model: the parameters.
        drawn: the candidates' joint positions, and the number removed by each constraint.
        candidates: the M poses to choose from.
        A: shape (M, m, F), their Jacobian in units of noise and priors.
        H: shape (F, F), information of the priors and of previously measured poses.
        n_measured: number of previously measured poses.
        task: shape (F, F), matrix of the mean squared error over the task [m^2].
        W: shape (F, F), weights of the criterion; None for the determinant.
        rng: random generator for random designs.
    """

    design_model: DesignModel
    drawn: Draw
    candidates: Conditions
    A: np.ndarray
    H: np.ndarray
    n_measured: int
    task: np.ndarray
    W: np.ndarray | None
    rng: np.random.Generator

    @classmethod
    def of(cls, reach: Reach, *, options: Options, request: DesignRequest) -> Study:
        """Draw candidates, and compute the information of each.

        Raises:
            BadInputError: for constraints that leave too few poses, an unknown rival, or an
                unsupported sensor or model.
        """
        rng = [np.random.default_rng([request.seed, part]) for part in range(4)]
        log.info("drawing %d candidates within the constraints", request.n_candidates)
        drawn = reach.draw(request.n_candidates, rng[0])
        _check_draw(drawn, request)
        poses = PoseBuilder(reach.robot, options, request)
        candidates = poses.at(drawn.q, rng[1])
        rivals = _rivals(reach, options, request, candidates=candidates)
        known = None if request.measured is None else poses.of(request.measured)
        rows = candidates if known is None else _together(candidates, known)
        design_model = DesignModel.of(
            reach.robot, rows, options, reach.rig, rivals=rivals, targets=poses.targets
        )
        H = design_model.known.copy()
        if known is not None:
            H += total(design_model.readings(known))
        E = design_model.errors(_task_poses(poses, reach, rng[2]))
        weight = total(E) / len(E)
        W = weight if request.criterion == "task" else None
        if rivals:
            W = weights(design_model.rivals, design_model.n_free)
        count = 0 if known is None else len(known)
        A = design_model.readings(candidates)
        return cls(design_model, drawn, candidates, A, H, count, weight, W, rng[3])

    @cached_property
    def mean(self) -> np.ndarray:
        """Information of one average candidate, shape (F, F)."""
        return total(self.A) / len(self.A)

    def rank(self, n: int) -> int:
        """Return the number of directions, including base and tool, that n average candidates
        identify beyond the priors.
        """
        return self.design_model.posterior(n * self.mean).identifiable_rank

    def quality(self, H: np.ndarray) -> Quality:
        """Return the quality of information H, shape (F, F)."""
        core = np.ix_(self.design_model.core, self.design_model.core)
        error = np.sqrt(value(covariance(H[core]), self.task[core]))
        rivals = self.design_model.rivals
        return Quality(float(error), noncentrality(covariance(H), rivals) if rivals else ())

    def design(self, n: int) -> list[int]:
        """Return n candidates that no single exchange improves: the better of two starts.

        Exchanges end in one of many local optima; the optimum of the determinant is another start
        than a greedy choice.
        """
        log.info("exchanging %d poses among %d candidates", n, len(self.A))
        found = []
        for W in (self.W, None) if self.W is not None else (None,):
            chosen, _ = choose_greedily(self.A, W, self.H, n)
            found.append(exchange(self.A, self.W, self.H, exchange(self.A, W, self.H, chosen)))
        return min(
            found,
            key=lambda design: value(covariance(self.H + information(self.A, design)), self.W),
        )

    def refine(self, design: Conditions, reach: Reach) -> Conditions:
        """Improve a design by coordinate exchange within the constraints (Meyer and Nachtsheim,
        Technometrics 37, 1995).

        Each pose in turn is replaced by its best neighbour that differs in one joint; its other
        conditions, such as the payload, are unchanged. Joint positions do not repeat between poses,
        as a drive's error would be measured twice at one position and not at all at another.
        """
        q = design.q.copy()
        A = self.design_model.readings(design)
        for sweep, window in enumerate(_WINDOWS):
            log.info(
                "refining the poses, sweep %d",
                sweep + 1,
                extra={"done": sweep, "of": len(_WINDOWS)},
            )
            for place in range(len(q)):
                rest = np.delete(A, place, axis=0).reshape(-1, A.shape[2])
                C = covariance(self.H + rest.T @ rest)
                trial = _neighbours(q, place, reach, window)
                if not len(trial):
                    continue
                readings = self.design_model.readings(
                    replace(design.select(np.full(len(trial), place)), q=trial)
                )
                gain = gains(*spread_of(readings, C, self.W))
                least = float(gains(*spread_of(A[place][None], C, self.W))[0])
                better = np.argsort(-gain)[: np.sum(gain > least + _WORTH * abs(least))]
                k = next((k for k in better if not reach.collides(trial[k : k + 1])[0]), None)
                if k is not None:
                    q[place] = trial[k]
                    A[place] = readings[k]
        return replace(design, q=q)

    def random(self, n: int) -> list[np.ndarray]:
        """Return the information of random designs of n poses, including previously
        measured ones.
        """
        draws = (self.rng.choice(len(self.A), n, replace=False) for _ in range(RANDOM_DESIGNS))
        return [self.H + information(self.A, draw) for draw in draws]

    def bound(self, n: int) -> float:
        """Return the lower bound of the predicted error of n candidates, with the criterion task
        [m].
        """
        return float(np.sqrt(max(lower_bound(self.A, self.task, self.H, n), 0.0)))

    def curve(self, known: CurvePoint) -> tuple[CurvePoint, ...]:
        """Return designs of several numbers of poses, including the number of ``known``, each
        starting from the previous.
        """
        most = min(max(_BEYOND * known.poses, _AT_LEAST), len(self.A))
        points = []
        chosen = list[int]()
        for n in sorted({n for n in _LADDER if n <= most} | {known.poses}):
            log.info("designing %d poses for the curve", n)
            chosen, _ = choose_greedily(self.A, self.W, self.H, n, chosen)
            chosen = exchange(self.A, self.W, self.H, chosen, passes=_FEW_PASSES)
            designed = self.quality(self.H + information(self.A, chosen))
            at_random = (
                known.random
                if n == known.poses
                else Quality.median([self.quality(H) for H in self.random(n)])
            )
            points.append(CurvePoint(n, designed, at_random))
        return tuple(points)

    def smallest(self, accuracy: float) -> int:
        """Return the smallest number of candidates whose exchanged design reaches an accuracy [m].

        Raises:
            BadInputError: if no practical number of candidates does.
        """
        most = min(_LADDER[-1], len(self.A))
        log.info("looking for the number of poses that gives %.4g mm", 1e3 * accuracy)
        chosen, course = choose_greedily(self.A, self.W, self.H, most)
        enough = np.flatnonzero(np.sqrt(course) <= accuracy)
        if not len(enough):
            raise BadInputError(
                f"accuracy {1e3 * accuracy:g} mm: {most} poses reach "
                f"{1e3 * np.sqrt(course[-1]):.4g} mm over the task; "
                "expected more than that, or less noise, another sensor, fewer constraints"
            )
        low = 0
        high = int(enough[0]) + 1
        while high - low > 1:
            n = (low + high) // 2
            design = exchange(self.A, self.W, self.H, chosen[:n], passes=_FEW_PASSES)
            is_reached = self.quality(self.H + information(self.A, design)).error <= accuracy
            low, high = (low, n) if is_reached else (n, high)
        return high


def _task_poses(poses: PoseBuilder, reach: Reach, rng: np.random.Generator) -> Conditions:
    """Return the poses over which the predicted error is averaged: the task's, or random ones."""
    task = poses.request.task
    if task is None:
        return poses.at(reach.draw(_TASK_POSES, rng, measured=False).q, rng)
    return replace(poses.of(task), target=np.zeros(len(task), int))


def _neighbours(q: np.ndarray, place: int, reach: Reach, window: float) -> np.ndarray:
    """Return poses, admissible except for self-collision, that differ from one of q, shape (N, n),
    in one joint.
    """
    lower, upper = reach.range
    half = 0.5 * window * (upper - lower)
    low = np.maximum(lower, q[place] - half)
    high = np.minimum(upper, q[place] + half)
    steps = low + (np.arange(_STEPS)[:, None] + place * _SHIFT % 1.0) / _STEPS * (high - low)
    taken = np.delete(q, place, axis=0)
    apart = min(_APART, _OF_SHARE / len(q)) * (upper - lower)
    trial = np.tile(q[place], (q.shape[1], _STEPS, 1))
    for joint in range(q.shape[1]):
        trial[joint, :, joint] = steps[:, joint]
    is_new = np.all(np.abs(steps[:, None] - taken) > apart, axis=1).T
    own = reach.robot.own_joints
    trial = reach.robot.following(trial[own][is_new[own]])
    return np.asarray(trial[reach.allows_apart(trial)])


def find_rival(text: str, chain: Chain, conditions: Conditions) -> Effect:
    """Return the effect of a name as by :func:`find_effect`, in the fewest parameters: a drive
    curve with few pieces.
    """
    effect = find_effect(text, chain, conditions)
    return effect.reduced(PoseSet(chain, conditions)) if isinstance(effect, Reducible) else effect


def _rivals(
    reach: Reach, options: Options, request: DesignRequest, *, candidates: Conditions
) -> list[Effect]:
    chain = Chain.of(reach.robot, moment_frame=options.first_frame, gravity=options.gravity)
    rivals = [find_rival(text, chain, candidates) for text in request.tell_apart or ()]
    if rivals and rivals[0] == rivals[1]:
        raise BadInputError(
            f"effects {' and '.join(request.tell_apart or ())}: one and the same; expected two"
        )
    return rivals


def _check_draw(drawn: Draw, request: DesignRequest) -> None:
    """Refuse constraints that leave too few poses, with the number that each removes."""
    found = len(drawn.q)
    needed = request.fewest
    if found < needed:
        raise BadInputError(
            f"the constraints leave too few poses for {needed}: {drawn.in_words()}; relax "
            "the one that removes most"
        )
    if found < request.n_candidates:
        warn(f"the constraints leave {found} candidates of {request.n_candidates} requested")


def _together(one: Conditions, other: Conditions) -> Conditions:
    """Return the poses of both, one after the other, without columns that only one of them has."""
    pairs = {f.name: (getattr(one, f.name), getattr(other, f.name)) for f in fields(Conditions)}
    columns: dict[str, Any] = {
        name: None if a is None or b is None else np.concatenate([a, b])
        for name, (a, b) in pairs.items()
    }
    return Conditions(**columns | {"payload_centre": one.payload_centre})
