r"""The changes that a health check must detect, the power of a diagnosis at some poses, and the
fewest poses.

Each change of a robot is scaled to a given motion of the target. The test of
:mod:`pincal.diagnosis.row_evidence` at poses j, with rows N_j of nuisance parameters (the posterior
of the calibration, masses, the new station's frames) and columns g_j of a change, in units of the
noise, has the non-centrality

.. math:: \lambda = \sum_j g_j^T g_j - z^T K z, \qquad
    K = H + \sum_j N_j^T N_j, \qquad z = K^{-1} \sum_j N_j^T g_j,

with prior information H. With :math:`u = g_j - N_j z`, one more pose adds
:math:`u^T (1 + N_j K^{-1} N_j^T)^{-1} u`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pincal.calibration.fitted_robot import FittedRobot
from pincal.calibration.row_noise import noise_of_rows
from pincal.design.design_model import check_rig, frame_effects, nominal_values, predicted_station
from pincal.design.design_numbers import DESIGN_NUMBERS
from pincal.design.exchange import covariance
from pincal.design.reach import SensorSetup
from pincal.diagnosis.change_search import limit_for
from pincal.diagnosis.excluded import detected_noncentrality
from pincal.diagnosis.lineup import ChangeHypotheses, PossibleChange
from pincal.diagnosis.row_evidence import Known, prior_root, rows_in_noise
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Curve
from pincal.model.model import Model
from pincal.parameters import estimate_of
from pincal.thresholds import Count, Scale

# Number of random directions in which a change of several parameters is to be detected.
_WAYS: Count = 10
# Rows for which changes are enumerated: as many as a check has.
_ROWS: Count = 16
# Prior information on frames, relative to the average information of a row: practically none.
_NOTHING: Scale = 1e-6
# Passes over a design in which poses are exchanged.
_PASSES: Count = 3
# The larger, the more the hardest change dominates the choice of a pose.
_SHARPNESS: Scale = 4.0


@dataclass(frozen=True)
class DetectableChange:
    """A change to be detected: its index in the lineup, its step of the parameters, the rank of its
    test.
    """

    change: int
    step: np.ndarray
    rank: int


def lineup_over(model: FittedRobot, rig: SensorSetup, conditions: Conditions) -> ChangeHypotheses:
    """Return all possible changes of a robot, for poses in which a new station reads the model's
    predictions.
    """
    check_rig(rig)
    arm = model.model
    chain = Chain.of(
        arm.chain.robot, moment_frame=arm.chain.moment_frame, gravity=arm.chain.gravity
    )
    frames = frame_effects(chain, rig, conditions)
    effects = (*frames, *(effect for effect in arm.effects if effect.scope == "robot"))
    there = Model(chain, effects, equilibrium=arm.equilibrium)
    values = nominal_values(there, rig, rig.target(chain.robot))
    known = model.robot_estimate
    places = [there.index(name) for name in known.names]
    values[places] = known.values
    station = predicted_station(there, values, rig, conditions)
    of_arm = np.zeros((len(values),) * 2)
    of_arm[np.ix_(places, places)] = known.dense_covariance()
    sigma = noise_of_rows(model, rig.sensor, station.sensor.blocks).sigma
    at_rig = replace(model.station, sensor_kind=rig.sensor, sigma=sigma)
    estimate = estimate_of(station.parameters, values, of_arm)
    placed = model.with_station(at_rig).with_model(there, estimate)
    few = ChangeHypotheses.of(
        placed, station.select(np.arange(_ROWS)), Known.of(model, station.conditions)
    )
    return replace(few, station=station.with_model(few.station.model))


def detectable_changes(
    lineup: ChangeHypotheses, places: Conditions, notice: float, *, rng: np.random.Generator
) -> tuple[list[DetectableChange], list[PossibleChange]]:
    """Return the changes to be detected, and those that new frames absorb or that never are so
    large.
    """
    model = lineup.station.model
    poses, motion = model.linearise(model.own(lineup.start), places)
    sizes = np.where(np.isfinite(lineup.sizes), lineup.sizes, 0.0)
    motion = _without_frames(poses, motion) * sizes[: motion.shape[2]]
    detectable = []
    absorbed = []
    for i, (change, at) in enumerate(zip(lineup.changes, lineup.places, strict=True)):
        if isinstance(change.effect, Curve) or change.belief is not None:
            continue
        ways = np.ones((1, 1)) if len(at) == 1 else rng.standard_normal((_WAYS, len(at)))
        farthest = np.linalg.norm(motion[:, :, at] @ ways.T, axis=1).max(axis=0)
        seen = farthest * DESIGN_NUMBERS.largest >= notice * np.linalg.norm(ways, axis=1)
        if not seen.any():
            absorbed.append(change)
        strengths = np.linalg.svd(motion[:, :, at].reshape(-1, len(at)), compute_uv=False)
        rank = int(np.sum(strengths > DESIGN_NUMBERS.seen * strengths[0]))
        for way, far in zip(ways[seen], farthest[seen], strict=True):
            step = np.zeros(len(lineup.start))
            step[at] = sizes[at] * way * notice / far
            detectable.append(DetectableChange(i, step, rank))
    return detectable, absorbed


def _without_frames(poses: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Return motion of the target, shape (V, 3, P), with refitted base and target frames projected
    out.
    """
    points = poses[:, :, 3]
    n = len(poses)
    turned = np.cross(np.eye(3)[None], points[:, None]).transpose(0, 2, 1)
    frames = np.concatenate(
        [np.tile(np.eye(3), (n, 1, 1)), turned, poses[:, :, :3]], axis=2
    ).reshape(3 * n, -1)
    rows = motion.reshape(3 * n, -1)
    return np.asarray(rows - frames @ np.linalg.lstsq(frames, rows, rcond=1e-10)[0]).reshape(
        motion.shape
    )


def detection_design(
    lineup: ChangeHypotheses,
    detectable: list[DetectableChange],
    *,
    alpha: float,
    power: float,
    degrees: float,
) -> DetectionDesign:
    """Return the information of the candidates on the changes to be detected."""
    station = lineup.station
    A, _ = rows_in_noise(station, lineup.start, lineup.robot.sigma)
    m = station.reading_size
    uncertain = prior_root(station, lineup.known, lineup.surroundings) @ A
    own = A[lineup.own]
    own = own / np.sqrt(np.maximum(np.mean(own**2, axis=1, keepdims=True), 1e-300))
    rows = np.vstack([uncertain, own]).T.reshape(len(station), m, -1)
    return DetectionDesign(
        N=rows,
        G=(np.array([one.step for one in detectable]) @ A).T.reshape(len(station), m, -1),
        H=np.diag(np.append(np.ones(len(uncertain)), np.full(len(own), _NOTHING))),
        ranks=np.array([one.rank for one in detectable]),
        limit=limit_for(alpha, len(lineup.changes)),
        degrees=degrees - len(own),
        power=power,
    )


@dataclass(frozen=True)
class DetectionDesign:
    """Candidate poses, and the information of each on the changes to be detected.

    Attributes:
        N: shape (M, m, K), rows of the nuisance parameters.
        G: shape (M, m, Q), columns of the changes, each of the size to be detected.
        H: shape (K, K), prior information.
        ranks: shape (Q,), degrees of freedom of the test of each change.
        limit: p-value below which a change is an alarm.
        degrees: degrees of freedom of the noise from other data, less those that the rows spend on
            frames.
        power: required probability of detection.
    """

    N: np.ndarray
    G: np.ndarray
    H: np.ndarray
    ranks: np.ndarray
    limit: float
    degrees: float
    power: float

    def needed(self, n: int) -> np.ndarray:
        """Return the non-centrality that each change must have with n poses, shape (Q,)."""
        degrees = max(self.degrees + n * self.N.shape[1], 1.0)
        return np.array(
            [
                detected_noncentrality(int(rank), degrees, self.limit, self.power)
                for rank in self.ranks
            ]
        )

    def noncentralities(self, chosen: Sequence[int]) -> np.ndarray:
        """Return the non-centralities of all changes at some of the candidates, shape (Q,)."""
        return self._seen(chosen)[0]

    def certainty(self, chosen: Sequence[int]) -> float:
        """Return the least ratio of non-centrality to the one needed, over all changes."""
        return float((self.noncentralities(chosen) / self.needed(len(chosen))).min())

    def fewest(self, most: int, start: Sequence[int] = ()) -> list[int]:
        """Return the fewest candidates found that detect every change, at most ``most``, beginning
        with ``start``.
        """
        chosen = list(start)
        while len(chosen) < most and (not chosen or self.certainty(chosen) < 1.0):
            chosen.append(self._best(chosen, self._costs(chosen)))
        if self.certainty(chosen) < 1.0:
            return self._exchanged(chosen)
        while len(chosen) > 1:
            fewer = self._exchanged(self._without_one(chosen))
            if self.certainty(fewer) < 1.0:
                break
            chosen = fewer
        return chosen

    def fewest_of(self, most: int, groups: np.ndarray) -> list[int]:
        """Return the best of :meth:`fewest` from an empty start and from two candidates of each
        group, shape (M,).

        A first pose at an unknown socket carries no information, so that adding poses singly would
        use one socket only.
        """
        pairs = [int(j) for group in np.unique(groups) for j in np.flatnonzero(groups == group)[:2]]
        found = (
            [self.fewest(most), self.fewest(most, pairs)] if len(pairs) > 2 else [self.fewest(most)]
        )
        return min(
            found,
            key=lambda chosen: (self.certainty(chosen) < 1.0, len(chosen), -self.certainty(chosen)),
        )

    def _seen(self, chosen: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the non-centralities, shape (Q,), all z, shape (K, Q), and the inverse of K, shape
        (K, K).
        """
        N, G = (part[list(chosen)].reshape(-1, part.shape[2]) for part in (self.N, self.G))
        inverse = covariance(self.H + N.T @ N)
        z = inverse @ (N.T @ G)
        return np.maximum(np.sum(G * (G - N @ z), axis=0), 0.0), z, inverse

    def _costs(self, chosen: Sequence[int]) -> np.ndarray:
        """Return the cost of the deficient non-centralities with each candidate added,
        shape (M,).
        """
        found, z, inverse = self._seen(chosen)
        U = self.G - self.N @ z
        inner = np.eye(U.shape[1]) + self.N @ inverse @ self.N.transpose(0, 2, 1)
        more = np.sum(np.linalg.solve(np.linalg.cholesky(inner), U) ** 2, axis=1)
        # 1 in the denominator keeps the cost of a change that no pose shows finite.
        return np.asarray(
            np.sum((self.needed(len(chosen) + 1) / (1.0 + found + more)) ** _SHARPNESS, axis=1)
        )

    def _exchanged(self, chosen: list[int]) -> list[int]:
        """Return a design with poses exchanged for better ones until it detects every change."""
        design = list(chosen)
        for _ in range(_PASSES):
            before = list(design)
            for place in range(len(design)):
                if self.certainty(design) >= 1.0:
                    return design
                rest = design[:place] + design[place + 1 :]
                design[place] = self._best(rest, self._costs(rest))
            if design == before:
                break
        return design

    def _without_one(self, chosen: list[int]) -> list[int]:
        """Return a design without its least valuable pose."""
        places = range(len(chosen))
        rests = [chosen[:place] + chosen[place + 1 :] for place in places]
        missed = [
            float(np.sum((1.0 / (1.0 + self.noncentralities(rest))) ** _SHARPNESS))
            for rest in rests
        ]
        return rests[int(np.argmin(missed))]

    @staticmethod
    def _best(chosen: Sequence[int], costs: np.ndarray) -> int:
        costs = costs.copy()
        costs[list(chosen)] = np.inf
        return int(np.argmin(costs))
