"""What a health check has to notice: each change of a robot, just so large that it moves the target by so much."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pincal.calibration.calibrated import CalibratedModel, estimate_of
from pincal.calibration.placing import noise_like
from pincal.design.design_model import check_rig, foreseen_station, frames_of, nominal_values
from pincal.design.reach import SensorSetup
from pincal.design.watch import Watch
from pincal.diagnosis.changes import Change
from pincal.diagnosis.evidence import Known, spread, whitened
from pincal.diagnosis.lineup import Lineup
from pincal.diagnosis.search import limit_for
from pincal.model.chain import Chain
from pincal.model.conditions import Conditions
from pincal.model.effect import Curve
from pincal.model.model import Model

# Random directions in which a change of several parameters is to be noticed.
_WAYS = 10
# Part of the motion of a change's best direction below which another is not counted.
_SEEN = 1e-3
# Sizes that are typical of its parameters beyond which no change is taken to go.
_LARGEST = 10.0
# Rows by which changes are lined up: as many as a check has.
_ROWS = 16
# Information that a design has of frames before any row, in parts of what a row has on average: as good as none.
_NOTHING = 1e-6


@dataclass(frozen=True)
class Guarded:
    """A change that is to be noticed: its place in the lineup, what it adds to the parameters, the rank of its test."""

    change: int
    step: np.ndarray
    rank: int


def lineup_over(model: CalibratedModel, rig: SensorSetup, conditions: Conditions) -> Lineup:
    """Return all that may happen to a robot, over poses in which a new station reads what the model predicts."""
    check_rig(rig)
    arm = model.model
    chain = Chain.of(arm.chain.robot, moment_frame=arm.chain.moment_frame, gravity=arm.chain.gravity)
    frames = frames_of(chain, rig, conditions)
    effects = (*frames, *(effect for effect in arm.effects if effect.scope == "robot"))
    there = Model(chain, effects, equilibrium=arm.equilibrium)
    values = nominal_values(there, rig, rig.target(chain.robot))
    known = model.robot_estimate
    places = [there.index(name) for name in known.names]
    values[places] = known.values
    station = foreseen_station(there, values, rig, conditions)
    of_arm = np.zeros((len(values),) * 2)
    of_arm[np.ix_(places, places)] = known.dense_covariance()
    placed = replace(
        model,
        model=there,
        estimate=estimate_of(station.parameters, values, of_arm),
        sensor_kind=rig.sensor,
        sigma=noise_like(model, rig.sensor, station.sensor.blocks),
    )
    few = Lineup.of(placed, station.select(np.arange(_ROWS)), Known.of(model))
    return replace(few, station=station.with_model(few.station.model))


def guarded_changes(
    lineup: Lineup, places: Conditions, notice: float, *, rng: np.random.Generator
) -> tuple[list[Guarded], list[Change]]:
    """Return the changes to be noticed, and those that new frames take up or that never are so large."""
    model = lineup.station.model
    poses, motion = model.linearise(model.own(lineup.start), places)
    sizes = np.where(np.isfinite(lineup.sizes), lineup.sizes, 0.0)
    motion = _without_frames(poses, motion) * sizes[: motion.shape[2]]
    guarded, absorbed = [], []
    for i, (change, at) in enumerate(zip(lineup.changes, lineup.places, strict=True)):
        if isinstance(change.effect, Curve) or change.belief is not None:
            continue
        ways = np.ones((1, 1)) if len(at) == 1 else rng.standard_normal((_WAYS, len(at)))
        farthest = np.linalg.norm(motion[:, :, at] @ ways.T, axis=1).max(axis=0)
        seen = farthest * _LARGEST >= notice * np.linalg.norm(ways, axis=1)
        if not seen.any():
            absorbed.append(change)
        strengths = np.linalg.svd(motion[:, :, at].reshape(-1, len(at)), compute_uv=False)
        rank = int(np.sum(strengths > _SEEN * strengths[0]))
        for way, far in zip(ways[seen], farthest[seen], strict=True):
            step = np.zeros(len(lineup.start))
            step[at] = sizes[at] * way * notice / far
            guarded.append(Guarded(i, step, rank))
    return guarded, absorbed


def _without_frames(poses: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Return motion of the target, shape (V, 3, P), less what placing base and target anew takes up."""
    points, n = poses[:, :, 3], len(poses)
    turned = np.cross(np.eye(3)[None], points[:, None]).transpose(0, 2, 1)
    frames = np.concatenate([np.tile(np.eye(3), (n, 1, 1)), turned, poses[:, :, :3]], axis=2).reshape(3 * n, -1)
    rows = motion.reshape(3 * n, -1)
    return np.asarray(rows - frames @ np.linalg.lstsq(frames, rows, rcond=1e-10)[0]).reshape(motion.shape)


def watch_of(lineup: Lineup, guarded: list[Guarded], *, alpha: float, power: float, degrees: float) -> Watch:
    """Return what the candidates tell of the changes that are to be noticed."""
    station = lineup.station
    A, _ = whitened(station, lineup.start, lineup.robot.sigma)
    m = sum(block.size for block in station.sensor.blocks)
    uncertain, own = spread(station, lineup.known, lineup.beside) @ A, A[lineup.own]
    own = own / np.sqrt(np.maximum(np.mean(own**2, axis=1, keepdims=True), 1e-300))
    rows = np.vstack([uncertain, own]).T.reshape(len(station), m, -1)
    return Watch(
        N=rows,
        G=(np.array([one.step for one in guarded]) @ A).T.reshape(len(station), m, -1),
        H=np.diag(np.append(np.ones(len(uncertain)), np.full(len(own), _NOTHING))),
        ranks=np.array([one.rank for one in guarded]),
        limit=limit_for(alpha, len(lineup.changes)),
        degrees=degrees - len(own),
        power=power,
    )
