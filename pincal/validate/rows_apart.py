"""What rows that do not fit the others have in common: a place in the table, a region, a joint that was read wrong."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.measure.rows import some_rows

# Fewest rows on either side of a step.
_EACH = 10
# A residual counts as no more than so many times the typical one: single wrong readings make no step.
_CLIPPED = 5.0
# The least statistic of a step. Simulated machines have up to 12, real arms measured along a grid 31.
_STEP = 45.0
# A step has to explain so much more than a drift: one in the middle explains a third more, a drift looks a quarter less.
_NO_DRIFT = 1.15
# Part of the squares that a joint read wrong has to explain to be named.
_EXPLAINED = 0.8
# Rows that a region may tell wrongly, as a part of those that are apart.
_MISTOLD = 0.3
# Rows that show whether there is a step, and those that show where; more add nothing but time.
_FEW, _MOST = 400, 4000
# Directions of the fitted parameters that are weaker than this part of the strongest are none.
_RANK = 1e-5
# Functions of a curve that follow a shift by themselves; of more, neighbours do together, as the curve is smooth: the few
# rows would not tell so many apart, nor leave anything of a step.
_FUNCTIONS = 24
# Difference [rad or m] by which joints are moved for a derivative.
_MOVED = 1e-5


@dataclass(frozen=True)
class Step:
    """A place in a table from which on all readings are shifted.

    Attributes:
        line: of the first row that is shifted.
        size: how far [m].
    """

    line: int
    size: float


def step_in(station: Station, values: np.ndarray, free: np.ndarray, lines: np.ndarray) -> Step | None:
    """Return where, in the order of the rows, the instrument or the target was moved; None if it was not.

    A shift from some row on is one more parameter in each direction; what the fitted ones make of it is projected out. Rows
    next to each other are often poses next to each other, which a model misses alike: the variance that a shift is compared
    with is that of means of neighbours.

    Args:
        station: the calibrated model over the rows.
        values: shape (P,), of its parameters.
        free: shape (P,), which of them were fitted.
        lines: shape (N,), line of each row.
    """
    order = np.argsort(lines, kind="stable")
    if not station.sensor.reads_pose or len(order) < 4 * _EACH:
        return None
    found = None
    for most in (_FEW, _MOST):
        taken = order[some_rows(len(order), most)]
        # Which way rows moved is a matter of the readings as they are.
        found = _step(replace(station.select(taken), whitening=None, serial=None), values, free, lines[taken])
        if found is None or len(taken) == len(order):
            break
    return found


def _step(station: Station, values: np.ndarray, free: np.ndarray, lines: np.ndarray) -> Step | None:
    """Return the step in rows that stand in order."""
    n = len(lines)
    # Components of a row next to each other, shape (3 N, columns).
    parts = (jacobian.columns(_FUNCTIONS, slice(3)) for _, _, jacobian in station.linearise_shared(values, free))
    J = np.concatenate([part.transpose(2, 1, 0) for part in parts]).reshape(3 * n, -1)
    J = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    sizes, axes = np.linalg.eigh(J.T @ J)
    kept = sizes > _RANK**2 * sizes[-1]
    Q = J @ (axes[:, kept] / np.sqrt(sizes[kept]))
    off = station.displacements(values)
    long = np.linalg.norm(off, axis=1, keepdims=True)
    off = (off * np.minimum(1.0, _CLIPPED * np.median(long) / np.maximum(long, 1e-300))).ravel()
    off = (off - Q @ (Q.T @ off)).reshape(n, 3)
    Q = Q.reshape(n, 3, -1)
    after = np.arange(n)[::-1] + 1.0
    gains, moves = _gains(np.cumsum(off[::-1], axis=0)[::-1], np.cumsum(Q[::-1], axis=0)[::-1], after)
    inner = slice(_EACH, n - _EACH)
    at = _EACH + int(np.argmax(gains[inner]))
    ramp = np.linspace(-1.0, 1.0, n)
    drift = _gains((ramp @ off)[None], np.einsum("i,iab->ab", ramp, Q)[None], np.array([np.sum(ramp**2)]))[0][0]
    shift = np.where(np.arange(n)[:, None] >= at, moves[at], 0.0).ravel()
    flat = Q.reshape(3 * n, -1)
    left = off - (shift - flat @ (flat.T @ shift)).reshape(n, 3)
    width = int(np.sqrt(n))
    means = left[: n // width * width].reshape(-1, width, 3).mean(axis=1)
    variance = max(width * float(np.mean(means**2)), float(np.mean(left**2)))
    if gains[at] < _STEP * variance or gains[at] < _NO_DRIFT * drift:
        return None
    return Step(int(lines[at]), float(np.linalg.norm(moves[at])))


def _gains(sums: np.ndarray, parts: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much motions reduce the sum of squares, shape (K,), and how far they go, shape (K, 3).

    Args:
        sums: shape (K, 3), products of each motion with the residuals.
        parts: shape (K, 3, r), its products with directions that are fitted anyway.
        weights: shape (K,), its own sum of squares.
    """
    normal = weights[:, None, None] * np.eye(3) - parts @ parts.transpose(0, 2, 1)
    # A motion that the fitted directions make themselves tells nothing.
    normal = normal + _RANK * weights[:, None, None] * np.eye(3)
    moves = np.linalg.solve(normal, sums[:, :, None])[:, :, 0]
    return np.sum(moves * sums, axis=1), moves


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
