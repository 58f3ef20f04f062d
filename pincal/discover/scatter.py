"""Scatter of one joint: what moves it from pose to pose but stands in no column."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pincal.discover.levers import levers
from pincal.identify.fit import Fit
from pincal.identify.normal import block_rows
from pincal.identify.station import Station

# Twice the log-likelihood that scatter of a joint has to gain: 5 standard deviations of one parameter, so that none of a
# robot's joints gets there by chance (test_scatter.py: neither noise nor several targets do, 50 urad do).
_ENOUGH = 25.0
# Candidate variances of the joint, in units of the noise seen at the joint's mean lever.
_RATIOS = np.logspace(-2, 3, 101)


@dataclass(frozen=True)
class Scatter:
    """A joint that is somewhere else each time.

    Attributes:
        joint: its name.
        sigma: standard deviation of its position [rad or m].
        gain: twice the log-likelihood gained.
    """

    joint: str
    sigma: float
    gain: float


def find_scatter(fit: Fit) -> Scatter | None:
    """Return the joint whose scatter explains the residuals best, if it explains enough.

    Along the lever of joint j at visit i, of length a_ij, the variance is sigma^2 + s_j^2 a_ij^2, and sigma^2 across it: a
    variance component, estimated by maximum likelihood with sigma^2 profiled out. What is read in one visit, several targets
    or the points of an image, shares the joint's position.
    """
    visit = visits(fit.station)
    found = [_of_joint(fit, i, visit) for i in range(fit.model.chain.robot.n_joints)]
    best = max(found, key=lambda scatter: scatter.gain)
    return best if best.gain > _ENOUGH else None


def visits(problem: Station) -> np.ndarray:
    """Return the visit that each row belongs to, shape (N,).

    Rows of the same joint positions are one visit, unless they read the same thing again.
    """
    pose = np.unique(np.round(problem.conditions.q, 9), axis=0, return_inverse=True)[1].ravel()
    point = problem.sensor.groups
    read = np.column_stack([pose, problem.conditions.target, np.zeros(len(pose), int) if point is None else point])
    _, thing, count = np.unique(read, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(thing.ravel(), kind="stable")
    again = np.empty(len(pose), int)
    again[order] = np.arange(len(pose)) - np.repeat(np.cumsum(count) - count, count)
    return np.unique(np.column_stack([pose, again]), axis=0, return_inverse=True)[1].ravel()


def _of_joint(fit: Fit, i: int, visit: np.ndarray) -> Scatter:
    rows = block_rows(fit.station)[0]
    residuals = fit.station.residuals(fit.values)[rows] * fit.station.weights
    lever = levers(fit, (int(fit.model.chain.drives[i]),))[0][rows] * fit.station.weights
    sound = fit.solution.weights > 0.0
    r, a = residuals[:, sound], lever[:, sound]
    a2 = np.bincount(visit[sound], np.sum(a**2, axis=0))
    along2 = np.bincount(visit[sound], np.sum(r * a, axis=0)) ** 2 / np.maximum(a2, 1e-300)
    across2 = float(np.sum(r**2) - np.sum(along2))
    readings = r.size

    def likelihood(ratio: np.ndarray) -> np.ndarray:
        spread = 1.0 + np.outer(ratio, a2 / np.mean(a2))
        sigma2 = (across2 + np.sum(along2 / spread, axis=1)) / readings
        return np.asarray(-readings * np.log(sigma2) - np.sum(np.log(spread), axis=1))

    gains = likelihood(_RATIOS) - likelihood(np.zeros(1))
    best = int(np.argmax(gains))
    spread = 1.0 + _RATIOS[best] * a2 / np.mean(a2)
    sigma2 = (across2 + np.sum(along2 / spread)) / readings
    sigma = float(np.sqrt(_RATIOS[best] * sigma2 / np.mean(a2)))
    return Scatter(fit.model.chain.robot.joint_names[i], sigma, float(max(gains[best], 0.0)))
