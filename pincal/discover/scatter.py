"""Scatter of one joint: what moves it from pose to pose but stands in no column."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pincal.discover.levers import levers
from pincal.identify.fit import Fit
from pincal.identify.normal import block_rows
from pincal.identify.station import Station
from pincal.io.discovery_file import ScatteringJoint

# Twice the log-likelihood that scatter of a joint has to gain: 5 standard deviations of one parameter, so that none of a
# robot's joints gets there by chance (test_scatter.py: neither noise nor several targets do, 50 urad do).
_ENOUGH = 25.0
# Candidate variances of the joint, in units of the noise seen at the joint's mean lever.
_RATIOS = np.logspace(-2, 3, 101)


def find_scatter(fit: Fit) -> ScatteringJoint | None:
    """Return the joint whose scatter explains the residuals best, if it explains enough.

    Along the lever of joint j at visit i, of length a_ij, the variance is sigma^2 + s_j^2 a_ij^2, and sigma^2 across it: a
    variance component, estimated by maximum likelihood with sigma^2 profiled out. What is read in one visit, several targets
    or the points of an image, shares the joint's position.
    """
    found = [(*one, alone) for alone in fit.alone for one in _scatters(alone)]
    gain, sigma, joint, alone = max(found, key=lambda one: one[0])
    if gain <= _ENOUGH:
        return None
    conditions, missing = alone.station.conditions, "time"
    if conditions.approach is None:
        missing = f"approach_{joint}"
    elif conditions.temperature is None:
        missing = "temperature"
    return ScatteringJoint(joint, sigma, missing)


def _scatters(fit: Fit) -> Iterator[tuple[float, float, str]]:
    """Yield the gain and the standard deviation of the scatter of each joint at the only station, and the joint."""
    chain, rows = fit.model.chain, block_rows(fit.station)[0]
    sound = fit.solution.weights > 0.0
    weights, visit = fit.station.weights[sound], visits(fit.station)[sound]
    residuals = fit.station.residuals(fit.values)[rows, sound] * weights
    moved = levers(fit, tuple(map(int, chain.drives)))[:, rows, sound] * weights
    for joint, lever in zip(chain.robot.joint_names, moved, strict=True):
        yield *_scatter_along(lever, residuals, visit), joint


def visits(station: Station) -> np.ndarray:
    """Return the visit that each row belongs to, shape (N,).

    Rows of the same joint positions are one visit, unless they read the same thing again.
    """
    pose = np.unique(np.round(station.conditions.q, 9), axis=0, return_inverse=True)[1].ravel()
    point = station.sensor.groups
    read = np.column_stack([pose, station.conditions.target, np.zeros(len(pose), int) if point is None else point])
    _, thing, count = np.unique(read, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(thing.ravel(), kind="stable")
    again = np.empty(len(pose), int)
    again[order] = np.arange(len(pose)) - np.repeat(np.cumsum(count) - count, count)
    return np.unique(np.column_stack([pose, again]), axis=0, return_inverse=True)[1].ravel()


def _scatter_along(lever: np.ndarray, residuals: np.ndarray, visit: np.ndarray) -> tuple[float, float]:
    """Return twice the log-likelihood that scatter along a lever gains, and its standard deviation [rad or m].

    Args:
        lever: shape (size, N), of the first block of readings.
        residuals: shape (size, N).
        visit: shape (N,), the visit of each row.
    """
    a2 = np.bincount(visit, np.sum(lever**2, axis=0))
    along2 = np.bincount(visit, np.sum(residuals * lever, axis=0)) ** 2 / np.maximum(a2, 1e-300)
    across2, readings = float(np.sum(residuals**2) - np.sum(along2)), residuals.size
    # In the first row without any scatter.
    ratios = np.concatenate([[0.0], _RATIOS])
    spread = 1.0 + np.outer(ratios, a2 / np.mean(a2))
    sigma2 = (across2 + np.sum(along2 / spread, axis=1)) / readings
    likelihood = -readings * np.log(sigma2) - np.sum(np.log(spread), axis=1)
    best = 1 + int(np.argmax(likelihood[1:]))
    gain = float(likelihood[best] - likelihood[0])
    return max(gain, 0.0), float(np.sqrt(ratios[best] * sigma2[best] / np.mean(a2)))
