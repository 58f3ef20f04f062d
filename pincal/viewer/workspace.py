"""Poses that spread evenly over the places that an arm reaches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pincal.calibration.calibrated import CalibratedModel
from pincal.model.effects import Conditions

# Random poses per place: enough that hardly a cell of the grid is missed.
_DRAWS = 40
_MOST_DRAWS = 400_000
_PIECE = 20_000
# Halvings of the interval in which the size of a cell is looked for.
_HALVINGS = 16


def workspace_poses(
    calibrated: CalibratedModel, places: int, *, payload: float, known: dict[str, float], seed: int
) -> np.ndarray:
    """Return joint positions that reach about ``places`` cells of a regular grid, one pose per cell.

    Args:
        calibrated: the robot; poses lie within the joint range that its calibration covered.
        places: about how many cells.
        payload: mass at the tip [kg].
        known: temperature [deg C] and time [s], where the model needs them.
        seed: of the random poses from which those nearest to the cells' centres are taken.

    Returns:
        Shape (about ``places``, n) [rad or m].
    """
    rng = np.random.default_rng(seed)
    lower, upper = calibrated.covered.q.T
    q = rng.uniform(lower, upper, (min(_DRAWS * places, max(_MOST_DRAWS, places)), len(lower)))
    q = calibrated.model.chain.robot.following(q)
    pieces = (at_conditions(q[i : i + _PIECE], calibrated, payload, known) for i in range(0, len(q), _PIECE))
    reached = np.concatenate([calibrated.predict(piece)[:, :, 3] for piece in pieces])
    size = _cell_size(reached, places)
    off_centre = np.linalg.norm(reached - np.round(reached / size) * size, axis=1)
    order = np.argsort(off_centre, kind="stable")
    _, first = np.unique(_cells(reached[order], size), return_index=True)
    return np.asarray(q[order[first]])


def at_conditions(q: np.ndarray, calibrated: CalibratedModel, payload: float, known: dict[str, float]) -> Conditions:
    """Return the conditions of joint positions, shape (N, n), that share payload [kg], temperature and time."""
    plain = Conditions.at(q, payload=payload, payload_centre=calibrated.payload_centre)
    columns = {name: np.full(len(q), value) for name, value in known.items()}
    # How joints arrived is unknown: 0, as for a table that does not tell; and they stand as they are commanded.
    unknown = np.zeros(q.shape)
    return replace(plain, approach=unknown, move=unknown, droop=unknown, **columns)


def _cell_size(reached: np.ndarray, places: int) -> float:
    """Return the size of a cell [m] at which about ``places`` of them are reached."""
    extent = float(np.ptp(reached, axis=0).max())
    if extent == 0.0:
        return 1.0
    low, high = extent / 1e3, 2.0 * extent
    for _ in range(_HALVINGS):
        size = float(np.sqrt(low * high))
        count = len(np.unique(_cells(reached, size)))
        low, high = (size, high) if count > places else (low, size)
    return high


def _cells(points: np.ndarray, size: float) -> np.ndarray:
    """Return the number of each point's cell, shape (N,)."""
    steps = np.round(points / size).astype(np.int64)
    steps -= steps.min(axis=0)
    return np.asarray(np.ravel_multi_index(tuple(steps.T), tuple(steps.max(axis=0) + 1)))
