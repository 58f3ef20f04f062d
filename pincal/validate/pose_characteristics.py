r"""Characteristics of ISO 9283 beside AP and RP that visits of poses tell, each with its 95 %
interval.

With r_j the attained minus the commanded position in visit j of n, D_j the distance of two attained
poses in their j-th visits, D_c that of the commanded ones, S a standard deviation with n - 1,

.. math:: AD = |\bar D - D_c|, \quad RD = 3 S_D, \quad
          vAP = \max_{h,k} |\bar r_h - \bar r_k|, \quad
          dAP = \max_{t,u} |AP_t - AP_u|, \quad dRP = \max_{t,u} |RP_t - RP_u|

(ISO 9283:1998, 7.2 to 7.5), with h, k the directions from which a pose was approached, t, u the
sessions in which it was visited. As with AP, the commanded pose is the prediction for the joint
positions that were read.

Intervals take scatter as normal and independent between visits. Where it is alike in all directions
they hold the truth in 92 to 98 % of cases; where one direction scatters three times as much as the
others in 84 to 99 %, and where all scatter is along one line and AP half of what it does to the
mean, in 73 % (``test_pose_characteristics.py`` holds a part of this). Intervals of means over poses
take the poses for a sample of those that matter, and leave out one pose at a time (jackknife), as
pairs of poses share poses. All figures hold the scatter of the visits: vAP, dAP and
dRP of a robot without any are about 1.5 times its standard deviation in the mean of the visits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import bdtrik, chdtri, fdtr, ncfdtr, stdtrit

from pincal.thresholds import Count, Scale
from pincal.validate.accuracy import position_accuracy
from pincal.validate.lack_of_fit import evenness, scatter_of

# Probability on either side of an interval.
_TAIL: Scale = 0.025
# Degrees of freedom of a standard deviation that varies as RP does, for each visit after the first:
# RP of n visits has the relative variance 0.25 / n if scatter is normal and alike in all directions
# (l_j then follows Maxwell's distribution, whose skewness is 0.486 and kurtosis 3.108).
_OF_REPEATABILITY: Scale = 2.0
# Noncentrality above which the length of a mean is normal.
_CLEAR: Scale = 40.0
# Pairs of poses whose distances are looked at, and the seed by which they are chosen.
_MOST_PAIRS: Count = 5000
_SEED: Count = 0

Interval = tuple[float, float]


@dataclass(frozen=True, eq=False)
class PoseVisits:
    """The visits of poses, one row each, of M rows.

    Attributes:
        residuals: shape (M, 3), attained minus commanded position [m].
        commanded: shape (M, 3) [m].
        pose: shape (M,), number of the pose.
        session: shape (M,), number of the session.
        side: shape (M, n), signs of the last moves of the joints; None where these are unknown.
    """

    residuals: np.ndarray
    commanded: np.ndarray
    pose: np.ndarray
    session: np.ndarray
    side: np.ndarray | None = None

    def of_poses(self) -> Iterator[np.ndarray]:
        """Yield the rows of each pose that was visited twice or more, in order."""
        for number in np.unique(self.pose):
            rows = np.flatnonzero(self.pose == number)
            if len(rows) > 1:
                yield rows


def accuracy_interval(residuals: np.ndarray) -> Interval:
    """Return the interval of the length of the mean of normal residuals, shape (n, 3) [m].

    The scatter along the mean counts, as it may differ between directions.

    Example:
        >>> visits = np.array([[1.0, 0.1, 0.0], [1.1, 0.0, 0.1], [0.9, 0.0, 0.0]])
        >>> low, high = accuracy_interval(visits)
        >>> 0.7 < low < 1.0 < high < 1.3
        True
    """
    n = len(residuals)
    mean = residuals.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length == 0.0:
        variance = float(residuals.var(axis=0, ddof=1).mean())
    else:
        variance = float((residuals @ mean / length).var(ddof=1))
    return _length_interval(mean, variance / n, n - 1)


def _length_interval(mean: np.ndarray, variance: float, degrees: int) -> Interval:
    """Return the interval of the length of a vector, shape (3,), of which each component has been
    estimated with a variance, itself estimated with so many degrees of freedom: by the noncentral F
    distribution.
    """
    length = float(np.linalg.norm(mean))
    if variance == 0.0:
        return length, length
    statistic = length**2 / (3.0 * variance)
    if length**2 / variance > _CLEAR:
        half = float(-stdtrit(degrees, _TAIL)) * variance**0.5
        return length - half, length + half

    def reached(tail: float) -> float:
        """Return the length at which a statistic as small has this probability."""
        if fdtr(3, degrees, statistic) <= tail:
            return 0.0
        most = 10.0
        while ncfdtr(3, degrees, most, statistic) > tail:
            most *= 1.5
        root = brentq(lambda nc: ncfdtr(3, degrees, nc, statistic) - tail, 0.0, most, xtol=1e-6)
        return float(np.sqrt(root * variance))

    return reached(1.0 - _TAIL), reached(_TAIL)


def deviation_interval(deviation: float, degrees: float) -> Interval:
    """Return the interval of what a standard deviation of normal values estimates.

    Example:
        >>> low, high = deviation_interval(1.0, 29)
        >>> round(low, 3), round(high, 3)
        (0.796, 1.344)
    """
    low, high = (degrees / chdtri(degrees, tail) for tail in (_TAIL, 1.0 - _TAIL))
    return float(deviation * low**0.5), float(deviation * high**0.5)


def repeatability_interval(residuals: np.ndarray) -> Interval:
    """Return the interval of the repeatability RP of normal residuals, shape (n, 3) [m]."""
    even = evenness(scatter_of(residuals.T, np.zeros(len(residuals), int)))
    degrees = _OF_REPEATABILITY * (len(residuals) - 1) * even
    return deviation_interval(_repeatability(residuals), degrees)


def quantile_interval(
    values: np.ndarray, part: float, *, independent: int | None = None
) -> tuple[float | None, float | None]:
    """Return the interval of a quantile by order statistics, whatever the distribution.

    Args:
        values: shape (N,).
        part: the quantile, such as 0.95.
        independent: how many of the values are independent; default: all.

    Returns:
        Its ends, None for one that so few values do not show.

    Example:
        >>> quantile_interval(np.arange(1.0, 74.0), 0.95)
        (65.0, 73.0)
        >>> quantile_interval(np.arange(1.0, 1001.0), 0.5)
        (469.0, 532.0)
    """
    n = len(values) if independent is None else independent
    in_order = np.sort(values)
    # At most so many of the values are below the quantile, but for the tail.
    fewest = int(np.floor(bdtrik(_TAIL, n, part)))
    most = int(np.ceil(bdtrik(1.0 - _TAIL, n, part)))

    def value(rank: int) -> float | None:
        if not 0 < rank <= n:
            return None
        return float(in_order[round((rank - 0.5) / n * len(values) - 0.5)])

    return value(fewest + 1 if fewest >= 0 else 0), value(most + 1)


def error_intervals(
    sizes: Mapping[str, np.ndarray], *, independent: int, shares: np.ndarray | None = None
) -> dict[str, tuple[float | None, float | None]]:
    """Return the intervals of the mean and of the 95th percentile of errors.

    Args:
        sizes: the errors by unit, shape (N,) each.
        independent: how many of them are independent.
        shares: weight of each error in the mean, shape (N,); default: 1.

    Returns:
        Ends by name, such as ``mean_mm`` and ``p95_mm``; None for one that is not determined.
    """
    found = dict[str, tuple[float | None, float | None]]()
    for unit, errors in sizes.items():
        if independent > 1:
            mean = float(np.average(errors, weights=shares))
            square = np.average((errors - mean) ** 2, weights=shares)
            deviation = np.sqrt(square * len(errors) / max(len(errors) - 1, 1))
            half = float(-stdtrit(independent - 1, _TAIL) * deviation / independent**0.5)
            found[f"mean_{unit}"] = (max(mean - half, 0.0), mean + half)
        found[f"p95_{unit}"] = quantile_interval(errors, 0.95, independent=independent)
    return found


def jackknife_interval(
    members: np.ndarray, statistic: Callable[[np.ndarray], float], n: int
) -> Interval | None:
    """Return the interval of a mean over poses, or over pairs of poses; None for fewer than three.

    Args:
        members: shape (V, k), the poses, numbered from 0, that each value involves.
        statistic: returns the mean of the values of a mask, shape (V,).
        n: number of poses.
    """
    if n < 3:
        return None
    everything = np.ones(len(members), bool)
    without = [statistic(~np.any(members == pose, axis=1)) for pose in range(n)]
    spread = np.sqrt((n - 1) / n * np.sum((np.array(without) - np.mean(without)) ** 2))
    middle = statistic(everything)
    half = float(-stdtrit(n - 1, _TAIL) * spread)
    return max(middle - half, 0.0), middle + half


def characteristics(visits: PoseVisits) -> dict[str, Any]:
    """Return what the visits tell, by name with unit.

    Returns:
        For each of ``AP_mm RP_mm AD_mm RD_mm vAP_mm dAP_mm dRP_mm``: "mean" over the poses or
        pairs, its "interval" (of AP and RP of a single pose by its visits; None for two poses, and
        for the others of fewer than three), "max", the number "of" poses or pairs and the least
        number of "cycles"; left out where the visits do not tell it.
    """
    poses = list(visits.of_poses())
    of = visits.residuals
    by_name: dict[str, Any] = {
        "AP_mm": _by_pose(poses, lambda rows: _accuracy(of[rows])),
        "RP_mm": _by_pose(poses, lambda rows: _repeatability(of[rows])),
        **_by_pair(visits, poses),
        "vAP_mm": _by_pose(poses, lambda rows: _directions(visits, rows)),
        "dAP_mm": _by_pose(poses, lambda rows: _drift(visits, rows, _accuracy)),
        "dRP_mm": _by_pose(poses, lambda rows: _drift(visits, rows, _repeatability)),
    }
    if len(poses) == 1:
        alone = {"AP_mm": accuracy_interval, "RP_mm": repeatability_interval}
        for name, interval in alone.items():
            by_name[name]["interval"] = [1e3 * end for end in interval(of[poses[0]])]
    return {name: found for name, found in by_name.items() if found is not None}


def _accuracy(residuals: np.ndarray) -> float:
    return position_accuracy(residuals.T)[0]


def _repeatability(residuals: np.ndarray) -> float:
    return position_accuracy(residuals.T)[1]


def _parts(labels: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
    """Return the rows of each label that two visits or more have."""
    of = labels[rows]
    parts = [rows[np.all(of == label, axis=1)] for label in np.unique(of, axis=0)]
    return [part for part in parts if len(part) > 1]


def _directions(visits: PoseVisits, rows: np.ndarray) -> float | None:
    """Return vAP of the visits of a pose [m]; None if all came from one direction."""
    if visits.side is None:
        return None
    # A joint whose side is unknown tells no direction.
    known = rows[np.any(visits.side[rows] != 0.0, axis=1)]
    means = [visits.residuals[part].mean(axis=0) for part in _parts(visits.side, known)]
    apart = [float(np.linalg.norm(a - b)) for a, b in combinations(means, 2)]
    return max(apart, default=None)


def _drift(
    visits: PoseVisits, rows: np.ndarray, figure: Callable[[np.ndarray], float]
) -> float | None:
    """Return by how much a figure of a pose differs between sessions; None for one session."""
    found = [figure(visits.residuals[part]) for part in _parts(visits.session[:, None], rows)]
    return max(found) - min(found) if len(found) > 1 else None


def _by_pose(
    poses: list[np.ndarray], figure: Callable[[np.ndarray], float | None]
) -> dict[str, Any] | None:
    found = [(figure(rows), len(rows)) for rows in poses]
    values = np.array([value for value, _ in found if value is not None])
    if not len(values):
        return None
    members = np.arange(len(values))[:, None]
    cycles = min(n for value, n in found if value is not None)
    return _entry(values, members, len(values), cycles)


def _by_pair(visits: PoseVisits, poses: list[np.ndarray]) -> dict[str, Any]:
    """Return AD and RD of the pairs of poses, their visits taken in order."""
    pairs = np.array(list(combinations(range(len(poses)), 2)))
    if not len(pairs):
        return {}
    if len(pairs) > _MOST_PAIRS:
        pairs = pairs[np.sort(np.random.default_rng(_SEED).permutation(len(pairs))[:_MOST_PAIRS])]
    accuracy = np.empty(len(pairs))
    repeatability = np.empty(len(pairs))
    for k, (one, other) in enumerate(pairs):
        n = min(len(poses[one]), len(poses[other]))
        a = poses[one][:n]
        b = poses[other][:n]
        commanded = visits.commanded[a] - visits.commanded[b]
        attained = commanded + visits.residuals[a] - visits.residuals[b]
        error = np.linalg.norm(attained, axis=1) - np.linalg.norm(commanded, axis=1)
        accuracy[k] = abs(error.mean())
        repeatability[k] = 3.0 * error.std(ddof=1)
    cycles = min(map(len, poses))
    return {
        "AD_mm": _entry(accuracy, pairs, len(poses), cycles),
        "RD_mm": _entry(repeatability, pairs, len(poses), cycles),
    }


def _entry(values: np.ndarray, members: np.ndarray, n: int, cycles: int) -> dict[str, Any]:
    """Return the summary of values [m] in mm."""
    interval = jackknife_interval(members, lambda some: float(np.mean(values[some])), n)
    return {
        "mean": 1e3 * float(values.mean()),
        "interval": None if interval is None else [1e3 * end for end in interval],
        "max": 1e3 * float(values.max()),
        "of": len(values),
        "cycles": cycles,
    }


def interval_words(intervals: Mapping[str, tuple[float | None, float | None]]) -> str:
    """Return the intervals of errors in words.

    Example:
        >>> interval_words({"mean_mm": (0.08, 0.1), "p95_mm": (0.15, None)})
        '95 % intervals: mean 0.0800 to 0.1000 mm; 95th percentile above 0.1500 mm'
    """
    words = []
    for name, (low, high) in intervals.items():
        statistic, unit = name.split("_", 1)
        label = {"mean": "mean", "p95": "95th percentile"}[statistic]
        if low is not None and high is not None:
            words.append(f"{label} {low:.4f} to {high:.4f} {unit}")
        elif low is not None:
            words.append(f"{label} above {low:.4f} {unit}")
    return f"95 % intervals: {'; '.join(words)}" if words else "too few rows for intervals"
