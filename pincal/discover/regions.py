"""Where in the workspace, and along which direction, a disagreement shows more than elsewhere."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pincal.identify.fit import Fit
from pincal.io.discovery_file import Disagreement

# Chance that sound data show a range of the workspace, and shuffles by which it is judged: three of them lie beyond it.
_ALPHA, _SHUFFLES = 0.01, 300
# Part of the excess that a direction has to hold, and standard deviations that it has to be above the noise.
_POINTED, _SURE = 0.55, 4.0


def regions_of(fit: Fit, left: np.ndarray, expected: float) -> Iterator[Disagreement]:
    """Yield the range of reach or height and the direction in which what is left of positions is concentrated.

    Args:
        fit: the fit.
        left: shape (3, N), whitened residuals in the frame of the instrument.
        expected: what the noise makes of the squares of a row.
    """
    robot, gravity = fit.model.chain.robot, fit.model.chain.gravity
    # A row's part of the excess: its squares less what the noise makes of them.
    energy = np.sum(left**2, axis=0) - expected
    if energy.sum() <= 0.0:
        return
    up = -gravity / np.linalg.norm(gravity)
    away = robot.forward_kinematics(fit.station.conditions.q)[:, :3, 3] - robot.frames.T_base_first[:3, 3]
    first = robot.joint_names[0]
    ranges = ("reach", f"from {first}", np.linalg.norm(away, axis=1)), ("height", f"above {first}", away @ up)
    found = [region for name, where, x in ranges for region in _thickest(name, where, x, energy)]
    if found:
        yield max(found, key=lambda region: region.share)
    yield from _direction(fit.model.chain.base_rotation.T @ left, away, up, expected)


def _thickest(name: str, where: str, x: np.ndarray, energy: np.ndarray) -> Iterator[Disagreement]:
    """Yield the third of the rows, neighbours in x [m], with most of the excess, if chance does not make as much."""
    order = np.argsort(x, kind="stable")
    third = max(len(x) // 3, 1)

    def sums(rows: np.ndarray) -> np.ndarray:
        total = np.cumsum(np.concatenate([np.zeros((*rows.shape[:-1], 1)), rows], axis=-1), axis=-1)
        return np.asarray(total[..., third:] - total[..., :-third])

    found = sums(energy[order])
    shuffled = np.random.default_rng(0).permuted(np.tile(energy, (_SHUFFLES, 1)), axis=1)
    if np.mean(sums(shuffled).max(axis=1) >= found.max()) > _ALPHA:
        return
    inside = order[np.argmax(found) :][:third]
    span = f"{x[inside].min():.2f} to {x[inside].max():.2f} m"
    statement = f"it shows where the tip is {span} {where}, in {100 * third / len(x):.0f} % of the poses"
    yield Disagreement(statement, min(float(energy[inside].sum() / energy.sum()), 1.0), region=f"{name} {span}")


def _direction(left: np.ndarray, away: np.ndarray, up: np.ndarray, expected: float) -> Iterator[Disagreement]:
    """Yield the direction in which more than half of the excess points, if there is one.

    Args:
        left: shape (3, N), whitened residuals in the base frame.
        away: shape (N, 3), the tip from the origin of the first joint [m].
        up: shape (3,), against gravity.
        expected: what the noise makes of the squares of a row.
    """
    outward = away - np.outer(away @ up, up)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    parts = {
        "vertical": up @ left,
        "radial": np.sum(outward.T * left, axis=0),
        "tangential": np.sum(np.cross(up, outward).T * left, axis=0),
    }
    excess = {name: float(np.sum(part**2) - len(part) * expected / 3.0) for name, part in parts.items()}
    name = max(excess, key=lambda key: excess[key])
    whole = sum(max(value, 0.0) for value in excess.values())
    # A sum of squares of N numbers scatters by the root of 2 N.
    if excess[name] >= _POINTED * whole and excess[name] >= _SURE * np.sqrt(2.0 * left.shape[1]):
        direction = f"{name} direction"
        statement = f"the error points in the {direction} (a third would be even)"
        yield Disagreement(statement, excess[name] / whole, region=direction)
