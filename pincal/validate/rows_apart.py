"""What rows that do not fit the others have in common: a place in the table, a region, a joint that was read wrong."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pincal.identify.station import Station
from pincal.measure.measurements import Measurements

# Part of the squares that a joint read wrong has to explain to be named.
_EXPLAINED = 0.8
# Rows that a region may tell wrongly, as a part of those that are apart.
_MISTOLD = 0.3
# Difference [rad or m] by which joints are moved for a derivative.
_MOVED = 1e-5


def in_common(station: Station, values: np.ndarray, table: Measurements, apart: np.ndarray) -> str:
    """Return what rows that do not fit have in common, in words; empty if nothing is found.

    Args:
        station: the calibrated model over all rows.
        values: shape (P,), of its parameters.
        table: the rows.
        apart: shape (N,), which do not fit.
    """
    for name, unit, feature in _features(table):
        for word, inside in _halves(feature, apart):
            if (inside == apart).mean() >= 1.0 - _MISTOLD * min(float(apart.mean()), 0.5):
                end = feature[inside].min() if word == "at least" else feature[inside].max()
                return f"nearly all of them have {name} {word} {end:.6g}{unit}"
    off = station.displacements(values)[apart]
    squares = float(np.sum(off**2))
    explained = []
    for j, name in enumerate(table.joint_names):
        along = _moved_by(station, values, j)[apart]
        angle = float(np.sum(off * along) / max(float(np.sum(along**2)), 1e-300))
        explained.append((1.0 - float(np.sum((off - along * angle) ** 2)) / squares, name, angle, j))
    share, name, angle, j = max(explained)
    if share < _EXPLAINED:
        return ""
    unit = "mm" if station.model.chain.robot.joint_units[j] == "m" else "mrad"
    return f"{name} looks read {abs(angle) * 1e3:.3g} {unit} wrong in them"


def _features(table: Measurements) -> Iterator[tuple[str, str, np.ndarray]]:
    yield "line", "", table.rows.astype(float)
    if table.time is not None:
        yield "time", " s", table.time
    for name, q in zip(table.joint_names, table.q.T, strict=True):
        yield name, "", q
    for name, unit, column in (("payload", " kg", table.payload), ("temperature", " deg C", table.temperature)):
        if column is not None:
            yield name, unit, column


def _halves(feature: np.ndarray, apart: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the rows above and below the value that tells those that are apart best."""
    order = np.argsort(feature, kind="stable")
    wrong = np.cumsum(apart[order])
    n, total = len(apart), int(apart.sum())
    ends = np.flatnonzero(np.append(np.diff(feature[order]) > 0, False))
    if not len(ends):
        return
    below = wrong[ends] + (n - (ends + 1)) - (total - wrong[ends])
    k = int(ends[np.argmax(below)])
    yield "at most", feature <= feature[order][k]
    k = int(ends[np.argmin(below)])
    yield "at least", feature > feature[order][k]


def _moved_by(station: Station, values: np.ndarray, joint: int) -> np.ndarray:
    """Return how each target moves with a joint, shape (N, 3) [m/rad or m/m], as far as its reading tells."""
    of_model, own = station.split(values)
    q = station.conditions.q.copy()
    q[:, joint] += _MOVED
    poses = station.model.predict(of_model, station.conditions)
    moved = station.model.predict(of_model, replace(station.conditions, q=q))
    sensor = station.sensor
    ends = [sensor.displacement(sensor.residuals(at, own), at, own) for at in (poses, moved)]
    return np.asarray(ends[0] - ends[1]) / _MOVED
