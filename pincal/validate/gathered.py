"""Whether errors cluster: wrong readings occur anywhere, errors of a robot in one place.

Rejected rows that are neighbours in the positions of a joint, or in the order of the rows, are
counted in windows from one of them to another. The probability that as many of all rejected rows
fall into a window of so many rows is at most binomial; all windows are accounted for (Bonferroni).
It is a scan statistic: Kulldorff 1997, Commun. Stat. 26, 1481-1496.

A bump of a drive, which need not make outliers, displaces the targets of all poses in a narrow
window of its joint: the errors along the joint's lever have one sign there. The mean of each such
window, each row clipped so that a few wrong readings do not make one, is compared with all other
windows of that width: a model error everywhere makes these larger, too, and is no bump.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import bdtrc, stdtr

from pincal.identify.motion_fields import MotionField, fields_of_joints
from pincal.identify.station import Station
from pincal.measure.measurements import Measurements
from pincal.measure.poses import SCATTER, same_joints
from pincal.thresholds import Count, Scale
from pincal.validate.gathering_numbers import GATHERED

# Outliers up to which all windows are tested.
_MOST: Count = 200
# Ratio of consecutive widths of windows.
_WIDER: Scale = 1.4
# Permutations that determine how likely a bump is, the fewest after which one is clearly none, how
# much more likely than the limit it then is, and errors whose windows are computed at once.
_ORDERS: Count = 200
_FIRST_ORDERS: Count = 25
_CLEARLY: Scale = 5.0
_AT_ONCE: Count = 25_000
# Windows of a width whose median stands for all of them, over those that do not overlap: neighbours
# share most of their rows.
_OVERLAPPING: Count = 4
# Standard deviation over the median absolute error, for normal noise.
_NORMAL: Scale = 1.4826


@dataclass(frozen=True)
class Gathering:
    """A cluster of rows with errors.

    Attributes:
        rows: the rows of the station.
        among: number of rows there, rejected or not.
        variable: name of the joint along whose positions they cluster, "line" for the order of the
            rows.
        low, high: its range [rad or m; line].
        p_value: probability of as many outliers in any such place.
        size: mean error of the joint there [rad or m]; None for outliers.
    """

    rows: np.ndarray
    among: int
    variable: str
    low: float
    high: float
    p_value: float
    size: float | None = None


def gathering_of(station: Station, rejected: np.ndarray) -> Gathering | None:
    """Return the most significant cluster of rejected rows, a mask of shape (N,); None if they may
    lie anywhere.
    """
    if station.conditions.are_of_motion:
        # A moving arm passes a place within a moment: consecutive wrong readings there are one.
        rejected = rejected & ~np.append(False, rejected[:-1])
    if not GATHERED.fewest <= np.count_nonzero(rejected) <= min(_MOST, len(rejected) // 2):
        return None
    names = (*station.model.chain.robot.joint_names, "line")
    order = np.arange(len(rejected), dtype=float) if station.position is None else station.position
    features = [*station.conditions.q.T, order]
    found = [
        (p_value, k, low, high)
        for k, x in enumerate(features)
        if np.ptp(x)
        for p_value, low, high in _thickest(x, rejected)
    ]
    if not found:
        return None
    p_value, k, low, high = min(found)
    p_value = min(p_value * len(features), 1.0)
    if p_value > GATHERED.chance:
        return None
    inside = (features[k] >= low) & (features[k] <= high)
    return Gathering(
        np.flatnonzero(inside & rejected), int(inside.sum()), names[k], low, high, p_value
    )


def bump_in(station: Station, values: np.ndarray) -> Gathering | None:
    """Return the range of a joint in which all targets are displaced alike, as by a bump of its
    drive; None if none is.

    Arms in motion are not tested: an error that lasts for a moment is in a narrow window of each
    joint. Arguments as for
    :func:`fields_of_setup`, rejected rows included.
    """
    is_moving = station.conditions.are_of_motion
    if (
        is_moving
        or not station.sensor.reads_pose
        or station.serial is not None
        or len(station) * GATHERED.part < GATHERED.in_bump
    ):
        return None
    pose = np.unique(same_joints(station.conditions.q, SCATTER), return_inverse=True)[1].ravel()
    if (pose.max() + 1) * GATHERED.part < GATHERED.in_bump:
        return None
    off = station.displacements(values)
    fields = list(fields_of_joints(station, values))
    every = [_Windows.along(field, station, off, pose) for field in fields]
    if not every:
        return None
    surprises = [float(windows.surprises(windows.off).max()) for windows in every]
    best = every[int(np.argmax(surprises))]
    most = max(surprises)
    if np.exp(-most) * len(best.q) * len(best.widths) > GATHERED.permuted:
        return None
    p_value = best.chance(most) * len(fields)
    return None if p_value > GATHERED.bump_chance else best.gathering(p_value)


@dataclass(frozen=True, eq=False)
class _Windows:
    """Windows of a joint's positions, for N poses sorted by these.

    Readings of several targets at one pose are one observation of the joint.

    Attributes:
        joint: its name.
        order: shape (N,), numbers of the poses.
        pose: shape (rows,), the pose of each row.
        q: shape (N,), positions [rad or m].
        lever: shape (N,), motion of all targets of the pose with the joint [m/rad or m/m].
        off: shape (N,), error of these along it [m].
    """

    joint: str
    order: np.ndarray
    pose: np.ndarray
    q: np.ndarray
    lever: np.ndarray
    off: np.ndarray

    @classmethod
    def along(
        cls, field: MotionField, station: Station, off: np.ndarray, pose: np.ndarray
    ) -> _Windows:
        """Return the windows of a joint for errors ``off`` of the targets, shape (rows, 3) [m], at
        poses, shape (rows,).
        """
        _, first = np.unique(pose, return_index=True)
        q = station.conditions.q[first, station.model.chain.robot.joint_names.index(field.name)]
        order = np.argsort(q, kind="stable")
        motion = field.directions[:, :, 0]
        lever = np.sqrt(np.maximum(np.bincount(pose, np.sum(motion**2, axis=1)), 1e-300))
        along = np.bincount(pose, np.einsum("na,na->n", motion, off)) / lever
        return cls(field.name, order, pose, q[order], lever[order], along[order])

    @cached_property
    def widths(self) -> list[int]:
        """Numbers of rows in windows."""
        count = 1 + int(np.log(GATHERED.part * len(self.q) / GATHERED.in_bump) / np.log(_WIDER))
        return [int(GATHERED.in_bump * _WIDER**k) for k in range(count)]

    def _clipped(self, off: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the typical size of errors [m], and clipped errors in units of it, shape (N,)."""
        typical = max(_NORMAL * float(np.median(np.abs(off))), 1e-300)
        return typical, np.where(
            np.abs(off) < GATHERED.outlier * typical,
            np.clip(off / typical, -GATHERED.clipped, GATHERED.clipped),
            0.0,
        )

    def _means(self, clipped: np.ndarray) -> Iterator[np.ndarray]:
        """Yield for each width the means of all windows, in standard deviations, for clipped
        errors, shape (D, N).
        """
        sums = np.zeros((len(clipped), len(self.lever) + 1))
        np.cumsum(self.lever * clipped, axis=1, out=sums[:, 1:])
        squares = np.append(0.0, np.cumsum(self.lever**2))
        for m in self.widths:
            means = np.abs(sums[:, m:] - sums[:, :-m]) / np.sqrt(squares[m:] - squares[:-m])
            some = means[:, :: max(m // _OVERLAPPING, 1)]
            yield means / np.maximum(1.0, _NORMAL * _middles(some))

    def surprises(self, off: np.ndarray) -> np.ndarray:
        """Return minus the log p-value of the most significant window of each width, shape
        (widths,).
        """
        return self._surprises(self._clipped(off)[1][None])[:, 0]

    def _surprises(self, clipped: np.ndarray) -> np.ndarray:
        """Return the same for each of D sets of clipped errors, shape (D, N): shape (widths, D)."""
        largest = np.array([means.max(axis=1) for means in self._means(clipped)])
        # The reference are as many windows as do not overlap.
        degrees = len(self.q) / np.array(self.widths)
        return np.asarray(-np.log(2.0 * stdtr(degrees[:, None], -largest)))

    def chance(self, surprise: float) -> float:
        """Return the probability of a window as significant under permutations of the errors.

        Their largest surprises follow an extreme-value distribution (Gumbel), of which mean and
        standard deviation are drawn; no more permutations are when it is clearly no bump.
        """
        rng = np.random.default_rng(0)
        _, clipped = self._clipped(self.off)
        at_once = max(_AT_ONCE // len(clipped), _FIRST_ORDERS)
        drawn = np.empty(0)
        p_value = 1.0
        while len(drawn) < _ORDERS:
            orders = rng.permuted(np.tile(clipped, (min(at_once, _ORDERS), 1)), axis=1)
            drawn = np.append(drawn, self._surprises(orders).max(axis=0))
            scale = np.sqrt(6.0) / np.pi * float(drawn.std())
            excess = (float(drawn.mean()) - surprise) / scale - np.euler_gamma
            p_value = -float(np.expm1(-np.exp(excess)))
            if p_value > _CLEARLY * GATHERED.bump_chance:
                break
        return p_value

    def gathering(self, p_value: float) -> Gathering:
        """Return the most significant window."""
        k = int(np.argmax(self.surprises(self.off)))
        first = int(np.argmax(list(self._means(self._clipped(self.off)[1][None]))[k][0]))
        m = self.widths[k]
        inside = slice(first, first + m)
        # Wrong readings among them are clipped for the size, too.
        typical, clipped = self._clipped(self.off)
        size = typical * float(
            self.lever[inside] @ clipped[inside] / (self.lever[inside] @ self.lever[inside])
        )
        low = self.q[first]
        high = self.q[first + m - 1]
        rows = np.flatnonzero(np.isin(self.pose, self.order[inside]))
        return Gathering(rows, len(rows), self.joint, float(low), float(high), p_value, size)


def _middles(rows: np.ndarray) -> np.ndarray:
    """Return the median of each row, shape (D, 1): as np.median, which takes twice as long."""
    at = (rows.shape[1] - 1) // 2, rows.shape[1] // 2
    return np.asarray(np.partition(rows, at, axis=1)[:, at].mean(axis=1, keepdims=True))


def _thickest(x: np.ndarray, rejected: np.ndarray) -> Iterator[tuple[float, float, float]]:
    """Yield the p-value and the ends of the window of x with the most significant number of
    rejected rows.
    """
    order = np.sort(x)
    ends = np.sort(x[rejected])
    first = np.searchsorted(order, ends, "left")
    last = np.searchsorted(order, ends, "right")
    i, j = np.triu_indices(len(ends), GATHERED.fewest - 1)
    if len(i):
        chances = bdtrc(j - i, len(ends), (last[j] - first[i]) / len(x))
        best = int(np.argmin(chances))
        yield float(chances[best]) * len(i), float(ends[i[best]]), float(ends[j[best]])


def in_common(station: Station, values: np.ndarray, table: Measurements, apart: np.ndarray) -> str:
    """Return what rows that do not fit have in common, in words; empty if nothing is found.

    ``apart``, shape (N,), are the rows of the table, and of the calibrated model's station, that do
    not fit.
    """
    for name, unit, feature in _features(table):
        for word, inside in _subsamples(feature, apart):
            if (inside == apart).mean() >= 1.0 - GATHERED.mistold * min(float(apart.mean()), 0.5):
                end = feature[inside].min() if word == "at least" else feature[inside].max()
                return f"nearly all of them have {name} {word} {end:.6g}{unit}"
    off = station.displacements(values)[apart]
    squares = float(np.sum(off**2))
    explained = []
    for field in fields_of_joints(station, values):
        along = field.directions[apart, :, 0]
        angle = float(np.sum(off * along) / max(float(np.sum(along**2)), 1e-300))
        explained.append(
            (
                1.0 - float(np.sum((off - along * angle) ** 2)) / squares,
                field.name,
                angle,
                field.unit,
            )
        )
    share, name, angle, unit = max(explained, default=(0.0, "", 0.0, ""))
    return (
        f"{name} appears to be misread by {abs(angle) * 1e3:.3g} m{unit} in them"
        if share >= GATHERED.explained
        else ""
    )


def _features(table: Measurements) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield name, unit and values of each column that rows may have in common."""
    joints = ((name, "", q) for name, q in zip(table.joint_names, table.q.T, strict=True))
    conditions = (("payload", " kg", table.payload), ("temperature", " deg C", table.temperature))
    for name, unit, column in (
        ("line", "", table.rows.astype(float)),
        ("time", " s", table.time),
        *joints,
        *conditions,
    ):
        if column is not None:
            yield name, unit, column


def _subsamples(feature: np.ndarray, apart: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the rows below and above the value that best separates those that do not fit."""
    order = np.argsort(feature, kind="stable")
    wrong = np.cumsum(apart[order])
    n = len(apart)
    total = int(apart.sum())
    ends = np.flatnonzero(np.append(np.diff(feature[order]) > 0, False))
    if not len(ends):
        return
    right = wrong[ends] + (n - (ends + 1)) - (total - wrong[ends])
    values = feature[order][ends]
    yield "at most", feature <= values[np.argmax(right)]
    yield "at least", feature > values[np.argmin(right)]
