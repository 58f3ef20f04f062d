r"""Path accuracy and path repeatability by ISO 9283 of an arm that drives one path n times.

With x_c(s) the commanded path, and x_j(s) where cycle j crosses the plane through x_c(s)
perpendicular to the path,

.. math:: AT_p = \max_s |\bar x(s) - x_c(s)|, \quad RT_p = \max_s \, (\bar l(s) + 3 S_l(s)), \quad
          AT_a = \max_s |\bar a(s) - a_c(s)|, \quad RT_a = \max_s \, 3 S_a(s)

(ISO 9283:1998, 8.2 and 8.3; l_j is the distance of cycle j from the mean of all, S with n - 1; a,
b, c turn about x, y, z). As with poses, the commanded path is the model's prediction for the joint
positions that were read. A single cycle has accuracy only, which includes the noise of the
instrument.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.thresholds import Count
from pincal.validate.validation_numbers import PATHS

CYCLES_OF_PATH: Count = 10
"""Cycles of a path that ISO 9283 requires."""

# Largest numbers of time steps and of moments in the search for cycles, and steps that count as
# one.
_STEPS: Count = 20_000
_ASKED: Count = 1_000
_BESIDE: Count = 4


def path_accuracy(
    station: Station, values: np.ndarray, table: Measurements
) -> dict[str, Any] | None:
    """Return accuracy and repeatability along the path of a session in motion.

    Args:
        station: a model over the rows.
        values: shape (P,), its parameters.
        table: the rows.

    Returns:
        Number of cycles and of points of the path, ``AT_mm`` and, for poses, ``AT_a_mrad``,
        ``AT_b_mrad``, ``AT_c_mrad``;
            for more than one cycle also ``RT_mm`` and so on. None for held poses, or where no
            position is measured.
    """
    if table.moving is None or table.time is None or not station.sensor.reads_pose:
        return None
    order = np.argsort(table.time, kind="stable")
    of_model, _ = station.split(values)
    path = station.model.predict(of_model, station.conditions)[order, :, 3]
    return along_path(table.time[order], table.q[order], path, station.residuals(values)[:, order])


def along_path(
    time: np.ndarray, q: np.ndarray, path: np.ndarray, residuals: np.ndarray
) -> dict[str, Any]:
    """Return the result of :func:`path_accuracy`.

    Args:
        time: shape (N,), increasing [s].
        q: joint positions, shape (N, n).
        path: commanded positions, shape (N, 3) [m].
        residuals: attained minus commanded position [m], shape (3, N), or pose [m, rad], shape (6,
            N).
    """
    way = np.gradient(path, time, axis=0)
    speed = np.linalg.norm(way, axis=1, keepdims=True)
    # An arm that stands still has no direction.
    way /= np.maximum(speed, max(PATHS.slow * float(np.median(speed)), 1e-12))
    off = residuals.T.copy()
    off[:, :3] -= way * np.sum(off[:, :3] * way, axis=1, keepdims=True)
    begin, period, n = cycles_of(time, q)
    cycles = off[None]
    if n > 1:
        points = round(period / float(np.median(np.diff(time))))
        along = begin + period * np.arange(points) / points
        at = along[along + (n - 1) * period <= time[-1]] + period * np.arange(n)[:, None]
        cycles = np.stack([np.interp(at, time, component) for component in off.T], axis=2)
    mean = cycles.mean(axis=0)
    found: dict[str, Any] = {"cycles": n, "points": len(mean), "standard": CYCLES_OF_PATH}
    found |= {"AT_mm": 1e3 * float(np.linalg.norm(mean[:, :3], axis=1).max())}
    found |= {
        f"AT_{a}_mrad": 1e3 * float(np.abs(of).max())
        for a, of in zip("abc", mean[:, 3:].T, strict=False)
    }
    if n > 1:
        distance = np.linalg.norm(cycles[:, :, :3] - mean[:, :3], axis=2)
        found |= {
            "RT_mm": 1e3 * float((distance.mean(axis=0) + 3.0 * distance.std(axis=0, ddof=1)).max())
        }
        spread = 3e3 * cycles[:, :, 3:].std(axis=0, ddof=1).T
        found |= {f"RT_{a}_mrad": float(of.max()) for a, of in zip("abc", spread, strict=False)}
    return found


def cycles_of(time: np.ndarray, q: np.ndarray) -> tuple[float, float, int]:
    """Return start [s], period [s] and number of the cycles of joint positions, shape (N, n).

    Before and after, the arm may do something else. Without repetition the whole time is one cycle.
    """
    from scipy.spatial import KDTree

    count = min(len(time), _STEPS)
    even, step = np.linspace(time[0], time[-1], count, retstep=True)
    once = float(time[0]), float(time[-1] - time[0]), 1
    z = np.stack([np.interp(even, time, joint) for joint in q.T])
    near = PATHS.same * float(np.sqrt(z.var(axis=1).sum()))
    # Lags after which the joints are back at their positions at some moments.
    asked = np.arange(0, count, max(count // _ASKED, 1))
    found = KDTree(z.T).query_ball_point(z.T[asked], near) if near else np.empty(0, object)
    lags = np.concatenate(
        [np.asarray(hits) - i for hits, i in zip(found, asked, strict=False)] or [np.zeros(0, int)]
    )
    lag = _shortest_common(lags, count)
    if lag is None:
        return once
    period = float(step) * lag
    later = np.stack([np.interp(even + period, even, joint) for joint in z])
    same = (np.sum((later - z) ** 2, axis=0) < near**2) & (even + period <= even[-1])
    if not same.any():
        return once
    start, end = _longest_run(same)
    n = 1 + int((end - start) * step / period + PATHS.short)
    return (float(even[start]), period, n) if n > 1 else once


def _shortest_common(lags: np.ndarray, count: int) -> float | None:
    """Return the first lag [steps] after which the arm is often back, of ``count`` steps; None if
    it never is after having moved away.
    """
    often = np.convolve(
        np.bincount(lags[lags > 0], minlength=count), np.ones(2 * _BESIDE + 1), "same"
    )
    away = int(np.argmin(often))
    if not often[away:].any():
        return None
    first = away + int(np.argmax(often[away:] > PATHS.often * often[away:].max()))
    most = first + int(np.argmax(often[first : first + 4 * _BESIDE]))
    return float(np.mean(lags[np.abs(lags - most) <= 2 * _BESIDE]))


def _longest_run(holds: np.ndarray) -> tuple[int, int]:
    """Return start and end of the longest run of rows for which something holds, shape (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(int)))
    longest = int(np.argmax(edges[1::2] - edges[::2]))
    return int(edges[2 * longest]), int(edges[2 * longest + 1])


def path_words(found: dict[str, Any]) -> str:
    """Return accuracy and repeatability in words.

    Example:
        >>> found = {"cycles": 1, "points": 9, "standard": 10, "AT_mm": 0.25}
        >>> for part in path_words(found).split(": "):
        ...     print(part)
        AT 0.2500 mm; one cycle, the noise of the instrument included
        repeat the path, ISO 9283 specifies 10 cycles
    """
    parts = {name: name.rsplit("_", 1) for name in found if name.startswith(("AT_", "RT_"))}
    sizes = [
        f"{of.replace('_', ' ')} {found[name]:.4f} {unit}" for name, (of, unit) in parts.items()
    ]
    n = found["cycles"]
    asked = found["standard"]
    rest = (
        "one cycle, the noise of the instrument included: repeat the path, ISO 9283 "
        f"specifies {asked} cycles"
    )
    if n > 1:
        rest = f"{n} cycles" + (f"; ISO 9283 specifies {asked}" if n < asked else "")
    return f"{', '.join(sizes)}; {rest}"
